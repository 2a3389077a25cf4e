"""Pads: a mesh of a material, bonded to a base, condensed onto its surface or nodal.

Displacements are in the frame of the base, which turns with it. A condensed pad is linear and
massless: its state are the parts z_b (nodes, 2) [N] of its nodal forces that have set in, branch by
branch of its material's chain. A nodal pad, at finite strain or inertial, has the displacements of
its nodes, beside them those of its relaxing branches, and with inertia the nodes' velocities.
"""

from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any

import numpy as np
import torch
from scipy.sparse.linalg import SuperLU, splu
from scipy.special import ndtr
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from torchsoft.display import suggestion
from torchsoft.physics.arguments import number, tensor, whole
from torchsoft.physics.elements import element_energy, element_potential
from torchsoft.physics.hyperelastic import Hyperelastic, again, described, plane
from torchsoft.physics.material import Material
from torchsoft.physics.mesh import (
    Array,
    Index,
    Mesh,
    dofs_of,
    lame_moduli,
    unit_compliance,
)
from torchsoft.physics.mesh.element import (
    QUADRILATERAL,
    Element,
    element_constants,
    gradients,
)
from torchsoft.physics.shapes import parameter
from torchsoft.physics.state import StateBlock
from torchsoft.quantity import Length, Quantity, Ratio, check_declared, quantities

