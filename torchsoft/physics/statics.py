"""Statics of any rig, without friction: pads settled around given bodies, and free coordinates in balance on them.

Without rates all branches of a massless pad carry the contact force itself, z_b = f, and its displacements are u = C f.
At the contact points that is u = A f(u), with A the pad's compliance from point to point and f the contact law, without
any rate, at the bodies' given poses and the points' given stretches.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchsoft.physics.condensed import point_inputs
from torchsoft.physics.contact import interface_law
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.state import State
from torchsoft.physics.validity import check_array, check_values

RESIDUAL = 1e-13
"""Residual of an equilibrium [m], forces counted by the compliance they meet."""

SETTLING = 30
"""Iterations of Newton's method for a pad; from undeformed pads it takes about ten."""

STRIDE = 0.2
"""Longest step of the search for balance over the height of the thinnest pad."""

STALLED = 20
"""Steps without smaller loads and without way, after which the search ends: loads to and fro over the edge of a contact."""

ITERATIONS = 200
"""Steps of the search at the most: a body may start that many strides above its pad."""


class NoEquilibrium(RuntimeError):
    """Newton's iteration found no static equilibrium."""


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
    check_given("pose", pose, dict.fromkeys(rig.bodies, 3))
    check_given("velocity", velocity, dict.fromkeys(rig.bodies, 3))
    check_given("stretch", stretch, {name: len(rig.pads[c.pad].point_nodes) for name, c in rig.contacts.items()})
    still = State({}, dict(stretch), dict(pose), {}, {name: torch.zeros_like(v) for name, v in velocity.items()})
    pads = {name: carried(rig, name, still) for name in rig.pads}
    return rig.pack(still._replace(pads=pads, velocity=dict(velocity)))


def check_given(field: str, given: Mapping[str, Tensor], lengths: Mapping[str, int]) -> None:
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


def carried(rig: Rig, name: str, state: State) -> Tensor:
    """Nodal forces (..., branches, nodes, 2) [N] of a pad, by semi-smooth Newton from the undeformed pad.

    Batch dimensions of `state` hold copies of one state: one backward pass then gives as many rows of a Jacobian.
    The last iteration is taken with the gradient on, which makes the derivative the implicit function theorem's.
    """
    pad = rig.pads[name]
    own = [key for key, contact in rig.contacts.items() if contact.pad == name]
    C, branches = pad.compliance(), pad.material.branches
    if not own:
        return torch.zeros(branches, pad.nodes, 2, dtype=torch.float64)
    one = first(state)

    def force(u: Tensor, state: State = one) -> Tensor:
        """On the points (..., points, 2) [N], for their displacements u (..., points, 2) [m]."""
        return sum((point_forces(rig, key, state, u) for key in own), torch.zeros_like(u))

    def displaced(f: Tensor) -> Tensor:
        """A f: displacements (..., points, 2) [m] under forces on the points (..., points, 2)."""
        return pad.spread @ ((pad.spread.mT @ f).flatten(-2) @ C.mT).unflatten(-1, (-1, 2))

    def linearise(u: Tensor) -> tuple[Tensor, Tensor]:
        """Residual u - A f(u) and the slopes (points, 2, 2) of f: a point's force depends on its own displacement
        only."""
        with torch.enable_grad():
            x = u.detach().expand(2, -1, -1).clone().requires_grad_(True)  # a copy for each component of the force
            f = force(x)
            (rows,) = torch.autograd.grad(f[0, :, 0].sum() + f[1, :, 1].sum(), x, materialize_grads=True)
        with torch.no_grad():
            return u - displaced(f[0]), rows.transpose(0, 1)

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
        touching = torch.linalg.solve(J, r[..., t, :].flatten(-2)[..., None]).unflatten(-2, (-1, 2))
        return r + displaced(torch.zeros_like(r).index_copy(-2, t, (G[t] @ touching)[..., 0]))

    with torch.no_grad():
        u = torch.zeros(len(pad.point_nodes), 2, dtype=torch.float64)
        r, G = linearise(u)
        for _ in range(SETTLING):
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
                f"the massless pad `{name}` does not settle (residual {float(r.abs().max()):.2g} m after {SETTLING} "
                "iterations); is a body deep in it, or are the stretches large?"
            )
    u = u - newton_step(u - displaced(force(u, state)), G)
    f = pad.spread.mT @ force(u, state)
    return f[..., None, :, :].expand(*f.shape[:-2], branches, -1, -1)


def first(state: State) -> State:
    """Of several copies of a state."""
    batch = next(iter(state.pose.values())).ndim - 1
    return State(*({name: value[(0,) * batch] for name, value in part.items()} for part in state))


def point_forces(rig: Rig, key: str, state: State, u: Tensor) -> Tensor:
    """Of one contact on its pad (points, 2) [N], for the points' displacements u (points, 2) [m] at rest."""
    contact = rig.contacts[key]
    shape = rig.bodies[contact.body].shape
    assert shape is not None
    x = point_inputs(rig, key, state, u, torch.zeros_like(u))
    return interface_law(contact.law, shape, x)[..., :2]


def massless(rig: Rig) -> Rig:
    """The rig with its inertial pads condensed onto their surfaces, which in statics is the same; itself if it has none."""
    if not any(pad.inertial for pad in rig.pads.values()):
        return rig
    return Rig(
        bodies=rig.bodies, pads={name: pad.condensed() for name, pad in rig.pads.items()}, contacts=rig.contacts,
        actuators=rig.actuators, reference=rig.reference, gravity=float(rig.gravity.detach()), symbols=rig.symbols,
    )  # fmt: skip


