"""Pads that have settled around given bodies: what their surfaces carry where bodies stand, or move past slowly.

Without rates all branches of a massless pad carry the contact force itself, z_b = f, and its displacements are u = C f.
At the contact points that is u = A f(u), with A the pad's compliance from point to point and f the contact law, without
any rate, at the bodies' given poses and the points' given stretches.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchsoft.physics.condensed import point_inputs
from torchsoft.physics.contact import interface_law
from torchsoft.physics.equilibrium import RESIDUAL, NoEquilibrium
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State
from torchsoft.physics.validity import check_array, check_values

ITERATIONS = 30
"""Of Newton's method; from undeformed pads it takes about ten."""


def settled(
    rig: Rig, pose: Mapping[str, Tensor], velocity: Mapping[str, Tensor], stretch: Mapping[str, Tensor]
) -> Tensor:
    """State (size,) with massless pads settled around bodies at `pose` [m, rad], by body (3,), and contacts whose
    points are stretched by `stretch` [m], by contact (points,).

    The bodies move at `velocity` [m/s, rad/s], by body (3,), but the pads carry what they would if these stood still:
    under a body that rolls at v the pads lag behind by v tau only, whereas pads at rest under it would meet all of its
    dashpots. Differentiable once in all three and in the rig's parameters, by the implicit function theorem; not smooth
    where a point touches or slips. Called again with the same numbers it gives the same bits.

    Raises `ValueError` for other shapes or a rig with parameters that are not physical, `NotImplementedError` for
    inertial pads, `NoEquilibrium` where Newton's method fails.
    """
    if torch.is_inference_mode_enabled():
        raise ValueError("settled pads need torch's graphs, which torch.inference_mode() has not; use torch.no_grad()")
    check_values(rig)
    for name, pad in rig.pads.items():
        if pad.inertial:
            raise NotImplementedError(f"pad `{name}` is inertial; only massless pads can be settled")
    _check("pose", pose, dict.fromkeys(rig.bodies, 3))
    _check("velocity", velocity, dict.fromkeys(rig.bodies, 3))
    _check("stretch", stretch, {name: len(rig.pads[c.pad].point_nodes) for name, c in rig.contacts.items()})
    still = State({}, dict(stretch), dict(pose), {}, {name: torch.zeros_like(v) for name, v in velocity.items()})
    pads = {name: _forces(rig, name, still) for name in rig.pads}
    return rig.pack(still._replace(pads=pads, velocity=dict(velocity)))


def _check(field: str, given: Mapping[str, Tensor], lengths: Mapping[str, int]) -> None:
    """Raises `ValueError` unless there is a finite float64 tensor of the right length by every name."""
    if set(given) != set(lengths):
        raise ValueError(f"`{field}` must be given by the names {list(lengths)}, but is by {list(given)}")
    for name, value in given.items():
        check_array(f"{field}[{name!r}]", value)
        if value.shape != (lengths[name],) or not bool(value.isfinite().all()):
            raise ValueError(
                f"`{field}[{name!r}]` must hold {lengths[name]} finite numbers, but has shape {tuple(value.shape)}, "
                f"{int(value.isfinite().sum())} of them finite"
            )


def _forces(rig: Rig, name: str, state: State) -> Tensor:
    """Nodal forces (branches, nodes, 2) [N] of a pad, by semi-smooth Newton from the undeformed pad.

    The last iteration is taken with the gradient on, which makes the derivative the implicit function theorem's.
    """
    pad = rig.pads[name]
    own = [key for key, contact in rig.contacts.items() if contact.pad == name]
    C, branches = pad.compliance(), pad.material.branches
    if not own:
        return torch.zeros(branches, pad.nodes, 2, dtype=torch.float64)
    points = torch.zeros(len(pad.point_nodes), 2, dtype=torch.float64)

    def force(u: Tensor) -> Tensor:
        """On the points (points, 2) [N], for their displacements u (points, 2) [m]."""
        return sum((_point_forces(rig, key, state, u) for key in own), torch.zeros_like(u))

    def displaced(f: Tensor) -> Tensor:
        """A f: displacements (points, 2) [m] under forces on the points (points, 2)."""
        return pad.spread @ (C @ (pad.spread.mT @ f).flatten()).unflatten(0, (-1, 2))

    def linearise(u: Tensor) -> tuple[Tensor, Tensor]:
        """Residual u - A f(u) and the slopes (points, 2, 2) of f: a point's force depends on its own displacement
        only."""
        with torch.enable_grad():
            x = u.detach().requires_grad_(True)
            f = force(x)
            rows = [torch.autograd.grad(f[:, i].sum(), x, retain_graph=i == 0, allow_unused=True)[0] for i in range(2)]
        with torch.no_grad():
            return u - displaced(f), torch.stack([torch.zeros_like(u) if row is None else row for row in rows], 1)

    def newton_step(r: Tensor, G: Tensor) -> Tensor:
        """(1 - A G)^-1 r: points that do not touch have no slope, and follow the others."""
        t = torch.nonzero(G.flatten(1).any(1))[:, 0]
        if not len(t):
            return r
        S = pad.spread[t]
        nodes = torch.nonzero(S.any(0))[:, 0]
        A = C.detach().unflatten(0, (-1, 2)).unflatten(2, (-1, 2))[nodes][:, :, nodes]
        A_tt = torch.einsum("pn,niaj,qa->piqj", S[:, nodes], A, S[:, nodes])
        J = torch.eye(2 * len(t), dtype=r.dtype) - torch.einsum("piqj,qjk->piqk", A_tt, G[t]).reshape(2 * len(t), -1)
        touching = torch.linalg.solve(J, r[t].flatten()[:, None]).unflatten(0, (-1, 2))
        carried = torch.zeros_like(r).index_copy(0, t, (G[t] @ touching)[..., 0])
        return r + displaced(carried)

    with torch.no_grad():
        u = points
        r, G = linearise(u)
        for _ in range(ITERATIONS):
            if float(r.abs().max()) <= RESIDUAL:
                break
            step = newton_step(r, G)
            for _ in range(12):  # halve until the residual falls
                trial = linearise(u - step)
                if float(trial[0].norm()) < float(r.norm()):
                    break
                step = 0.5 * step
            u, (r, G) = u - step, trial
        else:
            raise NoEquilibrium(
                f"the massless pad `{name}` does not settle (residual {float(r.abs().max()):.2g} m after {ITERATIONS} "
                "iterations); is a body deep in it, or are the stretches large?"
            )
    u = u - newton_step(u - displaced(force(u)), G)
    return (pad.spread.mT @ force(u)).expand(branches, -1, -1)


def _point_forces(rig: Rig, key: str, state: State, u: Tensor) -> Tensor:
    """Of one contact on its pad (points, 2) [N], for the points' displacements u (points, 2) [m] at rest."""
    contact = rig.contacts[key]
    shape = rig.bodies[contact.body].shape
    assert shape is not None
    x = point_inputs(rig, key, state, u, torch.zeros_like(u))
    return interface_law(contact.law, shape, x)[..., :2]
