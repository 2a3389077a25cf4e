"""Question: do the data name the law that made them, and do they say so where they cannot tell?

Two pairs of laws: friction that falls smoothly with the speed of slip or Coulomb's with one
coefficient; rubber of Kelvin and Voigt, or in series with a spring (the standard linear solid).
Truths are drawn about the nominal parameters, each law by turns; both laws are fitted to the noisy
recording, from the nominal parameters, with 2 to 4 unknowns, and `torchsoft.sysid.compare` judges.
Three motions show the difference, two hardly do with sensors 4 and 5 times worse, and two do not:
gentle rolling without slip, and a slow roll with sensors 10 times worse. Whether data can tell is
measured without their noise: the wrong law is fitted to the exact recording, and what it leaves is
D times the noise of one sample. By the rule (`torchsoft.sysid.compare`) the right law should be
named in more than 95 % of cases from D = 7.3 on, and a wrong one in no more than 0.06 %, whatever
D.

Coulomb's law has one coefficient here: with two, efforts jump where slip begins and gradients are
biased. The smooth law's mu_k / mu_s ends at 0.9 and the solid's E_instant / E at 4, because without
such bounds either contains the other law.

Command: .venv/bin/python experiments/law_comparison.py [--cases 100] [--workers 2] [--smoke]
Expected: at least 95 of 100 named right where motions show the difference, none named wrong
anywhere, "cannot tell" where they do not. A quarter of an hour on two cores.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchsoft import BuiltRig, Coulomb, RigFile, excite
from torchsoft.experiment import COARSE, RIG, markdown, options, repeated, timed, write
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import Problem, Recording, Sensor, Stage, Unknown, record
from torchsoft.sysid.compare import Comparison, Evidence, compare, fitted
from torchsoft.sysid.fit import Fit
from torchsoft.sysid.runs import Runner

NOMINAL = RigFile.ready("paper").override(
    {"contact.v_s": 0.05, "contact.mu_s": 0.7, "contact.mu_k": 0.6} | COARSE
)
RTOL = 1e-4
DATA_RTOL = 1e-6
FALLS = 0.9
"""Largest kinetic over static friction of the smooth law: with any it would contain the other
law."""

STIFFER = (1.3, 4.0)
"""Bounds of instantaneous over relaxed modulus of the standard linear solid: with any it would
contain the other law."""


class Amontons(Coulomb):
    """Coulomb's law with one coefficient, static and kinetic: with two, efforts jump where slip
    begins, and the gradient of a run does not know it."""

    def __init__(self, mu: float) -> None:
        super().__init__(mu, mu)
        self.mu_k = self.mu_s


SLIP = "laws.steel_on_rubber.friction"
E, TAU, E_INSTANT = (f"materials.rubber.{name}" for name in ("E", "tau", "E_instant"))
K_N, MU_S, MU_K = "laws.steel_on_rubber.K_n", f"{SLIP}.mu_s", f"{SLIP}.mu_k"
UNKNOWNS: dict[str, dict[str, Unknown]] = {
    "smooth": {
        E: Unknown(), MU_S: Unknown(low=0.3, high=1.5),
        MU_K: Unknown(ratio_to=MU_S, low=0.4, high=FALLS),
    },
    "coulomb": {E: Unknown(), MU_S: Unknown(low=0.3, high=1.5)},
    "kelvin_voigt": {E: Unknown(), TAU: Unknown(), K_N: Unknown()},
    "solid": {
        E: Unknown(), TAU: Unknown(), K_N: Unknown(),
        E_INSTANT: Unknown(ratio_to=E, low=STIFFER[0], high=STIFFER[1]),
    },
}  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """A motion, how much worse the sensors are than good ones, the two laws that compete, and other
    entries of the rig file."""

    excitation: Excitation
    laws: tuple[str, str]
    worse: float = 1.0
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sensors(self) -> dict[str, Sensor]:
        return {channel: Sensor(noise=self.worse * one.noise) for channel, one in RIG.items()}

    def built(self, law: str) -> BuiltRig:
        """The nominal rig with a law."""
        file = excite(NOMINAL, self.excitation).override(self.changes)
        rubber, parts = dict(file.materials["rubber"]), {}
        if law == "coulomb":
            parts = {SLIP: Amontons(file.table()[MU_S]["value"])}
        if law == "solid":  # tau is longer, so that it creeps at low frequencies as the other does
            solid = {"kind": "standard_linear_solid", "E_instant": 2.2 * rubber["E"]}
            solid |= {"tau": 1.8 * rubber["tau"]} | {k: rubber[k] for k in ("E", "nu", "depth")}
            file = file.override({"materials.rubber": solid})
        return file.build(parts)


FRICTION, RUBBER = ("smooth", "coulomb"), ("kelvin_voigt", "solid")
LIGHT = 0.7e-4


def roll(travel: float, since: float, until: float) -> dict[str, Any]:
    """A roll to the right [m]."""
    return {"kind": "profile", "times": (since, until), "values": (0, travel), "offset": "start"}


def sines(amplitude: float, seed: int) -> dict[str, Any]:
    return {"kind": "multi_sine", "amplitude": amplitude, "band": (4.0, 15.0), "seed": seed}


SHAKEN = Excitation(sines(4e-3, 0), sines(1e-4, 1), duration=1.0, depth=LIGHT)
STROKE = Excitation(
    {"kind": "strokes", "travel": 25e-3, "stroke_time": 0.15}, duration=0.8, depth=LIGHT
)
GENTLE = Excitation(roll(3e-3, 0.5, 0.85), duration=0.85, depth=0.9e-3)
PRESSED = Excitation(
    roll(5e-3, 0.5, 0.9), {"kind": "chirp", "amplitude": 4e-4, "first": 8.0, "last": 8.0},
    duration=0.9,
)  # fmt: skip
SLOW = Excitation(roll(3e-3, 0.7, 1.0), duration=1.0)
SLOWLY = {f"motion.{name}.times": (0.0, 0.6) for name in ("y_d", "F_ff")}
"""A slower grasp."""

SETTINGS = {
    "shaken until it slips": Setting(SHAKEN, FRICTION),
    "one stroke that slips": Setting(STROKE, FRICTION),
    "pressed at 8 Hz": Setting(PRESSED, RUBBER),
    "one stroke that slips, cheap sensors": Setting(STROKE, FRICTION, worse=4.0),
    "pressed at 8 Hz, cheap sensors": Setting(PRESSED, RUBBER, worse=5.0),
    "rolled gently": Setting(GENTLE, FRICTION),
    "rolled slowly, cheap sensors": Setting(SLOW, RUBBER, 10.0, SLOWLY),
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
    table = NOMINAL.table()
    truth = {
        name: table[name]["value"] * float(np.exp(0.1 * rng.standard_normal()))
        for name in (E, MU_S, TAU, K_N) if name in UNKNOWNS[law]
    }  # fmt: skip
    if law == "smooth":
        truth[MU_K] = truth[MU_S] * float(rng.uniform(0.6, 0.85))
    if law == "solid":
        truth[TAU] *= 1.8
        truth[E_INSTANT] = truth[E] * float(rng.uniform(1.5, 3.5))
    return Case(setting, law, truth, int(rng.integers(2**31)))


def data(case: Case, noise: float) -> Recording:
    """What a rig with the true law gives; the true law's nominal rig is in it."""
    setting = SETTINGS[case.setting]
    return record(
        "motion",
        setting.built(case.law),
        case.truth,
        setting.sensors,
        rtol=DATA_RTOL,
        noise=noise,
        seed=case.seed,
    )


