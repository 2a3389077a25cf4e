"""Plans: slopes against differences, targets within limits, draws, rejections, and the command."""

import json
import math
import re
import tomllib
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tqdm import tqdm

from torchsoft import Profile, Reference, simulate
from torchsoft.cli import main
from torchsoft.plan import Bounds, Limit, Plan, Target, plan
from torchsoft.plan.knots import Moves
from torchsoft.plan.problem import Evaluator, Free, Terms, Variables
from torchsoft.plan.search import Criterion, Search
from torchsoft.rigs import RigFile
from torchsoft.rigs.goal import Goal, drawn, plan_file
from torchsoft.rigs.written import template, to_toml

ROOT = Path(__file__).parents[1]
CHANGES = """
pads.left_tip = {elements_x = 40, elements_y = 2, points = 1}
pads.right_tip = {elements_x = 40, elements_y = 2, points = 1}
outputs.duration = 0.6
[motion]
left_x = {times = [0.0, 0.2, 0.5], values = ["start", "start", "start"]}
right_x = {times = [0.0, 0.2, 0.5], values = ["start", "start", "start"]}
left_y = {times = [0.2, 0.35, 0.5], values = ["start", "start", "start"]}
right_y = {times = [0.2, 0.5], values = ["start", "start"]}
lean = {times = [0.2, 0.5], values = [0.0, 0.0]}
"""
REORIENT = RigFile.from_toml(ROOT / "examples" / "plan" / "reorient.toml")
FILE = REORIENT.override(**tomllib.loads(CHANGES))
BUILT = FILE.build()
GOAL = """
rtol = 1e-3
[free]
left_y = {low = -25e-3, high = 25e-3, speed = 0.3, after = 0.2}
right_y = {low = -25e-3, high = 25e-3, speed = 0.3, after = 0.2}
right_x = {low = 15e-3, high = 25e-3, speed = 0.1, after = 0.2}
[targets]
turn = {channel = "theta_object", value = 0.175, tolerance = 8.75e-3}
x = {channel = "x_object", value = 0.0, tolerance = 1e-4}
y = {channel = "y_object", value = 0.0, tolerance = 1e-4}
"""
"""The body is turned by 10 degrees, to half a degree, and stays where it is."""

READ = Goal.model_validate(tomllib.loads(GOAL))
FREE, TARGETS, TURN = READ.free, READ.targets, READ.targets["turn"]


def planned(free: Free = FREE, **how: Any) -> Plan:
    options = {"y0": BUILT.y0, "rtol": 1e-3} | how
    return plan(BUILT.rig, BUILT.t, free, **options)


@pytest.fixture(scope="module")
def turned():
    return planned(targets=TARGETS)


# derivatives and terms
# ----------------------------------------------------------------------


def searched(free: Free, rtol: float, over: Any = None, terms: Terms | None = None) -> Search:
    variables = Variables(BUILT.rig, BUILT.rig.reference, free, 0.6)
    terms = terms or Terms(None, {"turn": TURN}, {})
    evaluator = Evaluator(BUILT.rig, BUILT.t, variables, terms, BUILT.y0, over or {}, rtol)
    return Search(evaluator, Criterion(variables, 1.0), math.inf, tqdm(disable=True))


def test_slopes_are_the_differences():
    """With respect to knots, a gain and a contact stiffness, of every draw, in one direction; and
    those of the price of change. At two of three plans near each other: where a point slips or
    touches at a step, slopes are off by some parts in a thousand."""
    free = FREE | {"actuators.left_y.Kp": (1e4, 1e5), "laws.dry.K_n": (5e4, 2e5)}
    limits = {"grip": Limit(channel="effort_left_x", low=4.0, high=50.0, since=0.1)}
    objective = lambda run: run["effort_left_y"].square().mean()
    over = {"materials.silicone.E": torch.tensor([5e5, 5.2e5]).double()}
    search = searched(free, 1e-9, over, Terms(objective, TARGETS, limits))
    evaluate, z = search.evaluator.evaluate, search.evaluator.variables.start.copy()
    z[:3] += [-0.1, 0.12, -0.05]
    way, off = np.random.default_rng(1).standard_normal(len(z)), []
    while len(off) < 3 and np.sum(np.array(off) < 1) < 2:
        at = z + 2e-5 * len(off) * way
        found = evaluate(at)
        assert found.errors.shape == (2, 3)
        parts = found.slopes[0][:, None], found.slopes[1], found.slopes[2]
        slopes = np.concatenate(parts, 1) @ way
        ahead, behind = (evaluate(at + s * 1e-4 * way, gradient=False) for s in (1, -1))
        differences = [
            (getattr(ahead, part) - getattr(behind, part)).reshape(2, -1) / 2e-4
            for part in ("value", "errors", "excess")
        ]
        wanted = np.concatenate(differences, 1)
        off.append(np.max(np.abs(slopes - wanted) / (5e-3 + 1e-3 * np.abs(wanted))))
    assert max(off) < 10
    assert np.median(off) < 1
    more, less = (search.criterion.changed(z + s * way)[0] for s in (1, -1))
    assert search.criterion.changed(z)[1] @ way == pytest.approx((more - less) / 2, rel=1e-9)


