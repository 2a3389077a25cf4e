"""Question: does contact follow the closed forms of mechanics, at every size?

Slopes, stops and spins over two to four decades of size; Hertz's contact and the flat punch;
Cattaneo's and Mindlin's partial slip; Carter's rolling. The closed forms stand on the page of the
documentation.

Command: .venv/bin/python experiments/validation/contact_theory.py [--smoke]
Expected: sliding, stops and spin within 0.1 % at every mass and size; Hertz within 0.03 % in a and
0.23 % in p_0; the punch's pressure within 0.7 %; c within 0.1 % of a; creep to 0.3 % of the limit,
rolled to both sides. A minute of a core.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    Coulomb,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    QuadMesh,
    Reference,
    Rig,
    RoundedBox,
    Sampled,
    SmoothSlip,
    SoftContact,
    Trajectory,
    hold,
    simulate,
)
from torchsoft.experiment import grid, markdown, options, write
from torchsoft.physics.contact import SlipLaw, turned
from torchsoft.physics.mesh import Array
from torchsoft.physics.mesh.mesh import quads
from torchsoft.physics.shapes import Shape
from torchsoft.physics.statics import resting, standing

GRAVITY, MU, RTOL = 9.81, 0.5, 1e-4

A, RADIUS, DEPTH, MODULUS = 10e-3, 2.0, 40e-3, 1e6
"""Half-width by theory, radius of the circle and depth [m], and E* [Pa], of the half-plane."""

TAU, GROWTH, WIDE = 1e-4, 1.2, 120.0
"""Its retardation time [s]; of its mesh the growth of elements outwards, and its half-width in
A."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/contact_theory")
    masses_kg: tuple[float, ...] = (1e-3, 0.1, 10.0)
    sizes_mm: tuple[float, ...] = (5.0, 50.0, 500.0)  # heights of the pads
    slopes_deg: tuple[float, ...] = (10.0, 20.0, 26.0, 27.0, 30.0, 45.0)
    elements: tuple[int, ...] = (5, 10, 20, 40)  # over the half-width of the contact
    springs: tuple[float, ...] = (25.0, 100.0, 400.0)  # K per area in units of E* / a
    thick: tuple[float, ...] = (15.0, 30.0, 60.0, 120.0)  # heights of the layer over a
    tractions: tuple[float, ...] = (0.25, 0.5, 0.75, 0.9)  # Q / (mu P) of rolls
    nu: tuple[float, ...] = (0.49, 0.45)  # of rolls
    way: float = 5.0  # of a roll over a
    rolled_elements: int = 20
    smoke: bool = False  # a size that takes seconds


