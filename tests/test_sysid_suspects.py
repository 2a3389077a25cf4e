"""What an identification takes for granted: data name the assumption that is wrong, and intervals
allow for what they cannot tell. Conclusions are rows: numbers in, conclusion out."""

import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from closed_forms import ClosedForm, optimum
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
from torchsoft.sysid.assumption_checks import Checked, with_scores
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.conclusion import estimate_findings, ordering_constraints, step_findings
from torchsoft.sysid.estimate import Quantity
from torchsoft.sysid.fit import Check
from torchsoft.sysid.residual_tests import ResidualTest
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.search import best_of
from torchsoft.sysid.suspect_findings import LIKELY, risk_findings, suspect_findings
from torchsoft.sysid.suspect_findings import test_findings as findings_of_tests

E, K_N, MU_K = "materials.gel.E", "laws.dry.K_n", "contact.mu_k"
TRUTH = {E: 0.85e6, K_N: 1.3e5}
SENSORS = {
    "x_ball": Sensor(noise=1e-5), "y_ball": Sensor(noise=2e-6),
    "theta_ball": Sensor(noise=5e-4), "effort_y": Sensor(noise=0.05),
}  # fmt: skip
BALL = RigFile.from_tree(
    tomllib.loads("""
[bodies.ball]
mass = 0.4
shape = {kind = "circle", radius = 20e-3}
start = {x = 30e-3, y = "rest"}
[materials.gel]
kind = "kelvin_voigt"
E = 0.8e6
nu = 0.45
tau = 5e-3
depth = 40e-3
[pads.floor]
material = "gel"
length = 60e-3
height = 5e-3
elements_x = 30
elements_y = 1
[laws.dry]
K_n = 1.2e5
R_n = 400.0
K_t = 1.2e5
R_t = 400.0
friction = {kind = "smooth", mu_s = 0.8, mu_k = 0.7, v_s = 0.05}
[contacts]
floor = {pad = "floor", body = "ball", law = "dry"}
[actuators]
x = {pushes = "ball.x", setpoint = "x_d", Kp = 1e4, Kd = 100.0}
y = {pushes = "ball.y", setpoint = "y_d", Kp = 5e4, Kd = 200.0}
[motion.x_d]
kind = "profile"
times = [0.05, 0.15, 0.25]
values = ["start", 36e-3, 30e-3]
[motion.y_d]
kind = "profile"
times = [0.0, 0.05, 0.1, 0.15, 0.25]
values = ["start", 24.2e-3, 24.5e-3, 24.0e-3, 24.4e-3]
[outputs]
duration = 0.3
interval = 5e-3
""")
)
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
    found = [one for one in answer.assumptions if one.suspected and one.score > LIKELY]
    return {one.name: one for one in found if one.passed}


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Data of the model itself: with trusted assumptions, interrupted among their tests, whole."""
    runs, run = [], Runner.run
    folder = tmp_path_factory.mktemp("runs")

    def counted(self, jobs):
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
    assert whole.verdict == "holds"
    assert {one.code for one in whole.findings} <= {
        "undetectable",
        "untestable",
        "undetectable-others",
    }
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
    assert any(one.code == "undetectable" for one in whole.findings)


def test_an_interrupt_among_the_assumptions_keeps_the_fit(answers):
    trusted, stopped, whole = answers
    assert stopped[E].last == trusted[E].last == whole[E].last
    (left,) = (one.facts["names"] for one in stopped.findings if one.code == "interrupted")
    done, every = ({one.name for one in answer.assumptions} for answer in (stopped, whole))
    assert done < every
    assert {*left} == every - done


def late(channels: str, by: float) -> Reading:
    return lambda name, t, y: CubicSpline(t, y)(np.maximum(t - by * (name in channels), t[0]))


def off(channel: str, add: float = 0.0, factor: float = 1.0) -> Reading:
    return lambda name, t, y: factor * y + add if name == channel else y


CAUSES = {
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
    found, (warning,) = named(answer), [f for f in answer.findings if f.code.startswith("cause")]
    assert name in found
    assert answer.verdict != "holds"
    assert warning.code == ("cause" if len(found) == 1 else "causes")
    cases = [name for one in warning.facts["cases"] for name in [one["name"]]]
    assert {*cases} == {*found}
    one = found[name]
    assert one.score > 0.1
    assert sum(rival.score for rival in found.values()) == pytest.approx(1.0, abs=LIKELY)
    assert one.favoured == pytest.approx(amount, rel=0.1, abs=4 * one.favoured_sd)
    assert one.under[E] == pytest.approx(TRUTH[E], rel=0.05)
    if one.parameter:
        assert one.value == pytest.approx(one.nominal * (1 + one.favoured / 100), rel=1e-9)


# Conclusions: numbers in, finding out

ALARM = ResidualTest("motion", "roll", "x", 1e-9, 0.4, {"like": "its rate"})


def suspect(name: str, gain: float, **more: Any) -> AssumptionTest:
    """A number that a refit finds 5 % off; the sum of squares was 1000."""
    usual = {
        "left": 1000.0 - gain, "favoured": 5.0, "favoured_sd": 0.5, "significance": gain,
        "value": 1.05, "refitted": True, "passed": True, "moves": {E: 0.08}, "under": {E: 8e5},
    }  # fmt: skip
    stated = f"{name} is 1"
    return AssumptionTest(
        name, "known", stated, "", 1.0, "%", name, 1.0, 0.01, gain=gain, **usual | more
    )


def concluded(tests: list[AssumptionTest], **more: Any) -> Checked:
    found = {"fails_as_stated": (ALARM,), "sd": {E: 0.004}} | more
    return Checked(with_scores(tests, 990), np.zeros((1, 0)), np.eye(1), **found)


none, a = suspect("c", 0.5, significance=0.5), suspect("a", 300.0)
linear = partial(suspect, refitted=False)
LEFT = {"fails_best": (ALARM,), "fails_besides": (ALARM,)}


@pytest.mark.parametrize(
    ("tests", "found", "code", "says"),
    [
        ([none], {"fails_as_stated": ()}, "", ""),
        ([a, none], {}, "cause",
         "that a is 1: the sum of squares falls from 1000 to 700 with a = 1.05 "
         f"(+5 % ± 0.5). {E} would move by 0.4 standard deviations; estimates under it: {E} = 8e"),
        ([a, suspect("b", 299.0), suspect("c", 200.0)], {}, "causes",
         "2 assumptions, and cannot tell which: a = 1.05 (+5 % ± 0.5), score 0.56, b = 1.05"),
        ([suspect("b", 300.0, passed=False), suspect("a", 280.0)], {}, "cause", "that a is 1"),
        ([linear("a", 31.0)], {"fails_as_stated": ()}, "unconfirmed",
         "most likely a = 1.05 (+5 % ± 0.5): the sum of squares falls by 31, which is more"),
        ([linear("a", 531.0, moves={E: 3.6})], {}, "far",
         f"{E} would move by 18 standard deviations, too far for a score test. Run `torchsoft ex"),
        ([suspect("a", 531.0, under={})], {}, "cause", "refit with a free has not converged"),
        ([a], LEFT, "nearest", "the nearest, a = 1.05 (+5 % ± 0.5), the sum of squares falls by 300"
         ", but residuals still fail a test (correlation with the motion in x of `roll`)"),
        ([linear("a", 300.0)], LEFT, "likeliest", "only a refit can confirm or exclude, is a ="),
        ([linear("a", 300.0)], LEFT | {"fails_besides": (), "besides": (suspect("d", 50.0),)},
         "likeliest",
         "With d also free nothing would be left."),
        ([linear("a", 300.0), linear("b", 250.0)], {}, "rivals",
         "one of 2 assumptions: a = 1.05 (+5 % ± 0.5), b = 1.05"),
        ([none], LEFT | {"searched": True}, "none", "1 of 1 suspects were refitted"),
        ([linear("c", 2.0)], LEFT, "no-suspect", "c (0% of the misfit)"),
        ([linear("c", 2.0)], {"fails_as_stated": ()}, "", ""),
    ],
)  # fmt: skip
def test_the_conclusion_is_that_of_the_numbers(tests, found, code, says):
    """Something that is not explained is an error; a cause that is named is a warning."""
    findings = suspect_findings(concluded(tests, **found), "error")
    assert [one.code for one in findings] == ([code] if code else [])
    for one in findings:
        assert says in str(one), str(one)
        warns = code in ("cause", "causes", "rivals", "far")
        assert one.severity == ("warning" if warns else "error")


def test_scores_are_tempered_and_a_law_has_no_amplitude_to_pay_for():
    law = replace(suspect("law", 300.0 - np.log(990)), kind="law")
    assert [one.score for one in concluded([a, law]).checks] == pytest.approx([0.5, 0.5])
    scores = [one.score for one in concluded([a, suspect("b", 299.0)]).checks]
    assert scores[0] / scores[1] == pytest.approx(np.exp(0.5 * 0.46), rel=1e-6)


@pytest.mark.parametrize(
    ("favoured", "refitted", "unit", "suspected"),
    [(24.0, False, "%", True), (-208.0, False, "%", False), (-208.0, True, "%", True),
     (124.0, False, "N", True)],
)  # fmt: skip
def test_a_number_that_would_have_to_vanish_is_no_cause(favoured, refitted, unit, suspected):
    one = suspect("a", 900.0, favoured=favoured, refitted=refitted)
    assert replace(one, unit=unit, suspected=None).suspected is suspected


def test_the_largest_undetectable_shift_and_hints_are_named():
    """The largest that the data would not show, the largest that they cannot test, the others that
    move an estimate by three standard deviations, and what the data contradict by as many."""

    def hidden(name, move, detectable, **more):
        usual = {"moves": {E: move}, "detectable": detectable, "refitted": False, "favoured": 0.1}
        return suspect(name, 0.0, **usual | more)

    tests = [
        hidden("a", 2.0, 3.0), hidden("b", -0.5, 4.0), hidden("c", 0.1, 5.0),
        hidden("far", 3.0, 1e3), hidden("seen", 9.0, 3.0, suspected=True), hidden("x", 4.0, 1.0),
        hidden("hint", 0.1, 2.0, favoured=1.5, favoured_sd=0.43),
        hidden("never", 0.1, 2.0, favoured=-1.5, favoured_sd=0.43, one_sided=True),
    ]  # fmt: skip
    found = {one.code: one for one in risk_findings(concluded(tests))}
    assert {*found} == {"undetectable", "untestable", "undetectable-others", "contradicted"}
    assert all(one.severity == "note" for one in found.values())
    assert f"6 standard deviations of {E}. It occurs if a differs by 3 %" in str(
        found["undetectable"]
    )
    assert "which these data cannot test: an error of 1 % shifts it" in str(found["untestable"])
    assert str(found["undetectable-others"]).endswith(
        "up to 4 standard deviations without being detected: x."
    )
    assert "stated values of hint = 1.05 (+1.5 % ± 0.43) by three" in str(found["contradicted"])
    assert [one["name"] for one in found["contradicted"].facts["cases"]] == ["hint"]
    assert not risk_findings(concluded([hidden("b", -0.5, 1.0)]))


def test_constants_of_the_computation_widen_intervals_and_are_named():
    rng = np.random.default_rng(0)
    J, columns = rng.standard_normal((9, 2)), rng.standard_normal((9, 3))
    rows = np.concatenate([J, columns], 1)
    precision = rows.T @ rows + np.diag([0.0, 0.0, 1.0, 1.0, 1.0])
    mesh = AssumptionTest("mesh", "numerical", "pads have 10 elements", "they had 20",
                          moves={E: 1.5}, favoured_sd=0.8)  # fmt: skip
    lost = replace(mesh, unchecked="a run failed")
    checked = Checked([mesh, lost], columns, J, not_refitted=("b", "c"), sd={E: 0.1, K_N: 0.1})
    np.testing.assert_allclose(checked.covariance(), np.linalg.inv(precision)[:2, :2], rtol=1e-9)
    wide = np.sqrt(np.diag(np.linalg.inv(precision))[0] / np.linalg.inv(J.T @ J)[0, 0])
    assert checked.wider[E] == pytest.approx(wide)
    effort, moves, unknown = map(str, findings_of_tests(checked))
    assert "so b, c were not refitted" in effort
    assert re.search(rf"{E} depends on .* pads have 10 .* by 1\.5 .* {wide:.2g} times as", moves)
    assert "could not be checked (pads have 10 elements): a run failed" in unknown


@pytest.mark.parametrize(
    ("squares", "kept"),
    [
        ([900.0, 800.0, 700.0, 850.0, 750.0, 950.0], "ceb"),  # finalists at least
        ([500.0 + 40 * k for k in range(12)], "abcd"),  # the best third
        ([102.0, 400.0, 600.0, 900.0], "ab"),  # half the gain of one that explains the misfit
        ([120.0, 400.0, 600.0, 900.0], "abc"),  # which this one does not
    ],
)
def test_the_best_of_a_bracket_go_on(squares, kept):
    end = optimum(ClosedForm(lambda x: [x[0]], 1), 0.0)
    linear = SimpleNamespace(square=1000.0, dof=100)
    fits = {
        name: end._replace(at=end.at._replace(r=np.array([square**0.5])))
        for name, square in zip("abcdefghijkl", squares)
    }
    assert [*best_of(fits, linear)] == [*kept]


def estimate(name: str, **more: Any) -> Estimate:
    usual = {
        "unit": "m", "recording": None, "value": 2.0, "ci95": None, "relative_sd": 0.01,
        "last": 2.0, "identifiable": True, "at_bound": False, "step_bias_sd": 0.0,
    }  # fmt: skip
    return Estimate(name=name, **usual | more)


HELD = {"mu_s": (MU_K, 0.7)}
FINE = Check(1e-5, bias=np.zeros(1))


@pytest.mark.parametrize(
    ("found", "state", "says"),
    [
        ([estimate("a")], {}, []),
        ([estimate("a")], {"converged": False}, ["stopped before it converged"]),
        ([estimate("a")], {"converged": False, "stalled": True}, []),
        ([estimate("a")], {"check": Check(1e-5)}, ["rtol = 1e-05 could not be checked"]),
        ([estimate("a", at_bound=True)], {}, [r"a ended at a bound \(2\)\. Widen"]),
        ([estimate("a", at_bound=True, identifiable=False)], {}, ["a is not identifiable"]),
        ([estimate("mu_s", at_bound=True, last=0.70007)], {}, [f"{MU_K} = 0.7, which is stated"]),
        ([estimate("a", at_bound=True, step_bias_sd=-1e7), estimate("E", step_bias_sd=2.0)], {},
         ["a ended", r"shifts E by 2 standard deviations \(\+2\.00%\)\. Take rtol = 1e-06"]),
        ([estimate("x", step_bias_sd=2.0, last=1e-9, relative_sd=1e4)], {}, [r"\(\+2e-05 m\)"]),
        ([estimate("a")], {"check": FINE._replace(jacobian_error=0.5)}, ["error is 0.5 of the no"]),
        ([estimate("a")], {"check": FINE._replace(rough=("p0",)), "converged": False},
         ["not smooth in p0.*`torchsoft profile`.* of p0"]),
    ],
)  # fmt: skip
def test_bounds_steps_and_convergence_are_noted_where_they_mean_something(found, state, says):
    end = optimum(ClosedForm(lambda x: [x[0]], 1), 0.0).by(1e-5)
    end = end._replace(**{"converged": True, "check": FINE} | state)
    findings = estimate_findings(found, HELD) + step_findings(end, found, False)
    assert len(findings) == len(says)
    assert all(re.search(words, str(one)) for words, one in zip(says, findings)), findings


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
