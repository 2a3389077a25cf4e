"""Reference of a rig: signals of time, such as the paper's 7th-order profiles (Eq. 20-29)."""

from collections.abc import Mapping, Sequence
from copy import copy
from math import ceil, comb, perm
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from scipy.linalg import solve_banded
from torch import Tensor, nn

from torchsoft.display import suggestion
from torchsoft.physics.arguments import check_transforms, line
from torchsoft.physics.names import check_names

FADE = 0.15
"""Time [s] over which waves come and go."""

CLOSEST = 1e-9
"""Time [s] between two different values of a signal at the least: no step by tolerance is shorter,
and a rate that lasts for less would act on nothing."""

Knotted = tuple[list[float], list[float]]
"""Times [s] and values."""


class Piecewise(nn.Module):
    """A signal of polynomials between knots; constant before the first knot and after the last.

    times (k,) [s] strictly increasing, values (k,). Raises `ValueError` for anything else.
    """

    times: Tensor
    values: Tensor

    def __init__(self, times: Sequence[float] | Tensor, values: Sequence[float] | Tensor) -> None:
        super().__init__()
        check_transforms()
        many = values
        try:
            knots = torch.as_tensor(times, dtype=torch.float64).contiguous()
            if not isinstance(many, Tensor):
                listed = [torch.as_tensor(v, dtype=torch.float64) for v in many]
                many = torch.stack(listed) if listed else torch.zeros(0)
        except OverflowError as error:
            raise ValueError(f"`times` and `values` must be finite: {error}") from None
        self.register_buffer("times", knots)
        # a tensor with a graph keeps it; anything else becomes a parameter that is not trained
        # unless asked for
        self.values = (
            many.double()
            if many.requires_grad
            else nn.Parameter(many.double(), requires_grad=False)
        )
        if wrong := self.ill_posed():
            raise ValueError(wrong)
        if not bool(torch.isfinite(many).all()):
            raise ValueError(f"`values` must be finite, but are {line(many.tolist())}")

    def ill_posed(self) -> str:
        """Fault of the knots as they are now, values that are not finite aside; empty where there
        is none."""
        t = self.times.detach().numpy()  # whose small operations take a tenth of torch's time
        if t.ndim != 1 or len(t) == 0 or not (np.diff(t) > 0).all() or not np.isfinite(t).all():
            return f"`times` must increase strictly, from one time on, but are {line(t.tolist())}"
        if self.values.shape != t.shape:
            return (
                f"`values` must hold one number per time ({len(t)}), but have shape "
                f"{tuple(self.values.shape)}"
            )
        for i in np.flatnonzero(np.diff(t) < CLOSEST):
            if bool(self.values[i] == self.values[i + 1]):
                continue
            return (
                f"`times` of different values must be {CLOSEST:g} s apart or more, no step is "
                f"shorter, but {t[i]:g} s and {t[i + 1]:g} s are {t[i + 1] - t[i]:.2g} s apart; "
                "let the signal take longer from one to the other"
            )
        return ""

    def control(self) -> Tensor:
        """Control points of every piece's polynomial, in Bernstein's form (k - 1, degree + 1)."""
        raise NotImplementedError

    def with_values(self, values: Tensor) -> Self:
        """The same signal through other values (k,), whose graph it keeps."""
        out = copy(self)
        out._parameters = {k: x for k, x in self._parameters.items() if k != "values"}
        out.__dict__["values"] = values
        return out

    def pieces(self) -> "Pieces":
        """The polynomials, one at least; constant before the first and after the last."""
        if len(self.times) == 1:
            return self.times, torch.ones_like(self.times), self.values[:, None]
        return self.times[:-1], self.times.diff(), self.control()

    @property
    def stops(self) -> Tensor:
        """Times [s] that no step chosen by tolerances passes."""
        return self.times

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Value and rate at t (...)."""
        value, rate = evaluate(self.pieces(), t)
        return value, rate


Pieces = tuple[Tensor, Tensor, Tensor]
"""Start and span [s] of every piece (k,), and its control points in Bernstein's form (k, degree +
1)."""


def evaluate(pieces: Pieces, t: Tensor, order: int = 1) -> list[Tensor]:
    """Value and derivatives up to `order` of polynomials at t (...), by de Casteljau's scheme,
    which is exact at the knots."""
    at, span, control = pieces
    i = torch.searchsorted(at, t.detach().contiguous(), right=True).clamp(min=1) - 1
    u = (t - at[i]) / span[i]
    inside = ((u >= 0) & (u <= 1)).to(t.dtype)
    u = u.clamp(0.0, 1.0)
    points, before, after = control[i], (1 - u)[..., None], u[..., None]
    degree, out = points.shape[-1] - 1, [torch.zeros_like(u)] * (order + 1)
    for left in range(degree, -1, -1):
        if left <= order:
            scale = perm(degree, left) / span[i] ** left * inside if left else 1.0
            out[left] = points.diff(left)[..., 0] * scale
        if left:
            points = before * points[..., :-1] + after * points[..., 1:]
    return out


def hermite(times: Tensor, jets: Sequence[Tensor]) -> Pieces:
    """The pieces of degree 7 between `times` (k,) [s] with given values, rates, second and third
    derivatives (k,)."""
    span = times.diff()
    y, v, a, j = (jet * scale for jet, scale in zip(jets, (1.0, 1 / 7, 1 / 42, 1 / 210)))
    ends = []
    for here, h in ((slice(None, -1), span), (slice(1, None), -span)):
        b = y[here], h * v[here], h**2 * a[here], h**3 * j[here]
        ends.append([b[0], b[0] + b[1], b[0] + 2 * b[1] + b[2], b[0] + 3 * b[1] + 3 * b[2] + b[3]])
    return times[:-1], span, torch.stack((*ends[0], *ends[1][::-1]), -1)


class Profile(Piecewise):
    """A signal that goes from value to value along 7th-order polynomials, at rest (rate, second and
    third derivative zero) at every knot (Eq. 20-29); constant before the first knot and after the
    last.

    times (k,) [s] strictly increasing, values (k,). Raises `ValueError` for anything else.
    """

    def control(self) -> Tensor:
        """Control points of every piece (k - 1, 8): four at either knot, which makes (20) with
        (22)-(24)."""
        return torch.cat(
            (self.values[:-1, None].expand(-1, 4), self.values[1:, None].expand(-1, 4)), -1
        )


class Lines(Piecewise):
    """A signal on straight lines from value to value, whose rate jumps at the knots."""

    def control(self) -> Tensor:
        """Control points of every piece (k - 1, 2): its ends."""
        return torch.stack((self.values[:-1], self.values[1:]), -1)


class Wave(NamedTuple):
    """Amplitudes [m], frequencies [Hz], sweeps [Hz/s] and phases [rad], each (components,)."""

    amplitude: Tensor
    frequency: Tensor
    sweep: Tensor
    phase: Tensor


def wave(*columns: object) -> Wave:
    """A `Wave` of arrays or numbers."""
    return Wave(
        *(
            torch.from_numpy(np.atleast_1d(np.asarray(column, dtype=np.float64)))
            for column in columns
        )
    )


PERIODS = 1e5
"""Most periods of a wave in one run."""


class Waves(Profile):
    """A profile with sines on top: sum of a sin(phi + 2 pi (f tau + r tau^2 / 2)), tau [s] being
    the time since `since`; faded in from there and out until `until` [s].

    In pieces of degree 7, `PIECES` to the shortest period, that have the value and three
    derivatives of this at either end: no further from it than 1e-11 times the amplitude.
    """

    PIECES: ClassVar = 24
    fine: Tensor

    def __init__(self, profile: Knotted, since: float, until: float, wave: Wave) -> None:
        super().__init__(*profile)
        self.since, self.wave = since, wave
        self.window = Profile([since, since + FADE, until - FADE, until], [0.0, 1.0, 1.0, 0.0])
        fastest = float(
            torch.maximum(wave.frequency, wave.frequency + wave.sweep * (until - since)).max()
        )
        count = self.PIECES * max(2.0, fastest * (until - since))
        every = torch.linspace(since, until, ceil(count) + 1, dtype=torch.float64)
        self.register_buffer("fine", torch.cat((every, self.times, self.window.times)).unique())

    @property
    def stops(self) -> Tensor:
        """Times [s] that no step chosen by tolerances passes."""
        return torch.cat((self.times, self.window.times))

    def pieces(self) -> Pieces:
        """The polynomials; constant before the first and after the last."""
        window, wave = (
            evaluate(self.window.pieces(), self.fine, 3),
            self.sines(self.fine - self.since),
        )
        jets = evaluate(super().pieces(), self.fine, 3)
        for n in range(4):
            jets[n] = jets[n] + sum(comb(n, k) * window[k] * wave[n - k] for k in range(n + 1))
        return hermite(self.fine, jets)

    def sines(self, tau: Tensor) -> list[Tensor]:
        """The sum of sines and its first three derivatives at tau (...) [s]."""
        amplitude, frequency, sweep, phase = self.wave
        tau = tau[..., None]
        angle = phase + 2 * torch.pi * (frequency * tau + 0.5 * sweep * tau**2)
        w, w_dot = 2 * torch.pi * (frequency + sweep * tau), 2 * torch.pi * sweep
        s, c = angle.sin(), angle.cos()
        jets = s, c * w, c * w_dot - s * w**2, -c * w**3 - 3 * s * w * w_dot
        return [(amplitude * jet).sum(-1) for jet in jets]


class Retimed(Piecewise):
    """Another signal with its time scaled and shifted: its value at t [s] comes at rate * t +
    shift."""

    def __init__(self, signal: Piecewise, rate: float = 1.0, shift: float = 0.0) -> None:
        nn.Module.__init__(self)
        self.signal, self.rate, self.shift = signal, rate, shift

    @property
    def times(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Times [s] of the knots."""
        return self.rate * self.signal.times + self.shift

    @property
    def values(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Values at the knots."""
        return self.signal.values

    @property
    def stops(self) -> Tensor:
        """Times [s] that no step chosen by tolerances passes."""
        return self.rate * self.signal.stops + self.shift

    def pieces(self) -> Pieces:
        """The polynomials, at their new times."""
        at, span, control = self.signal.pieces()
        return self.rate * at + self.shift, self.rate * span, control


class Later(nn.Module):
    """Another signal, of any kind, with its time shifted: the value at t [s] is that at t +
    shift."""

    def __init__(self, signal: nn.Module, shift: float) -> None:
        super().__init__()
        self.signal, self.shift = signal, shift

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Value and rate at t (...)."""
        return self.signal(t + self.shift)


class Sampled(Piecewise):
    """A recorded set-point: the cubic through values (k,) at times (k,) [s] with the given rates
    (k,), or with those of a cubic spline, which is at rest at both ends if `clamped`; constant
    before the first and after the last. A step chosen by tolerances passes `KNOTS_PER_STEP` knots
    at most."""

    KNOTS_PER_STEP: ClassVar = 4
    given: Tensor | None

    def __init__(
        self,
        times: Sequence[float] | Tensor,
        values: Sequence[float] | Tensor,
        rates: Sequence[float] | Tensor | None = None,
        clamped: bool = False,
    ) -> None:
        super().__init__(times, values)
        self.clamped = clamped
        slope = None if rates is None else torch.as_tensor(rates, dtype=torch.float64)
        if slope is not None and (
            slope.shape != self.times.shape or not bool(torch.isfinite(slope).all())
        ):
            raise ValueError(
                f"`rates` must hold one finite number per time ({len(self.times)}), but are {rates}"
            )
        self.register_buffer("given", slope)

    @property
    def rates(self) -> Tensor:
        """Rates (k,) at the knots: the given ones, or the spline's through the values as they are
        now."""
        if self.given is not None:
            return self.given
        return (clamped_rates if self.clamped else spline_rates)(self.times, self.values)

    @property
    def stops(self) -> Tensor:
        """Times [s] that no step chosen by tolerances passes."""
        return self.times[:: self.KNOTS_PER_STEP]

    def control(self) -> Tensor:
        """Control points of every piece (k - 1, 4)."""
        third, rates = self.times.diff() / 3, self.rates
        a, b = self.values[:-1], self.values[1:]
        return torch.stack((a, a + third * rates[:-1], b - third * rates[1:], b), -1)


def spline_rates(t: Tensor, y: Tensor) -> Tensor:
    """Rates (k,) at the knots of the cubic spline through y (k,) at times t (k,) [s] without a knot
    at the second time and at the last but one: a parabola through three, a line through two.
    Differentiable in both."""
    h = t.diff()
    slope = y.diff() / h
    if len(t) < 3:
        return torch.zeros_like(y) if len(t) == 1 else slope.expand(2)
    inner = h[1:] * slope[:-1] + h[:-1] * slope[1:]
    if len(t) == 3:
        middle = inner / h.sum()
        return torch.cat((2 * slope[:1] - middle, middle, 2 * slope[1:] - middle))
    first, last = h[:1] + h[1:2], h[-2:-1] + h[-1:]
    diagonal = torch.cat((h[1:2], 2 * (h[:-1] + h[1:]), h[-2:-1]))
    lower, upper = torch.cat((h[1:], last)), torch.cat((first, h[:-1]))
    begin = ((h[:1] + 2 * first) * h[1:2] * slope[:1] + h[:1] ** 2 * slope[1:2]) / first
    end = (h[-1:] ** 2 * slope[-2:-1] + (2 * last + h[-1:]) * h[-2:-1] * slope[-1:]) / last
    return Tridiagonal.apply(lower, diagonal, upper, torch.cat((begin, 3 * inner, end)))  # pyright: ignore[reportReturnType]


def clamped_rates(t: Tensor, y: Tensor) -> Tensor:
    """Rates (k,) at the knots of the cubic spline through y (k,) at times t (k,) [s] that is at
    rest at both ends. Differentiable in both."""
    h, none = t.diff(), y.new_zeros(1)
    if len(t) < 3:
        return torch.zeros_like(y)
    slope = y.diff() / h
    inner = h[1:] * slope[:-1] + h[:-1] * slope[1:]
    lower, upper = torch.cat((h[1:], none)), torch.cat((none, h[:-1]))
    diagonal = torch.cat((none + 1, 2 * (h[:-1] + h[1:]), none + 1))
    return Tridiagonal.apply(lower, diagonal, upper, torch.cat((none, 3 * inner, none)))  # pyright: ignore[reportReturnType]


class Tridiagonal(torch.autograd.Function):
    """The solution x (k,) of a tridiagonal system with right-hand side b (k,): O(k), differentiable
    in everything."""

    @staticmethod
    def forward(lower: Tensor, diagonal: Tensor, upper: Tensor, b: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        bands = np.zeros((3, len(b)))
        bands[0, 1:], bands[1], bands[2, :-1] = upper.numpy(), diagonal.numpy(), lower.numpy()
        return torch.from_numpy(solve_banded((1, 1), bands, b.numpy()))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:3], output)

    @staticmethod
    def vmap(info: Any, in_dims: Any, *inputs: Tensor) -> tuple[Tensor, int]:
        """Solutions of one system for a batch of right-hand sides."""
        *system, b = inputs
        return Tridiagonal.forward(*system, b.movedim(in_dims[3], 1)), 1  # pyright: ignore[reportCallIssue]

    @staticmethod
    def backward(ctx: Any, x_bar: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        lower, diagonal, upper, x = ctx.saved_tensors
        b_bar: Any = Tridiagonal.apply(upper, diagonal, lower, x_bar)
        return -b_bar[1:] * x[:-1], -b_bar * x, -b_bar[:-1] * x[1:], b_bar


class Reference(nn.Module):
    """Reference of a rig: named signals of time, setpoints, feed-forward efforts and driven
    coordinates.

    Its time counts from `origin` [s]. Raises `ValueError` for a name that a signal cannot have, and
    for a signal that is not a module giving (value, rate) at t.
    """

    origin: float = 0.0

    def __init__(self, /, **signals: nn.Module) -> None:
        super().__init__()
        check_names("motion", signals, dotted=True)
        for name, signal in signals.items():
            if not isinstance(signal, nn.Module):
                raise ValueError(
                    f"the signal `{name}` must be a module such as `Profile`, but is "
                    f"{type(signal).__name__}"
                )
        self.signals = nn.ModuleDict(
            {name.replace(".", ":"): signal for name, signal in signals.items()}
        )

    def forward(self, t: Tensor, names: Sequence[str]) -> Tensor:
        """Values and rates (..., names, 2) at t (...) [s]. Raises `ValueError` for a signal that is
        not there, or is none."""
        rows = []
        for name in names:
            if name.replace(".", ":") not in self.signals:
                known = [key.replace(":", ".") for key in self.signals]
                raise ValueError(
                    f"the reference has no signal `{name}`; {suggestion(name, known, 'it has')}"
                )
            rows.append(self._asked(name, t))
        return torch.stack(rows, -2) if rows else t.new_zeros((*t.shape, 0, 2))

    def _asked(self, name: str, t: Tensor) -> Tensor:
        """Value and rate (..., 2) of one signal."""
        given = self._now(name)(t)
        if (
            not isinstance(given, tuple)
            or len(given) != 2
            or not all(isinstance(x, Tensor) for x in given)
        ):
            raise ValueError(
                f"the signal `{name}` must give two tensors, value and rate, but gives "
                f"{type(given).__name__}"
            )
        for x in given:
            if x.shape != t.shape or x.dtype != torch.float64:
                raise ValueError(
                    f"the signal `{name}` must give float64 of shape {tuple(t.shape)}, but gives "
                    f"{x.dtype} of {tuple(x.shape)}"
                )
        return torch.stack(given, -1)

    def _now(self, name: str) -> nn.Module:
        """A signal, whose knots may have been changed since it was made. Raises `ValueError` for
        those that are none."""
        signal = self[name]
        if isinstance(signal, Piecewise) and (wrong := signal.ill_posed()):
            raise ValueError(f"the signal `{name}` of the reference is none any more: {wrong}")
        return signal

    def is_plain(self, names: Sequence[str]) -> bool:
        """Whether these signals are polynomials of this package's, and nothing else decides their
        values."""
        return not self.overridden and all(polynomial(self[name]) for name in names)

    def plain(self, names: Sequence[str]) -> list[Piecewise] | None:
        """These signals, if they are plain; else None. Raises `ValueError` for knots that are
        none."""
        chosen = [self._now(name) for name in names]
        return chosen if self.is_plain(names) else None  # pyright: ignore[reportReturnType]

    @property
    def overridden(self) -> bool:
        """Whether anything but its signals decides the values."""
        changed = type(self).forward is not Reference.forward
        return bool(changed or self._forward_hooks or self._forward_pre_hooks)

    def since(self, origin: float) -> "Reference":
        """The same with time counted from `origin` [s]. Knots are shifted themselves, which rounds
        nothing near the origin; signals of other kinds are asked at origin + t, as float64 resolves
        it."""
        if origin == 0:
            return self
        if self.overridden:
            return _Since(self, origin)
        out = Reference()
        out.origin = self.origin + origin
        for key, one in self.signals.items():
            shift = Retimed(one, shift=-origin) if polynomial(one) else Later(one, origin)  # pyright: ignore[reportArgumentType]
            out.signals[key] = shift
        return out

    def __getitem__(self, name: str) -> nn.Module:
        return self.signals[name.replace(".", ":")]

    def replaced(self, signals: Mapping[str, nn.Module]) -> "Reference":
        """The same with other signals by these names; itself where there are none."""
        if not signals:
            return self
        out, modules = copy(self), {name.replace(".", ":"): one for name, one in signals.items()}
        out._modules = self._modules | {"signals": nn.ModuleDict({**self.signals, **modules})}
        return out


class _Since(Reference):
    """A reference that computes its values in its own way, with time counted from an origin [s]."""

    def __init__(self, other: Reference, origin: float) -> None:
        super().__init__()
        self.other, self.shift, self.origin = other, origin, other.origin + origin
        self.signals = other.signals

    def forward(self, t: Tensor, names: Sequence[str]) -> Tensor:
        """Values and rates (..., names, 2) at t (...) [s]."""
        return self.other(t + self.shift, names)


def polynomial(signal: nn.Module) -> bool:
    """Whether a signal is made of polynomials of this package's and nothing else decides its
    values."""
    built_in = isinstance(signal, Piecewise) and type(signal).__module__.startswith("torchsoft.")
    return built_in and not (signal._forward_hooks or signal._forward_pre_hooks)


def hold(**values: float) -> Reference:
    """The reference that stays where it is."""
    return Reference(**{name: Profile([0.0], [value]) for name, value in values.items()})