# sliding
# ----------------------------------------------------------------------


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass(frozen=True)
class Scene:
    """A body of `mass` [kg] on a pad of height `size` [m]: lengths are in units of that, the
    modulus of m g / size^2, times of sqrt(size / g)."""

    mass: float = 0.15
    size: float = 12e-3
    friction: SlipLaw = field(default_factory=lambda: Coulomb(MU, MU))
    modulus: float = 500.0
    tau: float = 1e-3
    springs: float = 100.0  # K_n and K_t of an area, in units of E / size.
    elements: int = 8  # Per height along the pad.
    length: float = 20.0
    points: int = 2

    @property
    def time(self) -> float:
        return math.sqrt(self.size / GRAVITY)

    @property
    def speed(self) -> float:
        return math.sqrt(self.size * GRAVITY)

    def rig(self, shape: Shape, angle: float = 0.0, gravity: float = GRAVITY) -> Rig:
        L = self.size
        depth = 3 * L
        E = self.modulus * self.mass * GRAVITY / L**2
        spacing = L / self.elements
        K = self.springs * E / L * depth * spacing
        R = 0.1 * K * self.tau * self.time
        law = SoftContact(K, R, K, R, friction=self.friction, node_spacing=spacing)
        mesh = PadMesh(self.length * L, L, round(self.length * self.elements), 6)
        material = KelvinVoigt(E, 0.45, 1e3, self.tau * self.time, depth)
        return Rig(
            bodies={"body": Body(self.mass, shape)},
            pads={"pad": Pad(mesh, material, angle=angle, points=self.points)},
            contacts={"pad": Contact("pad", "body", law)},
            gravity=gravity,
        )

    def start(
        self, shape: Shape, at: float, angle: float, v: float = 0.0, omega: float = 0.0
    ) -> tuple[Rig, Tensor]:
        """The rig, and the body at rest on a slope at `at` [m] along it, or moving with v, omega
        there."""
        level = self.rig(shape, gravity=GRAVITY * math.cos(angle))
        y0 = level.state(body={"x": at, "y": "rest"})
        x, y, _ = level.unpack(y0).pose["body"].tolist()
        rig = self.rig(shape, angle)
        place = turned(f64(x, y), f64(angle)[0])
        pose = {"body": torch.cat((place, f64(angle)))}
        y0 = standing(rig, pose)
        y0[rig.layout.slices["velocity", "body"]] = f64(
            v * math.cos(angle), v * math.sin(angle), omega
        )
        return rig, y0

    def box(self) -> Shape:
        return RoundedBox(1.7 * self.size, 0.8 * self.size, radius=0.3 * self.size)

    def slope(self, degrees: float) -> dict[str, float]:
        """Acceleration of a box down a slope, from the second half of its way."""
        angle = math.radians(degrees)
        rig, y0 = self.start(self.box(), 16 * self.size, angle)
        t = grid(5 * self.time, 0.05 * self.time)
        way = -along(simulate(rig, t, y0=y0, rtol=RTOL), angle)
        half = slice(len(t) // 2, None)
        expected = max(0.0, GRAVITY * (math.sin(angle) - MU * math.cos(angle)))
        bend = float(2 * np.polyfit(t[half].numpy(), way[half], 2)[0])
        return {
            "expected [m/s2]": expected,
            "found [m/s2]": bend,
            "off": (bend - expected) / (expected or GRAVITY),
        }

    def stop(self) -> float:
        """Way to a stop over theory's, less one."""
        v = 2 * self.speed
        rig, y0 = self.start(self.box(), 3 * self.size, 0.0, v)
        t = grid(1.3 * v / (MU * GRAVITY), 0.05 * self.time)
        way = along(simulate(rig, t, y0=y0, rtol=RTOL), 0.0)
        return float(way[-1] * 2 * MU * GRAVITY / v**2 - 1)

    def spun(self) -> tuple[Array, Array]:
        """A spinning disc set down: times in units of that of slip, spins in units of the first."""
        r, surface = 2 * self.size, 3 * self.speed
        rig, y0 = self.start(Circle(r), 5 * self.size, 0.0, 0.0, -surface / r)
        slips = surface / (3 * MU * GRAVITY)
        run = simulate(rig, grid(1.5 * slips, 0.01 * slips), y0=y0, rtol=RTOL)
        return run.t.numpy() / slips, -run["omega_body"].numpy() * r / surface

    def spin(self) -> tuple[float, float]:
        """Rate at which the spin falls, and the spin of rolling, over theory's, less one."""
        t, spin = self.spun()
        slides = (t > 0.2) & (t < 0.8)
        return (
            float(np.polyfit(t[slides], spin[slides], 1)[0] / (-2 / 3) - 1),
            float(3 * spin[t > 1.1].mean() - 1),
        )


def along(run: Trajectory, angle: float) -> Array:
    """Way of the body [m] up a slope at `angle` [rad]."""
    x, y = run["x_body"] - run["x_body"][0], run["y_body"] - run["y_body"][0]
    return (x * math.cos(angle) + y * math.sin(angle)).numpy()


def sizes(config: Config) -> list[dict[str, float]]:
    """Boxes and discs of every mass and size: what is off."""
    rows = []
    cases = [(m, s) for m in config.masses_kg for s in config.sizes_mm]
    for mass, size in tqdm(cases, "sizes", leave=False, disable=None):
        scene = Scene(mass, 1e-3 * size)
        rate, final = scene.spin()
        rows.append({
            "mass [kg]": mass, "pad [mm]": size, "slope of 45 deg": scene.slope(45.0)["off"],
            "stop": scene.stop(), "spin's rate": rate, "spin of rolling": final,
        })  # fmt: skip
    return rows


# half-plane
# ----------------------------------------------------------------------


@dataclass(frozen=True)
class HalfPlane:
    """A rigid body pressed onto a pad so thick that it is nearly a half-plane. Lengths are in units
    of the contact's half-width a by theory, A [m]."""

    nu: float = 0.49
    elements: int = 20  # Over the half-width.
    springs: float = 100.0  # K_n and K_t of an area, in units of E* / a.
    thick: float = 120.0  # The pad's height.
    fine: tuple[float, float] = (-1.3, 1.3)  # Where the elements are small.

    @property
    def E(self) -> float:
        """Young's modulus [Pa] of a unit E*."""
        return MODULUS * (1 - self.nu**2)

    @property
    def load(self) -> float:
        """Normal force [N] under which a circle of `RADIUS` touches over 2 a, by Hertz."""
        return math.pi * MODULUS * A**2 / (4 * RADIUS) * DEPTH

    def mesh(self) -> QuadMesh:
        """Small squares under the contact, growing outwards and downwards."""
        h = A / self.elements
        low, high = self.fine
        count = round((high - low) * self.elements)
        middle = A * low + h * np.arange(count + 1)
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
        R = K * TAU
        law = SoftContact(K, R, K, R, friction=Coulomb(MU, MU), node_spacing=h)
        material = KelvinVoigt(self.E, self.nu, 1e3, TAU, DEPTH)
        theta = "free" if turns else 0.0
        body = Body(self.load / GRAVITY, shape, x="driven", theta=theta)
        twist = Actuator(
            "body.theta", "body.theta", PD(0.0, 0.0), setpoint="theta_d", feed_forward="moment"
        )
        return Rig(
            bodies={"body": body},
            pads={"pad": Pad(self.mesh(), material, points=2)},
            contacts={"pad": Contact("pad", "body", law)},
            actuators={"twist": twist} if turns else {},
            reference=reference or hold(**{"body.x": 0.0}),
            gravity=GRAVITY,
        )


STIFF = HalfPlane(elements=40, springs=400.0)


def growing(first: float, whole: float) -> Array:
    """Distances [m] of nodes that go away in steps growing by `GROWTH`, up to `whole`."""
    steps = first * GROWTH ** np.arange(1, 400)
    way = np.cumsum(steps)
    way = way[: int(np.searchsorted(way, whole)) + 1]
    return way * whole / way[-1]


def pressed(rig: Rig, top: float) -> Tensor:
    """The rig with its body at rest, sought from about Hertz's approach below `top` [m], the height
    at which it touches."""
    near = f64(0.0, top - 2.0 * A**2 / RADIUS, 0.0)
    return standing(rig, resting(rig, {"body": near}, {"body": (1,)}))


class Tractions(NamedTuple):
    """Of the elements along the surface: places [m], pressure and shear [Pa]."""

    x: Array
    p: Array
    q: Array


def tractions(rig: Rig, forces: Array) -> Tractions:
    """Of the normal and tangential forces (points, 2) [N], the two points of each element together:
    at the edge of a stick zone they lie on either side of theory."""
    pad = rig.pads["pad"]
    pair = lambda points: points.reshape(-1, 2).sum(-1)
    x = 0.5 * pair(pad.point_positions[:, 0].numpy())
    area = DEPTH * pair(np.asarray(pad.point_lengths))
    return Tractions(x, *(pair(one) / area for one in forces.T))


def ran(rig: Rig, run: Trajectory) -> list[Tractions]:
    """At every time of a run."""
    return [tractions(rig, at) for at in run.force["pad"].numpy()]


def ellipse(x: Array, y: Array, within: float) -> tuple[float, float]:
    """Half-width [m] and height of y = y_0 sqrt(1 - x^2 / a^2) by least squares in |x| <
    `within`."""
    k = abs(x) < within
    slope, top = np.polyfit(x[k] ** 2, y[k] ** 2, 1)
    return math.sqrt(-top / slope), math.sqrt(top)


@torch.no_grad()
def still(rig: Rig, top: float) -> Tractions:
    """Of the body at rest, which no friction holds."""
    state = rig.unpack(pressed(rig, top))
    graph = rig.evaluate(0.0, state, rig.follow(0.0), settled=True)
    F_N = graph.interfaces["pad"].F_N.numpy()
    return tractions(rig, np.stack((F_N, 0 * F_N), -1))


def hertz(case: HalfPlane) -> dict[str, float]:
    """Half-width and peak pressure over Hertz's, less one."""
    at = still(case.rig(Circle(RADIUS)), RADIUS)
    a, top = ellipse(at.x, at.p, 0.9 * A)
    return {"half-width": a / A - 1, "peak": top / (MODULUS * A / (2 * RADIUS)) - 1}


CORNER = 0.02  # Radius of the punch's corners over its half-width.


def punch(case: HalfPlane) -> tuple[dict[str, float], Tractions]:
    """A flat punch: the half-width that its pressure has over that of its flat side, less one; the
    largest error of the pressure in the inner 70 %, by that half-width and by the flat side's."""
    box = RoundedBox(A, 0.5 * A, radius=CORNER * A)
    at = still(case.rig(box), 0.5 * A)
    k = abs(at.x) < 0.7 * A
    slope, top = np.polyfit(at.x[k] ** 2, at.p[k] ** -2, 1)
    flat, own = (1 - CORNER) * A, math.sqrt(-top / slope)
    pressure = lambda a: case.load / DEPTH / (math.pi * np.sqrt(a**2 - at.x[k] ** 2))
    off = [float(abs(at.p[k] / pressure(a) - 1).max()) for a in (own, flat)]
    return {"half-width": own / flat - 1, "pressure": off[0], "by the flat side": off[1]}, at


def root(x: Array, a: float) -> Array:
    """sqrt(1 - x^2 / a^2), zero outside of a."""
    return np.sqrt(np.clip(1 - (x / a) ** 2, 0.0, None))


def sheared(x: Array, Q: float, most: float | None = None) -> Array:
    """Cattaneo's shear over mu p_0 under Q over mu P, or on return to it from `most`."""
    c = math.sqrt(1 - (Q if most is None else most))
    first = root(x, A) - c * root(x, c * A)
    if most is None:
        return first
    back = math.sqrt(1 - (most - Q) / 2)
    return first - 2 * (root(x, A) - back * root(x, back * A))


STROKE = 1.8
"""Of the tangential displacement, over mu a^2 / R: 0.6 to 0.7 of what makes all slip."""


def cattaneo(case: HalfPlane) -> tuple[dict[str, float], list[tuple[Tractions, Array]]]:
    """Slid to and fro under a held load: errors of the stick zone's half-width c over a at about
    half of the largest force, and on return, and the deviations of the shear over mu p_0; the
    tractions and theory's shear on the way, at the turn and on return."""
    stroke = STROKE * MU * A**2 / RADIUS
    there = Profile([0.0, 1.0, 2.0], [0.0, stroke, 0.0])
    rig = case.rig(Circle(RADIUS), Reference(**{"body.x": there}))
    run = simulate(rig, grid(2.0, 0.025), y0=pressed(rig, RADIUS), rtol=RTOL)
    every = ran(rig, run)
    load = [float((one.q.sum()) / (MU * one.p.sum())) for one in weighted(rig, every)]
    most, half = load[40], int(np.argmin(np.abs(np.array(load[:40]) - 0.5 * load[40])))
    back = 40 + int(np.argmin(np.abs(np.array(load[40:]) - 0.2 * most)))
    top, found, shown = MU * MODULUS * A / (2 * RADIUS), {}, []
    for name, i, before in (("way", half, None), ("turn", 40, None), ("return", back, most)):
        at, theory = every[i], sheared(every[i].x, load[i], before)
        inner = MU * at.p - at.q if before is None else every[40].q - at.q
        c = math.sqrt(1 - load[i] if before is None else 1 - (most - load[i]) / 2)
        if before is not None:
            inner = 2 * MU * at.p - inner
        found[f"c, {name}"] = ellipse(at.x, inner, 0.85 * c * A)[0] / A - c
        found[f"Q, {name}"] = load[i]
        found[f"shear, {name}"] = float(np.sqrt(np.mean((at.q / top - theory)[abs(at.x) < A] ** 2)))
        shown.append((at, theory))
    return found, shown


def weighted(rig: Rig, every: list[Tractions]) -> list[Tractions]:
    """Tractions times the lengths of their elements."""
    length = np.asarray(rig.pads["pad"].point_lengths).reshape(-1, 2).sum(-1)
    return [Tractions(one.x, length * one.p, length * one.q) for one in every]


def rolled(case: HalfPlane, traction: float, way: float) -> tuple[float, float, Tractions]:
    """Creepage over mu a / R and Q over mu P, steady, of a roll with a moment Q R; and the
    tractions about the disc's centre."""
    v, moment = A, traction * MU * case.load * RADIUS
    reference = Reference(**{
        "body.x": Sampled([0.0, way], [0.0, way * v], [v, v]),
        "theta_d": Profile([0.0], [0.0]),
        "moment": Profile([0.0, 1.0], [0.0, moment]),
    })  # fmt: skip
    rig = case.rig(Circle(RADIUS), reference, turns=True)
    y0 = pressed(rig, RADIUS)
    y0[rig.layout.slices["velocity", "body"]] = f64(0.0, -v / RADIUS)
    t = grid(way, 0.05)
    run = simulate(rig, t, y0=y0, rtol=RTOL)
    late = t > way - 1
    angle = torch.diff(run["theta_body"][late][[0, -1]]).item()
    passed = torch.diff(run["x_body"][late][[0, -1]]).item()
    every = ran(rig, run)
    at = weighted(rig, every)
    Q = np.mean([one.q.sum() / (MU * one.p.sum()) for one, k in zip(at, late) if k])
    last = every[-1]
    creepage = (1 + angle * RADIUS / passed) / (MU * A / RADIUS)
    return creepage, float(Q), last._replace(x=last.x - way * A)


def carter(nu: float, config: Config) -> list[dict[str, Any]]:
    """Rolls with a traction to both sides: half of the difference of their creepages and tractions,
    and what the traction is off Carter's for that creepage, over the limit; half of the sum."""
    case = HalfPlane(nu, config.rolled_elements, fine=(-1.3, config.way + 1.3))
    rows = []
    for traction in tqdm(config.tractions, f"rolls, nu = {nu:g}", leave=False, disable=None):
        (one, Q, at), (other, P, _) = (rolled(case, x * traction, config.way) for x in (1, -1))
        xi, Q = 0.5 * (one - other), 0.5 * (Q - P)
        near = abs(at.x) < 1.2 * A
        rows.append({
            "nu": nu, "creepage": xi, "traction": Q, "off": Q - (1 - (1 - min(1.0, xi)) ** 2),
            "one side off": Q - (1 - (1 - min(1.0, one)) ** 2), "free rolling": 0.5 * (one + other),
            "x": (at.x[near] / A).tolist(), "p": at.p[near].tolist(), "q": at.q[near].tolist(),
        })  # fmt: skip
    return rows


# all of it
# ----------------------------------------------------------------------


def reduced(config: Config) -> Config:
    """A size that takes seconds."""
    return Config(
        out=config.out, masses_kg=(0.1,), sizes_mm=(50.0,), slopes_deg=(20.0,),
        elements=(10, 20), springs=(), thick=(30.0,), tractions=(0.5,), nu=(0.49,),
        way=3.0, rolled_elements=10, smoke=True,
    )  # fmt: skip


def run(config: Config) -> dict[str, Any]:
    """Everything that `summary.json` holds."""
    usual = HalfPlane()
    slopes = {f"{angle:g}": Scene().slope(angle) for angle in config.slopes_deg}
    slopes["45, smooth law"] = Scene(friction=SmoothSlip(MU, MU)).slope(45.0)
    cases = {
        **{f"{n} elements": replace(usual, elements=n) for n in config.elements},
        **{f"springs {k:g} E*/a": replace(usual, springs=k) for k in config.springs},
    }
    stiff = {"40 elements, springs 400 E*/a": STIFF}
    layers = {f"layer of {h:g} a": replace(usual, thick=h) for h in config.thick}
    slid = {
        name: cattaneo(case)[0]
        for name, case in tqdm(cases.items(), "slid", leave=False, disable=None)
    }
    return {
        "slopes": slopes,
        "sizes": sizes(config),
        "hertz": {name: hertz(case) for name, case in {**cases, **stiff, **layers}.items()},
        "punch": {name: punch(case)[0] for name, case in {**cases, **stiff}.items()},
        "cattaneo": slid,
        "carter": [row for nu in config.nu for row in carter(nu, config)],
    }


def figure(found: dict[str, Any]) -> Figure:
    """Pressures, shears, creep and spin: circles are found, lines theory's."""
    made = Figure(figsize=(10, 6.4), layout="constrained")
    axes = made.subplots(2, 3)
    case, x = HalfPlane(), np.linspace(-1.2, 1.2, 481)
    dots: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 3, "mfc": "none"}
    top = MODULUS * A / (2 * RADIUS)

    ax, at = axes[0, 0], still(case.rig(Circle(RADIUS)), RADIUS)
    ax.plot(x, root(x, 1.0), "k")
    ax.plot(at.x / A, at.p / top, color="C0", **dots)
    ax.set(title="circle (Hertz)", xlabel="x / a", ylabel="p / p_0", xlim=(-1.2, 1.2))

    ax = axes[0, 1]
    numbers, at = punch(STIFF)
    own = (1 + numbers["half-width"]) * (1 - CORNER)
    inner = np.linspace(-0.995, 0.995, 400)
    ax.plot(inner, 1 / np.sqrt(1 - inner**2), "k")
    ax.plot(at.x / A / own, at.p * math.pi * own * A * DEPTH / case.load, color="C0", **dots)
    ax.set(title="flat punch", xlabel="x / a", ylabel="p pi a / P", xlim=(-1.2, 1.2), ylim=(0, 5))

    ax = axes[0, 2]
    numbers, shown = cattaneo(case)
    for i, ((at, theory), name) in enumerate(zip(shown, ("way", "turn", "return"))):
        label = f"{name}: Q = {numbers[f'Q, {name}']:.2f} mu P"
        ax.plot(at.x / A, theory, color="k", lw=1)
        ax.plot(at.x / A, at.q / (MU * top), color=f"C{i}", label=label, **dots)
    ax.set(title="partial slip (Cattaneo, Mindlin)", xlabel="x / a", ylabel="q / (mu p_0)")
    ax.set(xlim=(-1.2, 1.2), ylim=(-0.55, 1.45))
    ax.legend(fontsize=7, loc="upper center")

    ax, xi = axes[1, 0], np.linspace(0, 1, 101)
    ax.plot(xi, 1 - (1 - xi) ** 2, "k")
    for i, nu in enumerate(dict.fromkeys(row["nu"] for row in found["carter"])):
        rows = [row for row in found["carter"] if row["nu"] == nu]
        marker = {**dots, "marker": "os^"[i], "ms": 5}
        ax.plot(
            [row["creepage"] for row in rows], [row["traction"] for row in rows],
            color=f"C{i}", label=f"nu = {nu:g}", **marker,
        )  # fmt: skip
    ax.set(title="rolling (Carter)", xlabel="xi R / (mu a)", ylabel="Q / (mu P)")
    ax.legend(fontsize=7)

    ax = axes[1, 1]
    row = min(found["carter"], key=lambda row: (-row["nu"], abs(row["traction"] - 0.5)))
    c = math.sqrt(1 - row["traction"])
    ax.plot(x, root(x, 1.0) - c * root(x - (1 - c), c), "k")
    ax.plot(x, root(x, 1.0), "k:", lw=1)
    ax.plot(row["x"], np.array(row["q"]) / (MU * top), color="C0", **dots)
    title = f"rolling, Q = {row['traction']:.2f} mu P"
    ax.set(title=title, xlabel="x / a", ylabel="q / (mu p_0)", xlim=(-1.2, 1.2))

    ax = axes[1, 2]
    t, spin = Scene().spun()
    ax.plot([0, 1, 1.5], [1, 1 / 3, 1 / 3], "k")
    ax.plot(t[::4], spin[::4], color="C0", **dots)
    ax.set(
        title="spinning disc set down", xlabel="3 mu g t / (omega_0 r)", ylabel="omega / omega_0"
    )
    ax.set(ylim=(0, 1.1))
    return made


