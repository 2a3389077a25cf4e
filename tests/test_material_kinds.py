"""Materials of frequency sweeps, pulls and decks: files as laboratories have them, read by the
command and in Python."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from torchsoft.cli import main
from torchsoft.materials.deck import read_deck
from torchsoft.materials.fit import fit
from torchsoft.materials.measured import Measured, Pull, Spectrum, read
from torchsoft.materials.modulus import modulus
from torchsoft.physics.hyperelastic import KINDS
from torchsoft.physics.material import Prony

REST = {"nu": 0.45, "rho": 1100.0, "depth": 0.044}
RUBBER = Prony(E=4e5, moduli=[2e5, 1e5], tau=[0.01, 0.5], **REST)
OMEGA = np.geomspace(0.1, 1e3, 25)


def spectrum(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Storage and loss modulus of `RUBBER` with relative noise."""
    parts = ((2e5, 0.01), (1e5, 0.5))
    z = 4e5 + sum(E * 1j * OMEGA * tau / (1 + 1j * OMEGA * tau) for E, tau in parts)
    rng = np.random.default_rng(3)
    return (
        z.real * (1 + noise * rng.normal(size=25)),
        z.imag * (1 + noise * rng.normal(size=25)),
    )


def write(path: Path, head: str, *columns: np.ndarray) -> Path:
    rows = (",".join(f"{x:.12g}" for x in row) for row in zip(*columns))
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


# --- sweeps


def swept(path: Path, way: str) -> Path:
    storage, loss = spectrum()
    hertz, shear = OMEGA / (2 * np.pi), 2 * 1.45
    if way == "tension":
        head = "frequency [Hz],storage_modulus [MPa],loss_modulus [kPa]"
        return write(path, head, hertz, 1e-6 * storage, 1e-3 * loss)
    if way == "shear, the highest frequency first":
        head = "loss_shear_modulus [Pa],frequency [rad/s],storage_shear_modulus [Pa]"
        return write(path, head, (loss / shear)[::-1], OMEGA[::-1], (storage / shear)[::-1])
    head = "frequency [Hz],tan_delta [1],storage_modulus [Pa]"
    return write(path, head, hertz, loss / storage, storage)


@pytest.mark.parametrize("way", ["tension", "shear, the highest frequency first", "tan delta"])
def test_a_sweep_gives_the_series_that_made_it(way, tmp_path):
    test = read(swept(tmp_path / "dma.csv", way), nu=0.45)
    assert isinstance(test, Spectrum)
    found = fit(test)
    assert found.kind == "prony"
    expected = {"E": 4e5, "E_1": 2e5, "E_2": 1e5, "tau_1": 0.01, "tau_2": 0.5}
    assert found.values == pytest.approx(expected, rel=1e-7)


def test_a_noisy_sweep_agrees_with_an_independent_fit(tmp_path):
    """scipy's NNLS on a grid of 40 times, at all frequencies within 1 %."""
    storage, loss = spectrum(0.003)
    path = write(
        tmp_path / "dma.csv", "frequency [rad/s],storage_modulus [Pa],loss_modulus [Pa]",
        OMEGA, storage, loss,
    )  # fmt: skip
    test = read(path)
    assert isinstance(test, Spectrum)
    found = fit(test).material(**REST).complex_modulus(torch.from_numpy(OMEGA)).detach().numpy()
    z = 1j * OMEGA[:, None] * np.geomspace(1e-3, 10, 40)
    z = np.column_stack((np.ones(25), z / (1 + z)))
    A, b = np.concatenate((z.real, z.imag)), np.concatenate((storage, loss))
    size = np.tile(np.hypot(storage, loss), 2)
    other = z @ nnls(A / size[:, None], b / size)[0]
    assert np.abs(found / other - 1).max() < 0.01


# --- pulls


def pull(path: Path, sign: float = 1.0) -> Path:
    """A strip of 20 mm and 6 mm2, with a toe, up to 60 % and halfway back, E = 0.8 MPa."""
    strain = np.concatenate((np.linspace(0, 0.6, 121), np.linspace(0.595, 0.3, 60)))
    stress = 0.8e6 * (strain - 0.02) - 0.4e6 * strain**2
    head = "elongation [mm],force [N]"
    return write(path, head, sign * 20 * strain, sign * 6e-6 * stress)


