"""Small rigs, runs, recordings and datasets, quick enough to be made hundreds of times."""

import csv
import tomllib
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from conftest import PAPER, excited, rest, still, stroked

from hostile.processes import ROOT
from torchsoft import RigFile, Trajectory, simulate
from torchsoft.datasets import generate as generation
from torchsoft.datasets.config import Config
from torchsoft.datasets.generate import Serial, generate, simulate_task
from torchsoft.sysid import Problem, Sensor, Unknown, record

EXAMPLE = ROOT / "examples" / "identify"

SMALL = {"pad.elements_x": 40, "pad.elements_y": 1, "contact.v_s": 0.05}

DATASET = """
title = "Small"
rig = "paper"
seed = 5
trajectories = 3
trajectories_per_shard = 2
duration = 0.5
sample_interval = 0.025
step = 0.005
samples_per_chunk = 16
[fixed]
"pads.L.elements_x" = 40
"pads.L.elements_y" = 1
"pads.U.elements_x" = 40
"pads.U.elements_y" = 1
"laws.steel_on_rubber.friction.v_s" = 0.05
"motion.y_d.times_2" = 0.1
"motion.F_ff" = { kind = "profile", times = [0.0, 0.1], values = [0.0, "held"] }
[parameters]
"materials.rubber.E" = { low = 7e5, high = 8e5, scale = "log" }
"motion.y_d.values_2" = { low = 48.6e-3, high = 48.8e-3 }
[[kinds]]
name = "shake"
fixed."motion.x_d" = { kind = "chirp", since = 0.1, amplitude = 1e-3, first = 2.0, last = 5.0 }
parameters."motion.x_d.amplitude" = { low = 2e-4, high = 4e-4 }
"""

ROLLING = """
import json, threading, torch
from torchsoft import RigFile
torch.set_num_threads(1)
def roll(_=0):
    coarse = {"pad.elements_x": 40, "pad.elements_y": 1, "contact.v_s": 0.05}
    force = {"motion.F_ff.values": [0.0, -75.0]}
    built = RigFile.ready("paper").override(coarse | force).build()
    run = built.run(torch.linspace(0, 0.3, 7, dtype=torch.float64), gradient="discrete")
    run["y_Br"][-1].backward()
    slope = built.rig.parameter("materials.rubber.E").grad
    return [float(value).hex() for value in (*run["y_Br"].detach(), slope)]
"""
"""A program that can roll the disc, and differentiate that, to the bit."""

ROLL = ROLLING + "print(json.dumps(roll()))\n"

MOTIONS = """
[[motion]]
kind = "hold"
value = 60e-3
[[motion]]
kind = "profile"
times = [0.4, 1.0]
values = [0.0, 5e-3]
offset = "start"
[[motion]]
kind = "strokes"
travel = 5e-3
stroke_time = 0.2
since = 0.4
until = 0.9
[[motion]]
kind = "spline"
times = [0.0, 0.5, 1.0]
values = [60e-3, 62e-3, 61e-3]
[[motion]]
kind = "sines"
components = [{ amplitude = 1e-3, frequency = 2.0, phase = 0.3 }]
since = 0.4
[[motion]]
kind = "multi_sine"
amplitude = 1e-3
band = [0.5, 8.0]
components = 3
seed = 1
since = 0.4
[[motion]]
kind = "chirp"
amplitude = 1e-3
first = 0.3
last = 8.0
since = 0.4
"""


def coarse(name: str) -> RigFile:
    """A ready rig on coarse meshes."""
    file = RigFile.ready(name)
    return file.override(pads={name: {"elements_x": 20, "elements_y": 1} for name in file.pads})


def rigs() -> list[dict[str, Any]]:
    """Ready rigs, and the paper's, moved along its pads in every way."""
    files = [coarse(name) for name in ("paper", "light_grasp", "two_fingers", "drop")]
    short = files[0].override(outputs={"duration": 1.0, "snapshots": []})
    files += [short.override({"motion.x_d": way}) for way in tomllib.loads(MOTIONS)["motion"]]
    return [file.model_dump(mode="json", exclude_unset=True) for file in files]


def dataset(folder: Path, trajectories: int = 3) -> Path:
    """A file that describes a small dataset."""
    path = folder / f"small-{trajectories}.toml"
    path.write_text(DATASET.replace("trajectories = 3", f"trajectories = {trajectories}"))
    return path


_rows: dict[tuple[str, int], Any] = {}


def remembered(config: Config, task: Any) -> Any:
    """A row of a dataset, simulated once in this process and those forked from it."""
    key = config.hash, task.index
    if key not in _rows:
        _rows[key] = simulate_task(config, task)
    return dict(_rows[key])


def make(description: Path, folder: Path) -> None:
    """Generate a dataset in this process."""
    torch.set_num_threads(1)
    with mock.patch.object(generation, "simulate_task", remembered):
        config = Config.from_toml(description)
        assert generate(config, str(folder), Serial(), progress=False) == 0


def run() -> Trajectory:
    """The disc at rest, for 50 ms."""
    model = still(SMALL)
    t = torch.linspace(0, 0.05, 11, dtype=torch.float64)
    return simulate(model, t, y0=rest(model).detach(), step=5e-3)


def problem() -> Problem:
    """Stiffnesses of pads and contacts, from strokes of 0.4 s."""
    sensors = {"x_C": Sensor(noise=1e-5), "y_Br": Sensor(noise=1e-5), "F_y": Sensor(noise=0.1)}
    built = excited(stroked(5e-3, 0.15, duration=0.4, grasp=0.08, since=0.1), PAPER.override(SMALL))
    recorded = record("strokes", built, {"pad.E": 0.9e6}, sensors, rtol=1e-3, seed=3)
    return Problem([recorded], sensors, {"pad.E": Unknown(nominal=1.1e6), "contact.K_n": Unknown()})


def cells(rows: int = 42) -> list[list[str]]:
    """The heading and first rows of the example's recording, 0.2 s."""
    with (EXAMPLE / "rolling.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))[:rows]


def csv_text(table: list[list[str]]) -> str:
    return "".join(",".join(row) + "\n" for row in table)
