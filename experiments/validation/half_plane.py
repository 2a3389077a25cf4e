"""A rigid body on a pad so thick that it is nearly a half-plane, beside Hertz, the flat punch,
Cattaneo and Mindlin, and Carter. Lengths are in units of the contact's half-width by theory, A."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from experiments.frame import grid
from experiments.validation.sliding import GRAVITY, MU, RTOL, f64
from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    Coulomb,
    KelvinVoigt,
    Pad,
    Profile,
    QuadMesh,
    Reference,
    Rig,
    RoundedBox,
    Sampled,
    SoftContact,
    Trajectory,
    hold,
    simulate,
)
from torchsoft.physics.mesh import Array
from torchsoft.physics.mesh.mesh import quads
from torchsoft.physics.shapes import Shape
from torchsoft.physics.statics import resting, standing

A, RADIUS, DEPTH, MODULUS = 10e-3, 2.0, 40e-3, 1e6
"""Half-width by theory, radius of the circle and depth [m], and E* [Pa], of the half-plane."""

TAU, GROWTH, WIDE = 1e-4, 1.2, 120.0
"""Its retardation time [s]; of its mesh the growth of elements outwards, and its half-width."""

PEAK = MODULUS * A / (2 * RADIUS)
"""Hertz's largest pressure [Pa]."""

CORNER = 0.02
"""Radius of the punch's corners over its half-width."""

STROKE = 1.8
"""Of the tangential displacement, over mu a^2 / R: 0.6 to 0.7 of what makes all slip."""

WAY = 5.0
"""Of a roll."""


def growing(first: float, whole: float) -> Array:
    """Distances [m] of nodes that go away in steps growing by `GROWTH`, up to `whole`."""
    way = np.cumsum(first * GROWTH ** np.arange(1, 400))
    way = way[: int(np.searchsorted(way, whole)) + 1]
    return way * whole / way[-1]


@dataclass(frozen=True)
class HalfPlane:
    nu: float = 0.49
    elements: int = 20  # over the half-width
    springs: float = 100.0  # K_n and K_t of an area, in units of E* / a
    thick: float = 120.0  # height of the pad
    rolled: float = 0.0  # to the right of the contact, where elements are small too

    @property
    def load(self) -> float:
        """Normal force [N] under which a circle of `RADIUS` touches over 2 a, by Hertz."""
        return math.pi * MODULUS * A**2 / (4 * RADIUS) * DEPTH

    def mesh(self) -> QuadMesh:
        """Small squares under the contact, growing outwards and downwards."""
        h = A / self.elements
        count = round((2.6 + self.rolled) * self.elements)
        middle = -1.3 * A + h * np.arange(count + 1)
        out = growing(h, WIDE * A)
        x = np.concatenate((middle[0] - out[::-1], middle, middle[-1] + out))
        y = np.concatenate((-growing(h, self.thick * A)[::-1], [0.0]))
        points = np.stack(np.broadcast_arrays(x[:, None], y), -1).reshape(-1, 2)
        number = np.arange(len(points)).reshape(len(x), len(y))
        sides = lambda line: np.stack((line[:-1], line[1:]), -1)
        bonded = np.concatenate((sides(number[:, 0]), sides(number[0]), sides(number[-1])))
        return QuadMesh.of(points, quads(number), sides(number[1:-1, -1]), bonded)

    def rig(self, shape: Shape, reference: Reference | None = None, turns: bool = False) -> Rig:
        """The body under its load, with x driven and y free; `turns`: theta free under a moment."""
        h = A / self.elements
        K = self.springs * MODULUS / A * DEPTH * h
        law = SoftContact(K, K * TAU, K, K * TAU, friction=Coulomb(MU, MU), node_spacing=h)
        material = KelvinVoigt(MODULUS * (1 - self.nu**2), self.nu, 1e3, TAU, DEPTH)
        theta = "free" if turns else 0.0
        twist = Actuator(
            "body.theta", "body.theta", PD(0.0, 0.0), setpoint="theta_d", feed_forward="moment"
        )
        return Rig(
            bodies={"body": Body(self.load / GRAVITY, shape, x="driven", theta=theta)},
            pads={"pad": Pad(self.mesh(), material, points=2)},
            contacts={"pad": Contact("pad", "body", law)},
            actuators={"twist": twist} if turns else {},
            reference=reference or hold(**{"body.x": 0.0}),
            gravity=GRAVITY,
        )


