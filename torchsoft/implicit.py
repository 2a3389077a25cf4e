"""The implicit stepper: the compiled kernel fed from a `SoftGrasp`, and its registration with torchdiffeq."""

import importlib
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import linalg
from torch import Tensor

from torchsoft.model import SoftGrasp
from torchsoft.node_kernel import Array, Constants
from torchsoft.pad import Pad, banded
from torchsoft.run_kernel import CONVERGED, GAMMA, INTEGRALS, LOST, NEWTON_FAILED, OFF_THE_PAD, run
from torchsoft.stage_kernel import PadArrays, PadState, pad_work
from torchsoft.state import State

log = logging.getLogger("torchsoft")

METHOD = "sdirk2"
"""Name under which `torchdiffeq.odeint` knows the stepper once torchsoft is imported."""

CHUNK = 500
"""Steps per compiled call: how often progress is shown and Ctrl-C is heard."""


class SimulationFailed(RuntimeError):
    """A run that ended early: when and why. `time` [s]; `trajectory` holds what was simulated until then, if any."""

    def __init__(self, reason: str, time: float) -> None:
        super().__init__(reason)
        self.reason, self.time = reason, time
        self.trajectory: Any = None


@dataclass
class Progress:
    """What the stepper has produced so far: rows of the output grid, and its counters."""

    y: Array
    forces: Array
    extras: Array
    rows: int = 1
    steps: int = 0
    solves: int = 0


def check_times(t: Tensor) -> None:
    """Raises `ValueError` unless t is a float64 vector of at least two finite, strictly increasing times."""
    if t.ndim != 1 or len(t) < 2 or t.dtype != torch.float64:
        raise ValueError(
            f"`t` must be a float64 vector of two times or more, but is {t.dtype} of shape {tuple(t.shape)}"
        )
    if not bool(torch.isfinite(t).all()) or not bool((t.diff() > 0).all()):
        bad = int((~(t.diff() > 0)).nonzero()[0, 0]) if bool(torch.isfinite(t).all()) else 0
        raise ValueError(
            f"`t` must increase strictly and be finite, but t[{bad}:{bad + 2}] = {t[bad : bad + 2].tolist()}"
        )


