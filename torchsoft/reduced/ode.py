"""Small ordinary differential equations y' = S y + C phi(y, u): text, torch module, and fast
rollout.

One list of terms defines the equations in text, the right-hand side for torchdiffeq, and the
compiled rollout. A linear model is rolled out by an exact recursion, any other by an L-stable
step: scipy's stiff solvers call Python at every step and cost more than the full simulator.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numba import njit
from scipy.signal import cont2discrete
from torch import Tensor, nn

from torchsoft.codegen import compile_law
from torchsoft.display import Shown
from torchsoft.solve.kernel.invoke import call_linearise, call_value

UNITS = {
    "x_C": "m", "theta": "rad", "x_Br": "m", "v_C": "m/s", "omega": "rad/s", "v_Br": "m/s",
    "F_x": "N", "x_d": "m", "x_d_dot": "m/s",
}  # fmt: skip
"""Units of the variables of a reduced model."""

BEYOND = 100.0
"""Largest state of a rollout, over the states' scale; beyond, it has diverged."""

GAMMA = 1 + 1 / math.sqrt(2)
"""Coefficient of the Rosenbrock method ROS2: second order, L-stable."""

TOLERANCE = 1e-3
"""Largest difference, over the states' scale, between rollouts of one step and of half of it."""

HALVINGS = 8
"""Most halvings of the step of a rollout."""


class Factor(NamedTuple):
    """shape(form / scale), with a linear combination `form` of variables by name."""

    form: Mapping[str, float]
    shape: Literal["linear", "tanh", "abs"] = "linear"
    scale: float = 1.0


@dataclass(frozen=True)
class Term:
    """A candidate term, the product of its factors, with its formula as text and its unit."""

    text: str
    unit: str
    factors: tuple[Factor, ...]

    @property
    def linear(self) -> bool:
        return len(self.factors) == 1 and self.factors[0].shape == "linear"


class Table(NamedTuple):
    """Terms as tensors: forms (terms * factors, variables), and masks of the factors that are a
    tanh or a modulus (terms, factors)."""

    forms: Tensor
    tanh: Tensor
    modulus: Tensor


def tabulate(terms: Sequence[Term], variables: Sequence[str]) -> Table:
    """Terms as tensors over `variables` and the constant "1". Raises `ValueError` for an unknown
    variable."""
    names, most = [*variables, "1"], max((len(term.factors) for term in terms), default=1)
    forms = np.zeros((len(terms), most, len(names)))
    shapes = np.full((len(terms), most), "linear", dtype=object)
    forms[:, :, -1] = 1.0  # a factor that is not there is one
    for i, term in enumerate(terms):
        for j, factor in enumerate(term.factors):
            forms[i, j] = 0.0
            shapes[i, j] = factor.shape
            for name, weight in factor.form.items():
                if name not in names:
                    raise ValueError(
                        f"term `{term.text}` needs the variable {name!r}; known: {', '.join(names)}"
                    )
                forms[i, j, names.index(name)] = weight / factor.scale
    arrays = (
        forms.reshape(-1, len(names)),
        np.asarray(shapes == "tanh"),
        np.asarray(shapes == "abs"),
    )
    return Table(*map(torch.from_numpy, arrays))


def features(z: Tensor, table: Table) -> Tensor:
    """phi (..., terms) of the variables z (..., variables + 1)."""
    factor = (z @ table.forms.mT).reshape(*z.shape[:-1], *table.tanh.shape)
    return torch.where(
        table.tanh, factor.tanh(), torch.where(table.modulus, factor.abs(), factor)
    ).prod(-1)


class Held(nn.Module):
    """Inputs u (T, inputs) sampled at t (T,) [s], interpolated linearly."""

    t: Tensor
    u: Tensor

    def __init__(self, t: Tensor, u: Tensor) -> None:
        super().__init__()
        self.register_buffer("t", t)
        self.register_buffer("u", u)

    def forward(self, t: Tensor | float) -> Tensor:
        when = torch.as_tensor(t, dtype=self.t.dtype)
        i = torch.searchsorted(self.t, when.detach()).clamp(1, len(self.t) - 1)
        fraction = (when - self.t[i - 1]) / (self.t[i] - self.t[i - 1])
        return torch.lerp(self.u[i - 1], self.u[i], fraction.clamp(0.0, 1.0))


