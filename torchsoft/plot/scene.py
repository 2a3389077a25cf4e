"""Picture of one instant of a run: deformed pads coloured by stress, bodies with a spoke, contact
points by their state, and contact forces as curves.

Figures and animation share it. Everything on axes is in millimetres and newtons.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from torchsoft.physics.energy import SEPARATED, SLIPPING, STICKING
from torchsoft.physics.mesh import Array
from torchsoft.physics.setup import PadSetup, Setup, von_mises
from torchsoft.solve.trajectory import Trajectory

NORMAL, FRICTION, INK = "#cc3311", "#0077bb", "#333333"
"""Red and blue as in the paper, which colour-blind readers can distinguish."""

PAD, LAYER, DISC, STEEL = "#f6ecd6", "#8a6d3b", "#dfe5ea", "#b8bec4"

STRESS = "YlOrBr"
"""Colour map of the von Mises stress, from zero to the largest in the picture."""

STATES = {
    STICKING: ("sticks", "o", "#222222"),
    SLIPPING: ("slips", "^", "#ee7733"),
    SEPARATED: ("apart", ".", "#9aa0a6"),
    -1: ("touches", "s", "#666666"),
}
"""Word, marker and colour of the states of contact points; -1 is contact without a known state."""

MM = 1e3

STEEP = 0.7
"""Cosine of the slope of a surface along which up is more telling than right."""


def in_world(places: Array, pose: Array) -> Array:
    """Points (..., 2) in the world from the frame of a body; pose (3,) is the body's x, y and angle
    [rad]."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return places @ np.array([[c, s], [-s, c]]) + pose[:2]


def straight_up(outline: Array) -> Array:
    """The highest point (2,) where a closed outline (points, 2) crosses the y axis; the origin if
    it never does."""
    (x, y), (x_next, y_next) = outline[:-1].T, outline[1:].T
    k = np.flatnonzero((x > 0) != (x_next > 0))
    crossed = y[k] + (y_next - y)[k] * x[k] / (x - x_next)[k]
    return np.array([0.0, crossed.max(initial=0.0)])


class Instant(NamedTuple):
    """One sample in drawn units: time [s], poses of the bodies and of the pads' bases (3,) [mm, mm,
    rad], positions [mm], forces [N].

    mesh: pad -> (mesh nodes, 2); stress: pad -> von Mises' (elements,) [kPa]; points: contact ->
    (points, 2); force: contact -> (points, 2), normal force and friction on the pad, the latter
    positive along `along_surface`; along: contact -> (points,), how far the points are in that
    direction; state: contact -> (points,).
    """

    time: float
    pose: dict[str, Array]
    base: dict[str, Array]
    mesh: dict[str, Array]
    stress: dict[str, Array]
    points: dict[str, Array]
    force: dict[str, Array]
    along: dict[str, Array]
    state: dict[str, NDArray[np.int8]]

    def near(self, contact: str, margin: int = 1) -> NDArray[np.int64]:
        """Indices of the points under a normal force, and of `margin` neighbours on each side."""
        pressed = self.force[contact][:, 0] > 0
        return np.flatnonzero(binary_dilation(pressed, iterations=margin))


def instants(run: Trajectory, times: Sequence[float]) -> list[Instant]:
    """The samples of a run nearest to `times` [s], in drawn units."""
    rows, setup = [run.at(time) for time in times], run.setup
    u = {name: run.displacement[name][rows].detach().numpy() for name in setup.pads}
    whole = {name: pad.displacement(u[name]) for name, pad in setup.pads.items()}
    stresses = {name: 1e-3 * von_mises(pad.stress(whole[name])) for name, pad in setup.pads.items()}
    meshes = {
        name: MM * pad.placed(pad.mesh.nodes + whole[name]) for name, pad in setup.pads.items()
    }
    shown = []
    for i, row in enumerate(rows):
        pose = {name: x[row].detach().numpy() * [MM, MM, 1.0] for name, x in run.state.pose.items()}
        base = {
            name: np.zeros(3) if pad.base is None else pose[pad.base]
            for name, pad in setup.pads.items()
        }
        points, force, along = {}, {}, {}
        for key, contact in setup.contacts.items():
            pad, own = setup.pads[contact.pad], base[contact.pad]
            points[key] = in_world(MM * pad.surface_points(u[contact.pad][i]), own)
            direction, (_, y) = along_surface(pad, own), own_axes(pad, own)
            t = np.array([y[1], -y[0]])  # of the moving frame, whose normal points into the pad
            force[key] = run.force[key][row].detach().numpy() * [1.0, np.sign(direction @ t)]
            along[key] = points[key] @ direction
        mesh = {name: in_world(meshes[name][i], base[name]) for name in meshes}
        stress = {name: stresses[name][i] for name in stresses}
        state = {key: run.contact_state[key][row].numpy() for key in setup.contacts}
        time = float(run.t[row])
        shown.append(Instant(time, pose, base, mesh, stress, points, force, along, state))
    return shown


