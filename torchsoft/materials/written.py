"""A fitted material as files: a table in TOML, a summary of how it was made, a figure."""

import json
import re
from collections.abc import Mapping
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from torchsoft.files import finite, save_text, write_json
from torchsoft.materials.deck import Deck
from torchsoft.materials.energies import EnergyFit, stretches
from torchsoft.materials.fit import Fit
from torchsoft.materials.measured import Spectrum
from torchsoft.materials.modulus import Modulus
from torchsoft.physics.hyperelastic import KINDS
from torchsoft.physics.validity import check_numbers, sound
from torchsoft.plot.figures import ACTUAL, OTHER, STYLE, new_figure, save
from torchsoft.plot.scene import INK
from torchsoft.tables import toml_row

MPA = 1e-6

UNITS = {
    "E": "Pa",
    "moduli": "Pa",
    "J": "1",
    "C10": "Pa",
    "C01": "Pa",
    "C20": "Pa",
    "C30": "Pa",
    "mu": "Pa",
    "alpha": "1",
    "tau": "s",
    "times": "s",
    "tau_instant": "s",
    "nu": "1",
    "rho": "kg/m3",
    "depth": "m",
}

FILES = ("material.toml", "summary.json", "fit.png")
"""Files that are written."""


Found = Fit | Modulus | EnergyFit | Deck
"""A material that a file tells."""


def write(
    found: Found, folder: Path, assumed: Mapping[str, float], options: Mapping[str, object]
) -> None:
    """Write `FILES`. `assumed` are coefficients that the file does not tell; `options` are those of
    the command. Each file appears whole or not at all. Raises `ValueError` for coefficients that no
    material has."""
    try:
        material = KINDS[found.kind](**found.table(), **assumed)
        check_numbers(material)
        sound(material)
    except ValueError as error:
        raise ValueError(
            f"{source(found)[0]}: the {found.kind} material of this fit is not physical: {error}; "
            "look at the units and the signs of the columns"
        ) from None
    save_text(folder / "material.toml", toml(found, assumed))
    write_json(folder / "summary.json", summary(found, assumed, options))
    save(drawn(found), folder / "fit.png")


def source(found: Found) -> tuple[Path, str]:
    """File, and kind of test."""
    if isinstance(found, Deck):
        return found.path, "deck"
    if isinstance(found, EnergyFit):
        tests = dict.fromkeys(pull.test for pull in found.pulls)
        return found.measured.path, f"{' and '.join(tests)} test"
    return found.measured.path, f"{found.measured.test} test"


def toml(found: Found, assumed: Mapping[str, float]) -> str:
    """The material as a table with the names of the constructor's arguments, with its origin and
    its limits in comments."""
    path, test = source(found)
    key = path.stem if re.fullmatch(r"[A-Za-z0-9_-]+", path.stem) else json.dumps(path.stem)
    rows = [f"[materials.{key}]", f'kind = "{found.kind}"']
    table = found.table()
    for argument, value in table.items():
        note = ", small: the instantaneous spring's" if argument == "tau_instant" else ""
        note = ", small beside the times" if argument == "tau" and "times" in table else note
        rows.append(toml_row(argument, value, f"[{UNITS[argument]}]{note}"))
    rows += [
        toml_row(name, value, f"[{UNITS[name]}] not of this {test}: assumed")
        for name, value in assumed.items()
    ]
    head = [f"From {path.name} ({test}) by torchsoft {version('torchsoft')}.", *found.notices]
    return "\n".join([*(f"# {' '.join(text.split())}" for text in head), "", *rows]) + "\n"


def summary(
    found: Found, assumed: Mapping[str, float], options: Mapping[str, object]
) -> dict[str, object]:
    """Coefficients, their origin and the method, in SI units."""
    path, test = source(found)
    sd = {} if isinstance(found, Deck) else found.sd
    return {
        "made_by": {"torchsoft": version("torchsoft"), "command": "torchsoft material fit",
        "options": dict(options)},
        "data": {"file": path.name, "sha256": sha256(path.read_bytes()).hexdigest(), "test": test},
        "kind": found.kind,
        "coefficients": {
            name: finite({"value": x, **({"sd": sd[name]} if name in sd else {})})
            for name, x in found.values.items()
        },
        "assumed": dict(assumed),
        "notices": list(found.notices),
        **method(found),
    }  # fmt: skip


