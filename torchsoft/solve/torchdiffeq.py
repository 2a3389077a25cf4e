"""The stepper under torchdiffeq's own verbs, `odeint` and `odeint_adjoint`, once
`register_method()` has been called.

`odeint(rig, y0, t, method="sdirk2")` has the discrete adjoint behind it already. `odeint_adjoint`
works as well: it calls the same method once more, backwards and interval by interval, on its
augmented dynamics, which the solver recognises and answers with the discrete adjoint of the
interval. That is exact too, but pays its overhead at every output time.

A solver of the same name that torchdiffeq has of its own is left to everybody else's functions.
"""

import importlib
import inspect
from collections import deque
from copy import copy
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchsoft.parallel import cores, parallel_map
from torchsoft.physics.rig import Rig
from torchsoft.solve.gradients import Solved, Task, attached, march, run_adjoint
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import METHOD, ImplicitStepper

REMEMBERED = 4
"""Runs of a model whose states are remembered: `odeint_adjoint` hands its solver only the later end
of an interval."""


class _Run(NamedTuple):
    """Times (T,), states (T, samples, size), and every sample's steps; a step ends at every
    time."""

    t: Tensor
    y: Tensor
    knots: list[Array]


_runs: WeakKeyDictionary[Rig, deque[_Run]] = WeakKeyDictionary()


class TorchdiffeqSolver:
    """`torchdiffeq.odeint(model, y0, t, method="sdirk2", rtol=1e-4, atol=1e-5)`, and the same for
    `odeint_adjoint`.

    Takes batches: y0 (..., size); each sample is stepped by itself, with steps of its own, so none
    depends on its neighbours. rtol and atol are those of `simulate`; torchdiffeq's own
    defaults (1e-7, 1e-9) are strict for a motion with contact. Options: `step_size` [s] for equal
    steps instead, and the stepper's own, such as Newton's `tolerance` [N]. Raises `TypeError` for
    dynamics that are not a `Rig`'s, `ValueError` for times that do not increase.
    """

    theirs: Any = None
    """torchdiffeq's own solver of this name, for functions that are not a rig's."""

    def __new__(cls, func: Any, y0: Tensor, *arguments: Any, **options: Any) -> Any:
        if cls.theirs is not None and not isinstance(_rig_behind(func), Rig):
            return cls.theirs(func, y0, *arguments, **options)
        return super().__new__(cls)

    def __init__(
        self, func: Any, y0: Tensor, rtol: float, atol: float, norm: Any = None, **options: Any
    ) -> None:
        model, augmented = _rig_behind(func), _augmented(func)
        if not isinstance(model, Rig):
            raise TypeError(
                f"method='{METHOD}' integrates a torchsoft.Rig, but got {type(model).__name__}"
            )
        if "step_size" in options:
            options["step"] = options.pop("step_size")
        known = set(inspect.signature(ImplicitStepper).parameters) - {
            "rig",
            "reference",
            "rtol",
            "atol",
            "knots",
            "landing",
            "structure",
            "values",
            "differentiable",
        }
        if strange := set(options) - known:
            raise ValueError(
                f"method='{METHOD}' has no option {sorted(strange)}; it has step_size, "
                f"{', '.join(sorted(known))}"
            )
        self.model, self.y0, self.negated = model, y0, _negates_time(func)
        self.adjoint_params: tuple[Tensor, ...] | None = augmented.get("adjoint_params")
        with (
            torch.enable_grad()
        ):  # odeint_adjoint comes without; its parameters' gradients need the graph
            self.stepper = ImplicitStepper(
                model, rtol=float(rtol), atol=float(atol), landing=True, **options
            )

    def integrate(self, t: Tensor) -> Tensor:
        if self.adjoint_params is not None:
            return self._augmented(t, self.adjoint_params)
        t = -t if self.negated else t  # the caller's times, which decrease: `check` rejects them
        samples = self.y0.reshape(-1, self.y0.shape[-1])
        runs: list[Any] = [None] * len(samples)

        for sample in samples:
            self.stepper.check(sample.detach(), t)

        def run(i: int) -> Solved:
            return deque(march(Task(copy(self.stepper), t, samples[i])), maxlen=1)[0]

        for i, solved in parallel_map(run, len(samples)):
            runs[i] = solved
        solution = torch.stack([y for y, _ in attached(runs, cores())], 1)
        knots = [solved.out.knots for solved in runs]
        _runs.setdefault(self.model, deque(maxlen=REMEMBERED)).append(
            _Run(t.detach().clone(), solution.detach(), knots)
        )
        return solution.reshape(len(t), *self.y0.shape)

    def _augmented(self, t: Tensor, parameters: tuple[Tensor, ...]) -> Tensor:
        """(0, y, y_bar, *parameter_bars) carried from the end of one output interval to its start;
        t is negated."""
        tail = sum(p.numel() for p in parameters)
        size, end, start = self.model.layout.size, -t[0], -t[1]
        count = (len(self.y0) - 1 - tail) // 2
        y, y_bar, bars = self.y0[1:].split([count, count, tail])
        y_start, knots = self._state_before(start, end, y.reshape(-1, size))
        y_bars, interval = y_bar.reshape(-1, size).clone(), torch.stack((start, end))
        for sample in range(len(y_bars)):
            segments: list[Segment] = []
            again = self.stepper.along(knots[sample])
            *_, out = again.integrate(
                y_start[sample], interval, segments, float("inf"), outputs_too=False
            )
            run = Solved(Task(again, interval, y_start[sample]), out, segments)
            outputs = torch.stack((torch.zeros_like(y_bars[sample]), y_bars[sample]))
            y_bars[sample], *cotangents = run_adjoint(run, outputs, None)
            if parameters:
                with torch.enable_grad():
                    times = np.concatenate([one.plan.stage_times.ravel() for one in segments])
                    made_of = again.parameters.p, again.signals_at(times)
                    value = torch.cat(
                        [(x * cotangent).flatten() for x, cotangent in zip(made_of, cotangents)]
                    ).sum()
                    parts = torch.autograd.grad(
                        value, parameters, allow_unused=True, retain_graph=True
                    )
                parts = [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, parts)]
                bars = bars + torch.cat([part.flatten() for part in parts])
        carried = torch.cat((self.y0[:1], y_start.flatten(), y_bars.flatten(), bars))
        return torch.stack((self.y0, carried))

    def _state_before(self, start: Tensor, end: Tensor, y: Tensor) -> tuple[Tensor, list[Array]]:
        """The remembered states (samples, size) at `start` of the run that has y (samples, size) at
        `end`, and each sample's steps from there to the end."""
        for run in reversed(_runs.get(self.model, deque())):
            i = int(torch.searchsorted(run.t, end))
            if i > 0 and run.t[i] == end and run.t[i - 1] == start and torch.equal(run.y[i], y):
                first, last = float(start), float(end)
                slack = 1e-9 * (last - first)
                inside = [k[(k > first + slack) & (k < last - slack)] for k in run.knots]
                return run.y[i - 1], [np.concatenate([[first], k, [last]]) for k in inside]
        raise RuntimeError(
            f"the run to differentiate is not among the last {REMEMBERED} of this model; call "
            "backward before running it again, or use odeint, which keeps what it needs"
        )

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        return set()


