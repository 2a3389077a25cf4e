"""Any rig at rest, without friction: the free coordinates at which loads, weights and loops are in balance, on settled pads.

Friction locked in is left out: no point is stretched. A coordinate that nothing pushes stays where it was put.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchsoft.physics.equilibrium import RESIDUAL, NoEquilibrium
from torchsoft.physics.multibond import net_efforts
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.settled import settled

STRIDE = 0.2
"""Longest step of the search over the height of the thinnest pad."""

STALLED = 20
"""Steps without smaller loads, and without having gone further than one of the longest steps, after which it is given up: loads
to and fro over the edge of a contact."""

ITERATIONS = 200
"""Steps of the search at the most: a body may start that many strides above its pad."""


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
    still = {name: torch.zeros(3, dtype=torch.float64) for name in soft.bodies}
    stretch = {
        name: torch.zeros(len(soft.pads[c.pad].point_nodes), dtype=torch.float64) for name, c in soft.contacts.items()
    }
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
        parts = (q / scale).split(counts)
        return {name: held[name].detach().index_copy(0, free[name], part) for name, part in zip(free, parts)}

    def loads(q: Tensor) -> Tensor:
        """Net loads on the free coordinates (n,) [N]."""
        graph = soft.evaluate(0.0, soft.unpack(settled(soft, poses(q), still, stretch)), settled=True)
        net = soft.loads(graph, net_efforts(graph.ports, soft.junctions))
        return torch.cat([net[name][axes] for name, axes in free.items()]) / scale

    path: list[tuple[float, Tensor]] = []
    while len(path) < ITERATIONS and not stalled(path, STRIDE * mesh):
        with torch.enable_grad():
            x = q.detach().requires_grad_(True)
            F = loads(x)
            rows = [torch.autograd.grad(one, x, retain_graph=True)[0] if one.requires_grad else None for one in F]
        F, K = F.detach(), -torch.stack([torch.zeros_like(q) if row is None else row for row in rows])
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
