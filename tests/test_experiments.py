"""Every experiment at smoke size, and the number it stands for."""

import json
import math
import sys
from importlib import import_module
from pathlib import Path
from statistics import median
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from conftest import f64

from torchsoft import Ellipse

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
FOLDERS = EXPERIMENTS, EXPERIMENTS / "validation"
sys.path[:0] = map(str, FOLDERS)  # as for a script; modules of an experiment lie beside it


def experiment(name: str) -> ModuleType:
    """The experiment's file as a module; the folder is not a package."""
    module = import_module(name)
    assert Path(str(module.__file__)).parent in FOLDERS
    return module


def smoke(name: str, out: Path) -> tuple[ModuleType, dict[str, Any]]:
    """An experiment carried out at smoke size, and its summary."""
    module = experiment(name)
    run = module.main if hasattr(module, "main") else module.run
    run(module.Config(out=out, smoke=True))
    return module, json.loads((out / "summary.json").read_text())


def test_grasp_and_roll_smoke(tmp_path):
    module, numbers = smoke("grasp_and_roll", tmp_path)
    assert numbers["y_C_grasp_mm"] == pytest.approx(23.20, abs=0.01)
    assert numbers["y_Br_hold_mm"]["max"] == pytest.approx(48.6, abs=0.002)
    assert (
        numbers["grasp_force_N"] > numbers["paper_like"]["grasp_force_N"] + 5
    )  # locked-in friction stiffens the pads
    assert numbers["x_C_mm"]["0"] == 60.0
    assert numbers["x_C_mm"]["10"] is None
    assert numbers["energy_residual_rel"] < 2e-4
    assert numbers["config"]["smoke"] is True
    assert module.FIGURE_16 == (0.375, 2.5, 5.0, 7.5, 10.0, 17.5, 20.0, 22.5, 25.0)
    assert {"effort_x", "effort_y"} <= {channel for _, channel, *_ in module.CURVES}
    names = {path.name for path in tmp_path.iterdir()}
    assert {
        "trajectory.nc",
        "force_distribution_0.125s.png",
        "multibond.dot",
        "animation.gif",
        "snapshots.png",
    } <= names
    assert not [name for name in names if "partial" in name]
    lines = module.table(numbers).splitlines()
    assert lines[1].startswith("| ---")
    assert "23.20" in next(line for line in lines if "y_C in the grasp" in line)
    finer = numbers["F_x_peak_finer_N"]
    assert f"{finer:.3f}" in next(line for line in lines if "4 points an element" in line)
    assert 0 < finer < 0.9 * numbers["F_x_peak_N"]


def test_pad_fidelity_smoke(tmp_path):
    """Inertia changes the disc by nanometres and the forces by millinewtons, and more in a fast
    stroke; the mesh moves the grasp by little."""
    module = experiment("pad_fidelity")
    result = module.run(module.Config(out=tmp_path, smoke=True))
    slow, fast, mesh = result.values()
    assert slow["y_C"]["difference"] < 0.02  # [um]
    assert slow["effort_y"]["difference"] < 10  # [mN]
    assert fast["x_C"]["difference"] > slow["x_C"]["difference"]
    assert mesh["y_C"]["difference"] < 30  # [um]
    assert "| effort_y | mN |" in module.table(result)


def test_step_accuracy_smoke(tmp_path):
    """Motion, forces and gradients come nearer with the tolerance; the table holds every way."""
    module = experiment("step_accuracy")
    (rows,) = module.run(module.Config(out=tmp_path, smoke=True)).values()
    loose, tight, equal = rows.values()
    for name in ("x_C", "effort_y", "gradient"):
        assert tight[name] < loose[name]
    usual = median(tight["gradients"].values())  # the worst, of mu_s, is as rough as the roundings
    assert usual < 0.02
    assert usual < 0.2 * median(loose["gradients"].values())
    assert loose["steps"] < tight["steps"]
    assert equal["refused"] == 0
    assert module.table(rows).count("|\n") == 4


