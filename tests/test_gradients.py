"""Gradients of runs: adjoint, sensitivities and backpropagation equal; finite differences;
reproducible to the bit."""

from dataclasses import dataclass

import pytest
import torch
from conftest import coarse, f64, grasped, times
from torch import Tensor, nn
from unrolled import unrolled_solution

import torchsoft.solve.adjoint
from torchsoft import SoftGrasp, simulate
from torchsoft.channels import MEASURED
from torchsoft.paper.rig import NAMES
from torchsoft.solve.adjoint import GradientFailed
from torchsoft.solve.trajectory import channels

NEWTON = 1e-10
"""Newton's tolerance of the compiled steps compared here [N]; 1e-11 is rounding, and not reached at
every step."""
SAME_STEPS = 1e-10
"""Adjoint against backpropagation, relative: two solutions of the same stages."""
SMALL = 0.1
"""A gradient p dL/dp below this part of the largest one is the difference of larger terms."""

UNITS = f64(1e-5, 1e-5, 1e-3, 1e-5, 1e-5, 1e-3, 1e-3, 1e-1, 1e-3, 1e-3, 1.0, 1.0)
"""What counts as one unit of each measured channel in the loss: m, rad, m/s, rad/s, N."""


@dataclass(frozen=True)
class Window:
    """A short run: model, initial state (size,), outputs t (T,) [s], step [s]; `origin` are the
    channels at the start."""

    model: SoftGrasp
    y0: Tensor
    t: Tensor
    step: float
    origin: Tensor

    def compiled(self, y0: Tensor | None = None) -> Tensor:
        """States (T, size) by the compiled stepper, the discrete adjoint behind them."""
        y0 = self.y0 if y0 is None else y0
        return simulate(
            self.model, self.t, y0=y0, step=self.step, tolerance=NEWTON, gradient="discrete"
        ).y

    def loss(self, y: Tensor) -> Tensor:
        """Smooth, with another weight for every component: the measured channels, less `origin`."""
        z = measured(self.model, y, self.t) - self.origin
        weight = torch.linspace(0.5, 1.5, z.numel(), dtype=torch.float64).reshape(z.shape)
        return (weight * (z + 0.1 * z**2)).sum()

    def gradients(self, y: Tensor, wanted: list[Tensor]) -> list[Tensor]:
        parts = torch.autograd.grad(self.loss(y), wanted, allow_unused=True)
        return [torch.zeros_like(x) if g is None else g for x, g in zip(wanted, parts)]


def measured(model: SoftGrasp, y: Tensor, t: Tensor) -> Tensor:
    """(T, 12): the channels that can be measured, in `UNITS`."""
    signals = model.follow(t)
    found = channels(model, model.unpack(y, signals), signals)
    return torch.stack([found[name] for name in MEASURED], -1) / UNITS


@torch.no_grad()
def window(model: SoftGrasp, y0: Tensor, t: Tensor, step: float) -> Window:
    return Window(model, y0, t, step, measured(model, y0[None], t[:1]))


def stick() -> Window:
    model = coarse()
    return window(model, grasped(model, (1e-2, 5e-3)), times(4e-3, 5), 1e-3)


def slip() -> Window:
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    return window(model, grasped(model, (0.08, 0.0)), times(2e-3, 5), 5e-4)


def make_break() -> Window:
    """Fast enough that nodes touch and leave within a few steps."""
    model = coarse(scenario__x_C0=0.0609)
    return window(model, grasped(model, (0.3, -0.02)), times(2e-3, 5), 5e-4)


def jerk() -> Window:
    """A light grasp, the horizontal loop about the bracket, and the bracket far from where that
    loop wants it."""
    model = coarse(
        scenario__y_Br_grasp=49.7e-3,
        control__senses="bracket",
        contact__mu_s=0.3,
        contact__mu_k=0.2,
    )
    y0 = grasped(model)
    with torch.no_grad():
        model.reference["x_d"].values += 2e-3
    return window(model, y0, times(6e-3, 5), 5e-4)


WINDOWS = {"stick": stick, "slip": slip, "make-break": make_break, "jerk": jerk}


@torch.no_grad()
def modes(model: SoftGrasp, y: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Which nodes touch and which slip, (T, nodes) each."""
    graph = model.evaluate(t, model.unpack(y, t=t))
    on = torch.cat([i.frame.g > 0 for i in graph.interfaces.values()], -1)
    return on, on & torch.cat([i.out[..., 6] != 0 for i in graph.interfaces.values()], -1)


def scalars(model: SoftGrasp) -> dict[str, nn.Parameter]:
    """Every trained scalar parameter but the density, which massless pads do not use, by the names
    of `Parameters`."""
    known = {own: name for name, own in NAMES.items()}
    found = {
        known[name]: p for name, p in model.named_parameters() if p.ndim == 0 and p.requires_grad
    }
    return {name: p for name, p in found.items() if name != "pad.rho"}


# one step
# ----------------------------------------------------------------------


# runs
# ----------------------------------------------------------------------


@pytest.mark.parametrize("name", WINDOWS)
def test_windows_are_what_they_are_called(name: str) -> None:
    w = WINDOWS[name]()
    with torch.no_grad():
        on, slipping = modes(w.model, w.compiled(), w.t)
    touching, leaving = int((on[1:] & ~on[:-1]).sum()), int((on[:-1] & ~on[1:]).sum())
    if name != "jerk":
        assert (touching > 0 and leaving > 0) if name == "make-break" else touching + leaving == 0
    assert bool(slipping.any()) == (name != "stick")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name == "jerk")) for name in WINDOWS],
)
def test_adjoint_equals_backpropagation_through_the_plain_step(name: str) -> None:
    """The initial state and every parameter; a gradient that is small by cancellation is held to
    the larger ones."""
    w = WINDOWS[name]()
    y0 = w.y0.requires_grad_(True)
    wanted = [y0, *scalars(w.model).values()]
    assert len(wanted) == 22
    adjoint = w.gradients(w.compiled(), wanted)
    plain = w.gradients(unrolled_solution(w.model, y0, w.t, step=w.step), wanted)
    largest = max(float((b * p.detach()).norm()) for b, p in zip(plain[1:], wanted[1:]))
    for label, p, a, b in zip(["y0", *scalars(w.model)], wanted, adjoint, plain):
        floor = 0.0 if label == "y0" else SMALL * largest / float(p.detach().norm())
        assert float((a - b).norm()) <= SAME_STEPS * max(float(b.norm()), floor), (label, a, b)


def test_same_gradient_twice_and_from_checkpoints_to_the_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also when every tape is made again from where its segment began, over several segments."""
    model = coarse()
    y0 = grasped(model, (2e-3, 1e-3)).requires_grad_(True)
    t = torch.cat(
        (times(0.4, 201), f64(0.401, 0.402))
    )  # another step size at the end: another segment
    w = window(model, y0, t, 4e-4)
    wanted = [y0, *scalars(model).values()]
    first, second = (w.gradients(w.compiled(), wanted) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second))
    monkeypatch.setattr(torchsoft.solve.adjoint, "TAPE_BYTES", 0)
    again = w.gradients(w.compiled(), wanted)
    assert all(torch.equal(a, b) for a, b in zip(first, again))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_cotangent_that_is_not_finite_is_refused(bad: float) -> None:
    w = stick()
    solution = w.compiled()
    cotangent = torch.zeros_like(solution)
    cotangent[3, w.model.layout.slices["velocity", "disc"]] = bad
    with pytest.raises(GradientFailed, match="the cotangent of output 3 is not finite"):
        solution.backward(cotangent)