def test_limits_measure_the_run(turned):
    run, y = turned.trajectory, turned.trajectory["effort_left_x"][20:51]
    limit = Limit(channel="effort_left_x", low=1.0, high=5.0, since=0.2, until=0.5)
    expected = [(float(y.max()) - 5.0) / 4.0, (1.0 - float(y.min())) / 4.0]
    assert limit(run).tolist() == pytest.approx(expected)


@settings(max_examples=20, derandomize=True)
@given(st.floats(-0.2, 0.2), st.floats(0.05, 0.3))
def test_the_nearest_motion_keeps_its_range_and_speed(there, speed):
    """In both directions."""
    far = Profile([0.0, 0.2, 0.5], [8e-3, 8e-3, there])
    bounds = {"left_y": Bounds(low=-25e-3, high=25e-3, speed=speed, after=0.2)}
    moves = Moves(Reference(left_y=far), bounds, 0.6)
    signal = moves.reference(torch.from_numpy(moves.start))["left_y"]
    values = torch.stack([signal(x)[0] for x in torch.linspace(0.2, 0.5, 31).double()])
    assert float(values.abs().max()) <= 25e-3 * (1 + 1e-9)
    assert float(values.diff().abs().max()) <= 1e-2 * speed * (1 + 1e-6)


# what is found
# ----------------------------------------------------------------------


def test_the_target_is_reached_and_the_rig_carries_it_out(turned):
    assert (turned.reached, turned.holds) == (True, 1.0)
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
    found = planned(free, targets=TARGETS, limits=limits)
    assert found.reached
    assert float(found.trajectory["effort_left_x"][50:].min()) >= low * (1 - 2e-3)


def test_adam_lowers_squared_errors():
    found = planned(targets={"turn": TURN}, method="adam", iterations=15, rate=0.03)
    assert abs(float(found.errors["turn"][0])) < 0.5 * 20.0  # from 20 tolerances
    assert found.history[-1].missed < found.history[0].missed


def test_the_best_of_several_starts_is_taken_with_its_slopes():
    """Looks without gradient only choose among the starts."""
    search = searched(
        {"left_y": FREE["left_y"].model_copy(update={"low": -6e-3, "high": 6e-3})}, 1e-3
    )
    search.begin(4, 0)
    assert search.best_visit.missed == min(one.missed for one in search.history)
    assert search.best_visit.missed < search.history[0].missed
    assert np.abs(search.evaluate(search.found.z).slopes[1]).min() > 0
    with pytest.raises(ValueError, match="finite bounds"):
        planned({"actuators.left_y.Kp": (0.0, math.inf)}, targets={"turn": TURN}, starts=3)


def test_a_plan_does_not_depend_on_the_unit_of_its_objective():
    ends = []
    for unit in (1.0, 1e3):
        found = planned(
            objective=lambda run, unit=unit: unit * (run["theta_object"][-1] - 0.1) ** 2,
            iterations=10,
        )
        ends.append(float(found.trajectory["theta_object"][-1]))
    assert ends == pytest.approx([0.1, 0.1], abs=0.01)


def test_an_unreachable_target_has_reasons():
    """A turn by 170 degrees ends where the body leaves a pad; the best so far is kept, also where
    the time is over."""
    far = TURN.model_copy(update={"value": math.radians(170)})
    found = planned(targets=TARGETS | {"turn": far}, iterations=1, seconds=1e-9)
    assert (found.reached, found.holds, len(found.history)) == (False, 0.0, 1)
    assert any("turn is -" in reason for reason in found.reasons)
    assert any("as was asked for" in notice for notice in found.notices)
    assert "NOT reached" in repr(found)


