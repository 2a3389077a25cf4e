"""The independent simulator: it shares nothing with torchsoft and agrees with it where the
assumptions are equal; each of its deviations does what its name says."""

import ast
import re
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import PAPER, excited

from experiments.validation import foreign
from experiments.validation.foreign import Numbers, Run
from experiments.validation.foreign.motion import lying, pads
from experiments.validation.foreign.pad import compliance
from experiments.validation.foreign.step import CREEP, SAMPLED_AT, TAKEN_IN, aged, friction, node
from torchsoft import BuiltRig, PadMesh, Trajectory, simulate
from torchsoft.physics.mesh import unit_compliance
from torchsoft.rigs.excite import Excitation

SETTLE, STEP = 0.02, 12.5e-6
SINES = {"kind": "multi_sine", "band": (5.0, 20.0)}
SHAKEN = Excitation(
    SINES | {"amplitude": 10e-3, "seed": 5}, SINES | {"amplitude": 2e-4, "seed": 1},
    duration=0.36, depth=2e-4, grasp=0.04, since=0.05, grip=-1e-4,
)  # fmt: skip
RIG = {
    "pad.elements_x": 60, "pad.elements_y": 3, "contact.v_s": 0.05, "contact.mu_s": 0.6,
    "contact.mu_k": 0.4,
}  # fmt: skip
OWN = Numbers(across=60, through=3, mu_s=0.6, mu_k=0.4, x_C0=60.3e-3, senses_disc=False)
POSES = ("x_C", "y_C", "theta", "x_Br", "y_Br")
CHANNELS = (*POSES, "v_x", "omega", "F_x", "F_y")
SAMPLES = 60, 120, 200, 280, 340
"""Rows, one each millisecond, of the table below."""
LIMIT = {
    "x_C": [0.06022815219, 0.05955843049, 0.06118673714, 0.05967242798, 0.05896818915],
    "y_C": [0.02377408228, 0.02376774732, 0.02377404756, 0.02375685934, 0.02375898734],
    "theta": [0.003638192196, 0.0387016892, -0.04704600951, 0.03341191835, 0.06963535812],
    "x_Br": [0.06029995951, 0.05892491515, 0.06227108211, 0.06170224726, 0.06031649943],
    "y_Br": [0.04978241255, 0.04977766913, 0.04980999861, 0.04975079502, 0.04977489137],
    "v_x": [1.277959973e-05, -0.05810415801, -0.01591339928, 0.01728215103, -0.001297644377],
    "omega": [-0.0004641628915, 2.972803826, 0.83926732, -0.8202321997, 0.06207284318],
    "F_x": [0.008752493141, 0.1078849534, 0.3498078095, -8.861599302, -0.5451171763],
    "F_y": [-5.053474092, -5.009118166, -4.156979339, -7.901984961, -4.580841441],
}  # fmt: skip
"""The independent simulator's run, extrapolated to steps of zero length."""


@cache
def built() -> BuiltRig:
    return excited(SHAKEN, PAPER.override(RIG))


@cache
def independent(step: float, p: Numbers = OWN) -> Run:
    """Rows every millisecond; it starts shortly before the reference does."""
    t = step * np.arange(-round(SETTLE / step), round(SHAKEN.duration / step) + 1)
    signals = built().rig.reference(torch.from_numpy(t), ("x_d", "y_d", "F_ff")).detach().numpy()
    return foreign.simulate(p, t, signals, round(1e-3 / step))


def ours(rtol: float) -> Trajectory:
    model, y0, _ = built()
    return simulate(model, torch.arange(-20, 361).double() * 1e-3, y0=y0, rtol=rtol)


def test_motions_agree_with_those_of_an_independent_simulator():
    run = ours(1e-5)
    for c, values in LIMIT.items():
        off = np.abs(run[c].numpy()[[*SAMPLES]] - values).max() / np.ptp(run[c].numpy())
        assert off < (2e-4 if c in POSES else 3e-3), c


