"""The picture of one instant of any rig: deformed pads on their bases, bodies with a spoke, and the
contact forces as curves.

Figures and animation share it. Everything on axes is in millimetres and newtons.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from torchsoft.physics.mesh import Array, Mesh, lame_moduli
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig
from torchsoft.solve.trajectory import Trajectory

NORMAL, FRICTION, INK = "#cc3311", "#0077bb", "#333333"
"""Red and blue as in the paper, a pair that colour-blind readers can distinguish."""

PAD, LAYER, DISC, STEEL = "#f2e3c2", "#8a6d3b", "#dfe5ea", "#b8bec4"

MM = 1e3


@lru_cache(maxsize=4)
def interior_solver(mesh: Mesh, nu: float) -> tuple[SuperLU, NDArray[np.int64], Array]:
    """Factorised K_ii, the free dofs that are interior, and K_is (dense), for the surface dofs in
    `mesh.surface` order.

    The interior follows the surface whatever E and depth, so both are taken as 1.
    """
    K_lambda, K_mu, _ = mesh.matrices
    lame_lambda, lame_mu = lame_moduli(1.0, nu)
    K = mesh.assemble(lame_lambda * K_lambda + lame_mu * K_mu).tocsc()
    surface = (2 * mesh.surface[:, None] + np.arange(2)).ravel()
    inside = np.ones(2 * len(mesh.free), np.bool_)
    inside[surface] = False
    interior = np.flatnonzero(inside)
    return splu(K[interior][:, interior]), interior, K[interior][:, surface].toarray()


def deformed_mesh(pad: Pad, u: Tensor) -> Array:
    """Places (..., mesh nodes, 2) [m] of all nodes of the mesh, bonded ones too, in the frame of
    the pad's base.

    u (..., nodes, 2) [m]: displacements as a run records them. A massless pad has only its surface
    there; the interior is in equilibrium with it, u_i = -K_ii^-1 K_is u_s.
    """
    mesh, batch = pad.mesh, tuple(u.shape[:-2])
    own = (u.detach().reshape(-1, pad.nodes, 2) @ pad.axes).flatten(1).numpy()
    free = np.zeros((len(own), 2 * len(mesh.free)))
    if pad.inertial:
        free[:] = own
    else:
        factor, interior, K_is = interior_solver(mesh, pad.material.nu.item())
        free[:, (2 * mesh.surface[:, None] + np.arange(2)).ravel()] = own
        free[:, interior] = -factor.solve(K_is @ own.T).T
    displacement = np.zeros((len(own), len(mesh.nodes), 2))
    displacement[:, mesh.free] = free.reshape(len(own), -1, 2)
    return pad.placed(mesh.nodes + displacement).reshape(*batch, -1, 2)


def in_world(places: Array, pose: Array) -> Array:
    """Places (..., 2) in the frame of a body, in the world; pose (3,): the body's x, y and angle
    [rad]."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return places @ np.array([[c, s], [-s, c]]) + pose[:2]


def straight_up(outline: Array) -> Array:
    """The highest place (2,) where a closed outline (points, 2) crosses the y axis; the origin if
    it does nowhere."""
    (x, y), (x_next, y_next) = outline[:-1].T, outline[1:].T
    k = np.flatnonzero((x > 0) != (x_next > 0))
    crossed = y[k] + (y_next - y)[k] * x[k] / (x - x_next)[k]
    return np.array([0.0, crossed.max(initial=0.0)])


class Instant(NamedTuple):
    """One sample as drawn: time [s], poses of the bodies and of the pads' bases (3,) [mm, mm, rad],
    places [mm], forces [N].

    mesh: pad -> (mesh nodes, 2); points: contact -> (points, 2); force: contact -> (points, 2),
    normal force and friction on the pad, the latter positive along `along_surface`; along: contact
    -> (points,), how far the points are in that direction.
    """

    time: float
    pose: dict[str, Array]
    base: dict[str, Array]
    mesh: dict[str, Array]
    points: dict[str, Array]
    force: dict[str, Array]
    along: dict[str, Array]

    def near(self, contact: str) -> NDArray[np.int64]:
        """Numbers of the points under a normal force, and of one more on each side."""
        return np.flatnonzero(np.convolve(self.force[contact][:, 0] > 0, np.ones(3), "same") > 0)


