"""What a run says of itself at its end."""

import re
import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import torch
from conftest import COARSE, PAPER, coarse, excited, f64, grasped, still, times, towards
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
from torchsoft.solve.diagnostics import RESIDUAL, doubts


def told(model: Rig, run: Callable[..., object] = simulate, **options: object) -> list[str]:
    """The warnings of a run, or of many."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(model, **options)
    return [str(w.message) for w in caught]


@pytest.mark.parametrize(("name", "step"), [("deep jerks", 0.05), ("light jerks", 0.04)])
def test_hard_motions_pass_at_the_default_step_and_at_what_is_advised(name, step):
    """The hardest of the ready excitations, and the same as coarse as nobody should take them."""
    begun = excited(name, PAPER.override(COARSE | {"contact.v_s": 5e-3}))
    t = times(CATALOGUE[name].duration, 2)
    assert told(begun.rig, t=t, y0=begun.y0) == []
    begun.rig.reference = towards(begun.rig, Profile([0.6, 0.68, 0.76], [0.06, 0.08, 0.06]))
    (text,) = told(begun.rig, t=t, y0=begun.y0, step=step)
    assert "the energies of the run do not balance" in text
    advised = float(re.search(r"try steps of (\S+) s", text)[1])
    assert told(begun.rig, t=t, y0=begun.y0, step=advised) == []


class Springy(nn.Module):
    """A slip law that gives back what it takes: more slip than the effort allows."""

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return 1.9 * E / R


def test_a_slip_law_that_supplies_power_is_seen_in_the_ledger():
    model = still(COARSE, friction=Springy())
    said = told(model, t=times(0.01, 6), y0=grasped(model, (0.05, 0.0)))
    assert any("`slip` is to dissipate energy, but gave" in text for text in said), said
    assert any("the slip law of `L` gives" in text for text in said), said


class Held(nn.Module):
    """A slip law that records no derivative of its coefficient, or of something that it does not
    depend on."""

    def __init__(self, mu: float, what: str) -> None:
        super().__init__()
        self.mu, self.what = nn.Parameter(f64(mu)[0]), what

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        slips = E.detach() > self.mu.detach() * F_N.detach()
        with torch.set_grad_enabled(self.what != "mu"):
            cap = self.mu * F_N
        cap = cap.detach() if self.what == "F_N" else cap
        return torch.where(slips, (E - cap) / R, 0.0)


@pytest.mark.parametrize(
    ("what", "line"), [("mu", "cap = self.mu"), ("F_N", r"cap = cap.detach\(\)"), ("", "")]
)
def test_a_law_that_detaches_what_it_depends_on_is_told_of(what, line):
    """With its line; not one that detaches the condition of a choice only, nor one whose parameter
    is held on purpose."""
    slip = Held(0.3 + 0.001 * len(what), what)
    model = still(COARSE, friction=slip)
    run = {"t": times(0.01, 3), "y0": grasped(model, (0.05, 0.0)), "gradient": "discrete"}
    said = told(model, **run)
    sentence = (
        r"the gradient of the slip law of `L` is not that of its value: torch is told to record "
        rf"none at .*test_ledger.py:\d+, `{line}.*so that derivatives by the normal force, `mu` are"
    )
    assert [bool(re.match(sentence, text)) for text in said] == [True] * bool(what), said


@pytest.mark.parametrize(
    ("slip", "told_of"),
    [
        (Coulomb(0.5, 0.4), True),
        (lambda E, F_N, R: torch.where(0.5 * F_N <= E, (E - 0.4 * F_N) / R, 0.0), True),
        (Coulomb(0.5, 0.5), False),
        (SmoothSlip(0.5, 0.4, 0.05), False),
        (lambda E, F_N, R: (E - 0.5 * F_N).clamp(min=0.0) / R, False),
    ],
)
def test_friction_that_jumps_is_told_of_where_a_gradient_leaves_that_out(slip, told_of):
    """By its static coefficient the adjoint is zero, where it decides how far points stick."""
    model = still(COARSE, friction=slip)
    run = {"t": times(4e-3, 3), "y0": grasped(model, (0.05, -0.01))}
    assert told(model, **run, gradient="none") == []
    for route in ({"gradient": "discrete"}, {"gradient": "forward", "wrt": ["pad.E"]}):
        said = told(model, **run, **route)
        assert [text.split(":")[0] for text in said] == ["contact `L`", "contact `U`"] * told_of
        assert all("leaves such jumps out" in text for text in said)
    if isinstance(slip, Coulomb) and told_of:
        with pytest.warns(UserWarning, match="zero by a static coefficient"):
            made = simulate(model, **run, gradient="discrete")
        (slope,) = torch.autograd.grad(made["x_C"][-1], slip.mu_s)
        assert slope == 0.0


@pytest.mark.parametrize("of", ["effort", "normal force"])
def test_friction_of_the_trial_effort_is_told_of(of):
    """What a stage adds to the dashpot is in it: forces depend on the steps (0.1 N of 83 in a
    random rig), and gradients of forces at their ends are of others."""

    def slip(E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = 0.3 + 0.2 * torch.tanh((E if of == "effort" else F_N) / 10)
        return (E - mu * F_N).clamp(min=0.0) / (R + 0.0 * F_N)

    model = still(COARSE, friction=slip)
    said = told(model, t=times(1e-3, 2), y0=grasped(model))
    assert [("leaves the same effort" in text) for text in said] == [True] * (of == "effort")


class Repelling(nn.Module):
    """A spring that pushes away from x_0, 10 1/s for 0.4 kg."""

    def __init__(self) -> None:
        super().__init__()
        self.x_0 = nn.Parameter(f64(0.1)[0])

    def forward(self, w: Tensor, w_dot: Tensor, F: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        return 40.0 * (q - self.x_0) + 0.0 * (w + w_dot + F + q_dot)


def test_a_gradient_that_the_rig_amplifies_is_told_of():
    """At the top of a hill x stays, and its derivatives grow by cosh(10 t): by 3.6e10 in 2.5 s."""
    push = Actuator("disc.x", "disc.x", Repelling(), setpoint="x")
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(0.02), weighted=False)}, pads={}, contacts={},
        actuators={"push": push}, reference=hold(x=0.0),
    )  # fmt: skip
    y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
    y0[0] = 0.1

    def backward(model: Rig, t: Tensor) -> None:
        made = simulate(model, t, y0=y0, step=2e-3, gradient="discrete")
        made["x_disc"][-1].backward()

    def forward(model: Rig, t: Tensor) -> None:
        simulate(model, t, y0=y0, step=2e-3, gradient="forward", wrt=["actuators.push.law.x_0"])

    for route in (backward, forward):
        (text,) = told(rig, route, t=times(2.5, 2))
        assert re.search(r"changes by 1e-1\d of itself moves the run by its own size", text)
        assert told(rig, route, t=times(1.0, 2)) == []


def test_a_parameter_that_is_held_may_be_detached():
    class Fixed(Held):
        def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
            return (E - self.mu.detach() * F_N).clamp(min=0.0) / R

    model = still(COARSE, friction=Fixed(0.3, ""))
    run = {"t": times(0.002, 2), "y0": grasped(model)}
    (text,) = told(model, **run)
    assert "derivatives by `mu` are wrong" in text
    model.contacts["L"].law.friction.requires_grad_(False)
    assert told(model, **run) == []


def test_controllers_and_shapes_and_materials_that_detach_are_told_of():
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

    contact = SoftContact(1e5, 400.0, 1e5, 400.0, friction=SmoothSlip(0.8, 0.7, 0.05))
    mesh, rubber = PadMesh(0.04, 4e-3, 8, 2), Rubber(7.5e5, 0.45, 1100.0, 0.01, 0.044)
    rig = Rig(
        bodies={"disc": Body(0.4, Disc(0.02))}, pads={"P": Pad(mesh, rubber)},
        contacts={"c": Contact("P", "disc", contact)}, reference=hold(x_d=0.0),
        actuators={"a": Actuator("disc.x", "disc.x", Loop(), setpoint="x_d")},
    )  # fmt: skip
    y0 = rig.state(disc={"x": 0.02, "y": "rest"})
    for text, what in zip(
        told(rig, t=times(1e-3, 2), y0=y0),
        (
            "the material of `P`.*by `tau` are",
            "the law of `actuators.a`.*by disc.x's rate are",
            "the shape of `disc`.*by x, y are",
        ),
        strict=True,
    ):
        assert re.match(rf"the gradient of {what} wrong", text), text


class Gel(Hyperelastic):
    """A neo-Hookean energy and another term."""

    def __init__(self, term: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__(E=7.5e5, nu=0.45, rho=1100.0, tau=0.01, depth=0.044)
        self.c, self.term = nn.Parameter(f64(2e5)[0]), term

    def distortion(self, F: Tensor) -> Tensor:
        I1, _, _ = invariants(F)
        return 0.5 * self.shear * (I1 - 3) + self.term(self.c, I1 - 3)


class Wiping(nn.Module):
    """Friction that falls with the way slid; its rate detaches `gain`."""

    states: ClassVar = {"way": OwnState("m")}

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(f64(1.0)[0])

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor, z: Tensor, stage: Tensor) -> Any:
        slip = (E - (0.4 + 0.1 * torch.exp(-z[..., 0] / 1e-3)) * F_N).clamp(min=0.0) / R
        return slip, (self.gain.detach() * torch.where(F_N > 0, slip, 0.0))[..., None]


class Swing(nn.Module):
    """A set-point whose amplitude is `made` of a parameter."""

    def __init__(self, made: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.amplitude, self.made = nn.Parameter(f64(1e-3)[0]), made

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        a = self.made(self.amplitude)
        return 0.02 + a * torch.sin(20 * t), 20 * a * torch.cos(20 * t)


@pytest.mark.parametrize(
    ("parts", "names"),
    [
        ({"material": lambda: Gel(lambda c, x: c.detach() * x**2)}, "`c`"),
        ({"material": lambda: Gel(lambda c, x: c * x.detach() * x)}, r"F_xx \(a stress\).*`c`"),
        ({"material": lambda: Gel(lambda c, x: c * x**2)}, ""),
        ({"friction": Wiping}, "`gain`"),
        ({"signal": lambda: Swing(lambda a: a.detach())}, "`signals.x_d.amplitude`"),
        ({"signal": lambda: Swing(Tensor.item)}, "`signals.x_d.amplitude`"),
        ({"signal": lambda: Swing(lambda a: a)}, ""),
    ],
)
def test_energies_states_and_signals_that_detach_are_named(parts, names):
    made = {name: make() for name, make in parts.items()}
    friction = made.get("friction", SmoothSlip(0.8, 0.7, 0.05))
    material = made.get("material", KelvinVoigt(7.5e5, 0.45, 1100.0, 0.01, 0.044))
    contact = SoftContact(1e5, 400.0, 1e5, 400.0, friction=friction)
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(0.02))},
        pads={"P": Pad(PadMesh(0.04, 4e-3, 8, 2), material)},
        contacts={"c": Contact("P", "disc", contact)},
        actuators={"a": Actuator("disc.x", "disc.x", PD(1e3, 10.0), setpoint="x_d")},
        reference=Reference(x_d=made["signal"]) if "signal" in made else hold(x_d=0.02),
    )  # fmt: skip
    said = told(rig, t=times(1e-3, 2), y0=rig.state(disc={"x": 0.02, "y": 23.9e-3}))
    sentence = f"the gradient of .* is not that of its value.*derivatives by {names} are wrong"
    assert [bool(re.match(sentence, text)) for text in said] == [True] * bool(names), said


def test_a_pad_pressed_flat_is_told_of():
    model = coarse()
    y0 = grasped(model)
    model.reference = hold(x_d=0.06, y_d=0.044, F_ff=-1000.0)
    said = told(model, t=times(0.2, 5), y0=y0, step=5e-4)
    assert any("gave way by" in text and "beyond linear elasticity" in text for text in said), said


def test_a_batch_tells_every_doubt_once_with_all_its_runs():
    model = coarse()
    y0 = grasped(model)
    pressed = hold(x_d=0.06, y_d=0.044, F_ff=-1000.0)
    references = [model.reference, pressed, model.reference, pressed]
    said = told(model, simulate_batch, t=times(0.02, 3), y0=y0, step=5e-4, reference=references)
    for pad, text in zip("LU", said, strict=True):
        assert re.match(
            rf"runs 1, 3 \(numbers of run 1\): the pad `{pad}` of height .* gave way by", text
        ), text
    assert told(
        model, simulate_batch, t=times(0.02, 3), y0=y0, step=5e-4, reference=references[:2]
    )[0].startswith("run 1: the pad")


def test_a_body_without_contact_or_energy_passes():
    """Nothing moves, nothing is stored: no division by nothing."""
    rig = Rig(bodies={"disc": Body(1.0, Circle(0.02), weighted=False)}, pads={}, contacts={})
    run = simulate(rig, times(0.1, 3), y0=torch.zeros(6, dtype=torch.float64))
    assert doubts(run, rig) == {}
    assert 0 < RESIDUAL < 0.1
