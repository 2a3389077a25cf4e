"""Geometry and parts of a run: meshes, outlines, contacts and actuators as they were, in plain
numbers that files and pictures take; and the fields inside of pads, from their own elements."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from torchsoft.physics.channels import declared
from torchsoft.physics.hyperelastic import Hyperelastic, again, described, plane
from torchsoft.physics.mesh import Array, Mesh, StoredMesh, dofs_of, lame_moduli
from torchsoft.physics.mesh.mesh import gradients, strains
from torchsoft.physics.names import effort_channel
from torchsoft.physics.pads import Pad, contact_points, shape_functions
from torchsoft.physics.rig import Rig


@lru_cache(maxsize=8)
def interior_solver(mesh: Mesh, nu: float) -> tuple[SuperLU, NDArray[np.int64], Array]:
    """Factorised K_ii, the free dofs that are interior, and K_is (dense), for the surface dofs in
    `mesh.surface` order.

    The interior's displacement depends on the surface's only, for any E and depth; both are 1.
    """
    K, surface = mesh.stiffness(*lame_moduli(1.0, nu)).tocsc(), dofs_of(mesh.surface)
    interior = np.setdiff1d(np.arange(2 * len(mesh.free)), surface)
    return splu(K[interior][:, interior]), interior, K[interior][:, surface].toarray()


@lru_cache(maxsize=8)
def strain_operator(mesh: Mesh) -> Array:
    """B (elements, 3, 8): (e_xx, e_yy, 2 e_xy) at the centres of the elements."""
    return strains(gradients(mesh.nodes[mesh.elements], 0.0, 0.0)[1])


@lru_cache(maxsize=8)
def slopes(mesh: Mesh) -> Array:
    """Gradients (elements, 4, 2) [1/m] of the shape functions at the centres of the elements."""
    return gradients(mesh.nodes[mesh.elements], 0.0, 0.0)[1]


@dataclass(frozen=True)
class PadSetup:
    """A pad as it was: its mesh, own axes (2, 2) and origin [m] in the frame of its base (a body's
    name, or the ground), relaxed modulus E [Pa], nu and depth [m], contact points an element; of
    one at finite strain its energy, a kind with its numbers, None for one of the user's own.

    Fields are (..., mesh nodes or elements, components), in the pad's own axes.
    """

    mesh: Mesh
    axes: Array
    origin: Array
    base: str | None
    inertial: bool
    points: int
    E: float
    nu: float
    depth: float
    finite: bool = False
    energy: dict[str, Any] | None = None

    @classmethod
    def of(cls, pad: Pad) -> Self:
        """A pad as it is now."""
        material = pad.material
        finite = isinstance(material, Hyperelastic)
        E, nu, depth = (getattr(material, x).item() for x in ("E", "nu", "depth"))
        return cls(
            pad.mesh, pad.axes.numpy(), pad.origin.numpy(), pad.base, pad.inertial, pad.points,
            E, nu, depth, finite, described(material) if finite else None,
        )  # fmt: skip

    @property
    def nodal(self) -> bool:
        """Whether a run records the displacements of all nodes."""
        return self.inertial or self.finite

    def placed(self, own: Array) -> Array:
        """Places (..., 2) in the pad's own frame, in the base's."""
        return own @ self.axes.T + self.origin

    @cached_property
    def spread(self) -> Array:
        """Shape functions of the surface nodes at the contact points (points, surface nodes)."""
        nodes, shares, _ = contact_points(self.mesh, self.points)
        return shape_functions(nodes, shares, len(self.mesh.surface))

    @cached_property
    def lengths(self) -> Array:
        """Lengths of surface [m] that the contact points stand for (points,)."""
        return np.asarray(contact_points(self.mesh, self.points)[2])

    def displacement(self, u: Array) -> Array:
        """Displacements of all nodes of the mesh (..., mesh nodes, 2) [m], bonded ones too.

        u (..., nodes, 2) [m]: displacements as a run records them, in the base's frame. A massless
        pad has only its surface there; the interior is in equilibrium with it, u_i = -K_ii^-1 K_is
        u_s.
        """
        mesh = self.mesh
        own = (u.reshape(-1, *u.shape[-2:]) @ self.axes).reshape(-1, 2 * u.shape[-2])
        free = np.zeros((len(own), 2 * len(mesh.free)))
        if self.nodal:
            free[:] = own
        else:
            factor, interior, K_is = interior_solver(mesh, self.nu)
            free[:, dofs_of(mesh.surface)] = own
            free[:, interior] = -factor.solve(K_is @ own.T).T
        out = np.zeros((len(own), len(mesh.nodes), 2))
        out[:, mesh.free] = free.reshape(len(own), -1, 2)
        return out.reshape(*u.shape[:-2], -1, 2)

    def surface_points(self, u: Array) -> Array:
        """Places (..., points, 2) [m] of the contact points in the frame of the base."""
        own = u[..., self.mesh.surface, :] if self.nodal else u
        nodes = self.placed(self.mesh.nodes[self.mesh.free[self.mesh.surface]]) + own
        return self.spread @ nodes

    def strain(self, displacement: Array) -> Array:
        """Strains (e_xx, e_yy, e_xy) at the centres of the elements (..., elements, 3), of
        displacements of all nodes; of a pad at finite strain they are U - 1, F = R U."""
        if self.finite:
            F = self.gradient(displacement)
            C = np.swapaxes(F, -1, -2) @ F
            J = np.linalg.det(F)
            U = (C + J[..., None, None] * np.eye(2)) / np.sqrt(
                np.trace(C, axis1=-2, axis2=-1) + 2 * J
            )[..., None, None]
            return np.stack((U[..., 0, 0] - 1, U[..., 1, 1] - 1, U[..., 0, 1]), -1)
        nodes = displacement[..., self.mesh.elements, :]
        flat = nodes.reshape(*nodes.shape[:-2], 8)
        return np.einsum("eij,...ej->...ei", strain_operator(self.mesh), flat) * [1.0, 1.0, 0.5]

    def gradient(self, displacement: Array) -> Array:
        """F (..., elements, 2, 2) at the centres of the elements."""
        nodes = displacement[..., self.mesh.elements, :]
        return np.eye(2) + np.einsum("eki,...ekj->...eji", slopes(self.mesh), nodes)

    def largest_strain(self, u: Array) -> Array:
        """Largest principal strain (...) at the centres of the elements, by its modulus, of
        displacements u (..., nodes, 2) [m] as a run records them."""
        e = self.strain(self.displacement(u))
        mean, half = 0.5 * (e[..., 0] + e[..., 1]), 0.5 * (e[..., 0] - e[..., 1])
        return (np.abs(mean) + np.hypot(half, e[..., 2])).max(-1)

    def stress(self, displacement: Array) -> Array:
        """Elastic stresses (s_xx, s_yy, s_zz, s_xy) [Pa] (..., elements, 4) of the relaxed material
        in plane strain, at the centres of the elements, of displacements of all nodes; Cauchy's of
        a pad at finite strain. The part that the dashpots carry is not in them.

        Raises `ValueError` for an energy of the user's own, which a file does not hold.
        """
        if self.finite:
            return self._cauchy_stress(self.gradient(displacement))
        strain = self.strain(displacement)
        lame_lambda, lame_mu = lame_moduli(self.E, self.nu)
        mean = lame_lambda * (strain[..., 0] + strain[..., 1])
        parts = [mean + 2 * lame_mu * strain[..., i] for i in (0, 1)]
        return np.stack((*parts, mean, 2 * lame_mu * strain[..., 2]), -1)

    @torch.inference_mode(False)
    def _cauchy_stress(self, F: Array) -> Array:
        """P F^T / det F of the first Piola-Kirchhoff stress P = dW/dF."""
        if self.energy is None:
            raise ValueError(
                "the strain energy of the pad is one of your own, which runs do not hold, so that "
                "its stresses are not known; plot something else"
            )
        whole = plane(torch.from_numpy(F))
        with torch.enable_grad():
            W = again(self.energy).energy(whole.requires_grad_()).sum()
            (P,) = torch.autograd.grad(W, whole)
        stress = (P @ whole.detach().mT).numpy() / np.linalg.det(F)[..., None, None]
        places = ((0, 0), (1, 1), (2, 2), (0, 1))
        return np.stack([stress[..., i, j] for i, j in places], -1)


def von_mises(stress: Array) -> Array:
    """Von Mises' equivalent stress [Pa] (...) of stresses (..., 4)."""
    xx, yy, zz, xy = (stress[..., i] for i in range(4))
    return np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * xy**2)


