"""What an identification will cost."""

from torchsoft.cost import RUN, Cost, row_memory, step_seconds
from torchsoft.sysid.plan import ALL, COARSE, FIRST, LAST
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import REACH, SETTLE, Recording


def rows(recording: Recording, step: float, interpolated: bool) -> float:
    """Rows of one run at a step [s]."""
    spacing = recording.spacing(step, interpolated)
    return len(recording.times) if spacing is None else (recording.duration + 2 * REACH) / spacing


def cost(
    problem: Problem,
    step: float,
    starts: int,
    workers: int,
    heldout: tuple[str, ...] = (),
    method: str = "gauss_newton",
) -> Cost:
    """Of `default_plan` where every stage takes all its evaluations; descents on the adjoint take more of them, and memory for
    a matrix that interpolates between the rows."""
    fitted = [r for r in problem.recordings if r.name not in heldout]
    slowest = min(fitted, key=lambda r: r.speed)

    def runs(recording: Recording) -> list[tuple[int, float]]:
        """How many at which step [s]."""
        first = [(starts * FIRST, COARSE[0] * step)] if recording is slowest else []
        return [*first, (ALL, COARSE[1] * step), (LAST, step)]

    descent, steps, seconds = method != "gauss_newton", 0.0, []
    for recording in fitted:
        each = step_seconds(recording.settings, differentiated=True)
        seconds.append(0.0)
        for number, at in runs(recording):
            length = max(rows(recording, at, problem.interpolated), (recording.duration + SETTLE) / at)
            number *= 4 if descent else 1
            steps += number * length
            seconds[-1] += number * (length * each + RUN)
    lengths = {r.name: rows(r, step, problem.interpolated) for r in problem.recordings}
    matrix = 3 * 8 / 2**30 if descent else 0.0
    memory = sorted(lengths[r.name] * (row_memory(r.settings) + matrix * lengths[r.name]) for r in problem.recordings)
    at_once = max(1, min(workers, len(fitted)))
    return Cost(
        steps=steps,
        seconds=max(sum(seconds) / at_once, max(seconds)),
        memory=sum(memory[-at_once:]),
    )
