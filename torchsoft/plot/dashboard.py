"""One figure of a whole run: an instant of it, motions with their set-points, contact forces with
the friction cone, points that stick and slip, efforts, stress in the pads, energies.

Times in s, lengths in mm, angles in rad, forces in N, moments in N mm, stresses in kPa, energies in
mJ.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchsoft.display import suggestion
from torchsoft.physics.energy import SLIPPING
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import von_mises
from torchsoft.physics.parts import COORDINATES
from torchsoft.plot.figures import (
    COLOURS,
    DESIRED,
    SIZES,
    Look,
    Size,
    finish_time_axis,
    legend_above,
    letter,
    looking,
    new_figure,
    stress_bar,
    timeline,
)
from torchsoft.plot.scene import (
    FRICTION,
    INK,
    MM,
    NORMAL,
    STATES,
    Instant,
    Scene,
    along_surface,
    instants,
    keys,
    limits,
)
from torchsoft.solve.trajectory import Trajectory

STILL = 1e-3
"""Range [mm, or rad] below which a coordinate counts as still."""

SAMPLES = 400
"""Most samples at which stresses are computed."""

DENSER = 0.3
"""Share of the frames that are spaced by steps, not by time."""

RIPPLES = 6
"""Number of changes of the touching points from which the figure explains ripples."""

RIPPLE = (
    "Ripples of forces: points touch and part one by one; more contact points an element smooth "
    "them."
)
"""Explanation of ripples of the forces."""


SETPOINT, ACTUAL = "set-point", "actual"
"""Names of the curves of a coordinate."""


class Chart(NamedTuple):
    """Curves over the run by name (T,), in one drawn unit."""

    name: str
    label: str
    unit: str
    curves: dict[str, Array]

    def coloured(self) -> Iterator[tuple[str, Array, str]]:
        """Name, values and colour of every curve."""
        colours = COLOURS * len(self.curves)
        first = (DESIRED, *colours) if SETPOINT in self.curves else colours
        yield from ((name, x, colour) for (name, x), colour in zip(self.curves.items(), first))


def motions(run: Trajectory) -> Iterator[Chart]:
    """Every coordinate that is not fixed, with its set-point if a loop follows one."""
    setpoints = {
        at: name for one in run.setup.actuators.values() for at, name in one.follows.items()
    }
    for name, body in run.setup.bodies.items():
        for axis, place in zip(COORDINATES, run.state.pose[name].detach().numpy().T):
            if body.freedom[axis] == "fixed":
                continue
            scale, unit = (1.0, "rad") if axis == "theta" else (MM, "mm")
            coordinate, drawn = f"{name}.{axis}", dict[str, Array]()
            if coordinate in setpoints:
                drawn[SETPOINT] = scale * run[setpoints[coordinate]].detach().numpy()
            drawn[ACTUAL] = scale * place
            yield Chart(coordinate, f"{axis} of {name}", unit, drawn)


def liveliest(run: Trajectory) -> str:
    """The free coordinate with the largest range, angles times the body's size; one that no loop
    pushes if there is any."""
    looped = {one.pushes for one in run.setup.actuators.values()}

    def way(chart: Chart) -> tuple[bool, float]:
        name, _, axis = chart.name.partition(".")
        body = run.setup.bodies[name]
        size = MM * body.size if axis == "theta" and body.size else 1.0
        free = body.freedom[axis] == "free" and chart.name not in looped
        return free, size * float(np.ptp(chart.curves[ACTUAL]))

    return max(motions(run), key=way).name


def draw(axes: Axes, run: Trajectory, chart: Chart) -> None:
    """Draw the curves of a chart."""
    t = timeline(axes, f"{chart.label} [{chart.unit}]", run)
    for name, values, colour in chart.coloured():
        axes.plot(t, values, color=colour, lw=3 if name == SETPOINT else None, label=name)
    if chart.name == FRICTION_SUM:
        axes.axhline(0, color=INK, lw=0.5, zorder=1)
    if chart.unit == "%":
        axes.axhline(100, color=INK, lw=0.8, ls=":")
        axes.set_ylim(0, max(108.0, 1.04 * axes.dataLim.y1))
    if [*chart.curves] != [ACTUAL]:
        legend_above(axes)


FRICTION_SUM, TOUCHING, SLIDING = "friction", "points in contact", "slipping"
"""Names of some sums over the points of a contact."""


def sums(run: Trajectory) -> list[Chart]:
    """Sums over the points of each contact: the forces, the used share of the friction cone (of the
    normal force where a law has no mu_s; NaN without force), and the numbers of touching and of
    slipping points; none without contacts."""
    laws = {name: contact.friction for name, contact in run.setup.contacts.items()}
    known = all("mu_s" in law for law in laws.values())
    share_of = "share of the friction limit" if known else "friction over normal force"
    kinds = {"normal force": "N", FRICTION_SUM: "N", share_of: "%", TOUCHING: "1", SLIDING: "1"}
    out = [Chart(kind, kind, unit, {}) for kind, unit in kinds.items()]
    for name, force in run.force.items():
        normal, friction = force.detach().unbind(-1)
        total, state = normal.sum(-1), run.contact_state[name]
        mu = laws[name]["mu_s"] if known else 1.0
        share = torch.where(total > 1e-9, 100 * friction.abs().sum(-1) / (mu * total), torch.nan)
        touching, slipping = (state != 0).sum(-1), (state == SLIPPING).sum(-1)
        for one, values in zip(out, (total, friction.sum(-1), share, touching, slipping)):
            one.curves[name] = values.double().numpy()
    return out if run.force else []


def points(axes: Axes, run: Trajectory, touching: Chart, slipping: Chart) -> None:
    """Draw the number of touching points, and of slipping ones among them."""
    t = timeline(axes, "contact points", run)
    for name, values, colour in touching.coloured():
        axes.step(t, values, where="mid", color=colour, label=name)
        axes.fill_between(t, 0, slipping.curves[name], step="mid", color=colour, alpha=0.45, lw=0)
    axes.fill_between([], [], color=INK, alpha=0.45, lw=0, label="slipping")
    axes.set_ylim(0, None)
    axes.yaxis.set_major_locator(MaxNLocator("auto", integer=True))
    legend_above(axes)


def efforts(run: Trajectory) -> Iterator[Chart]:
    """The effort of every actuator."""
    for one in run.setup.actuators.values():
        scale, unit = (MM, "N mm") if one.unit == "N.m" else (1.0, "N")
        effort = scale * run[one.channel].detach().numpy()
        yield Chart(one.channel, f"on {one.pushes}", unit, {ACTUAL: effort})


def frame_rows(run: Trajectory, frames: int) -> list[int]:
    """Rows of the run for `frames` frames or fewer, each once; denser where the steps were
    shorter."""
    t, knots = run.t.numpy(), run.knots.numpy()
    count = np.interp(t, knots, np.linspace(0.0, 1.0, len(knots)))
    clock = (1 - DENSER) * (t - t[0]) / (t[-1] - t[0]) + DENSER * count
    rows = np.interp(np.linspace(0.0, clock[-1], frames), clock, np.arange(len(t)))
    return np.unique(rows.round().astype(int)).tolist()


def stresses(axes: Axes, run: Trajectory) -> None:
    """Draw the largest von Mises stress in every pad."""
    rows = frame_rows(run, SAMPLES)
    for (name, pad), colour in zip(run.setup.pads.items(), COLOURS * len(run.setup.pads)):
        whole = pad.displacement(run.displacement[name][rows].detach().numpy())
        peak = 1e-3 * von_mises(pad.stress(whole)).max(-1)
        timeline(axes, "von Mises,\nelastic [kPa]", run)
        axes.plot(run.t.numpy()[rows], peak, color=colour, label=f"pad {name}")
    axes.set_ylim(0, None)
    legend_above(axes)


def energy_groups(run: Trajectory) -> list[tuple[str, Array, str]]:
    """Label, energy [mJ] (T,) and colour of groups of stored and dissipated energies; each energy
    is in one group."""
    zero = torch.zeros_like(run.t)
    stored, dissipated = dict(run.energy), dict(run.dissipated)

    def taken(energies: dict[str, torch.Tensor], prefix: str) -> Array:
        names = [name for name in energies if name.startswith(prefix)]
        return MM * sum((energies.pop(name) for name in names), zero).detach().numpy()

    return [
        ("stored in pads", taken(stored, "strain_"), "#2171b5"),
        ("in contact springs", taken(stored, "normal_springs") + taken(stored, "tangential"),
         "#9ecae1"),
        ("kinetic", taken(stored, ""), "#08306b"),
        ("dissipated in pads", taken(dissipated, "pad_"), "#d94801"),
        ("by slip", taken(dissipated, "slip"), "#fdae6b"),
        ("by dashpots", taken(dissipated, ""), "#7f2704"),
    ]  # fmt: skip


def energies(axes: Axes, run: Trajectory) -> None:
    """Draw stored and dissipated energies, stacked, and the energy supplied by the sources."""
    t = timeline(axes, "energy [mJ]", run)
    labels, parts, colours = zip(*energy_groups(run))
    axes.stackplot(t, *parts, labels=labels, colors=colours, lw=0)
    start = MM * sum(float(value[0].detach()) for value in run.energy.values())
    supplied = MM * sum((x.detach().numpy() for x in run.supplied.values()), np.zeros(len(t)))
    axes.plot(t, start + supplied, color=INK, ls=(0, (4, 2)), label="start + supplied")
    axes.set_ylim(0, None)
    legend_above(axes)


def cones(axes: Axes, run: Trajectory, instant: Instant, contact: str) -> None:
    """Draw normal force and friction [N] at the points of one contact over their place along the
    surface [mm]; friction with its cone where the law has one, and points by their state."""
    near, name = instant.near(contact), run.setup.contacts[contact].pad
    pad, state = run.setup.pads[name], instant.state[contact][near]
    along = along_surface(pad, instant.base[name])
    x = instant.points[contact][near] @ along
    normal, friction = instant.force[contact][near].T
    mu = run.setup.contacts[contact].friction.get("mu_s")
    if mu is not None:
        axes.fill_between(x, -mu * normal, mu * normal, color=FRICTION, alpha=0.14, lw=0)
        axes.plot(x, mu * normal, ":", color=FRICTION, lw=0.8)
        axes.plot(x, -mu * normal, ":", color=FRICTION, lw=0.8, label=f"cone, mu_s = {mu:g}")
    axes.axhline(0, color=INK, lw=0.6)
    axes.plot(x, normal, color=NORMAL, label="normal force")
    axes.plot(x, friction, color=FRICTION, label="friction")
    for kind, (_, marker, colour) in STATES.items():
        at = state == kind
        style = {"color": colour, "mew": 0, "ms": 0.35 * rcParams["font.size"]}
        axes.plot(x[at], normal[at], marker, x[at], friction[at], marker, **style)
    axes.set_ylabel("force [N]")
    if not len(near):
        axes.set(xticks=[], yticks=[], ylim=(-1, 1), xlabel="no point touches")
        return
    axes.set_xlabel("x [mm]" if along[0] > 0.999 else "along the surface [mm]")
    legend_above(axes)
    area = pad.material.depth.item() * pad.point_lengths[near]
    if np.ptp(area) < 1e-6 * area[0]:  # else a force is not the same pressure everywhere
        scale = 1e-3 / float(area[0])
        both = partial(np.multiply, scale), partial(np.multiply, 1 / scale)
        beside = axes.secondary_yaxis("right", functions=both)
        beside.set_ylabel("traction [kPa]")


def scene(axes: Axes, run: Trajectory, instant: Instant) -> None:
    """Draw bodies, pads and contact forces, with the colour bar of the stress and a legend."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    one = Scene(axes, run.setup, [instant], size=0.1 * rcParams["font.size"])
    one.show(instant)
    one.scale_bar()
    axes.set_anchor("W")
    stress_bar(figure, [axes], one.stress)
    columns = 5 if figure.get_figwidth() > SIZES["column"].width else 2
    handles = keys(run.setup, [instant])
    figure.legend(handles=handles, loc="outside upper right", ncols=columns)


