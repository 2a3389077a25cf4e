"""Mutated configurations, identification files and tables of measurements: accepted and then
finite, or rejected in a sentence that names the field, or file, row and column."""

import tomllib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from hostile.damage import Mutant, document, written
from hostile.processes import ROOT
from hostile.specimens import cells, csv_text, rigs
from hostile.trial import LIMIT, Tally, count, random, sentence
from torchsoft import RigFile, simulate
from torchsoft.cost import Costly, agree
from torchsoft.datasets.config import Config
from torchsoft.datasets.generate import cost as dataset_cost
from torchsoft.datasets.generate import points
from torchsoft.datasets.rig_files import embedded
from torchsoft.sysid import measured
from torchsoft.sysid.measured import cost
from torchsoft.sysid.runs import Runner
from torchsoft.tables import from_toml

pytestmark = pytest.mark.slow

SMALL = 1e-3
"""Meshes whose stiffness takes more memory than this [GiB] are not built here."""

BRIEFLY = torch.tensor([0.0, 2e-3, 6e-3], dtype=torch.float64)


def attack(
    tally: Tally, changed: Mutant, read: Callable[[], Any], use: Callable[[Any], None] | None
) -> Any:
    """Count one input; what is made of it, or None where it was rejected. `use` raises
    `AssertionError` for what is accepted and is nonsense, and may reject it with a sentence too."""
    shown = f"{changed.place} = {changed.new!r:.60}"
    made = tally.call(shown, read, blamed=changed.named)
    if made is not None and changed.no_number:
        tally.held(False, f"{shown}: accepted in the place of a number")
    elif made is not None and use:
        later = partial(use, made)
        tally.call(f"{shown}, used", later, (ValueError, RuntimeError), limit=6 * LIMIT)
    return made


def finite(*tensors: torch.Tensor) -> None:
    assert all(bool(torch.isfinite(x).all()) for x in tensors), "not finite"


# configurations
# ----------------------------------------------------------------------


def datasets() -> list[dict[str, Any]]:
    files = sorted((ROOT / "data_gen" / "configs").glob("*.toml"))
    trees = [embedded(tomllib.loads(path.read_text()), path.parent) for path in files]
    for tree in trees:
        blocks = (name for name, pad in tree["rig"]["pads"].items() if "elements_x" in pad)
        coarse = {f"pads.{name}.elements_x": 20 for name in blocks}
        tree["fixed"] = tree.get("fixed", {}) | coarse
    return trees


def run_briefly(file: RigFile) -> None:
    """The rig, its motions to the end, and three steps."""
    rig = file.assemble()
    points = sum(pad.point_positions.shape[0] for pad in rig.pads.values())
    if max(pad.mesh.memory for pad in rig.pads.values()) > SMALL or points > 1000:
        return
    made, y0, _ = file.build()
    until = torch.linspace(0, file.outputs.duration, 101, dtype=torch.float64)
    run = simulate(made, BRIEFLY, y0=y0, step=2e-3)
    finite(y0, made.follow(until), run.y, *run.channels.values())


def design_briefly(config: Config) -> None:
    """The cost, the first tasks of the design, and the begin of one; a costly set needs the user's
    word."""
    expected = dataset_cost(config, 2)
    assert np.isfinite(expected).all(), f"no estimate: {expected}"
    try:
        agree(expected, False, "take less")
    except Costly:
        assert expected.seconds > 3600 or expected.memory > 1
    few = config.model_copy(update={"trajectories": min(config.trajectories, 4)})
    for i, u in enumerate(points(few)):
        one = few.subject.task(i, u)
        assert np.isfinite([x for x in one.labels.values() if not isinstance(x, str)]).all()
    if max(pad.mesh.memory for pad in few.subject.template.pads.values()) <= SMALL:
        rig, y0 = few.subject.begin(one)
        finite(y0, simulate(rig, BRIEFLY, y0=y0, step=2e-3).y)


