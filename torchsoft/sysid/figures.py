"""Pictures of an identification: estimates, residuals, and designed motions."""

import re
from collections.abc import Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    MaxNLocator,
    NullLocator,
)

from torchsoft.plot.figures import ACTUAL, DESIRED, OTHER, STYLE
from torchsoft.sysid.design import Design
from torchsoft.sysid.estimate import ChannelResiduals, Direction, Estimate
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.recording import Array
from torchsoft.sysid.residual_tests import LAGS, autocorrelation
from torchsoft.tables import plain

SHOWN = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}
"""Units in figures, by SI unit, with the factor to them; others stay as they are."""

WIDTH = 5.4
"""Width of a figure [in], at which its text is legible on a phone."""

NAME = 24
"""Most characters in a line of a name beside an axis."""

MOST_NAMES = 3
"""Most components in the name of a direction."""


class Trace(NamedTuple):
    """One channel of one recording: its unit, times (k,) [s], measured and predicted samples (k,),
    and residuals over the noise (k,), raw and whitened."""

    recording: str
    channel: str
    unit: str
    t: Array
    measured: Array
    predicted: Array
    residual: Array
    white: Array


def direction_name(d: Direction) -> str:
    """Largest components of a direction, such as `pad.E − 0.24 contact.K_n`."""
    parts = list(d.components.items())
    sign = -1 if parts and parts[0][1] < 0 else 1
    parts = [(name, sign * value) for name, value in parts]
    terms = []
    for i, (name, v) in enumerate(parts[:MOST_NAMES]):
        factor = f"{abs(v):.2f} " if abs(v) < 0.995 else ""
        terms.append(f"{'−' if v < 0 else '+' if i else ''} {factor}{name}".strip())
    text = " ".join(terms)
    return text + (" …" if len(parts) > MOST_NAMES else "")


def literal(text: str, width: int = 200) -> str:
    """Text for matplotlib, with dollars escaped, in lines of at most `width` characters; names of
    parameters are broken after a dot."""
    parts = rf"\S{{1,{width - 1}}}(?:\.|$)|\S{{1,{width}}}"
    broken = [
        " ".join(re.findall(parts, word)) if len(word) > width else word
        for word in plain(text).split()
    ]
    return fill(" ".join(broken), width).replace("$", r"\$")


@rc_context(STYLE)
def estimates_figure(estimates: Sequence[Estimate]) -> Figure | None:
    """Estimates over their starts, with intervals; None where none can be on a log scale."""
    rows = [(e, e.start) for e in estimates if e.start is not None and e.start > 0]
    if not rows:
        return None
    figure = Figure(figsize=(WIDTH, 0.9 + 0.42 * len(rows)), layout="constrained")
    axes = figure.subplots()
    axes.axvline(1, color="#999999", lw=1, zorder=0.5)
    reach = [1 / 1.5, 1.5]
    for row, (e, s) in enumerate(rows):
        if e.value is None or e.ci95 is None:
            axes.axhspan(row - 0.32, row + 0.32, color="#f6e3d6", lw=0)
            axes.text(
                0.5,
                row,
                "not identifiable",
                transform=axes.get_yaxis_transform(),
                ha="center",
                va="center",
                fontsize=9,
                color="#a34400",
            )
            continue
        low, value, high = (max(v / s, 1e-6) for v in (e.ci95[0], e.value, e.ci95[1]))
        axes.errorbar(
            value,
            row,
            xerr=[[value - low], [high - value]],
            fmt="o",
            color=ACTUAL,
            ms=6,
            lw=2.4,
            capsize=4,
            capthick=1.2,
        )
        reach += [low, high]
    axes.set_xscale("log")
    low, high = min(reach) / 1.15, max(reach) * 1.15
    axes.set(xlim=(low, high), ylim=(len(rows) - 0.5, -0.5))
    figure.supxlabel("estimate over start value, 95 % interval", fontsize=10)
    axes.set_yticks(range(len(rows)), [literal(e.label, NAME) for e, _ in rows])
    ticks = [
        v
        for v in (0.01, 0.03, 0.1, 0.2, 0.33, 0.5, 0.7, 1, 1.5, 2, 3, 5, 10, 30, 100)
        if low <= v <= high
    ]
    while len(ticks) > 7:
        ticks = [v for i, v in enumerate(ticks) if v == 1 or (i - ticks.index(1)) % 2 == 0]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"× {v:g}"))
    axes.grid(False, axis="y")
    return figure


