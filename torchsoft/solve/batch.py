"""Many runs in one call, each with parameters, start, reference and times of its own, side by side
in threads."""

import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from torchsoft.caller import warn
from torchsoft.display import Shown, hidden
from torchsoft.parallel import cores, parallel_map, single_threaded, ungraphed
from torchsoft.physics.arguments import Numbers, tensor, whole
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.physics.structure import Structure
from torchsoft.physics.validity import check_array
from torchsoft.solve.diagnostics import doubts
from torchsoft.solve.gradients import TAPE_BYTES, Solved, attached
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import Initial, Start, prepare, run
from torchsoft.solve.trajectory import Trajectory


class SamplesFailed(UserWarning):
    """Warning that runs of a batch failed."""


@dataclass(frozen=True, repr=False)
class Batch(Shown):
    """The runs of a batch: their trajectories, None where a run failed, and why those failed, by
    number.

    Stacked tensors have one row a run; rows of failed runs, and times behind a run's last one, are
    NaN. `mask` (runs, T) says where there is something; take losses over it: NaN times zero is NaN,
    in gradients too.
    """

    trajectories: tuple[Trajectory | None, ...] = field(repr=False)
    failures: dict[int, Exception]
    lengths: tuple[int, ...]
    wall_s: float

    def __len__(self) -> int:
        return len(self.trajectories)

    def keys(self) -> Sequence[str]:
        """Names of the channels that every run has."""
        done = [run for run in self.trajectories if run is not None]
        return [name for name in done[0] if all(name in run for run in done)] if done else []

    def __contains__(self, channel: object) -> bool:
        return channel in self.keys()

    def __iter__(self) -> Iterator[Trajectory | None]:
        return iter(self.trajectories)

    def _ipython_key_completions_(self) -> Sequence[str]:
        return self.keys()

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        done = [run for run in self.trajectories if run is not None]
        rows = [("channels", ", ".join(self.keys()) or "none")]
        if done:
            steps = [run.stats.steps for run in done]
            worst = max(run.energy_residual_rel for run in done)
            rows.append(
                (
                    "times",
                    f"up to {max(float(run.t[-1]) for run in done):g} s, at most "
                    f"{max(self.lengths)} samples",
                )
            )
            rows.append(("steps", f"{min(steps)} to {max(steps)} a run"))
            rows.append(("energy", f"at most {worst:.1e} of what was injected is missing"))
        rows += [(f"run {i} failed", str(reason)) for i, reason in list(self.failures.items())[:3]]
        count, wall = len(self), self.wall_s
        return f"Batch: {count} runs, {len(self.failures)} failed, {wall:.2g} s", rows

    def __getitem__(self, channel: str) -> Tensor:
        """A channel (runs, T). Raises `KeyError` for a channel that a run does not have."""
        return self._stacked(lambda run: run[channel])

    def together(self, *channels: str) -> Tensor:
        """Channels side by side (runs, T, channels)."""
        return torch.stack([self[name] for name in channels], -1)

    @property
    def mask(self) -> Tensor:
        """Mask (runs, T) of the samples that exist."""
        there = torch.tensor([0 if run is None else len(run.t) for run in self.trajectories])
        return torch.arange(max(self.lengths)) < there[:, None]

    @property
    def t(self) -> Tensor:
        """Times [s] (runs, T)."""
        return self._stacked(lambda run: run.t)

    @property
    def y(self) -> Tensor:
        """Flat states (runs, T, size). Raises `ValueError` where the rigs have states of different
        sizes."""
        return self._stacked(lambda run: run.y)

    @property
    def sensitivities(self) -> Tensor:
        """Derivatives (runs, T, components, n) of gradient="forward"."""
        if not all(run is None or run.wrt for run in self.trajectories):
            raise ValueError(
                "the batch was run without sensitivities; ask for them with gradient='forward' and "
                "`wrt`"
            )
        return self._stacked(lambda run: run.sensitivities)

    def _stacked(self, of: Callable[[Trajectory], Any]) -> Tensor:
        parts = [None if run is None else of(run) for run in self.trajectories]
        shapes = {part.shape[1:] for part in parts if part is not None}
        if len(shapes) > 1:
            raise ValueError(
                "the runs' rows have different shapes, "
                f"{' and '.join(str(tuple(s)) for s in shapes)}"
            )
        unfilled = torch.full(
            (max(self.lengths), *next(iter(shapes), ())), torch.nan, dtype=torch.float64
        )
        rows = [
            unfilled if part is None else torch.cat((part, unfilled[len(part) :])) for part in parts
        ]
        return torch.stack(rows)