class ImplicitStepper:
    """SDIRK2 on one model: L-stable, second order, stiffly accurate.

    `step` [s] is the largest step; every output interval is cut into equal steps no longer than it. Newton stops when
    the contact law and the linear relations agree to `tolerance` [N] at every node. `window` [m] is how near a node has
    to be to count as one that may touch (checked after every stage; only speed depends on it).
    """

    def __init__(
        self,
        model: SoftGrasp,
        *,
        step: float = 2e-3,
        tolerance: float = 1e-9,
        max_iterations: int = 40,
        window: float = 3e-4,
    ) -> None:
        if not (math.isfinite(step) and step > 0):
            raise ValueError(f"`step` must be a positive number of seconds, but is {step}")
        for name, value in model.named_parameters():
            if not bool(torch.isfinite(value).all()):
                raise ValueError(f"parameter `{name}` must be finite, but is {value.tolist()}")
        self.model, self.step, self.tolerance, self.max_iterations, self.window = (
            model,
            step,
            tolerance,
            max_iterations,
            window,
        )
        self._arrays: dict[float, tuple[PadArrays, PadArrays]] = {}

    def constants(self) -> Constants:
        """The model's scalars as the kernel takes them."""
        m = self.model
        c, friction, control = m.contact, m.contact.friction, m.controllers
        coulomb = m.settings.contact.friction == "coulomb"
        return Constants(
            *(x.item() for x in (c.K_n, c.R_n, c.K_t, c.R_t, c.eta, friction.mu_s, friction.mu_k)),  # pyright: ignore[reportAttributeAccessIssue]
            v_s=math.inf if coulomb else friction.v_s.item(),  # pyright: ignore[reportAttributeAccessIssue]
            epsilon=c.epsilon,
            coulomb=coulomb,
            tau=m.material.tau.item(),
            radius=m.shape.radius.item(),
            m_C=m.m_C.item(),
            I_C=m.inertia.item(),
            m_Br=m.m_Br.item(),
            gravity=m.gravity.item(),
            K_81=control.K_81.item(),
            R_80=control.R_80.item(),
            K_98=control.K_98.item(),
            R_99=control.R_99.item(),
            pad_length=m.settings.pad.length,
        )

    def pad_arrays(self, h: float) -> tuple[PadArrays, PadArrays]:
        """Both pads' mobilities for the step h [s]."""
        if h not in self._arrays:
            if len(self._arrays) > 8:  # an irregular output grid has many step sizes; each holds some megabytes
                self._arrays.clear()
            m = self.model
            self._arrays[h] = (self._pad(m.pad_L, GAMMA * h, False), self._pad(m.pad_U, GAMMA * h, True))
        return self._arrays[h]

    @torch.no_grad()
    def _pad(self, pad: Pad, ah: float, moving_base: bool) -> PadArrays:
        material, size = self.model.material, 2 * pad.nodes
        stiff = material.tau.item() + ah
        if pad.massless:
            P = np.ascontiguousarray((pad.compliance(material) / stiff).numpy().T)
            D, B, M, factor = np.zeros((size, 2)), np.zeros((2, 2)), np.zeros(0), np.zeros((0, 0))
        else:
            M = np.repeat(pad.masses(material).numpy(), 2)  # pyright: ignore[reportCallIssue]
            K_lambda, K_mu, _ = pad.mesh.matrices
            lame_lambda, lame_mu = (x.item() for x in material.lame())
            mirror = np.tile(pad.mirror.numpy(), pad.nodes)
            K = pad.mesh.assemble(material.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu))
            A = banded(K.multiply(mirror[:, None] * mirror[None, :]).tocsr() * stiff)
            A[0] += M / ah
            factor = linalg.cholesky_banded(A, lower=True)
            dofs = (2 * pad.surface.numpy()[:, None] + np.arange(2)).ravel()
            loads = np.zeros((size, len(dofs)))
            loads[dofs, np.arange(len(dofs))] = 1.0
            P = np.ascontiguousarray(linalg.cho_solve_banded((factor, True), loads).T)
            uniform = M[:, None] * np.tile(np.eye(2), (pad.nodes, 1)) / ah
            D = linalg.cho_solve_banded((factor, True), uniform)
            B = np.diag(uniform.sum(0)) - uniform.T @ D
            factor = np.ascontiguousarray(factor)
        share = self.model.share(pad).numpy()
        return PadArrays(pad.positions.numpy(), pad.surface.numpy(), share, P, D, B, M, factor, moving_base)

    @torch.no_grad()
    def integrate(self, y0: Tensor, t: Tensor) -> Iterator[Progress]:
        """Step from y0 (size,) through t (T,), yielding the same growing `Progress` after every compiled call.

        `extras` holds the running integrals (`run_kernel.INTEGRALS`) and the bracket's moment. The last yield is the
        complete run. Raises `SimulationFailed`.
        """
        check_times(t)
        m, times = self.model, t.numpy()
        state = m.layout.unpack(y0)
        if y0.ndim != 1 or not bool(torch.isfinite(y0).all()):
            raise ValueError(
                f"`y0` must be one finite state, shape ({m.layout.size},), but has shape {tuple(y0.shape)}"
            )
        surfaces = len(m.pad_L.surface) + len(m.pad_U.surface)
        out = Progress(
            np.empty((len(t), m.layout.size)), np.empty((len(t), surfaces, 2)), np.zeros((len(t), len(INTEGRALS) + 1))
        )
        out.y[0], out.forces[0], out.extras[0, -1] = y0.numpy(), *_start(m, times[0], state)
        pad_states = tuple(self._pad_state(k, state) for k in "LU")
        q = torch.cat((state.r_C, state.theta[None], state.r_Br)).numpy()
        V = torch.cat((state.v_C, state.omega[None], state.v_Br)).numpy()
        integrals, constants = np.zeros(len(INTEGRALS)), self.constants()
        works = None
        announce_compilation()
        for h, starts, keep in self._chunks(times):
            stage_times = torch.from_numpy(starts[:, None] + h * np.array([GAMMA, 1.0]))
            wants = torch.stack(m.reference(stage_times), -1).numpy()
            pads = self.pad_arrays(h)
            works = works or tuple(pad_work(pad) for pad in pads)
            rows = slice(out.rows, out.rows + int(keep.sum()))
            steps, status, solves = run(
                pads, pad_states, works, q, V, wants, h, constants, self.tolerance, self.max_iterations, self.window, keep,
                integrals, out.y[rows], out.forces[rows], out.extras[rows],
            )  # fmt: skip
            out.rows += int(keep[:steps].sum())
            out.steps += steps
            out.solves += solves
            if status != CONVERGED:
                yield out
                raise self._failure(status, float(starts[steps]), h)
            yield out

    def _pad_state(self, which: str, state: State) -> PadState:
        pad, u, v, s = self.model.pads[which], *(getattr(state, f"{part}_{which}") for part in "uvs")
        force = pad.elastic_force(self.model.material, u)  # pyright: ignore[reportCallIssue]
        return PadState(*(x.flatten().clone().numpy() for x in (u, v, force, s)))

    def _chunks(self, times: Array) -> Iterator[tuple[float, Array, Any]]:
        """(h, start times of the steps, which of them end at an output) of runs of equal steps, at most CHUNK long."""
        spans = np.diff(times)
        counts = np.maximum(1, np.ceil(spans / self.step * (1 - 1e-9))).astype(int)
        sizes = spans / counts
        first = 0
        while first < len(spans):
            last, total = first, 0
            same = lambda k: counts[k] == counts[first] and abs(sizes[k] - sizes[first]) <= 1e-9 * sizes[first]
            while last < len(spans) and same(last) and (total == 0 or total + counts[last] <= CHUNK):
                total += counts[last]
                last += 1
            n, h = counts[first], float(sizes[first])
            starts = (times[first:last, None] + h * np.arange(n)).ravel()
            keep = np.zeros(total, np.bool_)
            keep[n - 1 :: n] = True
            for k in range(0, total, CHUNK):  # one interval alone may be longer than a chunk
                yield h, starts[k : k + CHUNK], keep[k : k + CHUNK]
            first = last

    def _failure(self, status: int, time: float, h: float) -> SimulationFailed:
        reasons = {
            NEWTON_FAILED: f"Newton's iteration did not converge within {self.max_iterations} iterations in the step of "
            f"{h:.3g} s; try a smaller step, or a larger contact.v_s: where friction falls with slip faster than the pads damp, "
            "massless pads have no unique velocity",
            OFF_THE_PAD: "the disc was lost: its contact reached the end of a pad",
            LOST: "the disc was lost: it left the space between the pads",
        }
        return SimulationFailed(f"at t = {time:.4f} s {reasons[status]}", time)


