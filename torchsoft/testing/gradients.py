"""Whether the derivatives of a run are those of what ran: adjoint, forward sensitivities and
central differences along the same steps."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.display import Shown
from torchsoft.physics.arguments import Numbers, tensor
from torchsoft.physics.channels import Touch
from torchsoft.physics.rig import Rig
from torchsoft.solve.gradients import directions
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import RTOL, Initial, simulate, started
from torchsoft.solve.simulate import Start as Begin
from torchsoft.solve.trajectory import Trajectory
from torchsoft.testing.energy import conclude

Value = Callable[[Trajectory], Tensor]
Values = Callable[[Trajectory], dict[str, Tensor]]
Leaves = dict[str, Tensor]
Pair = tuple[float | None, float | None]
Slopes = dict[str, dict[str, float]]
"""Derivatives of every value by every leaf, along the leaf's way."""

NEWTON = 1e-10
"""Newton's tolerance of the runs [N]: differences are as good as steps are solved."""

LENGTHS = 1e-8, 3e-9, 3e-8, 1e-9, 1e-7, 1e-10, 1e-6
"""Of differences, relative to the parameter, in the order in which they are tried until two
neighbours agree with each other and with the derivative."""

REPEATS = 4
"""Most runs along the steps of the one before, until all of them are solved as they are given."""

WEAK = 100.0
"""Most by which a parameter that matters less than others is moved further."""

BOUND = 1e-5
"""Relative error of a derivative beside its difference, beyond the difference's own uncertainty."""

UNCLEAR = 1e-2
"""Relative uncertainty of a difference beyond which there is nothing to compare with."""

TOGETHER = "all together"
"""Name of the direction in which all parameters weigh alike, as far as they weigh at all."""

REST = 1.0 / (1.0 - 0.1 ** (2.0 / 3.0))
"""Error of the steps over the change by a tenth of the tolerance: that of a method of second order
falls with the tolerance to the power of two thirds."""

NOTHING, NOISE = 1e-9, 1e-6
"""Parts of the largest derivative, or of the value, below which an adjoint is rounding, and a
difference noise."""


class Derivative(NamedTuple):
    """The derivative of a value by the relative change of a parameter, or along a random direction
    of one of several entries, of the start or of the knots of the reference: by the adjoint,
    forward (None: of custom values, and of parameters of several entries), by central
    differences with their uncertainty (None: taken together only), and its error by the steps, as
    the change at a tenth of the tolerance shows it (None: not asked for). `scale` is the largest
    derivative of the value, by adjoint or by differences, or the value where it is larger; of all
    together, the sum of their sizes."""

    value: str
    by: str
    adjoint: float
    forward: float | None
    difference: float | None
    uncertainty: float | None
    step_error: float | None
    scale: float

    @property
    def size(self) -> float:
        """What its errors are relative to: the larger of adjoint and difference, whose parts
        may cancel where all parameters are taken together."""
        together = self.scale if self.by == TOGETHER else 0.0
        return max(abs(self.adjoint), abs(self.difference or 0.0), together)

    @property
    def zero(self) -> bool:
        """Whether the parameter has no effect on the value: adjoint and difference are rounding."""
        difference, uncertainty = abs(self.difference or 0.0), self.uncertainty or 0.0
        rounding = NOTHING * self.scale
        return (
            abs(self.adjoint) <= rounding
            and difference <= rounding + 2 * uncertainty
            and uncertainty <= NOISE * self.scale
        )

    @property
    def clear(self) -> bool:
        """Whether differences say what it is."""
        return self.zero or self.uncertainty is None or self.uncertainty <= UNCLEAR * self.size

    @property
    def signed(self) -> bool:
        """Whether its sign does not depend on the steps."""
        error = self.step_error or 0.0
        return error < max(abs(self.adjoint), NOTHING * self.scale) or error == 0.0


