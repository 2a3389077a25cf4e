"""Static, frictionless equilibria: the disc at rest under its weight, and pressed between the pads."""

import torch
from torch import Tensor

from torchsoft.contact import moving_frame, normal_force
from torchsoft.model import SoftGrasp
from torchsoft.state import State

RESIDUAL = 1e-13
"""Equilibrium residual [m], forces counted by the compliance they meet."""


class NoEquilibrium(RuntimeError):
    """Newton's iteration found no static equilibrium."""


def rest(model: SoftGrasp) -> Tensor:
    """State (size,): the disc at rest on the lower pad under its weight, the upper pad just touching it from above."""
    state = _solve(model, bracket_height=None)
    p = model.settings
    top = state.r_C[1] + model.shape.radius + p.pad.height + p.bracket.cm_height
    return model.layout.pack(state._replace(r_Br=torch.stack((state.r_C[0], top))))


def press(model: SoftGrasp, bracket_height: float) -> Tensor:
    """State (size,): the disc between the pads with the bracket held at `bracket_height` [m], without friction.

    Raises `NoEquilibrium` when the bracket is too high for its pad to touch the disc, sunk in under its weight.
    """
    p = model.settings
    apart = bracket_height - p.bracket.cm_height >= 2 * (p.pad.height + p.disc.radius)
    state = None if apart else _solve(model, bracket_height)
    if state is None or not bool(state.u_U.any()):
        raise NoEquilibrium(f"the bracket at {bracket_height} m is too high for its pad to touch the disc; lower it")
    return model.layout.pack(state)


@torch.no_grad()
def holding_force(model: SoftGrasp, y: Tensor) -> float:
    """Force [N] on the bracket, downwards, that balances the upper pad's normal forces in the frictionless state y (size,)."""
    frame, zero = model.frame("U", model.layout.unpack(y)), torch.zeros((), dtype=torch.float64)
    F_N = normal_force(frame.g, zero, zero, model.share(model.pad_U) * model.contact.K_n, zero)
    return float((F_N * frame.n[:, 1]).sum())


def _solve(model: SoftGrasp, bracket_height: float | None) -> State:
    """Unknowns: the disc's height and the displacements of the nodes under (and above) it; x_C stays at `x_C0`.

    Newton with the module's own normal law; the last iteration is taken with the gradient on, so that the equilibrium's
    derivative with respect to every parameter is the implicit function theorem's.
    """
    p = model.settings
    x, height = torch.tensor(p.scenario.x_C0, dtype=torch.float64), p.pad.height
    zero = torch.zeros((), dtype=torch.float64)
    y_Br = zero + (bracket_height if bracket_height is not None else 10 * (p.disc.radius + height))
    bases = {"L": torch.zeros(2, dtype=torch.float64)} | (
        {} if bracket_height is None else {"U": torch.stack((x, y_Br))}
    )
    weight, reach = model.m_C * model.gravity, min(p.disc.radius, 3 * (p.disc.radius * height) ** 0.5)
    sides = [_Side(model, k, base, x, reach) for k, base in bases.items()]
    soft = sides[0].C.detach().diagonal().max()
    sizes = [2 * len(side.near) for side in sides]

    def residual(z: Tensor, forces: list[Tensor]) -> Tensor:
        """Of the disc's balance, by the compliance it meets, and of u = C f on each side [m]."""
        balance = -weight - sum(f[:, 1].sum() for f in forces)
        parts = (u - side.C @ f.flatten() for side, f, u in zip(sides, forces, z[1:].split(sizes)))
        return torch.cat([soft * balance[None], *parts])

    def forces(z: Tensor) -> list[Tensor]:
        return [side.force(u.unflatten(0, (-1, 2)), z[0]) for side, u in zip(sides, z[1:].split(sizes))]

    def linearise(z: Tensor) -> Tensor:
        """Jacobian of the residual, from each node's 2 x 2 block df/du; raising the disc is lowering the nodes."""
        blocks = [side.force_by_place(u.unflatten(0, (-1, 2)), z[0]) for side, u in zip(sides, z[1:].split(sizes))]
        J = torch.eye(len(z), dtype=torch.float64)
        J[0, 0], first = soft * sum(G[:, 1, 1].sum() for G in blocks), 1
        for side, G in zip(sides, blocks):
            here, first = slice(first, first + 2 * len(G)), first + 2 * len(G)
            J[0, here] = -soft * G[:, 1].flatten()
            J[here, 0] = side.C @ G[:, :, 1].flatten()
            J[here, here] -= torch.einsum("ank,nkj->anj", side.C.unflatten(1, (-1, 2)), G).flatten(1)
        return J

    upper = 2 * p.disc.radius + height if bracket_height is None else bracket_height - p.bracket.cm_height - height
    start = height + p.disc.radius - 0.1 * height if bracket_height is None else 0.5 * (height + upper)
    z = torch.cat((zero[None] + start, torch.zeros(sum(sizes), dtype=torch.float64)))
    with torch.no_grad():
        r = residual(z, forces(z))
        for _ in range(100):
            if float(r.abs().max()) <= RESIDUAL:
                break
            step = _newton_step(linearise(z), r)
            scale = min(1.0, 0.2 * height / float(step[0].abs().clamp(min=1e-12)))
            for _ in range(12):
                trial = z - scale * step
                r_trial = residual(trial, forces(trial))
                if float(r_trial.norm()) < float(r.norm()):
                    break
                scale *= 0.5
            z, r = trial, r_trial
        else:
            raise NoEquilibrium(
                f"no static equilibrium found (residual {float(r.abs().max()):.2g} m after 100 iterations); are the "
                "contact springs far stiffer than the pads?"
            )
        J = linearise(z)
    z = z - _newton_step(J, residual(z, forces(z)))
    state = model.layout.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    state = state._replace(r_C=torch.stack((x, z[0])), r_Br=torch.stack((x, y_Br)))
    return state._replace(**{f"u_{side.name}": side.spread(f) for side, f in zip(sides, forces(z))})