def instants(rig: Rig, trajectory: Trajectory, times: Sequence[float]) -> list[Instant]:
    """The samples of `trajectory` nearest to `times` [s], as drawn."""
    rows = [trajectory.at(time) for time in times]
    displacement = {name: trajectory.displacement[name][rows].detach() for name in rig.pads}
    meshes = {name: MM * deformed_mesh(pad, displacement[name]) for name, pad in rig.pads.items()}
    shown = []
    for i, row in enumerate(rows):
        pose = {
            name: x[row].detach().numpy() * [MM, MM, 1.0]
            for name, x in trajectory.state.pose.items()
        }
        base = {
            name: np.zeros(3) if pad.base is None else pose[pad.base]
            for name, pad in rig.pads.items()
        }
        points, force, along = {}, {}, {}
        for key, contact in rig.contacts.items():
            pad, own = rig.pads[contact.pad], base[contact.pad]
            points[key] = in_world(
                MM * (pad.spread @ (pad.positions + displacement[contact.pad][i])).numpy(), own
            )
            direction, (_, y) = along_surface(pad, own), own_axes(pad, own)
            t = np.array([y[1], -y[0]])  # of the moving frame, whose normal points into the pad
            force[key] = trajectory.force[key][row].detach().numpy() * [1.0, np.sign(direction @ t)]
            along[key] = points[key] @ direction
        mesh = {name: in_world(meshes[name][i], base[name]) for name in meshes}
        shown.append(Instant(float(trajectory.t[row]), pose, base, mesh, points, force, along))
    return shown


def own_axes(pad: Pad, base: Array) -> Array:
    """A pad's own x and y (2, 2) as unit vectors of the world; base (3,) is the pose of what it is
    bonded to."""
    return in_world(pad.axes.numpy().T, base) - base[:2]


def along_surface(pad: Pad, base: Array) -> Array:
    """The direction (2,) along a pad's surface that points to the right, or straight up."""
    x = own_axes(pad, base)[0]
    return x if x[0] + 1e-6 * x[1] > 0 else -x


def outwards(rig: Rig, instant: Instant) -> str:
    """Where friction points that is drawn outwards."""
    steep = any(
        abs(along_surface(pad, instant.base[name])[0]) < 0.7 for name, pad in rig.pads.items()
    )
    return "outwards: to the right or up" if steep else "outwards: to the right"


def own_places(pad: Pad, base: Array, own: Array) -> Array:
    """Places (..., 2) [mm] in the pad's own frame, in the world [mm]."""
    return in_world(MM * pad.placed(own / MM), base)


def around_contact(instant: Instant, contact: str) -> tuple[Array, Array]:
    """Places along the pad's surface [mm] and forces [N] of the touching points and of one more on
    each side."""
    rows = instant.near(contact)
    return instant.along[contact][rows], instant.force[contact][rows]


def unit(rig: Rig) -> float:
    """What margins and curves are measured in [mm]: one for the paper's pads of 120 mm."""
    return MM * max((pad.mesh.length for pad in rig.pads.values()), default=0.12) / 120


def curve_height(rig: Rig) -> float:
    """Height [mm] of the largest force's curve."""
    return 13.0 * unit(rig)


def force_scale(rig: Rig, shown: Sequence[Instant]) -> tuple[float, float]:
    """mm per N at which the largest force is as high as `curve_height`, and a round force [N] for
    the scale bar."""
    largest = max(
        (float(np.abs(force).max()) for instant in shown for force in instant.force.values()),
        default=0.0,
    )
    if largest == 0:
        return 1.0, 1.0
    decade = 10.0 ** np.floor(np.log10(largest))
    return curve_height(rig) / largest, float(
        max(m * decade for m in (1, 2, 5) if m * decade <= largest)
    )


def plates(rig: Rig) -> dict[str, float]:
    """Thickness [mm] of the plate behind each pad: symmetric about its base's centre, none on a
    base that has a shape, that of the others where the centre is not behind the pad."""
    out = {}
    for name, pad in rig.pads.items():
        if pad.base is not None:
            behind = (
                2 * MM * float((pad.placed(np.zeros(2)) @ pad.axes.numpy())[1])
            )  # height of the face over the base's centre
            if rig.bodies[pad.base].shape is not None:
                out[name] = 0.0
            elif behind > 1e-6:
                out[name] = behind
    thickest = max(out.values(), default=0.0) or 4 * unit(rig)
    return {name: out.get(name, thickest) for name in rig.pads}


