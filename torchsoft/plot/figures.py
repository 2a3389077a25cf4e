"""The paper's figures, drawn from a run: each function takes a `Trajectory` and returns a matplotlib `Figure`.

Times in s, lengths in mm, forces in N, energies in mJ.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.files import replacing
from torchsoft.model import SoftGrasp
from torchsoft.pad import Array
from torchsoft.plot.scene import FRICTION, INK, MM, NORMAL, Instant, Scene, around_contact, force_scale, instants, span
from torchsoft.trajectory import Trajectory

STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "figure.titlesize": 12,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.4,
}

DESIRED, ACTUAL, OTHER = "#999999", "#0077bb", "#ee7733"

STORED = {
    "lower pad, strain": (("strain_L",), "#08519c"),
    "upper pad, strain": (("strain_U",), "#4292c6"),
    "contact springs": (("normal_springs", "tangential_springs"), "#9ecae1"),
    "kinetic": (("disc", "spin", "bracket", "kinetic_L", "kinetic_U"), "#deebf7"),
}
DISSIPATED = {
    "lower pad, damping": (("pad_L",), "#a63603"),
    "upper pad, damping": (("pad_U",), "#e6550d"),
    "contact dashpots": (("contact_dashpots",), "#fdae6b"),
    "slip": (("slip",), "#fee6ce"),
}

SNAPSHOTS = (0.375, 2.5, 5.0, 7.5, 10.0, 17.5, 20.0, 22.5, 25.0)
"""Times [s] of the paper's Fig. 16."""


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write the figure in the format of the suffix. The file appears whole or not at all."""
    with replacing(path) as partial:
        figure.savefig(partial, dpi=dpi, format=path.suffix[1:])


def new_figure(title: str, width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def timeline(axes: Axes, label: str, trajectory: Trajectory) -> NDArray[np.float64]:
    """Label an axis over time, and return the times [s]."""
    axes.set_ylabel(label)
    t = trajectory.t.numpy()
    axes.set_xlim(float(t[0]), float(t[-1]) * 1.01)
    return t


@rc_context(STYLE)
def motion(trajectory: Trajectory) -> Figure:
    """The disc's horizontal displacement and velocity, desired and actual, and what lies between them."""
    figure = new_figure("Desired and actual motion of the disc (paper: Figs. 10 and 13)", 9, 5.6)
    axes = figure.subplots(2, 2, sharex=True, height_ratios=(2, 1))
    s = trajectory.state
    columns = (
        ("a) displacement", "x_C [mm]", trajectory.desired[:, 0], s.r_C[:, 0], "error [mm]"),
        ("b) velocity", "velocity of C [mm/s]", trajectory.desired[:, 1], s.v_C[:, 0], "error [mm/s]"),
    )
    for (upper, lower), (title, label, desired, actual, error) in zip(axes.T, columns):
        t = timeline(upper, label.replace("x_C", "$x_C$"), trajectory)
        upper.plot(t, MM * desired.numpy(), color=DESIRED, lw=4, label="desired")
        upper.plot(t, MM * actual.numpy(), color=ACTUAL, lw=1.1, label="actual")
        upper.set_title(title)
        lower.plot(timeline(lower, error, trajectory), MM * (actual - desired).numpy(), color=ACTUAL, lw=0.8)
        lower.set_title("actual less desired")
        lower.set_xlabel("time [s]")
    axes[0, 0].legend()
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def control_forces(trajectory: Trajectory) -> Figure:
    """Both controllers' forces on the bracket."""
    figure = new_figure("Control forces on the bracket (paper: Fig. 11)", 9, 3.6)
    panels = figure.subplots(1, 2)
    titles = (
        ("a) vertical, positive upwards", "$F_y$ [N]", 1),
        ("b) horizontal, positive to the right", "$F_x$ [N]", 0),
    )
    for axes, (title, label, axis) in zip(panels, titles):
        t = timeline(axes, label, trajectory)
        axes.plot(t, trajectory.control[:, axis].numpy(), color=ACTUAL, lw=1.1)
        axes.set_title(title)
        axes.set_xlabel("time [s]")
    if trajectory.t[-1] > 2:  # the grasp takes one eightieth of the axis: show it again
        grasp = panels[0].inset_axes((0.35, 0.38, 0.55, 0.5))
        first = trajectory.t <= 1
        grasp.plot(trajectory.t[first].numpy(), trajectory.control[first, 1].numpy(), color=ACTUAL, lw=1.1)
        grasp.set_title("the grasp", fontsize=9)
        grasp.set_xlim(0, 1)
        grasp.tick_params(labelsize=8)
    return figure


@rc_context(STYLE)
def one_curve(trajectory: Trajectory, title: str, label: str, values: Tensor) -> Figure:
    """A single signal (T,) over time."""
    figure = new_figure(title, 6.5, 3.6)
    axes = figure.subplots()
    axes.axhline(0, color=INK, lw=0.6)
    axes.plot(timeline(axes, label, trajectory), values.numpy(), color=ACTUAL, lw=1.1)
    axes.set_xlabel("time [s]")
    return figure


