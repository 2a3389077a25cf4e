"""Whether the derivatives of a run are those of what ran: adjoint, forward sensitivities and
central differences along the same steps."""

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.display import Shown
from torchsoft.physics.arguments import Numbers, tensor
from torchsoft.physics.rig import Rig
from torchsoft.solve.gradients import directions
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import RTOL, Initial, simulate, started
from torchsoft.solve.simulate import Start as Begin
from torchsoft.solve.trajectory import Touch, Trajectory
from torchsoft.testing.energy import conclude

Value = Callable[[Trajectory], Tensor]
Leaves = dict[str, Tensor]

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
        found = {one.by: True for one in self.derivatives if one.by != TOGETHER}
        for one in self.derivatives:
            if one.by in found:
                found[one.by] = found[one.by] and holds(one)
        return tuple(name for name, holding in found.items() if holding)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Parameters whose derivatives are all zero, so that nothing about them was checked."""
        return self._throughout(lambda one: one.zero)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """Parameters that have an effect, but no difference to compare with."""
        vague = self._throughout(lambda one: one.zero or not one.clear)
        return tuple(name for name in vague if name not in self.without_effect)

    def _regime(self) -> tuple[dict[str, float], dict[str, int]]:
        """Shares of the contact points' time in every state, and how often they touch down and
        leave."""
        states = torch.cat([x.flatten(1) for x in self.run.contact_state.values()], 1)
        kinds = {"stick": 1, "slip": 2, "out of contact": 0}
        shares = {name: float((states == kind).double().mean()) for name, kind in kinds.items()}
        on = states > 0
        touched, left = (int(x.sum()) for x in (on[1:] & ~on[:-1], on[:-1] & ~on[1:]))
        return shares, {"touch down": touched, "leave": left}

    @property
    def regime(self) -> str:
        """What the contact points did in the run."""
        shares, changes = self._regime()
        parts = ", ".join(f"{share:.0%} {name}" for name, share in shares.items())
        return f"{parts}; {', '.join(f'{count} {name}' for name, count in changes.items())}"

    @property
    def absent(self) -> tuple[str, ...]:
        """What the contact points never did in the run; empty for a rig without contacts."""
        if not self.run.contact_state:
            return ()
        shares, changes = self._regime()
        if shares["out of contact"] == 1.0:
            return ("touch",)
        return tuple(name for name, much in (shares | changes).items() if not much)

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [("contact points", self.regime)] if self.run.contact_state else []
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
    start = _start(rig, t, y0, rtol)
    with _leaves(rig, start, wrt) as leaves:
        check = _checked(rig, start, leaves, of, rtol, bound, dy0, each, step_error, centres)
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


class Start(NamedTuple):
    """Times (T,), the initial state, as a function of the rig, and a run from it: its states
    (T, size) and its steps."""

    t: Tensor
    begin: Begin
    y: Tensor
    knots: Tensor

    @property
    def y0(self) -> Tensor:
        """The initial state (size,) of the run."""
        return self.y[0]


def constant(state: Tensor) -> Begin:
    """The start at a state (size,), whatever the rig's parameters are."""
    return lambda rig: Initial(state, rig.reference)


def _start(rig: Rig, t: Numbers, y0: Numbers | Begin, rtol: float) -> Start:
    run = simulate(rig, t, y0=y0, rtol=rtol, tolerance=NEWTON)
    first = y0 if callable(y0) else constant(tensor("y0", y0).detach())
    # rounding may keep Newton from solving a step where a law bends, which is then halved
    for _ in range(REPEATS):
        run = _along(rig, run.t, run.knots, y0=first)
        if run.stats.failed_steps == 0:
            break
    return Start(run.t, first, run.y.detach(), run.knots)


