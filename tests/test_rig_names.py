"""Names of a rig's numbers: those of its file, short ones, sources, units, and changes by names and
by tables; names that are taken; and what a built rig does."""

import json
import pickle
import re
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from conftest import COARSE, PAPER, coarse, nested, still, times
from hypothesis import given, settings
from hypothesis import strategies as st
from test_controllers import file as controlled

from torchsoft import Body, BuiltRig, Profile, Reference, Rig, RigFile
from torchsoft.rigs.build import READY, ready
from torchsoft.rigs.written import to_toml

COULOMB = {"kind": "coulomb", "mu_s": 0.8, "mu_k": 0.7}
PHYSICAL = ("gravity", "bodies", "materials", "laws", "actuators", "controllers")
MASS = ("density", "depth", "half_width", "half_height", "radius")
"""Numbers that the mass of a uniform body is computed from."""
SERIES = {
    "kind": "prony", "E": 4e5, "moduli": [1e5, 2e5], "tau": [2e-3, 3e-2], "depth": 44e-3,
}  # fmt: skip


def rejection(values: dict[str, Any] | None = None, **groups: Any) -> str:
    """The message with which these changes of the paper's file are rejected."""
    with pytest.raises(ValueError, match=r"^[^\n]+$") as error:
        PAPER.override(values, **groups).assemble()
    return str(error.value)


# names of parameters
# ----------------------------------------------------------------------


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


OPENED = {
    **{name: RigFile.ready(name) for name in ("paper", "rounded_box", "two_fingers")},
    "series": controlled().override(materials={"rubber": SERIES}),
}


@pytest.mark.parametrize("rig", OPENED)
def test_every_number_that_a_rig_is_made_with_has_its_name(rig):
    """Each number of the file is changed in turn: what changes in the rig is called the same."""
    file = OPENED[rig]
    before, seen = values(file.assemble()), set[str]()
    for name, value in numbers(file.model_dump(exclude_unset=True)):
        group, part, *_ = (*name.split("."), "")
        if group not in PHYSICAL:
            continue
        after = values(file.override(**nested(name, 1.01 * value or 1e-3)).assemble())
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
    assert seen


def test_short_names_are_for_typing_only():
    """Parameters and channels have both; results have the full ones."""
    one = PAPER.override({"pad.E": 8e5, "pad.elements_x": 60})
    assert [pad.elements_x for pad in one.pads.values()] == [60, 60]
    lengths = {"pads.L.elements_x": 60, "pads.U.elements_x": 60}
    assert one == PAPER.override({"materials.rubber.E": 8e5} | lengths)
    assert PAPER.full("pad.elements_x") == tuple(lengths)
    built = brief()
    rig, run = built.rig, built.run(times(0.02, 3), step=5e-3)
    for short, full in rig.short.items():
        if full in run:
            assert run[short] is run[full]
        else:
            assert rig.parameter(short) is rig.parameter(full)
    assert not rig.short.keys() & {*run.channels, *rig.description()["parameters"], *one.table()}
    assert "pad.elements_x" not in rig.short  # no parameter, and no channel
    sharp = still({"laws.steel_on_rubber.friction": COULOMB})
    with pytest.raises(ValueError, match=r"`contact.v_s` is not a parameter"):
        sharp.parameter("contact.v_s")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ({"pad.E": "materials.steel.E"}, "names.pad.E: `materials.steel.E` is not .* has rubber"),
        ({"angle": "theta_D"}, "names.angle: .* no channel `theta_D`; did you mean"),
        ({"x_C": "theta_C"}, "names.x_C: it is the name of something else already"),
        ({"none": []}, "names.none"),
    ],
)
def test_a_short_name_of_nothing_or_of_two_things_is_rejected(names, words):
    assert re.search(words, rejection(names=names))


