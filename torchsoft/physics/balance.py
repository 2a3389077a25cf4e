"""Balance of a pad with the forces on its surface: displacements at rest, or rates.

`newton` solves the equations of any pad: those of a condensed pad's contact points (`Points`), or
of a nodal pad's nodes (`Nodes`). A last iteration with the gradient on, `corrected`, makes the
derivative that of the implicit function theorem.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from scipy.linalg.lapack import dgbtrf, dgbtrs  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import Pad, under_forces

HALVINGS = 12
"""Halvings of a step of Newton's method at the most."""

Forces = Callable[[Tensor], Tensor]
"""A function of displacements, or of rates: of corners (..., elements, dofs) to forces on them, or
of contact points (..., points, 2) to forces on these."""

Solve = Callable[[Tensor], Tensor]
"""Step of Newton's method (..., n, 2) for a residual (..., n, 2), differentiable in it."""


class Equations(Protocol):
    """Equations whose `residual` (..., n, 2) is to vanish at x (..., n, 2), and their linear
    solution at x. Where residuals are of another kind than x, steps are judged in their place."""

    like_x: bool

    def residual(self, x: Tensor) -> Tensor: ...

    def linearised(self, x: Tensor) -> Solve: ...


@torch.no_grad()
def newton(
    equations: Equations, first: Tensor, tolerance: float, iterations: int
) -> tuple[Tensor, Solve, float]:
    """The solution from `first` (..., n, 2) on, the last linear solution, and the largest residual,
    or step, that is left.

    A step is halved, sample by sample, until the residual, or the step after it by the same linear
    solution, is smaller. Raises `FloatingPointError` where a matrix is singular.
    """
    x, left = first.detach(), np.inf
    r, solve = equations.residual(x), equations.linearised(x)
    judged = (lambda r: r) if equations.like_x else (lambda r: solve(r))
    for _ in range(iterations):
        off = judged(r)
        sizes = off.abs().amax((-2, -1))
        left, going = float(sizes.max()), sizes > tolerance
        if not bool(going.any()):
            break
        size, way = off.flatten(-2).norm(dim=-1), solve(r) * going[..., None, None]
        for _ in range(HALVINGS):
            r = equations.residual(x + way)
            worse = going & ~(judged(r).flatten(-2).norm(dim=-1) < size)
            if not bool(worse.any()):
                break
            way = way * torch.where(worse, 0.5, 1.0)[..., None, None]
        x = x + way
        solve = equations.linearised(x)
    return x, solve, left


def corrected(equations: Equations, x: Tensor, solve: Solve) -> Tensor:
    """One iteration from the solution x (..., n, 2), which gives it its derivative."""
    return x + solve(equations.residual(x))


def slopes_at_points(law: Forces, x: Tensor) -> Tensor:
    """Derivatives (..., points, 2, 2) of the forces on contact points at x (..., points, 2), of
    which each depends on its own point only."""
    with torch.enable_grad():
        twice = torch.stack((x, x)).detach().requires_grad_()  # a copy for each component
        f = law(twice)
        total = (f[0, ..., 0] + f[1, ..., 1]).sum()
        (rows,) = torch.autograd.grad(total, twice, materialize_grads=True)
    return rows.movedim(0, -2)


class Points:
    """Contact points of a condensed pad at x = N (free + A N^T f(x)) (..., points, 2): A (2 nodes,
    2 nodes) is its compliance or mobility, N (points, nodes) its shape functions, `free` (...,
    nodes, 2) what its nodes do without forces, f a law of contact points."""

    like_x = True

    def __init__(self, A: Tensor, N: Tensor, free: Tensor, law: Forces) -> None:
        self.A, self.N, self.free, self.law = A, N, free, law

    def moved(self, f: Tensor) -> Tensor:
        """Points under forces f (..., points, 2) on them."""
        return self.N @ (self.free + under_forces(self.A, self.N.mT @ f))

    def residual(self, x: Tensor) -> Tensor:
        return self.moved(self.law(x)) - x

    def linearised(self, x: Tensor) -> Solve:
        """(1 - B G)^-1 with B = N A N^T and the slopes G of the law, of which only the points with
        a slope are unknowns."""
        N, A, G = self.N, self.A.detach(), slopes_at_points(self.law, x)
        sloped = torch.nonzero(G.flatten(-2).any(-1).reshape(-1, len(N)).any(0))[:, 0]
        if not len(sloped):
            return lambda r: r
        G, N_sloped = G[..., sloped, :, :], N[sloped]
        components = torch.kron(N_sloped, torch.eye(2, dtype=N.dtype))
        B = (components @ A @ components.mT).unflatten(-1, (-1, 2))
        J = torch.eye(len(components), dtype=x.dtype)
        J = J - torch.einsum("rpj,...pjk->...rpk", B, G).flatten(-2)

        def solve(r: Tensor) -> Tensor:
            step = torch.linalg.solve(J, r[..., sloped, :].flatten(-2)[..., None])
            force = (G @ step.unflatten(-2, (-1, 2)))[..., 0]
            return r + N @ under_forces(A, N_sloped.mT @ force)

        return solve


def contact_forces(
    A: Tensor, N: Tensor, free: Tensor, law: Forces, tolerance: float, iterations: int,
    first: Tensor | None = None,
) -> tuple[Tensor, float]:  # fmt: skip
    """Forces N^T f (..., nodes, 2) [N] of a law at the contact points of a condensed pad (see
    `Points`), and the largest residual that is left, from the forces `first` (..., points, 2) on,
    none by default.

    The last iteration takes the law's forces along its slopes: forces of the law at the points
    found would have an error of its stiffness times the rounding of the points."""
    points = Points(A, N, free, law)
    x, solve, left = newton(
        points, N @ free if first is None else points.moved(first), tolerance, iterations
    )
    f = law(x)
    way = solve(points.moved(f) - x)
    return N.mT @ (f + (slopes_at_points(law, x) @ way[..., None])[..., 0]), left


