"""Identification on a coarse mesh: Jacobians, recovery, what is not identifiable, nuisances,
resuming."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from closed_forms import ClosedForm
from conftest import COARSE, PAPER, RIG, excited, stroked, waves

from torchsoft.rigs.excite import CATALOGUE, GRIP, Excitation
from torchsoft.sysid import (
    Problem,
    Recording,
    Sensor,
    Stage,
    Unknown,
    Unreachable,
    identify,
    record,
    runs,
    sensitivity,
)
from torchsoft.sysid.assumptions import assumptions
from torchsoft.sysid.fit import (
    Fit,
    descend,
    gauss_newton,
    standard_deviations,
)
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.plan import (
    SCANNED,
    default_plan,
    jacobian_error,
    run_plan,
    scan,
    sobol,
    tie_ratios,
    visible,
)
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Residuals
from torchsoft.sysid.runs import Runner

BASE = PAPER.override(COARSE)
RTOL = 1e-4
TRUSTED: dict[str, Any] = {"assumptions": "trusted"}
"""Nothing but the fit."""
SENSORS = RIG
GRASP: dict[str, Any] = {"duration": 0.65, "grasp": 0.2, "since": 0.25}
STROKES = stroked(travel=8e-3, stroke_time=0.2, **GRASP)
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


def four(**changes: Unknown) -> dict[str, Unknown]:
    """E and tau from twice and half the nominal values."""
    start = {E: 1.5e6, TAU: 5e-3}
    return {name: Unknown(nominal=start.get(name)) for name in FOUR} | {MU_K: known(MU_K)} | changes


def known(name: str) -> Unknown:
    return Unknown(nominal=TRUTH[name], fixed=True)


def check_derivatives(
    problem: Problem,
    x: np.ndarray,
    rtol: float,
    near: float,
    h: float = 1e-5,
    adjoint: float = 1e-8,
    only: Sequence[str] = (),
) -> None:
    """Columns of the Jacobian, or only some of them, against central differences, of `near` [1];
    the gradient of the adjoint against the Jacobian's. A larger h [1] passes kinks of contact."""
    free, which, runner = problem.coordinates.free, problem.names, Runner(problem.recordings)
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
    loss, gradient, failed = problem.misfit(runner, x, which, steps, free)
    assert not failed
    assert loss == pytest.approx(0.5 * at.r @ at.r, rel=1e-12)
    np.testing.assert_allclose(
        gradient, at.J.T @ at.r, rtol=adjoint, atol=adjoint * np.abs(gradient).max()
    )


SHORT = stroked(travel=8e-3, stroke_time=0.1, duration=0.25, grasp=0.1, since=0.1)


