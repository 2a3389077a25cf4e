"""Signals of time: the paper's profiles, recorded set-points, references, and where their gradients
go."""

import numpy as np
import pytest
import torch
from conftest import f64, times
from scipy.interpolate import CubicSpline
from torch.autograd import gradcheck

from torchsoft import Profile, Reference, Sampled, hold
from torchsoft.physics.motion import Lines, Retimed, Waves, wave

TIMES = [0.0, 0.4, 1.0, 1.5]
VALUES = [0.06, 0.04, 0.05, 0.01]


def test_profile_is_the_papers_seventh_order_polynomial():
    """Ends where it should, at rest with zero acceleration and jerk; peak speed 4.375 mm/s for 20
    mm in 10 s."""
    profile = Profile([0.0, 10.0], [0.06, 0.04])
    t = times(10, 1001)
    value, rate = profile(t)
    assert float(value[0]) == 0.06
    assert float(value[-1]) == pytest.approx(0.04, abs=1e-15)
    assert float(rate.abs().max()) == pytest.approx(4.375e-3, rel=1e-12)
    for time in (0.0, 10.0):
        derivative = lambda t: profile(t)[1].sum()
        t0 = torch.tensor(time + (1e-9 if time == 0 else -1e-9), dtype=torch.float64)
        acceleration = torch.func.grad(derivative)
        assert float(profile(t0)[1].abs()) < 1e-12
        assert float(acceleration(t0).abs()) < 1e-12
        assert float(torch.func.grad(acceleration)(t0).abs()) < 1e-9
    slope = torch.func.grad(lambda t: profile(t)[0].sum())(t[123])
    assert float(slope) == pytest.approx(float(rate[123]), rel=1e-12)


def test_profile_goes_through_its_knots_and_stays_outside_them():
    profile = Profile(TIMES, VALUES)
    value, rate = profile(f64(-1.0, *TIMES, 9.0))
    assert value.tolist() == pytest.approx([VALUES[0], *VALUES, VALUES[-1]], abs=1e-16)
    assert torch.equal(rate, torch.zeros_like(rate))


def test_lines_interpolate():
    signal, t = Lines(TIMES, VALUES), torch.linspace(-0.5, 2.0, 301, dtype=torch.float64)
    np.testing.assert_allclose(signal(t)[0], np.interp(t, TIMES, VALUES), rtol=0, atol=1e-16)


@pytest.mark.parametrize("knots", [2, 3, 4])
def test_sampled_is_the_cubic_spline_and_stays_outside_it(knots):
    signal, spline = (
        Sampled(TIMES[:knots], VALUES[:knots]),
        CubicSpline(TIMES[:knots], VALUES[:knots]),
    )
    t = times(TIMES[knots - 1], 301)
    value, rate = signal(t)
    np.testing.assert_allclose(value, spline(t), rtol=0, atol=1e-15)
    np.testing.assert_allclose(rate, spline(t, 1), rtol=0, atol=1e-13)
    value, rate = signal(f64(-0.5, 2.0))
    assert value.tolist() == pytest.approx([VALUES[0], VALUES[knots - 1]], abs=1e-16)
    assert torch.equal(rate, torch.zeros_like(rate))


def test_sampled_stays_the_spline_when_its_knots_are_changed():
    """In place, and by a gradient: that of what is computed by finite differences of the values and
    of the times."""
    signal = Sampled([0.0, 0.1, 0.2, 0.3, 0.4], [1.0, 1.0, 1.0, 1.0, 1.0])
    at, values = f64(0.0, 0.4, 1.0, 1.5, 2.5), f64(0.06, 0.04, 0.05, 0.01, 0.02)
    with torch.no_grad():
        signal.times.copy_(at)
        signal.values.copy_(values)
    t = times(2.5, 101)
    np.testing.assert_allclose(
        signal(t)[1].detach(), CubicSpline(at, values)(t, 1), rtol=0, atol=1e-13
    )
    for k in (2, 3, 4, 5):
        knots = at[:k].clone().requires_grad_(), values[:k].clone().requires_grad_()
        assert gradcheck(lambda *knots: torch.stack(Sampled(*knots)(f64(0.1, 0.3))), knots)


def test_sampled_with_rates_is_hermites_cubic():
    """x^3 from its values and rates, exactly."""
    knots = f64(0.0, 0.5, 2.0)
    signal = Sampled(knots.tolist(), (knots**3).tolist(), (3 * knots**2).tolist())
    t = times(2, 101)
    value, rate = signal(t)
    assert torch.allclose(value, t**3, rtol=0, atol=1e-14)
    assert torch.allclose(rate, 3 * t**2, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "signal", [Profile([0.3], [0.05]), Sampled([0.3], [0.05])], ids=["profile", "sampled"]
)
def test_one_knot_is_a_constant(signal):
    value, rate = signal(f64(0.0, 0.3, 1.0))
    assert value.tolist() == [0.05] * 3
    assert rate.tolist() == [0.0] * 3


