"""What every friction law guarantees at a point, numbers worked out by hand, bodies on slopes at
any load and size; springs and dashpots that a rig file takes from its pads."""

import math
import tomllib
from typing import Any

import numpy as np
import pytest
import torch
from conftest import f64
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsoft import AgeingSlip, Coulomb, RateAndState, RigFile, SmoothSlip, SoftContact
from torchsoft.physics.contact import ContactState
from torchsoft.rigs.check import check
from torchsoft.sysid.extensions import extend

K, R = 1e5, 400.0
"""Springs [N/m] and dashpots [N.s/m] of the laws below."""


def law(friction: Any = None, **more: float) -> SoftContact:
    return SoftContact(K, R, 2 * K, R / 2, friction=friction or SmoothSlip(0.8, 0.5, 0.05), **more)


# A new law is one line: with it, the largest friction over the force that it follows.
LAWS = {
    "smooth": (law(), 0.8),
    "coulomb": (law(Coulomb(0.8, 0.5)), 0.8),
    "ageing": (law(AgeingSlip(0.7, 0.5, 0.05, ageing=0.01, D_c=20e-6)), 0.8),
    "rate and state": (law(RateAndState(0.6, 0.012, 0.02, 50e-6, 1e-3, 0.05)), 0.8),
    "of a power, with another ratio": (law(power=1.7, friction_ratio=1.1), 0.88),
    "adhering": (law(adhesion=0.02), 0.8),
}


@torch.no_grad()
def at(contact: SoftContact, *x: float, **more: Any) -> ContactState:
    """Of penetration, its rate, sliding speed and stretch."""
    return contact(*(f64(one)[0] for one in x), **more)


POINT = {
    "g": st.floats(-1e-4, 0.0) | st.floats(1e-12, 1e-4), "g_dot": st.floats(-1.0, 1.0),
    "v_T": st.floats(-1.0, 1.0), "s": st.floats(-1e-3, 1e-3),
    "weight": st.sampled_from([1e-6, 0.5, 1.0, 3e6]),
}  # fmt: skip


EVERY = pytest.mark.parametrize(("contact", "most"), LAWS.values(), ids=LAWS)


@EVERY
def test_forces_are_continuous_at_touch_down(contact, most):
    """They grow from zero with the springs, whatever the speed."""
    for g in (1e-9, 1e-12):
        got, apart = (at(contact, depth, 0.2, 0.3, 1e-5) for depth in (g, -g))
        grown = 3 * float(contact.spring(f64(g)).detach()) + 0.02 * g / 1e-6
        assert abs(float(got.F_N)) <= grown
        assert abs(float(got.F_T)) <= most * grown + 1e-13
        assert float(apart.F_N) == float(apart.F_T) == 0.0
        assert abs(float(got.s_dot - apart.s_dot)) <= most * grown / (R / 2) + 1e-12


@EVERY
@settings(max_examples=30, derandomize=True, deadline=None)
@given(**POINT)
def test_power_is_balanced_friction_is_bounded_and_has_no_direction(
    contact, most, g, g_dot, v_T, s, weight
):
    """What the motion puts in is stored or dissipated by dashpots and slip; at any load."""
    got = at(contact, g, g_dot, v_T, s, weight=weight)
    F_N, F_T, s_dot, gamma_dot = (float(x) for x in got[:4])
    depth, stretch = f64(g).requires_grad_(), f64(s).requires_grad_()
    H = torch.stack(contact.stored(depth, stretch, weight)).sum()
    by_g, by_s = (float(x) for x in torch.autograd.grad(H, (depth, stretch)))
    with torch.no_grad():
        lost = [float(x) for x in contact.dissipated(got, f64(g), f64(g_dot), weight)]
    trial = weight * (2 * K * abs(s) + R * abs(v_T))
    scale = abs(F_N * g_dot) + trial * (abs(v_T) + abs(gamma_dot)) + 1e-12 * weight
    assert min(lost) >= -1e-12 * scale
    assert F_N * g_dot + F_T * v_T == pytest.approx(
        by_g * g_dot + by_s * s_dot + sum(lost), abs=1e-9 * (scale + abs(by_g * g_dot))
    )
    pull, spring = (float(of(f64(g)).detach()) for of in (contact.pull, contact.spring))
    assert abs(F_T) <= most * (F_N + weight * pull) + 1e-9 * trial
    assert 0 <= F_N + weight * pull <= 3 * weight * spring * (1 + 1e-12)  # continuous at touch-down
    if g <= 0:
        assert (F_N, F_T) == (0.0, 0.0)
    other = at(contact, g, g_dot, -v_T, -s, weight=weight)
    mirrored = [F_N, -F_T, -s_dot, -gamma_dot]
    assert [float(x) for x in other[:4]] == pytest.approx(mirrored, rel=1e-15, abs=1e-290)


