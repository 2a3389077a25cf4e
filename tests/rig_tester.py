"""The tester of a rig beyond `torchsoft.testing`: compiled steps, forces and copies, whatever the
rig is made of."""

import pickle
import warnings
from copy import deepcopy

import pytest
import torch
from conftest import f64, shaken
from torch import Tensor

from torchsoft import Coulomb, Rig, Trajectory
from torchsoft.physics.contact import cross
from torchsoft.solve.kernel.arrays import GAMMA
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.solve.system import Rates
from torchsoft.testing import check_gradients

NEWTON = 1e-10
"""Newton's tolerance of the compiled steps [N]; 1e-11 is rounding, and not reached at every
step."""

Start = tuple[Rig, Tensor]
"""A rig with a reference that moves, and its initial state (size,)."""


def is_inertial(rig: Rig) -> bool:
    return any(pad.inertial for pad in rig.pads.values())


def at_random(start: Start, seed: int) -> Tensor:
    """The initial state shaken about: touching and separated points, stick and slip, stretched
    springs."""
    rig, y0 = start
    return shaken(rig, rig.unpack(y0), seed)


@torch.no_grad()
def telling(start: Start) -> int:
    """The first seed of a state in which every contact touches at some of its points only; of all
    that touch some stick and some slip."""
    rig = start[0]
    for seed in range(100):
        touching, slipping = [], []
        for one in rig.evaluate(0.01, rig.unpack(at_random(start, seed))).interfaces.values():
            on = one.frame.g > 0
            touching.append(on)
            slipping.append(one.law.slip[on] > 1e-12)  # [W]; friction may creep
        some = torch.cat(slipping)
        if all(on.any() and not on.all() for on in touching) and some.any() and not some.all():
            return seed
    raise AssertionError("no state touches, sticks and slips at every contact")


@torch.no_grad()
def assert_parts_are_kept(start: Start) -> None:
    """States taken apart and put together, batches, and copies of the rig, to the bit or to
    rounding."""
    rig, _ = start
    y = torch.stack([at_random(start, seed) for seed in range(4)]).reshape(2, 2, -1)
    state = rig.unpack(y)
    assert torch.equal(rig.pack(state), y)
    assert all(part.shape[:2] == (2, 2) for field in state for part in field.values())
    alone = torch.stack([rig(0.01, sample) for sample in y.reshape(4, -1)]).reshape(y.shape)
    scale = alone.abs().amax(-1, keepdim=True)
    assert float(((rig(0.01, y) - alone) / scale).abs().max()) < 1e-12
    changed = {name: value * 1.01 for name, value in rig.named_parameters() if value.requires_grad}
    called = torch.func.functional_call(rig, changed, (0.01, y[0, 0]))
    for copy in (deepcopy(rig), pickle.loads(pickle.dumps(rig))):
        assert torch.equal(copy(0.01, y[0, 0]), alone[0, 0])
        copy.load_state_dict(changed, strict=False)
        assert torch.equal(copy(0.01, y[0, 0]), called)
    assert not torch.equal(called, alone[0, 0])


def assert_rates_differentiable(start: Start, seed: int) -> None:
    """Autograd through `forward`, along one direction of the state and of every parameter, against
    differences."""
    rig, y = start[0], at_random(start, seed)
    generator = torch.Generator().manual_seed(seed)
    weight = torch.randn(len(y), generator=generator, dtype=torch.float64)
    weight /= rig(0.01, y).detach().abs().clamp(min=1e-3)

    def value(by: Tensor) -> Tensor:
        changed = {
            name: p.detach() * (1 + by * (1 + 0.1 * (i % 7)))
            for i, (name, p) in enumerate(rig.named_parameters())
        }
        return weight @ torch.func.functional_call(rig, changed, (0.01, y + by * (y - start[1])))

    (slope,) = torch.autograd.grad(value(by := f64(0.0)[0].requires_grad_()), by)
    with torch.no_grad():
        up, down = (float(value(f64(h)[0])) for h in (1e-7, -1e-7))
    assert float(slope) == pytest.approx((up - down) / 2e-7, rel=1e-5)


