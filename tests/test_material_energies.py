"""Strain energies fitted to tables of pulls, compressions and shears."""

import json

import numpy as np
import pytest

from torchsoft import MooneyRivlin, NeoHookean, Ogden, Yeoh
from torchsoft.__main__ import main
from torchsoft.materials.energies import fit_energy, nominal_stress, stretches
from torchsoft.materials.measured import Pull, read
from torchsoft.materials.presets import PRESETS
from torchsoft.rigs import RigFile

REST = {"nu": 0.49, "rho": 1e3, "tau": 0.01, "depth": 0.04}
TRUE = {
    "neo_hookean": NeoHookean(E=6e5, **REST),
    "mooney_rivlin": MooneyRivlin(C10=8e4, C01=2e4, **REST),
    "yeoh": Yeoh(C10=9e4, C20=-5e3, C30=8e2, **REST),
    "ogden": Ogden(mu=[2e5, 3e4], alpha=[1.7, -2.5], **REST),
}
WAYS = {
    "tension": np.linspace(1.01, 2.0, 40),
    "compression": np.linspace(0.99, 0.6, 30),
    "planar": np.linspace(1.01, 1.8, 30),
    "biaxial": np.linspace(1.01, 1.6, 30),
    "shear": np.linspace(0.02, 1.0, 30),
}


def table(path, test: str, material, noise: float = 0.0, true: bool = False):
    x = WAYS[test]
    stress = nominal_stress(material, test, x)
    if true:
        stress = stress * x
    strain = x if test == "shear" else x - 1
    stress = stress * (1 + noise * np.random.default_rng(0).normal(size=len(x)))
    rows = "\n".join(f"{a!r},{b!r}" for a, b in zip(strain.tolist(), (1e-6 * stress).tolist()))
    path.write_text(f"strain [1],stress [MPa]\n{rows}\n")
    return path


def pulls(folder, material, *tests: str, **how) -> list[Pull]:
    found = []
    for test in tests:
        path = table(folder / f"{test}.csv", test, material, **how)
        found.append(read(path, test=test, whole=True, true=how.get("true", False)))
    return found


def test_closed_forms_of_the_neo_hookean_solid():
    rubber, mu = TRUE["neo_hookean"], 6e5 / (2 * 1.49)
    for test, form in (
        ("tension", lambda x: mu * (x - x**-2)), ("compression", lambda x: mu * (x - x**-2)),
        ("planar", lambda x: mu * (x - x**-3)), ("biaxial", lambda x: mu * (x - x**-5)),
        ("shear", lambda x: mu * x),
    ):  # fmt: skip
        x = WAYS[test]
        assert nominal_stress(rubber, test, x) == pytest.approx(form(x), rel=1e-10)


@pytest.mark.parametrize("kind", TRUE)
def test_energies_are_found_again_from_three_kinds_of_tests(kind, tmp_path):
    rows = pulls(tmp_path, TRUE[kind], "tension", "compression", "biaxial")
    found = fit_energy(rows, kind, nu=0.49, terms=2 if kind == "ogden" else None)
    assert found.rms < 1e-8
    x = np.linspace(0.7, 1.6, 20)
    made = found.material(nu=0.49, rho=1e3, depth=0.04, tau=0.01)
    for test in ("planar", "shear"):
        expected = nominal_stress(TRUE[kind], test, x)
        assert nominal_stress(made, test, x) == pytest.approx(expected, rel=1e-5, abs=10)


def test_true_stress_and_noise(tmp_path):
    rubber = TRUE["neo_hookean"]
    exact = fit_energy(pulls(tmp_path, rubber, "tension", true=True), "neo_hookean", nu=0.49)
    assert exact.values["E"] == pytest.approx(6e5, rel=1e-9)
    noisy = fit_energy(pulls(tmp_path, rubber, "tension", noise=0.02), "neo_hookean", nu=0.49)
    assert abs(noisy.values["E"] - 6e5) < 3 * noisy.sd["E"]
    assert 1e3 < noisy.sd["E"] < 1e4
    assert stretches(noisy.measured).max() == pytest.approx(2.0)


def test_what_one_test_does_not_tell_is_said(tmp_path):
    rows = pulls(tmp_path, TRUE["yeoh"], "tension")
    found = fit_energy(rows, "mooney_rivlin", nu=0.49)
    said = " ".join(found.notices)
    assert "stretches from 1.01 to 2" in said
    assert "one kind of test does not tell" in said
    falling = Yeoh(C10=9e4, C20=-3e4, C30=2e3, **REST)
    assert "not stable" in " ".join(
        fit_energy(pulls(tmp_path, falling, "tension"), "yeoh", nu=0.49).notices
    )
    with pytest.raises(ValueError, match="`terms` are those of ogden"):
        fit_energy(rows, "yeoh", nu=0.49, terms=2)
    with pytest.raises(ValueError, match="take fewer terms"):
        fit_energy(rows, "ogden", nu=0.49, terms=6)


