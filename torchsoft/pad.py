"""The soft pads: Q4 plane-strain finite elements on a regular mesh, massless (condensed) or inertial.

A pad is described in its own frame: bonded base at y = 0, free surface at y = height. The lower pad stands like
that in the world; the upper one is its mirror image, so that its displacements in the world are S u with
S = diag(1, -1). Nodes are numbered column by column, which keeps the matrices banded.

Every stiffness is linear in the two Lame moduli, K = depth (lambda K_lambda + mu K_mu). The dilatational part is
integrated at the element's centre and the shear part at 2 x 2 points (selective reduced integration), which is free
of volumetric locking and of hourglass modes.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg, sparse
from torch import Tensor, nn

from torchsoft.parameters import PadParameters

Array = NDArray[np.float64]


class Material(nn.Module):
    """Kelvin-Voigt rubber: E [Pa], nu [1], rho [kg/m3], tau [s] and the out-of-plane depth [m] of the pads."""

    def __init__(self, p: PadParameters) -> None:
        super().__init__()
        self.E, self.nu, self.rho, self.tau, self.depth = (
            nn.Parameter(torch.tensor(value, dtype=torch.float64)) for value in (p.E, p.nu, p.rho, p.tau, p.depth)
        )

    def lame(self) -> tuple[Tensor, Tensor]:
        """Lame moduli (lambda, mu) [Pa]."""
        return lame_moduli(self.E, self.nu)


Modulus = TypeVar("Modulus", float, Tensor)


def lame_moduli(E: Modulus, nu: Modulus) -> tuple[Modulus, Modulus]:
    """lambda = E nu / ((1 + nu)(1 - 2 nu)), mu = E / (2 (1 + nu)), in the unit of E."""
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def element_matrices(a: float, b: float) -> tuple[Array, Array, Array]:
    """K_lambda, K_mu (per modulus and depth) [1] and the consistent M (per density and depth) [m2], each (8, 8).

    Bilinear rectangle of sides a, b [m], nodes anticlockwise from the lower left, dofs (x, y) node by node.
    """
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)

    def strain(xi: float, zeta: float) -> tuple[Array, Array]:
        N = (1 + corner[:, 0] * xi) * (1 + corner[:, 1] * zeta) / 4
        dx = corner[:, 0] * (1 + corner[:, 1] * zeta) / 4 * 2 / a
        dy = corner[:, 1] * (1 + corner[:, 0] * xi) / 4 * 2 / b
        B = np.zeros((3, 8))
        B[0, 0::2], B[1, 1::2] = dx, dy
        B[2, 0::2], B[2, 1::2] = dy, dx
        return N, B

    area, gauss = a * b, 1 / np.sqrt(3)
    divergence = strain(0.0, 0.0)[1][:2].sum(0)
    K_lambda = area * np.outer(divergence, divergence)
    K_mu, M = np.zeros((8, 8)), np.zeros((8, 8))
    for xi in (-gauss, gauss):
        for zeta in (-gauss, gauss):
            N, B = strain(xi, zeta)
            K_mu += area / 4 * B.T @ np.diag([2.0, 2.0, 1.0]) @ B
            M += area / 4 * np.kron(np.outer(N, N), np.eye(2))
    return K_lambda, K_mu, M


@dataclass(frozen=True)
class PadMesh:
    """Regular mesh of a pad in its own frame, its bonded nodes, and the matrices of its free nodes."""

    length: float
    height: float
    elements_x: int
    elements_y: int
    bonded_sides: bool = False

    @cached_property
    def nodes(self) -> Array:
        """Reference positions [m], shape (N, 2)."""
        x = np.linspace(0, self.length, self.elements_x + 1)
        y = np.linspace(0, self.height, self.elements_y + 1)
        return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)

    @cached_property
    def elements(self) -> NDArray[np.int64]:
        """Node numbers of each element, anticlockwise, shape (elements, 4)."""
        number = np.arange(len(self.nodes)).reshape(self.elements_x + 1, self.elements_y + 1)
        corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        return np.stack(corners, -1).reshape(-1, 4)

    @cached_property
    def bonded(self) -> NDArray[np.bool_]:
        """Nodes held by the ground or the bracket, shape (N,): the base, and the sides of an enclosed pad."""
        x, y = self.nodes.T
        return (y == 0) | (self.bonded_sides & ((x == 0) | (x == self.length)))

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """Numbers of the nodes that move."""
        return np.flatnonzero(~self.bonded)

    @cached_property
    def surface(self) -> NDArray[np.int64]:
        """Numbers, among the free nodes, of those on the free surface, from left to right."""
        return np.flatnonzero(self.nodes[self.free, 1] == self.height)

    @cached_property
    def tributary(self) -> Array:
        """Length of surface that each surface node stands for [m], shape (surface,)."""
        x = self.nodes[self.free[self.surface], 0]
        spacing = self.length / self.elements_x
        return spacing * np.where((x == 0) | (x == self.length), 0.5, 1.0)

    def assemble(self, element: Array, all_nodes: bool = False) -> sparse.csr_array:
        """Global matrix of one (8, 8) element matrix, on the dofs of the free nodes or of all of them."""
        dofs = (2 * self.elements[:, :, None] + np.arange(2)).reshape(-1, 8)
        rows, cols = np.repeat(dofs, 8, 1).ravel(), np.tile(dofs, (1, 8)).ravel()
        size = 2 * len(self.nodes)
        full = sparse.csr_array((np.tile(element.ravel(), len(dofs)), (rows, cols)), shape=(size, size))
        keep = (2 * self.free[:, None] + np.arange(2)).ravel()
        return full if all_nodes else full[keep][:, keep]

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array]:
        """Element matrices K_lambda, K_mu, M of this mesh."""
        return element_matrices(self.length / self.elements_x, self.height / self.elements_y)

    def banded_stiffness(self, lame_lambda: float, lame_mu: float) -> Array:
        """Stiffness per depth of the free nodes [Pa] in scipy's lower banded storage, shape (band, 2 free)."""
        K_lambda, K_mu, _ = self.matrices
        return banded(self.assemble(lame_lambda * K_lambda + lame_mu * K_mu))

    @cached_property
    def nodal_areas(self) -> Array:
        """Lumped mass per density and depth of the free nodes [m2], shape (free,): row sums of the consistent M."""
        return self.assemble(self.matrices[2], all_nodes=True).sum(1)[::2][self.free]


