"""The independent simulator: it shares nothing with torchsoft and agrees with it where the
assumptions are equal; what its deviations do is measured in `experiments/validation/suspects`."""

import ast
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import PAPER, excited

from experiments.validation import foreign
from experiments.validation.foreign import Numbers, Run
from experiments.validation.foreign.pad import compliance
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
