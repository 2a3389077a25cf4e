"""Statics of any rig, without friction: pads settled around given bodies, and free coordinates in
balance on them.

Without rates all branches of a condensed pad carry the contact force itself, z_b = f, and its
displacements are u = C f. At the contact points that is u = A f(u), with A the pad's compliance
from point to point and f the contact law, without any rate, at the bodies' given poses and the
points' given stretches. A nodal pad's elements are in balance with f(u), its branches relaxed.
"""

from collections import deque
from collections.abc import Container, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsoft.parallel import one_torch_thread, ungraphed
from torchsoft.physics.balance import Nodes, contact_forces, corrected, newton
from torchsoft.physics.contact import cross, turned
from torchsoft.physics.graph import Graph
from torchsoft.physics.motion import Reference
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.state import State
from torchsoft.physics.structure import values_of
from torchsoft.physics.validity import check_array, check_points, check_values

RESIDUAL = 1e-13
"""Residual of an equilibrium [m]: the way that the loads left over would push."""

SETTLING = 30
"""Iterations of Newton's method for a pad; from undeformed pads it takes about ten."""

SOFTER = (1e-4, 1e-3, 1e-2, 0.1, 1.0)
"""Parts of the contact forces under which a nodal pad settles, one after the other, where it does
not under all of them at once."""

STRIDE = 0.2
"""Longest step of the search for balance over the height of the thinnest pad."""

NEUTRAL, ROUNDED = 1e-12, 1e-14
"""Stiffness of a direction over the largest that makes it neutral, such as the turning of a disc
without weight, and load on it, over that stiffness and a stride, that is rounding."""

STALLED = 20
"""Steps without smaller loads and without way, after which the search ends: loads to and fro over
the edge of a contact."""

ITERATIONS = 200
"""Steps of the search at the most: a body may start that many strides above its pad."""


class NoEquilibrium(RuntimeError):
    """Newton's iteration found no static equilibrium."""


@ungraphed
@one_torch_thread()
def settled(
    rig: Graph,
    pose: Mapping[str, Tensor],
    velocity: Mapping[str, Tensor],
    stretch: Mapping[str, Tensor],
    t: float = 0.0,
    reference: Reference | None = None,
) -> Tensor:
    """State (size,) with pads settled around bodies at `pose` [m, rad], by body (3,), contacts
    whose points are stretched by `stretch` [m], by contact (points,), and states of actuators that
    start at t [s] of a reference, by default the rig's.

    The bodies move at `velocity` [m/s, rad/s], by body (3,), but the pads carry the loads of bodies
    that stand still: under a body that rolls at v the pads lag behind by v tau only, whereas pads
    at rest under it would meet all of its dashpots. Differentiable once in all three and in the
    rig's parameters, by the implicit function theorem; not smooth where a point touches or slips.
    Called again with the same numbers it gives the same bits.

    Raises `ValueError` for other shapes or a rig with parameters that are not physical,
    `NoEquilibrium` where Newton's method fails.
    """
    if torch.is_inference_mode_enabled():
        raise ValueError(
            "settled pads need torch's graphs, which torch.inference_mode() has not; use "
            "torch.no_grad()"
        )
    check_values(rig)
    check_points(rig)
    check_given("pose", pose, dict.fromkeys(rig.bodies, 3))
    check_given("velocity", velocity, dict.fromkeys(rig.bodies, 3))
    check_given("stretch", stretch, rig.point_counts)
    at_rest = State(
        {},
        dict(stretch),
        dict(pose),
        {},
        {name: torch.zeros_like(v) for name, v in velocity.items()},
    )
    pads = {name: carried(rig, name, at_rest) for name in rig.pads}
    moving = at_rest._replace(velocity=dict(velocity))
    inertial = [name for name, pad in rig.pads.items() if pad.inertial]
    rates = {name: carried_along(rig, name, moving, pads[name]) for name in inertial}
    return rig.pack(moving._replace(pads=pads, rates=rates), t, reference)