def test_the_modulus_of_a_pull_is_that_of_its_range(tmp_path):
    sizes = {"length": 20e-3, "area": 6e-6}
    for test, sign in (("tension", 1.0), ("compression", -1.0), ("compression", 1.0)):
        found = read(pull(tmp_path / "p.csv", sign), test=test, strains=(0.05, 0.15), **sizes)
        assert isinstance(found, Pull)
        result = modulus(found)
        assert result.values["E"] == pytest.approx(0.8e6 - 0.8e6 * 0.1, rel=1e-3)
        assert result.ends == pytest.approx((0.76e6, 0.68e6), rel=1e-6)
        assert any("slope goes from 0.76 to 0.68 MPa" in one for one in result.notices)
        for left_out in ("10 rows from row 2 to row 11: strains below 0.05",
                "90 rows from row 33 to row 122: strains above 0.15",
                "60 rows from row 123 to row 182: after the largest strain"):  # fmt: skip
            assert any(left_out in one for one in result.notices)


def timed(path: Path) -> Path:
    """A triangle of strain, which holds nothing."""
    t = np.linspace(0, 2, 41)
    strain = 0.2 * np.minimum(t, 2 - t)
    return write(path, "t [s],strain [1],stress [Pa]", t, strain, 1e6 * strain)


COUNT = np.arange(21.0)


def straight(path: Path, first: float, last: float, column: str = "strain [1]") -> Path:
    """A stress in proportion to the strain, or to the stretch less one."""
    x = np.linspace(first, last, 21)
    return write(path, f"{column},stress [Pa]", x, 1e5 * (x - ("stretch" in column)))


