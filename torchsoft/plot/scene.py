"""The picture of one instant: ground, deformed pads, bracket, disc with a spoke, and the nodal forces as curves.

Figures and animation share it. Everything on axes is in millimetres and newtons.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from torchsoft.model import SoftGrasp
from torchsoft.pad import Array, PadMesh, lame_moduli
from torchsoft.trajectory import Trajectory

NORMAL, FRICTION, INK = "#cc3311", "#0077bb", "#333333"
"""Red and blue as in the paper, a pair that colour-blind readers can distinguish."""

PAD, LAYER, DISC, STEEL = "#f2e3c2", "#8a6d3b", "#dfe5ea", "#b8bec4"

MM = 1e3


@lru_cache(maxsize=4)
def interior_solver(mesh: PadMesh, nu: float) -> tuple[SuperLU, NDArray[np.int64], Array]:
    """Factorised K_ii, the free dofs that are interior, and K_is (dense), for the surface dofs in `mesh.surface` order.

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


def deformed_mesh(model: SoftGrasp, which: str, u: Tensor, base: Tensor | None = None) -> Array:
    """Positions (..., elements_x + 1, elements_y + 1, 2) [m] of all mesh nodes of pad "L" or "U", bonded ones too.

    u (..., nodes, 2) [m]: the pad's displacements as the state holds them. A massless pad has only its surface there;
    the interior is in equilibrium with it, u_i = -K_ii^-1 K_is u_s. `base` (..., 2) [m] is where the pad's origin is,
    the bracket's centre of mass for the upper pad. The second mesh axis runs from the bonded face to the free surface.
    """
    pad, mesh, batch = model.pads[which], model.pads[which].mesh, tuple(u.shape[:-2])
    mirror = pad.mirror.numpy()
    own = u.detach().reshape(-1, pad.nodes, 2).numpy() * mirror  # in the pad's own frame
    free = np.zeros((len(own), 2 * len(mesh.free)))
    if pad.massless:
        surface = (2 * mesh.surface[:, None] + np.arange(2)).ravel()
        factor, interior, K_is = interior_solver(mesh, model.material.nu.item())
        free[:, surface] = own.reshape(len(own), -1)
        free[:, interior] = -factor.solve(K_is @ free[:, surface].T).T
    else:
        free[:] = own.reshape(len(own), -1)
    displacement = np.zeros((len(own), len(mesh.nodes), 2))
    displacement[:, mesh.free] = free.reshape(len(own), -1, 2)
    first = pad.positions[pad.surface[0]].numpy()  # where the model puts the first surface node
    origin = first - mesh.nodes[mesh.free[mesh.surface[0]]] * mirror
    positions = (mesh.nodes + displacement) * mirror + origin
    positions = positions.reshape(*batch, mesh.elements_x + 1, mesh.elements_y + 1, 2)
    return positions if base is None else positions + base.detach().numpy()[..., None, None, :]


class Instant(NamedTuple):
    """One sample as drawn: time [s], angle [rad], positions [mm], forces [N].

    mesh: pad -> (elements_x + 1, elements_y + 1, 2); surface: pad -> (surface, 2); force: pad -> (surface, 2), normal
    force and friction on the pad, the latter positive to the right.
    """

    time: float
    centre: Array
    angle: float
    bracket: Array
    mesh: dict[str, Array]
    surface: dict[str, Array]
    force: dict[str, Array]

    def touching(self, which: str) -> NDArray[np.bool_]:
        """Surface nodes under a normal force."""
        return self.force[which][:, 0] > 0


def instants(model: SoftGrasp, trajectory: Trajectory, times: Sequence[float]) -> list[Instant]:
    """The samples of `trajectory` nearest to `times` [s], as drawn."""
    rows = [trajectory.at(time) for time in times]
    s = model.layout.unpack(trajectory.y[rows])
    mesh = {"L": MM * deformed_mesh(model, "L", s.u_L), "U": MM * deformed_mesh(model, "U", s.u_U, s.r_Br)}
    number = {k: pad.mesh.free[pad.mesh.surface] for k, pad in model.pads.items()}
    surface = {k: mesh[k].reshape(len(rows), -1, 2)[:, number[k]] for k in "LU"}
    to_the_right = {"L": np.array([1.0, 1.0]), "U": np.array([1.0, -1.0])}  # t points left on the upper pad
    force = {k: getattr(trajectory, f"force_{k}")[rows].numpy() * to_the_right[k] for k in "LU"}
    return [
        Instant(
            float(trajectory.t[row]),
            MM * s.r_C[i].numpy(),
            s.theta[i].item(),
            MM * s.r_Br[i].numpy(),
            {k: mesh[k][i] for k in "LU"},
            {k: surface[k][i] for k in "LU"},
            {k: force[k][i] for k in "LU"},
        )
        for i, row in enumerate(rows)
    ]


def around_contact(instant: Instant, which: str) -> tuple[Array, Array]:
    """x [mm] and forces [N] of the touching nodes of a pad and of one more on each side."""
    rows = np.flatnonzero(np.convolve(instant.touching(which), np.ones(3), "same") > 0)
    return instant.surface[which][rows, 0], instant.force[which][rows]


