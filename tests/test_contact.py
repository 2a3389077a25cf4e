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


def smooth(mu_s: float = 0.8, mu_k: float = 0.5, v_s: float = 0.02) -> SmoothSlip:
    return SmoothSlip(mu_s, mu_k, v_s)


def law(friction: SlipLaw | None = None) -> SoftContact:
    return SoftContact(K, R, 2 * K, R / 2, friction=friction or smooth())


@torch.no_grad()
def at(
    contact: SoftContact, g: float, g_dot: float, v_T: float, s: float, **more: float
) -> ContactState:
    return contact(*(f64(x)[0] for x in (g, g_dot, v_T, s)), **more)


# by hand
# ----------------------------------------------------------------------


@pytest.mark.parametrize("g_dot", [-0.05, 0.0, 0.02])
def test_a_separated_point_carries_nothing_and_its_spring_relaxes(g_dot):
    """R_t s' = -K_t s: nothing presses, so the spring slips home against its dashpot."""
    got = at(law(), g=-1e-7, g_dot=g_dot, v_T=0.3, s=1e-5)
    assert (got.F_N, got.F_T) == (0.0, 0.0)
    assert float(got.s_dot) == pytest.approx(-2 * K * 1e-5 / (R / 2), rel=1e-14)
    assert float(got.gamma_dot) == -float(got.s_dot)


def test_the_normal_dashpot_carries_at_most_twice_what_the_spring_does():
    for D, force in (
        (0.9, 1.873),
        (-0.9, 0.1),
        (2.7, 2.971),
        (3.1, 3.0),
        (-1.1, 0.0),
        (400.0, 3.0),
    ):
        got = at(law(), g=1e-5, g_dot=D / R, v_T=0.0, s=0.0)
        assert float(got.F_N) == pytest.approx(force, rel=1e-12, abs=1e-15)


def test_a_sticking_point_is_a_spring_and_a_dashpot():
    g, v_T, s = 9e-6, 1e-4, 2e-6
    got = at(law(), g=g, g_dot=0.0, v_T=v_T, s=s, weight=2.0)
    assert float(got.F_N) == pytest.approx(2 * K * g, rel=1e-15)
    assert float(got.s_dot) == v_T
    assert float(got.gamma_dot) == 0.0
    assert float(got.F_T) == pytest.approx(2 * (2 * K * s + R / 2 * v_T), rel=1e-14)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_slipping_point_solves_the_quadratic(side):
    """R x = E - (mu_k + (mu_s - mu_k)/(1 + x/v_s)) F_N at F_N = 10 N, E = 12 N: 200 x^2 + (4 - 7) x
    - 0.08 = 0."""
    g = 1e-4
    s = 12.0 / (2 * K)  # the trial effort, with v_T = 0
    got = at(law(), g=g, g_dot=0.0, v_T=0.0, s=side * s)
    x = (3.0 + math.sqrt(3.0**2 + 4 * 200.0 * 0.08)) / 400.0
    assert float(got.gamma_dot) == pytest.approx(side * x, rel=1e-13)
    assert float(got.s_dot) == pytest.approx(-side * x, rel=1e-13)
    mu = 0.5 + 0.3 / (1 + x / 0.02)
    assert float(got.F_T) == pytest.approx(side * mu * 10.0, rel=1e-12)
    assert got.e == got.F_T


def test_coulomb_slips_with_kinetic_friction():
    contact = law(Coulomb(0.8, 0.5))
    got = at(contact, g=1e-4, g_dot=0.0, v_T=0.0, s=12.0 / (2 * K))
    assert float(got.e) == pytest.approx(5.0, rel=1e-14)
    assert float(got.gamma_dot) == pytest.approx((12.0 - 5.0) / (R / 2), rel=1e-14)
    stuck = at(contact, g=1e-4, g_dot=0.0, v_T=0.0, s=7.999 / (2 * K))
    assert float(stuck.gamma_dot) == 0.0


def test_withdrawal_does_not_pull():
    assert float(at(law(), g=1e-5, g_dot=-0.1, v_T=0.0, s=0.0).F_N) == 0.0
    assert float(at(law(), g=1e-5, g_dot=-1e-3, v_T=0.0, s=0.0).F_N) == pytest.approx(0.6)


def test_a_stage_acts_through_the_stretch_at_its_end():
    """The law at a stage equals the instantaneous law at s* + a h s', stick and slip."""
    for v_T in (1e-3, 0.5):
        stage = at(law(), g=5e-5, g_dot=1e-3, v_T=v_T, s=1e-6, stage=6e-4)
        now = at(law(), g=5e-5, g_dot=1e-3, v_T=v_T, s=1e-6 + 6e-4 * float(stage.s_dot))
        for name in set(ContactState._fields) - {"z_dot"}:  # this friction has no states
            assert float(getattr(now, name)) == pytest.approx(
                float(getattr(stage, name)), rel=1e-11
            ), name