class Scene:
    """The artists of one picture on `axes`; `show` puts the `moving` ones, in drawing order, where
    another instant has them.

    `columns` is the spacing, in elements, of the vertical mesh lines; every layer is drawn. With
    `curves` = (mm per N, scale bar in N) the contact forces stand behind the pads, normal force red
    with filled circles, friction blue.
    """

    def __init__(
        self, axes: Axes, rig: Rig, *, columns: int = 5, curves: tuple[float, float] | None = None
    ) -> None:  # fmt: skip
        self.rig, self.columns, self.curves = rig, columns, curves
        self.thickness = plates(rig)
        self.shapes = {
            name: MM * body.shape.outline().numpy()
            for name, body in rig.bodies.items()
            if body.shape is not None
        }

        def polygons(
            names: Sequence[str], face: str, edge: str, width: float
        ) -> dict[str, Polygon]:
            out = {
                k: Polygon(np.zeros((3, 2)), facecolor=face, edgecolor=edge, lw=width)
                for k in names
            }
            for polygon in out.values():
                axes.add_patch(polygon)
            return out

        self.plates = polygons(
            [name for name, size in self.thickness.items() if size], STEEL, INK, 0.6
        )
        self.outlines = polygons(list(rig.pads), PAD, "none", 0.0)
        self.layers = {k: LineCollection([], colors=LAYER, linewidths=0.5) for k in rig.pads}
        for lines in self.layers.values():
            axes.add_collection(lines, autolim=False)
        self.bodies = polygons(list(self.shapes), DISC, INK, 1.0)
        self.spokes, self.hubs, self.friction, self.normal = {}, {}, {}, {}
        for k in self.shapes:
            (self.spokes[k],) = axes.plot([], [], color=INK, lw=1.6, solid_capstyle="butt")
            (self.hubs[k],) = axes.plot([], [], "o", color=INK, ms=3)
        for k in rig.contacts if curves else ():
            (self.friction[k],) = axes.plot([], [], color=FRICTION, lw=1.1)
            (self.normal[k],) = axes.plot([], [], color=NORMAL, lw=1.1, marker="o", ms=1.8)
        groups = (
            self.plates,
            self.outlines,
            self.layers,
            self.bodies,
            self.spokes,
            self.hubs,
            self.friction,
            self.normal,
        )
        self.moving: list[Artist] = [artist for group in groups for artist in group.values()]
        axes.set_aspect("equal")

    def show(self, instant: Instant) -> None:
        """Put everything where it is at `instant`."""
        for k, nodes in instant.mesh.items():
            mesh = self.rig.pads[k].mesh
            self.outlines[k].set_xy(nodes[mesh.outline])
            self.layers[k].set_segments([nodes[line] for line in mesh.lines(self.columns)])
        for k, plate in self.plates.items():
            plate.set_xy(self.behind(instant, k, 0.0, self.thickness[k]))
        for k, outline in self.shapes.items():
            pose = instant.pose[k]
            self.bodies[k].set_xy(in_world(outline, pose))
            self.spokes[k].set_data(*np.stack((pose[:2], in_world(straight_up(outline), pose)), -1))
            self.hubs[k].set_data(*pose[:2, None])
        for k in self.normal:
            name, rows = self.rig.contacts[k].pad, instant.near(k)
            pad, base, force = self.rig.pads[name], instant.base[name], instant.force[k][rows]
            x = (instant.points[k][rows] - own_places(pad, base, np.zeros(2))) @ own_axes(
                pad, base
            )[0]
            foot = -self.thickness[name] - 5.0 * unit(self.rig)
            for line, values in ((self.normal[k], force[:, 0]), (self.friction[k], force[:, 1])):
                assert self.curves
                line.set_data(
                    *own_places(pad, base, np.stack((x, foot - self.curves[0] * values), -1)).T
                )

    def behind(self, instant: Instant, name: str, side: float, depth: float) -> Array:
        """Corners (4, 2) [mm] of the rectangle behind a pad's bonded face, wider than it by `side`
        [mm] on each side."""
        pad = self.rig.pads[name]
        (left, face), (right, _) = MM * pad.mesh.base + [[-side, 0.0], [side, 0.0]]
        corners = np.array(
            [[left, face - depth], [right, face - depth], [right, face], [left, face]]
        )
        return own_places(pad, instant.base[name], corners)

    def limits(self, shown: Sequence[Instant]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of x and y [mm] that hold every instant shown, with the force curves behind the
        pads."""
        step, rows = unit(self.rig), []
        for instant in shown:
            for k, outline in self.shapes.items():
                around = in_world(outline, instant.pose[k])
                rows += [around - 2.0 * step, around + 2.0 * step]
            for k, mesh in instant.mesh.items():
                depth = self.thickness[k] + (
                    curve_height(self.rig) + 7.0 * step if self.curves else 4.0 * step
                )
                rows += [mesh.reshape(-1, 2), self.behind(instant, k, 4.0 * step, depth)]
        every = np.concatenate(rows)
        (left, low), (right, high) = every.min(0), every.max(0)
        return (float(left), float(right)), (float(low), float(high))

    def scale_bar(self, axes: Axes) -> None:
        """A vertical bar in the upper right corner, as long as the scale's force."""
        assert self.curves
        millimetres, force = self.curves
        step, (_, right), (_, high) = unit(self.rig), axes.get_xlim(), axes.get_ylim()
        x, y = right - 6.0 * step, high - curve_height(self.rig) - 2.0 * step
        axes.plot([x, x], [y, y + millimetres * force], color=INK, lw=1.5, solid_capstyle="butt")
        axes.text(
            x - 2.0 * step,
            y + 0.5 * millimetres * force,
            f"{force:g} N",
            ha="right",
            va="center",
            fontsize=8,
        )