SAMPLES = 64
"""States whose elements are evaluated side by side."""


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # whoever asks first, others need graphs
def turned_compliance(mesh: Mesh, nu: float, axes: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """C of a mesh for E depth = 1 and its derivative by nu, turned from the pad's own axes into the
    base's."""
    R = np.array(axes).reshape(2, 2)

    def turned(blocks: Array) -> Tensor:
        n = len(blocks) // 2
        if R[0, 1] == R[1, 0] == 0.0:  # turned by nothing but a mirror
            signs = np.tile(np.diag(R), n)
            return torch.from_numpy(blocks * np.outer(signs, signs))
        out = np.einsum("ij,ajbk,lk->aibl", R, blocks.reshape(n, 2, n, 2), R)
        return torch.from_numpy(out.reshape(blocks.shape))

    C, dC = unit_compliance(mesh, nu)
    return turned(C), turned(dC)


class Pad(nn.Module):
    """`base` names the body that it is bonded to, None the ground; the mesh is mirrored if wanted
    (y upside down), turned by `angle` [rad] and put with its own origin, a corner or the left end
    of its base, at `origin` [m] in the base's frame.

    `points` contact points an element of the surface lie at Gauss places; 0 puts one on every node,
    as in the paper. `positions` are the undeformed places of the nodes in the state (nodes, 2) [m],
    `surface` numbers those on the surface. `E_ratio` and `tau_ratio` [1] make the pad differ from
    others of its material. Raises `ValueError` for a negative number of points.
    """

    positions: Tensor
    origin: Tensor
    surface: Tensor
    axes: Tensor

    def __init__(
        self, mesh: Mesh, material: Material, *, base: str | None = None,
        origin: tuple[float, float] = (0.0, 0.0), angle: float = 0.0, mirrored: bool = False,
        inertial: bool = False, points: int = 0,
        E_ratio: Annotated[Ratio, "Young's modulus over the material's"] | None = None,
        tau_ratio: Annotated[Ratio, "retardation times over the material's"] | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.points = whole("points", points, 0)
        self.E_ratio, self.tau_ratio = (
            None if ratio is None else parameter(ratio, name)
            for name, ratio in (("E_ratio", E_ratio), ("tau_ratio", tau_ratio))
        )
        self.mesh, self.material, self.base, self.inertial = mesh, material, base, inertial
        if self.nodal and mesh.element is not QUADRILATERAL:
            raise NotImplementedError(
                "a pad that is inertial or at finite strain needs a mesh of bilinear quadrilaterals"
            )
        kept = np.arange(len(mesh.free)) if self.nodal else mesh.surface
        self.angle, self.mirrored = float(angle), bool(mirrored)
        c, s = np.cos(angle), np.sin(angle)
        axes = np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if mirrored else 1.0])
        self.register_buffer("axes", torch.from_numpy(axes), persistent=False)
        self.register_buffer("origin", tensor("origin", origin).detach().clone(), persistent=False)
        self.register_buffer(
            "positions",
            torch.from_numpy(self.placed(mesh.nodes[mesh.free][kept])),
            persistent=False,
        )
        surface = mesh.surface if self.nodal else np.arange(len(kept))
        self.register_buffer("surface", torch.from_numpy(surface.copy()), persistent=False)
        self.point_nodes, self.point_shares, self.point_lengths = contact_points(mesh, points)
        interpolation = shape_functions(surface[self.point_nodes], self.point_shares, len(kept))
        self.register_buffer("interpolation", torch.from_numpy(interpolation), persistent=False)

    def remeshed(self, finer: int, points: int) -> "Pad":
        """The same pad of `finer` times as many elements each way, with so many contact points an
        element."""
        return self._again(self.mesh.refined(finer), self.material, self.inertial, points)

    def condensed(self) -> "Pad":
        """The same pad, linear and without inertia."""
        material = self.material
        linear = material.linear() if isinstance(material, Hyperelastic) else material
        return self._again(self.mesh, linear, False, self.points)

    def made_of(self, material: Material) -> "Pad":
        """The same pad of another material."""
        return self._again(self.mesh, material, self.inertial, self.points)

    def reshaped(self, mesh: Mesh, origin: Array, turn: float = 0.0) -> "Pad":
        """The same pad on another mesh, its origin (2,) [m] elsewhere, and turned further [rad]."""
        return self._again(mesh, self.material, self.inertial, self.points, origin, turn)

    def _again(
        self, mesh: Mesh, material: Material, inertial: bool, points: int,
        origin: Array | None = None, turn: float = 0.0,
    ) -> "Pad":  # fmt: skip
        x, y = self.origin.tolist() if origin is None else origin
        pad = Pad(
            mesh, material, base=self.base, origin=(float(x), float(y)), angle=self.angle + turn,
            mirrored=self.mirrored, inertial=inertial, points=points,
        )  # fmt: skip
        pad.E_ratio, pad.tau_ratio = self.E_ratio, self.tau_ratio
        return pad

    def described(self) -> dict[str, Any]:
        """Numbers and names of the pad as it is now, for files; not its mesh. Of a custom
        material only the small strains of the relaxed one are known."""
        settings = {name: getattr(self, name) for name in ("base", "angle", "mirrored", "inertial")}
        ratios = {name: getattr(self, name) for name in ("E_ratio", "tau_ratio")}
        known = {name: None if one is None else one.item() for name, one in ratios.items()}
        material = None if len(self.material.added) else described(self.material)
        if material is None:
            relaxed = {name: getattr(self.material, name).item() for name in RELAXED}
            material = {"kind": None, "finite": isinstance(self.material, Hyperelastic), **relaxed}
        origin = self.origin.tolist()
        return {**settings, **known, "points": self.points, "origin": origin, "material": material}

    @classmethod
    def again(cls, described: Mapping[str, Any], mesh: Mesh) -> "Pad":
        """The pad that was `described`, on its mesh."""
        known = described["material"]
        if known["kind"] is not None:
            material = again(known)
        elif known["finite"]:
            material = Hyperelastic(known["E"], known["nu"], known["rho"], 1.0, known["depth"])
        else:
            material = Material(*(known[name] for name in RELAXED))
        return cls(mesh, **{**described, "material": material})

    @property
    def E(self) -> Tensor:
        """Relaxed Young's modulus [Pa]."""
        return self.material.E if self.E_ratio is None else self.E_ratio * self.material.E

    def chain(self) -> tuple[Tensor, Tensor]:
        """Fractions J [1] and retardation times tau [s], shape (branches,) each."""
        fractions, times = self.material.whole_chain()
        return fractions, times if self.tau_ratio is None else self.tau_ratio * times

    @property
    def branches(self) -> int:
        """Kelvin elements of the chain."""
        return self.material.branches + len(self.material.added)

    interpolation: Tensor
    """Shape functions of the nodes in the state at the contact points (points, nodes)."""

    def at_points(self, x: Tensor) -> Tensor:
        """Nodal vectors (..., nodes, 2) at the contact points (..., points, 2)."""
        return x[..., self.surface, :] if self.points == 0 else self.interpolation @ x

    @property
    def nodes(self) -> int:
        return len(self.positions)

    @property
    def state_shape(self) -> tuple[int, ...]:
        """Shape of the pad's part of the state: displacements of all fields (nodes, 2 fields), or
        forces that have set in (branches, nodes, 2)."""
        return (self.nodes, 2 * self.fields) if self.nodal else (self.branches, self.nodes, 2)

    def blocks(self, name: str) -> list[StateBlock]:
        """States of the pad called `name`: forces or displacements, and rates of one with
        inertia."""
        block = StateBlock.of("pads", name, self.state_shape, "m" if self.nodal else "N")
        rates = StateBlock.of("rates", name, (self.nodes, 2), "m/s")
        return [block, rates] if self.inertial else [block]

    @property
    def fields(self) -> int:
        """Displacements of a nodal pad's nodes: their own, and those of every relaxing branch."""
        return self.branches if isinstance(self.material, Hyperelastic) else 1

    def placed(self, places: Array) -> Array:
        """Places (..., 2) in the base's frame of `places` in the pad's own."""
        return places @ self.axes.numpy().T + self.origin.numpy()

    @property
    def space(self) -> Array:
        """Least and largest coordinates (2, 2) [m] in the base's frame between which the centre of
        a body must be to touch the pad."""
        corners = self.placed(np.stack(np.meshgrid(*self.mesh.space.T), -1).reshape(-1, 2))
        return np.stack((corners.min(0), corners.max(0)))

    @property
    def point_positions(self) -> Tensor:
        """Undeformed places of the contact points in the base's frame (points, 2) [m]."""
        return self.interpolation @ self.positions

    @property
    def point_coordinates(self) -> Array:
        """Coordinates of the contact points along the undeformed surface, from its middle
        (points,) [m]."""
        face = self.mesh.face
        way = np.linalg.norm(np.diff(self.mesh.nodes[face], axis=0), axis=1).cumsum()
        along = np.concatenate(([0.0], way)) - 0.5 * way[-1]
        nodes = along[~self.mesh.bonded[face]]
        return (self.point_shares * nodes[self.point_nodes]).sum(-1)

    def unit_compliance(self) -> tuple[Tensor, Tensor]:
        """C for E depth = 1 and its derivative by nu, at the material's own nu, in the base's
        frame. Shared between calls; not to be written to."""
        axes = tuple(self.axes.flatten().tolist())
        return turned_compliance(self.mesh, self.material.nu.item(), axes)

    def compliance(self) -> Tensor:
        """Static displacement of the surface nodes per force on them [m/N], (2 surface, 2 surface):
        (K^-1)_ss.

        Proportional to 1 / (E depth); its derivative by nu is exact to first order (a second
        derivative comes out as zero).
        """
        C, dC = self.unit_compliance()
        material = self.material
        if material.nu.requires_grad and torch.is_grad_enabled():
            C = C + dC * (material.nu - material.nu.detach())
        return C / (self.E * material.depth)

    def check_chain(self, name: str) -> None:
        """Raises `NotImplementedError` naming the nodal pad for a material with several retardation
        times, unless it is massless and at finite strain with branches of its own."""
        count = self.branches if self.inertial else 1 + len(self.material.added)
        if self.nodal and count != 1:
            raise NotImplementedError(
                f"the pad `{name}` needs a material of one retardation time, being "
                f"{'inertial' if self.inertial else 'at finite strain'}, but has {count}; "
                "take a massless pad of a linear material"
            )

    def bond_elements(self, name: str) -> tuple[str, ...]:
        """The pad of this name in the multibond graph: a C and an R field, those of all Kelvin
        elements of its chain, or of its strain energy W."""
        if isinstance(self.material, Hyperelastic):
            indices = name if self.fields == 1 else f"{name},0..{self.fields - 1}"
            return f"C: W_{indices}", f"R: R_{indices}"
        indices = name if self.branches == 1 else f"{name},1..{self.branches}"
        return f"C: [K_{indices}]^-1", f"R: [R_{indices}]"

    def masses(self) -> Tensor:
        """Lumped mass of each node that moves [kg], (nodes,); the bonded nodes' masses are left
        out, as in the paper."""
        return (
            self.material.rho
            * self.material.depth
            * torch.from_numpy(self.mesh.areas[self.mesh.free])
        )

    def factors(self) -> Tensor:
        """Numbers (4 + 2 branches,) of the elements besides the material's energy, as
        `element_potentials` has them."""
        material, branches = self.material, list[tuple[Tensor, Tensor]]()
        if isinstance(material, Hyperelastic):
            tau, branches = material.tau, material.relaxation()
        else:
            tau = material.chain()[1][0]
        if self.tau_ratio is not None:
            tau, branches = self.tau_ratio * tau, [(m, self.tau_ratio * t) for m, t in branches]
        depth = material.depth if self.E_ratio is None else self.E_ratio * material.depth
        arms = [number for branch in branches for number in branch]
        return torch.stack((depth, tau, *lame_moduli(material.E, material.nu), *arms))

    def at_corners(self, x: Tensor) -> Tensor:
        """Nodal vectors (..., nodes, 2 fields) at the corners of the elements (..., elements, 8
        fields), field by field, zero where they are bonded."""
        held, dofs = torch.from_numpy(self.corners < 0), torch.from_numpy(self.corners.clip(0))
        fields = [torch.where(held, 0.0, one.flatten(-2)[..., dofs]) for one in x.split(2, -1)]
        return fields[0] if len(fields) == 1 else torch.cat(fields, -1)

    def from_corners(self, f: Tensor) -> Tensor:
        """Sum (..., nodes, 2) of vectors at the corners of the elements (..., elements, 8)."""
        held, dofs = torch.from_numpy(self.corners < 0), torch.from_numpy(self.corners.clip(0))
        total = f.new_zeros(*f.shape[:-2], 2 * self.nodes)
        values = torch.where(held, 0.0, f).flatten(-2)
        return total.index_add(-1, dofs.flatten(), values).unflatten(-1, (-1, 2))

    def element_inputs(self, u: Tensor, rate: Tensor) -> tuple[Material, Tensor, Tensor]:
        """Arguments of the laws of a nodal pad's elements, with displacements and rates (...,
        elements, 8 fields) at their corners; without those of branches these have relaxed."""
        constants = torch.from_numpy(self.constants).expand(*u.shape[:-1], -1)
        inputs = torch.cat((u, rate, constants), -1)
        return self.material, self.factors(), inputs

    def element_forces(self, u: Tensor, rate: Tensor | None = None) -> Tensor:
        """Forces (..., elements, 8 fields) [N] on the corners of a nodal pad's elements, by default
        at rest."""
        u, velocity = torch.broadcast_tensors(u, torch.zeros_like(u) if rate is None else rate)
        recorded = torch.is_grad_enabled()
        with torch.enable_grad():
            if not (recorded and u.requires_grad):
                u = u.detach().requires_grad_()
            if not (recorded and velocity.requires_grad):
                velocity = velocity.detach().requires_grad_()
            given = self.element_inputs(u, velocity)
            energy = element_energy(*given).sum()
            (force,) = torch.autograd.grad(energy, u, create_graph=recorded, retain_graph=True)
            if rate is not None:
                potential = element_potential(*given).sum()
                (viscous,) = torch.autograd.grad(potential, velocity, create_graph=recorded)
                force = force + viscous
        return force

    def internal_force(self, u: Tensor, rate: Tensor) -> Tensor:
        """Forces of an inertial pad (..., nodes, 2) [N] at displacements u (..., nodes, 2) [m] and
        their rates [m/s]."""
        return self.from_corners(self.element_forces(self.at_corners(u), self.at_corners(rate)))

    def strain_energy(self, part: Tensor, displacement: Tensor | None = None) -> Tensor:
        """Energy (...) [J] in a state: `part` of a nodal pad are displacements u (..., nodes, 2
        fields) [m], of a condensed one nodal forces that have set in (..., branches, nodes, 2) [N],
        with one branch those times the `displacement` (..., nodes, 2), if it is known. The graph of
        nodal pads is made when it is asked for, some samples at a time: that of a long run would
        not fit."""
        if not self.nodal:
            fractions, _ = self.chain()
            if displacement is not None and len(fractions) == 1:
                return 0.5 * (part[..., 0, :, :] * displacement).sum((-2, -1))
            z = part.flatten(-2)
            return 0.5 * (fractions * ((z @ self.compliance()) * z).sum(-1)).sum(-1)

        def energy_of(u: Tensor) -> Tensor:
            at = self.at_corners(u)
            return element_energy(*self.element_inputs(at, torch.zeros_like(at))).sum(-1)

        parts = part.reshape(-1, *part.shape[-2:]).split(SAMPLES)
        energy = [checkpoint(energy_of, one, use_reentrant=False) for one in parts]
        return torch.cat(energy).reshape(part.shape[:-2])

    def dissipation(self, part: Tensor, given: Tensor) -> Tensor:
        """Power (...) [W] that the pad takes out in a state, as in `strain_energy`; `given` of a
        nodal pad are rates (..., nodes, 2 fields) [m/s], of a condensed one forces (..., nodes, 2)
        [N] on its nodes."""
        if not self.nodal:
            fractions, times = self.chain()
            rate = ((given[..., None, :, :] - part) / times[:, None, None]).flatten(-2)
            return (fractions * times * ((rate @ self.compliance()) * rate).sum(-1)).sum(-1)
        inputs = self.element_inputs(self.at_corners(part), self.at_corners(given))
        return 2 * element_potential(*inputs).sum(-1)

    @property
    def nodal(self) -> bool:
        """Whether the state holds the displacements of all nodes, and not those of the surface
        alone."""
        return self.inertial or isinstance(self.material, Hyperelastic)

    @cached_property
    def corners(self) -> Index:
        """Dofs of the nodes of every element (elements, dofs), -1 where they are bonded."""
        number = np.full(len(self.mesh.nodes), -1)
        number[self.mesh.free] = np.arange(len(self.mesh.free))
        node = number[self.mesh.elements]
        dofs = np.stack((2 * node, 2 * node + 1), -1).reshape(len(node), -1)
        return np.where(dofs < 0, -1, dofs)

    @property
    def constants(self) -> Array:
        """Constants of every element (elements, constants) in the base's frame."""
        return constants_of(
            self.mesh.element, self.placed(self.mesh.nodes[self.mesh.elements]).tobytes()
        )

    # Fields inside of the pad, (..., mesh nodes or elements, components), in the pad's own axes.

    def displacement(self, u: Array) -> Array:
        """Displacements of all nodes of the mesh (..., mesh nodes, 2) [m], bonded ones too.

        u (..., nodes, 2) [m]: displacements as a run records them, in the base's frame. A massless
        pad has only its surface there; the interior is in equilibrium with it, u_i = -K_ii^-1 K_is
        u_s.
        """
        mesh = self.mesh
        local = (u.reshape(-1, *u.shape[-2:]) @ self.axes.numpy()).reshape(-1, 2 * u.shape[-2])
        free = np.zeros((len(local), 2 * len(mesh.free)))
        if self.nodal:
            free[:] = local
        else:
            factor, interior, K_is = interior_solver(mesh, self.material.nu.item())
            free[:, dofs_of(mesh.surface)] = local
            free[:, interior] = -factor.solve(K_is @ local.T).T
        out = np.zeros((len(local), len(mesh.nodes), 2))
        out[:, mesh.free] = free.reshape(len(local), -1, 2)
        return out.reshape(*u.shape[:-2], -1, 2)

    def surface_points(self, u: Array) -> Array:
        """Places (..., points, 2) [m] of the contact points in the frame of the base, of
        displacements u (..., nodes, 2) [m] as a run records them."""
        return (self.interpolation @ (self.positions + torch.from_numpy(u))).numpy()

    def gradient(self, displacement: Array) -> Array:
        """F (..., elements, 2, 2) at the centres of the elements, of displacements of all nodes."""
        nodes = displacement[..., self.mesh.elements, :]
        return np.eye(2) + np.einsum("eki,...ekj->...eji", slopes(self.mesh), nodes)

    def strain(self, displacement: Array) -> Array:
        """Strains (e_xx, e_yy, e_xy) at the centres of the elements (..., elements, 3), of
        displacements of all nodes; of a pad at finite strain they are U - 1, F = R U."""
        F = self.gradient(displacement)
        U = 0.5 * (F + np.swapaxes(F, -1, -2))
        if isinstance(self.material, Hyperelastic):
            C, J = np.swapaxes(F, -1, -2) @ F, np.linalg.det(F)
            U = (C + J[..., None, None] * np.eye(2)) / np.sqrt(
                np.trace(C, axis1=-2, axis2=-1) + 2 * J
            )[..., None, None]
        return np.stack((U[..., 0, 0] - 1, U[..., 1, 1] - 1, U[..., 0, 1]), -1)

    def largest_strain(self, u: Array) -> Array:
        """Largest principal strain (...) at the centres of the elements, by its modulus, of
        displacements u (..., nodes, 2) [m] as a run records them."""
        e = self.strain(self.displacement(u))
        mean, half = 0.5 * (e[..., 0] + e[..., 1]), 0.5 * (e[..., 0] - e[..., 1])
        return (np.abs(mean) + np.hypot(half, e[..., 2])).max(-1)

    @torch.inference_mode(False)
    def stress(self, displacement: Array) -> Array:
        """Elastic stresses (s_xx, s_yy, s_zz, s_xy) [Pa] (..., elements, 4) of the relaxed material
        in plane strain, at the centres of the elements, of displacements of all nodes; Cauchy's of
        a pad at finite strain, P F^T / det F of the first Piola-Kirchhoff stress P = dW/dF. The
        part that the dashpots carry is not in them.

        Raises `ValueError` for a custom energy, which runs do not hold.
        """
        ratio = 1.0 if self.E_ratio is None else self.E_ratio.item()
        if not isinstance(self.material, Hyperelastic):
            strain = self.strain(displacement)
            moduli = ratio * self.material.E.item(), self.material.nu.item()
            lame_lambda, lame_mu = lame_moduli(*moduli)
            mean = lame_lambda * (strain[..., 0] + strain[..., 1])
            parts = [mean + 2 * lame_mu * strain[..., i] for i in (0, 1)]
            return np.stack((*parts, mean, 2 * lame_mu * strain[..., 2]), -1)
        if type(self.material) is Hyperelastic:
            raise ValueError(
                "the strain energy of the pad is one of your own, which runs do not hold, so that "
                "its stresses are not known; plot something else"
            )
        F = plane(torch.from_numpy(self.gradient(displacement)))
        with torch.enable_grad():
            W = self.material.energy(F.requires_grad_()).sum()
            (P,) = torch.autograd.grad(W, F)
        stress = ratio * (P @ F.detach().mT / F.detach().det()[..., None, None]).numpy()
        return np.stack([stress[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1))], -1)


