"""`simulate`: what runs is what is saved, gradients reach what was put in whatever happens to it
later, and the surroundings of a run do not matter."""

import numpy as np
import pytest
import torch
from conftest import (
    COARSE,
    PAPER,
    coarse,
    excited,
    f64,
    grasped,
    rest,
    still,
    times,
    towards,
)
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchsoft import (
    Coulomb,
    Ellipse,
    Profile,
    Rig,
    SimulationFailed,
    simulate,
)
from torchsoft.rigs.excite import Excitation
from torchsoft.solve import parameters, stepper
from torchsoft.solve.gradients import GradientFailed
from torchsoft.solve.simulate import SharedStart

T = times(0.02, 11)


class Exp(nn.Module):
    """A positive parameter by its logarithm."""

    def forward(self, x: Tensor) -> Tensor:
        return x.exp()

    def right_inverse(self, x: Tensor) -> Tensor:
        return x.log()


def rolled(model: Rig, **options: object):
    """A short run from the grasp, the disc moving."""
    return simulate(model, T, y0=grasped(model, (0.05, 0.0)), step=2e-3, **options)


def test_what_is_saved_is_what_ran():
    """Numbers behind parametrizations, what was loaded, an optimiser's step, another law."""
    model, other = coarse(), coarse(contact__K_n=2e5)
    law, E = model.contacts["L"].law, model.parameter("pad.E")
    parametrize.register_parametrization(law, "K_t", Exp())
    with torch.no_grad():
        law.parametrizations.K_t.original.add_(0.1)
    model.load_state_dict(other.state_dict(), strict=False)
    optimiser = torch.optim.SGD([E], lr=1e12)
    rolled(model, gradient="discrete")["theta"][-1].backward()
    optimiser.step()
    law.friction = Coulomb(0.5, 0.4)
    made_by = rolled(model).made_by
    saved = made_by["parameters"]
    assert saved["laws.steel_on_rubber.K_t"] == law.K_t.item() != 1.2e5
    assert saved["laws.steel_on_rubber.K_n"] == 2e5
    assert saved["materials.rubber.E"] == E.item() != 0.75e6
    assert made_by["friction"]["L"] == "Coulomb"
    assert "laws.steel_on_rubber.friction.v_s" not in saved


# gradients reach what was put in
# ----------------------------------------------------------------------

NAMES = {
    "pads.L.material.E": 0.8e6, "contacts.L.law.K_n": 1e5, "bodies.disc.shape.radius": 19.4e-3,
    "actuators.x.law.Kp": 1e5, "contacts.L.law.friction.mu_s": 0.3, "bodies.disc.mass": 0.5,
    "contacts.L.law.K_t": 1e5, "actuators.y.law.Kp": 1e5,
}  # fmt: skip


class Simulated(nn.Module):
    """A run as a module, for functional_call."""

    def __init__(self, model: Rig) -> None:
        super().__init__()
        self.model = model

    def forward(self, y0: Tensor) -> Tensor:
        return simulate(self.model, T, y0=y0, step=2e-3, gradient="discrete")["theta"][-1]


def test_gradients_reach_parameters_however_they_are_put_in():
    """In place, by functional_call, behind d/d log p = p d/dp, and tied to others."""
    rigs = plain, called, logarithmic, tied = [coarse(contact__mu_k=0.2) for _ in range(4)]
    y0 = grasped(plain, (0.08, 0.0))
    for model in rigs:
        model.reference = plain.reference
        with torch.no_grad():
            for name, value in NAMES.items() if model is not called else ():
                model.get_parameter(name).fill_(value)
    theta = Simulated(plain)(y0)
    expected = torch.autograd.grad(theta, [*map(plain.get_parameter, NAMES)])
    assert all(float(x) != 0 for x in expected)

    put = {f"model.{name}": f64(value)[0].requires_grad_() for name, value in NAMES.items()}
    other = torch.func.functional_call(Simulated(called), put, (y0,))
    assert torch.equal(theta, other)
    assert all(map(torch.equal, torch.autograd.grad(other, list(put.values())), expected))

    logs = []
    for name in NAMES:
        owner, _, last = name.rpartition(".")
        part = logarithmic.get_submodule(owner)
        parametrize.register_parametrization(part, last, Exp())
        logs.append(part.parametrizations[last].original)
    got = torch.stack(torch.autograd.grad(Simulated(logarithmic)(y0), logs))
    values = f64(*NAMES.values())
    torch.testing.assert_close(got, torch.stack(expected) * values, rtol=1e-7, atol=0)

    law = tied.contacts["L"].law
    law.K_t = tied.actuators["y"].law.Kp = law.K_n
    alone = [by for by, name in zip(expected, NAMES) if name.endswith(("K_n", "K_t", "y.law.Kp"))]
    (together,) = torch.autograd.grad(Simulated(tied)(y0), law.K_n)
    assert float(together) == pytest.approx(float(sum(alone)), rel=1e-9)