@pytest.mark.slow
def test_the_independent_simulator_converges_to_the_same_motion():
    """Halving its step halves the difference from torchsoft; extrapolated to no step at all, poses
    are within 1e-4 of their ranges, rates and forces within 1e-3, slip of 0.1 m/s included."""
    coarse, fine = independent(2 * STEP), independent(STEP)
    run = ours(1e-7)
    limit = {c: 2 * fine.channels[c] - coarse.channels[c] for c in CHANNELS}
    first, second, last = (
        {c: float(np.abs(x[c] - run[c].numpy()).max() / np.ptp(run[c].numpy())) for c in CHANNELS}
        for x in (coarse.channels, fine.channels, limit)
    )
    assert fine.slip.max() > 0.1
    assert len(set(fine.touching)) > 4
    for c in CHANNELS:
        assert second[c] < 2e-3, c
        assert first[c] / second[c] == pytest.approx(2.0, abs=0.15), c
        assert last[c] < (1e-4 if c in POSES else 1e-3), c
        assert limit[c][[*SAMPLES]] == pytest.approx(LIMIT[c], rel=1e-8), c


def test_it_shares_nothing_with_torchsoft_and_its_pads_are_as_soft():
    """Kronecker products of bars and an assembly element by element are the same integrals."""
    allowed = re.compile(rf"({re.escape(foreign.__name__)}|numpy|scipy|numba|typing)(\.|$)")
    for path in Path(foreign.__file__).parent.glob("*.py"):
        for one in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in one.names] if isinstance(one, ast.Import) else []
            names += [one.module or ""] if isinstance(one, ast.ImportFrom) else []
            assert all(map(allowed.match, names)), path
    mesh = PadMesh(OWN.length, OWN.height, OWN.across, OWN.through)
    C = unit_compliance(mesh, OWN.nu)[0] / (OWN.E * OWN.depth)
    np.testing.assert_allclose(compliance(OWN), C, rtol=0, atol=1e-10 * C.max())


# its deviations
# ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("slipping", [False, True])
def test_the_literal_law(slipping):
    """A spring and a dashpot from the place of first contact; once the force in them has been above
    mu_s F_N, mu_k F_N against the sliding, and the spring goes on stretching."""
    p, h, depth = OWN._replace(literal=True), STEP, 5e-5
    for v, s in product((0.02, -0.02), (1e-6, 1e-3)):
        fx, fy, torque, stretch, slips, _ = node(
            p, h, 0.0, 0.0, 0.0, v / (p.radius - depth), 0.0, -(p.radius - depth), s, slipping,
            p.mu_s, p.mu_k,
        )  # fmt: skip
        F_N, e = p.K_n * depth, p.K_t * stretch + p.R_t * v
        assert -fy == pytest.approx(F_N)
        assert stretch == pytest.approx(s + h * v)
        assert slips == (abs(e) > p.mu_s * F_N)
        e = p.mu_k * F_N * v / np.hypot(v, CREEP) if slipping else e
        assert fx == pytest.approx(e * depth / (depth + TAKEN_IN))
        assert torque == pytest.approx(-(p.radius - depth) * fx)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("differs", "matters"),
    [
        ({"across": 120, "through": 6}, True),
        ({"literal": True}, True),
        ({"x_C0": 60.34e-3}, True),
        ({"wear": 0.2}, True),
        ({"F_x_most": 1e6, "F_y_most": 1e6}, False),
        ({"ageing_time": 1.0, "renewed": 1e-3}, False),
        ({"slow_tau": 0.3}, False),
    ],
)
def test_a_deviation_exceeds_the_sensors_or_changes_no_bit(differs, matters):
    """Sensors of 10 um and 0.1 N."""
    own, other = (independent(2 * STEP, p).channels for p in (OWN, OWN._replace(**differs)))
    off = {c: np.abs(own[c] - other[c]).max() for c in CHANNELS}
    assert max(off["F_x"] / 0.1, off["x_C"] / 1e-5) > 1 if matters else not any(off.values())


REST = OWN._replace(senses_disc=True, through=2, length=0.03, x_C0=0.015, across=120)
"""The disc lies on the lower pad, of a fine mesh, while the bracket hangs far above it."""
PULL = 5.0
"""Force [N] that is fed forward to the bracket after a tenth of the time."""