def test_names_go_with_the_entries_that_a_change_takes_away():
    changed = PAPER.override({"laws.steel_on_rubber.friction": COULOMB})
    assert PAPER.names.keys() - changed.names.keys() == {"contact.v_s"}
    with pytest.raises(ValueError, match=r"`contact.v_s` is not in the rig file"):
        changed.override({"contact.v_s": 1e-3})
    assert PAPER.override({"pad.inertial": True}).names == PAPER.names  # there by default


@pytest.mark.parametrize("name", ["pad.Young", "pad.E.x", ""])
def test_an_unknown_name_is_rejected(name):
    assert f"`{name}` is not in the rig file: " in rejection({name: 1.0})
    with pytest.raises(ValueError, match=rf"`{re.escape(name)}` is not in the rig file"):
        PAPER.unit_of(name)


# sources and units
# ----------------------------------------------------------------------


def test_a_number_that_is_changed_loses_its_source():
    for change in ({"materials.rubber.E": 8e5}, {"pad.E": 8e5}):
        changed = PAPER.override(change)
        assert PAPER.sources.keys() - changed.sources.keys() == {"materials.rubber.E"}
        assert changed.table()["materials.rubber.E"]["source"] == "assumed"
    assert PAPER.override(materials={"rubber": {"E": 8e5}}).sources == changed.sources
    assert PAPER.override({"pad.E": 0.75e6}).sources == PAPER.sources  # the same number
    kept = PAPER.override({"motion.x_d.values_2": 41e-3})
    assert PAPER.sources.keys() - kept.sources.keys() == {"motion.x_d.values"}


def test_a_source_of_a_number_that_has_its_default_stays():
    tables = PAPER.model_dump(exclude_unset=True)
    del tables["actuators"]["x"]["Kd"]
    name = "actuators.x.Kd"
    file = RigFile.from_tree(tables).override(outputs={"duration": 0.5, "snapshots": []})
    assert name in file.sources
    assert file.sources.keys() - file.override({name: 3.0}).sources.keys() == {name}


def test_the_table_has_value_unit_source_and_meaning_of_every_number():
    table = PAPER.table()
    assert {row["source"].partition(":")[0] for row in table.values()} == {"published", "assumed"}
    assert table["bodies.disc.shape.radius"] == {
        "value": 19.37e-3, "unit": "m", "source": "published: radius of the disc",
        "meaning": "radius",
    }  # fmt: skip
    assert all(row["unit"] and row["meaning"] for row in table.values())


WIDE = {"measures": ["bracket.x", "bracket.y", "disc.theta"], "pushes": ["bracket.x", "bracket.y"],
        "setpoints": ["x_d", "y_d"], "gain": [[1.0] * 6, [2.0] * 6]}  # fmt: skip


@pytest.mark.parametrize(
    ("file", "name", "unit"),
    [
        *((PAPER, name, unit) for name, unit in {
            "pad.E": "Pa", "contact.mu_s": "1", "gravity": "m/s2", "control.R_99": "N.s/m",
            "motion.F_ff.values": "N", "motion.x_d.values_2": "m", "motion.x_d.times": "s",
        }.items()),
        *((RigFile.ready("two_fingers"), name, unit) for name, unit in {
            "actuators.left_turn.Kd": "N.m.s/rad", "motion.lean.values": "rad",
        }.items()),
        (RigFile.ready("orientation"), "actuators.turn_lower.Kp", "N/rad"),
        *((controlled(**WIDE), f"controllers.jaw.{name}", unit) for name, unit in {
            "gain_1_1": "N/m", "gain_1_3": "N/rad", "gain_2_4": "N.s/m", "gain_2_6": "N.s/rad",
        }.items()),
    ],
)  # fmt: skip
def test_an_entry_has_a_unit(file, name, unit):
    assert file.unit_of(name) == unit
    if name.startswith("controllers"):
        found = file.assemble().quantity(name)
        assert (found.unit, found.low) == (unit, -1e12)


