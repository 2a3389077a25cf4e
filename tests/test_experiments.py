"""Every program of `experiments` at smoke size, with the claims that it is for; the tables of the
pages are those of the stored results."""

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from statistics import mean, median
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from conftest import COARSE, paper

from experiments import tables
from experiments.frame import Table, numbers, write
from experiments.validation.rolling_resistance import layer_compliance

Claims = Callable[[Any], None]
SMOKE: dict[str, Claims] = {}


def program(name: str) -> ModuleType:
    folder = (
        "" if name in ("grasp_and_roll", "identify_contact", "reduced_model") else "validation."
    )
    return import_module(f"experiments.{folder}{name}")


def claims(check: Claims) -> Claims:
    """What the program of the same name claims, of its summary."""
    SMOKE[check.__name__] = check
    return check


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOKE)
def test_a_program_keeps_its_claims_at_smoke_size(name, tmp_path):
    module = program(name)
    module.main(module.Config(out=tmp_path, smoke=True))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["tables"]
    assert not list(tmp_path.glob("*partial*"))
    SMOKE[name](summary)


def near(value: float, **how: Any) -> Any:
    return pytest.approx(value, **how)


@claims
def grasp_and_roll(found):
    """Locked-in friction stiffens the pads; a share of F_x is the mesh's."""
    default, paper_like = found["default"], found["paper_like"]
    assert default["y_C in the grasp, 0.375 s [mm]"] == near(23.20, abs=0.01)
    assert default["y_Br from 0.5 s on, highest [mm]"] == near(48.6, abs=0.002)
    force = "grasping force fed forward [N]"
    assert default[force] > paper_like[force] + 5
    assert (default["x_C(0 s) [mm]"], default["x_C(10 s) [mm]"]) == (60.0, None)
    assert default["energy residual / injected"] < 2e-4
    on_nodes = default["peak horizontal force F_x [N], contact points on nodes"]
    assert 0 < default["the same, 4 points an element"] < 0.9 * on_nodes


@claims
def step_accuracy(found):
    """Motion, forces and gradients come nearer with the tolerance."""
    (rows,) = found["motions"].values()
    loose, tight, equal = rows.values()
    assert all(tight[name] < loose[name] for name in ("x_C", "effort_y", "gradient"))
    usual = median(tight["gradients"].values())  # the worst, of mu_s, is as rough as the roundings
    assert usual < min(0.02, 0.2 * median(loose["gradients"].values()))
    assert loose["steps"] < tight["steps"]
    assert equal["refused"] == 0


@claims
def identify_contact(found):
    """Without noise the truth, with noise the truth within what was predicted."""
    cases = {case["case"]: case for case in found["cases"]}
    assert all(abs(p["error"]) < 1e-3 for p in cases["noise-free"]["parameters"].values())
    for name, p in cases["noisy"]["parameters"].items():
        assert abs(p["error"]) < 3.5 * p["relative_sd"], name
    assert max(cases["noisy"]["heldout_nrmse"]["shaking"].values()) < 0.05


@claims
def interval_coverage(found):
    """Errors of a few standard deviations, not of many: two seeds are too few for a share."""
    errors = {
        case: [abs(e) for one in row["parameters"].values() for e in one["errors"]]
        for case, row in found["cases"].items()
    }
    white, coloured = mean(errors["white"]), mean(errors["coloured"])
    assert 0.1 < min(white, coloured) < max(white, coloured) < 2
    assert found["cases"]["white"]["notices"] == {}
    assert max(errors["two fingers"] + errors["two jaws"]) < 4


@claims
def foreign_rigs(found):
    """Recordings of the same rig hold; a flipped sign is named."""
    same, flipped = found["cases"]
    assert found["silent"] == 0
    assert (same["verdicts"], same["held"]) == ({"holds": 1}, same["of"])
    assert flipped["named"] == 1


@claims
def rolling_resistance(found):
    """Force and power give one resistance, near theory's, with a peak."""
    (rubber,), (light,) = found["by speed"].values(), found["by load"].values()
    low, top, high = rubber.values()
    for one in (low, top, high):
        assert abs(one["power / force - 1"]) < 0.01
        assert 0.97 < one["measured / theory"] < 1.06
    assert top["measured"] > 1.2 * max(low["measured"], high["measured"])
    assert light["measured / theory"] == near(1.01, abs=0.02)


