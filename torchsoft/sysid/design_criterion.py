"""Design criterion of a candidate motion, and its exact gradient by the knots, from 2 n runs of the
adjoint.

With the whitened Jacobian J (m, n) of the samples by the coordinates x, the covariance is C =
(J'J)^-1; for a criterion phi and G = d phi / d(J'J), its derivative by a knot k is

    d phi / dk = sum_j W_j . d/dx_j (dr/dk),        W = 2 J G held fixed,

the difference along each x_j of the discrete adjoint by the knots with the weights W_j: 2 n runs
for any number of knots.

The covariance describes the end of a fit if samples are linear in the parameters over the
intervals, and runs exact. Both fail where a motion is chaotic, with large sensitivities that no fit
can use. So phi is that of C + mean(e e'), with e a fraction of the errors of one Gauss-Newton step
from a standard deviation away; its derivative ignores that of e. A motion is refused where a small
change of a parameter changes samples completely (`check_predictable`).
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch

from torchsoft.display import suggestion
from torchsoft.parallel import parallel_map, single_threaded
from torchsoft.plan.knots import Moves
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import unjudged
from torchsoft.sysid.fit import fisher
from torchsoft.sysid.initial_state import PREFIX, reference_from
from torchsoft.sysid.prediction import Frozen, Prediction, Steps, choice, predict, prepared
from torchsoft.sysid.problem import Problem, Residuals
from torchsoft.sysid.recording import Array, Mask, Recording, RunContext
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import in_full

# Criteria of optimal design


Optimality = Literal["D", "A"]


def optimality(criterion: Optimality, C: Array) -> tuple[float, Array]:
    """One number for a covariance C (s, s) of parameters' relative errors, the logarithm of a
    standard deviation, the smaller the better, and its derivative (s, s) by C.

    "D" is the mean logarithm along the axes of the ellipsoid of errors, its volume; "A" the root
    mean square of the standard deviations. With one parameter both are the same, and are called
    c-optimality. Raises `ValueError` for another.
    """
    if criterion not in get_args(Optimality):
        raise ValueError(
            f"`criterion` must be one of {', '.join(get_args(Optimality))}, not {criterion!r}"
        )
    if criterion == "D":
        return 0.5 * float(np.linalg.slogdet(C)[1]) / len(C), 0.5 * np.linalg.inv(C) / len(C)
    total = float(np.trace(C))
    return 0.5 * float(np.log(total / len(C))), 0.5 * np.eye(len(C)) / total


def chosen(
    problem: Problem, x: Array, names: Sequence[str] | None
) -> tuple[tuple[str, ...], Array]:
    """The parameters `names`, by default every free one that all recordings share, and the matrix
    (s, n) from errors of the coordinates x (n,) to their relative errors (s,). Raises `ValueError`
    for unknown names."""
    c, one = problem.coordinates, problem.recordings[0]
    values = c.values(x, one.name, one.parameters)
    rows = c.jacobian(x, one.name, values) * c.free / np.array([[values[name]] for name in c.names])
    own = {a.name for a in c.all if a.recording is not None}
    known = [
        name
        for name, row in zip(c.names, rows)
        if row.any() and name not in own and not name.startswith(PREFIX)
    ]
    selected = tuple(known if names is None else map(one.rig.full, names))
    if not selected or len(set(selected)) < len(selected) or not set(selected) <= set(known):
        raise ValueError(
            f"`names` must be some of the parameters {', '.join(known)}, each once, but is "
            f"{list(selected)}"
        )
    return selected, np.stack([rows[c.names.index(name)] for name in selected])


# Evaluation of a motion, and its gradient


RTOL = 1e-3
"""Relative tolerance of the runs: standard deviations are right to some percent."""

Range = tuple[float, float]
"""Lower and upper bound of a channel [its unit]."""

DIFFERENCE = 1e-2
"""Step of the difference along a coordinate [1]: wide, since gradients are rough where points
touch, leave and slip."""

MARGIN = 0.97
"""Fraction of a limit from which the penalty starts, since peaks lie between samples."""

PREDICTABLE = 10.0
"""Largest derivative of a sample by the logarithm of a parameter, over the largest sample of its
channel, of an acceptable motion."""

FARTHEST = 0.1
"""Largest relative error of a parameter at which a Gauss-Newton step is tried."""

TRIED = 2
"""Number of starting points for Gauss-Newton steps, each with its own signs."""

LEFT = 0.3
"""Fraction of these errors in the criterion: fits take finer steps than a search for motions."""

PRICE = 5.0
"""Penalty of a sample at twice its limit, in units of the criterion."""


class DesignEvaluation(NamedTuple):
    """One motion: the criterion, the penalty `cost` of excess, the largest fraction of their limits
    that channels reach, the relative standard `deviations` of the parameters (s,), their `errors`
    (k, s) by nonlinear samples, the criterion's derivative G (n, n) by the Fisher matrix, the rows
    J (m, n) of the samples, the steps, and the run."""

    value: float
    cost: float
    peaks: dict[str, float]
    deviations: dict[str, float]
    errors: Array
    G: Array
    J: Array
    steps: Frozen
    run: Prediction


class DesignEvaluator:
    """The criterion of motions of one recording of a problem at the nominal values of its unknowns,
    and its gradient by their knots. Raises `ValueError` where the other recordings cannot be
    run."""

    def __init__(
        self,
        problem: Problem,
        plan: str,
        moves: Moves,
        limits: Mapping[str, Range],
        criterion: Optimality,
        names: Sequence[str] | None,
        rtol: float,
        workers: int,
    ) -> None:
        self.problem, self.k, self.moves = problem, problem.names.index(plan), moves
        self.recording, self.rtol, self.workers = problem.recordings[self.k], rtol, workers
        self.criterion: Optimality = criterion
        self.x, self.free = problem.coordinates.start, problem.coordinates.free
        self.names, self.T = chosen(problem, self.x, names)
        self.limits = in_full([self.recording.rig], limits)
        for channel, (low, high) in self.limits.items():
            if channel not in self.recording.channels or not low < high:
                raise ValueError(
                    f"limits.{channel} = ({low:g}, {high:g}): a limit is (low, high) of a channel "
                    f"of the rig; {suggestion(channel, self.recording.channels, 'known:')}"
                )
        self.grid, self.recorded = self.recording.grid(problem.interpolated), self._recorded()
        self._idle: list[RunContext] = []
        self.cost = Counter({"runs": 0, "gradients": 0})

    def _recorded(self) -> Array:
        """A square root (.., n) of the Fisher matrix of the other recordings."""
        p = self.problem
        which = [name for name in p.names if name != self.recording.name]
        if not which:
            return np.zeros((0, len(self.x)))
        runner = Runner(p.recordings, self.workers)
        at = p.residuals(runner, self.x, which, self.rtol, self.free)
        if at.failed:
            raise ValueError(f"the nominal values do not reproduce what was recorded: {at.reasons}")
        return np.linalg.qr(at.J[: len(at.J) - len(p.coordinates.priors)])[1]

    @contextmanager
    def _context(self) -> Iterator[RunContext]:
        """A copy of the recording's rig, ready to run, which is discarded if a run fails."""
        context = self._idle.pop() if self._idle else self.recording.run_context()
        yield context
        self._idle.append(context)

    def run(
        self, z: Array, x: Array, steps: Steps, free: Mask | None
    ) -> tuple[Residuals, Prediction]:
        """Residuals of the motion z at x, those of the priors last, and the run. Raises
        `SimulationFailed`."""
        p = self.problem
        by_name = {self.recording.name: steps} if isinstance(steps, Frozen) else steps
        (job,) = p.jobs(x, [self.recording.name], by_name, free)
        with self._context() as context:
            context.rig.reference = self.moves.reference(torch.from_numpy(z))
            run = predict(context, job.values, self.grid, job.names, steps)
        self.cost["runs"] += 1
        return p.gather(x, [job], [run]), run

    def evaluate(self, z: Array, steps: Frozen | None = None) -> DesignEvaluation:
        """Evaluate the motion z, with the evaluator's tolerance or with `steps`; on frozen steps
        without the errors. Raises `SimulationFailed`."""
        at, run = self.run(z, self.x, self.rtol if steps is None else steps, self.free)
        C, T = np.zeros((len(self.x), len(self.x))), self.T
        every = np.concatenate((self.recorded, at.J))[:, self.free]
        C[np.ix_(self.free, self.free)] = fisher(every)[0]
        self.check_predictable(at.J, run)
        errors = self.errors(z, at, C) if steps is None else np.zeros((1, len(T)))
        spread = T @ C @ T.T
        deviations = dict(zip(self.names, np.sqrt(np.diag(spread)).tolist()))
        spread += LEFT**2 * errors.T @ errors / len(errors)
        value, S = optimality(self.criterion, spread)
        reached = {name: np.abs(part) for name, part in self.reached(run).items()}
        excess = [np.maximum(part - MARGIN, 0.0) for part in reached.values()]
        return DesignEvaluation(
            value,
            PRICE * sum(float(np.sum(part**2)) for part in excess),
            {name: float(part.max()) for name, part in reached.items()},
            deviations,
            errors,
            -C @ T.T @ S @ T @ C,
            at.J[: len(at.J) - len(self.problem.coordinates.priors)],
            at.steps[self.recording.name],
            run,
        )

    def check_predictable(self, J: Array, run: Prediction) -> None:
        """Raises `SimulationFailed` where a small change of a parameter would change the samples
        completely: their information is then that of chaos, which no fit can use."""
        c, at = self.problem.coordinates, 0
        rig = [one.of_the_rig and one.scale == "log" for one in c.all]
        for channel, one in self.problem.readouts(self.x, self.k).items():
            t, _ = self.recording.samples[channel]
            most = np.abs(one.expected(run, t)[0]).max() / self.problem.sensors[channel].noise
            of = np.abs(J[at : at + len(t)]).max(0) * rig / max(most, 1.0)
            if of.max() > PREDICTABLE:
                raise SimulationFailed(
                    f"a change of `{c.labels[int(of.argmax())]}` by 1 % would change `{channel}` "
                    f"by {of.max():.0f} % of its largest value: nothing that follows from it can "
                    "be predicted",
                    float(run.t[-1]),
                )
            at += len(t)

    def errors(self, z: Array, at: Residuals, C: Array) -> Array:
        """Relative errors (k, s) of the parameters after one noiseless Gauss-Newton step from a
        standard deviation away, at points of different signs, each on its own steps: zero where
        samples are linear over an interval and steps fine enough, large where the motion is
        chaotic. Raises `SimulationFailed`."""
        out, (low, high), T = [], self.problem.coordinates.bounds, self.T
        sd = np.minimum(np.sqrt(np.diag(T @ C @ T.T)), FARTHEST)
        for k in range(TRIED):
            signs = (-1.0) ** (np.arange(len(T)) // 2**k)
            off = np.clip(self.x + np.linalg.pinv(T) @ (signs * sd), low, high) - self.x
            there, _ = self.run(z, self.x + off, self.rtol, None)
            out.append(T @ C @ at.J.T @ (there.r - at.r - at.J @ off))
        return np.array(out)

    def reached(self, run: Prediction) -> dict[str, Array]:
        """Position of limited channels (G,) within their ranges: 0 in the middle, -1 and 1 at the
        ends."""
        column = self.recording.channels.index
        return {
            name: (2 * run.signals[:, column(name)] - low - high) / (high - low)
            for name, (low, high) in self.limits.items()
        }

    def slopes(self, z: Array, at: DesignEvaluation) -> Array:
        """Gradient by z of the criterion and of the penalty, on the steps of the evaluation. Raises
        `SimulationFailed`."""
        c, x, W, tasks = self.problem.coordinates, self.x, 2 * at.J @ at.G, []
        (low, high), here = c.bounds, self.overload(at.run)  # weights on the signals at x
        for j in np.flatnonzero(self.free & (np.abs(at.J).max(0) > 0)):
            ahead, behind = x.copy(), x.copy()
            ahead[j], behind[j] = min(x[j] + DIFFERENCE, high[j]), max(x[j] - DIFFERENCE, low[j])
            w = W[:, j] / (ahead[j] - behind[j])
            if c.all[j].of_the_rig:
                weights = self.pulled(x, at.run, w)
                tasks += [(ahead, weights), (behind, -weights)]
            else:  # the run is the same, only what a sensor makes of it is not
                here += self.pulled(ahead, at.run, w) - self.pulled(behind, at.run, w)
        if here.any():
            tasks.append((x, here))

        def swept(i: int) -> Array:
            return self.adjoint(z, tasks[i][0], at.steps, tasks[i][1])

        with single_threaded():
            return np.asarray(
                sum(part for _, part in parallel_map(swept, len(tasks), self.workers))
            )

    def adjoint(self, z: Array, x: Array, steps: Steps, weights: Array) -> Array:
        """Gradient by z of the signals of the run at x, weighted with `weights` (G, channels).
        Raises `SimulationFailed`."""
        variables = torch.tensor(z, requires_grad=True)
        with self._context() as context:
            context.rig.reference = self.moves.reference(variables)
            y0 = prepared(context, self.problem.values(x, self.k), ())[0].detach()
            run = unjudged(
                context.rig,
                self.grid.t,
                y0=y0,
                reference=reference_from(context.rig, context.start, context.rig.unpack(y0).pose),
                gradient="discrete",
                **choice(steps),
            )
            signals = run.together(*self.recording.channels)[self.grid.early :]
            (slopes,) = torch.autograd.grad(signals, variables, torch.from_numpy(weights))
        self.cost["gradients"] += 1
        return slopes.numpy()

    def pulled(self, x: Array, run: Prediction, w: Array) -> Array:
        """Weights (G, channels) on the signals, from weights w (m,) on the residuals."""
        out, at = np.zeros(run.signals.shape), 0
        for channel, one in self.problem.readouts(x, self.k).items():
            t, measured = self.recording.samples[channel]
            _, weight = one.residuals(one.expected(run, t)[0], measured)
            v, noise = w[at : at + len(t)], self.problem.noise.get(channel)
            v = v if noise is None else noise.whitener(t).T @ v
            out += one.pulled_back(run, t, weight * v)
            at += len(t)
        return out

    def overload(self, run: Prediction) -> Array:
        """Derivative of the penalty by the signals (G, channels)."""
        out, column = np.zeros(run.signals.shape), self.recording.channels.index
        for name, part in self.reached(run).items():
            low, high = self.limits[name]
            excess = np.maximum(np.abs(part) - MARGIN, 0.0) * np.sign(part)
            out[:, column(name)] = 4 * PRICE * excess / (high - low)
        return out

    def made(self, z: Array, at: DesignEvaluation) -> Recording:
        """The recording of a motion, with the noiseless samples of its sensors."""
        rig, samples = deepcopy(self.recording.rig), {}
        with torch.no_grad():
            rig.reference = self.moves.reference(torch.from_numpy(z))
        for channel, one in self.problem.readouts(self.x, self.k).items():
            t, _ = self.recording.samples[channel]
            samples[channel] = t, one.expected(at.run, t)[0]
        return replace(self.recording, rig=rig, samples=samples)
