"""The contact law of one point against numbers worked out by hand, its limits, its continuity, and
its derivatives."""

import math

import pytest
import torch
from conftest import f64
from hypothesis import given
from hypothesis import strategies as st

from torchsoft import Circle, Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.contact import (
    ContactState,
    SlipLaw,
    moving_frame,
)

K, R = 1e5, 400.0
"""Springs [N/m] and dashpots [N.s/m] of the laws below."""


def smooth(
    mu_s: float = 0.8, mu_k: float = 0.5, v_s: float = 0.01, eta: float = 20.0
) -> SmoothSlip:
    return SmoothSlip(mu_s, mu_k, v_s, eta)


def law(friction: SlipLaw | None = None, epsilon: float = 1e-6) -> SoftContact:
    return SoftContact(K, R, 2 * K, R / 2, friction=friction or smooth(), epsilon=epsilon)


@torch.no_grad()
def at(
    contact: SoftContact, g: float, g_dot: float, v_T: float, s: float, **more: float
) -> ContactState:
    return contact(*(f64(x)[0] for x in (g, g_dot, v_T, s)), **more)


# by hand
# ----------------------------------------------------------------------


@pytest.mark.parametrize("g_dot", [-0.05, 0.0, 0.02])
def test_a_separated_point_carries_nothing_and_its_spring_relaxes(g_dot):
    """(eta + R_t) s' = -K_t s: nothing presses, so the spring slips home against the two
    viscosities."""
    got = at(law(), g=-1e-7, g_dot=g_dot, v_T=0.3, s=1e-5)
    assert (got.F_N, got.F_T, got.rho) == (0.0, 0.0, 0.0)
    assert float(got.s_dot) == pytest.approx(-2 * K * 1e-5 / (20.0 + R / 2), rel=1e-14)
    assert float(got.gamma_dot) == -float(got.s_dot)


def test_a_point_one_epsilon_deep_has_half_its_dashpots():
    got = at(law(), g=1e-6, g_dot=1e-3, v_T=0.0, s=0.0)
    assert float(got.rho) == 0.5
    assert float(got.F_N) == pytest.approx(K * 1e-6 + R * 1e-3 / 2, rel=1e-14)


def test_a_sticking_point_is_a_spring_and_a_dashpot():
    g, v_T, s = 9e-6, 1e-4, 2e-6
    got = at(law(), g=g, g_dot=0.0, v_T=v_T, s=s, weight=2.0)
    assert float(got.rho) == pytest.approx(0.9, rel=1e-15)
    assert float(got.F_N) == pytest.approx(2 * K * g, rel=1e-15)
    assert float(got.s_dot) == pytest.approx(0.9 * v_T, rel=1e-15)
    assert float(got.gamma_dot) == 0.0
    assert float(got.F_T) == pytest.approx(2 * 0.9 * (2 * K * s + R / 2 * 0.9 * v_T), rel=1e-14)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_slipping_point_solves_the_quadratic(side):
    """(eta + R) x = E - (mu_k + (mu_s - mu_k)/(1 + x/v_s)) F_N at F_N = 10 N, E = 12 N: 220 x^2 +
    (2.2 - 7) x - 0.04 = 0."""
    g = 1e-4
    rho = g / (g + 1e-6)
    s = 12.0 / (2 * K)  # the trial effort, with v_T = 0
    got = at(law(), g=g, g_dot=0.0, v_T=0.0, s=side * s)
    x = (4.8 + math.sqrt(4.8**2 + 4 * 220.0 * 0.04)) / 440.0
    assert float(got.gamma_dot) == pytest.approx(side * x, rel=1e-13)
    assert float(got.s_dot) == pytest.approx(-side * x, rel=1e-13)
    mu = 0.5 + 0.3 / (1 + x / 0.01)
    assert float(got.e) == pytest.approx(side * (mu * 10.0 + 20.0 * x), rel=1e-12)
    assert float(got.F_T) == pytest.approx(rho * float(got.e), rel=1e-15)


def test_coulomb_slips_with_kinetic_friction():
    contact = law(Coulomb(0.8, 0.5))
    got = at(contact, g=1e-4, g_dot=0.0, v_T=0.0, s=12.0 / (2 * K))
    assert float(got.e) == pytest.approx(5.0, rel=1e-14)
    assert float(got.gamma_dot) == pytest.approx((12.0 - 5.0) / (R / 2), rel=1e-14)
    stuck = at(contact, g=1e-4, g_dot=0.0, v_T=0.0, s=7.999 / (2 * K))
    assert float(stuck.gamma_dot) == 0.0


def test_withdrawal_does_not_pull():
    assert float(at(law(), g=1e-5, g_dot=-0.1, v_T=0.0, s=0.0).F_N) == 0.0
    assert float(at(law(), g=1e-5, g_dot=-1e-3, v_T=0.0, s=0.0).F_N) == pytest.approx(
        1.0 - 0.4 * 10 / 11, rel=1e-14
    )


def test_a_stage_acts_through_the_stretch_at_its_end():
    """The law at a stage equals the instantaneous law at s* + a h s', stick and slip."""
    for v_T in (1e-3, 0.5):
        stage = at(law(), g=5e-5, g_dot=1e-3, v_T=v_T, s=1e-6, stage=6e-4)
        now = at(law(), g=5e-5, g_dot=1e-3, v_T=v_T, s=1e-6 + 6e-4 * float(stage.s_dot))
        for name in ContactState._fields:
            assert float(getattr(now, name)) == pytest.approx(
                float(getattr(stage, name)), rel=1e-11
            ), name


