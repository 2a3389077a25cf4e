"""Friction at any load and size: bodies on slopes stick below arctan mu and slide above it, and the
cone holds at every point; numbers that a rig file takes from its pads."""

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.physics.extensions import extend
from torchsoft.rigs import RigFile
from torchsoft.rigs.check import check
from torchsoft.rigs.written import to_toml
from torchsoft.tables import InvalidTable

MU_S, MU_K, G = 0.8, 0.7, 9.81
FRICTION: dict[str, dict[str, Any]] = {
    "coulomb": {"kind": "coulomb", "mu_s": MU_S, "mu_k": MU_K},
    "smooth": {"kind": "smooth", "mu_s": MU_S, "mu_k": MU_K, "v_s": 50e-3},
}


def box(degrees: float, mass: float, friction: str, tau: float = 1e-3, **springs: Any) -> RigFile:
    """A box of 40 x 20 mm on a pad tilted by an angle; everything stiff in proportion to its
    mass."""
    angle, k = math.radians(degrees), mass / 0.15
    along, above = 120e-3, 22.0e-3 - 9e-6  # in the pad's own axes, at rest or near it
    x, y = (
        along * math.cos(angle) - above * math.sin(angle),
        along * math.sin(angle) + above * math.cos(angle),
    )
    numbers = {"K_n": 5e4 * k, "R_n": 20.0 * k, "K_t": 5e4 * k, "R_t": 20.0 * k} | springs
    return RigFile.from_tree({
        "title": "box on a slope",
        "bodies": {"box": {
            "mass": mass, "start": {"x": x, "y": y, "theta": angle},
            "shape": {"kind": "rounded_box", "half_width": 20e-3, "half_height": 10e-3,
                      "radius": 4e-3},
        }},
        "materials": {"gel": {"kind": "kelvin_voigt", "E": 0.15e6 * k, "nu": 0.45, "tau": tau,
                              "depth": 40e-3}},
        "pads": {"ground": {"material": "gel", "angle": angle, "length": 160e-3, "height": 12e-3,
                            "elements_x": 80, "elements_y": 4}},
        "laws": {"dry": numbers | {"friction": FRICTION[friction]}},
        "contacts": {"ground": {"pad": "ground", "body": "box", "law": "dry"}},
        "outputs": {"duration": 0.25, "interval": 2e-3, "video": "none", "figures": False},
    })  # fmt: skip


@pytest.mark.parametrize("friction", ["coulomb", "smooth"])
@pytest.mark.parametrize("mass", [0.01, 0.15, 3.0])
@pytest.mark.parametrize("degrees", [20, 30, 45])
def test_a_box_on_a_slope_does_as_coulomb_says(degrees, mass, friction):
    """It stays below arctan mu_s = 38.7 degrees; above it slides at g (sin - mu cos), less what the
    pad's viscosity takes, some 2 % of it at tau = 1 ms."""
    built = box(degrees, mass, friction).build()
    run = simulate(built.rig, built.t, y0=built.y0)
    slope = math.radians(degrees)
    x, y = (run[f"{axis}_box"] - run[f"{axis}_box"][0] for axis in "xy")
    down = -(x * math.cos(slope) + y * math.sin(slope)).numpy()
    F_N, F_T = run.force["ground"].unbind(-1)
    assert float((F_T.abs() - MU_S * F_N).max()) <= 1e-9
    late = run.t.numpy() > 0.125
    if math.tan(slope) < MU_S:
        assert abs(down[-1] - down[late][0]) < 5e-6
        return
    slides, accelerates = np.polyfit(run.t.numpy()[late], down[late], 2)[1::-1]
    v = slides + 2 * accelerates * run.t.numpy()[late]
    mu = MU_K + (0.0 if friction == "coulomb" else float(((MU_S - MU_K) / (1 + v / 50e-3)).mean()))
    expected = G * (math.sin(slope) - mu * math.cos(slope))
    assert 2 * accelerates == pytest.approx(expected, rel=0.04)