@dataclass(frozen=True)
class BodySetup:
    """A body as it was: its outline (points, 2) [m] about its centre, None where nothing touches
    it, how each of its coordinates was free, and the channel that it is."""

    outline: Array | None
    freedom: dict[str, str]
    channels: dict[str, str]

    @property
    def size(self) -> float:
        """Largest distance of the outline from the centre [m]; 0 without one."""
        return 0.0 if self.outline is None else float(np.linalg.norm(self.outline, axis=1).max())


@dataclass(frozen=True)
class ContactSetup:
    """A contact: its pad, its body, and the coefficients of friction that its law has, by name."""

    pad: str
    body: str
    friction: dict[str, float]


@dataclass(frozen=True)
class ActuatorSetup:
    """An actuator: the coordinate that it pushes, its channel, the unit of its effort, and the
    set-points that coordinates follow, by coordinate."""

    pushes: str
    channel: str
    unit: str
    follows: dict[str, str]


@dataclass(frozen=True)
class Setup:
    """Bodies, pads, contacts and actuators as a run had them, and short names and meanings of
    channels."""

    bodies: dict[str, BodySetup] = field(default_factory=dict)
    pads: dict[str, PadSetup] = field(default_factory=dict)
    contacts: dict[str, ContactSetup] = field(default_factory=dict)
    actuators: dict[str, ActuatorSetup] = field(default_factory=dict)
    short: dict[str, str] = field(default_factory=dict)
    meanings: dict[str, str] = field(default_factory=dict)

    @classmethod
    @torch.inference_mode(False)  # outlines need torch's graphs
    @torch.no_grad()
    def of(cls, rig: Rig) -> Self:
        """A rig as it is now."""
        return cls(
            bodies={
                name: BodySetup(
                    None if body.shape is None else body.shape.outline().detach().numpy().copy(),
                    dict(body.freedom),
                    {axis: f"{axis}_{rig.symbols[name]}" for axis in body.freedom},
                )
                for name, body in rig.bodies.items()
            },
            pads={name: PadSetup.of(pad) for name, pad in rig.pads.items()},
            contacts={
                name: ContactSetup(
                    contact.pad, contact.body,
                    {
                        mu: float(value)
                        for mu in ("mu_s", "mu_k")
                        for value in [getattr(contact.law.friction, mu, None)]
                        if isinstance(value, torch.Tensor)
                    },
                )
                for name, contact in rig.contacts.items()
            },
            actuators={
                name: ActuatorSetup(
                    one.pushes, effort_channel(name), one.effort_unit,
                    {at: signal for at, signal in one.follows if signal != one.feed_forward},
                )
                for name, one in rig.actuators.items()
            },
            short=dict(rig.short), meanings={one.name: one.meaning for one in declared(rig)},
        )  # fmt: skip

    def plain(self) -> dict[str, Any]:
        """Everything but arrays, for JSON."""

        def rest(part: Any, without: tuple[str, ...] = ()) -> dict[str, Any]:
            return {
                name: x.tolist() if isinstance(x, np.ndarray) else x
                for name, x in vars(part).items()
                if name in part.__dataclass_fields__ and name not in without
            }

        return {
            "bodies": {name: rest(one, ("outline",)) for name, one in self.bodies.items()},
            "pads": {name: rest(one, ("mesh",)) for name, one in self.pads.items()},
            "contacts": {name: rest(one) for name, one in self.contacts.items()},
            "actuators": {name: rest(one) for name, one in self.actuators.items()},
            "short": self.short,
            "meanings": self.meanings,
        }

    @classmethod
    def again(
        cls, plain: dict[str, Any], outlines: dict[str, Array], meshes: dict[str, StoredMesh]
    ) -> Self:
        """The setup of `plain` and its arrays."""
        pads = {}
        for name, one in plain["pads"].items():
            arrays = {key: np.array(one[key]) for key in ("axes", "origin")}
            pads[name] = PadSetup(**one | arrays | {"mesh": meshes[name]})
        return cls(
            {
                name: BodySetup(outline=outlines.get(name), **one)
                for name, one in plain["bodies"].items()
            },
            pads,
            {name: ContactSetup(**one) for name, one in plain["contacts"].items()},
            {name: ActuatorSetup(**one) for name, one in plain["actuators"].items()},
            plain.get("short", {}),
            plain.get("meanings", {}),
        )