@pytest.mark.slow
def test_benchmark_smoke(tmp_path):
    """A sweep costs less than two runs, a Jacobian less than four; every part has its place in the
    summary."""
    module = experiment("benchmark")
    config = module.Config(out=tmp_path, duration=3.0, exact=1e-6, repeats=3)
    costs = module.costs(config)
    for way in module.ways(config):
        assert costs[way]["gradient over run"] < 2
        assert costs[way]["Jacobian for 8 over run"] < 4
    loose, tight, *_ = (costs[way]["x_C"] for way in module.ways(config))
    assert tight < loose
    found = module.run(module.Config(out=tmp_path, smoke=True))
    assert found["batches"]["2 runs of 0.2 s, 2 threads"]["failures"] == 0
    assert list(found["growth"]["wall_s"]) == ["61", "121"]
    assert "| 2 runs of 0.2 s, 2 threads |" in module.tables(found)


@pytest.mark.slow
def test_peers_smoke():
    """Every integrator reaches the stepper's solution with the compiled right-hand side."""
    pytest.importorskip("diffrax")
    module = experiment("benchmark")
    numbers = module.peers(module.Config(window=5e-3, repeats=1, smoke=True))
    for rows in numbers["equal"].values():
        assert all(row is not None for row in rows.values())
    assert "scipy LSODA" in module.peers_table(numbers)


def test_experiment_design_smoke(tmp_path):
    """Jerks of a light grasp see friction and dashpots better than strokes; together they see more
    than either alone."""
    module, summary = smoke("experiment_design", tmp_path)
    single = {row["names"][0]: row["sd"] for row in summary["single"]}
    both = summary["together"][0]["sd"]
    R_n = "laws.steel_on_rubber.R_n"
    assert single["jerks, light"][R_n] < single["strokes"][R_n]
    assert all(both[name] <= min(sd[name] for sd in single.values()) for name in module.NAMES)
    assert all(row["inconsistency"] < module.CONSISTENT for row in summary["single"])


@pytest.mark.slow
def test_identify_contact_smoke(tmp_path):
    """Without noise the truth, with noise the truth within what was predicted, by differences the
    same at more runs."""
    _, summary = smoke("identify_contact", tmp_path)
    cases = {case["case"]: case for case in summary["cases"]}
    assert all(abs(p["relative_error"]) < 1e-3 for p in cases["noise-free"]["parameters"].values())
    for name, p in cases["noisy"]["parameters"].items():
        assert abs(p["relative_error"]) < 3.5 * p["relative_sd"], name
        again = cases["finite differences"]["parameters"][name]
        assert again["estimate"] == pytest.approx(
            p["estimate"], rel=0.4 * p["relative_sd"]
        )  # each rests within 0.2
    assert max(cases["noisy"]["heldout_nrmse"]["shaking"].values()) < 0.05
    assert cases["finite differences"]["simulations"] > 2 * cases["noisy"]["jacobians"]
    assert (tmp_path / "report.html").exists()


@pytest.mark.slow
def test_identify_by_touch_smoke(tmp_path):
    """Taxels shrink every interval, shear shrinks it further, and the fits are within theirs."""
    _, summary = smoke("identify_by_touch", tmp_path)
    without, _, normal, shear = summary["relative_sd"]["strokes"].values()
    for name, sd in without.items():
        assert sd > 1.5 * normal[name] > 2 * shear[name], name
    for fit in summary["fits"].values():
        assert max(abs(one["error_in_sd"]) for one in fit.values()) < 3.5
    assert max(summary["chi2"].values()) == pytest.approx(1.0, abs=0.1)
    assert summary["jacobian"]["ratio"] < 2.0  # one timing in a test


