"""What an identification takes for granted: data name the assumption that is wrong, and intervals
allow for what they cannot tell. Conclusions are rows: numbers in, conclusion out."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from torchsoft import RigFile
from torchsoft.sysid import (
    Estimate,
    IdentificationResult,
    Problem,
    Recording,
    Sensor,
    Stage,
    Unknown,
    explain,
    identify,
    record,
)
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.estimate import Quantity
from torchsoft.sysid.identification import notices_on, ordering_constraints
from torchsoft.sysid.refits import fewest, pursuit
from torchsoft.sysid.residual_tests import Verdict
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sensitivity import Checked, with_odds
from torchsoft.sysid.suspects import LIKELY, assumption_doubts, assumption_notices, unseen

E, K_N, MU_S, MU_K = "materials.gel.E", "laws.dry.K_n", "contact.mu_s", "contact.mu_k"
TRUTH = {E: 0.85e6, K_N: 1.3e5}
SENSORS = {
    "x_ball": Sensor(noise=1e-5), "y_ball": Sensor(noise=2e-6),
    "theta_ball": Sensor(noise=5e-4), "effort_y": Sensor(noise=0.05),
}  # fmt: skip
BALL = RigFile.from_tree({
    "bodies": {"ball": {"mass": 0.4, "shape": {"kind": "circle", "radius": 20e-3},
                        "start": {"x": 30e-3, "y": "rest"}}},
    "materials": {"gel": {"kind": "kelvin_voigt", "E": 0.8e6, "nu": 0.45, "tau": 5e-3,
                          "depth": 40e-3}},
    "pads": {"floor": {"material": "gel", "length": 60e-3, "height": 5e-3, "elements_x": 30,
                       "elements_y": 1}},
    "laws": {"dry": {"K_n": 1.2e5, "R_n": 400.0, "K_t": 1.2e5, "R_t": 400.0, "friction":
                     {"kind": "smooth", "mu_s": 0.8, "mu_k": 0.7, "v_s": 0.05}}},
    "contacts": {"floor": {"pad": "floor", "body": "ball", "law": "dry"}},
    "actuators": {"x": {"pushes": "ball.x", "setpoint": "x_d", "Kp": 1e4, "Kd": 100.0},
                  "y": {"pushes": "ball.y", "setpoint": "y_d", "Kp": 5e4, "Kd": 200.0}},
    "motion": {"x_d": {"kind": "profile", "times": [0.05, 0.15, 0.25],
                       "values": ["start", 36e-3, 30e-3]},
               "y_d": {"kind": "profile", "times": [0.0, 0.05, 0.1, 0.15, 0.25],
                       "values": ["start", 24.2e-3, 24.5e-3, 24.0e-3, 24.4e-3]}},
    "outputs": {"duration": 0.3, "interval": 5e-3},
})  # fmt: skip
"""A ball that two controllers press onto a soft floor and roll along it."""

Reading = Callable[[str, np.ndarray, np.ndarray], np.ndarray]


FINER = {"pads.floor.elements_x": 60, "pads.floor.elements_y": 2}


@cache
def exact(finer: bool = False, **truth: float) -> Recording:
    named = {name.replace("__", "."): value for name, value in truth.items()}
    file = BALL.override(FINER) if finer else BALL
    return record("press", file.build(), TRUTH | named, SENSORS, rtol=1e-5, noise=0.0)


def recorded(reading: Reading = lambda name, t, y: y, **made: Any) -> Recording:
    """The recording with samples of another rig, and another reading of the exact samples by
    channel; noise is as stated."""
    rng, samples = np.random.default_rng(4), {}
    for name, (t, y) in exact(**made).samples.items():
        noise = SENSORS[name].noise * rng.standard_normal(len(t))
        samples[name] = t, reading(name, t, y) + noise
    return replace(exact(), samples=samples)


def fitted(
    fit: Callable[..., IdentificationResult], recording: Recording, **how: Any
) -> IdentificationResult:
    problem = Problem([recording], SENSORS, {name: Unknown() for name in TRUTH})
    stages = [Stage("all", problem.names, problem.coordinates.labels, 1e-4)]
    return fit(problem, plan=stages, **how)


def named(answer: IdentificationResult) -> dict[str, AssumptionTest]:
    """The assumptions of which one is the cause."""
    found = [one for one in answer.assumptions if one.suspected and one.odds > LIKELY]
    return {one.name: one for one in found if one.passed}


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Data of the model itself: with trusted assumptions, interrupted among their tests, whole."""
    runs, run = [], Runner.run
    folder = tmp_path_factory.mktemp("runs")

    def counted(self: Runner, jobs: Any) -> Any:
        runs.append(1)
        if len(runs) == most:
            raise KeyboardInterrupt
        return run(self, jobs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runner, "run", counted)
        most = 0
        trusted = fitted(identify, recorded(), checkpoint=folder, assumptions="trusted")
        most = 2 * len(runs) + 5
        interrupted = fitted(identify, recorded(), checkpoint=folder)
    return trusted, interrupted, fitted(identify, recorded(), checkpoint=folder)


