"""Materials fitted to tests of laboratories: series, moduli and energies that are found again from
tables that they made, what tables do not determine, presets, and the command."""

import json
import re
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.integrate import quad

from torchsoft import GeneralisedKelvin, MooneyRivlin, NeoHookean, Ogden, Prony, RigFile, Yeoh
from torchsoft.cli import main
from torchsoft.materials.energies import fit_energy, nominal_stress
from torchsoft.materials.fit import fit
from torchsoft.materials.measured import Measured, Pull, Spectrum, faded, read, responses
from torchsoft.materials.modulus import modulus
from torchsoft.materials.presets import PRESETS, from_shore_a
from torchsoft.materials.written import FILES, write

Array = NDArray[np.float64]
REST = {"nu": 0.45, "rho": 1100.0, "depth": 0.044}
MODULI, TIMES = np.array([3e5, 1e5, 5e4]), np.array([0.05, 2.0, 60.0])
RELAXING = {"E": 2e5} | {f"E_{k}": x for k, x in enumerate(MODULI, 1)}
RELAXING |= {f"tau_{k}": x for k, x in enumerate(TIMES, 1)}
CREEPING = {"E": 1e6 / 3.5, "J_1": 0.5 / 3.5, "J_2": 2 / 3.5, "tau_1": 0.3, "tau_2": 20.0}
T = np.concatenate(([0.0], np.geomspace(1e-2, 600, 200)))
OMEGA = np.geomspace(0.1, 1e3, 25)
SWEPT = {"E": 4e5, "E_1": 2e5, "E_2": 1e5, "tau_1": 0.01, "tau_2": 0.5}


def relaxing(noise: float = 0.0, seed: int = 0, ramp: float = 0.0) -> Measured:
    """A strain of 5 % put on within `ramp` [s], and the stress, with noise over the largest."""
    strain = np.full_like(T, 0.05) if ramp == 0 else 0.05 * np.clip(T / ramp, 0, 1)
    stress = responses("relaxation", T, strain, TIMES) @ np.append(2e5, MODULI)
    stress += noise * stress.max() * np.random.default_rng(seed).normal(size=len(T))
    return Measured(Path("made"), "relaxation", T, strain, stress)


def creeping(noise: float = 0.0, seed: int = 0) -> Measured:
    """A stress of 10 kPa put on at once, and the strain."""
    stress = np.full_like(T, 1e4)
    strain = responses("creep", T, stress, np.array([0.3, 20.0])) @ [1e-6, 0.5e-6, 2e-6]
    strain += noise * strain.max() * np.random.default_rng(seed).normal(size=len(T))
    return Measured(Path("made"), "creep", T, strain, stress)


def swept() -> Spectrum:
    z = 1j * OMEGA
    E = 4e5 + 2e5 * z * 0.01 / (1 + z * 0.01) + 1e5 * z * 0.5 / (1 + z * 0.5)
    return Spectrum(Path("made"), OMEGA, E.real, E.imag)


def table(path: Path, columns: Mapping[str, Any]) -> Path:
    """A CSV file of columns by their headings."""
    rows = (",".join(f"{x:.17g}" for x in row) for row in zip(*columns.values()))
    path.write_text("\n".join([",".join(columns), *rows]) + "\n", encoding="utf-8")
    return path


# series


def test_what_has_faded_is_the_integral():
    """Of a history that steps at first and then is linear between its samples."""
    rng = np.random.default_rng(1)
    t, x = np.sort(rng.uniform(0.1, 5, 12)), rng.normal(size=12)
    rate, tau = np.diff(x) / np.diff(t), np.array([0.02, 0.7, 30.0])
    h = faded(t, x, tau)
    for i in (0, 3, 11):
        for k, time in enumerate(tau):
            fading = lambda s, i=i, time=time: np.exp((s - t[i]) / time)
            parts = [rate[j] * quad(fading, t[j], t[j + 1], epsabs=1e-13)[0] for j in range(i)]
            assert h[i, k] == pytest.approx(sum(parts) + x[0] * fading(0.0), abs=1e-11)


