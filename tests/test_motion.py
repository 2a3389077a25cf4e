"""What every motion guarantees, against closed forms and scipy: value and rate, gradients with
respect to knots, and other times."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from conftest import f64
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from torch.autograd import gradcheck

from torchsoft import Profile, Reference, Sampled
from torchsoft.physics.motion import Lines, Retimed, Waves, wave

TIMES, VALUES = np.array([0.0, 0.4, 1.0, 1.5]), np.array([0.06, 0.04, 0.05, 0.01])
RATES = np.array([0.1, -0.2, 0.0, 0.3])
SINCE, UNTIL, SWEEP = 0.2, 1.3, 2.0


def seventh(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """The paper's polynomials, at rest with zero acceleration and jerk at every knot."""
    t = t.clip(TIMES[0], TIMES[-1])
    i = (np.searchsorted(TIMES, t, side="right") - 1).clip(0, len(TIMES) - 2)
    u = (t - TIMES[i]) / np.diff(TIMES)[i]
    return VALUES[i] + np.diff(VALUES)[i] * u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)


def sines(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """A wave of 1 mm and 7 Hz, whose frequency rises, on a profile; exact away from its ends."""
    tau = t - SINCE
    phase = 0.3 + 2 * np.pi * (7.0 * tau + 0.5 * SWEEP * tau**2)
    return seventh(t) + 1e-3 * np.sin(phase) * ((t > SINCE) & (t < UNTIL))


def clip(f: Callable[..., NDArray[np.float64]]) -> Callable[..., NDArray[np.float64]]:
    return lambda t: f(t.clip(TIMES[0], TIMES[-1]))


REST = CubicSpline(TIMES, VALUES, bc_type="clamped")
# A new motion is one line: how it is made, and its values.
MOTIONS = {
    "profile": (lambda: Profile(TIMES, VALUES), seventh),
    "lines": (lambda: Lines(TIMES, VALUES), lambda t: np.interp(t, TIMES, VALUES)),
    "sampled": (lambda: Sampled(TIMES, VALUES), clip(CubicSpline(TIMES, VALUES))),
    "sampled, three knots": (
        lambda: Sampled(TIMES[1:], VALUES[1:]),
        lambda t: CubicSpline(TIMES[1:], VALUES[1:])(t.clip(TIMES[1], TIMES[-1])),
    ),
    "sampled, at rest": (lambda: Sampled(TIMES, VALUES, clamped=True), clip(REST)),
    "sampled with rates": (
        lambda: Sampled(TIMES, VALUES, RATES), clip(CubicHermiteSpline(TIMES, VALUES, RATES))
    ),
    "waves": (
        lambda: Waves((TIMES.tolist(), VALUES.tolist()), SINCE, UNTIL, wave(1e-3, 7.0, SWEEP, 0.3)),
        sines,
    ),
    "later and faster": (
        lambda: Retimed(Sampled(TIMES, VALUES), 1.02, -0.03),
        lambda t: clip(CubicSpline(TIMES, VALUES))((t + 0.03) / 1.02),
    ),
    "one knot": (lambda: Profile([0.3], [0.05]), lambda t: np.full_like(t, 0.05)),
}  # fmt: skip


@pytest.fixture(params=MOTIONS)
def case(request):
    make, values = MOTIONS[request.param]
    return make(), values


def test_values_are_the_closed_form_and_rates_their_slopes(case):
    """Constant before the first knot and after the last; continuous at the knots."""
    signal, values = case
    t = np.linspace(-0.3, 2.0, 463)
    fading = (abs(t - SINCE) < 0.16) | (abs(t - UNTIL) < 0.16)
    judged = ~fading | (not isinstance(signal, Waves))
    value, rate = (x.detach().numpy() for x in signal(torch.from_numpy(t)))
    assert value[judged] == pytest.approx(values(t)[judged], abs=1e-13)
    assert not rate[(t < -0.04) | (t > 1.6)].any()
    h = 1e-6
    ahead, behind = (signal(torch.from_numpy(t + by))[0].detach().numpy() for by in (h, -h))
    assert (ahead - behind) / (2 * h) == pytest.approx(rate, abs=1e-5)


def test_gradients_with_respect_to_knots(case):
    """Knots changed in place count."""
    signal, _ = case
    t = f64(-0.1, 0.1, 0.3, 0.4, 0.7, 1.3, 1.9)
    signal.values.requires_grad_(True)
    assert gradcheck(lambda *_: torch.stack(signal(t)), (signal.values,))
    before = signal(t)[0]
    with torch.no_grad():
        signal.values.add_(0.01)
    assert signal(t)[0].tolist() == pytest.approx((before + 0.01).tolist(), abs=1e-14)


@pytest.mark.parametrize("k", [2, 3, 4, 5])
def test_gradients_with_respect_to_times_of_samples(k):
    knots = [f64(0.0, 0.4, 1.0, 1.5, 2.5), f64(0.06, 0.04, 0.05, 0.01, 0.02)]
    knots = [one[:k].clone().requires_grad_() for one in knots]
    assert gradcheck(lambda *knots: torch.stack(Sampled(*knots)(f64(0.1, 0.3))), knots)


def test_a_tensor_with_a_graph_given_as_a_knot_keeps_it():
    """One among numbers, and all at once; a plain number is a parameter that is not trained."""
    x = f64(0.04)[0].requires_grad_()
    value, _ = Profile([0.0, 1.0], [0.06, 2 * x])(f64(0.0, 0.5, 1.0))
    (slope,) = torch.autograd.grad(value.sum(), x)
    assert float(slope) == pytest.approx(2 * 1.5, rel=1e-14)
    knots = f64(0.1, 0.2).requires_grad_()
    for signal in (Profile([0.0, 1.0], knots**2), Sampled([0.0, 1.0], knots**2, [0.0, 0.0])):
        (slope,) = torch.autograd.grad(signal(f64(1.0))[0].sum(), knots)
        assert torch.allclose(slope, f64(0.0, 0.4))
        assert not list(signal.parameters())
    assert [p.requires_grad for p in Profile([0.0, 1.0], [0.06, 0.05]).parameters()] == [False]


def test_a_motion_at_other_times_keeps_all_of_it(case):
    """Knots, waves and their window move, and so do the times that no step passes."""
    signal, _ = case
    rate, shift = 1.02, -0.03
    moved, t = Retimed(signal, rate, shift), torch.linspace(-0.1, 1.4, 301, dtype=torch.float64)
    (value, slope), (there, slope_there) = signal(t), moved(rate * t + shift)
    torch.testing.assert_close(there, value, rtol=0, atol=1e-12)
    away = (t[:, None] - signal.times).abs().amin(-1) > 1e-9  # lines jump at knots
    torch.testing.assert_close(rate * slope_there[away], slope[away], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(moved.stops, rate * signal.stops + shift, rtol=0, atol=0)


@pytest.mark.parametrize("kind", [Profile, Lines, Sampled])
def test_a_jump_within_less_than_the_shortest_step_is_rejected(kind):
    """Its rate would act on nothing."""
    with pytest.raises(ValueError, match="`times` of different values must be 1e-09 s apart"):
        kind([0.0, 9e-10], [0.0, 20e-3])
    assert len(kind([0.0, 1e-12, 1.0], [0.0, 0.0, 1.0]).times) == 3
    assert float(kind([0.0, 1.1e-9], [0.0, 20e-3])(f64(1.0))[0]) == 20e-3
    changed = kind([0.0, 1e-12, 1.0], [0.0, 0.0, 1.0])
    with torch.no_grad():
        changed.values[1] = 1.0
    with pytest.raises(ValueError, match="the signal `x_d` of the reference"):
        Reference(x_d=changed)(f64(0.0), ["x_d"])