def hanging(p: Numbers, duration: float, step: float = 1e-4, pull: float = 0.0) -> Run:
    """A run of the disc alone, every step a row; the bracket's set-points are at rest."""
    t = step * np.arange(round(duration / step) + 1)
    signals = np.zeros((len(t), 3, 2))
    signals[:, 0, 0], signals[:, 1, 0] = p.x_C0, 0.1
    signals[len(t) // 10 :, 2, 0] = pull
    return foreign.simulate(p, t, signals)


def late(back: float):
    return lambda f: np.interp(np.arange(len(f)) - back, np.arange(len(f)), f)


def lagging(f: np.ndarray) -> np.ndarray:
    """Backward Euler's steps of a fifth of the lag."""
    out = f.copy()
    for i in range(1, len(f)):
        out[i] = (out[i - 1] + 0.2 * f[i]) / 1.2
    return out


def held(f: np.ndarray) -> np.ndarray:
    """Samples every ten steps, taken after a part of the period."""
    first = round(10 * SAMPLED_AT)
    return f[np.maximum(first + 10 * ((np.arange(len(f)) - first - 1) // 10), 0)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("deviation", "of"),
    [
        ({"delay": 5e-4}, late(5)),
        ({"delay": 2.5e-4}, late(2.5)),
        ({"delay": 0.4e-4}, late(0.4)),
        ({"lag": 5e-4}, lagging),
        ({"hold": 1e-3}, held),
        ({"F_x_most": 1.0, "F_y_most": 1.0}, lambda f: np.clip(f, -1.0, 1.0)),
    ],
)
def test_a_controller_that_deviates(deviation, of):
    p = REST._replace(**deviation)
    c = hanging(p, 0.03, pull=PULL).channels
    ahead = np.where(np.arange(301) >= 30, PULL, 0.0)
    asked = {
        "F_x": p.K_x * (p.x_C0 - c["x_C"]) - p.R_x * c["v_x"],
        "F_y": p.K_y * (0.1 - c["y_Br"]) - p.R_y * c["v_y_Br"] + ahead,
    }
    for name, force in asked.items():
        np.testing.assert_allclose(c[name][10:], of(force)[10:], atol=2e-6)
    assert np.ptp(c["F_y"]) > 1.0


@pytest.mark.slow
def test_friction_of_the_upper_contact_wear_and_age():
    """Age grows at rest, and goes with slip until the time of a slip of `renewed` is left."""
    p = OWN._replace(upper_friction=1.03, ageing=0.02, ageing_time=0.01)
    assert friction(p, 0, 0.0, 1.0) == pytest.approx((p.mu_s, p.mu_k))
    assert friction(p, 1, 0.0, 0.9) == pytest.approx((0.927 * p.mu_s, 0.927 * p.mu_k))
    assert friction(p, 0, 0.1, 1.0) == pytest.approx((p.mu_s + 0.02 * np.log(11.0), p.mu_k))
    age = 0.0
    for speed, expected in ((0.0, 1e-2), (0.1, p.renewed / 0.1)):
        for _ in range(100):
            age = aged(p, 1e-4, age, speed)
        assert age == pytest.approx(expected)


@pytest.mark.slow
def test_a_weight_off_the_centre_rocks():
    """On a hard pad the disc rocks about the place where its weight is lowest, at the rate of a
    pendulum that rolls."""
    c = 2e-3
    p = REST._replace(com_x=0.05 * c, com_y=-c, E=50e6, tau=1e-4, R_n=30.0, R_t=30.0)
    run = hanging(p, 1.3, 2e-4)
    inertia = p.mass * (0.5 * p.radius**2 + (p.radius - c) ** 2)
    crossings = run.t[1:][np.diff(np.sign(run.channels["theta"] + 0.05)) != 0]
    assert len(crossings) > 2
    rate = np.pi / np.diff(crossings).mean()
    assert rate == pytest.approx((p.mass * p.gravity * c / inertia) ** 0.5, rel=0.03)


@pytest.mark.slow
def test_a_tilted_pad_is_a_turned_gravity():
    """To first order the disc rolls down a pad as it does along a level one in a gravity turned
    the other way, by half of a fall along the slope over 1.5 masses, less by the mesh."""
    down, along = (
        hanging(REST._replace(**one), 0.1).channels["x_C"][-1] - REST.x_C0
        for one in ({"tilt_L": -1e-3}, {"tilt": 1e-3})
    )
    assert down == pytest.approx(along, rel=0.05)
    assert 0.8 < along / (0.5 * 9.81e-3 / 1.5 * 0.1**2) < 1.0


@pytest.mark.slow
def test_pads_that_soften():
    """By the end of a slow run the disc, without friction, lies as deep as on pads of what is left
    of E; retardation of 10 ms of 2 s leaves it half a percent behind."""
    p = REST._replace(softening=0.2, mu_s=0.0, mu_k=0.0)
    X, C, share = pads(p)
    y = hanging(p, 2.0, 1e-3).channels["y_C"]
    start, end = (lying(p, scale * C[0], X, share)[0] for scale in (1.0, 1 / 0.8))
    assert y[0] == start
    assert y[-1] - start == pytest.approx(0.995 * (end - start), rel=5e-3)
