"""Where the run of a recording begins: at rest in a known place, in a known state, or where some
coordinates tell.

A start adds coordinates of its own to a problem, called `start.<body>.<axis>` and the like, each
with a prior; their values travel with those of the parameters, and the state at the beginning is
differentiable in both.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.excitation import start
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, resting, settled, standing
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.tangent import directions

Array = NDArray[np.float64]

Samples = Mapping[str, tuple[Array, Array]]
"""Times (k,) [s] and values (k,) by channel."""

PREFIX = "start."
"""How the names of a start's coordinates begin."""

SETTLE = 0.2
"""Time [s] that a disc at rest is given, before the first sample, to sink into the pad: twenty of
the pads' own times tau."""

FORGOTTEN = 3.0
"""Longest retardation times of the pads after which what a start gets wrong of their displacements
counts as gone."""

BOUNDS = 8.0
"""Bounds of a start's coordinate: so many standard deviations of its prior to each side."""


class StartCoordinate(NamedTuple):
    """One coordinate of a start: its name, its prior's mean, where the search begins, and its
    standard deviation [SI]."""

    name: str
    mean: float
    sd: float


Begin = Callable[[Mapping[str, Tensor]], Tensor]
"""The state (size,) at the beginning for values of the start's coordinates by name, differentiable
in these and in the parameters of the rig that it was made for."""


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
        """The state as a function, for a rig that has the nominal parameters now and may be given
        others later."""
        ...


class AtRest(NamedTuple):
    """The disc of the paper's rig at rest on the lower pad at x [m], by default `scenario.x_C0`,
    and the bracket clear of it.

    `position_sd` [m] is how well that is known: above zero the place of the disc is a coordinate,
    `start.disc.x`. The displacements of the pads are those at the nominal parameters, whatever the
    others are: most of what that gets wrong has died away at the first sample.
    """

    position_sd: float = 0.0
    x: float | None = None
    lead: float = SETTLE

    def __str__(self) -> str:
        place = "scenario.x_C0" if self.x is None else f"x = {self.x:g} m"
        return f"{self.lead:g} s early, the disc at rest at {place} ± {self.position_sd:g} m"

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        if not isinstance(rig, SoftGrasp):
            raise ValueError(
                "only the paper's rig has a rest of its own: give the recording another `start`"
            )
        warn_of_memory(rig, self.lead)
        if not 0 <= self.position_sd <= 0.1:
            raise ValueError(f"`position_sd` must be from 0 to 0.1 m, but is {self.position_sd}")
        return (
            (StartCoordinate("start.disc.x", self.place(rig), self.position_sd),)
            if self.position_sd > 0
            else ()
        )

    def place(self, rig: SoftGrasp) -> float:
        """x of the disc [m]."""
        return rig.settings.scenario.x_C0 if self.x is None else self.x

    def begin(self, rig: Rig, samples: Samples) -> Begin:
        assert isinstance(rig, SoftGrasp)
        return held(rig, self.place(rig), rig)


class Standing(NamedTuple):
    """Bodies stand at known places, `lead` [s] before the first sample, and pads have settled
    around them.

    `bodies` holds coordinates and rates of every body, 3 each [m, rad, m/s, rad/s]; `rests` by body
    the numbers of the coordinates that are in balance instead, no actuator pushing; `position_sd`
    the standard deviations of coordinates such as "disc.x" [m, rad], which are coordinates of the
    start. Rest and pads are those of the present parameters, not of the nominal ones.
    """

    bodies: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]
    lead: float = SETTLE
    rests: Mapping[str, Sequence[int]] = MappingProxyType({})
    position_sd: Mapping[str, float] = MappingProxyType({})

    @classmethod
    def of(cls, rig: Rig, y0: Tensor, lead: float = SETTLE) -> "Standing":
        """The places of the state y0 (size,)."""
        state = rig.unpack(y0.detach())
        pairs = zip(state.pose.items(), state.velocity.values())
        return cls({k: (tuple(q.tolist()), tuple(v.tolist())) for (k, q), v in pairs}, lead)

    def __repr__(self) -> str:
        rests, sd = dict(self.rests), dict(self.position_sd)
        return f"Standing({dict(self.bodies)}, {self.lead}, {rests}, {sd})"

    def __str__(self) -> str:
        return f"{self.lead:g} s early, bodies at known places, pads settled around them"

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        if self.lead > 0:
            warn_of_memory(rig, self.lead)
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
        """Where the body of a coordinate stands [m or rad]."""
        body, axis = coordinate.split(".")
        return self.bodies[body][0][COORDINATES.index(axis)]

    def begin(self, rig: Rig, samples: Samples) -> Begin:
        at = min(float(t[0]) for t, _ in samples.values()) - self.lead
        given, velocity = (
            {name: torch.tensor(one[k], dtype=torch.float64) for name, one in self.bodies.items()}
            for k in range(2)
        )
        still = torch.zeros(len(rig.signals), 2, dtype=torch.float64)

        def state(values: Mapping[str, Tensor]) -> Tensor:
            pose = dict(given)
            for name in self.position_sd:
                if (place := values.get(f"{PREFIX}{name}")) is not None:
                    body, axis = name.split(".")
                    row = torch.eye(3, dtype=torch.float64)[COORDINATES.index(axis)]
                    pose[body] = pose[body] + (place - self.place(name)) * row
            try:
                if self.rests:
                    pose = resting(rig, pose, self.rests, signals=still, actuators=())
                found = rig.unpack(standing(rig, pose))
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

    def begin(self, rig: Rig, samples: Samples) -> Begin:
        return lambda values: self.y0

    def __repr__(self) -> str:
        return f"Known({self.y0.tolist()}, {self.lead})"

    def __str__(self) -> str:
        return f"{self.lead:g} s early, in a known state"