def test_nothing_speaks_against_what_is_right(answers):
    trusted, _, whole = answers
    assert (whole.verdict, whole.notices, whole.doubts) == ("holds", [], [])
    names = {one.name for one in whole.assumptions}
    assert {
        "mesh", "contact points", "mesh phase", "Coulomb friction",
        "actuators.y.Kp", "bodies.ball.shape.radius", "bias x_ball", "gain theta_ball",
        "clock of the set-points", "tilt of the pad floor", "limit of the controller x",
    } <= names  # fmt: skip
    assert not names & set(TRUTH)
    assert not any(one.unchecked or one.suspected for one in whole.assumptions)
    for name, value in TRUTH.items():
        assert abs(np.log(whole[name].last / value)) < 3 * whole[name].relative_sd
        assert whole[name].relative_sd >= 0.999 * trusted[name].relative_sd
    assert any("would not be seen, and moves" in text for text in whole.unseen)


def test_an_interrupt_among_the_assumptions_keeps_the_fit(answers):
    trusted, stopped, whole = answers
    assert stopped[E].last == trusted[E].last == whole[E].last
    left = stopped.made_by["untried"]
    assert any(", ".join(left) in text and "same command" in text for text in stopped.notices)
    done, every = ({one.name for one in answer.assumptions} for answer in (stopped, whole))
    assert done < every
    assert {*left} == every - done
    assert whole.made_by["untried"] == []


def late(channels: str, by: float) -> Reading:
    return lambda name, t, y: CubicSpline(t, y)(np.maximum(t - by * (name in channels), t[0]))


def off(channel: str, add: float = 0.0, factor: float = 1.0) -> Reading:
    return lambda name, t, y: factor * y + add if name == channel else y


CAUSES: dict[str, tuple[Callable[[], Recording], float]] = {
    "delay x_ball": (lambda: recorded(late("x_ball", 3e-4)), 0.3),
    "bias theta_ball": (lambda: recorded(off("theta_ball", 3e-3)), 3e-3),
    "gain effort_y": (lambda: recorded(off("effort_y", factor=1.05)), 5.0),
    "bodies.ball.mass": (lambda: recorded(bodies__ball__mass=0.44), 10.0),
    "bodies.ball.shape.radius": (lambda: recorded(bodies__ball__shape__radius=20.1e-3), 0.5),
    "mesh": (lambda: recorded(finer=True), 1.0),
}


@pytest.mark.parametrize(
    "name", [k if k == "delay x_ball" else pytest.param(k, marks=pytest.mark.slow) for k in CAUSES]
)
def test_the_cause_of_a_misfit_is_named_with_its_amount(name):
    """Alone, or beside what acts alike, such as a low-pass beside a delay."""
    make, amount = CAUSES[name]
    answer = fitted(explain, make(), effort=0.5 if name == "delay x_ball" else 4.0)
    found, (doubt, *_) = named(answer), answer.doubts
    assert name in found
    assert answer.explained
    assert all(other in doubt or found[other].stated in doubt for other in found)
    one = found[name]
    assert one.odds > 0.1
    assert sum(rival.odds for rival in found.values()) == pytest.approx(1.0, abs=LIKELY)
    assert one.favoured == pytest.approx(amount, rel=0.1, abs=4 * one.favoured_sd)
    assert one.under[E] == pytest.approx(TRUTH[E], rel=0.05)
    if one.parameter:
        assert one.value == pytest.approx(one.nominal * (1 + one.favoured / 100), rel=1e-9)