# limits and continuity
# ----------------------------------------------------------------------


@pytest.mark.parametrize("s", [0.0, 1e-5])
@pytest.mark.parametrize("friction", [smooth(), Coulomb(0.8, 0.5)])
def test_forces_are_continuous_at_touch_down(friction, s):
    """They grow from zero with the springs, whatever the speed; friction inside Coulomb's cone."""
    for g in (1e-9, 1e-11, 1e-13):
        got = at(law(friction), g=g, g_dot=0.2, v_T=0.3, s=s)
        assert K * g < float(got.F_N) <= 3 * K * g * (1 + 1e-15)
        assert abs(float(got.F_T)) <= 0.8 * float(got.F_N) * (1 + 1e-9) + 1e-13
        apart = at(law(friction), g=-g, g_dot=0.2, v_T=0.3, s=s)
        assert float(apart.F_N) == 0.0
        assert abs(float(got.s_dot - apart.s_dot)) <= 0.8 * 3 * K * g / (R / 2) + 1e-15


@given(g=st.floats(-1e-4, 0.0) | st.floats(1e-15, 1e-3), g_dot=st.floats(-1.0, 1.0),
    v_T=st.floats(-1.0, 1.0), s=st.floats(-1e-3, 1e-3),
    scale=st.sampled_from([1e-6, 1.0, 1e6]))  # fmt: skip
@pytest.mark.parametrize("friction", [smooth(), Coulomb(0.8, 0.5)])
def test_friction_is_coulombs_at_any_load(friction, g, g_dot, v_T, s, scale):
    """|F_T| <= mu_s F_N, and mu_k F_N where a Coulomb point slips; springs and dashpots in
    proportion change forces in proportion and nothing else."""
    one = at(law(friction), g, g_dot, v_T, s)
    scaled = SoftContact(*(scale * x for x in (K, R, 2 * K, R / 2)), friction=friction)
    other = at(scaled, g, g_dot, v_T, s)
    rounding = 1e-12 * (2 * K * abs(s) + R * abs(v_T)) + 1e-300
    assert abs(float(one.F_T)) <= 0.8 * float(one.F_N) + rounding
    if isinstance(friction, Coulomb) and float(one.gamma_dot) != 0.0:
        assert abs(float(one.F_T)) == pytest.approx(0.5 * float(one.F_N), abs=rounding)
    for a, b in zip((other.F_N, other.F_T), (one.F_N, one.F_T)):
        assert float(a) / scale == pytest.approx(float(b), rel=1e-9, abs=rounding)
    assert float(other.gamma_dot) == pytest.approx(float(one.gamma_dot), rel=1e-9, abs=1e-11)


def test_smooth_slip_begins_continuously_and_coulombs_does_not():
    F_N, dashpot = f64(10.0), f64(200.0)
    with torch.no_grad():
        for part in (1e-6, 1e-9):
            E = 8.0 * (1 + part) * torch.ones(1, dtype=torch.float64)
            assert (
                0.0
                < float(smooth(v_s=0.05)(E, F_N, dashpot))
                < 8.0 * part / (200.0 - 3.0 / 0.05) * 1.01
            )
        assert float(Coulomb(0.8, 0.5)(f64(8.0), F_N, dashpot)) == pytest.approx(
            3.0 / 200.0, rel=1e-14
        )


FORCES, RATES, DEPTHS = st.floats(0.0, 100.0), st.floats(-1.0, 1.0), st.floats(-1e-4, 1e-3)


@given(E=FORCES, F_N=FORCES, dashpot=st.floats(1.0, 1e4), mu_k=st.floats(0.0, 1.0),
    extra=st.floats(0.0, 1.0),
       v_s=st.floats(1e-3, 1.0))  # fmt: skip
def test_smooth_slip_satisfies_its_equation(E, F_N, dashpot, mu_k, extra, v_s):
    friction = SmoothSlip(mu_k + extra, mu_k, v_s)
    with torch.no_grad():
        x = float(friction(f64(E), f64(F_N), f64(dashpot)))
    assert 0.0 <= dashpot * x <= E * (1 + 1e-12) + 1e-300  # a slip is exact to its last denormal
    if (mu_k + extra) * F_N >= E:
        assert x == 0.0 or (mu_k + extra) * F_N == E
    else:
        mu = mu_k + extra / (1 + x / v_s)
        assert dashpot * x == pytest.approx(E - mu * F_N, rel=1e-9, abs=1e-9 * (E + F_N) + 1e-300)


@pytest.mark.parametrize("friction", [smooth(), Coulomb(0.8, 0.5)], ids=["smooth", "coulomb"])
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
