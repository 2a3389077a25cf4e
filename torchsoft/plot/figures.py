"""The paper's figures, drawn from a run: each function takes a `Trajectory` and returns a
matplotlib `Figure`.

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

from torchsoft.channels import PADS
from torchsoft.files import replacing
from torchsoft.physics.mesh import Array
from torchsoft.physics.rig import Rig
from torchsoft.plot.scene import (
    FRICTION,
    INK,
    MM,
    NORMAL,
    Instant,
    Scene,
    along_surface,
    around_contact,
    force_scale,
    in_world,
    instants,
    outwards,
    own_axes,
    unit,
)
from torchsoft.solve.trajectory import Trajectory

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

STRAIN, DAMPING = ("#08519c", "#4292c6", "#2171b5"), ("#a63603", "#e6550d", "#d94801")
"""Colours of the pads' energies, in turn."""

SNAPSHOTS = (0.375, 2.5, 5.0, 7.5, 10.0, 17.5, 20.0, 22.5, 25.0)
"""Times [s] of the paper's Fig. 16."""


CLOSE = 10.0
"""How far a close-up reaches on either side, for pads like the paper's [mm]."""


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
    place = axes.get_subplotspec()
    if place is not None and place.is_last_row():
        axes.set_xlabel("time [s]")
    t = trajectory.t.numpy()
    axes.set_xlim(float(t[0]), float(t[-1]) * 1.01)
    return t


@rc_context(STYLE)
def motion(trajectory: Trajectory) -> Figure:
    """The disc's horizontal displacement and velocity, desired and actual, and what lies between
    them."""
    figure = new_figure("Desired and actual motion of the disc (paper: Figs. 10 and 13)", 9, 5.6)
    axes = figure.subplots(2, 2, sharex=True, height_ratios=(2, 1))
    columns = (
        ("a) displacement", "x_C [mm]", trajectory["x_d"], trajectory["x_C"], "error [mm]"),
        (
            "b) velocity",
            "velocity of C [mm/s]",
            trajectory["x_d_dot"],
            trajectory["v_x"],
            "error [mm/s]",
        ),
    )
    for (upper, lower), (title, label, desired, actual, error) in zip(axes.T, columns):
        t = timeline(upper, label.replace("x_C", "$x_C$"), trajectory)
        upper.plot(t, MM * desired.numpy(), color=DESIRED, lw=4, label="desired")
        upper.plot(t, MM * actual.numpy(), color=ACTUAL, lw=1.1, label="actual")
        upper.set_title(title)
        lower.plot(
            timeline(lower, error, trajectory),
            MM * (actual - desired).numpy(),
            color=ACTUAL,
            lw=0.8,
        )
        lower.set_title("actual less desired")
    axes[0, 0].legend()
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def control_forces(trajectory: Trajectory) -> Figure:
    """Both controllers' forces on the bracket."""
    figure = new_figure("Control forces on the bracket (paper: Fig. 11)", 9, 3.6)
    panels = figure.subplots(1, 2)
    titles = (
        ("a) vertical, positive upwards", "$F_y$ [N]", "F_y"),
        ("b) horizontal, positive to the right", "$F_x$ [N]", "F_x"),
    )
    for axes, (title, label, channel) in zip(panels, titles):
        t = timeline(axes, label, trajectory)
        axes.plot(t, trajectory[channel].numpy(), color=ACTUAL, lw=1.1)
        axes.set_title(title)
    if trajectory.t[-1] > 2:  # the grasp takes one eightieth of the axis: show it again
        grasp = panels[0].inset_axes((0.35, 0.38, 0.55, 0.5))
        first = trajectory.t <= 1
        grasp.plot(
            trajectory.t[first].numpy(), trajectory["F_y"][first].numpy(), color=ACTUAL, lw=1.1
        )
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
    return figure


def bracket_moment(trajectory: Trajectory) -> Figure:
    """Moment on the bracket about its centre of mass."""
    title = "Moment on the bracket about its centre of mass (paper: Fig. 12)"
    return one_curve(
        trajectory, title, "$M_{Br}$ [N m], positive anticlockwise", trajectory["bracket_moment"]
    )