# changes
# ----------------------------------------------------------------------

CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "pad.E": st.floats(1e4, 1e9), "pad.nu": st.floats(-0.9, 0.4999),
        "pad.elements_x": st.integers(4, 1000), "pad.inertial": st.booleans(),
        "contact.K_n": st.floats(1e-3, 1e9), "contact.v_s": st.floats(0.1, 10.0),
        "control.senses": st.sampled_from(["disc.x", "bracket.x"]),
        "motion.x_d.values": st.lists(st.floats(0.04, 0.08), min_size=4, max_size=4),
        "gravity": st.floats(0.0, 30.0), "title": st.text(max_size=20),
        "pads.L.origin": st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
        "solver": st.fixed_dictionaries({}, optional={"rtol": st.floats(1e-9, 0.1)}),
    },
)  # fmt: skip


@settings(max_examples=20, derandomize=True, deadline=None)
@given(changes=CHANGES)
def test_changes_arrive_once_undo_and_are_written(changes):
    changed, before = PAPER.override(changes), PAPER.table()
    full = {name: value for key, value in changes.items() for name in PAPER.full(key)}
    after = changed.table()
    for name in before:
        value = full.get(name, before[name]["value"])
        assert after[name]["value"] == (tuple(value) if isinstance(value, list) else value)
    assert changed.override(changes) == changed == changed.override(full)
    assert changed == RigFile.from_tree(tomllib.loads(to_toml(changed)), changed.folder)
    back = {name: row["value"] for name, row in before.items() if name in full}
    undone = changed.override(back).table()
    assert all(undone[name]["value"] == row["value"] for name, row in before.items())


def test_names_replace_what_is_there_and_tables_merge():
    one = PAPER.override({"pad.E": 8e5}, outputs={"duration": 0.1, "snapshots": []})
    assert (one["pad.E"], one.outputs.duration) == (8e5, 0.1)
    assert one.outputs.interval == PAPER.outputs.interval
    merged = PAPER.override(motion={"y_d": {"values_2": 48e-3}})
    assert merged.motion["y_d"].values == ("start", 48e-3)
    hold = {"kind": "hold", "value": 50e-3}
    assert PAPER.override({"motion.y_d": hold}) == PAPER.override(motion={"y_d": hold})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pad.E": -1.0}, "materials.rubber.E: should be from 1 to"),
        ({"control.senses": "disc.z"}, "actuators.x.measures"),
        ({"laws.steel_on_rubber.friction.kind": "stribeck"}, "laws.steel_on_rubber.friction"),
        ({"contact.mu_k": 0.9}, "laws.steel_on_rubber.friction: .*0.9.*0.8"),
    ],
)
def test_impossible_values_are_rejected_by_their_full_names(changes, words):
    assert re.search(words, rejection(changes))


@pytest.mark.parametrize("key", ["gain_3_1", "gain_1_5", "gain_0_1", "gains_1_1"])
def test_an_entry_that_is_not_there_is_rejected(key):
    with pytest.raises(ValueError, match=rf"{key}: there is no such entry|`{key}`.* mean `gain`"):
        controlled().override(controllers={"jaw": {key: 1.0}})


# files
# ----------------------------------------------------------------------


def test_a_file_comes_before_a_ready_rig_of_its_name(tmp_path):
    assert RigFile.from_toml(READY / "paper.toml") == PAPER
    with pytest.raises(ValueError, match=r"there is no ready rig `papers`; did you mean `paper`"):
        RigFile.ready("papers")
    assert RigFile.path("paper", tmp_path) == READY / "paper.toml"
    (tmp_path / "paper").write_text("")
    assert RigFile.path("paper", tmp_path) == tmp_path / "paper"
    with pytest.raises(ValueError, match=r"mine\.tom: No such file .*; the ready rigs are drop, "):
        RigFile.path("mine.tom", tmp_path)