def own_axes(pad: PadSetup, base: Array) -> Array:
    """A pad's x and y axes (2, 2) as unit vectors of the world; base (3,) is the pose of its
    base."""
    return in_world(pad.axes.T, base) - base[:2]


def along_surface(pad: PadSetup, base: Array) -> Array:
    """Unit vector (2,) along a pad's surface that points to the right, or up where it is steep: the
    same way while a finger leans."""
    x = own_axes(pad, base)[0]
    return x if x[int(abs(x[0]) < STEEP)] > 0 else -x


def outwards(setup: Setup, instant: Instant) -> str:
    """Direction of positive friction in the picture, in words."""
    steep = any(
        abs(along_surface(pad, instant.base[name])[0]) < STEEP for name, pad in setup.pads.items()
    )
    return "outwards: to the right or up" if steep else "outwards: to the right"


def own_places(pad: PadSetup, base: Array, own: Array) -> Array:
    """Points (..., 2) [mm] in the world from the pad's own frame [mm]."""
    return in_world(MM * pad.placed(own / MM), base)


def unit(setup: Setup) -> float:
    """Length unit of margins and curves [mm]: one for the paper's pads of 120 mm."""
    return MM * max((pad.mesh.length for pad in setup.pads.values()), default=0.12) / 120


def curve_height(setup: Setup) -> float:
    """Height [mm] of the curve of the largest force."""
    return 16.0 * unit(setup)


def foot(setup: Setup, thickness: float) -> Array:
    """A point (2,) [mm] of the line on which force curves stand, behind the plate of that
    thickness, in the pad's own frame."""
    return np.array([0.0, -thickness - 5.0 * unit(setup)])


def force_scale(setup: Setup, shown: Sequence[Instant]) -> tuple[float, float]:
    """Scale of the force curves [mm/N], at which the largest force has `curve_height`, and a round
    force [N] for the scale bar."""
    largest = max(
        (float(np.abs(force).max()) for instant in shown for force in instant.force.values()),
        default=0.0,
    )
    if largest == 0:
        return 1.0, 1.0
    decade = 10.0 ** np.floor(np.log10(largest))
    return curve_height(setup) / largest, float(
        max(m * decade for m in (1, 2, 5) if m * decade <= largest)
    )


def plates(setup: Setup) -> dict[str, float]:
    """Thickness [mm] of the plate drawn behind each pad. It is symmetric about the centre of the
    base; none on a base with a shape, and the thickest of the others where that centre is not
    behind the pad."""
    out = {}
    for name, pad in setup.pads.items():
        if pad.base is not None:
            behind = (
                2 * MM * float((pad.placed(np.zeros(2)) @ pad.axes)[1])
            )  # height of the face over the base's centre
            if setup.bodies[pad.base].outline is not None:
                out[name] = 0.0
            elif behind > 1e-6:
                out[name] = behind
    thickest = max(out.values(), default=0.0) or 4 * unit(setup)
    return {name: out.get(name, thickest) for name in setup.pads}


