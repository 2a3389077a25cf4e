"""Question: can an interval be wrong without a warning beside it, when the rig is not the one that
the fit takes for granted?

A second simulator (`tests/foreign`: own finite elements, one dense Newton system, backward Euler at
20 us, no function shared with torchsoft) makes recordings of rigs that differ in what a laboratory
would not know: the mesh, the friction law, the place of the disc, its radius. Others differ in the
sensors (zero, sign, delay, colour) or in what is noted down (set-points at the samples only, F_ff
left out, whose x the loop measures). `torchsoft.sysid` identifies eight parameters from each, with
noise of 10 um, 0.5 mrad and 0.1 N at 200 Hz; every case has the same noise, so that cases differ by
what is wrong and not by luck. An interval holds the truth or not; a warning names the cause or not.

Command: .venv/bin/python experiments/validation/foreign_rigs.py [--smoke] [--only "mesh 240 x 6"]
[--workers 2] Expected: every interval holds, or a warning names the cause; no case is silent. About
an hour on two cores, the recordings included.
"""

import sys
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from torchsoft import Reference, RigFile, excite
from torchsoft.experiment import COARSE, RIG, coloured, markdown, options, repeated, write
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import (
    IdentificationResult,
    Problem,
    Recording,
    Unreachable,
    explain,
)
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import forget

TESTS = Path(__file__).parents[2] / "tests"
sys.path[:0] = str(TESTS), str(Path(__file__).parents[1])

from foreign import Numbers, simulate  # noqa: E402  # pyright: ignore[reportMissingImports]
from identify_contact import LAW, MU_S, RUBBER, TRUTH, problem  # noqa: E402

SMOKE_UNKNOWNS = MU_S, f"{LAW}.K_n", f"{RUBBER}.E", f"{RUBBER}.tau"

SIGNALS = ("x_d", "y_d", "F_ff")
CALLED = {"theta_C": "theta", "effort_x": "F_x", "effort_y": "F_y"}
"""Channels as the stranger calls them."""

SETTLE = 0.2
"""Time [s] that the rig is simulated before the first sample: the disc has been put down then."""

CLEAR = 1e-4
"""Gap [m] between disc and upper pad at the start, as the stranger's runs have it."""

KEPT = 1e-3
"""Spacing [s] of the rows that are kept."""

RATE = 200.0
"""Samples a second."""


def sines(roll: float, band: tuple[float, float], duration: float, depth: float) -> Excitation:
    """Shaken along [m] and across the pads."""
    sums = [
        {"kind": "multi_sine", "amplitude": size, "band": band, "seed": seed}
        for seed, size in enumerate((roll, 2e-4))
    ]
    return Excitation(*sums, duration=duration, depth=depth)


def strokes(travel: float, stroke_time: float, duration: float, depth: float) -> Excitation:
    motion = {"kind": "strokes", "travel": travel, "stroke_time": stroke_time}
    return Excitation(motion, None, duration, depth)


def sweep(amplitude: float, first: float, last: float) -> dict[str, Any]:
    return {"kind": "chirp", "amplitude": amplitude, "first": first, "last": last}


def pressing(
    travel: float, amplitude: float, frequency: float, duration: float, depth: float
) -> Excitation:
    """Pressed at a frequency [Hz] while the disc rolls."""
    times, values = (0.5, duration), (0.0, travel)
    roll = {"kind": "profile", "times": times, "values": values, "offset": "start"}
    return Excitation(roll, sweep(amplitude, frequency, frequency), duration, depth)


EXCITATIONS = {
    "deep pressing": pressing(20e-3, 8e-4, 17.0, 1.2, 2.4e-3),
    "light shaking": sines(6e-3, (4.0, 20.0), 1.2, 2e-4),
    "light jerks": strokes(80e-3, 0.2, 1.0, 1e-4),
    "deep chirp": Excitation(sweep(5e-3, 1.0, 25.0), sweep(5e-4, 1.0, 25.0), 1.3, 2.4e-3),
    "hard shaking": sines(12.5e-3, (4.0, 20.0), 1.2, 2e-4),
    "long shaking": sines(12.5e-3, (4.0, 20.0), 1.5, 2e-4),
    "gentle roll": strokes(10e-3, 0.6, 1.5, 1.4e-3),
    "pressing": pressing(8e-3, 4e-4, 12.0, 0.9, 1.4e-3),
    "shaking": sines(6e-3, (4.0, 17.0), 0.9, 3e-4),
}
"""Motions of a second or so: three gentle ones, which show all eight parameters together, hard
ones, and the two of the smoke size."""


class Made(NamedTuple):
    """One run: times (n,) [s] every `KEPT`, channels (n,) by name, and the fastest slip [m/s]."""

    t: Array
    channels: dict[str, Array]
    slip: float


