"""Steps of a run: equal ones between output times, or those that tolerances choose."""

import ctypes
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.motion import Reference, evaluate
from torchsoft.physics.rig import Rig
from torchsoft.physics.validity import check_array
from torchsoft.solve.kernel.arrays import GAMMA, NO_SIGNALS, Errors, Signals
from torchsoft.solve.kernel.table import Array, Index

# The steps of a run: equal ones between output times, or those that tolerances chose, and where
# the outputs lie in them.


CHUNK = 500
"""Steps per compiled call: how often progress is shown and Ctrl-C is heard."""


class Plan(NamedTuple):
    """Steps taken in one compiled call: their starts, counted from the run's, and lengths h [s],
    per output its step and the part of it (0 to 1), the start being one of step -1, and the signals
    (steps, 2, signals, 2) at their stages."""

    starts: Array
    h: Array
    out_step: Index
    out_part: Array
    signals: Array = np.zeros((0, 2, 0, 2))

    def taken(self, steps: int, outputs: int) -> "Plan":
        """The first steps, with the first outputs."""
        starts, h, step, part, signals = self
        return Plan(starts[:steps], h[:steps], step[:outputs], part[:outputs], signals[:steps])

    def left(self, steps: int, outputs: int) -> "Plan":
        """What is left without the first steps and the first outputs."""
        starts, h, step, part, signals = self
        step = step[outputs:] - steps
        return Plan(starts[steps:], h[steps:], step, part[outputs:], signals[steps:])

    def halved(self) -> "Plan":
        """Of a single step: two of half the length."""
        half, later = 0.5 * self.h[0], self.out_part > 0.5
        return Plan(
            np.array([self.starts[0], self.starts[0] + half]), np.array([half, half]),
            later.astype(np.int64), np.where(later, 2 * self.out_part - 1, 2 * self.out_part),
        )  # fmt: skip

    @property
    def stage_times(self) -> Array:
        """Times of the stages (steps, 2) since the run's start [s]."""
        return self.starts[:, None] + self.h[:, None] * np.array([GAMMA, 1.0])

    @property
    def output_times(self) -> Array:
        """Times of the outputs since the run's start [s]."""
        step = np.maximum(self.out_step, 0)
        return self.starts[step] + self.out_part * self.h[step]


LONGEST = 0.1
"""Longest step [s] by tolerance."""

MOST_STEPS = 100_000_000
"""Steps that one run may take at the most."""


SHORTEST = 1e-12
"""Time [s] between two outputs at the least."""


def check_times(t: Tensor, step: float | None = None) -> None:
    """Raises `ValueError` unless t is a float64 vector of at least two finite, strictly increasing
    times, no more than `MOST_STEPS` steps of `step` [s], or of the longest by tolerance, apart in
    all."""
    check_array("t", t)
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(
            f"`t` must be a float64 vector of two times or more, but is {t.dtype} of shape "
            f"{tuple(t.shape)}"
        )
    if t.requires_grad:
        raise ValueError(
            "`t` must not require a gradient, since none is computed by the times; use t.detach()"
        )
    times = t.numpy()
    apart, finite = np.diff(times), bool(np.isfinite(times).all())
    if not finite or not (apart > 0).all():
        bad = int(np.flatnonzero(~(apart > 0))[0]) if finite else 0
        raise ValueError(
            f"`t` must increase strictly and be finite, but t[{bad}:{bad + 2}] = "
            f"{times[bad : bad + 2].tolist()}"
        )
    first, last = float(times[0]), float(times[-1])
    if (count := (last - first) / (LONGEST if step is None else step)) > MOST_STEPS:
        raise ValueError(
            f"`t` and `step` ask for {count:.3g} steps, but at most {MOST_STEPS:.3g} can be taken "
            "in one run; take less time"
            + (
                f" (by tolerance no step is longer than {LONGEST:g} s)"
                if step is None
                else " or longer steps"
            )
        )
    rounding = 16 * np.finfo(np.float64).eps
    finest = max(SHORTEST, rounding * max(abs(first), abs(last)))
    if apart.min() < finest:
        raise ValueError(
            f"`t` must be further apart than {finest:.1g} s, the float64 resolution at "
            "these times; count them from the beginning of the run"
        )
    finest = max(SHORTEST, rounding * (last - first))
    if step is not None and step < finest:
        raise ValueError(
            f"`step` must be longer than {finest:.1g} s, the float64 resolution at the end of "
            "the run; take a longer one, or a shorter run"
        )


