"""Question: where a rig is not what the fit assumes, is the right suspect named, or none?

The independent simulator of `foreign_rigs.py` makes recordings of one motion of 1.5 s of rigs that
differ in one thing each: `CASES`, a pad, the power of the penalty force, a second retardation time,
friction of a guide, an inertia, a tilt, a known number, a sensor, a clock; and `DEPARTURES`, of a
size that a laboratory would overlook and of half that: friction of one contact, a centre of mass,
adhesion, a pad's height, a controller, another sensor. Six parameters are identified, every start
off by a factor of 1.6, from several noise seeds; `explain` is called where `identify` says so.

An estimate is off by its error over its standard deviation. A suspect is named if its odds among
all of them are 1 % at least. A repetition is covered where the true suspect is named, where the
verdict is that the model does not explain the data, or where a sentence on what would not be
noticed names the true suspect; it has a false cause where the data are said to contradict
something that is right.

Command: .venv/bin/python -m experiments.validation.suspects [--seeds 5] [--first 0]
[--table departures] [--only "tilt of 2 mrad"] [--smoke]
Expected: no estimate is off by three deviations in a repetition that is not covered, no false
cause, and no notice where nothing is wrong. About two hours on two cores for `CASES`, and six for
`DEPARTURES`.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.signal import lfilter

from experiments.frame import Table, options, repeated, timed, write
from experiments.identify_contact import LAW, MU_K, MU_S, RUBBER, SENSORS, TRUTH
from experiments.validation.foreign_recordings import (
    KEPT,
    Alter,
    Case,
    Made,
    Sensing,
    chosen,
    make_all,
)
from torchsoft.sysid import IdentificationResult, Recording, Unreachable, explain, identify
from torchsoft.sysid.alternatives import delayed
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import forget
from torchsoft.sysid.suspect_findings import LIKELY

SIX = (f"{LAW}.K_n", f"{LAW}.K_t", MU_S, MU_K, f"{RUBBER}.E", f"{RUBBER}.tau")
"""Unknowns; the laboratory knows the others."""

OFF = 3.0
"""Standard deviations by which an estimate is off."""


# faults of sensors
# ----------------------------------------------------------------------


def reading(channel: str, fault: Callable[[Array, np.random.Generator], Array]) -> Alter:
    """A fault in the readings of one channel."""

    def alter(recording: Recording, rng: np.random.Generator) -> Recording:
        t, y = recording.samples[channel]
        return replace(recording, samples=recording.samples | {channel: (t, fault(y, rng))})

    return alter


def with_outliers(y: Array, rng: np.random.Generator) -> Array:
    y, hit = y.copy(), rng.choice(len(y), 4, replace=False)
    y[hit] += 15 * SENSORS["effort_y"].noise * rng.choice([-1.0, 1.0], 4)
    return y


def late(recording: Recording, rng: np.random.Generator) -> Recording:
    """Set-points that were carried out 1.5 ms after they were noted."""
    made = delayed(recording, -1.5e-3)
    assert made is not None
    return made


def low_passed(channel: str, cutoff: float) -> Sensing:
    """A channel through a first-order low-pass with a cut-off [Hz], at rest at the begin."""
    keep = float(np.exp(-2 * np.pi * cutoff * KEPT))

    def sensed(channels: Mapping[str, Array]) -> Mapping[str, Array]:
        y = channels[channel]
        return {channel: y[0] + lfilter([1 - keep], [1.0, -keep], y - y[0])}

    return sensed


def mixed(into: str, other: str, part: float) -> Sensing:
    """A part of another channel in a channel."""
    return lambda channels: {into: channels[into] + part * channels[other]}


def scaled(factor: float, about: Literal["zero", "begin"]) -> Sensing:
    """Both coordinates of a camera, whose zero is that of the rig or where the disc begins."""

    def sensed(channels: Mapping[str, Array]) -> Mapping[str, Array]:
        zero = {c: channels[c][0] if about == "begin" else 0.0 for c in ("x_C", "y_C")}
        return {c: zero[c] + factor * (channels[c] - zero[c]) for c in zero}

    return sensed


def with_play(channel: str, play: float) -> Sensing:
    """A channel behind a gear with a play, which follows when it has been taken up."""

    def sensed(channels: Mapping[str, Array]) -> Mapping[str, Array]:
        out, at = channels[channel].copy(), channels[channel][0]
        for i, y in enumerate(channels[channel]):
            out[i] = at = min(max(at, y - play / 2), y + play / 2)
        return {channel: out}

    return sensed


def gaps(part: float) -> Alter:
    """A part of the samples of every channel that is missing, here and there."""

    def alter(recording: Recording, rng: np.random.Generator) -> Recording:
        left = {}
        for channel, (t, y) in recording.samples.items():
            kept = rng.random(len(t)) >= part
            left[channel] = t[kept], y[kept]
        return replace(recording, samples=left)

    return alter


# cases
# ----------------------------------------------------------------------


def named(
    name: str, suspects: tuple[str, ...] = (), motion: str = "long shaking", **how: Any
) -> Case:
    """A case of one motion and six unknowns."""
    return Case(name, suspects, unknowns=SIX, motions=(motion,), **how)


CASES = (
    named("nothing"),
    named("upper pad 10 % stiffer", ("pads.U.E_ratio", "pads.L.E_ratio"), differs={"upper": 1.1}),
    named("penalty force ~ g^1.5", (f"{LAW}.power",), differs={"power": 1.5}),
    named("second time, 1 % of compliance", (f"{RUBBER}.slow",), differs={"slow": 0.01}),
    named("2 N of friction on the guide", ("guides.bracket.x.friction",),
          differs={"friction": 2.0}),
    named("inertia +5 %", ("bodies.disc.inertia_ratio",), differs={"inertia": 1.05}),
    named("tilt of 2 mrad", ("gravity_tilt",), differs={"tilt": 2e-3}),
    named("nu +4.44 %", (f"{RUBBER}.nu",), differs={"nu": 0.47}),
    named("disc mass +5 %", ("bodies.disc.mass",), differs={"mass": 1.05 * 0.4065}),
    named("gain of F_x 3 %", ("gain effort_x",),
          alter=reading("effort_x", lambda y, _: 1.03 * y)),
    named("set-points 1.5 ms late", ("clock of the set-points",), alter=late),
    named("theta in steps of 2 mrad", words=("theta_C comes in steps",),
          alter=reading("theta_C", lambda y, _: 2e-3 * np.round(y / 2e-3))),
    named("outliers in F_y", words=("outliers",), alter=reading("effort_y", with_outliers)),
    named("gentle roll", motion="gentle roll"),
)  # fmt: skip

Sized = Callable[[float], dict[str, Any]]
"""What differs in a case of a size."""


def rig(number: str, scale: float = 1.0, usual: float = 0.0) -> Sized:
    """A number of the simulator that is `scale` times the size away from the usual one."""
    return lambda size: {"differs": {number: usual + scale * size}}


def sensor(fault: Callable[[float], Sensing]) -> Sized:
    return lambda size: {"sensed": fault(size)}


FRICTION, CENTRE, HEIGHT = ("friction_ratio",), ("bodies.disc.centre",), ("height of", "thickness")
LATE = ("actuators.lag", "actuators.x.lag", "actuators.y.lag")
"""To first order a delay, a lag and half the period of a hold are the same."""
SCALE = ("gain x_C", "scale of the camera", "scale about the start")

PAIRS: tuple[tuple[str, tuple[str, ...], tuple[float, float], Sized], ...] = (
    ("friction of the upper pad +{} %", FRICTION, (3, 1.5), rig("upper_friction", 0.01, 1.0)),
    ("friction of the upper pad +{} %", FRICTION, (8, 4), rig("upper_friction", 0.01, 1.0)),
    ("centre of mass {} mm lower", CENTRE, (0.1, 0.05), rig("com_y", -1e-3)),
    ("centre of mass {} mm lower", CENTRE, (0.2, -0.1), rig("com_y", -1e-3)),
    ("centre of mass {} mm aside", CENTRE, (0.02, 0.01), rig("com_x", 1e-3)),
    ("adhesion of {} N a node", ("adhesion",), (0.02, 0.01), rig("adhesion")),
    ("adhesion of {} N a node", ("adhesion",), (0.05, 0.025), rig("adhesion")),
    ("pads {} % thicker", HEIGHT, (1, 0.5), rig("thicker", 0.01, 1.0)),
    ("pads {} % thicker", HEIGHT, (3, 1.5), rig("thicker", 0.01, 1.0)),
    ("upper pad {} % thicker", (*HEIGHT, "E_ratio"), (3, 1.5), rig("thicker_U", 0.01, 1.0)),
    ("pads {} % longer", ("length of",), (1, 0.5), rig("longer", 0.01, 1.0)),
    ("mu_s ageing at rest, b = {}", ("ageing", "aging"), (0.02, 0.01), rig("ageing")),
    ("{} % of instantaneous compliance", (f"{RUBBER}.fast(",), (1, 0.5), rig("fast", 0.01)),
    ("controllers {} ms late", LATE, (0.1, 0.05), rig("delay", 1e-3)),
    ("controllers {} ms late", LATE, (0.5, 0.25), rig("delay", 1e-3)),
    ("controllers lag by {} ms", LATE, (0.5, 0.25), rig("lag", 1e-3)),
    ("controllers hold for {} ms", LATE, (1, 0.5), rig("hold", 1e-3)),
    ("F_x limited to {} N", ("limit of the controller x",), (24, 26), rig("F_x_most")),
    ("upper pad tilted by {} mrad", ("tilt of",), (2, 1), rig("tilt_U", 1e-3)),
    ("lower pad tilted by {} mrad", ("tilt of", "gravity_tilt"), (2, 1), rig("tilt_L", 1e-3)),
    ("E falls by {} %", ("drift of materials",), (3, 1.5), rig("softening", 0.01)),
    ("friction falls by {} %", ("drift of laws",), (5, 2.5), rig("wear", 0.01)),
    ("theta through a low-pass of {} Hz", ("lag theta_C",), (20, 40),
     sensor(lambda size: low_passed("theta", size))),
    ("{} % of effort_y in effort_x", ("misalignment effort_x",), (2, 1),
     sensor(lambda size: mixed("F_x", "F_y", size / 100))),
    ("camera's scale {}", SCALE, (1.002, 1.001), sensor(lambda size: scaled(size, "zero"))),
    ("camera's scale {} about the begin", SCALE, (1.002, 1.001),
     sensor(lambda size: scaled(size, "begin"))),
    ("play of {} mrad in theta", ("backlash theta_C",), (0.5, 0.25),
     sensor(lambda size: with_play("theta", 1e-3 * size))),
)  # fmt: skip
"""Name, true suspects, a size and as a rule half of it, and what differs."""


def sized(which: int) -> list[Case]:
    """The cases of the whole sizes (0), or of the halves (1)."""
    return [
        named(name.format(f"{sizes[which]:g}"), suspects, **differs(sizes[which]))
        for name, suspects, sizes, differs in PAIRS
    ]


DEPARTURES = (
    *sized(0),
    named("20 % of samples missing", alter=gaps(0.2)),
    named("pink noise", words=("colour", "autocorrelat"), colour="pink"),
    *sized(1),
)
"""Things that a laboratory would overlook, the whole sizes before the halves."""

EVERY = (*CASES, *DEPARTURES)
TABLES = {"suspects": CASES, "departures": DEPARTURES, "all": EVERY}
SMOKE = ("inertia +5 %", "pads 0.5 % thicker")


@dataclass(frozen=True)
class Settings:
    """What studies of independent recordings have in common."""

    out: Path = Path("out/suspects")
    seeds: int = 5
    first: int = 0  # the first seed
    rtol: float = 1e-5  # of the fits' last stage
    step: float = 20e-6  # of the simulator [s]; 1 ms is a multiple of twice as much
    workers: int = 2  # repetitions at a time
    explain: bool = True  # where `identify` says so
    only: tuple[str, ...] = ()  # names of cases, of any table; those of the table by default
    smoke: bool = False  # few cases, one seed, a looser tolerance


@dataclass(frozen=True)
class Config(Settings):
    table: Literal["suspects", "departures", "all"] = "suspects"


# repetitions
# ----------------------------------------------------------------------


def is_right(case: Case, text: str) -> bool:
    """Whether a name or a sentence names the true suspect."""
    return any(part in text for part in (*case.suspects, *case.words))


class Repetition(NamedTuple):
    """One seed: errors over standard deviations of what is identifiable, by name; suspects with
    their odds; what the data are said to contradict although it is right; the verdict, notices,
    and sentences on what would not be noticed; seconds of `identify` and, where it was called, of
    `explain`."""

    off: dict[str, float]
    named: dict[str, float]
    false: list[str]
    verdict: str
    notices: list[str]
    unseen: list[str]
    codes: list[str]
    identify_s: float
    explain_s: float | None

    @property
    def worst(self) -> str:
        """The estimate that is off most; empty without estimates."""
        return max(self.off, key=lambda name: abs(self.off[name]), default="")

    def named_rightly(self, case: Case) -> bool:
        worded = any(word in text for word in case.words for text in self.notices)
        return worded or any(is_right(case, name) for name in self.named)

    def outcome(self, case: Case) -> str:
        """What is concluded, in one word of `FROZEN`."""
        if self.false:
            return "false cause"
        if {"cause", "causes"} & {*self.codes} or (case.words and self.named_rightly(case)):
            return "named"
        if "unconfirmed" in self.codes:
            return "unconfirmed"
        return {"does not explain": "none"}.get(self.verdict, self.verdict)

    def covered(self, case: Case) -> bool:
        """Whether a reader is told to doubt the estimates, or of what would not be noticed."""
        unseen = any(is_right(case, sentence) for sentence in self.unseen)
        return self.named_rightly(case) or self.verdict == "does not explain" or unseen

    def silent(self, case: Case) -> bool:
        return abs(self.off.get(self.worst, 0.0)) > OFF and not self.covered(case)


FROZEN: dict[str, str] = json.loads(
    (Path(__file__).parents[1] / "results" / "suspects_frozen.json").read_text(encoding="utf-8")
)["outcomes"]
"""Outcomes before the search was rewritten: the true cause is "named", perhaps among others;
something is "unconfirmed", "doubtful", or "none" of the suspects explains it; the model "holds"."""

CAUSES = "cause", "causes", "rivals"
UNSETTLED = {"rivals", "far", "likeliest", "no-suspect"}
RISKS = {"undetectable", "untestable", "undetectable-others", "contradicted"}
"""Codes of findings: that name causes, that ask for refits, and on what the data would not show."""


def false_causes(case: Case, result: IdentificationResult) -> list[str]:
    """Sentences of a cause, or of several, without the true one."""
    return [
        str(one)
        for one in result.findings
        if one.code in CAUSES
        and not any(is_right(case, suspect["name"]) for suspect in one.facts["cases"])
    ]


def summed(case: Case, reps: list[Repetition]) -> dict[str, Any]:
    """A case in numbers; `silent`: seeds of which an estimate is off without being covered."""
    every = [z for one in reps for z in one.off.values()]
    odds = Counter[str]()
    for one in reps:
        odds.update(one.named)
    return {
        "name": case.name, "held": sum(abs(z) < 1.96 for z in every), "of": len(every),
        "worst": [one.off.get(one.worst, 0.0) for one in reps],
        "worst_of": [one.worst for one in reps],
        "verdicts": Counter(one.verdict for one in reps),
        "outcomes": Counter(one.outcome(case) for one in reps), "frozen": FROZEN.get(case.name, ""),
        "named": sum(one.named_rightly(case) for one in reps),
        "odds": {k: x / len(reps) for k, x in odds.items()},
        "false": sum(bool(one.false) for one in reps),
        "covered": sum(one.covered(case) for one in reps),
        "silent": sum(one.silent(case) for one in reps),
        "identify_s": max(one.identify_s for one in reps),
        "explain_s": max((one.explain_s for one in reps if one.explain_s), default=None),
        "repetitions": [one._asdict() for one in reps],
    }  # fmt: skip


def repeat(case: Case, made: Sequence[Made], seed: int, config: Settings) -> Repetition:
    """Identify a case from its recordings with one seed of the noise."""
    name = re.sub(r"[^\w.+-]+", "-", case.name)
    folder = config.out / f"runs-{name}-{seed}"
    how: dict[str, Any] = {"rtol": config.rtol, "checkpoint": folder}
    explain_s = None
    try:
        one = case.problem(made, seed)
        result, identify_s = timed(lambda: identify(one, **how))
        if config.explain and {one.code for one in result.findings} & UNSETTLED:
            result, explain_s = timed(lambda: explain(one, **how))
    except (Unreachable, ValueError) as error:
        if not case.rejected:
            raise
        return Repetition({}, {}, [], "rejected", [str(error)], [], [], 0.0, None)
    forget(folder)
    off = {
        e.name: float(np.log(e.value / TRUTH[e.name]) / e.relative_sd)
        for e in result.estimates if e.value is not None
    }  # fmt: skip
    named = {one.name: one.score for one in result.assumptions if one.score > LIKELY}
    unseen = [str(one) for one in result.findings if one.code in RISKS]
    notices = [str(one) for one in result.findings if one.code not in RISKS]
    return Repetition(
        off, named, false_causes(case, result), result.verdict, notices,
        unseen, [one.code for one in result.findings], identify_s, explain_s,
    )  # fmt: skip


def table(cases: list[dict[str, Any]]) -> Table:
    rows = []
    for one in cases:
        odds = sorted(one["odds"].items(), key=lambda item: -item[1])[:2]
        worst = int(np.argmax(np.abs(one["worst"])))
        of = one["worst_of"][worst].rpartition(".")[2]
        rows.append((
            one["name"], f"{one['held']} of {one['of']}",
            f"{abs(one['worst'][worst]):.1f} {of}".rstrip(),
            ", ".join(f"{outcome} ({count})" for outcome, count in one["outcomes"].items()),
            one["frozen"],
            ", ".join(f"{name} ({x:.2g})" for name, x in odds) or "-",
            f"{one['identify_s']:.0f}", f"{one['explain_s']:.0f}" if one["explain_s"] else "-",
        ))  # fmt: skip
    head = ("what differs", "intervals that hold", "worst error / sd", "outcome",
            "frozen", "named (mean odds)", "identify [s]", "explain [s]")  # fmt: skip
    return Table(head, rows)


OUTCOMES = "named", "unconfirmed", "doubtful", "none", "holds", "false cause"


def outcomes(cases: list[dict[str, Any]]) -> Table:
    """Repetitions by the outcome of `FROZEN`, a row each, and by their own, a column each."""
    pairs = Counter[tuple[str, str]]()
    for one in cases:
        for outcome, count in one["outcomes"].items():
            pairs[one["frozen"], outcome] += count
    before, now = ([one for one in OUTCOMES if any(pair[k] == one for pair in pairs)]
                   for k in (0, 1))  # fmt: skip
    rows = [[was, *(str(pairs[was, one] or "") for one in now)] for was in before]
    return Table(("before", *now), rows)


def study(cases: Sequence[Case], config: Settings, name: str) -> None:
    """Make the recordings of all cases, identify them from every seed, and write their table."""
    made = make_all((o for case in cases for o in case.orders), config.step, config.workers)
    done = list[dict[str, Any]]()
    for case in cases:
        runs = [made[order] for order in case.orders]
        one = lambda seed, case=case, runs=runs: repeat(case, runs, config.first + seed, config)
        done.append(summed(case, repeated(one, config.seeds, config.workers, case.name)))
        totals = {what: sum(row[what] for row in done) for what in ("silent", "false")}
        tables = {name: table(done)}
        if any(row["frozen"] for row in done):
            tables["outcomes"] = outcomes(done)
        write(config, {**totals, "cases": done}, tables)


def main(config: Config) -> None:
    some = TABLES[config.table] if not config.only else EVERY
    cases = chosen(some, config.only) if not config.smoke else chosen(EVERY, config.only or SMOKE)
    if config.smoke:
        config = replace(config, seeds=1, workers=1, rtol=1e-4, step=5e-5)
    study(cases, config, config.table)


if __name__ == "__main__":
    main(options(Config, __doc__))
