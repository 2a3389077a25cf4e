"""`identify`: carry out a plan of stages, then state how certain the result is and what is not identifiable."""

import sys
import time as clock
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from torchsoft.sysid.answer.result import IdentificationResult
from torchsoft.sysid.checks.colour import Coloured, allow_for_colour
from torchsoft.sysid.conclude import How, conclude
from torchsoft.sysid.fit.fit import Fit, Notify, Unreachable, chord, descend, gauss_newton
from torchsoft.sysid.fit.plan import Stage, default_plan
from torchsoft.sysid.fit.robust import Loss
from torchsoft.sysid.fit.stages import Method, progress_bar, run_stage, stage_entry
from torchsoft.sysid.prechecks.finding import accepted
from torchsoft.sysid.prechecks.prechecks import check
from torchsoft.sysid.problem.problem import Problem, Residuals
from torchsoft.sysid.problem.recording import Array
from torchsoft.sysid.problem.workers import Runner
from torchsoft.sysid.settings import RTOL, Assumed, Settings
from torchsoft.tables import plain


def identify(
    problem: Problem, *, rtol: float = RTOL, plan: Sequence[Stage] | None = None, starts: int = 1, loss: Loss = "linear",
    method: Method = "gauss_newton", heldout: Sequence[str] = (), workers: int = 1, checkpoint: str | Path | None = None,
    progress: bool = False, seed: int = 0, tightenings: int = 2, assumptions: Assumed = "checked",
    acknowledged: Sequence[str] = (),
) -> IdentificationResult:  # fmt: skip
    """Find the unknown parameters of `problem`, with intervals, and find which of them the data do not determine.

    Every stage of the `plan` (`default_plan` by default, whose first stage is begun from `starts` Sobol points by `seed`)
    freezes the steps that its tolerance chooses at its start, one sequence a recording, so that residuals are smooth in the
    unknowns. `rtol` is the last stage's. At the end a run with a tenth of it tells how far the steps shift the estimates:
    where that is more than `STEP_BIAS` standard deviations, the fit goes on with a tenth of the tolerance, up to
    `tightenings` times (with the linear loss). `loss` is scipy's robust loss; `method` may descend on the adjoint instead,
    with the linear loss only.
    Recordings named in `heldout` are predicted, not fitted; `workers` threads run side by side. With a `checkpoint`
    folder every run is kept there: an identification that was interrupted, called again with the same arguments, continues
    where it was.

    At the end the assumptions (mesh, touch-down ramp, place of the disc, numbers that are called known, faults of sensors, the
    friction law) are tested to first order, a run each, and intervals allow for constants of the computation that the data
    cannot tell. Where no test explains a misfit, a notice names the candidates, and `explain` tries them. Before the fit
    recordings are held against what such a rig can do at all: signs, units, delays, zeros, set-points, the body that a loop
    senses; `acknowledged` names findings that are no mistakes. With `assumptions` = "trusted" both are left out.

    Raises `ValueError` for what `Settings` does not take, and for recordings that are not there or cannot be what they are
    taken for, `Unreachable` where the model cannot follow the data.
    """
    unknown = set(heldout) - set(problem.names)
    if unknown or len(set(heldout)) == len(problem.recordings):
        raise ValueError(f"`heldout` must name some of {list(problem.names)}, but not all; it is {list(heldout)}")
    settings = Settings(
        rtol=rtol, starts=starts, loss=loss, method=method, workers=workers, seed=seed, tightenings=tightenings,
        assumptions=assumptions,
    )  # fmt: skip
    if plan is not None and (starts > 1 or rtol not in (RTOL, *(stage.rtol for stage in plan))):
        raise ValueError("`starts` and `rtol` are those of the default plan: say them of the stages of `plan` instead")
    fitted, began = [name for name in problem.names if name not in heldout], clock.perf_counter()
    runner = Runner(problem.recordings, workers, Path(checkpoint) if checkpoint is not None else None)
    looks = accepted(check(problem, runner, fitted), acknowledged) if assumptions != "trusted" else []
    for look in looks if progress else ():
        tqdm.write(plain(f"note: {look}"), file=sys.stderr)
    x, fit, stages = problem.coordinates.start, None, []
    with explained(looks):
        if plan is None:
            plan = default_plan(problem, runner, rtol, fitted, starts)
        for number, stage in enumerate(plan):
            before = clock.perf_counter()
            with progress_bar(f"{number + 1}/{len(plan)} {stage.name}", progress) as bar:
                fit = run_stage(problem, runner, stage, x, loss, method, seed + number, bar)
            x = fit.x
            stages.append(stage_entry(stage.name, stage, stage.rtol, fit, before))
    if fit is None:
        raise ValueError("`plan` has no stages")
    before = clock.perf_counter()
    with progress_bar("colour of the noise", progress) as bar:
        coloured = with_its_noise(problem, runner, plan[-1], fit, loss, method, bar)
    stages += [
        stage_entry("with the noise that was found", plan[-1], plan[-1].rtol, one, before) for one in coloured.fits
    ]
    how = How(fitted, tuple(heldout), tuple(acknowledged), settings)
    return conclude(coloured, runner, plan[-1], stages, how, looks, began, progress)


def explain(problem: Problem, **how: Any) -> IdentificationResult:
    """Identify, and look for the cause of a misfit that no test of an assumption explains to first order.

    The fit is repeated without one assumption after the other (another law, number, mesh, place, sensor) until one explains the
    data: some minutes each, with progress that names it. Takes the arguments of `identify`, and with its `checkpoint` begins
    where that ended; Ctrl-C keeps what was tried. Raises what `identify` does.
    """
    return identify(problem, **how, assumptions="explained")


@contextmanager
def explained(looks: Sequence[str]) -> Iterator[None]:
    """Tells whom the model cannot follow the data what looked wrong with the recordings themselves."""
    try:
        yield
    except Unreachable as error:
        raise Unreachable(error.lost, looks) from None


def with_its_noise(
    problem: Problem, runner: Runner, stage: Stage, fit: Fit, loss: Loss, method: Method, notify: Notify
) -> Coloured:
    """The fit of the last stage, gone on with whatever noise it leaves: by new Jacobians, then by the last one."""
    free, which = np.isin(problem.coordinates.labels, stage.free), stage.recordings
    common: dict[str, Any] = {"which": which, "free": free, "steps": fit.steps, "notify": notify}

    def residuals(one: Problem, x: Array) -> Residuals:
        return one.residuals(runner, x, which, fit.steps, free)

    def refit(one: Problem, last: Fit, number: int) -> Fit:
        if number > 0 and loss == "linear" and last.at is not None:
            return chord(one, runner, last.x, last.at, **common)
        if method == "gauss_newton":
            more: dict[str, Any] = {"evaluations": stage.evaluations, "tolerance": stage.tolerance, "loss": loss}
            return gauss_newton(one, runner, last.x, first=last.at, **more, **common)
        end = descend(one, runner, last.x, method=method, evaluations=4 * stage.evaluations, **common)
        return end._replace(at=residuals(one, end.x))

    return allow_for_colour(problem, fit._replace(at=fit.at or residuals(problem, fit.x)), free, which, refit)