class Order(NamedTuple):
    """One run that is to be made: an excitation by name, and how the rig differs, by the names of
    `foreign.Numbers`; `smoke`: on a coarse mesh."""

    excitation: str
    differs: tuple[tuple[str, Any], ...] = ()
    smoke: bool = False


def planned(excitation: str, smoke: bool) -> RigFile:
    """What the laboratory knows and has planned; the unknown numbers are the usual ones."""
    known = {name: value for name, value in TRUTH.items() if name not in SMOKE_UNKNOWNS}
    less = COARSE | known if smoke else {}
    file = RigFile.ready("paper").override({"contact.v_s": 0.05} | less)
    return excite(file, EXCITATIONS[excitation]._replace(grip=-CLEAR))


def numbers(file: RigFile, differs: Mapping[str, Any]) -> Numbers:
    """The stranger's rig: the known numbers, the truth of the unknown ones, and what differs."""
    stated = {name: row["value"] for name, row in file.table().items()}
    known = {
        "v_s": f"{LAW}.friction.v_s", "nu": f"{RUBBER}.nu", "depth": f"{RUBBER}.depth",
        "length": "pads.U.length", "height": "pads.U.height", "across": "pads.U.elements_x",
        "through": "pads.U.elements_y", "radius": "bodies.disc.shape.radius",
        "mass": "bodies.disc.mass", "bracket_mass": "bodies.bracket.mass", "gravity": "gravity",
        "x_C0": "bodies.disc.start.x", "K_x": "actuators.x.Kp", "R_x": "actuators.x.Kd",
        "K_y": "actuators.y.Kp", "R_y": "actuators.y.Kd",
    }  # fmt: skip
    return Numbers(**{
        **{own: stated[name] for own, name in known.items()},
        **{name.rpartition(".")[2]: value for name, value in TRUTH.items()},
        "cm_height": -stated["pads.U.origin"][1], "spacing": 1e-3,
        "senses_disc": file.actuators["x"].measures == "disc.x",
        **differs,
    })  # fmt: skip


def make(order: Order, step: float) -> Made:
    """A run of the stranger's simulator on steps of `step` and of twice that, extrapolated to none,
    for the error of backward Euler is of first order. The literal law jumps, and is not
    extrapolated."""
    fine = stepped(order, step)
    if dict(order.differs).get("literal"):
        return fine
    coarse = stepped(order, 2 * step)
    return fine._replace(
        channels={name: 2 * value - coarse.channels[name] for name, value in fine.channels.items()}
    )


def stepped(order: Order, step: float) -> Made:
    """A run of the stranger's simulator on steps of `step` [s]."""
    file = planned(order.excitation, order.smoke)
    count = round((file.outputs.duration + SETTLE) / step)
    t = step * (np.arange(count + 1) - round(SETTLE / step))
    signals = file.build().rig.reference(torch.from_numpy(t), SIGNALS).detach().numpy()
    run = simulate(numbers(file, dict(order.differs)), t, signals, round(KEPT / step))
    return Made(run.t, run.channels, float(np.max(run.slip)))


def make_all(orders: Iterable[Order], step: float, workers: int) -> dict[Order, Made]:
    """All runs, side by side in threads."""
    every = list(dict.fromkeys(orders))
    made = repeated(lambda i: make(every[i], step), len(every), workers, "recordings")
    return dict(zip(every, made))


Samples = dict[str, tuple[Array, Array]]
"""Times (k,) [s] and values (k,) by channel."""


def pink(count: int, rng: np.random.Generator) -> Array:
    """Noise (count,) of deviation 1 whose power falls with the frequency, down to one period a
    recording."""
    spectrum = np.fft.rfft(rng.standard_normal(count))
    spectrum /= np.maximum(np.arange(len(spectrum)), 1.0) ** 0.5
    noise = np.fft.irfft(spectrum, count)
    return noise / noise.std()


def sampled(
    made: Made, seed: int, delay: Mapping[str, float], colour: float | Literal["pink"]
) -> Samples:
    """What the sensors `RIG` give at `RATE` from t = 0 on, some of them late by a `delay` [s] (a
    multiple of `KEPT`).

    Their noise has their own deviation and the first autocorrelation `colour`, or is pink; it is
    the same for the same seed.
    """
    rng, out = np.random.default_rng(seed), {}
    every, first = round(1 / RATE / KEPT), int(np.searchsorted(made.t, -0.5 * KEPT))
    for channel, sensor in RIG.items():
        at = np.arange(first, len(made.t), every)
        noise = pink(len(at), rng) if colour == "pink" else coloured(len(at), colour, rng)
        exact = made.channels[CALLED.get(channel, channel)][
            at - round(delay.get(channel, 0.0) / KEPT)
        ]
        out[channel] = (made.t[at], exact + sensor.noise * noise)
    return out


