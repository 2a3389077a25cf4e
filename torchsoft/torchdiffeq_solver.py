"""The stepper under torchdiffeq's own verbs: `odeint` and `odeint_adjoint`."""

import importlib
from typing import Any

import torch
from torch import Tensor

from torchsoft.adjoint import differentiable_solution
from torchsoft.implicit import METHOD, ImplicitStepper
from torchsoft.model import SoftGrasp


class TorchdiffeqSolver:
    """`torchdiffeq.odeint(model, y0, t, method="sdirk2", options={"step_size": 2e-3})`.

    Takes batches: y0 (..., size); each sample is stepped by itself, so none depends on its neighbours. rtol and atol are
    not used: the step is fixed and Newton's tolerance is the stepper's.
    """

    def __init__(self, func: Any, y0: Tensor, rtol: float, atol: float, norm: Any = None, **options: Any) -> None:
        model = func
        while not isinstance(model, SoftGrasp):
            model = getattr(model, "base_func", None)
            if model is None:
                raise TypeError(f"method='{METHOD}' integrates a torchsoft.SoftGrasp, but got {type(func).__name__}")
        if "step_size" in options:
            options["step"] = options.pop("step_size")
        self.model, self.y0 = model, y0
        self.stepper = ImplicitStepper(model, **options)

    def integrate(self, t: Tensor) -> Tensor:
        samples = self.y0.reshape(-1, self.y0.shape[-1])
        runs = [differentiable_solution(self.stepper, sample, t)[0] for sample in samples]
        return torch.stack(runs, 1).reshape(len(t), *self.y0.shape)

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        return set()


def register() -> None:
    """Add the stepper to torchdiffeq's table of solvers. The table is private, hence the check of what is there."""
    solvers = getattr(importlib.import_module("torchdiffeq._impl.odeint"), "SOLVERS", None)
    if not isinstance(solvers, dict) or "dopri5" not in solvers:
        raise ImportError("this torchdiffeq keeps its solvers elsewhere; torchsoft was made for torchdiffeq 0.2.5")
    solvers[METHOD] = TorchdiffeqSolver
