"""Shared states: models at rest, in the grasp, rolling, and at random."""

import pytest
import torch
from torch import Tensor

from torchsoft import Parameters, SoftGrasp, press
from torchsoft.state import State

torch.set_num_threads(1)

COARSE = {"pad.elements_x": 60, "pad.elements_y": 2, "contact.v_s": 0.05}


def coarse(**changes: object) -> SoftGrasp:
    """A model on a coarse mesh (2 mm nodes), quick enough for hundreds of evaluations."""
    return SoftGrasp(Parameters().override(COARSE | {k.replace("__", "."): v for k, v in changes.items()}))


def random_state(model: SoftGrasp, seed: int, slip: float = 0.02) -> Tensor:
    """A grasped state (size,) shaken about: touching and separated nodes, stick and slip, stretched springs."""
    generator = torch.Generator().manual_seed(seed)
    state = model.layout.unpack(press(model, model.settings.scenario.y_Br_grasp).detach())

    def noise(like: Tensor, scale: float) -> Tensor:
        return scale * torch.randn(like.shape, generator=generator, dtype=torch.float64)

    shaken = State(
        u_L=state.u_L + noise(state.u_L, 2e-5),
        u_U=state.u_U + noise(state.u_U, 2e-5),
        s_L=noise(state.s_L, 2e-5),
        s_U=noise(state.s_U, 2e-5),
        r_C=state.r_C + noise(state.r_C, 1e-4),
        theta=noise(state.theta, 0.3),
        r_Br=state.r_Br + noise(state.r_Br, 1e-4),
        v_L=noise(state.v_L, 0.01 * slip),
        v_U=noise(state.v_U, 0.01 * slip),
        v_C=noise(state.v_C, slip),
        omega=noise(state.omega, slip / 0.02),
        v_Br=noise(state.v_Br, slip),
    )
    return model.layout.pack(shaken)


@pytest.fixture(params=["massless", "inertial"])
def fidelity(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=["smooth", "coulomb"])
def friction(request: pytest.FixtureRequest) -> str:
    return request.param
