"""A fitted material as files: a table in TOML, a summary of how it was made, a figure."""

import json
import re
from collections.abc import Mapping
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchsoft.files import finite, save_text, write_json
from torchsoft.materials.energies import PullFit, stretches
from torchsoft.materials.fit import Fit
from torchsoft.materials.measured import Spectrum
from torchsoft.physics.validity import check_numbers, sound
from torchsoft.plot.figures import ACTUAL, OTHER, STYLE, new_figure, save
from torchsoft.plot.scene import INK
from torchsoft.tables import toml_row

MPA = 1e-6

UNITS = {
    **dict.fromkeys(("E", "moduli", "C10", "C01", "C20", "C30", "mu"), "Pa"),
    **dict.fromkeys(("J", "alpha", "nu"), "1"),
    **dict.fromkeys(("tau", "times", "tau_instant"), "s"),
    "rho": "kg/m3",
    "depth": "m",
}
"""Unit of every argument of a material's constructor; a coefficient `mu_2` is an entry of `mu`."""

FILES = ("material.toml", "summary.json", "fit.png")
"""Files that are written."""

Found = Fit | PullFit
"""A material fitted to a test."""


def write(
    found: Found, folder: Path, assumed: Mapping[str, float], options: Mapping[str, object]
) -> None:
    """Write `FILES`. `assumed` are coefficients that the test does not determine; `options` are
    those of the command. Each file appears whole or not at all. Raises `ValueError` for
    coefficients that no material has."""
    try:
        material = found.material(**assumed)
        check_numbers(material)
        sound(material)
    except ValueError as error:
        raise ValueError(
            f"{found.measured.path}: the {found.kind} material of this fit is not physical: "
            f"{error}; look at the units and the signs of the columns"
        ) from None
    save_text(folder / "material.toml", toml(found, assumed, options))
    write_json(folder / "summary.json", summary(found, assumed, options))
    save(drawn(found), folder / "fit.png")


def toml(found: Found, assumed: Mapping[str, float], options: Mapping[str, object]) -> str:
    """The material as a table with the names of the constructor's arguments, with its origin and
    its limits in comments."""
    path, table = found.measured.path, found.table()
    key = path.stem if re.fullmatch(r"[A-Za-z0-9_-]+", path.stem) else json.dumps(path.stem)
    notes = {"tau_instant": ", small: the instantaneous spring's"}
    if "times" in table:
        notes["tau"] = ", small beside the times"
    origins = {k: "assumed" if options.get(k) is None else "stated" for k in assumed}
    comments = [
        f"From {path.name} ({found.test} test) by torchsoft {version('torchsoft')}.",
        *found.notices,
    ]
    rows = [
        *(f"# {' '.join(text.split())}" for text in comments),
        "",
        f"[materials.{key}]",
        f'kind = "{found.kind}"',
        *(toml_row(k, x, f"[{UNITS[k]}]{notes.get(k, '')}") for k, x in table.items()),
        *(
            toml_row(k, x, f"[{UNITS[k]}] not of this {found.test} test: {origins[k]}")
            for k, x in assumed.items()
        ),
    ]
    return "\n".join(rows) + "\n"


def summary(
    found: Found, assumed: Mapping[str, float], options: Mapping[str, object]
) -> dict[str, object]:
    """Coefficients, their origin and the method, in SI units."""
    path = found.measured.path
    return {
        "made_by": {
            "torchsoft": version("torchsoft"),
            "command": "torchsoft material fit",
            "options": dict(options),
        },
        "data": {
            "file": path.name,
            "sha256": sha256(path.read_bytes()).hexdigest(),
            "test": f"{found.test} test",
        },
        "kind": found.kind,
        "coefficients": {
            name: finite({"value": value, "sd": found.sd[name]})
            for name, value in found.values.items()
        },
        "assumed": dict(assumed),
        "notices": list(found.notices),
        **found.method(),
    }


def printed(found: Found) -> str:
    """The coefficients with 95 % intervals, and the notices."""
    rows = [f"{found.measured.path.name}: {found.test} test, {found.described}"]
    for name, value in found.values.items():
        argument = re.sub(r"_\d+$", "", name)
        interval = f"+- {196 * found.sd[name] / abs(value):.2g} %"
        rows.append(f"{name:<8}{value:<12.5g}{UNITS[argument]:<3}{interval}")
    return "\n".join([*rows, *(f"note: {notice}" for notice in found.notices)])


