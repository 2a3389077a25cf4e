"""Runs that begin anywhere, in motion or in mid-grasp: poses, velocities and stretches are unknown.

The pads follow from them. They begin settled around the bodies, and forget what that gets wrong within some of their
own times tau: samples should count from `lead` after the beginning only.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.statics import NoEquilibrium, settled
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid.problem.start import PREFIX, Array, Begin, Samples, StartCoordinate, warn_of_memory

LEAD = 50e-3
"""Time [s] for which samples do not count: five of the pads' own times tau."""

Normal = tuple[float, float]
"""Mean and standard deviation."""


class Stretch(NamedTuple):
    """The stretch of a contact's points is linear between `places` (k,) [m] along the pad's face, in the base's frame,
    and zero a step beyond them. There it is normal with mean zero and the standard deviation `sd` [m]."""

    places: tuple[float, ...]
    sd: float

    def basis(self, pad: Pad) -> Array:
        """Stretches of the pad's contact points for one of 1 m at each place (points, k)."""
        at, knots = along(pad, pad.point_positions), np.array(self.places)
        step = np.diff(knots).mean() if len(knots) > 1 else float(pad.mesh.length / pad.mesh.elements_x)
        knots = np.concatenate(([knots[0] - step], knots, [knots[-1] + step]))
        return np.stack([np.interp(at, knots, row) for row in np.eye(len(knots))[1:-1]], -1)


def along(pad: Pad, positions: Tensor) -> Array:
    """Places (...) [m] along a pad's face of positions (..., 2) [m] in its base's frame."""
    return (positions @ pad.axes[:, 0]).detach().numpy()


class MovingStart(NamedTuple):
    """A run begins in motion, `lead` [s] before the first sample.

    `bodies` holds mean and standard deviation of every free coordinate by its name, "disc.x" [m, or rad], and of every
    rate, "disc.v_x" [m/s, or rad/s]. What has a deviation above zero is a coordinate, "start.disc.x". `stretch` holds
    by contact what is known of stretched springs, a coordinate a place, "start.L.stretch.0"; a contact left out has
    none. Places are not points of a mesh, so that the same start serves other meshes.
    """

    bodies: Mapping[str, Normal]
    stretch: Mapping[str, Stretch]
    lead: float = LEAD

    def coordinates(self, rig: Rig, samples: Samples) -> tuple[StartCoordinate, ...]:
        check_names(rig, self.bodies)
        for name in self.stretch:
            if name not in rig.contacts:
                raise ValueError(
                    f"`stretch` of the start speaks of `{name}`; the contacts are {', '.join(rig.contacts)}"
                )
        out = [(f"{PREFIX}{name}", *normal) for name, normal in self.bodies.items()]
        for name, (places, sd) in self.stretch.items():
            if not places or not np.isfinite(places).all() or not (np.diff(places) > 0).all():
                raise ValueError(f"the places of the stretch of `{name}` must be finite and increase, but are {places}")
            out += [(f"{PREFIX}{name}.stretch.{k}", 0.0, sd) for k in range(len(places))]
        for name, mean, sd in out:
            if not (np.isfinite(mean) and np.isfinite(sd) and sd >= 0):
                raise ValueError(f"`{name}` needs a finite mean, and a deviation from 0 on, but has {mean} and {sd}")
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
            basis[name] = torch.from_numpy(self.stretch[name].basis(pad) if name in self.stretch else none)

        def state(values: Mapping[str, Tensor]) -> Tensor:
            stretch = {}
            for name, B in basis.items():
                s = [values.get(f"{PREFIX}{name}.stretch.{k}", B.new_zeros(())) for k in range(B.shape[1])]
                stretch[name] = B @ torch.stack([*s, B.new_zeros(())])[:-1]
            try:
                return settled(rig, *placed(rig, signals, self.bodies, values), stretch)
            except NoEquilibrium as error:
                raise SimulationFailed(f"the run cannot begin there: {error}", at) from None

        return state


def free_coordinates(rig: Rig) -> tuple[str, ...]:
    """Names of the bodies' free coordinates, such as "disc.x", in the order of the state; with rates after them,
    "disc.v_x"."""
    every = [(name, COORDINATES[axis]) for name, axes in rig.layout.free.items() for axis in axes]
    return tuple(f"{name}.{v}{axis}" for v in ("", "v_") for name, axis in every)


def check_names(rig: Rig, bodies: Mapping[str, Normal]) -> None:
    """Raises `ValueError` unless every free coordinate and its rate is given, and nothing else."""
    known = free_coordinates(rig)
    if wrong := [name for name in (*known, *bodies) if (name in known) != (name in bodies)]:
        fault = "is missing" if wrong[0] in known else "is none of them"
        raise ValueError(f"`bodies` of a start must name {', '.join(known)}, but `{wrong[0]}` {fault}")


def placed(
    rig: Rig, signals: Tensor, bodies: Mapping[str, Normal], values: Mapping[str, Tensor]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Poses and velocities by body (3,) for values of the coordinates, the means where there are none; signals
    (signals, 2) place what is driven."""
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
