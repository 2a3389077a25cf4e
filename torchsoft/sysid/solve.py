"""`identify`: carry out a plan of stages, then state how certain the result is and what is not identifiable."""

import time as clock
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.sysid.fit import Fit, Loss, Notify, Unreachable, descend, gauss_newton
from torchsoft.sysid.information import fisher
from torchsoft.sysid.plan import LOOSE, Stage, default_plan
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array
from torchsoft.sysid.result import IdentificationResult, directions, estimates, nrmse, residual_channels
from torchsoft.sysid.settle import FINER, STEP_BIAS, settle
from torchsoft.sysid.workers import Runner

Method = Literal["gauss_newton", "lbfgs", "adam"]

RTOL = 1e-5
"""Relative tolerance of the last stage: derivatives are then right to some percent, and estimates to a fraction of a standard
deviation where sensors are as good as `RIG`."""

COLOUR_LIMIT = 0.5
"""Residuals over the noise below which their colour does not matter: data without noise."""

MISFIT = 1.2
"""chi2 above which the model, or the noise that was given, is called wrong."""


def identify(
    problem: Problem, *, rtol: float = RTOL, plan: Sequence[Stage] | None = None, starts: int = 1, loss: Loss = "linear",
    method: Method = "gauss_newton", heldout: Sequence[str] = (), workers: int = 1, checkpoint: str | Path | None = None,
    progress: bool = False, seed: int = 0, tightenings: int = 2,
) -> IdentificationResult:  # fmt: skip
    """Find the unknown parameters of `problem`, with intervals, and find which of them the data do not determine.

    Every stage of the `plan` (`default_plan` by default, whose first stage is begun from `starts` Sobol points by `seed`)
    freezes the steps that its tolerance chooses at its start, one sequence a recording, so that residuals are smooth in the
    unknowns. `rtol` is the last stage's. At the end a run with a tenth of it tells how far the steps shift the estimates:
    where that is more than `STEP_BIAS` standard deviations, the fit goes on with a tenth of the tolerance, up to
    `tightenings` times (with the linear loss). `loss` is scipy's robust loss; `method` may descend on the adjoint instead.
    Recordings named in `heldout` are predicted, not fitted; `workers` threads run side by side. With a `checkpoint`
    folder every run is kept there: an identification that was interrupted, called again with the same arguments, continues
    where it was.

    Raises `ValueError` for recordings that are not there, `Unreachable` where the model cannot follow the data.
    """
    unknown = set(heldout) - set(problem.names)
    if unknown or len(set(heldout)) == len(problem.recordings):
        raise ValueError(f"`heldout` must name some of {list(problem.names)}, but not all; it is {list(heldout)}")
    if rtol <= 0 or starts < 1 or tightenings < 0:
        raise ValueError(
            f"`rtol` and `starts` must be positive and `tightenings` not negative, but are {rtol}, {starts} and {tightenings}"
        )
    fitted, began = [name for name in problem.names if name not in heldout], clock.perf_counter()
    runner = Runner(problem.recordings, workers, Path(checkpoint) if checkpoint is not None else None)
    if plan is None:
        plan = default_plan(problem, runner, rtol, fitted, starts)
    x, fit, stages = problem.coordinates.start, None, []
    for number, stage in enumerate(plan):
        before = clock.perf_counter()
        with progress_bar(f"{number + 1}/{len(plan)} {stage.name}", progress) as bar:
            fit = run_stage(problem, runner, stage, x, loss, method, seed + number, bar)
        x = fit.x
        stages.append(stage_entry(stage.name, stage, stage.rtol, fit, before))
    if fit is None:
        raise ValueError("`plan` has no stages")
    return build_result(
        problem, runner, plan[-1], fit, fitted, list(heldout), stages, method, loss, seed, began, tightenings, progress
    )


def stage_entry(name: str, stage: Stage, rtol: float, fit: Fit, began: float) -> dict[str, Any]:
    """The result's entry on a stage that began at `began` on the clock [s]."""
    return {
        "name": name, "recordings": list(stage.recordings), "free": list(stage.free), "rtol": rtol,
        "evaluations": fit.evaluations, "chi2": fit.chi2, "converged": fit.converged,
        "wall_s": clock.perf_counter() - began,
    }  # fmt: skip