@pytest.mark.slow
def test_of_two_causes_neither_is_the_cause():
    """An offset of one sensor and the gain of another."""
    both = lambda name, t, y: off("theta_ball", 3e-3)(
        name, t, off("effort_y", factor=1.05)(name, t, y)
    )
    answer = fitted(identify, recorded(both))
    assert answer.verdict == "does not explain"
    assert not answer.explained
    assert re.search("which only a new fit can exclude|first order", answer.doubts[0])
    assert not answer.doubts[0].startswith("the data contradict that")


# Conclusions: numbers in, conclusion out

ALARM = Verdict("motion", "roll", "x", 1e-9, 0.4, "x of `roll` (40% of it, most like its rate)")


def suspect(name: str, gain: float, **more: Any) -> AssumptionTest:
    """A number that a new fit finds 5 % off; the sum of squares was 1000."""
    usual: dict[str, Any] = {
        "left": 1000.0 - gain, "favoured": 5.0, "favoured_sd": 0.5, "significance": gain,
        "value": 1.05, "refitted": True, "passed": True, "moves": {E: 0.4}, "under": {E: 8e5},
    }  # fmt: skip
    stated = f"{name} is 1"
    return AssumptionTest(
        name, "known", stated, "", 1.0, "%", name, 1.0, 0.01, gain=gain, **usual | more
    )


def concluded(tests: list[AssumptionTest], **more: Any) -> Checked:
    found: dict[str, Any] = {"as_stated": (ALARM,), "sd": {E: 0.004}} | more
    return Checked(with_odds(tests, 990), np.zeros((1, 0)), np.eye(1), **found)


none, a = suspect("c", 0.5, significance=0.5), suspect("a", 300.0)
linear = partial(suspect, refitted=False)
LEFT: dict[str, Any] = {"alarms": (ALARM,), "left": (ALARM,)}


@pytest.mark.parametrize(
    ("tests", "found", "explains", "says"),
    [
        ([none], {"as_stated": ()}, False, None),
        ([a, none], {}, True, r"^the data contradict that a is 1: .* falls by 300 in a new fit "
         r"with a = 1\.05 \(\+5 %, \+- 0\.5\); .*E would move by 0\.4 .* under it: .*E = 8e\+05"),
        ([a, suspect("b", 299.0), suspect("c", 200.0)], {}, True, r"one of 2 assumptions, .* do "
         r"not tell which: .* a with .*, odds 0\.56; b with .*, odds 0\.44; estimates under"),
        ([suspect("b", 300.0, passed=False), suspect("a", 280.0)], {}, True, "that a is 1"),
        ([linear("a", 31.0)], {"as_stated": ()}, False, "^something is not as stated, most like a"
         ".* would fall by 31 .* nothing confirms the cause"),
        ([linear("a", 531.0, moves={E: 3.6})], {"candidates": ("a",)}, True,
         "most like a: .*E would move by 18 standard deviations, too far .* `explain` fits again"),
        ([suspect("a", 531.0, under={})], {}, True, "that a is 1.* has not come to rest"),
        ([a], LEFT, False, r"none of the assumptions tested: .* nearest one, a, .* falls by 300 .* "
         "but residuals follow the motion in x of `roll`"),
        ([linear("a", 300.0)], LEFT, False, "which only a new fit can exclude, is a: .* but resid"),
        ([linear("a", 300.0)], LEFT | {"left": (), "besides": (suspect("d", 50.0),)}, False,
         "; nothing would be left with d with d = 1.05"),
        ([linear("a", 300.0), linear("b", 250.0)], {"candidates": ("a", "b")}, True,
         r"one of 2 assumptions, .*: a \(by 300\); b \(by 250\): `explain` compares them"),
        ([none], LEFT, False, "none of 1 suspects explains the misfit: residuals follow"),
        ([linear("c", 2.0)], LEFT | {"candidates": ("c",)}, False,
         r"no suspect explains .* c \(0% of .*: `explain` fits again with each of 1"),
    ],
)  # fmt: skip
def test_the_conclusion_is_that_of_the_numbers(tests, found, explains, says):
    checked = concluded(tests, **found)
    assert checked.explained == explains
    doubts = assumption_doubts(checked)
    assert len(doubts) == (says is not None)
    if says is not None:
        assert re.search(says, doubts[0]), doubts[0]