def percent(part: float) -> str:
    return f"{100 * part:+.2f} %"


def table(found: dict[str, Any]) -> str:
    """What was found, and how far it is off."""
    slopes = [
        (name, *(f"{row[k]:.4f}" for k in ("expected [m/s2]", "found [m/s2]")), percent(row["off"]))
        for name, row in found["slopes"].items()
    ]
    names = list(found["sizes"][0])
    bodies = [
        (*(f"{row[k]:g}" for k in names[:2]), *(percent(row[k]) for k in names[2:]))
        for row in found["sizes"]
    ]
    pressed = [
        (
            name, percent(row["half-width"]), percent(row["peak"]),
            *(percent(x) for x in found["punch"].get(name, {}).values()),
        )
        for name, row in found["hertz"].items()
    ]  # fmt: skip
    parts = "c, way", "c, turn", "c, return", "shear, way", "shear, turn", "shear, return"
    slid = [
        (name, *(percent(row[part]) for part in parts)) for name, row in found["cattaneo"].items()
    ]
    rolls = [
        (
            f"{row['nu']:g}", f"{row['creepage']:.4f}", f"{row['traction']:.4f}",
            percent(row["off"]), percent(row["one side off"]), percent(row["free rolling"]),
        )
        for row in found["carter"]
    ]  # fmt: skip
    width = len(max(pressed, key=len))
    pressed = [row + ("-",) * (width - len(row)) for row in pressed]
    return "\n\n".join((
        markdown(("slope [deg]", "expected [m/s2]", "found [m/s2]", "off"), slopes),
        markdown(names, bodies),
        markdown(
            ("case", "Hertz: a", "Hertz: p_0", "punch: a", "punch: p", "punch: p, a of the flat"),
            pressed,
        ),
        markdown(("case", *parts), slid),
        markdown(
            ("nu", "xi R / (mu a)", "Q / (mu P)", "off", "off, one side alone", "free rolling"),
            rolls,
        ),
    ))  # fmt: skip


def main(config: Config) -> None:
    found = run(reduced(config) if config.smoke else config)
    write(config, found, {"contact_theory": figure(found)}, table(found))


if __name__ == "__main__":
    main(options(Config, __doc__))
