"""`simulate` and its trajectory: what runs is what is saved, gradients reach what was put in, and
nothing unphysical runs."""

import numpy as np
import pytest
import torch
from conftest import (
    COARSE,
    PAPER,
    RUBBER,
    Exp,
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
    Actuator,
    Coulomb,
    Ellipse,
    Profile,
    Rig,
    Shape,
    SmoothSlip,
    StandardLinearSolid,
    hold,
    simulate,
)
from torchsoft.rigs.excite import Excitation
from torchsoft.solve import stepper, system
from torchsoft.solve.gradients import GradientFailed
from torchsoft.solve.progress import SimulationFailed

T = times(0.02, 11)


def rolled(model: Rig, **options: object):
    """A short run from the grasp, the disc moving."""
    return simulate(model, T, y0=grasped(model, (0.05, 0.0)), step=2e-3, **options)


# what runs is what is saved
# ----------------------------------------------------------------------


def test_values_set_on_the_module_run_and_are_saved():
    """A number set in place is in what the run says of itself, and in the run."""
    model, other = coarse(), coarse(contact__K_n=2e5)
    y0 = grasped(other, (0.05, 0.0))
    model.reference = other.reference
    model.contacts["L"].law.K_n.data = f64(2e5)[0]
    run, expected = (simulate(m, T, y0=y0) for m in (model, other))
    assert torch.equal(run.y, expected.y)
    assert run.made_by == expected.made_by
    assert run.made_by["parameters"]["laws.steel_on_rubber.K_n"] == 2e5


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


class Polygonal(Shape):
    """A shape of somebody's own in plain torch: a circle by its support, radius and all."""

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.r = nn.Parameter(torch.tensor(radius, dtype=torch.float64))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        d = (x * x).sum(-1).sqrt()
        return d - self.r, x / d[..., None]

    def gyration(self) -> Tensor:
        return self.r**2 / 2

    def support(self, direction: Tensor) -> Tensor:
        return self.r * (direction * direction).sum(-1).sqrt()


def test_a_shape_and_a_friction_law_of_ones_own_run_with_gradients():
    """The same circle and the same law written anew: the same run, and the same gradients."""
    built_in = coarse()
    mine = SmoothSlip(0.8, 0.7, 0.05).requires_grad_(False)  # captured, so a constant of the law
    own = still(COARSE, friction=lambda E, F_N, R: mine(E, F_N, R), shape=Polygonal(19.37e-3))
    one, other = rolled(built_in, gradient="discrete"), rolled(own, gradient="discrete")
    assert float((one.y - other.y).detach().abs().max()) < 1e-9
    a, b = (
        torch.autograd.grad(run["theta"][-1], r)[0]
        for run, r in (
            (one, built_in.bodies["disc"].shape.radius),
            (other, own.bodies["disc"].shape.r),
        )
    )
    assert float(a) == pytest.approx(float(b), rel=1e-6)


# gradients reach what was put in
# ----------------------------------------------------------------------


def test_what_becomes_of_the_reference_and_the_model_does_not_change_the_gradient():
    """Between run and backward: another reference, knots moved in place, a parameter set in
    place."""
    model = coarse()
    run = rolled(model, gradient="discrete")
    wanted = [model.parameter(name) for name in ("pad.E", "contact.K_t", "control.R_80")]
    before = torch.autograd.grad(run["theta"][-1], wanted, retain_graph=True)
    with torch.no_grad():
        model.reference["x_d"].values += 1e-3
    model.reference = hold(x_d=0.03, y_d=0.07, F_ff=9.0)
    after = torch.autograd.grad(run["theta"][-1], wanted, retain_graph=True)
    model.contacts["L"].law.K_n.data = f64(5e5)[0]
    last = torch.autograd.grad(run["theta"][-1], wanted)
    assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(before, after, last))


class Simulated(nn.Module):
    """A run as a module, for functional_call."""

    def __init__(self, model: Rig, **options: object) -> None:
        super().__init__()
        self.model, self.options = model, options

    def forward(self, y0: Tensor) -> Tensor:
        return simulate(self.model, T, y0=y0, step=2e-3, gradient="discrete", **self.options)[
            "theta"
        ][-1]


