"""Where the run of a recording begins: at rest in a known place, in a known state, or where some coordinates tell.

A start adds coordinates of its own to a problem, called `start.<body>.<axis>` and the like, each with a prior; their values
travel with those of the parameters, and the state at the beginning is differentiable in both.
"""

import warnings
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.excitation import start
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig
from torchsoft.solve.tangent import directions

Array = NDArray[np.float64]

Samples = Mapping[str, tuple[Array, Array]]
"""Times (k,) [s] and values (k,) by channel."""

PREFIX = "start."
"""How the names of a start's coordinates begin."""

SETTLE = 0.2
"""Time [s] that a disc at rest is given, before the first sample, to sink into the pad: twenty of the pads' own times tau."""

FORGOTTEN = 3.0
"""Longest retardation times of the pads after which what a start gets wrong of their displacements counts as gone."""

BOUNDS = 8.0
"""Bounds of a start's coordinate: so many standard deviations of its prior to each side."""


class StartCoordinate(NamedTuple):
    """One coordinate of a start: its name, its prior's mean, where the search begins, and its standard deviation [SI]."""

    name: str
    mean: float
    sd: float


Begin = Callable[[Mapping[str, Tensor]], Tensor]
"""The state (size,) at the beginning for values of the start's coordinates by name, differentiable in these and in the
parameters of the rig that it was made for."""


class Start(Protocol):
    """Says where a run begins. Its `repr` names everything that decides it."""

    @property
    def lead(self) -> float:
        """Time [s] that is simulated before the first sample."""
        ...

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        """What is unknown of it. Raises `ValueError` for a rig that cannot begin so."""
        ...

    def begin(self, rig: Rig, samples: Samples) -> Begin:
        """The state as a function, for a rig that has the nominal parameters now and may be given others later."""
        ...


class AtRest(NamedTuple):
    """The disc of the paper's rig at rest on the lower pad at x [m], by default `scenario.x_C0`, and the bracket clear of it.

    `position_sd` [m] is how well that is known: above zero the place of the disc is a coordinate, `start.disc.x`. The
    displacements of the pads are those at the nominal parameters, whatever the others are: most of what that gets wrong
    has died away at the first sample.
    """

    position_sd: float = 0.0
    x: float | None = None
    lead: float = SETTLE

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        if not isinstance(rig, SoftGrasp):
            raise ValueError("only the paper's rig has a rest of its own: give the recording another `start`")
        warn_of_memory(rig, self.lead)
        if not 0 <= self.position_sd <= 0.1:
            raise ValueError(f"`position_sd` must be from 0 to 0.1 m, but is {self.position_sd}")
        return (StartCoordinate("start.disc.x", self.place(rig), self.position_sd),) if self.position_sd > 0 else ()

    def place(self, rig: SoftGrasp) -> float:
        """x of the disc [m]."""
        return rig.settings.scenario.x_C0 if self.x is None else self.x

    def begin(self, rig: Rig, samples: Samples) -> Begin:
        assert isinstance(rig, SoftGrasp)
        return RestState(rig, rig, self.place(rig))


class Known(NamedTuple):
    """A state y0 (size,) that is known, `lead` [s] before the first sample."""

    y0: Tensor
    lead: float = 0.0

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        rig.layout.check(self.y0)
        return ()

    def begin(self, rig: Rig, samples: Samples) -> Begin:
        return lambda values: self.y0

    def __repr__(self) -> str:
        return f"Known({self.y0.tolist()}, {self.lead})"


class RestState:
    """The state of `AtRest`: displacements stay when parameters change, and massless pads get the forces that hold them so."""

    def __init__(self, nominal: SoftGrasp, rig: SoftGrasp, x: float) -> None:
        self.rig, self.nominal = rig, deepcopy(nominal).requires_grad_(False)
        self.x0 = torch.tensor(x, dtype=torch.float64)
        self.x: float | None = None

    def __call__(self, values: Mapping[str, Tensor]) -> Tensor:
        x = values.get("start.disc.x", self.x0)
        if float(x.detach()) != self.x:
            at = x.detach().clone().requires_grad_(True)
            y = start(self.nominal, at)
            self.x, self.y = float(at.detach()), y.detach()
            self.slope = torch.from_numpy(directions(y, [at])[:, 0])
        state = self.rig.unpack(self.y + self.slope * (x - x.detach()))
        pads = dict(state.pads)
        for name, pad in self.rig.pads.items():
            if not pad.inertial:
                pads[name] = held_forces(pad, pads[name], self.nominal.pads[name])
        return self.rig.pack(state._replace(pads=pads))


def held_start(nominal: SoftGrasp, rig: SoftGrasp) -> Tensor:
    """The state (size,) of `AtRest` for a rig that may have other parameters than the nominal one."""
    return RestState(nominal, rig, AtRest().place(nominal))({})


def warn_of_memory(rig: Rig, lead: float) -> None:
    """Warns of massless pads that do not forget their beginning before the first sample, `lead` [s] later."""
    for name, pad in rig.pads.items():
        longest = float(pad.material.chain()[1].detach().max())
        if not pad.inertial and lead < FORGOTTEN * longest:
            warnings.warn(
                f"the run begins {lead:g} s before the first sample, but the pad `{name}` creeps for {longest:.3g} s: what "
                f"is not known of its beginning reaches the samples; a `lead` of {FORGOTTEN * longest:.3g} s would do",
                stacklevel=2,
            )


def held_forces(pad: Pad, z: Tensor, nominal: Pad) -> Tensor:
    """Forces (branches, nodes, 2) [N] that make, with the pad's present material, the displacements that z makes with the
    nominal one.

    They are in proportion to E depth, which needs no linear solve: a solve's last bits differ from call to call, and a run that
    is made again must be the same.
    """
    material, was = pad.material, nominal.material
    if float(material.nu.detach()) != float(was.nu):
        fractions, _ = was.chain()
        u = nominal.compliance() @ (fractions[:, None, None] * z).sum(-3).flatten()
        f = torch.linalg.solve(pad.compliance(), u)
        f = torch.round(f.detach(), decimals=9) + (f - f.detach())
        return f.unflatten(0, (-1, 2)).expand(z.shape)
    scaled = z * (material.E * material.depth / float(was.E * was.depth))
    C, dC = pad.unit_compliance()
    by_nu = -torch.linalg.solve(C, dC @ scaled.detach().flatten(-2).mT).mT.reshape(z.shape)
    return scaled + by_nu * (material.nu - material.nu.detach())