def banded(matrix: sparse.csr_array) -> Array:
    """Lower banded storage of a symmetric sparse matrix: `out[i - j, j]` is entry (i, j)."""
    entries = matrix.tocoo()
    row, col = entries.row, entries.col
    lower = row >= col
    out = np.zeros(((row - col).max() + 1, matrix.shape[0]))  # pyright: ignore[reportOptionalSubscript]
    out[(row - col)[lower], col[lower]] = entries.data[lower]
    return out


class Pad(nn.Module):
    """What the model asks of either fidelity; positions and displacements are in the world frame.

    `nodes` is the number of nodes in the state and `positions` where they stand undeformed [m], (nodes, 2), relative
    to the base's own origin (the ground's, or the bracket's centre of mass). `surface` numbers those on the contact
    surface, and `tributary` is the length each of these stands for [m].
    """

    positions: Tensor
    surface: Tensor
    tributary: Tensor
    mirror: Tensor
    massless: bool

    def __init__(self, mesh: PadMesh, origin: tuple[float, float], mirrored: bool) -> None:
        super().__init__()
        self.mesh = mesh
        sign = np.array([1.0, -1.0 if mirrored else 1.0])
        kept = mesh.surface if self.massless else np.arange(len(mesh.free))
        self.nodes = len(kept)
        self._kept = (2 * kept[:, None] + np.arange(2)).ravel()
        positions = mesh.nodes[mesh.free][kept] * sign + np.array(origin)
        self.register_buffer("mirror", torch.from_numpy(sign))
        self.register_buffer("positions", torch.from_numpy(positions))
        self.register_buffer("tributary", torch.from_numpy(mesh.tributary))
        self.register_buffer("surface", torch.from_numpy(np.searchsorted(kept, mesh.surface)))
        self._solved: tuple[float, Tensor, Tensor] | None = None

    def elastic_force(self, material: Material, u: Tensor) -> Tensor:
        """K u: displacements u (..., nodes, 2) [m] to forces of the same shape [N]."""
        raise NotImplementedError

    def masses(self, material: Material) -> Tensor:
        """Lumped mass of each node in the state [kg], shape (nodes,)."""
        raise NotImplementedError

    def compliance(self, material: Material) -> Tensor:
        """Static displacement of every node in the state per surface force [m/N], shape (2 nodes, 2 surface).

        For the massless pad this is C = (K^-1)_ss. Proportional to 1 / (E depth); its derivative with respect to
        nu is exact to first order (a second derivative in nu comes out as zero).
        """
        C, dC = self._unit_compliance(material)
        if material.nu.requires_grad:
            C = C + dC * (material.nu - material.nu.detach())
        return C / (material.E * material.depth)

    def compliance_by_nu(self, material: Material) -> Tensor:
        """Derivative of `compliance` with respect to nu [m/N], shape (2 nodes, 2 surface)."""
        return self._unit_compliance(material)[1] / (material.E * material.depth)

    def _unit_compliance(self, material: Material) -> tuple[Tensor, Tensor]:
        """C for E depth = 1 and its derivative by nu, solved for once per value of nu."""
        nu = material.nu.detach().item()
        if self._solved is None or self._solved[0] != nu:
            self._solved = nu, *self._solve_unit_compliance(nu)
        return self._solved[1:]

    def _solve_unit_compliance(self, nu: float) -> tuple[Tensor, Tensor]:
        """C for E depth = 1, and its derivative dC/dnu = -K^-1 (dK/dnu) K^-1, restricted."""
        surface = (2 * self.mesh.surface[:, None] + np.arange(2)).ravel()
        loads = np.zeros((2 * len(self.mesh.free), len(surface)))
        loads[surface, np.arange(len(surface))] = 1.0
        factor = linalg.cholesky_banded(self.mesh.banded_stiffness(*lame_moduli(1.0, nu)), lower=True)
        X = linalg.cho_solve_banded((factor, True), loads)
        with torch.enable_grad():
            nu_ = torch.tensor(nu, dtype=torch.float64, requires_grad=True)
            moduli = lame_moduli(torch.ones_like(nu_), nu_)
        d_lambda, d_mu = (torch.autograd.grad(modulus, nu_, retain_graph=True)[0].item() for modulus in moduli)
        K_lambda, K_mu, _ = self.mesh.matrices
        dK = self.mesh.assemble(d_lambda * K_lambda + d_mu * K_mu)
        dX = -linalg.cho_solve_banded((factor, True), dK @ X)
        s = self.mirror.numpy()
        rows, cols = np.tile(s, len(self._kept) // 2)[:, None], np.tile(s, len(surface) // 2)
        return torch.from_numpy(rows * X[self._kept] * cols), torch.from_numpy(rows * dX[self._kept] * cols)


class MasslessPad(Pad):
    """The statically condensed pad: only surface nodes, tau u' + u = C f (exact, because R = tau K)."""

    massless = True

    def elastic_force(self, material: Material, u: Tensor) -> Tensor:
        """K u with the condensed K = C^-1."""
        rows = u.reshape(-1, 2 * self.nodes)
        return torch.linalg.solve(self.compliance(material), rows.mT).mT.reshape(u.shape)

    def masses(self, material: Material) -> Tensor:
        return torch.zeros(self.nodes, dtype=torch.float64)


class InertialPad(Pad):
    """The paper's full fields on all free nodes: I (lumped masses), C = K^-1, R = tau K."""

    massless = False
    connectivity: Tensor
    areas: Tensor
    K_lambda: Tensor
    K_mu: Tensor

    def __init__(self, mesh: PadMesh, origin: tuple[float, float], mirrored: bool) -> None:
        super().__init__(mesh, origin, mirrored)
        K_lambda, K_mu, _ = mesh.matrices
        # bonded nodes do not move: they read, and write to, one spare slot behind the free ones
        slot = np.full(len(mesh.nodes), len(mesh.free))
        slot[mesh.free] = np.arange(len(mesh.free))
        self.register_buffer("connectivity", torch.from_numpy(slot[mesh.elements]))
        self.register_buffer("areas", torch.from_numpy(mesh.nodal_areas))
        self.register_buffer("K_lambda", torch.from_numpy(K_lambda))
        self.register_buffer("K_mu", torch.from_numpy(K_mu))

    def masses(self, material: Material) -> Tensor:
        """The bonded nodes' masses are left out, as in the paper."""
        return material.rho * material.depth * self.areas

    def elastic_force(self, material: Material, u: Tensor) -> Tensor:
        """K u, element by element."""
        lame_lambda, lame_mu = material.lame()
        K_e = material.depth * (lame_lambda * self.K_lambda + lame_mu * self.K_mu)
        padded = nn.functional.pad(u * self.mirror, (0, 0, 0, 1))
        u_e = padded[..., self.connectivity, :].flatten(-2)
        f_e = (u_e @ K_e).unflatten(-1, (4, 2))
        f = torch.zeros_like(padded).index_add(-2, self.connectivity.flatten(), f_e.flatten(-3, -2))
        return f[..., :-1, :] * self.mirror


def build_pads(p: PadParameters, cm_height: float) -> tuple[Pad, Pad]:
    """Lower and upper pad; the upper one's origin is the bracket's centre of mass, `cm_height` [m] above its base."""
    kind = MasslessPad if p.fidelity == "massless" else InertialPad
    lower = PadMesh(p.length, p.height, p.elements_x, p.elements_y)
    upper = PadMesh(p.length, p.height, p.elements_x, p.elements_y, bonded_sides=p.enclosed)
    return kind(lower, (0.0, 0.0), mirrored=False), kind(upper, (-p.length / 2, -cm_height), mirrored=True)