# limits and continuity
# ----------------------------------------------------------------------


@pytest.mark.parametrize("s", [0.0, 1e-5])
@pytest.mark.parametrize("friction", [smooth(), Coulomb(0.8, 0.5)])
def test_forces_are_continuous_at_touch_down(friction, s):
    """They grow from zero no faster than the springs, and the dashpots over epsilon, let them."""
    for g in (1e-9, 1e-11, 1e-13):
        got = at(law(friction), g=g, g_dot=0.2, v_T=0.3, s=s)
        steepest = K + R * 0.2 / 1e-6
        assert 0.0 < float(got.F_N) <= steepest * g
        assert abs(float(got.F_T)) <= g / 1e-6 * (2 * K * s + R / 2 * 0.3)
        apart = at(law(friction), g=-g, g_dot=0.2, v_T=0.3, s=s)
        assert float(apart.F_N) == 0.0
        assert abs(float(got.s_dot - apart.s_dot)) <= (g / 1e-6) * (1.0 + steepest * 1e-6 / (R / 2))


def test_smooth_slip_begins_continuously_and_coulombs_does_not():
    F_N, dashpot = f64(10.0), f64(200.0)
    with torch.no_grad():
        for part in (1e-6, 1e-9):
            E = 8.0 * (1 + part) * torch.ones(1, dtype=torch.float64)
            assert (
                0.0
                < float(smooth(v_s=0.05)(E, F_N, dashpot))
                < 8.0 * part / (220.0 - 3.0 / 0.05) * 1.01
            )
        assert float(Coulomb(0.8, 0.5)(f64(8.0), F_N, dashpot)) == pytest.approx(
            3.0 / 200.0, rel=1e-14
        )


FORCES, RATES, DEPTHS = st.floats(0.0, 100.0), st.floats(-1.0, 1.0), st.floats(-1e-4, 1e-3)


@given(E=FORCES, F_N=FORCES, dashpot=st.floats(1.0, 1e4), mu_k=st.floats(0.0, 1.0),
    extra=st.floats(0.0, 1.0),
       v_s=st.floats(1e-3, 1.0), eta=st.floats(0.0, 100.0))  # fmt: skip
def test_smooth_slip_satisfies_its_equation(E, F_N, dashpot, mu_k, extra, v_s, eta):
    friction = SmoothSlip(mu_k + extra, mu_k, v_s, eta)
    with torch.no_grad():
        x = float(friction(f64(E), f64(F_N), f64(dashpot)))
    assert 0.0 <= dashpot * x <= E * (1 + 1e-12)
    if (mu_k + extra) * F_N >= E:
        assert x == 0.0 or (mu_k + extra) * F_N == E
    else:
        mu = mu_k + extra / (1 + x / v_s)
        assert (eta + dashpot) * x == pytest.approx(
            E - mu * F_N, rel=1e-9, abs=1e-11 * (E + F_N) + 1e-300
        )


@pytest.mark.parametrize(
    "friction", [smooth(), smooth(eta=0.0), Coulomb(0.8, 0.5)], ids=["smooth", "no eta", "coulomb"]
)
@given(
    g=DEPTHS,
    g_dot=RATES,
    v_T=RATES,
    s=st.floats(-1e-3, 1e-3),
    weight=st.sampled_from([0.5, 1.0, 3.0]),
)
def test_dissipation_is_never_negative(friction, g, g_dot, v_T, s, weight):
    contact = law(friction)
    got = at(contact, g, g_dot, v_T, s, weight=weight)
    with torch.no_grad():
        dashpots, slip = contact.dissipated(got, f64(g), f64(g_dot), weight)
    trial = weight * (2 * K * abs(s) + R * abs(v_T))
    scale = abs(float(got.F_N * g_dot)) + trial * (abs(v_T) + abs(float(got.gamma_dot)))
    assert float(dashpots) >= -1e-13 * scale
    assert float(slip) >= -1e-13 * scale
    stored = weight * K * max(g, 0.0) * g_dot + weight * 2 * K * s * float(got.s_dot)
    taken = float(got.F_N) * g_dot + float(got.F_T) * v_T  # what the point's motion puts in
    assert taken == pytest.approx(
        stored + float(dashpots) + float(slip), rel=1e-9, abs=1e-12 * (1 + abs(stored) + scale)
    )


@given(g=DEPTHS, g_dot=RATES, v_T=RATES, s=st.floats(-1e-3, 1e-3))
def test_friction_knows_no_direction(g, g_dot, v_T, s):
    one, other = at(law(), g, g_dot, v_T, s), at(law(), g, g_dot, -v_T, -s)
    assert torch.equal(one.F_N, other.F_N)
    assert (one.F_T, one.s_dot, one.gamma_dot) == (-other.F_T, -other.s_dot, -other.gamma_dot)


# a point and a body
# ----------------------------------------------------------------------


def test_moving_frame_of_a_circle_by_hand():
    frame = moving_frame(Circle(0.02), f64(0.0, -0.019, 0.012, 0.016).reshape(2, 2), f64(0.3, 0.3))
    assert torch.allclose(frame.n, f64(0.0, -1.0, 0.6, 0.8).reshape(2, 2), rtol=0, atol=1e-15)
    assert torch.allclose(frame.t, f64(1.0, 0.0, -0.8, 0.6).reshape(2, 2), rtol=0, atol=1e-15)
    assert torch.allclose(frame.g, f64(1e-3, 0.0), rtol=0, atol=1e-17)


# derivatives
# ----------------------------------------------------------------------