def _closure(function: Any) -> dict[str, Any]:
    return dict(inspect.getclosurevars(function).nonlocals)


def _augmented(func: Any) -> dict[str, Any]:
    """The variables of torchdiffeq's augmented dynamics; none where `func` is anything else."""
    found = _innermost(func)
    return _closure(found) if inspect.isfunction(found) else {}


def _rig_behind(func: Any) -> Any:
    """The dynamics, inside any wrappers of torchdiffeq."""
    return _innermost(_augmented(func).get("func", _innermost(func)))


def _negates_time(func: Any) -> bool:
    """Whether a wrapper of torchdiffeq turns decreasing times round."""
    while hasattr(func, "base_func"):
        if getattr(func, "mul", 1.0) < 0:
            return True
        func = func.base_func
    return False


def _innermost(func: Any) -> Any:
    while hasattr(func, "base_func"):
        func = func.base_func
    return func


def register_method() -> None:
    """Adds `method="sdirk2"` to the solvers of torchdiffeq in this process; called again it does
    nothing.

    Functions that are no rig's keep a solver of this name that torchdiffeq has of its own. Raises
    `ImportError` for a torchdiffeq that keeps its solvers elsewhere.
    """
    solvers = getattr(importlib.import_module("torchdiffeq._impl.odeint"), "SOLVERS", None)
    if not isinstance(solvers, dict) or "dopri5" not in solvers:
        raise ImportError(
            "this torchdiffeq keeps its solvers elsewhere; torchsoft was made for torchdiffeq 0.2.5"
        )
    present = solvers.get(METHOD)
    if present is None:
        solvers[METHOD] = TorchdiffeqSolver
    elif not (isinstance(present, type) and issubclass(present, TorchdiffeqSolver)):
        solvers[METHOD] = type("TorchdiffeqSolver", (TorchdiffeqSolver,), {"theirs": present})
