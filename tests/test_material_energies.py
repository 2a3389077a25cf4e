"""Strain energies fitted to tables of pulls, compressions and shears."""

import json

import numpy as np
import pytest

from torchsoft import MooneyRivlin, NeoHookean, Ogden, Yeoh
from torchsoft.__main__ import main
from torchsoft.materials import energies
from torchsoft.materials.energies import fit_energy, nominal_stress, stretches
from torchsoft.materials.measured import Pull, read
from torchsoft.materials.presets import PRESETS
from torchsoft.materials.written import write
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


def torn(path):
    """A neo-Hookean specimen of 3 mu = 87 kPa that tears at a stretch of 2.6, in row 34."""
    x = np.linspace(1, 2.9, 39)
    stress = 29e3 * (x - x**-2) * np.where(x > 2.6001, (3 - x) / 0.5, 1)
    rows = "\n".join(f"{a:.3f},{b:.1f}" for a, b in zip(x, stress))
    path.write_text(f"stretch [1],stress [Pa]\n{rows}\n")
    return str(path)


def test_a_torn_specimen_is_fitted_up_to_where_it_tore(tmp_path, capsys):
    ask = ["material", "fit", torn(tmp_path / "torn.csv"), "--test", "tension", "--nu", "0.49"]
    ask += ["--energy", "neo_hookean", "--out", str(tmp_path / "out")]
    assert main(ask) == 2
    err = capsys.readouterr().err
    assert "row 35: the stress falls" in err
    assert "(a stretch of 2.6) on" in err
    remedy = err.split("--range")[1].split()
    assert main([*ask, "--range", *remedy]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    E = 2 * 1.49 * 29e3
    assert summary["coefficients"]["E"]["value"] == pytest.approx(E, rel=1e-4)
    assert any("6 rows from row 35 to row 40: strains above 1.6" in x for x in summary["notices"])


def test_rows_after_the_largest_strain_are_reported(tmp_path):
    path, x = tmp_path / "loop.csv", np.r_[np.linspace(0, 1, 21), np.linspace(0.9, 0.1, 9)]
    rows = "\n".join(f"{a!r},{b!r}" for a, b in zip(x.tolist(), (3e4 * x).tolist()))
    path.write_text(f"strain [1],stress [Pa]\n{rows}\n")
    test = read(path, test="tension", whole=True)
    assert isinstance(test, Pull)
    found = fit_energy([test], "neo_hookean", nu=0.49)
    assert any("9 rows from row 23 to row 31: after" in one for one in found.notices)


def test_true_stress_of_compression_in_either_sign(tmp_path):
    """True stress is E / 3 (x^2 - 1 / x), whichever direction counts as positive."""
    for sign in (1, -1):
        x = np.linspace(0.99, 0.6, 20)
        rows = zip((sign * (1 - x)).tolist(), (-sign * 2e5 * (x**2 - 1 / x)).tolist())
        path = tmp_path / "pressed.csv"
        path.write_text("strain [1],stress [Pa]\n" + "\n".join(f"{a!r},{b!r}" for a, b in rows))
        test = read(path, test="compression", whole=True, true=True)
        assert isinstance(test, Pull)
        found = fit_energy([test], "neo_hookean", nu=0.49)
        assert found.values["E"] == pytest.approx(2 * 1.49 * 2e5, rel=1e-9)


def test_unphysical_energies_are_rejected(tmp_path):
    """The stress grows with the cube of the strain, so that a polynomial starts downwards."""
    x = np.linspace(0, 1.5, 30)
    cubic = Pull(tmp_path / "cubic.csv", "tension", x, 1e5 * x**3, (0.0, 1.5), ())
    for kind in ("mooney_rivlin", "yeoh"):
        with pytest.raises(ValueError, match=r"a shear modulus of -\d.* but it must be positive"):
            fit_energy([cubic], kind, nu=0.49)
    soft = fit_energy(
        [Pull(cubic.path, "tension", x, 1e-3 * x, (0.0, 1.5), ())], "neo_hookean", nu=0.49
    )
    with pytest.raises(ValueError, match=r"parameter `E` must be from 1 to .* but is 0\.00"):
        write(soft, tmp_path, {"nu": 0.49, "rho": 1e3, "tau": 0.01, "depth": 0.04}, {})


STIFFENING = (0.0, 0.25739, 0.420847, 0.518429, 0.609233, 0.659472, 0.725627, 0.756164, 0.812768,
    0.834691, 0.889458, 0.909682, 0.968974, 0.993877, 1.064964, 1.101971, 1.194328, 1.252889,
    1.379243, 1.471617, 1.648954, 1.790940, 2.041571)  # fmt: skip
"""Stress [MPa] at stretches from 1 to 7.38, which stiffens as natural rubber does."""


@pytest.mark.parametrize(
    ("terms", "evaluations", "rms"),
    [(2, 400, 0.00515), pytest.param(3, 2000, 0.00509, marks=pytest.mark.slow)],
)
def test_ogden_takes_few_evaluations(terms, evaluations, rms, tmp_path, monkeypatch):
    """Without a warning: the exponents are bounded, so that no power of a stretch overflows."""
    calls = []

    def counted(*arguments):
        calls.append(1)
        return nominal_stress(*arguments)

    monkeypatch.setattr(energies, "nominal_stress", counted)
    x = np.linspace(0, 6.38, len(STIFFENING))
    pull = Pull(tmp_path / "pull.csv", "tension", x, 1e6 * np.array(STIFFENING), (0.0, 6.38), ())
    found = fit_energy([pull], "ogden", nu=0.49, terms=terms)
    assert found.rms < rms
    assert len(calls) < evaluations
    if terms == 3:
        assert any("at the limit of exponents, 50: alpha_" in one for one in found.notices)


def test_what_one_test_does_not_tell_is_said(tmp_path):
    rows = pulls(tmp_path, TRUE["yeoh"], "tension")
    found = fit_energy(rows, "mooney_rivlin", nu=0.49)
    said = " ".join(found.notices)
    assert "stretches from 1.01 to 2" in said
    assert "one kind of test does not tell" in said
    falling = Yeoh(C10=9e4, C20=-9e3, C30=4e2, **REST)
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
    rows = "\n".join(f"{a!r},5,{b!r}" for a, b in zip(t.tolist(), (5e-8 * modulus).tolist()))
    path.write_text(f"t [s],strain [%],stress [MPa]\n{rows}\n")
    return path


@pytest.mark.parametrize("fast", [False, True])
def test_a_relaxation_test_beside_pulls_gives_branches(fast, tmp_path, capsys):
    """Relative to the relaxed energy, which pulls that were fast tell 1.5 times too high."""
    pull = table(tmp_path / "tension.csv", "tension", TRUE["neo_hookean"])
    out, over_time = tmp_path / "out", relaxation(tmp_path / "relaxation.csv")
    ask = ["material", "fit", str(pull), "--test", "tension", "--energy", "neo_hookean"]
    ask += ["--relaxation", str(over_time), "--nu", "0.49", "--out", str(out), "--range", "0", "1"]
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
