"""Gradients of runs: adjoint, sensitivities and backpropagation equal; finite differences; reproducible to the bit."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import pytest
import torch
from conftest import coarse, f64, grasped, random_state, times, turning
from torch import Tensor, nn
from torch.autograd import gradcheck
from torchdiffeq import odeint
from unrolled import unrolled_solution

import torchsoft.solve.adjoint
from torchsoft import METHOD, Parameters, Profile, Reference, Rig, SoftGrasp, simulate
from torchsoft.channels import MEASURED
from torchsoft.paper.rig import NAMES
from torchsoft.solve.adjoint import GradientFailed
from torchsoft.solve.trajectory import channels

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
    "contact.K_n", "contact.R_n", "contact.K_t", "contact.mu_s", "contact.mu_k", "pad.E", "pad.nu", "pad.tau",
    "disc.radius", "disc.mass", "disc.inertia_ratio", "control.R_80",
)  # fmt: skip
"""Parameters held against central differences, at least one of each law; the others follow from the other comparisons."""

UNITS = f64(1e-5, 1e-5, 1e-3, 1e-5, 1e-5, 1e-3, 1e-3, 1e-1, 1e-3, 1e-3, 1.0, 1.0)
"""What counts as one unit of each measured channel in the loss: m, rad, m/s, rad/s, N."""


@dataclass(frozen=True)
class Window:
    """A short run: model, initial state (size,), outputs t (T,) [s], step [s]; `origin` are the channels at the start."""

    model: SoftGrasp
    y0: Tensor
    t: Tensor
    step: float
    origin: Tensor

    def compiled(self, y0: Tensor | None = None) -> Tensor:
        """States (T, size) by the compiled stepper, the discrete adjoint behind them."""
        y0 = self.y0 if y0 is None else y0
        return simulate(self.model, self.t, y0=y0, step=self.step, tolerance=NEWTON, gradient="discrete").y

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
    """A light grasp, the horizontal loop about the bracket, and the bracket far from where that loop wants it."""
    model = coarse(scenario__y_Br_grasp=49.7e-3, control__senses="bracket", contact__mu_s=0.3, contact__mu_k=0.2)
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
    """Every trained scalar parameter but the density, which massless pads do not use, by the names of `Parameters`."""
    known = {own: name for name, own in NAMES.items()}
    found = {known[name]: p for name, p in model.named_parameters() if p.ndim == 0 and p.requires_grad}
    return {name: p for name, p in found.items() if name != "pad.rho"}


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
    values = [central_difference(function, p, finer * relative) for relative in (3e-4, 1e-4, 3e-5)]
    return min(pairwise(values), key=lambda pair: abs(pair[1] - pair[0]))[1]


# one step -----------------------------------------------------------------------------------------------------------


def test_one_unrolled_step_by_gradcheck() -> None:
    """Along one direction in the state and along all parameters at once; some nodes slip."""
    w = slip()
    values = {NAMES[n]: p.detach() for n, p in scalars(w.model).items() if n != "pad.nu"}  # nu is solved for anew
    rigid = torch.arange(w.model.layout.slices["pose", "disc"].start, w.model.layout.size)
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
        z = measured(w.model, y, w.t[1:2])[0]
        return torch.stack((z[:5].sum(), z[5:].sum()))

    inputs = (f64(0.0)[0].requires_grad_(), f64(0.0)[0].requires_grad_())
    assert gradcheck(end, inputs, eps=1e-6, atol=1e-4, rtol=1e-6, check_undefined_grad=False)


def test_zero_stretch_of_a_node_that_never_touches() -> None:
    """Such a stretch only decays, whichever way the gradient is found."""
    w = stick()
    part, never = w.model.layout.slices["stretch", "L"], 0  # the pad's first node
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
    assert float(plain[at]) == pytest.approx(float(decayed), rel=1e-12)


# runs ---------------------------------------------------------------------------------------------------------------


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
    assert len(wanted) == 22
    adjoint = w.gradients(w.compiled(), wanted)
    plain = w.gradients(unrolled_solution(w.model, y0, w.t, step=w.step), wanted)
    largest = max(float((b * p.detach()).norm()) for b, p in zip(plain[1:], wanted[1:]))
    for label, p, a, b in zip(["y0", *scalars(w.model)], wanted, adjoint, plain):
        floor = 0.0 if label == "y0" else SMALL * largest / float(p.detach().norm())
        assert float((a - b).norm()) <= SAME_STEPS * max(float(b.norm()), floor), (label, a, b)


@pytest.mark.parametrize("name", WINDOWS)
def test_adjoint_equals_sensitivities(name: str) -> None:
    w = WINDOWS[name]()
    names = list(scalars(w.model))
    adjoint = w.gradients(w.compiled(), list(scalars(w.model).values()))
    run = simulate(w.model, w.t, y0=w.y0, step=w.step, tolerance=NEWTON, gradient="forward", wrt=names)
    assert run.sensitivities is not None
    assert run.wrt == tuple(names)
    y = run.y.clone().requires_grad_(True)
    y_bar, *direct = w.gradients(y, [y, *scalars(w.model).values()])
    forward = torch.einsum("ti,tin->n", y_bar, run.sensitivities) + torch.stack(direct)
    for label, a, b in zip(names, adjoint, forward):
        assert float((a - b).abs()) <= SAME_TAPE * float(b.abs()), (label, a, b)
    rigid = simulate(w.model, w.t, y0=w.y0, step=w.step, tolerance=NEWTON, gradient="forward", wrt=names, rigid=True)
    assert rigid.sensitivities is not None
    assert torch.equal(rigid.sensitivities, run.sensitivities[:, -10:])


def test_sensitivities_begin_with_those_of_the_start() -> None:
    """dy0 carried to the end is the Jacobian's product with it, by the adjoint."""
    w = stick()
    dy0 = 1e-6 * torch.randn(len(w.y0), 1, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    one, other = (
        simulate(w.model, w.t, y0=w.y0, step=w.step, tolerance=NEWTON, gradient="forward", wrt=["pad.E"], dy0=start)
        for start in (None, dy0)
    )
    assert one.sensitivities is not None
    assert other.sensitivities is not None
    assert torch.equal(other.sensitivities[0], dy0)
    carried = float((other.sensitivities - one.sensitivities)[-1, -6, 0])
    y0 = w.y0.clone().requires_grad_()
    (row,) = torch.autograd.grad(w.compiled(y0)[-1, -6], y0)
    assert carried == pytest.approx(float(row @ dy0[:, 0]), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "bound"), [("stick", WITHIN_MODE), ("slip", WITHIN_MODE), ("make-break", ACROSS_MODES)]
)
def test_adjoint_equals_central_differences(name: str, bound: float) -> None:
    w = WINDOWS[name]()
    judged = {label: scalars(w.model)[label] for label in JUDGED}
    adjoint = [a.item() for a in w.gradients(w.compiled(), list(judged.values()))]
    largest = max(abs(a * p.item()) for a, p in zip(adjoint, judged.values()))
    for (label, p), a in zip(judged.items(), adjoint):
        judge = plateau(lambda: w.loss(w.compiled()), p, 1e-2 if label == "disc.radius" else 1.0)
        floor = NOISE * largest / p.item()
        assert abs(a - judge) <= bound * max(abs(judge), floor), (label, a, judge)