class Scene:
    """The artists of one picture on `axes`; `show` moves the artists in `moving`, which are in
    drawing order, to another instant.

    The mesh is the real one, in finer lines where it is dense. `curves` = (mm per N, scale bar in
    N) draws the contact forces behind the pads, normal force red, friction blue. `stress` [kPa] is
    the value of the darkest colour; pads are plain without it. `size` scales markers and lines.
    """

    def __init__(
        self, axes: Axes, setup: Setup, *, curves: tuple[float, float] | None = None,
        stress: float | None = None, size: float = 1.0,
    ) -> None:  # fmt: skip
        self.axes, self.setup, self.curves = axes, setup, curves
        self.thickness = plates(setup)
        self.shapes = {
            name: MM * body.outline
            for name, body in setup.bodies.items()
            if body.outline is not None
        }

        def polygons(
            names: Sequence[str], face: str, edge: str, width: float
        ) -> dict[str, Polygon]:
            out = {
                k: Polygon(np.zeros((3, 2)), fc=face, ec=edge, lw=size * width, joinstyle="round")
                for k in names
            }
            for polygon in out.values():
                axes.add_patch(polygon)
            return out

        self.plates = polygons(
            [name for name, thick in self.thickness.items() if thick], STEEL, INK, 0.6
        )
        self.fields, self.layers = {}, {}
        for k, pad in setup.pads.items():
            colours: dict[str, Any] = {"facecolors": PAD}
            if stress:
                colours = {"cmap": STRESS, "norm": Normalize(0.0, stress)}
            self.fields[k] = PolyCollection([], lw=0.3, edgecolors="face", **colours)
            side = MM * float(np.median(np.ptp(pad.mesh.nodes[pad.mesh.sides], 1).max(-1)))
            width = 0.35 * size * min(1.0, side / unit(setup))
            self.layers[k] = LineCollection([], colors=LAYER, linewidths=width, alpha=0.6)
            for collection in (self.fields[k], self.layers[k]):
                axes.add_collection(collection, autolim=False)
        self.outlines = polygons(list(setup.pads), "none", LAYER, 0.9)
        self.bodies = polygons(list(self.shapes), DISC, INK, 1.0)
        self.spokes, self.hubs, self.friction, self.normal = {}, {}, {}, {}
        for k in self.shapes:
            (self.spokes[k],) = axes.plot([], [], color=INK, lw=1.6 * size, solid_capstyle="butt")
            (self.hubs[k],) = axes.plot([], [], "o", color=INK, ms=3 * size)
        self.states: dict[tuple[str, int], Line2D] = {}
        for k in setup.contacts:
            for state, (_, marker, colour) in STATES.items():
                ms = size * (2.0 if state == SEPARATED else 3.6 if state == SLIPPING else 2.8)
                (self.states[k, state],) = axes.plot([], [], marker, color=colour, ms=ms, mew=0)
        for k in setup.contacts if curves else ():
            self.friction[k] = Polygon(
                np.zeros((3, 2)), facecolor=FRICTION, edgecolor=FRICTION, alpha=0.75, lw=0.8 * size
            )
            self.normal[k] = Polygon(
                np.zeros((3, 2)), facecolor=f"{NORMAL}33", edgecolor=NORMAL, lw=1.2 * size
            )
            axes.add_patch(self.normal[k])
            axes.add_patch(self.friction[k])
        groups = (
            self.plates, self.fields, self.layers, self.outlines, self.bodies, self.spokes,
            self.hubs, self.normal, self.friction, self.states,
        )  # fmt: skip
        self.moving: list[Artist] = [artist for group in groups for artist in group.values()]
        axes.set_aspect("equal")

    def show(self, instant: Instant) -> None:
        """Move all artists to `instant`."""
        for k, nodes in instant.mesh.items():
            mesh = self.setup.pads[k].mesh
            self.outlines[k].set_xy(nodes[mesh.outline])
            self.layers[k].set_segments(nodes[mesh.sides])
            self.fields[k].set_verts(nodes[mesh.elements])
            if self.fields[k].norm.scaled():
                self.fields[k].set_array(instant.stress[k])
        for k, plate in self.plates.items():
            plate.set_xy(self.behind(instant, k, 0.0, self.thickness[k]))
        for k, outline in self.shapes.items():
            pose = instant.pose[k]
            self.bodies[k].set_xy(in_world(outline, pose))
            self.spokes[k].set_data(*np.stack((pose[:2], in_world(straight_up(outline), pose)), -1))
            self.hubs[k].set_data(*pose[:2, None])
        for (k, state), line in self.states.items():
            rows = instant.near(k, 8)
            line.set_data(*instant.points[k][rows[instant.state[k][rows] == state]].T)
        for k in self.normal:
            name, rows = self.setup.contacts[k].pad, instant.near(k)
            pad, base, force = self.setup.pads[name], instant.base[name], instant.force[k][rows]
            x = (instant.points[k][rows] - own_places(pad, base, np.zeros(2))) @ own_axes(
                pad, base
            )[0]
            _, low = foot(self.setup, self.thickness[name])
            for area, values in ((self.normal[k], force[:, 0]), (self.friction[k], force[:, 1])):
                assert self.curves
                row = np.stack((x, low - self.curves[0] * values), -1)
                ends = np.stack((x, np.full_like(x, low)), -1)[[0, -1]] if len(x) else row
                around = np.concatenate((ends[:1], row, ends[1:]))
                area.set_xy(own_places(pad, base, around) if len(x) else np.zeros((1, 2)))

    def behind(self, instant: Instant, name: str, side: float, depth: float) -> Array:
        """Corners (4, 2) [mm] of the rectangle behind a pad's bonded face, wider by `side` [mm] on
        each side."""
        pad = self.setup.pads[name]
        (left, face), (right, _) = MM * pad.mesh.base + [[-side, 0.0], [side, 0.0]]
        corners = np.array(
            [[left, face - depth], [right, face - depth], [right, face], [left, face]]
        )
        return own_places(pad, instant.base[name], corners)

    def limits(self, shown: Sequence[Instant]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of x and y [mm] for all instants, force curves included."""
        step, rows = unit(self.setup), []
        for instant in shown:
            for k, outline in self.shapes.items():
                around = in_world(outline, instant.pose[k])
                rows += [around - 2.0 * step, around + 2.0 * step]
            for k, mesh in instant.mesh.items():
                depth = self.thickness[k] + (
                    curve_height(self.setup) + 7.0 * step if self.curves else 4.0 * step
                )
                rows += [mesh.reshape(-1, 2), self.behind(instant, k, 4.0 * step, depth)]
        every = np.concatenate(rows)
        (left, low), (right, high) = every.min(0), every.max(0)
        return (float(left), float(right)), (float(low), float(high))

    def scale_bar(self, axes: Axes) -> None:
        """Draw a vertical bar in the upper right corner, with the length of the scale's force."""
        assert self.curves
        millimetres, force = self.curves
        step, (_, right), (_, high) = unit(self.setup), axes.get_xlim(), axes.get_ylim()
        x, y = right - 6.0 * step, high - curve_height(self.setup) - 2.0 * step
        axes.plot([x, x], [y, y + millimetres * force], color=INK, lw=1.5, solid_capstyle="butt")
        axes.text(
            x - 2.0 * step,
            y + 0.5 * millimetres * force,
            f"{force:g} N",
            ha="right",
            va="center",
            fontsize="small",
        )


def largest_stress(shown: Sequence[Instant]) -> float:
    """Largest von Mises stress [kPa] of some instants."""
    return max((float(one.max()) for at in shown for one in at.stress.values()), default=0.0)


def keys(setup: Setup, shown: Sequence[Instant]) -> list[Artist]:
    """Handles of a legend: the contact states that occur, and forces."""
    there = {int(x) for at in shown for one in at.state.values() for x in np.unique(one)}
    out: list[Artist] = [
        Line2D([], [], ls="", marker=marker, color=colour, ms=5, label=f"point {word}")
        for state, (word, marker, colour) in STATES.items() if state in there
    ]  # fmt: skip
    if setup.contacts:
        out += [
            Line2D([], [], color=NORMAL, lw=1.4, label="normal force"),
            Line2D([], [], color=FRICTION, lw=1.4, label=f"friction ({outwards(setup, shown[0])})"),
        ]
    return out
