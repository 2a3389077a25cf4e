"""Rigs in which nothing is free: a driven indenter, the commonest test of a rubber."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import f64

from torchsoft import BuiltRig, RigFile, hold
from torchsoft.cli import main
from torchsoft.physics.statics import resting, standing
from torchsoft.rigs.check import check
from torchsoft.solve.diagnostics import NEUTRAL, modes
from torchsoft.testing import check_gradients

RIG = """
[bodies.indenter]
x = 0.0
theta = 0.0
y = "driven"
shape = {{kind = "circle", radius = 12.5e-3}}
[materials.gel]
kind = "standard_linear_solid"
E = 40e3
E_instant = 60e3
nu = 0.45
tau = 1.0
depth = 40e-3
[pads.gel]
material = "gel"
origin = [-30e-3, 0.0]
length = 60e-3
height = 20e-3
elements_x = 20
elements_y = 4
[laws.dry]
K_n = 5e4
R_n = 20.0
K_t = 5e4
R_t = 20.0
friction = {{kind = "smooth", mu_s = 0.5, mu_k = 0.4, v_s = 50e-3}}
[contacts.gel]
pad = "gel"
body = "indenter"
law = "dry"
[motion."indenter.y"]
kind = "profile"
times = [0.0, 1.0]
values = [{start}, 31.5e-3]
[outputs]
duration = 2.0
interval = 0.02
video = "none"
figures = false
"""

FIT = """
rig = "rig.toml"
start = {kind = "rest", lead = 0.0}
[unknowns]
"materials.gel.tau" = {}
[sensors]
"indenter.load_y" = {noise = 0.01}
"""


def written(folder: Path, start: float = 32.5e-3) -> Path:
    """The rig file, whose indenter starts at `start` [m]; the pad's face is reached at 32.5 mm."""
    path = folder / "rig.toml"
    path.write_text(RIG.format(start=start))
    return path


@pytest.fixture
def built(tmp_path: Path) -> BuiltRig:
    """The rig, started where the indenter touches."""
    return RigFile.from_toml(written(tmp_path)).build()


@pytest.mark.parametrize("start", [32.5e-3, 33e-3])
def test_the_check_finds_nothing(tmp_path: Path, start: float):
    """An indenter that starts on the pad, or out of contact, is sound; energies balance."""
    file = RigFile.from_toml(written(tmp_path, start))
    assert {one.severity for one in check(file)} <= {"note"}
    run = file.build().run()
    assert float(run["indenter.load_y"][-1]) > 1.0
    assert run.energy_residual_rel < 1e-3


def test_gradients_of_the_force(built: BuiltRig):
    """With respect to a material's tau and to the motion."""
    check_gradients(
        built.rig, built.t[:61:10], built.y0, of=["indenter.load_y"], step_error=False, bound=1e-3,
        wrt=["materials.gel.tau", "reference.signals.indenter:y.values"],
    )  # fmt: skip


def test_modes_without_a_free_coordinate(built: BuiltRig):
    """Out of contact there is none; pressed in, pads relax and nothing grows; at rest the body is
    where it is driven."""
    rig = built.rig
    apart = {"indenter": f64(0.0, 33e-3, 0.0)}
    assert not len(modes(rig, standing(rig, apart), hold(**{"indenter.y": 33e-3})).values)
    pressed = {"indenter": f64(0.0, 31.5e-3, 0.0)}
    found = modes(rig, standing(rig, pressed), hold(**{"indenter.y": 31.5e-3}))
    assert not found.moves
    assert float(found.values.real.max()) < NEUTRAL
    assert float(found.values.real.min()) < -NEUTRAL
    assert torch.equal(resting(rig, pressed)["indenter"], pressed["indenter"])


def test_identified_from_its_force(tmp_path, monkeypatch, capsys):
    """The force alone is measured; its relaxation tells tau, though the clock is Unix time."""
    monkeypatch.chdir(tmp_path)
    run = RigFile.from_toml(written(tmp_path)).build().run()
    force = run["indenter.load_y"].numpy() + np.random.default_rng(0).normal(0, 0.01, len(run.t))
    table = np.stack((1.7e9 + run.t.numpy(), 1e3 * run["y_indenter"].numpy(), force), -1)
    heading = "t [s],indenter.y [mm],indenter.load_y [N]"
    np.savetxt("loop.csv", table, "%.6f", ",", header=heading, comments="")
    Path("fit.toml").write_text(FIT)
    assert main(["identify", "loop.csv", "fit.toml", "--out", "out", "--no-progress"]) == 0
    low, high = json.loads(Path("out/answer.json").read_text())["estimates"][0]["ci95"]
    assert "1 of 1 parameters identifiable" in capsys.readouterr().out
    assert low < 1.0 < high < low + 0.2