def check_given(field: str, given: Mapping[str, Tensor], lengths: Mapping[str, int]) -> None:
    """Raises `ValueError` unless there is a finite float64 tensor of the right length by every
    name."""
    if set(given) != set(lengths):
        raise ValueError(
            f"`{field}` must be given by the names {list(lengths)}, but is by {list(given)}"
        )
    for name, value in given.items():
        check_array(f"{field}[{name!r}]", value)
        if value.shape != (lengths[name],) or not bool(value.isfinite().all()):
            raise ValueError(
                f"`{field}[{name!r}]` must hold {lengths[name]} finite numbers, but has shape "
                f"{tuple(value.shape)}, {int(value.isfinite().sum())} of them finite"
            )


def carried(rig: Graph, name: str, state: State, known: dict[str, Tensor] | None = None) -> Tensor:
    """A pad's part of the state at rest, by semi-smooth Newton from the undeformed pad: its nodes'
    displacements (..., nodes, 2 fields) [m], or the forces on them (..., branches, nodes, 2) [N].

    Batch dimensions of `state` hold copies of one state: one backward pass then gives as many rows
    of a Jacobian. A nodal pad is sought from the displacements that `known` holds of a state
    nearby, and leaves its own there.
    """
    pad = rig.pads[name]
    contacts = rig.contacts_of(name)
    batch = next(iter(state.pose.values())).shape[:-1]
    undeformed = torch.zeros(*batch, pad.nodes, 2, dtype=torch.float64)
    found, left = undeformed, 0.0
    if contacts and pad.nodal:
        found, left = displaced(rig, name, state, batch, {} if known is None else known)
    elif contacts:
        law = lambda u: rig.point_forces(contacts, state, u, torch.zeros_like(u))
        found, left = contact_forces(
            pad.compliance(), pad.interpolation, undeformed, law, RESIDUAL, SETTLING
        )
    if not left <= RESIDUAL:
        raise NoEquilibrium(
            f"the pad `{name}` does not settle (residual {left:.2g} m after {SETTLING} "
            "iterations); is a body deep in it, or are the stretches large?"
        )
    if pad.nodal:
        return torch.cat([found] * pad.fields, -1)
    return found[..., None, :, :].expand(*batch, pad.branches, -1, -1)


def displaced(
    rig: Graph, name: str, state: State, batch: Sequence[int], known: dict[str, Tensor]
) -> tuple[Tensor, float]:
    """Displacements (*batch, nodes, 2) [m] of a nodal pad in balance with its contacts, in a batch
    of copies of one state, and the largest step that is left."""
    pad, contacts, first = rig.pads[name], rig.contacts_of(name), (0,) * len(batch)

    def law(u: Tensor, state: State, part: float = 1.0) -> Tensor:
        return part * rig.point_forces(contacts, state, u, torch.zeros_like(u))

    alone = lambda values: {key: value[first].detach() for key, value in values.items()}
    one = State({}, alone(state.stretch), alone(state.pose), {}, alone(state.velocity))
    undeformed = torch.zeros(pad.nodes, 2, dtype=torch.float64)
    begins = [(known[name], (1.0,))] if name in known else []
    for u, parts in (*begins, (undeformed, (1.0,)), (undeformed, SOFTER)):
        try:
            for part in parts:
                softer = Nodes(pad, pad.element_forces, partial(law, state=one, part=part))
                u, solve, left = newton(softer, u, RESIDUAL, SETTLING)
        except FloatingPointError:
            continue
        if left <= RESIDUAL:
            known[name] = u
            copies = Nodes(pad, pad.element_forces, partial(law, state=state))
            return corrected(copies, u.expand(*batch, -1, -1), solve), left
    return undeformed, torch.inf


def carried_along(rig: Graph, name: str, state: State, u: Tensor) -> Tensor:
    """Velocities (nodes, 2) [m/s] of a pad's nodes that its base carries along, displaced by u."""
    pose, velocity = rig.base_motion(name, state)
    return velocity[:2] + velocity[2] * cross(turned(rig.pads[name].positions + u, pose[2]))


def with_condensed_pads(rig: Graph) -> Graph:
    """The rig with all pads linear and massless, on their surface alone; itself if they are."""
    if not any(pad.nodal for pad in rig.pads.values()):
        return rig
    return Graph(
        bodies=rig.bodies, pads={name: pad.condensed() for name, pad in rig.pads.items()},
        contacts=rig.contacts, actuators=rig.actuators, reference=rig.reference,
        gravity=float(rig.gravity.detach()), symbols=rig.symbols, taxels=rig.taxels,
    )  # fmt: skip


