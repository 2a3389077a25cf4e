"""Every program of `experiments` at smoke size, with claims that no other test makes; the tables of
the pages are those of the stored results."""

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from conftest import COARSE, paper

from experiments import tables
from experiments.frame import Table, numbers, write
from experiments.validation import step_accuracy
from experiments.validation.rolling_resistance import layer_compliance

# what a program claims of its summary
# ----------------------------------------------------------------------


def foreign_rigs(found):
    """Recordings of the same rig hold; a flipped sign is named."""
    same, flipped = found["cases"]
    assert found["silent"] == 0
    assert (same["verdicts"], same["held"]) == ({"holds": 1}, same["of"])
    assert flipped["named"] == 1


def rolling_resistance(found):
    """Force and power give one resistance, near theory's, with a peak."""
    (rubber,), (light,) = found["by speed"].values(), found["by load"].values()
    low, top, high = rubber.values()
    for one in (low, top, high):
        assert abs(one["power / force - 1"]) < 0.01
        assert 0.97 < one["measured / theory"] < 1.06
    assert top["measured"] > 1.2 * max(low["measured"], high["measured"])
    assert light["measured / theory"] == pytest.approx(1.01, abs=0.02)


def test_compliance_of_a_layer_has_both_limits():
    """Long waves compress a layer uniaxially, short ones see a half-plane."""
    h, nu = 4e-3, 0.3
    long, deep, deeper = layer_compliance(np.array([1e-3, 11.9, 12.1]) / h, h, nu)
    assert long[1, 1].real == pytest.approx(h * (1 + nu) * (1 - 2 * nu) / (1 - nu), rel=1e-5)
    assert np.abs(deeper / deep * 12.1 / 11.9 - 1).max() < 1e-6


def contact_theory(found):
    """Sliding, spin, Hertz, partial slip and creep are the textbook's to a percent or less."""
    assert abs(found["slopes"]["20"]["found [m/s2]"]) < 1e-4  # it sticks
    assert abs(found["slopes"]["45, smooth law"]["off"]) < 1e-3
    (row,), (roll,) = found["sizes"].values(), found["rolling"].values()
    assert max(abs(row[k]) for k in ("stop", "spin's rate", "spin of rolling")) < 3e-3
    circle, slid = found["pressure"]["20 elements"], found["partial slip"]["20 elements"]
    assert max(abs(circle["Hertz: a"]), abs(circle["Hertz: p_0"])) < 4e-3
    for part in ("way", "turn", "return"):
        assert abs(slid[f"c, {part}"]) < 3e-3
        assert abs(slid[f"shear, {part}"]) < 0.02
    assert found["pressure"]["40 elements, springs 400 E*/a"]["punch: p"] < 3e-3
    assert roll["Q / (mu P)"] == pytest.approx(0.5, abs=1e-3)
    assert abs(roll["off"]) < 5e-3


def peers(found):
    """Positions after a slide are theory's, and their derivatives but for the ripple of nodes."""
    table = found["tables"]["torchsoft"]
    off = {
        name: float(cell.rstrip("%")) for name, cell in zip(table["head"][1:], table["rows"][0][1:])
    }
    assert max(abs(off[name]) for name in ("block: x", "rolls: x")) < 0.2
    assert max(abs(off[name]) for name in ("block: dx/dmu", "block: dx/dv")) < 0.5
    assert abs(off["rolls: dx/dmu"]) < 5


@pytest.mark.slow
def test_the_inertia_of_pads_changes_nothing_that_can_be_measured():
    """Nanometres of the disc and millinewtons of the force, in a grasp on a coarse mesh."""
    massless, inertial = (
        paper(COARSE | {"pad.inertial": how}).run(np.linspace(0.0, 0.8, 81), step=2e-3)
        for how in (False, True)
    )
    for channel, most in (("x_C", 2e-8), ("y_C", 2e-8), ("effort_y", 1e-2)):
        assert (massless[channel] - inertial[channel]).abs().max() < most, channel


SMOKE = {
    "grasp_and_roll": len, "identify_contact": len, "reduced_model": len,
    "validation.step_accuracy": len, "validation.gradient_accuracy": len,
    "validation.interval_coverage": len, "validation.foreign_rigs": foreign_rigs,
    "validation.rolling_resistance": rolling_resistance,
    "validation.contact_theory": contact_theory, "validation.peers": peers,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOKE)
def test_a_program_keeps_its_claims_at_smoke_size(name, tmp_path):
    module = import_module(f"experiments.{name}")
    module.main(module.Config(out=tmp_path, smoke=True))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["tables"]
    assert not list(tmp_path.glob("*partial*"))
    SMOKE[name](summary)


# frame and tables
# ----------------------------------------------------------------------


@pytest.mark.parametrize("page", tables.PAGES)
def test_the_tables_of_a_page_are_those_of_the_results(page):
    text = (tables.ROOT / page).read_text(encoding="utf-8")
    assert "<!-- table" in text
    assert tables.filled(text) == text


def test_a_summary_becomes_a_table_with_its_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "RESULTS", tmp_path / "results")
    tables.RESULTS.mkdir()
    mark = "<!-- table step_accuracy motion -->\nold\n<!-- end -->\n"
    config = step_accuracy.Config(out=tmp_path / "step_accuracy")
    write(config, {}, {"motion": numbers("way", {"rtol = 1e-3": {"error": 0.5}})})
    tables.store(config.out / "summary.json")
    page = tables.filled(mark)
    assert str(Table(("way", "error"), [("rtol = 1e-3", "0.5")])) in page
    assert "Commit: " in page
    with pytest.raises(ValueError, match="no table 'other'"):
        tables.filled(mark.replace("motion", "other"))
    write(step_accuracy.Config(out=config.out, smoke=True), {}, {})
    with pytest.raises(ValueError, match="give the summary of a whole run"):
        tables.store(Path(config.out) / "summary.json")