def test_gradients_reach_the_tensors_of_a_functional_call():
    model = coarse()
    y0 = grasped(model, (0.05, 0.0))
    names = {
        "pads.L.material.E": 0.8e6, "contacts.L.law.K_n": 1e5, "bodies.disc.shape.radius": 19.4e-3,
        "actuators.x.law.Kp": 1e5,
    }  # fmt: skip
    put_in = {f"model.{name}": f64(value)[0].requires_grad_() for name, value in names.items()}
    theta = torch.func.functional_call(Simulated(model), put_in, (y0,))
    got = torch.autograd.grad(theta, list(put_in.values()))
    changed = coarse()
    changed.reference = model.reference
    with torch.no_grad():
        for name, value in names.items():
            changed.get_parameter(name).fill_(value)
    other = Simulated(changed)(y0)
    expected = torch.autograd.grad(other, [changed.get_parameter(name) for name in names])
    assert torch.equal(theta.detach(), other.detach())
    assert all(torch.equal(a, b) for a, b in zip(got, expected))
    assert all(float(x) != 0 for x in got)
    assert float(model.parameter("pad.E").detach()) == 0.75e6


def test_parametrized_parameters_get_their_gradients():
    """d/d log p = p d/dp, for a parameter of every kind of part."""
    plain, logarithmic = (coarse(contact__mu_s=0.3, contact__mu_k=0.2) for _ in "12")
    y0 = grasped(plain, (0.08, 0.0))
    logarithmic.reference = plain.reference
    names = ("K_t", "mu_s", "E", "nu", "Kd", "radius", "mass")

    def owners(m: Rig) -> zip:
        law, rubber, disc = m.contacts["L"].law, m.pads["L"].material, m.bodies["disc"]
        loop = m.actuators["x"].law
        return zip((law, law.friction, rubber, rubber, loop, disc.shape, disc), names)

    values = [getattr(owner, name) for owner, name in owners(plain)]
    for owner, name in owners(logarithmic):
        parametrize.register_parametrization(owner, name, Exp())
    logs = [owner.parametrizations[name].original for owner, name in owners(logarithmic)]
    wanted, got = (
        torch.stack(torch.autograd.grad(Simulated(model)(y0), leaves))
        for model, leaves in ((plain, values), (logarithmic, logs))
    )
    assert bool((wanted != 0).all())
    expected = wanted * torch.stack(values).detach()
    torch.testing.assert_close(got, expected, rtol=1e-8, atol=0)


def test_tied_parameters_get_the_sum_of_their_gradients():
    """One tensor as two parameters of a law, and as parameters of different parts."""
    plain, tied = coarse(), coarse()
    y0 = grasped(plain, (0.05, 0.01))
    tied.reference = plain.reference
    law = tied.contacts["L"].law
    law.R_t = law.R_n
    tied.actuators["y"].law.Kp = law.K_n  # 1.2e5 N/m all of them
    law.K_t = law.K_n
    names = ("contact.R_n", "contact.R_t", "contact.K_n", "contact.K_t", "control.K_98")
    R_n, R_t, K_n, K_t, K_98 = torch.autograd.grad(
        Simulated(plain)(y0), [plain.parameter(n) for n in names]
    )
    R, K = torch.autograd.grad(Simulated(tied)(y0), [law.R_n, law.K_n])
    assert float(R) == pytest.approx(float(R_n + R_t), rel=1e-9)
    assert float(K) == pytest.approx(float(K_n + K_t + K_98), rel=1e-9)
    assert min(abs(float(x)) for x in (R_n, R_t, K_n, K_t, K_98)) > 0


def test_what_has_no_gradient_says_so():
    """Integrals over the steps, and second derivatives; one of no weight in a sum is none."""
    model = coarse()
    run = rolled(model, gradient="discrete")
    lost = run.dissipated["slip"][-1]
    with pytest.raises(GradientFailed, match=r"the integral `slip` .* has no gradient"):
        (run["theta"][-1] + lost).backward(retain_graph=True)
    (run["theta"][-1] + 0.0 * lost).backward(retain_graph=True)
    with pytest.raises(GradientFailed, match="has no second derivative"):
        torch.autograd.grad(run["theta"][-1], model.parameter("pad.E"), create_graph=True)
    assert not rolled(model).dissipated["slip"].requires_grad


SHARE = 0.5
"""A number that the law below reads from its module."""


class Sharing(nn.Module):
    """A slip law that depends on a global number."""

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return (E - SHARE * F_N).clamp(min=0.0) / R