STIFF = HalfPlane(elements=40, springs=400.0)


class Tractions(NamedTuple):
    """Of the elements along the surface: places and lengths [m], pressure and shear [Pa]."""

    x: Array
    length: Array
    p: Array
    q: Array

    @property
    def friction(self) -> float:
        """Q / (mu P)."""
        return float((self.length * self.q).sum() / (MU * (self.length * self.p).sum()))


def tractions(rig: Rig, forces: Array) -> Tractions:
    """Of the normal and tangential forces (points, 2) [N], the two points of each element together:
    at the edge of a stick zone they lie on either side of theory."""
    pad = rig.pads["pad"]
    pair = lambda points: points.reshape(-1, 2).sum(-1)
    x, length = 0.5 * pad.point_positions[:, 0].numpy(), np.asarray(pad.point_lengths)
    p, q = (pair(force) / (DEPTH * pair(length)) for force in forces.T)
    return Tractions(pair(x), pair(length), p, q)


def along(rig: Rig, run: Trajectory) -> list[Tractions]:
    """Tractions at every time of a run."""
    return [tractions(rig, at) for at in run.force["pad"].numpy()]


def ellipse(x: Array, y: Array, within: float) -> tuple[float, float]:
    """Half-width [m] and height of y = y_0 sqrt(1 - x^2 / a^2) by least squares in |x| <
    `within`."""
    k = abs(x) < within
    slope, top = np.polyfit(x[k] ** 2, y[k] ** 2, 1)
    return math.sqrt(-top / slope), math.sqrt(top)


def root(x: Array, a: float) -> Array:
    """sqrt(1 - x^2 / a^2), zero outside of a."""
    return np.sqrt(np.clip(1 - (x / a) ** 2, 0.0, None))


def pressed(rig: Rig, top: float) -> Tensor:
    """The rig with its body at rest, sought from about Hertz's approach below `top` [m], the height
    at which it touches."""
    near = f64(0.0, top - 2.0 * A**2 / RADIUS, 0.0)
    return standing(rig, resting(rig, {"body": near}, {"body": (1,)}))


@torch.no_grad()
def still(rig: Rig, top: float) -> Tractions:
    """Of the body at rest, which no friction holds."""
    state = rig.unpack(pressed(rig, top))
    graph = rig.evaluate(0.0, state, rig.follow(0.0), settled=True)
    F_N = graph.interfaces["pad"].F_N.numpy()
    return tractions(rig, np.stack((F_N, 0 * F_N), -1))


def hertz(case: HalfPlane) -> dict[str, float]:
    """Half-width and peak pressure of a circle over Hertz's, less one."""
    at = still(case.rig(Circle(RADIUS)), RADIUS)
    a, top = ellipse(at.x, at.p, 0.9 * A)
    return {"Hertz: a": a / A - 1, "Hertz: p_0": top / PEAK - 1}


def punch(case: HalfPlane) -> dict[str, float]:
    """A flat punch: the half-width that its pressure has over that of its flat side, less one; the
    largest error of the pressure in the inner 70 %, by that half-width and by the flat side's."""
    at = still(case.rig(RoundedBox(A, 0.5 * A, radius=CORNER * A)), 0.5 * A)
    k = abs(at.x) < 0.7 * A
    slope, top = np.polyfit(at.x[k] ** 2, at.p[k] ** -2, 1)
    flat, own = (1 - CORNER) * A, math.sqrt(-top / slope)
    pressure = lambda a: case.load / DEPTH / (math.pi * np.sqrt(a**2 - at.x[k] ** 2))
    off = [float(abs(at.p[k] / pressure(a) - 1).max()) for a in (own, flat)]
    return {"punch: a": own / flat - 1, "punch: p": off[0], "punch: p, a of the flat": off[1]}


