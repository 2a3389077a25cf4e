"""The tester of a rig: power and momentum, compiled steps, gradients and copies, whatever the rig
is made of."""

import pickle
from copy import deepcopy
from typing import Any

import pytest
import torch
from conftest import f64, shaken
from torch import Tensor

from torchsoft import Coulomb, Rig, Trajectory, simulate
from torchsoft.physics.contact import cross, turned
from torchsoft.physics.energy import dissipated, stored, supplied
from torchsoft.physics.multibond import net_efforts
from torchsoft.solve.kernel.arrays import GAMMA
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.solve.system import Rates
from torchsoft.solve.trajectory import Touch

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
            slipping.append(one.out[..., 6][on] != 0)
        some = torch.cat(slipping)
        if all(on.any() and not on.all() for on in touching) and some.any() and not some.all():
            return seed
    raise AssertionError("no state touches, sticks and slips at every contact")


def assert_power_balanced(start: Start, seed: int, t: float = 0.01) -> None:
    """dH/dt = supplied + driven - dissipated to rounding, no R field supplies power, and every
    transformer is dual."""
    rig, y, now = start[0], at_random(start, seed).requires_grad_(), f64(t)[0].requires_grad_()
    H = sum(stored(rig, rig.unpack(y, t=now)).values())
    by_y, by_t = torch.autograd.grad(H, (y, now), allow_unused=True)
    with torch.no_grad():
        state, rate = rig.unpack(y, t=now), rig(now, y)
        graph = rig.evaluate(now, state)
        loads = rig.loads(graph, net_efforts(graph.ports, rig.junctions))
        drives = [
            -loads[name][i] * state.velocity[name][i]
            for name, body in rig.bodies.items() for i,
            axis in enumerate(body.freedom) if body.freedom[axis] == "driven"
        ]  # fmt: skip
        loss = dissipated(rig, state, graph)
        powers = torch.stack(
            [*drives, *supplied(graph).values(), *(-power for power in loss.values())]
        )
        H_dot = by_y @ rate + (0.0 if by_t is None else by_t)
    scale = float(powers.abs().sum())
    assert abs(float(H_dot - powers.sum())) < 1e-9 * scale
    assert min(float(power) for power in loss.values()) > -1e-12 * scale
    generator = torch.Generator().manual_seed(seed)
    flows = {
        name: torch.randn(flow.shape, generator=generator, dtype=torch.float64)
        for name, flow in graph.flows.items()
    }
    for name, port in graph.ports.items():
        flow = port.transformer.flow(flows)
        effort = torch.randn(flow.shape, generator=generator, dtype=torch.float64)
        back = port.transformer.effort(effort, rig.junctions)
        dual = sum(float((back[junction] * flows[junction]).sum()) for junction in back)
        assert abs(dual - float((effort * flow).sum())) < 1e-12 * (
            1 + float((effort * flow).abs().sum())
        ), name