RELAXED = ("E", "nu", "rho", "depth")
"""Numbers that files keep of a custom material."""


def von_mises(stress: Array) -> Array:
    """Von Mises' equivalent stress [Pa] (...) of stresses (..., 4)."""
    xx, yy, zz, xy = (stress[..., i] for i in range(4))
    return np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * xy**2)


@lru_cache(maxsize=8)
def interior_solver(mesh: Mesh, nu: float) -> tuple[SuperLU, Index, Array]:
    """Factorised K_ii, the free dofs that are interior, and K_is (dense), for the surface dofs in
    `mesh.surface` order.

    The interior's displacement depends on the surface's only, for any E and depth; both are 1.
    """
    K, surface = mesh.stiffness(*lame_moduli(1.0, nu)).tocsc(), dofs_of(mesh.surface)
    interior = np.setdiff1d(np.arange(2 * len(mesh.free)), surface)
    return splu(K[interior][:, interior]), interior, K[interior][:, surface].toarray()


@lru_cache(maxsize=8)
def slopes(mesh: Mesh) -> Array:
    """Gradients (elements, nodes, 2) [1/m] of the shape functions at the elements' centres."""
    return gradients(mesh.element, mesh.nodes[mesh.elements], 0.0, 0.0)[0]


@lru_cache(maxsize=8)
def constants_of(element: Element, nodes: bytes) -> Array:
    """Constants of elements with nodes (elements, nodes, 2) [m]."""
    return element_constants(element, np.frombuffer(nodes).reshape(-1, element.nodes, 2))


