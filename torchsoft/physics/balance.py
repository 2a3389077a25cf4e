"""Balance of the nodes of a pad with the forces on its surface: displacements at rest, or rates.

Newton's method with the banded matrix of the elements' and the contacts' derivatives; a last
iteration with the gradient on makes the derivative that of the implicit function theorem.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.linalg.lapack import dgbtrf, dgbtrs  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import HALVINGS, Pad

Forces = Callable[[Tensor], Tensor]
"""A function of displacements, or of rates: of corners (..., elements, 8) to forces on them, or of
contact points (..., points, 2) to forces on these."""


class Banded:
    """Place of a pad's coefficients in LAPACK's banded storage."""

    def __init__(self, pad: Pad) -> None:
        self.size = 2 * pad.nodes
        row = np.broadcast_to(pad.corners[:, :, None], (*pad.corners.shape, 8))
        column = np.swapaxes(row, 1, 2)
        self.kept = (row >= 0) & (column >= 0)
        own = pad.surface.numpy()[pad.point_nodes]
        nodes = np.broadcast_to(own[:, :, None, None, None], (len(own), 2, 2, 2, 2))
        others = np.broadcast_to(own[:, None, :, None, None], nodes.shape)
        r, c = (np.arange(2)[None, None, None, :, None], np.arange(2))
        self.shares = pad.point_shares[:, :, None] * pad.point_shares[:, None, :]
        self.row = np.concatenate((row[self.kept], (2 * nodes + r).ravel()))
        self.column = np.concatenate((column[self.kept], (2 * others + c).ravel()))
        self.band = int(np.abs(self.row - self.column).max(initial=0))

    def factor(self, elements: Array, contacts: Array) -> "Factor":
        """The factorised derivative of the residual, internal less contact forces, of those of the
        elements' forces (elements, 8, 8) and of the points' (points, 2, 2)."""
        A = np.zeros((3 * self.band + 1, self.size), order="F")
        spread = self.shares[:, :, :, None, None] * contacts[:, None, None]
        values = np.concatenate((elements[self.kept], -spread.ravel()))
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


class Balance:
    """Nodes (..., nodes, 2) of a pad in balance, of the elements' forces `internal` and of those of
    a law of contact points, none by default."""

    def __init__(self, pad: Pad, internal: Forces, law: Forces | None = None) -> None:
        self.pad, self.internal, self.law = pad, internal, law

    @cached_property
    def banded(self) -> Banded:
        return Banded(self.pad)

    def residual(self, x: Tensor) -> Tensor:
        """Contact less internal forces (..., nodes, 2) [N]."""
        pad = self.pad
        left = -pad.from_corners(self.internal(pad.at_corners(x)))
        return left if self.law is None else left + pad.spread.mT @ self.law(pad.spread @ x)

    def linearised(self, x: Tensor) -> list[Factor]:
        """Factors of the derivative of internal less contact forces, sample by sample."""
        pad = self.pad
        with torch.enable_grad():
            at = pad.at_corners(x).expand(8, *x.shape[:-2], -1, -1).clone().requires_grad_()
            each = self.internal(at).movedim(-1, 0).diagonal(0, 0, 1)  # a copy for each component
            (rows,) = torch.autograd.grad(each.sum(), at)
            elements = rows.movedim(0, -2).reshape(-1, *pad.corners.shape, 8)
            contacts = torch.zeros(len(elements), len(pad.spread), 2, 2, dtype=x.dtype)
            if self.law is not None:
                twice = torch.stack((pad.spread @ x,) * 2).requires_grad_()
                f = self.law(twice)
                total = (f[0, ..., 0] + f[1, ..., 1]).sum()
                (G,) = torch.autograd.grad(total, twice, materialize_grads=True)
                contacts = G.movedim(0, -2).reshape(contacts.shape)
        pairs = zip(elements.numpy(), contacts.numpy())
        return [self.banded.factor(*pair) for pair in pairs]

    @torch.no_grad()
    def found(
        self, first: Tensor, tolerance: float, iterations: int
    ) -> tuple[Tensor, list[Factor], float]:
        """The nodes from `first` (..., nodes, 2) on, the factors of the last iteration, and its
        largest step.

        Raises `FloatingPointError` where the matrix is singular.
        """
        x, factors, left = first.detach(), list[Factor](), np.inf
        r = self.residual(x)
        for _ in range(iterations):
            factors = self.linearised(x)
            step = solved(r.reshape(len(factors), -1), factors).reshape(r.shape)
            sizes = step.abs().amax((-2, -1))
            left, going = float(sizes.max()), sizes > tolerance
            if not bool(going.any()):
                break
            size, way = step.flatten(-2).norm(dim=-1), step * going[..., None, None]
            for _ in range(HALVINGS):  # until the step after it, with the same matrix, is shorter
                r = self.residual(x + way)
                after = solved(r.reshape(len(factors), -1), factors)
                worse = going & ~(after.norm(dim=-1).reshape(size.shape) < size)
                if not bool(worse.any()):
                    break
                way = way * torch.where(worse, 0.5, 1.0)[..., None, None]
            x = x + way
        return x, factors, left

    def corrected(self, x: Tensor, factors: list[Factor]) -> Tensor:
        """One iteration from the nodes x (..., nodes, 2) in balance, which gives them their
        derivative; `factors` sample by sample."""
        r = self.residual(x)
        step: Any = _Solved.apply(r.reshape(len(factors), -1), factors, False)
        return x + step.reshape(r.shape)