def quadratic() -> dict[str, float]:
    """R x = E - (mu_k + (mu_s - mu_k) / (1 + x / v_s)) F_N at F_N = 10 N, E = 12 N, v_s = 20 mm/s:
    200 x^2 - 3 x - 0.08 = 0."""
    root = (3.0 + math.sqrt(9.0 + 4 * 200.0 * 0.08)) / 400.0
    return {"gamma_dot": root, "s_dot": -root, "F_T": 10.0 * (0.5 + 0.3 / (1 + root / 0.02))}


SMOOTH, COULOMB = SmoothSlip(0.8, 0.5, 0.02), Coulomb(0.8, 0.5)
BY_HAND = [
    # apart, the spring slips home against its dashpot: R_t s' = -K_t s
    (law(), (-1e-7, 0.02, 0.3, 1e-5), {"F_N": 0.0, "F_T": 0.0, "s_dot": -0.01, "gamma_dot": 0.01}),
    # the normal dashpot carries at most twice what the spring does, and does not pull
    *((law(), (1e-5, D / R, 0.0, 0.0), {"F_N": F_N}) for D, F_N in (
        (0.9, 1.873), (-0.9, 0.1), (2.7, 2.971), (3.1, 3.0), (-1.1, 0.0), (400.0, 3.0))),
    # a spring and a dashpot
    (law(), (9e-6, 0.0, 1e-4, 2e-6), {"F_N": 0.9, "s_dot": 1e-4, "gamma_dot": 0.0, "F_T": 0.42}),
    (law(SMOOTH), (1e-4, 0.0, 0.0, 6e-5), quadratic()),
    (law(COULOMB), (1e-4, 0.0, 0.0, 6e-5), {"F_T": 5.0, "gamma_dot": 7.0 / 200.0}),
    (law(COULOMB), (1e-4, 0.0, 0.0, 3.9999e-5), {"gamma_dot": 0.0}),
    (law(power=2.0), (5e-5, 0.0, 0.0, 0.0), {"F_N": 2.5}),
    (law(adhesion=0.02), (1e-6, 0.0, 0.0, 0.0), {"F_N": 0.1 - 0.01}),
    (law(COULOMB, friction_ratio=1.2), (1e-4, 0.0, 0.0, 6e-5), {"F_T": 6.0}),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(BY_HAND)))
def test_forces_and_rates_are_those_worked_out_by_hand(row):
    contact, x, expected = BY_HAND[row]
    got = at(contact, *x)
    for name, value in expected.items():
        assert float(getattr(got, name)) == pytest.approx(value, rel=1e-12, abs=1e-15), name


MU_0, A, B, D_C, V_0 = 0.6, 0.012, 0.02, 20e-6, 1e-3
FALL, V_S, T_0 = 0.1, 5e-3, 1e-3


def ageing(strengthening: float) -> tuple[Any, ...]:
    """A slip law, its coefficient of the slip rate and of the age after it, that of points at rest,
    and the fall of friction with the slip rate [s/m] that a dashpot has to balance."""
    strength = lambda age: MU_0 + strengthening * torch.log1p(age / T_0)
    moving = lambda V, age: MU_0 - FALL + (strength(age) - MU_0 + FALL) / (1 + V / V_S)
    fall = lambda age, h: (strength(age) - MU_0 + FALL) / V_S + h * strengthening / D_C
    return AgeingSlip(MU_0, MU_0 - FALL, V_S, strengthening, D_C, T_0), moving, strength, fall


def evolving() -> tuple[Any, ...]:
    def moving(V, age):
        """a asinh(V / (2 V_0) exp((mu_0 + b ln(V_0 age / D_c)) / a))."""
        x = torch.log(V / (2 * V_0)) + (MU_0 + B * torch.log(V_0 * age / D_C)) / A
        return A * torch.where(x > 20, x + math.log(2), torch.asinh(torch.exp(x.clamp(max=20))))

    law = RateAndState(MU_0, A, B, D_C, V_0)
    return law, moving, torch.zeros_like, lambda age, h: h * (B - A) / D_C