def _newton_step(J: Tensor, r: Tensor) -> Tensor:
    """J^-1 r; the shortest step where no node touches and leaves the disc's height undetermined."""
    step, singular = torch.linalg.solve_ex(J, r[:, None])
    return (torch.linalg.lstsq(J, r[:, None]).solution if bool(singular) else step)[:, 0]


class _Side:
    """One pad's surface nodes within `reach` of the disc's x: their frictionless force, and what it does to the pad."""

    def __init__(self, model: SoftGrasp, name: str, base: Tensor, x: Tensor, reach: float) -> None:
        self.model, self.name, self.x = model, name, x
        pad = model.pads[name]
        places = pad.positions[pad.surface] + base
        self.near = torch.nonzero((places[:, 0] - x).abs() < reach)[:, 0]
        self.places = places[self.near]
        self.K_n = model.share(pad)[self.near] * model.contact.K_n
        columns, rows = (
            (2 * nodes[:, None] + torch.arange(2)).flatten() for nodes in (self.near, pad.surface[self.near])
        )
        self.everywhere = pad.compliance(model.material)[:, columns]
        """displacement of every node per force on the near ones [m/N]"""
        self.C = self.everywhere[rows]

    def force(self, u: Tensor, y_C: Tensor) -> Tensor:
        """On each near node, (near, 2) [N], for their displacements u (near, 2) [m] and the disc's height [m]."""
        zero = torch.zeros_like(y_C)
        frame = moving_frame(self.model.shape, self.places + u, torch.stack((self.x, y_C)), zero)
        return normal_force(frame.g, zero, zero, self.K_n, zero)[:, None] * frame.n

    def force_by_place(self, u: Tensor, y_C: Tensor) -> Tensor:
        """df/du of each node by itself, (near, 2, 2) [N/m]."""
        with torch.enable_grad():
            u = u.detach().requires_grad_()
            rows = self.force(u, y_C).sum(0)
            return torch.stack([torch.autograd.grad(row, u, retain_graph=True)[0] for row in rows], 1)

    def spread(self, f: Tensor) -> Tensor:
        """Displacement of every node of the pad, (nodes, 2)."""
        return (self.everywhere @ f.flatten()).unflatten(-1, (-1, 2))
