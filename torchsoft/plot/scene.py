"""Picture of one instant of a run: deformed pads coloured by stress, bodies with a spoke, contact
points by their state, and contact forces as curves.

Figures and animation share it. Everything on axes is in millimetres and newtons.
"""

from collections.abc import Iterable, Sequence
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
from torchsoft.physics.pads import Pad, von_mises
from torchsoft.physics.setup import Setup
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

MARKER_SIZES = {STICKING: 2.8, SLIPPING: 3.6, SEPARATED: 2.0, -1: 2.8}

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

    mesh: pad -> (mesh nodes, 2); stress: pad -> von Mises stress (elements,) [kPa]; points: contact
    -> (points, 2); force: contact -> (points, 2), normal force and friction on the pad, the latter
    positive along `along_surface`; state: contact -> (points,).
    """

    time: float
    pose: dict[str, Array]
    base: dict[str, Array]
    mesh: dict[str, Array]
    stress: dict[str, Array]
    points: dict[str, Array]
    force: dict[str, Array]
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
        points, force = {}, {}
        for key, contact in setup.contacts.items():
            pad, own = setup.pads[contact.pad], base[contact.pad]
            points[key] = in_world(MM * pad.surface_points(u[contact.pad][i]), own)
            force[key] = run.force[key][row].detach().numpy() * [1.0, friction_sign(pad, own)]
        mesh = {name: in_world(meshes[name][i], base[name]) for name in meshes}
        stress = {name: stresses[name][i] for name in stresses}
        state = {key: run.contact_state[key][row].numpy() for key in setup.contacts}
        time = float(run.t[row])
        shown.append(Instant(time, pose, base, mesh, stress, points, force, state))
    return shown


def own_axes(pad: Pad, base: Array) -> Array:
    """A pad's x and y axes (2, 2) as unit vectors of the world; base (3,) is the pose of its
    base."""
    return in_world(pad.axes.numpy().T, base) - base[:2]


def along_surface(pad: Pad, base: Array) -> Array:
    """Unit vector (2,) along a pad's surface that points to the right, or up where it is steep: the
    same way while a finger leans."""
    x = own_axes(pad, base)[0]
    return x if x[int(abs(x[0]) < STEEP)] > 0 else -x


def friction_sign(pad: Pad, base: Array) -> float:
    """1 where the recorded friction is positive along `along_surface`, else -1. Records use the
    frame whose normal points into the pad, for mirrored pads too."""
    x, y = own_axes(pad, base)[1]
    return float(np.sign(along_surface(pad, base) @ np.array([y, -x])))


def outwards(setup: Setup, instant: Instant) -> str:
    """Direction of positive friction in the picture, in words."""
    steep = any(
        abs(along_surface(pad, instant.base[name])[0]) < STEEP for name, pad in setup.pads.items()
    )
    return "outwards: to the right or up" if steep else "outwards: to the right"


def own_places(pad: Pad, base: Array, own: Array) -> Array:
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


def largest_force(shown: Sequence[Instant]) -> float:
    """Largest force [N] at a contact point in some instants."""
    return max((float(np.abs(x).max()) for at in shown for x in at.force.values()), default=0.0)


def force_scale(setup: Setup, shown: Sequence[Instant]) -> float:
    """Scale of the force curves [mm/N], at which the largest force has `curve_height`; 1 where
    there is no force."""
    return curve_height(setup) / (largest_force(shown) or curve_height(setup))


def plates(setup: Setup) -> dict[str, float]:
    """Thickness [mm] of the plate drawn behind each pad. It is symmetric about the centre of the
    base; none on a base with a shape, and the thickest of the others where that centre is not
    behind the pad."""
    out = {}
    for name, pad in setup.pads.items():
        if pad.base is not None:
            origin = pad.placed(np.zeros(2)) @ pad.axes.numpy()
            height = MM * float(origin[1])  # of face over centre
            if setup.bodies[pad.base].outline is not None:
                out[name] = 0.0
            elif height > 5e-7:
                out[name] = 2 * height
    thickest = max(out.values(), default=0.0) or 4 * unit(setup)
    return {name: out.get(name, thickest) for name in setup.pads}


def behind(pad: Pad, base: Array, depth: float, *, wider: float = 0.0) -> Array:
    """Corners (4, 2) [mm] of the rectangle of a `depth` behind a pad's bonded face, `wider` [mm]
    than the face on each side; base (3,) is the pose of the pad's base."""
    (left, face), (right, _) = MM * pad.mesh.base + [[-wider, 0.0], [wider, 0.0]]
    corners = np.array([[left, face - depth], [right, face - depth], [right, face], [left, face]])
    return own_places(pad, base, corners)