def chunks(starts: Array, h: Array, out_step: Index, out_part: Array) -> Iterator[Plan]:
    """A plan, CHUNK steps at a time."""
    whole = Plan(starts, h, out_step, out_part)
    for k in range(0, len(h), CHUNK):
        first, last = np.searchsorted(out_step, (k, k + CHUNK))
        yield whole.taken(k + CHUNK, last).left(k, first)


def equal_steps(t: Tensor, step: float) -> Iterator[Plan]:
    """Cut the intervals between the times t (T,) [s] into equal steps no longer than `step` [s];
    the steps of one plan have one length."""
    times = t.numpy() - t.numpy()[0]
    spans = np.diff(times)
    counts = np.maximum(1, np.ceil(spans / step * (1 - 1e-9))).astype(int)
    sizes = spans / counts
    changes = (np.diff(counts) != 0) | (np.abs(np.diff(sizes)) > 1e-9 * sizes[:-1])
    for equal in np.split(np.arange(len(spans)), np.flatnonzero(changes) + 1):
        n, h = int(counts[equal[0]]), float(sizes[equal[0]])
        starts, ends = (times[equal, None] + h * np.arange(n)).ravel(), np.arange(1, len(equal) + 1)
        yield from chunks(starts, np.full(len(starts), h), n * ends - 1, np.ones(len(equal)))


def check_knots(knots: Tensor) -> Array:
    """The ends of given steps (steps + 1,) [s]. Raises `ValueError` unless they are two or more,
    finite and increasing."""
    check_array("knots", knots)
    if (
        knots.ndim != 1
        or len(knots) < 2
        or not bool(torch.isfinite(knots).all())
        or not bool((knots.diff() > 0).all())
    ):
        raise ValueError(
            "`knots` must be two times or more [s], finite and increasing, but has shape "
            f"{tuple(knots.shape)}"
        )
    return np.ascontiguousarray(knots.detach().numpy())


def given_steps(t: Tensor, knots: Array) -> Iterator[Plan]:
    """The steps between `knots` (n + 1,) [s], of another run, with outputs at t (T,).

    Raises `ValueError` unless they cover t from its first time on.
    """
    times, h = t.numpy(), np.diff(knots)
    rounding = 4 * np.finfo(np.float64).eps * abs(times[-1])
    if knots[0] != times[0] or knots[-1] < times[-1] - max(1e-9 * h[-1], rounding):
        raise ValueError(
            f"`knots` must go from t[0] = {times[0]:g} s to t[-1] = {times[-1]:g} s, but go from "
            f"{knots[0]:g} s to {knots[-1]:g} s"
        )
    times, knots = times - times[0], knots - times[0]
    at = np.minimum(np.searchsorted(knots, times[1:], side="left"), len(h)) - 1
    parts = (times[1:] - knots[at]) / h[at]
    parts = np.where(parts > 1.0 - 1e-9, 1.0, parts)
    return chunks(knots[:-1], h, at, parts)


# Data of a rig for step-size control: groups of errors with their units, and the reference's
# pieces.


UNITS = {"force": 1.0, "length": 1e-3, "angle": 1.0}
"""Largest units of `atol`: nodal forces [N], displacements, stretches and positions [m], angles
[rad]."""

THIN = 0.1
"""Unit of lengths over the size of the smallest body, at the most."""