GENTLE = ("deep pressing", "light shaking", "light jerks")


@dataclass(frozen=True)
class Case:
    """A rig that `differs` by the names of `foreign.Numbers`, sensors that are late or coloured or
    have an `offset`, `flipped` channels, and what the laboratory notes wrongly: other settings, no
    `F_ff`, set-points at the samples only.

    `cause` are words one of which a warning must have to name what is wrong; none where nothing is.
    """

    name: str
    cause: tuple[str, ...] = ()
    excitations: tuple[str, ...] = GENTLE
    differs: Mapping[str, Any] = field(default_factory=dict)
    delay: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    colour: float | Literal["pink"] = 0.0
    flipped: tuple[str, ...] = ()
    noted: Mapping[str, Any] = field(default_factory=dict)
    no_feed_forward: bool = False
    sparse: bool = False

    def recording(self, excitation: str, made: Made, seed: int, smoke: bool = False) -> Recording:
        """One run as the laboratory hands it over, sampled by its sensors."""
        file = planned(excitation, smoke)
        reference = file.build().rig.reference
        if self.sparse:
            reference = at_samples(reference, file.outputs.duration)
        if self.no_feed_forward:
            signals = {name: reference[name] for name in ("x_d", "y_d")}
            reference = Reference(**signals, F_ff=Profile([0.0], [0.0]))
        samples = sampled(made, seed, self.delay, self.colour)
        for channel, (t, y) in samples.items():
            sign = -1.0 if channel in self.flipped else 1.0
            samples[channel] = t, sign * (y + self.offset.get(channel, 0.0))
        rig, y0, _ = file.override(self.noted).build()
        rig.reference = reference
        at_rest = Standing.of(rig, y0, rests={"disc": [1]})
        return Recording(excitation, rig, samples, at_rest)


def at_samples(reference: Reference, duration: float) -> Reference:
    """The reference as a file at the sensors' rate has it: values, and splines between them."""
    t = torch.from_numpy(np.arange(0.0, duration + 0.5 / RATE, 1 / RATE))
    values = reference(t, SIGNALS)[..., 0].detach()
    return Reference(**{name: Sampled(t, values[:, i]) for i, name in enumerate(SIGNALS)})


CASES = (
    Case("same assumptions, gentle"),
    Case("same assumptions, hard", excitations=("deep chirp", "light shaking", "light jerks")),
    Case("slip at 0.15 m/s", excitations=("deep pressing", "light shaking", "hard shaking")),
    Case("mesh 240 x 6", ("mesh", "element"), differs={"across": 240, "through": 6}),
    Case("literal Coulomb", ("none of the assumptions",), differs={"literal": True}),
    Case("x_C0 off by 40 um", ("disc begins",), differs={"x_C0": 60.34e-3}),
    Case("theta zeroed elsewhere", ("theta",), offset={"theta_C": 0.02}),
    Case("set-points at 200 Hz", ("set-point", "setpoint"), sparse=True),
    Case("F_ff left out", ("F_ff", "fed forward", "feed-forward"), no_feed_forward=True),
    Case("loop convention wrong", ("senses", "x_d"), noted={"control.senses": "disc.x"}),
    Case("sign of F_x flipped", ("sign",), flipped=("effort_x",)),
    Case("AR(1) noise of 0.9", ("colour", "white", "AR(", "autocorrel"), colour=0.9),
    Case("camera 2 ms late", ("delay", "late"), delay={"x_C": 2e-3, "y_C": 2e-3, "theta_C": 2e-3}),
    Case("radius off by 0.5 %", ("radius",), differs={"radius": 1.005 * 19.37e-3}),
)


START = 1.6
"""Every parameter begins off by this factor, one up and the next one down."""

SMOKE = ("same assumptions, gentle", "sign of F_x flipped")


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/foreign_rigs")
    rtol: float = 1e-5  # of the fits' last stage
    step: float = 20e-6  # of the stranger's simulator [s]; 1 ms is a multiple of twice as much
    seed: int = 7  # of the noise
    workers: int = 2
    only: tuple[str, ...] = ()  # names of cases; all of them by default
    smoke: bool = False  # two cases, four parameters, two short recordings on a coarse mesh


@dataclass(frozen=True)
class Outcome:
    """One case with what came of it: by parameter the truth, the estimate, its error [1] and
    interval and whether that holds the truth; the sum of squares a sample; warnings, or the
    sentence with which it was refused."""

    name: str
    parameters: dict[str, dict[str, Any]]
    chi2: float | None
    warnings: list[str]
    verdict: str
    fastest_slip: float
    wall_s: float