def bracket_moment(trajectory: Trajectory) -> Figure:
    """Moment on the bracket about its centre of mass."""
    title = "Moment on the bracket about its centre of mass (paper: Fig. 12)"
    return one_curve(trajectory, title, "$M_{Br}$ [N m], positive anticlockwise", trajectory.bracket_moment)


def angular_momentum(trajectory: Trajectory) -> Figure:
    """Angular momentum of the disc about its centre of mass."""
    title = "Angular momentum of the disc about its centre of mass (paper: Fig. 17)"
    momentum = MM**2 * trajectory.inertia * trajectory.state.omega
    return one_curve(trajectory, title, r"$I_C\,\omega$ [kg mm²/s], positive anticlockwise", momentum)


def contact_forces(axes: Axes, instant: Instant, which: str) -> None:
    """Normal force (red, filled circles) and friction (blue) on one pad's nodes [N] against x [mm]."""
    x, force = around_contact(instant, which)
    axes.axhline(0, color=INK, lw=0.6)
    axes.plot(x, force[:, 1], "s-", color=FRICTION, ms=3.5, label="friction (positive to the right)")
    axes.plot(x, force[:, 0], "o-", color=NORMAL, ms=4.5, label="normal force on the pad's nodes")
    axes.set_ylabel("force [N]")


@rc_context(STYLE)
def force_distribution(trajectory: Trajectory, model: SoftGrasp, time: float) -> Figure:
    """Normal force and friction on both pads at the sample nearest to `time` [s], over the deformed pads."""
    (instant,) = instants(model, trajectory, [time])
    source = {0.125: " (paper: Fig. 14)", 5.0: " (paper: Fig. 15)"}.get(time, "")
    figure = new_figure(f"Contact forces on the pads at t = {instant.time:g} s{source}", 10.5, 7.4)
    grid = figure.add_gridspec(4, 2, width_ratios=(1, 1.1), height_ratios=(1, 1.3, 1.3, 1))
    centre, radius, half = instant.centre, MM * model.settings.disc.radius, 10.0
    whole = figure.add_subplot(grid[:, 0])
    Scene(whole, model, columns=2).show(instant)
    whole.set(xlim=(centre[0] - 32, centre[0] + 32), ylim=(-10, 2 * radius + 20), title="b) disc and pads")
    whole.set(xlabel="x [mm]", ylabel="y [mm]")
    whole.grid(False)
    spread = np.concatenate([around_contact(instant, k)[1].ravel() for k in "LU"])
    low, high = float(spread.min(initial=0.0)), float(spread.max(initial=1e-3))
    rows = (
        ("c) forces on the upper pad", "U"),
        ("upper interface, close up", "U"),
        ("lower interface, close up", "L"),
        ("a) forces on the lower pad", "L"),
    )
    first = None
    for row, (title, which) in enumerate(rows):
        first = axes = figure.add_subplot(grid[row, 1], sharex=first)
        axes.set_title(title)
        if row in (0, 3):
            contact_forces(axes, instant, which)
            axes.set_ylim(low - 0.08 * (high - low), high + 0.12 * (high - low))
        else:
            Scene(axes, model, columns=1).show(instant)
            out = 1 if which == "U" else -1
            middle = float(centre[1]) + out * (radius + 0.5 * MM * model.settings.pad.height - 0.5)
            axes.set_ylim(middle - 3.3, middle + 3.3, auto=True)  # give way to the equal aspect
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_ylabel("y [mm]")
            axes.grid(False)
        axes.tick_params(labelbottom=row == 3)
    assert first is not None
    first.set(xlim=(centre[0] - half, centre[0] + half), xlabel="x [mm]")
    first.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside upper right", ncols=2)
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def snapshots(trajectory: Trajectory, model: SoftGrasp, times: Sequence[float] = SNAPSHOTS) -> Figure:
    """Disc, deformed pads and contact forces at `times` [s]; those after the end of the run are left out."""
    end = float(trajectory.t[-1]) + 1e-9
    shown = instants(model, trajectory, [t for t in times if t <= end] or [end])
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure("The disc rolled between the pads (paper: Fig. 16)", 4.6 * columns + 0.4, 2.75 * rows + 0.9)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    height = 13.0
    curves = force_scale(shown, height)
    x_limits, y_limits = span(model, height)
    for axes, instant, letter in zip(grid.flat, shown, "abcdefghijklmnopqrstuvwxyz"):
        scene = Scene(axes, model, columns=5, curves=curves)
        scene.show(instant)
        scene.scale_bar(axes, x_limits[1] - 6, y_limits[1] - height - 2)
        axes.set(xlim=x_limits, ylim=y_limits, title=f"{letter}) t = {instant.time:g} s")
        axes.grid(False)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel("x [mm]")
    for axes in grid[:, 0]:
        axes.set_ylabel("y [mm]")
    first = grid.flat[0]
    handles = [first.plot([], [], "o-", color=NORMAL, ms=3)[0], first.plot([], [], color=FRICTION)[0]]
    labels = ["normal force on the nodes", "friction on the pad (outwards: to the right)"]
    figure.legend(handles, labels, loc="outside lower center", ncols=min(2, columns))
    return figure


