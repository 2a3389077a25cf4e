"""How the cost of a run grows with nodes, with touching nodes, with simulated time and with the size of a batch."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from _benchmark_batches import own_parameters
from _benchmark_common import Config, median_time, prepare
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from torchsoft import Parameters, simulate
from torchsoft.experiment import grid, markdown

DEPTHS = (0.5e-3, 1e-3, 1.5e-3, 2e-3, 2.5e-3)
"""By how much the grasp compresses both pads together [m]."""


@dataclass
class Growth:
    """Wall times [s] over something that is counted, and what else was counted."""

    over: str
    unit: str
    values: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    solves: list[float] = field(default_factory=list)  # linear solves of the runs

    @property
    def exponent(self) -> float:
        """Slope of log time over log value, by least squares."""
        return float(np.polyfit(np.log(self.values), np.log(self.wall_s), 1)[0])

    @property
    def exponent_per_solve(self) -> float | None:
        """The same of the time for one linear solve."""
        if not self.solves:
            return None
        return float(np.polyfit(np.log(self.values), np.log(np.divide(self.wall_s, self.solves)), 1)[0])

    def summary(self) -> dict[str, Any]:
        return {
            "over": self.over, "unit": self.unit, "values": self.values, "wall_s": self.wall_s, "solves": self.solves,
            "exponent": self.exponent, "exponent_per_solve": self.exponent_per_solve,
        }  # fmt: skip


def growth(config: Config) -> list[Growth]:
    """Wall times at the looser tolerance; meshes, depths and batches over the batch's simulated time."""
    rtol, t, repeats = config.rtols[0], grid(config.batch_duration), min(config.repeats, 3)
    nodes = Growth("surface nodes of a pad", "1")
    for n in config.elements_x:
        m = prepare(n)
        nodes.values.append(n + 1)
        nodes.wall_s.append(median_time(lambda m=m: simulate(m.model, t, y0=m.y0, rtol=rtol), repeats))
        nodes.solves.append(simulate(m.model, t, y0=m.y0, rtol=rtol).stats.newton_iterations)
    touching = Growth("points that touch, both pads", "1")
    for depth in DEPTHS[:: 4 if config.smoke else 1]:
        m = prepare(y_Br_grasp=wide() - depth)
        run = simulate(m.model, t, y0=m.y0, rtol=rtol)
        touching.values.append(float(sum((f[-1, :, 0] > 0).sum() for f in run.force.values())))
        touching.wall_s.append(median_time(lambda m=m: simulate(m.model, t, y0=m.y0, rtol=rtol), repeats))
        touching.solves.append(run.stats.newton_iterations)
    m, simulated = prepare(), Growth("simulated time", "s")
    for part in (1 / 30, 1 / 10, 1 / 3, 1.0):
        t = grid(part * config.duration)
        simulated.values.append(float(t[-1]))
        simulated.wall_s.append(median_time(lambda t=t: simulate(m.model, t, y0=m.y0, rtol=rtol), repeats))
        simulated.solves.append(simulate(m.model, t, y0=m.y0, rtol=rtol).stats.newton_iterations)
    return [nodes, touching, simulated, batch_growth(config)]


def batch_growth(config: Config) -> Growth:
    """Wall times of batches on one thread."""
    from torchsoft import simulate_batch

    out, m, t = Growth("runs of a batch", "1"), prepare(), grid(config.short_duration)
    for count in (2, 4) if config.smoke else (4, 16, 64, 256):
        parameters = own_parameters(m.model, count)
        task = lambda: simulate_batch(m.model, t, y0=m.y0, parameters=parameters, threads=1, rtol=config.rtols[0])  # noqa: B023
        out.values.append(count)
        out.wall_s.append(median_time(task, 1 if config.smoke else 3))
    return out


def wide() -> float:
    """Height of the bracket [m] at which the disc just touches both pads."""
    p = Parameters()
    return p.scenario.y_Br_grasp + p.compression


def growth_table(every: list[Growth]) -> str:
    """One row a measurement, with the exponents."""
    rows = [
        (
            one.over if i == 0 else "", f"{value:g}", f"{wall:.3g}", f"{int(one.solves[i])}" if one.solves else "",
            f"{one.exponent:.2f}" if i == 0 else "",
            f"{one.exponent_per_solve:.2f}" if i == 0 and one.exponent_per_solve is not None else "",
        )
        for one in every for i, (value, wall) in enumerate(zip(one.values, one.wall_s))
    ]  # fmt: skip
    return markdown(("growth with", "value", "wall time [s]", "linear solves", "exponent", "exponent of a solve"), rows)


def growth_figure(every: list[Growth]) -> Figure:
    """Wall times and the fitted powers, one axis each."""
    fig = Figure(figsize=(13, 3.4), layout="constrained")
    for ax, one in zip(fig.subplots(1, len(every)), every):
        draw(ax, one)
    fig.axes[0].set_ylabel("wall time [s]")
    return fig


def draw(ax: Axes, one: Growth) -> None:
    """Measured times and the power law through them."""
    x, y = np.array(one.values), np.array(one.wall_s)
    scale = np.exp(np.mean(np.log(y) - one.exponent * np.log(x)))
    ax.loglog(x, scale * x**one.exponent, "-", color="0.6", label=f"exponent {one.exponent:.2f}")
    ax.loglog(x, y, "o", color="#0072b2")
    ax.set_xticks(x, [f"{value:g}" for value in x])
    ax.xaxis.set_minor_locator(NullLocator())
    low, high = y.min(), y.max()
    if high < 20 * low:  # a range that has no power of ten of its own
        ticks = np.geomspace(low, high, 4) if high > 1.5 * low else np.array([low, high])
        ax.set_yticks(ticks, [f"{value:.2g}" for value in ticks])
        ax.yaxis.set_minor_locator(NullLocator())
    ax.set_ylim(0.7 * low, 1.4 * high)
    ax.set_xlabel(one.over + (f" [{one.unit}]" if one.unit != "1" else ""))
    ax.legend(loc="upper left")