@dataclass(frozen=True, repr=False)
class Rollout(Shown):
    """States y (T, states) at t (T,) [s], NaN from the time of divergence `diverged_at` [s] on, and
    the wall time [s]."""

    t: np.ndarray
    y: np.ndarray
    diverged_at: float | None
    wall_s: float

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [("samples", f"{len(self.t)}, {self.t[0]:g} to {self.t[-1]:g} s")]
        return f"Rollout: {self}", [*rows, ("time", f"{1e3 * self.wall_s:.3g} ms")]

    def __str__(self) -> str:
        return (
            "bounded" if self.diverged_at is None else f"diverged at t = {self.diverged_at:.4g} s"
        )


def indices(places: Sequence[tuple[int, int]]) -> tuple[Tensor, ...] | None:
    """Places (row, column) of a matrix, as `index_put` takes them; None if there are none."""
    return tuple(torch.tensor(one, dtype=torch.long) for one in zip(*places)) or None


class ReducedModel(Shown, nn.Module):
    """y' = S y + C phi(y, u). `forward(t, y)` follows torchdiffeq, y (..., states); inputs come
    from `signal(t)`.

    states, inputs: names. kinematics: which state is the rate of which, as in {"x_C": "v_C"}.
    equations: for every other state the (term, coefficient) pairs of its rate, SI units. feedback:
    for inputs that a control law makes, its gains on states and on further inputs, {"F_x": {"x_d":
    K, "x_C": -K}}; `signal` then gives those further inputs. Coefficients and gains are
    `nn.Parameter`s. scale (states,): sizes that belong to the states, for judging divergence.
    intervals: for every term in order its (low, high), if an ensemble has found them.
    """

    def __init__(
        self, states: Sequence[str], inputs: Sequence[str], kinematics: Mapping[str, str],
        equations: Mapping[str, Sequence[tuple[Term, float]]], *,
        feedback: Mapping[str, Mapping[str, float]] | None = None,
        scale: np.ndarray | Sequence[float] | None = None,
        intervals: Sequence[tuple[float, float]] | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.states, self.inputs, self.kinematics = tuple(states), tuple(inputs), dict(kinematics)
        missing = set(self.states) ^ (set(kinematics) | set(equations))
        if missing:
            raise ValueError(
                "every state needs one equation, but these have none or are no states: "
                f"{sorted(missing)}"
            )
        self.targets = [target for target, pairs in equations.items() for _ in pairs]
        self.terms = [term for pairs in equations.values() for term, _ in pairs]
        values = [value for pairs in equations.values() for _, value in pairs]
        self.coefficients = nn.Parameter(torch.tensor(values, dtype=torch.float64))
        self.intervals = None if intervals is None else [(float(a), float(b)) for a, b in intervals]
        self.feedback = {name: dict(law) for name, law in (feedback or {}).items()}
        made = [name for law in self.feedback.values() for name in law if name not in self.states]
        self.outer = tuple(
            dict.fromkeys([name for name in inputs if name not in self.feedback] + made)
        )
        self.gains = nn.Parameter(
            torch.tensor(
                [gain for law in self.feedback.values() for gain in law.values()],
                dtype=torch.float64,
            )
        )
        self.scale = np.asarray(
            scale if scale is not None else np.ones(len(self.states)), dtype=float
        )
        self.signal: nn.Module | None = None
        self._table = tabulate(self.terms, (*self.states, *self.inputs))
        entries = [(self.states.index(target), i) for i, target in enumerate(self.targets)]
        self._entries = indices(entries)
        law = [
            (self.inputs.index(name), [*self.states, *self.outer].index(other))
            for name, gains in self.feedback.items() for other in gains
        ]  # fmt: skip
        self._law = indices(law)

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [tuple(line.split(" = ", 1)) for line in self.text()]
        inputs = f", inputs {', '.join(self.outer)}" if self.outer else ""
        return f"ReducedModel: {len(self.terms)} terms{inputs}", rows  # pyright: ignore[reportReturnType]

    @property
    def linear(self) -> bool:
        return all(term.linear for term in self.terms)

    def with_feedback(self, feedback: Mapping[str, Mapping[str, float]] | None) -> "ReducedModel":
        """The same equations under another control law."""
        return ReducedModel(
            self.states, self.inputs, self.kinematics, self.equations(), feedback=feedback,
            scale=self.scale, intervals=self.intervals,
        )  # fmt: skip

    def equations(self) -> dict[str, list[tuple[Term, float]]]:
        """(term, coefficient) pairs by the state of whose rate they are part."""
        out: dict[str, list[tuple[Term, float]]] = {
            name: [] for name in self.states if name not in self.kinematics
        }
        for target, term, value in zip(
            self.targets, self.terms, self.coefficients.detach().tolist()
        ):
            out[target].append((term, value))
        return out

    def matrices(self) -> tuple[Tensor, Tensor, Tensor]:
        """S (states, states), C (states, terms) and the control law's K (inputs, states + outer
        inputs)."""
        n, m = len(self.states), len(self.inputs)
        S = torch.zeros(n, n, dtype=torch.float64)
        for name, rate in self.kinematics.items():
            S[self.states.index(name), self.states.index(rate)] = 1.0
        C = torch.zeros(n, len(self.terms), dtype=torch.float64)
        if self._entries is not None:
            C = C.index_put(self._entries, self.coefficients)
        K = torch.zeros(m, n + len(self.outer), dtype=torch.float64)
        for i, name in enumerate(self.inputs):
            if name in self.outer:
                K[i, n + self.outer.index(name)] = 1.0
        return S, C, K if self._law is None else K.index_put(self._law, self.gains)

    def forward(self, t: Tensor | float, y: Tensor) -> Tensor:
        """dy/dt, shaped like y (..., states). Raises `ValueError` when the model has inputs but no
        `signal`."""
        w = y.new_zeros(*y.shape[:-1], 0)
        if self.outer:
            if self.signal is None:
                raise ValueError(
                    f"set `signal` to a module that gives {', '.join(self.outer)} at t, such as "
                    "`Held`"
                )
            w = self.signal(t).expand(*y.shape[:-1], -1)
        return self.rates(torch.cat((y, w), -1))

    def rates(self, yw: Tensor) -> Tensor:
        """dy/dt (..., states) from states and outer inputs (..., states + outer)."""
        return _rates(yw, self._table, *self.matrices())

    def phi(self, yu: np.ndarray) -> np.ndarray:
        """The terms (T, terms) at states and inputs (T, states + inputs)."""
        return features(
            torch.from_numpy(np.column_stack((yu, np.ones(len(yu))))), self._table
        ).numpy()

    def state_space(self) -> tuple[np.ndarray, np.ndarray]:
        """A (states, states) and B (states, outer + 1) of y' = A y + B (u, 1). Raises `ValueError`
        unless linear."""
        if not self.linear:
            raise ValueError("the model has terms that are not linear; it has no A and B")
        n, size = len(self.states), len(self.states) + len(self.outer)
        f = self.rates(torch.eye(size + 1, size, dtype=torch.float64).roll(1, 0)).detach().numpy()
        slopes = (f[1:] - f[0]).T
        return slopes[:, :n], np.column_stack((slopes[:, n:], f[0]))

    def rollout(
        self, t: np.ndarray, y0: np.ndarray, u: np.ndarray, *, scale: np.ndarray | None = None
    ) -> Rollout:
        """Integrate from y0 (states,) at t[0] with outer inputs u (T, outer), straight between the
        times t (T,) [s].

        Exact for linear models on equally spaced times, a compiled Rosenbrock method otherwise. A
        rollout that goes `BEYOND` times `scale` (states,), the model's by default, has diverged: it
        is NaN from that time on.
        """
        t, y0, u = (
            np.asarray(t, float),
            np.asarray(y0, float),
            np.asarray(u, float).reshape(len(t), -1),
        )
        if u.shape[1] != len(self.outer) or y0.shape != (len(self.states),):
            raise ValueError(
                f"`y0` must hold {', '.join(self.states)} and `u` one column each for "
                f"{', '.join(self.outer) or 'nothing'}, but have shapes {y0.shape} and {u.shape}"
            )
        size = self.scale if scale is None else np.asarray(scale, float)
        began, limit = perf_counter(), BEYOND * size
        if self.linear and len(t) > 2 and np.allclose(np.diff(t), t[1] - t[0], rtol=1e-6, atol=0):
            with np.errstate(over="ignore", invalid="ignore"):
                y = linear_rollout(
                    *self.state_space(), t[1] - t[0], y0, np.column_stack((u, np.ones(len(t))))
                )
        else:
            parts = [part.detach() for part in self.matrices()]
            law = compile_law(
                lambda x, _: _rates(x, self._table, *parts),
                torch.ones(len(y0) + u.shape[1]).double(), {}, differentiated=len(y0),
            )  # fmt: skip
            y = nonlinear_rollout(law.value, law.linearise, t, y0, u, limit, size)
        wild, ended = ~(np.abs(y) <= limit).all(-1), None
        if wild.any():
            y[wild.argmax() :], ended = np.nan, float(t[wild.argmax()])
        return Rollout(t, y, ended, perf_counter() - began)

    def text(self) -> list[str]:
        """One equation a line, in SI units."""
        lines = [f"{name}' = {rate}" for name, rate in self.kinematics.items()]
        for target, pairs in self.equations().items():
            body = " ".join(
                f"{'+-'[value < 0]} {abs(value):.4g} {_bracketed(term.text)}"
                for term, value in pairs
            )
            lines.append(f"{target}' = {body.removeprefix('+ ') or '0'}")
        return lines

    def coefficient_table(self) -> list[dict[str, Any]]:
        """Every coefficient with its unit and, from an ensemble, its interval."""
        rows, intervals = [], self.intervals or [None] * len(self.terms)
        for target, term, value, interval in zip(
            self.targets, self.terms, self.coefficients.tolist(), intervals
        ):
            unit = f"{UNITS.get(target, target)}/s per {term.unit}"
            rows.append(
                {
                    "equation": target,
                    "term": term.text,
                    "value": value,
                    "unit": unit,
                    "interval": interval,
                }
            )
        return rows


def _rates(yw: Tensor, table: Table, S: Tensor, C: Tensor, K: Tensor) -> Tensor:
    y = yw[..., : len(S)]
    z = torch.cat((y, yw @ K.mT, torch.ones_like(yw[..., :1])), -1)
    return y @ S.mT + features(z, table) @ C.mT


def _bracketed(text: str) -> str:
    return f"({text})" if " + " in text or " - " in text else text


def linear_rollout(
    A: np.ndarray, B: np.ndarray, h: float, y0: np.ndarray, w: np.ndarray
) -> np.ndarray:
    """Exact solution (T, states) of y' = A y + B w from y0 at steps of h [s], with w (T, inputs)
    linear between them."""
    n = len(A)
    discrete: Any = cont2discrete((A, B, np.eye(n), np.zeros_like(B)), h, method="foh")
    F, G, _, D, _ = discrete
    return recursion(F, w @ G.T, y0 - D @ w[0]) + w @ D.T


@njit(cache=True)
def recursion(F, f, x0):
    """x[k+1] = F x[k] + f[k] from x[0] = x0, as (T, n) with f (T, n)."""
    T, n = f.shape
    x = np.empty((T, n))
    x[0] = x0
    for k in range(T - 1):
        for i in range(n):
            total = f[k, i]
            for j in range(n):
                total += F[i, j] * x[k, j]
            x[k + 1, i] = total
    return x


def nonlinear_rollout(
    value: int,
    linearise: int,
    t: np.ndarray,
    y0: np.ndarray,
    w: np.ndarray,
    limit: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:
    """y (T, states) at t (T,) [s], NaN once it is beyond `limit` (states,); the step is halved
    until the solution converges.

    value, linearise: addresses of the compiled rates of (y, w), differentiated by y.
    """

    def stepped(pieces: int) -> np.ndarray:
        step: Any = _rosenbrock
        return step(value, linearise, t, y0, w, limit, pieces)

    y = stepped(1)
    for halving in range(1, HALVINGS + 1):
        coarse, y = y, stepped(2**halving)
        error = np.abs(y - coarse) / scale
        if np.isfinite(y).all() and np.isfinite(coarse).all() and error.max() <= TOLERANCE:
            break
        if halving >= 3 and np.isnan(y[-1, 0]) and np.isnan(coarse[-1, 0]):
            break  # it diverges at either step
    return y


@njit(cache=True)
def _rosenbrock(value, linearise, t, y0, w, limit, pieces):
    n = len(y0)
    out = np.full((len(t), n), np.nan)
    out[0] = y0
    y, f, later, J, one, none = (
        y0.copy(),
        np.empty(n),
        np.empty(n),
        np.empty((n, n)),
        np.eye(n),
        np.empty(0),
    )
    for k in range(len(t) - 1):
        h, rise = (t[k + 1] - t[k]) / pieces, (w[k + 1] - w[k]) / pieces
        for piece in range(pieces):
            here = w[k] + rise * piece
            call_linearise(linearise, np.concatenate((y, here)), none, f, J)
            call_value(value, np.concatenate((y, here + rise)), none, later)
            drift = GAMMA * (later - f)
            inverse = np.linalg.inv(one - GAMMA * h * J)
            k1 = inverse @ (f + drift)
            call_value(value, np.concatenate((y + h * k1, here + rise)), none, later)
            k2 = inverse @ (later - 2 * k1 - drift)
            y = y + h * (1.5 * k1 + 0.5 * k2)
            for i in range(n):
                if not abs(y[i]) <= limit[i]:
                    return out
        out[k + 1] = y
    return out