MADE = {
    "step": (relaxing(), RELAXING), "ramp": (relaxing(ramp=0.1), RELAXING),
    "creep": (creeping(), CREEPING), "sweep": (swept(), SWEPT),
    "creep without a spring": (
        Measured(Path("made"), "creep", T, 1e-2 * (1 - np.exp(-T / 5)), np.full_like(T, 5e3)),
        {"E": 5e5, "J_1": 1.0, "tau_1": 5.0},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_a_series_is_found_again_exactly(name):
    made, truth = MADE[name]
    found = fit(made)
    assert found.values == pytest.approx(truth, rel=1e-6)
    assert found.rms < 1e-9
    solid = found.material(**REST)
    assert isinstance(solid, GeneralisedKelvin if made.test == "creep" else Prony)
    assert solid.well_posed() == ""
    if name == "step":
        expected = torch.from_numpy(made.stress / 0.05)
        assert torch.allclose(solid.relaxation(torch.from_numpy(T)), expected, rtol=1e-9)
    if name == "creep":
        late = torch.from_numpy(T[T > 0.1])  # the instantaneous spring is compressed
        expected = torch.from_numpy(made.strain[T > 0.1] / 1e4)
        assert torch.allclose(solid.creep(late), expected, rtol=1e-9)


@pytest.mark.parametrize(("make", "truth"), [(relaxing, RELAXING), (creeping, CREEPING)])
def test_standard_deviations_are_those_of_the_errors(make, truth):
    """Root mean square of the errors over their deviations, by coefficient, in 20 tests with noise
    of 0.5 %; and as many terms are found as there are."""
    terms = (len(truth) - 1) // 2
    assert fit(make(5e-3, 0)).terms == terms
    found = [fit(make(5e-3, seed), terms=terms) for seed in range(20)]
    for name, value in truth.items():
        scaled = [(one.values[name] - value) / one.sd[name] for one in found]
        assert 0.6 < np.sqrt(np.mean(np.square(scaled))) < 1.5, name


def of(strain: Any, stress: Any, t: Any = T, test: Any = "relaxation", **how: Any) -> Measured:
    return Measured(Path("made"), test, t, strain, stress, **how)


NOISY = relaxing(1e-3)
NOTICES = [
    (of(NOISY.strain[T < 20], NOISY.stress[T < 20], T[T < 20]), None,
     "what relaxes slower counts to the relaxed modulus E"),
    (NOISY, 1, "follow a pattern"),
    (of(10 * NOISY.strain, 10 * NOISY.stress), None, "strains go up to 50%"),
    (relaxing(0.1), 3, "hardly determined, with a standard deviation above 50%: "),
    (of(1e-2 + 1e-3 * T, np.full_like(T, 1e4), test="creep"), None, "the creep flows"),
]  # fmt: skip


@pytest.mark.parametrize(("made", "terms", "notice"), NOTICES, ids=[one for *_, one in NOTICES])
def test_what_the_rows_do_not_tell_is_reported(made, terms, notice):
    assert notice in " ".join(fit(made, terms=terms).notices)
    if notice.startswith("what"):
        assert fit(made).values["E"] > 2.2e5  # of 2e5 and 5e4 exp(-20 / 60)
    else:
        assert notice not in " ".join(fit(NOISY).notices)


def test_a_term_that_the_rows_do_not_determine_is_left_out():
    """A jerk in the first rows of a pull, which a term at the shortest time would take for itself;
    asked for, it stays."""
    t = np.arange(0.0, 40.0, 0.04)
    strain = 0.05 * np.clip(t / 2.0, 0, 1)
    stress = responses("relaxation", t, strain, TIMES[1:]) @ np.append(2e5, MODULI[1:])
    stress += 2e-3 * stress.max() * np.random.default_rng(1).normal(size=len(t))
    stress[1:5] += 0.03 * stress.max() * np.array([1.0, 3.0, 2.0, 0.5])
    made = of(strain, stress, t)
    found = fit(made)
    assert not found.undetermined
    assert fit(made, terms=3).undetermined
    assert found.values["tau_1"] == pytest.approx(2.0, rel=0.2)
    assert f"but {found.terms} are taken: the rows do not determine E_1" in found.notices[-1]


def test_a_compliance_over_decades_counts_row_by_row():
    """A power law over twelve decades of time: the series is as good at the first row."""
    t = np.geomspace(1e-8, 1e4, 61)
    found = fit(of(1e-6 * t**0.4, np.ones_like(t), t, "creep", per_load=True))
    assert "of each row" in found.described
    assert np.abs(found.residual / found.measured.answer).max() < 0.2


@pytest.mark.parametrize(
    ("stress", "terms", "words"),
    [
        (relaxing().strain * 1e5 * np.exp(-T / 2.0), None, "no relaxed modulus remains"),
        (1e5 * relaxing().strain, None, "or nothing changes in time"),
        (relaxing().stress, 9, "`terms` must be from 1 to 7 for what made resolves, but is 9"),
    ],
)
def test_what_cannot_be_fitted_is_rejected(stress, terms, words):
    with pytest.raises(ValueError, match=words):
        fit(of(relaxing().strain, stress), terms=terms)


# pulls


def pull(sign: float = 1.0, noise: Any = 0.0) -> dict[str, Array]:
    """A strip of 20 mm and 6 mm2, with a toe, up to 60 % and halfway back, E = 0.8 MPa."""
    strain = np.concatenate((np.linspace(0, 0.6, 121), np.linspace(0.595, 0.3, 60)))
    stress = 0.8e6 * (strain - 0.02) - 0.4e6 * strain**2 + noise
    return {"elongation [mm]": sign * 20 * strain, "force [N]": sign * 6e-6 * stress}


SIZES = {"length": 20e-3, "area": 6e-6}


@pytest.mark.parametrize(
    ("test", "sign"), [("tension", 1.0), ("compression", 1.0), ("compression", -1.0)]
)
def test_the_modulus_of_a_pull_is_that_of_its_range(test, sign, tmp_path):
    path = table(tmp_path / "p.csv", pull(sign))
    found = read(path, test=test, strains=(0.05, 0.15), **SIZES)
    assert isinstance(found, Pull)
    result = modulus(found)
    assert result.values["E"] == pytest.approx(0.8e6 - 0.8e6 * 0.1, rel=1e-3)
    for notice in ("slope goes from 0.76 to 0.68 MPa",
            "rows 2 to 11 were left out (strains below 0.05)",
            "rows 33 to 122 were left out (strains above 0.15)",
            "rows 123 to 182 were left out (after the largest strain)"):  # fmt: skip
        assert any(notice in one for one in result.notices)


def test_the_standard_deviation_of_a_modulus_is_that_of_its_errors():
    strain, rng, scaled = np.linspace(0.05, 0.15, 30), np.random.default_rng(0), []
    for _ in range(200):
        stress = 1e6 * strain + 1e3 * rng.normal(size=30)
        result = modulus(Pull(Path("made"), "tension", strain, stress, (0.05, 0.15), ()))
        scaled.append((result.values["E"] - 1e6) / result.sd["E"])
    assert np.std(scaled) == pytest.approx(1.0, abs=0.15)


# energies

SOFT = {"nu": 0.49, "rho": 1e3, "tau": 0.01, "depth": 0.04}
TRUE = {
    "neo_hookean": NeoHookean(E=6e5, **SOFT),
    "mooney_rivlin": MooneyRivlin(C10=8e4, C01=2e4, **SOFT),
    "yeoh": Yeoh(C10=9e4, C20=-5e3, C30=8e2, **SOFT),
    "ogden": Ogden(mu=[2e5, 3e4], alpha=[1.7, -2.5], **SOFT),
}
WAYS = {
    "tension": np.linspace(1.01, 2.0, 20), "compression": np.linspace(0.99, 0.6, 15),
    "planar": np.linspace(1.01, 1.8, 15), "biaxial": np.linspace(1.01, 1.6, 15),
    "shear": np.linspace(0.02, 1.0, 15),
}  # fmt: skip


def columns(test: str, material: Any, noise: float = 0.0) -> dict[str, Array]:
    x = WAYS[test]
    stress = nominal_stress(material, test, x)
    stress *= 1 + noise * np.random.default_rng(0).normal(size=len(x))
    return {"strain [1]": x if test == "shear" else x - 1, "stress [MPa]": 1e-6 * stress}


def pulls(folder: Path, material: Any, *tests: str, noise: float = 0.0) -> list[Any]:
    paths = [table(folder / f"{test}.csv", columns(test, material, noise)) for test in tests]
    return [read(path, test=path.stem, whole=True) for path in paths]  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("test", "power"),
    [("tension", 2), ("compression", 2), ("planar", 3), ("biaxial", 5), ("shear", None)],
)
def test_closed_forms_of_the_neo_hookean_solid(test, power):
    x, mu = WAYS[test], 6e5 / (2 * 1.49)
    expected = mu * (x if power is None else x - x**-power)
    assert nominal_stress(TRUE["neo_hookean"], test, x) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("kind", TRUE)
def test_energies_are_found_again_from_three_kinds_of_tests(kind, tmp_path):
    rows = pulls(tmp_path, TRUE[kind], "tension", "compression", "biaxial")
    found = fit_energy(rows, kind, nu=0.49, terms=2 if kind == "ogden" else None)
    assert found.rms < 1e-8
    x, made = np.linspace(0.7, 1.6, 20), found.material(**SOFT)
    for test in ("planar", "shear"):
        expected = nominal_stress(TRUE[kind], test, x)
        assert nominal_stress(made, test, x) == pytest.approx(expected, rel=1e-5, abs=10)


def test_an_exponent_may_pass_zero(tmp_path):
    """In the search for the one term of a material that has two of opposite signs."""
    found = fit_energy(pulls(tmp_path, TRUE["ogden"], "tension", "shear"), "ogden", nu=0.49)
    assert found.rms < 0.02


def test_noise_shows_in_the_standard_deviation(tmp_path):
    found = fit_energy(
        pulls(tmp_path, TRUE["neo_hookean"], "tension", noise=0.02), "neo_hookean", nu=0.49
    )
    assert abs(found.values["E"] - 6e5) < 3 * found.sd["E"]
    assert 1e3 < found.sd["E"] < 1e4


@pytest.mark.parametrize(("test", "end", "sign"), [("tension", 2.0, 1), ("compression", 0.6, 1),
    ("compression", 0.6, -1)])  # fmt: skip
def test_true_stress_counts_in_either_sign(test, end, sign, tmp_path):
    """True stress is E / 3 (x^2 - 1 / x), whichever direction counts as positive."""
    x = np.linspace(1, end, 21)[1:]
    made = {"strain [1]": sign * (x - 1), "stress [Pa]": sign * 2e5 * (x**2 - 1 / x)}
    rows = read(table(tmp_path / "t.csv", made), test=test, whole=True, true=True)
    found = fit_energy([rows], "neo_hookean", nu=0.49)
    assert found.values["E"] == pytest.approx(2 * 1.49 * 2e5, rel=1e-9)


def test_unphysical_energies_are_rejected(tmp_path):
    """The stress grows with the cube of the strain, so that a polynomial starts downwards."""
    x = np.linspace(0, 1.5, 30)
    made = lambda stress: [Pull(tmp_path / "made.csv", "tension", x, stress, (0.0, 1.5), ())]
    for kind in ("mooney_rivlin", "yeoh"):
        with pytest.raises(ValueError, match=r"a shear modulus of -\d.* but it must be positive"):
            fit_energy(made(1e5 * x**3), kind, nu=0.49)
    soft = fit_energy(made(1e-3 * x), "neo_hookean", nu=0.49)
    with pytest.raises(ValueError, match=r"parameter `E` must be from 1 to .* but is 0\.00"):
        write(soft, tmp_path, SOFT, {})


STIFFENING = np.fromstring(
    "0 0.25739 0.420847 0.518429 0.609233 0.659472 0.725627 0.756164 0.812768 0.834691 0.889458 "
    "0.909682 0.968974 0.993877 1.064964 1.101971 1.194328 1.252889 1.379243 1.471617 1.648954 "
    "1.790940 2.041571",
    sep=" ",
)
"""Stress [MPa] at stretches from 1 to 7.38, which stiffens as natural rubber does."""


@pytest.mark.parametrize(
    ("terms", "rms"), [(2, 0.00515), pytest.param(3, 0.00509, marks=pytest.mark.slow)]
)
def test_ogdens_exponents_are_bounded_so_that_no_power_overflows(terms, rms, tmp_path):
    x = np.linspace(0, 6.38, len(STIFFENING))
    made = Pull(tmp_path / "p.csv", "tension", x, 1e6 * STIFFENING, (0.0, 6.38), ())
    found = fit_energy([made], "ogden", nu=0.49, terms=terms)
    assert found.rms < rms
    assert any("at the limit of exponents" in one for one in found.notices) == (terms == 3)


def test_what_one_test_does_not_tell_is_reported(tmp_path):
    rows = pulls(tmp_path, TRUE["yeoh"], "tension")
    notices = " ".join(fit_energy(rows, "mooney_rivlin", nu=0.49).notices)
    assert "stretches from 1.01 to 2" in notices
    assert "one kind of test does not determine" in notices
    falling = pulls(tmp_path, Yeoh(C10=9e4, C20=-9e3, C30=4e2, **SOFT), "tension")
    assert "not stable" in " ".join(fit_energy(falling, "yeoh", nu=0.49).notices)
    for kind, terms, words in (("yeoh", 2, "those of ogden"), ("ogden", 6, "take fewer terms")):
        with pytest.raises(ValueError, match=words):
            fit_energy(rows, kind, nu=0.49, terms=terms)


# tables

STRAIN, STRESS = relaxing().strain, relaxing().stress
STORAGE, LOSS, HERTZ = swept().storage, swept().loss, OMEGA / (2 * np.pi)
SAME = [
    ({"t [ms]": 1e3 * T, "strain [%]": 1e2 * STRAIN, "stress [MPa]": 1e-6 * STRESS}, {}),
    ({"t [min]": T / 60, "stretch [1]": 1 + STRAIN, "stress [kPa]": 1e-3 * STRESS}, {}),
    ({"t [h]": T / 3600, "elongation [mm]": 80 * STRAIN, "force [N]": 2e-5 * STRESS},
     {"length": 0.08, "area": 2e-5}),
    ({"t [s]": T, "modulus [GPa]": 1e-9 * STRESS / 0.05}, {}),
    ({"t [s]": T, "compliance [1/MPa]": 1e2 * creeping().strain}, {}),
    ({"frequency [Hz]": HERTZ, "storage_modulus [MPa]": 1e-6 * STORAGE,
      "loss_modulus [kPa]": 1e-3 * LOSS}, {}),
    ({"loss_shear_modulus [Pa]": LOSS[::-1] / 2.9, "frequency [rad/s]": OMEGA[::-1],
      "storage_shear_modulus [Pa]": STORAGE[::-1] / 2.9}, {"nu": 0.45}),
    ({"frequency [Hz]": HERTZ, "tan_delta [1]": LOSS / STORAGE, "storage_modulus [Pa]": STORAGE},
     {}),
]  # fmt: skip


@pytest.mark.parametrize(("made", "how"), SAME, ids=[" ".join(one) for one, _ in SAME])
def test_every_column_and_unit_reads_the_same(made, how, tmp_path):
    found = read(table(tmp_path / "test.csv", made), **how)
    expected = {"relaxation": relaxing(), "creep": creeping(), "sweep": swept()}[found.test]
    assert ("compliance" in " ".join(made)) == (found.test == "creep")
    assert np.allclose(found.t, expected.t, rtol=1e-12, atol=1e-15)
    scale = expected.driven if found.test != "sweep" and found.per_load else 1.0
    assert np.allclose(scale * found.answer, expected.answer, rtol=1e-12)


COUNT, ONES = np.arange(21.0), np.ones(21)
HELD = {"t [s]": COUNT, "strain [1]": ONES, "stress [Pa]": ONES}
MODULUS = {"t [s]": COUNT, "modulus [Pa]": ONES}
SWEEP = {"frequency [Hz]": OMEGA, "storage_modulus [Pa]": OMEGA[::-1], "tan_delta [1]": OMEGA}
TRIANGLE = {"strain [1]": 10 - abs(10 - COUNT), "stress [Pa]": 10 - abs(10 - COUNT)}
PULLED = {"test": "tension", "whole": True}
PRESSED = {"test": "compression", "whole": True}
FROM_NOTHING = {"t [s]": COUNT, "strain [1]": -0.1 * COUNT, "stress [Pa]": -COUNT}
WRONG = [
    ({"t [s]": COUNT, "stress [Pa]": ONES}, {}, "needs one of the columns strain, stretch"),
    (HELD | {"stretch [1]": ONES}, {}, "but has strain and stretch"),
    (TRIANGLE, {}, "has no column `t`"),
    (HELD | {"t [s]": np.r_[COUNT[:-1], 3]}, {}, "row 22, column `t`: 3 s follows 19 s"),
    ({name: x[:5] for name, x in HELD.items()}, {}, "has 5 rows of numbers, but needs at least 8"),
    (HELD | {"strain [1]": 0 * ONES}, {}, "the strain is zero throughout"),
    (HELD | {"stress [Pa]": -ONES}, {}, "strain and stress are opposite"),
    ({"t [s]": COUNT, "elongation [m]": ONES, "force [N]": ONES}, {}, "gauge length, `length`"),
    (HELD, {"area": 1.0}, "`stress` needs no `area`"),
    (MODULUS | {"strain [1]": ONES}, {}, "`modulus` stands alone beside `t`"),
    (MODULUS, {"test": "creep"}, "`modulus` is of a relaxation test, not"),
    (MODULUS | {"modulus [Pa]": 7.5 - COUNT}, {}, "row 10, column `modulus`: -0.5 Pa is not above"),
    (TRIANGLE | {"t [s]": COUNT}, {}, "neither strain nor stress was held, they change by 100%"),
    (TRIANGLE, {"test": "tension"}, "--range 0 0.1; the test goes from 0 to 10"),
    (TRIANGLE, {"test": "tension", "strains": (20, 30)}, "has 0 rows with strains from 20 to 30"),
    (TRIANGLE, PRESSED, "row 3: the strain is -1, but"),
    (FROM_NOTHING, {}, "row 12: the strain is -1, but"),
    ({name: x[:10] for name, x in FROM_NOTHING.items()}, PULLED, "the strain is negative, -0.9"),
    ({"stretch [1]": 1 + COUNT, "stress [Pa]": COUNT}, PRESSED, "up to 21, but"),
    ({name: np.r_[x, 2 * x] for name, x in TRIANGLE.items()}, PULLED, "keep the rows of one load"),
    (SWEEP, {}, "the storage modulus falls from 1000 Pa"),
    ({"frequency [Hz]": OMEGA, "storage_modulus [Pa]": OMEGA}, {}, "may replace the second; but"),
    (SAME[6][0], {}, "need Poisson's"),
    (SWEEP, {"test": "creep"}, "`frequency` is of a sweep, not of a creep test"),
]  # fmt: skip


@pytest.mark.parametrize(("made", "how", "message"), WRONG, ids=[one for *_, one in WRONG])
def test_a_table_that_makes_no_sense_is_rejected(made, how, message, tmp_path):
    with pytest.raises(ValueError, match=re.escape(message)):
        read(table(tmp_path / "test.csv", made), **how)


# the command


def relaxation(folder: Path) -> Path:
    """A relaxation test of a rubber with two terms, a third and a sixth of its relaxed modulus."""
    t = np.geomspace(1e-3, 100, 100)
    modulus = 5e5 * (1 + np.exp(-t / 0.1) / 3 + np.exp(-t / 4.0) / 6)
    return table(folder / "relaxation.csv", {"t [s]": t, "modulus [Pa]": modulus})


NOISIER = relaxing(2e-3)
RELAXED = {"t [s]": T, "strain [1]": NOISIER.strain, "stress [Pa]": NOISIER.stress}
FITTED = ["--test", "tension", "--nu", "0.49", "--energy"]
COMMANDS = {
    "relaxing": (lambda f: table(f / "test.csv", RELAXED), ["--nu", "0.49", "--depth", "0.02"],
        "prony of 3 terms", 2e5),
    "pull": (lambda f: table(f / "test.csv", pull()), ["--test", "tension", "--range", "0", "0.1",
        "--length", "0.02", "--area", "6e-6", "--tau", "0.02"], "kelvin_voigt, residual", 0.76e6),
    "energy": (lambda f: table(f / "test.csv", columns("tension", TRUE["ogden"])), [*FITTED,
        "ogden", "--terms", "2", "--also", "shear={}/shear.csv"], "residual", 2.3e5 * 2.98),
    "slow": (lambda f: table(f / "test.csv", columns("tension", TRUE["neo_hookean"])), [*FITTED,
        "neo_hookean", "--relaxation", "{}/relaxation.csv"], "count as slow", 6e5),
    "fast": (lambda f: table(f / "test.csv", columns("tension", TRUE["neo_hookean"])), [*FITTED,
        "neo_hookean", "--relaxation", "{}/relaxation.csv", "--fast"], "count as fast", 4e5),
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_writes_a_material_that_rig_files_take(name, tmp_path, capsys):
    make, options, words, E = COMMANDS[name]
    file, out = make(tmp_path), tmp_path / "out"
    table(tmp_path / "shear.csv", columns("shear", TRUE["ogden"]))
    relaxation(tmp_path)
    options = [one.format(tmp_path) for one in options]
    assert main(["material", "fit", str(file), *options, "--out", str(out)]) == 0
    text, err = capsys.readouterr()
    assert err == ""
    assert words in text
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    rubber = {"kind": "file", "file": str(out / "material.toml")}
    rig = RigFile.ready("paper").override({"materials.rubber": rubber}).assemble()
    material = rig.pads["L"].material
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert (out / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert material.E.item() == pytest.approx(E, rel=0.02 if "ing" in name else 1e-3)
    for key, default in {"nu": 0.45, "depth": 0.044}.items():
        given = options[options.index(f"--{key}") + 1] if f"--{key}" in options else default
        assert getattr(material, key).item() == float(given)
    assert summary["data"]["sha256"] == sha256(file.read_bytes()).hexdigest()
    assert all(notice in text for notice in summary["notices"])
    if name in ("slow", "fast"):  # branches relative to the relaxed energy
        found = sorted(x.item() for pair in material.relaxation() for x in pair)
        assert found == pytest.approx([0.1, 1 / 6, 1 / 3, 4.0], rel=1e-3)


def test_a_torn_specimen_is_read_up_to_where_it_tore(tmp_path):
    """A specimen of 3 mu = 87 kPa that tears at a stretch of 2.6, in row 34; with the range that
    the error advises."""
    x = np.linspace(1, 2.9, 39)
    stress = 29e3 * (x - x**-2) * np.where(x > 2.6001, (3 - x) / 0.5, 1)
    path = table(tmp_path / "torn.csv", {"stretch [1]": x, "stress [Pa]": stress})
    with pytest.raises(ValueError, match=r"row 35: the stress falls .*a stretch of 2.6") as error:
        read(path, test="tension", whole=True)
    low, high = map(float, str(error.value).split("--range")[1].split())
    rows = read(path, test="tension", strains=(low, high))
    assert (rows.strain[-1], len(rows.strain)) == (pytest.approx(1.6), 33)


OPTIONS = [
    (["--column", "strain"], "--column must be NAME=HEADING"),
    ([*FITTED[:2], "--range", "0", "1", "--also", "shear=x.csv"], "--also is of"),
    ([*FITTED, "yeoh", "--also", "x.csv"], "must be TEST=FILE"),
    ([*FITTED, "yeoh", "--fast"], "state it, --relaxation FILE"),
    (["--test", "planar", "--range", "0", "1"], "use --energy neo_hookean"),
]


@pytest.mark.parametrize(("options", "words"), OPTIONS, ids=[one for *_, one in OPTIONS])
def test_options_that_do_not_belong_are_rejected(options, words, tmp_path, capsys):
    path = table(tmp_path / "t.csv", columns("tension", TRUE["yeoh"]))
    assert main(["material", "fit", str(path), *options, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err


# rubbers from the literature


def test_presets_say_where_every_coefficient_is_from(capsys):
    assert main(["material", "presets"]) == 0
    text = capsys.readouterr().out
    for name, one in PRESETS.items():
        material = one.material(0.044)
        assert material.well_posed() == ""
        for coefficient, (value, source, origin) in one.coefficients.items():
            assert f"{source}: {origin}" in text
            own = f"{coefficient}_1" if coefficient in ("mu", "alpha") else coefficient
            assert getattr(material, own).item() == value
            assumed = coefficient in ("nu", "rho", "tau")
            fitted = "fitted" if "finite strain" in name else "published"
            assert source == ("assumed" if assumed else fitted)


def test_the_relation_of_hardness_and_modulus():
    """Gent (1958), at two hardnesses by hand; only where the scale means something."""
    assert from_shore_a(20) == pytest.approx(0.0981e6 * 208.4672 / (0.137505 * 203.2), rel=1e-12)
    assert from_shore_a(50) == pytest.approx(2.46e6, rel=5e-3)
    for hardness in (10.0, 95.0):
        with pytest.raises(ValueError, match="the hardness must be from 20 to 80 Shore A"):
            from_shore_a(hardness)