def limits(setup: Setup, shown: Sequence[Instant]) -> tuple[Array, Array]:
    """Limits (2,) of x and of y [mm] for all instants, force curves included."""
    margin, thickness, rows = unit(setup), plates(setup), []
    for instant in shown:
        for name, body in setup.bodies.items():
            if body.outline is not None:
                around = in_world(MM * body.outline, instant.pose[name])
                rows += [around - 2.0 * margin, around + 2.0 * margin]
        for name, mesh in instant.mesh.items():
            depth = thickness[name] + curve_height(setup) + 7.0 * margin
            rows += [mesh, behind(setup.pads[name], instant.base[name], depth, wider=4.0 * margin)]
    every = np.concatenate(rows)
    x, y = np.stack((every.min(0), every.max(0)), -1)
    return x, y


class Scene:
    """The artists of one picture on `axes`, whose limits and scales fit the instants in `shown`.
    `show` moves the artists in `moving`, which are in drawing order, to an instant.

    The mesh is the real one, in finer lines where it is dense. Contact forces stand as curves
    behind the pads, normal force red, friction blue. Pads show their von Mises stress, or are plain
    unless `stressed`. `size` scales markers and lines.
    """

    def __init__(
        self, axes: Axes, setup: Setup, shown: Sequence[Instant], *, stressed: bool = True,
        size: float = 1.0,
    ) -> None:  # fmt: skip
        self.axes, self.setup = axes, setup
        self.thickness = plates(setup)
        self.force_scale, self.largest_force = force_scale(setup, shown), largest_force(shown)
        self.stress = largest_stress(shown) if stressed else 0.0
        self.shapes = {
            name: MM * body.outline
            for name, body in setup.bodies.items()
            if body.outline is not None
        }

        def polygons(
            names: Iterable[str], face: str, edge: str, width: float
        ) -> dict[str, Polygon]:
            out = {
                name: Polygon(
                    np.zeros((3, 2)), fc=face, ec=edge, lw=size * width, joinstyle="round"
                )
                for name in names
            }
            for polygon in out.values():
                axes.add_patch(polygon)
            return out

        with_plate = [name for name, thickness in self.thickness.items() if thickness]
        self.plates = polygons(with_plate, STEEL, INK, 0.6)
        self.fields, self.layers = {}, {}
        colours: dict[str, Any] = {"facecolors": PAD}
        if self.stress:
            colours = {"cmap": STRESS, "norm": Normalize(0.0, self.stress)}
        for name, pad in setup.pads.items():
            side = MM * float(np.median(np.ptp(pad.mesh.nodes[pad.mesh.sides], 1).max(-1)))
            width = 0.35 * size * min(1.0, side / unit(setup))
            self.fields[name] = PolyCollection([], lw=0.3, edgecolors="face", **colours)
            self.layers[name] = LineCollection([], colors=LAYER, linewidths=width, alpha=0.6)
            axes.add_collection(self.fields[name], autolim=False)
            axes.add_collection(self.layers[name], autolim=False)
        self.outlines = polygons(setup.pads, "none", LAYER, 0.9)
        self.bodies = polygons(self.shapes, DISC, INK, 1.0)
        self.spokes, self.hubs, self.states = {}, {}, {}
        for name in self.shapes:
            style: dict[str, Any] = {"lw": 1.6 * size, "solid_capstyle": "butt"}
            (self.spokes[name],) = axes.plot([], [], color=INK, **style)
            (self.hubs[name],) = axes.plot([], [], "o", color=INK, ms=3 * size)
        for name in setup.contacts:
            for state, (_, marker, colour) in STATES.items():
                style = {"color": colour, "ms": size * MARKER_SIZES[state], "mew": 0}
                (self.states[name, state],) = axes.plot([], [], marker, **style)
        self.normal = polygons(setup.contacts, f"{NORMAL}33", NORMAL, 1.2)
        self.friction = polygons(setup.contacts, f"{FRICTION}bf", f"{FRICTION}bf", 0.8)
        groups = (
            self.plates, self.fields, self.layers, self.outlines, self.bodies, self.spokes,
            self.hubs, self.normal, self.friction, self.states,
        )  # fmt: skip
        self.moving: list[Artist] = [artist for group in groups for artist in group.values()]
        x, y = limits(setup, shown)
        axes.set(xlim=x, ylim=y, xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        axes.grid(False)

    def show(self, instant: Instant) -> None:
        """Move all artists to `instant`."""
        setup = self.setup
        for name, nodes in instant.mesh.items():
            mesh = setup.pads[name].mesh
            self.outlines[name].set_xy(nodes[mesh.outline])
            self.layers[name].set_segments(nodes[mesh.sides])
            self.fields[name].set_verts(nodes[mesh.elements])
            if self.stress:
                self.fields[name].set_array(instant.stress[name])
        for name, plate in self.plates.items():
            plate.set_xy(behind(setup.pads[name], instant.base[name], self.thickness[name]))
        for name, outline in self.shapes.items():
            pose = instant.pose[name]
            top = in_world(straight_up(outline), pose)
            self.bodies[name].set_xy(in_world(outline, pose))
            self.spokes[name].set_data(*np.stack((pose[:2], top), -1))
            self.hubs[name].set_data(*pose[:2, None])
        for (name, state), line in self.states.items():
            rows = instant.near(name, 8)
            line.set_data(*instant.points[name][rows[instant.state[name][rows] == state]].T)
        for name in setup.contacts:
            for area, kind in ((self.normal[name], 0), (self.friction[name], 1)):
                area.set_xy(self.force_curve(instant, name, kind))

    def force_curve(self, instant: Instant, contact: str, kind: int) -> Array:
        """Corners (points + 2, 2) [mm] of the area under the curve of the normal force (`kind` 0)
        or the friction (1) of a contact; one point without a force."""
        name, near = self.setup.contacts[contact].pad, instant.near(contact)
        if not len(near):
            return np.zeros((1, 2))
        pad, base = self.setup.pads[name], instant.base[name]
        origin = own_places(pad, base, np.zeros(2))
        x = (instant.points[contact][near] - origin) @ own_axes(pad, base)[0]
        _, low = foot(self.setup, self.thickness[name])
        curve = np.stack((x, low - self.force_scale * instant.force[contact][near, kind]), -1)
        return own_places(pad, base, np.concatenate(([[x[0], low]], curve, [[x[-1], low]])))

    def scale_bar(self) -> None:
        """Draw a vertical bar in the upper right corner, with the length of a round force; none
        where there is no force."""
        if not self.largest_force:
            return
        decade, step = 10.0 ** np.floor(np.log10(self.largest_force)), unit(self.setup)
        force = float(max(m * decade for m in (1, 2, 5) if m * decade <= self.largest_force))
        x = self.axes.get_xlim()[1] - 6.0 * step
        y = self.axes.get_ylim()[1] - curve_height(self.setup) - 2.0 * step
        top = y + self.force_scale * force
        self.axes.plot([x, x], [y, top], color=INK, lw=1.5, solid_capstyle="butt")
        label: Any = {"ha": "right", "va": "center", "fontsize": "small"}
        self.axes.text(x - 2.0 * step, y + 0.5 * step, f"{force:g} N", **label)


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
