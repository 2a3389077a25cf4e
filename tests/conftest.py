"""Shared rigs and states: at rest, in the grasp, rolling, and at random."""

import gc
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchsoft import (
    Body,
    Parameters,
    Reference,
    Rig,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
    hold,
    press,
    register_method,
)
from torchsoft.paper.equilibrium import holding_force
from torchsoft.physics.state import State

register_method()

torch.set_num_threads(1)
gc.set_threshold(50_000, 20, 20)

RUBBER = {"E": 7.5e5, "nu": 0.45, "rho": 1100.0, "depth": 0.044}
COARSE = {"pad.elements_x": 60, "pad.elements_y": 2, "contact.v_s": 0.05}


def coarse(**changes: object) -> SoftGrasp:
    """A model on a coarse mesh (2 mm nodes), quick enough for hundreds of evaluations."""
    return SoftGrasp(
        Parameters().override(COARSE | {k.replace("__", "."): v for k, v in changes.items()})
    )


def turning(**changes: object) -> Rig:
    """The coarse rig with a bracket that may turn and has weight, driven as before; its pads are
    massless."""
    model = coarse(**changes)
    bracket = Body(0.4, inertia=3e-4)
    rig = Rig(
        bodies={"disc": model.disc, "bracket": bracket}, pads=dict(model.pads),
        contacts=dict(model.contacts), actuators=dict(model.actuators), reference=model.reference,
    )  # fmt: skip
    rig.fixed = lambda: model  # the same rig with a bracket that does not turn
    return rig


def paper_settings(recording: Any) -> Parameters:
    """Of a recording of the paper's rig."""
    assert isinstance(recording.rig, SoftGrasp)
    return recording.rig.settings


def nested(name: str, value: Any) -> dict[str, Any]:
    """A tree with a value by a dotted name, `__` for a dot."""
    for part in reversed(name.replace("__", ".").split(".")):
        value = {part: value}
    return value


def dry(**how: Any) -> SoftContact:
    """A contact with smooth slip."""
    return SoftContact(1.2e5, 440.0, 1.2e5, 440.0, friction=SmoothSlip(0.8, 0.7, 0.05), **how)


def times(end: float, n: int) -> Tensor:
    return torch.linspace(0, end, n, dtype=torch.float64)


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def grasp(model: SoftGrasp, velocity: tuple[float, float] = (0.0, 0.0)) -> tuple[Tensor, Reference]:
    """The frictionless grasp (size,) with the disc moving at `velocity` [m/s], and the reference
    that holds it there."""
    y = press(model, model.settings.scenario.y_Br_grasp).detach()
    pose = model.unpack(y).pose
    y[model.layout.slices["velocity", "disc"]] = f64(*velocity, 0.0)
    return y, hold(
        x_d=float(pose["disc"][0]), y_d=float(pose["bracket"][1]), F_ff=-holding_force(model, y)
    )


def grasped(model: SoftGrasp, velocity: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """The grasp, after the model was given the reference that holds it."""
    y, model.reference = grasp(model, velocity)
    return y


def towards(model: Rig, x_d: nn.Module) -> Reference:
    """The model's reference with another horizontal set-point."""
    return Reference(**{name: model.reference[name] for name in model.signals} | {"x_d": x_d})


def random_state(rig: Rig, seed: int, slip: float = 0.02) -> Tensor:
    """A grasped state (size,) of the paper's rigs shaken about."""
    model = rig if isinstance(rig, SoftGrasp) else rig.fixed()
    return shaken(
        rig, model.unpack(press(model, model.settings.scenario.y_Br_grasp).detach()), seed, slip
    )


def shaken(rig: Rig, state: State, seed: int, slip: float = 0.02) -> Tensor:
    """A state (size,) shaken about: touching and separated nodes, stick and slip, stretched
    springs."""
    generator = torch.Generator().manual_seed(seed)

    def moved(part: dict[str, Tensor], scale: float | Tensor) -> dict[str, Tensor]:
        noise = {
            name: torch.randn(x.shape, generator=generator, dtype=torch.float64)
            for name, x in part.items()
        }
        return {name: x + scale * noise[name] for name, x in part.items()}

    force = 2e-5 if any(pad.inertial for pad in rig.pads.values()) else 0.5  # [m] or [N]
    return rig.pack(
        State(
            pads=moved(state.pads, force),
            stretch=moved(state.stretch, 2e-5),
            pose=moved(state.pose, f64(1e-4, 1e-4, 0.02)),
            rates=moved(state.rates, 0.01 * slip),
            velocity=moved(state.velocity, slip * f64(1.0, 1.0, 50.0)),
        )
    )


class Exp(nn.Module):
    """A positive parameter by its logarithm."""

    def forward(self, x: Tensor) -> Tensor:
        return x.exp()

    def right_inverse(self, x: Tensor) -> Tensor:
        return x.log()


def pytest_collection_finish() -> None:
    """Keep modules out of garbage collections, which are a twentieth of the time else."""
    gc.collect()
    gc.freeze()


@pytest.fixture(params=["massless", "inertial"])
def fidelity(request):
    return request.param
