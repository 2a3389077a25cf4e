"""Figures of a run of any rig: where its bodies went, what touched and pushed.

Times in s, lengths in mm, angles in rad, forces in N, moments in N mm.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from torchsoft.physics.mesh import Array
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.plot.figures import ACTUAL, DESIRED, STYLE, new_figure, timeline
from torchsoft.plot.scene import INK, MM
from torchsoft.solve.trajectory import Trajectory

COLOURS = ("#0077bb", "#ee7733", "#009988", "#cc3311", "#33bbee", "#ee3377", "#bbbbbb")
"""One after the other for bodies, contacts and actuators."""

STILL = 1e-3
"""Range [mm, or rad] below which a coordinate has not moved."""


class Curve(NamedTuple):
    """A coordinate over the run: its name, its label and its values (T,) as drawn; the set-point,
    where a loop has one."""

    name: str
    label: str
    values: Array
    setpoint: Array | None


def curves(trajectory: Trajectory, rig: Rig) -> Iterator[Curve]:
    """Every coordinate that is not fixed."""
    wanted = {
        coordinate: setpoint
        for a in rig.actuators.values()
        for coordinate, setpoint in a.follows if setpoint != a.feed_forward
    }  # fmt: skip
    for name, body in rig.bodies.items():
        for axis, place in zip(COORDINATES, trajectory.state.pose[name].detach().numpy().T):
            if body.freedom[axis] == "fixed":
                continue
            scale, unit = (1.0, "rad") if axis == "theta" else (MM, "mm")
            symbol, letter = rig.symbols[name], r"\theta" if axis == "theta" else axis
            label = (
                f"{axis} of {name} [{unit}]"
                if symbol == name
                else f"${letter}_{{{symbol}}}$ [{unit}]"
            )
            setpoint, coordinate = None, f"{name}.{axis}"
            if coordinate in wanted:
                setpoint = scale * trajectory[wanted[coordinate]].detach().numpy()
            yield Curve(coordinate, label, scale * place, setpoint)


def liveliest(trajectory: Trajectory, rig: Rig) -> str:
    """The free coordinate that moves most, an angle counting by the body's size; one without a loop
    if there is any."""
    looped = {actuator.pushes for actuator in rig.actuators.values()}

    def way(curve: Curve) -> tuple[bool, float]:
        body, _, axis = curve.name.partition(".")
        shape = rig.bodies[body].shape
        size = MM * shape.size() if axis == "theta" and shape is not None else 1.0
        return rig.bodies[body].freedom[axis] == "free" and curve.name not in looped, size * float(
            np.ptp(curve.values)
        )

    return max(curves(trajectory, rig), key=way).name


@rc_context(STYLE)
def motions(trajectory: Trajectory, rig: Rig) -> Figure:
    """Every coordinate that moves, a panel each, with the set-point of its loop."""
    shown = [c for c in curves(trajectory, rig) if np.ptp(c.values) > STILL]
    shown = shown or list(curves(trajectory, rig))[:1]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure("Motion of the bodies", 3.7 * columns + 0.3, 2.1 * rows + 0.8)
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for axes, curve in zip(grid.flat, shown):
        t = timeline(axes, curve.label, trajectory)
        if curve.setpoint is not None:
            axes.plot(t, curve.setpoint, color=DESIRED, lw=3.5, label="set-point")
        axes.plot(t, curve.values, color=ACTUAL, lw=1.1, label="actual")
        if curve.setpoint is not None:
            axes.legend()
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for axes in grid.flat[max(0, len(shown) - columns) : len(shown)]:
        axes.set_xlabel("time [s]")
        axes.tick_params(labelbottom=True)
    figure.align_ylabels()
    return figure


@rc_context(STYLE)
def efforts(trajectory: Trajectory, rig: Rig) -> Figure:
    """Sums of the forces at each contact, touching points and, where there are any, what the
    actuators push with."""
    kinds = (
        ("pushes", "turns")
        if any(a.pushes.endswith("theta") for a in rig.actuators.values())
        else ("pushes",)
    )
    rows = 3 + (len(kinds) if rig.actuators else 0)
    figure = new_figure("Contact forces and efforts", 8.5, 1.75 * rows + 0.7)
    panels = list(figure.subplots(rows, 1, sharex=True))
    labels = ("normal forces [N]", "friction [N]", "touching points")
    for (name, force), colour in zip(trajectory.force.items(), COLOURS * len(rig.contacts)):
        values = force[..., 0].sum(-1), force[..., 1].sum(-1), (force[..., 0] > 0).sum(-1)
        for axes, label, value in zip(panels, labels, values):
            axes.plot(
                timeline(axes, label, trajectory),
                value.detach().numpy(),
                color=colour,
                lw=1.1,
                label=name,
            )
    for kind, axes in zip(kinds, panels[3:]):
        turns = kind == "turns"
        chosen = [(n, a) for n, a in rig.actuators.items() if a.pushes.endswith("theta") == turns]
        for (name, actuator), colour in zip(chosen, COLOURS * len(chosen)):
            value = (MM if turns else 1.0) * trajectory[
                rig.renamed.get(f"F_{name}", f"F_{name}")
            ].detach().numpy()
            label = "efforts [N mm]" if turns else "efforts [N]"
            axes.plot(
                timeline(axes, label, trajectory),
                value,
                color=colour,
                lw=1.1,
                label=f"{name}, on {actuator.pushes}",
            )
    for axes in panels:
        axes.axhline(0, color=INK, lw=0.5, zorder=1)
        if axes not in panels[1:3]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.align_ylabels(panels)
    return figure