@torch.no_grad()
def assert_rigid_motion_is_free(start: Start, seed: int) -> None:
    """Neither pads nor contacts see a velocity that all share, ground included, nor a common
    rotation about any point unless the ground does: momentum and its moment are those of weights,
    actuators and drives alone."""
    rig = start[0]
    state = rig.unpack(at_random(start, seed))
    graph = rig.evaluate(0.0, state)
    for v, spin in ((f64(0.3, -0.7), 0.0), (f64(0.0, 0.0), 2.0)):
        flow = lambda r, v=v, spin=spin: v + spin * torch.stack((-r[..., 1] + 0.01, r[..., 0]), -1)
        flows = {"ground": flow(f64(0.0, 0.01).reshape(1, 2))}
        for name in rig.bodies:
            flows |= {
                name: flow(state.pose[name][None, :2]),
                f"{name}_spin": f64(spin).reshape(1, 1),
            }
        for name, pad in rig.pads.items():
            (place, _), u = rig.base_motion(name, state), rig.displacement(name, state)
            flows[f"pad_{name}"] = flow(place[:2] + turned(pad.positions + u, place[2]))
        for name, port in graph.ports.items():
            if not port.source and (spin == 0.0 or "ground" not in port.transformer.blocks):
                assert float(port.transformer.flow(flows).abs().max()) < 1e-14, name


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
    star, a, end = (
        torch.from_numpy(stepper.tapes(segments[-1])[0].y),
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
            assert float((run.force[name][i] - face.out[..., 3:5]).abs().max()) < 1e-8, name
        for name, pad in rig.pads.items():
            moment = float((cross(pad.positions) * graph.ports[f"pad_{name}"].effort).sum())
            recorded = float(run[rig.renamed.get(f"M_{name}", f"M_{name}")][i])
            assert recorded == pytest.approx(moment, abs=1e-9), name


def assert_gradients_exact(
    start: Start, t: Tensor, rtol: float = 1e-4, bound: float = 2e-6, centres: bool = False
) -> Trajectory:
    """A run whose ledger closes and whose forces are the module's. The discrete adjoint of its
    motion, and that of its forces, loads and moments, by the start, every parameter and every value
    of the reference is the difference along the same steps, and its forward sensitivities are the
    adjoint.

    Differences are taken along one direction, in which all of these weigh alike as far as they
    weigh at all.
    """
    rig, y0 = start
    kick, shake = f64(0.0)[0].requires_grad_(), at_random(start, 0) - y0
    leaves = {"start": kick} | {name: p for name, p in rig.named_parameters() if p.requires_grad}
    for name, p in rig.reference.named_parameters(prefix="reference"):
        if name.endswith(".values"):
            leaves[name] = p.requires_grad_()
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(len(t) - 1, rig.layout.size, generator=generator, dtype=torch.float64)
    for (part, _), where in rig.layout.slices.items():
        weights[:, where] *= {"pose": 1e3, "velocity": 10.0}.get(part, 0.0)  # [1/m, s/m]
    touch = Touch(rig)
    felt = [name for name in touch if centres or "centre" not in name]
    pulls = torch.randn(len(t), len(felt), generator=generator, dtype=torch.float64)
    pulls *= f64(*({"N": 1.0, "N.m": 50.0, "m": 1e3}[touch.unit(name)] for name in felt))

    def run(**how: Any) -> tuple[Trajectory, dict[str, Tensor]]:
        made = simulate(rig, t, y0=y0 + kick * shake, tolerance=NEWTON, **how)
        motion = (weights * (made.y[1:] - y0)).sum()
        return made, {"motion": motion, "forces": (pulls * made.together(*felt)).sum()}

    made, values = run(rtol=rtol, gradient="discrete")
    assert made.energy_residual_rel < 2e-3
    if not any(isinstance(part, Coulomb) for part in rig.modules()):  # on which side of its jump?
        assert_forces_are_the_modules(rig, made)
    wanted = [
        name
        for name, p in leaves.items()
        if p.ndim == 0 and name != "start" and not name.startswith("reference")
    ]
    forward = simulate(
        rig, t, y0=y0, knots=made.knots, tolerance=NEWTON, gradient="forward", wrt=wanted,
        touch=felt, dy0=torch.cat(
            (torch.zeros(len(y0), len(wanted), dtype=torch.float64), shake[:, None]), -1),
    )  # fmt: skip
    of_forces = torch.stack([forward.touch_sensitivities[name] for name in felt], 1)
    by_forward = {
        "motion": torch.einsum("ti,tin->n", weights, forward.sensitivities[1:]),
        "forces": torch.einsum("ti,tin->n", pulls, of_forces),
    }
    kept = {name: p.detach().clone() for name, p in leaves.items()}
    for kind, value in values.items():
        slopes = torch.autograd.grad(
            value, list(leaves.values()), allow_unused=True, retain_graph=True
        )
        ways, shares = {}, {}
        for (name, p), slope in zip(leaves.items(), slopes):
            if slope is None:
                continue
            way = torch.randn(p.shape, generator=generator, dtype=torch.float64).sign()
            ways[name] = way * (1.0 if name == "start" else p.detach().abs().mean() + 1e-6)
            shares[name] = float((slope * ways[name]).sum())
        largest = max(map(abs, shares.values()))
        for name, slope in zip([*wanted, "start"], by_forward[kind]):
            found = float(slope * ways.get(name, torch.ones(())))
            assert found == pytest.approx(shares.get(name, 0.0), rel=1e-7, abs=1e-8 * largest), name
        for name, share in shares.items():  # lengths decide when points touch: hardly changed
            most = 10.0 if "shape" in name or "reference" in name else 100.0
            ways[name] *= (factor := min(largest / (abs(share) + 1e-300), most))
            shares[name] = share * factor
        ends = []
        for h in (2e-9, -2e-9):
            with torch.no_grad():
                for name, way in ways.items():
                    leaves[name].add_(h * way)
                ends.append(float(run(knots=made.knots)[1][kind]))
                for name, one in kept.items():
                    leaves[name].copy_(one)
        slope, scale = (ends[0] - ends[1]) / 4e-9, sum(map(abs, shares.values()))
        assert slope == pytest.approx(sum(shares.values()), abs=bound * scale), (kind, shares)
    return made
