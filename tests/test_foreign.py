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
from foreign.pad import compliance
from foreign.step import CREEP, TAKEN_IN, node

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
            p, h, 0.0, 0.0, v / (p.radius - depth), 0.0, -(p.radius - depth), s, slipping
        )
        F_N = p.K_n * depth
        e = p.K_t * stretch + p.R_t * v
        assert -fy == pytest.approx(F_N)
        assert stretch == pytest.approx(s + h * v)
        assert slips == (abs(e) > p.mu_s * F_N)
        e = p.mu_k * F_N * v / np.hypot(v, CREEP) if slipping else e
        assert fx == pytest.approx(e * depth / (depth + TAKEN_IN))
        assert torque == pytest.approx(-(p.radius - depth) * fx)


OTHERS = (
    {"across": 120, "through": 6},
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