def angular_momentum(trajectory: Trajectory) -> Figure:
    """Angular momentum of the disc about its centre of mass."""
    title = "Angular momentum of the disc about its centre of mass (paper: Fig. 17)"
    label = r"$I_C\,\omega$ [kg mm²/s], positive anticlockwise"
    return one_curve(trajectory, title, label, MM**2 * trajectory["angular_momentum"])


def contact_forces(axes: Axes, instant: Instant, contact: str) -> None:
    """Normal force (red, filled circles) and friction (blue) at one contact's points [N] against x
    [mm]."""
    x, force = around_contact(instant, contact)
    axes.axhline(0, color=INK, lw=0.6)
    axes.plot(
        x, force[:, 1], "s-", color=FRICTION, ms=3.5, label="friction (positive to the right)"
    )
    axes.plot(x, force[:, 0], "o-", color=NORMAL, ms=4.5, label="normal force on the pad's nodes")
    axes.set_ylabel("force [N]")


def close_up(axes: Axes, rig: Rig, instant: Instant, contact: str, shared: bool) -> None:
    """The deformed pad under one contact, and the body on it; a `shared` axis of x gives way to the
    equal aspect in y."""
    Scene(axes, rig, columns=1).show(instant)
    name, body = rig.contacts[contact].pad, rig.contacts[contact].body
    shape, pose, pad = rig.bodies[body].shape, instant.pose[body], rig.pads[name]
    assert shape is not None
    inwards = -own_axes(pad, instant.base[name])[1]
    own = torch.from_numpy(in_world(inwards, np.array([0.0, 0.0, -pose[2]])))
    reach = MM * (
        float(shape.support(own).detach()) + min(0.5 * pad.mesh.height, 2.5e-3 * unit(rig))
    ) - 0.5 * unit(rig)
    x, y = pose[:2] + reach * inwards
    axes.set_xlim(x - CLOSE * unit(rig), x + CLOSE * unit(rig))
    axes.set_ylim(y - 3.3 * unit(rig), y + 3.3 * unit(rig), auto=True)
    axes.set_aspect("equal", adjustable="datalim" if shared else "box")
    axes.set_ylabel("y [mm]")
    axes.grid(False)