def grouped_energies(energies: Mapping[str, Tensor], groups: Mapping[str, tuple[tuple[str, ...], str]]) -> list[Array]:
    """Sums [mJ] of the named energies, one array a group; what a fidelity does not have counts as nothing."""
    none = torch.zeros_like(next(iter(energies.values())))
    return [MM * sum((energies[n] for n in names if n in energies), none).numpy() for names, _ in groups.values()]


@rc_context(STYLE)
def energy_balance(trajectory: Trajectory) -> Figure:
    """Energy stored and dissipated, stacked, against what the sources supplied, and the residual of that balance."""
    figure = new_figure("Energy: stored and dissipated against supplied", 9.5, 6.2)
    stack, residual = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    t = timeline(stack, "energy [mJ]", trajectory)
    parts = grouped_energies(trajectory.energy, STORED) + grouped_energies(trajectory.dissipated, DISSIPATED)
    groups = STORED | DISSIPATED
    kinds = ["stored"] * len(STORED) + ["dissipated"] * len(DISSIPATED)
    labels = [f"{kind}: {name} (up to {part.max():.2g} mJ)" for kind, name, part in zip(kinds, groups, parts)]
    stack.stackplot(t, *parts, labels=labels, colors=[colour for _, colour in groups.values()], lw=0)
    start = MM * sum(float(value[0]) for value in trajectory.energy.values())
    supplied = start + MM * sum(value.numpy() for value in trajectory.supplied.values())
    stack.plot(t, supplied, color="black", lw=1.4, ls=(0, (4, 2)), label="stored at the start + supplied")
    stack.set_ylim(0, None)
    handles, names = stack.get_legend_handles_labels()
    figure.legend(handles[::-1], names[::-1], loc="outside right center")  # in the order of the stack
    residual.plot(timeline(residual, "residual [mJ]", trajectory), MM * trajectory.energy_residual.numpy(), color=INK)
    residual.set_title(f"residual: at most {trajectory.energy_residual_rel:.1e} of what the sources injected")
    residual.set_xlabel("time [s]")
    figure.align_ylabels()
    return figure


def friction_ratio(trajectory: Trajectory) -> Array:
    """Sum of |F_T| over sum of F_N, both pads, in %; zero where nothing touches."""
    forces = torch.cat((trajectory.force_L, trajectory.force_U), 1)
    normal, friction = forces[..., 0].sum(-1), forces[..., 1].abs().sum(-1)
    return (100 * friction / normal.clamp(min=1e-12)).numpy()


@rc_context(STYLE)
def friction_comparison(runs: Mapping[str, tuple[SoftGrasp, Trajectory]]) -> Figure:
    """Friction of several parameter sets: on both pads in the grasp and in rolling, its ratio to the normal force, and F_x."""
    figure = new_figure("Two friction sets compared (paper: Figs. 11b, 14 and 15)", 10, 8)
    axes = figure.subplots(3, 2)
    for panel in axes[:2].flat[1:]:
        panel.sharey(axes[0, 0])
    styles = list(zip((FRICTION, OTHER, INK), ("o-", "s--", "^:")))
    end = min(float(trajectory.t[-1]) for _, trajectory in runs.values())
    for column, time in enumerate((0.375, 5.0)):
        for (name, (model, trajectory)), (colour, marker) in zip(runs.items(), styles):
            (instant,) = instants(model, trajectory, [min(time, end)])
            for row, k in enumerate("UL"):
                x, force = around_contact(instant, k)
                axes[row, column].plot(x, force[:, 1], marker, color=colour, ms=3.5, label=name)
                axes[row, column].set_title(f"{'upper' if k == 'U' else 'lower'} pad, t = {instant.time:g} s")
                axes[row, column].set(xlabel="x [mm]", ylabel="friction, right + [N]")
    for (name, (_, trajectory)), (colour, marker) in zip(runs.items(), styles):
        line = {"color": colour, "ls": marker[1:], "lw": 1.1, "label": name}
        axes[2, 0].plot(timeline(axes[2, 0], "friction / normal [%]", trajectory), friction_ratio(trajectory), **line)
        axes[2, 1].plot(timeline(axes[2, 1], "$F_x$ [N]", trajectory), trajectory.control[:, 0].numpy(), **line)
    axes[2, 0].set_title("sum of |friction| over sum of normal force, both pads")
    axes[2, 1].set_title("horizontal control force")
    for panel in axes[2]:
        panel.set_xlabel("time [s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
