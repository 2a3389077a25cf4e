"""The finite elements of scikit-fem, against which those of the pads are held; meshed where a pad
stands in the world."""

import numpy as np
from skfem import Basis, BilinearForm, ElementQuad1, ElementVector, MeshQuad
from skfem.helpers import ddot, div, dot, sym_grad
from torch import Tensor

from torchsoft import Pad
from torchsoft.physics.mesh import Array, lame_moduli

CM_HEIGHT = 2.18e-3


@BilinearForm
def dilatation(u, v, _):
    return div(u) * div(v)


@BilinearForm
def shear(u, v, _):
    return 2 * ddot(sym_grad(u), sym_grad(v))


@BilinearForm
def mass(u, v, _):
    return dot(u, v)


def oracle(x: Array, y: Array, centred: bool = True) -> tuple[Array, Array, Array]:
    """scikit-fem's K_lambda, K_mu, M on the grid x, y [m]; nodes column by column, dofs (x, y) node
    by node."""
    mesh = MeshQuad.init_tensor(x, y)
    element = ElementVector(ElementQuad1())
    basis = Basis(mesh, element, intorder=2)
    assert basis.dx.shape[1] == 4  # 2 x 2 points
    centre = Basis(mesh, element, quadrature=(np.full((2, 1), 0.5), np.ones(1)))
    order = basis.nodal_dofs[:, np.lexsort((mesh.p[1], mesh.p[0]))].T.ravel()
    forms = (dilatation, centre if centred else basis), (shear, basis), (mass, basis)
    K_lambda, K_mu, M = (form.assemble(b).toarray()[order][:, order] for form, b in forms)
    return K_lambda, K_mu, M


def world_stiffness(pad: Pad) -> tuple[Array, Array]:
    """Positions [m] (n, 2) and dense stiffness [N/m] of a pad's free nodes, meshed where it stands
    in the world."""
    p, rubber = pad.mesh, pad.material
    if pad.base is None:
        left, base, top = 0.0, 0.0, p.height
    else:
        left, base, top = -p.length / 2, -CM_HEIGHT, -CM_HEIGHT - p.height
    x = np.linspace(left, left + p.length, p.elements_x + 1)
    y = np.linspace(min(base, top), max(base, top), p.elements_y + 1)
    K_lambda, K_mu, _ = oracle(x, y)
    lame_lambda, lame_mu = lame_moduli(rubber.E.item(), rubber.nu.item())
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    held = nodes[:, 1] == base
    if p.bonded_sides:
        held |= (nodes[:, 0] == x[0]) | (nodes[:, 0] == x[-1])
    dofs = (2 * np.flatnonzero(~held)[:, None] + np.arange(2)).ravel()
    K = rubber.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu)
    return nodes[~held], K[dofs][:, dofs]


def matching(positions: Tensor, nodes: Array) -> Array:
    """Dofs of the oracle's `nodes`, in the order of a pad's `positions`."""
    distance = np.linalg.norm(positions.numpy()[:, None] - nodes, axis=-1)
    assert distance.min(1).max() < 1e-15
    return (2 * distance.argmin(1)[:, None] + np.arange(2)).ravel()