def most_loaded(run: Trajectory) -> float:
    """The time [s] of the largest normal force."""
    forces = (force[..., 0].sum(-1) for force in run.force.values())
    return float(run.t[int(sum(forces, torch.zeros_like(run.t)).argmax())])


def panels(run: Trajectory, instant: Instant) -> dict[str, Callable[[Axes], None]]:
    """Functions that draw the panels of a run by name: the scene and the contacts at an instant,
    then all that changes over time."""
    out: dict[str, Callable[[Axes], None]] = {"scene": partial(scene, run=run, instant=instant)}
    for contact in reversed(run.setup.contacts):
        out[f"contact {contact}"] = partial(cones, run=run, instant=instant, contact=contact)
    every, totals = list(motions(run)), {one.name: one for one in sums(run)}
    moving = [one for one in every if np.ptp(one.curves[ACTUAL]) > STILL] or every[:1]
    touching, slipping = totals.pop(TOUCHING, None), totals.pop(SLIDING, None)
    for one in (*moving, *totals.values()):
        out[one.name] = partial(draw, run=run, chart=one)
    if touching and slipping:
        out[TOUCHING] = partial(points, run=run, touching=touching, slipping=slipping)
    for one in efforts(run):
        out[one.name] = partial(draw, run=run, chart=one)
    if run.setup.pads:
        out["stress"] = partial(stresses, run=run)
    return out | {"energy": partial(energies, run=run)}