def _start(model: SoftGrasp, time: float, state: State) -> tuple[Array, float]:
    """Nodal forces and bracket moment at the start, from the module."""
    graph = model.evaluate(time, state)
    force = torch.cat([torch.stack(graph.interfaces[k].contact[:2], -1) for k in "LU"]).numpy()
    port = graph.ports["pad_U"]
    return force, float(port.transformer.effort(port.effort, model.junctions)["bracket_spin"].sum().neg())


_announced = False


def announce_compilation() -> None:
    """Say, once and only if nothing is cached, what the first run is waiting for."""
    global _announced
    cache = Path(run.stats.cache_path or "")
    if not _announced and not run.signatures and not list(cache.glob("run_kernel.run-*.nbi")):
        log.warning("compiling the implicit stepper (about half a minute, once; the result is cached in %s)", cache)
    _announced = True


class _NoGradientYet(torch.autograd.Function):
    """Passes the solution through and refuses to differentiate it."""

    @staticmethod
    def forward(ctx: Any, solution: Tensor, *inputs: Tensor) -> Tensor:
        return solution.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise NotImplementedError(
            f"method='{METHOD}' has no gradient yet; differentiate short windows through an explicit method such as 'rk4'"
        )


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
        samples = self.y0.detach().reshape(-1, self.y0.shape[-1])
        runs = []
        for sample in samples:
            *_, last = self.stepper.integrate(sample, t)
            runs.append(torch.from_numpy(last.y))
        solution = torch.stack(runs, 1).reshape(len(t), *self.y0.shape)
        return _NoGradientYet.apply(solution, self.y0, *self.model.parameters())  # pyright: ignore[reportReturnType]

    @classmethod
    def valid_callbacks(cls) -> set[str]:
        return set()


def register() -> None:
    """Add the stepper to torchdiffeq's table of solvers. The table is private, hence the check of what is there."""
    solvers = getattr(importlib.import_module("torchdiffeq._impl.odeint"), "SOLVERS", None)
    if not isinstance(solvers, dict) or "dopri5" not in solvers:
        raise ImportError("this torchdiffeq keeps its solvers elsewhere; torchsoft was made for torchdiffeq 0.2.5")
    solvers[METHOD] = TorchdiffeqSolver