class HeldPads:
    """A nominal state, given by the start's coordinates: displacements stay when parameters change,
    and massless pads get the forces that hold them so."""

    def __init__(self, nominal: Rig, rig: Rig, state: Begin) -> None:
        self.rig, self.nominal, self.state = rig, deepcopy(nominal).requires_grad_(False), state

    def __call__(self, values: Mapping[str, Tensor]) -> Tensor:
        state = self.rig.unpack(self.state(values))
        pads = dict(state.pads)
        for name, pad in self.rig.pads.items():
            if not pad.inertial:
                pads[name] = held_forces(pad, pads[name], self.nominal.pads[name])
        return self.rig.pack(state._replace(pads=pads))


def held(nominal: SoftGrasp, place: float, rig: SoftGrasp) -> HeldPads:
    """The state of `AtRest`, the disc at `place` [m] unless its coordinate says otherwise."""
    own, known = deepcopy(nominal).requires_grad_(False), dict[float, tuple[Tensor, Tensor]]()

    def state(values: Mapping[str, Tensor]) -> Tensor:
        x = values.get("start.disc.x", torch.tensor(place, dtype=torch.float64))
        if float(x.detach()) not in known:
            at = x.detach().clone().requires_grad_(True)
            y = start(own, at)
            known.clear()
            known[float(at.detach())] = y.detach(), torch.from_numpy(directions(y, [at])[:, 0])
        y, slope = known[float(x.detach())]
        return y + slope * (x - x.detach())

    return HeldPads(nominal, rig, state)


def warn_of_memory(rig: Rig, lead: float) -> None:
    """Warns of massless pads that do not forget their beginning before the first sample, `lead` [s]
    later."""
    for name, pad in rig.pads.items():
        longest = float(pad.chain()[1].detach().max())
        if not pad.inertial and lead < FORGOTTEN * longest:
            warnings.warn(
                f"the run begins {lead:g} s before the first sample, but the pad `{name}` creeps "
                f"for {longest:.3g} s: what is not known of its beginning reaches the samples; a "
                f"`lead` of {FORGOTTEN * longest:.3g} s would do",
                stacklevel=2,
            )


def held_forces(pad: Pad, z: Tensor, nominal: Pad) -> Tensor:
    """Forces (branches, nodes, 2) [N] that make, with the pad's present material, the displacements
    that z makes with the nominal one.

    They are in proportion to E depth, which needs no linear solve: a solve's last bits differ from
    call to call, and a run that is made again must be the same.
    """
    material, was = pad.material, nominal.material
    if float(material.nu.detach()) != float(was.nu):
        fractions, _ = nominal.chain()
        u = nominal.compliance() @ (fractions[:, None, None] * z).sum(-3).flatten()
        f = torch.linalg.solve(pad.compliance(), u)
        f = torch.round(f.detach(), decimals=9) + (f - f.detach())
        return f.unflatten(0, (-1, 2)).expand(z.shape)
    scaled = z * (pad.E * material.depth / float(nominal.E * was.depth))
    C, dC = pad.unit_compliance()
    by_nu = -torch.linalg.solve(C, dC @ scaled.detach().flatten(-2).mT).mT.reshape(z.shape)
    return scaled + by_nu * (material.nu - material.nu.detach())


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
    """A run begins in motion, `lead` [s] before the first sample.

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

    def begin(self, rig: Rig, samples: Samples) -> Begin:
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
                return settled(rig, *placed(rig, signals, self.bodies, values), stretch)
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