OTHERS: dict[str, Callable[[], tuple[Rig, Tensor]]] = {
    "turning": lambda: ((rig := turning()), random_state(rig, 3, slip=0.005)),
    "inertial": lambda: ((rig := coarse(pad__fidelity="inertial")), grasped(rig, (0.02, 5e-3))),
    "two points an element": lambda: ((rig := coarse(contact__points=2)), grasped(rig, (0.02, 5e-3))),
}


@pytest.mark.parametrize("name", OTHERS)
def test_gradients_of_other_rigs_by_differences(name: str) -> None:
    """A bracket that turns, inertial pads, Gauss points: along a direction of the start, and by the parameters that matter."""
    rig, y0 = OTHERS[name]()
    t, size = times(3e-3, 4), rig.layout.size
    weight, away = (torch.randn(size, generator=torch.Generator().manual_seed(i), dtype=torch.float64) for i in (0, 1))
    weight[: rig.layout.slices["pose", "disc"].start] = 0.0

    def loss(start: Tensor = y0) -> Tensor:
        return simulate(rig, t, y0=start, step=5e-4, tolerance=NEWTON, gradient="discrete").y[1:].mv(weight).sum()

    start = y0.clone().requires_grad_()
    parameters = {name: p for name, p in rig.named_parameters() if p.ndim == 0 and p.requires_grad}
    y0_bar, *bars = torch.autograd.grad(loss(start), [start, *parameters.values()], allow_unused=True)
    with torch.no_grad():
        up, down = (float(loss(y0 + sign * 1e-9 * away)) for sign in (1, -1))
    assert float(y0_bar @ away) == pytest.approx((up - down) / 2e-9, rel=1e-5)
    found = {n: float(bar * p.detach()) for (n, p), bar in zip(parameters.items(), bars) if bar is not None}
    largest = sorted(found, key=lambda n: -abs(found[n]))[:6]
    for label in largest:
        p, finer = parameters[label], 1e-2 if "radius" in label else 1.0
        wide, narrow = (central_difference(loss, p, finer * h) * p.item() for h in (1e-4, 5e-5))
        judge = (4 * narrow - wide) / 3
        assert abs(found[label] - judge) <= 1e-5 * max(abs(judge), 1e-2 * abs(found[largest[0]])), (
            label,
            found[label],
            judge,
        )


