"""Rigs in files: what is read, refused, checked, built, run and drawn, from Python and from the
command line."""

import json
import math
import re
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import f64, holding_force, nested, press, still
from PIL import Image
from test_rig_parts import STONE

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.materials.presets import from_shore_a
from torchsoft.physics.statics import resting, standing
from torchsoft.rigs import RigFile
from torchsoft.rigs import run as running
from torchsoft.rigs.build import ready
from torchsoft.rigs.check import check
from torchsoft.rigs.course import Estimate
from torchsoft.rigs.written import template, to_toml
from torchsoft.solve.diagnostics import linearised, modes
from torchsoft.solve.formats import load
from torchsoft.solve.simulate import Interrupted

READY = [RigFile.path(name) for name in ready()]

ELSEWHERE = "fingertips", "two_fingers", "ellipse", "rounded_box"
"""Ready rigs whose parts other tests run."""


def coarse(file: RigFile, **groups: dict[str, Any]) -> RigFile:
    """The rig on a mesh half as fine."""
    pads = {
        name: {"elements_around": pad.elements_around // 2}
        if pad.kind == "fingertip"
        else {"elements_x": max(16, pad.elements_x // 2), "elements_y": 2}
        for name, pad in file.pads.items()
    }
    return file.override(pads=pads).override(**groups)


def shorter(file: RigFile, duration: float) -> RigFile:
    return file.override(outputs={"duration": duration, "snapshots": (), "frames": 3})


def changed(file: RigFile, **values: Any) -> RigFile:
    """The rig with fields replaced by their dotted names, `__` for a dot."""
    for name, value in values.items():
        file = file.override(**nested(name, value))
    return file


# ready rigs
# ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in ELSEWHERE))
        for path in READY
    ],
)
def test_a_ready_rig_checks_clean_and_runs(path):
    file = coarse(RigFile.from_toml(path))
    assert [str(one) for one in check(file) if one.severity != "note"] == []
    done = running.carry_out(shorter(file, 0.1))
    assert done.stopped is None
    assert float(done.trajectory.t[-1]) == pytest.approx(0.1)
    assert done.trajectory.energy_residual_rel < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_a_ready_rig_runs_to_its_end(path):
    file = RigFile.from_toml(path)
    assert [str(one) for one in check(file) if one.severity != "note"] == []
    done = running.carry_out(file)
    assert done.stopped is None
    assert done.trajectory.energy_residual_rel < 1e-3


@pytest.mark.parametrize("gap", [0.0, 5e-5])
def test_a_loop_that_is_about_to_close_is_not_judged(gap):
    """The bracket does not hold the disc yet, so that the loop over both is unstable there."""
    file = RigFile.ready("paper")
    ready = file.build()
    top = float(ready.rig.unpack(ready.y0).pose["bracket"][1])
    found = check(changed(file, bodies__bracket__start__y=top + gap))
    assert [str(one) for one in found if one.severity != "note"] == []


def test_what_is_held_is_the_papers_grasping_force():
    """Fed forward, it is that of the friction-free grasp, and the bracket comes down to touch the
    disc wherever this is; both by statics."""
    file = changed(
        coarse(RigFile.ready("paper")), motion__F_ff__values=(0.0, "held"),
        materials__rubber__E=0.6e6, bodies__disc__start__x=60.3e-3,
        bodies__bracket__start__x=60.3e-3, motion__x_d={"kind": "hold"},
    )  # fmt: skip
    ready = file.build()
    force, _ = ready.rig.reference["F_ff"](f64(1.0)[0])
    grasp = {"disc": {"x": 60.3e-3, "y": "rest"}, "bracket": {"x": 60.3e-3, "y": 48.6e-3}}
    held = holding_force(ready.rig, ready.rig.state(grasp))
    assert float(force) == pytest.approx(-held, rel=1e-9)
    state = ready.rig.unpack(ready.y0)
    depth = float(ready.rig.penetration("U", state).max().detach())
    assert -1e-15 < depth <= 0.0
    aside = changed(file, bodies__bracket__start__x=1.0)
    with pytest.raises(ValueError, match=r'bracket\.start\.y: "touch", but no pad bonded to it'):
        aside.build()


def test_strokes_go_there_and_back_until_there_is_no_time_for_more():
    stroke = {"kind": "strokes", "since": 0.5, "stroke_time": 0.2, "travel": -1e-3, "until": 1.2}
    file = changed(coarse(RigFile.ready("paper")), motion__x_d=stroke)
    follow = file.build().rig.reference["x_d"]
    t = f64(0.0, 0.5, 0.6, 0.7, 0.9, 1.1, 1.3)
    wanted = f64(0.0, 0.0, -0.5e-3, -1e-3, 0.0, -1e-3, -1e-3)
    assert torch.allclose(follow(t)[0] - 60e-3, wanted, rtol=0, atol=1e-12)


def test_short_names_are_for_typing():
    """Results have the full ones; a short one is of what is there, and of nothing else."""
    paper = coarse(shorter(RigFile.ready("paper"), 0.02))
    file = changed(paper, names__push="effort_x", names__soft="materials.rubber.E")
    file = file.override({"soft": 0.6e6})
    done = running.carry_out(file)
    run, numbers = done.trajectory, running.summary(file, done, [])
    assert run["push"] is run["F_x"] is run["effort_x"]
    assert not {"push", "F_x"} & {*run.keys(), *run.to_xarray()}
    assert set(numbers["actuators"]) == {"x", "y"}
    assert run.setup.pads["L"].E == 0.6e6
    for short, full, sentence in (
        ("turn", "theta_X", "the rig has no channel `theta_X`; .*`theta_C`"),
        ("turn", "materials.steel.E", r"names\.turn: `materials\.steel\.E` is not in the rig file"),
        ("x_C", "theta_C", r"names\.x_C: it is the name of something else already"),
    ):
        with pytest.raises(ValueError, match=sentence):
            paper.override(names={short: full}).assemble()


def test_a_drop_is_not_missed():
    """Steps chosen by tolerance would be through the pad; the first touch is where free fall
    says."""
    file = coarse(RigFile.ready("drop"))
    file = changed(shorter(file, 0.3), outputs__interval=1e-3)
    run = running.carry_out(file).trajectory
    y, force = run["y_ellipse"], run.force["ground"][..., 0].sum(-1)
    touch = int((force > 0).nonzero()[0])
    s = file.bodies["ellipse"].start
    fallen = s.y - 0.5 * 9.81 * run.t[:touch] ** 2
    assert torch.allclose(y[:touch], fallen, rtol=0, atol=1e-7)
    reach = math.hypot(18e-3 * math.sin(0.5), 11e-3 * math.cos(0.5))
    assert float(y[touch]) == pytest.approx(12e-3 + reach, abs=1.2e-3)
    assert float(y.min()) > 12e-3 + 9e-3  # it lies on the pad


# loops and steps -------


@pytest.mark.slow
def test_a_loop_is_unstable_as_the_papers_modes_say():
    """The leading mode is that of the paper's own equilibrium: the friction-free grasp."""
    model = still({"pad.elements_x": 60, "pad.elements_y": 2, "pad.tau": 1e-3})
    leading = complex(modes(model, press(model), model.reference).values[0])
    paper = coarse(RigFile.ready("paper"))
    found, *notes = check(changed(paper, materials__rubber__tau=1e-3))
    assert {one.severity for one in notes} <= {"note"}
    assert found.severity == "error"
    assert found.where == "actuators.x"
    assert "the rig is unstable at t = 0.375 s: its leading mode is +" in found.message
    words = found.message.partition("mode is ")[2].split()
    assert float(words[0]) == pytest.approx(leading.real, rel=0.2)
    assert float(words[2].rstrip("j")) == pytest.approx(abs(leading.imag), rel=0.05)


def test_modes_are_those_of_the_whole_state():
    """What is left out where nothing touches decides nothing."""
    model = still({"pad.elements_x": 60, "pad.elements_y": 2})
    y = press(model)
    whole = torch.linalg.eigvals(linearised(model, y, model.reference))
    some = modes(model, y, model.reference).values
    found = (some[:, None] - whole).abs().amin(1) / some.abs().clamp(min=1.0)
    assert float(found.max()) < 1e-3
    assert float(whole.real.max()) == pytest.approx(float(some.real.max()), abs=0.05)


def test_steps_are_held_against_the_modes():
    """With less damping the paper's loops swing with 600 rad/s: five steps a period are 2 ms."""
    paper = coarse(RigFile.ready("paper"))
    paper = shorter(changed(paper, materials__rubber__tau=2e-3), 1.0)
    for h, coarse_steps in ((1e-3, False), (4e-3, True)):
        said = [one.message for one in check(paper.override(solver={"step": h}))]
        assert any("a mode of the rig swings with" in one for one in said) == coarse_steps


def test_a_body_that_flies_is_told_of_coarse_steps():
    file = coarse(
        RigFile.ready("drop"),
        solver={"step": 0.05},
    )
    assert any("a body comes flying and may be through a pad" in one.message for one in check(file))


# motions
# ----------------------------------------------------------------------


def motion(
    table: dict[str, Any], folder: Path | None = None, duration: float = 2.0
) -> Callable[[float], float]:
    """A motion of the template's bracket in x, as a function of time."""
    file = changed(coarse(template("t")), motion__x_d=table, outputs__duration=duration)
    file._folder = folder or Path()
    signal = file.build().rig.reference["x_d"]
    return lambda t: float(signal(torch.tensor(t, dtype=torch.float64))[0].detach())


def test_a_hardness_stands_for_a_modulus(tmp_path, monkeypatch, capsys):
    """With a note of which; `init` begins with a rubber of the literature."""
    monkeypatch.chdir(tmp_path)
    tree = template("t").model_dump(exclude_unset=True)
    del tree["materials"]["rubber"]["E"]
    tree["materials"]["rubber"]["shore_a"] = 30
    stated = r"shore_a = 30 is taken for E = 1\.14 MPa, the estimate"
    with pytest.warns(UserWarning, match=stated) as caught:
        file = RigFile.from_tree(tree)
    assert caught[0].filename == __file__  # through pydantic
    assert file.materials["rubber"].build(tmp_path).E.item() == from_shore_a(30)
    assert (
        file.override(materials={"rubber": {"E": 1e6}}).assemble().parameter("materials.rubber.E")
        == 1e6
    )
    for wrong, sentence in ((90, "hardness must be from 20 to 80"), ("a", r"a number \[Shore A\]")):
        tree["materials"]["rubber"]["shore_a"] = wrong
        with pytest.raises(ValueError, match=rf"materials\.rubber: shore_a: .*{sentence}"):
            RigFile.from_tree(tree)
    assert main(["init", "skin", "--material", "Dragon Skin 30"]) == 0
    assert RigFile.from_toml("skin.toml").build().rig.parameter(
        "materials.rubber.E"
    ) == from_shore_a(30)
    assert main(["init", "other", "--material", "Dragon"]) == 2
    assert "did you mean `Dragon Skin 30`?" in capsys.readouterr().err


def test_motions_go_through_what_they_are_given(tmp_path):
    (tmp_path / "x.csv").write_text(
        "\ufefft [ms], note [mm], x_d [mm]\n0,7,1\n500,,2\n1000,7,4\n", encoding="utf-8"
    )
    (tmp_path / "y.csv").write_text("Time (ms),Stage x (mm)\n0,1\n500,2\n1000,4\n")
    (tmp_path / "clock.csv").write_text(
        "t [ms],x_d [mm]\n1700000000000,1\n1700000000500,2\n1700000001000,4\n"
    )
    knots = {"times": (0.2, 1.0), "values": ("start", 5e-3)}
    for table, expected in (
        ({"kind": "hold"}, {0.0: 0.0, 1.0: 0.0}),
        ({"kind": "hold", "value": 2e-3}, {1.0: 2e-3}),
        ({"kind": "profile", **knots}, {0.0: 0.0, 0.2: 0.0, 0.6: 2.5e-3, 1.0: 5e-3, 2.0: 5e-3}),
        ({"kind": "spline", **knots}, {0.0: 0.0, 0.2: 0.0, 0.6: 2.5e-3, 1.0: 5e-3, 2.0: 5e-3}),
        ({"kind": "sines", "components": [{"amplitude": 1e-3, "frequency": 2.0}]},
        {0.0: 0.0, 1.125: 1e-3, 2.0: 0.0}),
        ({"kind": "chirp", "amplitude": 1e-3, "first": 1.0, "last": 1.0, "since": 0.5},
        {0.5: 0.0, 1.25: 1e-3 * math.sin(1.5 * math.pi), 1.0: 0.0}),
        ({"kind": "csv", "file": "x.csv", "column": "x_d", "offset": 1e-3},
        {0.0: 2e-3, 0.5: 3e-3, 1.0: 5e-3, 2.0: 5e-3}),
        ({"kind": "csv", "file": "y.csv", "column": "Stage x", "time": "Time"},
        {0.0: 1e-3, 0.5: 2e-3, 1.0: 4e-3}),
        ({"kind": "csv", "file": "clock.csv", "column": "x_d", "from_first": True, "scale": -2.0,
          "offset": 1e-3}, {0.0: -1e-3, 0.5: -3e-3, 1.0: -7e-3}),
    ):  # fmt: skip
        x = motion(table, tmp_path)
        for time, value in expected.items():
            assert x(time) == pytest.approx(value, abs=1e-9), (table["kind"], time)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("t [s],x_d [mm]\n0,0\n1,1\n", r"x\.csv ends at 1 s, but the run lasts until 2 s"),
        (
            "t [s],x [mm]\n0,0\n1,1\n",
            r"x\.csv has no column `x_d \[m\]`, in this unit .*; it has `t`, `x`; .* in `column`",
        ),
        (
            "Time (s),x_d (m)\n0,0\n1,1\n",
            r"x\.csv has no column `t \[s\]`, .*; it has `x_d`, `Time`; say which one in `time`",
        ),
        (
            "t [s],x_d [N]\n0,0\n1,1\n",
            r"row 1, column `x_d` cannot be in 'N'; it can be in m, cm, mm",
        ),
        ("t [s],x_d [mm]\n0,0\n1,\n", r"row 3, column `x_d` is empty"),
        ("t [s],x_d [mm]\n1,0\n0,1\n", r"row 3, column `t`: 0 s follows 1 s; times must increase"),
        ("t [s],x_d [mm]\n0,0\n", r"has 1 rows of numbers"),
        (
            "t [s],x_d [mm]\n1.7e9,0\n1.7000001e9,1\n",
            r"begins at 1\.7e\+09 s, and the run ends at 2 s: where its times are of a clock, say "
            r"from_first = true",
        ),
    ],
)
def test_a_recorded_motion_that_cannot_be_is_named(tmp_path, text, sentence):
    (tmp_path / "x.csv").write_text(text, encoding="utf-8")
    file = changed(
        coarse(template("t")), motion__x_d={"kind": "csv", "file": "x.csv", "column": "x_d"}
    )
    file._folder = tmp_path
    (first, *_) = check(file)
    assert first.severity == "error"
    assert first.where == "motion.x_d.file"
    assert re.search(sentence, first.message), first.message


