"""Gradients of runs: finite differences in every regime of contact; reproducible to the bit."""

import pytest
import torch
from conftest import GRASPED, coarse, f64, grasped, times
from rig_tester import assert_gradients_exact
from torch import Tensor

import torchsoft.solve.gradients
from torchsoft import Rig, simulate
from torchsoft.solve.gradients import GradientFailed

Window = tuple[Rig, Tensor, float]
"""A model, its initial state (size,), and how long it runs [s]."""


def window(
    duration: float, velocity: tuple[float, float] = (0.0, 0.0), height: float = GRASPED,
    x: float = 60e-3, **changes: object,
) -> Window:  # fmt: skip
    model = coarse(**changes)
    return model, grasped(model, velocity, height=height, x=x), duration


SLIPPERY = {"contact__mu_s": 0.3, "contact__mu_k": 0.2}


def jerk() -> Window:
    """A light grasp, the horizontal loop about the bracket, and the bracket far from where that
    loop wants it."""
    made = window(6e-3, height=49.7e-3, control__senses="bracket.x", **SLIPPERY)
    with torch.no_grad():
        made[0].reference["x_d"].values += 2e-3
    return made


WINDOWS = {
    "stick": lambda: window(4e-3, (1e-2, 5e-3)),
    "slip": lambda: window(2e-3, (0.08, 0.0), **SLIPPERY),
    "make-break": lambda: window(2e-3, (0.3, -0.02), x=0.0609),
    "jerk": jerk,
}


@pytest.mark.parametrize("name", WINDOWS)
def test_gradients_are_the_differences_in_every_regime(name):
    """And the windows are what they are called."""
    model, y0, duration = WINDOWS[name]()
    run = assert_gradients_exact((model, y0), times(duration, 5), rtol=1e-6)
    with torch.no_grad():
        faces = model.evaluate(run.t, model.unpack(run.y, t=run.t)).interfaces.values()
    on = torch.cat([face.frame.g > 0 for face in faces], -1)
    slips = on & torch.cat([face.law.slip != 0 for face in faces], -1)
    touching, leaving = int((on[1:] & ~on[:-1]).sum()), int((on[:-1] & ~on[1:]).sum())
    if name != "jerk":
        assert (touching > 0 and leaving > 0) if name == "make-break" else touching + leaving == 0
    assert bool(slips.any()) == (name != "stick")


def test_same_gradient_twice_and_from_checkpoints_to_the_bit(
    monkeypatch,
):
    """Also when every tape is made again from where its segment began, over several segments."""
    model = coarse()
    wanted = [grasped(model, (2e-3, 1e-3)).requires_grad_(), *model.parameters()]
    wanted = [p for p in wanted if p.requires_grad]
    t = torch.cat((times(0.4, 201), f64(0.401, 0.402)))  # another step size at the end

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
def test_a_cotangent_that_is_not_finite_is_refused(bad):
    model, y0, duration = WINDOWS["stick"]()
    solution = simulate(model, times(duration, 5), y0=y0, step=1e-3, gradient="discrete").y
    cotangent = torch.zeros_like(solution)
    cotangent[3, model.layout.slices["velocity", "disc"]] = bad
    with pytest.raises(GradientFailed, match="the cotangent of output 3 is not finite"):
        solution.backward(cotangent)