def sheared(x: Array, Q: float, most: float | None = None) -> Array:
    """Cattaneo's shear over mu p_0 under Q over mu P, or on return to it from `most`."""
    c = math.sqrt(1 - (Q if most is None else most))
    first = root(x, A) - c * root(x, c * A)
    if most is None:
        return first
    back = math.sqrt(1 - (most - Q) / 2)
    return first - 2 * (root(x, A) - back * root(x, back * A))


def cattaneo(case: HalfPlane) -> tuple[dict[str, float], dict[str, tuple[Tractions, Array]]]:
    """Slid to and fro under a held load, at about half of the largest force, at the turn and on
    return: errors of the stick zone's half-width c over a, and deviations of the shear over mu p_0;
    the tractions, and theory's shear."""
    stroke = STROKE * MU * A**2 / RADIUS
    there = Profile([0.0, 1.0, 2.0], [0.0, stroke, 0.0])
    rig = case.rig(Circle(RADIUS), Reference(**{"body.x": there}))
    run = simulate(rig, grid(2.0, 0.025), y0=pressed(rig, RADIUS), rtol=RTOL)
    every = along(rig, run)
    load = np.array([at.friction for at in every])
    turn, most = 40, load[40]
    half = int(np.argmin(abs(load[:turn] - 0.5 * most)))
    back = turn + int(np.argmin(abs(load[turn:] - 0.2 * most)))
    found, shown = {}, {}
    for name, i in (("way", half), ("turn", turn), ("return", back)):
        at, returns = every[i], name == "return"
        theory = sheared(at.x, load[i], most if returns else None)
        c = math.sqrt(1 - (most - load[i]) / 2 if returns else 1 - load[i])
        stuck = 2 * MU * at.p - (every[turn].q - at.q) if returns else MU * at.p - at.q
        off = (at.q / (MU * PEAK) - theory)[abs(at.x) < A]
        found[f"c, {name}"] = ellipse(at.x, stuck, 0.85 * c * A)[0] / A - c
        found[f"shear, {name}"] = float(np.sqrt(np.mean(off**2)))
        shown[f"{name}: Q = {load[i]:.2f} mu P"] = at, theory
    return found, shown


def rolled(case: HalfPlane, traction: float) -> tuple[float, float]:
    """Creepage over mu a / R and Q over mu P, steady, of a roll with a moment Q R."""
    v, moment, way = A, traction * MU * case.load * RADIUS, case.rolled
    reference = Reference(**{
        "body.x": Sampled([0.0, way], [0.0, way * v], [v, v]),
        "theta_d": Profile([0.0], [0.0]),
        "moment": Profile([0.0, 1.0], [0.0, moment]),
    })  # fmt: skip
    rig = case.rig(Circle(RADIUS), reference, turns=True)
    y0, t = pressed(rig, RADIUS), grid(way, 0.05)
    y0[rig.layout.slices["velocity", "body"]] = f64(0.0, -v / RADIUS)
    run = simulate(rig, t, y0=y0, rtol=RTOL)
    late = t > way - 1
    angle, passed = (torch.diff(run[x][late][[0, -1]]).item() for x in ("theta_body", "x_body"))
    Q = np.mean([at.friction for at, steady in zip(along(rig, run), late) if steady])
    return (1 + angle * RADIUS / passed) / (MU * A / RADIUS), float(Q)


def carter(case: HalfPlane, traction: float) -> dict[str, float]:
    """Rolls with a traction to both sides: half of the difference of their creepages and tractions,
    and what the traction is off Carter's for that creepage, over the limit; half of the sum."""
    (one, Q), (other, P) = (rolled(case, sign * traction) for sign in (1, -1))
    xi, Q = 0.5 * (one - other), 0.5 * (Q - P)
    by_theory = lambda creepage: 1 - (1 - min(1.0, creepage)) ** 2
    return {
        "xi R / (mu a)": xi, "Q / (mu P)": Q, "off": Q - by_theory(xi),
        "off, one side alone": Q - by_theory(one), "free rolling": 0.5 * (one + other),
    }  # fmt: skip
