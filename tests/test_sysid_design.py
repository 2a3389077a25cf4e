"""Designed motions: criteria and slopes against differences, what should be recorded next, and the
candidates of a configuration."""

import json
import re
from dataclasses import replace
from itertools import cycle, repeat
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RIG, excited, stroked
from test_sysid_rigs import replaced

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.plan.knots import Bounds, Moves
from torchsoft.rigs import RigFile
from torchsoft.rigs.excite import Excitation
from torchsoft.rigs.written import located
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid import Problem, Sensor, Unknown, record
from torchsoft.sysid.configuration import read_config
from torchsoft.sysid.design import AS_STATED, design, planned, rank
from torchsoft.sysid.design_criterion import LEFT, DesignEvaluator, chosen, optimality
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
    "x_d": Bounds(low=0.055, high=0.065, speed=0.2, after=0.13),
    "y_d": Bounds(low=0.048, high=0.0499, speed=0.1, after=0.13),
}
SENSORS = {name: RIG[name] for name in ("x_C", "theta_C", "y_Br", "effort_x", "effort_y")}
BOTH = {E: Unknown(), K_N: Unknown()}


@pytest.fixture(scope="module")
def plan():
    return record("plan", excited(PLAN, P), {}, SENSORS, rtol=1e-3, noise=0.0)


@pytest.fixture(scope="module")
def problem(plan):
    return Problem([plan], SENSORS, BOTH)


def evaluator(problem: Problem, **limits: tuple[float, float]) -> DesignEvaluator:
    recording = problem.recordings[0]
    moves = Moves(recording.rig.reference, BOUNDS, float(recording.times[-1]))
    return DesignEvaluator(problem, recording.name, moves, limits, "A", None, 1e-4, 1)


def stated_deviations(problem: Problem) -> dict[str, float]:
    """At the start, without priors."""
    x, free = problem.coordinates.start, problem.coordinates.free
    J = problem.residuals(Runner(problem.recordings), x, problem.names, 1e-3, free).J
    names, T = chosen(problem, x, None)
    return dict(zip(names, np.sqrt(np.diag(T @ np.linalg.inv(J.T @ J) @ T.T)).tolist()))


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_a_criterion_has_its_derivative_and_is_a_logarithm_of_deviations(criterion):
    root, direction = np.random.default_rng(0).standard_normal((2, 3, 3))
    C, direction = root @ root.T, direction + direction.T
    value, slope = optimality(criterion, C)
    ahead, behind = (optimality(criterion, C + h * direction)[0] for h in (1e-6, -1e-6))
    assert np.sum(slope * direction) == pytest.approx((ahead - behind) / 2e-6, rel=1e-6)
    assert optimality(criterion, 4 * C)[0] == pytest.approx(value + np.log(2))
    assert optimality(criterion, np.array([[0.04]]))[0] == pytest.approx(np.log(0.2))


def test_slopes_are_those_of_differences(plan, monkeypatch):
    """Of values of the knots, with what excess costs; a sensor's gain and bias are fitted
    beside the parameters. At two of three motions near each other: where a point slips or touches
    at a step, slopes are off by some parts in a thousand."""
    monkeypatch.setattr("torchsoft.sysid.design_criterion.DIFFERENCE", 1e-4)
    faulty = {"effort_x": Sensor(noise=0.1, bias=1.0, gain=0.1)}
    one = evaluator(Problem([plan], SENSORS | faulty, BOTH), F_y=(-30.0, 30.0))
    direction, h, off = np.random.default_rng(1).standard_normal(one.moves.n), 3e-5, []
    while len(off) < 3 and np.sum(np.array(off) < 3e-4) < 2:
        z = one.moves.start + 2e-4 * len(off) * direction
        at = one.evaluate(z)
        assert at.peaks["effort_y"] > 1
        ahead, behind = (one.evaluate(z + s * h * direction, at.steps) for s in (1, -1))
        wanted = (ahead.value + ahead.cost - behind.value - behind.cost) / (2 * h)
        off.append(abs(one.slopes(z, at) @ direction / wanted - 1))
    assert max(off) < 1e-2
    assert np.median(off) < 3e-4