@contextmanager
def progress_bar(label: str, shown: bool) -> Iterator[Notify]:
    """Shows the progress of one stage: call it with chi2 after every evaluation."""
    with tqdm(desc=label, unit=" evaluations", disable=not shown) as bar:

        def notify(chi2: float) -> None:
            bar.set_postfix_str(f"chi2 = {chi2:.4g}", refresh=False)
            bar.update()

        yield notify


def run_stage(
    problem: Problem, runner: Runner, stage: Stage, x: Array, loss: Loss, method: Method, seed: int, notify: Any
) -> Fit:
    """One stage from x: ties, scans, Sobol starts, fit on the steps of each start; the best fit. Raises `Unreachable` where no
    start can be simulated."""
    c = problem.coordinates
    for label in (*stage.free, *(label for label, _ in (*stage.tied, *stage.scanned))):
        if label not in c.labels:
            raise ValueError(f"stage `{stage.name}` names {label!r}; the coordinates are {', '.join(c.labels)}")
    free, x = np.isin(c.labels, stage.free), x.copy()
    for label, value in stage.tied:
        i = c.labels.index(label)
        x[i] = c.all[i].to_x(value)
    for label, values in stage.scanned:
        x = scan(problem, runner, stage, x, c.labels.index(label), values, notify)
    best: Fit | None = None
    failure: Unreachable | None = None
    for start in (x, *sobol(problem, x, free, stage, seed)):
        try:
            wanted = free if method == "gauss_newton" else None
            first, steps = problem.freeze(runner, start, stage.recordings, stage.rtol, wanted)
            if first.lost:
                raise Unreachable(first.lost)
            common: dict[str, Any] = {"which": stage.recordings, "free": free, "steps": steps, "notify": notify}
            if method == "gauss_newton":
                fit = gauss_newton(
                    problem, runner, start, evaluations=stage.evaluations, tolerance=stage.tolerance, loss=loss, first=first,
                    **common,
                )  # fmt: skip
            else:
                fit = descend(problem, runner, start, method=method, evaluations=4 * stage.evaluations, **common)
        except Unreachable as lost:
            failure = failure or lost
            continue
        if best is None or fit.chi2 < best.chi2:
            best = fit
    if best is None:
        assert failure is not None
        raise failure
    return best


def scan(
    problem: Problem, runner: Runner, stage: Stage, x: Array, i: int, values: Sequence[float], notify: Notify
) -> Array:
    """x with the one of the values for coordinate number i that fits best, the others held; all are run side by side."""
    rtol = max(LOOSE, stage.rtol)
    trials = [x.copy() for _ in values]
    for trial, value in zip(trials, values):
        trial[i] = problem.coordinates.all[i].to_x(value)
    jobs = [problem.jobs(trial, stage.recordings, rtol, None) for trial in trials]
    runs = iter(runner.run([job for some in jobs for job in some]))
    misfits = []
    for trial, some in zip(trials, jobs):
        misfits.append(float(np.mean(problem.gather(trial, some, [next(runs) for _ in some]).r ** 2)))
        notify(misfits[-1])
    return trials[int(np.argmin(misfits))]


def sobol(problem: Problem, x: Array, free: NDArray[np.bool_], stage: Stage, seed: int) -> list[Array]:
    """`stage.starts` - 1 more points within the stage's spread of x, in the free coordinates and within the bounds."""
    if stage.starts == 1:
        return []
    low, high = problem.coordinates.bounds
    reach = np.array([np.log(stage.spread) if c.scale == "log" else 0.5 for c in problem.coordinates.all])
    low, high = np.maximum(low, x - reach), np.minimum(high, x + reach)
    power = (stage.starts - 1).bit_length()
    points = qmc.Sobol(int(free.sum()), rng=np.random.default_rng(seed)).random_base2(power)[: stage.starts - 1]
    out = []
    for u in points:
        start = x.copy()
        start[free] = low[free] + u * (high - low)[free]
        out.append(start)
    return out


