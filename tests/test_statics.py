"""Statics: the experiment at smoke size, and a long box lying flat as a flat punch of another
finite-element program."""

import json

import numpy as np
import pytest
import torch
from conftest import PAPER, f64, holding_force, press, still
from fem_oracle import dilatation, shear, world_stiffness
from skfem import Basis, ElementQuad2, ElementVector, MeshQuad, condense, solve
from test_experiments import experiment

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    RoundedBox,
    SmoothSlip,
    SoftContact,
)
from torchsoft.physics.mesh import lame_moduli
from torchsoft.physics.state import State
from torchsoft.physics.statics import resting


@pytest.fixture(scope="module")
def statics():
    return experiment("statics")


@pytest.fixture(scope="module")
def result(statics, tmp_path_factory):
    return statics.run(statics.Config(out=tmp_path_factory.mktemp("statics"), smoke=True))


def test_the_full_grasp(statics, result):
    grasp = statics.full_grasp(result.meshes)["120 x 4"]
    assert grasp["force_N"] == pytest.approx(70.16, abs=0.01)
    assert grasp["y_C_mm"] == pytest.approx(
        23.20, abs=0.005
    )  # the paper's, to the digits it prints
    assert grasp["penetration_um"] == pytest.approx(82.2, abs=0.1)
    assert grasp["half_width_mm"] == pytest.approx(5.31, abs=0.01)
    assert grasp["nodes_touching"] == 11


def test_the_force_converges_in_mesh_and_penalty(statics, result):
    # two curves and the expected order already foretell the limits of the whole experiment (70.54
    # and 79.33 N)
    assert result.families["mesh"].limit == pytest.approx(70.54, rel=2e-3)
    assert result.families["penalty"].limit == pytest.approx(79.33, rel=5e-3)
    for curves, name, off in ((result.meshes, "60 x 2", 0.0141), (result.penalties, "1", 0.0869)):
        assert statics.full_grasp(curves)[name]["to the next"] == pytest.approx(off, abs=1e-4)


def test_force_and_contact_grow_with_compression(result):
    for curve in (*result.meshes.values(), *result.penalties.values()):
        for grows in (curve.force, curve.half_width, curve.penetration, -curve.y_C):
            assert bool((grows.diff() > 0).all())
        assert bool((curve.touching.diff() >= 0).all())
        assert float(curve.compression[-1]) == pytest.approx(1.5e-3, abs=1e-15)


def test_files(statics, result):
    numbers = json.loads(json.dumps(statics.summary(result), allow_nan=False))
    same = numbers["mesh"]["full_grasp"]["120 x 4"], numbers["penalty"]["full_grasp"]["1"]
    assert same[0]["force_N"] == same[1]["force_N"]
    assert numbers["mesh"]["full_grasp"]["60 x 2"]["nodes_touching"] == 5
    assert len(numbers["mesh"]["curves"]["120 x 4"]["force"]) == 3
    assert statics.table(result).splitlines()[2].startswith("| 60 x 2 | 69.175 |")


# --- a flat punch
# ----------------------------------------------------------------------

PUNCH = RoundedBox(half_width=15.5e-3, half_height=10e-3, radius=1e-3)
FLAT = 14.5e-3
"""Half of its flat side [m]."""
DEPTH = 1e-4
"""By how much [m] it is pressed into each of two pads."""


PAD, RUBBER = PAPER.pads["L"], PAPER.materials["rubber"]


def punched(K_n: float, elements_x: int) -> tuple[Rig, State, float]:
    """The box pressed between the pads without weight; the force [N] on the bracket."""
    changes = {"gravity": 0.0, "contact.K_n": K_n}
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    model = still(changes | mesh, shape=PUNCH)
    y = press(model, 2 * (PAD.height + 10e-3 - DEPTH) + 2.18e-3).detach()
    return model, model.unpack(y), holding_force(model, y)