def problems(case: Case, recording: Recording) -> dict[str, Problem]:
    """Both laws, begun with nominal parameters."""
    setting, out = SETTINGS[case.setting], {}
    for law in setting.laws:
        rig = setting.built(law).rig
        rig.reference = recording.rig.reference
        out[law] = Problem([replace(recording, rig=rig)], setting.sensors, UNKNOWNS[law])
    return out


def plan(problem: Problem) -> list[Stage]:
    """Loosely, then by `RTOL`."""
    free = problem.coordinates.labels
    return [
        Stage("loosely", problem.names, free, 1e-3, tolerance=1e-2),
        Stage("everything", problem.names, free, RTOL, tolerance=1e-3),
    ]


ANSWERS = ("right", "wrong", "cannot tell", "none fits")

TELLING = ("shaken until it slips", "one stroke that slips", "pressed at 8 Hz")
"""Motions that show the difference."""

ENOUGH = 7.3
"""D from which the rule names the right law in 95 % of cases."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/law_comparison")
    # in all of the motions that show the difference; an eighth as many in each of the others
    cases: int = 100
    seed: int = 0
    workers: int = 2
    smoke: bool = False  # two cases of two motions


@dataclass(frozen=True)
class Judged:
    """One case: what the comparison said, and `apart`, the D of the wrong law on data without
    noise."""

    case: Case
    apart: float
    comparison: Comparison
    wall_s: float

    @property
    def answer(self) -> str:
        if self.comparison.law is None:
            return self.comparison.outcome
        return "right" if self.comparison.law == self.case.law else "wrong"


def counts(config: Config) -> dict[str, int]:
    """Cases by motion."""
    if config.smoke:
        return {"one stroke that slips": 2, "rolled gently": 2}
    each = -(-config.cases // len(TELLING))
    some = {name: min(each, config.cases - i * each) for i, name in enumerate(TELLING)}
    others = [name for name in SETTINGS if name not in TELLING]
    return some | {name: max(2, config.cases // 8) for name in others}


def judge(case: Case) -> Judged:
    laws = problems(case, data(case, 1.0))
    found, wall = timed(
        lambda: compare(laws, plans={name: plan(one) for name, one in laws.items()})
    )
    wrong, exact = next(
        one for one in problems(case, data(case, 0.0)).items() if one[0] != case.law
    )
    begin = Fit(exact, Runner(exact.recordings), exact.coordinates.start)
    left = Evidence(wrong, fitted(wrong, begin, exact.names, plan(exact)))
    return Judged(case, float(np.linalg.norm(left.fitted.r)), found, wall)


def summed(judged: Sequence[Judged], motions: Iterable[str]) -> list[dict[str, Any]]:
    """By motion, then for all data that can tell, and all that cannot, by D."""
    groups = {name: [one for one in judged if one.case.setting == name] for name in motions}
    groups["motions that show the difference"] = [
        one for one in judged if one.case.setting in TELLING
    ]
    groups[f"D of {ENOUGH:g} or more"] = [one for one in judged if one.apart >= ENOUGH]
    groups[f"D below {ENOUGH:g}"] = [one for one in judged if one.apart < ENOUGH]
    out = []
    for name, some in groups.items():
        answers, D = Counter(one.answer for one in some), [one.apart for one in some]
        counts = {key: answers[key] for key in ANSWERS}
        spread = np.quantile(D, [0, 0.5, 1]).tolist() if D else []
        out.append({"group": name, "cases": len(some), **counts, "D": spread})
    return out


def main(config: Config) -> None:
    config = replace(config, workers=1) if config.smoke else config
    motions = counts(config)
    cases = [draw(name, k, config.seed) for name, number in motions.items() for k in range(number)]
    judged = repeated(lambda k: judge(cases[k]), len(cases), config.workers, "cases")
    groups = summed(judged, motions)
    rows = [
        (
            row["group"],
            row["cases"],
            " / ".join(f"{v:.2g}" for v in row["D"]),
            *(row[answer] for answer in ANSWERS),
        )
        for row in groups
    ]
    table = markdown(("data", "cases", "D least / median / most", *ANSWERS), rows)
    every = [
        {
            "motion": one.case.setting, "law": one.case.law, "truth": one.case.truth,
            "seed": one.case.seed, "D": one.apart, "answer": one.answer, "wall_s": one.wall_s,
            "verdict": one.comparison.verdict,
        }
        for one in judged
    ]  # fmt: skip
    write(config, {"groups": groups, "cases": every}, table=table)


if __name__ == "__main__":
    main(options(Config, __doc__))