@pytest.mark.parametrize("when", ["computed", "integrate"])
def test_a_run_has_the_parameters_that_it_started_with(monkeypatch, when):
    """Whatever another thread does to them meanwhile."""
    model = coarse()
    y0, t, before = grasped(model), times(0.02, 5), {}
    model.reference["x_d"].values.requires_grad_()

    def result() -> list[Tensor]:
        run = simulate(model, t, y0=y0, gradient="discrete")
        ends = torch.stack([x[-1] for x in (*run.channels.values(), *run.energy.values())])
        wanted = [p for p in model.parameters() if p.requires_grad]
        slopes = torch.autograd.grad(ends.sum(), wanted, materialize_grads=True)
        return [ends.detach(), torch.tensor([*run.made_by["parameters"].values()][:3]), *slopes]

    def changing(make):
        def other(*arguments):
            with torch.no_grad():
                for value in model.parameters():
                    before.setdefault(value, value.clone())
                    value.mul_(1.01)
            return make(*arguments)

        return other

    expected = result()
    owner = stepper.ImplicitStepper if when == "integrate" else parameters
    monkeypatch.setattr(owner, when, changing(getattr(owner, when)))
    found = result()
    assert len(before) > 10
    assert all(map(torch.equal, found, expected))


def test_what_has_no_gradient_says_so():
    """Integrals over the steps, unless of no weight; second derivatives; a shared graph."""
    model = coarse()
    run = rolled(model, gradient="discrete")
    lost = run.dissipated["slip"][-1]
    with pytest.raises(GradientFailed, match=r"the integral `slip` .* has no gradient"):
        (run["theta"][-1] + lost).backward(retain_graph=True)
    (run["theta"][-1] + 0.0 * lost).backward(retain_graph=True)
    with pytest.raises(GradientFailed, match="has no second derivative"):
        torch.autograd.grad(run["theta"][-1], model.parameter("pad.E"), create_graph=True)
    y0 = rest(model)
    first, second = (simulate(model, T[:3], y0=y0, gradient="discrete")["y_C"][-1] for _ in "12")
    first.backward()
    with pytest.raises(SharedStart, match=r"make y0 anew .* y0\.detach\(\) .*retain_graph=True"):
        second.backward()


# surroundings, routes and forms
# ----------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::UserWarning")  # torch's, of what it does not compile
@pytest.mark.slow
def test_torch_compile_leaves_a_run_alone():
    """A run in a compiled function is the run, gradient and all."""
    model = coarse()

    def end(scale: float) -> Tensor:
        return rolled(model, gradient="discrete")["theta"][-1] * scale

    made = [one(2.0) for one in (end, torch.compile(end, backend="aot_eager"))]
    slopes = [torch.autograd.grad(one, model.parameter("pad.E"))[0] for one in made]
    assert torch.equal(*made)
    assert torch.equal(*slopes)


