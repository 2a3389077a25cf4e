"""What a run warns of at its end: energies that do not balance, and gradients that are not those of
the values."""

import re
import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, coarse, excited, f64, grasped, still, times, towards
from torch import Tensor, nn

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    Coulomb,
    Hyperelastic,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    SmoothSlip,
    SoftContact,
    hold,
    simulate,
    simulate_batch,
)
from torchsoft.physics.hyperelastic import invariants
from torchsoft.physics.state import OwnState
from torchsoft.rigs.excite import CATALOGUE


def warned(model: Rig, run: Callable[..., object] = simulate, **options: object) -> list[str]:
    """The warnings of a run, or of many."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(model, **options)
    return [str(w.message) for w in caught]


def assert_each_matches(texts: list[str], patterns: list[str]) -> None:
    assert len(texts) == len(patterns), texts
    for text, pattern in zip(texts, patterns):
        assert re.search(pattern, text), text


# energies
# ----------------------------------------------------------------------


@pytest.mark.parametrize(("name", "step"), [("deep jerks", 0.05), ("light jerks", 0.04)])
def test_hard_motions_pass_at_the_default_step_and_at_what_is_advised(name, step):
    """The hardest of the ready excitations, and the same as coarse as nobody should take them."""
    rig, y0, _ = excited(name, PAPER.override(COARSE | {"contact.v_s": 5e-3}))
    t = times(CATALOGUE[name].duration, 2)
    assert warned(rig, t=t, y0=y0) == []
    rig.reference = towards(rig, Profile([0.6, 0.68, 0.76], [0.06, 0.08, 0.06]))
    (text,) = warned(rig, t=t, y0=y0, step=step)
    assert "the energies of the run do not balance" in text
    advised = float(re.search(r"try steps of (\S+) s", text)[1])
    assert warned(rig, t=t, y0=y0, step=advised) == []


def test_a_slip_law_that_supplies_power_is_seen():
    """More slip than the effort allows."""
    model = still(COARSE, friction=lambda E, F_N, R: 1.9 * E / R)
    texts = "\n".join(warned(model, t=times(0.01, 6), y0=grasped(model, (0.05, 0.0))))
    assert "`slip` is to dissipate energy, but gave" in texts
    assert "the slip law of `L` gives" in texts


def test_a_body_without_contact_or_energy_passes():
    """No division by nothing."""
    rig = Rig(bodies={"disc": Body(1.0, Circle(0.02), weighted=False)}, pads={}, contacts={})
    assert warned(rig, t=times(0.1, 3), y0=torch.zeros(6, dtype=torch.float64)) == []


def test_a_pad_pressed_flat_is_reported_once_with_all_its_runs():
    model = coarse()
    y0, pressed = grasped(model), hold(x_d=0.06, y_d=0.044, F_ff=-1000.0)
    how = {"t": times(0.02, 3), "y0": y0, "step": 5e-4}
    references = [model.reference, pressed, model.reference, pressed]
    runs = r"runs 1, 3 \(numbers of run 1\): the pad `{}` of height .* gave way by"
    texts = warned(model, simulate_batch, reference=references, **how)
    assert_each_matches(texts, [runs.format(pad) for pad in "LU"])
    texts = warned(model, reference=pressed, **how)
    assert_each_matches(texts, ["`L` of height .* beyond linear elasticity", "`U` of height"])


# gradients that leave something out
# ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("slip", "jumps"),
    [
        (Coulomb(0.5, 0.4), True),
        (lambda E, F_N, R: torch.where(0.5 * F_N <= E, (E - 0.4 * F_N) / R, 0.0), True),
        (Coulomb(0.5, 0.5), False),
        (SmoothSlip(0.5, 0.4, 0.05), False),
    ],
)
def test_friction_that_jumps_is_reported_where_a_gradient_leaves_that_out(slip, jumps):
    """With respect to its static coefficient the adjoint is zero, where it decides how far points
    stick."""
    model = still(COARSE, friction=slip)
    run = {"t": times(4e-3, 3), "y0": grasped(model, (0.05, -0.01))}
    assert warned(model, **run, gradient="none") == []
    for route in ({"gradient": "discrete"}, {"gradient": "forward", "wrt": ["pad.E"]}):
        found = [f"contact `{pad}`: .*leaves such jumps out" for pad in "LU" if jumps]
        assert_each_matches(warned(model, **run, **route), found)


@pytest.mark.parametrize("of", ["effort", "normal force"])
def test_friction_of_the_trial_effort_is_reported(of):
    """What a stage adds to the dashpot is in it: forces depend on the steps."""

    def slip(E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = 0.3 + 0.2 * torch.tanh((E if of == "effort" else F_N) / 10)
        return (E - mu * F_N).clamp(min=0.0) / R

    model = still(COARSE, friction=slip)
    texts = warned(model, t=times(1e-3, 2), y0=grasped(model))
    assert_each_matches(texts, ["leaves the same effort"] * (of == "effort"))


class Repelling(nn.Module):
    """A spring that pushes away from x_0, 10 1/s for 0.4 kg."""

    def __init__(self) -> None:
        super().__init__()
        self.x_0 = nn.Parameter(f64(0.1)[0])

    def forward(self, w: Tensor, w_dot: Tensor, F: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        return 40.0 * (q - self.x_0) + 0.0 * (w + w_dot + F + q_dot)


def test_a_gradient_that_the_rig_amplifies_is_reported():
    """At the top of a hill x stays, and its derivatives grow by cosh(10 t): by 3.6e10 in 2.5 s."""
    push = Actuator("disc.x", "disc.x", Repelling(), setpoint="x")
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(0.02), weighted=False)}, pads={}, contacts={},
        actuators={"push": push}, reference=hold(x=0.0),
    )  # fmt: skip
    y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
    y0[0] = 0.1
    routes: tuple[dict[str, Any], ...] = (
        {"gradient": "discrete"}, {"gradient": "forward", "wrt": ["actuators.push.law.x_0"]},
    )  # fmt: skip

    def run(model: Rig, t: Tensor, **route: Any) -> None:
        made = simulate(model, t, y0=y0, step=2e-3, **route)
        if route["gradient"] == "discrete":
            made["x_disc"][-1].backward()

    for route in routes:
        (text,) = warned(rig, run, t=times(2.5, 2), **route)
        assert re.search(r"changes by 1e-1\d of itself moves the run by its own size", text)
        assert warned(rig, run, t=times(1.0, 2), **route) == []


# parts that detach what they depend on
# ----------------------------------------------------------------------


class Held(nn.Module):
    """A slip law that detaches its coefficient, the normal force, or its condition only."""

    def __init__(self, what: str) -> None:
        super().__init__()
        self.mu, self.what = nn.Parameter(f64(0.3)[0]), what

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        slips = E.detach() > self.mu.detach() * F_N.detach()
        mu = self.mu.detach() if self.what == "mu" else self.mu
        with torch.set_grad_enabled(self.what != "F_N"):
            normal = F_N * 1.0
        return torch.where(slips, (E - mu * normal) / R, 0.0)


class Wiping(nn.Module):
    """Friction that falls with the way slid; its rate detaches `gain`."""

    states: ClassVar = {"way": OwnState("m")}

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(f64(1.0)[0])

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor, z: Tensor, stage: Tensor) -> Any:
        slip = (E - (0.4 + 0.1 * torch.exp(-z[..., 0] / 1e-3)) * F_N).clamp(min=0.0) / R
        return slip, (self.gain.detach() * torch.where(F_N > 0, slip, 0.0))[..., None]


class Loop(nn.Module):
    def forward(self, w: Tensor, w_dot: Tensor, F: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        return 1e3 * (w - q) - 10 * q_dot.detach()


class Disc(Circle):
    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        phi, n = super().forward(x)
        return phi, n.detach()


class Rubber(KelvinVoigt):
    def chain(self) -> tuple[Tensor, Tensor]:
        J, tau = super().chain()
        return J, tau.detach()


class Gel(Hyperelastic):
    """A neo-Hookean energy and another term."""

    def __init__(self, term: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__(**RUBBER, tau=0.01)
        self.c, self.term = nn.Parameter(f64(2e5)[0]), term

    def distortion(self, F: Tensor) -> Tensor:
        I1, _, _ = invariants(F)
        return 0.5 * self.shear * (I1 - 3) + self.term(self.c, I1 - 3)


class Swing(nn.Module):
    """A set-point whose amplitude is `made` of a parameter."""

    def __init__(self, made: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.amplitude, self.made = nn.Parameter(f64(1e-3)[0]), made

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        a = self.made(self.amplitude)
        return 0.02 + a * torch.sin(20 * t), 20 * a * torch.cos(20 * t)


def part(name: str, make: Callable[[], nn.Module], *by: str) -> Any:
    """A part by its name in the rig below, and what the warnings name, of values and derivatives,
    one for each."""
    return pytest.param(name, make, by, id="-".join((name, *by)))


@pytest.mark.parametrize(
    ("name", "make", "by"),
    [
        part("friction", lambda: Held("F_N"), r"slip law .*:\d+, `normal = F_N.*by the normal"),
        part("friction", lambda: Held("mu"), "slip law .*by `mu` are"),
        part("friction", lambda: Held("mu").requires_grad_(False)),
        part("friction", lambda: Held("")),
        part("friction", Wiping, "by `gain` are"),
        part("law", Loop, "the law of `actuators.a`.*by disc.x's rate are"),
        part("shape", lambda: Disc(0.02), "the shape of `disc`.*by x, y are"),
        part("material", lambda: Rubber(**RUBBER, tau=0.01), "material of `P`.*by `tau` are"),
        part("material", lambda: Gel(lambda c, x: c.detach() * x**2), "by `c` are"),
        part("material", lambda: Gel(lambda c, x: c * x.detach() * x), r"F_xx \(a stress\).*`c`"),
        part("signal", lambda: Swing(lambda a: a.detach()), "by `signals.x_d.amplitude` are"),
        part("signal", lambda: Swing(Tensor.item), "by `signals.x_d.amplitude` are"),
        part("signal", lambda: Swing(lambda a: a)),
    ],
)
def test_a_part_that_detaches_what_it_depends_on_is_named(name, make, by):
    """With what the derivatives are wrong with respect to; not one that detaches the condition of a
    choice only, nor one whose parameter is held on purpose."""
    made: dict[str, Any] = {name: make()}
    friction = made.get("friction", SmoothSlip(0.8, 0.7, 0.05))
    contact = SoftContact(1e5, 400.0, 1e5, 400.0, friction=friction)
    material = made.get("material", KelvinVoigt(**RUBBER, tau=0.01))
    loop = Actuator("disc.x", "disc.x", made.get("law", PD(1e3, 10.0)), setpoint="x_d")
    rig = Rig(
        bodies={"disc": Body(0.4, made.get("shape", Circle(0.02)))},
        pads={"P": Pad(PadMesh(0.04, 4e-3, 8, 2), material)},
        contacts={"c": Contact("P", "disc", contact)}, actuators={"a": loop},
        reference=Reference(x_d=made["signal"]) if "signal" in made else hold(x_d=0.02),
    )  # fmt: skip
    y0 = rig.state(disc={"x": 0.02, "y": 23.9e-3}).detach()
    patterns = [f"^the gradient of .*{one}" for one in by]
    assert_each_matches(warned(rig, t=times(1e-3, 2), y0=y0), patterns)
