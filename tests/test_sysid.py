"""Identification on a coarse mesh: recovery of the truth, what is not identifiable, and plans."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from closed_forms import ClosedForm, optimum
from conftest import COARSE, PAPER, RIG, excited, stroked, waves

from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import (
    Problem,
    Recording,
    Sensor,
    Stage,
    Unknown,
    Unreachable,
    identify,
    record,
)
from torchsoft.sysid.fit import Fit, gauss_newton
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.stages import default_plan, jacobian_error, refine_steps, run_plan, run_stage

BASE, SENSORS = PAPER.override(COARSE), RIG
GRASP = {"duration": 0.65, "grasp": 0.2, "since": 0.25}
STROKES = stroked(travel=8e-3, stroke_time=0.2, **GRASP)
SHORT = stroked(travel=8e-3, stroke_time=0.1, duration=0.25, grasp=0.1, since=0.1)
SHAKE = Excitation(*waves(6e-3, 1e-4, (2, 12)), depth=6.8e-4, **GRASP)
E, TAU, K_N = "materials.rubber.E", "materials.rubber.tau", "laws.steel_on_rubber.K_n"
MU_S, MU_K = (f"laws.steel_on_rubber.friction.{name}" for name in ("mu_s", "mu_k"))
RATIO = f"{MU_K} / {MU_S}"
TRUTH = {E: 0.9e6, TAU: 0.012, K_N: 1.6e5, MU_S: 0.5, MU_K: 0.4}
FOUR = (E, TAU, K_N, MU_S)


@pytest.fixture(scope="module")
def strokes():
    """Without noise, of parameters up to a half away from the nominal ones."""
    return record("strokes", excited(STROKES, BASE), TRUTH, SENSORS, noise=0.0)


@pytest.fixture(scope="module")
def shake():
    return record("shake", excited(SHAKE, BASE), TRUTH, SENSORS, noise=0.0)


@pytest.fixture(scope="module")
def short():
    return record("short", excited(SHORT, BASE), TRUTH, SENSORS, noise=0.0)


def known(*names: str) -> dict[str, Unknown]:
    return {name: Unknown(nominal=TRUTH[name], fixed=True) for name in names}


def four(**changes: Unknown) -> dict[str, Unknown]:
    """E and tau from twice and half the nominal values."""
    start = {E: 1.5e6, TAU: 5e-3}
    return {name: Unknown(nominal=start.get(name)) for name in FOUR} | known(MU_K) | changes


def fit(
    recording: Recording, unknowns: dict[str, Unknown], rtol: float = 1e-3,
    sensors: dict[str, Sensor] = SENSORS, **how: Any,
) -> Any:  # fmt: skip
    """One stage, and none of the tests of assumptions."""
    problem = Problem([recording], sensors, unknowns)
    labels = [one.label for one in problem.coordinates.all if not one.fixed]
    plan = [Stage("all", (recording.name,), tuple(labels), rtol)]
    return identify(problem, plan=plan, **{"assumptions": "trusted"} | how)


def check_derivatives(
    problem: Problem, x: np.ndarray, rtol: float, near: float, h: float = 1e-5,
    only: Sequence[str] = (), runner: Runner | None = None,
) -> None:  # fmt: skip
    """Columns of the Jacobian, or only some of them, against central differences, of `near` [1]. A
    larger h [1] passes kinks of contact."""
    free, which = problem.coordinates.free, problem.names
    runner = runner or Runner(problem.recordings)
    chosen = problem.residuals(runner, x, which, rtol)
    steps = chosen.steps
    at = problem.residuals(runner, x, which, steps, free)
    assert np.abs(at.r - chosen.r).max() < 1e-6
    for label in only or problem.coordinates.labels:
        i = problem.coordinates.labels.index(label)
        ahead, behind = (
            problem.residuals(runner, x + s * h * np.eye(len(x))[i], which, steps).r
            for s in (1, -1)
        )
        slope = (ahead - behind) / (2 * h)
        assert np.linalg.norm(at.J[:, i] - slope) < near * np.linalg.norm(slope), label


@pytest.mark.slow
def test_data_without_noise_return_the_truth_and_intervals_contain_it(strokes, shake):
    problem = Problem([strokes, shake], SENSORS, four())
    answer = identify(problem, heldout=["shake"], assumptions="trusted")
    for name in FOUR:
        e = answer[name]
        error = np.log(e.value / TRUTH[name]) / e.relative_sd
        assert error == pytest.approx(e.step_bias_sd, abs=2e-3), "what is left is due to the steps"
        assert abs(error) < 0.03
        assert e.ci95[0] < TRUTH[name] < e.ci95[1]
    assert answer.converged
    assert max(answer.chi2, *answer.heldout["shake"].values()) < 1e-3
    content = json.loads(answer.to_json())
    assert content["made_by"]["recordings"].keys() == {"strokes", "shake"}
    assert content["cost"]["jacobians"] > 0


def test_a_fit_reports_what_its_runs_warn_of_once_at_its_end():
    law = {"kind": "coulomb", "mu_s": 0.3, "mu_k": 0.2}
    file = BASE.override({"laws.steel_on_rubber.friction": law})
    data = record("short", excited(SHORT, file), {E: 0.9e6}, SENSORS, rtol=1e-4)
    findings = map(str, fit(data, {E: Unknown()}, tightenings=0).findings)
    jumps = [text for text in findings if "leaves such jumps out" in text]
    assert jumps
    assert all(text.startswith("The run of recording `short`: contact `") for text in jumps)


@pytest.mark.slow
def test_a_misfit_far_above_the_noise_is_not_refined(short):
    """Half a millimetre of a wave in a reading of 10 um; chi2 of the file is that of the
    headline."""
    t, y = short.samples["x_C"]
    wavy = replace(short, samples=short.samples | {"x_C": (t, y + 5e-4 * np.sin(50 * t))})
    answer = fit(wavy, {E: Unknown(nominal=7e5)})
    assert {stage["rtol"] for stage in answer.stages} == {1e-3}
    codes = {one.code: one.severity for one in answer.findings}
    assert (codes["larger"], codes["steps-not-refined"]) == ("error", "note")
    content = json.loads(answer.to_json())
    squares = [one.stated**2 for one in answer.residuals]
    assert content["chi2"] == pytest.approx(np.mean(squares), rel=0.05)
    assert content["chi2"] > 25
    assert f"χ² = {content['chi2']:.3g}" in answer.headline


def test_a_regular_grid_between_the_samples_changes_nothing(short):
    problem, runner = Problem([short], SENSORS, four()), Runner([short])
    exact = problem.residuals(runner, problem.coordinates.start, ["short"], 1e-5).r
    problem.interpolated = True
    between = problem.residuals(runner, problem.coordinates.start, ["short"], 1e-5).r
    assert np.abs(between - exact).max() < 0.2 < np.abs(exact).max()


@pytest.mark.slow
def test_a_tolerance_too_coarse_for_the_data_is_reported_and_tightened():
    hard = Excitation(*waves(4e-3, 2e-4, (10, 40)), duration=0.55, grasp=0.15, since=0.2)
    data = record("hard", excited(hard, BASE), {}, SENSORS, rtol=1e-6, noise=0.0)
    coarse = fit(data, {E: Unknown(), TAU: Unknown()}, 3e-2, tightenings=0)
    found = next(one for one in coarse.findings if one.code == "steps-too-coarse")
    assert (found.facts["rtol"], found.facts["finer"]) == pytest.approx((0.03, 0.003))
    worst = max(coarse.estimates, key=lambda e: abs(e.step_bias_sd))
    error = lambda answer: np.log(answer[worst.name].last / BASE.table()[worst.name]["value"])
    assert abs(error(coarse)) > worst.relative_sd  # so the notice is needed
    assert abs(worst.step_bias_sd) > 0.5
    better = fit(data, {E: Unknown(), TAU: Unknown()}, 3e-2, tightenings=3)
    assert not any(one.code == "steps-too-coarse" for one in better.findings)
    assert better.made_by["rtol"] < 3e-2
    assert abs(error(better)) < 0.2 * abs(error(coarse))


# Fits of closed forms


@pytest.mark.parametrize(("level", "stalls"), [(30.0, True), (3.0, False)])
def test_a_fit_without_headway_ends_early_and_reports_it(level, stalls):
    """A model that cannot follow, and residuals too rough for steps to be of use; not one that is
    near the noise. The rough coordinate is named."""
    rough = lambda x: np.array([level, x[0] + 2.0 * np.abs(np.sin(40 * x[0])), 0.3 * x[1]])
    end = gauss_newton(optimum(ClosedForm(rough, 2), 2.0, 3.0), tolerance=1e-9)
    assert end.stalled == bool(end.findings) == stalls
    assert not end.converged
    assert end.evaluations < 10 if stalls else end.evaluations == 30
    assert end.chi2 == pytest.approx(float(np.mean(rough(end.x) ** 2)))
    assert not stalls or "over 6 evaluations" in str(end.findings[0])
    assert refine_steps(end, tightenings=2).check.rough[0] == "p0"


@pytest.mark.parametrize(("most", "ends"), [(1.0, (0.0615, 1.0)), (4.0, (-1.0, 2.2))])
def test_a_coordinate_held_at_its_bound_leaves_the_others_at_their_optimum(most, ends):
    """Two that correlate: the bound of the second moves the first."""
    J, best = np.array([[1.0, 0.9], [0.0, 0.3], [0.2, 0.1]]), np.array([-1.0, 2.2])
    one = optimum(ClosedForm(lambda x: J @ (x - best), 2, high=np.exp(most)), 0.0, 0.5)
    np.testing.assert_allclose(one.x + one.newton_step(), ends, atol=1e-3)


def test_of_several_starts_the_best_end_is_kept():
    """Two optima, the worse one next to the start; a bound is between the start and some others."""
    two = ClosedForm(lambda x: [3 * (x[0] ** 2 - 0.64), 0.3 * (x[0] - 0.8)], 1, low=0.45)
    end = lambda starts: run_stage(
        Fit(two, Runner(()), np.array([-0.7]), Stage("", ("data",), ("p0",), 1e-3, starts=starts)),
        seed=0,
    )
    assert end(1).x < 0
    assert end(4).x == pytest.approx(0.8)


class Failing(ClosedForm):
    """With the optimum at one, whose runs at rtol = 1e-4 fail where p0 is beyond `wall`."""

    wall = 0.5

    def residuals(self, runner, x, which, steps, free=None):
        at = super().residuals(runner, x, which, steps, free)
        failed = steps == 1e-4 and x[0] > self.wall
        return at._replace(failed={"data": FailedRun("no", 0.5)}) if failed else at


def test_a_stage_that_cannot_start_ends_the_plan_or_starts_where_the_plan_did():
    """The first where it only repeats the stage before at a finer tolerance."""
    problem = Failing(lambda x: x - 1.0, 2)
    first, begin = Stage("one", ("data",), ("p0",), 1e-3), Fit(problem, Runner(()), np.zeros(2))
    finer = replace(first, name="two", rtol=1e-4)
    end = run_plan(begin, [first, finer])
    assert [stage["name"] for stage in end.stages] == ["one"]
    assert end.x == pytest.approx([1.0, 0.0])
    assert [one.code for one in end.findings] == ["stage-failed"]
    other = [first, replace(finer, free=("p1",))]
    end = run_plan(begin, other)
    assert [stage["name"] for stage in end.stages] == ["one", "two"]
    assert end.x == pytest.approx([0.0, 1.0])
    assert end.failure is None
    problem.wall = -1.0
    with pytest.raises(Unreachable, match="recording `data`: no"):
        run_plan(begin, other)


def test_the_error_of_a_jacobian_is_that_along_a_standard_deviation():
    """Of x_0, known to 0.05 where x_1 is held and to 0.1 where it is not; x_2 is not known."""
    exact = np.array([[20.0, np.sqrt(300.0), 0], [0, 10.0, 0], [0, 0, 1.0]])
    rough = exact + np.array([[0, 0, 0], [2.0, 0, 0], [0, 0, 9.0]])
    assert jacobian_error(exact, exact) == 0
    assert jacobian_error(rough, exact) == pytest.approx(0.2)


# Plans and runs


def test_a_plan_starts_with_the_slow_ties_ratios_and_ends_with_everything(strokes, shake):
    unknowns = four(**{MU_K: Unknown(ratio_to=MU_S, nominal=0.7, low=0.3, high=1.0)})
    problem = Problem([shake, strokes], SENSORS, unknowns)
    *tied, scanned, last = default_plan(problem, Runner(problem.recordings), 1e-5, problem.names)
    slow = min(problem.recordings, key=lambda recording: recording.speed)
    assert tied[0].recordings == (slow.name,)
    assert dict(tied[0].tied) == {RATIO: 1.0}
    assert all(RATIO not in stage.free for stage in tied)
    assert set(scanned.free) == set(last.free) == set(problem.coordinates.labels)
    assert dict(scanned.scanned)[RATIO][0] == 1.0
    assert tied[0].rtol > last.rtol == 1e-5


def test_residuals_are_the_same_to_the_bit_alone_with_others_and_in_threads(short):
    twin = replace(short, name="twin")
    later = replace(short, name="later", start=short.start._replace(lead=0.3))

    def rows(*recordings, workers=1):
        problem = Problem(recordings, SENSORS, {E: Unknown(nominal=1.1e6), TAU: Unknown()})
        x, free, runner = *(problem.coordinates.start, problem.coordinates.free), Runner
        return problem.residuals(runner(recordings, workers), x, problem.names, 1e-3, free)

    one, other = rows(short), rows(later)
    for workers in (1, 2):
        found = rows(short, twin, later, workers=workers)
        np.testing.assert_array_equal(found.r, np.concatenate([one.r, one.r, other.r]))
        np.testing.assert_array_equal(found.J, np.concatenate([one.J, one.J, other.J]))


# What fits together


def test_a_problem_without_unknowns_or_a_plan_that_contradicts_its_options_is_rejected(short):
    with pytest.raises(ValueError, match="nothing to identify: no unknown is free"):
        Problem([short], SENSORS, known(E))
    with pytest.raises(ValueError, match="names of their own, but are called"):
        Problem([short, short], SENSORS, {E: Unknown()})
    problem = Problem([short], SENSORS, {E: Unknown()})
    with pytest.raises(ValueError, match="`starts` and `rtol` are those of the default plan"):
        identify(problem, starts=3, plan=[])


SAMPLES = np.linspace(0.0, 0.1, 5)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ({}, "no samples"),
        ({"x": (SAMPLES, SAMPLES)}, "`x` is not a channel"),
        ({"x_C": (SAMPLES, SAMPLES[1:])}, "times and values alike"),
        ({"x_C": (SAMPLES[::-1], SAMPLES)}, "must increase, but .* sort the samples"),
        ({"x_C": (SAMPLES, np.nan * SAMPLES)}, "must have finite times and values"),
    ],
)
def test_samples_that_are_no_recording_are_rejected(short, samples, message):
    with pytest.raises(ValueError, match=message):
        replace(short, samples=samples)
