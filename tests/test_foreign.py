"""The stranger's simulator: it shares nothing with torchsoft, agrees with it where the assumptions
are the same, and each of its own ways does what it says."""

import ast
from functools import cache
from itertools import product
from pathlib import Path

import foreign
import numpy as np
import pytest
import torch
from conftest import PAPER, excited
from foreign import Numbers, Run
from foreign.motion import lying, pads
from foreign.pad import compliance
from foreign.step import CREEP, SAMPLED_AT, TAKEN_IN, aged, friction, march, node

from torchsoft import BuiltRig, PadMesh, Trajectory, simulate
from torchsoft.physics.mesh import unit_compliance
from torchsoft.rigs.excite import Excitation

SETTLE, STEP = 0.02, 12.5e-6
SINES = {"kind": "multi_sine", "band": (5.0, 20.0)}
SHAKEN = Excitation(
    SINES | {"amplitude": 10e-3, "seed": 5},  # most others part more suddenly: smaller steps
    SINES | {"amplitude": 2e-4, "seed": 1},
    duration=0.36, depth=2e-4, grasp=0.04, since=0.05, grip=-1e-4,  # clear, as the stranger's is
)  # fmt: skip
RIG = {
    "pad.elements_x": 60,
    "pad.elements_y": 3,
    "contact.v_s": 0.05,
    "contact.mu_s": 0.6,
    "contact.mu_k": 0.4,
}
OWN = Numbers(across=60, through=3, mu_s=0.6, mu_k=0.4, x_C0=60.3e-3, senses_disc=False)
POSES = ("x_C", "y_C", "theta", "x_Br", "y_Br")
CHANNELS = (*POSES, "v_x", "omega", "F_x", "F_y")


@cache
def begun() -> BuiltRig:
    return excited(SHAKEN, PAPER.override(RIG))


@cache
def strange(step: float, p: Numbers = OWN) -> Run:
    """The stranger's run, rows every millisecond; it begins shortly before the reference does."""
    t = step * np.arange(-round(SETTLE / step), round(SHAKEN.duration / step) + 1)
    signals = begun().rig.reference(torch.from_numpy(t), ("x_d", "y_d", "F_ff")).detach().numpy()
    return foreign.simulate(p, t, signals, round(1e-3 / step))


@cache
def ours() -> Trajectory:
    model, y0, _ = begun()
    return simulate(model, torch.from_numpy(strange(STEP).t), y0=y0, rtol=1e-7)


