"""How one stage of an identification is carried out: ties, scans, starts, and a fit on frozen steps."""

import time as clock
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from torchsoft.sysid.fit.fit import Fit, Notify, Unreachable, descend, gauss_newton
from torchsoft.sysid.fit.plan import LOOSE, Stage
from torchsoft.sysid.fit.robust import Loss
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner
from torchsoft.tables import plain

Method = Literal["gauss_newton", "lbfgs", "adam"]


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
    with tqdm(desc=plain(label), unit=" evaluations", disable=not shown) as bar:

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