def method(found: Found) -> dict[str, object]:
    """How the coefficients were found, and how well they fit."""
    if isinstance(found, Deck):
        return {"method": "as the deck has them", "material": found.name}
    if isinstance(found, Modulus):
        return {
            "method": "slope of a straight line by least squares", "rows": len(found.fitted),
            "strains": list(found.measured.strains), "slopes_at_ends": list(found.ends),
            "residual_rms": found.rms, "residual_of": "of the largest",
        }  # fmt: skip
    if isinstance(found, EnergyFit):
        series, over_time = found.relaxation, dict[str, object]()
        if series is not None:
            path = series.measured.path
            file = {"file": path.name, "sha256": sha256(path.read_bytes()).hexdigest()}
            over_time["relaxation"] = file | method(series)
        return over_time | {
            "method": "least squares of the nominal stress of an incompressible specimen",
            "tables": [
                {"file": p.path.name, "test": p.test, "rows": len(p.strain),
                 "strains": list(p.strains)} for p in found.pulls
            ],
            "residual_rms": found.rms, "residual_of": "of the largest",
        }  # fmt: skip
    m = found.measured
    return {
        "method": "nonnegative least squares on a logarithmic grid of times, then least squares in "
        "strengths and times together; the number of terms by Schwarz's criterion (BIC)",
        "rows": len(m.t),
        "resolved_s": list(m.window),
        "largest_strain": m.largest_strain,
        "criterion": {str(count): score for count, score in found.scores.items()},
        "residual_rms": found.rms,
        "residual_of": found.residual_of,
        "residual_correlation": found.correlation,
    }


def printed(found: Found) -> str:
    """The coefficients with 95 % intervals, and the notices."""
    units = {"E": "Pa", "t": "s", "J": "1", "n": "1", "C": "Pa", "m": "Pa", "a": "1"}
    path, test = source(found)
    if isinstance(found, Deck):
        head, sd = f"material {found.name}, {found.kind} of {found.terms} terms", {}
    elif isinstance(found, Modulus):
        low, high = found.measured.strains
        head = f"strains from {low:g} to {high:g}, residual {found.rms:.2%} of the largest"
        sd = found.sd
    elif isinstance(found, EnergyFit):
        head, sd = f"{found.kind}, residual {found.rms:.2%} of the largest", found.sd
    else:
        head = f"{found.kind} of {found.terms} terms, residual {found.rms:.2%} {found.residual_of}"
        sd = found.sd
    rows = [
        f"{name:<8}{value:<12.5g}{units[name[0]]:<3}"
        + (f"+- {196 * sd[name] / abs(value):.2g} %" if name in sd else "")
        for name, value in found.values.items()
    ]
    notes = (f"note: {notice}" for notice in found.notices)
    return "\n".join([f"{path.name}: {test}, {head}", *(row.rstrip() for row in rows), *notes])


def drawn(found: Found) -> Figure:
    """The figure of a material."""
    if isinstance(found, Deck):
        return series(found)
    if isinstance(found, EnergyFit):
        return energy(found)
    return line_of(found) if isinstance(found, Modulus) else fitted(found)


@rc_context(STYLE)
def energy(found: EnergyFit) -> Figure:
    """Nominal stress over stretch of every table with the energy's, and their differences."""
    figure = new_figure(f"{found.measured.path.name}: {found.kind}", 9, 5.4)
    data, left = figure.subplots(2, 1, height_ratios=(3, 1.4), sharex=True)
    for number, (pull, curve) in enumerate(zip(found.pulls, found.fitted)):
        x, own = stretches(pull), f"C{number}"
        x = 1 + x if pull.test == "shear" else x
        label = f"{pull.test}, {len(x)} rows"
        data.plot(x, MPA * pull.stress, ".", color=own, ms=4, label=label)
        data.plot(x, MPA * curve, color=own)
        left.plot(x, MPA * (pull.stress - curve), ".", color=own, ms=4)
    data.set(
        ylabel="nominal stress [MPa]",
        title=f"a) stress; the lines are of W, residual {found.rms:.2%} of the largest",
    )
    data.legend()
    left.axhline(0.0, color=OTHER)
    sheared = any(pull.test == "shear" for pull in found.pulls)
    left.set(
        ylabel="residual [MPa]", title="b) measured less fitted",
        xlabel="stretch [1]" + (", or 1 + the amount of shear" if sheared else ""),
    )  # fmt: skip
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def series(deck: Deck) -> Figure:
    """The relaxation modulus of a deck over time."""
    tau = deck.listed("tau")
    t = np.geomspace(min(tau) / 100, 100 * max(tau), 400)
    figure = new_figure(f"{deck.path.name}: material {deck.name}, {deck.terms} terms", 9, 4)
    axes = figure.subplots()
    axes.plot(t, MPA * deck.relaxation(t), color=OTHER)
    axes.plot(tau, MPA * deck.relaxation(np.array(tau)), "o", color=ACTUAL, label="times of terms")
    axes.axhline(MPA * deck.values["E"], color=INK, lw=0.8, ls="--", label="relaxed")
    axes.set(xscale="log", xlabel="time [s]", ylabel="relaxation modulus [MPa]", ylim=(0, None))
    axes.legend()
    return figure