def test_more_targets_than_free_values_are_reached_where_they_can_be():
    free = {"right_y": FREE["right_y"]}
    still = Target(channel="omega_object", value=0.0, tolerance=1.0)
    near = TURN.model_copy(update={"value": math.radians(5)})
    assert planned(free, targets={"turn": near, "still": still}).reached
    found = planned(free, targets={"turn": TURN, "still": still}, seconds=1e-9)
    assert any("more targets (2) than values (1): add knots" in one for one in found.reasons)


def pressed(changes: str) -> RigFile:
    """The template, changed, on coarse pads."""
    return template("press").override(**tomllib.loads(PRESSED + changes))


PRESSED = """
pads.lower = {elements_x = 20, elements_y = 2, points = 1}
pads.upper = {elements_x = 20, elements_y = 2, points = 1}
outputs.duration = 0.3
motion.x_d.kind = "hold"
"""


def test_slip_before_anything_may_move_is_no_reason():
    """At touch-down every point slips for a moment."""
    file = pressed("""
bodies.disc.start.x = 1e-3
bodies.bracket.start.y = "touch"
motion.y_d = {times = [0.0, 0.02, 0.1, 0.2], values = ["start", "start", "start", "start"]}
motion.press = {times = [0.0, 0.1], values = [0.0, -20.0]}
""")
    built = file.build()
    for after, slips in ((0.02, True), (0.1, False)):
        found = plan(
            built.rig, built.t, {"y_d": Bounds(low=40e-3, high=60e-3, speed=0.1, after=after)},
            targets={"down": Target(channel="y_bracket", value=45e-3, tolerance=1e-6)},
            y0=built.y0, seconds=1e-9,
        )  # fmt: skip
        assert any("`upper` slips" in one for one in found.reasons) == slips


@pytest.mark.parametrize("case", ["finer", "one, then Ctrl-C"])
def test_runs_that_fail_are_worse_and_an_interrupt_keeps_the_best(monkeypatch, case):
    """A plan whose finer run fails is not reached."""
    evaluate, number = Evaluator.evaluate, count(1)

    def failing(self, z, rtol=None, **how):
        found, i = evaluate(self, z, rtol, **how), next(number)
        if (self.rtol if rtol is None else rtol) < 1e-3 if case == "finer" else i == 2:
            found.failure = "draw 0: made to fail"
        if i == 5 and case != "finer":
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(Evaluator, "evaluate", failing)
    found = planned(targets=TARGETS)
    said = "\n".join(found.notices)
    if case == "finer":
        assert (found.reached, found.holds) == (False, 0.0)
        assert "by rtol = 1e-05 a run fails" in said
    else:
        assert re.search("made to fail(.|\n)*|interrupted after", said)
        assert found.history[-1].missed < found.history[0].missed


# rejections
# ----------------------------------------------------------------------

KP, TURNED = "actuators.left_y.Kp", {"targets": {"turn": TURN}}


def target(**changes: Any) -> dict[str, Any]:
    return {"targets": {"turn": TURN.model_copy(update=changes)}}


@pytest.mark.parametrize(
    ("free", "how", "message"),
    [
        ({}, TURNED, "nothing to plan"),
        (FREE, {}, "give an `objective`, `targets` or both"),
        ({"left_z": FREE["left_y"]}, TURNED, "no Profile called `left_z`.*did you mean `left_y`"),
        ({"actuators.left_y.K": (1.0, 2.0)}, TURNED, "not a parameter of this rig; did you mean"),
        ({KP: (2.0, 1.0)}, TURNED, "low must be below"),
        ({KP: (1.0, 2.0)}, TURNED, "begin within"),
        (FREE, target(channel="theta"), "targets.turn: there is no channel `theta`; did you mean"),
        (FREE, target(at=2.0), "outside the run"),
        (FREE, {"objective": lambda run: torch.tensor(math.nan)}, "is not finite"),
        (FREE, {"objective": lambda run: 1.0}, "as a tensor"),
        (FREE, {"objective": lambda run: run["x_object"]}, "must give one number"),
        (FREE, TURNED | {"method": "newton"}, "`method` must be one of"),
        ({KP: (1e4, 1e5)}, TURNED | {"over": {KP: [5e4, 5e4]}}, "both free and drawn"),
        (FREE, TURNED | {"over": {"laws.dry.K_n": [1e5], "gravity": [1.0, 2.0]}}, "one entry"),
    ],
)  # fmt: skip
def test_arguments_that_do_not_fit_together_are_rejected(free, how, message):
    with pytest.raises(ValueError, match=message):
        planned(free, **how)


def test_a_limit_needs_a_bound():
    with pytest.raises(ValueError, match="needs `low`, `high` or both"):
        Limit(channel="x")