@torch.no_grad()
def standing(rig: Rig, pose: Mapping[str, Tensor]) -> Tensor:
    """State (size,) of bodies that stand at `pose` [m, m, rad], by body (3,), with pads settled around them and no point
    stretched. Raises what `settled` does, but takes inertial pads."""
    soft = massless(rig)
    still = {name: torch.zeros(3, dtype=torch.float64) for name in soft.bodies}
    stretch = {
        name: torch.zeros(len(soft.pads[c.pad].point_nodes), dtype=torch.float64) for name, c in soft.contacts.items()
    }
    with torch.enable_grad():
        y = settled(soft, pose, still, stretch).detach()
    if soft is rig:
        return y
    state, own = soft.layout.unpack(y, pose, still), rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64))
    pads = {
        name: pad.static_displacement(state.pads[name][0]) if pad.inertial else state.pads[name]
        for name, pad in rig.pads.items()
    }
    return rig.pack(own._replace(pads=pads, pose=state.pose))


def resting(rig: Rig, pose: Mapping[str, Tensor], residual: float = RESIDUAL) -> dict[str, Tensor]:
    """Poses (3,) [m, m, rad] by body of a rig at rest, looked for from `pose`; fixed and driven coordinates are what they are
    at t = 0, whatever `pose` says.

    Newton's method on the net loads of the free coordinates, each step no longer than `STRIDE`: a body above its pad comes down
    to it. Done when net loads, counted by the compliance of the softest pad, are below `residual` [m]. Raises `NoEquilibrium`
    where there is no balance, and what `settled` does.
    """
    soft = massless(rig)
    held, _ = soft.held(soft.follow(0.0))
    free = {name: torch.tensor(axes, dtype=torch.long) for name, axes in soft.layout.free.items()}
    with torch.no_grad():
        masses = {name: torch.stack(body.masses) for name, body in soft.bodies.items()}
        # an angle counts by the way of a point at the radius of gyration, so that all are lengths and forces
        sizes = {
            name: torch.stack((one, one, (m[2] / m[0]).sqrt())) for name, m in masses.items() for one in [m[0] / m[0]]
        }
        scale = torch.cat([sizes[name][axes] for name, axes in free.items()])
        q = torch.cat([pose[name].detach()[axes] for name, axes in free.items()]) * scale
        mesh = min(pad.mesh.height for pad in soft.pads.values())
        softest = max(float(pad.compliance().diagonal().max()) for pad in soft.pads.values())
    counts = [len(axes) for axes in free.values()]

    def poses(q: Tensor) -> dict[str, Tensor]:
        parts = (q / scale).split(counts, -1)
        fixed = {name: held[name].detach().expand(*q.shape[:-1], 3) for name in free}
        return held | {name: fixed[name].index_copy(-1, free[name], part) for name, part in zip(free, parts)}

    def loads(q: Tensor) -> Tensor:
        """Net loads on the free coordinates (..., n) [N]."""
        still = {name: torch.zeros(*q.shape[:-1], 3, dtype=q.dtype) for name in soft.bodies}
        stretch = {
            name: torch.zeros(*q.shape[:-1], len(soft.pads[c.pad].point_nodes), dtype=q.dtype)
            for name, c in soft.contacts.items()
        }
        state = State({}, stretch, poses(q), {}, still)
        state = state._replace(pads={name: carried(soft, name, state) for name in soft.pads})
        graph = soft.evaluate(0.0, state, settled=True)
        net = soft.loads(graph, net_efforts(graph.ports, soft.junctions))
        return torch.cat([net[name][..., axes] for name, axes in free.items()], -1) / scale

    path: list[tuple[float, Tensor]] = []
    while len(path) < ITERATIONS and not stalled(path, STRIDE * mesh):
        with torch.enable_grad():
            x = q.detach().expand(len(q), -1).clone().requires_grad_(True)  # a copy for each load
            F = loads(x)
            (rows,) = torch.autograd.grad(F.diagonal().sum(), x, materialize_grads=True)
        F, K = F[0].detach(), -rows
        size = float(F.norm())
        if size * softest <= residual:
            return {name: value.detach() for name, value in poses(q).items()}
        path.append((size, q))
        # as stiff as keeps the step short, which vanishes with the load: quadratic at the end
        q = q + torch.linalg.solve(K + size / (STRIDE * mesh) * torch.eye(len(q), dtype=q.dtype), F)
    worst = int(F.abs().argmax())
    names = [f"{name}.{COORDINATES[int(axis)]}" for name, axes in free.items() for axis in axes]
    raise NoEquilibrium(
        f"nothing is at rest: after {len(path)} steps {float(F.abs().max()):.2g} N still push {names[worst]}; is there a pad "
        "to carry it?"
    )


def stalled(path: Sequence[tuple[float, Tensor]], stride: float) -> bool:
    """Whether the last steps of loads [N] and coordinates (n,) [m] led nowhere."""
    if len(path) <= STALLED:
        return False
    before, last = path[:-STALLED], path[-STALLED:]
    near = float((last[-1][1] - last[0][1]).norm()) <= stride
    return near and min(size for size, _ in last) >= min(size for size, _ in before)