def build_result(
    problem: Problem, runner: Runner, stage: Stage, fit: Fit, fitted: list[str], heldout: list[str],
    stages: list[dict[str, Any]], method: Method, loss: Loss, seed: int, began: float, tightenings: int, progress: bool,
) -> IdentificationResult:  # fmt: skip
    """The result at the end of a fit."""
    c = problem.coordinates
    free, start = np.isin(c.labels, stage.free), clock.perf_counter()
    with progress_bar("check of the steps", progress) as notify:
        end = settle(problem, runner, stage, fit, free, tightenings if loss == "linear" else 0, notify)
    x, at, rtol = end.x, end.at, end.rtol
    for number, (by, one) in enumerate(end.fits):
        name = "steps chosen anew" if by == (end.fits[number - 1][0] if number else stage.rtol) else "tighter tolerance"
        stages = [*stages, stage_entry(name, stage, by, one, start)]
    C_free, values, vectors = fisher(at.J[:, free])
    C, shift = np.zeros((len(x), len(x))), np.zeros(len(x)) if end.bias is None else end.bias
    chi2 = float(at.r @ at.r) / max(len(at.r) - int(free.sum()), 1)
    C[np.ix_(free, free)] = C_free * max(1.0, chi2)
    labels = [label for label, one in zip(c.labels, free) if one]
    found = estimates(problem, x, free, C, shift)
    predicted, notices = {}, []
    if heldout:
        held = problem.residuals(runner, x, heldout, rtol)
        if held.lost:
            notices += [f"held-out recording `{k}` could not be simulated: {v.reason}" for k, v in held.lost.items()]
        else:
            predicted = nrmse(problem, held.r, heldout)
    sd = np.sqrt(np.diag(C_free))
    channels = residual_channels(problem, at, fitted)
    notices += notices_on(found, chi2, fit.converged, rtol, end.bias is None, channels)
    return IdentificationResult(
        estimates=found,
        labels=labels,
        x=[float(v) for v in x],
        correlation=(C_free / np.outer(sd, sd)).tolist(),
        directions=directions(labels, values, vectors),
        chi2=chi2,
        converged=fit.converged,
        residuals=channels,
        heldout=predicted,
        notices=notices,
        stages=stages,
        cost={
            "simulations": runner.simulations, "jacobians": runner.jacobians, "gradients": runner.gradients,
            "remembered": runner.remembered, "data_seconds": sum(r.duration for r in problem.recordings if r.name in fitted),
            "samples": len(at.r), "wall_s": clock.perf_counter() - began,
        },
        made_by={
            "torchsoft": version("torchsoft"), "method": method, "loss": loss, "seed": seed, "rtol": rtol,
            "workers": runner.workers,
            "unknowns": {name: u.model_dump() for name, u in problem.unknowns.items()},
            "sensors": {name: s.model_dump() for name, s in problem.sensors.items()},
            "recordings": {r.name: r.fingerprint for r in problem.recordings},
        },
        covariance=C.tolist(),
    )  # fmt: skip


def notices_on(
    found: list[Any], chi2: float, converged: bool, rtol: float, unchecked: bool, channels: list[Any]
) -> list[str]:
    """Sentences on what a reader must know before using the numbers."""
    out = []
    for e in found:
        if not e.identifiable:
            change = f"a change by {e.relative_sd:.0%}" if e.relative_sd < 9 else "a change by a factor of ten"
            out.append(f"{e.name} is not identifiable from these data: {change} would not show in them")
        if e.at_bound:
            out.append(f"{e.name} ended at a bound ({e.last:.4g}): widen the bound or question the model")
    worst = max(found, key=lambda e: abs(e.step_bias_sd), default=None)
    if unchecked:
        out.append(f"the tolerance rtol = {rtol:g} could not be checked: a run failed that was made to check it")
    elif worst is not None and abs(worst.step_bias_sd) > STEP_BIAS:
        out.append(
            f"the tolerance rtol = {rtol:g} is too coarse for these data: it shifts {worst.name} by "
            f"{abs(worst.step_bias_sd):.2g} standard deviations ({worst.step_bias_sd * worst.relative_sd:+.2%}); take "
            f"rtol = {FINER * rtol:g}"
        )
    if chi2 > MISFIT:
        out.append(
            f"chi2 = {chi2:.3g}: the residuals are larger than the noise that was given; intervals are widened by "
            f"{chi2**0.5:.2g}, and the model may be wrong"
        )
    if not converged:
        out.append("the last stage stopped before it converged: give it more evaluations")
    coloured = [f"{r.channel} of {r.recording}" for r in channels if r.p_white < 1e-3 and r.rms > COLOUR_LIMIT]
    if coloured:
        out.append(f"residuals are not white in {', '.join(coloured)}: something systematic is left")
    return out