def shape_functions(nodes: Any, shares: Array, count: int) -> Array:
    """Shape functions of `count` nodes at points (points, count), from the nodes of every point
    (points, side) and those of these."""
    out = np.zeros((len(nodes), count))
    np.add.at(out, (np.arange(len(nodes))[:, None], nodes), shares)
    return out


def contact_points(mesh: Mesh, points: int) -> tuple[Any, Array, Array]:
    """Surface nodes of every contact point (points, side), their shape functions there, and the
    length of surface that the point stands for [m]."""
    count, side = len(mesh.surface), mesh.element.side
    if points == 0:
        nodes = np.tile(np.arange(count)[:, None], side)
        return nodes, np.tile(np.eye(side)[0], (count, 1)), mesh.tributary
    sides = np.arange(0, count - 1, side - 1)[:, None] + np.arange(side)  # (sides, side)
    places, shares, lengths = mesh.nodes[mesh.free[mesh.surface]][sides], [], []
    for xi, weight in zip(*np.polynomial.legendre.leggauss(points)):
        functions, slopes = mesh.element.functions(xi, -1.0)
        shares.append(functions[:side])
        lengths.append(weight * np.linalg.norm(slopes[:side, 0] @ places, axis=-1))
    nodes = np.repeat(sides, points, 0)
    return nodes, np.tile(shares, (len(sides), 1)), np.stack(lengths, -1).ravel()