@pytest.mark.slow
def test_settings_of_the_process_change_no_bit():
    """torch's default dtype, denormal numbers flushed, numpy's errors raised."""
    roll = {"kind": "multi_sine", "amplitude": 1e-3, "band": (5.0, 20.0)}
    excitation = Excitation(roll, duration=0.5, grasp=0.05, since=0.07)

    def made() -> list[Tensor]:
        rig, y0, _ = excited(excitation, PAPER.override(COARSE))
        run = simulate(rig, times(0.1, 6), y0=y0, gradient="discrete")
        ahead = simulate(rig, run.t, y0=y0, gradient="forward", wrt=["pad.E", "pad.nu"])
        by = torch.autograd.grad(run["y_C"][-1], [rig.parameter("pad.E")])
        oval = still(COARSE, shape=Ellipse(19.8e-3, 19.1e-3), friction=Coulomb(0.5, 0.4))
        start = rest(oval)
        return [start, oval(0.0, start), run.y, *run.channels.values(), *run.energy.values(), *by,
                ahead.sensitivities]  # fmt: skip

    expected, before = made(), torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    torch.set_flush_denormal(True)
    try:
        with np.errstate(all="raise"):
            found = made()
    finally:
        torch.set_default_dtype(before)
        torch.set_flush_denormal(False)
    assert all(map(torch.equal, found, expected))


def test_routes_and_grad_modes_agree_on_the_run():
    """A run in inference mode leaves compliances that one with gradients can use."""
    model = coarse()
    model.pads["L"].material.nu.data.fill_(0.4321)  # of no other test
    y0 = torch.from_numpy(grasped(coarse(), (0.05, 0.0)).numpy())
    go = lambda **how: simulate(model, T, y0=y0, step=2e-3, tolerance=1e-10, **how)
    with torch.inference_mode():
        run = go(gradient="discrete")
    with torch.no_grad():
        none = go(gradient="discrete")
    discrete, ahead = go(gradient="discrete"), go(gradient="forward", wrt=["pad.E"])
    assert all(torch.equal(one.y, run.y) for one in (none, discrete, ahead))
    discrete["y_C"][-1].backward()
    assert model.pads["L"].material.nu.grad.abs() > 0
    assert not none["theta"].requires_grad
    assert not go()["theta"].requires_grad


def strided(x: Tensor) -> Tensor:
    """Every second number of a tensor."""
    return torch.stack((x, x), 1)[:, 0]


@pytest.mark.parametrize(
    "form", [Tensor.numpy, Tensor.tolist, Tensor.float, lambda x: tuple(x.tolist()), strided]
)
def test_numbers_may_be_given_in_any_form(form):
    model = coarse()
    y0 = grasped(model, (0.05, 0.0))
    t64, y64 = (torch.as_tensor(form(x), dtype=torch.float64) for x in (T, y0))
    run = simulate(model, form(T), y0=form(y0))
    assert run.t.dtype == run.y.dtype == torch.float64
    assert torch.equal(run.y, simulate(model, t64, y0=y64).y)
    again = simulate(model, t64, y0=y64, knots=form(run.knots)) if form is strided else run
    assert float((again.y - run.y).abs().max()) < 1e-12


def test_gradients_reach_what_is_given_in_single_precision():
    model = coarse()
    y0 = rest(model).detach().float().requires_grad_()
    simulate(model, T[:3], y0=y0, gradient="discrete")["y_C"][-1].backward()
    assert y0.grad.dtype == torch.float32
    assert bool(y0.grad.any())


def test_a_law_that_turns_nan_never_converges():
    """The slip rate of an effort from 13 to 90 N is not a number: the run ends there, and says
    so."""

    def broken(E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        wrong = (E > 13.0) & (E < 90.0) & (F_N > 10.0)
        return torch.where(wrong, torch.nan, (E - 0.8 * F_N).clamp(min=0.0) / R)

    model = still(COARSE, friction=broken)
    y0 = grasped(model)
    pushed = towards(model, Profile([0.0, 0.2], [0.06, 0.09]))
    with pytest.raises(SimulationFailed, match=r"at t = .* s Newton's .* not converge") as caught:
        simulate(model, times(0.2, 21), y0=y0, reference=pushed, step=2e-3)
    assert bool(torch.isfinite(caught.value.trajectory.y).all())