@rc_context(STYLE)
def force_distribution(trajectory: Trajectory, rig: Rig, time: float) -> Figure:
    """Normal force and friction at every contact at the sample nearest to `time` [s], over the
    deformed pads."""
    (instant,) = instants(rig, trajectory, [time])
    source = {0.125: " (paper: Fig. 14)", 5.0: " (paper: Fig. 15)"}.get(time, "")
    contacts = list(rig.contacts)[::-1]
    rows = [(key, close) for key in contacts for close in (False, True)]
    rows[-2:] = rows[:-3:-1]  # the forces come last, over the labels of the axis
    figure = new_figure(
        f"Contact forces on the pads at t = {instant.time:g} s{source}", 10.5, 3.7 * len(contacts)
    )
    grid = figure.add_gridspec(
        len(rows),
        2,
        width_ratios=(1, 1.1),
        height_ratios=[1.3 if close else 1 for _, close in rows],
    )
    body = rig.bodies[rig.contacts[contacts[-1]].body]
    centre, radius = (
        instant.pose[rig.contacts[contacts[-1]].body],
        MM * body.shape.size() if body.shape else 0.0,
    )
    whole = figure.add_subplot(grid[:, 0])
    Scene(whole, rig, columns=2).show(instant)
    whole.set(xlim=(centre[0] - 1.6 * radius, centre[0] + 1.6 * radius), title="b) bodies and pads")
    whole.set(
        ylim=(centre[1] - 1.65 * radius, centre[1] + 1.85 * radius),
        xlabel="x [mm]",
        ylabel="y [mm]",
    )
    whole.grid(False)
    spread = np.concatenate([around_contact(instant, k)[1].ravel() for k in contacts])
    low, high = float(spread.min(initial=0.0)), float(spread.max(initial=1e-3))
    first, shared = None, rig.contacts[contacts[0]].body
    for row, (key, close) in enumerate(rows):
        contact = rig.contacts[key]
        direction = along_surface(rig.pads[contact.pad], instant.base[contact.pad])
        level = bool(direction[0] > 0.999) and contact.body == shared
        axes = figure.add_subplot(grid[row, 1], sharex=first if level else None)
        if close:
            axes.set_title(
                f"{PADS[key]} interface, close up" if key in PADS else f"{key}, close up"
            )
            close_up(axes, rig, instant, key, level)
        else:
            letter = {"U": "c) ", "L": "a) "}.get(key, "")
            axes.set_title(
                f"{letter}forces on the {PADS[key]} pad"
                if key in PADS
                else f"{key}, forces on the pad"
            )
            contact_forces(axes, instant, key)
            middle = float(instant.pose[contact.body][:2] @ direction)
            axes.set_xlim(middle - CLOSE * unit(rig), middle + CLOSE * unit(rig))
            axes.set_ylim(low - 0.08 * (high - low), high + 0.12 * (high - low))
        axes.tick_params(labelbottom=not level or row == len(rows) - 1)
        first = axes if level and first is None else first
    axes.set_xlabel("x [mm]" if direction[0] > 0.999 else "along the surface [mm]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside upper right", ncols=2)
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def snapshots(
    trajectory: Trajectory, rig: Rig, times: Sequence[float] = SNAPSHOTS,
    title: str = "Bodies, pads and contact forces over time (paper: Fig. 16)",
) -> Figure:  # fmt: skip
    """Bodies, deformed pads and contact forces at `times` [s]; those after the end of the run are
    left out."""
    end = float(trajectory.t[-1]) + 1e-9
    shown = instants(rig, trajectory, [t for t in times if t <= end] or [end])
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    curves = force_scale(rig, shown)
    (left, right), (low, high) = Scene(Figure().subplots(), rig, curves=curves).limits(shown)
    tall = min(max((high - low) / (right - left), 0.3), 1.5)
    width = 4.6 if tall < 0.75 else 3.4
    figure = new_figure(title, width * columns + 0.4, (0.9 * width * tall + 0.3) * rows + 0.9)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, instant, letter in zip(grid.flat, shown, "abcdefghijklmnopqrstuvwxyz"):
        scene = Scene(axes, rig, columns=5, curves=curves)
        scene.show(instant)
        x_limits, y_limits = scene.limits(shown)
        axes.set(xlim=x_limits, ylim=y_limits, title=f"{letter}) t = {instant.time:g} s")
        scene.scale_bar(axes)
        axes.grid(False)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel("x [mm]")
    for axes in grid[:, 0]:
        axes.set_ylabel("y [mm]")
    first = grid.flat[0]
    handles = [
        first.plot([], [], "o-", color=NORMAL, ms=3)[0],
        first.plot([], [], color=FRICTION)[0],
    ]
    labels = ["normal force on the nodes", f"friction on the pad ({outwards(rig, shown[0])})"]
    figure.legend(handles, labels, loc="outside lower center", ncols=min(2, columns))
    return figure


def energy_groups(trajectory: Trajectory) -> list[tuple[str, Array, str]]:
    """Label, energy [mJ] (T,) and colour of what is stored (pads, springs, motion) and dissipated
    (pads, dashpots, slip)."""
    stored, lost = (
        {name: energy.detach() for name, energy in energies.items()}
        for energies in (trajectory.energy, trajectory.dissipated)
    )
    groups = []
    for energies, prefix, label, colours in (
        (stored, "strain_", "stored: {} pad, strain", STRAIN),
        (lost, "pad_", "dissipated: {} pad, damping", DAMPING),
    ):
        names = [name for name in energies if name.startswith(prefix)]
        for i, name in enumerate(names):
            pad = name.removeprefix(prefix)
            groups.append(
                (label.format(PADS.get(pad, pad)), energies.pop(name), colours[i % len(colours)])
            )
        if energies is stored:
            springs = stored.pop("normal_springs") + stored.pop("tangential_springs")
            groups.append(("stored: contact springs", springs, "#9ecae1"))
            groups.append(
                ("stored: kinetic", sum(stored.values(), torch.zeros_like(trajectory.t)), "#deebf7")
            )
    for (name, energy), colour in zip(lost.items(), ("#fdae6b", "#fee6ce")):
        groups.append((f"dissipated: {name.replace('_', ' ')}", energy, colour))
    return [
        (f"{name} (up to {MM * float(x.max()):.2g} mJ)", MM * x.numpy(), colour)
        for name, x, colour in groups
    ]