@pytest.mark.parametrize("name", ready())
def test_rig_files_are_pickled_and_written(name):
    file = RigFile.ready(name)
    again = pickle.loads(pickle.dumps(file))
    assert again == file == RigFile.from_tree(tomllib.loads(to_toml(file)), file.folder)
    assert again.folder == file.folder
    assert again.model_fields_set == file.model_fields_set


# names that are taken
# ----------------------------------------------------------------------

MOTION = "left_close"


def renamed(new: str) -> RigFile:
    """A ready rig with another name of a motion in every place."""
    tree = json.dumps(RigFile.ready("two_fingers").model_dump(exclude_unset=True))
    assert f'"{MOTION}"' in tree
    return RigFile.from_tree(json.loads(tree.replace(f'"{MOTION}"', json.dumps(new))))


@pytest.mark.parametrize("name", ["a/b", "", "forward", "a.b.c", "1", "a\nb"])
def test_motions_have_names_by_the_rule_of_the_others(name):
    words = "taken by torch" if name == "forward" else "letters, digits and"
    with pytest.raises(ValueError, match=f"motion\\..*: the name .*{words}"):
        renamed(name)
    with pytest.raises(ValueError, match=f"motion\\..*: the name .*{words}"):
        Reference(**{name: Profile([0.0], [0.0])})
    assert Reference(self=Profile([0.0], [1.0]))(torch.zeros(1).double(), ["self"])[0, 0, 0] == 1


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        ("x_{body}", "{body}.x"),
        ("effort_{actuator}", "the effort of the actuator `{actuator}`"),
        ("time", "an array `time` of files"),
        ("energy_{body}", "`energy_{body}` of the body"),
    ],
)
def test_two_channels_of_one_name_are_rejected_with_both_owners(name, owner):
    file = RigFile.ready("two_fingers")
    parts = {k: next(iter(getattr(file, f"{k}s"))) for k in ("pad", "actuator", "contact")}
    parts["body"] = next(iter(file.bodies))
    name, owner = name.format(**parts), owner.format(**parts)
    with pytest.raises(ValueError, match=re.escape(f"the channel `{name}`")) as rejected:
        renamed(name).assemble()
    assert owner in str(rejected.value)
    assert f"the motion `{name}`" in str(rejected.value)


@pytest.mark.parametrize("name", ["ground", "disc_spin", "keys"])
def test_bodies_cannot_have_names_of_other_junctions(name):
    model = coarse()
    parts = {"pads": dict(model.pads), "contacts": dict(model.contacts)}
    bodies = dict(model.bodies) | {name: Body(0.1, theta=0.0)}
    with pytest.raises(ValueError, match=f"the junction `{name}`|bodies.{name}: the name"):
        Rig(bodies=bodies, **parts)


# built rigs
# ----------------------------------------------------------------------


def brief(changes: dict[str, Any] | None = None, **groups: Any) -> BuiltRig:
    short = {"duration": 0.03, "snapshots": ()}
    file = PAPER.override(COARSE | (changes or {}), outputs=short)
    return file.override(**groups).build()


def test_a_built_rig_runs_as_its_file_says():
    one = brief(outputs={"interval": 0.015}, solver={"step": 5e-3})
    rig, y0, t = one
    assert (rig, y0, t) == (one.rig, one.y0, one.t)
    assert t.tolist() == pytest.approx([0.0, 0.015, 0.03])
    run = one.run()
    assert torch.equal(run.t, t)
    assert torch.equal(run.y[0], y0)
    assert [one.run(**how).stats.steps for how in ({}, {"step": 2.5e-3})] == [6, 12]
    assert one.run(rtol=1e-4).stats.steps != 6  # a choice of steps replaces the file's
    y0 = rig.state(disc={"x": 61e-3, "y": "rest"}, bracket={"x": 61e-3, "y": "touch"})
    assert one.run(times(0.01, 2), y0=y0)["x_C"][0] == 61e-3
