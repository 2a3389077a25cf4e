"""Plans: slopes against differences, targets within limits, draws, refusals, and the command."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hostile.damage import document
from tqdm import tqdm

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.plan import Bounds, Limit, Plan, Target, plan
from torchsoft.plan.problem import Evaluator, Free, Terms, Variables
from torchsoft.plan.search import Search
from torchsoft.rigs import RigFile
from torchsoft.rigs.goal import Goal, drawn, plan_file
from torchsoft.rigs.written import template

ROOT = Path(__file__).parents[1]
FILE = RigFile.from_toml(ROOT / "experiments" / "reorient.toml").override(
    pads={"left_tip": {"elements_x": 40, "elements_y": 2, "points": 1},
          "right_tip": {"elements_x": 40, "elements_y": 2, "points": 1}},
    motion={"left_x": {"times": [0.0, 0.2, 0.5], "values": ["start"] * 3},
            "right_x": {"times": [0.0, 0.2, 0.5], "values": ["start"] * 3},
            "left_y": {"times": [0.2, 0.5], "values": ["start"] * 2},
            "right_y": {"times": [0.2, 0.5], "values": ["start"] * 2},
            "lean": {"times": [0.2, 0.5], "values": [0.0] * 2}},
    outputs={"duration": 0.6},
)  # fmt: skip
BUILT = FILE.build()
FREE = {
    "left_y": Bounds(low=-25e-3, high=25e-3, speed=0.3, after=0.2),
    "right_y": Bounds(low=-25e-3, high=25e-3, speed=0.3, after=0.2),
    "right_x": Bounds(low=15e-3, high=25e-3, speed=0.1, after=0.2),
}
TURN = Target(channel="theta_object", value=math.radians(10), tolerance=math.radians(0.5))
PLACE = {
    "x": Target(channel="x_object", value=0.0, tolerance=1e-4),
    "y": Target(channel="y_object", value=0.0, tolerance=1e-4),
}
GOAL = {
    "free": {k: one.model_dump(exclude_none=True) for k, one in FREE.items()},
    "targets": {
        k: one.model_dump(exclude_none=True) for k, one in ({"turn": TURN} | PLACE).items()
    },
    "rtol": 1e-3,
}


def planned(free: Free = FREE, **how: Any) -> Plan:
    options: dict[str, Any] = {"y0": BUILT.y0, "rtol": 1e-3} | how
    return plan(BUILT.rig, BUILT.t, free, **options)


@pytest.fixture(scope="module")
def turned():
    return planned(targets={"turn": TURN} | PLACE)


# derivatives
# ----------------------------------------------------------------------


def test_slopes_are_the_differences():
    """By knots, a gain and a coefficient of friction, of every draw; along two directions."""
    free = FREE | {"actuators.left_y.Kp": (1e4, 1e5), "laws.dry.K_n": (5e4, 2e5)}
    variables = Variables(BUILT.rig, BUILT.rig.reference, free, 0.6)
    limits = {"grip": Limit(channel="effort_left_x", low=4.0, high=50.0, since=0.1)}
    terms = Terms(lambda run: run["effort_left_y"].square().mean(), {"turn": TURN} | PLACE, limits)
    over = {"materials.silicone.E": torch.tensor([5e5, 5.2e5]).double()}
    evaluator = Evaluator(BUILT.rig, BUILT.t, variables, terms, BUILT.y0, over, 1e-9, None)
    z = variables.start.copy()
    z[:3] += [-0.1, 0.12, -0.05]
    evaluation = evaluator.evaluate(z)
    assert evaluation.errors.shape == (2, 3)
    slopes = np.concatenate(
        [evaluation.slopes[0][:, None], evaluation.slopes[1], evaluation.slopes[2]], 1
    )
    for way in np.random.default_rng(0).standard_normal((2, variables.n)):
        ahead, behind = (evaluator.evaluate(z + s * 1e-4 * way, gradient=False) for s in (1, -1))
        differences = [
            (getattr(ahead, part) - getattr(behind, part)).reshape(2, -1) / 2e-4
            for part in ("value", "errors", "excess")
        ]
        np.testing.assert_allclose(
            slopes @ way, np.concatenate(differences, 1), rtol=1e-3, atol=2e-3
        )


# what is found
# ----------------------------------------------------------------------


def test_the_target_is_reached_and_the_rig_carries_it_out(turned):
    assert turned.reached
    assert turned.holds == 1.0
    again = simulate(turned.rig, BUILT.t, y0=BUILT.y0, rtol=1e-6)
    assert abs(float(again["theta_object"][-1]) - TURN.value) < TURN.tolerance
    assert abs(float(again["y_object"][-1])) < 1e-4
    assert "reached" in repr(turned)
    assert turned.made_by["evaluations"] >= len(turned.history)


def test_a_limit_is_kept_at_a_price(turned):
    """Without the limit the grip falls below it; with it fingers close."""
    low = float(turned.trajectory["effort_left_x"][30:].min()) + 1.0
    limits = {"grip": Limit(channel="effort_left_x", low=low, since=0.5)}
    free = FREE | {"left_x": Bounds(low=-25e-3, high=-15e-3, speed=0.1, after=0.2)}
    found = planned(free, targets={"turn": TURN} | PLACE, limits=limits)
    assert found.reached
    assert float(found.trajectory["effort_left_x"][50:].min()) >= low * (1 - 2e-3)


@pytest.mark.slow
def test_an_objective_is_lowered_within_targets():
    """The least work of a finger that may choose its gain, by the worst of two draws."""
    objective = lambda run: run["effort_left_y"].square().mean()
    over = {"laws.dry.K_n": torch.tensor([1e5, 1.1e5])}
    found = planned(
        FREE, objective=objective, targets={"turn": TURN}, over=over, robust="worst",
        iterations=3,
    )  # fmt: skip
    assert found.made_by["draws"] == 2
    assert found.holds == 1.0
    assert found.value <= found.history[0].value or found.history[0].missed > 0


def test_adam_lowers_squared_errors():
    found = planned(targets={"turn": TURN}, method="adam", iterations=25, rate=0.02)
    assert abs(float(found.errors["turn"][0])) < 0.5 * 20.0  # from 20 tolerances
    assert found.history[-1].missed < found.history[0].missed


def test_several_starts_begin_with_the_best():
    free = {"left_y": Bounds(low=-6e-3, high=6e-3, speed=0.3, after=0.2)}
    found = planned(free, targets={"turn": TURN}, starts=4, iterations=1)
    assert min(one.missed for one in found.history) < found.history[0].missed
    with pytest.raises(ValueError, match="finite bounds"):
        planned({"actuators.left_y.Kp": (0.0, math.inf)}, targets={"turn": TURN}, starts=3)


def test_the_best_of_several_starts_has_its_slopes():
    """Looks without gradient only choose among the starts."""
    free = {"left_y": Bounds(low=-6e-3, high=6e-3, speed=0.3, after=0.2)}
    variables = Variables(BUILT.rig, BUILT.rig.reference, free, 0.6)
    terms = Terms(None, {"turn": TURN}, {})
    evaluator = Evaluator(BUILT.rig, BUILT.t, variables, terms, BUILT.y0, {}, 1e-3, None)
    search = Search(evaluator, "mean", 1.0, math.inf, tqdm(disable=True))
    search.begin(4, 0)
    assert np.abs(search.evaluate(search.found.z).slopes[1]).min() > 0


def test_a_plan_whose_finer_run_fails_is_not_reached(monkeypatch):
    """Nor does the search lose it where a finer one cannot begin."""
    evaluate = Evaluator.evaluate

    def failing(self: Evaluator, z: Any, rtol: float | None = None, **how: Any) -> Any:
        found = evaluate(self, z, rtol, **how)
        if (self.rtol if rtol is None else rtol) < 1e-3:
            found.failure = "draw 0: made to fail"
        return found

    monkeypatch.setattr(Evaluator, "evaluate", failing)
    found = planned(targets={"turn": TURN} | PLACE)
    assert not found.reached
    assert found.holds == 0.0
    assert any(text.startswith("by rtol = 1e-05 a run fails") for text in found.notices)


def test_what_cannot_be_reached_says_why():
    """A turn by 170 degrees ends where the body leaves a pad; what was found until then is kept."""
    far = TURN.model_copy(update={"value": math.radians(170)})
    found = planned(targets={"turn": far} | PLACE, iterations=1)
    assert not found.reached
    assert found.holds == 0.0
    assert any("turn is -" in reason for reason in found.reasons)
    assert "NOT reached" in repr(found)


def test_a_run_that_fails_is_worse_and_an_interrupt_keeps_the_best(
    monkeypatch,
):
    evaluate, count = Evaluator.evaluate, 0

    def failing(self: Evaluator, z: Any, rtol: float | None = None, **how: Any) -> Any:
        nonlocal count
        count += 1
        found = evaluate(self, z, rtol, **how)
        if count == 2:
            found.failure = "draw 0: made to fail"
        if count == 5:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(Evaluator, "evaluate", failing)
    found = planned(targets={"turn": TURN} | PLACE)
    assert any("made to fail" in notice for notice in found.notices)
    assert any("interrupted after" in notice for notice in found.notices)
    assert found.history[-1].missed < found.history[0].missed


def test_seconds_end_a_search():
    found = planned(targets={"turn": TURN} | PLACE, seconds=1e-9)
    assert any("as was asked for" in notice for notice in found.notices)
    assert len(found.history) == 1


# refusals
# ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (lambda: planned({}, targets={"turn": TURN}), "nothing to plan"),
        (lambda: planned(), "give an `objective`, `targets` or both"),
        (lambda: planned({"left_z": FREE["left_y"]}, targets={"turn": TURN}),
         "no Profile called `left_z`.*did you mean `left_y`"),
        (lambda: planned({"actuators.left_y.K": (1.0, 2.0)}, targets={"turn": TURN}),
         "`actuators.left_y.K` is not a parameter of this rig; did you mean"),
        (lambda: planned({"actuators.left_y.Kp": (2.0, 1.0)}, targets={"turn": TURN}),
         "low must be below"),
        (lambda: planned({"actuators.left_y.Kp": (1.0, 2.0)}, targets={"turn": TURN}),
         "begin within"),
        (lambda: planned(targets={"turn": TURN.model_copy(update={"channel": "theta"})}),
         "targets.turn: there is no channel `theta`; did you mean"),
        (lambda: planned(targets={"turn": TURN.model_copy(update={"at": 2.0})}), "outside the run"),
        (lambda: planned(objective=lambda run: torch.tensor(math.nan)), "is not finite"),
        (lambda: planned(objective=lambda run: 1.0), "as a tensor"),
        (lambda: planned(objective=lambda run: run["x_object"]), "must give one number"),
        (lambda: planned(targets={"turn": TURN}, method="newton"), "`method` must be one of"),
        (lambda: planned({"actuators.left_y.Kp": (1e4, 1e5)}, targets={"turn": TURN},
                         over={"actuators.left_y.Kp": [5e4, 5e4]}), "both free and drawn"),
        (lambda: planned(targets={"turn": TURN}, over={"laws.dry.K_n": [1e5], "gravity": [1., 2.]}),
         "one entry"),
        (lambda: Limit(channel="x"), "needs `low`, `high` or both"),
        (lambda: Target(channel="x", value=math.nan, tolerance=1.0), "value"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(how, message):
    with pytest.raises(ValueError, match=message):
        how()


def test_a_start_that_cannot_be_run_is_refused():
    """A body that nothing holds."""
    slippery = FILE.override(
        laws={"dry": {"friction": {"kind": "smooth", "mu_s": 0.02, "mu_k": 0.02, "v_s": 0.05}}}
    ).build()
    limits = {"up": Limit(channel="y_object", low=-1e-3)}
    found = None
    with pytest.raises(ValueError, match=r"no start of the plan can be run: draw 0"):
        found = plan(
            slippery.rig, torch.linspace(0, 3.0, 61), FREE, targets={"turn": TURN}, limits=limits,
            y0=slippery.y0, rtol=1e-3,
        )  # fmt: skip
    assert found is None


# the command
# ----------------------------------------------------------------------


def test_the_command_writes_a_rig_file_that_runs(tmp_path, capsys):
    from torchsoft.rigs.written import to_toml

    (tmp_path / "rig.toml").write_text(to_toml(FILE), encoding="utf-8")
    (tmp_path / "goal.toml").write_text(document(GOAL), encoding="utf-8")
    files = [str(tmp_path / name) for name in ("rig.toml", "goal.toml")]
    assert main(["plan", *files, "--out", str(tmp_path / "out"), "--no-progress"]) == 0
    out = capsys.readouterr().out
    assert "Plan: reached; " in out  # of one run, and so of no draws
    assert "-0.00" not in out
    assert (tmp_path / "out" / "run.png").stat().st_size > 10_000
    built = RigFile.from_toml(tmp_path / "out" / "motion.toml").build()
    again = simulate(built.rig, built.t, y0=built.y0, rtol=1e-5)
    assert abs(float(again["theta_object"][-1]) - TURN.value) < TURN.tolerance
    said = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert said["reached"]
    assert said["made_by"]["rtol"] == 1e-3
    (tmp_path / "goal.toml").write_text(document(GOAL | {"drws": 3}), encoding="utf-8")
    assert main(["plan", *files, "--out", str(tmp_path / "out"), "--force"]) == 2
    assert "drws" in capsys.readouterr().err


@pytest.mark.parametrize(("press", "reached"), [([0.0, -20.0], True), (["held", "held"], False)])
def test_the_written_file_is_run_again(press, reached):
    """The file's own run is told: an offset is not added twice, and an effort that is held anew
    with the planned set-points is named."""
    few = {"elements_x": 40, "elements_y": 2}
    file = template("press").override(
        pads={"lower": few, "upper": few}, outputs={"duration": 0.3},
        motion={
            "x_d": {"kind": "hold"},
            "y_d": {"times": [0.0, 0.2], "values": [0.0, -0.9e-3], "offset": "start"},
            "press": {"times": [0.0, 0.2], "values": press},
        },
    )  # fmt: skip
    goal = Goal.model_validate({
        "free": {"y_d": {"low": 45e-3, "high": 52e-3, "speed": 0.1, "after": 0.1}}, "rtol": 1e-3,
        "targets": {"down": {"channel": "y_bracket", "value": 48.7e-3, "tolerance": 1e-5}},
    })  # fmt: skip
    found, written = plan_file(file, goal)
    built = written.build()
    again = simulate(built.rig, built.t, y0=built.y0, rtol=1e-5)
    off = (float(again["y_bracket"][-1]) - 48.7e-3) / 1e-5
    assert float(found.errors["down"][0]) == pytest.approx(off, abs=0.01)
    assert found.reached == (abs(off) < 1) == reached
    assert any("anew with what was planned" in reason for reason in found.reasons) != reached


def test_draws_begin_with_the_stated_numbers_and_those_of_an_identification_with_its_estimates():
    name, other = "materials.silicone.E", "laws.dry.K_n"
    goal = Goal.model_validate(GOAL | {"uncertain": {name: {"low": 4e5, "high": 6e5}}})
    for known in ({}, {other: [2e5, 1.9e5, 2.1e5]}):
        _, over, y0 = drawn(FILE, goal, 2, seed=0, known=known)
        assert {key: over[key].tolist() for key in known} == known
        assert over[name].shape == (3,)
        assert float(over[name][0]) == 5e5
        assert bool(((over[name] > 4e5) & (over[name] < 6e5)).all())
        assert y0.shape == (3, BUILT.rig.layout.size)
        assert not torch.equal(y0[0], y0[1])
    with pytest.raises(ValueError, match=f"uncertain.{name} is drawn by the identification"):
        drawn(FILE, goal, 1, seed=0, known={name: [5e5, 5e5]})
    with pytest.raises(ValueError, match=r"uncertain.*contact"):
        plan_file(FILE, goal, {"contact.K_n": [1e5, 1e5]})


def test_the_search_scales_an_objective():
    """A plan does not depend on the unit of its objective."""
    ends = []
    for unit in (1.0, 1e3):
        found = planned(
            objective=lambda run, unit=unit: unit * (run["theta_object"][-1] - 0.1) ** 2,
            iterations=10,
        )
        ends.append(float(found.trajectory["theta_object"][-1]))
    assert ends == pytest.approx([0.1, 0.1], abs=0.01)
