"""Rolling resistance, measured: a disc pressed onto one pad by a held force is driven along it at a constant speed and turns
freely. Past its transients it is read over whole elements, in two ways: the mean force that drives it over the load, and what
the ledger says was dissipated over load and way.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from _shapes_theory import Rolling, moving_contact, peak, winkler
from tqdm import tqdm

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Prony,
    Reference,
    Rig,
    Sampled,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
    simulate,
)
from torchsoft.physics.material import Material
from torchsoft.physics.statics import resting, standing

RADIUS, HEIGHT, DEPTH = 19.37e-3, 4.59e-3, 44e-3
"""The paper's disc and pads [m]."""

STIFFNESS = 1.2e5
"""K_n and K_t [N/m] of a millimetre of surface, as in the paper's rig; no dashpots, so that the rubber alone dissipates."""

TAU = 0.1
"""Retardation time [s] of Kelvin-Voigt and of the standard linear solid. Massless pads have no other scale of time, so that
the speed counts as v TAU over the contact's half-width only."""

SPRING_TIME = 1e-6
"""Retardation time [s] of instantaneous springs: too short to show at any speed here."""

MASS = 0.02
"""Of the disc [kg], so light that its bounces die out at once."""

MARGIN, RAMP, SETTLING, WAKES = 15e-3, 4e-3, 12e-3, 4.0
"""Pad kept free at its ends, way in which the speed is reached, and way before the reading [m]: `SETTLING`, or so many times
v TAU, after which the wake behind the disc is as long as it gets."""

ELEMENTS = 16
"""Elements over which a roll is read."""

READINGS = 16
"""Of the forces, an element."""


@dataclass(frozen=True)
class Case:
    """A layer, how much the disc is pressed onto it [N], and elements along the pad [m] and through it."""

    material: Material
    at: Rolling
    load: float
    element: float
    layers: int


class Roll(NamedTuple):
    """One steady roll and its theory, resistances over the load [1]: mean force, power dissipated over N v and the part of
    slip in it, the small-deformation theory, the thin layer's closed form; depth [m] of the disc, measured and of the theory;
    the run's energy residual over what was injected, and its steps."""

    speed: float
    force: float
    power: float
    slip: float
    theory: float
    winkler: float
    depth: float
    theory_depth: float
    residual: float
    steps: int


def series(moduli: Mapping[float, float], nu: float = 0.45) -> Prony:
    """A relaxation series with E = 0.75 MPa left at the end; moduli [Pa] by their times [s]."""
    return Prony(0.75e6, nu, 1100.0, DEPTH, moduli.values(), moduli, tau_instant=SPRING_TIME)


def layer(height: float, load: float, material: Material, element: float, layers: int) -> Case:
    per_length = STIFFNESS / 1e-3
    return Case(material, Rolling(RADIUS, height, DEPTH, per_length, per_length), load, element, layers)


def cases(load: float, element: float) -> dict[str, Case]:
    """Three rubbers as the paper's pad under `load` [N], on elements of a length [m]; and a thin compressible layer, for which
    theory has a closed form."""
    solid = StandardLinearSolid(0.75e6, 1.5e6, 0.45, 1100.0, TAU, DEPTH, tau_instant=SPRING_TIME)
    rubbers = {
        "Kelvin-Voigt": KelvinVoigt(0.75e6, 0.45, 1100.0, TAU, DEPTH),
        "standard linear solid": solid,
        "relaxation series": series({5e-3: 0.25e6, 15e-3: 0.25e6, 50e-3: 0.25e6}),
    }
    out = {name: layer(HEIGHT, load, rubber, element, 6) for name, rubber in rubbers.items()}
    return out | {
        "thin layer, one relaxation time": layer(1e-3, 0.25 * load, series({50e-3: 0.75e6}, 0.2), 0.5 * element, 4)
    }


def half_width(case: Case) -> float:
    """Of the contact at rest [m], by the theory's slow limit."""
    slow = moving_contact(case.at, case.material, case.load, 1e-6)
    return 0.5 * (slow.front + slow.behind)


def length(case: Case, speeds: list[float]) -> float:
    """Of a pad long enough for the fastest roll [m], in whole elements."""
    way = 2 * MARGIN + RAMP + max(SETTLING, WAKES * TAU * max(speeds)) + ELEMENTS * case.element
    return case.element * np.ceil(way / case.element)


