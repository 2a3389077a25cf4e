"""Design of motions of a rig file: the candidates of a configuration, and knots that move."""

import json
import re
from typing import Any

import numpy as np
import pytest
import torch
from test_sysid_rigs import replaced

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.plan.knots import knots
from torchsoft.rigs import RigFile
from torchsoft.rigs.written import located
from torchsoft.sysid import Problem, design
from torchsoft.sysid.configuration import read_config
from torchsoft.sysid.design import AS_STATED, planned
from torchsoft.sysid.runs import Runner

PLAN = """
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
iterations = 4
rtol = 1e-3
limits.x_upper = [-0.03, 0.05]
[design.candidates]
twist.motion.theta_d = {times = [0.4, 0.5, 0.6, 0.7], values = [-0.1, 0.3, -0.5, -0.1]}
far.motion.theta_d = {times = [0.4, 0.7], values = [-0.1, 2.9]}
[design.bounds]
theta_d = {low = -0.5, high = 0.5, speed = 30.0, after = 0.4}
"""


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("design")
    (folder / "fit.toml").write_text(PLAN, encoding="utf-8")
    asked = ["design", str(folder / "fit.toml"), "--out", str(folder / "out"), "--no-progress"]
    assert main(asked) == 0
    return folder


def test_candidates_are_ranked_by_what_they_tell(out):
    """The deviations are those of the Fisher matrix; a motion that cannot be made comes last."""
    first, second, last = json.loads((out / "out" / "design.json").read_text())["candidates"]
    assert (first["name"], second["name"], last["name"]) == ("twist", AS_STATED, "far")
    assert first["value"] < second["value"]
    assert "was lost: " in last["failure"]
    stated = read_config(out / "fit.toml")
    file = RigFile.ready("orientation").override(**stated.settings)
    twisted = file.override(**stated.design.candidates["twist"])
    made = planned(stated, twisted, twisted.build(), "twist", stated.design.rtol, noise=0.0)
    problem = Problem([made], stated.sensors, stated.unknowns)
    x, free = problem.coordinates.start, problem.coordinates.free
    J = problem.residuals(Runner([made]), x, ["twist"], stated.design.rtol, free).J
    assert list(first["deviations"]) == list(problem.coordinates.labels)
    wanted = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    assert list(first["deviations"].values()) == pytest.approx(wanted.tolist(), rel=1e-6)


def test_the_designed_motion_is_a_rig_file_that_runs(out):
    file = RigFile.from_toml(out / "out" / "motion.toml")
    written = json.loads((out / "out" / "design.json").read_text())
    motion: Any = file.motion["theta_d"]
    assert motion.kind == "profile"
    assert motion.times == (0.4, 0.5, 0.6, 0.7)
    assert motion.values[0] + motion.offset == 0.0
    assert written["confirmed"]
    assert 0 < max(abs(np.array(motion.values) - [0.0, 0.4, -0.4, 0.0])) < 0.2
    assert max(map(abs, motion.values)) <= 0.5 + 1e-9
    assert written["made_by"]["iterations"] == 4
    began, *later = [visit["value"] for visit in written["history"]]
    assert min(later) < began
    assert (out / "out" / "design.png").stat().st_size > 10_000
    rig, y0, t = file.build()
    assert simulate(rig, t[:3], y0=y0)["x_disc"].isfinite().all()
    followed = rig.follow(torch.tensor([0.5, 0.8]).double())[:, rig.signals.index("theta_d"), 0]
    assert followed.tolist() == pytest.approx([motion.values[1], motion.values[3]])


def test_files_that_a_rig_names_are_found_from_elsewhere(tmp_path):
    column = {"kind": "csv", "file": "x.csv", "column": "x"}
    (tmp_path / "x.csv").write_text("t [s],x [m]\n0,0\n1,0.001\n", encoding="utf-8")
    file = RigFile.ready("orientation")
    file._folder = tmp_path
    whole: Any = located(file.override(motion={"x_d": column})).motion["x_d"]
    assert whole.file == str(tmp_path / "x.csv")


@pytest.mark.slow
def test_a_file_that_moves_otherwise_than_the_search_is_named(monkeypatch, tmp_path, capsys):
    def other(reference, names):
        return knots(reference, names) | {"bear": {"times": [0.0], "values": [9.0]}}

    monkeypatch.setattr(design, "knots", other)
    (tmp_path / "fit.toml").write_text(PLAN, encoding="utf-8")
    asked = ["design", str(tmp_path / "fit.toml"), "--out", str(tmp_path / "out"), "--no-progress"]
    assert main(asked) == 1
    assert "motion.bear of the written file is up to 3 off" in capsys.readouterr().out
    assert not json.loads((tmp_path / "out" / "design.json").read_text())["confirmed"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace(text.splitlines()[1], ""), "rig is missing: say rig"),
        (replaced("x_upper = ", "x_uper = "), "limits.x_uper = .* did you mean `x_upper`\\?"),
        (replaced("twist.motion", "twist.motions"), "design.candidates.twist: `motions` is not"),
        (replaced("theta_d = {low", "theta = {low"), "no Profile called `theta`"),
        (
            lambda text: text.replace("0.3, -0.5", "9.0, -9.0").replace("0.1, -0.1]", "9.0, 0.0]"),
            "no candidate can be made: .* was lost",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_designed_is_refused(tmp_path, change, words, capsys):
    (tmp_path / "fit.toml").write_text(change(PLAN), encoding="utf-8")
    asked = ["design", str(tmp_path / "fit.toml"), "--out", str(tmp_path / "o"), "--no-progress"]
    assert main(asked) == 2
    assert re.search(words, capsys.readouterr().err)