def test_odds_are_tempered_and_a_law_has_no_amplitude_to_pay_for():
    law = replace(suspect("law", 300.0 - np.log(990)), kind="law")
    assert [one.odds for one in concluded([a, law]).checks] == pytest.approx([0.5, 0.5])
    odds = [one.odds for one in concluded([a, suspect("b", 299.0)]).checks]
    assert odds[0] / odds[1] == pytest.approx(np.exp(0.5 * 0.46), rel=1e-6)


@pytest.mark.parametrize(
    ("favoured", "refitted", "unit", "suspected"),
    [(24.0, False, "%", True), (-208.0, False, "%", False), (-208.0, True, "%", True),
     (124.0, False, "N", True)],
)  # fmt: skip
def test_a_number_that_would_have_to_vanish_is_no_cause(favoured, refitted, unit, suspected):
    one = suspect("a", 900.0, favoured=favoured, refitted=refitted)
    assert replace(one, unit=unit, suspected=None).suspected is suspected


def test_what_would_not_be_seen_is_stated_with_its_size_or_its_price():
    """The worst three of each kind that move an estimate by more than a standard deviation, and
    first what the data hint at."""

    def hidden(name: str, move: float, detectable: float, **more: Any) -> AssumptionTest:
        usual = {"moves": {E: move}, "detectable": detectable, "refitted": False}
        return suspect(name, 0.0, **usual | more)

    tests = [
        hidden("a", 2.0, 3.0), hidden("b", -0.5, 4.0), hidden("c", 0.1, 5.0), hidden("d", 1.0, 1.5),
        hidden("e", 5.0, 0.5), hidden("far", 3.0, 1e3), hidden("seen", 9.0, 3.0, suspected=True),
        hidden("hint", 1.0, 2.0, significance=12.0, favoured=1.5, favoured_sd=0.43),
    ]  # fmt: skip
    found = [
        re.match(r"(\w+): (\S+) % .* moves \S+ by (\S+)", text) for text in unseen(concluded(tests))
    ]
    first = [one.groups() for one in found if one]
    assert first == [("hint", "2", "2"), ("a", "3", "6"), ("e", "0.5", "2.5")]
    said = unseen(concluded(tests))
    assert said[0].endswith("the data favour +1.5 % +- 0.43, which may be chance")
    assert said[3] == f"{E} takes far as exact: 1 % of it is +1.2 % of {E}"
    more = [hidden("x", 4.0, 3.0), hidden("y", 8.0, 2.0), hidden("z", 7.0, 1.0)]
    last = unseen(concluded([*tests, *more]))[-1]
    assert re.match("2 more would .* by up to 7 standard .*: z, a", last)


def test_constants_of_the_computation_widen_intervals_and_are_named():
    rng = np.random.default_rng(0)
    J, columns = rng.standard_normal((9, 2)), rng.standard_normal((9, 3))
    rows = np.concatenate([J, columns], 1)
    precision = rows.T @ rows + np.diag([0.0, 0.0, 1.0, 1.0, 1.0])
    mesh = AssumptionTest("mesh", "numerical", "pads have 10 elements", "they had 20",
                          moves={E: 1.5}, favoured_sd=0.8)  # fmt: skip
    lost = replace(mesh, unchecked="a run failed")
    checked = Checked([mesh, lost], columns, J, late=("b", "c"), sd={E: 0.1, K_N: 0.1})
    np.testing.assert_allclose(checked.covariance(), np.linalg.inv(precision)[:2, :2], rtol=1e-9)
    wide = np.sqrt(np.diag(np.linalg.inv(precision))[0] / np.linalg.inv(J.T @ J)[0, 0])
    assert checked.wider[E] == pytest.approx(wide)
    effort, moves, unknown = assumption_notices(checked)
    assert "none with another b, c" in effort
    assert re.search(rf"{E} hangs on .* pads have 10 .* by 1\.5 .* {wide:.2g} times as", moves)
    assert "could not be checked what it does that pads have 10 elements" in unknown