@pytest.mark.parametrize(
    ("text", "where", "sentence"),
    [
        (
            "t [s],x_d [mm]\n" + "".join(f"{0.01 * i},{round(0.03 * i, 1)}\n" for i in range(250)),
            "motion.x_d.file",
            r"in steps of 0\.0001 m, as of an encoder: rates .* by 0\.01 m/s",
        ),
        ("t [s],x_d [m]\n0,0\n1000,1e-3\n2000,0\n", "motion.x_d.file", r"lasts 2000 s.*millisec"),
        ("t [s],x_d [m]\n0,0\n1,12\n2,0\n", "motion.x_d", r"goes 12 m, .* is it in millimetres"),
    ],
)
def test_units_that_cannot_be_meant_are_asked_about(tmp_path, text, where, sentence):
    (tmp_path / "x.csv").write_text(text, encoding="utf-8")
    csv = {"kind": "csv", "file": "x.csv", "column": "x_d"}
    file = changed(coarse(template("t")), motion__x_d=csv)
    file._folder = tmp_path
    (found,) = (one for one in check(file) if one.where == where)
    assert found.severity == "warning"
    assert re.search(sentence, found.message), found.message


def test_a_body_too_heavy_to_rest_is_named_with_its_weight():
    (found,) = check(changed(coarse(template("t")), bodies__disc__mass=400.0))
    assert found.where == "bodies.disc.start.y"
    assert "no rest under its weight of 3.92e+03 N is found" in found.message


