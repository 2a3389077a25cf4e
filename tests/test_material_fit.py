"""Materials fitted to relaxation and creep tests, the command that does it, and rubbers from the
literature."""

import json
import math
import re
import tomllib
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.integrate import quad

from torchsoft.cli import main
from torchsoft.materials.fit import Fit, fit
from torchsoft.materials.measured import Measured, faded, read, responses
from torchsoft.materials.presets import PRESETS, from_shore_a
from torchsoft.materials.written import FILES
from torchsoft.physics.hyperelastic import KINDS
from torchsoft.physics.material import GeneralisedKelvin, Prony

Array = NDArray[np.float64]
REST = {"nu": 0.45, "rho": 1100.0, "depth": 0.044}
MODULI, TIMES = np.array([3e5, 1e5, 5e4]), np.array([0.05, 2.0, 60.0])
RELAXING = {
    "E": 2e5,
    "E_1": 3e5,
    "E_2": 1e5,
    "E_3": 5e4,
    "tau_1": 0.05,
    "tau_2": 2.0,
    "tau_3": 60.0,
}
COMPLIANCES, LATE = np.array([1e-6, 0.5e-6, 2e-6]), np.array([0.3, 20.0])
CREEPING = {"E": 1e6 / 3.5, "J_1": 0.5 / 3.5, "J_2": 2 / 3.5, "tau_1": 0.3, "tau_2": 20.0}
T = np.concatenate(([0.0], np.geomspace(1e-2, 600, 200)))


def relaxing(noise: float = 0.0, seed: int = 0, ramp: float = 0.0) -> Measured:
    """A strain of 5 % put on within `ramp` [s], and the stress, with noise over the largest."""
    strain = np.full_like(T, 0.05) if ramp == 0 else 0.05 * np.clip(T / ramp, 0, 1)
    stress = responses("relaxation", T, strain, TIMES) @ np.append(2e5, MODULI)
    stress += noise * stress.max() * np.random.default_rng(seed).normal(size=len(T))
    return Measured(Path("made"), "relaxation", T, strain, stress)


def creeping(noise: float = 0.0, seed: int = 0) -> Measured:
    """A stress of 10 kPa put on at once, and the strain."""
    stress = np.full_like(T, 1e4)
    strain = responses("creep", T, stress, LATE) @ COMPLIANCES
    strain += noise * strain.max() * np.random.default_rng(seed).normal(size=len(T))
    return Measured(Path("made"), "creep", T, strain, stress)


def table(path: Path, **columns: Array) -> Path:
    """A CSV file of columns by their headings, `_` for the space before the unit."""
    heading = ",".join(name.replace("_", " ") for name in columns)
    rows = (",".join(f"{x:.17g}" for x in row) for row in zip(*columns.values()))
    path.write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    return path


def plain(folder: Path, measured: Measured, name: str = "test.csv") -> Path:
    return table(
        folder / name,
        **{"t_[s]": measured.t, "strain_[1]": measured.strain, "stress_[Pa]": measured.stress},
    )


# --- series and fits
# ----------------------------------------------------------------------


def test_what_has_faded_is_the_integral():
    """Of a history that steps at first and then is linear between its samples."""
    rng = np.random.default_rng(1)
    t, x = np.sort(rng.uniform(0.1, 5, 12)), rng.normal(size=12)
    tau = np.array([0.02, 0.7, 30.0])

    def piece(s: float, i: int, j: int, time: float) -> float:
        return math.exp((s - t[i]) / time) * (x[j + 1] - x[j]) / (t[j + 1] - t[j])

    h = faded(t, x, tau)
    for i in (0, 3, 11):
        for k, time in enumerate(tau):
            parts = [
                quad(piece, t[j], t[j + 1], args=(i, j, time), epsabs=1e-13)[0] for j in range(i)
            ]
            assert h[i, k] == pytest.approx(sum(parts) + x[0] * math.exp(-t[i] / time), abs=1e-11)


@pytest.mark.parametrize(
    ("made", "truth"),
    [(relaxing(), RELAXING), (relaxing(ramp=0.1), RELAXING), (creeping(), CREEPING)],
    ids=["step", "ramp", "creep"],
)
def test_a_series_is_found_again_exactly(made, truth):
    found = fit(made)
    assert found.terms == (len(truth) - 1) // 2
    assert found.values == pytest.approx(truth, rel=1e-9)
    assert found.rms < 1e-12
    if made.test == "relaxation":
        solid = found.material(**REST)
        assert isinstance(solid, Prony)
        expected = torch.from_numpy(made.stress / 0.05)
        if made.strain[0] > 0:
            assert torch.allclose(
                solid.relaxation(torch.from_numpy(T)).detach(), expected, rtol=1e-9
            )
    else:
        solid = found.material(**REST)
        assert isinstance(solid, GeneralisedKelvin)
        late = torch.from_numpy(T[T > 0.1])  # the instantaneous spring has given way
        assert torch.allclose(
            solid.creep(late).detach(), torch.from_numpy(made.strain[T > 0.1] / 1e4), rtol=1e-9
        )