@torch.no_grad()
def assert_compiled_is_the_module(start: Start, seed: int, h: float = 2e-4) -> None:
    """Y = y* + a h f(t, Y) at both stages of a step, with pads, contacts, friction, bodies and
    control; and rates."""
    rig, y = start[0], at_random(start, seed)
    parts = {key: where for key, where in rig.layout.slices.items() if where.start < where.stop}
    segments: list[Segment] = []
    stepper = ImplicitStepper(rig, step=h, tolerance=NEWTON)
    *_, last = stepper.integrate(y, f64(0.0, h), segments, float("inf"))
    assert last.steps == 1
    tapes = segments[-1].tapes
    assert tapes is not None
    star, a, end = (
        torch.from_numpy(tapes[0].y),
        GAMMA * h,
        torch.from_numpy(last.y[-1]),
    )
    assert torch.equal(star[0], y)
    first = y + a / (h - a) * (star[1] - y)
    for begin, stage, time in ((y, first, a), (star[1], end, h)):
        got, expected = (stage - begin) / a, rig(time, stage)
        for (part, name), where in parts.items():
            noise = (
                1e-9 * float(expected[where].abs().max())
                + 1e-9
                + 4e-15 * float(stage[where].abs().max()) / a
            )
            if part == "rates":
                noise += NEWTON / float(rig.pads[name].masses().min())
            elif part == "velocity":  # Newton's tolerance at a few nodes, on the spin
                noise += 3 * NEWTON * 0.02 / float(rig.bodies[name].inertia)
            assert float((got - expected)[where].abs().max()) < noise, (part, name, time)
    if not is_inertial(rig):
        rates, expected = torch.from_numpy(Rates(rig)(0.01, y.numpy())), rig(0.01, y)
        for where in parts.values():
            assert (
                float((rates - expected)[where].abs().max())
                <= 1e-9 * float(expected[where].abs().max()) + 1e-12
            )


@torch.no_grad()
def assert_forces_are_the_modules(rig: Rig, run: Trajectory) -> None:
    """Nodal forces of a run, and the moment of every pad's efforts about the undeformed places of
    its nodes (Eq. 35)."""
    for i, t in enumerate(run.t):
        state = rig.unpack(run.y[i], t=t)
        graph = rig.evaluate(t, state)
        for name, face in graph.interfaces.items():
            assert float((run.force[name][i] - face.law.force).abs().max()) < 1e-8, name
        for name, pad in rig.pads.items():
            moment = float((cross(pad.positions) * graph.ports[f"pad_{name}"].effort).sum())
            recorded = float(run[f"M_{name}"][i])
            assert recorded == pytest.approx(moment, abs=1e-9), name


def assert_gradients_exact(
    start: Start, t: Tensor, rtol: float = 1e-4, bound: float = 2e-6, centres: bool = False
) -> Trajectory:
    """A run whose ledger closes and whose forces are the module's, and `check_gradients` of it
    along one direction of the start, of every parameter and of every value of the reference."""
    rig, y0 = start
    with warnings.catch_warnings():  # some parameters have no effect
        warnings.filterwarnings("ignore", "the derivatives by .* were not checked")
        checked = check_gradients(
            rig, t, y0, rtol=rtol, bound=bound, dy0=at_random(start, 0) - y0, each=False,
            step_error=False, centres=centres,
        )  # fmt: skip
    made = checked.run
    assert made.energy_residual_rel < 2e-3
    if not any(isinstance(part, Coulomb) for part in rig.modules()):  # on which side of its jump?
        assert_forces_are_the_modules(rig, made)
    judged = [one for one in checked.derivatives if one.difference is not None]
    assert len(judged) == 2
    for one in judged:
        assert one.difference == pytest.approx(one.adjoint, abs=bound * one.scale), checked
    return made