def test_the_fewest_effects_that_span_a_misfit_are_found():
    """Without e, which resembles the misfit most, but is not needed beside a and c; a copy adds
    nothing, and a one-sided effect counts on its side only."""
    effects = dict(zip("abcd", np.eye(8)))
    effects["e"] = np.array([0.7, 0.2, 0.65, 0, 0, 0, 0, 0.2]) / 1.006**0.5
    r = 5 * effects["a"] + 4 * effects["c"]
    for enough, names in ((0.01, ["a", "c"]), (5.0, ["e"]), (50.0, [])):
        assert fewest(effects, r, enough) == names
    assert fewest(effects, np.ones(8), 0.1) == []
    both = {"a": effects["a"], "copy": 2 * effects["a"], "c": effects["c"]}
    assert len(pursuit(both, r, 9)) == 2
    for sign, names in ((1.0, ["c"]), (-1.0, ["a", "c"])):
        assert pursuit({"a": sign * both["a"], "c": both["c"]}, r, 9, one_sided=["a"]) == names


def estimate(name: str, **more: Any) -> Estimate:
    usual: dict[str, Any] = {
        "unit": "m", "recording": None, "value": 2.0, "ci95": None, "relative_sd": 0.01,
        "last": 2.0, "identifiable": True, "at_bound": False, "step_bias_sd": 0.0,
    }  # fmt: skip
    return Estimate(name=name, **usual | more)


HELD = {"mu_s": (MU_K, 0.7)}


@pytest.mark.parametrize(
    ("found", "converged", "says"),
    [
        ([estimate("a")], True, []),
        ([estimate("a")], False, ["before it converged: give it more evaluations"]),
        ([estimate("a", at_bound=True)], True, [r"a ended at a bound \(2\): widen"]),
        ([estimate("a", at_bound=True, identifiable=False)], True, ["a is not identifiable"]),
        ([estimate("mu_s", at_bound=True, last=0.70007)], True, [f"{MU_K} = 0.7, which is known"]),
        ([estimate("a", at_bound=True, step_bias_sd=-1e7), estimate("E", step_bias_sd=2.0)], True,
         ["a ended", r"shifts E by 2 standard deviations \(\+2\.00%\); take rtol = 1e-06"]),
        ([estimate("x", step_bias_sd=2.0, last=1e-9, relative_sd=1e4)], True, [r"\(\+2e-05 m\)"]),
    ],
)  # fmt: skip
def test_bounds_steps_and_convergence_are_noted_where_they_mean_something(found, converged, says):
    notices = notices_on(found, HELD, converged, 1e-5, False)
    assert len(notices) == len(says)
    assert all(map(re.search, says, notices)), notices


def test_a_known_number_bounds_an_unknown_one():
    problem = Problem([exact()], SENSORS, {"laws.dry.friction.mu_s": Unknown()})
    held = ordering_constraints(problem)
    assert held == {"laws.dry.friction.mu_s": ("laws.dry.friction.mu_k", 0.7)}


@pytest.mark.parametrize(
    ("value", "sd", "seen"),
    [(0.2, 250.5, False), (300.0, 160.0, False), (300.0, 100.0, True), (0.2, 1.0, True)],
)
def test_an_interval_wider_than_its_value_determines_nothing(value, sd, seen):
    """On a linear scale from 0 to 600, but for a value that is next to zero for certain."""
    one = Quantity("R_t", "parameter", None, "", value, 1.0, 600.0, np.ones(1), [0], None)
    assert one.identifiable(sd / 600.0) is seen
    assert one._replace(kind="bias").identifiable(sd / 600.0)