def stated(recordings: list[Recording], truth: Mapping[str, float]) -> Problem:
    """Starts off by `START`; mu_k by its ratio to mu_s."""
    begin = {name: value * START ** (-1) ** i for i, (name, value) in enumerate(truth.items())}
    if "contact.mu_k" in begin:
        begin["contact.mu_k"] = 0.9 * begin["contact.mu_s"]
    return problem(recordings, begin)


def chosen(cases: Iterable[Any], only: Sequence[str]) -> list[Any]:
    """The cases that were asked for, or all. Raises `ValueError` for a name that is not there."""
    known = {case.name: case for case in cases}
    if strange := [name for name in only if name not in known]:
        raise ValueError(f"there is no case {strange[0]!r}; the cases are {', '.join(known)}")
    return [known[name] for name in only or known]


def judged(found: IdentificationResult, truth: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Estimates beside the truth; one without an interval claims nothing."""
    out = {}
    for name, value in truth.items():
        e = found[name]
        out[name] = {
            "truth": value, "estimate": e.value, "ci95": e.ci95, "relative_sd": e.relative_sd,
            "error": None if e.value is None else e.value / value - 1,
            "inside": None if e.ci95 is None else bool(e.ci95[0] <= value <= e.ci95[1]),
        }  # fmt: skip
    return out


def study(case: Case, made: Sequence[Made], config: Config) -> Outcome:
    """Identify one case. Its runs are kept until it is done: begun again, it goes through them in
    seconds."""
    runs = config.out / f"runs-{case.name.replace(' ', '-').replace('/', '-')}"
    truth = {name: TRUTH[name] for name in SMOKE_UNKNOWNS} if config.smoke else TRUTH
    began, rows, chi2 = perf_counter(), dict[str, dict[str, Any]](), None
    try:
        recordings = [
            case.recording(name, one, config.seed + 10 * k, config.smoke)
            for k, (name, one) in enumerate(zip(case.excitations, made))
        ]
        found = explain(
            stated(recordings, truth), rtol=config.rtol, workers=config.workers, checkpoint=runs,
            progress=not config.smoke,
        )  # fmt: skip
        rows, chi2, notices = judged(found, truth), found.chi2, [*map(str, found.findings)]
    except (Unreachable, ValueError) as error:
        notices = [str(error)]
    named = any(word.lower() in text.lower() for word in case.cause for text in notices)
    if rows and all(row["inside"] is not False for row in rows.values()):
        verdict = "holds"
    else:
        verdict = "cause named" if named else "warned, cause not named" if notices else "silent"
    slip, wall = max(one.slip for one in made), perf_counter() - began
    return Outcome(case.name, rows, chi2, notices, verdict, slip, wall)


def table(outcomes: list[Outcome]) -> str:
    """Errors in percent, those outside of their interval in bold, and what was said."""
    rows = []
    for one in outcomes:
        cells = [
            "-" if row["error"] is None else f"{100 * row['error']:+.2g}" if row["inside"]
            else f"**{100 * row['error']:+.2g}**"
            for row in one.parameters.values()
        ]  # fmt: skip
        chi2 = "-" if one.chi2 is None else f"{one.chi2:.3f}"
        warnings = "; ".join(textwrap.shorten(text, 110) for text in one.warnings).replace("|", "/")
        errors = " ".join(cells)
        rows.append((one.name, errors, chi2, one.verdict, f"{one.wall_s:.0f}", warnings or "-"))
    names = max((one.parameters for one in outcomes), key=len)
    short = " ".join(name.rpartition(".")[2] for name in names)
    head = ("case", f"errors [%] of {short}", "chi2", "verdict", "wall [s]", "warnings")
    return markdown(head, rows)


def main(config: Config) -> None:
    cases = chosen(CASES, config.only or (SMOKE if config.smoke else ()))
    if config.smoke:
        config = replace(config, workers=1, step=5e-5)
        cases = [replace(case, excitations=("pressing", "shaking")) for case in cases]
    orders = {
        case.name: [
            Order(name, tuple(sorted(case.differs.items())), config.smoke)
            for name in case.excitations
        ]
        for case in cases
    }
    every = [order for some in orders.values() for order in some]
    made, outcomes = make_all(every, config.step, config.workers), list[Outcome]()
    for case in cases:
        outcomes.append(study(case, [made[order] for order in orders[case.name]], config))
        print(f"\n{case.name}: {outcomes[-1].verdict}", *outcomes[-1].warnings, sep="\n  ")
        verdicts = Counter(one.verdict for one in outcomes)
        content = {"verdicts": verdicts, "cases": [asdict(one) for one in outcomes]}
        write(config, content, table=table(outcomes))
    for folder in config.out.glob("runs-*"):
        forget(folder)


if __name__ == "__main__":
    main(options(Config, __doc__))
