"""What an identification will cost."""

from collections.abc import Iterable

from torchsoft.cost import RUN, Cost, row_memory, step_seconds, steps_per_second
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp
from torchsoft.sysid.plan import ALL, FINER, FIRST, FREE, LAST, LOOSE, USUAL
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording

CHECKED = 30
"""Runs that a recording is asked for to check what is taken for granted."""

FEW, COLUMN = 8, 0.09
"""So many unknowns are a few; what each one more adds to the time of a step that is differentiated."""


def cost(
    problem: Problem,
    rtol: float,
    starts: int,
    workers: int,
    heldout: tuple[str, ...] = (),
    method: str = "gauss_newton",
) -> Cost:
    """Of `default_plan` where every stage takes all its evaluations, and of the checks before and after it; descents on the
    adjoint take more of them, and memory for a matrix that interpolates between the rows. For the paper's rig."""
    fitted = [r for r in problem.recordings if r.name not in heldout]
    slowest = min(fitted, key=lambda r: r.speed)
    rows = {r.name: len(r.grid(problem.interpolated).t) for r in problem.recordings}
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)

    def runs(recording: Recording) -> list[tuple[float, float, bool]]:
        """How many at which tolerance, and whether they are differentiated."""
        first = [(starts * FIRST, loose, True)] if recording is slowest else []
        stages = [(ALL, loose, True), (FREE, usual, True), (LAST if rtol < usual else 0, rtol, True)]
        return [*first, *stages, (1, loose, False), (1, FINER * rtol, False), (CHECKED, usual, False)]

    descent, steps, seconds = method != "gauss_newton", 0.0, []
    for recording in fitted:
        seconds.append(0.0)
        mine = [c for c in problem.coordinates.all if c.of_the_rig and c.recording in (None, recording.name)]
        more = 1 + COLUMN * max(len(mine) - FEW, 0)
        for number, by, differentiated in runs(recording):
            length = (recording.duration + recording.start.lead) * steps_per_second(by) + rows[recording.name]
            number *= 4 if descent and differentiated else 1
            steps += number * length
            step = step_seconds(paper_settings(recording), differentiated) * (more if differentiated else 1.0)
            seconds[-1] += number * (length * step + RUN)
    matrix = 3 * 8 / 2**30 if descent else 0.0
    memory = sorted(rows[r.name] * (row_memory(paper_settings(r)) + matrix * rows[r.name]) for r in problem.recordings)
    at_once = max(1, min(workers, len(fitted)))
    return Cost(
        steps=steps,
        seconds=max(sum(seconds) / at_once, max(seconds)),
        memory=sum(memory[-at_once:]),
    )


def one_by_one(costs: Iterable[Cost]) -> Cost:
    """Of several identifications, such as those of competing laws."""
    every = list(costs)
    return Cost(sum(c.steps for c in every), sum(c.seconds for c in every), max(c.memory for c in every))


def paper_settings(recording: Recording) -> Parameters:
    """Of the paper's rig."""
    assert isinstance(recording.rig, SoftGrasp)
    return recording.rig.settings
