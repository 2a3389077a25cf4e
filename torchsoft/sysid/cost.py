"""What an identification will cost."""

from torchsoft.cost import RUN, Cost, row_memory, step_seconds, steps_per_second
from torchsoft.parameters import Parameters
from torchsoft.physics.paper import SoftGrasp
from torchsoft.sysid.plan import ALL, FIRST, FREE, LAST, LOOSE, USUAL
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.settle import FINER


def cost(
    problem: Problem,
    rtol: float,
    starts: int,
    workers: int,
    heldout: tuple[str, ...] = (),
    method: str = "gauss_newton",
) -> Cost:
    """Of `default_plan` where every stage takes all its evaluations; descents on the adjoint take more of them, and memory for
    a matrix that interpolates between the rows. For the paper's rig."""
    fitted = [r for r in problem.recordings if r.name not in heldout]
    slowest = min(fitted, key=lambda r: r.speed)
    rows = {r.name: len(r.grid(problem.interpolated).t) for r in problem.recordings}
    loose, usual = max(LOOSE, rtol), max(USUAL, rtol)

    def runs(recording: Recording) -> list[tuple[int, float]]:
        """How many at which tolerance."""
        first = [(starts * FIRST, loose)] if recording is slowest else []
        return [*first, (ALL, loose), (FREE, usual), (LAST if rtol < usual else 0, rtol), (1, FINER * rtol)]

    descent, steps, seconds = method != "gauss_newton", 0.0, []
    for recording in fitted:
        each = step_seconds(paper_settings(recording), differentiated=True)
        seconds.append(0.0)
        for number, by in runs(recording):
            length = (recording.duration + recording.start.lead) * steps_per_second(by) + rows[recording.name]
            number *= 4 if descent else 1
            steps += number * length
            seconds[-1] += number * (length * each + RUN)
    matrix = 3 * 8 / 2**30 if descent else 0.0
    memory = sorted(rows[r.name] * (row_memory(paper_settings(r)) + matrix * rows[r.name]) for r in problem.recordings)
    at_once = max(1, min(workers, len(fitted)))
    return Cost(
        steps=steps,
        seconds=max(sum(seconds) / at_once, max(seconds)),
        memory=sum(memory[-at_once:]),
    )


def paper_settings(recording: Recording) -> Parameters:
    """Of the paper's rig."""
    assert isinstance(recording.rig, SoftGrasp)
    return recording.rig.settings
