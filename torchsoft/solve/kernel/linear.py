"""Linear solves of a stage and other operations on arrays, in place and without allocation.

Inner loops run over views from 0 on: an index that might be negative, as Python allows, keeps a
loop from being vectorised.
"""

from torchsoft.solve.kernel import compiled
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
def carry(factor: float, x: Array, y: Array, back: bool) -> None:
    """Add a multiple of vector x to y, or `back` of y to x: the transpose."""
    if back and x.size == 1:  # without the cost of a loop
        x[0] += factor * y[0]
    elif back:
        add(factor, y, x)
    else:
        add(factor, x, y)


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
        inverse, pivot, right = 1.0 / A[k, k], A[k, k + 1 : n], b[k, :m]
        for i in range(k + 1, n):
            factor = A[i, k] * inverse
            if factor != 0.0:
                row, other = A[i, k + 1 : n], b[i, :m]
                add(-factor, pivot, row)
                add(-factor, right, other)
    for k in range(n - 1, -1, -1):
        inverse, right = 1.0 / A[k, k], b[k, :m]
        for i in range(k + 1, n):
            add(-A[k, i], b[i], right)
        for j in range(m):
            right[j] *= inverse


@compiled
def bounds(start: Array, i: int) -> slice:
    """Entries of part i among parts that lie one after the other."""
    return slice(start[i], start[i + 1])


# Banded matrices: entry (i, j) of row i stands at i (2 band + 1) + j - i + band.


@compiled
def factor_banded(A: Array, n: int, band: int) -> None:
    """L U of a banded matrix in place, L with ones on its diagonal. Rows are not exchanged: the
    matrices of pads are positive definite up to small parts."""
    width = 2 * band + 1
    for k in range(n):
        last = min(n, k + band + 1)
        inverse = 1.0 / A[k * width + band]
        right = A[k * width + band + 1 : k * width + band + last - k]
        for i in range(k + 1, last):
            at = i * width + band + k - i
            factor = A[at] * inverse
            A[at] = factor
            if factor != 0.0:
                add(-factor, right, A[at + 1 : at + last - k])


@compiled
def dot_of_four(x: Array, y: Array) -> float:
    """Product of two vectors of x's length, as four sums, which do not wait for each other."""
    a = b = c = d = 0.0
    end = x.size - x.size % 4
    for i in range(0, end, 4):
        a += x[i] * y[i]
        b += x[i + 1] * y[i + 1]
        c += x[i + 2] * y[i + 2]
        d += x[i + 3] * y[i + 3]
    for i in range(end, x.size):
        a += x[i] * y[i]
    return (a + b) + (c + d)


@compiled
def solve_one_banded(A: Array, n: int, band: int, b: Array) -> None:
    """Solution of A x = b (n,) in place; A is factorised."""
    width = 2 * band + 1
    for i in range(n):
        k = max(0, i - band)
        b[i] -= dot_of_four(A[i * width + band + k - i : i * width + band], b[k:i])
    for i in range(n - 1, -1, -1):
        last = min(n, i + band + 1)
        at = i * width + band
        b[i] = (b[i] - dot_of_four(A[at + 1 : at + last - i], b[i + 1 : last])) / A[at]


@compiled
def solve_banded(A: Array, n: int, band: int, b: Array, m: int, first: int) -> None:
    """Solution of A x = b for the m right-hand sides b (n m,), row by row, zero before row `first`,
    in place; A is factorised."""
    if m == 1:
        solve_one_banded(A, n, band, b)
        return
    width = 2 * band + 1
    for i in range(first, n):
        row = b[i * m : (i + 1) * m]
        for k in range(max(first, i - band), i):
            factor = A[i * width + band + k - i]
            if factor != 0.0:
                add(-factor, b[k * m : (k + 1) * m], row)
    for i in range(n - 1, -1, -1):
        row = b[i * m : (i + 1) * m]
        for k in range(i + 1, min(n, i + band + 1)):
            add(-A[i * width + band + k - i], b[k * m : (k + 1) * m], row)
        inverse = 1.0 / A[i * width + band]
        for j in range(m):
            row[j] *= inverse


@compiled
def solve_transposed(A: Array, n: int, band: int, b: Array) -> None:
    """Solution of A^T x = b (n,) in place; A is factorised."""
    width = 2 * band + 1
    for i in range(n):
        last = min(n, i + band + 1)
        b[i] /= A[i * width + band]
        add(-b[i], A[i * width + band + 1 : i * width + band + last - i], b[i + 1 : last])
    for i in range(n - 1, -1, -1):
        first = max(0, i - band)
        add(-b[i], A[i * width + band + first - i : i * width + band], b[first:i])
