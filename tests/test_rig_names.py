"""Numbers of a rig file have their names in that file, whatever asks for them."""

import json
import pickle
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from conftest import coarse, nested
from test_controllers import file as controlled
from torch import nn

from torchsoft import Body, Profile, Reference, Rig
from torchsoft.rigs import RigFile
from torchsoft.rigs.build import ready
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown

RIGS = ready()
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
    return RigFile.ready(name)


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


@pytest.mark.parametrize("rig", [*RIGS, "controllers", "series"])
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


TREE = RigFile.path("two_fingers")


def renamed(old: str, new: str) -> RigFile:
    """A ready rig with another name in every place."""
    tree = json.dumps(RigFile.from_toml(TREE).model_dump(exclude_unset=True))
    assert f'"{old}"' in tree
    return RigFile.from_tree(json.loads(tree.replace(f'"{old}"', json.dumps(new))))


MOTION = next(iter(RigFile.from_toml(TREE).motion))


@pytest.mark.parametrize("name", ["a/b", ".", "", "forward", "training", "a.b.c", "1", "a\nb"])
def test_motions_have_names_by_the_rule_of_the_others(name):
    words = "taken by torch" if name in ("forward", "training") else "letters, digits and"
    with pytest.raises(ValueError, match=f"motion\\..*: the name .*{words}"):
        renamed(MOTION, name)
    with pytest.raises(ValueError, match=f"motion\\..*: the name .*{words}"):
        Reference(**{name: Profile([0.0], [0.0])})
    assert "self" in renamed(MOTION, "self").assemble().signals
    assert Reference(self=Profile([0.0], [1.0]))(torch.zeros(1).double(), ["self"])[0, 0, 0] == 1


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        ("x_{body}", "{body}.x"),
        ("v_x_{body}", "the rate of {body}.x"),
        ("angular_momentum_{body}", "the angular momentum of the body `{body}`"),
        ("M_{pad}", "the moment on the pad `{pad}`"),
        ("effort_{actuator}", "the effort of the actuator `{actuator}`"),
        ("time", "an array `time` of files"),
        ("pose", "an array `pose` of files"),
        ("stretch_{contact}", "`stretch_{contact}` of the contact"),
        ("{contact}.centre", "`{contact}.centre` of the contact"),
        ("energy_strain_{pad}", "`energy_strain_{pad}` of the pad"),
        ("energy_{body}", "`energy_{body}` of the body"),
        ("supplied_control_{actuator}", "`supplied_control_{actuator}` of the actuator"),
    ],
)
def test_two_channels_of_one_name_are_refused_with_both_owners(name, owner):
    """A motion that was called `x_disc` was read in place of the disc's x."""
    rig = renamed(MOTION, MOTION).assemble()
    parts = {k: next(iter(getattr(rig, f"{k}s"))) for k in ("pad", "actuator", "contact")}
    parts["body"] = next(iter(rig.bodies))
    name, owner = name.format(**parts), owner.format(**parts)
    with pytest.raises(ValueError, match=re.escape(f"the channel `{name}`")) as refused:
        renamed(MOTION, name).assemble()
    assert owner in str(refused.value)
    assert f"the motion `{name}`" in str(refused.value)


@pytest.mark.parametrize("name", ["ground", "disc_spin", "pad_L", "a/b", "keys"])
def test_bodies_cannot_have_names_of_other_junctions(name):
    """One called "ground" did not settle in one rig and ran in others."""
    model = coarse()
    parts = {"pads": dict(model.pads), "contacts": dict(model.contacts)}
    bodies = dict(model.bodies) | {name: Body(0.1, theta=0.0)}
    with pytest.raises(ValueError, match=f"the junction `{name}`|bodies.{name}: the name"):
        Rig(bodies=bodies, **parts)


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every number in tables and lists, as its container and key."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        if isinstance(value, dict | list):
            yield from places(value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield tree, key


def test_integers_of_400_digits_in_a_file_are_refused():
    """In bounds of all kinds: some of them ended in an OverflowError."""
    tree = json.loads(RigFile.from_toml(TREE).model_dump_json(exclude_none=True))
    count = 0
    for table, key in places(tree):
        before, table[key] = table[key], 10**400
        with pytest.raises(ValueError, match="should be") as refused:
            RigFile.from_tree(tree)
        assert len(str(refused.value)) < 300
        table[key], count = before, count + 1
    assert count > 50


@pytest.mark.parametrize("name", RIGS)
def test_rig_files_are_pickled(name):
    file = opened(name)
    again = pickle.loads(pickle.dumps(file))
    assert again == file
    assert again.folder == file.folder
    assert again.model_fields_set == file.model_fields_set
