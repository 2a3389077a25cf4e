"""Identification of the rig that a rig file describes, by the names of that file."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.rigs.build import RigFile
from torchsoft.sysid import (
    Problem,
    load_answer,
)
from torchsoft.sysid.columns import wraps
from torchsoft.sysid.measured import load
from torchsoft.sysid.prediction import Frozen
from torchsoft.sysid.runs import since

RIG = RigFile.path("two_fingers")
SENSORS = {"x_disc": 10e-6, "y_disc": 10e-6, "x_left": 10e-6, "effort_left_x": 0.05}
TRUTH = {"materials.silicone.E": 0.45e6, "actuators.left_x.Kd": 180.0}
FIT = """
rig = "rig.toml"
start = {kind = "rest", lead = 0.0}
columns.camera = "x_disc"
[settings]
pads.table.elements_x = 25
pads.left_tip.elements_x = 18
pads.right_tip.elements_x = 18
[unknowns]
"materials.silicone.E" = {}
"actuators.left_x.Kd" = {}
[sensors]
x_disc.noise = 1e-5
y_disc.noise = 1e-5
x_left.noise = 1e-5
effort_left_x.noise = 0.05
"""
PLAN = FIT.replace(
    'start = {kind = "rest", lead = 0.0}',
    "rehearsal = {duration = 0.6, seed = 3}\n"
    'fit = {assumptions = "trusted", rtol = 1e-3, tightenings = 0}',
)


@pytest.fixture(scope="module")
def run():
    """The truth: the fingers close and lift the disc."""
    tips = {name: {"elements_x": 18} for name in ("left_tip", "right_tip")}
    file = RigFile.ready("two_fingers").override(TRUTH, pads={"table": {"elements_x": 25}} | tips)
    rig, y0, _ = file.build()
    return simulate(rig, torch.linspace(0, 1.2, 241, dtype=torch.float64), y0=y0, rtol=1e-5)


@pytest.fixture
def folder(tmp_path, run):
    """The rig's file, a recording, and what is to be found."""
    noise = np.random.default_rng(1)
    (tmp_path / "rig.toml").write_text(RIG.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "fit.toml").write_text(FIT, encoding="utf-8")
    columns = [run[name].numpy() + sd * noise.standard_normal(241) for name, sd in SENSORS.items()]
    head = "t (s),camera (mm),y_disc [mm],x_left [mm],effort_left_x [N]"
    table = np.stack([run.t.numpy(), *(1e3 * x for x in columns[:3]), columns[3]], 1)
    np.savetxt(tmp_path / "run.csv", table, "%.9g", ",", header=head, comments="")
    return tmp_path


def changed(path: Any, change: Callable[[str], str]) -> None:
    text = path.read_text(encoding="utf-8")
    assert change(text) != text
    path.write_text(change(text), encoding="utf-8")


def replaced(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


def loaded(folder: Any) -> Problem:
    return load([folder / "run.csv"], folder / "fit.toml").problem


def with_column(folder: Any, heading: str, cells: list[str]) -> None:
    rows = (folder / "run.csv").read_text(encoding="utf-8").splitlines()
    text = "\n".join(f"{row},{cell}" for row, cell in zip(rows, [heading, *cells]))
    (folder / "run.csv").write_text(text, encoding="utf-8")


def test_frozen_steps_of_a_run_that_begins_earlier_or_later():
    knots = np.array([0.0, 4e-3, 0.01])
    earlier = since(Frozen(knots), -5e-3).knots
    assert earlier.tolist() == pytest.approx([-5e-3, -3e-3, -1e-3, 0.0, 4e-3, 0.01])
    assert np.array_equal(since(Frozen(earlier), 0.0).knots, knots)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("fit.toml", replaced('"x_disc"', '"x_dsc"'), "columns.camera = 'x_dsc' is no channel"),
        ("fit.toml", replaced("left_x.Kd", "left_x.Ki"), "`actuators.left_x.Ki` cannot be"),
        ("fit.toml", replaced("table.elements_x", "table.elements"), "settings.*`elements`"),
        ("rig.toml", replaced("mass = 0.25", "mas = 0.25"), "rig: .*`mas` is not known"),
        ("run.csv", replaced("camera", "x_disc"), "`x_disc` is not known"),
        (
            "fit.toml",
            replaced("[settings]", "[settings]\noutputs = {duration = 0.5, snapshots = []}"),
            "row 242, column `t`: 1.2 s is after the end of the file's own motions, 0.5 s",
        ),
        (
            "run.csv", lambda text: re.sub(r"(?m)^0\.?[01]?\d*,.*\n", "", text),
            "column `t`: a recording that begins at rest .* at 0 s, not at 1 s",
        ),
    ],
)  # fmt: skip
def test_files_that_a_rig_cannot_be_identified_from_are_rejected(folder, file, change, message):
    changed(folder / file, change)
    with pytest.raises(ValueError, match=message):
        loaded(folder)


