"""Designed motions: criteria and slopes against differences, bounds that hold everywhere, and what
should be recorded next."""

from dataclasses import replace
from itertools import cycle, repeat
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RIG, excited, grasp, stroked, turning

from torchsoft import Profile, Reference
from torchsoft.plan.knots import Bounds, Moves, profile
from torchsoft.rigs.excite import Excitation
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown, record
from torchsoft.sysid.design import LINEARIZATION_ERROR, design, rank
from torchsoft.sysid.figures import design_figure
from torchsoft.sysid.fit import fisher
from torchsoft.sysid.planner import LEFT, Optimality, Planner, chosen, deviations, optimality
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner

P, DEPTH = PAPER.override(COARSE), 1e-3
E, K_N = "materials.rubber.E", "laws.steel_on_rubber.K_n"
MU_S, MU_K = (f"laws.steel_on_rubber.friction.{name}" for name in ("mu_s", "mu_k"))


def path(times: tuple[float, ...], values: tuple[float, ...]) -> dict[str, Any]:
    """Table of a profile [s, m] from where its coordinate starts."""
    return {"kind": "profile", "times": times, "values": values, "offset": "start"}


PLAN = Excitation(
    path((0.12, 0.17, 0.22), (0.0, 1e-3, -0.5e-3)),
    path((0.0, 0.1, 0.12, 0.18, 0.22), (0.0, -DEPTH, -DEPTH, -2e-4 - DEPTH, 1e-4 - DEPTH)),
    duration=0.25, grasp=0.1, depth=DEPTH,
)  # fmt: skip
BOUNDS = {
    "x_d": Bounds(low=0.055, high=0.065, speed=0.2, after=0.13, shortest=0.02),
    "y_d": Bounds(low=0.048, high=0.0499, speed=0.1, after=0.13),
}
SENSORS = {name: RIG[name] for name in ("x_C", "theta_C", "y_Br", "effort_x", "effort_y")}


@pytest.fixture(scope="session")
def plan():
    return record("plan", excited(PLAN, P), {}, SENSORS, rtol=1e-3, noise=0.0)


@pytest.fixture(scope="session")
def problem(plan):
    return Problem([plan], SENSORS, {E: Unknown(), K_N: Unknown()})


def planner(problem: Problem, criterion: Optimality, **limits: tuple[float, float]) -> Planner:
    recording = problem.recordings[0]
    moves = Moves(recording.rig.reference, BOUNDS, float(recording.times[-1]))
    return Planner(problem, recording.name, moves, limits, criterion, None, 1e-4, 1)


@pytest.mark.parametrize("criterion", ["D", "A", "worst"])
def test_a_criterion_has_the_derivative_of_its_differences(criterion):
    rng = np.random.default_rng(0)
    root, direction = rng.standard_normal((2, 3, 3))
    C, direction = root @ root.T, direction + direction.T
    value, slope = optimality(criterion, C)
    ahead, behind = (optimality(criterion, C + h * direction)[0] for h in (1e-6, -1e-6))
    assert np.sum(slope * direction) == pytest.approx((ahead - behind) / 2e-6, rel=1e-6)
    assert optimality(criterion, 4 * C)[0] == pytest.approx(
        value + np.log(2)
    )  # a logarithm of standard deviations


def test_for_one_parameter_the_criteria_are_one():
    kinds: tuple[Optimality, ...] = ("D", "A", "worst")
    values = [optimality(kind, np.array([[0.04]]))[0] for kind in kinds]
    assert values == pytest.approx([np.log(0.2)] * 3)


@pytest.mark.parametrize("sensors", [{}, {"effort_x": Sensor(noise=0.1, bias=1.0, gain=0.1)}])
def test_slopes_are_those_of_differences(plan, sensors, monkeypatch):
    """Of values and times of the knots, with what excess costs; a sensor's gain and bias are fitted
    beside the parameters."""
    monkeypatch.setattr("torchsoft.sysid.planner.DIFFERENCE", 1e-4)
    stated = Problem([plan], SENSORS | sensors, {E: Unknown(), K_N: Unknown()})
    one = planner(stated, "A", F_y=(-30.0, 30.0))
    z, x = one.moves.start, stated.coordinates.start
    at = one.evaluate(z, x)
    slopes, direction, h = (
        one.slopes(z, x, at),
        np.random.default_rng(1).standard_normal(one.moves.n),
        3e-5,
    )
    assert at.peaks["effort_y"] > 1
    ahead, behind = (one.evaluate(z + s * h * direction, x, at.steps) for s in (1, -1))
    wanted = (ahead.value + ahead.cost - behind.value - behind.cost) / (2 * h)
    assert slopes @ direction == pytest.approx(wanted, rel=1e-3)


