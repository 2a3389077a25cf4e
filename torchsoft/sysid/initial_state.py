"""Starts of recorded runs: at rest in a known place, in a known state, or at coordinates to be
estimated.

A start adds coordinates of its own to a problem, called `start.<body>.<axis>` and the like, each
with a prior; their values travel with those of the parameters, and the initial state is
differentiable in both.
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.display import suggestion
from torchsoft.physics.motion import Piecewise, Reference
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import REST, balanced
from torchsoft.physics.statics import NoEquilibrium, settled, standing
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.initial import FollowedStart
from torchsoft.solve.progress import SimulationFailed

Array = NDArray[np.float64]

Samples = Mapping[str, tuple[Array, Array]]
"""Times (k,) [s] and values (k,) by channel."""

BALANCED = 1e-8
"""Last step of the search for a body at rest [m]; its convergence is quadratic."""

PREFIX = "start."
"""Prefix of the names of a start's coordinates."""

SETTLE = 0.2
"""Time [s] that a disc at rest is given, before the first sample, to sink into the pad: twenty of
the pads' own times tau."""

FORGOTTEN = 3.0
"""Longest retardation times of the pads after which what a start gets wrong of their displacements
counts as gone."""

BOUNDS = 8.0
"""Bounds of a start's coordinate: so many standard deviations of its prior to each side."""


class StartCoordinate(NamedTuple):
    """One coordinate of a start: its name, its prior's mean, where the search starts, and its
    standard deviation [SI]."""

    name: str
    mean: float
    sd: float


InitialState = Callable[[Mapping[str, Tensor]], Tensor]
"""The initial state (size,) for values of the start's coordinates by name, differentiable
in these and in the parameters of the rig that it was made for."""


class Start(Protocol):
    """Start of a run. Its `repr` names everything that decides it."""

    @property
    def lead(self) -> float:
        """Time [s] that is simulated before the first sample."""
        ...

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        """Unknown coordinates. Raises `ValueError` for a rig that cannot start so."""
        ...

    def initial_state(self, rig: Rig, samples: Samples) -> InitialState:
        """The state as a function, for a rig that has the nominal parameters now and may be given
        others later."""
        ...


