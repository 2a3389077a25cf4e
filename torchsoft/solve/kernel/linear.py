"""Small linear solves of a stage and other operations on arrays, in place and without allocation.

Inner loops run over views from 0 on: an index that might be negative, as Python allows, keeps a
loop from being vectorised.
"""

from torchsoft.solve.kernel import compiled, inlined
from torchsoft.solve.kernel.table import Array


@compiled
def put(values: Array, out: Array) -> None:
    """Copy an array into another of the same shape."""
    for i in range(out.size):
        out.flat[i] = values.flat[i]


@compiled
def add(factor: float, x: Array, out: Array) -> None:
    """Add a multiple of a vector to another one, of out's length."""
    for i in range(out.size):
        out[i] += factor * x[i]


@compiled
def dot(x: Array, y: Array) -> float:
    """Product of two vectors, of x's length."""
    total = 0.0
    for i in range(x.size):
        total += x[i] * y[i]
    return total


@compiled
def solve_dense(A: Array, b: Array, n: int, m: int) -> None:
    """Gaussian elimination with row pivoting on the leading n x n block; b (n, m) becomes the
    solution."""
    for k in range(n):
        p = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[p, k]):
                p = i
        if p != k:
            for j in range(k, n):
                A[k, j], A[p, j] = A[p, j], A[k, j]
            for j in range(m):
                b[k, j], b[p, j] = b[p, j], b[k, j]
        inverse, own, right = 1.0 / A[k, k], A[k, k + 1 : n], b[k, :m]
        for i in range(k + 1, n):
            factor = A[i, k] * inverse
            if factor != 0.0:
                row, other = A[i, k + 1 : n], b[i, :m]
                add(-factor, own, row)
                add(-factor, right, other)
    for k in range(n - 1, -1, -1):
        inverse, right = 1.0 / A[k, k], b[k, :m]
        for i in range(k + 1, n):
            add(-A[k, i], b[i], right)
        for j in range(m):
            right[j] *= inverse


@inlined
def row_of(matrices: Array, start: int, i: int, size: int) -> Array:
    """Row i of the (size, size) matrix that begins at `start`, a view."""
    return matrices[start + i * size : start + (i + 1) * size]


@compiled
def bounds(start: Array, i: int) -> slice:
    """Entries of part i among parts that lie one after the other."""
    return slice(start[i], start[i + 1])


@compiled
def solve_banded(factor: Array, b: Array) -> None:
    """Solve L L^T x = b in place, L in scipy's lower banded storage."""
    band, n = factor.shape
    for i in range(n):
        b[i] /= factor[0, i]
        for k in range(1, min(band, n - i)):
            b[i + k] -= factor[k, i] * b[i]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for k in range(1, min(band, n - i)):
            total -= factor[k, i] * b[i + k]
        b[i] = total / factor[0, i]