def apart(own: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest difference from torchsoft's run over the channel's range."""
    return {
        c: float(np.abs(own[c] - ours()[c].numpy()).max() / np.ptp(ours()[c].numpy()))
        for c in CHANNELS
    }


def test_it_imports_nothing_of_torchsoft():
    for path in Path(foreign.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text())
        names = []
        for one in ast.walk(tree):
            if isinstance(one, ast.Import):
                names += [alias.name for alias in one.names]
            elif isinstance(one, ast.ImportFrom):
                names.append(one.module or "")
        allowed = {"foreign", "numpy", "scipy", "numba", "typing"}
        assert {name.split(".")[0] for name in names} <= allowed, path


def test_pads_are_as_soft():
    """Kronecker products of bars and an assembly element by element are the same integrals; their
    solves differ by rounding."""
    mesh = PadMesh(OWN.length, OWN.height, OWN.across, OWN.through)
    C = unit_compliance(mesh, OWN.nu)[0] / (OWN.E * OWN.depth)
    np.testing.assert_allclose(compliance(OWN), C, rtol=0, atol=1e-10 * C.max())


@pytest.mark.slow
def test_motions_agree_with_equal_assumptions():
    """Halving the step halves the difference from torchsoft; of two runs extrapolated to no step at
    all, poses are within 1e-4 of their ranges and rates and forces within 1e-3, slip of 0.1 m/s and
    touching and parting nodes included."""
    coarse, fine = strange(2 * STEP), strange(STEP)
    first, second = apart(coarse.channels), apart(fine.channels)
    limit = apart({c: 2 * fine.channels[c] - coarse.channels[c] for c in CHANNELS})
    assert fine.slip.max() > 0.1
    assert len(set(fine.touching)) > 4
    for c in CHANNELS:
        assert second[c] < 2e-3, c
        assert first[c] / second[c] == pytest.approx(2.0, abs=0.15), c
        assert limit[c] < (1e-4 if c in POSES else 1e-3), c


@pytest.mark.parametrize("slipping", [False, True])
def test_the_literal_law(slipping):
    """A spring and a dashpot from the place of first contact; once the force in them has been above
    mu_s F_N, mu_k F_N against the sliding, and the spring goes on stretching."""
    p, h, depth = OWN._replace(literal=True), STEP, 5e-5
    for v, s in product((0.02, -0.02), (1e-6, 1e-3)):
        fx, fy, torque, stretch, slips, _ = node(
            p, h, 0.0, 0.0, v / (p.radius - depth), 0.0, -(p.radius - depth), s, slipping,
            p.mu_s, p.mu_k,
        )  # fmt: skip
        F_N = p.K_n * depth
        e = p.K_t * stretch + p.R_t * v
        assert -fy == pytest.approx(F_N)
        assert stretch == pytest.approx(s + h * v)
        assert slips == (abs(e) > p.mu_s * F_N)
        e = p.mu_k * F_N * v / np.hypot(v, CREEP) if slipping else e
        assert fx == pytest.approx(e * depth / (depth + TAKEN_IN))
        assert torque == pytest.approx(-(p.radius - depth) * fx)


OTHERS = (
    pytest.param({"across": 120, "through": 6}, marks=pytest.mark.slow),
    {"literal": True},
    {"x_C0": 60.34e-3},
)


@pytest.mark.parametrize("differs", OTHERS)
def test_what_may_differ_makes_a_difference(differs):
    """More than sensors of 10 um and 0.1 N overlook."""
    own, other = strange(2 * STEP).channels, strange(2 * STEP, OWN._replace(**differs)).channels
    assert (
        max(
            np.abs(own["F_x"] - other["F_x"]).max() / 0.1,
            np.abs(own["x_C"] - other["x_C"]).max() / 1e-5,
        )
        > 1
    )


REST = OWN._replace(senses_disc=True, through=2, length=0.03, x_C0=0.015, across=120)
"""A rig whose disc lies on the lower pad, of a fine mesh, while the bracket hangs far above it."""


def hanging(p: Numbers, duration: float, step: float = 1e-4, pull: float = 0.0) -> Run:
    """A run of the disc alone, every step a row; the bracket's set-points are at rest, and a force
    `pull` [N] is fed forward after a tenth of the time."""
    t = step * np.arange(round(duration / step) + 1)
    signals = np.zeros((len(t), 3, 2))
    signals[:, 0, 0], signals[:, 1, 0] = p.x_C0, 0.1
    signals[len(t) // 10 :, 2, 0] = pull
    return foreign.simulate(p, t, signals)


def asked(p: Numbers, run: Run, pull: float) -> tuple[np.ndarray, np.ndarray]:
    """What the controllers of `hanging` ask for, from poses and speeds."""
    c = run.channels
    x, v_x = (c["x_C"], c["v_x"]) if p.senses_disc else (c["x_Br"], c["v_x_Br"])
    ahead = np.where(np.arange(len(run.t)) >= len(run.t) // 10, pull, 0.0)
    return (
        p.K_x * (p.x_C0 - x) - p.R_x * v_x,
        p.K_y * (0.1 - c["y_Br"]) - p.R_y * c["v_y_Br"] + ahead,
    )


EARLIER = dict(
    zip(
        CHANNELS,
        (
            0.06022772909039153, 0.023788677566176177, 0.0036656406875290536, 0.06029982266772645,
            0.04981009423610709, 9.298627197842102e-05, -0.006577024454883856,
            -0.005980270989445563, -5.802844217471285,
        ),
    )
)  # fmt: skip
"""After 30 ms of the reference, which begins to roll the disc under the upper pad, as computed
before anything but the mesh, the law and the start could differ."""


def test_nothing_differs_by_default():
    found = strange(4 * STEP).channels
    for c, value in EARLIER.items():
        assert found[c][50] == pytest.approx(value, rel=1e-8), c


@pytest.mark.parametrize(
    "idle",
    [{"F_x_most": 1e6, "F_y_most": 1e6}, {"ageing_time": 1.0, "renewed": 1e-3}, {"slow_tau": 0.3}],
)
def test_what_is_idle_changes_no_bit(idle):
    p = OWN._replace(**idle)
    own, other = strange(4 * STEP).channels, strange(4 * STEP, p).channels
    assert all(np.array_equal(own[c], other[c]) for c in CHANNELS)


def test_friction_of_the_upper_contact_wear_and_age():
    p = OWN._replace(upper_friction=1.03, ageing=0.02, ageing_time=0.01)
    assert friction(p, 0, 0.0, 1.0) == pytest.approx((p.mu_s, p.mu_k))
    assert friction(p, 1, 0.0, 1.0) == pytest.approx((1.03 * p.mu_s, 1.03 * p.mu_k))
    assert friction(p, 0, 0.0, 0.9) == pytest.approx((0.9 * p.mu_s, 0.9 * p.mu_k))
    aged_s = p.mu_s + 0.02 * np.log(11.0)
    assert friction(p, 0, 0.1, 1.0) == pytest.approx((aged_s, p.mu_k))


def test_age_grows_at_rest_and_goes_with_slip():
    p, age = OWN, 0.0
    for _ in range(100):
        age = aged(p, 1e-4, age, 0.0)
    assert age == pytest.approx(1e-2)
    for _ in range(100):  # 1 mm of slip in 10 ms: what is left is the time of a slip of `renewed`
        age = aged(p, 1e-4, age, 0.1)
    assert age == pytest.approx(p.renewed / 0.1)


def test_friction_of_a_run_wears():
    """A node's friction in the middle of a run is that of a rig with so much less."""
    worn, less = OWN._replace(wear=0.2), OWN._replace(mu_s=0.5 * OWN.mu_s, mu_k=0.5 * OWN.mu_k)
    own, little, most = (strange(4 * STEP, p).channels["x_C"] for p in (OWN, worn, less))
    assert 0 < np.abs(little - own).max() < np.abs(most - own).max()


def test_centre_of_mass_flies_straight():
    """Without contact the centre of mass falls as a point does, the spin stays, and the contour's
    centre goes round it."""
    p, h, spin, steps = OWN._replace(com_x=2e-3, com_y=-1e-3), 1e-5, 20.0, 2000
    X, C, share = pads(p)
    q, v = np.array([0.06, 1.0, 0.3, 0.06, 3.0]), np.array([0.4, 0.5, spin, 0.0, 0.0])
    signals = np.zeros((steps + 1, 3, 2))
    signals[:, 0, 0], signals[:, 1, 0] = 0.06, 3.0
    u = np.zeros_like(X)

    def centre_of_mass(theta):
        c, s = np.cos(theta), np.sin(theta)
        return p.com_x * c - p.com_y * s, p.com_x * s + p.com_y * c

    x0, y0 = centre_of_mass(0.3)
    v0 = np.array([0.4 - spin * y0, 0.5 + spin * x0])  # of the centre of mass
    rows, lost = march(p._replace(senses_disc=False), h, C, X, share, q, v, u, signals, 1)
    t = h * np.arange(steps + 1)
    x, y = centre_of_mass(rows[:, 2])
    assert lost == -1
    np.testing.assert_allclose(rows[:, 7], spin, rtol=1e-12)
    # the contour's centre is moved by its end-of-step speed: an error of first order
    np.testing.assert_allclose(rows[:, 0] + x, 0.06 + x0 + v0[0] * t, atol=5e-6 * 2)
    fall = 1.0 + y0 + v0[1] * t - 0.5 * p.gravity * t**2
    np.testing.assert_allclose(rows[:, 1] + y, fall, atol=5e-6 * 2)


def test_a_weight_off_the_centre_rocks():
    """On a hard pad the disc rocks about the place where its weight is lowest, at the rate of a
    pendulum that rolls."""
    c = 2e-3
    p = REST._replace(com_x=0.05 * c, com_y=-c, E=50e6, tau=1e-4, R_n=30.0, R_t=30.0)
    run = hanging(p, 1.3, 2e-4)
    inertia = p.mass * (0.5 * p.radius**2 + (p.radius - c) ** 2)
    theta = run.channels["theta"] + 0.05
    crossings = run.t[1:][np.diff(np.sign(theta)) != 0]
    assert len(crossings) > 2
    rate = np.pi / np.diff(crossings).mean()
    assert rate == pytest.approx((p.mass * p.gravity * c / inertia) ** 0.5, rel=0.03)


def test_adhesion_draws_and_friction_goes_by_what_presses():
    p, depth, h = OWN._replace(adhesion=0.02), 5e-5, STEP
    drawn = p.adhesion * depth / (depth + TAKEN_IN)
    for v in (0.0, 1.0):
        at = (0.0, 0.0, v / (p.radius - depth), 0.0, -(p.radius - depth), 0.0, False, 0.6, 0.4)
        own, other = node(OWN, h, *at), node(p, h, *at)
        assert other[0] == own[0]
        assert other[1] == pytest.approx(own[1] + drawn)
    p = REST._replace(adhesion=0.02)
    X, C, share = pads(p)
    y, _ = lying(p, C[0], X, share)
    assert y < lying(REST, C[0], X, share)[0] - 1e-8
    run = hanging(p, 0.02)
    assert run.channels["y_C"] == pytest.approx(y, abs=1e-9)


def test_pads_of_another_height_and_length():
    """Without lateral contraction a pad under a uniform load is a spring of its height; surfaces
    stay."""
    p = OWN._replace(nu=0.0, thicker=1.1, thicker_U=0.9, upper=1.25, longer=1.05)
    X, C, share = pads(p)
    length = p.longer * p.length
    force = np.zeros((len(share), 2))
    force[:, 1] = share * p.spacing * p.depth  # 1 Pa
    for k, height in enumerate((1.1 * p.height, 0.99 * p.height / 1.25)):
        u = (C[k] @ force.ravel()).reshape(-1, 2)
        np.testing.assert_allclose(u[:, 1], height / p.E, rtol=1e-9)
        assert np.ptp(X[k, :, 0]) == pytest.approx(length)
    own = pads(OWN)[0]
    assert (X[:, :, 1] == own[:, :, 1]).all()
    assert (X[:, 0] == own[:, 0]).all()
    assert share.sum() == pytest.approx(length / p.spacing)


def test_pads_that_are_tilted():
    """A force along the turned normal does what one along the normal does, turned."""
    p, a = OWN._replace(tilt_L=0.02, tilt_U=-0.01), 40
    X, C, share = pads(p)
    flat, C_flat, _ = pads(OWN)
    for k, tilt in enumerate((0.02, -0.01)):
        R = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
        for direction in np.eye(2):
            f, f_flat = np.zeros((2, len(share), 2))
            f[a], f_flat[a] = R @ direction, direction
            u, u_flat = (
                (one @ x.ravel()).reshape(-1, 2) for one, x in ((C[k], f), (C_flat[k], f_flat))
            )
            np.testing.assert_allclose(u, u_flat @ R.T, atol=1e-12 * np.abs(u).max())
        middle = len(share) // 2
        np.testing.assert_allclose(X[k, middle], flat[k, middle], atol=1e-15)
        along = X[k, -1] - X[k, 0]
        assert np.arctan2(along[1], along[0]) == pytest.approx(tilt)


def test_a_tilted_pad_is_a_turned_gravity():
    """To first order the disc rolls down a pad as it does along a level one in a gravity turned
    the other way, by half of a fall along the slope over 1.5 masses; but for the mesh, which it
    feels."""
    pad, weight = (
        hanging(REST._replace(**one), 0.1) for one in ({"tilt_L": -1e-3}, {"tilt": 1e-3})
    )
    down, along = (run.channels["x_C"][-1] - REST.x_C0 for run in (pad, weight))
    assert down == pytest.approx(along, rel=0.05)
    assert 0.8 < along / (0.5 * 9.81e-3 / 1.5 * 0.1**2) < 1.0


def test_compliance_that_sets_in_at_once():
    """All of it: pads with a retardation time of a microsecond. A part of it lies between."""
    at_once, fast, part, slow = (
        hanging(REST._replace(adhesion=0.05, softening=0.5, **one), 0.02).channels
        for one in ({"fast": 1.0}, {"tau": 1e-6}, {"fast": 0.5}, {})
    )
    for c in CHANNELS:
        np.testing.assert_allclose(at_once[c], fast[c], rtol=0, atol=1e-10)
    assert at_once["y_C"][-1] < part["y_C"][-1] < slow["y_C"][-1]


PULL = 5.0
"""Force [N] that is fed forward to the bracket."""


def test_a_controller_that_is_late():
    """By whole steps, and by parts of one."""
    for delay, back in ((5e-4, 5), (2.5e-4, 2.5), (0.4e-4, 0.4)):
        p = REST._replace(delay=delay)
        run = hanging(p, 0.03, pull=PULL)
        for name, force in zip(("F_x", "F_y"), asked(p, run, PULL)):
            i = np.arange(len(force)) - back
            late = np.interp(i, np.arange(len(force)), force)
            np.testing.assert_allclose(run.channels[name], late, atol=1e-7)
        assert np.ptp(run.channels["F_y"]) > 1.0


def test_a_controller_that_lags():
    p, h = REST._replace(lag=5e-4), 1e-4
    run = hanging(p, 0.03, h, PULL)
    for name, force in zip(("F_x", "F_y"), asked(p, run, PULL)):
        F = run.channels[name]
        np.testing.assert_allclose(np.diff(F) / h, (force[1:] - F[1:]) / p.lag, atol=1e-2)


def test_a_controller_that_holds():
    p, h = REST._replace(hold=1e-3), 1e-4
    run = hanging(p, 0.03, h, PULL)
    first = round(SAMPLED_AT * p.hold / h)
    for name, force in zip(("F_x", "F_y"), asked(p, run, PULL)):
        F = run.channels[name]
        for i in range(first, len(F) - 10, 10):
            np.testing.assert_allclose(F[i + 1 : i + 11], force[i], atol=1e-7)


def test_a_controller_that_is_limited():
    p = REST._replace(F_y_most=1.0)
    run = hanging(p, 0.03, pull=PULL)
    force = asked(p, run, PULL)[1]
    assert np.abs(force).max() > 1.5
    np.testing.assert_allclose(run.channels["F_y"], np.clip(force, -1.0, 1.0), atol=1e-7)


def test_pads_that_soften():
    """By the end of a slow run the disc, without friction, lies as deep as on pads of what is left
    of E."""
    p = REST._replace(softening=0.2, mu_s=0.0, mu_k=0.0)
    X, C, share = pads(p)
    run = hanging(p, 2.0, 1e-3)
    begin, end = (lying(p, scale * C[0], X, share)[0] for scale in (1.0, 1 / 0.8))
    assert run.channels["y_C"][0] == begin
    # retardation of 10 ms of 2 s leaves it half a percent behind
    assert run.channels["y_C"][-1] - begin == pytest.approx(0.995 * (end - begin), rel=5e-3)