def rig(case: Case, v: float, pad_length: float) -> tuple[Rig, float]:
    """The disc, ready to roll at v [m/s] after a ramp, and when it has passed the transients [s]."""
    at, duration = case.at, (pad_length - 2 * MARGIN) / v
    mesh = PadMesh(pad_length, at.height, round(pad_length / case.element), case.layers)
    law = SoftContact(STIFFNESS, 0.0, STIFFNESS, 0.0, friction=SmoothSlip(0.8, 0.8, 0.05, 10.0))
    ramped, before = 2 * RAMP / v, RAMP + max(SETTLING, WAKES * TAU * v)
    way = Sampled([0.0, ramped, ramped + duration], [MARGIN, MARGIN + RAMP, MARGIN + RAMP + v * duration], [0.0, v, v])
    made = Rig(
        bodies={"disc": Body(MASS, Circle(at.radius), x="driven", weighted=False)},
        pads={"pad": Pad(mesh, case.material, points=2)},
        contacts={"pad": Contact("pad", "disc", law)},
        actuators={"press": Actuator("disc.y", "disc.y", PD(0.0, 0.0), setpoint="y_d", feed_forward="load")},
        reference=Reference(**{"disc.x": way, "y_d": Profile([0.0], [0.0]), "load": Profile([0.0], [-case.load])}),
    )
    return made, ramped + (before - RAMP) / v


@torch.no_grad()
def roll(case: Case, v: float, pad_length: float, rtol: float) -> Roll:
    """One steady roll at v [m/s], measured and by theory."""
    made, since = rig(case, v, pad_length)
    start = torch.tensor([MARGIN, case.at.height + case.at.radius - 0.1 * case.at.height, 0.0], dtype=torch.float64)
    y0 = standing(made, resting(made, {"disc": start}))
    way = ELEMENTS * case.element
    read = since + torch.linspace(0, way / v, ELEMENTS * READINGS + 1, dtype=torch.float64)
    run = simulate(made, torch.cat((torch.zeros(1, dtype=torch.float64), read)), y0=y0, rtol=rtol)
    x, work = run["x_disc"][1:], case.load * way
    lost = {name: (energy[-1] - energy[1]).item() / work for name, energy in run.dissipated.items()}
    force = torch.trapezoid(-run.load["disc"][1:, 0], x).item() / work
    surface = case.at.height + case.at.radius
    theory = moving_contact(case.at, case.material, case.load, v)
    return Roll(
        v, force, sum(lost.values()), lost["slip"], theory.coefficient, winkler(case.at, case.material, case.load, v)[0],
        surface - run["y_disc"][1:].mean().item(), theory.depth, run.energy_residual_rel, run.stats.steps,
    )  # fmt: skip


@dataclass(frozen=True)
class Resistance:
    """One rubber's curve: half-width of the contact at rest [m], its rolls, and both theories at speeds between [m/s]."""

    half_width: float
    rolls: list[Roll]
    speeds: list[float]
    theory: list[float]
    winkler: list[float]

    def deborah(self, v: float) -> float:
        """De = v TAU / a."""
        return v * TAU / self.half_width

    def peak(self, kind: str) -> tuple[float, float] | None:
        """Speed [m/s] and height of the rolls' largest "force", or of a theory at their speeds."""
        return peak([one.speed for one in self.rolls], [getattr(one, kind) for one in self.rolls])


def resistance(case: Case, slowest: float, fastest: float, speeds: int, rtol: float) -> Resistance:
    """Rolls at `speeds` speeds from `slowest` to `fastest`, as De."""
    a = half_width(case)
    measured, between = ((np.geomspace(slowest, fastest, n) * a / TAU).tolist() for n in (speeds, 3 * speeds - 2))
    pad_length = length(case, measured)
    rolls = [roll(case, v, pad_length, rtol) for v in tqdm(measured, "speeds", leave=False)]
    theory = [moving_contact(case.at, case.material, case.load, v).coefficient for v in between]
    thin = [winkler(case.at, case.material, case.load, v)[0] for v in between]
    return Resistance(a, rolls, between, theory, thin)
