"""Posterior draws by NUTS with exact gradients, also for a posterior that is not Gaussian.

A coordinate x between its bounds becomes y = logit((x - low) / (high - low)), whose density has the
additional factor dx/dy. y is whitened by the curvature at the optimum, so that the sampler sees
approximately a standard normal distribution.
"""

import importlib
import threading
import time as clock
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, log_expit, logit

from torchsoft.sysid.posterior import (
    CHECKED,
    Posterior,
    measure,
    notices_on_runs,
    notices_on_steps,
    steps_off,
)
from torchsoft.sysid.profile import Optimum
from torchsoft.sysid.recording import Array
from torchsoft.threads import single_threaded

EDGE = 1e-3
"""Least distance of the whitened coordinates' origin from a bound, over the width of the bounds."""

R_HAT, EFFECTIVE = 1.01, 100
"""Largest R-hat of mixed chains (Vehtari et al. 2021), and fewest effective draws for an
interval."""


class Failed(RuntimeError):
    """A failed run, which the sampler treats as a wall."""

    is_recoverable = True


class Whitened(NamedTuple):
    """Free coordinates as functions of z (n,): y = middle + A z, x = low + width expit(y)."""

    low: Array
    width: Array
    middle: Array
    A: Array

    @classmethod
    def of(cls, o: Optimum) -> "Whitened":
        low, high = o.bounds
        width = high - low
        u = np.clip((o.x[o.free] - low) / width, EDGE, 1 - EDGE)
        by_y = o.J * (width * u * (1 - u))
        precision = by_y.T @ by_y + np.diag(
            2 * u * (1 - u)
        )  # of the misfit, and of the factor dx/dy
        A: Any = np.linalg.inv(np.linalg.cholesky(precision)).T
        return cls(low, width, logit(u), A)

    def coordinates(self, z: Array) -> Array:
        return self.low + self.width * expit(self.middle + self.A @ z)

    def density(self, o: Optimum, z: Array) -> tuple[float, Array]:
        """Log posterior density of z, up to a constant, and its gradient (n,). Raises `Failed`."""
        y = self.middle + self.A @ z
        x, u = o.place(self.low + self.width * expit(y)), expit(y)
        value, gradient, reason = o.misfit(x)
        if reason:
            raise Failed(reason)
        more, by = measure(o, x)
        value = -value + more + float((log_expit(y) + log_expit(-y)).sum())
        return value, self.A.T @ ((by - gradient) * self.width * u * (1 - u) + 1 - 2 * u)


def sampler() -> Any:
    """nutpie. Raises `ImportError` with the remedy where it is missing."""
    try:
        with warnings.catch_warnings(action="ignore"):  # arviz announces its next edition
            importlib.import_module("nutpie.compiled_pyfunc")
            return importlib.import_module("nutpie")
    except ImportError as missing:
        raise ImportError("NUTS needs nutpie: pip install 'torchsoft[nuts]'") from missing