def test_compliance_of_a_layer_has_both_limits():
    """Long waves compress a layer uniaxially, short ones see a half-plane."""
    h, nu = 4e-3, 0.3
    long, deep, deeper = layer_compliance(np.array([1e-3, 11.9, 12.1]) / h, h, nu)
    assert long[1, 1].real == near(h * (1 + nu) * (1 - 2 * nu) / (1 - nu), rel=1e-5)
    assert np.abs(deeper / deep * 12.1 / 11.9 - 1).max() < 1e-6


@claims
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
    assert roll["Q / (mu P)"] == near(0.5, abs=1e-3)
    assert abs(roll["off"]) < 5e-3


@claims
def peers(found):
    """Positions after a slide are theory's, and their derivatives but for the ripple of nodes."""
    table = found["tables"]["torchsoft"]
    off = {
        name: float(cell.rstrip("%")) for name, cell in zip(table["head"][1:], table["rows"][0][1:])
    }
    assert max(abs(off[name]) for name in ("block: x", "rolls: x")) < 0.2
    assert max(abs(off[name]) for name in ("block: dx/dmu", "block: dx/dv")) < 0.5
    assert abs(off["rolls: dx/dmu"]) < 5


@claims
def gradient_accuracy(found):
    """The windows are what they are called, and errors are 1e-6 where the judge is that good."""
    slip, stick, grasp = (found["windows"][name] for name in ("slip", "stick", "grasp"))
    assert slip["events"]["slip_onsets"] > 0
    assert stick["events"]["slip_onsets"] + stick["events"]["touch"] == 0
    assert grasp["events"]["touch"] > 3
    for window in (slip, stick):
        errors, unsure = window["relative_error"], window["judge_uncertainty"]
        assert max(errors[name] for name in errors if unsure[name] <= 1e-6) <= 1e-6


@claims
def reduced_model(found):
    """What is found agrees with mechanics, and with the full model where it is used."""
    radius = found["rolling_radius_mm"]
    assert found["terms"] <= 10
    assert found["heldout_nrmse"] < 0.02
    assert radius["found"] == near(radius["expected"], rel=0.03)
    rows = {(row["equation"], row["term"]): row for row in found["coefficients"]}
    for term in ("x_Br - 2 x_C", "v_Br - 2 v_C"):
        row = rows["v_C", term]
        assert abs(row["error"]) < 0.1
        assert row["interval"][0] < row["value"] < row["interval"][1]
    assert rows["v_Br", "F_x"]["value"] == near(1 / 0.4065, rel=0.05)


@pytest.mark.slow
def test_the_inertia_of_pads_changes_nothing_that_can_be_measured():
    """Nanometres of the disc and millinewtons of the force, in a grasp on a coarse mesh."""
    massless, inertial = (
        paper(COARSE | {"pad.inertial": how}).run(np.linspace(0.0, 0.8, 81), step=2e-3)
        for how in (False, True)
    )
    for channel, most in (("x_C", 2e-8), ("y_C", 2e-8), ("effort_y", 1e-2)):
        assert (massless[channel] - inertial[channel]).abs().max() < most, channel


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
    module = program("step_accuracy")
    mark = "<!-- table step_accuracy motion -->\nold\n<!-- end -->\n"
    config = module.Config(out=tmp_path / "step_accuracy")
    write(config, {}, {"motion": numbers("way", {"rtol = 1e-3": {"error": 0.5}})})
    tables.store(config.out / "summary.json")
    page = tables.filled(mark)
    assert str(Table(("way", "error"), [("rtol = 1e-3", "0.5")])) in page
    assert "Commit: " in page
    with pytest.raises(ValueError, match="no table 'other'"):
        tables.filled(mark.replace("motion", "other"))
    write(module.Config(out=config.out, smoke=True), {}, {})
    with pytest.raises(ValueError, match="give the summary of a whole run"):
        tables.store(Path(config.out) / "summary.json")
