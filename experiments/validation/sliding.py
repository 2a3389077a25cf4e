"""A box that slides down a slope or to a stop, and a spinning disc that is set down, on one pad.

Lengths are in units of the pad's height L, times of sqrt(L / g), the modulus of m g / L^2: every
mass and size is the same motion.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from experiments.frame import grid
from torchsoft import (
    Body,
    Circle,
    Contact,
    Coulomb,
    KelvinVoigt,
    Pad,
    PadMesh,
    Rig,
    RoundedBox,
    SoftContact,
    Trajectory,
    simulate,
)
from torchsoft.physics.contact import SlipLaw, turned
from torchsoft.physics.mesh import Array
from torchsoft.physics.shapes import Shape
from torchsoft.physics.statics import standing

GRAVITY, MU, RTOL = 9.81, 0.5, 1e-4

E, TAU, SPRINGS = 500.0, 1e-3, 100.0
"""Modulus and retardation time of the pad; K_n and K_t of an area, in units of E / L."""

LENGTH = 20.0
"""Length of the pad."""


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def along(run: Trajectory, angle: float) -> Array:
    """Way of the body [m] up a slope at `angle` [rad]."""
    x, y = run["x_body"] - run["x_body"][0], run["y_body"] - run["y_body"][0]
    return (x * math.cos(angle) + y * math.sin(angle)).numpy()


@dataclass(frozen=True)
class Sliding:
    """A body of `mass` [kg] on a pad of height `size` [m] with `elements` along this height."""

    mass: float = 0.15
    size: float = 12e-3
    friction: SlipLaw = field(default_factory=lambda: Coulomb(MU, MU))
    tau: float = TAU
    elements: int = 8

    @property
    def time(self) -> float:
        return math.sqrt(self.size / GRAVITY)

    @property
    def speed(self) -> float:
        return math.sqrt(self.size * GRAVITY)

    @property
    def box(self) -> Shape:
        return RoundedBox(1.7 * self.size, 0.8 * self.size, radius=0.3 * self.size)

    def rig(self, shape: Shape, angle: float = 0.0, gravity: float = GRAVITY) -> Rig:
        L, spacing, depth = self.size, self.size / self.elements, 3 * self.size
        modulus, tau = E * self.mass * GRAVITY / L**2, self.tau * self.time
        K = SPRINGS * modulus / L * depth * spacing
        R = 0.1 * K * tau
        law = SoftContact(K, R, K, R, friction=self.friction, node_spacing=spacing)
        mesh = PadMesh(LENGTH * L, L, round(LENGTH * self.elements), 3 * self.elements // 4)
        material = KelvinVoigt(modulus, 0.45, 1e3, tau, depth)
        return Rig(
            bodies={"body": Body(self.mass, shape)},
            pads={"pad": Pad(mesh, material, angle=angle, points=2)},
            contacts={"pad": Contact("pad", "body", law)},
            gravity=gravity,
        )

    def start(
        self, shape: Shape, at: float, angle: float = 0.0, v: float = 0.0, omega: float = 0.0
    ) -> tuple[Rig, Tensor]:
        """The body at a place `at` [m] along a slope, with v [m/s] along it and omega [rad/s]."""
        level = self.rig(shape, gravity=GRAVITY * math.cos(angle))
        x, y, _ = level.unpack(level.state(body={"x": at, "y": "rest"})).pose["body"].tolist()
        rig = self.rig(shape, angle)
        place = turned(f64(x, y), f64(angle)[0])
        y0 = standing(rig, {"body": torch.cat((place, f64(angle)))})
        velocity = f64(v * math.cos(angle), v * math.sin(angle), omega)
        y0[rig.layout.slices["velocity", "body"]] = velocity
        return rig, y0

    def run(self, shape: Shape, at: float, t: Tensor, **start: float) -> Trajectory:
        rig, y0 = self.start(shape, at, **start)
        return simulate(rig, t, y0=y0, rtol=RTOL)

    def slope(self, degrees: float) -> dict[str, float]:
        """Acceleration of a box down a slope, from the second half of its way."""
        angle, t = math.radians(degrees), grid(5 * self.time, 0.05 * self.time)
        way = -along(self.run(self.box, 16 * self.size, t, angle=angle), angle)
        half = slice(len(t) // 2, None)
        expected = max(0.0, GRAVITY * (math.sin(angle) - MU * math.cos(angle)))
        found = float(2 * np.polyfit(t[half].numpy(), way[half], 2)[0])
        off = (found - expected) / (expected or GRAVITY)
        return {"expected [m/s2]": expected, "found [m/s2]": found, "off": off}

    def stop(self) -> float:
        """Way of a box to a stop over theory's, less one."""
        v = 2 * self.speed
        t = grid(1.3 * v / (MU * GRAVITY), 0.05 * self.time)
        way = along(self.run(self.box, 3 * self.size, t, v=v), 0.0)
        return float(way[-1] * 2 * MU * GRAVITY / v**2 - 1)

    def spun(self) -> tuple[Array, Array]:
        """A spinning disc set down: times in units of that of slip, spins in units of the first."""
        r, surface = 2 * self.size, 3 * self.speed
        slips = surface / (3 * MU * GRAVITY)
        t = grid(1.5 * slips, 0.01 * slips)
        run = self.run(Circle(r), 5 * self.size, t, omega=-surface / r)
        return run.t.numpy() / slips, -run["omega_body"].numpy() * r / surface

    def errors(self) -> dict[str, float]:
        """All of it over theory's, less one."""
        t, spin = self.spun()
        slides = (t > 0.2) & (t < 0.8)
        rate = float(np.polyfit(t[slides], spin[slides], 1)[0] / (-2 / 3) - 1)
        return {
            "slope of 45 deg": self.slope(45.0)["off"], "stop": self.stop(), "spin's rate": rate,
            "spin of rolling": float(3 * spin[t > 1.1].mean() - 1),
        }  # fmt: skip
