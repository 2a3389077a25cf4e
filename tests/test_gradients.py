"""Gradients of runs: finite differences and forward sensitivities in every regime of contact;
reproducible to the bit."""

from typing import Any

import pytest
import torch
from conftest import coarse, f64, grasped, times
from rig_tester import assert_gradients_exact
from torch import Tensor

import torchsoft.solve.gradients
from torchsoft import Rig, simulate
from torchsoft.solve.gradients import GradientFailed


def window(
    velocity: tuple[float, float], place: dict[str, float], x_d: float = 0.0, **changes: object
) -> tuple[Rig, Tensor]:
    model = coarse(**changes)
    y0 = grasped(model, velocity, **place)
    with torch.no_grad():
        model.reference["x_d"].values += x_d
    return model, y0


SLIPPERY = {"contact__mu_s": 0.3, "contact__mu_k": 0.2}
WINDOWS: dict[str, tuple[float, Any]] = {
    "stick": (4e-3, lambda: window((1e-2, 5e-3), {})),
    "slip": (2e-3, lambda: window((0.08, 0.0), {}, **SLIPPERY)),
    "make-break": (2e-3, lambda: window((0.3, -0.02), {"x": 0.0609})),
    "jerk": (6e-3, lambda: window(
        (0.0, 0.0), {"height": 49.7e-3}, 2e-3, control__senses="bracket.x", **SLIPPERY)),
}  # fmt: skip
"""Durations [s] and rigs with a start; the jerk is of a light grasp, with the bracket far from its
set-point."""


@pytest.mark.parametrize("name", WINDOWS)
def test_gradients_are_the_differences_in_every_regime(name):
    """And the windows are what they are called."""
    duration, make = WINDOWS[name]
    model, y0 = make()
    run = assert_gradients_exact((model, y0), times(duration, 5), rtol=1e-6)
    with torch.no_grad():
        faces = model.evaluate(run.t, model.unpack(run.y, t=run.t)).interfaces
    on = torch.cat([face.frame.g > 0 for face in faces.values()], -1)
    slips = on & torch.cat([face.law.slip != 0 for face in faces.values()], -1)
    touching, leaving = int((on[1:] & ~on[:-1]).sum()), int((on[:-1] & ~on[1:]).sum())
    if name in ("stick", "slip", "make-break"):
        assert (touching > 0 and leaving > 0) if name == "make-break" else touching + leaving == 0
    assert bool(slips.any()) == (name != "stick")


def test_a_gradient_is_the_same_from_checkpoints_to_the_bit(monkeypatch):
    """When every tape is made again from where its segment starts, over several segments."""
    model = coarse()
    wanted = [grasped(model, (2e-3, 1e-3)).requires_grad_(), *model.parameters()]
    wanted = [p for p in wanted if p.requires_grad]
    t = torch.cat((times(0.1, 51), f64(0.101, 0.102)))  # another step size at the end

    def gradients() -> tuple[Tensor, ...]:
        run = simulate(model, t, y0=wanted[0], step=4e-4, gradient="discrete")
        weights = torch.linspace(0.5, 1.5, run.y.numel(), dtype=torch.float64).reshape(run.y.shape)
        return torch.autograd.grad((weights * run.y).sum(), wanted, materialize_grads=True)

    first, second = gradients(), gradients()
    monkeypatch.setattr(torchsoft.solve.gradients, "TAPE_BYTES", 0)
    for a, b, again in zip(first, second, gradients()):
        assert torch.equal(a, b)
        assert torch.equal(a, again)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_cotangent_that_is_not_finite_is_rejected(bad):
    model = coarse(pad__elements_x=24)
    y = simulate(model, times(4e-3, 5), y0=grasped(model), step=1e-3, gradient="discrete").y
    cotangent = torch.zeros_like(y)
    cotangent[3, model.layout.slices["velocity", "disc"]] = bad
    with pytest.raises(GradientFailed, match="the cotangent of output 3 is not finite"):
        y.backward(cotangent)
