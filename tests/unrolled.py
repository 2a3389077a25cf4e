"""The same implicit step in plain torch, every operation recorded by autograd: the reference of the
compiled derivatives.

One stage is solved by Newton's method with the Jacobian from forward-mode differentiation of the
rig's own laws, and its last iteration is taken with the gradient on, so that backpropagation
through many steps is exact. Slow, for short windows; massless pads, one state at a time.
"""

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.condensed import free_rates
from torchsoft.physics.contact import cross, free_law, interface_law, turned
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State
from torchsoft.solve.grid import check_times, equal_steps
from torchsoft.solve.kernel.arrays import GAMMA, MIX

WINDOW = 3e-4
"""How near to touching [m] a point has to be at the start of a stage to be an unknown of it."""


def unrolled_solution(
    rig: Rig, y0: Tensor, t: Tensor, reference: Reference | None = None, *, step: float = 2e-3,
    tolerance: float = 1e-12, max_iterations: int = 40,
) -> Tensor:  # fmt: skip
    """States (T, size) at the times t (T,), by the steps that `simulate` takes.

    `tolerance` is Newton's, on the residuals of nodal rates and free velocities [m/s, rad/s].
    Raises `NotImplementedError` for inertial pads and `RuntimeError` when Newton's method does not
    converge.
    """
    check_times(t)
    if any(pad.inertial for pad in rig.pads.values()):
        raise NotImplementedError("the unrolled step is for massless pads")
    y, out = y0, [y0]
    for starts, lengths, ends, _ in equal_steps(t, step):
        h, keep = float(lengths[0]), np.isin(np.arange(len(starts)), ends)
        for start, output in zip(starts, keep):
            Y_1 = _stage(rig, y, start + GAMMA * h, GAMMA * h, reference, tolerance, max_iterations)
            y = _stage(
                rig, y + MIX * (Y_1 - y), start + h, GAMMA * h, reference, tolerance, max_iterations
            )
            if output:
                out.append(y)
    return torch.stack(out)