@pytest.mark.parametrize("made", [ageing(0.0), ageing(0.005), ageing(0.1), evolving()])
def test_the_slip_rate_solves_the_elements_equation(made):
    """R V + mu F_N = E at the end of a stage; V = 0 below the strength at rest; dV/dE =
    1 / (R + d(mu F_N)/dV). Over many orders of magnitude."""
    friction, moving, strength, fall = made
    random = np.random.default_rng(0)
    E, F_N, dashpot, h, age = torch.from_numpy(
        10 ** random.uniform([[-6], [-5], [-1], [-7], [-5]], [[2], [1], [3], [-2], [3]], (5, 20000))
    )
    dashpot = dashpot + fall(age + h, h) * F_N
    V, rate = friction(E.requires_grad_(), F_N, dashpot, age[:, None], h)
    (by_E,) = torch.autograd.grad(V.sum(), E)
    E, V, aged = E.detach(), V.detach().requires_grad_(), (age + h * rate[:, 0]).detach()
    slips = (V > 0).detach()
    assert torch.equal(slips, strength(age + h) * F_N < E)
    assert int(slips.sum()) > 5000
    after = (age + h) / (1 + h * V / D_C)
    assert aged.numpy() == pytest.approx(after.detach().numpy(), rel=1e-9)
    force = moving(V, after) * F_N
    (slope,) = torch.autograd.grad(force[slips].sum(), V)
    left = ((dashpot * V + force) / E - 1).detach()
    assert float(left[slips].abs().max()) < 1e-9
    expected = (1 / (dashpot + slope)).detach()[slips]
    assert by_E[slips].numpy() == pytest.approx(expected.numpy(), rel=1e-8)
    assert by_E[~slips].count_nonzero() == 0


def test_static_friction_at_the_start_is_that_of_the_age_there():
    friction = AgeingSlip(0.6, 0.5, ageing=0.02, t_0=1e-3, age_0=0.3)
    assert friction.at_rest().item() == pytest.approx(0.6 + 0.02 * math.log(301.0), rel=1e-12)


# bodies on slopes

MU_S, MU_K, G = 0.8, 0.7, 9.81


BOX = """
[bodies.box]
mass = 0.15
shape = {kind = "rounded_box", half_width = 20e-3, half_height = 10e-3, radius = 4e-3}
start = {x = 0.0, y = 22e-3, theta = 0.0}
[materials.gel]
kind = "kelvin_voigt"
E = 0.15e6
nu = 0.45
tau = 1e-3
depth = 40e-3
[pads.ground]
material = "gel"
length = 160e-3
height = 12e-3
elements_x = 80
elements_y = 4
[laws.dry]
K_n = 5e4
R_n = 20.0
K_t = 5e4
R_t = 20.0
friction = {kind = "coulomb", mu_s = 0.8, mu_k = 0.7}
[contacts]
ground = {pad = "ground", body = "box", law = "dry"}
[outputs]
duration = 0.25
interval = 2e-3
"""
"""A box of 40 x 20 mm on a pad."""


def box(degrees: float, mass: float = 0.15, friction: str = "smooth", **springs: Any) -> RigFile:
    """On the pad tilted by an angle; everything stiff in proportion to the mass."""
    angle, k = math.radians(degrees), mass / 0.15
    # in the pad's own axes, at rest or near it
    place = complex(120e-3, 22.0e-3 - 9e-6) * complex(math.cos(angle), math.sin(angle))
    numbers = {"K_n": 5e4 * k, "R_n": 20.0 * k, "K_t": 5e4 * k, "R_t": 20.0 * k} | springs
    falls = {"v_s": 50e-3} if friction == "smooth" else {}
    return RigFile.from_tree(tomllib.loads(BOX)).override(
        {f"laws.dry.{name}": value for name, value in numbers.items()},
        bodies={"box": {"mass": mass, "start": {"x": place.real, "y": place.imag, "theta": angle}}},
        materials={"gel": {"E": 0.15e6 * k}}, pads={"ground": {"angle": angle}},
        laws={"dry": {"friction": {"kind": friction, "mu_s": MU_S, "mu_k": MU_K, **falls}}},
    )  # fmt: skip


def slid(run: Any, degrees: float) -> np.ndarray:
    """Way down the slope [m]."""
    slope = math.radians(degrees)
    x, y = (run[f"{axis}_box"] - run[f"{axis}_box"][0] for axis in "xy")
    return -(x * math.cos(slope) + y * math.sin(slope)).numpy()


