"""The pads' finite elements: patch test, rigid motions, independent assembly, locking and order."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest
from fem_oracle import dilatation, shear
from skfem import (
    Basis,
    ElementQuad1,
    ElementQuad2,
    ElementVector,
    FacetBasis,
    LinearForm,
    MeshQuad,
    condense,
    solve,
)

from torchsoft import KelvinVoigt, Pad, PadMesh
from torchsoft.physics.mesh import Array, banded, lame_moduli

ROUNDING = 1e-13
"""Relative to the largest entry: two assemblies of the same integrals, in another order of
summation."""


def stiffness(mesh: PadMesh, nu: float, E: float = 1.0, all_nodes: bool = True) -> Array:
    """Dense stiffness per depth of the package."""
    lame_lambda, lame_mu = lame_moduli(E, nu)
    K_lambda, K_mu, _ = mesh.matrices
    return mesh.assemble(lame_lambda * K_lambda + lame_mu * K_mu, all_nodes).toarray()


# the element
# ----------------------------------------------------------------------


def test_banded_storage_holds_the_whole_matrix():
    mesh = PadMesh(0.02, 4e-3, 7, 3, bonded_sides=True)
    lame_lambda, lame_mu = lame_moduli(1.0, 0.4)
    ab = banded(mesh.assemble(lame_lambda * mesh.matrices[0] + lame_mu * mesh.matrices[1]))
    n = ab.shape[1]
    lower = sum(np.diag(ab[k, : n - k], -k) for k in range(len(ab)))
    K = stiffness(mesh, 0.4, all_nodes=False)
    assert np.abs(lower + np.tril(lower, -1).T - K).max() < ROUNDING * np.abs(K).max()


# locking and order
# ----------------------------------------------------------------------

LENGTH, HEIGHT, WIDTH = 0.04, 4.59e-3, 3e-3


def pressure(x: Array) -> Array:
    """A smooth pressure [Pa], about as wide as the contact of the full grasp and far from the
    layer's ends."""
    return np.exp(-(((x - LENGTH / 2) / WIDTH) ** 2))


@dataclass(frozen=True)
class Layer:
    """Work of the pressure on a bonded layer with E = 1 Pa and unit depth, by scikit-fem."""

    nu: float

    def work(self, elements_x: int, elements_y: int, order: Literal[1, 2]) -> float:
        """With full integration of bilinear (order 1) or biquadratic (order 2) elements."""
        x, y = np.linspace(0, LENGTH, elements_x + 1), np.linspace(0, HEIGHT, elements_y + 1)
        mesh = MeshQuad.init_tensor(x, y).with_boundaries(
            {"top": lambda x: x[1] == HEIGHT, "base": lambda x: x[1] == 0}
        )
        element = ElementVector(ElementQuad1() if order == 1 else ElementQuad2())
        basis, facets = Basis(mesh, element), FacetBasis(mesh, element, facets="top", intorder=10)
        lame_lambda, lame_mu = lame_moduli(1.0, self.nu)
        K = lame_lambda * dilatation.assemble(basis) + lame_mu * shear.assemble(basis)
        f = LinearForm(lambda v, w: -pressure(w.x[0]) * v[1]).assemble(facets)
        return float(f @ solve(*condense(K, f, D=basis.get_dofs("base"))))


def pad_work(nu: float, elements_x: int, elements_y: int) -> float:
    """The same work by the massless pad, the pressure lumped to its nodes as contact forces are."""
    pad = Pad(
        PadMesh(LENGTH, HEIGHT, elements_x, elements_y), KelvinVoigt(1.0, nu, 1.0, 1.0, depth=1.0)
    )
    C = pad.compliance().detach().numpy()
    f = np.zeros((pad.nodes, 2))
    f[:, 1] = -pressure(pad.positions[:, 0].numpy()) * pad.mesh.tributary
    return float(f.ravel() @ C @ f.ravel())


# full integration misses at least this share of the work on 1 mm elements; measured 17 and 93 %
@pytest.mark.parametrize(("nu", "lost_by_full_integration"), [(0.49, 0.15), (0.4999, 0.9)])
def test_a_nearly_incompressible_layer_does_not_lock(nu, lost_by_full_integration):
    reference = Layer(nu).work(160, 20, order=2)  # itself good to 3e-4 at nu = 0.4999
    assert (
        abs(pad_work(nu, 40, 4) / reference - 1) < 0.02
    )  # the default 1 mm elements: measured 1.4 and 1.5 %
    assert Layer(nu).work(40, 4, order=1) / reference - 1 < -lost_by_full_integration


@pytest.mark.parametrize("nu", [0.3, 0.45, 0.49])
def test_work_converges_with_the_square_of_the_spacing(nu):
    reference = Layer(nu).work(160, 20, order=2)  # good to 1.5e-5 and better
    errors = np.array([abs(pad_work(nu, 20 * k, 2 * k) / reference - 1) for k in (2, 4, 8)])
    order = np.log2(errors[:-1] / errors[1:])
    assert np.all(order > 1.9)
    assert np.all(order < 2.2)
    assert errors[-1] < 1e-3