@pytest.mark.parametrize(("make", "truth"), [(relaxing, RELAXING), (creeping, CREEPING)])
def test_standard_deviations_are_those_of_the_errors(make, truth):
    """Root mean square of the errors over their deviations, by coefficient, in 30 tests with noise
    of 0.5 %; and as many terms are asked for as there are."""
    terms = (len(truth) - 1) // 2
    assert [fit(make(5e-3, seed)).terms for seed in range(3)] == [terms] * 3
    found = [fit(make(5e-3, seed), terms=terms) for seed in range(30)]
    for name, value in truth.items():
        scaled = np.array([(one.values[name] - value) / one.sd[name] for one in found])
        assert 0.6 < np.sqrt(np.mean(scaled**2)) < 1.5, name


def test_a_solid_without_a_spring_creeps_from_nothing():
    """Kelvin and Voigt's: all of the compliance is late, and none is left at once."""
    stress = np.full_like(T, 1e4)
    strain = responses("creep", T, stress, np.array([5.0])) @ np.array([0.0, 2e-6])
    found = fit(Measured(Path("made"), "creep", T, strain, stress))
    assert found.values == pytest.approx({"E": 5e5, "J_1": 1.0, "tau_1": 5.0}, rel=1e-6)
    solid = found.material(**REST)
    assert isinstance(solid, GeneralisedKelvin)
    assert solid.well_posed() == ""


def test_what_the_rows_do_not_tell_is_said():
    """A time beyond the test counts to what remains; a pattern in the residuals, and large
    strains."""
    made = relaxing(1e-3)
    early = made.t < 20
    short = fit(
        Measured(made.path, "relaxation", made.t[early], made.strain[early], made.stress[early])
    )
    assert (
        "they do not tell what relaxes faster, and what relaxes slower counts to the relaxed "
        "modulus E" in short.notices[0]
    )
    assert short.values["E"] > 2.2e5  # of 2e5 and 5e4 exp(-20 / 60)
    assert len(fit(made).notices) == 1
    few = fit(made, terms=1)
    assert few.terms == 1
    assert few.correlation > 0.8
    assert any("follow a pattern" in notice for notice in few.notices)
    large = fit(Measured(made.path, "relaxation", made.t, 10 * made.strain, 10 * made.stress))
    assert any(
        "strains go up to 50%, and the material is linear" in notice for notice in large.notices
    )
    noisy = fit(relaxing(0.1), terms=3)
    assert any(
        "hardly determined, with a standard deviation above 50%: " in notice
        for notice in noisy.notices
    )


def test_one_odd_row_at_the_end_changes_nothing():
    """A row written twice, a microsecond apart: no term relaxes within it."""
    made = relaxing(1e-3)
    t = np.append(made.t, made.t[-1] + 1e-6)
    strain, stress = np.append(made.strain, 0.05), np.append(made.stress, 1.02 * made.stress[-1])
    odd = Measured(made.path, "relaxation", t, strain, stress)
    assert odd.window[0] == pytest.approx(made.window[0])
    regular, found = fit(made), fit(odd)
    assert found.terms == regular.terms
    assert found.values == pytest.approx(regular.values, rel=0.1)


def test_a_term_that_the_rows_do_not_determine_is_left_out():
    """A jerk in the first rows of a pull, which a term at the shortest time would take for itself;
    asked for, it stays."""
    t = np.arange(0.0, 40.0, 0.02)
    strain = 0.05 * np.clip(t / 2.0, 0, 1)
    stress = responses("relaxation", t, strain, TIMES[1:]) @ np.append(2e5, MODULI[1:])
    stress += 2e-3 * stress.max() * np.random.default_rng(1).normal(size=len(t))
    stress[1:5] += 0.03 * stress.max() * np.array([1.0, 3.0, 2.0, 0.5])
    made = Measured(Path("made"), "relaxation", t, strain, stress)
    found, asked = fit(made), fit(made, terms=3)
    assert not found.undetermined
    assert asked.undetermined
    assert found.terms < min(found.scores, key=lambda k: found.scores[k])
    assert found.values["tau_1"] == pytest.approx(2.0, rel=0.2)
    assert f"but {found.terms} are taken: the rows do not determine E_1" in found.notices[-1]


