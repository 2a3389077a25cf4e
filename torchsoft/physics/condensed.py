"""Massless pads: motion of their contact points, from the relation between nodal forces and the
contact law.

Rates are u' = free + P F with P = C sum of J / (tau + a h) and free = -C sum of J z / (tau + a h);
`stage` = a h is zero for the ODE itself. Static displacements are u = C F.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from torchsoft.physics.pads import Pad

HALVINGS = 12
"""Halvings of a step of Newton's method at the most."""


def free_rates(pad: Pad, z: Tensor, stage: float) -> tuple[Tensor, Tensor]:
    """Rates of a massless pad's nodes without contact (..., nodes, 2) [m/s] and its mobility P
    [m/(N.s)], for the forces z (..., branches, nodes, 2) that have set in at the stage's start."""
    fractions, times = pad.chain()
    C, rest = pad.compliance(), fractions / (times + stage)
    return -nodal(C, (rest[:, None, None] * z).sum(-3)), rest.sum() * C


def nodal(A: Tensor, F: Tensor) -> Tensor:
    """A F (..., nodes, 2) of forces on the nodes F (..., nodes, 2)."""
    return (F.flatten(-2) @ A.mT).unflatten(-1, (-1, 2))


def nodal_forces(
    A: Tensor,
    N: Tensor,
    free: Tensor,
    law: Callable[[Tensor], Tensor],
    tolerance: float,
    iterations: int,
) -> tuple[Tensor, float]:
    """Forces F = N^T f (..., nodes, 2) [N] of a law f(x) at contact points x = N (free + A F) (...,
    points, 2), and the largest residual that is left of x.

    A (2 nodes, 2 nodes) is the pad's compliance or mobility, N (points, nodes) its shape functions
    at the points. Semi-smooth Newton from no force, in which the force on a point depends on its
    own x only, so that only the points with a slope are unknowns. The last iteration is taken with
    the gradient on, which makes the derivative the implicit function theorem's.
    """
    relation = A.detach()

    def linearise(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mismatch of the forces, the mismatch of x that it causes, and the slopes (..., points, 2,
        2) of the law."""
        x = N @ (free + nodal(relation, N.mT @ f))
        with torch.enable_grad():
            twice = torch.stack((x, x)).requires_grad_()  # a copy for each component
            at = law(twice)
            components = (at[0, ..., 0] + at[1, ..., 1]).sum()
            (G,) = torch.autograd.grad(components, twice, materialize_grads=True)
        v = at[0].detach() - f
        return v, N @ nodal(relation, N.mT @ v), G.movedim(0, -2)

    def correction(v: Tensor, G: Tensor) -> Tensor:
        """(1 - G B)^-1 v with B = N A N^T."""
        sloped = torch.nonzero(G.flatten(-2).any(-1).reshape(-1, len(N)).any(0))[:, 0]
        if not len(sloped):
            return v
        G, spread = G[..., sloped, :, :], torch.kron(N[sloped], torch.eye(2, dtype=N.dtype))
        B = (spread @ relation @ spread.mT).unflatten(-1, (-1, 2))
        J = torch.eye(len(spread), dtype=v.dtype) - torch.einsum(
            "rpj,...pjk->...rpk", B, G
        ).flatten(-2)
        x = torch.linalg.solve(
            J, (N @ nodal(relation, N.mT @ v))[..., sloped, :].flatten(-2)[..., None]
        )
        return v.index_add(-2, sloped, (G @ x.unflatten(-2, (-1, 2)))[..., 0])

    with torch.no_grad():
        f = torch.zeros(*free.shape[:-2], len(N), 2, dtype=free.dtype)
        v, r, G = linearise(f)
        for _ in range(iterations):
            size = r.flatten(-2).norm(dim=-1)
            going = r.abs().amax((-2, -1)) > tolerance
            if not bool(going.any()):
                break
            way = correction(v, G) * going[..., None, None]
            for _ in range(HALVINGS):  # sample by sample, until the residual falls
                v, r, G = linearise(f + way)
                worse = going & ~(r.flatten(-2).norm(dim=-1) < size)
                if not bool(worse.any()):
                    break
                way = way * torch.where(worse, 0.5, 1.0)[..., None, None]
            f = f + way
        left = float(r.abs().max())
        f = f + correction(v, G)
    v = law(N @ (free + nodal(A, N.mT @ f))) - f
    return N.mT @ (f + correction(v, G)), left