def test_a_long_box_is_a_flat_punch_on_springs():
    """On the same mesh, assembled by scikit-fem, with a spring K_n between each node under the flat
    side and the box."""
    model, state, force = punched(1.2e5, 120)
    nodes, K = world_stiffness(model.pads["L"])
    under = np.flatnonzero((nodes[:, 1] == PAD.height) & (np.abs(nodes[:, 0] - 60e-3) < FLAT))
    springs = 1.2e5 * np.bincount(2 * under + 1, minlength=len(K))
    depth = PAD.height - (float(state.pose["disc"][1]) - 10e-3)
    u = np.linalg.solve(K + np.diag(springs), -depth * springs)
    carried = springs * (depth + u)
    assert depth == pytest.approx(DEPTH, rel=1e-9)  # both pads give way alike
    assert len(under) == 29
    assert force == pytest.approx(carried.sum(), rel=1e-9)
    surface = nodes[:, 1] == PAD.height
    assert state.pads["L"][0, :, 1].numpy() == pytest.approx(
        -carried[1::2][surface], rel=1e-7, abs=1e-9
    )


@pytest.mark.slow
def test_a_long_box_on_stiff_springs_is_a_rigid_flat_punch():
    """Quadratic elements of a quarter of a millimetre under a rigid, smooth punch; ours are
    bilinear of half a millimetre."""
    mesh = MeshQuad.init_tensor(np.linspace(0, PAD.length, 481), np.linspace(0, PAD.height, 17))
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=4)
    lame_lambda, lame_mu = lame_moduli(RUBBER.E, RUBBER.nu)
    K = RUBBER.depth * (lame_lambda * dilatation.assemble(basis) + lame_mu * shear.assemble(basis))
    x, y = basis.doflocs
    vertical = np.isin(
        np.arange(basis.N),
        np.concatenate([dofs[1] for dofs in (basis.nodal_dofs, basis.facet_dofs)]),
    )
    under = np.flatnonzero(vertical & (y == PAD.height) & (np.abs(x - 60e-3) < FLAT + 1e-9))
    u = np.zeros(basis.N)
    u[under] = -DEPTH
    u = solve(*condense(K, x=u, D=np.union1d(np.flatnonzero(y == 0), under)))
    rigid = -(K @ u)[under].sum()
    assert rigid == pytest.approx(66.17, abs=0.01)
    assert punched(1.2e8, 240)[2] == pytest.approx(rigid, rel=2e-3)
    assert punched(1.2e8, 120)[2] == pytest.approx(
        rigid, rel=3e-2
    )  # the flat side ends between its nodes


# --- a neutral direction
# ----------------------------------------------------------------------


def weightless(E: float) -> Rig:
    """A disc under 20 N that nothing turns, on a pad of modulus E [Pa]."""
    law = SoftContact(1e6, 0.0, 1e6, 10.0, friction=SmoothSlip(0.8, 0.8, 0.05))
    material = KelvinVoigt(E, 0.45, rho=1e3, tau=0.01, depth=0.02)
    press = Actuator("disc.y", "disc.y", PD(0.0, 0.0), setpoint="y_d", feed_forward="load")
    held = {"disc.x": 20.3e-3, "y_d": 0.0, "load": -20.0}
    return Rig(
        bodies={"disc": Body(0.1, Circle(0.01), x="driven", weighted=False)},
        pads={"pad": Pad(PadMesh(0.04, 0.005, 40, 4), material, points=2)},
        contacts={"pad": Contact("pad", "disc", law)},
        actuators={"press": press},
        reference=Reference(**{name: Profile([0.0], [value]) for name, value in held.items()}),
    )


@pytest.mark.parametrize("theta", [0.0, 0.3])
def test_a_neutral_direction_stays_where_it_is(theta):
    """Its stiffness and load are rounding; the depth and its derivative are exact."""
    rig, start = weightless(1e6), f64(20.3e-3, 14.8e-3, theta)
    found = resting(rig, {"disc": start})["disc"]
    assert found[2].item() == pytest.approx(theta, abs=1e-12)
    alone = resting(rig, {"disc": start}, {"disc": (1,)})["disc"]
    assert found[1].item() == pytest.approx(alone[1].item(), abs=1e-13)
    (slope,) = torch.autograd.grad(found[1], rig.parameter("pads.pad.material.E"))
    with torch.no_grad():
        ends = [resting(weightless(1e6 + by), {"disc": start})["disc"][1] for by in (100, -100)]
    assert slope.item() == pytest.approx((ends[0] - ends[1]).item() / 200, rel=1e-5)