def test_what_two_pads_grip_is_taken_along():
    """The estimate before a run: fingertips go around a box that they hold, and the box with them;
    the run agrees."""
    file = RigFile.ready("fingertips")
    estimate = Estimate(file, file.build())
    for time, angle in ((2.0, -0.6), (3.4, 0.6), (4.4, 0.0)):
        box = estimate(time)["box"]
        assert box == pytest.approx([0.0, 45e-3, angle], abs=2e-4)
    assert estimate(0.5)["box"][1] < 22e-3  # not lifted yet


def test_driven_jaws_carry_a_disc():
    """Coordinates driven in x, y and theta, without a loop; the pads settle around a start that is
    a grasp."""
    jaw = {"x": "driven", "y": "driven", "theta": "driven"}
    tree = coarse(template("t")).model_dump(exclude_unset=True)
    tree["bodies"]["bracket"] = jaw
    tree["bodies"]["disc"]["start"] = {"x": 0.3e-3, "y": 24.5e-3}
    tree["actuators"] = {}
    tree["motion"] = {
        "bracket": {
            "x": {"kind": "profile", "times": [0.0, 0.2], "values": [0.0, 4e-3]},
            "y": {"kind": "hold", "value": 49e-3}, "theta": {"kind": "hold", "value": 0.0},
        }
    }  # fmt: skip
    tree["outputs"] = {"duration": 0.25}
    file = RigFile.from_tree(tree)
    run = running.carry_out(file).trajectory
    assert float(run.force["upper"][0, :, 0].sum()) > 10.0  # it starts pressed
    assert float(run["x_disc"][-1]) == pytest.approx(2.3e-3, abs=2e-4)
    assert run.units["bracket.x"] == "m"
    assert "drive_bracket" in run.supplied