def test_the_command_writes_a_material_that_rig_files_take(tmp_path, capsys):
    one, other = (
        table(tmp_path / f"{test}.csv", test, TRUE["ogden"]) for test in ("tension", "shear")
    )
    out = tmp_path / "out"
    ask = ["material", "fit", str(one), "--test", "tension", "--energy", "ogden", "--terms", "2"]
    assert main([*ask, "--also", f"shear={other}", "--nu", "0.48", "--out", str(out)]) == 0
    assert "residual" in capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text())
    assert [one["test"] for one in summary["tables"]] == ["tension", "shear"]
    text = (out / "material.toml").read_text()
    assert "mu = [" in text
    assert "assumed" in text
    rig = RigFile.ready("paper").override(
        {"materials.rubber": {"kind": "file", "file": str(out / "material.toml")}}
    )
    made = rig.assemble().pads["L"].material
    assert isinstance(made, Ogden)
    assert made.nu.item() == 0.48
    assert (out / "fit.png").stat().st_size > 1000


def relaxation(path):
    """A relaxation test of a rubber with two terms, a third and a sixth of its relaxed modulus."""
    t = np.geomspace(1e-3, 100, 200)
    modulus = 5e5 * (1 + np.exp(-t / 0.1) / 3 + np.exp(-t / 4.0) / 6)
    rows = "\n".join(f"{a!r},{b!r}" for a, b in zip(t.tolist(), (1e-6 * modulus).tolist()))
    path.write_text(f"t [s],modulus [MPa]\n{rows}\n")
    return path


@pytest.mark.parametrize("fast", [False, True])
def test_a_relaxation_test_beside_pulls_gives_branches(fast, tmp_path, capsys):
    """Relative to the relaxed energy, which pulls that were fast tell 1.5 times too high."""
    pull = table(tmp_path / "tension.csv", "tension", TRUE["neo_hookean"])
    out, over_time = tmp_path / "out", relaxation(tmp_path / "relaxation.csv")
    ask = ["material", "fit", str(pull), "--test", "tension", "--energy", "neo_hookean"]
    ask += ["--relaxation", str(over_time), "--nu", "0.49", "--out", str(out)]
    assert main([*ask, *["--fast"] * fast]) == 0
    assert f"count as {'fast' if fast else 'slow'}" in capsys.readouterr().out
    file = RigFile.ready("paper").override(
        {"materials.rubber": {"kind": "file", "file": str(out / "material.toml")}}
    )
    made = file.assemble().pads["L"].material
    assert isinstance(made, NeoHookean)
    E = 6e5 / (1.5 if fast else 1.0)
    assert made.E.item() == pytest.approx(E, rel=1e-6)
    found = sorted([x.item() for x in pair] for pair in made.relaxation())
    assert np.array(found) == pytest.approx(np.array([[1 / 6, 4.0], [1 / 3, 0.1]]), rel=1e-3)
    assert made.tau.item() < 0.01
    summary = json.loads((out / "summary.json").read_text())
    assert summary["relaxation"]["file"] == "relaxation.csv"
    assert {"E", "E_1", "tau_2"} <= summary["coefficients"].keys()


def test_refusals_of_the_command(tmp_path, capsys):
    one = str(table(tmp_path / "tension.csv", "tension", TRUE["yeoh"]))
    out = ["--out", str(tmp_path / "out")]
    for more, said in (
        (["--test", "tension", "--also", "shear=x.csv", "--range", "0", "1"], "--also is of"),
        (["--test", "tension", "--energy", "yeoh", "--also", "x.csv"], "must be TEST=FILE"),
        (["--test", "planar", "--range", "0", "1"], "say --energy neo_hookean"),
        (["--test", "tension", "--energy", "yeoh", "--fast"], "say which, --relaxation FILE"),
        (["--test", "tension", "--relaxation", "x.csv", "--range", "0", "1"], "is of energies"),
    ):
        assert main(["material", "fit", one, *more, *out]) != 0
        assert said in capsys.readouterr().err


def test_presets_at_finite_strain_are_of_their_data_s_size():
    soft, stiff = (
        PRESETS[f"{name}, finite strain"] for name in ("Ecoflex 00-30", "Dragon Skin 30")
    )
    for one, modulus in ((soft, (3e4, 6e4)), (stiff, (4e5, 6e5))):
        made = one.material(0.044)
        assert modulus[0] < made.E.item() < modulus[1]
        assert made.well_posed() == ""