def test_errors_of_steps_and_of_linearising_count(plan):
    """Sensors ten thousand times as good see the steps, and what a covariance promises is not
    there."""
    sensors = {name: Sensor(noise=one.noise / 4e4) for name, one in SENSORS.items()}
    one = evaluator(Problem([plan], sensors, BOTH))
    at = one.evaluate(one.moves.start)
    sd = np.array(list(at.deviations.values()))
    size = np.mean(sd**2 + LEFT**2 * (at.errors**2).mean(0))
    assert at.value == pytest.approx(0.5 * np.log(size))
    assert np.abs(at.errors / sd).max() > 10


def test_a_ratio_counts_with_its_denominator_and_nuisances_do_not(plan):
    unknowns = {MU_S: Unknown(), MU_K: Unknown(nominal=0.5, ratio_to=MU_S)}
    stated = Problem([plan], SENSORS | {"effort_y": Sensor(noise=0.1, bias=1.0)}, unknowns)
    names, T = chosen(stated, stated.coordinates.start, ["contact.mu_k"])
    assert names == (MU_K,)
    assert T.tolist() == [[1.0, 1.0, 0.0]]
    assert chosen(stated, stated.coordinates.start, None)[0] == (MU_S, MU_K)


def bounds(name: str, low: float, high: float, after: float) -> dict[str, Any]:
    return {"bounds": {name: Bounds(low=low, high=high, speed=1, after=after)}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plan": "other"}, "`plan` must be one of the recordings"),
        ({"bounds": {}}, "names no signal"),
        (bounds("F_ff", -9, 0, 0.2), "`F_ff` has no knot after 0.2 s"),
        (bounds("x_d", 0, 1, -1), "must have a knot at or before after = -1 s"),
        (bounds("x_d", 0, 0.001, 0.13), "no motion of these knots"),
        ({"limits": {"F_x": (1.0, -1.0)}}, r"limits.effort_x = \(1, -1\)"),
        ({"limits": {"Fx": (-1.0, 1.0)}}, "limits.Fx"),
        ({"names": ["pad.nu"]}, f"`names` must be some of the parameters {E}, {K_N}"),
    ],
)
def test_a_design_that_does_not_fit_is_rejected(problem, changes, message):
    with pytest.raises(ValueError, match=message):
        design(problem, **{"plan": "plan", "bounds": BOUNDS} | changes)


def test_a_search_leaves_out_what_cannot_be_run_and_keeps_the_best_when_interrupted(
    problem, monkeypatch
):
    """The motion given must run."""
    evaluate, slopes = DesignEvaluator.evaluate, DesignEvaluator.slopes
    lost, stops = cycle([False, False, True]), iter([False, True])

    def sometimes(self, *given):
        if next(lost):
            raise SimulationFailed("the disc was lost", 0.1)
        return evaluate(self, *given)

    def interrupted(self, *given):
        if next(stops):
            raise KeyboardInterrupt
        return slopes(self, *given)

    monkeypatch.setattr(DesignEvaluator, "evaluate", sometimes)
    monkeypatch.setattr(DesignEvaluator, "slopes", interrupted)
    found = design(problem, "plan", BOUNDS, iterations=50)
    assert [one.code for one in found.findings] == ["design-interrupted", "design-failed"]
    assert str(found.findings[0]) == "Interrupted after 1 of 50 iterations."
    lost = repeat(True)
    with pytest.raises(ValueError, match="the motion given cannot be run"):
        design(problem, "plan", BOUNDS, iterations=3)


def test_the_next_recording_is_predicted(plan, problem):
    """What a recording would add is what it does add."""
    motion = stroked(2e-3, stroke_time=0.1, duration=0.25, grasp=0.1, since=0.12, depth=DEPTH)
    roll = record("roll", excited(motion, P), {}, SENSORS, rtol=1e-3, noise=0.0)
    same = replace(plan, name="same")
    first, second = rank([plan], [same, roll], SENSORS, problem.unknowns, rtol=1e-3)
    assert first.score < second.score
    by_name = {one.name: one.deviations for one in (first, second)}
    (alone,) = rank([], [plan], SENSORS, problem.unknowns, rtol=1e-3)
    for name, sd in alone.deviations.items():
        assert by_name["same"][name] == pytest.approx(sd / 2**0.5)  # twice the same
    added = stated_deviations(Problem([plan, roll], SENSORS, problem.unknowns))
    assert by_name["roll"] == pytest.approx(added)


# The candidates of a configuration

