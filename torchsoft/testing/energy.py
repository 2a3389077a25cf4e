"""Whether a rig keeps the balance of power: at states, and over a run."""

from collections.abc import Iterator

import torch
from torch import Tensor

from torchsoft.physics.arguments import Numbers, tensor
from torchsoft.physics.contact import turned
from torchsoft.physics.energy import dissipated, stored, supplied
from torchsoft.physics.hyperelastic import Hyperelastic, plane
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.rig import Rig
from torchsoft.solve.diagnostics import missing_energy
from torchsoft.solve.simulate import simulate
from torchsoft.solve.trajectory import Trajectory

ROUNDING = 1e-9
"""Part of all powers, taken without their signs, that may be missing at a state."""

RESTING = 1e-15
"""Part of the stored energy a second that rounding may supply where nothing moves [1/s]."""

RESIDUAL = 0.01
"""Part of the energy stored at the start and injected that a run may miss."""

STATES = 5
"""States of a run at which powers are balanced, at the most: that is slow."""


class CheckFailed(AssertionError):
    """A check did not hold: what it is about, one sentence a fault."""


def conclude(faults: list[str]) -> None:
    """Raises `CheckFailed` unless there are no faults."""
    if faults:
        raise CheckFailed("\n".join(faults))


def check_power(rig: Rig, y: Numbers, t: float = 0.0) -> None:
    """At the state y (size,) and the time t [s]: stored energy changes by what is supplied less
    what is dissipated, to rounding; no R element supplies power; every transformer of the graph
    returns the power that it takes; and a motion that all parts share is felt by no pad and by no
    contact, so that momentum and its moment are kept.

    Raises `CheckFailed`.
    """
    given = tensor("y", y).detach()
    faults = [*_power_faults(rig, given, t), *_momentum_faults(rig, given)]
    conclude([f"at t = {t:g} s {fault}" for fault in faults])


def check_energy(
    rig: Rig, t: Numbers, y0: Numbers, *, rtol: float | None = None,
    residual: float = RESIDUAL,
) -> Trajectory:  # fmt: skip
    """A run from y0 through the times t whose energies must balance within `residual` of what was
    stored at the start and injected since, with `check_power` at some of its outputs. Strain
    energies of pads must not change with a rotation, and must be stable, at the strains of these
    outputs.

    Returns the run; raises `CheckFailed`.
    """
    run = simulate(rig, t, y0=y0, rtol=rtol)
    faults = []
    if not (part := missing_energy(run)) <= residual:
        faults.append(
            f"{part:.2%} of the energy that was stored at the start and injected since is missing "
            f"or too much, and {residual:.2%} may be: take a smaller `rtol`, or see whether a law "
            "of yours supplies power"
        )
    rows = torch.linspace(0, len(run.t) - 1, min(STATES, len(run.t))).round().long()
    faults += _strain_energy_faults(rig, run, rows)
    for k in rows:
        try:
            check_power(rig, run.y[k], float(run.t[k]))
        except CheckFailed as failed:
            faults += str(failed).splitlines()
    conclude(faults)
    return run


def _strain_energy_faults(rig: Rig, run: Trajectory, rows: Tensor) -> Iterator[str]:
    """Faults of the energies of pads at finite strain at some outputs of a run."""
    for name, pad in rig.pads.items():
        if isinstance(pad.material, Hyperelastic):
            setup, u = run.setup.pads[name], run.displacement[name][rows].detach().numpy()
            F = torch.from_numpy(setup.gradient(setup.displacement(u)))
            if wrong := pad.material.fault_at(plane(F.flatten(0, 1))):
                yield f"the material of `{name}`: {wrong}"


def _power_faults(rig: Rig, y: Tensor, t: float) -> list[str]:
    y, now = y.clone().requires_grad_(), torch.tensor(t, dtype=torch.float64).requires_grad_()
    H = torch.stack(list(stored(rig, rig.unpack(y, t=now)).values())).sum()
    by_y, by_t = torch.autograd.grad(H, (y, now), allow_unused=True, materialize_grads=True)
    with torch.no_grad():
        state, rate = rig.unpack(y, t=now), rig(now, y)
        graph = rig.evaluate(now, state)
        loads = rig.loads(graph, net_efforts(graph.ports, rig.junctions))
        drives = [
            -loads[name][i] * state.velocity[name][i]
            for name, body in rig.bodies.items()
            for i, axis in enumerate(body.freedom)
            if body.freedom[axis] == "driven"
        ]
        loss = dissipated(rig, state, graph)
        powers = torch.stack(
            [*drives, *supplied(graph).values(), *(-power for power in loss.values())]
        )
        missing = float(by_y @ rate + by_t - powers.sum())
        scale = float(powers.abs().sum())
        rounded = RESTING * float(H) + 1e-14 * float((by_y * rate).abs().sum())
    faults = []
    if not abs(missing) <= ROUNDING * scale + rounded:
        faults.append(
            f"stored energy changes by {missing:.3g} W that neither sources nor R elements account "
            f"for, among powers of {scale:.3g} W"
        )
    faults += [
        f"`{name}` is to dissipate energy, but supplies {-float(power):.3g} W"
        for name, power in loss.items()
        if not float(power) >= -1e-12 * scale - rounded
    ]
    generator = torch.Generator().manual_seed(0)
    noise = lambda x: torch.randn(x.shape, generator=generator, dtype=torch.float64)
    flows = {name: noise(flow) for name, flow in graph.flows.items()}
    for name, port in graph.ports.items():
        flow = port.transformer.flow(flows)
        effort = noise(flow)
        back = port.transformer.effort(effort, rig.junctions)
        lost = sum(float((back[junction] * flows[junction]).sum()) for junction in back)
        lost -= float((effort * flow).sum())
        if not abs(lost) <= 1e-12 * (1 + float((effort * flow).abs().sum())):
            faults.append(f"the transformer of `{name}` does not return the power that it takes")
    return faults


@torch.no_grad()
def _momentum_faults(rig: Rig, y: Tensor) -> list[str]:
    """A velocity that all share, ground included, and a common rotation, unless a port feels the
    ground, which does not turn."""
    state, faults = rig.unpack(y), []
    graph = rig.evaluate(0.0, state)
    for v, spin in (([0.3, -0.7], 0.0), ([0.0, 0.0], 2.0)):
        speed = torch.tensor(v, dtype=torch.float64)

        def flow(r: Tensor, speed: Tensor = speed, spin: float = spin) -> Tensor:
            return speed + spin * torch.stack((-r[..., 1] + 0.01, r[..., 0]), -1)

        flows = {"ground": flow(torch.tensor([[0.0, 0.01]], dtype=torch.float64))}
        for name in rig.bodies:
            flows[name] = flow(state.pose[name][None, :2])
            flows[f"{name}_spin"] = torch.full((1, 1), spin, dtype=torch.float64)
        for name, pad in rig.pads.items():
            (place, _), u = rig.base_motion(name, state), rig.displacement(name, state)
            flows[f"pad_{name}"] = flow(place[:2] + turned(pad.positions + u, place[2]))
        faults += [
            f"`{name}` resists a {'rotation' if spin else 'velocity'} that all parts share"
            for name, port in graph.ports.items()
            if not port.source
            and (spin == 0.0 or "ground" not in port.transformer.blocks)
            and not float(port.transformer.flow(flows).abs().max()) < 1e-14
        ]
    return faults