@dataclass(frozen=True, repr=False)
class GradientCheck(Shown):
    """Derivatives of a run that were compared, and the run."""

    derivatives: tuple[Derivative, ...]
    run: Trajectory
    rtol: float

    @property
    def unclear(self) -> tuple[Derivative, ...]:
        """Derivatives that have no difference to compare with: a law has a kink there, or a run did
        not take the same steps."""
        return tuple(one for one in self.derivatives if not one.clear)

    @property
    def unsigned(self) -> tuple[Derivative, ...]:
        """Derivatives whose sign depends on the steps."""
        return tuple(one for one in self.derivatives if not one.signed)

    def _throughout(self, holds: Callable[[Derivative], bool]) -> tuple[str, ...]:
        """Parameters of which something holds for the derivatives of all values."""
        names = dict.fromkeys(one.by for one in self.derivatives if one.by != TOGETHER)
        broken = {one.by for one in self.derivatives if not holds(one)}
        return tuple(name for name in names if name not in broken)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Parameters whose derivatives are all zero, so that nothing about them was checked."""
        return self._throughout(lambda one: one.zero)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """Parameters that have an effect, but no difference to compare with."""
        vague = self._throughout(lambda one: one.zero or not one.clear)
        return tuple(name for name in vague if name not in self.without_effect)

    @cached_property
    def contact_regimes(self) -> dict[str, float]:
        """Shares of the contact points' time in every state, and how often they touch down and
        leave; empty for a rig without contacts."""
        if not self.run.contact_state:
            return {}
        states = torch.cat([x.flatten(1) for x in self.run.contact_state.values()], 1)
        kinds = {"stick": 1, "slip": 2, "out of contact": 0}
        shares = {name: float((states == kind).double().mean()) for name, kind in kinds.items()}
        on = states > 0
        changes = {"touch down": on[1:] & ~on[:-1], "leave": on[:-1] & ~on[1:]}
        return shares | {name: int(x.sum()) for name, x in changes.items()}

    @property
    def regime(self) -> str:
        """What the contact points did in the run."""
        texts = [
            f"{much} {name}" if isinstance(much, int) else f"{much:.0%} {name}"
            for name, much in self.contact_regimes.items()
        ]
        return f"{', '.join(texts[:3])}; {', '.join(texts[3:])}"

    @property
    def absent(self) -> tuple[str, ...]:
        """What the contact points never did in the run; empty for a rig without contacts."""
        if self.contact_regimes.get("out of contact") == 1.0:
            return ("touch",)
        return tuple(name for name, much in self.contact_regimes.items() if not much)

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [("contact points", self.regime)] if self.contact_regimes else []
        for label, names in (("without effect", self.without_effect), ("unclear", self.unchecked)):
            rows += [(label, ", ".join(names))] if names else []
        for one in self.derivatives:
            text = f"{one.adjoint:.6g} adjoint"
            text += "" if one.forward is None else f", {one.forward:.6g} forward"
            if one.difference is not None:
                text += f", {one.difference:.6g} +- {one.uncertainty:.1g} differences"
            text += "" if one.step_error is None else f", {one.step_error:.1g} by the steps"
            text += "" if one.clear else " (unclear)"
            text += "" if one.signed else " (sign unknown)"
            rows.append((f"{one.value} by {one.by}", text))
        return f"GradientCheck: {len(self.derivatives)} derivatives, rtol {self.rtol:g}", rows


def check_gradients(
    rig: Rig, t: Numbers, y0: Numbers | Begin, *, wrt: Sequence[str] | None = None,
    of: Value | Sequence[str] | None = None, rtol: float = RTOL, bound: float = BOUND,
    dy0: Numbers | None = None, each: bool = True, step_error: bool = True, centres: bool = False,
) -> GradientCheck:  # fmt: skip
    """Compare the derivatives of a run from y0 (size,) through the times t (T,) [s] three ways: the
    discrete adjoint, forward sensitivities, and central differences of runs along the same steps.
    A `y0` that is a function of the rig, such as `BuiltRig.initial`, is differentiated, too.

    Of what: names of channels, whose last values are differentiated, or a function of the run that
    gives a number; by default a random sum of the bodies' motion, and one of all forces, loads and
    moments (with `centres` the centres of pressure too). By what: `wrt` names parameters, "start"
    (along dy0 (size,), by default a random direction as large as the run's own changes) and
    "reference.NAME.values"; by default all that require a gradient, the start and the knots.

    Every difference is taken at two lengths that agree; how much they disagree is its uncertainty.
    A derivative may miss its difference by `bound` of the larger of the two and twice the
    uncertainty. Parameters whose derivatives are zero throughout, such as coefficients of friction
    in a run without slip, were not checked: for those in `wrt` that is a fault. By default, where a
    parameter may have no effect, such as a limit that is not reached, the result lists them as
    `without_effect`, and a warning names them if no contact point touches, sticks or slips in the
    run.

    Without `each` there is one difference for all parameters, along a direction in which they weigh
    equally: few runs, and no word on which parameter is wrong. With `step_error` one more run, at a
    tenth of `rtol`, says how much of each derivative is that of the steps; a warning names those
    whose sign depends on it.

    Raises `CheckFailed` with a message on every fault, `ValueError` for names that are not known.
    """
    steps = _steps(rig, t, y0, rtol)
    direction = _direction(rig, steps) if dy0 is None else tensor("dy0", dy0).detach()
    with _leaves(rig, wrt) as leaves:
        probe = Probe(rig, steps, leaves, direction, _values(rig, steps, of, centres))
        check = probe.compared(rtol, bound, each, step_error)
    faults, idle = _faults(check, bound), check.without_effect
    if idle and (wrt is not None or len(idle) == len(leaves)):
        faults.append(_unchecked(check, idle))
    conclude(faults)
    idle = idle if {"touch", "stick", "slip"} & {*check.absent} else ()
    for names in filter(None, (idle, check.unchecked)):
        warn(_unchecked(check, names))
    for one in check.unsigned:
        warn(
            f"the sign of the derivative of `{one.value}` by `{one.by}` depends on the steps: it "
            f"is {one.adjoint:.3g} with an error of {one.step_error:.3g} at rtol = {rtol:g}; take "
            "a smaller `rtol`"
        )
    return check


class Steps(NamedTuple):
    """The steps along which all runs are compared: times (T,), the initial state as a function of
    the rig, knots, and the states (T, size) at the times."""

    t: Tensor
    begin: Begin
    knots: Tensor
    y: Tensor


def _steps(rig: Rig, t: Numbers, y0: Numbers | Begin, rtol: float) -> Steps:
    begin = y0
    if not callable(begin):
        state = tensor("y0", begin).detach()
        begin = lambda rig: Initial(state, rig.reference)
    run = simulate(rig, t, y0=y0, rtol=rtol, tolerance=NEWTON)
    # rounding may keep Newton from solving a step where a law bends, which is then halved
    for _ in range(REPEATS):
        run = _along(rig, run.t, run.knots, y0=begin)
        if run.stats.failed_steps == 0:
            break
    return Steps(run.t, begin, run.knots, run.y.detach())


def _along(rig: Rig, t: Tensor, knots: Tensor, **how: Any) -> Trajectory:
    """A run along given steps; those that were halved show in its `stats`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return simulate(rig, t, knots=knots, tolerance=NEWTON, **how)


@contextmanager
def _leaves(rig: Rig, wrt: Sequence[str] | None) -> Iterator[Leaves]:
    """The tensors that are to be moved, which require a gradient meanwhile; the start's is a number
    that moves it along its direction."""
    kick = {"start": torch.zeros((), dtype=torch.float64)}
    knots = {
        name: p
        for name, p in rig.reference.named_parameters(prefix="reference")
        if name.endswith(".values")
    }
    mine = {own: other for other, own in rig.names.items()}
    own = {mine.get(name, name): p for name, p in rig.named_parameters() if p.requires_grad}
    leaves = kick | own | knots
    if wrt is not None:
        known = kick | knots
        leaves = {name: known[name] if name in known else rig.parameter(name) for name in wrt}
    before = [(p, p.requires_grad) for p in leaves.values()]
    for p in leaves.values():
        p.requires_grad_()
    try:
        yield leaves
    finally:
        for p, required in before:
            p.requires_grad_(required)


class RandomSums:
    """The values that are differentiated by default: a random sum of the bodies' motion, and one of
    the channels of touch `felt`; also of forward sensitivities."""

    def __init__(self, rig: Rig, steps: Steps, centres: bool) -> None:
        generator = torch.Generator().manual_seed(0)
        draw = lambda *shape: torch.randn(shape, generator=generator, dtype=torch.float64)
        self.y0, self.weights = steps.y[0], draw(len(steps.t) - 1, rig.layout.size)
        for (part, _), where in rig.layout.slices.items():
            self.weights[:, where] *= {"pose": 1e3, "velocity": 10.0}.get(part, 0.0)  # [1/m, s/m]
        touch = Touch(rig)
        # centres of pressure bend sharply at light forces
        self.felt = [name for name in touch if centres or "centre" not in name]
        units = [{"N": 1.0, "N.m": 50.0, "m": 1e3}[touch.unit(name)] for name in self.felt]
        self.pulls = draw(len(steps.t), len(self.felt)) * torch.tensor(units, dtype=torch.float64)

    def __call__(self, run: Trajectory) -> dict[str, Tensor]:
        motion = {"motion": (self.weights * (run.y[1:] - self.y0)).sum()}
        if not self.felt:
            return motion
        return motion | {"forces": (self.pulls * run.together(*self.felt)).sum()}

    def forward(self, run: Trajectory) -> dict[str, Tensor]:
        """Derivatives (n,) of the values by the forward sensitivities of a run."""
        assert run.sensitivities is not None
        motion = {"motion": torch.einsum("ti,tin->n", self.weights, run.sensitivities[1:])}
        if not self.felt:
            return motion
        touch = torch.stack([run.touch_sensitivities[name] for name in self.felt], 1)
        return motion | {"forces": torch.einsum("ti,tin->n", self.pulls, touch)}


def _values(rig: Rig, steps: Steps, of: Value | Sequence[str] | None, centres: bool) -> Values:
    if of is None:
        return RandomSums(rig, steps, centres)
    if isinstance(of, str) or not (callable(of) or isinstance(of, Sequence)):
        raise ValueError(f"`of` must be a list of channels or a function, but is {of!r}")
    if callable(of):
        return lambda run: {"value": of(run)}
    return lambda run: {name: run[name][-1] for name in of}


@dataclass(frozen=True)
class Probe:
    """A rig whose leaves are moved: parameters, knots, and the start, along its direction (size,).
    Its runs take given steps, and `values` are differentiated."""

    rig: Rig
    steps: Steps
    leaves: Leaves
    direction: Tensor
    values: Values

    def begin(self, rig: Rig) -> Initial:
        """The initial state, moved along the direction."""
        initial = self.steps.begin(rig)
        if "start" not in self.leaves:
            return initial
        return initial._replace(y0=initial.y0 + self.leaves["start"] * self.direction)

    @cached_property
    def ways(self) -> Leaves:
        """The change of every leaf along which it is differentiated: its own size, with random
        signs where it has several entries."""
        generator, out = torch.Generator().manual_seed(1), {}
        for name, p in self.leaves.items():
            signs = torch.randn(p.shape, generator=generator, dtype=torch.float64).sign()
            size = 1.0 if name == "start" else float(p.detach().abs().mean()) or 1e-6
            out[name] = size * (signs if p.ndim else torch.ones(()))
        return out

    def run(self, **how: Any) -> Trajectory:
        return _along(self.rig, self.steps.t, self.steps.knots, **{"y0": self.begin} | how)

    def adjoints(self, run: Trajectory) -> Slopes:
        """Derivatives of every value along the way of every leaf."""
        found, leaves = {}, list(self.leaves.values())
        how: dict[str, Any] = {"retain_graph": True, "materialize_grads": True}
        for kind, value in self.values(run).items():
            slopes = torch.autograd.grad(value, leaves, allow_unused=True, **how)
            pairs = zip(self.ways.items(), slopes)
            found[kind] = {name: float((slope * way).sum()) for (name, way), slope in pairs}
        return found

    def finer_adjoints(self, rtol: float) -> Slopes:
        """Derivatives of a run at a tenth of the tolerance; empty, with a warning, if it fails."""
        how: dict[str, Any] = {"tolerance": NEWTON, "gradient": "discrete"}
        try:
            run = simulate(self.rig, self.steps.t, y0=self.begin, rtol=0.1 * rtol, **how)
        except SimulationFailed as failed:
            warn(
                f"the error of the steps is not known, since a run at a tenth of rtol = {rtol:g} "
                f"failed: {failed}",
            )
            return {}
        return self.adjoints(run)

    def forwards(self) -> Slopes:
        """Derivatives by forward sensitivities, by the start and the scalars; empty for custom
        values."""
        numbers = [
            name
            for name, p in self.leaves.items()
            if p.ndim == 0 and name != "start" and not name.startswith("reference.")
        ]
        names = [*numbers, "start"] if "start" in self.leaves else numbers
        if not names or not isinstance(self.values, RandomSums):
            return {}
        initial = started(self.rig, self.steps.begin, "forward")
        dy0 = directions(initial.y0, [*map(self.rig.parameter, numbers)])
        run = self.run(
            y0=initial, gradient="forward", wrt=numbers, touch=self.values.felt,
            dy0=torch.cat((torch.from_numpy(dy0), self.direction[:, None]), -1),
        )  # fmt: skip
        if run.stats.failed_steps or run.sensitivities is None:
            return {}
        return {
            kind: {name: float(slope * self.ways[name]) for name, slope in zip(names, slopes)}
            for kind, slopes in self.values.forward(run).items()
        }

    def differences(self, along: Leaves, h: float) -> dict[str, float]:
        """Central differences of all values; not a number where a step was halved."""
        ends = []
        for by in (h, -h):
            with _moved(self.leaves, {name: by * way for name, way in along.items()}):
                run = self.run()
            failed = run.stats.failed_steps > 0
            ends.append({k: np.nan if failed else float(v) for k, v in self.values(run).items()})
        return {kind: (ends[0][kind] - ends[1][kind]) / (2 * h) for kind in ends[0]}

    def compared(self, rtol: float, bound: float, each: bool, step_error: bool) -> GradientCheck:
        """Derivatives by all ways. Without `each` a difference is taken of all leaves together."""
        run = self.run(gradient="discrete")
        own = self.adjoints(run)
        finer = self.finer_adjoints(rtol) if step_error else {}
        ahead = self.forwards()
        sizes = {kind: abs(float(value.detach())) for kind, value in self.values(run).items()}
        largest = {kind: max(map(abs, found.values()), default=0.0) for kind, found in own.items()}
        weights = {
            kind: {name: abs(x) / (largest[kind] + 1e-300) for name, x in found.items()}
            for kind, found in own.items()
        }
        derivatives = []
        for name in self.leaves:
            expected = {kind: found[name] for kind, found in own.items()}
            judged: Mapping[str, Pair] = dict.fromkeys(own, (None, None))
            if each:
                reach = _reach(name, max(weights[kind][name] for kind in own))
                scale = {kind: max(abs(x), largest[kind] / WEAK) for kind, x in expected.items()}
                way = {name: self.ways[name]}
                differenced = lambda h, way=way, reach=reach: self.differences(way, reach * h)
                judged = _judged(differenced, expected, scale, bound)
            for kind, adjoint in expected.items():
                change = REST * abs(finer[kind][name] - adjoint) if finer else None
                forward = ahead.get(kind, {}).get(name)
                one = Derivative(kind, name, adjoint, forward, *judged[kind], change, 0.0)
                sizes[kind] = max(sizes[kind], one.size - (one.uncertainty or 0.0), abs(adjoint))
                derivatives.append(one)
        derivatives = [one._replace(scale=sizes[one.value]) for one in derivatives]
        if not each:
            derivatives += [self._together(kind, own[kind], weights[kind], bound) for kind in own]
        return GradientCheck(tuple(derivatives), run, rtol)

    def _together(
        self, kind: str, adjoints: Mapping[str, float], weights: Mapping[str, float], bound: float
    ) -> Derivative:
        """The derivative of one value along all ways at once, each as far as its leaf reaches."""
        reach = {name: _reach(name, weights[name]) for name in self.leaves}
        along = {name: reach[name] * way for name, way in self.ways.items()}
        parts = [reach[name] * adjoint for name, adjoint in adjoints.items()]
        whole, scale = sum(parts), sum(map(abs, parts))
        differenced = partial(self.differences, along)
        judged = _judged(differenced, {kind: whole}, {kind: scale}, bound)[kind]
        return Derivative(kind, TOGETHER, whole, None, *judged, None, scale)


def _reach(name: str, weight: float) -> float:
    """How much further a leaf is moved whose derivative is the part `weight` of the largest.
    Lengths decide when points touch, and are hardly changed."""
    most = 0.1 * WEAK if "shape" in name or "reference" in name else WEAK
    return min(1 / max(weight, 1e-300), most)


def _judged(
    differenced: Callable[[float], Mapping[str, float]],
    expected: Mapping[str, float],
    scale: Mapping[str, float],
    bound: float,
) -> dict[str, tuple[float, float]]:
    """Of every value the difference and its uncertainty. No further length is tried once the
    `expected` values are met, to `bound` of their `scale`."""
    found: dict[str, dict[float, float]] = {kind: {} for kind in expected}
    best: dict[str, tuple[float, float]] = {}
    for length in LENGTHS:
        differences = differenced(length)
        for kind, at in found.items():
            at[length] = differences[kind]
        best = {kind: _agreed(at) for kind, at in found.items()}
        if all(
            uncertainty <= 0.1 * bound * scale[kind]
            and abs(value - expected[kind]) <= bound * scale[kind]
            for kind, (value, uncertainty) in best.items()
        ):
            break
    return best


def _agreed(found: Mapping[float, float]) -> tuple[float, float]:
    """The difference and its uncertainty, from the two neighbouring lengths that agree best: their
    distance, or twice the noise of shorter lengths, which falls with the length, since noise may
    agree by chance and few lengths show less of it than there is."""
    best, noise = (np.nan, np.inf), 0.0
    for a, b in pairwise(sorted(found)):
        spread = abs(found[a] - found[b])
        if np.isfinite(spread):
            noise = max(noise, a * spread)
            uncertainty = max(spread, 2 * noise / b)
            if uncertainty < best[1]:
                best = found[b], uncertainty
    return best


def _faults(check: GradientCheck, bound: float) -> list[str]:
    faults = []
    for one in check.derivatives:
        what = f"the derivative of `{one.value}` by `{one.by}` is {one.adjoint:.8g} by the adjoint"
        if not np.isfinite(one.adjoint):
            faults.append(f"{what}, which is no number")
        elif one.difference is not None and one.uncertainty is not None and one.clear:
            allowed = bound * one.size + NOTHING * one.scale + 2 * one.uncertainty
            if not abs(one.adjoint - one.difference) <= allowed:
                faults.append(
                    f"{what} and {one.difference:.8g} +- {one.uncertainty:.1g} by differences: a "
                    "law or a signal of the rig has another gradient than its value, or jumps"
                )
        if one.forward is not None and not (
            abs(one.forward - one.adjoint) <= 1e-7 * abs(one.adjoint) + 1e-8 * one.scale
        ):
            faults.append(f"{what} and {one.forward:.8g} forward")
    return faults


def _unchecked(check: GradientCheck, names: Sequence[str]) -> str:
    """Message on parameters whose derivatives were compared with nothing."""
    if set(names) <= {*check.without_effect}:
        reason = "they are zero throughout"
        if check.absent:
            reason += f" (contact points never {' or '.join(check.absent)}: {check.regime})"
    else:
        reason = f"their differences are uncertain by more than {UNCLEAR:.0%}"
    return (
        f"the derivatives by {', '.join(f'`{name}`' for name in names)} were not checked: "
        f"{reason}; choose a run in which they have a clear effect, or leave them out of `wrt`"
    )


def _direction(rig: Rig, steps: Steps) -> Tensor:
    """A random direction of the start, every part of the state as large as it changed in the
    run."""
    generator = torch.Generator().manual_seed(2)
    way = torch.randn(rig.layout.size, generator=generator, dtype=torch.float64)
    for where in rig.layout.slices.values():
        if where.start < where.stop:
            way[where] *= (steps.y[:, where] - steps.y[0, where]).abs().max()
    return way


@contextmanager
def _moved(leaves: Leaves, by: Leaves) -> Iterator[None]:
    kept = {name: leaves[name].detach().clone() for name in by}
    with torch.no_grad():
        try:
            for name, way in by.items():
                leaves[name].add_(way)
            yield
        finally:
            for name, value in kept.items():
                leaves[name].copy_(value)
