"""A rig that is ready to run."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsoft.parallel import single_threaded
from torchsoft.physics.arguments import Numbers
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import Starts, moving
from torchsoft.physics.structure import values_of
from torchsoft.physics.validity import check_values
from torchsoft.rigs.initial import (
    Followed,
    holding_effort,
    initial_poses,
    settled_pads,
    signal,
)
from torchsoft.rigs.schema import RigTables
from torchsoft.solve.simulate import Initial, simulate
from torchsoft.solve.trajectory import Trajectory

STEPPING = ("rtol", "atol", "step", "knots")
"""Arguments of `simulate` that choose the steps."""

SAME = 1e-9
"""Relative difference of values below which a set-point is the one that its rig starts with."""


@dataclass(frozen=True)
class BuiltRig:
    """A rig with the reference that it follows, the state y0 (size,) with which it was built, and
    the times t (T,) [s] of the outputs, the last of which is the end of the motion.

    `file` is the rig file that it was built from, and `solver` the choice of steps. `followed`
    holds the motions that have a value given as "start" or "held", by name; `last` the last start
    without a gradient. Unpacks to rig, y0, t.
    """

    rig: Rig
    y0: Tensor
    t: Tensor
    file: RigTables = field(repr=False)
    followed: Mapping[str, Followed] = field(repr=False)
    solver: Mapping[str, Any] = field(default_factory=dict, repr=False)
    last: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __iter__(self) -> Iterator[Any]:
        return iter((self.rig, self.y0, self.t))

    @property
    def starts(self) -> Starts:
        """Coordinates and rates at which bodies start, by body, as the file gives them."""
        return self.file.starts

    @single_threaded()
    def initial(self, rig: Rig | None = None) -> Initial:
        """The state at the start and the reference, for the parameters that the rig has now, or a
        copy of it with others, and differentiable in them.

        Values of motions given as "start" or "held" follow the start; what was added to them in
        place is kept. Raises `ValueError` naming the field where there is no equilibrium.
        """
        rig = self.rig if rig is None else rig
        key = () if torch.is_grad_enabled() else self.key(rig)
        if key and self.last.get("key") == key:
            return self.last["start"]
        check_values(rig)
        reference = own = self.rig.reference
        driven: Any = {name: own[name] for name in self.file.driven}
        poses = initial_poses(self.file, rig, driven)
        for name, one in self.followed.items():
            if name.replace(".", ":") in own.signals and own[name] is one.signal:
                held = partial(holding_effort, self.file, rig, poses, reference)
                now = signal(self.file, name, poses, held).values
                values = following(one.signal.values, one.values, now)
                reference = reference.replaced({name: one.signal.with_values(values)})
        y0 = moving(rig, settled_pads(self.file, rig, poses, reference), self.starts)
        if key:
            self.last.update(key=key, start=Initial(y0, reference))
        return Initial(y0, reference)

    def key(self, rig: Rig) -> tuple[Any, ...]:
        """All that the start of a rig depends on; empty where that is not known."""
        found, motion = values_of(rig), values_of(self.rig.reference)
        return (*found, *motion) if found and motion else ()

    def start(self) -> Tensor:
        """The state (size,) at the start, for the parameters that the rig has now, which it is
        differentiable in. Raises `ValueError`."""
        return self.initial().y0

    def run(self, t: Numbers | None = None, **options: Any) -> Trajectory:
        """The run, by `simulate` with its `options`: over the times t, by steps as the rig file
        chooses them, and from the start that the rig's present parameters have, where they are not
        given. A state `y0` that is given is constant, and so are the set-points."""
        own = STEPPING if any(options.get(name) is not None for name in STEPPING) else ()
        solver = {name: value for name, value in self.solver.items() if name not in own}
        given: dict[str, Any] = {"y0": self.initial} | solver | options
        return simulate(self.rig, self.t if t is None else t, **given)


def following(values: Tensor, built: Tensor, now: Tensor) -> Tensor:
    """Values (k,) of a motion whose start moved from `built` to `now`: what was added to them in
    place since is kept, but those that are at the present start already, such as of a loaded state
    dict, are left there. Other knots than those that were built follow nothing."""
    if values.shape != built.shape:
        return values
    there = (values != built) & torch.isclose(values, now, rtol=SAME, atol=0.0)
    return now + torch.where(there, values - now.detach(), values - built)