@pytest.mark.slow
def test_interval_coverage_smoke(tmp_path):
    """Errors of a few standard deviations, not of many: two seeds are too few for a share. Colour
    is found where it is, and rig files are identified by their names."""
    module, summary = smoke("interval_coverage", tmp_path)
    cases = summary["cases"]
    errors = {
        case: [abs(e) for one in row["parameters"].values() for e in one["errors"]]
        for case, row in cases.items()
    }
    mean = {case: sum(some) / len(some) for case, some in errors.items()}
    assert 0.1 < mean["white"] < 2
    assert 0.1 < mean["coloured"] < 2
    assert mean["coloured, ignored"] > 1.5 * mean["coloured"]
    assert cases["white"]["notices"] == cases["white"]["orders"] == {}
    assert sum(cases["coloured"]["orders"].values()) == 14
    for name, lab in (("two fingers", module.FINGERS), ("two jaws", module.JAWS)):
        assert list(cases[name]["parameters"]) == list(lab.truth)[:3]
        assert max(errors[name]) < 4


@pytest.mark.slow
def test_contact_points_smoke(tmp_path):
    """Two points an element take most of the nodes out of the force along the pad."""
    _, summary = smoke("contact_points", tmp_path)
    nodes, between = (summary["cases"][name] for name in ("1 mm, nodes", "1 mm, 2"))
    name = "static ripple of the force along the pad [mN]"
    assert between[name] < 0.3 * nodes[name]


@pytest.mark.slow
def test_orientation_smoke(tmp_path):
    """Loops turn and carry the disc within the tolerance; what they do not do is as rigid statics
    say, and is said."""
    _, summary = smoke("orientation", tmp_path)
    alone, fed = summary["loops_alone"], summary["efforts_fed_forward"]["ellipse 1.3"]
    assert alone["disc"]["verdict"] == fed["verdict"] == "within"
    assert (
        alone["disc, by kinematics"]["rest_deg"] > 1.0
    )  # soft pads do not roll with the disc's radius
    ellipse, asks = alone["ellipse 1.3"], summary["rigid"]["ellipse 1.3"]
    stiffness = summary["gains"]["turn_lower"]["Kp"] * math.pi / 180  # [N/deg]
    assert ellipse["verdict"] == "beyond"
    assert ellipse["angle_deg"] == pytest.approx(asks["effort"] / stiffness, rel=0.25)
    assert ellipse["friction"] == pytest.approx(asks["friction"], rel=0.1)
    assert ellipse["opening_mm"] == pytest.approx(asks["opening_mm"], rel=0.05)
    assert summary["frictions"]["0.2"]["verdict"] == "lost"  # its friction cone asks for 0.29
    assert summary["speeds"]["6.0"]["verdict"] == "beyond"
    assert summary["speeds"]["6.0"]["position_mm"] == pytest.approx(
        summary["inertia_alone_mm_deg"]["6.0"][0], rel=0.2
    )
    assert summary["frictions"]["0.2"]["stopped"].startswith("at t = ")
    assert {"snapshots.png", "orientation.gif", "ellipse.gif"} <= {
        x.name for x in tmp_path.iterdir()
    }


def test_orientation_rig_has_the_gains_of_its_design():
    """The gains in the file are those of the experiment's bandwidth; rigid statics are the closed
    form of an ellipse."""
    module = experiment("orientation")
    file = module.READY
    for name, gains in module.design(file, 150.0).items():
        assert file.actuators[name].Kp == pytest.approx(gains["Kp"], rel=1e-2)
        assert file.actuators[name].Kd == pytest.approx(gains["Kd"], rel=1e-2)
    asks = module.rigid(Ellipse(20e-3, 10e-3), 10.0, 0.0)
    assert asks.friction == pytest.approx(0.75, rel=1e-3)  # (k^2 - 1) / 2 k at aspect k = 2
    assert asks.opening_mm == pytest.approx(20.0)