@pytest.mark.parametrize(("heading", "low"), [("theta_disc", -180.0), ("eye", 0.0)])
def test_an_angle_that_wraps_is_named_and_unwrapped(folder, heading, low):
    """Jumps by a turn, across a missing sample too; angles of the recording are those turned."""
    turned = 500 * np.linspace(0, 1.2, 241) ** 2  # [deg], 1.2 turns and more
    column = [f"{(x - low) % 360 + low:.9g}" for x in turned]
    jump = int(np.argmax(turned >= 360 + low))
    column[jump - 1] = ""
    with_column(folder, f"{heading} [deg]", column)
    of = "" if heading == "theta_disc" else 'of = "theta_disc", '

    def stated(more):
        fit = FIT.replace("columns.cam", f"columns.{heading} = {{{of}{more}}}\ncolumns.cam")
        (folder / "fit.toml").write_text(fit, encoding="utf-8")

    stated("unwrap = false")
    shown = of and r" \(theta_disc\)"
    words = rf"row {jump + 2}, column `{heading}`{shown} jumps by a turn, .*{heading}.unwrap = "
    with pytest.raises(ValueError, match=words):
        loaded(folder)
    stated("unwrap = true")
    (made,) = loaded(folder).recordings
    kept = np.delete(turned, jump - 1)
    assert made.samples["theta_disc"][1] == pytest.approx(np.radians(kept), abs=1e-9)


def test_what_is_no_angle_is_not_unwrapped(folder):
    changed(folder / "fit.toml", replaced("columns.c", "columns.y_disc.unwrap = true\ncolumns.c"))
    with pytest.raises(ValueError, match=r"columns\.y_disc\.unwrap: `y_disc` is in m, and only"):
        loaded(folder)
    assert wraps(np.array([3.0, 3.1, -3.1, -3.0])).tolist() == [1]
    assert not len(wraps(10.0 * np.arange(9)))  # degrees taken for radians are another mistake


@pytest.mark.slow
def test_a_rehearsal_reports_what_an_experiment_would_identify(folder):
    """Its recording is a template of the real one: the same configuration accepts it."""
    plan, out = folder / "plan.toml", folder / "out"
    plan.write_text(PLAN, encoding="utf-8")
    assert main(["rehearse", f"{plan}", "--out", f"{out}", "--no-progress"]) == 0
    truth = {"materials.silicone.E": 0.5e6, "actuators.left_x.Kd": 150.0}
    for one in load_answer(out / "answer.json").estimates:
        assert abs(np.log(one.start / truth[one.name])) == pytest.approx(np.log(1.3))
        assert one.value == pytest.approx(truth[one.name], rel=4 * one.relative_sd)
    head, first, *rows = (out / "rehearsal.csv").read_text(encoding="utf-8").splitlines()
    assert head.startswith("t [s],left_close [m],left_lift [m],lean [rad]")
    assert "camera [m]" in head
    assert first.startswith("0,-0.024,")
    assert len(rows) == 120
    made = load([out / "rehearsal.csv"], plan).problem.recordings[0]
    assert made.samples["x_disc"][1].std() > 0


@pytest.mark.parametrize(
    ("change", "more", "message"),
    [
        (str, ("run.csv",), "a rehearsal makes its own data: leave .*run.csv out"),
        (
            replaced("effort_left_x.n", "effort_lft_x.n"), (),
            "`effort_lft_x` is not a channel of the rig of `rehearsal`; did you mean",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_rehearsed_is_rejected(folder, change, more, message, capsys):
    (folder / "plan.toml").write_text(change(PLAN), encoding="utf-8")
    files = [str(folder / name) for name in ("plan.toml", *more)]
    assert main(["rehearse", *files, "--out", str(folder / "out"), "--no-progress"]) == 2
    assert re.search(message, capsys.readouterr().err)