@rc_context(STYLE)
def trace_figure(
    trace: Trace, channel: ChannelResiduals | None, noise: Autoregression | None = None
) -> Figure:
    """Measured and predicted samples, residuals over the noise, and the autocorrelation of whitened
    residuals with its band; for coloured noise also that of raw residuals and of the noise
    model."""
    shown, scale = SHOWN.get(trace.unit, (trace.unit, 1.0))
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    data, residual, correlation = figure.subplots(3, 1, height_ratios=(2.1, 1, 1))
    data.plot(trace.t, scale * trace.measured, ".", color="#999999", ms=3.5, label="measured")
    data.plot(trace.t, scale * trace.predicted, color=ACTUAL, lw=1.1, label="predicted")
    data.set_title(literal(f"{trace.channel} [{shown}]" if shown else trace.channel))
    data.legend(
        loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=2, handlelength=1.2, borderpad=0.2
    )
    data.tick_params(labelbottom=False)
    rms, r = float(np.sqrt(np.mean(trace.residual**2))), trace.residual
    residual.axhspan(-1.96, 1.96, color="#e8f1f7", lw=0)
    residual.plot(trace.t, r, ".", color=ACTUAL, ms=2.5)
    residual.set_title(f"residual over noise (rms {rms:.2f}; band: 95 %)")
    residual.set(xlabel="time [s]", xlim=data.get_xlim())
    most = 1.1 * max(3.0, float(np.abs(r).max()))
    residual.set_ylim(-most, most)
    rho, band = autocorrelation(trace.white), 1.96 / np.sqrt(len(r))
    correlation.axhspan(-band, band, color="#e8f1f7", lw=0)
    correlation.axhline(0, color="#1d2329", lw=0.6)
    if len(rho):
        correlation.vlines(np.arange(1, len(rho) + 1), 0, rho, color=ACTUAL, lw=2)
    most = max(0.2, float(np.abs(rho).max(initial=0.0)))
    white = f" (white: p = {channel.p_white:.2g})" if channel is not None else ""
    if noise is not None:
        before, gamma = autocorrelation(r), noise.autocovariance(len(rho) + 1)
        lags = np.arange(1, len(rho) + 1)
        correlation.plot(lags, gamma[1:] / gamma[0], color=OTHER, lw=1.2)
        correlation.plot(lags, before, "o", color=OTHER, ms=3)
        most = max(most, float(np.abs(before).max(initial=0.0)))
        white = f"; orange: before order {noise.order} was taken out"
    correlation.set_title(
        f"autocorrelation{'' if noise is not None else ' of the residual'}{white}"
    )
    correlation.set(xlabel="lag [samples]", xlim=(0.3, LAGS + 0.7))
    correlation.set_ylim(-1.25 * most, 1.25 * most)
    correlation.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (data, residual, correlation):
        axes.yaxis.set_major_locator(MaxNLocator(5 if axes is data else 3))
    return figure


# Designed motion


@rc_context(STYLE)
def design_figure(design: Design) -> Figure:
    """Designed signals above; relative standard deviations and the criterion below."""
    names, bounds = tuple(design.made_by["bounds"]), design.made_by["bounds"]
    figure = Figure(figsize=(9.0, 1.8 * len(names) + 3.2), layout="constrained")
    panels: Any = figure.subfigures(2, 1, height_ratios=(1.8 * len(names), 3.2))
    above, below = panels
    t = np.linspace(design.recording.times[0], design.recording.times[-1], 2000)
    for ax, name in zip(above.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0], names):
        shown, scale = SHOWN.get(own := design.recording.units[name], (own, 1.0))
        for one, colour, label in (
            (design.given, DESIRED, "given"),
            (design.recording, ACTUAL, "designed"),
        ):
            signal = one.rig.reference(torch.from_numpy(t), [name])[:, 0, 0].detach().numpy()
            ax.plot(t, scale * signal, color=colour, label=label)
        for end in ("low", "high"):
            ax.axhline(scale * bounds[name][end], color=OTHER, lw=0.8, ls=":")
        ax.set_ylabel(f"{name} [{shown}]")
    above.axes[0].legend(loc="upper right", ncols=2)
    above.axes[-1].set_xlabel("time [s]")
    left, right = below.subplots(1, 2, width_ratios=(3, 2))
    at = np.arange(len(design.before))
    for offset, sds, colour in ((-0.2, design.before, DESIRED), (0.2, design.after, ACTUAL)):
        left.bar(at + offset, [100 * sd for sd in sds.values()], 0.38, color=colour)
    left.set_yscale("log")
    left.set_xticks(at, [name.split(".")[-1] for name in design.before])
    left.set_ylabel("standard deviation [%]")
    right.plot(
        [v.iteration for v in design.history],
        [v.value for v in design.history],
        "o-",
        color=ACTUAL,
        ms=3,
    )
    right.set(xlabel="iteration", ylabel=f"criterion {design.made_by['criterion']}")
    return figure