@pytest.mark.parametrize("inertial", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_jacobian_of_either_kind_of_pads_at_the_start_of_a_grasp(inertial):
    """The starting displacements are held, also where a pad's elasticity changes."""
    file = BASE.override({"pad.inertial": inertial})
    data = record("short", excited(SHORT, file), {E: 0.9e6}, SENSORS)
    unknowns = {E: Unknown(), "pad.nu": Unknown(low=0.4, high=0.49), TAU: Unknown()}
    problem = Problem([data], SENSORS, unknowns)
    check_derivatives(problem, problem.coordinates.start, RTOL, 1e-5, h=3e-6)


@pytest.mark.slow
def test_noise_free_data_give_the_truth_back_and_intervals_hold_it(strokes, shake):
    answer = identify(Problem([strokes, shake], SENSORS, four()), heldout=["shake"], **TRUSTED)
    for name in FOUR:
        e = answer[name]
        assert e.identifiable
        error = np.log(e.value / TRUTH[name]) / e.relative_sd
        assert error == pytest.approx(e.step_bias_sd, rel=0.1), "what is left is due to the steps"
        assert abs(error) < 0.03
        assert e.ci95[0] < TRUTH[name] < e.ci95[1]
    assert answer.converged
    assert answer.chi2 < 1e-3
    assert max(answer.heldout["shake"].values()) < 1e-3
    content = json.loads(answer.to_json())
    assert content["made_by"]["recordings"].keys() == {"strokes", "shake"}
    assert content["cost"]["jacobians"] > 0


def test_runs_on_the_way_of_a_fit_warn_of_nothing_and_its_end_says_it():
    """Every trial warned of friction that jumps, wherever it was."""
    law = {"kind": "coulomb", "mu_s": 0.3, "mu_k": 0.2}
    file = BASE.override({"laws.steel_on_rubber.friction": law})
    data = record("short", excited(SHORT, file), {E: 0.9e6}, SENSORS)
    answer = identify(Problem([data], SENSORS, {E: Unknown()}), rtol=1e-3, **TRUSTED)
    said = [one for one in answer.notices if "leaves such jumps out" in one]
    assert said
    assert all(one.startswith("the run of recording `short`: contact `") for one in said)


@pytest.mark.parametrize(("level", "stalls"), [(30.0, True), (3.0, False)])
def test_a_fit_without_headway_ends_where_it_is_and_says_so(level, stalls):
    """A model that cannot follow, and residuals too rough for steps to be of use; not one that is
    near the noise."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.array([level, x[0] + 2.0 * np.abs(np.sin(40 * x[0])), 0.3 * x[1]])

    problem, x = ClosedForm(residuals, 2), np.array([2.0, 3.0])
    runner: Any = None
    stage = Stage("all", (), problem.coordinates.labels, 1e-3)
    fit = gauss_newton(Fit(problem, runner, x, stage), tolerance=1e-9)
    assert fit.stalled == stalls
    assert fit.evaluations == (8 if stalls else 30)
    assert not fit.converged
    assert fit.chi2 == pytest.approx(float(np.mean(residuals(fit.x) ** 2)))
    assert bool(fit.notices) == stalls
    assert not stalls or "the fit made no headway: over 6 evaluations" in fit.notices[0]


def test_a_fit_far_above_the_noise_is_not_refined(strokes, monkeypatch):
    """Half a millimetre of a wave in a reading of 10 um: finer steps would be to no purpose. The
    fit makes no headway, so that it has not converged, although one with coloured noise would; chi2
    of the file is that of the headline."""
    monkeypatch.setattr("torchsoft.sysid.fit.HEADWAY", 0)
    monkeypatch.setattr("torchsoft.sysid.fit.LITTLE", 1.0)  # any fit far above the noise
    t, y = strokes.samples["x_C"]
    wavy = replace(strokes, samples=strokes.samples | {"x_C": (t, y + 5e-4 * np.sin(50 * t))})
    answer = identify(Problem([wavy], SENSORS, {E: Unknown(nominal=7e5)}), rtol=1e-3, **TRUSTED)
    assert {stage["rtol"] for stage in answer.stages} == {1e-3}
    assert {stage["name"] for stage in answer.stages} <= {
        "strokes: first look", "everything", "with the noise that was found",
    }  # fmt: skip
    assert any("steps were checked and not made finer" in one for one in answer.notices)
    assert any("the fit made no headway" in one for one in answer.notices)
    assert answer.stages[-1]["converged"]  # with coloured noise
    assert not answer.converged
    content = json.loads(answer.to_json())
    assert not content["converged"]
    assert content["chi2"] == pytest.approx(answer.residuals[0].stated ** 2 / 7, rel=0.05)  # of 7
    assert content["chi2_whitened"] < 1.0 < 25 < content["chi2"]
    assert f"χ² = {content['chi2']:.3g}" in answer.headline


def test_the_adjoint_route_ends_where_gauss_newton_does(strokes):
    problem = Problem(
        [strokes], SENSORS, {E: Unknown(nominal=1.0e6), TAU: Unknown()} | rest_known()
    )
    runner = Runner(problem.recordings)
    c = problem.coordinates
    free = tuple(one.label for one in c.within(c.free))
    begin = Fit(problem, runner, c.start, Stage("all", ("strokes",), free, RTOL)).begun()
    newton = gauss_newton(begin)
    descent = descend(begin._replace(method="lbfgs"), evaluations=20)
    adam = descend(newton._replace(method="adam"), evaluations=2)
    free = problem.coordinates.free
    np.testing.assert_allclose(descent.x[free], newton.x[free], atol=2e-3)
    assert adam.evaluations == 2
    assert adam.chi2 <= newton.chi2 + 1e-9


def rest_known() -> dict[str, Unknown]:
    return {name: known(name) for name in (K_N, MU_S, MU_K)}


def test_what_the_data_do_not_determine_is_not_a_number():
    gentle = stroked(travel=1e-3, stroke_time=0.4, **GRASP)
    data = record("gentle", excited(gentle, BASE), {}, SENSORS, seed=1)
    answer = identify(
        Problem([data], SENSORS, {E: Unknown(), MU_K: Unknown()}), rtol=RTOL,
        plan=[Stage("all", ("gentle",), (E, MU_K), RTOL)],
        **TRUSTED,
    )  # fmt: skip
    unseen, seen = answer[MU_K], answer[E]
    assert not unseen.identifiable
    assert unseen.value is None
    assert unseen.ci95 is None
    assert seen.identifiable
    assert seen.ci95[0] < BASE.materials["rubber"].E < seen.ci95[1]
    assert any(MU_K in notice for notice in answer.notices)
    assert not answer.directions[-1].identifiable
    assert MU_K in answer.directions[-1].components
    row = next(e for e in json.loads(answer.to_json())["estimates"] if e["name"] == MU_K)
    assert row["value"] is None
    assert "not identifiable" in answer.table()


def test_bias_and_delay_are_found_and_missing_samples_do_not_matter(strokes):
    t, theta = strokes.samples["theta_C"]
    late = np.interp(t - 1.5e-3, t, theta) + 2e-3
    samples = strokes.samples | {
        "theta_C": (t[3::2], late[3::2]),
        "effort_x": tuple(x[:60] for x in strokes.samples["effort_x"]),
    }
    data = replace(strokes, name="gaps", samples=samples)
    sensors = SENSORS | {"theta_C": Sensor(noise=5e-4, bias=0.02, delay=5e-3)}
    unknowns = {E: Unknown()} | rest_known() | {TAU: known(TAU)}
    answer = identify(Problem([data], sensors, unknowns), rtol=RTOL, **TRUSTED)
    assert answer[E].value == pytest.approx(TRUTH[E], rel=2e-3)
    assert answer["bias of theta_C"].value == pytest.approx(2e-3, abs=1e-4)
    assert answer["delay of theta_C"].value == pytest.approx(1.5e-3, abs=1e-4)


def test_a_regular_grid_between_the_samples_changes_nothing(strokes):
    problem = Problem([strokes], SENSORS, four())
    runner = Runner(problem.recordings)
    exact = problem.residuals(runner, problem.coordinates.start, ["strokes"], 1e-5).r
    problem.interpolated = True
    between = problem.residuals(runner, problem.coordinates.start, ["strokes"], 1e-5).r
    assert np.abs(between - exact).max() < 0.2 < np.abs(exact).max()


@pytest.fixture(scope="module")
def shaking():
    """Hard, by fine steps, without noise."""
    hard = Excitation(*waves(4e-3, 2e-4, (10, 40)), **GRASP)
    return record("shaking", excited(hard, BASE), {}, SENSORS, rtol=1e-7, noise=0.0)


def test_a_tolerance_too_coarse_for_the_data_is_found_and_tightened(shaking):
    problem = Problem([shaking], SENSORS, {E: Unknown(), TAU: Unknown()})
    plan = [Stage("all", ("shaking",), (E, TAU), 3e-2)]
    coarse = identify(problem, plan=plan, tightenings=0, **TRUSTED)
    assert any(
        "rtol = 0.03 is too coarse" in notice and "take rtol = 0.003" in notice
        for notice in coarse.notices
    )
    worst = max(coarse.estimates, key=lambda e: abs(e.step_bias_sd))
    nominal = BASE.table()[worst.name]["value"]
    error = float(np.log(worst.last / nominal))
    assert abs(error) > worst.relative_sd  # so the notice is needed
    assert worst.step_bias_sd * worst.relative_sd == pytest.approx(
        error, rel=0.5
    )  # and its size is about right
    better = identify(problem, plan=plan, **TRUSTED)
    assert not any("too coarse" in notice for notice in better.notices)
    assert better.made_by["rtol"] < 3e-2
    assert abs(np.log(better[worst.name].last / nominal)) < 0.2 * abs(error)


def test_a_coordinate_held_at_its_bound_leaves_the_others_at_rest():
    """Two that correlate, the second held where the misfit still falls: the first is where it is
    least, beside it."""
    J, x = np.array([[1.0, 0.9], [0.0, 0.3], [0.2, 0.1]]), np.array([0.0, 1.0])
    r = np.array([-0.9, -2.0, 0.0])
    r -= J[:, 0] * (J[:, 0] @ r) / (J[:, 0] @ J[:, 0])
    for most, moves in ((1.0, False), (9.0, True)):
        bounds = np.array([-5.0, 0.0]), np.array([5.0, most])
        problem: Any = SimpleNamespace(
            coordinates=SimpleNamespace(bounds=bounds, labels=("a", "b"))
        )
        at, stage = Residuals(r, J, {}), Stage("both", (), ("a", "b"), RTOL)
        step = Fit(problem, Runner(()), x, stage, at).newton_step()
        assert np.abs(step).min() > 0.5 if moves else step == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.slow
def test_a_fit_that_went_far_goes_on_with_steps_of_its_own(strokes):
    """From a start so far off that the steps chosen there are the wrong ones in the end."""
    unknowns = {name: Unknown(nominal=0.4 * TRUTH[name]) for name in FOUR} | {MU_K: known(MU_K)}
    unknowns |= {MU_S: Unknown(nominal=0.9)}
    problem = Problem([strokes], SENSORS, unknowns)
    answer = identify(problem, plan=[Stage("all", ("strokes",), FOUR, 1e-3)], **TRUSTED)
    first, anew = (stage["name"] for stage in answer.stages[:2])
    assert (first, anew) == ("all", "steps chosen anew")
    assert {stage["rtol"] for stage in answer.stages[:2]} == {1e-3}
    assert answer.made_by["rtol"] == 1e-4, "the Jacobian by 1e-3 is too rough"
    assert answer.converged
    for name in FOUR:
        e = answer[name]
        assert abs(np.log(e.last / TRUTH[name])) < e.relative_sd, name


def test_the_error_of_a_jacobian_is_that_along_a_standard_deviation():
    """Of x_0, known to 0.05 where x_1 is held and to 0.1 where it is not; x_2 is not known."""
    exact = np.array([[20.0, np.sqrt(300.0), 0], [0, 10.0, 0], [0, 0, 1.0]])
    rough = exact + np.array([[0, 0, 0], [2.0, 0, 0], [0, 0, 9.0]])
    assert jacobian_error(exact, exact) == 0
    assert jacobian_error(rough, exact) == pytest.approx(0.2)


def test_recordings_that_begin_alike_share_their_start(strokes, monkeypatch):
    """To the bit as each by itself."""
    started, inner = list[object](), runs.initial_state

    def counted(*given):
        started.append(given)
        return inner(*given)

    monkeypatch.setattr(runs, "initial_state", counted)
    twin = replace(strokes, name="twin")
    later = replace(strokes, name="later", start=strokes.start._replace(lead=0.3))
    unknowns = {E: Unknown(nominal=1.1e6), TAU: Unknown()}

    def rows(*recordings):
        problem = Problem(recordings, SENSORS, unknowns)
        x, free = problem.coordinates.start, problem.coordinates.free
        return problem.residuals(Runner(recordings), x, problem.names, 1e-3, free)

    found, alone = rows(strokes, twin, later), [rows(strokes), rows(strokes), rows(later)]
    assert len(started) == 2
    np.testing.assert_array_equal(found.r, np.concatenate([one.r for one in alone]))
    np.testing.assert_array_equal(found.J, np.concatenate([one.J for one in alone]))


def test_interrupted_it_continues_and_ends_the_same(strokes, tmp_path, monkeypatch):
    problem = Problem(
        [strokes], SENSORS, {E: Unknown(nominal=1.4e6), TAU: Unknown()} | rest_known()
    )
    whole = identify(problem, rtol=RTOL, **TRUSTED)
    inner, left = Runner.run, [4]

    def interrupted(self: Runner, jobs: list) -> list:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return inner(self, jobs)

    with monkeypatch.context() as patch:
        patch.setattr(Runner, "run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            identify(problem, rtol=RTOL, checkpoint=tmp_path / "runs", **TRUSTED)
    kept = len(list((tmp_path / "runs").glob("*.run")))
    assert kept >= 3  # runs asked for twice are made once
    again = identify(problem, rtol=RTOL, checkpoint=tmp_path / "runs", **TRUSTED)
    assert again.cost["remembered"] >= kept
    assert again.x == whole.x
    third = identify(problem, rtol=RTOL, checkpoint=tmp_path / "runs", **TRUSTED)
    assert third.cost["remembered"] == third.cost["simulations"] + third.cost["jacobians"]


def test_threads_give_the_same_residuals(strokes, shake):
    problem = Problem([strokes, shake], SENSORS, four())
    one, two = (
        problem.residuals(
            Runner(problem.recordings, workers), problem.coordinates.start, problem.names, RTOL,
            problem.coordinates.free,
        )
        for workers in (1, 2)
    )  # fmt: skip
    np.testing.assert_array_equal(one.r, two.r)
    np.testing.assert_array_equal(one.J, two.J)


def test_wrong_recordings_sensors_and_unknowns_are_refused(strokes):
    one, (t, y) = {E: Unknown()}, strokes.samples["x_C"]

    def problem(
        names: int = 1, sensors: dict[str, Sensor] = SENSORS, unknowns: dict[str, Unknown] = one
    ) -> Problem:
        return Problem([strokes] * names, sensors, unknowns)

    def sampled(channel: str, *samples: Any) -> Recording:
        return replace(strokes, samples={channel: samples} if channel else {})

    refused: list[tuple[Callable[[], Any], str]] = [
        (lambda: problem(2), "names of their own"),
        (lambda: problem(sensors={"z": Sensor(noise=1.0)}), "`z` is not a channel"),
        (
            lambda: problem(sensors={"omega": Sensor(noise=1.0)}),
            "samples of `omega_C`",
        ),
        (lambda: problem(unknowns={E: Unknown(fixed=True)}), "nothing to identify"),
        (lambda: problem(unknowns={"pad.length": Unknown()}), "`pad.length` cannot be identified"),
        (lambda: identify(problem(), heldout=["strokes"]), "`heldout`"),
        (lambda: sampled(""), "no samples"),
        (lambda: sampled("x", t, y), "`x` is not a channel"),
        (lambda: sampled("x_C", t, y[1:]), "times and values alike"),
        (lambda: sampled("x_C", t[::-1], y), "must increase, but .* sort the samples"),
        (lambda: sampled("x_C", t, np.full_like(y, np.nan)), "finite values"),
    ]
    for made, message in refused:
        with pytest.raises(ValueError, match=message):
            made()


def test_short_names_are_taken_and_the_problem_has_the_full_ones(strokes):
    """Of parameters, of what they are ratios to, of sensors, and of coloured noise; the last of two
    sensors of one channel counts."""
    colour = Autoregression((0.8,), 0.7, 5e-3)
    sensors = RIG | {"theta_C": Sensor(noise=1e-3, bias=0.1)}
    unknowns = {"contact.mu_s": Unknown(), "contact.mu_k": Unknown(ratio_to="contact.mu_s")}
    problem = Problem([strokes], sensors, unknowns, {"F_x": colour})
    assert problem.coordinates.labels == (MU_S, RATIO, "bias of theta_C")
    assert problem.unknowns == {MU_S: Unknown(), MU_K: Unknown(ratio_to=MU_S)}
    assert problem.sensors.keys() == strokes.samples.keys()
    assert problem.sensors["theta_C"] == sensors["theta_C"]
    assert problem.noise == {"effort_x": colour}
    nu = "materials.rubber.nu"
    with pytest.raises(ValueError, match=f"unknowns.{nu}.high = 0.6 is beyond what {nu} may be"):
        Problem([strokes], SENSORS, {"pad.nu": Unknown(high=0.6)})


@pytest.mark.slow
def test_data_out_of_reach_name_the_recording():
    data = record("strokes", excited(STROKES, BASE, senses="disc"), {}, SENSORS)
    problem = Problem(
        [data], SENSORS, {E: Unknown(nominal=4e4)}
    )  # so soft that the loop is unstable
    with pytest.raises(Unreachable, match=r"recording `strokes`: .* t = .* s"):
        identify(problem, plan=[Stage("all", ("strokes",), (E,), 1e-3)])


@pytest.mark.slow
def test_a_plan_ends_where_a_finer_stage_cannot_begin(monkeypatch):
    """The fit is kept, says so, and is tested on its own steps."""
    residuals, first = Problem.residuals, iter([True])

    def failing(self: Problem, runner: Any, x: Any, which: Any, steps: Any, free: Any = None):
        at = residuals(self, runner, x, which, steps, free)
        if not isinstance(steps, float) or next(first, False):
            return at
        return at._replace(failed={"strokes": FailedRun("at t = 0.5 s: no", 0.5)})

    monkeypatch.setattr(Problem, "residuals", failing)
    few = lambda *given: [one for one in assumptions(*given) if one.name in tried]
    tried = "mesh", "clock of the set-points", "bodies.disc.mass"
    monkeypatch.setattr(sensitivity, "assumptions", few)
    data = record("strokes", excited(SHORT, BASE), {E: TRUTH[E]}, SENSORS, noise=0.0)
    problem = Problem([data], SENSORS, {E: Unknown(nominal=0.8e6)})
    plan = [Stage(f"by {rtol}", ("strokes",), (E,), rtol) for rtol in (1e-3, 1e-4)]
    answer = identify(problem, plan=plan)
    assert answer[E].value == pytest.approx(TRUTH[E], rel=0.05)
    assert answer.made_by["rtol"] == 1e-3
    assert answer.made_by["rtol_asked"] == 1e-4
    assert not answer.converged
    assert any("the fit ended by rtol = 0.001: by a finer tolerance" in s for s in answer.notices)
    tested = {one.name: one.unchecked for one in answer.assumptions}
    assert not tested["mesh"]
    assert not tested["clock of the set-points"]
    assert tested.keys() >= {*tried}
    other = [plan[0], replace(plan[1], free=())]
    first = iter([True])
    with pytest.raises(Unreachable, match=r"recording `strokes`: at t = 0.5 s: no"):
        identify(problem, plan=other)


@pytest.mark.parametrize(
    ("truth", "free", "ends"),
    [
        ((0.5, 0.55), (MU_S, RATIO), (0.5, 0.55)),  # its denominator by the factor's root
        ((0.3708, 0.7), (MU_S, RATIO), (0.3708, 0.7)),  # it stays
        ((0.5, 0.55), (RATIO,), (0.3708, 0.55)),  # it is not free
    ],
)
def test_a_ratio_is_scanned_with_its_denominator(strokes, monkeypatch, truth, free, ends):
    """Friction coefficients that were fitted as one lie between those that are not."""
    monkeypatch.setattr(
        Problem, "gather", lambda self, x, jobs, runs: Residuals(x - at, np.zeros((2, 2)), {})
    )
    unknowns = {MU_S: Unknown(), MU_K: Unknown(ratio_to=MU_S)}
    problem = Problem([strokes], SENSORS, unknowns)
    c, runner = problem.coordinates, SimpleNamespace(run=lambda jobs: [None for _ in jobs])
    place = lambda values: np.array([one.to_x(v) for one, v in zip(c.all, values)])
    at, tied = place(truth), place((0.3708, 1.0))
    stage = Stage("everything", ("strokes",), free, 1e-4)
    x = scan(Fit(problem, runner, tied, stage), 1, SCANNED)
    assert x == pytest.approx(place(ends), abs=1e-3)


def test_another_stage_that_cannot_begin_there_begins_where_the_plan_did(strokes, monkeypatch):
    """One that has other coordinates or recordings; it is refused only if it fails there, too."""
    begun: list[list[float]] = []

    def simulated(fit: Fit, seed: int) -> Fit:
        begun.append(list(fit.x))
        if fit.x[0] == failing.get(fit.stage.name):
            raise Unreachable({"strokes": FailedRun("no", 0.5)})
        return fit._replace(x=fit.x + 1.0, at=fit.at._replace(r=np.ones(1)))

    monkeypatch.setattr("torchsoft.sysid.plan.run_stage", simulated)
    stages = [Stage(name, ("strokes",), (name,), 1e-3) for name in ("one", "two", "three")]
    failing, runner = {"two": 1.0}, Runner(())
    begin: Any = Fit(strokes, runner, np.zeros(2))
    end = run_plan(begin, stages)
    assert begun == [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0], [1.0, 1.0]]
    assert end.failure is None
    assert [entry["name"] for entry in end.stages] == ["one", "two", "three"]
    failing = {"one": 0.0}
    with pytest.raises(Unreachable, match="recording `strokes`"):
        run_plan(begin, stages)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"loss": "huber", "method": "lbfgs"},
         "^the method 'lbfgs' has no robust loss: for loss = 'huber' take"),
        ({"assumptions": "check"}, "^assumptions should be 'checked', 'explained' or 'trusted', "
                                   "not 'check'"),
        ({"rtol": float("nan")}, "^rtol should be a finite number, not nan"),
        ({"starts": 0}, "^starts should be greater than or equal to 1, not 0"),
        ({"starts": 3, "plan": []}, "^`starts` and `rtol` are those of the default plan"),
    ],
)  # fmt: skip
def test_what_a_fit_cannot_honour_is_refused_before_it(strokes, how, message):
    with pytest.raises(ValueError, match=message):
        identify(Problem([strokes], SENSORS, four()), **how)


@pytest.mark.slow
def test_sobol_starts_stay_within_bounds_and_the_best_end_is_kept(strokes):
    problem = Problem(
        [strokes], SENSORS, {E: Unknown(nominal=1.0e6, low=0.5e6, high=2e6)} | rest_known()
    )
    stage = Stage("all", ("strokes",), (E,), 1e-3, starts=3)
    begin = Fit(problem, Runner(problem.recordings), problem.coordinates.start, stage)
    points = sobol(begin, 0)
    low, high = problem.coordinates.bounds
    assert len({p.tobytes() for p in points}) == len(points) == 2
    assert all((low <= p).all() and (p <= high).all() for p in points)
    answer = identify(problem, plan=[stage], **TRUSTED)
    assert answer[E].last == pytest.approx(TRUTH[E], rel=0.05)


def test_plan_begins_slowly_ties_ratios_and_ends_with_everything(strokes, shake):
    unknowns = four(**{MU_K: Unknown(ratio_to=MU_S, nominal=0.7, low=0.3, high=1.0)})
    problem = Problem([shake, strokes], SENSORS, unknowns)
    runner = Runner(problem.recordings)
    plan = default_plan(problem, runner, 1e-5, problem.names)
    slow = min(problem.recordings, key=lambda recording: recording.speed)
    assert plan[0].recordings == (slow.name,)
    assert dict(plan[0].tied) == {RATIO: 1.0}
    *tied, scanned, last = plan
    assert all(RATIO not in stage.free for stage in tied)
    assert set(scanned.free) == set(last.free) == set(problem.coordinates.labels)
    assert dict(scanned.scanned)[RATIO][0] == 1.0
    assert plan[0].rtol > plan[-1].rtol == 1e-5
    tied = tie_ratios(problem, problem.coordinates.start)
    assert problem.values(tied, 0)[MU_K] == pytest.approx(problem.values(tied, 0)[MU_S])


def test_visible_drops_what_cannot_be_separated_from_the_others():
    a = np.random.default_rng(0).standard_normal((50, 1))
    J = np.hstack((100 * a, 100 * a + 1e-6, 40 * np.random.default_rng(1).standard_normal((50, 1))))
    assert visible(J, np.ones(3, bool)).sum() == 2
    assert not visible(J, np.array([False, False, True]))[:2].any()
    assert standard_deviations(np.eye(2) * 10.0) == pytest.approx([0.1, 0.1])


@pytest.mark.parametrize("name", CATALOGUE)
def test_excitations_begin_at_rest_in_a_light_grip(name):
    model, y0, _ = excited(name, BASE, F_ff=-10.0)
    state = model.unpack(y0)
    with torch.no_grad():
        assert 0.0 < float(model.penetration("U", state).max()) < GRIP
        assert model.penetration("L", state).gt(0).any()
        assert model(0.0, y0)[model.layout.slices["velocity", "disc"]][1].abs() < 1e-6