@pytest.mark.parametrize(
    "name",
    [
        "template",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("light_grasp", "orientation")),
    ],
)
def test_efforts_ripple_by_less_than_a_twentieth(name):
    """A body that rolls from contact point to contact point: twice the points an element change no
    effort by more than 5 % of its peak."""
    if name == "template":
        file = template("rolls").override({"outputs.duration": 1.0})
    else:
        file = RigFile.ready(name)
    twice = {f"pads.{pad}.points": 2 * table.points or 2 for pad, table in file.pads.items()}
    run, finer = (one.build().run() for one in (file, file.override(twice)))
    for actuator in run.setup.actuators.values():
        effort, other = run[actuator.channel], finer[actuator.channel]
        assert float((effort - other).abs().max()) < 0.05 * float(other.abs().max())


def test_orientation_is_controlled_through_another_body():
    """A loop that measures the disc's angle and pushes the bracket sideways; the other way round it
    is unstable."""
    loop = {
        "pushes": "bracket.x",
        "measures": "disc.theta",
        "setpoint": "w",
        "Kp": 1000.0,
        "Kd": 4.0,
        "reversed": True,
    }
    tree = coarse(template("t")).model_dump(exclude_unset=True)
    tree["actuators"]["x"] = loop
    tree["motion"] |= {"w": {"kind": "profile", "times": (0.5, 1.0), "values": ("start", 0.3)}}
    del tree["motion"]["x_d"]
    tree["outputs"] = {"duration": 1.3, "interval": 0.05}
    early = RigFile.model_validate(tree)  # before they touch
    assert any("nothing that touches ties disc.theta" in one.message for one in check(early))
    tree["bodies"]["bracket"]["start"]["y"] = 49.5e-3
    tree["motion"]["y_d"] = {"kind": "hold"}
    file = RigFile.model_validate(tree)
    assert {one.severity for one in check(file)} == {"note"}
    run = running.carry_out(file).trajectory
    assert float(run["theta_disc"][-1]) == pytest.approx(0.3, abs=5e-3)
    assert float(run["x_bracket"][-1]) < -8e-3
    wrong = file.override(actuators={"x": {"reversed": False}})
    assert "the rig is unstable" in check(wrong)[0].message