def force_scale(shown: Sequence[Instant], height: float) -> tuple[float, float]:
    """mm per N at which the largest force is `height` [mm] high, and a round force [N] for the scale bar."""
    largest = max(float(np.abs(i.force[k]).max()) for i in shown for k in "LU")
    if largest == 0:
        return 1.0, 1.0
    decade = 10.0 ** np.floor(np.log10(largest))
    return height / largest, float(max(m * decade for m in (1, 2, 5) if m * decade <= largest))


class Scene:
    """The artists of one picture on `axes`; `show` moves them to another instant.

    `columns` is the spacing, in elements, of the vertical mesh lines; every layer is drawn. With `curves` = (mm per N,
    scale bar in N) the nodal forces stand outside the pads, normal force red with filled circles, friction blue.
    """

    def __init__(
        self, axes: Axes, model: SoftGrasp, *, columns: int = 5, curves: tuple[float, float] | None = None
    ) -> None:
        p = model.settings
        self.columns, self.curves = columns, curves
        self.plate = 2 * MM * p.bracket.cm_height
        self.offset = self.plate + 5.0
        length, radius = MM * p.pad.length, MM * p.disc.radius
        axes.add_patch(Rectangle((0, -self.plate), length, self.plate, facecolor=STEEL, edgecolor=INK, lw=0.6))
        self.bracket = Rectangle((0, 0), length, self.plate, facecolor=STEEL, edgecolor=INK, lw=0.6)
        self.outline = {k: Polygon(np.zeros((3, 2)), facecolor=PAD, edgecolor="none") for k in "LU"}
        self.layers = {k: LineCollection([], colors=LAYER, linewidths=0.5) for k in "LU"}
        self.disc = Circle((0, 0), radius, facecolor=DISC, edgecolor=INK, lw=1.0)
        for patch in (self.bracket, *self.outline.values()):
            axes.add_patch(patch)
        for lines in self.layers.values():
            axes.add_collection(lines, autolim=False)
        axes.add_patch(self.disc)
        (self.spoke,) = axes.plot([], [], color=INK, lw=1.6, solid_capstyle="butt")
        (self.hub,) = axes.plot([], [], "o", color=INK, ms=3)
        self.friction, self.normal = {}, {}
        if curves:
            for k in "LU":
                (self.friction[k],) = axes.plot([], [], color=FRICTION, lw=1.1)
                (self.normal[k],) = axes.plot([], [], color=NORMAL, lw=1.1, marker="o", ms=1.8)
        axes.set_aspect("equal")

    @property
    def moving(self) -> list[Artist]:
        """The artists that `show` changes, in drawing order."""
        curves = [*self.friction.values(), *self.normal.values()]
        return [self.bracket, *self.outline.values(), *self.layers.values(), self.disc, self.spoke, self.hub, *curves]

    def show(self, instant: Instant) -> None:
        """Put everything where it is at `instant`."""
        face = instant.mesh["U"][0, 0]
        self.bracket.set_xy((float(face[0]), float(face[1])))
        for k, mesh in instant.mesh.items():
            self.outline[k].set_xy(np.concatenate((mesh[:, 0], mesh[-1], mesh[::-1, -1], mesh[0, ::-1])))
            self.layers[k].set_segments([*mesh.swapaxes(0, 1), *mesh[:: self.columns], mesh[-1]])
        self.disc.center = (float(instant.centre[0]), float(instant.centre[1]))
        tip = instant.centre + self.disc.radius * np.array([-np.sin(instant.angle), np.cos(instant.angle)])
        self.spoke.set_data(*np.stack((instant.centre, tip), -1))
        self.hub.set_data(*instant.centre[:, None])
        if self.curves:
            for k, out in (("L", -1.0), ("U", 1.0)):
                x, force = around_contact(instant, k)
                foot = -self.offset if k == "L" else float(face[1]) + self.offset
                self.normal[k].set_data(x, foot + out * self.curves[0] * force[:, 0])
                self.friction[k].set_data(x, foot + out * self.curves[0] * force[:, 1])

    def scale_bar(self, axes: Axes, x: float, y: float) -> None:
        """A vertical bar at (x, y) [mm] as long as the scale's force."""
        assert self.curves
        millimetres, force = self.curves
        axes.plot([x, x], [y, y + millimetres * force], color=INK, lw=1.5, solid_capstyle="butt")
        axes.text(x - 2, y + 0.5 * millimetres * force, f"{force:g} N", ha="right", va="center", fontsize=8)


def span(model: SoftGrasp, height: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of x and y [mm] that hold the whole manipulation, with `height` [mm] of force curves above and below."""
    p = model.settings
    half = 0.5 * p.pad.length
    middles = (p.scenario.x_C0, p.scenario.x_C0 + 2 * p.scenario.travel)  # the bracket moves twice as far as the disc
    left, right = min(0.0, *middles, *(m - half for m in middles)), max(p.pad.length, *(m + half for m in middles))
    plate = 2 * p.bracket.cm_height
    top = 2 * (p.pad.height + p.disc.radius) + plate
    margin = height + 7.0
    return (MM * left - 4, MM * right + 4), (-MM * plate - margin, MM * top + margin)
