"""What an identification takes for granted: data say where it is otherwise; intervals allow for
what they cannot tell."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import accumulate
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from closed_forms import ClosedForm
from conftest import COARSE, PAPER, RIG, excited, stroked
from scipy.interpolate import CubicSpline

from torchsoft import RigFile
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import (
    Problem,
    Recording,
    Sensor,
    Stage,
    Unknown,
    identify,
    new_fits,
    record,
    refits,
)
from torchsoft.sysid.assumption_tests import (
    TIGHTENINGS,
    Again,
    AssumptionTest,
    Judge,
    assumption_test,
)
from torchsoft.sysid.assumptions import (
    AMOUNTS,
    PLACE,
    WIDEST,
    Variation,
    assumptions,
    at_finite_strain,
    coulomb,
    delayed,
    remeshed,
)
from torchsoft.sysid.estimate import Quantity
from torchsoft.sysid.fit import Check, Fit, standard_deviations
from torchsoft.sysid.identification import notices_on, ordering_constraints
from torchsoft.sysid.new_fits import MOST, TRIALS, NewFits, alike
from torchsoft.sysid.plan import LOOSE, settle
from torchsoft.sysid.prediction import predict
from torchsoft.sysid.recording import Array, extended
from torchsoft.sysid.refits import (
    EVIDENT,
    REFITS,
    assuming,
    difference,
    fewest,
    first_step,
    joint_fit,
    likeness,
    reach,
    refit,
    shares,
)
from torchsoft.sysid.residual_tests import Verdict
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sensitivity import (
    TEMPERED,
    Checked,
    check_assumptions,
    compared,
    doubted,
    rivals,
)
from torchsoft.sysid.suspects import LIKELY, assumption_doubts, assumption_notices, unseen

BASE = PAPER.override(COARSE)
E, NU, K_N = "materials.rubber.E", "materials.rubber.nu", "laws.steel_on_rubber.K_n"
MU_S, MU_K, V_S = (f"laws.steel_on_rubber.friction.{one}" for one in ("mu_s", "mu_k", "v_s"))
MASS, RADIUS = "bodies.disc.mass", "bodies.disc.shape.radius"
RATIO = "bodies.disc.inertia_ratio"
TRUTH = {E: 0.85e6, K_N: 1.3e5}
STROKES = stroked(travel=8e-3, stroke_time=0.2, duration=0.9)
HARD = stroked(travel=16e-3, stroke_time=0.1, duration=0.9)
BRIEF = stroked(travel=8e-3, stroke_time=0.15, duration=0.3, grasp=0.12, since=0.15)
SENSORS = {name: RIG[name] for name in ("x_C", "theta_C", "y_Br", "effort_x", "effort_y")}
RTOL = 1e-4


def recorded(
    truth: dict[str, float] | None = None, excitation: Excitation = STROKES, file: RigFile = BASE
) -> Recording:
    return record(
        "strokes", excited(excitation, file), TRUTH | (truth or {}), SENSORS, rtol=1e-6, seed=4
    )


@cache
def brief() -> Recording:
    return recorded(excitation=BRIEF)


ALARM = Verdict("motion", "roll", "x", 1e-9, 0.4, "x of `roll` (40% of it, most like its rate)")


def notices(found: Checked) -> list[str]:
    """All that is said of the assumptions."""
    return assumption_doubts(found) + assumption_notices(found)


def checked(
    data: Recording,
    doubtful: bool = False,
    sensors: dict[str, Sensor] = SENSORS,
    explain: bool = True,
) -> Checked:
    problem = Problem([data], sensors, {name: Unknown() for name in TRUTH})
    stages = [Stage("all", problem.names, problem.coordinates.labels, RTOL)]
    answer = identify(problem, plan=stages, assumptions="trusted")
    end = ended(problem, np.array(answer.x))
    return check_assumptions(end, doubtful=doubtful, effort=np.inf if explain else 0.0)


def ended(problem: Problem, x: np.ndarray) -> Fit:
    """A fit that has ended at x (n,)."""
    stage = Stage("all", problem.names, problem.coordinates.labels, RTOL)
    end = Fit(problem, Runner(problem.recordings), x, stage).begun()
    return end._replace(check=Check(RTOL, end.at))


@pytest.fixture(scope="module")
def same():
    """Of data that the same model made."""
    return checked(brief())


def test_nothing_is_said_of_what_is_right(same):
    assert not notices(same)
    names = {one.name for one in same.checks}
    assert {
        "mesh", "contact points", "mesh phase", "start of disc.x",
        "Coulomb friction", "feed-forward", RADIUS, "actuators.y.Kp", "bias x_C", "delay effort_x",
        "gain theta_C",
    } <= names  # fmt: skip
    assert not names & set(TRUTH)
    assert not any(one.unchecked for one in same.checks)


def test_intervals_allow_for_what_the_data_cannot_tell_of_the_computation(same):
    plain = np.linalg.inv(same.J.T @ same.J)
    wider = same.covariance()
    assert (np.diag(wider) >= np.diag(plain)).all()
    columns = np.concatenate([same.J, same.columns], 1)
    precision = columns.T @ columns
    precision[2:, 2:] += np.eye(same.columns.shape[1])
    np.testing.assert_allclose(wider, np.linalg.inv(precision)[:2, :2], rtol=1e-6)


def sampled(
    truth: dict[str, float] | None = None, file: RigFile = BASE, excitation: Excitation = STROKES
) -> Recording:
    """The recording with samples of another truth, or of another rig."""
    return replace(
        recorded(excitation=excitation), samples=recorded(truth, excitation, file).samples
    )


def further(by: float) -> RigFile:
    """The rig whose disc begins further right by a distance [m], and is not told so."""
    return BASE.override({"bodies.disc.start.x": BASE.bodies["disc"].start.x + by})


def turned(data: Recording) -> Recording:
    t, theta = data.samples["theta_C"]
    return replace(data, samples=data.samples | {"theta_C": (t, theta + 2e-3)})


def read_by(
    data: Recording, reading: Callable[[str, Array, Array], Array],
    sensors: dict[str, Sensor] = SENSORS,
) -> Recording:  # fmt: skip
    """The recording with another reading (k,) of the exact samples by channel, and noise as
    stated."""
    exact = record("exact", excited(STROKES, BASE), TRUTH, sensors, rtol=1e-6, noise=0.0)
    rng, samples = np.random.default_rng(4), {}
    for name, (t, y) in exact.samples.items():
        noise = sensors[name].noise * rng.standard_normal(len(t))
        samples[name] = t, reading(name, t, y) + noise
    return replace(data, samples=samples)


def late(
    data: Recording, by: float, channels: Sequence[str], sensors: dict[str, Sensor] = SENSORS
) -> Recording:
    """The recording with channels that came late by a time [s]."""
    return read_by(data, lambda name, t, y: CubicSpline(t, y)(t - by * (name in channels)), sensors)


def geared(data: Recording, backlash: float) -> Recording:
    """The recording with theta_C behind a gear."""

    def reading(name: str, t: Array, y: Array) -> Array:
        if name != "theta_C":
            return y
        every = np.linspace(t[0], t[-1], 10 * len(t) - 9)
        follow = lambda at, now: np.clip(at, now - backlash / 2, now + backlash / 2)
        return np.array([*accumulate(CubicSpline(t, y)(every), follow)])[::10]

    return read_by(data, reading)


@pytest.mark.parametrize(
    ("made", "name", "favoured", "says"),
    [
        (lambda: delayed(brief(), -3e-4), "clock of the set-points", 0.3,
         "set-points and sensors"),
        (lambda: sampled(file=further(1.5 * PLACE)), "start of disc.x", 30.0,
         "disc begins where the start says"),
        (lambda: turned(recorded()), "bias theta_C", 2e-3, "theta_C has no unknown bias"),
        (lambda: late(recorded(), 1e-3, ["x_C"]), "delay x_C", 1.0, "x_C has no unknown delay"),
        (lambda: geared(recorded(), 1e-3), "backlash theta_C", 1e-3,
         "theta_C has no unknown backlash"),
        (lambda: sampled({RATIO: 1.2}, excitation=HARD), RATIO, 20.0, f"{RATIO} is 1"),
        (lambda: sampled({RADIUS: 19.39e-3}), RADIUS, 0.103, f"{RADIUS} is 0.01937"),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_the_cause_is_named_with_its_amount(made, name, favoured, says):
    found = checked(made(), doubtful=True)
    (one,) = (one for one in found.checks if one.name == name)
    assert one.suspected
    assert one.favoured == pytest.approx(favoured, rel=0.1, abs=4 * one.favoured_sd)
    if one.parameter:
        assert one.value == pytest.approx(
            (1 + one.favoured / 100) * BASE.assemble().parameter(name).item(), rel=1e-9
        )
        assert f"with {name} = {one.value:.6g} (" in notices(found)[0]
    assert one.under[E] == pytest.approx(TRUTH[E], rel=0.05)
    said = notices(found)[0]
    assert re.search(f"estimates under (it|one or another): {re.escape(E)} = ", said)
    rivals = [other for other in found.favoured if other.passed and other.odds > LIKELY]
    if len(rivals) > 1:  # as a delay and a lag of one sensor
        assert said.startswith(f"the data contradict one of {len(rivals)} assumptions")
        assert f" {name}{one.found}, odds " in said
    else:
        assert said.startswith(f"the data contradict that {says}")


def made_by(
    other: Recording | None, data: Recording, sensors: dict[str, Sensor] = SENSORS
) -> Recording:
    """The samples that another rig would have given, with noise."""
    run, rng = predict(other.begin(), TRUTH, other.grid(False), (), 1e-6), np.random.default_rng(0)
    samples = {}
    for channel, sensor in sensors.items():
        exact = run.signals[:, other.channels.index(channel)]
        samples[channel] = (run.t, exact + sensor.noise * rng.standard_normal(len(exact)))
    return replace(data, samples=samples)


@pytest.mark.slow
def test_a_finer_mesh_is_asked_for_by_data_that_one_made():
    data = recorded()
    found = checked(made_by(remeshed(data, 2, 0), data))
    (mesh,) = (one for one in found.checks if one.name == "mesh")
    assert mesh.suspected
    assert mesh.favoured == pytest.approx(1.0, abs=0.2)
    assert any("mesh" in text and "if they had 120 x 4" in text for text in notices(found))


LIGHT = stroked(travel=30e-3, stroke_time=0.15, duration=0.9, depth=1.8e-4)
QUIET = {name: Sensor(noise=0.2 * one.noise) for name, one in SENSORS.items()}


@pytest.fixture(scope="module")
def far_off():
    """Data of Coulomb's friction, with coordinates and residuals at which a fit with smooth
    friction has ended where nothing can be learnt."""
    known = BASE.override({"contact.mu_s": 0.1, "contact.mu_k": 0.07, "contact.v_s": 0.1})
    data = record("light", excited(LIGHT, known), TRUTH, SENSORS, rtol=1e-5, noise=0.0)
    problem = Problem([made_by(coulomb(data), data)], SENSORS, {name: Unknown() for name in TRUTH})
    return ended(problem, problem.coordinates.start + [-0.5, 0.5])


@pytest.mark.slow
def test_what_no_test_explains_has_candidates(
    far_off,
):
    """Nothing is fitted again: a notice says what `explain` would try."""
    found = check_assumptions(far_off, doubtful=True)
    assert not any(one.refitted for one in found.checks)
    assert "Coulomb friction" in found.candidates
    assert any(": `explain` fits again with each of " in text for text in notices(found))


@pytest.mark.slow
def test_under_another_law_a_fit_that_is_far_off_begins_anew(
    far_off,
):
    problem = far_off.problem
    law = next(
        one
        for one in assumptions(problem.recordings, set(TRUTH), problem.sensors)
        if one.name == "Coulomb friction"
    )
    as_stated, again = (refit(far_off, tried) for tried in ((), [law]))
    assert as_stated.chi2 > 20  # nothing can be done with smooth friction
    again = settle(again, TIGHTENINGS)  # on coarse steps it may end 20 deviations off
    assert again.converged
    assert again.chi2 < 1.2
    for name, value in TRUTH.items():
        sd = dict(zip(again.labels, standard_deviations(again.J)))[name]
        assert sd < 0.1
        assert again.by_label[name] == pytest.approx(np.log(value), abs=3 * sd)


@pytest.mark.slow
@pytest.mark.parametrize("true", [False, True])
def test_a_costly_law_is_fitted_finely_where_it_leaves_less(true):
    """Neo-Hookean pads: E of linear ones is high where the data are of these."""
    data = brief()
    made = made_by(at_finite_strain(data) if true else data, data)
    problem = Problem([made], SENSORS, {name: Unknown() for name in TRUTH})
    start = dict(TRUTH) | ({E: 1.1 * TRUTH[E]} if true else {})
    end = ended(problem, problem.coordinates.begun({k: np.log(v) for k, v in start.items()}))
    every = assumptions(problem.recordings, set(TRUTH), problem.sensors)
    fit = refit(end, [next(one for one in every if one.costly)])
    assert fit.rtol == (RTOL if true else LOOSE)
    assert (fit.square < end.square) == true
    if true:
        assert fit.chi2 < 1.2
        sd = float(fit.sd[fit.labels.index(E)])
        assert fit.by_label[E] == pytest.approx(np.log(TRUTH[E]), abs=4 * sd)


@pytest.mark.slow
def test_a_joint_fit_ranks_suspects_where_the_first_fit_ended_far_off():
    """A heavier disc: at the end of a fit without it, other numbers explain more to first order."""
    truth = TRUTH | {MASS: 1.08 * BASE.bodies["disc"].mass}
    data = record("strokes", excited(STROKES, BASE), truth, QUIET, rtol=1e-6, seed=4)
    problem = Problem([data], QUIET, {name: Unknown() for name in TRUTH})
    end = ended(problem, problem.coordinates.start + [0.7, -0.7])
    suspects = [
        one
        for one in assumptions(problem.recordings, set(TRUTH), problem.sensors)
        if one.name in (MASS, NU, V_S, "mesh")
    ]
    enough = 1.1 * len(end.at.r)
    found = joint_fit(end, suspects, enough)
    assert found.square < enough
    parts, (together, _) = shares(end, found, suspects)
    assert parts.keys() == {MASS, NU, V_S}
    assert max(parts, key=lambda name: parts[name]) == MASS
    assert 0.95 < parts[MASS] < 1.05
    assert together == [MASS]
    assert np.exp(found.by_label[E]) == pytest.approx(TRUTH[E], rel=0.01)


def test_kinds_of_faults_that_are_alike_to_first_order_are_all_tried():
    made = lambda kind, name: SimpleNamespace(name=f"{kind} {name}", fault=(name, kind))
    candidates: Any = [made(kind, name) for kind in ("lag", "delay", "bias") for name in "xy"]
    gains = {one.name: 1.0 if one.fault[1] == "bias" else 50.0 for one in candidates}
    names = [[one.name for one in some] for some in alike(candidates, ["lag x", "lag y"], gains)]
    assert names == [["lag x", "lag y"], ["delay x", "delay y"]]
    mixed = alike(candidates, ["lag x", "delay y"], gains)
    assert [[one.name for one in some] for some in mixed] == names
    assert alike(candidates, ["lag x", "bias y"], gains | {"bias y": 400.0}) == []
    (both, _) = alike(candidates, ["lag x", "lag y", "delay y"], gains)  # each channel once
    assert [one.name for one in both] == ["lag x", "lag y"]


@pytest.mark.slow
def test_faults_that_only_together_explain_the_data_are_named_together():
    """A camera that is late: two channels are, by the same time."""
    data = record("strokes", excited(STROKES, BASE), TRUTH, QUIET, rtol=1e-6, seed=4)
    found = checked(late(data, 2e-3, ["x_C", "theta_C"], QUIET), doubtful=True, sensors=QUIET)
    one = max((one for one in found.checks if one.kind == "several"), key=lambda one: one.odds)
    assert one.name == "delay x_C and delay theta_C"
    assert one.odds > 0.9
    notice = notices(found)[0]
    assert "delay x_C and delay theta_C" in notice or "no unknown delay and theta_C" in notice
    assert re.search(r" if x_C came late \(\+(1\.9|2)\S* ms fit best, .*\) and if theta_C", notice)
    assert one.under[E] == pytest.approx(TRUTH[E], rel=0.01)


def test_the_fewest_effects_that_span_a_misfit_are_found():
    """Without e, which resembles the misfit most, but is not needed beside a and c."""
    effects = dict(zip("abcd", np.eye(8)))
    effects["e"] = np.array([0.7, 0.2, 0.65, 0, 0, 0, 0, 0.2]) / 1.006**0.5
    r = 5 * effects["a"] + 4 * effects["c"]
    assert fewest(effects, r, 0.01) == ["a", "c"]
    assert fewest(effects, r, 5.0) == ["e"]
    assert fewest(effects, r, 50.0) == []
    assert fewest(effects, np.ones(8), 0.1) == []


def test_a_first_step_far_off_is_the_best_of_its_parts(monkeypatch):
    """A whole one passes the minimum by more than it was away; a tiny part brings little."""
    problem: Any = ClosedForm(lambda x: 10.0 * np.arctan(8.0 * x), 1)
    stage = Stage("far off", ("data",), ("p0",), RTOL)
    end = Fit(problem, Runner(()), np.array([0.4]), stage).begun()
    monkeypatch.setattr(refits, "assuming", lambda *given, free: problem)
    monkeypatch.setattr(refits, "under", lambda *given: end)
    monkeypatch.setattr(refits, "begun", lambda *given: end.x)
    fit = first_step(end, Variation("a", "known", "", ""))
    assert fit is not None
    np.testing.assert_allclose(fit.x, 0.15)
    assert fit.square < end.square < 100 * np.arctan(8 * 0.6) ** 2


def test_a_new_fit_begins_at_the_end_of_the_first_where_it_cannot_at_that_of_a_short_one(
    monkeypatch,
):
    """A short fit by a loose tolerance may end where a finer one finds no run."""
    problem: Any = ClosedForm(lambda x: x - 0.1, 1, fails=lambda x: x[0] > 0.5)
    stage = Stage("far off", ("data",), ("p0",), RTOL)
    end = Fit(problem, Runner(()), np.array([0.4]), stage).begun()
    near = end._replace(x=np.array([0.6]))
    problem.runner = lambda runner: runner
    monkeypatch.setattr(refits, "assuming", lambda *given, free: problem)
    tried = [Variation("a", "known", "", "")]
    for begin in (None, near):
        fit = refit(end, tried, begin)
        assert fit is not None
        np.testing.assert_allclose(fit.x, 0.1, atol=1e-6)


def screened(monkeypatch: pytest.MonkeyPatch, left: dict[str, float]) -> None:
    """Short fits that end with a sum of squares by name, which a few more steps halve."""
    monkeypatch.setattr(
        new_fits,
        "first_step",
        lambda end, one: SimpleNamespace(square=left[one.name]) if one.name in left else None,
    )
    monkeypatch.setattr(
        new_fits,
        "carried_on",
        lambda fit, count: SimpleNamespace(square=fit.square / 2),
    )


@pytest.mark.parametrize(
    ("law", "joint_left", "rests", "lefts", "tried", "together"),
    [
        (700.0, 10.0, True, {"law": 50.0}, ["law"], ()),
        (700.0, 10.0, True, {"b": 50.0}, ["law", "b"], ()),
        (700.0, 10.0, True, {}, ["law", "b", "a"], ()),
        (700.0, 10.0, True, {}, ["law"], ("a", "b")),
        (700.0, 300.0, False, {}, ["law"], ("a", "b")),
        (1100.0, 300.0, False, {}, ["law", "b", "a"], ("a", "b")),
        (1100.0, 300.0, True, {}, ["law"], ("a", "b")),
        (1100.0, 500.0, False, {}, ["law"], ("a", "b")),
    ],
)
def test_a_joint_fit_decides_what_is_tried(
    law, joint_left, rests, lefts, tried, together, monkeypatch
):
    """After the best of short fits. Where it explains the data, those first that explain it
    together, then numbers by their part; where not, those that are left by their short fits, if
    none of these explains most; and no number at all where all of them leave much, or rest where
    much is left."""
    taken = [Variation(name, "sensor", "", "", fault=(name, "delay")) for name in "abc"]
    taken.append(Variation("law", "law", "", "", vary=lambda r, amount, run: r))
    gains = {"a": 300.0, "b": 200.0, "c": 40.0, "law": 10.0}

    def fitted(again: Again, as_stated: Fit) -> AssumptionTest:
        left = 50.0 if len(again.tried) > 1 else lefts.get(again.name, 999.0)
        return replace(again.linear[0], name=again.name, left=left, refitted=True)

    checks = {one.name: assumption_test(one, gain=gains[one.name], suspected=True) for one in taken}
    judge: Any = SimpleNamespace(
        square=1000.0,
        work={},
        complementary=lambda some, count: [one for one in some if one.name != "c"],
        explained_chi2=100.0,
        misfit=lambda left: left - 10.0,
        nearly=lambda one: one.left < 100.0,
        of_size=lambda one: True,
        ends={},
        fit=fitted,
        at_rest=fitted,
    )
    parts = {"a": 0.25, "b": 0.25 if together else 0.9}
    joint = SimpleNamespace(square=joint_left, converged=rests, chi2=9.0)
    # c explains too little to first order for a short fit
    screened(monkeypatch, {"a": 1900.0, "b": 1800.0, "c": 2.0, "law": law})
    monkeypatch.setattr(new_fits, "joint_fit", lambda *given: joint)
    monkeypatch.setattr(new_fits, "shares", lambda *given: (parts, [["a", "law"], together]))
    monkeypatch.setattr(new_fits, "refit", lambda *given, **named: SimpleNamespace(square=1e3))
    problem: Any = ClosedForm(lambda x: 10.0 + x, 1)
    end = Fit(problem, Runner(()), np.zeros(1), Stage("far off", ("data",), ("p0",), RTOL)).begun()
    found = [one.name for one in NewFits(end, taken, taken, judge, checks)]
    assert found == tried
    left_out = joint_left > 400.0 or (rests and joint_left > 100.0)
    assert all(checks[name].suspected != left_out for name in "ab")


@pytest.mark.parametrize(
    ("kind", "b", "lefts", "tried", "ranked"),
    [
        ("known", 800.0, {"a": 50.0}, ["a"], []),
        ("known", 800.0, {"b": 50.0}, ["a", "b"], ["short"]),
        ("known", 800.0, {}, ["a", "b", "law"], ["short", "joint"]),
        ("known", 1100.0, {}, ["a", "law"], ["short", "joint"]),
        ("sensor", 800.0, {"a": 50.0}, ["a"], []),
        ("sensor", 800.0, {}, ["a", "b", "law"], ["joint", "short"]),
    ],
)
def test_one_suspect_may_spare_the_joint_fit(kind, b, lefts, tried, ranked, monkeypatch):
    """Where it explains most of the misfit to first order, or in a short fit, and leaves nothing in
    a new fit; else all numbers are fitted at once, before if the first was a
    sensor, and here none is the cause."""
    taken = [Variation(name, kind, "", "", fault=(name, "delay")) for name in "ab"]
    taken.append(Variation("law", "law", "", "", vary=lambda r, amount, run: r))
    gains = {"a": 600.0, "b": 100.0, "law": 50.0}
    checks = {one.name: assumption_test(one, gain=gains[one.name], suspected=True) for one in taken}
    done = list[str]()
    judge: Any = SimpleNamespace(
        square=1000.0,
        work={},
        complementary=lambda some, count: some[:count],
        explained_chi2=100.0,
        ends={},
        misfit=lambda left: left - 10.0,
        of_size=lambda one: True,
        nearly=lambda one: one.left < 100.0,
    )
    end: Any = SimpleNamespace(progress=False, runner=SimpleNamespace(work=0.0), chi2=9.0)
    end._replace = lambda **_: end

    def joint_fit(*_: object) -> Any:
        done.append("joint")
        return SimpleNamespace(square=900.0, converged=False, chi2=9.0)

    def fitted(fits: NewFits, some: list[Variation], *_: object) -> None:
        name = some[0].name
        fits.checks[name] = replace(fits.checks[name], left=lefts.get(name, 999.0))

    def short(fits: NewFits) -> None:
        done.append("short")
        screen(fits)

    screen = NewFits.screen
    screened(monkeypatch, {"b": b, "law": 1900.0})
    monkeypatch.setattr(NewFits, "screen", short)
    monkeypatch.setattr(new_fits, "joint_fit", joint_fit)
    monkeypatch.setattr(new_fits, "shares", lambda *_: ({"a": 0.1, "b": 0.1}, []))
    monkeypatch.setattr(new_fits, "refit", lambda *_: SimpleNamespace(square=1e3))
    monkeypatch.setattr(NewFits, "fit", fitted)
    assert [one.name for one in NewFits(end, taken, taken, judge, checks)] == tried
    assert done == ranked


def test_constants_of_the_computation_have_short_fits_however_they_begin(monkeypatch):
    """A finer mesh moves the estimates, so that its first step is among the worst."""
    numbers = [f"n{k}" for k in range(MOST + 2)]
    taken = [Variation(name, "sensor", "", "", fault=(name, "delay")) for name in numbers]
    taken.append(Variation("mesh", "numerical", "", "", vary=lambda r, amount, run: r))
    checks = {one.name: assumption_test(one, gain=500.0, suspected=True) for one in taken}
    judge: Any = SimpleNamespace(
        square=1000.0, misfit=lambda left: left - 10.0, of_size=lambda one: True
    )
    end: Any = SimpleNamespace(
        progress=False, runner=SimpleNamespace(work=0.0), chi2=9.0, square=1e3
    )
    end._replace = lambda **_: end
    screened(monkeypatch, {one.name: 600.0 + k for k, one in enumerate(taken)})
    fits = NewFits(end, [], taken, judge, checks)
    with fits.bar:
        fits.screen()
    assert [*fits.short] == ["mesh", *numbers[:MOST]]


def test_new_fits_end_with_the_effort(monkeypatch):
    """The first suspect is tried whatever it takes; those that are left then have names."""
    taken = [Variation(name, "sensor", "", "", fault=(name, "delay")) for name in "abc"]
    checks = {one.name: assumption_test(one, gain=9.0, suspected=True) for one in taken}
    judge: Any = SimpleNamespace(
        square=1000.0,
        work={"c": 0.1},
        ends={},
        of_size=lambda one: True,
        nearly=lambda one: False,
        misfit=lambda left: left - 10.0,
    )
    runner: Any = SimpleNamespace(work=2.0)
    end: Any = SimpleNamespace(progress=False, runner=runner, chi2=1.0)
    end._replace = lambda **_: end

    def refitted(*_: object) -> None:
        runner.work += 3.0

    monkeypatch.setattr(new_fits, "refit", refitted)
    fits = NewFits(end, taken, taken, judge, checks, effort=2.0)
    assert [*fits] == []  # the fit as stated could not begin
    monkeypatch.setattr(new_fits, "refit", lambda end, tried, near=None: refitted() or not tried)
    monkeypatch.setattr(NewFits, "fit", lambda *_: refitted())
    for effort, tried in ((2.0, "a"), (4.9, "ab"), (5.1, "abc")):  # c is expected to take 1 more
        runner.work = 2.0
        fits = NewFits(end, taken, taken, judge, checks, effort)
        assert [one.name for one in fits] == [*tried]
        assert fits.late == [one for one in "abc" if one not in tried]
    runner.work = 2.0
    fits = NewFits(end, taken, taken, judge, checks, effort=2.0)
    assert [one.name for one in fits] == ["a"]
    (said,) = assumption_notices(Checked([], np.zeros((1, 0)), np.eye(1), late=tuple(fits.late)))
    assert "there was none with another b, c; a larger one tries them" in said


@pytest.mark.parametrize(
    ("before", "after", "passed", "tried"),
    [(1, 2, True, "a"), (1, 4, True, "ab"), (-4, 1, True, "ab"), (1, 2, False, "ab")],
)
def test_others_are_tried_that_act_alike_at_the_end_of_a_new_fit(
    before, after, passed, tried, monkeypatch
):
    """Where the cause moves estimates by more than three standard deviations, to first order or in
    its new fit, or has not passed its tests: b has no effect to first order at the end of the first
    fit."""
    a, b = (Variation(name, "known", "", "", vary=lambda r, amount, run: r) for name in "ab")
    gains, moves = {"a": 900.0, "b": 2.0}, {"a": {"E": before}, "b": {"E": 0.0}}
    checks = {
        one.name: assumption_test(
            one, gain=gains[one.name], favoured=1.0, moves=moves[one.name], suspected=True
        )
        for one in (a, b)
    }
    ends = dict[str, Any]()
    judge: Any = SimpleNamespace(
        square=1000.0, work={}, ends=ends, of_size=lambda one: True,
        nearly=lambda one: one.refitted, misfit=lambda left: left - 10.0,
        at_rest=lambda again, _: checks[again.tried[0].name],
    )  # fmt: skip
    end: Any = SimpleNamespace(progress=False, runner=SimpleNamespace(work=0.0), chi2=1.05)
    end._replace = lambda **_: end

    def fitted(fits: NewFits, some: list[Variation], *_: object) -> None:
        name = some[0].name
        ends[name] = SimpleNamespace(fit=end, tried=some)
        fits.checks[name] = replace(
            fits.checks[name], refitted=True, passed=passed, moves={"E": after}
        )

    monkeypatch.setattr(new_fits, "refit", lambda *_: True)
    monkeypatch.setattr(new_fits, "likeness", lambda end, cause, others: {"b": 0.9})
    monkeypatch.setattr(NewFits, "fit", fitted)
    assert [one.name for one in NewFits(end, [a], [a, b], judge, checks)] == [*tried]


@pytest.mark.parametrize(
    ("lefts", "passes", "rested"),
    [
        ((900.0, 910.0, 990.0), "abc", "ab"),
        ((950.0, 910.0, 990.0), "c", "bac"),
        ((900.0, 960.0, 990.0), "b", "ab"),
        ((900.0, 960.0, 990.0), "", "a"),
    ],
)
def test_the_best_new_fits_go_on_until_they_are_at_rest(lefts, passes, rested, monkeypatch):
    """The best first, and those that leave about as much, whatever that takes; one that passes its
    tests goes on too while none that leaves less has passed."""
    taken = [Variation(name, "sensor", "", "", fault=(name, "delay")) for name in "abc"]
    checks = {
        one.name: assumption_test(
            one, left=left, refitted=True, suspected=True, passed=one.name in passes
        )
        for one, left in zip(taken, lefts)
    }
    done = list[str]()

    def at_rest(name: str, _: object) -> AssumptionTest:
        done.append(name)  # finer steps leave less
        return replace(checks[name], left=checks[name].left - 300.0)

    judge: Any = SimpleNamespace(
        square=2000.0, work={}, ends={name: name for name in checks},
        nearly=lambda one: one.refitted, at_rest=at_rest, misfit=lambda left: left - 10.0,
    )  # fmt: skip
    end: Any = SimpleNamespace(progress=False, runner=SimpleNamespace(work=1.0), chi2=1.05)
    end._replace = lambda **_: end
    fits = NewFits(end, [], taken, judge, checks)
    with fits.bar:
        fits.finish(end)
    assert "".join(done) == rested


def test_rivals_of_a_cause_have_no_second_start_and_fewer_evaluations(monkeypatch):
    taken = [Variation(name, "known", "", "", vary=lambda r, amount, run: r) for name in "ab"]
    checks = {one.name: assumption_test(one, gain=90.0, suspected=True) for one in taken}
    starts = list[tuple[bool, int]]()

    def refitted(
        end: Any, tried: Any, begin: Any = None, enough: float = 0.0, anew: bool = True,
        evaluations: int = REFITS,
    ) -> object:  # fmt: skip
        starts.extend([(anew, evaluations)] * len(tried))
        return object()

    judge: Any = SimpleNamespace(
        square=1000.0, work={}, ends={}, explained_chi2=100.0, of_size=lambda one: True,
        nearly=lambda one: one.refitted, misfit=lambda left: left - 10.0,
        fit=lambda again, as_stated: replace(again.linear[0], refitted=True),
        at_rest=lambda again, as_stated: replace(again.linear[0], refitted=True),
    )  # fmt: skip
    end: Any = SimpleNamespace(progress=False, runner=SimpleNamespace(work=0.0), chi2=1.05)
    end._replace = lambda **_: end
    monkeypatch.setattr(new_fits, "refit", refitted)
    assert [one.name for one in NewFits(end, taken, taken, judge, checks)] == ["a", "b"]
    assert starts == [(True, REFITS), (False, TRIALS)]


def test_suspects_of_a_joint_fit_complement_each_other():
    """A copy of the first one adds nothing; one that is one-sided counts on its side only."""
    e = np.eye(40)
    r = -(5 * e[3] + 3 * e[4] + e[5]) + 9 * e[0]
    effects = {
        "a": e[3], "copy of a": 2 * e[3], "near a": e[3] + 0.1 * e[4], "b": e[4], "c": e[5],
        "wrong side": -(e[4] + e[5]),
    }  # fmt: skip
    judge: Any = SimpleNamespace(Q=e[:, :1], r=r, columns=effects)
    some = [Variation(k, "known", "", "", one_sided=k == "wrong side") for k in effects]
    some.append(Variation("could not be run", "known", "", ""))
    found = [one.name for one in Judge.complementary(judge, some, 3)]
    assert found == ["near a", "a", "c"]
    assert len(Judge.complementary(judge, some, 9)) == 3


def test_a_cause_has_an_effect_of_the_size_of_the_misfit():
    """Known of a mesh, or of what is costly, and of no law where it is ten times as large; a number
    may be off by more than its variation."""
    e = np.eye(40)
    judge: Any = SimpleNamespace(
        Q=e[:, :1], square=140.0, misfit=lambda left: left - 40.0,
        columns={"small": 5 * e[3] + 90 * e[0], "large": 6 * e[4], "huge": 101 * e[5]},
    )  # fmt: skip

    def large(name: str, **given: Any) -> bool:
        return Judge.of_size(judge, Variation(name, stated="", otherwise="", **given))

    assert [large(name, kind="numerical") for name in ("small", "large")] == [False, True]
    assert not large("small", kind="law", costly=True)
    assert [large("huge", kind=kind) for kind in ("law", "numerical", "known")] == [0, 0, 1]
    assert large("small", kind="known")
    assert large("small", kind="law")
    assert large("not run", kind="numerical")


def test_a_number_is_like_a_cause_as_far_as_its_range_goes():
    """A heavier disc: gravity has most of its effect, but not within a thousandth of its range."""
    data = recorded({MASS: 1.03 * BASE.bodies["disc"].mass}, BRIEF)
    problem = Problem([data], SENSORS, {name: Unknown() for name in TRUTH})
    end = ended(problem, problem.coordinates.start)
    known = {one.name: one for one in assumptions(problem.recordings, set(TRUTH), problem.sensors)}
    fit = refit(end, [known[MASS]])
    assert fit is not None
    gravity = known["gravity"]
    short = replace(gravity, amount=1e-3 * gravity.amount, step=1e-3 * gravity.step)
    (far,), (near,) = (likeness(fit, known[MASS], [one]).values() for one in (gravity, short))
    assert 0.1 < far <= 1.0
    assert near < 0.2 * far
    low, high = reach(fit.problem, gravity)
    assert low == pytest.approx(-AMOUNTS * WIDEST)
    assert high == pytest.approx(AMOUNTS * WIDEST)
    assert reach(fit.problem, known["mesh"]) == (-np.inf, np.inf)
    never = replace(gravity, step=1e6 * gravity.step, nominal=-gravity.nominal)
    assert reach(fit.problem, never) == (0.0, 0.0)


@pytest.mark.parametrize(("second", "near"), [(250.0, ["a", "b"]), (80.0, [])])
def test_near_rivals_to_first_order_are_left_to_new_fits(same, second, near):
    taken = [Variation(name, "known", f"{name} is 1", "", parameter=name) for name in "abc"]
    checks = {
        one.name: assumption_test(
            one, gain=gain, favoured=1.0, significance=gain, odds=odds, passed=True
        )
        for one, gain, odds in zip(taken, (300.0, second, 5.0), (1.0, 0.0, 0.0))
    }
    assert [one.name for one in rivals(taken, checks)] == near
    alarms = {"as_stated": (ALARM,)}
    said = notices(same._replace(checks=[*checks.values()], candidates=tuple(near), **alarms))
    assert said[0].startswith("the data contradict that a is 1") != bool(near)
    assert ("one of 2 assumptions" in said[0] and "b (by 250): `explain`" in said[0]) == bool(near)


def test_a_number_is_varied_as_far_as_there_is_a_rig():
    """Friction in slip must not exceed that at rest."""
    data = recorded(excitation=BRIEF, file=BASE.override({MU_K: 0.795}))
    problem = Problem([data], SENSORS, {name: Unknown() for name in TRUTH})
    (one,) = (
        one
        for one in assumptions(problem.recordings, set(TRUTH), problem.sensors)
        if one.name == MU_K
    )
    other = assuming(problem, [one], free=True)
    sliding = next(a for a in other.coordinates.all if a.name == MU_K)
    reach = AMOUNTS * one.step / one.nominal
    assert sliding.low == pytest.approx((1 - reach) * 0.795)
    assert 0.795 < sliding.high < 0.8 < (1 + reach) * 0.795


def test_a_doubtful_fit_is_repeated_with_what_would_explain_most():
    """And with every law, which either holds or does not."""
    names = [f"number {k}" for k in range(MOST + 5)]
    taken = [Variation(name, "known", "", "", parameter=name) for name in names]
    taken.append(Variation("law", "law", "", "", vary=lambda r, amount, run: r))
    checks = {
        one.name: assumption_test(one, gain=100.0 - k, left=900.0, favoured=1.0)
        for k, one in enumerate(taken)
    }
    checks["number 3"] = replace(checks["number 3"], unchecked="a run failed")
    found = [one.name for one in doubted(taken, checks)]
    assert found == [*names[:3], *names[4 : MOST + 1], "law"]


@pytest.mark.parametrize(("left", "sd"), [(1000.0, 100.0), (50000.0, 0.032)])
def test_a_new_fit_that_is_much_worse_tells_a_constant(left, sd):
    """Though its estimates are far away: the data tell that the other constant is wrong."""
    one = Variation("mesh", "numerical", "pads have 10 elements", "they had 20")
    linear = AssumptionTest("mesh", "numerical", one.stated, one.otherwise, gain=-1e9)
    made = lambda one, moves, gain, left, favoured, favoured_sd, *_: replace(
        linear, favoured_sd=favoured_sd, refitted=True
    )
    end = SimpleNamespace(x=np.zeros(0), free=np.zeros(0, bool))
    judge: Any = SimpleNamespace(
        dof=1000, labels=(), end=end, sd=np.zeros(0), made=made, alarms=lambda r, J: []
    )
    again: Any = SimpleNamespace(square=left, by_label={}, converged=True, at=end, J=None)
    again.at.r = None
    stated: Any = SimpleNamespace(square=999.9999, at=end)
    found = Judge.alone(judge, one, again, stated, linear)
    assert found.favoured_sd == pytest.approx(sd, rel=0.02)


def test_a_suspect_is_named_beside_another_unless_that_is_evidently_better():
    assert np.exp(-0.5 * TEMPERED * EVIDENT) == pytest.approx(LIKELY, rel=0.02)


def test_what_cannot_be_told_apart_is_named_with_its_odds(same):
    """Equal gains have equal odds, a much smaller one none."""
    tests = [
        AssumptionTest(
            name, "known", f"{name} is 1", "", 1.0, "%", name, 1.0, 0.01, gain=gain,
            left=1000.0 - gain, favoured=5.0, favoured_sd=0.5, significance=gain, value=1.05,
            refitted=True, passed=True,
        )
        for name, gain in (("a", 300.0), ("b", 299.0), ("c", 200.0))
    ]  # fmt: skip
    judge: Any = SimpleNamespace(
        dof=990, besides=lambda best, every: ((), [], []), alarms=lambda r, J: []
    )
    found = compared(same._replace(checks=tests, as_stated=(ALARM,)), judge)
    odds = {one.name: one.odds for one in found.checks}
    assert odds["a"] == pytest.approx(1 / (1 + np.exp(-0.5 * TEMPERED)), rel=1e-3)
    assert odds["a"] + odds["b"] == pytest.approx(1.0)
    assert odds["c"] < 1e-8
    (said,) = notices(found)
    assert said == (
        "the data contradict one of 2 assumptions, or what acts alike, and do not tell which: the "
        "sum of squares falls by 300 in a new fit under a with a = 1.05 (+5 %, +- 0.5), odds 0.56; "
        "b with b = 1.05 (+5 %, +- 0.5), odds 0.44"
    )
    judge.besides = lambda best, every: ((), [ALARM], [ALARM])
    (said,) = notices(compared(same._replace(checks=tests, as_stated=(ALARM,)), judge))
    assert said == (
        "the misfit stands for something that is none of the assumptions tested: with the nearest "
        "one, a, the sum of squares falls by 300 in a new fit with a = 1.05 (+5 %, +- 0.5), but "
        "residuals follow the motion in x of `roll` (40% of it, most like its rate)"
    )
    tests = [replace(one, refitted=False) for one in tests]
    (said,) = notices(compared(same._replace(checks=tests, as_stated=(ALARM,)), judge))
    assert said.startswith("the likeliest suspect, which only a new fit can exclude, is a: with it")
    assert "none of" not in said


def test_a_suspect_is_no_cause_where_residuals_pass_without_it(same):
    (one,) = (one for one in same.checks if one.name == RADIUS)
    found = replace(
        one, suspected=True, passed=True, odds=1.0, gain=31.0, favoured=2.0, favoured_sd=0.4,
        value=0.0198,
    )  # fmt: skip
    checked = same._replace(checks=[found])
    (said,) = notices(checked)
    assert said == (
        f"something is not as stated, most like {RADIUS}: the sum of squares would fall by 31 with "
        f"{RADIUS} = 0.0198 (+2 %, +- 0.4), which is more than chance. Residuals pass every test "
        "without it, so that nothing confirms the cause"
    )
    assert not checked.explained


def test_a_suspect_that_moves_estimates_far_is_no_cause_to_first_order(same):
    (one,) = (one for one in same.checks if one.name == RADIUS)
    found = replace(
        one, suspected=True, passed=True, odds=1.0, gain=531.0, favoured=2.0, favoured_sd=0.1,
        value=0.0198, moves={E: 0.9},
    )  # fmt: skip
    (said,) = notices(same._replace(checks=[found], as_stated=(ALARM,), candidates=(RADIUS,)))
    assert said == (
        f"something is not as stated, most like {RADIUS}: the sum of squares would fall by 531 "
        f"with {RADIUS} = 0.0198 (+2 %, +- 0.1); {E} would move by 18 standard deviations, too far "
        "for a test to first order: `explain` fits again with it, and with what acts alike there"
    )


def test_a_cause_whose_fit_has_not_come_to_rest_tells_no_estimates(same):
    (one,) = (one for one in same.checks if one.name == RADIUS)
    found = replace(
        one, suspected=True, passed=True, odds=1.0, gain=531.0, favoured=2.0, favoured_sd=0.1,
        value=0.0198, moves={E: 0.9}, refitted=True, under={},
    )  # fmt: skip
    (said,) = notices(same._replace(checks=[found], as_stated=(ALARM,)))
    assert said.startswith(f"the data contradict that {one.stated}")
    assert said.endswith("; the fit under it has not come to rest, and tells no estimates")
    assert "estimates under" not in said
    rival = replace(found, name="b", odds=0.4)
    (said,) = notices(same._replace(checks=[replace(found, odds=0.6), rival], as_stated=(ALARM,)))
    assert "do not tell which" in said
    assert "estimates under" not in said


def test_a_suspect_under_which_something_is_left_loses_to_one_that_passes(same):
    """However much more the sum of squares falls with it."""
    tests = [
        AssumptionTest(
            name, "known", f"{name} is 1", "", 1.0, "%", name, 1.0, 0.01, gain=gain,
            left=1000.0 - gain, favoured=5.0, favoured_sd=0.5, significance=gain, value=1.05,
            refitted=True, passed=passed,
        )
        for name, gain, passed in (("a", 300.0, False), ("b", 280.0, True))
    ]  # fmt: skip
    judge: Any = SimpleNamespace(
        dof=990,
        besides=lambda best, every: ((), [], []),
        alarms=lambda r, J: [],
    )
    found = compared(same._replace(checks=tests, as_stated=(ALARM,)), judge)
    assert [one.odds for one in found.checks] == [0.0, 1.0]
    (said,) = notices(found)
    assert said.startswith("the data contradict that b is 1")
    assert "one of" not in said


def test_what_would_not_be_seen_is_said_with_its_size_or_its_price(same):
    """The worst three of each kind that move an estimate by more than a standard deviation."""

    def one(name: str, move: float, detectable: float, **others: Any) -> AssumptionTest:
        usual = {"moves": {E: move}, "detectable": detectable}
        return AssumptionTest(name, "known", "", "", 1.0, "%", **(usual | others))

    tests = [
        one("a", 2.0, 3.0), one("b", -0.5, 4.0), one("c", 0.1, 5.0), one("d", 1.0, 1.5),
        one("e", 5.0, 0.5), one("far", 3.0, 1e3), one("seen", 9.0, 3.0, suspected=True),
    ]  # fmt: skip
    said = unseen(same._replace(checks=tests, sd={E: 0.004}))
    assert said == [
        f"a: 3 % more or less than stated would not be seen, and moves {E} by 6 standard "
        "deviations",
        f"e: 0.5 % more or less than stated would not be seen, and moves {E} by 2.5 standard "
        "deviations",
        f"b: 4 % more or less than stated would not be seen, and moves {E} by 2 standard "
        "deviations",
        f"{E} takes far as exact: 1 % of it is +1.2 % of {E}",
    ]
    hinted = one("hint", 1.0, 2.0, significance=12.0, favoured=1.5, favoured_sd=0.43)
    first, *others = unseen(same._replace(checks=[*tests, hinted], sd={E: 0.004}))
    assert first == (
        f"hint: 2 % more or less than stated would not be seen, and moves {E} by 2 standard "
        "deviations; the data favour +1.5 % +- 0.43, which may be chance"
    )
    assert others == [*said[:2], said[3]]
    more = [one("x", 4.0, 3.0), one("y", 8.0, 2.0), one("z", 7.0, 0.5)]
    assert unseen(same._replace(checks=[*tests, *more], sd={E: 0.004}))[-1] == (
        "1 more would move an estimate by up to 3.5 standard deviations without being seen: z"
    )


@pytest.mark.slow
def test_two_causes_are_both_named_and_neither_is_the_cause():
    """An offset of one sensor and the gain of another: the second one besides the first."""
    data = turned(brief())
    t, force = data.samples["effort_y"]
    found = checked(
        replace(data, samples=data.samples | {"effort_y": (t, 1.03 * force)}), explain=False
    )
    first, *_ = sorted(found.checks, key=lambda one: -one.odds)
    assert {first.name, *(one.name for one in found.besides)} >= {"bias theta_C", "gain effort_y"}
    said = notices(found)[0]
    assert said.startswith("the likeliest suspect, which only a new fit can exclude, is ")
    assert "bias theta_C" in said
    assert "gain effort_y" in said or not found.left
    assert not found.explained


@pytest.mark.slow
def test_extensions_are_suspects():
    """A pad that is stiffer than its material, and dry friction of a guide."""
    data = recorded()
    other = extended(data, ["guides.bracket.x.friction"])
    torch.nn.init.constant_(other.rig.parameter("guides.bracket.x.friction"), 1.0)
    found = checked(made_by(other, data), explain=False)
    (one,) = (one for one in found.checks if one.name == "guides.bracket.x.friction")
    assert one.odds > 0.9
    assert one.value == pytest.approx(1.0, abs=4 * one.favoured_sd)


def test_every_pad_is_meshed_anew_where_it_was():
    data = brief()
    other = remeshed(data, 2, 3)
    for name, pad in data.rig.pads.items():
        new = other.rig.pads[name]
        assert (new.mesh.elements_x, new.mesh.elements_y, new.points) == (120, 4, 3)
        ends = [(one.positions[0] - one.positions[-1]).tolist() for one in (pad, new)]
        np.testing.assert_allclose(ends[0], ends[1], atol=1e-15)
        np.testing.assert_allclose(new.positions[0], pad.positions[0], atol=1e-15)
        assert new.material is other.rig.pads["L"].material
        assert new.material is not pad.material


def test_what_is_unknown_is_not_taken_for_granted():
    data = brief()
    names = {one.name for one in assumptions([data], set(), SENSORS)}
    left = {one.name for one in assumptions([data], {RADIUS, "start.disc.x"}, SENSORS)}
    assert names - left == {RADIUS, "start of disc.x"}


def test_a_variation_that_cannot_be_run_is_said(monkeypatch):
    one = Variation(
        "mesh", "numerical", "the pads have few elements", "", vary=lambda r, amount, run: None
    )
    monkeypatch.setattr("torchsoft.sysid.sensitivity.assumptions", lambda *_: [one])
    (said,) = notices(checked(brief()))
    assert said.startswith("it could not be checked what it does that the pads have few elements")


@pytest.mark.parametrize(
    ("favoured", "refitted", "unit", "suspected"),
    [
        (24.0, False, "%", True),
        (-208.0, False, "%", False),
        (-208.0, True, "%", True),
        (124.0, False, "N", True),
    ],
)
def test_a_negative_mass_explains_nothing(favoured, refitted, unit, suspected):
    """A number of the rig that would have to vanish is no cause, and ends no search for one."""
    how = {"favoured": favoured, "significance": 1e6, "refitted": refitted}
    one = AssumptionTest("bodies.disc.mass", "known", "", "", 1.0, unit, **how)
    assert one.suspected is suspected


def test_an_interrupt_among_the_assumptions_keeps_the_fit(monkeypatch):
    calls = []

    def interrupted(*args: object) -> object:
        calls.append(args)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return difference(*args)

    monkeypatch.setattr("torchsoft.sysid.refits.difference", interrupted)
    problem = Problem([brief()], SENSORS, {name: Unknown() for name in TRUTH})
    answer = identify(problem, plan=[Stage("all", problem.names, problem.coordinates.labels, RTOL)])
    assert answer[E].value == pytest.approx(TRUTH[E], rel=0.01)
    assert any("interrupted, so these were not tried: " in text for text in answer.notices)
    assert answer.made_by["untried"][0] == "mesh phase"
    assert {one.name for one in answer.assumptions} >= {"mesh", "contact points", RADIUS}


def test_no_bound_is_to_be_widened_for_what_is_not_identifiable():
    for seen in (False, True):
        one: Any = SimpleNamespace(
            identifiable=seen,
            at_bound=True,
            relative_sd=2.0,
            label="a",
            name="a",
            last=1.0,
            step_bias_sd=0.0,
        )
        said = notices_on([one], {}, True, 1e-5, False)
        assert any("widen" in text for text in said) == seen


def test_a_shift_is_said_of_what_moves_in_numbers_that_mean_something():
    """No estimate at a bound, and no part of a sensor's fault that is next to nothing."""

    def one(label: str, **others: Any) -> Any:
        usual = {
            "identifiable": True,
            "at_bound": False,
            "relative_sd": 0.01,
            "last": 2.0,
            "step_bias_sd": 2.0,
            "unit": "m",
            "name": label,
        }
        return SimpleNamespace(label=label, **usual | others)

    bound = one("at its bound", at_bound=True, step_bias_sd=-1e7, relative_sd=2.0)
    unseen = one("unseen", identifiable=False, step_bias_sd=90.0, relative_sd=2.0)
    *_, said = notices_on([bound, unseen, one("E")], {}, True, 1e-5, False)
    assert "it shifts E by 2 standard deviations (+2.00%); take rtol = 1e-06" in said
    nearly = one("bias of x", last=1e-9, relative_sd=1e4)
    (said,) = notices_on([nearly], {}, True, 1e-5, False)
    assert "it shifts bias of x by 2 standard deviations (+2e-05 m)" in said


@pytest.mark.parametrize(
    ("value", "sd", "seen"),
    [(0.2, 250.5, False), (300.0, 160.0, False), (300.0, 100.0, True), (0.2, 1.0, True)],
)
def test_an_interval_wider_than_its_value_determines_nothing(value, sd, seen):
    """On a linear scale from 0 to 600, but for a value that is next to zero for certain."""
    one = Quantity("R_t", "parameter", None, "", value, 1.0, 600.0, np.ones(1), [0], None)
    assert one.identifiable(sd / 600.0) is seen
    assert one._replace(kind="bias").identifiable(sd / 600.0)


def test_a_known_number_that_holds_an_unknown_one_is_named():
    """mu_s ends at the mu_k that is taken for known."""
    problem = Problem([recorded()], SENSORS, {"contact.mu_s": Unknown()})
    held = ordering_constraints(problem)
    assert held == {MU_S: (MU_K, 0.7)}
    one: Any = SimpleNamespace(
        identifiable=True, at_bound=True, label="mu_s", name=MU_S, last=0.70007, step_bias_sd=0.0
    )
    (said,) = notices_on([one], held, True, 1e-5, False)
    assert f"{MU_K} = 0.7, which is known, holds it there; is that right?" in said