def test_mass_and_stiffness_in_proportion_change_nothing():
    """From 10 g to 3 kg, to the tolerance of steps."""
    runs = []
    for mass in (0.01, 3.0):
        built = box(45, mass, "smooth").build()
        runs.append(simulate(built.rig, built.t, y0=built.y0, rtol=1e-5)["x_box"])
    assert float((runs[0] - runs[1]).abs().max() / (runs[0].max() - runs[0].min())) < 1e-4


def test_a_body_slides_to_a_stop_within_v2_over_2_mu_g():
    """0.5 m/s, mu 0.5, 1 g and 1 kg: 25.5 mm."""
    for mass in (1e-3, 1.0):
        tree = box(0, mass, "coulomb", tau=1e-4).model_dump(exclude_unset=True)
        tree["laws"]["dry"]["friction"] = {"kind": "coulomb", "mu_s": 0.5, "mu_k": 0.5}
        tree["bodies"]["box"]["start"] |= {"x": 40e-3, "v_x": 0.5}
        built = RigFile.from_tree(tree).build()
        x = simulate(built.rig, built.t, y0=built.y0)["x_box"]
        assert float(x[-1] - x[0]) == pytest.approx(0.5**2 / (2 * 0.5 * G), rel=0.02)
        assert float((x[-1] - x[-20]).abs()) < 1e-4


# numbers of a law from its pad


def test_auto_takes_springs_and_dashpots_from_the_pad():
    file = box(20, 0.15, "smooth", **dict.fromkeys(("K_n", "R_n", "K_t", "R_t"), "auto"))
    rig = file.build().rig
    spring = 10 * 0.15e6 / (1 - 0.45**2) * 40e-3 * 1e-3 / 2e-3  # elements of 2 mm, per mm
    law = rig.contacts["ground"].law
    got = {name: getattr(law, name).item() for name in ("K_n", "K_t", "R_n", "R_t")}
    assert got["K_n"] == pytest.approx(spring, rel=0.02)  # a point at either end has half of it
    assert got["K_t"] == got["K_n"]
    assert got["R_n"] == got["R_t"] == pytest.approx(1e-3 * got["K_n"])
    assert not [one for one in check(file) if one.where == "contacts.ground"]
    assert 'K_n = "auto"' in to_toml(file)
    with pytest.raises(InvalidTable, match=r'K_n: should be "auto" or a number, not \'soft\''):
        box(20, 0.15, "smooth", K_n="soft")


def test_a_dashpot_that_is_auto_follows_a_spring_that_is_given():
    rig = box(20, 0.15, "smooth", R_t="auto").build().rig
    assert rig.contacts["ground"].law.R_t.item() == pytest.approx(1e-3 * 5e4)


def test_springs_and_dashpots_that_are_auto_follow_the_pad():
    """In place, in gradients and where a law is extended: as in the rig built anew."""
    auto = dict.fromkeys(("K_n", "R_n", "K_t", "R_t"), "auto")
    file, name = box(20, 0.15, "smooth", **auto), "materials.gel.E"
    file = file.override(outputs={"duration": 0.02, "interval": 5e-3})
    built = file.build()
    law, E = built.rig.contacts["ground"].law, built.rig.parameter(name)
    nominal, K_n = E.item(), law.K_n.item()
    run = built.run(gradient="discrete")
    run["x_box"][-1].backward()
    anew = lambda E: file.override({name: E}).build().run(knots=run.knots)["x_box"]
    high, low = (anew(nominal * (1 + h))[-1] for h in (1e-4, -1e-4))
    assert E.grad.item() == pytest.approx(float(high - low) / (2e-4 * nominal), rel=1e-4)
    with torch.no_grad():
        E.mul_(4.0)
    assert law.K_n.item() == pytest.approx(4 * K_n)
    assert (built.run(knots=run.knots)["x_box"] - anew(4 * nominal)).abs().max() < 1e-12
    assert built.rig.description()["parameters"]["laws.dry.K_n"] == pytest.approx(4 * K_n)
    with pytest.raises(ValueError, match=r"laws\.dry\.K_n` is \"auto\".*override"):
        built.rig.parameter("laws.dry.K_n")
    extend(built.rig, ["laws.dry.K_n"])
    assert built.rig.parameter("laws.dry.K_n").item() == pytest.approx(4 * K_n)
    assert (built.run(knots=run.knots)["x_box"] - anew(4 * nominal)).abs().max() < 1e-12