class Banded:
    """Place of a pad's coefficients in LAPACK's banded storage."""

    def __init__(self, pad: Pad) -> None:
        self.size = 2 * pad.nodes
        row = np.broadcast_to(pad.corners[:, :, None], (*pad.corners.shape, pad.corners.shape[1]))
        column = np.swapaxes(row, 1, 2)
        self.kept = (row >= 0) & (column >= 0)
        self.shares = pad.point_shares[:, :, None] * pad.point_shares[:, None, :]
        nodes, shape = pad.surface.numpy()[pad.point_nodes], (*self.shares.shape, 2, 2)
        dofs = 2 * nodes[:, :, None] + np.arange(2)  # (points, side, 2)
        r = np.broadcast_to(dofs[:, :, None, :, None], shape)
        c = np.broadcast_to(dofs[:, None, :, None, :], shape)
        self.row = np.concatenate((row[self.kept], r.ravel()))
        self.column = np.concatenate((column[self.kept], c.ravel()))
        self.band = int(np.abs(self.row - self.column).max(initial=0))

    def factor(self, elements: Array, contacts: Array) -> "Factor":
        """The factorised derivative of the residual, internal less contact forces, of those of the
        elements' forces (elements, dofs, dofs) and of the points' (points, 2, 2)."""
        A = np.zeros((3 * self.band + 1, self.size), order="F")
        on_nodes = self.shares[:, :, :, None, None] * contacts[:, None, None]
        values = np.concatenate((elements[self.kept], -on_nodes.ravel()))
        np.add.at(A, (2 * self.band + self.row - self.column, self.column), values)
        return Factor(A, self.band)


class Factor:
    """L U of a banded matrix; raises `FloatingPointError` for a singular one."""

    def __init__(self, A: Array, band: int) -> None:
        self.band = band
        self.LU, self.pivots, failed = dgbtrf(A, band, band, overwrite_ab=True)
        if failed or not np.isfinite(self.LU).all():
            raise FloatingPointError("the stiffness of a pad is singular")

    def solve(self, b: Array, transposed: bool = False) -> Array:
        """A^-1 b, or A^-T b, of b (size,)."""
        return dgbtrs(self.LU, self.band, self.band, b, self.pivots, trans=int(transposed))[0]


class _Solved(torch.autograd.Function):
    """A^-1 b (samples, size) of b, each with a factor of its own."""

    @staticmethod
    def forward(b: Tensor, factors: list[Factor], transposed: bool) -> Tensor:
        return solved(b, factors, transposed)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, ctx.factors, ctx.transposed = inputs

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int, ...], b: Tensor, factors: list[Factor], transposed: bool
    ) -> tuple[Tensor, int]:
        each = b.movedim(in_dims[0], 0)
        return torch.stack([_Solved.apply(one, factors, transposed) for one in each]), 0

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Any, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        # differentiable itself, for derivatives along directions
        return _Solved.apply(bar, ctx.factors, not ctx.transposed), None, None


def solved(b: Tensor, factors: list[Factor], transposed: bool = False) -> Tensor:
    """A^-1 b, or A^-T b, (samples, size) of b, each with a factor of its own."""
    rows = [one.solve(row, transposed) for one, row in zip(factors, b.detach().numpy())]
    return torch.from_numpy(np.stack(rows))


class Nodes:
    """Nodes (..., nodes, 2) of a nodal pad in balance, of the elements' forces `internal` and of
    those of a law of contact points, none by default."""

    like_x = False

    def __init__(self, pad: Pad, internal: Forces, law: Forces | None = None) -> None:
        self.pad, self.internal, self.law = pad, internal, law

    @cached_property
    def banded(self) -> Banded:
        return Banded(self.pad)

    def residual(self, x: Tensor) -> Tensor:
        """Contact less internal forces (..., nodes, 2) [N]."""
        pad = self.pad
        left = -pad.from_corners(self.internal(pad.at_corners(x)))
        return (
            left
            if self.law is None
            else left + pad.interpolation.mT @ self.law(pad.interpolation @ x)
        )

    def linearised(self, x: Tensor) -> Solve:
        """By factors of the derivative of internal less contact forces, sample by sample."""
        pad = self.pad
        with torch.enable_grad():
            at = pad.at_corners(x)
            at = at.expand(at.shape[-1], *at.shape).clone().requires_grad_()
            each = self.internal(at).movedim(-1, 0).diagonal(0, 0, 1)  # a copy for each component
            (rows,) = torch.autograd.grad(each.sum(), at)
        elements = rows.movedim(0, -2)
        elements = elements.reshape(-1, *elements.shape[-3:])
        contacts = torch.zeros(len(elements), len(pad.interpolation), 2, 2, dtype=x.dtype)
        if self.law is not None:
            contacts = slopes_at_points(self.law, pad.interpolation @ x).reshape(contacts.shape)
        pairs = zip(elements.numpy(), contacts.numpy())
        return self.by_factors([self.banded.factor(*pair) for pair in pairs])

    @staticmethod
    def by_factors(factors: list[Factor]) -> Solve:
        """Steps with a factor for every sample, or one for all."""

        def solve(r: Tensor) -> Tensor:
            rows = r.reshape(-1, r.shape[-2] * r.shape[-1])
            per_row = factors * (len(rows) // len(factors))
            step: Any = _Solved.apply(rows, per_row, False)
            return step.reshape(r.shape)

        return solve
