"""The matrices of scikit-fem's finite elements, against which those of the pads are compared."""

from typing import Any

import numpy as np
from skfem import Basis, BilinearForm, ElementQuad1, ElementVector, MeshQuad
from skfem.helpers import ddot, div, dot, sym_grad

from torchsoft.physics.mesh import Array


@BilinearForm
def dilatation(u, v, _):
    return div(u) * div(v)


@BilinearForm
def shear(u, v, _):
    return 2 * ddot(sym_grad(u), sym_grad(v))


@BilinearForm
def mass(u, v, _):
    return dot(u, v)


def matrices(nodes: Array, elements: Any) -> list[Array]:
    """K_lambda, K_mu and M of a mesh, dofs (x, y) node by node, with the quadratures of a pad's
    elements: lambda's in the centre, mu's and the mass's."""
    grid = MeshQuad(np.ascontiguousarray(nodes.T), elements.T)
    element = ElementVector(ElementQuad1())
    centre = Basis(grid, element, quadrature=(np.full((2, 1), 0.5), np.ones(1)))
    bases = centre, Basis(grid, element, intorder=2), Basis(grid, element, intorder=5)
    order = centre.nodal_dofs.T.ravel()
    forms = zip((dilatation, shear, mass), bases)
    return [form.assemble(basis).toarray()[order][:, order] for form, basis in forms]
