"""Rig files: the ready ones, their motions and starts, what is written, and the commands `init`,
`check` and `run`."""

import json
import math
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import f64, holding_force, press, still
from PIL import Image
from test_check import STONE

from torchsoft import RigFile
from torchsoft.cli import main
from torchsoft.materials.presets import from_shore_a
from torchsoft.physics.statics import resting, standing
from torchsoft.rigs import run as running
from torchsoft.rigs.build import ready
from torchsoft.rigs.check import check
from torchsoft.rigs.written import template, to_toml
from torchsoft.solve.diagnostics import linearised, modes
from torchsoft.solve.netcdf import load


def coarse(file: RigFile, values: dict[str, Any] | None = None) -> RigFile:
    """The rig on a mesh half as fine, changed."""
    pads = {
        name: {"elements_around": pad.elements_around // 2}
        if pad.kind == "fingertip"
        else {"elements_x": max(16, pad.elements_x // 2), "elements_y": 2}
        for name, pad in file.pads.items()
    }
    return file.override(pads=pads).override(values)


def shorter(file: RigFile, duration: float) -> RigFile:
    return file.override(outputs={"duration": duration, "snapshots": (), "frames": 3})


def doubts(file: RigFile) -> list[str]:
    return [str(one) for one in check(file) if one.severity != "note"]


# ready rigs
# ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ready())
def test_a_ready_rig_checks_clean(name):
    assert doubts(coarse(RigFile.ready(name))) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ready())
def test_a_ready_rig_runs_to_its_end(name):
    file = RigFile.ready(name)
    assert doubts(file) == []
    assert file.build().run().energy_residual_rel < 1e-3


def test_what_is_held_is_the_papers_grasping_force():
    """Fed forward, it is that of the friction-free grasp, and the bracket comes down to touch the
    disc wherever this is; both by statics."""
    file = coarse(RigFile.ready("paper"), {
        "motion.F_ff.values": (0.0, "held"), "materials.rubber.E": 0.6e6,
        "bodies.disc.start.x": 60.3e-3, "bodies.bracket.start.x": 60.3e-3,
        "motion.x_d": {"kind": "hold"},
    })  # fmt: skip
    built = file.build()
    force, _ = built.rig.reference["F_ff"](f64(1.0)[0])
    held = holding_force(built.rig, press(built.rig, 48.6e-3, 60.3e-3))
    assert float(force) == pytest.approx(-held, rel=1e-9)
    state = built.rig.unpack(built.y0)
    assert -1e-15 < float(built.rig.penetration("U", state).max().detach()) <= 0.0
    with pytest.raises(ValueError, match=r'bracket\.start\.y: "touch", but no pad bonded to it'):
        file.override({"bodies.bracket.start.x": 1.0}).build()


def test_a_drop_is_not_missed():
    """Steps chosen by tolerance would be through the pad; the first touch is where free fall
    says."""
    file = coarse(shorter(RigFile.ready("drop"), 0.3), {"outputs.interval": 1e-3})
    run = file.build().run()
    y, force = run["y_ellipse"], run.force["ground"][..., 0].sum(-1)
    touch = int((force > 0).nonzero()[0])
    s = file.bodies["ellipse"].start
    fallen = s.y - 0.5 * 9.81 * run.t[:touch] ** 2
    assert torch.allclose(y[:touch], fallen, rtol=0, atol=1e-7)
    reach = math.hypot(18e-3 * math.sin(0.5), 11e-3 * math.cos(0.5))
    assert float(y[touch]) == pytest.approx(12e-3 + reach, abs=1.2e-3)
    assert float(y.min()) > 12e-3 + 9e-3  # it lies on the pad


# modes
# ----------------------------------------------------------------------


def test_modes_are_those_of_the_whole_state():
    """What is left out where nothing touches decides nothing."""
    model = still({"pad.elements_x": 40, "pad.elements_y": 1})
    y = press(model)
    whole = torch.linalg.eigvals(linearised(model, y, model.reference))
    some = modes(model, y, model.reference).values
    found = (some[:, None] - whole).abs().amin(1) / some.abs().clamp(min=1.0)
    assert float(found.max()) < 1e-3
    assert float(whole.real.max()) == pytest.approx(float(some.real.max()), abs=0.05)


# motions
# ----------------------------------------------------------------------

KNOTS = {"times": (0.2, 1.0), "values": ("start", 5e-3)}
PASSED = {0.0: 0.0, 0.2: 0.0, 0.6: 2.5e-3, 1.0: 5e-3, 2.0: 5e-3}
STROKES = {"kind": "strokes", "since": 0.5, "stroke_time": 0.2, "travel": -1e-3, "until": 1.2}
CHIRP = {"kind": "chirp", "amplitude": 1e-3, "first": 1.0}
CSV = {"kind": "csv", "file": "x.csv", "column": "x_d"}

MOTIONS = [
    ({"kind": "hold"}, {0.0: 0.0, 1.0: 0.0}, ""),
    ({"kind": "hold", "value": 2e-3}, {1.0: 2e-3}, ""),
    ({"kind": "profile", **KNOTS}, PASSED, ""),
    ({"kind": "spline", **KNOTS}, PASSED, ""),
    (STROKES, {0.5: 0.0, 0.6: -0.5e-3, 0.7: -1e-3, 0.9: 0.0, 1.1: -1e-3, 1.3: -1e-3}, ""),
    ({"kind": "sines", "components": [{"amplitude": 1e-3, "frequency": 2.0}]},
     {0.0: 0.0, 1.125: 1e-3, 2.0: 0.0}, ""),
    (CHIRP | {"last": 1.0, "since": 0.5},
     {0.5: 0.0, 1.25: 1e-3 * math.sin(1.5 * math.pi), 1.0: 0.0}, ""),
    (CHIRP | {"last": 3.0},  # the phase is 2 pi (t + 0.5 t^2) within 2 s
     {0.5: 1e-3 * math.sin(1.25 * math.pi), 1.5: 1e-3 * math.sin(5.25 * math.pi)}, ""),
    (CSV | {"offset": 1e-3}, {0.0: 2e-3, 0.5: 3e-3, 1.0: 5e-3, 2.0: 5e-3},
     "\ufefft [ms], note [mm], x_d [mm]\n0,7,1\n500,,2\n1000,7,4\n"),
    (CSV | {"column": "Stage x", "time": "Time"}, {0.0: 1e-3, 0.5: 2e-3, 1.0: 4e-3},
     "Time (ms),Stage x (mm)\n0,1\n500,2\n1000,4\n"),
    (CSV | {"from_first": True, "scale": -2.0, "offset": 1e-3},
     {0.0: -1e-3, 0.5: -3e-3, 1.0: -7e-3},
     "t [ms],x_d [mm]\n1700000000000,1\n1700000000500,2\n1700000001000,4\n"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "expected", "csv"), MOTIONS)
def test_a_motion_goes_through_what_it_is_given(table, expected, csv, tmp_path):
    (tmp_path / "x.csv").write_text(csv, encoding="utf-8")
    file = coarse(template("t"), {"motion.x_d": table, "outputs.duration": 2.0})
    file._folder = tmp_path
    values, _ = file.build().rig.reference["x_d"](f64(*expected))
    assert values.tolist() == pytest.approx([*expected.values()], abs=1e-9)


def test_a_hardness_stands_for_a_modulus():
    """With a warning of which."""
    tree = template("t").model_dump(exclude_unset=True)
    rubber = tree["materials"]["rubber"]
    del rubber["E"]
    rubber["shore_a"] = 30
    with pytest.warns(UserWarning, match=r"shore_a = 30 is taken for E = 1\.14 MPa") as caught:
        file = RigFile.from_tree(tree)
    assert caught[0].filename == __file__  # through pydantic
    assert file.assemble().parameter("materials.rubber.E") == from_shore_a(30)
    for rubber["shore_a"] in (90, "a"):
        with pytest.raises(ValueError, match=r"rubber: shore_a: .*(20 to 80|number \[Shore A\])"):
            RigFile.from_tree(tree)


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


# starts
# ----------------------------------------------------------------------


@torch.no_grad()
def test_a_body_comes_down_to_its_rest_from_far_above_and_in_every_coordinate():
    rig = coarse(RigFile.ready("drop")).build().rig
    found = resting(rig, {"ellipse": f64(60.2e-3, 30e-3, 0.1)})["ellipse"]
    rate = rig(0.0, standing(rig, {"ellipse": found}))[rig.layout.rigid[3:]]
    assert float(rate.detach().abs().max()) < 1e-4
    assert float(found[2]) == pytest.approx(0.0, abs=1e-6)  # on its broad side


# writing
# ----------------------------------------------------------------------


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


@pytest.mark.parametrize("name", ["v1.2", "my rig.toml", "new/.x"])
def test_the_first_file_has_the_name_that_was_asked_for(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = name.removesuffix(".toml") + ".toml"
    assert main(["init", name]) == 0
    assert RigFile.from_toml(file).title == Path(file).stem
    words = shlex.split(capsys.readouterr().out)
    assert words[words.index("check") + 1] == file  # what to do next, as a shell takes it


@pytest.mark.parametrize("name", ["", "..", "a/", ".toml"])
def test_a_name_that_is_no_files_is_rejected(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["init", name]) == 2
    assert re.search(rf"NAME should be .* mine\.toml, not {name!r}", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


# commands
# ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A rig file that runs in no time."""
    path = tmp_path_factory.mktemp("rig") / "small.toml"
    path.write_text(to_toml(shorter(coarse(template("small")), 0.1)), encoding="utf-8")
    return path


def ran(file: Path, out: Path, *options: str) -> int:
    return main(["run", str(file), "--out", str(out), "--no-progress", *options])


def summary(out: Path) -> dict[str, Any]:
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_run_writes_everything(small, tmp_path, capsys):
    assert ran(small, tmp_path / "out") == 0
    out, err = capsys.readouterr()
    assert "0.1 s simulated" in out
    assert "note: actuators: stable" in err
    figures = {"snapshots.png", "dashboard.png"}
    always = {"trajectory.nc", "summary.json"}
    assert names(tmp_path / "out") == {"video.gif", "player.html"} | always | figures
    for name in figures:
        with Image.open(tmp_path / "out" / name) as picture:
            assert np.ptp(np.asarray(picture.convert("L"))) > 100
    with Image.open(tmp_path / "out" / "video.gif") as video:
        assert video.n_frames == 3
    assert load(tmp_path / "out" / "trajectory.nc")["effort_y"].attrs["units"] == "N"
    found = summary(tmp_path / "out")
    assert found["stopped"] is None
    assert found["doubts"] == []
    assert found["energy"]["worst_imbalance_over_injected"] < 1e-3
    assert RigFile.from_tree(found["file"]).model_dump() == RigFile.from_toml(small).model_dump()
    few = {"figures": False, "player": True, "video": "none"}
    running.run(RigFile.from_toml(small).override(outputs=few), tmp_path / "few")
    assert names(tmp_path / "few") == always | {"player.html"}


def test_what_is_wrong_is_not_run_unless_it_is_meant(small, tmp_path, capsys):
    path, out = tmp_path / "wrong.toml", tmp_path / "out"
    quiet = {"video": "none", "figures": False}
    wrong = RigFile.from_toml(small).override(**tomllib.loads(STONE), outputs=quiet)
    path.write_text(to_toml(wrong), encoding="utf-8")
    assert main(["check", str(path)]) == 2
    assert "error: bodies.disc: it and bodies.stone overlap" in capsys.readouterr().out
    assert ran(path, out) == 2
    assert "wrong.toml is not run; fix what is wrong, or use --anyway" in capsys.readouterr().err
    assert not out.exists()
    assert ran(path, out, "--anyway") == 0
    assert "bodies.stone overlap" in capsys.readouterr().err
    assert names(out) == {"trajectory.nc", "summary.json"}


def test_a_failure_keeps_what_was_simulated(small, tmp_path, capsys):
    """A disc thrown off its pad, and one that starts outside the space over it."""
    thrown = RigFile.from_toml(small).override({
        "bodies.disc.start.v_x": 3.0, "bodies.bracket.start.y": 90e-3,
        "motion.y_d.values": ("start", "start"),
    })  # fmt: skip
    for name, file in {
        "thrown": thrown,
        "outside": RigFile.from_toml(small).override({"pads.upper.origin": (5.0, 0.0)}),
    }.items():
        path, out = tmp_path / f"{name}.toml", tmp_path / name
        path.write_text(to_toml(file), encoding="utf-8")
        assert ran(path, out, "--anyway") == 2
        assert "was lost" in capsys.readouterr().err
        assert "was lost" in summary(out)["stopped"]
        assert (summary(out)["simulated_s"] > 0) == (name == "thrown")


def test_a_part_with_a_similar_name_is_suggested():
    with pytest.raises(ValueError, match=r"rubbr\.kind is missing; did you mean mat.*er"):
        template("t").override(materials={"rubbr": {"E": 1e6}})
    with pytest.raises(ValueError, match=r"bodies\.disk: .*; did you mean bodies\.disc\?"):
        template("t").override(bodies={"disk": {"mass": 1.0}})
