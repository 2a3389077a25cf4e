"""Names of a rig file: short ones, sources, units, and changes by names and by tables."""

import re
from typing import Any

import pytest
import torch
from conftest import COARSE, PAPER, times
from hypothesis import given
from hypothesis import strategies as st

from torchsoft import BuiltRig, RigFile
from torchsoft.rigs.build import READY, ready

LENGTHS = {"pads.L.elements_x": 60, "pads.U.elements_x": 60}


def refusal(values: dict[str, Any] | None = None, **groups: Any) -> str:
    """The message with which these changes of the paper's file are refused."""
    with pytest.raises(ValueError, match=r".") as error:
        PAPER.override(values, **groups).assemble()
    assert "\n" not in str(error.value)
    return str(error.value)


# short names
# ----------------------------------------------------------------------


def test_a_short_name_stands_for_an_entry_or_several():
    one = PAPER.override({"pad.E": 8e5, "pad.elements_x": 60})
    assert one.materials["rubber"].E == 8e5
    assert [pad.elements_x for pad in one.pads.values()] == [60, 60]
    assert one == PAPER.override({"materials.rubber.E": 8e5} | LENGTHS)
    assert PAPER.full("pad.elements_x") == tuple(LENGTHS)
    assert PAPER.full("theta") == ("theta_C",)
    assert PAPER.full("materials.rubber.E") == ("materials.rubber.E",)


def test_short_names_are_for_typing_only():
    rig = PAPER.override(COARSE).assemble()
    assert rig.short["pad.E"] == "materials.rubber.E"
    assert rig.short["F_x"] == "effort_x"
    assert "pad.elements_x" not in rig.short  # no parameter, and no channel
    assert rig.parameter("pad.E") is rig.parameter("materials.rubber.E")
    rows = rig.description()["parameters"]
    assert "materials.rubber.E" in rows
    assert not rows.keys() & rig.short.keys()
    assert not PAPER.table().keys() & rig.short.keys()


def test_a_channel_has_a_short_name():
    run = built().run(times(0.02, 3), step=5e-3)
    assert torch.equal(run["theta"], run["theta_C"])
    assert torch.equal(run["F_y"], run["effort_y"])
    assert not run.channels.keys() & run.rig.short.keys()


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ({"pad.E": "materials.steel.E"},
         "names.pad.E: `materials.steel.E` is not in the rig file: materials has rubber"),
        ({"mesh": ["pads.L.elements_x", "pads.M.elements_x"]}, "names.mesh: `pads.M.elements_x`"),
        ({"angle": "theta_D"}, "names.angle: the rig has no channel `theta_D`; did you mean"),
        ({"x_C": "theta_C"}, "names.x_C: it is the name of something else already"),
        ({"effort_x": "effort_y"}, "names.effort_x: it is the name of something else already"),
        ({"gravity": "materials.rubber.E"}, "names.gravity: it is the name of something else"),
        ({"materials.rubber.E": "materials.rubber.nu"}, "names.materials.rubber.E: it is the name"),
        ({"none": []}, "names.none"),
        ({"one": 1.0}, "names.one"),
    ],
)  # fmt: skip
def test_a_name_that_is_none_is_refused(names, words):
    assert words in refusal(names=names)


def test_names_of_what_a_change_took_away_go_with_it():
    coulomb = {"kind": "coulomb", "mu_s": 0.8, "mu_k": 0.7}
    changed = PAPER.override({"laws.steel_on_rubber.friction": coulomb})
    assert "contact.v_s" not in changed.names
    assert changed.names["contact.mu_s"] == PAPER.names["contact.mu_s"]
    with pytest.raises(ValueError, match=r"`contact.v_s` is not in the rig file"):
        changed.override({"contact.v_s": 1e-3})


@pytest.mark.parametrize("name", ["pad.Young", "pad", "E", "pad.E.x", "", "materials.rubber.Young"])
def test_an_unknown_name_is_refused(name):
    assert f"`{name}` is not in the rig file: " in refusal({name: 1.0})
    with pytest.raises(ValueError, match=rf"`{re.escape(name)}` is not in the rig file"):
        PAPER.unit_of(name)


# sources, units and the table
# ----------------------------------------------------------------------


def test_a_number_that_is_changed_loses_its_source():
    for name in ("materials.rubber.E", "pad.E"):
        changed = PAPER.override({name: 8e5})
        gone = PAPER.sources.keys() - changed.sources.keys()
        assert gone == {"materials.rubber.E"}
        assert changed.table()["materials.rubber.E"]["source"] == "assumed"
        assert changed.override({name: 0.75e6}).sources == changed.sources
    assert PAPER.override(materials={"rubber": {"E": 8e5}}).sources == changed.sources
    assert PAPER.override({"pad.E": 0.75e6}).sources == PAPER.sources  # the same number
    kept = PAPER.override({"motion.x_d.values_2": 41e-3})
    assert PAPER.sources.keys() - kept.sources.keys() == {"motion.x_d.values"}