BAD = {
    "neither held": (timed, {}, "neither strain nor stress was held, they change by 100% and 100%"),
    "no range": (timed, {"test": "tension"}, "which must be given; strains go from 0 to 0.2"),
    "an empty range": (timed, {"test": "tension", "strains": (0.5, 1.0)},
        "has 0 rows with strains from 0.5 to 1, but needs at least 8; strains go from 0 to 0.2"),
    "a range over time": (timed, {"test": "relaxation", "strains": (0.0, 1.0)},
        "a range of strains is of a tension or a compression test"),
    "no times": (lambda path: pull(path), {"length": 0.02, "area": 6e-6},
        "for a modulus say test = tension or compression"),
    "pressed": (lambda path: pull(path, -1.0),
        {"length": 0.02, "area": 6e-6, "test": "tension", "strains": (0.0, 1.0)},
        "row 122: the strain is negative, -0.6: a compression test?"),
    "pressed in two directions": (lambda path: straight(path, -0.6, 0.0),
        {"test": "biaxial", "whole": True},
        "row 2: the strain is negative, -0.6: a compression test?"),
    "pulled, not pressed": (lambda path: straight(path, 1.0, 1.6, "stretch [1]"),
        {"test": "compression", "whole": True}, "up to 1.6, but"),
    "pressed to nothing": (lambda path: straight(path, 0.0, -2.0),
        {"test": "compression", "whole": True}, "row 12: the strain is -1, but"),
    "pressed to nothing, positive": (lambda path: straight(path, 0.0, 2.0),
        {"test": "compression", "strains": (0.0, 0.5)}, "row 12: the strain is -1, but"),
    "pressed beyond nothing, over time": (lambda path: write(path,
        "t [s],strain [%],stress [Pa]", COUNT, 0 * COUNT - 110, 0 * COUNT - 1e5),
        {}, "row 2: the strain is -1.1, but"),
    "torn": (lambda path: write(path, "strain [%],stress [kPa]", 10 * COUNT,
        np.r_[COUNT[:15], 9.0, 7.0, 5.0, 3.0, 1.0, 0.0]),
        {"test": "tension", "strains": (0.1, 2.0)},
        "row 17: the stress falls from 1.4e+04 Pa at a strain of 1.4 (a stretch of 2.4) on, as "
        "where a specimen tears or slips: leave out rows 17 to 22 by a range of strains, --range "
        "0.1 1.4"),
    "a negative modulus": (lambda path: write(path, "t [s],modulus [kPa]", COUNT, 7.5 - COUNT),
        {}, "row 10, column `modulus`: -500 Pa is not above zero"),
    "a negative compliance": (lambda path: write(path, "t [s],compliance [1/kPa]", COUNT, -COUNT),
        {}, "row 3, column `compliance`: -0.001 1/Pa is not above zero"),
    "no modulus": (lambda path: write(path, "t [s],modulus [Pa]", COUNT, 0 * COUNT), {},
        "the modulus is zero throughout"),
    "a negative loss": (lambda path: write(path,
        "frequency [Hz],storage_modulus [Pa],loss_modulus [MPa]", OMEGA, OMEGA, -OMEGA),
        {}, "row 2, column `loss_modulus`: -1e+05 Pa is not above zero"),
    "a falling storage modulus": (lambda path: write(path,
        "frequency [Hz],storage_modulus [Pa],loss_modulus [Pa]", OMEGA[::-1], OMEGA, OMEGA),
        {}, "row 25: the storage modulus falls from 1000 Pa"),
    "cycles": (lambda path: write(path, "strain [1],stress [Pa]", *[np.tile(
        np.r_[np.linspace(0, 0.1, 9), np.linspace(0.1, 0, 9)], 2) * np.linspace(1, 2, 36)] * 2),
        {"test": "tension", "strains": (0.0, 0.1)}, "keep the rows of one loading"),
    "one modulus": (lambda path: write(path, "frequency [Hz],storage_modulus [Pa]",
        OMEGA, OMEGA), {}, "tan_delta may stand for the second; but there is storage_modulus"),
    "no Poisson's ratio":
        (lambda path: swept(path, "shear, the highest frequency first"), {}, "need Poisson's"),
    "another test": (lambda path: swept(path, "tension"), {"test": "creep"},
        "`frequency` is of a sweep, not of a creep test"),
    "no frequency": (timed, {"test": "sweep"}, "has no column `frequency`"),
    "an unknown name": (timed, {"headings": {"Kraft": "forse"}},
        "the column 'Kraft' stands for `forse`, which is not known"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_a_table_does_not_tell_is_asked_for(name, tmp_path):
    make, how, message = BAD[name]
    with pytest.raises(ValueError, match=re.escape(message)):
        read(make(tmp_path / "test.csv"), **how)


# --- decks

DECK = """** a pad
*Material, name=Rubber
*Density
1.1e-9,
*Elastic, moduli=INSTANTANEOUS
0.7, 0.45
*Viscoelastic, time=PRONY
0.3, 0.3, 0.5
0.2, 0.2, 0.01
*Material, name=Steel
*Elastic
210000., 0.3
*Step
"""


def test_a_deck_gives_its_series(tmp_path):
    path = tmp_path / "pad.inp"
    path.write_text(DECK, encoding="utf-8")
    found = read_deck(path, unit=1e6)
    expected = {
        "E": 3.5e5, "E_1": 1.4e5, "E_2": 2.1e5, "tau_1": 0.01, "tau_2": 0.5, "nu": 0.45
    }  # fmt: skip
    assert found.values == pytest.approx(expected)
    solid = found.material(rho=1100.0, depth=0.04)
    t = torch.tensor([0.0, 0.1, 30.0]).double()
    relaxed = 0.7e6 * (1 - 0.2 * (1 - torch.exp(-t / 0.01)) - 0.3 * (1 - torch.exp(-t / 0.5)))
    assert torch.allclose(solid.relaxation(t), relaxed, rtol=1e-12)
    assert np.allclose(found.relaxation(t.numpy()), relaxed, rtol=1e-12)
    assert len(found.notices) == 1
    path.write_text(DECK.replace(", moduli=INSTANTANEOUS", ""), encoding="utf-8")
    found = read_deck(path, unit=1e6)
    assert found.values["E"] == pytest.approx(0.7e6)
    assert found.values["E_1"] == pytest.approx(0.2 * 1.4e6)
    assert "of the long term, since MODULI is not said" in found.notices[0]


def test_a_hyperelastic_deck_whose_bulk_does_not_relax(tmp_path):
    """2 (C10 + C01) = 0.3 MPa and incompressible: E = 0.9 MPa; E = 9 K G / (3 K + G) is said."""
    path = tmp_path / "pad.inp"
    text = DECK.replace(
        "*Elastic, moduli=INSTANTANEOUS\n0.7, 0.45",
        "*Hyperelastic, mooney-rivlin, moduli=INSTANTANEOUS\n0.1, 0.05, 0.0",
    )
    path.write_text(text.replace("0.3, 0.3, 0.5", "0.3, , 0.5"), encoding="utf-8")
    found = read_deck(path, unit=1e6)
    assert found.values["E"] == pytest.approx(0.5 * 0.9e6, rel=1e-3)
    assert found.values["nu"] == 0.4995
    assert any("k_i are not g_i" in one and "-0.0% beside" in one for one in found.notices)
    soft = DECK.replace("0.3, 0.3, 0.5", "0.3, 0., 0.5").replace("0.2, 0.2,", "0.2, 0.,")
    path.write_text(soft, encoding="utf-8")
    nu, g = 0.45, 0.5
    G, K = 0.7 / (2 * (1 + nu)), 0.7 / (3 * (1 - 2 * nu))
    off = g / (9 * K * g * G / (3 * K + g * G) / 0.7) - 1
    assert any(f"{off:+.1%}" in one for one in read_deck(path, unit=1e6).notices)


BAD_DECKS = {
    "no series": (DECK.replace("*Viscoelastic", "*Depvar"), "0 materials with *VISCOELASTIC"),
    "test data": (DECK.replace("time=PRONY", "time=FREQUENCY DATA"), "must say TIME=PRONY"),
    "more than all": (DECK.replace("0.3, 0.3", "0.9, 0.3"), "below one in sum, which is 1.1"),
    "no elasticity": (DECK.replace("*Elastic, moduli=INSTANTANEOUS\n0.7, 0.45\n", ""),
        "there is no *ELASTIC and no *HYPERELASTIC"),
    "words": (DECK.replace("0.7, 0.45", "soft, 0.45"), "`SOFT, 0.45` should be 2 numbers"),
    "Ogden": (DECK.replace("*Elastic, moduli=INSTANTANEOUS", "*Hyperelastic, ogden"),
        "must be NEO HOOKE or MOONEY-RIVLIN"),
    "Marlow": (DECK.replace("moduli=INSTANTANEOUS", "type=ORTHOTROPIC"), "must be isotropic"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_DECKS)
def test_a_deck_that_tells_no_series_is_refused(name, tmp_path):
    path, (text, message) = tmp_path / "pad.inp", BAD_DECKS[name]
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(message)):
        read_deck(path, unit=1e6)


# --- the command


def deck(path: Path) -> Path:
    path = path.with_suffix(".inp")
    path.write_text(DECK, encoding="utf-8")
    return path


COMMANDS = {
    "sweep": (lambda path: swept(path, "tension"), [], "prony of 2 terms"),
    "pull": (pull, ["--test", "tension", "--range", "0", "0.1", "--length", "0.02", "--area",
        "6e-6", "--tau", "0.01"], "strains from 0 to 0.1"),
    "deck": (deck, ["--unit", "MPa", "--name", "rubber"], "material RUBBER, prony of 2 terms"),
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_reads_every_kind(name, tmp_path, capsys):
    make, options, words = COMMANDS[name]
    out = tmp_path / "out"
    assert (
        main(["material", "fit", str(make(tmp_path / "t.csv")), *options, "--out", str(out)]) == 0
    )
    assert words in capsys.readouterr().out
    table = tomllib.loads((out / "material.toml").read_text(encoding="utf-8"))["materials"]["t"]
    KINDS[table.pop("kind")](**table)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["coefficients"]["E"]["value"] == pytest.approx(table["E"])
    assert (out / "fit.png").stat().st_size > 10_000


def test_headings_of_another_language(tmp_path, capsys):
    t = np.geomspace(1e-2, 10, 30)
    stress = 0.05 * RUBBER.relaxation(torch.from_numpy(t)).detach().numpy()
    path = write(tmp_path / "t.csv", "Zeit,Dehnung,Spannung,Kanal 4\ns,%,kPa,-", t,
        np.full(30, 5.0), 1e-3 * stress, t)  # fmt: skip
    names = ["t=Zeit", "strain=Dehnung", "stress=Spannung"]
    options = [x for name in names for x in ("--column", name)]
    out = tmp_path / "out"
    command = ["material", "fit", str(path), *options, "--out", str(out)]
    assert main(command) == 2
    assert "column `Kanal 4` is not known" in capsys.readouterr().err
    assert main([*command, "--ignore", "Kanal 4"]) == 0
    test = read(path, headings={"Zeit": "t", "Dehnung": "strain", "Spannung": "stress"},
        ignore=["Kanal 4"])  # fmt: skip
    assert isinstance(test, Measured)
    assert test.largest_strain == pytest.approx(0.05)


REFUSALS = {
    "no unit": (deck, [], "a deck has no units: say that of its stresses, --unit MPa"),
    "a deck's length": (deck, ["--unit", "MPa", "--length", "1"], "a deck needs no --length"),
    "a deck's nu": (deck, ["--unit", "MPa", "--nu", "0.4"], "it tells nu itself: leave --nu out"),
    "a test's unit": (timed, ["--unit", "MPa"], "--unit is of decks, FILE.inp"),
    "a column": (timed, ["--column", "strain"], "--column must be NAME=HEADING"),
    "terms": (timed, ["--terms", "2", "--test", "tension", "--range", "0", "1"], "no --terms"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_options_that_do_not_belong_are_refused(name, tmp_path, capsys):
    make, options, words = REFUSALS[name]
    command = ["material", "fit", str(make(tmp_path / "t.csv")), *options]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
