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
from torchsoft.materials.fit import Fit
from torchsoft.plot.figures import ACTUAL, OTHER, STYLE, new_figure, save
from torchsoft.plot.scene import INK
from torchsoft.tables import toml_row

MPA = 1e-6

UNITS = {
    "E": "Pa",
    "moduli": "Pa",
    "J": "1",
    "tau": "s",
    "tau_instant": "s",
    "nu": "1",
    "rho": "kg/m3",
    "depth": "m",
}

FILES = ("material.toml", "summary.json", "fit.png")
"""Files that are written."""


def write(
    fit: Fit, folder: Path, assumed: Mapping[str, float], options: Mapping[str, object]
) -> None:
    """Write `FILES`. `assumed` are nu, rho and depth, which a test in one dimension does not tell;
    `options` are those of the command. Each file appears whole or not at all."""
    save_text(folder / "material.toml", toml(fit, assumed))
    write_json(folder / "summary.json", summary(fit, assumed, options))
    save(fitted(fit), folder / "fit.png")


def toml(fit: Fit, assumed: Mapping[str, float]) -> str:
    """The material as a table with the names of the constructor's arguments, with its origin and
    its limits in comments."""
    name = fit.measured.path.stem
    key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)
    rows = [f"[materials.{key}]", f'kind = "{fit.kind}"']
    for argument, value in fit.table().items():
        note = ", small: the instantaneous spring's" if argument == "tau_instant" else ""
        rows.append(toml_row(argument, value, f"[{UNITS[argument]}]{note}"))
    rows += [
        toml_row(name, value, f"[{UNITS[name]}] not of this test: assumed")
        for name, value in assumed.items()
    ]
    head = [
        f"Fitted to {fit.measured.path.name} ({fit.measured.test} test) by torchsoft "
        f"{version('torchsoft')}.",
        *fit.notices,
    ]
    return "\n".join([*(f"# {' '.join(text.split())}" for text in head), "", *rows]) + "\n"


def summary(
    fit: Fit, assumed: Mapping[str, float], options: Mapping[str, object]
) -> dict[str, object]:
    """Coefficients, their origin and the method, in SI units."""
    m = fit.measured
    return {
        "made_by": {
            "torchsoft": version("torchsoft"),
            "command": "torchsoft material fit",
            "options": dict(options),
        },
        "data": {
            "file": m.path.name,
            "sha256": sha256(m.path.read_bytes()).hexdigest(),
            "rows": len(m.t),
            "test": m.test,
            "resolved_s": list(m.window),
            "largest_strain": None if m.per_load else float(abs(m.strain).max()),
        },
        "method": "nonnegative least squares on a logarithmic grid of times, then least squares in "
        "strengths and times together; the number of terms by Schwarz's criterion (BIC)",
        "kind": fit.kind,
        "coefficients": {
            name: finite({"value": x, "sd": fit.sd[name]}) for name, x in fit.values.items()
        },
        "assumed": dict(assumed),
        "criterion": {str(count): score for count, score in fit.scores.items()},
        "residual_rms": fit.rms,
        "residual_of": fit.residual_of,
        "residual_correlation": fit.correlation,
        "notices": list(fit.notices),
    }


def printed(fit: Fit) -> str:
    """The coefficients with 95 % intervals, and the notices."""
    units = {"E": "Pa", "t": "s", "J": "1"}
    rows = [
        f"{name:<7}{value:<12.5g}{units[name[0]]:<3}+- {196 * fit.sd[name] / value:.2g} %"
        for name, value in fit.values.items()
    ]
    head = (
        f"{fit.measured.path.name}: {fit.measured.test} test, {fit.kind} of {fit.terms} terms, "
        f"residual {fit.rms:.2%} {fit.residual_of}"
    )
    return "\n".join([head, *rows, *(f"note: {notice}" for notice in fit.notices)])


@rc_context(STYLE)
def fitted(fit: Fit) -> Figure:
    """Measured and fitted answer over time, their difference, and strengths over times with 95 %
    intervals; times that the rows do not resolve are grey. The time axis is logarithmic: a row at t
    = 0 is left out."""
    m, relaxes = fit.measured, fit.kind == "prony"
    seen = m.t > 0
    quantity, per, scale = ("stress", "MPa", MPA) if relaxes else ("strain", "1", 1.0)
    if m.per_load:
        quantity, per, scale = (
            ("modulus", "MPa", MPA) if relaxes else ("compliance", "1/MPa", 1 / MPA)
        )
    series = "relaxation series" if relaxes else "generalised Kelvin chain"
    figure = new_figure(f"{m.path.name}: {m.test}, {series} of {fit.terms} terms", 9, 7.2)
    data, left, spectrum = figure.subplots(3, 1, height_ratios=(3, 1.4, 2), sharex=True)
    data.plot(
        m.t[seen], scale * m.answer[seen], ".", color=INK, ms=4, label=f"measured, {len(m.t)} rows"
    )
    data.plot(
        m.t[seen],
        scale * fit.fitted[seen],
        color=OTHER,
        label=f"fitted, residual {fit.rms:.2%} {fit.residual_of}",
    )
    data.set(ylabel=f"{quantity} [{per}]", title=f"a) {quantity}")
    data.legend()
    left.axhline(0.0, color=OTHER)
    left.plot(m.t[seen], scale * fit.residual[seen], ".", color=INK, ms=4)
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
        xlabel="time [s]",
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
