"""Cases of `law_comparison.py`: motions and sensors, the laws that compete in them, and truths drawn from either law."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from torchsoft import Coulomb, Parameters, Reference, SoftGrasp, StandardLinearSolid
from torchsoft.excitation import Excitation, MultiSine, Press, Roll, Strokes
from torchsoft.experiment import COARSE
from torchsoft.sysid import RIG, Problem, Recording, Sensor, Stage, Unknown, record

NOMINAL = Parameters().override({"contact.v_s": 0.05, "contact.mu_s": 0.7, "contact.mu_k": 0.6} | COARSE)
RTOL = 1e-4
DATA_RTOL = 1e-6
FALLS = 0.9
"""Largest kinetic over static friction of the smooth law: with any it would contain the other law but for eta."""

STIFFER = (1.3, 4.0)
"""Bounds of instantaneous over relaxed modulus of the standard linear solid: with any it would contain the other law."""


class Amontons(Coulomb):
    """Coulomb's law with one coefficient, static and kinetic: with two, efforts jump where slip begins, and the gradient of a
    run does not know it."""

    def __init__(self, mu: float) -> None:
        super().__init__(mu, mu)
        self.mu_k = self.mu_s


def coulomb(settings: Parameters, reference: Reference) -> SoftGrasp:
    return SoftGrasp(settings, reference, friction=Amontons(settings.contact.mu_s))


def solid(settings: Parameters, reference: Reference) -> SoftGrasp:
    """The rubber in series with a spring; tau is longer, so that it creeps at low frequencies as the other law does."""
    p = settings.pad
    rubber = StandardLinearSolid(E=p.E, E_instant=2.2 * p.E, nu=p.nu, rho=p.rho, tau=1.8 * p.tau, depth=p.depth)
    return SoftGrasp(settings, reference, material=rubber)


BUILDS: dict[str, Callable[[Parameters, Reference], SoftGrasp]] = {
    "smooth": SoftGrasp, "coulomb": coulomb, "kelvin_voigt": SoftGrasp, "solid": solid,
}  # fmt: skip
UNKNOWNS: dict[str, dict[str, Unknown]] = {
    "smooth": {
        "pad.E": Unknown(), "contact.mu_s": Unknown(low=0.3, high=1.5),
        "contact.mu_k": Unknown(ratio_to="contact.mu_s", low=0.4, high=FALLS),
    },
    "coulomb": {"pad.E": Unknown(), "contact.mu_s": Unknown(low=0.3, high=1.5)},
    "kelvin_voigt": {"pad.E": Unknown(), "pad.tau": Unknown(), "contact.K_n": Unknown()},
    "solid": {
        "pad.E": Unknown(), "pad.tau": Unknown(), "contact.K_n": Unknown(),
        "pad.E_instant": Unknown(ratio_to="pad.E", low=STIFFER[0], high=STIFFER[1]),
    },
}  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """A motion, how much worse the sensors are than good ones, and the two laws that compete."""

    excitation: Excitation
    laws: tuple[str, str]
    worse: float = 1.0

    @property
    def sensors(self) -> dict[str, Sensor]:
        return {channel: Sensor(noise=self.worse * one.noise) for channel, one in RIG.items()}


FRICTION, RUBBER = ("smooth", "coulomb"), ("kelvin_voigt", "solid")
LIGHT: dict[str, Any] = {"depth": 2e-4, "grasp_time": 0.15, "settle": 0.05}
SHAKEN = Excitation(motion=MultiSine(amplitude_x=4e-3, amplitude_y=1e-4, frequency=(4.0, 15.0)), duration=0.7, **LIGHT)
STROKE = Excitation(motion=Strokes(travel=25e-3, stroke_time=0.15), duration=0.5, **LIGHT)
GENTLE = Excitation(motion=Roll(travel=3e-3), duration=0.6, depth=1e-3, grasp_time=0.2, settle=0.05)
PRESSED = Excitation(
    motion=Press(amplitude=4e-4, frequency=8.0, travel=5e-3), duration=0.6, grasp_time=0.15, settle=0.05
)
SLOW = Excitation(motion=Roll(travel=3e-3), duration=1.0, grasp_time=0.6, settle=0.1)
SETTINGS = {
    "shaken until it slips": Setting(SHAKEN, FRICTION),
    "one stroke that slips": Setting(STROKE, FRICTION),
    "pressed at 8 Hz": Setting(PRESSED, RUBBER),
    "one stroke that slips, cheap sensors": Setting(STROKE, FRICTION, worse=4.0),
    "pressed at 8 Hz, cheap sensors": Setting(PRESSED, RUBBER, worse=5.0),
    "rolled gently": Setting(GENTLE, FRICTION),
    "rolled slowly, cheap sensors": Setting(SLOW, RUBBER, worse=10.0),
}


class Case(NamedTuple):
    """One truth: the law, its parameters by name, and the noise's seed."""

    setting: str
    law: str
    truth: dict[str, float]
    seed: int


def draw(setting: str, number: int, seed: int) -> Case:
    """The law by turns, parameters at random about the nominal ones."""
    rng = np.random.default_rng([seed, list(SETTINGS).index(setting), number])
    law = SETTINGS[setting].laws[number % 2]
    near = {
        "pad.E": NOMINAL.pad.E,
        "contact.mu_s": NOMINAL.contact.mu_s,
        "pad.tau": NOMINAL.pad.tau,
        "contact.K_n": NOMINAL.contact.K_n,
    }
    truth = {
        name: value * float(np.exp(0.1 * rng.standard_normal()))
        for name, value in near.items()
        if name in UNKNOWNS[law]
    }
    if law == "smooth":
        truth["contact.mu_k"] = truth["contact.mu_s"] * float(rng.uniform(0.6, 0.85))
    if law == "solid":
        truth["pad.tau"] *= 1.8
        truth["pad.E_instant"] = truth["pad.E"] * float(rng.uniform(1.5, 3.5))
    return Case(setting, law, truth, int(rng.integers(2**31)))


def data(case: Case, noise: float) -> Recording:
    """What a rig with the true law gives; the true law's nominal rig is in it."""
    setting = SETTINGS[case.setting]
    return record(
        "motion", setting.excitation, NOMINAL, NOMINAL, setting.sensors, rtol=DATA_RTOL, noise=noise, seed=case.seed,
        build=BUILDS[case.law], values=case.truth,
    )  # fmt: skip


def problems(case: Case, recording: Recording, kind: type[Problem] = Problem) -> dict[str, Problem]:
    """Both laws, begun with nominal parameters."""
    setting, out = SETTINGS[case.setting], {}
    for law in setting.laws:
        rig = BUILDS[law](setting.excitation.settings(NOMINAL), recording.rig.reference)
        out[law] = kind([replace(recording, rig=rig)], setting.sensors, UNKNOWNS[law])
    return out


def plan(problem: Problem) -> list[Stage]:
    """Loosely, then by `RTOL`."""
    free = problem.coordinates.labels
    return [
        Stage("loosely", problem.names, free, 1e-3, tolerance=1e-2),
        Stage("everything", problem.names, free, RTOL, tolerance=1e-3),
    ]