@pytest.mark.parametrize(
    ("degrees", "mass", "friction"),
    [(30, 0.01, "coulomb"), (30, 3.0, "smooth"), (45, 3.0, "coulomb"), (45, 0.01, "smooth")],
)
def test_a_box_on_a_slope_does_as_coulomb_says(degrees, mass, friction):
    """It stays below arctan mu_s = 38.7 degrees; above it slides at g (sin - mu cos), less what the
    pad's viscosity takes, some 2 % of it at tau = 1 ms."""
    run = box(degrees, mass, friction).build().run()
    slope, down, t = math.radians(degrees), slid(run, degrees), run.t.numpy()
    F_N, F_T = run.force["ground"].unbind(-1)
    assert float((F_T.abs() - MU_S * F_N).max()) <= 1e-9
    late = t > 0.125
    if math.tan(slope) < MU_S:
        assert abs(down[-1] - down[late][0]) < 5e-6
        return
    slides, accelerates = np.polyfit(t[late], down[late], 2)[1::-1]
    v = slides + 2 * accelerates * t[late]
    mu = MU_K + (0.0 if friction == "coulomb" else float(((MU_S - MU_K) / (1 + v / 50e-3)).mean()))
    assert 2 * accelerates == pytest.approx(G * (math.sin(slope) - mu * math.cos(slope)), rel=0.04)


def test_friction_falls_no_faster_than_dashpots_of_law_and_pad_balance():
    """The instantaneous spring of a series has a dashpot of 0.1 ms only; a run in which points slip
    warns. A pad with a dashpot bounds nothing."""
    assert box(45).build().rig.contacts["ground"].law.friction.R_pad is None
    series = {"kind": "prony", "E": 0.15e6, "moduli": [0.15e6], "tau": [1.0], "depth": 0.04}
    built = box(45).override({"materials.gel": series | {"nu": 0.45}}).build()
    law = built.rig.contacts["ground"].law
    F_N, R_t, R_pad = 0.07, law.R_t.item(), law.friction.R_pad.item()
    over = law.friction.range(f64(F_N), law.R_t).item()
    assert over == pytest.approx((MU_S - MU_K) * F_N * (1 / R_t + 1 / R_pad), rel=1e-12)
    assert over > 100e-3
    with pytest.warns(UserWarning, match="over a larger slip speed than v_s"):
        run = built.run()
    late = run.t.numpy() > 0.125
    acceleration = 2 * np.polyfit(run.t.numpy()[late], slid(run, 45)[late], 2)[0]
    expected = G * (1 - MU_S) * math.sqrt(0.5)
    assert 0.98 * expected < acceleration < 1.6 * expected


# numbers of a law from its pad


def test_springs_and_dashpots_that_are_auto_follow_the_pad():
    """At the start, in place and where a law is extended; runs and derivatives with them are in
    `test_initial`."""
    file = box(20, **dict.fromkeys(("K_n", "R_n", "K_t", "R_t"), "auto"))
    assert not [one for one in check(file) if one.where == "contacts.ground"]
    built = file.build()
    law, E = built.rig.contacts["ground"].law, built.rig.parameter("materials.gel.E")
    K_n = law.K_n.item()
    spring = 10 * 0.15e6 / (1 - 0.45**2) * 40e-3 * 1e-3 / 2e-3  # elements of 2 mm, per mm
    assert K_n == pytest.approx(spring, rel=0.02)  # a point at either end has half of it
    assert law.K_t.item() == K_n
    assert law.R_n.item() == law.R_t.item() == pytest.approx(1e-3 * K_n)
    with torch.no_grad():
        E.mul_(4.0)
    with pytest.raises(ValueError, match=r"laws\.dry\.K_n` is \"auto\".*override"):
        built.rig.parameter("laws.dry.K_n")
    for _ in range(2):
        assert law.K_n.item() == pytest.approx(4 * K_n)
        extend(built.rig, ["laws.dry.K_n"])
    given = box(20, R_t="auto").build().rig.contacts["ground"].law
    assert given.R_t.item() == pytest.approx(1e-3 * 5e4)  # follows the spring that is given


def test_springs_and_loads_that_a_linear_pad_is_not_for_are_noted():
    (note,) = (one for one in check(box(20, K_n=5e3)) if "springs" in one.message)
    assert (note.severity, note.where) == ("note", "contacts.ground")
    heavy = box(0).override(bodies={"box": {"mass": 3.0, "start": {"y": "rest"}}})
    assert any(one.severity == "note" and "strains reach" in one.message for one in check(heavy))


def test_a_custom_law_with_a_viscosity_of_its_own_is_warned_about():
    built = box(20).build()
    law = built.rig.contacts["ground"].law
    del law.friction
    law.friction = lambda E, F_N, R: (E - 0.5 * F_N).clamp(min=0.0) / (R + 10.0)
    with pytest.warns(UserWarning, match="where nothing presses"):
        built.run(t=built.t[:2])
