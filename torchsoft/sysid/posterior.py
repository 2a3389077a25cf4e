"""Posterior draws: by Laplace's approximation with importance weights, and by NUTS with exact
gradients.

The density is that of the coordinates: exp(-|r|^2 / 2), with priors as rows of r, within the
bounds. A coordinate without a prior is uniform between its bounds.
"""

import importlib
import threading
import time as clock
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.special import expit, log_expit, logit
from tqdm import tqdm

from torchsoft.display import hidden
from torchsoft.extras import needed
from torchsoft.files import write_json
from torchsoft.parallel import parallel_map, single_threaded
from torchsoft.sysid.fit import Fit
from torchsoft.sysid.profile import CHOSEN_ANEW
from torchsoft.sysid.recording import Array

WITHIN = 1e-3
"""Least fraction of Gaussian draws within the bounds."""

K_HAT = 0.7
"""Largest shape of the tail of reliable importance weights (Vehtari et al. 2024)."""

EFFICIENT = 0.5
"""Fraction of effective draws below which Laplace's approximation counts as rough."""

SAME = 1e-6
"""Range of log weights below which they count as equal."""

ALIKE = 0.9
"""Fraction of effective draws above which the tail of the weights carries no information."""

LEAST = -700.0
"""Log weight, relative to the largest, that counts as zero."""

FEWEST = 100
"""Fewest draws that determine the tail of their weights."""

CHECKED = 8
"""Number of draws simulated once more, with steps chosen anew."""


@dataclass(frozen=True)
class MarginalSummary:
    """One coordinate's marginal posterior in physical units."""

    label: str
    mean: float
    sd: float
    median: float
    ci95: tuple[float, float]
    effective: float
    r_hat: float | None


@dataclass(frozen=True)
class Posterior:
    """Draws (chains, draws, n) of the free coordinates `labels` in physical units, with normalised
    `weights` (chains, draws), results of checks, notices, cost and provenance.

    An interrupted run has fewer draws than requested.
    """

    method: Literal["laplace", "nuts"]
    labels: list[str]
    draws: Array = field(repr=False)
    weights: Array = field(repr=False)
    checks: dict[str, float]
    notices: list[str]
    cost: dict[str, float]
    made_by: dict[str, Any]

    @property
    def flat(self) -> tuple[Array, Array]:
        """All draws (draws, n) and their weights (draws,)."""
        return self.draws.reshape(-1, len(self.labels)), self.weights.ravel()

    @property
    def marginals(self) -> list[MarginalSummary]:
        (draws, weights), known, out = self.flat, diagnostics(), []
        for i, label in enumerate(self.labels):
            q = [quantile(draws[:, i], weights, part) for part in (0.025, 0.5, 0.975)]
            mean = float(weights @ draws[:, i])
            sd = float(weights @ (draws[:, i] - mean) ** 2) ** 0.5
            r_hat, effective = None, 1.0 / float(weights @ weights)
            if self.method == "nuts":
                r_hat, effective = (
                    float(of(halves(self.draws[..., i]))) for of in (known.rhat, known.ess)
                )
            out.append(MarginalSummary(label, mean, sd, q[1], (q[0], q[2]), effective, r_hat))
        return out

    def save(self, path: str | Path) -> None:
        """Write the JSON file. It appears whole or not at all."""
        content = asdict(self) | {
            "draws": self.draws.tolist(),
            "weights": self.weights.tolist(),
            "marginals": [asdict(one) for one in self.marginals],
        }
        write_json(path, content)