def rig_units(rig: Rig, smallest: float | None = None) -> dict[str, float]:
    """Units of `atol` for a rig: `UNITS`, or what its bodies weigh or would weigh, and a part of
    the `smallest` one [m], where they are less."""
    free = [one for one in rig.bodies.values() if "free" in one.freedom.values()]
    weight = sum(float(one.mass.detach() * rig.gravity.detach()) for one in free)
    if smallest is None:
        shapes = [one.shape for one in rig.bodies.values() if one.shape is not None]
        smallest = min((one.size() for one in shapes), default=math.inf)
    most = {"force": weight or math.inf, "length": THIN * smallest, "angle": math.inf}
    return {name: min(unit, most[name]) for name, unit in UNITS.items()}


class ErrorParts:
    """Parts of a rig's state whose error is judged together: each pad's forces, each contact's
    stretches, a state of its law of friction, in units of its start, a body's position, its angle.
    A rate's error counts by the displacement within a step. A position's size is how far it has
    come from the start."""

    def __init__(self, rig: Rig) -> None:
        layout, found = rig.layout, list[tuple[int, int, bool, str, str]]()
        self._poses = [here for (kind, _), here in layout.slices.items() if kind == "pose"]
        for block, here, unit in layout.groups():
            rate, quantity = block.field in ("rates", "velocity"), QUANTITIES[block.field]
            dimension = DIMENSIONS.get(unit, "start")
            found.append((here.start, here.stop, rate, dimension, f"{quantity} `{block.name}`"))
        self._ends = [(begin, end) for begin, end, *_ in found]
        columns = list(zip(*found)) or [()] * 5
        self._whole = [np.array(numbers, np.int64) for numbers in columns[:3]]
        self._dimensions, self.names = columns[3:]

    def of(self, y0: Array, atol: float, units: Mapping[str, float]) -> Errors:
        """The errors of a run from y0, with tolerances of `atol` units."""
        origin = np.zeros(len(y0))
        for here in self._poses:
            origin[here] = y0[here]
        off = y0 - origin
        size = [math.sqrt(off[a:b].dot(off[a:b])) for a, b in self._ends]
        unit = [units.get(one, 1.0) for one in self._dimensions]
        for i, one in enumerate(self._dimensions):
            if one == "start":
                begin, end = self._ends[i]
                unit[i] = math.sqrt(y0[begin:end].dot(y0[begin:end])) or 1.0
        first, last, rate = self._whole
        return Errors(first, last, rate, atol * np.array(unit), np.array(size), origin)


DIMENSIONS = {
    "N": "force", "N.m": "force", "m": "length", "rad": "angle", "m/s": "length", "rad/s": "angle",
    "m.s": "length", "rad.s": "angle",
}  # fmt: skip
"""Units of `atol` by those of states: a rate's is that of the way within a step, an integral's that
of a second of it. Others are judged in units of their start."""

QUANTITIES = {
    "pads": "the nodal forces of pad", "stretch": "the stretches of contact",
    "pose": "the pose of body", "rates": "the nodal velocities of pad",
    "velocity": "the velocity of body", "friction": "the states of friction of contact",
    "control": "the states of actuator",
}  # fmt: skip
"""Quantities of the parts of a state, in words."""