FLATTEST = 0.8
"""Height of a panel, over its usual one, down to which panels become flatter to fit on a page."""


def ripples(run: Trajectory) -> bool:
    """Whether points touch and part often enough to make the forces ripple."""
    late = run.t >= run.t[0] + 0.05 * (run.t[-1] - run.t[0])
    counts = [(state[late] != 0).sum(-1).diff() for state in run.contact_state.values()]
    on_nodes = any(pad.points == 0 for pad in run.setup.pads.values())
    return on_nodes and any(int((one != 0).sum()) >= RIPPLES for one in counts)


def chosen(only: Sequence[str], names: list[str]) -> list[str]:
    """The panels in `only`, or all of `names`; the scene first. Raises `ValueError` for an unknown
    one."""
    for name in only:
        if name not in names:
            raise ValueError(f"there is no panel `{name}`; {suggestion(name, names, 'there are')}")
    return sorted(dict.fromkeys(only or names), key=lambda name: name != "scene")


def arranged(
    names: Sequence[str], shape: float, title: str, size: Size
) -> tuple[Figure, dict[str, Axes]]:
    """An empty figure and the axes of its panels. The scene, `shape` times as high as wide, is in
    the upper left, with contacts to its right; all else follows below, row by row."""
    others = [name for name in names if name != "scene"]
    pictured, columns = "scene" in names, size.columns
    if not pictured:
        columns = min(columns, len(others))
    width = size.width / size.columns
    each, legend, tall, beside = 0.5 * width + 0.03 * size.font, 0.06 * size.font, 0.0, 0
    if pictured:
        share, span = (0.86, columns - 1) if columns > 1 else (0.73, 1)
        tall = min(shape, 1.1) * share * width * span + 0.5
        contacts = sum(name.startswith("contact ") for name in names)
        beside = min(contacts, round(tall / each)) if columns > 1 else 0
    top = [["scene"]] * pictured
    if pictured and columns > 1:
        top = [["scene"] * (columns - 1) + [name] for name in others[:beside] or ["."]]
    below = others[beside:]
    below += below[-1:] * (-len(below) % columns)  # the last takes what is left
    rows = [below[i : i + columns] for i in range(0, len(below), columns)]
    room = (size.height - tall - legend) / max(len(rows), 1)
    each = room if FLATTEST * each <= room < each else each
    figure = new_figure(title, width * columns, tall + len(rows) * each + legend)
    mosaic: Any = top + rows
    ratios = [tall] * len(top) + [each] * len(rows)
    if columns > 1 and top and rows:  # the colour bar of the scene moves its own rows only
        mosaic, ratios = [[top], [rows]], [tall, each * len(rows)]
    return figure, figure.subplot_mosaic(mosaic, height_ratios=ratios)