@ungraphed
def simulate_batch(
    rig: Rig | Sequence[Rig], t: Numbers, *,
    parameters: Mapping[str, Numbers] | None = None, y0: Numbers | Start | list[Initial | Start],
    reference: Reference | Sequence[Reference] | None = None, knots: Sequence[Tensor] | None = None,
    dy0: Numbers | None = None, threads: int | None = None,
    progress: bool = False, **options: Any,
) -> Batch:  # fmt: skip
    """`simulate` for many runs at once, in `threads` threads, one a core by default.

    Arguments that differ from run to run have one entry for each: `parameters` by name (runs, ...),
    y0 (runs, size), dy0 (runs, size, n), `reference`, t, `knots`, and even the rig; shared ones are
    given once: one rig, t (T,), y0 (size,), one reference. A `y0` that is a function of the rig,
    such as `BuiltRig.initial`, is evaluated at the parameters of every run. Results do not depend
    on the number of threads. `options` are those of `simulate`, the same for every run. With
    gradient="discrete" tensors computed from the batch have a gradient by `parameters`, y0 and
    other inputs; the
    backward sweeps run in threads too.

    A run that fails, or that cannot begin with its own parameters, is reported in `failures` and by
    a warning (`SamplesFailed`), and leaves the others alone. `simulate` of that run alone says
    more, if its loop is unstable.

    Raises `ValueError` for counts that do not agree and for options that no run could have. Ctrl-C
    ends the batch when the runs on their way have ended.
    """
    if isinstance(parameters, Mapping):
        parameters = {k: tensor(f"parameters[{k!r}]", x) for k, x in parameters.items()}
        for name, values in parameters.items():
            check_array(f"parameters[{name!r}]", values)
    t, dy0 = _rows("t", t), _rows("dy0", dy0)
    begun: Any = y0 if starts(y0) else _rows("y0", y0)
    # a single rig is a module, single times a vector, a single start too, a single reference a
    # module
    runs = _arguments(
        parameters,
        rig=(rig, isinstance(rig, nn.Module)),
        t=(t, isinstance(t, Tensor) and t.ndim == 1),
        y0=(begun, callable(begun) or (isinstance(begun, Tensor) and begun.ndim == 1)),
        reference=(reference, reference is None or isinstance(reference, nn.Module)),
        knots=(knots, knots is None),
        dy0=(dy0, dy0 is None or (isinstance(dy0, Tensor) and dy0.ndim == 2)),
    )
    count = len(runs)
    began, threads = (
        clock.perf_counter(),
        min(count, cores() if threads is None else whole("threads", threads, 1)),
    )
    budget = TAPE_BYTES / count
    structures = {
        id(rig): Structure(rig)
        for rig in {id(one["rig"]): one["rig"] for one in runs}.values()
        if isinstance(rig, Rig)
    }

    def work(i: int) -> Solved | Trajectory | Exception:
        try:
            values = run_values(runs[i]["rig"], parameters or {}, i)
            structure = structures.get(id(runs[i]["rig"]))
            task = prepare(**runs[i], structure=structure, values=values, **options)
            solved = run(task, budget, explained=False)
            return Trajectory.of(solved) if solved.segments is None else solved
        except (SimulationFailed, ValueError, np.linalg.LinAlgError) as failure:
            return failure

    results: list[Solved | Trajectory | Exception] = [ValueError("not run")] * count
    with single_threaded(), tqdm(total=count, unit="run", disable=hidden(progress)) as bar:
        for i, result in parallel_map(work, count, threads, turns=True):
            results[i] = result
            bar.update()
    done = {i: result for i, result in enumerate(results) if isinstance(result, Solved)}
    failures = {i: result for i, result in enumerate(results) if isinstance(result, Exception)}
    if failures:
        first = min(failures)
        if len(failures) == count and all(
            isinstance(one, ValueError) and str(one) == str(failures[first])
            for one in failures.values()
        ):
            raise failures[first]  # nothing of a single run
        message = f"{len(failures)} of {count} runs failed; run {first}: {failures[first]}"
        warn(message, SamplesFailed)
    trajectories = [one if isinstance(one, Trajectory) else None for one in results]
    for (i, solved), rows in zip(done.items(), attached([*done.values()], threads)):
        trajectories[i] = Trajectory.of(solved, rows)
    _doubt([one["rig"] for one in runs], trajectories)
    return Batch(
        tuple(trajectories),
        failures,
        tuple(len(one["t"]) for one in runs),
        clock.perf_counter() - began,
    )