# starts and estimates
# ----------------------------------------------------------------------


@pytest.mark.parametrize("inertial", [False, True])
def test_a_body_rests_where_nothing_accelerates_it(inertial):
    file = coarse(template("t"), pads={"lower": {"inertial": inertial}})
    ready = file.build()
    rate = ready.rig.unpack(ready.rig(0.0, ready.y0)).velocity["disc"]
    assert float(rate[1].detach().abs()) < 1e-5
    hovering = changed(file, bodies__disc__start__y=60e-3).build()
    assert float(hovering.y0[hovering.rig.layout.slices["pads", "lower"]].abs().max()) == 0.0


@torch.no_grad()
def test_a_body_comes_down_to_its_rest_from_far_above_and_in_every_coordinate():
    file = coarse(RigFile.ready("drop"))
    rig = file.build().rig
    pose = {"ellipse": f64(60.2e-3, 30e-3, 0.1)}
    found = resting(rig, pose)["ellipse"]
    rate = rig(0.0, standing(rig, {"ellipse": found}))[rig.layout.rigid[3:]]
    assert float(rate.detach().abs().max()) < 1e-4
    assert float(found[2]) == pytest.approx(0.0, abs=1e-6)  # on its broad side


def test_the_estimate_by_statics_is_where_the_run_ends():
    file = coarse(template("t"))
    ready = file.build()
    expected = Estimate(file, ready).balanced(0.45)
    run = running.carry_out(shorter(file, 0.45)).trajectory
    for name in ("disc", "bracket"):
        assert float(run[f"y_{name}"][-1]) == pytest.approx(expected[name][1], abs=3e-5)