CONFIG = """
rig = "orientation"
rehearsal = {rate = 100.0}
[settings]
outputs = {duration = 0.8, snapshots = []}
pads.lower = {elements_x = 35, elements_y = 2}
pads.upper = {elements_x = 35, elements_y = 2}
[settings.motion]
theta_d = {times = [0.4, 0.6, 0.7], values = [-0.1, 0.1, -0.1], offset = 0.1}
x_d.kind = "hold"
y_d.kind = "hold"
y_rate.kind = "hold"
grip.values = [-5.5, -8.0]
bear.values = [9.5, 12.0]
[unknowns]
"materials.rubber.E" = {}
"actuators.turn_lower.Kp" = {}
[sensors]
theta_disc.noise = 5e-4
x_lower.noise = 1e-5
effort_lift.noise = 0.05
[design]
iterations = 8
rtol = 1e-3
limits.x_upper = [-0.03, 0.05]
[design.candidates]
twist.motion.theta_d = {times = [0.4, 0.5, 0.6, 0.7], values = [-0.1, 0.1, -0.3, -0.1]}
far.motion.theta_d = {times = [0.4, 0.7], values = [-0.1, 2.9]}
[design.bounds]
theta_d = {low = -0.5, high = 0.5, speed = 30.0, after = 0.4}
"""


def designed(folder: Any, text: str = CONFIG) -> int:
    (folder / "fit.toml").write_text(text, encoding="utf-8")
    return main(["design", f"{folder / 'fit.toml'}", "--out", f"{folder / 'out'}", "--no-progress"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("design")
    assert designed(folder) == 0
    return folder


def test_candidates_are_ranked_by_the_deviations_of_the_fisher_matrix(folder):
    """A motion that cannot be made comes last."""
    first, second, last = json.loads((folder / "out/design.json").read_text())["candidates"]
    assert (first["name"], second["name"], last["name"]) == ("twist", AS_STATED, "far")
    assert first["value"] < second["value"]
    assert "was lost: " in last["failure"]
    stated = read_config(folder / "fit.toml")
    file = RigFile.ready("orientation").override(**stated.settings)
    twisted = file.override(**stated.design.candidates["twist"])
    made = planned(stated, twisted.build(), "twist", stated.design.rtol, noise=0.0)
    problem = Problem([made], stated.sensors, stated.unknowns)
    assert first["deviations"] == pytest.approx(stated_deviations(problem), rel=1e-6)


def test_the_designed_motion_is_a_rig_file_that_runs(folder):
    file = RigFile.from_toml(folder / "out/motion.toml")
    written = json.loads((folder / "out/design.json").read_text())
    motion = file.motion["theta_d"]
    assert motion.kind == "profile"
    assert motion.times == (0.4, 0.5, 0.6, 0.7)
    assert motion.values[0] + motion.offset == 0.0
    assert written["confirmed"]
    assert 0 < max(abs(np.array(motion.values) - [0.0, 0.2, -0.2, 0.0])) < 0.2
    assert max(map(abs, motion.values)) <= 0.5 + 1e-9
    first, *later = [visit["value"] for visit in written["history"]]
    assert min(later) < first
    rig, y0, t = file.build()
    assert simulate(rig, t[:3], y0=y0)["x_disc"].isfinite().all()
    followed = rig.follow(torch.tensor([0.5, 0.8]).double())[:, rig.signals.index("theta_d"), 0]
    assert followed.tolist() == pytest.approx([motion.values[1], motion.values[3]])


def test_files_that_a_rig_names_are_found_from_elsewhere(tmp_path):
    column = {"kind": "csv", "file": "x.csv", "column": "x"}
    (tmp_path / "x.csv").write_text("t [s],x [m]\n0,0\n1,0.001\n", encoding="utf-8")
    file = RigFile.ready("orientation")
    file._folder = tmp_path
    whole = located(file.override(motion={"x_d": column})).motion["x_d"]
    assert whole.file == str(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (replaced('rig = "orientation"', ""), "rig is missing"),
        (replaced("x_upper = ", "x_uper = "), "limits.x_uper = .* did you mean `x_upper`\\?"),
        (replaced("twist.motion", "twist.motions"), "design.candidates.twist: `motions` is not"),
        (replaced("theta_d = {low", "theta = {low"), "no Profile called `theta`"),
    ],
)
def test_a_configuration_without_a_design_is_rejected(tmp_path, change, message, capsys):
    assert designed(tmp_path, change(CONFIG)) == 2
    assert re.search(message, capsys.readouterr().err)
