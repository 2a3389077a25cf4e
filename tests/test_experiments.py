"""Every experiment at smoke size, with the claims that it is for."""

import json
import math
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from statistics import mean, median
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


Claims = Callable[[Any, ModuleType, Path], None]
SMOKE: dict[str, Claims] = {}


def claims(check: Claims) -> Claims:
    """What the experiment of the same name claims, of its summary, module and folder."""
    SMOKE[check.__name__] = check
    return check


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:the reduced model contradicts mechanics")  # under slip
@pytest.mark.parametrize("name", SMOKE)
def test_an_experiment_keeps_its_claims_at_smoke_size(name, tmp_path):
    module = experiment(name)
    config = module.Config(out=tmp_path, smoke=True)
    direct = name in ("pad_fidelity", "step_accuracy", "benchmark") or not hasattr(module, "main")
    summary = module.run(config) if direct else module.main(config)
    if (written := tmp_path / "summary.json").exists():
        summary = json.loads(written.read_text())
    SMOKE[name](summary, module, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert not [one for one in names if "partial" in one]


def near(value: float, **how: Any) -> Any:
    return pytest.approx(value, **how)


@claims
def grasp_and_roll(found, module, out):
    assert found["y_C_grasp_mm"] == near(23.20, abs=0.01)
    assert found["y_Br_hold_mm"]["max"] == near(48.6, abs=0.002)
    paper = found["paper_like"]["grasp_force_N"]
    assert found["grasp_force_N"] > paper + 5  # locked-in friction stiffens the pads
    assert (found["x_C_mm"]["0"], found["x_C_mm"]["10"]) == (60.0, None)
    assert found["energy_residual_rel"] < 2e-4
    assert {"trajectory.nc", "animation.gif"} < {path.name for path in out.iterdir()}
    assert 0 < found["F_x_peak_finer_N"] < 0.9 * found["F_x_peak_N"]  # a share is the mesh's


@claims
def pad_fidelity(found, module, out):
    """Inertia changes the disc by nanometres and the forces by millinewtons, and more in a fast
    stroke; the mesh moves the grasp by little."""
    slow, fast, mesh = (one for one in found.values() if isinstance(one, dict) and "x_C" in one)
    assert slow["y_C"]["difference"] < 0.02  # [um]
    assert slow["effort_y"]["difference"] < 10  # [mN]
    assert fast["x_C"]["difference"] > slow["x_C"]["difference"]
    assert mesh["y_C"]["difference"] < 30  # [um]


@claims
def step_accuracy(found, module, out):
    """Motion, forces and gradients come nearer with the tolerance."""
    (rows,) = (one for one in found.values() if isinstance(one, dict) and len(one) == 3)
    loose, tight, equal = rows.values()
    assert all(tight[name] < loose[name] for name in ("x_C", "effort_y", "gradient"))
    usual = median(tight["gradients"].values())  # the worst, of mu_s, is as rough as the roundings
    assert usual < min(0.02, 0.2 * median(loose["gradients"].values()))
    assert loose["steps"] < tight["steps"]
    assert equal["refused"] == 0


@claims
def experiment_design(found, module, out):
    """Jerks of a light grasp see friction and dashpots better than strokes; together they see more
    than either alone."""
    single = {row["names"][0]: row["sd"] for row in found["single"]}
    both = found["together"][0]["sd"]
    R_n = "laws.steel_on_rubber.R_n"
    assert single["jerks, light"][R_n] < single["strokes"][R_n]
    assert all(both[name] <= min(sd[name] for sd in single.values()) for name in module.NAMES)
    assert all(row["inconsistency"] < module.CONSISTENT for row in found["single"])


@claims
def benchmark(found, module, out):
    """Steps of a tighter tolerance are nearer to the exact solution; its times are its table's."""
    assert found["batches"]["2 runs of 0.2 s, 2 threads"]["failures"] == 0
    assert list(found["growth"]["wall_s"]) == ["61", "121"]
    config = module.Config(out=out, duration=3.0, exact=1e-6, repeats=1)
    costs = module.costs(config)
    loose, tight, *_ = (costs[way]["x_C"] for way in module.ways(config))
    assert tight < loose


@pytest.mark.slow
def test_every_integrator_of_the_benchmark_reaches_the_steppers_solution():
    """With the compiled right-hand side."""
    pytest.importorskip("diffrax")
    module = experiment("benchmark")
    numbers = module.peers(module.Config(window=5e-3, repeats=1, smoke=True))
    assert all(row is not None for rows in numbers["equal"].values() for row in rows.values())
    assert "scipy LSODA" in module.peers_table(numbers)


@claims
def identify_contact(found, module, out):
    """Without noise the truth, with noise the truth within what was predicted, by differences the
    same at more runs."""
    cases = {case["case"]: case for case in found["cases"]}
    assert all(abs(p["relative_error"]) < 1e-3 for p in cases["noise-free"]["parameters"].values())
    for name, p in cases["noisy"]["parameters"].items():
        assert abs(p["relative_error"]) < 3.5 * p["relative_sd"], name
        again = cases["finite differences"]["parameters"][name]["estimate"]
        assert again == near(p["estimate"], rel=0.4 * p["relative_sd"])
    assert max(cases["noisy"]["heldout_nrmse"]["shaking"].values()) < 0.05
    assert cases["finite differences"]["simulations"] > 2 * cases["noisy"]["jacobians"]


@claims
def identify_by_touch(found, module, out):
    """Taxels shrink every interval, shear shrinks it further, and the fits are within theirs."""
    without, _, normal, shear = found["relative_sd"]["strokes"].values()
    assert all(sd > 1.5 * normal[name] > 2 * shear[name] for name, sd in without.items())
    errors = [abs(one["error_in_sd"]) for fit in found["fits"].values() for one in fit.values()]
    assert max(errors) < 3.5
    assert max(found["chi2"].values()) == near(1.0, abs=0.1)


@claims
def interval_coverage(found, module, out):
    """Errors of a few standard deviations, not of many: two seeds are too few for a share. Colour
    is found where it is, and rig files are identified by their names."""
    cases = found["cases"]
    errors = {
        case: [abs(e) for one in row["parameters"].values() for e in one["errors"]]
        for case, row in cases.items()
    }
    white, coloured = mean(errors["white"]), mean(errors["coloured"])
    assert 0.1 < min(white, coloured) < max(white, coloured) < 2
    assert mean(errors["coloured, ignored"]) > 1.5 * coloured
    assert cases["white"]["notices"] == cases["white"]["orders"] == {}
    assert sum(cases["coloured"]["orders"].values()) == 14
    assert max(errors["two fingers"] + errors["two jaws"]) < 4


@claims
def contact_points(found, module, out):
    """Two points an element take most of the nodes out of the force along the pad."""
    nodes, between = (found["cases"][name] for name in ("1 mm, nodes", "1 mm, 2"))
    name = "static ripple of the force along the pad [mN]"
    assert between[name] < 0.3 * nodes[name]


@claims
def orientation(found, module, out):
    """Loops turn and carry the disc within the tolerance; what they do not do is as rigid statics
    say, and is reported."""
    alone, speeds = found["loops_alone"], found["speeds"]["6.0"]
    ellipse, asks = alone["ellipse 1.3"], found["rigid"]["ellipse 1.3"]
    assert alone["disc"]["verdict"] == "within"
    assert found["efforts_fed_forward"]["ellipse 1.3"]["verdict"] == "within"
    assert ellipse["verdict"] == speeds["verdict"] == "beyond"
    stiffness = found["gains"]["turn_lower"]["Kp"] * math.pi / 180  # [N/deg]
    assert ellipse["angle_deg"] == near(asks["effort"] / stiffness, rel=0.25)
    assert ellipse["friction"] == near(asks["friction"], rel=0.1)
    assert ellipse["opening_mm"] == near(asks["opening_mm"], rel=0.05)
    assert speeds["position_mm"] == near(found["inertia_alone_mm_deg"]["6.0"][0], rel=0.2)
    assert found["frictions"]["0.2"]["verdict"] == "lost"  # its friction cone asks for 0.29


def test_orientation_has_the_gains_of_its_design_and_the_closed_form_of_an_ellipse():
    module = experiment("orientation")
    for name, gains in module.design(module.READY, 150.0).items():
        own = module.READY.actuators[name]
        assert (own.Kp, own.Kd) == near((gains["Kp"], gains["Kd"]), rel=1e-2)
    asks = module.rigid(Ellipse(20e-3, 10e-3), 10.0, 0.0)
    assert asks.friction == near(0.75, rel=1e-3)  # (k^2 - 1) / 2 k at aspect k = 2
    assert asks.opening_mm == near(20.0)


@claims
def rolling_resistance(found, module, out):
    """Force and power give one resistance, near theory's, with a peak."""
    (one,) = found["resistance"].values()
    assert one["power over force less one, largest"] < 0.02
    assert 0.97 < min(one["force over theory"]) < max(one["force over theory"]) < 1.06
    low, top, high = (roll["force"] for roll in one["rolls"])
    assert top > 1.2 * max(low, high)  # the peak
    assert found["by load"]["10 N"]["force over theory"] == near(1.01, abs=0.02)


def test_compliance_of_a_layer_has_both_limits():
    """Long waves compress a layer uniaxially, short ones see a half-plane."""
    theory = experiment("rolling_resistance")
    h, nu = 4e-3, 0.3
    long, deep, deeper = theory.layer_compliance(np.array([1e-3, 11.9, 12.1]) / h, h, nu)
    assert long[1, 1].real == near(h * (1 + nu) * (1 - 2 * nu) / (1 - nu), rel=1e-5)
    assert np.abs(deeper / deep * 12.1 / 11.9 - 1).max() < 1e-6


@claims
def contact_theory(found, module, out):
    """Sliding, spin, Hertz, partial slip and creep are the textbook's to a percent or less."""
    assert abs(found["slopes"]["20"]["found [m/s2]"]) < 1e-4  # it sticks
    assert abs(found["slopes"]["45, smooth law"]["off"]) < 1e-3
    (row,), (roll,) = found["sizes"], found["carter"]
    assert max(abs(row[k]) for k in ("stop", "spin's rate", "spin of rolling")) < 3e-3
    circle, slid = (found[name]["20 elements"] for name in ("hertz", "cattaneo"))
    assert max(map(abs, circle.values())) < 4e-3
    for part in ("way", "turn", "return"):
        assert abs(slid[f"c, {part}"]) < 3e-3
        assert abs(slid[f"shear, {part}"]) < 0.02
    assert found["punch"]["40 elements, springs 400 E*/a"]["pressure"] < 3e-3
    assert roll["traction"] == near(0.5, abs=1e-3)
    assert abs(roll["off"]) < 5e-3


@claims
def startup(found, module, out):
    """Kernels of the wheel are as good as loaded; those that are missing are compiled."""
    assert found["wheel_s"]["first run"] < 0.2 * found["fallback_s"]["first run"]
    assert found["processes_s"]["import torchsoft"] < found["processes_s"]["import torch"]


def test_a_policy_becomes_a_controller(tmp_path):
    """Ranges of what it sees and does are folded into the network of the rig file."""
    module = experiment("learn_policy")
    policy = module.network(4, 3, seed=0)
    file = module.deployed(module.Config(out=tmp_path), policy, module.environment())
    rig = file.build().rig
    coordinates, rates = f64(0.2, 1e-3, -2e-3, 3e-3, 0.04), f64(0.5, -0.02, 0.1, -0.2, 0.03)
    goal = f64(-0.3, 0.0)
    seen = [1e-3 / 10e-3, 0.2, -0.02 / 0.1, 0.5 / 3.0, (-0.3 - 0.2) / 0.1, -1e-3 / 2e-3]
    lower, upper, grip = policy(f64(*seen)).tolist()
    expected = {
        "lower_x": 2e3 * (12e-3 * lower + 2e-3) - 60.0 * 0.1,
        "upper_x": 2e3 * (12e-3 * upper - 3e-3) + 60.0 * 0.2,
        "upper_y": -13.0 + 7.0 * grip,
    }
    for name, effort in expected.items():
        law = rig.actuators[f"policy_{name}"].law
        given = law(goal, torch.zeros_like(goal), f64(0.0)[0], coordinates, rates)
        assert given.item() == near(effort, rel=1e-9)


@claims
def learn_policy(found, module, out):
    assert {one["method"] for one in found["trainings"]} == set(module.METHODS)
    assert all(x < 2 for part in found["deployed"]["missed_rad"].values() for x in part)
    assert torch.jit.load(out / "policy.pt")(f64(*[0.0] * 6)).shape == (3,)


@claims
def learn_dynamics(found, module, out):
    assert {"mu = 0.5", "constant, fitted", "network"} == set(found["held out"])
    assert len(found["surrogate"]) == 6


def test_the_learned_law_solves_its_own_equation():
    """R v = E - mu(v) F_N, to the fixed-point sweeps' error, and no slip below the cap."""
    torch.manual_seed(0)
    law = experiment("learn_dynamics").MuNetwork()
    torch.nn.init.normal_(law.net[2].weight, std=0.1)
    E, F_N = torch.linspace(0, 30.0, 31).double(), f64(20.0).expand(31)
    v = law(E, F_N, f64(900.0))
    residual = (E - law.mu(v) * F_N).clamp(min=0.0) - 900.0 * v
    assert float(residual.detach().abs().max()) < 1e-2  # [N], of 20 N
    assert bool((v[0.9 * law.mu(f64(0.0)) * F_N > E] == 0).all())


@claims
def gradient_accuracy(found, module, out):
    """The windows are what they are called, and errors are 1e-6 where the judge is that good."""
    slip, stick, grasp = (found["windows"][name] for name in ("slip", "stick", "grasp"))
    assert slip["events"]["slip_onsets"] > 0
    assert stick["events"]["slip_onsets"] + stick["events"]["touch"] == 0
    assert grasp["events"]["touch"] > 3
    for window in (slip, stick):
        errors, unsure = window["relative_error"], window["judge_uncertainty"]
        assert max(errors[name] for name in errors if unsure[name] <= 1e-6) <= 1e-6


@claims
def reduced_model(found, module, out):
    """What is found agrees with mechanics, and with the full model where it is used."""
    stick, slip, radius = found["stick"], found["slip"], found["stick"]["rolling_radius_mm"]
    assert stick["terms"] <= 10
    assert stick["heldout_nrmse"] < 0.02
    assert radius["found"] == near(radius["expected"], rel=0.03)
    rows = {(row["equation"], row["term"]): row for row in stick["coefficients"]}
    for term in ("x_Br - 2 x_C", "v_Br - 2 v_C"):
        row = rows["v_C", term]
        assert abs(row["error"]) < 0.1
        assert row["interval"][0] < row["value"] < row["interval"][1]
    assert rows["v_Br", "F_x"]["value"] == near(1 / 0.4065, rel=0.05)
    assert slip["heldout_nrmse"] < 0.1
    fastest = min(slip["by_stroke"], key=lambda row: row["stroke_time_s"])
    assert fastest["slipping"] > 0.5
    assert fastest["nrmse_linear"] > 2 * fastest["nrmse"]  # it needs saturation


@claims
def law_comparison(found, module, out):
    """Named where contacts slip, and not where they roll."""
    *near, far, other = found["cases"]
    assert [case["answer"] for case in (*near, far, other)] == ["right"] * 2 + ["cannot tell"] * 2
    strokes = sorted(case["D"] for case in near)
    assert strokes[1] > 7.3
    assert strokes[0] > 1 > max(far["D"], other["D"])


@claims
def finite_strain(found, module, out):
    more = {name: row["more"] for name, row in found["layer"].items()}
    assert 0.2 < more["nu 0.45, 25% of the height"] < more["nu 0.49, 25% of the height"] < 0.5
    assert 0.77 < found["manipulation"]["linear"]["E as stiff [MPa]"] < 0.9