@rc_context(STYLE)
def line_of(found: Modulus) -> Figure:
    """Stress over strain with its line, and their difference."""
    m, E = found.measured, found.values["E"]
    figure = new_figure(f"{m.path.name}: {m.test} test, E = {MPA * E:.4g} MPa", 9, 5.4)
    data, left = figure.subplots(2, 1, height_ratios=(3, 1.4), sharex=True)
    data.plot(
        m.strain, MPA * m.stress, ".", color=INK, ms=4, label=f"measured, {len(m.strain)} rows"
    )
    data.plot(m.strain, MPA * found.fitted, color=OTHER, label=f"line, residual {found.rms:.2%}")
    data.set(ylabel="nominal stress [MPa]", title="a) stress")
    data.legend()
    left.axhline(0.0, color=OTHER)
    left.plot(m.strain, MPA * (m.stress - found.fitted), ".", color=INK, ms=4)
    left.set(xlabel="strain [1]", ylabel="residual [MPa]", title="b) measured less line")
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def fitted(fit: Fit) -> Figure:
    """Measured and fitted answer over time, their difference, and strengths over times with 95 %
    intervals; times that the rows do not resolve are grey. The time axis is logarithmic: a row at t
    = 0 is left out."""
    m, relaxes = fit.measured, fit.kind == "prony"
    swept = isinstance(m, Spectrum)
    quantity, per, scale = ("stress", "MPa", MPA) if relaxes else ("strain", "1", 1.0)
    if m.per_load:
        quantity, per, scale = (
            ("modulus", "MPa", MPA) if relaxes else ("compliance", "1/MPa", 1 / MPA)
        )
    name = "relaxation series" if relaxes else "generalised Kelvin chain"
    figure = new_figure(f"{m.path.name}: {m.test} test, {name} of {fit.terms} terms", 9, 7.2)
    data, left, spectrum = figure.subplots(3, 1, height_ratios=(3, 1.4, 2), sharex=True)
    parts = ("storage", "loss") if swept else ("measured",)
    rows = zip(
        parts, ".x", *(np.split(x, len(parts)) for x in (m.answer, fit.fitted, fit.residual))
    )
    for part, mark, answer, curve, residual in rows:
        seen = m.t > 0
        label = f"{part}, {len(m.t)} rows"
        data.plot(m.t[seen], scale * answer[seen], mark, color=INK, ms=4, label=label)
        label = f"fitted, residual {fit.rms:.2%} {fit.residual_of}" if part == parts[0] else None
        data.plot(m.t[seen], scale * curve[seen], color=OTHER, label=label)
        left.plot(m.t[seen], scale * residual[seen], mark, color=INK, ms=4)
    data.set(ylabel=f"{quantity} [{per}]", title=f"a) {quantity}")
    if m.relative:
        data.set(yscale="log")
    data.legend()
    left.axhline(0.0, color=OTHER)
    left.set(
        ylabel=f"residual [{per}]",
        title=f"b) measured less fitted, neighbours correlate by {fit.correlation:.2f}",
    )
    symbol, size, unit = ("E", MPA, " [MPa]") if relaxes else ("J", 1.0, " [1]")
    for k in range(1, fit.terms + 1):
        x, y = fit.values[f"tau_{k}"], fit.values[f"{symbol}_{k}"]
        spread = [[v - v / np.exp(1.96 * sd / v), v * np.exp(1.96 * sd / v) - v] for v, sd in (
            (x, fit.sd[f"tau_{k}"]), (y, fit.sd[f"{symbol}_{k}"])
        )]  # fmt: skip
        across, along = ([[low], [high]] for low, high in spread)
        spectrum.errorbar(
            x, size * y, size * np.array(along), across, fmt="o", color=ACTUAL, capsize=3
        )
    E = fit.values["E"]
    kept = f"E = {MPA * E:.4g} MPa ± {1.96 * fit.sd['E'] / E:.1%}"
    spectrum.margins(y=0.2)
    spectrum.set(
        xscale="log",
        yscale="log",
        xlabel="1 / circular frequency [s]" if swept else "time [s]",
        ylabel=f"${symbol}_i${unit}",
        title=f"c) terms; {kept}, relaxed",
    )
    low, high = m.window
    ends = spectrum.get_xlim()
    for axes in (data, left, spectrum):
        axes.axvspan(min(ends[0], low / 3), low, color="#f0f0f0", lw=0, zorder=0)
        axes.axvspan(high, max(ends[1], 3 * high), color="#f0f0f0", lw=0, zorder=0)
    spectrum.set_xlim(low / 3, 3 * high)
    figure.align_ylabels()
    return figure
