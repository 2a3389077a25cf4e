"""A fitted material as a figure: data and fit, what is left over, and the series."""

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from torchsoft.materials.fit import Fit
from torchsoft.plot.figures import ACTUAL, OTHER, STYLE, new_figure
from torchsoft.plot.scene import INK

MPA = 1e-6


@rc_context(STYLE)
def fitted(fit: Fit) -> Figure:
    """Measured and fitted answer over time, their difference, and strengths over times with 95 % intervals; grey is what the
    rows do not resolve. The time axis is logarithmic: a row at t = 0 is left out."""
    m, relaxes = fit.measured, fit.kind == "prony"
    seen = m.t > 0
    what, per, scale = ("stress", "MPa", MPA) if relaxes else ("strain", "1", 1.0)
    if m.per_load:
        what, per, scale = ("modulus", "MPa", MPA) if relaxes else ("compliance", "1/MPa", 1 / MPA)
    series = "relaxation series" if relaxes else "generalised Kelvin chain"
    figure = new_figure(f"{m.path.name}: {m.test}, {series} of {fit.terms} terms", 9, 7.2)
    data, left, spectrum = figure.subplots(3, 1, height_ratios=(3, 1.4, 2), sharex=True)
    data.plot(m.t[seen], scale * m.answer[seen], ".", color=INK, ms=4, label=f"measured, {len(m.t)} rows")
    data.plot(m.t[seen], scale * fit.fitted[seen], color=OTHER, label=f"fitted, residual {fit.rms:.2%} of the largest")
    data.set(ylabel=f"{what} [{per}]", title=f"a) {what}")
    data.legend()
    left.axhline(0.0, color=OTHER)
    left.plot(m.t[seen], scale * fit.residual[seen], ".", color=INK, ms=4)
    left.set(
        ylabel=f"residual [{per}]", title=f"b) measured less fitted, neighbours correlate by {fit.correlation:.2f}"
    )
    symbol, size, unit = ("E", MPA, " [MPa]") if relaxes else ("J", 1.0, " [1]")
    for k in range(1, fit.terms + 1):
        x, y = fit.values[f"tau_{k}"], fit.values[f"{symbol}_{k}"]
        spread = [[v - v / np.exp(1.96 * sd / v), v * np.exp(1.96 * sd / v) - v] for v, sd in (
            (x, fit.sd[f"tau_{k}"]), (y, fit.sd[f"{symbol}_{k}"])
        )]  # fmt: skip
        across, along = ([[low], [high]] for low, high in spread)
        spectrum.errorbar(x, size * y, size * np.array(along), across, fmt="o", color=ACTUAL, capsize=3)
    E = fit.values["E"]
    kept = f"E = {MPA * E:.4g} MPa ± {1.96 * fit.sd['E'] / E:.1%}"
    spectrum.margins(y=0.2)
    spectrum.set(
        xscale="log", yscale="log", xlabel="time [s]", ylabel=f"${symbol}_i${unit}", title=f"c) terms; {kept}, relaxed"
    )
    low, high = m.window
    ends = spectrum.get_xlim()
    for axes in (data, left, spectrum):
        axes.axvspan(min(ends[0], low / 3), low, color="#f0f0f0", lw=0, zorder=0)
        axes.axvspan(high, max(ends[1], 3 * high), color="#f0f0f0", lw=0, zorder=0)
    spectrum.set_xlim(low / 3, 3 * high)
    figure.align_ylabels()
    return figure