def test_springs_that_soften_a_contact_are_noted():
    (note,) = (one for one in check(box(20, 0.15, "smooth", K_n=5e3)) if "springs" in one.message)
    assert (note.severity, note.where) == ("note", "contacts.ground")


def test_strains_that_are_not_small_are_noted(tmp_path, capsys):
    """By the check, and by a run whose strains it cannot know."""
    heavy = box(0, 0.15, "smooth").override(bodies={"box": {"mass": 3.0, "start": {"y": "rest"}}})
    assert any(one.severity == "note" and "strains reach" in one.message for one in check(heavy))
    falls = box(0, 0.15, "smooth").override(
        bodies={"box": {"start": {"y": 60e-3}}}, outputs={"duration": 0.15}
    )
    assert not any("strains" in one.message for one in check(falls))
    (tmp_path / "falls.toml").write_text(to_toml(falls))
    assert main(["run", str(tmp_path / "falls.toml"), "--out", str(tmp_path / "out")]) == 0
    assert "strains reach" in capsys.readouterr().err


def test_a_law_with_a_viscosity_of_its_own_is_warned_about():
    built = box(20, 0.15, "smooth").build()
    law = built.rig.contacts["ground"].law
    del law.friction

    def viscous(E: torch.Tensor, F_N: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
        return (E - 0.5 * F_N).clamp(min=0.0) / (R + 10.0)

    law.friction = viscous
    with pytest.warns(UserWarning, match="where nothing presses") as caught:
        simulate(built.rig, built.t[:2], y0=built.y0)
    assert caught[0].filename == __file__


SERIES = {"kind": "prony", "E": 0.15e6, "moduli": [0.15e6], "tau": [1.0], "nu": 0.45, "depth": 0.04}


@pytest.mark.parametrize("degrees", [10, 30, 45])
def test_friction_may_fall_on_a_pad_of_little_damping(degrees):
    """The instantaneous spring of a series has a dashpot of 0.1 ms only: friction falls with slip
    no faster than it balances, which is said where points slip."""
    tree = box(degrees, 0.15, "smooth").model_dump(exclude_unset=True)
    tree["materials"]["gel"] = SERIES
    built = RigFile.from_tree(tree).build()
    law = built.rig.contacts["ground"].law
    rested = law.friction.range(torch.tensor(0.15 * 9.81 / 20), law.R_t)
    assert rested > 2 * law.friction.v_s
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        run = simulate(built.rig, built.t, y0=built.y0)
    falls = [one for one in said if "over a larger slip speed than v_s" in str(one.message)]
    assert degrees != 45 or falls
    assert degrees != 10 or not said
    slope = math.radians(degrees)
    x, y = (run[f"{axis}_box"] - run[f"{axis}_box"][0] for axis in "xy")
    down = -(x * math.cos(slope) + y * math.sin(slope)).numpy()
    late = run.t.numpy() > 0.125
    acceleration = 2 * np.polyfit(run.t.numpy()[late], down[late], 2)[0]
    expected = 9.81 * (math.sin(slope) - MU_S * math.cos(slope)) if degrees == 45 else 0.0
    slowest = 0.0 if degrees < 45 else 0.98 * expected
    assert slowest - 0.02 <= acceleration <= 1.6 * expected + 0.02


def test_a_pad_with_a_dashpot_of_its_own_bounds_nothing():
    assert box(30, 0.15, "smooth").build().rig.contacts["ground"].law.friction.R_pad is None