def test_gradient_by_the_initial_state_and_the_reference() -> None:
    """Along a random direction of y0, and by every value of the reference, against central differences."""
    model = coarse()
    y0 = grasped(model, (2e-3, 1e-3))
    x, y, force = (float(model.reference[name].values[0]) for name in ("x_d", "y_d", "F_ff"))
    ramp = [0.0, 0.02]
    model.reference = Reference(
        x_d=Profile(ramp, [x, x - 1e-3]), y_d=Profile(ramp, [y, y - 1e-5]), F_ff=Profile(ramp, [force, force - 1.0])
    )
    for p in model.reference.parameters():
        p.requires_grad_(True)
    w = window(model, y0.requires_grad_(True), times(8e-3, 9), 1e-3)
    y0_bar, *bars = w.gradients(w.compiled(), [y0, *model.reference.parameters()])
    away = torch.zeros(model.layout.size, dtype=torch.float64)
    for (part, _), where in model.layout.slices.items():  # about a nanometre each, in forces as well
        noise = torch.randn(where.stop - where.start, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        away[where] = (1e-4 if part == "pads" else 1e-9) * noise
    with torch.no_grad():
        up, down = (float(w.loss(w.compiled(y0.detach() + sign * away))) for sign in (1, -1))
    assert float(y0_bar @ away) == pytest.approx((up - down) / 2, rel=WITHIN_MODE)
    for (label, p), bar in zip(model.reference.named_parameters(), bars):
        for i in range(len(p)):
            keep, got, size = p.detach().clone(), [], 1e-3 if "F_ff" in label else 1e-8  # [N], [m]
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
    other[w.model.layout.slices["velocity", "disc"]] = f64(-0.02, 0.01, 0.0)

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
    y0 = grasped(model, (2e-3, 1e-3)).requires_grad_(True)
    t = torch.cat((times(0.4, 201), f64(0.401, 0.402)))  # another step size at the end: another segment
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


def test_simulate_names_what_is_wrong_with_what_is_wanted() -> None:
    w = stick()

    def forward(wrt: list[str], model: SoftGrasp = w.model, **more: Tensor) -> None:
        simulate(model, w.t, y0=w.y0, step=w.step, gradient="forward", wrt=wrt, **more)

    with pytest.raises(ValueError, match=r"`contact.K_x` is not a parameter of this rig; known: .*contact.K_n"):
        forward(["contact.K_n", "contact.K_x"])
    with pytest.raises(ValueError, match="gradient='forward' needs the parameters' names `wrt`, or directions `dy0`"):
        forward([])
    with pytest.raises(ValueError, match="`wrt` names the parameters of gradient='forward'"):
        simulate(w.model, w.t, y0=w.y0, step=w.step, gradient="discrete", wrt=["contact.K_n"])
    with pytest.raises(ValueError, match=r"`dy0` must have shape \(376, 1\), or more columns, but has"):
        forward(["contact.K_n"], dy0=torch.zeros(3, 1, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"`contact\.epsilon` must be a scalar parameter that requires a gradient"):
        forward(["contact.epsilon"])


def test_defaults_of_parameters_are_the_windows() -> None:
    """The names above are those of `Parameters`, and their values are what the model was made with."""
    model, table = coarse(), Parameters().override({"contact.v_s": 0.05}).table()
    assert {name: p.item() for name, p in scalars(model).items()} == {
        name: table[name]["value"] for name in scalars(model)
    }
