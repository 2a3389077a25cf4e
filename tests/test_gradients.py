"""Gradients: every law by gradcheck; adjoint, sensitivities and backpropagation equal; finite differences; reproducible."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import pytest
import torch
from conftest import coarse
from torch import Tensor, nn
from torch.autograd import gradcheck
from torchdiffeq import odeint

import torchsoft.adjoint
from torchsoft import METHOD, Parameters, SoftGrasp, press
from torchsoft.adjoint import GradientFailed, differentiable_solution
from torchsoft.contact import Coulomb, SmoothSlip, moving_frame, normal_force, ramp
from torchsoft.control import Controllers, Profile, Reference, Setpoint, hold
from torchsoft.equilibrium import holding_force
from torchsoft.implicit import ImplicitStepper
from torchsoft.sensitivity import sensitivities
from torchsoft.shapes import Circle
from torchsoft.unrolled import unrolled_solution

NEWTON = 1e-10
"""Newton's tolerance of the compiled steps compared here [N]; 1e-11 is rounding, and not reached at every step."""
SAME_STEPS = 1e-10
"""Adjoint against backpropagation, relative: two solutions of the same stages."""
SMALL = 0.1
"""A gradient p dL/dp below this part of the largest one is the difference of larger terms."""
SAME_TAPE = 1e-11
"""Adjoint against sensitivities, relative: the same linear systems, transposed and not."""
WITHIN_MODE = 1e-6
ACROSS_MODES = 1e-4
"""Adjoint against central differences, relative."""
NOISE = 1e-3
"""A gradient p dL/dp below this part of the largest one is in the rounding of its central difference."""
ALONE = 1e-12
"""A sample alone against the same sample in a batch, relative."""
JUDGED = (
    "contact.K_n", "contact.R_n", "contact.K_t", "contact.friction.mu_s", "contact.friction.mu_k", "material.E",
    "material.nu", "material.tau", "shape.radius", "m_C", "controllers.R_80",
)  # fmt: skip
"""Parameters held against central differences, at least one of each law; the others follow from the other comparisons."""

UNITS = {"r_C": 1e-5, "theta": 1e-3, "r_Br": 1e-5, "v_C": 1e-3, "omega": 1e-1, "v_Br": 1e-3}
"""What counts as one unit of each signal in the loss: m, rad, m, m/s, rad/s, m/s."""


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def times(end: float, n: int) -> Tensor:
    return torch.linspace(0, end, n, dtype=torch.float64)


@dataclass(frozen=True)
class Window:
    """A short run: model, initial state (size,), outputs t (T,) [s], step [s]; `origin` are the signals at the start."""

    model: SoftGrasp
    y0: Tensor
    t: Tensor
    step: float
    origin: Tensor

    def compiled(self, y0: Tensor | None = None) -> Tensor:
        """States (T, size) by the compiled stepper, the discrete adjoint behind them."""
        stepper = ImplicitStepper(self.model, step=self.step, tolerance=NEWTON)
        return differentiable_solution(stepper, self.y0 if y0 is None else y0, self.t)[0]

    def loss(self, y: Tensor) -> Tensor:
        """Smooth, with another weight for every component: poses, velocities and control forces, less `origin`."""
        z = signals(self.model, y, self.t) - self.origin
        weight = torch.linspace(0.5, 1.5, z.numel(), dtype=torch.float64).reshape(z.shape)
        return (weight * (z + 0.1 * z**2)).sum()

    def gradients(self, y: Tensor, wanted: list[Tensor]) -> list[Tensor]:
        parts = torch.autograd.grad(self.loss(y), wanted, allow_unused=True)
        return [torch.zeros_like(x) if g is None else g for x, g in zip(wanted, parts)]


def signals(model: SoftGrasp, y: Tensor, t: Tensor) -> Tensor:
    """(T, 11): poses and velocities of disc and bracket in `UNITS`, and the control force [N]."""
    s = model.layout.unpack(y)
    parts = [(getattr(s, k) / unit).reshape(len(t), -1) for k, unit in UNITS.items()]
    force = torch.stack(model.controllers(model.reference(t), s.r_C, s.v_C, s.r_Br, s.v_Br), -1)
    return torch.cat((*parts, force), -1)