@pytest.mark.slow
def test_rolling_resistance_smoke(tmp_path):
    """Force and power give one resistance, near theory's, with a peak."""
    _, summary = smoke("rolling_resistance", tmp_path)
    (one,) = summary["resistance"].values()
    assert one["power over force less one, largest"] < 0.02
    assert 0.97 < min(one["force over theory"]) < max(one["force over theory"]) < 1.06
    low, top, high = (roll["force"] for roll in one["rolls"])
    assert top > 1.2 * max(low, high)  # the peak
    assert summary["by load"]["10 N"]["force over theory"] == pytest.approx(1.01, abs=0.02)
    assert {"rolling_resistance.png", "table.md"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.slow
def test_contact_theory_smoke(tmp_path):
    """Sliding, spin, Hertz, partial slip and creep are the textbook's to a percent or less."""
    _, found = smoke("contact_theory", tmp_path)
    assert abs(found["slopes"]["20"]["found [m/s2]"]) < 1e-4  # it sticks
    assert abs(found["slopes"]["45, smooth law"]["off"]) < 1e-3
    (row,) = found["sizes"]
    assert max(abs(row[k]) for k in ("stop", "spin's rate", "spin of rolling")) < 3e-3
    circle, slid = (found[name]["20 elements"] for name in ("hertz", "cattaneo"))
    assert max(map(abs, circle.values())) < 4e-3
    assert max(abs(slid[f"c, {part}"]) for part in ("way", "turn", "return")) < 3e-3
    assert max(abs(slid[f"shear, {part}"]) for part in ("way", "turn", "return")) < 0.02
    assert found["punch"]["40 elements, springs 400 E*/a"]["pressure"] < 3e-3
    (roll,) = found["carter"]
    assert roll["traction"] == pytest.approx(0.5, abs=1e-3)
    assert abs(roll["off"]) < 5e-3
    assert {"contact_theory.png", "table.md"} <= {path.name for path in tmp_path.iterdir()}


def test_compliance_of_a_layer_has_both_limits():
    """Long waves compress a layer uniaxially, short ones see a half-plane."""
    theory = experiment("rolling_resistance")
    h, nu = 4e-3, 0.3
    long, deep, deeper = theory.layer_compliance(np.array([1e-3, 11.9, 12.1]) / h, h, nu)
    assert long[1, 1].real == pytest.approx(h * (1 + nu) * (1 - 2 * nu) / (1 - nu), rel=1e-5)
    assert np.abs(deeper / deep * 12.1 / 11.9 - 1).max() < 1e-6


@pytest.mark.slow
def test_startup_smoke(tmp_path):
    """Kernels of the wheel are as good as loaded; those that are missing are compiled."""
    _, found = smoke("startup", tmp_path)
    assert found["wheel_s"]["first run"] < 0.2 * found["fallback_s"]["first run"]
    assert found["processes_s"]["import torchsoft"] < found["processes_s"]["import torch"]


def test_a_policy_becomes_a_controller(tmp_path):
    """Ranges of what it sees and does are folded into the network of the rig file."""
    module = experiment("learn_policy")
    env = module.environment()
    policy = module.network(4, 3, seed=0)
    rig = module.deployed(module.Config(out=tmp_path), policy, env).build().rig
    coordinates = f64(0.2, 1e-3, -2e-3, 3e-3, 0.04)
    rates = f64(0.5, -0.02, 0.1, -0.2, 0.03)
    goal = f64(-0.3, 0.0)
    seen = [1e-3 / 10e-3, 0.2, -0.02 / 0.1, 0.5 / 3.0, (-0.3 - 0.2) / 0.1, -1e-3 / 2e-3]
    lower, upper, grip = policy(f64(*seen)).tolist()
    expected = {
        "lower_x": 2e3 * (12e-3 * lower + 2e-3) - 60.0 * 0.1,
        "upper_x": 2e3 * (12e-3 * upper - 3e-3) + 60.0 * 0.2,
        "upper_y": -13.0 + 7.0 * grip,
    }
    given = goal, torch.zeros_like(goal), f64(0.0)[0], coordinates, rates
    for name, effort in expected.items():
        law = rig.actuators[f"policy_{name}"].law
        assert law(*given).item() == pytest.approx(effort, rel=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_learn_policy_smoke(tmp_path):
    module, numbers = smoke("learn_policy", tmp_path)
    assert {one["method"] for one in numbers["trainings"]} == set(module.METHODS)
    assert all(x < 2 for part in numbers["deployed"]["missed_rad"].values() for x in part)
    assert torch.jit.load(tmp_path / "policy.pt")(f64(*[0.0] * 6)).shape == (3,)


@pytest.mark.slow
def test_learn_dynamics_smoke(tmp_path):
    _, numbers = smoke("learn_dynamics", tmp_path)
    assert set(numbers["held out"]) == {"mu = 0.5", "constant, fitted", "network"}
    assert len(numbers["surrogate"]) == 6
    assert (tmp_path / "learn_dynamics.png").exists()


@pytest.mark.slow
def test_gradient_accuracy_smoke(tmp_path):
    """The windows are what they are called, and errors are 1e-6 where the judge is that good."""
    _, numbers = smoke("gradient_accuracy", tmp_path)
    assert set(numbers["windows"]) == {"stick", "slip", "make-break", "grasp", "full"}
    slip, stick, grasp = (numbers["windows"][name] for name in ("slip", "stick", "grasp"))
    assert slip["events"]["slip_onsets"] > 0
    assert stick["events"]["slip_onsets"] + stick["events"]["touch"] == 0
    assert grasp["events"]["touch"] > 3
    for window in (slip, stick):
        errors, unsure = window["relative_error"], window["judge_uncertainty"]
        assert max(errors[name] for name in errors if unsure[name] <= 1e-6) <= 1e-6
    assert (tmp_path / "table.md").read_text().count("|\n") == 7


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the reduced model contradicts mechanics")  # under slip
def test_reduced_model_smoke(tmp_path):
    """What is found agrees with mechanics, and with the full model where it is used."""
    module, numbers = smoke("reduced_model", tmp_path)
    stick, slip = numbers["stick"], numbers["slip"]
    assert stick["terms"] <= 10
    assert stick["heldout_nrmse"] < 0.02
    radius = stick["rolling_radius_mm"]
    assert radius["found"] == pytest.approx(radius["expected"], rel=0.03)
    found = {(row["equation"], row["term"]): row for row in stick["coefficients"]}
    for term in ("x_Br - 2 x_C", "v_Br - 2 v_C"):
        row = found["v_C", term]
        assert abs(row["error"]) < 0.1
        assert row["interval"][0] < row["value"] < row["interval"][1]
    assert found["v_Br", "F_x"]["value"] == pytest.approx(1 / 0.4065, rel=0.05)
    assert slip["heldout_nrmse"] < 0.1
    fastest = min(slip["by_stroke"], key=lambda row: row["stroke_time_s"])
    assert fastest["slipping"] > 0.5
    assert fastest["nrmse_linear"] > 2 * fastest["nrmse"]  # it needs saturation
    assert "| stick |" in module.table({"stick": stick, "slip": slip})


@pytest.mark.slow
def test_law_comparison_smoke(tmp_path):
    """Named where contacts slip, and not where they roll."""
    _, summary = smoke("law_comparison", tmp_path)
    *near, far, other = summary["cases"]
    assert [case["answer"] for case in (*near, far, other)] == ["right"] * 2 + ["cannot tell"] * 2
    assert min(case["D"] for case in near) > 7.3 > 1 > max(far["D"], other["D"])


@pytest.mark.slow
def test_finite_strain_smoke(tmp_path):
    _, numbers = smoke("finite_strain", tmp_path)
    more = {name: row["more"] for name, row in numbers["layer"].items()}
    assert 0.2 < more["nu 0.45, 25% of the height"] < more["nu 0.49, 25% of the height"] < 0.5
    assert 0.77 < numbers["manipulation"]["linear"]["E as stiff [MPa]"] < 0.9
    assert (tmp_path / "finite_strain.png").exists()