def _stage(
    rig: Rig,
    y_star: Tensor,
    time: float,
    a: float,
    reference: Reference | None,
    tolerance: float,
    max_iterations: int,
) -> Tensor:
    """Y = y* + a f(time, Y). Unknowns: u' of the nodes that may be loaded, pad by pad, and the free
    velocities."""
    signals = rig.follow(torch.tensor(time, dtype=torch.float64), reference)
    star, free = rig.unpack(y_star, signals), rig.layout.free
    V_star = torch.cat([star.velocity[name][axes] for name, axes in free.items()])
    inertia = torch.cat(
        [torch.stack(list(rig.bodies[name].masses))[axes] for name, axes in free.items()]
    )
    u_star = {name: rig.displacement(name, star) for name in rig.pads}
    near, loaded, relation = {}, {}, {}
    for key, contact in rig.contacts.items():
        with torch.no_grad():
            near[key] = torch.nonzero(rig.penetration(key, star) > -WINDOW)[:, 0]
    for name, pad in rig.pads.items():
        touched = sum(
            (pad.spread[near[key]] != 0).any(0) for key, c in rig.contacts.items() if c.pad == name
        )
        loaded[name] = (
            torch.nonzero(touched)[:, 0]
            if isinstance(touched, Tensor)
            else torch.zeros(0, dtype=torch.long)
        )
        relation[name] = free_rates(pad, star.pads[name], a)
    sizes = [*(2 * len(nodes) for nodes in loaded.values()), len(V_star)]

    def moved(V: Tensor) -> State:
        """Poses and velocities at the end of the stage; pads and stretches as in y*."""
        pose, velocity = dict(star.pose), dict(star.velocity)
        for (name, axes), own in zip(free.items(), V.split([len(axes) for axes in free.values()])):
            index = torch.tensor(axes, dtype=torch.long)
            velocity[name] = velocity[name].index_copy(0, index, own)
            pose[name] = pose[name].index_copy(0, index, pose[name][index] + a * own)
        return star._replace(pose=pose, velocity=velocity)

    def interfaces(rates: dict[str, Tensor], at: State) -> dict[str, tuple[Tensor, Tensor]]:
        """Law inputs and outputs of every contact's near points."""
        out = {}
        for key, contact in rig.contacts.items():
            pad, nodes = rig.pads[contact.pad], loaded[contact.pad]
            spread = pad.spread[near[key]]
            u_dot = spread[:, nodes] @ rates[contact.pad]
            shape = rig.bodies[contact.body].shape
            assert shape is not None
            x = rig.point_inputs(
                key, at, spread @ u_star[contact.pad] + a * u_dot, u_dot, near[key], a
            )
            out[key] = x, interface_law(contact.law, shape, x)
        return out

    def forces(key: str, out: Tensor) -> Tensor:
        """Nodal forces of one contact on the loaded nodes of its pad."""
        name = rig.contacts[key].pad
        return rig.pads[name].spread[near[key]][:, loaded[name]].mT @ out[:, :2]

    def residual(x: Tensor) -> Tensor:
        *parts, V = x.split(sizes)
        rates = {name: part.unflatten(-1, (-1, 2)) for name, part in zip(rig.pads, parts)}
        at = moved(V)
        found, rows = interfaces(rates, at), []
        loads = {name: torch.zeros(3, dtype=torch.float64) for name in rig.bodies}
        for name, body in rig.bodies.items():
            if body.weighted:
                loads[name] = (
                    loads[name] - body.mass * rig.gravity * torch.tensor([0.0, 1.0, 0.0]).double()
                )
        for name, actuator in rig.actuators.items():
            body, _, axis = actuator.pushes.partition(".")
            along = torch.eye(3, dtype=torch.float64)[("x", "y", "theta").index(axis)]
            loads[body] = loads[body] + rig.actuator_effort(name, at, signals) * along
        for key, (inputs, out) in found.items():
            contact = rig.contacts[key]
            r_B, _ = rig.base_motion(contact.pad, at)
            d, f = inputs[:, 3:5], out[:, :2]
            total = turned(f.sum(0), r_B[2])  # (16), (19)
            loads[contact.body] = loads[contact.body] - torch.cat(
                (total, (cross(d) * f).sum()[None])
            )  # (18)
            base = rig.pads[contact.pad].base
            if base is not None:
                p = d + turned(at.pose[contact.body][:2] - r_B[:2], -r_B[2])
                loads[base] = loads[base] + torch.cat((total, (cross(p) * f).sum()[None]))
        for name in rig.pads:
            own, P = relation[name]
            dofs = (2 * loaded[name][:, None] + torch.arange(2)).flatten()
            F = sum(
                forces(key, out) for key, (_, out) in found.items() if rig.contacts[key].pad == name
            )
            if len(dofs):
                assert isinstance(F, Tensor)
                rows.append(
                    rates[name].flatten()
                    - own[loaded[name]].flatten()
                    - P[dofs][:, dofs] @ F.flatten()
                )
        load = torch.cat([loads[name][axes] for name, axes in free.items()])
        return torch.cat((*rows, V - V_star - a * load / inertia))

    with torch.no_grad():
        x = torch.cat((torch.zeros(sum(sizes[:-1]), dtype=torch.float64), V_star))
        r = residual(x)
        for _ in range(max_iterations):
            J = torch.func.jacfwd(residual)(x)
            if float(r.abs().max()) <= tolerance:
                break
            change, part = torch.linalg.solve(J, r[:, None])[:, 0], 1.0
            while True:
                trial = residual(x - part * change)
                if float(trial.norm()) < float(r.norm()) or part < 1 / 64:
                    break
                part *= 0.5
            x, r = x - part * change, trial
        else:
            raise RuntimeError(
                f"the unrolled step did not converge at t = {time:.4f} s; try a smaller step"
            )
    x = (
        x - torch.linalg.solve(J, residual(x)[:, None])[:, 0]
    )  # the implicit function theorem's derivative

    *parts, V = x.split(sizes)
    at = moved(V)
    found = interfaces(
        {name: part.unflatten(-1, (-1, 2)) for name, part in zip(rig.pads, parts)}, at
    )
    pads, stretch = {}, {}
    for name, pad in rig.pads.items():
        F = torch.zeros(pad.nodes, 2, dtype=torch.float64)
        for key, (_, out) in found.items():
            if rig.contacts[key].pad == name:
                F = F + pad.spread[near[key]].mT @ out[:, :2]
        times = pad.material.chain()[1][:, None, None]
        pads[name] = star.pads[name] + a * (F - star.pads[name]) / (times + a)
    for key, (_, out) in found.items():
        s, weight = star.stretch[key], rig.weight(key)
        far = free_law(
            rig.contacts[key].law, torch.stack((s, weight, torch.full_like(weight, a)), -1)
        )[0]
        stretch[key] = s + a * far.index_copy(0, near[key], out[:, 2])
    return rig.pack(at._replace(pads=pads, stretch=stretch))