def test_what_finite_steps_and_bent_samples_do_to_a_fit_counts(plan):
    """Sensors ten thousand times as good see the steps, and what a covariance promises is not
    there."""
    parts, sds = [], []
    for better in (4.0, 4e4):
        sensors = {name: Sensor(noise=one.noise / better) for name, one in SENSORS.items()}
        stated = Problem([plan], sensors, {E: Unknown(), K_N: Unknown()})
        one = planner(stated, "A")
        at = one.evaluate(one.moves.start, stated.coordinates.start)
        sd = np.array(list(one.deviations(stated.coordinates.start, at).values()))
        assert at.errors.shape == (2, 2)
        assert at.value == pytest.approx(
            0.5 * np.log(np.mean(sd**2 + LEFT**2 * (at.errors**2).mean(0)))
        )
        parts.append(np.abs(at.errors) / sd)
        sds.append(sd)
    assert parts[0].max() < 0.5 * LINEARIZATION_ERROR
    assert parts[1].max() > 10
    np.testing.assert_allclose(sds[0], 1e4 * sds[1], rtol=1e-9)


def test_nuisances_are_left_out_as_the_schur_complement(plan):
    stated = Problem(
        [plan],
        {**SENSORS, "effort_y": Sensor(noise=0.1, bias=1.0)},
        {E: Unknown(), K_N: Unknown()},
    )
    x, c = stated.coordinates.start, stated.coordinates
    J = stated.residuals(Runner([plan]), x, ["plan"], 1e-3, c.free).J
    F = J.T @ J
    left = F[:2, :2] - np.outer(F[:2, 2], F[2, :2]) / F[2, 2]
    names, T = chosen(stated, x, None)
    sds = deviations(names, T, fisher(J)[0])
    assert list(sds.values()) == pytest.approx(np.sqrt(np.diag(np.linalg.inv(left))))


def test_a_ratio_counts_with_what_it_is_a_ratio_to(plan):
    unknowns = {
        MU_S: Unknown(),
        MU_K: Unknown(nominal=0.5, ratio_to=MU_S),
    }
    stated = Problem([plan], SENSORS, unknowns)
    names, T = chosen(stated, stated.coordinates.start, ["contact.mu_k"])
    assert names == (MU_K,)
    assert T.tolist() == [[1.0, 1.0]]


def test_motions_keep_within_their_bounds_between_knots_too(plan):
    moves, t = (
        Moves(plan.rig.reference, BOUNDS, 0.25),
        torch.linspace(0.13, 0.3, 2000, dtype=torch.float64),
    )
    rng = np.random.default_rng(0)
    far = moves.start + 5 * rng.standard_normal(moves.n)
    reference = moves.reference(torch.from_numpy(moves.nearest(far)))
    for name, one in BOUNDS.items():
        value, rate = reference(t, [name])[:, 0].unbind(-1)
        assert one.low - 1e-9 <= float(value.min())
        assert float(value.max()) <= one.high + 1e-9
        assert float(rate.abs().max()) <= one.speed * (1 + 1e-6)
    times = profile(reference, "x_d").times
    assert float(times[1:].diff().min()) >= 0.02 * (1 - 1e-6)
    assert float(times[-1]) <= 0.25 * (1 + 1e-9)
    assert any("x_d at" in line for line in moves.active(moves.nearest(far)))
    assert np.abs(moves.nearest(moves.start) - moves.start).max() == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plan": "other"}, "`plan` must be one of the recordings"),
        ({"bounds": {}}, "names no signal"),
        (
            {"bounds": {"F_ff": Bounds(low=-9, high=0, speed=1, after=0.2)}},
            "`F_ff` has no knot after 0.2 s",
        ),
        (
            {"bounds": {"x_d": Bounds(low=0, high=1, speed=1, after=-1)}},
            "must have a knot at or before after = -1 s",
        ),
        (
            {"bounds": {"x_d": Bounds(low=0, high=0.001, speed=1, after=0.13)}},
            "no motion of these knots",
        ),
        ({"limits": {"F_x": (1.0, -1.0)}}, r"limits.effort_x = \(1, -1\)"),
        ({"limits": {"Fx": (-1.0, 1.0)}}, "limits.Fx"),
        ({"names": ["pad.nu"]}, f"`names` must be some of the parameters {E}, {K_N}"),
        ({"criterion": "E"}, "`criterion` must be one of D, A, worst, not 'E'"),
        ({"iterations": -1}, "`iterations` must not be negative"),
    ],
)
def test_what_does_not_fit_is_refused(problem, changes, message):
    given: dict[str, Any] = {"plan": "plan", "bounds": BOUNDS} | changes
    with pytest.raises(ValueError, match=message):
        design(problem, **given)


@pytest.fixture(scope="session")
def found(problem):
    return design(
        problem, "plan", BOUNDS, limits={"F_y": (-70.0, 70.0)}, iterations=20, rate=0.4,
        criterion="worst",
    )  # fmt: skip