@pytest.mark.parametrize(
    ("sources", "words"),
    [
        (
            {"materials.rubber.E": "measured"},
            'sources.materials.rubber.E: it should begin with "pu',
        ),
        ({"materials.rubber.G": "assumed"}, "sources.`materials.rubber.G` is not in the rig file"),
    ],
)
def test_a_source_that_is_none_is_refused(sources, words):
    assert words in refusal(sources=sources)


def test_the_table_tells_published_from_assumed():
    table = PAPER.table()
    published = {name for name, row in table.items() if row["source"].startswith("published: ")}
    assert published == {
        "bodies.disc.shape.radius", "bodies.disc.start.x", "pads.L.length", "pads.L.height",
        "pads.U.length", "pads.U.height", "actuators.x.Kp", "actuators.x.Kd", "actuators.y.Kp",
        "actuators.y.Kd", "motion.x_d.times", "motion.x_d.values", "motion.y_d.times",
        "motion.y_d.values",
    }  # fmt: skip
    assert {row["source"].partition(":")[0] for row in table.values()} == {"published", "assumed"}
    assert table["bodies.disc.shape.radius"] == {
        "value": 19.37e-3, "unit": "m", "source": "published: radius of the disc",
        "meaning": "radius",
    }  # fmt: skip
    assert all(row["unit"] and row["meaning"] for row in table.values())


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("materials.rubber.E", "Pa"), ("pad.E", "Pa"), ("contact.mu_s", "1"), ("gravity", "m/s2"),
        ("actuators.x.Kp", "N/m"), ("control.R_99", "N.s/m"), ("motion.F_ff.values", "N"),
        ("motion.x_d.values_2", "m"), ("motion.x_d.times", "s"), ("pad.elements_x", "1"),
        ("bodies.bracket.theta", "rad"), ("outputs.duration", "s"),
    ],
)  # fmt: skip
def test_an_entry_has_a_unit(name, unit):
    assert PAPER.unit_of(name) == unit


def test_units_of_gains_follow_what_they_push():
    file = RigFile.ready("two_fingers")
    assert file.unit_of("actuators.left_turn.Kp") == "N.m/rad"
    assert file.unit_of("actuators.left_turn.Kd") == "N.m.s/rad"
    assert file.unit_of("motion.lean.values") == "rad"
    assert RigFile.ready("orientation").unit_of("actuators.turn_lower.Kp") == "N/rad"


# changes
# ----------------------------------------------------------------------

CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "pad.E": st.floats(1e4, 1e9),
        "pad.nu": st.floats(-0.9, 0.4999),
        "pad.tau": st.floats(1e-4, 1.0),
        "pad.elements_x": st.integers(4, 1000),
        "pad.inertial": st.booleans(),
        "contact.K_n": st.floats(1e-3, 1e9),
        "contact.v_s": st.floats(0.1, 10.0),
        "control.senses": st.sampled_from(["disc.x", "bracket.x"]),
        "motion.x_d.values": st.lists(st.floats(0.04, 0.08), min_size=4, max_size=4),
        "gravity": st.floats(0.0, 30.0),
    },
)


@given(changes=CHANGES)
def test_changes_arrive_and_undo(changes):
    changed, before = PAPER.override(changes), PAPER.table()
    after = changed.table()
    full = {name: value for key, value in changes.items() for name in PAPER.full(key)}
    for name in before:
        value = full.get(name, before[name]["value"])
        assert after[name]["value"] == (tuple(value) if isinstance(value, list) else value)
    back = {name: row["value"] for name, row in before.items() if name in full}
    undone = changed.override(back)
    assert {name: row["value"] for name, row in undone.table().items() if name in before} == {
        name: row["value"] for name, row in before.items()
    }
    assert changed.override(full) == changed


def test_names_replace_what_is_there_and_tables_merge():
    one = PAPER.override({"pad.E": 8e5}, outputs={"duration": 0.1, "snapshots": []})
    assert (one.materials["rubber"].E, one.outputs.duration) == (8e5, 0.1)
    assert one.outputs.interval == PAPER.outputs.interval
    merged = PAPER.override(motion={"y_d": {"values_2": 48e-3}})
    assert merged.motion["y_d"].values == ("start", 48e-3)
    assert PAPER.override({"motion.y_d.values_2": 48e-3}) == merged
    assert PAPER.override({"motion.y_d.values.1": 48e-3}) == merged  # as in files of before
    with pytest.raises(ValueError, match=r"it has motion\.y_d\.values_1 to _2"):
        PAPER.override({"motion.y_d.values_7": 48e-3})
    hold = PAPER.override({"motion.y_d": {"kind": "hold", "value": 50e-3}})
    assert hold.motion["y_d"].model_dump() == {"kind": "hold", "value": 50e-3}
    assert PAPER.override(motion={"y_d": {"kind": "hold", "value": 50e-3}}) == hold
    assert PAPER.override() == PAPER.override({}) == PAPER


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"pad.E": -1.0}, "materials.rubber.E: should be from 1 to"),
        ({"pad.E": "soft"}, "materials.rubber.E should be a valid number"),
        ({"pad.nu": 0.5}, "materials.rubber.nu: should be from"),
        ({"pad.elements_x": 0}, "pads.L.elements_x: should be from 1"),
        ({"pad.elements_y": 120.5}, "pads.L.elements_y should be"),
        ({"pad.inertial": "perhaps"}, "pads.L.inertial"),
        ({"control.senses": "disc.z"}, "actuators.x.measures"),
        ({"pads.L.length": 10**400}, "pads.L: length should be a valid number"),
        ({"laws.steel_on_rubber.friction.kind": "stribeck"}, "laws.steel_on_rubber.friction"),
    ],
)
def test_impossible_values_are_refused_by_their_full_names(values, words):
    assert words in refusal(values)