def _along(rig: Rig, t: Tensor, knots: Tensor, **how: Any) -> Trajectory:
    """A run along given steps; those that were halved show in its `stats`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return simulate(rig, t, knots=knots, tolerance=NEWTON, **how)


@contextmanager
def _leaves(rig: Rig, start: Start, wrt: Sequence[str] | None) -> Iterator[Leaves]:
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
    asked = {name: p.requires_grad for name, p in leaves.items()}
    for p in leaves.values():
        p.requires_grad_()
    try:
        yield leaves
    finally:
        for name, p in leaves.items():
            p.requires_grad_(asked[name])


def _values(
    rig: Rig, start: Start, of: Value | Sequence[str] | None, centres: bool
) -> tuple[Callable[[Trajectory], dict[str, Tensor]], Callable[..., dict[str, Tensor]] | None]:
    """What is differentiated, by name, and how it is made of forward sensitivities (T, size, n) and
    those of touch (T, channels, n)."""
    if of is not None:
        if isinstance(of, str) or not (callable(of) or isinstance(of, Sequence)):
            raise ValueError(f"`of` must be a list of channels or a function, but is {of!r}")
        if callable(of):
            return lambda run: {"value": of(run)}, None
        return lambda run: {name: run[name][-1] for name in of}, None
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(
        len(start.t) - 1, rig.layout.size, generator=generator, dtype=torch.float64
    )
    for (part, _), where in rig.layout.slices.items():
        weights[:, where] *= {"pose": 1e3, "velocity": 10.0}.get(part, 0.0)  # [1/m, s/m]
    felt = felt_channels(rig, centres)
    pulls = torch.randn(len(start.t), len(felt), generator=generator, dtype=torch.float64)
    touch = Touch(rig)
    units = [{"N": 1.0, "N.m": 50.0, "m": 1e3}[touch.unit(name)] for name in felt]
    pulls *= torch.tensor(units, dtype=torch.float64)

    def values(run: Trajectory) -> dict[str, Tensor]:
        motion = (weights * (run.y[1:] - start.y0)).sum()
        return {"motion": motion} | (
            {"forces": (pulls * run.together(*felt)).sum()} if felt else {}
        )

    def forward(of_states: Tensor, of_forces: Tensor | None) -> dict[str, Tensor]:
        motion = torch.einsum("ti,tin->n", weights, of_states[1:])
        if of_forces is None:
            return {"motion": motion}
        return {"motion": motion, "forces": torch.einsum("ti,tin->n", pulls, of_forces)}

    return values, forward


def felt_channels(rig: Rig, centres: bool) -> list[str]:
    """Channels of touch; centres of pressure, which bend sharply at light forces, if wanted."""
    return [name for name in Touch(rig) if centres or "centre" not in name]


def _checked(
    rig: Rig, start: Start, leaves: Leaves, of: Any, rtol: float, bound: float,
    dy0: Numbers | None, each: bool, step_error: bool, centres: bool,
) -> GradientCheck:  # fmt: skip
    values, by_forward = _values(rig, start, of, centres)
    kick, generator = leaves.get("start"), torch.Generator().manual_seed(1)
    shake = _direction(rig, start) if dy0 is None else tensor("dy0", dy0).detach()

    def begin(rig: Rig) -> Initial:
        initial = start.begin(rig)
        return initial if kick is None else initial._replace(y0=initial.y0 + kick * shake)

    ways: Leaves = {}
    for name, p in leaves.items():
        sign = torch.randn(p.shape, generator=generator, dtype=torch.float64).sign()
        ways[name] = sign if p.ndim else torch.ones(())
        ways[name] = ways[name] * (
            1.0 if name == "start" else float(p.detach().abs().mean()) or 1e-6
        )

    def shares(made: Trajectory) -> dict[str, dict[str, float]]:
        """Derivatives of every value along the way of every leaf."""
        found = {}
        for kind, value in values(made).items():
            slopes = torch.autograd.grad(
                value, list(leaves.values()), retain_graph=True, materialize_grads=True,
                allow_unused=True,
            )  # fmt: skip
            pairs = zip(leaves, slopes)
            found[kind] = {name: float((slope * ways[name]).sum()) for name, slope in pairs}
        return found

    made = _along(rig, start.t, start.knots, y0=begin, gradient="discrete")
    own = shares(made)
    finer = {}
    if step_error:
        try:
            finer = shares(
                simulate(
                    rig, start.t, y0=begin, rtol=0.1 * rtol, tolerance=NEWTON, gradient="discrete"
                )
            )
        except SimulationFailed as failed:
            warn(
                f"the error of the steps is not known, since a run at a tenth of rtol = {rtol:g} "
                f"failed: {failed}",
            )
    ahead = _forward(rig, start, leaves, shake, ways, by_forward, centres)

    largest = {kind: max(map(abs, found.values()), default=0.0) for kind, found in own.items()}
    sizes = {kind: abs(float(value.detach())) for kind, value in values(made).items()}

    def differenced(by: float, along: Leaves) -> dict[str, float]:
        """Central differences of all values; not a number where a step was halved."""
        ends = []
        for h in (by, -by):
            moved = {name: h * way for name, way in along.items()}
            with _moved(leaves, moved):
                ended = _along(rig, start.t, start.knots, y0=begin)
            failed = ended.stats.failed_steps > 0
            ends.append({k: np.nan if failed else float(v) for k, v in values(ended).items()})
        return {kind: (ends[0][kind] - ends[1][kind]) / (2 * by) for kind in ends[0]}

    def factor(name: str, kinds: Collection[str]) -> float:
        """How much further a leaf is moved that matters less than the others. Lengths decide when
        points touch, and are hardly changed."""
        weight = max(abs(own[kind][name]) / (largest[kind] + 1e-300) for kind in kinds)
        most = 0.1 * WEAK if "shape" in name or "reference" in name else WEAK
        return min(1 / max(weight, 1e-300), most)

    derivatives = []
    for name in leaves:
        judged: Mapping[str, tuple[float | None, float | None]] = dict.fromkeys(own, (None, None))
        if each:
            much = factor(name, own)
            expected = {kind: found[name] for kind, found in own.items()}
            judged = _judged(
                lambda h, name=name, much=much: differenced(h * much, {name: ways[name]}), expected,
                {kind: max(abs(x), largest[kind] / WEAK) for kind, x in expected.items()}, bound,
            )  # fmt: skip
        for kind, found in own.items():
            change = REST * abs(finer[kind][name] - found[name]) if finer else None
            forward = ahead.get(kind, {}).get(name)
            one = Derivative(kind, name, found[name], forward, *judged[kind], change, 0.0)
            derivatives.append(one)
            sizes[kind] = max(sizes[kind], one.size - (one.uncertainty or 0.0), abs(one.adjoint))
    derivatives = [one._replace(scale=sizes[one.value]) for one in derivatives]
    for kind, found in {} if each else own.items():
        factors = {name: factor(name, [kind]) for name in leaves}
        along = {name: much * ways[name] for name, much in factors.items()}
        parts = {name: much * found[name] for name, much in factors.items()}
        scale = {kind: sum(map(abs, parts.values()))}
        whole = sum(parts.values())
        judged = _judged(lambda h, along=along: differenced(h, along), {kind: whole}, scale, bound)
        one = Derivative(kind, TOGETHER, whole, None, *judged[kind], None, scale[kind])
        derivatives.append(one)
    return GradientCheck(tuple(derivatives), made, rtol)


def _judged(
    differenced: Callable[[float], Mapping[str, float]],
    expected: Mapping[str, float],
    scale: Mapping[str, float],
    bound: float,
) -> dict[str, tuple[float, float]]:
    """Of every value the difference and its uncertainty, from the two neighbouring lengths that
    agree best: their distance, or the noise of shorter lengths, which falls with the length, since
    noise may agree by chance. No further length is tried once the `expected` values are met, to
    `bound` of their `scale`."""
    found: dict[float, Mapping[str, float]] = {}
    best: dict[str, tuple[float, float]] = {}
    for length in LENGTHS:
        found[length] = differenced(length)
        ordered, best = sorted(found), {}
        for kind in scale:
            noise = 0.0  # of the value itself, from lengths up to b
            for a, b in pairwise(ordered):
                spread, uncertainty = abs(found[a][kind] - found[b][kind]), np.inf
                if np.isfinite(spread):
                    noise = max(noise, a * spread)
                    uncertainty = max(spread, noise / b)
                if kind not in best or uncertainty < best[kind][1]:
                    best[kind] = found[b][kind], uncertainty
        if best and all(
            uncertainty <= 0.1 * bound * scale[kind]
            and abs(value - expected[kind]) <= bound * scale[kind]
            for kind, (value, uncertainty) in best.items()
        ):
            break
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


def _direction(rig: Rig, start: Start) -> Tensor:
    """A random direction of the start, every part of the state as large as it changed in the
    run."""
    generator = torch.Generator().manual_seed(2)
    way = torch.randn(rig.layout.size, generator=generator, dtype=torch.float64)
    for where in rig.layout.slices.values():
        if where.start < where.stop:
            way[where] *= (start.y[:, where] - start.y0[where]).abs().max()
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


def _forward(
    rig: Rig, start: Start, leaves: Leaves, shake: Tensor, ways: Leaves,
    by_forward: Callable[..., dict[str, Tensor]] | None, centres: bool,
) -> dict[str, dict[str, float]]:  # fmt: skip
    """Forward sensitivities of every value along the ways of the start and of the scalars."""
    wanted = [
        name
        for name, p in leaves.items()
        if p.ndim == 0 and name != "start" and not name.startswith("reference.")
    ]
    kicked = "start" in leaves
    if by_forward is None or not (wanted or kicked):
        return {}
    initial = started(rig, start.begin, "forward")
    dy0 = torch.from_numpy(directions(initial.y0, [*map(rig.parameter, wanted)]))
    felt = felt_channels(rig, centres)
    run = _along(
        rig, start.t, start.knots, y0=initial, gradient="forward", wrt=wanted, touch=felt,
        dy0=torch.cat((dy0, shake[:, None]), -1),
    )  # fmt: skip
    if run.stats.failed_steps or run.sensitivities is None:
        return {}
    of_forces = torch.stack([run.touch_sensitivities[name] for name in felt], 1) if felt else None
    names = [*wanted, "start"] if kicked else wanted
    return {
        kind: {name: float(slope * ways[name]) for name, slope in zip(names, slopes)}
        for kind, slopes in by_forward(run.sensitivities, of_forces).items()
    }
