"""A relaxation series as a Kelvin chain: the same linear viscoelastic solid, asked for its creep.

With E(t) = E (1 + sum of m_i exp(-t / t_i)) stress over strain is E (1 + sum of m_i s t_i / (1 + s t_i)) at a complex frequency
s. Its zeros s = -1/tau are the rates of creep: tau are the roots of

    1 = sum of m_i t_i / (tau - t_i),

the eigenvalues of diag(t) + v v^T with v_i^2 = m_i t_i. Each lies above its own relaxation time and below the next one.
"""

import numpy as np
import torch
from scipy.linalg.lapack import dlasd4  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor


def retarded(m: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Fractions J (n + 1,) [1] of the relaxed compliance, which sum to one, and retardation times tau (n,) [s] of the solid
    with moduli E m (n,), m > 0, and distinct relaxation times t (n,) [s]; J[0] is the instantaneous spring's.

    The roots come from LAPACK's secular equation, with the distances tau - t_i to full relative precision, whatever
    decades the times span; one Newton step with the gradient on makes their derivative the implicit function theorem's
    (so a second derivative is not exact). Raises `ValueError` for moduli or times that are not positive, and equal times.
    """
    t, order = t.sort()
    if not (bool((m > 0).all()) and bool((t > 0).all()) and bool((t.diff() > 0).all())):
        raise ValueError("a relaxation series needs positive moduli and positive times, no two of them equal")
    m = m[order]
    with torch.no_grad():
        apart = distances(m, t)  # tau_k - t_i
        slope = (m * t / apart**2).sum(-1)
        roots = t + apart.diagonal()
    apart = apart - (t - t.detach())
    step = ((m * t / apart).sum(-1) - 1) / slope
    tau, apart = roots + step, apart + step[:, None]
    J = 1 / (tau * (m * t / apart**2).sum(-1))
    return torch.cat((1 / (1 + m.sum())[None], J)), tau


def distances(m: Tensor, t: Tensor) -> Tensor:
    """tau_k - t_i (n, n) [s] for increasing times t (n,)."""
    if len(t) == 1:
        return (m * t)[:, None]
    v, d = (m * t).sqrt().numpy(), t.sqrt().numpy()
    size = float(np.linalg.norm(v))
    rows = []
    for k in range(len(d)):
        minus, _, plus, failed = dlasd4(k, d, v / size, size**2)  # t_i^1/2 -+ tau_k^1/2
        assert not failed
        rows.append(-minus * plus)
    return torch.from_numpy(np.stack(rows))
