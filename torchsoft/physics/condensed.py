"""Massless pads: their surface rates at one state, from the relation between nodal forces and the contact law.

u' = free + P F with P = C sum of J / (tau + a h) and free = -C sum of J z / (tau + a h); `stage` = a h is zero for the
ODE itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchsoft.physics.contact import cross, interface_law, moving_frame, turned
from torchsoft.physics.pads import Pad
from torchsoft.physics.state import State

if TYPE_CHECKING:
    from torchsoft.physics.rig import Rig

RATE_TOLERANCE = 1e-13
"""Residual [m/s] to which the rates are solved."""

RATE_ITERATIONS = 30


def point_inputs(
    rig: Rig, key: str, state: State, u: Tensor, u_dot: Tensor, which: Tensor | None = None, stage: float = 0.0
) -> Tensor:
    """Inputs x (..., points, 9) of a contact's law: u and u_dot (..., points, 2) are the points' own, in the base's frame."""
    contact = rig.contacts[key]
    pad, weight, s = rig.pads[contact.pad], rig.weight(key), state.stretch[key]
    X = pad.point_positions
    if which is not None:
        X, weight, s = X[which], weight[which], s[..., which]
    (r_B, v_B), r_C, v_C = rig.base_motion(contact.pad, state), state.pose[contact.body], state.velocity[contact.body]
    angle = r_B[..., 2]
    centre, glide = turned(r_C[..., :2] - r_B[..., :2], -angle), turned(v_C[..., :2] - v_B[..., :2], -angle)
    p = X + u
    d = p - centre[..., None, :]
    w = glide[..., None, :] - v_B[..., None, 2:] * cross(p) - u_dot
    one = torch.ones_like(d[..., 0])
    parts = (v_C[..., 2:] * one, d, (r_C[..., 2:] - r_B[..., 2:]) * one, s * one, weight * one, stage * one)
    columns = [part if part.ndim == d.ndim else part[..., None] for part in (w, *parts)]
    return torch.cat(columns, -1)


def free_rates(pad: Pad, z: Tensor, stage: float) -> tuple[Tensor, Tensor]:
    """Rates of a massless pad's nodes without contact (..., nodes, 2) [m/s] and its mobility P [m/(N.s)], for the forces
    z (..., branches, nodes, 2) that have set in at the stage's start."""
    fractions, times = pad.material.chain()
    C, rest = pad.compliance(), fractions / (times + stage)
    free = -((rest[:, None, None] * z).sum(-3).flatten(-2) @ C.mT).unflatten(-1, (-1, 2))
    return free, rest.sum() * C


def solve_rates(rig: Rig, name: str, own: Sequence[str], state: State, u: Tensor, stage: float = 0.0) -> Tensor:
    """Rates u' (..., nodes, 2) [m/s] of a massless pad's nodes, by semi-smooth Newton; u their displacements at stage zero.

    Only the nodes of touching points carry force, so only they are unknowns. The last iteration is taken with the gradient on,
    which makes the result's derivative the implicit function theorem's. Raises `RuntimeError` where it does not converge.
    """
    pad = rig.pads[name]
    free, P = free_rates(pad, state.pads[name], stage)
    touching = {}
    for key in own:
        contact = rig.contacts[key]
        shape = rig.bodies[contact.body].shape
        assert shape is not None
        x = point_inputs(rig, key, state, pad.spread @ u, torch.zeros_like(pad.spread @ u))
        inside = moving_frame(shape, x[..., 3:5], x[..., 5]).g > 0
        found = torch.nonzero(inside.reshape(-1, inside.shape[-1]).any(0))[:, 0]
        if len(found):
            touching[key] = found
    if not touching:
        return free
    loaded = torch.nonzero(torch.cat([pad.spread[which] for which in touching.values()]).any(0))[:, 0]
    dofs = (2 * loaded[:, None] + torch.arange(2)).flatten()
    P = P[:, dofs]
    P_aa, free_a = P[dofs], free[..., loaded, :]
    spread = {key: pad.spread[which][:, loaded] for key, which in touching.items()}

    def point_force(key: str, rate: Tensor) -> Tensor:
        """At a contact's touching points (..., points, 2), for their rates."""
        which, contact = touching[key], rig.contacts[key]
        shape = rig.bodies[contact.body].shape
        assert shape is not None
        x = point_inputs(rig, key, state, pad.spread[which] @ u, rate, which, stage)
        return interface_law(contact.law, shape, x)[..., :2]

    def force(u_dot: Tensor) -> Tensor:
        """Nodal forces for the loaded nodes' rates."""
        each = [S.mT @ point_force(key, S @ u_dot) for key, S in spread.items()]
        return sum(each[1:], each[0])

    def residual(u_dot: Tensor, F: Tensor) -> Tensor:
        return (u_dot - free_a).flatten(-2) - F.flatten(-2) @ P_aa.mT

    def linearise(u_dot: Tensor) -> tuple[Tensor, Tensor]:
        """Residual and its Jacobian: a point's force depends on its own rate only."""
        n = len(loaded)
        F, G = torch.zeros_like(u_dot), torch.zeros(*u_dot.shape[:-2], n, 2, n, 2, dtype=u.dtype)
        for key, S in spread.items():
            with torch.enable_grad():
                rate = (S @ u_dot.detach()).requires_grad_(True)
                f = point_force(key, rate)
                slopes = [torch.autograd.grad(f[..., i].sum(), rate, retain_graph=i == 0)[0] for i in range(2)]
            F = F + S.mT @ f.detach()
            G = G + torch.einsum("pn,...pij,pm->...nimj", S, torch.stack(slopes, -2), S)
        J = torch.eye(2 * n, dtype=u.dtype) - P_aa @ G.flatten(-2).flatten(-3, -2)
        return residual(u_dot, F), J

    def newton_step(r: Tensor, J: Tensor) -> Tensor:
        return torch.linalg.solve(J, r[..., None])[..., 0].unflatten(-1, (-1, 2))

    with torch.no_grad():
        u_dot = free_a.clone()
        r, J = linearise(u_dot)
        size = r.abs().amax(-1)
        for _ in range(RATE_ITERATIONS):
            going = size > RATE_TOLERANCE
            if not bool(going.any()):
                break
            step = newton_step(r, J) * going[..., None, None]
            for _ in range(8):  # halve, sample by sample, until the residual falls
                r, J = linearise(u_dot - step)
                worse = going & ~(r.abs().amax(-1) < size)
                if not bool(worse.any()):
                    break
                step = step * torch.where(worse, 0.5, 1.0)[..., None, None]
            u_dot = u_dot - step
            size = r.abs().amax(-1)
        if not bool((size <= 1e3 * RATE_TOLERANCE).all()):
            raise RuntimeError(
                f"the rates of the massless pad `{name}` did not converge: residual {float(size.max()):.2g} m/s after "
                f"{RATE_ITERATIONS} iterations; is v_s large enough for the pads' damping to balance the fall of friction with "
                "slip?"
            )
    u_dot = u_dot - newton_step(residual(u_dot, force(u_dot)), J)
    return free + (force(u_dot).flatten(-2) @ P.mT).unflatten(-1, (-1, 2))