# writing and running
# ----------------------------------------------------------------------


@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_what_is_written_is_what_was_read(path):
    file = RigFile.from_toml(path)
    again = RigFile.from_tree(tomllib.loads(to_toml(file)))
    assert again.model_dump() == file.model_dump()


def test_the_file_to_start_from_is_a_rig_with_a_comment_on_every_number(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    assert main(["init", str(path.with_suffix(""))]) == 0
    text = path.read_text(encoding="utf-8")
    assert RigFile.from_toml(path).model_dump() == template("mine").model_dump()
    rows = [row for row in text.splitlines() if re.match(r"(# )?\w+ = ?\S*$|.*  # ", row)]
    assert [row for row in rows if "  # " not in row and " # " not in row[2:]] == []
    for word in ("[kg]", "[m]", "[Pa]", "[N.s/m]", "[s]", "# inertial = ", "# step ="):
        assert word in text
    assert main(["init", str(path)]) == 2
    assert f"{path} is there already" in capsys.readouterr().err
    assert [one for one in check(coarse(RigFile.from_toml(path))) if one.severity != "note"] == []


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("v1.2", "v1.2.toml"),
        ("v1.2.toml", "v1.2.toml"),
        ("my rig", "my rig.toml"),
        ("new/folder/.x", "new/folder/.x.toml"),
    ],
)
def test_the_file_to_start_from_has_the_name_that_was_asked_for(
    name, file, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(["init", name]) == 0
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / file]
    assert RigFile.from_toml(file).title == Path(file).stem
    said = (
        capsys.readouterr().out.removeprefix(f"written to {file}; ").partition(" looks it over, ")
    )
    commands = [shlex.split(text) for text in (said[0], said[2].removesuffix(" simulates it\n"))]
    assert commands == [["torchsoft", "check", file], ["torchsoft", "run", file]]