@rc_context(STYLE)
def drawn(found: Found) -> Figure:
    """The figure of a material."""
    figure = new_figure(f"{found.measured.path.name}: {found.test} test, {found.described}", 9, 5.4)
    if isinstance(found, Fit):
        figure.set_figheight(7.2)
        draw_series(figure, found)
    else:
        data, residual = figure.subplots(2, 1, height_ratios=(3, 1.4), sharex=True)
        draw_stress(data, residual, found)
    figure.align_ylabels()
    return figure


def draw_stress(data: Axes, left: Axes, found: PullFit) -> None:
    """Nominal stress of every table and of the fit, and their differences: over the stretch, or
    over 1 + the amount of shear."""
    for number, (pull, curve) in enumerate(zip(found.pulls, found.fitted)):
        x, colour = stretches(pull) + (pull.test == "shear"), f"C{number}"
        label = f"{pull.test}, {len(x)} rows"
        data.plot(x, MPA * pull.stress, ".", color=colour, ms=4, label=label)
        data.plot(x, MPA * curve, color=colour)
        left.plot(x, MPA * (pull.stress - curve), ".", color=colour, ms=4)
    data.set(ylabel="nominal stress [MPa]", title="a) stress; the lines are fitted")
    data.legend()
    left.axhline(0.0, color=OTHER)
    left.set(
        xlabel="stretch [1], or 1 + the amount of shear",
        ylabel="residual [MPa]",
        title="b) measured less fitted",
    )


RESPONSES = {
    ("prony", False): ("stress", "MPa", MPA),
    ("prony", True): ("modulus", "MPa", MPA),
    ("generalised_kelvin", False): ("strain", "1", 1.0),
    ("generalised_kelvin", True): ("compliance", "1/MPa", 1 / MPA),
}
"""Response, its unit in figures and the factor to that, by kind and whether it is per load."""


def draw_series(figure: Figure, fit: Fit) -> None:
    """Measured and fitted response over time, their difference, and strengths over times with 95 %
    intervals; times that the rows do not resolve are grey. The time axis is logarithmic: a row at t
    = 0 is left out."""
    m, swept = fit.measured, isinstance(fit.measured, Spectrum)
    quantity, unit, scale = RESPONSES[fit.kind, m.per_load]
    data, left, spectrum = figure.subplots(3, 1, height_ratios=(3, 1.4, 2), sharex=True)
    parts = {"storage": ".", "loss": "x"} if swept else {"measured": "."}
    seen = m.t > 0
    responses = (np.split(scale * x, len(parts)) for x in (m.answer, fit.fitted, fit.residual))
    for (part, mark), measured, fitted, residual in zip(parts.items(), *responses):
        label = f"{part}, {len(m.t)} rows"
        data.plot(m.t[seen], measured[seen], mark, color=INK, ms=4, label=label)
        data.plot(m.t[seen], fitted[seen], color=OTHER)
        left.plot(m.t[seen], residual[seen], mark, color=INK, ms=4)
    data.set(ylabel=f"{quantity} [{unit}]", title=f"a) {quantity}; the lines are fitted")
    data.set_yscale("log" if m.relative else "linear")
    data.legend()
    left.axhline(0.0, color=OTHER)
    correlated = f"neighbours correlate by {fit.correlation:.2f}"
    left.set(ylabel=f"residual [{unit}]", title=f"b) measured less fitted, {correlated}")
    symbol, size, unit = ("E", MPA, "MPa") if fit.kind == "prony" else ("J", 1.0, "1")
    numbers = range(1, fit.terms + 1)
    (y, yerr), (x, xerr) = (
        np.array([(fit.values[name], 1.96 * fit.sd[name]) for name in names]).T
        for names in ([f"{symbol}_{k}" for k in numbers], [f"tau_{k}" for k in numbers])
    )
    spectrum.errorbar(x, size * y, size * yerr, xerr, fmt="o", color=ACTUAL, capsize=3)
    spectrum.margins(y=0.2)
    E, sd = fit.values["E"], fit.sd["E"]
    low, high = m.window
    spectrum.set(
        xscale="log",
        yscale="log",
        xlabel="1 / circular frequency [s]" if swept else "time [s]",
        ylabel=f"${symbol}_i$ [{unit}]",
        title=f"c) terms; E = {MPA * E:.4g} MPa ± {1.96 * sd / E:.1%}, relaxed",
        xlim=(low / 3, 3 * high),
    )
    for axes in (data, left, spectrum):
        axes.axvspan(low / 3, low, color="#f0f0f0", lw=0, zorder=0)
        axes.axvspan(high, 3 * high, color="#f0f0f0", lw=0, zorder=0)