KINDS = {
    "rig files": (RigFile, rigs, 8000, run_briefly),
    "dataset configurations": (Config, datasets, 4000, design_briefly),
}
"""What reads a configuration, valid ones, how many mutants, and what every third of the accepted is
used for."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("way", "share"), [("values", 1.0), ("text", 0.25)])
def test_a_mutated_table_is_finite_or_rejected_by_its_field(kind, way, share, tally, tmp_path):
    """With one value changed, or its text damaged."""
    table, valid, number, use = KINDS[kind]
    rng, trees, path = random(kind + way), valid(), tmp_path / "mutant.toml"
    assert all(map(table.model_validate, trees))
    read = partial(from_toml, path, table.model_validate)
    for i in range(count(share * number)):
        changed = written(path, trees[i % len(trees)], way, rng)
        attack(tally, changed, read, use if i % 3 == 0 else None)


# identifications
# ----------------------------------------------------------------------

RTOL = 1e-3
STATED = """
heldout = ["second"]
ignore = ["Temp"]
acknowledged = ["sign of F_x"]
start = { kind = "rest", position_sd = { "disc.x" = 1e-5 } }
[settings]
laws.steel_on_rubber.friction = { v_s = 0.05, mu_k = 0.5 }
actuators.x.measures = "bracket.x"
materials.rubber.nu = 0.45
[settings.bodies]
disc = { shape = { radius = 19.37e-3 }, start = { x = 60.3e-3 } }
bracket = { start = { x = 60.3e-3 } }
[settings.pads]
L = { elements_x = 20, elements_y = 1 }
U = { elements_x = 20, elements_y = 1 }
[unknowns]
"laws.steel_on_rubber.K_n" = { nominal = 8e4 }
"materials.rubber.E" = { nominal = 0.45e6 }
"materials.rubber.tau" = { nominal = 20e-3 }
"laws.steel_on_rubber.friction.mu_s" = { nominal = 0.9, low = 0.5, high = 2.0 }
"materials.rubber.nu" = { scale = "linear", low = 0.3, high = 0.49 }
[unknowns."laws.steel_on_rubber.R_t"]
nominal = 400.0
low = 100.0
high = 1e3
scale = "log"
per = "recording"
prior = { median = 400.0, sd = 0.5, kind = "log-normal" }
fixed = false
[sensors]
x_C = { noise = 10e-6 }
theta = { noise = 0.5e-3, bias = 1e-3, delay = 2e-3, per = "all" }
x_Br = { noise = 10e-6 }
y_Br = { noise = 10e-6 }
F_x = { noise = 0.1 }
[sensors.F_y]
noise = 0.1
gain = 0.02
drift = 0.1
low = -500.0
high = 500.0
colour = "white"
[fit]
rtol = 1e-3
starts = 1
loss = "linear"
workers = 1
seed = 0
[[recordings]]
files = ["second.csv", "force.csv"]
name = "second"
settings = { laws = { steel_on_rubber = { friction = { v_s = 0.06 } } } }
"""
SLOW = """
[[recordings]]
file = "third.csv"
name = "third"
[recordings.start]
kind = "moving"
lead = 40e-3
given = { "disc.y" = { mean = 23.5e-3, sd = 1e-4 } }
[compare.coulomb.settings.laws.steel_on_rubber]
friction = { kind = "coulomb", mu_s = 0.8, mu_k = 0.5 }
[compare.coulomb]
without = ["laws.steel_on_rubber.R_t"]
[compare.solid.settings.materials.rubber]
kind = "standard_linear_solid"
E = 0.75e6
E_instant = 8e6
nu = 0.45
tau = 10e-3
depth = 44e-3
"""
"""What a file may state; and what takes longer, a recording that starts in motion and competing
laws."""


def run_once(case: measured.Case) -> None:
    """The estimate, and one run from the start: residuals are finite, or the reason is a
    sentence."""
    problem, fit = case.problem, case.config.fit
    expected = cost(problem, fit.rtol, fit.starts, fit.workers, case.config.heldout)
    assert np.isfinite(expected).all(), f"no estimate: {expected}"
    memory = max(pad.mesh.memory for r in problem.recordings for pad in r.rig.pads.values())
    if memory > SMALL or cost(problem, RTOL, 1, 1).steps > 1e5:
        return
    start, free = problem.coordinates.start, problem.coordinates.free
    runner = Runner(problem.recordings)
    out = problem.residuals(runner, start, problem.names[:1], RTOL, free)
    assert all(sentence(lost.reason) for lost in out.failed.values()), out.failed
    assert out.failed or (np.isfinite(out.r).all() and np.isfinite(out.J).all()), "not finite"


@pytest.mark.parametrize(("way", "number"), [("values", 4000), ("text", 1000)])
def test_a_mutated_identification_is_finite_or_rejected_by_its_field(way, number, tmp_path, tally):
    table = cells()
    parts = {"data": table, "third": table, "second": [row[:5] + row[6:10] for row in table]}
    parts["force"] = [[row[0], *row[10:12], "Temp [K]"] for row in table]
    for name, rows in parts.items():
        (tmp_path / f"{name}.csv").write_text(csv_text(rows), encoding="utf-8")
    quick, slow = ({"rig": "paper"} | tomllib.loads(text) for text in (STATED, STATED + SLOW))
    rng, path = random(way), tmp_path / "rig.toml"
    path.write_text(document(slow), encoding="utf-8")
    load = partial(measured.load, [tmp_path / "data.csv"], path)
    assert attack(tally, Mutant(), load, run_once)
    for i in range(count(number)):
        changed = written(path, slow if i % 10 == 5 else quick, way, rng)
        attack(tally, changed, load, run_once if i % 10 == 0 else None)
