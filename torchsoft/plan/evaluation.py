"""Runs of a plan: values, targets and limits for every draw of uncertain parameters, and their
derivatives by the free variables."""

import warnings
from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.rig import Rig
from torchsoft.plan.goals import Term, evaluated
from torchsoft.plan.knots import Array
from torchsoft.plan.variables import Variables
from torchsoft.solve.batch import Batch, simulate_batch
from torchsoft.solve.trajectory import Trajectory


class Terms(NamedTuple):
    """Functions of a run: an objective to minimise, targets whose errors over a tolerance should
    vanish, and limits whose excess should not be positive."""

    objective: Term | None
    targets: Mapping[str, Term]
    limits: Mapping[str, Term]

    def of(self, run: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
        """Value (), errors (k,) and excess (m,) of a run. Raises `ValueError` naming the term."""
        alone = {} if self.objective is None else {"objective": self.objective}
        parts = []
        for field, terms in (("plan", alone), ("targets", self.targets), ("limits", self.limits)):
            found = list(evaluated(terms, run, field).values())
            parts.append(torch.cat(found) if found else torch.zeros(0, dtype=torch.float64))
        if self.objective is not None and len(parts[0]) != 1:
            raise ValueError("`objective` must give one number")
        return parts[0].sum(), parts[1], parts[2]

    def labels(self, run: Trajectory) -> tuple[list[str], list[str]]:
        """Names of the single errors, and of the single excesses."""

        def named(terms: Mapping[str, Term], field: str) -> list[str]:
            sizes = {name: len(v) for name, v in evaluated(terms, run, field).items()}
            return [
                name if size == 1 else f"{name}.{i}" for name, size in sizes.items()
                for i in range(size)
            ]  # fmt: skip

        return named(self.targets, "targets"), named(self.limits, "limits")


class Look:
    """A plan at z (n,): value (draws,), errors (draws, k) and excess (draws, m) of its runs, and
    their derivatives. `lost` is the reason of a failed run."""

    def __init__(
        self, z: Array, rows: Tensor, batch: Batch | None, terms: Terms, lost: str
    ) -> None:
        self.z, self.rows, self.batch, self.lost = z, rows, batch, lost
        if batch is None or lost:
            return
        parts = [terms.of(run) for run in batch.trajectories if run is not None]
        self._value, self._errors, self._excess = (torch.stack(part) for part in zip(*parts))
        self.value: Array = self._value.detach().numpy()
        self.errors: Array = self._errors.detach().numpy()
        self.excess: Array = self._excess.detach().numpy()

    @cached_property
    def slopes(self) -> tuple[Array, Array, Array]:
        """Derivatives by z of values (draws, n), errors (draws, k, n) and excess (draws, m, n); one
        backward pass over every run for each column. Raises `GradientFailed`."""

        def by(columns: Tensor) -> Array:
            if not columns.requires_grad:  # nothing of the run is in it
                return np.zeros((*columns.shape, self.rows.shape[-1]))
            found = [
                torch.autograd.grad(column.sum(), self.rows, retain_graph=True)[0]
                for column in columns.unbind(1)
            ]
            return torch.stack(found, 1).numpy()

        return by(self._value[:, None])[:, 0], by(self._errors), by(self._excess)


class Evaluator:
    """Evaluation of plans by runs. `over` holds draws of parameters by name (draws, ...), y0 their
    initial states (size,) or (draws, size)."""

    def __init__(
        self, rig: Rig, t: Tensor, variables: Variables, terms: Terms, y0: Tensor,
        over: Mapping[str, Tensor], rtol: float, threads: int | None,
    ) -> None:  # fmt: skip
        if twice := set(over) & set(variables.shapes):
            raise ValueError(f"`{min(twice)}` is both free and drawn; leave it out of one of them")
        counts = {name: len(values) for name, values in over.items()}
        if y0.ndim == 2:
            counts["y0"] = len(y0)
        if len(set(counts.values())) > 1:
            listed = ", ".join(f"{name} {count}" for name, count in counts.items())
            raise ValueError(f"every draw needs one entry, but there are: {listed}")
        self.draws = next(iter(counts.values()), 1)
        self.rig, self.t, self.variables, self.terms, self.y0 = rig, t, variables, terms, y0
        self.over, self.rtol, self.threads, self.looks = dict(over), rtol, threads, 0

    def look(self, z: Array, rtol: float | None = None, *, gradient: bool = True) -> Look:
        """The plan at z, with the evaluator's relative tolerance or another. Raises `ValueError`
        for impossible values."""
        self.looks += 1
        rows = torch.from_numpy(np.tile(z, (self.draws, 1))).requires_grad_(gradient)
        # the run that is kept is made again, and warns
        with warnings.catch_warnings(action="ignore"):
            batch = simulate_batch(
                self.rig, self.t, parameters=self.over | self.variables.parameters(rows),
                reference=[self.variables.reference(row) for row in rows], y0=self.y0,
                rtol=self.rtol if rtol is None else rtol, threads=self.threads,
                gradient="discrete" if gradient else "none",
            )  # fmt: skip
        lost = "; ".join(f"draw {i}: {why}" for i, why in list(batch.failures.items())[:1])
        return Look(z, rows, batch, self.terms, lost)