def test_a_law_is_what_its_code_is_now():
    """A global that it reads, and the number of iterations of a shape of the package, changed
    between two runs."""
    model = still(COARSE, friction=Sharing())
    y0 = grasped(model, (0.08, 0.0))
    first = simulate(model, T, y0=y0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(globals(), "SHARE", 0.9)
        assert not torch.equal(simulate(model, T, y0=y0).y, first.y)
    assert torch.equal(simulate(model, T, y0=y0).y, first.y)
    oval = still(COARSE, shape=Ellipse(20e-3, 18.8e-3))
    with pytest.MonkeyPatch.context() as patch:
        exact = simulate(oval, T, y0=y0).y
        patch.setattr(Ellipse, "ITERATIONS", 1)
        assert not torch.equal(simulate(oval, T, y0=y0).y, exact)


def test_what_is_saved_is_what_ran():
    """Numbers behind parametrizations, laws and shapes that were replaced, an optimiser's step,
    what was loaded."""
    model, other = coarse(), coarse(contact__K_n=2e5)
    y0 = grasped(model, (0.05, 0.0))
    said = lambda: simulate(model, T, y0=y0).made_by
    law, E = model.contacts["L"].law, model.parameter("pad.E")
    parametrize.register_parametrization(law, "K_t", Exp())
    with torch.no_grad():
        law.parametrizations.K_t.original.add_(0.1)
    assert said()["parameters"]["laws.steel_on_rubber.K_t"] == law.K_t.item() != 1.2e5
    model.load_state_dict(other.state_dict(), strict=False)
    assert said()["parameters"]["laws.steel_on_rubber.K_n"] == 2e5
    optimiser = torch.optim.SGD([E], lr=1e12)
    rolled(model, gradient="discrete")["theta"][-1].backward()
    optimiser.step()
    assert said()["parameters"]["materials.rubber.E"] == E.item() != 0.75e6
    law.friction = Coulomb(0.5, 0.4)
    made_by = said()
    assert made_by["friction"]["L"] == "Coulomb"
    assert "laws.steel_on_rubber.friction.v_s" not in made_by["parameters"]
    assert made_by["control"] == {"x": "PD", "y": "PD"}
    assert made_by["mesh"]["L"] == f"PadMesh, {len(model.pads['L'].mesh.nodes)} nodes"
    oval = still(COARSE, shape=Ellipse(19.8e-3, 19.1e-3))
    described = oval.description()
    assert "bodies.disc.shape.radius" not in described["parameters"]
    assert described["shape"] == {"disc": "Ellipse"}
    oval.actuators["x"] = Actuator(
        "disc.x", "bracket.x", lambda w, w_dot, f, q, q_dot: f - 1e3 * q, setpoint="x_d"
    )
    assert oval.description()["control"]["x"].endswith("<lambda>")


# surroundings
# ----------------------------------------------------------------------


def made_and_run() -> list[Tensor]:
    """Parts made, a motion begun and run with gradients and sensitivities."""
    roll = {"kind": "multi_sine", "amplitude": 1e-3, "band": (5.0, 20.0)}
    excitation = Excitation(roll, duration=0.5, grasp=0.05, since=0.07)
    rig, y0, _ = excited(excitation, PAPER.override(COARSE))
    run = simulate(rig, times(0.1, 6), y0=y0, gradient="discrete")
    forward = simulate(rig, run.t, y0=y0, gradient="forward", wrt=["pad.E", "pad.nu"])
    wanted = [rig.parameter(name) for name in ("pad.E", "contact.K_t")]
    gradients = torch.autograd.grad(run["y_C"][-1], wanted)
    oval = still(COARSE, shape=Ellipse(19.8e-3, 19.1e-3), friction=Coulomb(0.5, 0.4))
    parts = [
        rest(oval),
        oval(0.0, rest(oval)),
        run.y,
        *run.channels.values(),
        *run.energy.values(),
    ]
    return [*parts, *gradients, forward.sensitivities]


def test_torchs_default_dtype_does_not_matter():
    """To the bit."""
    expected, before = made_and_run(), torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    try:
        found = made_and_run()
    finally:
        torch.set_default_dtype(before)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_other_settings_of_the_process_do_not_matter():
    """numpy's errors raised, denormal numbers flushed, inference mode."""
    model = coarse()
    y0 = grasped(model, (0.05, 0.0))
    expected = simulate(model, T, y0=y0).y
    with np.errstate(all="raise"):
        assert torch.equal(simulate(model, T, y0=y0).y, expected)
    torch.set_flush_denormal(True)
    try:
        assert torch.equal(simulate(model, T, y0=y0).y, expected)
    finally:
        torch.set_flush_denormal(False)
    with torch.inference_mode():
        assert torch.equal(simulate(model, T, y0=y0, gradient="discrete").y, expected)


# routes
# ----------------------------------------------------------------------


def test_a_run_with_gradients_may_follow_one_in_inference_mode():
    """Both use the same compliances, which the first has computed."""
    model = coarse()
    model.pads["L"].material.nu.data.fill_(0.4321)  # of no other test
    y0 = torch.from_numpy(grasped(coarse(), (0.05, 0.0)).detach().numpy())
    with torch.inference_mode():
        run = simulate(model, T, y0=y0)
    again = simulate(model, T, y0=y0, gradient="discrete")
    assert torch.equal(again.y, run.y)
    again["y_C"][-1].backward()
    assert model.pads["L"].material.nu.grad.abs() > 0


def test_no_grad_is_honoured():
    model = coarse()
    y0 = grasped(model, (0.01, 0.0)).requires_grad_()
    t = times(2e-3, 3)
    with torch.no_grad():
        for route in ("none", "discrete"):
            run = simulate(model, t, y0=y0, gradient=route)
            assert not run.y.requires_grad, route
            assert not any(channel.requires_grad for channel in run.channels.values()), route
    assert simulate(model, t, y0=y0, gradient="discrete")["theta"].requires_grad
    assert not simulate(model, t, y0=y0)["theta"].requires_grad


def test_routes_agree_on_the_run():
    model = coarse()
    y0, t = grasped(model, (0.01, 0.0)), times(4e-3, 3)
    with torch.no_grad():
        none, discrete = (
            simulate(model, t, y0=y0, step=2e-3, gradient=route, tolerance=1e-10).y
            for route in ("none", "discrete")
        )
    forward = simulate(
        model, t, y0=y0, step=2e-3, gradient="forward", wrt=["pad.E"], tolerance=1e-10
    )
    assert torch.equal(none, discrete)
    assert torch.equal(none, forward.y)


# nothing unphysical runs
# ----------------------------------------------------------------------


def test_every_second_number_of_a_tensor_is_as_good_as_a_tensor():
    model, t = coarse(), times(0.02, 5)
    y0 = grasped(model, (0.05, 0.0)).detach()
    run = simulate(model, t, y0=y0)
    twice = lambda x: torch.stack((x, x), 1)[:, 0]
    for gradient in ("none", "discrete"):
        again = simulate(model, twice(t), y0=twice(y0), knots=twice(run.knots), gradient=gradient)
        torch.testing.assert_close(again.y, run.y, rtol=0, atol=1e-12)


def test_parts_replaced_after_a_run_run():
    """A material with more branches after the first run."""
    model, fresh = coarse(), coarse()
    simulate(model, T, y0=grasped(model))
    rubber = StandardLinearSolid(**RUBBER, E_instant=1.5e6, tau=0.01)
    for pad in (*model.pads.values(), *fresh.pads.values()):
        pad.material = rubber
    assert model.layout.size > coarse().layout.size
    y0 = grasped(fresh)
    model.reference = fresh.reference
    assert torch.equal(simulate(model, T, y0=y0).y, simulate(fresh, T, y0=y0).y)


def test_a_law_that_turns_nan_never_converges():
    """The slip rate of an effort from 13 to 90 N is not a number: the run ends there, and says
    so."""

    def broken(E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return torch.where(
            (E > 13.0) & (E < 90.0) & (F_N > 10.0), torch.nan, (E - 0.8 * F_N).clamp(min=0.0) / R
        )

    model = still(COARSE, friction=broken)
    y0 = grasped(model)
    pushed = towards(model, Profile([0.0, 0.2], [0.06, 0.09]))
    with pytest.raises(
        SimulationFailed, match=r"at t = .* s Newton's iteration did not converge"
    ) as caught:
        simulate(model, times(0.2, 21), y0=y0, reference=pushed, step=2e-3)
    assert bool(torch.isfinite(caught.value.trajectory.y).all())


# materials
# ----------------------------------------------------------------------


@pytest.mark.parametrize("when", ["computed", "integrate"])
def test_a_run_has_the_parameters_that_it_began_with(monkeypatch, when):
    """Those that another thread changed meanwhile made results that belong to no value: 38 runs of
    60 with E, 53 with a mass."""
    model = coarse()
    y0, t, before = grasped(model), times(0.02, 5), {}
    model.reference["x_d"].values.requires_grad_()

    def result() -> list[Tensor]:
        run = simulate(model, t, y0=y0, gradient="discrete")
        energies = torch.stack(list(run.energy.values()))[:, -1]
        ends = torch.stack([x[-1] for x in run.channels.values()])
        wanted = [p for p in model.parameters() if p.requires_grad]
        slopes = torch.autograd.grad(energies.sum() + ends.sum(), wanted, materialize_grads=True)
        told = torch.tensor([*run.made_by["parameters"].values()][:3])
        return [energies.detach(), ends.detach(), told, *slopes]

    def changing(make):
        def other(*arguments):
            with torch.no_grad():
                for value in model.parameters():
                    before.setdefault(value, value.clone())
                    value.mul_(1.01)
            return make(*arguments)

        return other

    expected = result()
    if when == "integrate":
        make = stepper.ImplicitStepper.integrate
        monkeypatch.setattr(stepper.ImplicitStepper, "integrate", changing(make))
    else:
        monkeypatch.setattr(system, "computed", changing(system.computed))
    found = result()
    assert len(before) > 10
    assert all(map(torch.equal, found, expected))
    assert simulate(model, t, y0=y0).rig is model
