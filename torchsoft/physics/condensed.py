"""Massless pads: what moves at their contact points, from the relation between nodal forces and the contact law.

Rates are u' = free + P F with P = C sum of J / (tau + a h) and free = -C sum of J z / (tau + a h); `stage` = a h is zero for
the ODE itself. Static displacements are u = C F.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from torchsoft.physics.pads import Pad

HALVINGS = 12
"""Halvings of a step of Newton's method at the most."""


def free_rates(pad: Pad, z: Tensor, stage: float) -> tuple[Tensor, Tensor]:
    """Rates of a massless pad's nodes without contact (..., nodes, 2) [m/s] and its mobility P [m/(N.s)], for the forces
    z (..., branches, nodes, 2) that have set in at the stage's start."""
    fractions, times = pad.material.chain()
    C, rest = pad.compliance(), fractions / (times + stage)
    free = -((rest[:, None, None] * z).sum(-3).flatten(-2) @ C.mT).unflatten(-1, (-1, 2))
    return free, rest.sum() * C


def nodal(A: Tensor, F: Tensor) -> Tensor:
    """A F (..., nodes, 2) of forces on the nodes F (..., nodes, 2)."""
    return (F.flatten(-2) @ A.mT).unflatten(-1, (-1, 2))


def nodal_forces(
    A: Tensor, N: Tensor, free: Tensor, law: Callable[[Tensor], Tensor], tolerance: float, iterations: int
) -> tuple[Tensor, float]:
    """Forces F = N^T f (..., nodes, 2) [N] of a law f(x) at contact points x = N (free + A F) (..., points, 2), and the largest
    residual that is left of x.

    A (2 nodes, 2 nodes) is the pad's compliance or mobility, N (points, nodes) its shape functions at the points. Semi-smooth
    Newton from `free`, in which the force on a point depends on its own x only, so that only the points with a slope are
    unknowns. The last iteration is taken with the gradient on, which makes the derivative the implicit function theorem's.
    """

    def residual(x: Tensor, f: Tensor) -> Tensor:
        return x - N @ (free + nodal(A, N.mT @ f))

    def linearise(x: Tensor) -> tuple[Tensor, Tensor]:
        """Residual and the slopes (..., points, 2, 2) of the law."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            f = law(x)
            rows = [
                torch.autograd.grad(f[..., i].sum(), x, retain_graph=i == 0, materialize_grads=True) for i in (0, 1)
            ]
        return residual(x, f).detach(), torch.stack([row for (row,) in rows], -2)

    def step(r: Tensor, G: Tensor) -> Tensor:
        """(1 - N A N^T G)^-1 r: points without a slope follow the others."""
        sloped = torch.nonzero(G.flatten(-2).any(-1).reshape(-1, len(N)).any(0))[:, 0]
        if not len(sloped):
            return r
        S, G = N[sloped], G[..., sloped, :, :]
        used = torch.nonzero(S.any(0))[:, 0]
        blocks = A.detach().unflatten(0, (-1, 2)).unflatten(2, (-1, 2))[used][:, :, used]
        between = torch.einsum("pn,niaj,qa->piqj", S[:, used], blocks, S[:, used])
        size = 2 * len(sloped)
        coupled = torch.einsum("piqj,...qjk->...piqk", between, G).reshape(*G.shape[:-3], size, size)
        J = torch.eye(size, dtype=r.dtype) - coupled
        own = torch.linalg.solve(J, r[..., sloped, :].flatten(-2)[..., None]).unflatten(-2, (-1, 2))
        return r + N @ nodal(A.detach(), S.mT @ (G @ own)[..., 0])

    def corrected(f: Tensor, G: Tensor) -> Tensor:
        """A step in forces, which stiff contacts need: law(N (free + A F)) is f to rounding."""
        v = law(N @ (free + nodal(A, N.mT @ f))) - f
        return f + v + (G @ step(N @ nodal(A.detach(), N.mT @ v), G)[..., None])[..., 0]

    with torch.no_grad():
        x = N @ free
        r, G = linearise(x)
        for _ in range(iterations):
            size = r.flatten(-2).norm(dim=-1)
            going = r.abs().amax((-2, -1)) > tolerance
            if not bool(going.any()):
                break
            way = step(r, G) * going[..., None, None]
            for _ in range(HALVINGS):  # sample by sample, until the residual falls
                r, G = linearise(x - way)
                worse = going & ~(r.flatten(-2).norm(dim=-1) < size)
                if not bool(worse.any()):
                    break
                way = way * torch.where(worse, 0.5, 1.0)[..., None, None]
            x = x - way
        left = float(r.abs().max())
        f = corrected(law(x), G)
    return N.mT @ corrected(f, G), left