def test_a_start_that_cannot_be_run_is_rejected():
    """A body that nothing holds."""
    friction = {"laws.dry.friction.mu_s": 0.02, "laws.dry.friction.mu_k": 0.02}
    slippery = FILE.override(friction).build()
    limits = {"up": Limit(channel="y_object", low=-1e-3)}
    with pytest.raises(ValueError, match=r"no start of the plan can be run: draw 0"):
        plan(slippery.rig, torch.linspace(0, 3.0, 61), FREE, **TURNED, limits=limits,
             y0=slippery.y0, rtol=1e-3)  # fmt: skip


# rig files and the command
# ----------------------------------------------------------------------


UNCERTAIN = """
[targets]
start = {channel = "M_left_tip", value = 0.0, tolerance = 1.0, at = 0.0}
[uncertain]
"materials.silicone.E" = {low = 4e5, high = 6e5}
"""


def test_every_draw_starts_from_the_equilibrium_of_its_own_parameters():
    """The first has the stated values, or the estimates of an identification, whose draws are taken
    as they are."""
    E, K_n = "materials.silicone.E", "laws.dry.K_n"
    head, _ = GOAL.split("[targets]")
    goal = Goal.model_validate(tomllib.loads(f"draws = 2\niterations = 1\n{head}{UNCERTAIN}"))
    known = {K_n: [2e5, 1.9e5, 2.1e5]}
    over = drawn(FILE, goal, 2, seed=goal.seed, known=known)
    assert over[K_n].tolist() == known[K_n]
    assert float(over[E][0]) == 5e5
    assert bool(((over[E] > 4e5) & (over[E] < 6e5)).all())
    found, _ = plan_file(FILE, goal, known)
    for i, error in enumerate(found.errors["start"].tolist()):
        built = FILE.override({name: float(values[i]) for name, values in over.items()}).build()
        run = simulate(built.rig, built.t[:2], y0=built.y0, rtol=1e-3)
        assert error == pytest.approx(float(run["M_left_tip"][0]), rel=1e-6)
    with pytest.raises(ValueError, match=f"uncertain.{E} is drawn by the identification"):
        drawn(FILE, goal, 1, seed=0, known={E: [5e5, 5e5]})
    with pytest.raises(ValueError, match=r"uncertain.*contact"):
        plan_file(FILE, goal, {"contact.K_n": [1e5, 1e5]})


def test_the_command_writes_a_rig_file_that_runs(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text(to_toml(FILE), encoding="utf-8")
    (tmp_path / "goal.toml").write_text(GOAL, encoding="utf-8")
    command = ["plan", *(str(tmp_path / name) for name in ("rig.toml", "goal.toml"))]
    command += ["--out", str(tmp_path / "out"), "--no-progress"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "Plan: reached; " in out  # of one run, and so of no draws
    assert "-0.00" not in out
    assert (tmp_path / "out" / "run.png").stat().st_size > 10_000
    planned = RigFile.from_toml(tmp_path / "out" / "motion.toml").motion["left_y"].values
    assert list(planned) != FILE.motion["left_y"].values
    stored = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert (stored["reached"], stored["made_by"]["rtol"]) == (True, 1e-3)
    (tmp_path / "goal.toml").write_text("drws = 3" + GOAL, encoding="utf-8")
    assert main([*command, "--force"]) == 2
    assert "drws" in capsys.readouterr().err


@pytest.mark.parametrize(("press", "reached"), [("[0, -20]", True), ('["held", "held"]', False)])
def test_the_written_file_is_run_again(press, reached):
    """The file's own run is told: an offset is not added twice, and an effort that is held anew
    with the planned set-points is named."""
    file = pressed(f"""
motion.y_d = {{times = [0.0, 0.2], values = [0.0, -0.9e-3], offset = "start"}}
motion.press = {{times = [0.0, 0.2], values = {press}}}
""")
    goal = Goal.model_validate(
        tomllib.loads("""
rtol = 1e-3
free.y_d = {low = 45e-3, high = 52e-3, speed = 0.1, after = 0.1}
targets.down = {channel = "y_bracket", value = 48.7e-3, tolerance = 1e-5}
""")
    )
    found, written = plan_file(file, goal)
    built = written.build()
    again = simulate(built.rig, built.t, y0=built.y0, rtol=1e-5)
    off = (float(again["y_bracket"][-1]) - 48.7e-3) / 1e-5
    assert float(found.errors["down"][0]) == pytest.approx(off, abs=0.01)
    assert found.reached == (abs(off) < 1) == reached
    assert any("anew with what was planned" in reason for reason in found.reasons) != reached