def halves(chains: Array) -> Array:
    """Draws (chains, draws), with a single chain split in two."""
    return chains if len(chains) > 1 else chains[:, : chains.size // 2 * 2].reshape(2, -1)


def diagnostics() -> Any:
    """ArviZ's array functions, imported here since the import takes a second. Raises
    `ModuleNotFoundError` with the remedy where they are missing."""
    return needed("arviz_stats.base", "posterior").array_stats


def quantile(values: Array, weights: Array, part: float) -> float:
    """Quantile of weighted draws (draws,)."""
    order = np.argsort(values)
    return float(np.interp(part, np.cumsum(weights[order]) - weights[order] / 2, values[order]))


def measure(o: Fit, x: Array) -> tuple[float, Array]:
    """Log Jacobian factor between densities of values and of coordinates x (n,), and its gradient
    by the free coordinates: d value / d x where a prior is normal on a logarithmic scale, or
    log-normal on a linear one."""
    total, gradient = 0.0, np.zeros(len(x))
    for i, prior in o.problem.coordinates.priors:
        c = o.problem.coordinates.all[i]
        if c.scale == "log" and prior.kind == "normal":
            total, gradient[i] = total + float(x[i]), 1.0
        elif c.scale == "linear" and prior.kind == "log-normal":
            value = c.to_value(x[i])
            total, gradient[i] = total - float(np.log(value)), -c.slope(x[i]) / value
    return total, gradient[o.free]


def laplace(o: Fit, *, draws: int = 400, seed: int = 0, progress: bool = False) -> Posterior:
    """Draws of the Gaussian at the optimum, with the covariance of the Fisher matrix, within the
    bounds.

    The exact density at every draw, a run each, gives importance weights with Pareto smoothing.
    They correct a Gaussian that is roughly right, and their k-hat shows where it is not. Raises
    `ValueError` for fewer draws than `FEWEST`, and where hardly a draw is within the bounds,
    because the data do not determine all coordinates.
    """
    if draws < FEWEST:
        raise ValueError(
            f"Laplace's approximation is checked by at least {FEWEST} draws, not by {draws}"
        )
    rng, (low, high) = np.random.default_rng(seed), o.bounds
    runs, began = o.runner.simulations, clock.perf_counter()
    z, noise = inside(rng, o.x[o.free], o.covariance, low, high, draws)
    log_q = -0.5 * (noise**2).sum(-1)
    log_p, failures = np.full(draws, -np.inf), list[str]()

    def density(k: int) -> tuple[float, str]:
        x = o.place(z[k])
        at = o.residuals(x)
        if at.failed:
            return -np.inf, at.reason
        return measure(o, x)[0] - 0.5 * float(at.r @ at.r), ""

    with single_threaded(), tqdm(desc="Laplace", total=draws, disable=hidden(progress)) as bar:
        for k, (value, reason) in parallel_map(density, draws, o.runner.workers):
            log_p[k], failures = value, [*failures, reason] if reason else failures
            bar.update()
    w, k_hat = importance(log_p - log_q)
    share, limit = 1.0 / float(draws * (w @ w)), min(K_HAT, 1 - 1 / np.log10(draws))
    notices = notices_on_runs(o, failures, draws)
    if k_hat > limit and share < ALIKE:
        notices.append(
            "Laplace's approximation is not to be trusted here: the tail of its importance "
            f"weights has k = {k_hat:.2g} (at most {limit:.2g}); use NUTS"
        )
    elif share < EFFICIENT:
        notices.append(
            f"Laplace's approximation is rough here: its draws are worth {share:.0%} of as many; "
            "use them by their weights"
        )
    off = steps_off(o, z[np.argsort(log_q)[: CHECKED // 2].tolist() + list(range(CHECKED // 2))])
    notices += notices_on_steps(o, off)
    checks = {"k_hat": k_hat, "efficiency": share, "failed": len(failures), "steps_off": off}
    cost = {
        "simulations": o.runner.simulations - runs,
        "gradients": 0,
        "wall_s": clock.perf_counter() - began,
    }
    return Posterior(
        "laplace",
        list(o.labels),
        o.values(z)[None],
        w[None],
        checks,
        notices,
        cost,
        {"seed": seed, "rtol": o.rtol},
    )


def importance(log_weights: Array) -> tuple[Array, float]:
    """Normalised importance weights (draws,) with Pareto smoothing, and the shape k of their tail,
    infinite where a few draws have all the weight. Draws without density have zero weight."""
    known = np.isfinite(log_weights)
    log_w, k_hat = log_weights[known] - log_weights[known].max(), -np.inf
    if np.ptp(log_w) > SAME:
        with np.errstate(divide="ignore", invalid="ignore"):
            smoothed, k_hat = diagnostics().psislw(
                -np.maximum(log_w, LEAST)
            )  # it takes weights' inverses
        log_w, k_hat = (smoothed, k_hat) if np.isfinite(smoothed).all() else (log_w, np.inf)
    w = np.zeros(len(log_weights))
    w[known] = np.exp(log_w - np.max(log_w))
    return w / w.sum(), float(k_hat)


def inside(
    rng: np.random.Generator, mean: Array, C: Array, low: Array, high: Array, count: int
) -> tuple[Array, Array]:
    """Normal draws (count, n) with covariance C (n, n) within bounds, and the standard normal draws
    behind them."""
    L, kept, tried = np.linalg.cholesky(C).T, np.zeros((0, len(mean))), 0
    while len(kept) < count and tried < count / WITHIN:
        noise = rng.standard_normal((4 * count, len(mean)))
        z = mean + noise @ L
        kept, tried = (
            np.concatenate((kept, noise[((z >= low) & (z <= high)).all(-1)])),
            tried + len(noise),
        )
    if len(kept) < count:
        raise ValueError(
            f"fewer than one in {1 / WITHIN:.0f} draws of the Gaussian at the optimum lie within "
            "the bounds: the data do not determine all coordinates, and Laplace's approximation "
            "says nothing; use NUTS, or priors"
        )
    return mean + kept[:count] @ L, kept[:count]


def steps_off(o: Fit, z: Array) -> float:
    """Largest change of |r|^2 by steps chosen anew, at free coordinates z (k, free coordinates);
    infinite where a run fails."""
    off = [o.step_effect(o.place(one)) for one in z]
    return float(np.max(np.where(np.isnan(off), np.inf, np.abs(off))))


def notices_on_steps(o: Fit, off: float) -> list[str]:
    if off <= CHOSEN_ANEW:
        return []
    return [
        f"steps chosen anew at some draws change |r|^2 by {off:.2g}: take a tighter tolerance than "
        f"rtol = {o.rtol:g}"
    ]


def notices_on_runs(o: Fit, failures: Sequence[str], runs: int) -> list[str]:
    """Sentences on failed runs, and on residuals larger than the noise."""
    m = o.problem.samples(o.which)
    chi2, out = o.square / m, []
    if failures:
        out.append(
            f"{len(failures)} of {runs} runs failed, so the posterior ends there: {failures[0]}"
        )
    if chi2 > 1 + 4 * np.sqrt(2 / m):
        out.append(
            f"the residuals are larger than the noise that was given (chi2 = {chi2:.3g}): the "
            "model or the noise is wrong, and the posterior with them"
        )
    return out


# Posterior draws by NUTS with exact gradients, also for a posterior that is not Gaussian.
#
# A coordinate x between its bounds becomes y = logit((x - low) / (high - low)), whose density has
# the additional factor dx/dy. y is whitened by the curvature at the optimum, so that the sampler
# sees approximately a standard normal distribution.


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
    def of(cls, o: Fit) -> "Whitened":
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

    def density(self, o: Fit, z: Array) -> tuple[float, Array]:
        """Log posterior density of z, up to a constant, and its gradient (n,). Raises `Failed`."""
        y = self.middle + self.A @ z
        x, u = o.place(self.low + self.width * expit(y)), expit(y)
        value, gradient, failed = o.misfit(x)
        for one in failed.values():
            raise Failed(one.reason)
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
    o: Fit,
    *,
    chains: int = 4,
    draws: int = 250,
    tune: int = 100,
    accept: float = 0.8,
    seed: int = 0,
    progress: bool = False,
) -> Posterior:
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
    package, white, failures = sampler(), Whitened.of(o), list[str]()
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
                failures.append(str(failure))
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
            model,
            chains=chains,
            cores=min(chains, o.runner.workers),
            draws=draws,
            tune=tune,
            target_accept=accept,
            seed=seed,
            progress_bar=progress,
        )
    z, stats = complete(trace, draws)
    seconds = clock.perf_counter() - began
    values = o.values(z)
    divergences, spent = int(stats["diverging"].sum()), o.runner.gradients - gradients
    notices = notices_on_runs(o, failures, spent)
    if z.shape[:2] != (chains, draws):
        notices.append(
            f"interrupted: there are {z.shape[1]} of {draws} draws from {z.shape[0]} of {chains} "
            "chains; intervals are rough"
        )
    rng = np.random.default_rng(seed)
    off = steps_off(o, z.reshape(-1, n)[rng.choice(z.shape[0] * z.shape[1], CHECKED)])
    notices += notices_on_steps(o, off)
    weights = np.full(z.shape[:2], 1.0 / (z.shape[0] * z.shape[1]))
    checks = {"divergences": divergences, "failed": len(failures), "steps_off": off}
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