def dashboard(
    run: Trajectory, *, only: Sequence[str] = (), time: float | None = None, title: str = "",
    look: Look = "screen",
) -> Figure:  # fmt: skip
    """The whole run in one figure, with the instant `time` [s], by default that of the largest
    normal force. `only` names some of the panels: "scene", contacts, coordinates such as "disc.x",
    "friction", and so on.

    `look` "page" or "column" is camera-ready: that wide, without a title; a column has the scene,
    two contacts and the friction by default. Raises `ValueError` for another one, and for a panel
    that is not there.
    """
    (instant,) = instants(run, [most_loaded(run) if time is None else time])
    drawn = panels(run, instant)
    if look == "column" and not only:
        contacts = [name for name in drawn if name.startswith("contact ")]
        only = ("scene", *contacts[:2], *(["friction"] if run.force else []))
    names = chosen(only, list(drawn))
    with looking(look) as size:
        x, y = limits(run.setup, [instant])
        heading = (title or "Run") if size.titled else ""
        figure, axes = arranged(names, float(np.ptp(y) / np.ptp(x)), heading, size)
        if size.titled and not only and ripples(run):
            figure.supxlabel(RIPPLE, fontsize="small", color="#666666")
        for i, name in enumerate(names):
            drawn[name](axes[name])
            about = f"t = {instant.time:g} s" if name == "scene" else name
            axes[name].set_title(f"{letter(i)} {about}")
            if not axes[name].get_xlabel():
                finish_time_axis(axes[name])
    return figure