def nuts(
    o: Optimum, *, chains: int = 4, draws: int = 250, tune: int = 100, accept: float = 0.8,
    seed: int = 0, progress: bool = False,
) -> Posterior:  # fmt: skip
    """Posterior draws by the No-U-Turn sampler of nutpie, in `chains` that run side by side in the
    optimum's threads, after `tune` draws of each for step size and scales. A larger target
    acceptance rate `accept` makes steps shorter.

    A run that fails counts as a wall. Ctrl-C ends the sampling with the draws so far, if there are
    any. The same seed gives the same draws. Raises `ImportError` without nutpie, and `RuntimeError`
    where no start near the optimum can be simulated.
    """
    if chains < 1 or draws < 4 or tune < 20:
        raise ValueError(
            f"NUTS needs a chain, 4 draws and 20 for tuning at least, but has {chains}, {draws} "
            f"and {tune}"
        )
    package, white, lost = sampler(), Whitened.of(o), list[str]()
    n, began, gradients, lock = (
        len(white.low),
        clock.perf_counter(),
        o.runner.gradients,
        threading.Lock(),
    )

    def density(z: Array) -> tuple[float, Array]:
        try:
            return white.density(o, z)
        except Failed as failure:
            with lock:
                lost.append(str(failure))
            raise

    def start(number: int) -> Array:
        return np.random.default_rng([seed, number]).standard_normal(n)

    def expand(*_: Any) -> Callable[[Array], dict[str, Array]]:
        return lambda z: {"x": white.coordinates(z)}

    model = package.compiled_pyfunc.from_pyfunc(
        n,
        lambda: density,
        expand,
        [np.dtype("float64")],
        [(n,)],
        ["x"],
        make_initial_point_fn=start,
    )
    with single_threaded(), warnings.catch_warnings(action="ignore"):
        trace = package.sample(
            model, chains=chains, cores=min(chains, o.workers), draws=draws, tune=tune,
            target_accept=accept, seed=seed, progress_bar=progress,
        )  # fmt: skip
    z, stats = complete(trace, draws)
    seconds = clock.perf_counter() - began
    values = o.values(z)
    divergences, spent = int(stats["diverging"].sum()), o.runner.gradients - gradients
    notices = notices_on_runs(o, lost, spent)
    if z.shape[:2] != (chains, draws):
        notices.append(
            f"interrupted: there are {z.shape[1]} of {draws} draws from {z.shape[0]} of {chains} "
            "chains; intervals are rough"
        )
    rng = np.random.default_rng(seed)
    off = steps_off(o, z.reshape(-1, n)[rng.choice(z.shape[0] * z.shape[1], CHECKED)])
    notices += notices_on_steps(o, off)
    weights = np.full(z.shape[:2], 1.0 / (z.shape[0] * z.shape[1]))
    checks = {"divergences": divergences, "failed": len(lost), "steps_off": off}
    cost = {"simulations": 2 * CHECKED, "gradients": spent, "wall_s": seconds}
    made_by = {
        "nutpie": version("nutpie"),
        "seed": seed,
        "rtol": o.rtol,
        "chains": chains,
        "draws": draws,
        "tune": tune,
    }
    out = Posterior("nuts", list(o.labels), values, weights, checks, notices, cost, made_by)
    notices += mixing(out, divergences)
    return out


def complete(trace: Any, draws: int) -> tuple[Array, dict[str, Array]]:
    """Free coordinates (chains, draws, n) and sampler statistics (chains, draws), of the chains,
    cut to equal length, that retain most draws. Raises `KeyboardInterrupt` where an interruption
    left none."""
    z = trace.posterior["x"].values[:, :draws]
    length = np.isfinite(z).all(-1).sum(-1)
    order = np.argsort(-length, kind="stable")
    count = int(np.argmax(length[order] * np.arange(1, len(length) + 1))) + 1
    kept, end = np.sort(order[:count]), int(length[order[count - 1]])
    if end < 4:
        raise KeyboardInterrupt
    return z[kept, :end], {"diverging": trace.sample_stats["diverging"].values[kept, :end]}


def mixing(posterior: Posterior, divergences: int) -> list[str]:
    """Sentences on chains that have not mixed."""
    out, rows = [], posterior.marginals
    if divergences:
        out.append(
            f"{divergences} of {posterior.weights.size} draws diverged: the posterior has places "
            "that NUTS did not reach; take shorter steps (accept = 0.95), or tighter bounds and "
            "priors"
        )
    worst = max(rows, key=lambda row: row.r_hat or 0.0)
    if not (worst.r_hat or np.inf) <= R_HAT:
        out.append(
            f"the chains have not mixed: R-hat of {worst.label} is {worst.r_hat:.3f}; take more "
            "draws"
        )
    fewest = min(rows, key=lambda row: row.effective)
    if not fewest.effective >= EFFECTIVE:
        out.append(
            f"there are only {fewest.effective:.0f} independent draws of {fewest.label}: its "
            "interval is rough; take more draws"
        )
    return out