def _doubt(rigs: Sequence[Rig], trajectories: Sequence[Trajectory | None]) -> None:
    """Warn once of everything that is doubtful, naming its runs, in the words of the first of
    them."""
    found: dict[str, dict[int, str]] = {}
    for i, trajectory in enumerate(trajectories):
        for subject, doubt in doubts(trajectory, rigs[i]).items() if trajectory is not None else ():
            found.setdefault(subject, {})[i] = doubt
    for runs in found.values():
        first, *others = runs
        label = (
            f"runs {', '.join(map(str, runs))} (numbers of run {first})"
            if others
            else f"run {first}"
        )
        warn(f"{label}: {runs[first]}")


def starts(y0: Any) -> bool:
    """Whether a start is a function of the rig, or a list of starts with their references."""
    return callable(y0) or (
        isinstance(y0, list) and all(callable(one) or isinstance(one, Initial) for one in y0)
    )


def _rows(name: str, given: Any) -> Any:
    """One tensor of numbers, or the entries of a list of several."""
    several = isinstance(given, list | tuple) and any(
        isinstance(one, Tensor | np.ndarray | Sequence) for one in given
    )
    if several and any(getattr(one, "ndim", 1) for one in given):
        return [tensor(name, one) for one in given]
    return None if given is None else tensor(name, given)


def _arguments(
    parameters: Mapping[str, Tensor] | None, **shared: tuple[Any, bool]
) -> list[dict[str, Any]]:
    """The arguments of every run, by name, from those of all runs, each with whether it is given
    once."""
    if parameters is not None and not isinstance(parameters, Mapping):
        raise ValueError(
            f"`parameters` must give tensors by name, but is {type(parameters).__name__}"
        )
    for name, values in (parameters or {}).items():
        if values.ndim == 0:
            raise ValueError(
                f"`parameters[{name!r}]` must have one entry a run, but is a single number"
            )
    counts = {name: len(given) for name, (given, single) in shared.items() if not single}
    counts |= {name: len(values) for name, values in (parameters or {}).items()}
    if not counts:
        raise ValueError(
            "nothing differs from run to run: give `parameters`, y0, t, references or rigs, one "
            "entry a run"
        )
    if len(set(counts.values())) > 1 or 0 in counts.values():
        listed = ", ".join(f"{name} {number}" for name, number in counts.items())
        raise ValueError(
            "every argument must have one entry a run, and one run at least, but there are: "
            f"{listed}"
        )
    return [
        {name: given if single else given[i] for name, (given, single) in shared.items()}
        for i in range(next(iter(counts.values())))
    ]


def run_values(rig: Rig, parameters: Mapping[str, Tensor], i: int) -> dict[int, Tensor]:
    """Row i of the parameters, by the id of the rig's own that they take the place of."""
    values: dict[int, Tensor] = {}
    for name, rows in parameters.items():
        old = rig.parameter(name)
        if rows[i].shape != old.shape:
            raise ValueError(
                f"`{name}` has shape {tuple(old.shape)}, but is given rows of shape "
                f"{tuple(rows[i].shape)}"
            )
        values[id(old)] = rows[i].double()
    return values