class Standing(NamedTuple):
    """Bodies stand at known places, `lead` [s] before the first sample, and pads have settled
    around them.

    `bodies` holds coordinates and rates of every body, 3 each [m, rad, m/s, rad/s]; `rests` by body
    the numbers of the coordinates that are in balance instead, no actuator pushing; `position_sd`
    the standard deviations of coordinates such as "disc.x" [m, rad], which are coordinates of the
    start; `presses` the bodies whose pads come down upon others, and how far, as a rig file says
    it; `followed` the motions whose values follow a coordinate that rests or presses. All are those
    of the present parameters, not of the nominal ones.
    """

    bodies: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]
    lead: float = SETTLE
    rests: Mapping[str, Sequence[int]] = MappingProxyType({})
    position_sd: Mapping[str, float] = MappingProxyType({})
    presses: Mapping[str, Any] = MappingProxyType({})
    followed: Mapping[str, FollowedStart] = MappingProxyType({})

    @classmethod
    def built(
        cls, built: BuiltRig, lead: float = SETTLE, position_sd: Mapping[str, float] | None = None
    ) -> "Standing":
        """Bodies where a rig file starts them, at rest or pressed with the present parameters."""
        file, rig = built.file, built.rig
        out, rests = cls.of(rig, built.y0, lead, file.rests(), position_sd), file.rests()
        presses = {
            name: given["y"] for name, given in built.starts.items()
            if isinstance(given.get("y"), str | Mapping) and given["y"] != REST
        }  # fmt: skip
        solved = [f"{name}.{COORDINATES[i]}" for name, axes in rests.items() for i in axes]
        solved += [f"{name}.y" for name in presses]
        followed = {
            name: one.start for name, one in built.followed.items()
            if one.start and one.start.coordinate in solved
        }  # fmt: skip
        return out._replace(presses=presses, followed=followed)

    @classmethod
    def of(
        cls,
        rig: Rig,
        y0: Tensor,
        lead: float = SETTLE,
        rests: Mapping[str, Sequence[int]] | None = None,
        position_sd: Mapping[str, float] | None = None,
    ) -> "Standing":
        """Bodies at the places of the state y0 (size,). Warns of pads that do not forget their
        initial state within the lead."""
        if lead > 0:
            warn_of_memory(rig, lead)
        state = rig.unpack(y0.detach())
        pairs = zip(state.pose.items(), state.velocity.values())
        bodies = {k: (tuple(q.tolist()), tuple(v.tolist())) for (k, q), v in pairs}
        return cls(bodies, lead, dict(rests or {}), dict(position_sd or {}))

    def __repr__(self) -> str:
        rests, sd = dict(self.rests), dict(self.position_sd)
        more = "".join(f", {dict(one)}" for one in (self.presses, self.followed) if one)
        return f"Standing({dict(self.bodies)}, {self.lead}, {rests}, {sd}{more})"

    def __str__(self) -> str:
        return f"{self.lead:g} s early, bodies at known places, pads settled around them"

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        known = free_coordinates(rig)[: len(free_coordinates(rig)) // 2]
        for name in self.position_sd:
            if name not in known:
                raise ValueError(
                    f"`position_sd` of the start speaks of `{name}`; "
                    f"{suggestion(name, known, 'there are')}"
                )
        return tuple(
            StartCoordinate(f"{PREFIX}{name}", self.place(name), sd)
            for name, sd in self.position_sd.items()
            if sd > 0
        )

    def place(self, coordinate: str) -> float:
        """Stated value of a coordinate [m or rad]."""
        body, axis = coordinate.split(".")
        return self.bodies[body][0][COORDINATES.index(axis)]

    def initial_state(self, rig: Rig, samples: Samples) -> InitialState:
        at = min(float(t[0]) for t, _ in samples.values()) - self.lead
        given, velocity = (
            {name: torch.tensor(one[k], dtype=torch.float64) for name, one in self.bodies.items()}
            for k in range(2)
        )

        def state(values: Mapping[str, Tensor]) -> Tensor:
            pose = dict(given)
            for name in self.position_sd:
                if (place := values.get(f"{PREFIX}{name}")) is not None:
                    body, axis = name.split(".")
                    row = torch.eye(3, dtype=torch.float64)[COORDINATES.index(axis)]
                    pose[body] = pose[body] + (place - self.place(name)) * row
            try:
                pose = balanced(rig, pose, self.rests, self.presses, BALANCED)
                reference = reference_from(rig, self, pose)
                found = rig.unpack(standing(rig, pose, at, reference))
            except NoEquilibrium as error:
                raise SimulationFailed(f"the run cannot begin there: {error}", at) from None
            moving = {name: velocity[name] for name in found.velocity}
            return rig.pack(found._replace(velocity=moving))

        return state


class Known(NamedTuple):
    """A state y0 (size,) that is known, `lead` [s] before the first sample."""

    y0: Tensor
    lead: float = 0.0

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        rig.layout.check(self.y0)
        return ()

    def initial_state(self, rig: Rig, samples: Samples) -> InitialState:
        return lambda values: self.y0

    def __repr__(self) -> str:
        return f"Known({self.y0.tolist()}, {self.lead})"

    def __str__(self) -> str:
        return f"{self.lead:g} s early, in a known state"


def reference_from(rig: Rig, start: Start, pose: Mapping[str, Tensor]) -> Reference:
    """The reference of a run whose bodies start at `pose` (3,), with set-points that follow."""
    signals = {}
    for name, one in getattr(start, "followed", {}).items():
        signal: Piecewise = rig.reference[name]  # pyright: ignore[reportAssignmentType]
        signals[name] = signal.with_values(signal.values + one.shift(pose))
    return rig.reference.replaced(signals)


def warn_of_memory(rig: Rig, lead: float) -> None:
    """Warns of massless pads that do not forget their initial state before the first sample,
    `lead` [s] later."""
    for name, pad in rig.pads.items():
        longest = float(pad.chain()[1].detach().max())
        if not pad.inertial and lead < FORGOTTEN * longest:
            warn(
                f"the run begins {lead:g} s before the first sample, but the pad `{name}` creeps "
                f"for {longest:.3g} s: what is not known of its beginning reaches the samples; a "
                f"`lead` of {FORGOTTEN * longest:.3g} s would do",
            )


# Starts in motion or in mid-grasp


LEAD = 50e-3
"""Time [s] for which samples do not count: five of the pads' own times tau."""

Normal = tuple[float, float]
"""Mean and standard deviation."""


class Stretch(NamedTuple):
    """The stretch of a contact's points is linear between `places` (k,) [m] along the pad's face,
    in the base's frame, and zero a step beyond them. There it is normal with mean zero and the
    standard deviation `sd` [m]."""

    places: tuple[float, ...]
    sd: float

    def basis(self, pad: Pad) -> Array:
        """Stretches of the pad's contact points for one of 1 m at each place (points, k)."""
        at, knots = along(pad, pad.point_positions), np.array(self.places)
        step = (
            np.diff(knots).mean()
            if len(knots) > 1
            else float(pad.mesh.length / pad.mesh.elements_x)
        )
        knots = np.concatenate(([knots[0] - step], knots, [knots[-1] + step]))
        return np.stack([np.interp(at, knots, row) for row in np.eye(len(knots))[1:-1]], -1)


def along(pad: Pad, positions: Tensor) -> Array:
    """Places (...) [m] along a pad's face of positions (..., 2) [m] in its base's frame."""
    return (positions @ pad.axes[:, 0]).detach().numpy()


class MovingStart(NamedTuple):
    """A run starts in motion, `lead` [s] before the first sample.

    `bodies` holds mean and standard deviation of every free coordinate by its name, "disc.x" [m, or
    rad], and of every rate, "disc.v_x" [m/s, or rad/s]. What has a deviation above zero is a
    coordinate, "start.disc.x". `stretch` holds by contact what is known of stretched springs, a
    coordinate a place, "start.L.stretch.0"; a contact left out has none. Places are not points of a
    mesh, so that the same start serves other meshes.
    """

    bodies: Mapping[str, Normal]
    stretch: Mapping[str, Stretch]
    lead: float = LEAD

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        check_names(rig, self.bodies)
        for name in self.stretch:
            if name not in rig.contacts:
                raise ValueError(
                    f"`stretch` of the start speaks of `{name}`; the contacts are "
                    f"{', '.join(rig.contacts)}"
                )
        out = [(f"{PREFIX}{name}", *normal) for name, normal in self.bodies.items()]
        for name, (places, sd) in self.stretch.items():
            if not places or not np.isfinite(places).all() or not (np.diff(places) > 0).all():
                raise ValueError(
                    f"the places of the stretch of `{name}` must be finite and increase, but are "
                    f"{places}"
                )
            out += [(f"{PREFIX}{name}.stretch.{k}", 0.0, sd) for k in range(len(places))]
        for name, mean, sd in out:
            if not (np.isfinite(mean) and np.isfinite(sd) and sd >= 0):
                raise ValueError(
                    f"`{name}` needs a finite mean, and a deviation from 0 on, but has {mean} and "
                    f"{sd}"
                )
        if not (np.isfinite(self.lead) and self.lead >= 0):
            raise ValueError(f"`lead` of the start must not be negative, but is {self.lead}")
        warn_of_memory(rig, self.lead)
        return tuple(StartCoordinate(*one) for one in out if one[2] > 0)

    def initial_state(self, rig: Rig, samples: Samples) -> InitialState:
        at = min(float(t[0]) for t, _ in samples.values()) - self.lead
        signals, basis = rig.follow(at).detach(), {}
        for name, contact in rig.contacts.items():
            pad = rig.pads[contact.pad]
            none = np.zeros((len(pad.point_nodes), 0))
            basis[name] = torch.from_numpy(
                self.stretch[name].basis(pad) if name in self.stretch else none
            )

        def state(values: Mapping[str, Tensor]) -> Tensor:
            stretch = {}
            for name, B in basis.items():
                s = [
                    values.get(f"{PREFIX}{name}.stretch.{k}", B.new_zeros(()))
                    for k in range(B.shape[1])
                ]
                stretch[name] = B @ torch.stack([*s, B.new_zeros(())])[:-1]
            try:
                return settled(rig, *placed(rig, signals, self.bodies, values), stretch, at)
            except NoEquilibrium as error:
                raise SimulationFailed(f"the run cannot begin there: {error}", at) from None

        return state


def free_coordinates(rig: Rig) -> tuple[str, ...]:
    """Names of the bodies' free coordinates, such as "disc.x", in the order of the state; with
    rates after them, "disc.v_x"."""
    every = [(name, COORDINATES[axis]) for name, axes in rig.layout.free.items() for axis in axes]
    return tuple(f"{name}.{v}{axis}" for v in ("", "v_") for name, axis in every)


def check_names(rig: Rig, bodies: Mapping[str, Normal]) -> None:
    """Raises `ValueError` unless every free coordinate and its rate is given, and nothing else."""
    known = free_coordinates(rig)
    if wrong := [name for name in (*known, *bodies) if (name in known) != (name in bodies)]:
        fault = "is missing" if wrong[0] in known else "is none of them"
        raise ValueError(
            f"`bodies` of a start must name {', '.join(known)}, but `{wrong[0]}` {fault}"
        )


def placed(
    rig: Rig, signals: Tensor, bodies: Mapping[str, Normal], values: Mapping[str, Tensor]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Poses and velocities by body (3,) for values of the coordinates, the means where there are
    none; signals (signals, 2) place what is driven."""
    parts = rig.held(signals)
    for part, v in zip(parts, ("", "v_")):
        for name, axes in rig.layout.free.items():
            rows = list(part[name].detach().unbind())
            for axis in axes:
                key = f"{name}.{v}{COORDINATES[axis]}"
                mean = torch.tensor(bodies[key][0], dtype=torch.float64)
                rows[axis] = values.get(PREFIX + key, mean)
            part[name] = torch.stack(rows)
    return parts
