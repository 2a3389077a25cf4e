"""Numbers of a rig file have their names in that file, whatever asks for them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import nested
from test_controllers import file as controlled
from torch import nn

from torchsoft import Rig
from torchsoft.rigs import RigFile
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown

RIGS = sorted((Path(__file__).parents[1] / "rigs").glob("*.toml"))
PHYSICAL = ("gravity", "bodies", "materials", "laws", "actuators", "controllers")
MASS = ("density", "depth", "half_width", "half_height", "radius")
"""Numbers that the mass of a uniform body is computed from."""
SERIES = {
    "kind": "prony", "E": 4e5, "moduli": [1e5, 2e5], "tau": [2e-3, 3e-2], "depth": 44e-3,
}  # fmt: skip


def opened(name: str) -> RigFile:
    if name == "controllers":
        return controlled()
    if name == "series":
        return controlled().override(materials={"rubber": SERIES})
    return RigFile.from_toml(RIGS[0].with_name(f"{name}.toml"))


def numbers(tree: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a file, by its name."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from numbers(value, f"{name}.{key}" if name else key)
    elif isinstance(tree, list | tuple):
        for k, value in enumerate(tree, 1):
            yield from numbers(value, f"{name}_{k}")
    elif isinstance(tree, float):
        yield name, tree


def values(rig: Rig) -> dict[str, float]:
    own = {path: name for name, path in rig.aliases.items()}
    return {own.get(name, name): value.item() for name, value in rig.named_parameters()}


@pytest.mark.parametrize("rig", [*(path.stem for path in RIGS), "controllers", "series"])
def test_every_number_that_a_rig_is_made_with_has_its_name(rig):
    """Each number of the file is changed in turn: what changes in the rig is called the same."""
    file = opened(rig)
    before, seen = values(file.assemble()), set[str]()
    for name, value in numbers(file.model_dump(exclude_unset=True)):
        group, part, *_ = (*name.split("."), "")
        if group not in PHYSICAL:
            continue
        other = file.override(**nested(name, 1.01 * value or 1e-3))
        after = values(other.assemble())
        own = (key for key in before if not key.endswith(".R_pad"))  # follows the pad
        changed = {key for key in own if after[key] != before[key]}
        if ".start." in name:
            assert not changed
        elif name.rpartition(".")[2] in MASS and group == "bodies":
            assert {f"bodies.{part}.mass", name} >= changed > set()
        else:
            assert changed == {name}
            assert after[name] == pytest.approx(1.01 * value or 1e-3, rel=1e-12)
            seen.add(name)
    assert len(seen) > 10


def test_gains_have_units_and_bounds():
    rig = controlled(pushes=["bracket.x", "bracket.y"]).assemble()
    for name, unit in (("gain_1_1", "N/m"), ("gain_2_3", "N.s/m")):
        found = rig.quantity(f"controllers.jaw.{name}")
        assert (found.unit, found.low) == (unit, -1e12)


def test_gains_are_unknowns():
    rig, y0, t = controlled().build()
    at = t.numpy()
    one = Recording("one", rig, {"x_disc": (at, 0 * at)}, Known(y0))
    sensors, gain = {"x_disc": Sensor(noise=1e-5)}, "controllers.jaw.gain_1_3"
    problem = Problem([one], sensors, {gain: Unknown(), "materials.rubber.E": Unknown()})
    assert problem.values(problem.coordinates.start, 0)[gain] == pytest.approx(400.0)
    with pytest.raises(ValueError, match=r"gain_1_2 = 0 is not on a logarithmic scale"):
        Problem([one], sensors, {"controllers.jaw.gain_1_2": Unknown()})
    with pytest.raises(ValueError, match=r"known: .*controllers\.jaw\.gain_1_1") as refused:
        Problem([one], sensors, {"controllers.jaw.gain_1": Unknown()})
    assert len(str(refused.value)) < 300


def test_weights_of_a_network_are_tensors_by_name(tmp_path):
    net = nn.Sequential(nn.Linear(8, 3), nn.Tanh(), nn.Linear(3, 2)).double()
    weights = {name: value.detach().numpy() for name, value in net.state_dict().items()}
    np.savez(tmp_path / "law.npz", **weights)
    file = controlled(network="law.npz")
    file._folder = tmp_path
    rig, y0, t = file.build()
    assert rig.parameter("controllers.jaw.network.0.weight").shape == (3, 8)
    one = Recording("one", rig, {"x_disc": (t.numpy(), 0 * t.numpy())}, Known(y0))
    name = "controllers.jaw.network.0.weight"
    with pytest.raises(ValueError, match=r"network\.0\.weight` .* has 24 numbers"):
        Problem([one], {"x_disc": Sensor(noise=1e-5)}, {name: Unknown()})


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"gain_3_1": 1.0}, "gain_3_1: there is no such entry"),
        ({"gain_1_5": 1.0}, "gain_1_5: there is no such entry"),
        ({"gain_0_1": 1.0}, "gain_0_1: there is no such entry"),
        ({"gains_1_1": 1.0}, "`gains_1_1` is not known here; did you mean `gain`"),
    ],
)
def test_an_entry_that_is_not_there_is_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        controlled().override(controllers={"jaw": settings})