def test_kinetic_friction_above_static_is_refused():
    message = refusal({"contact.mu_k": 0.9})
    assert "laws.steel_on_rubber.friction" in message
    assert "0.9" in message
    assert "0.8" in message
    assert PAPER.override({"contact.mu_k": 0.8}).laws["steel_on_rubber"].friction.mu_k == 0.8


# ready rigs, and runs
# ----------------------------------------------------------------------


def test_ready_rigs_have_names(tmp_path):
    assert {"paper", "two_fingers", "drop"} <= set(ready())
    assert RigFile.ready("paper") == RigFile.from_toml(READY / "paper.toml") == PAPER
    with pytest.raises(ValueError, match=r"there is no ready rig `papers`; did you mean `paper`"):
        RigFile.ready("papers")
    assert RigFile.path("paper") == READY / "paper.toml"
    (tmp_path / "paper").write_text("")  # a file comes first
    assert RigFile.path("paper", tmp_path) == tmp_path / "paper"
    (tmp_path / "mine.toml").write_text("")
    assert RigFile.path("mine.toml", tmp_path) == tmp_path / "mine.toml"
    with pytest.raises(ValueError, match=r"mine\.tom: No such file .*; the ready rigs are drop, "):
        RigFile.path("mine.tom", tmp_path)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("E = 1e6", "`E` is not known here"),
        ("[bodies.disc]\nmas = 1.0", "bodies.disc: `mas` is not known here"),
        ("[materials.rubber]\nE = soft", "line 2"),
        ('[channels]\ntheta = "theta_C"', "say [names], the short name first"),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_its_name(text, named, tmp_path):
    path = tmp_path / "soft.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"soft\.toml") as error:
        RigFile.from_toml(path)
    assert named in str(error.value).removeprefix(str(path))


def built(**outputs: Any) -> BuiltRig:
    short = {"duration": 0.03, "snapshots": ()} | outputs
    return PAPER.override(COARSE, outputs=short).build()


def test_a_built_rig_runs_as_its_file_says():
    one = built(interval=0.015)
    rig, y0, t = one
    assert (rig, y0, t) == (one.rig, one.y0, one.t)
    assert t.tolist() == pytest.approx([0.0, 0.015, 0.03])
    run = one.run()
    assert torch.equal(run.t, t)
    assert torch.equal(run.y[0], y0)
    assert torch.equal(one.run(times(0.01, 2)).t, times(0.01, 2))


def test_a_choice_of_steps_replaces_the_files():
    one = PAPER.override(
        COARSE, outputs={"duration": 0.03, "snapshots": ()}, solver={"step": 5e-3}
    ).build()
    assert one.run().stats.steps == 6
    assert one.run(step=2.5e-3).stats.steps == 12
    assert one.run(rtol=1e-4).stats.steps != 6


def test_a_run_may_begin_elsewhere():
    one = built()
    y0 = one.rig.state(disc={"x": 61e-3, "y": "rest"}, bracket={"x": 61e-3, "y": "touch"})
    assert one.run(times(0.01, 2), y0=y0)["x_C"][0] == 61e-3


def test_the_start_follows_the_parameters():
    """Differentiable, and that of the file as long as nothing was changed."""
    one = built()
    assert (one.start() - one.y0).abs().max() < 1e-12
    radius = one.rig.parameter("disc.radius")
    height = one.rig.layout.slices["pose", "disc"].start + 1
    (slope,) = torch.autograd.grad(one.start()[height], radius)
    with torch.no_grad():
        radius.copy_(radius + 1e-6)
        moved = one.start()
        made = PAPER.override(COARSE | {"disc.radius": radius.item()}).build()
    assert (moved - made.y0).abs().max() < 1e-12
    assert slope.item() == pytest.approx((moved - one.y0)[height].item() / 1e-6, rel=1e-4)
    assert 0.9 < slope.item() < 1.1


def test_a_source_of_a_number_that_has_its_default_stays():
    """It was a KeyError, wherever tables of the file were changed."""
    tables = RigFile.ready("paper").model_dump(exclude_unset=True)
    del tables["actuators"]["x"]["Kd"]
    name = "actuators.x.Kd"
    file = RigFile.from_tree(tables).override(outputs={"duration": 0.5, "snapshots": []})
    assert name in file.sources
    changed = file.override({name: 3.0})
    assert name not in changed.sources
    assert "actuators.x.Kp" in changed.sources