@pytest.mark.parametrize("name", ["", ".", "..", "a/", "a/..", ".toml", "/"])
def test_a_name_that_is_no_files_is_refused(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["init", name]) == 2
    expected = (
        "torchsoft: error: NAME should be the name of a file, such as mine or mine.toml, not "
        f"{name!r}\n"
    )
    assert capsys.readouterr().err == expected
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A rig file that runs in no time."""
    path = tmp_path_factory.mktemp("rig") / "small.toml"
    path.write_text(to_toml(shorter(coarse(template("small")), 0.1)), encoding="utf-8")
    return path


def test_run_writes_everything(small, tmp_path, capsys):
    assert main(["run", str(small), "--out", str(tmp_path / "out"), "--no-progress"]) == 0
    out, err = capsys.readouterr()
    assert "0.1 s simulated" in out
    assert "note: actuators: stable" in err
    names = {path.name for path in (tmp_path / "out").iterdir()}
    figures = {f"{name}.png" for name in ("snapshots", "dashboard")}
    assert names == {"trajectory.nc", "summary.json", "video.gif", "player.html"} | figures
    for name in figures:
        with Image.open(tmp_path / "out" / name) as picture:
            assert np.ptp(np.asarray(picture.convert("L"))) > 100
    with Image.open(tmp_path / "out" / "video.gif") as video:
        assert video.n_frames == 3
    data = load(tmp_path / "out" / "trajectory.nc")
    assert data["y_disc"].attrs["units"] == data["y_d"].attrs["units"] == "m"
    assert data["effort_y"].attrs["units"] == data["press"].attrs["units"] == "N"
    assert data["x_d_dot"].attrs["units"] == "m/s"
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["stopped"] is None
    assert summary["doubts"] == []
    assert summary["energy"]["worst_imbalance_over_injected"] < 1e-3
    assert (
        RigFile.model_validate_json(json.dumps(summary["file"])).model_dump()
        == RigFile.from_toml(small).model_dump()
    )
    few = RigFile.from_toml(small).override(
        outputs={"figures": False, "player": True, "video": "none"}
    )
    running.run(few, tmp_path / "few")
    names = {path.name for path in (tmp_path / "few").iterdir()}
    assert names == {"trajectory.nc", "summary.json", "player.html"}


def test_what_is_wrong_is_not_run_unless_it_is_meant(small, tmp_path, capsys):
    path = tmp_path / "wrong.toml"
    wrong = changed(RigFile.from_toml(small), bodies__stone=STONE, outputs__video="none")
    path.write_text(to_toml(changed(wrong, outputs__figures=False)), encoding="utf-8")
    assert main(["check", str(path)]) == 2
    assert "error: bodies.disc: it and bodies.stone overlap" in capsys.readouterr().out
    assert main(["run", str(path), "--out", str(tmp_path / "out"), "--no-progress"]) == 2
    assert "wrong.toml is not run; fix what is wrong, or say --anyway" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert (
        main(["run", str(path), "--out", str(tmp_path / "out"), "--no-progress", "--anyway"]) == 0
    )
    assert "bodies.stone overlap" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"trajectory.nc", "summary.json"}


def test_where_results_cannot_be_written_nothing_is_run(small, tmp_path, monkeypatch, capsys):
    monkeypatch.delattr(running, "simulate")
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    for out in (tmp_path / "taken", tmp_path / "taken" / "out"):
        assert main(["run", str(small), "--out", str(out), "--no-progress"]) == 2
        assert f"error: --out: results cannot be written to {out} (" in capsys.readouterr().err
        with pytest.raises(OSError, match="taken"):
            running.run(RigFile.from_toml(small), out)
    assert (tmp_path / "taken").read_text(encoding="utf-8") == "mine"


def test_an_interruption_keeps_what_was_simulated(small, tmp_path, monkeypatch, capsys):
    def interrupted(*args: Any, **options: Any) -> None:
        raise Interrupted(simulate(*args, **options))

    monkeypatch.setattr(running, "simulate", interrupted)
    assert main(["run", str(small), "--out", str(tmp_path), "--no-progress"]) == 130
    assert "interrupted; what was simulated until then is in" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"trajectory.nc", "summary.json"}
    assert (
        json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["stopped"]
        == "interrupted"
    )


def test_a_failure_keeps_what_was_simulated(small, tmp_path, capsys):
    """A disc thrown off its pad."""
    path = tmp_path / "thrown.toml"
    file = changed(
        RigFile.from_toml(small), bodies__disc__start__v_x=3.0, bodies__bracket__start__y=90e-3
    )
    path.write_text(
        to_toml(changed(file, motion__y_d__values=("start", "start"))), encoding="utf-8"
    )
    assert (
        main(["run", str(path), "--out", str(tmp_path / "out"), "--no-progress", "--anyway"]) == 2
    )
    assert "was lost" in capsys.readouterr().err
    assert (
        "was lost"
        in json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["stopped"]
    )


def test_pads_that_let_go_are_noted():
    """A set-point that was right for another body lifts the upper pad off this one."""
    file = changed(template("t"), motion__y_d__values=("start", 72e-3))
    (note,) = (one for one in check(file) if "let go" in one.message or "never" in one.message)
    assert note.where == "contacts.upper"
    knots = {"kind": "profile", "times": (0.0, 0.4, 1.0), "values": ("start", 49e-3, 72e-3)}
    pressed = changed(template("t"), motion__y_d=knots)
    (note,) = (one for one in check(pressed) if "let go" in one.message)
    assert (note.severity, note.where) == ("note", "contacts.upper")
    assert re.search(r"at t = .* s they are 2\d\.\d mm apart from it", note.message)


def test_a_part_that_is_called_alike_is_asked_about():
    with pytest.raises(
        ValueError, match=r"materials\.rubbr\.kind is missing; did you mean mat.*er"
    ):
        template("t").override(materials={"rubbr": {"E": 1e6}})
    with pytest.raises(ValueError, match=r"bodies\.disk: .*; did you mean bodies\.disc\?"):
        template("t").override(bodies={"disk": {"mass": 1.0}})


SQUARE = {"kind": "rounded_box", "half_width": 20e-3, "half_height": 20e-3, "radius": 3e-3}
BOX = {"shape": SQUARE, "start": {"theta": "rest"}}


@pytest.mark.parametrize(
    ("disc", "far", "press", "mu", "where"),
    [
        (BOX, 20e-3, -30.0, 0.7, {"bodies.disc"}),  # the run: 95 % of a pad's height
        (BOX, 10e-3, -30.0, 0.7, {"bodies.disc"}),  # 56 %
        (BOX, 2e-3, -30.0, 0.7, set()),  # 13 %
        (BOX, 20e-3, -30.0, 0.2, set()),  # it slides: 11 %
        ({"theta": 0.0}, 20e-3, -200.0, 0.7, {"pads.lower", "pads.upper"}),  # 53 %
        ({"theta": 0.0}, 20e-3, -30.0, 0.7, set()),  # 20 %
        ({}, 20e-3, -300.0, 0.7, set()),  # it rolls: 22 %
    ],
)  # fmt: skip
def test_pads_that_are_moved_along_a_body_that_cannot_roll_are_warned_about(
    disc, far, press, mu, where
):
    few = {"elements_x": 40, "elements_y": 2}
    file = template("t").override(
        pads={"lower": few, "upper": few}, bodies={"disc": disc},
        laws={"dry": {"friction": {"mu_s": mu, "mu_k": mu}}},
        motion={"x_d": {"values": ("start", far)}, "press": {"values": (0.0, press)}},
    )  # fmt: skip
    found = [one for one in check(file) if one.severity == "warning"]
    assert {one.where for one in found} == where
    assert all("cannot roll" in one.message for one in found)