# Massless pads: the relation between nodal forces and rates.
#
# Rates are u' = free + P F with P = C sum of J / (tau + a h) and free = -C sum of J z / (tau + a
# h); `stage` = a h is zero for the ODE itself. Static displacements are u = C F.


def free_rates(pad: Pad, z: Tensor, stage: float) -> tuple[Tensor, Tensor]:
    """Rates of a massless pad's nodes without contact (..., nodes, 2) [m/s] and its mobility P
    [m/(N.s)], for the forces z (..., branches, nodes, 2) that have set in at the stage's start."""
    fractions, times = pad.chain()
    C, rest = pad.compliance(), fractions / (times + stage)
    return -under_forces(C, (rest[:, None, None] * z).sum(-3)), rest.sum() * C


def under_forces(A: Tensor, F: Tensor) -> Tensor:
    """Displacements or rates A F (..., nodes, 2) of nodes under forces F (..., nodes, 2), A being
    their compliance or mobility (2 nodes, 2 nodes)."""
    return (F.flatten(-2) @ A.mT).unflatten(-1, (-1, 2))


# Taxels: an array of sensitive areas on the surface of a pad.


@dataclass(frozen=True)
class Taxels:
    """Areas of `width` [m] along the undeformed surface of the pad called `pad`.

    `count` of them lie side by side around the surface's middle; or `centres` [m] are the
    coordinates of their middles along the surface, from its middle. Each takes the part of a force
    that a Gaussian of standard deviation `spread` [m] about the place of that force has inside the
    area. Without a spread a force belongs to the area that it acts on, by halves at an edge.
    Raises `ValueError` unless one of count and centres is given, and for numbers out of range.
    """

    pad: Annotated[str, "name of one of the pads"]
    width: Annotated[Length, "width of a taxel along the surface"]
    _: KW_ONLY
    count: Annotated[int | None, "number of taxels, side by side around the middle"] = None
    centres: Annotated[
        Iterable[float], Quantity("m", -100.0, 100.0, "middles along the surface, from its middle")
    ] = ()
    spread: Annotated[
        float, Quantity("m", 0.0, 1.0, "standard deviation of the place where a force is felt")
    ] = 0.0

    def __post_init__(self) -> None:
        for name, given in (
            ("centres", self.centres),
            ("width", [self.width]),
            ("spread", [self.spread]),
        ):
            found = tuple(number(name, one) for one in given)
            object.__setattr__(self, name, found if name == "centres" else found[0])
        if (self.count is None) == (self.centres == ()):
            raise ValueError("taxels need a `count` or their `centres`, and not both")
        if self.count is not None:
            whole("count", self.count, 1)
        check_declared(self, *quantities(type(self)))

    @cached_property
    def places(self) -> Array:
        """Coordinates of the middles along the surface (taxels,) [m]."""
        if self.count is None:
            return np.array(self.centres)
        return (np.arange(float(self.count)) - 0.5 * (self.count - 1)) * self.width

    def weights(self, pad: Pad) -> Array:
        """Part of a force at every contact point of the pad that each taxel takes (taxels,
        points)."""
        off = self.places[:, None] - pad.point_coordinates
        left, right = (np.round(off + side * self.width, 12) for side in (0.5, -0.5))
        if self.spread == 0.0:
            return 0.5 * (np.sign(left) - np.sign(right))
        return ndtr(left / self.spread) - ndtr(right / self.spread)


def check_taxels(
    taxels: Mapping[str, Taxels], pads: Mapping[str, Pad], contacts: Iterable[str]
) -> None:
    """Raises `ValueError` for taxels on no pad, and for those that are called like a contact."""
    for name, one in taxels.items():
        if one.pad not in pads:
            raise ValueError(
                f"taxels.{name}: they lie on `{one.pad}`, "
                f"{suggestion(one.pad, pads, 'but the pads are')}"
            )
        if name in contacts:
            raise ValueError(
                f"taxels.{name}: a contact is called `{name}` too, whose forces have the same "
                "names; call one of them otherwise"
            )