@rc_context(STYLE)
def energy_balance(trajectory: Trajectory) -> Figure:
    """Energy stored and dissipated, stacked, against what the sources supplied, and the residual of
    that balance."""
    figure = new_figure("Energy: stored and dissipated against supplied", 9.5, 6.2)
    stack, residual = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    t = timeline(stack, "energy [mJ]", trajectory)
    labels, parts, colours = zip(*energy_groups(trajectory))
    stack.stackplot(t, *parts, labels=labels, colors=colours, lw=0)
    start = MM * sum(float(value[0].detach()) for value in trajectory.energy.values())
    supplied = start + MM * sum(x.detach().numpy() for x in trajectory.supplied.values())
    stack.plot(
        t, supplied, color="black", lw=1.4, ls=(0, (4, 2)), label="stored at the start + supplied"
    )
    stack.set_ylim(0, None)
    handles, names = stack.get_legend_handles_labels()
    figure.legend(
        handles[::-1], names[::-1], loc="outside right center"
    )  # in the order of the stack
    residual.plot(
        timeline(residual, "residual [mJ]", trajectory),
        MM * trajectory.energy_residual.detach().numpy(),
        color=INK,
    )
    residual.set_title(
        f"residual: at most {trajectory.energy_residual_rel:.1e} of what the sources injected"
    )
    figure.align_ylabels()
    return figure


def friction_ratio(trajectory: Trajectory) -> Array:
    """Sum of |F_T| over sum of F_N, all contacts, in %; zero where nothing touches."""
    forces = torch.cat(list(trajectory.force.values()), 1)
    normal, friction = forces[..., 0].sum(-1), forces[..., 1].abs().sum(-1)
    return (100 * friction / normal.clamp(min=1e-12)).detach().numpy()


@rc_context(STYLE)
def friction_comparison(runs: Mapping[str, tuple[Rig, Trajectory]]) -> Figure:
    """Friction of several parameter sets: at two contacts in grasp and roll, its ratio to the
    normal force, and F_x."""
    figure = new_figure("Two friction sets compared (paper: Figs. 11b, 14 and 15)", 10, 8)
    axes = figure.subplots(3, 2)
    for panel in axes[:2].flat[1:]:
        panel.sharey(axes[0, 0])
    styles = list(zip((FRICTION, OTHER, INK), ("o-", "s--", "^:")))
    end = min(float(trajectory.t[-1]) for _, trajectory in runs.values())
    for column, time in enumerate((0.375, 5.0)):
        for (name, (rig, trajectory)), (colour, marker) in zip(runs.items(), styles):
            (instant,) = instants(rig, trajectory, [min(time, end)])
            for row, k in enumerate(list(rig.contacts)[1::-1]):
                x, force = around_contact(instant, k)
                axes[row, column].plot(x, force[:, 1], marker, color=colour, ms=3.5, label=name)
                axes[row, column].set_title(f"{PADS.get(k, k)} pad, t = {instant.time:g} s")
                axes[row, column].set(xlabel="x [mm]", ylabel="friction, right + [N]")
    for (name, (_, trajectory)), (colour, marker) in zip(runs.items(), styles):
        line = {"color": colour, "ls": marker[1:], "lw": 1.1, "label": name}
        axes[2, 0].plot(
            timeline(axes[2, 0], "friction / normal [%]", trajectory),
            friction_ratio(trajectory),
            **line,
        )
        axes[2, 1].plot(
            timeline(axes[2, 1], "$F_x$ [N]", trajectory), trajectory["F_x"].numpy(), **line
        )
    axes[2, 0].set_title("sum of |friction| over sum of normal force")
    axes[2, 1].set_title("horizontal control force")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