def test_a_compliance_over_decades_counts_row_by_row():
    """A power law over twelve decades of time: the series is as good at the first row."""
    t = np.geomspace(1e-8, 1e4, 121)
    measured = Measured(Path("made"), "creep", t, 1e-6 * t**0.4, np.ones_like(t), per_load=True)
    found = fit(measured)
    assert found.residual_of == "of each row"
    assert np.abs(found.residual / measured.answer).max() < 0.2
    assert found.rms < 0.05
    assert fit(relaxing()).residual_of == "of the largest"


def test_creep_that_flows_is_named():
    """Under a held stress a Maxwell element's strain grows for ever; a solid's does not."""
    flowing = Measured(Path("made"), "creep", T, 1e-2 + 1e-3 * T, np.full_like(T, 1e4))
    assert any("the creep flows" in notice for notice in fit(flowing).notices)
    assert not any("the creep flows" in notice for notice in fit(creeping()).notices)


# --- files
# ----------------------------------------------------------------------


def test_every_column_and_unit_reads_the_same(tmp_path):
    made = relaxing()
    ways: list[tuple[dict[str, Array], dict[str, Any]]] = [
        ({"t_[s]": T, "strain_[1]": made.strain, "stress_[Pa]": made.stress}, {}),
        ({"t_[ms]": 1e3 * T, "strain_[%]": 1e2 * made.strain, "stress_[MPa]": 1e-6 * made.stress},
        {}), ({"t_[min]": T / 60, "stretch_[1]": 1 + made.strain,
        "stress_[kPa]": 1e-3 * made.stress}, {}),
        ({"t_[h]": T / 3600, "elongation_[mm]": 80 * made.strain, "force_[N]": 2e-5 * made.stress},
         {"length": 0.08, "area": 2e-5}),
        ({"t_[s]": T, "modulus_[GPa]": 1e-9 * made.stress / 0.05}, {}),
    ]  # fmt: skip
    for columns, how in ways:
        found = read(table(tmp_path / "test.csv", **columns), **how)
        assert found.test == "relaxation"
        scale = 0.05 if found.per_load else 1.0
        for mine, its in (
            (found.t, T),
            (scale * found.strain, made.strain),
            (scale * found.stress, made.stress),
        ):
            assert np.allclose(mine, its, rtol=1e-12, atol=1e-15)
    made = creeping()
    for columns in (
        {"t_[s]": T, "strain_[1]": made.strain, "stress_[Pa]": made.stress},
        {"t_[s]": T, "compliance_[1/MPa]": 1e2 * made.strain},
    ):
        found = read(table(tmp_path / "test.csv", **columns))
        assert found.test == "creep"
        assert np.allclose(found.strain / found.stress, made.strain / made.stress, rtol=1e-12)