@pytest.mark.slow
def test_a_designed_motion_tells_more(found, problem):
    """What is predicted for it is what its recording's own Jacobian says."""
    assert all(found.after[name] < 0.9 * was for name, was in found.before.items())
    assert not any("beyond its limits" in notice for notice in found.notices)
    assert found.made_by["gradients"] >= 20 * 4
    again = Problem([found.recording], SENSORS, problem.unknowns)
    x = again.coordinates.start
    at = again.residuals(Runner([found.recording]), x, ["plan"], 1e-3, again.coordinates.free)
    assert np.abs(at.r).max() < 0.1
    names, T = chosen(again, x, None)
    assert deviations(names, T, fisher(at.J)[0]) == pytest.approx(found.after, rel=0.05)
    assert found.table().count("\n") == 2
    assert len(design_figure(found).get_axes()) == 4


def test_any_rig_with_profiles():
    """It has no excitation, and its start is given."""
    rig: Any = turning(control__senses="bracket.x")
    y, still = grasp(rig.fixed())
    x = float(profile(still, "x_d").values)
    rig.reference = Reference(
        x_d=Profile([0.0, 0.04, 0.08], [x, x + 5e-4, x]), y_d=still["y_d"], F_ff=still["F_ff"]
    )
    t, sensors = (
        np.linspace(0.0, 0.1, 21),
        {"x_disc": SENSORS["x_C"], "theta_disc": SENSORS["theta_C"]},
    )
    data = Recording(
        "turning",
        rig,
        {name: (t, np.zeros(len(t))) for name in sensors},
        Known(rig.pack(rig.fixed().unpack(y))),
    )
    stated = Problem(
        [data], sensors, {"pads.L.material.E": Unknown(), "pads.L.material.tau": Unknown()}
    )
    bounds = {"x_d": Bounds(low=x - 2e-3, high=x + 2e-3, speed=0.2, shortest=0.02)}
    found = design(
        stated,
        "turning",
        bounds,
        names=["pads.L.material.tau"],
        iterations=4,
        rate=0.3,
        limits={"effort_x": (-20.0, 20.0)},
    )
    assert found.after["pads.L.material.tau"] < 0.9 * found.before["pads.L.material.tau"]
    assert found.made_by["gradients"] >= 4 * 4


def test_what_cannot_be_run_is_left(problem, monkeypatch):
    """In the search; the motion given is refused."""
    evaluate, lost = Planner.evaluate, cycle([False, False, True])

    def sometimes(self: Planner, *given: Any) -> Any:
        if next(lost):
            raise SimulationFailed("the disc was lost", 0.1)
        return evaluate(self, *given)

    monkeypatch.setattr(Planner, "evaluate", sometimes)
    found = design(problem, "plan", BOUNDS, iterations=2)
    assert any("could not be run" in notice for notice in found.notices)
    assert found.made_by["iterations"] == 2
    lost = repeat(True)
    with pytest.raises(ValueError, match="the motion given cannot be run"):
        design(problem, "plan", BOUNDS, iterations=3)


def test_an_interruption_leaves_the_best_so_far(problem, monkeypatch):
    slopes, stops = Planner.slopes, iter([False, False, True])

    def interrupted(self: Planner, *given: Any) -> Array:
        if next(stops):
            raise KeyboardInterrupt
        return slopes(self, *given)

    monkeypatch.setattr(Planner, "slopes", interrupted)
    found = design(problem, "plan", BOUNDS, iterations=50)
    assert "interrupted after 2 of 50 iterations" in found.notices


def test_the_next_recording_is_predicted(plan, problem):
    """What a recording would add is what it does add; one that cannot be made comes last."""
    motion = stroked(2e-3, stroke_time=0.1, duration=0.25, grasp=0.1, since=0.12, depth=DEPTH)
    roll = record("roll", excited(motion, P), {}, SENSORS, rtol=1e-3, noise=0.0)
    same = replace(plan, name="same")
    ranked = rank([plan], [same, roll], SENSORS, problem.unknowns, rtol=1e-3)
    assert ranked[0].score < ranked[1].score
    by_name = {one.name: one for one in ranked}
    for name, sd in rank([], [plan], SENSORS, problem.unknowns, rtol=1e-3)[0].deviations.items():
        assert by_name["same"].deviations[name] == pytest.approx(sd / 2**0.5)  # twice the same
    both = Problem([plan, roll], SENSORS, problem.unknowns)
    x = both.coordinates.start
    J = both.residuals(Runner(both.recordings), x, both.names, 1e-3, both.coordinates.free).J
    names, T = chosen(both, x, None)
    assert by_name["roll"].deviations == pytest.approx(deviations(names, T, fisher(J)[0]))