@torch.no_grad()
def window(model: SoftGrasp, y0: Tensor, t: Tensor, step: float) -> Window:
    return Window(model, y0, t, step, signals(model, y0[None], t[:1]))


def pressed(model: SoftGrasp, velocity: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """The frictionless grasp, held by the controllers, the disc moving at `velocity` [m/s]."""
    y = press(model, model.settings.scenario.y_Br_grasp).detach()
    state = model.layout.unpack(y)
    model.reference = hold(float(state.r_C[0]), float(state.r_Br[1]), -holding_force(model, y))
    y[model.layout.slices["v_C"]] = f64(*velocity)
    return y


def stick() -> Window:
    model = coarse()
    return window(model, pressed(model, (1e-2, 5e-3)), times(4e-3, 5), 1e-3)


def slip() -> Window:
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    return window(model, pressed(model, (0.08, 0.0)), times(2e-3, 5), 5e-4)


def make_break() -> Window:
    """Fast enough that nodes touch and leave within a few steps."""
    model = coarse(scenario__x_C0=0.0609)
    return window(model, pressed(model, (0.3, -0.02)), times(2e-3, 5), 5e-4)


def jerk() -> Window:
    """A light grasp, the horizontal loop about the bracket, and the bracket far from where that loop wants it."""
    model = coarse(scenario__y_Br_grasp=49.7e-3, control__senses="bracket", contact__mu_s=0.3, contact__mu_k=0.2)
    y0 = pressed(model)
    with torch.no_grad():
        model.reference.x.values += 2e-3
    return window(model, y0, times(6e-3, 5), 5e-4)


WINDOWS = {"stick": stick, "slip": slip, "make-break": make_break, "jerk": jerk}


@torch.no_grad()
def modes(model: SoftGrasp, y: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Which nodes touch and which slip, (T, nodes) each."""
    graph = model.evaluate(t, model.layout.unpack(y))
    on = torch.cat([i.frame.g > 0 for i in graph.interfaces.values()], -1)
    return on, on & torch.cat([i.contact.gamma_dot != 0 for i in graph.interfaces.values()], -1)


def scalars(model: SoftGrasp) -> dict[str, nn.Parameter]:
    """Every scalar parameter but the density, which massless pads do not use."""
    return {name: p for name, p in model.named_parameters() if p.ndim == 0 and name != "material.rho"}


@torch.no_grad()
def central_difference(function: Callable[[], Tensor], p: Tensor, relative: float) -> float:
    keep, ends, got = p.clone(), [], []
    for sign in (1, -1):
        p.copy_(keep * (1 + sign * relative))
        ends.append(float(p))
        got.append(float(function()))
    p.copy_(keep)
    return (got[0] - got[1]) / (ends[0] - ends[1])


def plateau(function: Callable[[], Tensor], p: Tensor, finer: float) -> float:
    """Central difference at the relative step where it changes least from one step to the next finer one."""
    values = [central_difference(function, p, finer * relative) for relative in (1e-3, 3e-4, 1e-4, 3e-5)]
    return min(pairwise(values), key=lambda pair: abs(pair[1] - pair[0]))[1]


# laws


def test_ramp_and_normal_force_by_gradcheck() -> None:
    g, g_dot = f64(3e-6, 5e-5, -2e-5).requires_grad_(), f64(-1e-4, 2e-2, 1e-2).requires_grad_()
    K_n, R_n = f64(1.2e5).requires_grad_(), f64(441.0).requires_grad_()
    check = {"eps": 1e-9, "atol": 1e-3, "rtol": 1e-4}  # g is some micrometres, so steps are nanometres
    assert gradcheck(lambda g: ramp(g, 1e-6), (g,), **check)
    assert gradcheck(lambda g, g_dot: normal_force(g, g_dot, ramp(g, 1e-6), K_n, R_n), (g, g_dot), **check)
    assert gradcheck(
        lambda K, R: normal_force(g.detach(), g_dot.detach(), ramp(g.detach(), 1e-6), K, R),
        (K_n, R_n),
        eps=1e-3,
        atol=1e-9,
    )


@pytest.mark.parametrize("E", [(3.0, 5.0), (9.0, 30.0)], ids=["stick", "slip"])
def test_smooth_slip_by_gradcheck(E: tuple[float, float]) -> None:
    """All arguments and parameters; at 10 N the cap is 8 N. Both forms of the root: 9 N and 30 N."""
    law = SmoothSlip(Parameters().contact)
    inputs = (
        f64(*E).requires_grad_(),
        f64(10.0, 10.0).requires_grad_(),
        *(f64(x).requires_grad_() for x in (441.0, 10)),
    )

    def rate(E: Tensor, F_N: Tensor, R: Tensor, eta: Tensor, *_: Tensor) -> Tensor:
        return 1e3 * law.slip_rate(E, F_N, R, eta)  # [mm/s]

    assert gradcheck(rate, (*inputs, *law.parameters()), eps=1e-7, atol=1e-6)
    slipping = E[0] > 8.0
    assert bool((rate(*inputs) > 0).all()) == slipping


@pytest.mark.parametrize("E", [3.0, 9.0], ids=["stick", "slip"])
def test_coulomb_by_gradcheck(E: float) -> None:
    law = Coulomb(Parameters().contact)
    inputs = tuple(f64(x).requires_grad_() for x in (E, 10.0, 441.0))
    assert gradcheck(
        lambda E, F_N, R, *_: 1e3 * law.slip_rate(E, F_N, R, f64(10.0)), (*inputs, *law.parameters()), atol=1e-6
    )


@pytest.mark.parametrize("stage", [0.0, 6e-4])
def test_contact_by_gradcheck(friction: str, stage: float) -> None:
    """Forces and rates of a sticking, two slipping (either way) and a separated node, in units of um, mm/s and N."""
    contact = coarse(contact__friction=friction).contact
    parameters = list(contact.parameters())
    share = torch.full((4,), 2.0, dtype=torch.float64)

    def outputs(g: Tensor, g_dot: Tensor, v_T: Tensor, s: Tensor, *_: Tensor) -> Tensor:
        out = contact(1e-6 * g, 1e-3 * g_dot, 1e-3 * v_T, 1e-6 * s, share, stage=stage)
        return torch.stack((out.F_N, out.F_T, 1e3 * out.s_dot, 1e3 * out.gamma_dot))

    x = (f64(60, 40, 40, -5), f64(5, -3, 2, 1), f64(1, 90, -80, 10), f64(3, 5, -5, 4))
    slipping = outputs(*x)[3] != 0
    assert slipping.tolist()[:3] == [False, True, True]
    assert gradcheck(outputs, tuple(v.requires_grad_() for v in x), eps=1e-6, atol=1e-5, rtol=1e-5)
    fixed = tuple(v.detach() for v in x)
    scale = [p.item() for p in parameters]

    def by_parameters(*log: Tensor) -> Tensor:
        values = dict(zip([n for n, _ in contact.named_parameters()], (a * b.exp() for a, b in zip(scale, log))))
        arguments = [a * b for a, b in zip(fixed, (1e-6, 1e-3, 1e-3, 1e-6))]
        out = torch.func.functional_call(contact, values, (*arguments, share), {"stage": stage})
        return torch.stack((out.F_N, out.F_T, 1e3 * out.s_dot, 1e3 * out.gamma_dot))

    assert gradcheck(by_parameters, tuple(f64(0.0)[0].requires_grad_() for _ in scale), eps=1e-6, atol=1e-5, rtol=1e-5)


def test_moving_frame_by_gradcheck() -> None:
    """Lengths in cm, so that gradcheck's step suits them."""
    shape = Circle(0.019)
    p, r_C, theta = f64(1.2, -1.4, 0.1, -1.9).reshape(2, 2), f64(0.05, 0.02), f64(0.7)[0]

    def frame(p: Tensor, r_C: Tensor, theta: Tensor, radius: Tensor) -> Tensor:
        with torch.no_grad():
            shape.radius.copy_(1e-2 * radius)
        f = moving_frame(shape, 1e-2 * p, 1e-2 * r_C, theta)
        return torch.cat((1e2 * f.d, f.n, f.t, 1e2 * (f.g + shape.radius.detach() - 1e-2 * radius)[..., None]), -1)

    inputs = [x.requires_grad_() for x in (p, r_C, theta)]
    assert gradcheck(lambda *x: frame(*x, radius=f64(1.9)[0]), inputs)


def test_controllers_and_profiles_by_gradcheck() -> None:
    controllers, profile = Controllers(Parameters().control), Profile([0.0, 0.4, 1.0], [0.06, 0.04, 0.05])
    profile.values.requires_grad_(True)
    t = f64(-0.1, 0.1, 0.3, 0.4, 0.7, 1.3)
    assert gradcheck(lambda *_: torch.stack(profile(t)), (profile.values,))
    assert gradcheck(lambda t: profile(t)[0], (f64(0.1, 0.3, 0.7).requires_grad_(),))
    want = [f64(x)[0].requires_grad_() for x in (0.06, 0.001, 0.048, 0.002, -70.0)]
    poses = [f64(*x).requires_grad_() for x in ((0.0601, 0.023), (0.01, 0.02), (0.06, 0.0481), (0.03, -0.01))]
    assert gradcheck(
        lambda *x: torch.stack(controllers(Setpoint(*x[:5]), *x[5:9])),
        (*want, *poses, *controllers.parameters()),
        rtol=1e-5,
    )


def test_one_unrolled_step_by_gradcheck() -> None:
    """Along one direction in the state and along all parameters at once; some nodes slip."""
    w = slip()
    values = {n: p.detach() for n, p in scalars(w.model).items() if n != "material.nu"}  # nu is solved for anew
    rigid = torch.arange(w.model.layout.slices["r_C"].start, w.model.layout.size)
    away = 1e-5 * torch.randn(len(rigid), generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    class Step(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = w.model

        def forward(self, y: Tensor) -> Tensor:
            return unrolled_solution(self.model, y, w.t[:2], step=w.step)[-1:]

    def end(a: Tensor, b: Tensor) -> Tensor:
        changed = {f"model.{n}": v * (1 + b) for n, v in values.items()}
        y = torch.func.functional_call(Step(), changed, (w.y0.index_add(0, rigid, away * a),))
        z = signals(w.model, y, w.t[1:2])[0]
        return torch.stack((z[:5].sum(), z[5:].sum()))

    inputs = (f64(0.0)[0].requires_grad_(), f64(0.0)[0].requires_grad_())
    assert gradcheck(end, inputs, eps=1e-6, atol=1e-4, rtol=1e-6, check_undefined_grad=False)


# runs


@pytest.mark.parametrize("name", WINDOWS)
def test_windows_are_what_they_are_called(name: str) -> None:
    w = WINDOWS[name]()
    with torch.no_grad():
        on, slipping = modes(w.model, w.compiled(), w.t)
    touching, leaving = int((on[1:] & ~on[:-1]).sum()), int((on[:-1] & ~on[1:]).sum())
    if name != "jerk":
        assert (touching > 0 and leaving > 0) if name == "make-break" else touching + leaving == 0
    assert bool(slipping.any()) == (name != "stick")


@pytest.mark.parametrize("name", WINDOWS)
def test_adjoint_equals_backpropagation_through_the_plain_step(name: str) -> None:
    """The initial state and every parameter; a gradient that is small by cancellation is held to the larger ones."""
    w = WINDOWS[name]()
    y0 = w.y0.requires_grad_(True)
    wanted = [y0, *scalars(w.model).values()]
    adjoint = w.gradients(w.compiled(), wanted)
    plain = w.gradients(unrolled_solution(w.model, y0, w.t, step=w.step), wanted)
    largest = max(float((b * p.detach()).norm()) for b, p in zip(plain[1:], wanted[1:]))
    for label, p, a, b in zip(["y0", *scalars(w.model)], wanted, adjoint, plain):
        floor = 0.0 if label == "y0" else SMALL * largest / float(p.detach().norm())
        assert float((a - b).norm()) <= SAME_STEPS * max(float(b.norm()), floor), (label, a, b)


def test_zero_stretch_of_a_node_that_never_touches() -> None:
    """Such a stretch only decays. The adjoint says so; torch's derivative of sign(s) |s| at s = 0 is zero."""
    w = stick()
    part, never = w.model.layout.slices["s_L"], 0  # the pad's first node
    at = part.start + never
    y0 = w.y0.clone().requires_grad_(True)
    (adjoint,) = torch.autograd.grad(w.compiled(y0)[1, at], y0)
    (plain,) = torch.autograd.grad(unrolled_solution(w.model, y0, w.t[:2], step=w.step)[1, at], y0)
    stretched = w.y0.clone()
    stretched[at] = 1e-6
    with torch.no_grad():
        decayed = w.compiled(stretched)[1, at] / 1e-6
    assert 0.1 < float(decayed) < 1.0
    assert float(adjoint[at]) == pytest.approx(float(decayed), rel=1e-12)
    assert float(plain[at]) == 1.0  # so it does not decay at all


@pytest.mark.parametrize("name", WINDOWS)
def test_adjoint_equals_sensitivities(name: str) -> None:
    w = WINDOWS[name]()
    names = list(scalars(w.model))
    adjoint = w.gradients(w.compiled(), list(scalars(w.model).values()))
    run = sensitivities(w.model, w.y0, w.t, names, step=w.step, tolerance=NEWTON)
    y = run.y.clone().requires_grad_(True)
    y_bar, *direct = w.gradients(y, [y, *scalars(w.model).values()])
    forward = torch.einsum("ti,tin->n", y_bar, run.dy) + torch.stack(direct)
    for label, a, b in zip(names, adjoint, forward):
        assert float((a - b).abs()) <= SAME_TAPE * float(b.abs()), (label, a, b)


@pytest.mark.parametrize(
    ("name", "bound"), [("stick", WITHIN_MODE), ("slip", WITHIN_MODE), ("make-break", ACROSS_MODES)]
)
def test_adjoint_equals_central_differences(name: str, bound: float) -> None:
    w = WINDOWS[name]()
    judged = {label: scalars(w.model)[label] for label in JUDGED}
    adjoint = [a.item() for a in w.gradients(w.compiled(), list(judged.values()))]
    largest = max(abs(a * p.item()) for a, p in zip(adjoint, judged.values()))
    for (label, p), a in zip(judged.items(), adjoint):
        judge = plateau(lambda: w.loss(w.compiled()), p, 1e-2 if label == "shape.radius" else 1.0)
        floor = NOISE * largest / p.item()
        assert abs(a - judge) <= bound * max(abs(judge), floor), (label, a, judge)


def test_gradient_by_the_initial_state_and_the_reference() -> None:
    """Along a random direction of y0, and by every value of the reference, against central differences."""
    model = coarse()
    y0 = pressed(model, (2e-3, 1e-3))
    x, y = (float(v) for v in (y0[model.layout.slices["r_C"]][0], y0[model.layout.slices["r_Br"]][1]))
    force = float(model.reference.F_y.values[0])
    ramp_ = [0.0, 0.02]
    model.reference = Reference(
        Profile(ramp_, [x, x - 1e-3]), Profile(ramp_, [y, y - 1e-5]), Profile(ramp_, [force, force - 1.0])
    )
    for p in model.reference.parameters():
        p.requires_grad_(True)
    w = window(model, y0.requires_grad_(True), times(8e-3, 9), 1e-3)
    y0_bar, *bars = w.gradients(w.compiled(), [y0, *model.reference.parameters()])
    generator = torch.Generator().manual_seed(1)
    away = 1e-9 * torch.randn(model.layout.size, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        up, down = (float(w.loss(w.compiled(y0.detach() + sign * away))) for sign in (1, -1))
    assert float(y0_bar @ away) == pytest.approx((up - down) / 2, rel=WITHIN_MODE)
    for (label, p), bar in zip(model.reference.named_parameters(), bars):
        for i in range(len(p)):
            keep, got, size = p.detach().clone(), [], 1e-3 if label.startswith("F_y") else 1e-8  # [N], [m]
            for sign in (1, -1):
                with torch.no_grad():
                    p[i] += sign * size
                    got.append(float(w.loss(w.compiled())))
                    p.copy_(keep)
            assert float(bar[i]) == pytest.approx((got[0] - got[1]) / (2 * size), rel=1e-5), (label, i)


def test_a_sample_does_not_depend_on_its_neighbours() -> None:
    """Trajectory and gradient of a sample alone and in a batch, through torchdiffeq."""
    w = slip()
    other = w.y0.clone()
    other[w.model.layout.slices["v_C"]] = f64(-0.02, 0.01)

    def solve(y: Tensor) -> tuple[Tensor, Tensor]:
        y = y.clone().requires_grad_(True)
        solution = odeint(w.model, y, w.t, method=METHOD, options={"step_size": w.step, "tolerance": NEWTON})
        first = solution if solution.ndim == 2 else solution[:, 0]
        return first.detach(), torch.autograd.grad(w.loss(first), y)[0]

    alone, gradient = solve(w.y0)
    for neighbours in ([other], [other, w.y0, 0.5 * (other + w.y0)]):
        solution, bars = solve(torch.stack((w.y0, *neighbours)))
        assert float((solution - alone).abs().max()) <= ALONE
        assert float((bars[0] - gradient).norm()) <= ALONE * float(gradient.norm())
        assert float(bars[1:].abs().max()) == 0.0


def test_same_gradient_twice_and_from_checkpoints_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when every tape is made again from where its segment began, over several segments."""
    model = coarse()
    y0 = pressed(model, (2e-3, 1e-3)).requires_grad_(True)
    t = torch.cat((times(0.4, 201), f64(0.401, 0.402)))  # another step size at the end: another segment
    w = window(model, y0, t, 4e-4)
    wanted = [y0, *scalars(model).values()]
    first, second = (w.gradients(w.compiled(), wanted) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second))
    monkeypatch.setattr(torchsoft.adjoint, "TAPE_BYTES", 0)
    again = w.gradients(w.compiled(), wanted)
    assert all(torch.equal(a, b) for a, b in zip(first, again))


def test_a_gradient_that_is_not_finite_says_when_and_where() -> None:
    w = stick()
    solution = w.compiled()
    bad = torch.zeros_like(solution)
    bad[3, w.model.layout.slices["v_C"]] = torch.nan
    with pytest.raises(GradientFailed, match=r"not finite at t = 0\.0020 s, at node \d+"):
        solution.backward(bad)


def test_sensitivities_name_what_is_wrong_with_their_arguments() -> None:
    w = stick()
    with pytest.raises(ValueError, match=r"holds \['contact.K_x'\]; known: .*contact.K_n"):
        sensitivities(w.model, w.y0, w.t, ["contact.K_n", "contact.K_x"], step=w.step)
    with pytest.raises(ValueError, match="`names` must be scalar parameters"):
        sensitivities(w.model, w.y0, w.t, [], step=w.step)
    with pytest.raises(ValueError, match="`dy0` must have shape"):
        sensitivities(w.model, w.y0, w.t, ["contact.K_n"], step=w.step, dy0=torch.zeros(3, 1, dtype=torch.float64))
    with pytest.raises(NotImplementedError, match="for massless pads"):
        sensitivities(coarse(pad__fidelity="inertial"), w.y0, w.t, ["contact.K_n"], step=w.step)
