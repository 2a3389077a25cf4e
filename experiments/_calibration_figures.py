"""Rank histograms with what uniform ranks may be, and one posterior: its draws, its Gaussian, its profiles."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from torchsoft.sysid.certainty.calibration import Calibration
from torchsoft.sysid.certainty.posterior import Posterior
from torchsoft.sysid.certainty.profile import RISE, Profile


def histogram(ax: Axes, one: Calibration, label: str, bins: int) -> None:
    """Ranks of one coordinate, and the band that 95 % of the bins of uniform ranks are in."""
    ranks = np.array(one.ranks)[:, one.labels.index(label)]
    edges = np.linspace(0, one.draws + 1, bins + 1)
    band = stats.binom(len(ranks), 1 / bins)
    ax.axhspan(float(band.ppf(0.025)), float(band.ppf(0.975)), color="0.85", lw=0)
    ax.axhline(len(ranks) / bins, color="0.5", lw=0.8)
    ax.hist(ranks + 0.5, bins=edges.tolist(), color="C0", rwidth=0.9)
    worse = min(one.p_chi2[label], one.p_ecdf[label])
    ax.set_title(f"{label}: p = {worse:.2g}", fontsize=8, color="C3" if worse < 0.01 else "k")
    ax.set_xticks([])
    ax.tick_params(labelsize=7)


def rank_histograms(calibrations: Mapping[str, Calibration]) -> Figure:
    """A row for every way to a posterior."""
    columns = max(len(one.labels) for one in calibrations.values())
    figure = Figure(figsize=(2.2 * columns, 1.5 * len(calibrations)), layout="constrained")
    axes = figure.subplots(len(calibrations), columns, squeeze=False)
    for row, (name, one) in zip(axes, calibrations.items()):
        for ax in row[len(one.labels) :]:
            ax.set_axis_off()
        for ax, label in zip(row, one.labels):
            histogram(ax, one, label, 10)
        row[0].set_ylabel(f"{name}\n{len(one.ranks)} truths", fontsize=8)
    between = "\n" if columns < 3 else "; "
    caption = "rank of the truth among the draws, from lowest to highest", "grey: 95 % of uniform ranks"
    figure.supxlabel(between.join(caption), fontsize=8)
    return figure


def one_posterior(gaussian: Posterior, sampled: Posterior, profiles: list[Profile], truth: list[float]) -> Figure:
    """Draws of two coordinates by NUTS, the ellipses of Laplace, the ways of the profiles; and the profiles."""
    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    plane, *rises = figure.subplots(1, 1 + len(profiles))
    draws, _ = sampled.flat
    x, first = np.log(draws), np.log(gaussian.draws[0])
    (a, b), C, mean = sampled.labels[:2], np.cov(first.T), first.mean(0)
    plane.plot(*draws[:, :2].T, ".", ms=2, color="C0", alpha=0.5, label="NUTS")
    circle = np.stack((np.cos(t := np.linspace(0, 2 * np.pi, 200)), np.sin(t)))
    for p in (0.5, 0.95):
        ellipse = mean[:2, None] + np.sqrt(stats.chi2.ppf(p, 2)) * np.linalg.cholesky(C[:2, :2]) @ circle
        plane.plot(*np.exp(ellipse), color="C1", lw=1.2, label="Laplace, 50 and 95 %" if p == 0.5 else None)
    one = profiles[1]
    plane.plot(one.others[a], one.values, "k-", lw=0.8, label=f"profile of {b}")
    plane.plot(*truth[:2], "*", color="C3", ms=10, label="truth")
    low, high = np.exp(np.quantile(x[:, :2], [0.001, 0.999], axis=0))
    plane.set(xlabel=a, ylabel=b, xscale="log", yscale="log", xlim=(0.97 * low[0], 1.03 * high[0]))
    plane.legend(fontsize=7)
    for ax, profile in zip(rises, profiles):
        values = np.array(profile.values)
        wald = np.log(profile.wald95)
        sd = (wald[1] - wald[0]) / (2 * RISE**0.5)
        grid = np.linspace(np.log(values[0]), np.log(values[-1]), 200)
        ax.plot(np.exp(grid), ((grid - np.log(profile.best)) / sd) ** 2, color="C1", lw=1.2, label="by the covariance")
        ax.plot(values, profile.rises, "o-", color="k", ms=3, lw=1, label="profile")
        ax.axhline(RISE, color="0.5", ls="--", lw=0.8)
        ax.set(xlabel=profile.label, ylim=(0, 2 * RISE), xscale="log", title="rise of -2 log posterior")
        ax.title.set_fontsize(8)
        ax.legend(fontsize=7)
    for ax in (plane, *rises):
        ax.tick_params(labelsize=7, which="both")
    return figure