class Followed:
    """The signals of runs as the kernels evaluate them; `since` has them for one run: `arrays`,
    and `stops` [s], times that no step may pass.

    A reference of pieces (`Profile`, `Sampled`, `Waves`) is evaluated by the kernel, any other one
    by itself, called at every stage as `signals`; its exceptions are kept in `error`. Signals
    called `names` come first, and then those that stay at the numbers `fixed`.
    """

    def __init__(
        self, reference: Reference, names: Sequence[str], fixed: Sequence[float],
        signals: Callable[[Tensor], Tensor],
    ) -> None:  # fmt: skip
        self.error: BaseException | None = None
        chosen = reference.plain(names)
        self._callback: Any = None
        self._pieces: Any = None
        self._count = len(names)
        if chosen is None:
            self.arrays = NO_SIGNALS._replace(address=self._call(signals), room=np.zeros(1))
            self.stops = np.zeros(0)
            return
        with torch.no_grad():
            found = [one.pieces() for one in chosen]
            pieces = [(at.numpy(), span.numpy(), c.numpy()) for at, span, c in found]
            stops = [one.stops.numpy() for one in chosen]
        self._stops, self._pieces = [x.copy() for x in stops], packed(pieces, fixed)

    def since(self, origin: float) -> "Followed":
        """The same, for one run whose time counts from `origin` [s]."""
        if self._pieces is None:
            return self
        out, room = copy(self), np.zeros_like(self._pieces.room)
        out.arrays = self._pieces._replace(at=self._pieces.at - origin, room=room)
        out.stops = np.concatenate([np.zeros(0), *self._stops]) - origin
        return out

    def on_lines(
        self, which: Sequence[int], first: float, last: float, values: Array
    ) -> "Followed":
        """The same from `first` to `last` [s], where time counts from, with some signals on lines
        between two values each (lines, 2), as they were on single lines before."""
        out, p, rows = copy(self), self._pieces, self._pieces.start[[*which]]
        at, span, control = p.at.copy(), p.span.copy(), p.control.copy()
        at[rows], span[rows], control[rows, :2] = first, last - first, values
        out._pieces = p._replace(at=at, span=span, control=control)
        others = [x for i, x in enumerate(self._stops) if i not in which]
        out._stops = [np.array([first, last]), *others]
        return out.since(first)

    def at(self, t: Tensor) -> Tensor | None:
        """Values and rates (..., signals, 2) at t (...) [s] of the reference's pieces, None where
        it has none."""
        if self._pieces is None:
            return None
        rows, p = list[Tensor](), self._pieces
        for i in range(self._count):
            here, width = slice(p.start[i], p.start[i + 1]), p.points[i]
            parts = p.at[here], p.span[here], p.control[here, :width].copy()
            at, span, control = map(torch.from_numpy, parts)
            rows.append(torch.stack(evaluate((at, span, control), t), -1))
        return torch.stack(rows, -2) if rows else t.new_zeros((*t.shape, 0, 2))

    @property
    def known(self) -> bool:
        """Whether the reference is made of pieces."""
        return self._pieces is not None

    def check(self) -> None:
        """Raises what a signal raised."""
        if self.error is not None:
            raise self.error

    def _call(self, signals: Callable[[Tensor], Tensor]) -> int:
        """Address of a function that writes the signals at the time x[0] to out."""

        def call(x: Any, _: Any, out: Any) -> None:
            try:
                with torch.no_grad():
                    values = signals(torch.tensor(x[0], dtype=torch.float64)).numpy().ravel()
            except BaseException as error:  # nothing can be raised through the kernel
                self.error = self.error or error
                values = None
            for i in range(self._count):
                out[i] = np.nan if values is None else values[i]

        self._count = signals(torch.zeros((), dtype=torch.float64)).numel()
        pointer = ctypes.POINTER(ctypes.c_double)
        self._callback = ctypes.CFUNCTYPE(None, pointer, pointer, pointer)(call)
        return ctypes.cast(self._callback, ctypes.c_void_p).value or 0


def packed(pieces: Sequence[tuple[Array, Array, Array]], fixed: Sequence[float]) -> Signals:
    """Signals of pieces, each with its starts and spans [s] and control points, and then those
    that are `fixed`."""
    counts, widths = [len(at) for at, *_ in pieces], [c.shape[1] for *_, c in pieces]
    total, widest = sum(counts), max(widths, default=1)
    start = np.cumsum([0, *counts, *[1] * len(fixed)])
    at, span = np.zeros(start[-1]), np.ones(start[-1])
    control = np.zeros((start[-1], widest))
    for first, width, (begins, spans, points) in zip(start, widths, pieces):
        here = slice(first, first + len(begins))
        at[here], span[here], control[here, :width] = begins, spans, points
    control[total:, 0] = fixed
    points = np.array([*widths, *[1] * len(fixed)], np.int64)
    return Signals(start, points, at, span, control, 0, np.zeros(max(widest, 1)))