@pytest.mark.parametrize("kind", [Profile, Sampled, Lines])
def test_signals_by_gradcheck(kind):
    """By the values of the knots, and by time where the signal is smooth."""
    signal = kind([0.0, 0.4, 1.0], [0.06, 0.04, 0.05])
    signal.values.requires_grad_(True)
    t = f64(-0.1, 0.1, 0.3, 0.4, 0.7, 1.3)
    assert gradcheck(lambda *_: torch.stack(signal(t)), (signal.values,))
    inside = f64(0.1, 0.3, 0.7).requires_grad_()
    assert gradcheck(lambda t: signal(t)[0], (inside,))
    (slope,) = torch.autograd.grad(signal(inside)[0].sum(), inside)
    assert torch.allclose(slope, signal(inside)[1], rtol=1e-12)


def test_a_tensor_with_a_graph_given_as_a_knot_keeps_it():
    """One knot among numbers, and all knots at once; a plain number is a parameter that is not
    trained."""
    x = f64(0.04)[0].requires_grad_()
    value, _ = Profile([0.0, 1.0], [0.06, 2 * x])(f64(0.0, 0.5, 1.0))
    (slope,) = torch.autograd.grad(value.sum(), x)
    assert float(slope) == pytest.approx(2 * 1.5, rel=1e-14)
    knots = f64(0.1, 0.2).requires_grad_()
    (slope,) = torch.autograd.grad(Profile([0.0, 1.0], knots**2)(f64(1.0))[0].sum(), knots)
    assert torch.allclose(slope, f64(0.0, 0.4))
    signal = Sampled([0.0, 1.0], knots**2, [0.0, 0.0])
    (slope,) = torch.autograd.grad(signal(f64(1.0))[0].sum(), knots)
    assert torch.allclose(slope, f64(0.0, 0.4))
    assert [p.requires_grad for p in Profile([0.0, 1.0], [0.06, 0.05]).parameters()] == [False]
    assert not list(Profile([0.0, 1.0], knots**2).parameters())


def test_reference_gives_named_signals_side_by_side():
    reference = Reference(x=Profile([0.0, 1.0], [0.0, 1.0]), y=Profile([0.0], [7.0]))
    t = times(1, 5)
    got = reference(t, ("y", "x", "y"))
    assert got.shape == (5, 3, 2)
    assert torch.equal(got[:, 1], torch.stack(reference["x"](t), -1))
    assert torch.equal(got[:, 0], got[:, 2])
    assert reference(t, ()).shape == (5, 0, 2)
    assert hold(x=1.0, y=-2.0)(f64(3.0), ("x", "y"))[0].tolist() == [[1.0, 0.0], [-2.0, 0.0]]


@pytest.mark.parametrize(
    "signal",
    [
        Profile([0.1, 0.5, 0.9], [0.0, 1.0, -0.5]),
        Waves(([0.0, 0.2], [0.0, 1e-3]), 0.3, 1.2, wave(1e-3, 7.0, 2.0, 0.3)),
        Sampled([0.0, 0.4, 0.7], [0.0, 1.0, 0.5], [0.0, 2.0, -1.0]),
        Profile([0.2], [3.0]),
    ],
    ids=["profile", "waves", "sampled", "constant"],
)
def test_a_signal_at_other_times(signal):
    """All of it moves: knots, waves and their window, given rates."""
    rate, shift = 1.02, -0.03
    moved = Retimed(signal, rate, shift)
    t = torch.linspace(-0.1, 1.4, 301, dtype=torch.float64)
    value, slope = signal(t)
    value_there, slope_there = moved(rate * t + shift)
    torch.testing.assert_close(value_there, value, rtol=0, atol=1e-12)
    torch.testing.assert_close(rate * slope_there, slope, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(moved.stops, rate * signal.stops + shift, rtol=0, atol=0)
    assert not moved.ill_posed()


@pytest.mark.parametrize("kind", [Profile, Lines, Sampled])
def test_a_jump_within_less_than_the_shortest_step_is_refused(kind):
    """Its rate acted on nothing: a step of 20 mm gave a bracket 3.4 m/s where one within 10 us
    gives 18 m/s."""
    for gap in (1e-16, 1e-12, 9e-10):
        with pytest.raises(ValueError, match="`times` of different values must be 1e-09 s apart"):
            kind([0.0, gap], [0.0, 20e-3])
        assert len(kind([0.0, gap, 1.0], [0.0, 0.0, 1.0]).times) == 3
    assert float(kind([0.0, 1.1e-9], [0.0, 20e-3])(torch.tensor(1.0).double())[0]) == 20e-3
    changed = Profile([0.0, 1e-12, 1.0], [0.0, 0.0, 1.0])
    with torch.no_grad():
        changed.values[1] = 1.0
    with pytest.raises(ValueError, match="the signal `x_d` of the reference is none any more"):
        Reference(x_d=changed)(f64(0.0), ["x_d"])