def standing(
    rig: Graph, pose: Mapping[str, Tensor], t: float = 0.0, reference: Reference | None = None
) -> Tensor:
    """State (size,) of bodies that stand at `pose` [m, m, rad], by body (3,), with pads settled
    around them and no point stretched, at t [s]. Differentiable and raises as `settled`."""
    at_rest = {name: torch.zeros(3, dtype=torch.float64) for name in rig.bodies}
    return settled(rig, pose, at_rest, unstretched(rig, ()), t, reference)


@one_torch_thread()
def standing_loads(rig: Graph, pose: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Forces and moments left on bodies that stand at `pose` (3,) [N, N, N.m], no actuator pushing.
    Differentiable and raises as `settled`."""
    return net_loads(rig, standing_state(rig, pose), no_signals(rig), ())


def standing_state(
    rig: Graph, pose: Mapping[str, Tensor], known: dict[str, Tensor] | None = None
) -> State:
    """State of bodies that stand at `pose` (..., 3) [m, m, rad], with pads settled around them from
    displacements `known` nearby (see `carried`), and no point stretched."""
    batch = next(iter(pose.values())).shape[:-1]
    at_rest = {name: torch.zeros(*batch, 3, dtype=torch.float64) for name in rig.bodies}
    state = State({}, unstretched(rig, batch), dict(pose), {}, at_rest)
    return state._replace(pads={name: carried(rig, name, state, known) for name in rig.pads})


def no_signals(rig: Graph) -> Tensor:
    """Zero signals and rates (signals, 2)."""
    return torch.zeros(len(rig.signals), 2, dtype=torch.float64)


def unstretched(rig: Graph, batch: Sequence[int]) -> dict[str, Tensor]:
    """No stretch (*batch, points) [m] at any contact."""
    return {
        name: torch.zeros(*batch, n, dtype=torch.float64) for name, n in rig.point_counts.items()
    }


class Balanced(NamedTuple):
    """A result of `resting`: the coordinates (n,) and the displacements of nodal pads from which
    its last step was taken, and the poses that it led to."""

    q: Tensor
    known: dict[str, Tensor]
    poses: dict[str, Tensor]


BALANCES = 64
"""Balances that are kept."""

_balances: deque[tuple[tuple[Any, ...], Balanced]] = deque(maxlen=BALANCES)


@ungraphed
@one_torch_thread()
def resting(
    rig: Graph, pose: Mapping[str, Tensor], free: Mapping[str, Sequence[int]] | None = None, *,
    signals: Tensor | None = None, actuators: Container[str] | None = None,
    pushed: Mapping[str, Tensor] | None = None, residual: float = RESIDUAL,
) -> dict[str, Tensor]:  # fmt: skip
    """Poses (3,) [m, m, rad] by body of a rig at rest, searched for from `pose`: the coordinates
    `free`, numbers by body (by default all that can move), are brought into balance, and all others
    stay as given.

    Newton's method on the net loads of the free coordinates, each step no longer than `STRIDE`: a
    body above its pad comes down to it. Done when a step is below `residual` [m], and at once where
    nothing is free. `actuators` names those that push, by default all, by `signals` (signals, 2),
    by default the reference's at t = 0; `pushed` are further loads (3,) [N, N, N.m] by body.
    Differentiable once in the given pose, in these loads and in the rig's parameters, by the
    implicit function theorem. The last `BALANCES` results are kept, by all that they depend on, and
    searched for once. Raises `NoEquilibrium` where there is no balance, and as `settled`.
    """
    check_points(rig)
    sought = {
        k: torch.tensor(axes, dtype=torch.long)
        for k, axes in (free or rig.layout.free).items()
        if len(axes)
    }
    if not sought:
        return dict(pose)
    followed = rig.follow(0.0) if signals is None else signals
    given = *pose.values(), *(pushed or {}).values(), followed
    names = tuple(k for k in rig.actuators if actuators is None or k in actuators)
    key = values_of(rig, *given), *pose, repr(sought), *(pushed or ()), names, residual
    kept = next((one for other, one in [*_balances] if other == key), None) if key[0] else None
    if kept and not torch.is_grad_enabled():
        return {name: at.clone() for name, at in kept.poses.items()}
    with torch.no_grad():
        masses = {name: torch.stack(rig.bodies[name].masses) for name in sought}
        # an angle counts by the way of a point at the radius of gyration, so that all are lengths
        # and forces
        sizes = {
            name: torch.stack((one, one, (m[2] / m[0]).sqrt()))
            for name, m in masses.items()
            for one in [m[0] / m[0]]
        }
        scale = torch.cat([sizes[name][axes] for name, axes in sought.items()])
        q = torch.cat([pose[name][axes] for name, axes in sought.items()]) * scale
        q = kept.q if kept else q
        stride = STRIDE * min(pad.mesh.height for pad in rig.pads.values())
    counts = [len(axes) for axes in sought.values()]

    def poses(q: Tensor) -> dict[str, Tensor]:
        parts = dict(zip(sought, (q / scale).split(counts, -1)))
        at = {name: value.expand(*q.shape[:-1], 3) for name, value in pose.items()}
        return at | {
            name: at[name].index_copy(-1, axes, parts[name]) for name, axes in sought.items()
        }

    def loads(q: Tensor) -> Tensor:
        """Net loads on the free coordinates (..., n) [N]."""
        state = standing_state(rig, poses(q), known)
        net = net_loads(rig, state, followed.expand(*q.shape[:-1], -1, -1), actuators)
        net |= {name: net[name] + load for name, load in (pushed or {}).items()}
        return torch.cat([net[name][..., axes] for name, axes in sought.items()], -1) / scale

    known: dict[str, Tensor] = dict(kept.known) if kept else {}
    path: list[tuple[float, Tensor]] = []
    while len(path) < ITERATIONS and not stalled(path, stride):
        before = dict(known)
        with torch.enable_grad():
            x = q.expand(len(q), -1).clone().requires_grad_(True)  # a copy for each load
            net = loads(x)
            (rows,) = torch.autograd.grad(
                net.diagonal().sum(), x, materialize_grads=True, retain_graph=True
            )
        F, K = net[0].detach(), -rows
        size = float(F.norm())
        U, S, V = torch.linalg.svd(K)
        along = U.mT @ F
        neutral = (NEUTRAL * S[0] >= S) & (along.abs() <= ROUNDED * S[0] * stride)
        # as stiff as keeps the step short, which vanishes with the load: quadratic at the end
        held = max(size / stride, torch.finfo(q.dtype).tiny)  # of a body without load, too
        short = held * torch.eye(len(q), dtype=q.dtype)
        step = torch.linalg.solve(K + short, F - U[:, neutral] @ along[neutral])
        if float(step.norm()) <= residual:
            inverse = (V.mT[:, ~neutral] / S[~neutral]) @ U.mT[~neutral]
            found = poses(q + inverse @ (net[0] if torch.is_grad_enabled() else F))
            if key[0] and not kept:
                copies = {name: at.detach().clone() for name, at in found.items()}
                _balances.append((key, Balanced(q, before, copies)))
            return found
        path.append((size, q))
        q = q + step
    worst = int(F.abs().argmax())
    names = [f"{name}.{COORDINATES[int(axis)]}" for name, axes in sought.items() for axis in axes]
    raise NoEquilibrium(
        f"no equilibrium found: after {len(path)} steps {float(F.abs().max()):.2g} N still push "
        f"{names[worst]}; is there a pad to carry it?"
    )


def net_loads(
    rig: Graph, state: State, signals: Tensor, actuators: Container[str] | None = None
) -> dict[str, Tensor]:
    """Forces and moments left on the bodies (..., 3) [N, N, N.m] in a state without rates;
    `actuators` names those that push, by default all."""
    graph = rig.evaluate(0.0, state, signals, settled=True)
    off = {f"control_{k}" for k in rig.actuators if actuators is not None and k not in actuators}
    ports = {name: port for name, port in graph.ports.items() if name not in off}
    return rig.loads(graph, net_efforts(ports, rig.junctions))


def stalled(path: Sequence[tuple[float, Tensor]], stride: float) -> bool:
    """Whether the last steps of loads [N] and coordinates (n,) [m] led nowhere."""
    if len(path) <= STALLED:
        return False
    before, last = path[:-STALLED], path[-STALLED:]
    near = float((last[-1][1] - last[0][1]).norm()) <= stride
    return near and min(size for size, _ in last) >= min(size for size, _ in before)