ONES, ZEROS = np.ones(9), np.zeros(9)
COUNT = np.arange(9.0)
REFUSED: dict[str, tuple[dict[str, Array], dict[str, Any], str]] = {
    "no strain": ({"t_[s]": COUNT, "stress_[Pa]": ONES}, {},
        "needs one of the columns strain, stretch, elongation"),
    "two strains": (
        {"t_[s]": COUNT, "strain_[1]": ONES, "stretch_[1]": ONES, "stress_[Pa]": ONES}, {},
        "but has strain and stretch"
    ),
    "no time": ({"strain_[1]": ONES, "stress_[Pa]": ONES}, {}, "has no column `t`"),
    "another unit": ({"t_[s]": COUNT, "modulus_[bar]": ONES}, {},
        "column `modulus` cannot be in 'bar'; it can be in Pa, kPa"),
    "unknown column": ({"t_[s]": COUNT, "E_[Pa]": ONES}, {},
        "row 1, column `E` is not known; columns and their units"),
    "negative time": ({"t_[s]": COUNT - 1, "modulus_[Pa]": ONES}, {},
        "row 2, column `t`: -1 s is before the load"),
    "time goes back": ({"t_[s]": np.r_[COUNT[:-1], 3], "modulus_[Pa]": ONES}, {},
        "row 10, column `t`: 3 s is not after 7 s"),
    "few rows": ({"t_[s]": COUNT[:5], "modulus_[Pa]": ONES[:5]}, {},
        "has 5 rows of numbers, but needs at least 8"),
    "no load": ({"t_[s]": COUNT, "strain_[1]": ZEROS, "stress_[Pa]": ONES}, {},
        "the strain is zero throughout"),
    "opposite": ({"t_[s]": COUNT, "strain_[1]": ONES, "stress_[Pa]": -ONES}, {},
    "strain and stress are opposite"),
    "no length": ({"t_[s]": COUNT, "elongation_[m]": ONES, "stress_[Pa]": ONES}, {},
    "needs the gauge length, `length` (--length) [m]"),
    "no area": ({"t_[s]": COUNT, "strain_[1]": ONES, "force_[N]": ONES}, {},
        "a force needs the cross-section, `area` (--area) [m2]"),
    "a length": ({"t_[s]": COUNT, "strain_[1]": ONES, "stress_[Pa]": ONES}, {"length": 1.0},
    "`strain` needs no `length`"), "negative area": (
        {"t_[s]": COUNT, "strain_[1]": ONES, "force_[N]": ONES}, {"area": -1.0},
        "`area` must be positive and finite, but is -1"
    ),
    "modulus and strain": ({"t_[s]": COUNT, "modulus_[Pa]": ONES, "strain_[1]": ONES}, {},
    "`modulus` stands alone beside `t`"),
    "modulus, creep": ({"t_[s]": COUNT, "modulus_[Pa]": ONES}, {"test": "creep"},
        "`modulus` is of a relaxation test, not"),
    "modulus, area": ({"t_[s]": COUNT, "modulus_[Pa]": ONES}, {"area": 1.0},
        "nothing is to be divided by the `area`"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_that_makes_no_sense_is_refused(name, tmp_path):
    columns, how, message = REFUSED[name]
    with pytest.raises(ValueError, match=re.escape(message)):
        read(table(tmp_path / "test.csv", **columns), **how)


def test_an_empty_cell_is_refused(tmp_path):
    path = plain(tmp_path, relaxing())
    path.write_text(path.read_text().replace("0.050000000000000003", "", 3))
    with pytest.raises(ValueError, match=r"test.csv, row 2, column `strain` is empty"):
        read(path)


def test_what_cannot_be_fitted_is_refused():
    made = relaxing()
    flowing = Measured(
        made.path, "relaxation", T, made.strain, made.strain * 1e5 * np.exp(-T / 2.0)
    )
    with pytest.raises(ValueError, match="no relaxed modulus remains, or nothing changes in time"):
        fit(flowing)
    with pytest.raises(ValueError, match="no relaxed modulus remains, or nothing changes in time"):
        fit(Measured(made.path, "relaxation", T, made.strain, 1e5 * made.strain))
    with pytest.raises(
        ValueError, match="`terms` must be from 1 to 7 for what made resolves, but is 9"
    ):
        fit(made, terms=9)


# --- the command
# ----------------------------------------------------------------------


@pytest.mark.parametrize("make", [relaxing, creeping])
def test_the_command_writes_a_table_a_summary_and_a_figure(make, tmp_path, capsys):
    file, out = plain(tmp_path, make(2e-3), "my rubber.csv"), tmp_path / "out"
    assert (
        main(["material", "fit", str(file), "--out", str(out), "--nu", "0.49", "--depth", "0.02"])
        == 0
    )
    text, err = capsys.readouterr()
    assert err == ""
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    test = read(file)
    assert isinstance(test, Measured)
    found: Fit = fit(test)
    made = tomllib.loads((out / "material.toml").read_text(encoding="utf-8"))["materials"][
        "my rubber"
    ]
    solid = KINDS[made.pop("kind")](**made)
    assert made == found.table() | {"nu": 0.49, "rho": 1100.0, "depth": 0.02}
    assert type(solid) is type(found.material(**REST))
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["data"]["sha256"] == sha256(file.read_bytes()).hexdigest()
    assert {name: one["value"] for name, one in summary["coefficients"].items()} == dict(
        found.values
    )
    assert summary["notices"] == list(found.notices)
    assert all(notice in text for notice in found.notices)
    assert (out / "fit.png").read_bytes().startswith(b"\x89PNG")


# --- rubbers from the literature
# ----------------------------------------------------------------------


def test_presets_say_where_every_coefficient_is_from(capsys):
    assert main(["material", "presets"]) == 0
    said = capsys.readouterr().out
    for name, one in PRESETS.items():
        assert one.name == name
        finite = "finite strain" in name
        assert set(one.coefficients) - {"nu", "rho", "tau"} == (
            {"mu", "alpha"} if finite else {"E"}
        )
        for coefficient, (value, source, origin) in one.coefficients.items():
            known = "assumed" if coefficient in ("nu", "rho", "tau") else "published"
            assert source == ("fitted" if finite and known == "published" else known)
            assert f"{source}: {origin}" in said
            own = f"{coefficient}_1" if coefficient in ("mu", "alpha") else coefficient
            assert getattr(one.material(0.03), own).item() == value


def test_the_relation_of_hardness_and_modulus():
    """Gent (1958), at two hardnesses by hand; only where the scale means something."""
    assert from_shore_a(20) == pytest.approx(0.0981e6 * 208.4672 / (0.137505 * 203.2), rel=1e-12)
    assert from_shore_a(50) == pytest.approx(2.46e6, rel=5e-3)
    for hardness in (10.0, 95.0, math.nan):
        with pytest.raises(ValueError, match="the hardness must be from 20 to 80 Shore A"):
            from_shore_a(hardness)
