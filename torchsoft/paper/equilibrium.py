"""Static, frictionless equilibria of the paper's rig: the object at rest under its weight, and pressed between the pads."""

import warnings
from typing import Any

import torch
from torch import Tensor

from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.arguments import number
from torchsoft.physics.contact import Frame, cross, moving_frame, normal_force
from torchsoft.physics.state import State
from torchsoft.physics.statics import RESIDUAL, NoEquilibrium
from torchsoft.physics.validity import check_values

MOMENT_ARM = 1e-2
"""Largest moment on the object, over its size and the load, that is not worth a warning."""


def check_statics(model: SoftGrasp) -> None:
    """Raises `ValueError` for a model whose statics would be nonsense, or have no graph."""
    if torch.is_inference_mode_enabled():
        raise ValueError("statics need torch's graphs, which torch.inference_mode() has not; use torch.no_grad()")
    check_values(model)


def rest(model: SoftGrasp, x: Tensor | None = None) -> Tensor:
    """State (size,): the object at rest on the lower pad under its weight, the upper pad just touching it from above.

    `x` () [m] is where, by default the scenario's x_C0; the state is differentiable in it.
    """
    check_statics(model)
    weightless = float((model.disc.mass * model.gravity).detach()) == 0.0
    at = torch.tensor(model.settings.scenario.x_C0, dtype=torch.float64) if x is None else x
    state = touching(model, at) if weightless else solve(model, None, at)
    x, y, _ = state.pose["disc"]
    return model.pack(with_bracket(state, x, model.touch_height(y)))


def press(model: SoftGrasp, bracket_height: float) -> Tensor:
    """State (size,): the object between the pads with the bracket held at `bracket_height` [m], without friction.

    Raises `NoEquilibrium` when the bracket is too high for its pad to touch the object, sunk in under its weight.
    """
    check_statics(model)
    number("bracket_height", bracket_height)
    p = model.settings
    with torch.no_grad():
        up = float(model.touch_height(p.pad.height + model.shape.support(torch.tensor([0.0, -1.0]).double())))
    x = torch.tensor(p.scenario.x_C0, dtype=torch.float64)
    state = None if bracket_height >= up else solve(model, bracket_height, x)
    if state is None or not bool(state.pads["U"].any()):
        raise NoEquilibrium(f"the bracket at {bracket_height} m is too high for its pad to touch the disc; lower it")
    return model.pack(state)


@torch.no_grad()
def holding_force(model: SoftGrasp, y: Tensor) -> float:
    """Force [N] on the bracket, downwards, that balances the upper pad's normal forces in the frictionless state y (size,)."""
    pad, part = model.pads["U"], model.unpack(y).pads["U"]
    force = pad.elastic_force(part) if pad.inertial else part[0]
    return float(force[:, 1].sum())


def with_bracket(state: State, x: Tensor, y: Tensor) -> State:
    return state._replace(pose=state.pose | {"bracket": torch.stack((x, y, torch.zeros_like(y)))})


def touching(model: SoftGrasp, x: Tensor) -> State:
    """The object where it just touches the undeformed lower pad: what a body without weight rests like."""
    top = model.settings.pad.height
    zero = torch.zeros((), dtype=torch.float64)
    below = float(model.shape.support(torch.tensor([0.0, -1.0]).double()).detach())
    from scipy.optimize import brentq  # a third of a second, for inertial pads only

    side = Side(model, "L", torch.zeros(2, dtype=torch.float64), x)

    def deepest(height: Tensor) -> tuple[Tensor, Tensor]:
        """Penetration of the deepest point [m], and its derivative by the height."""
        frame = side.frame(torch.zeros(len(side.near), 2, dtype=torch.float64), height)
        k = frame.g.argmax()
        return frame.g[k], frame.n[k, 1]

    with torch.no_grad():
        y: Any = brentq(lambda y: float(deepest(zero + y)[0]), top + 0.5 * below, top + 1.01 * below, xtol=1e-15)
    penetration, slope = deepest(zero + y)
    height = y - penetration / slope.detach()  # its gradient is the implicit function theorem's
    state = model.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    return with_bracket(state._replace(pose=state.pose | {"disc": torch.stack((x, height, zero))}), x, zero)


def solve(model: SoftGrasp, bracket_height: float | None, x: Tensor) -> State:
    """Unknowns: the object's height and the displacements of the nodes under (and above) it; the object stays at x [m].

    Newton with the module's own normal law; the last iteration is taken with the gradient on, so that the equilibrium's
    derivative with respect to every parameter is the implicit function theorem's.
    """
    p = model.settings
    height = p.pad.height
    zero = torch.zeros((), dtype=torch.float64)
    below, above = (float(model.shape.support(torch.tensor([0.0, s]).double()).detach()) for s in (-1.0, 1.0))
    y_Br = zero + (bracket_height if bracket_height is not None else 10 * (below + height))
    bases = {"L": torch.zeros(2, dtype=torch.float64)} | (
        {} if bracket_height is None else {"U": torch.stack((x, y_Br))}
    )
    weight = model.disc.mass * model.gravity
    sides = [Side(model, k, base, x) for k, base in bases.items()]
    soft = sides[0].C.detach().diagonal().max()
    sizes = [2 * len(side.near) for side in sides]

    def forces(z: Tensor) -> list[Tensor]:
        return [side.force(u.unflatten(0, (-1, 2)), z[0]) for side, u in zip(sides, z[1:].split(sizes))]

    def residual(z: Tensor) -> Tensor:
        """Of the object's balance, by the compliance it meets, and of u = C F on each side [m]."""
        F = forces(z)
        balance = -weight - sum(f[:, 1].sum() for f in F)
        parts = (u - side.C @ f.flatten() for side, f, u in zip(sides, F, z[1:].split(sizes)))
        return torch.cat([soft * balance[None], *parts])

    def linearise(z: Tensor) -> Tensor:
        with torch.enable_grad():
            return torch.autograd.functional.jacobian(residual, z.detach(), vectorize=True)  # pyright: ignore

    upper = 2 * below + height if bracket_height is None else bracket_height - p.bracket.cm_height - height
    start = height + below - 0.1 * height if bracket_height is None else 0.5 * (height + below + upper - above)
    z = torch.cat((zero[None] + start, torch.zeros(sum(sizes), dtype=torch.float64)))
    with torch.no_grad():
        r = residual(z)
        for _ in range(100):
            if float(r.abs().max()) <= RESIDUAL:
                break
            step = newton_step(linearise(z), r)
            scale = min(1.0, 0.2 * height / float(step[0].abs().clamp(min=1e-12)))
            for _ in range(12):
                trial = z - scale * step
                r_trial = residual(trial)
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
    z = z - newton_step(J, residual(z))
    with torch.no_grad():
        turning = [side.turning(u.unflatten(0, (-1, 2)), z[0]) for side, u in zip(sides, z[1:].split(sizes))]
        moment, load = (float(sum(x)) for x in zip(*turning))
    if abs(moment) > MOMENT_ARM * model.shape.size() * load:
        warnings.warn(
            f"the object is held at theta = 0, where the pads turn it with {moment:.3g} N.m: a run from here begins with that",
            stacklevel=3,
        )
    state = model.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    pads = dict(state.pads)
    for side, F in zip(sides, forces(z)):
        pads[side.name] = side.everywhere(F)
    state = state._replace(pads=pads, pose=state.pose | {"disc": torch.stack((x, z[0], zero))})
    return with_bracket(state, x, y_Br)


def newton_step(J: Tensor, r: Tensor) -> Tensor:
    """J^-1 r; the shortest step where no node touches and leaves the object's height undetermined."""
    step, singular = torch.linalg.solve_ex(J, r[:, None])
    return (torch.linalg.lstsq(J, r[:, None]).solution if bool(singular) else step)[:, 0]


class Side:
    """One pad's surface as far as the object reaches sideways: its frictionless nodal forces, and what they do to the pad."""

    def __init__(self, model: SoftGrasp, name: str, base: Tensor, x: Tensor) -> None:
        self.model, self.name, self.x, self.pad = model, name, x, model.pads[name]
        sideways = torch.tensor([[1.0, 0.0], [-1.0, 0.0]]).double()
        reach = float(model.shape.support(sideways).detach().max())
        places = self.pad.point_positions + base
        points = torch.nonzero((places[:, 0] - x.detach()).abs() < reach)[:, 0]
        spread = self.pad.spread[points][:, self.pad.surface]
        self.near = torch.nonzero(spread.any(0))[:, 0]
        self.places, self.spread = places[points], spread[:, self.near]
        self.K_n = model.weight(name)[points] * model.contacts[name].law.K_n
        dofs = (2 * self.near[:, None] + torch.arange(2)).flatten()
        self.C = self.pad.compliance()[dofs][:, dofs]

    def frame(self, u: Tensor, y_C: Tensor) -> Frame:
        """Of each near point, for displacements u (near, 2) [m] of the near nodes and the object's height [m]."""
        d = self.places + self.spread @ u - torch.stack((self.x, y_C))
        return moving_frame(self.model.shape, d, torch.zeros_like(y_C).expand(len(d)))

    def point_forces(self, frame: Frame) -> Tensor:
        """On each near point (points, 2) [N]."""
        zero = torch.zeros((), dtype=torch.float64)
        return normal_force(frame.g, zero, zero, self.K_n, zero)[:, None] * frame.n

    def force(self, u: Tensor, y_C: Tensor) -> Tensor:
        """On each near node, (near, 2) [N], for their displacements u (near, 2) [m] and the object's height [m]."""
        return self.spread.mT @ self.point_forces(self.frame(u, y_C))

    def turning(self, u: Tensor, y_C: Tensor) -> tuple[Tensor, Tensor]:
        """Moment on the object [N.m], and the sum of the points' forces [N]."""
        frame = self.frame(u, y_C)
        f = self.point_forces(frame)
        return -(cross(frame.d) * f).sum(), torch.linalg.vector_norm(f, dim=-1).sum()

    def everywhere(self, F: Tensor) -> Tensor:
        """The pad's state under nodal forces F (near, 2): forces that have set in, or the displacements of all nodes."""
        count = len(self.pad.mesh.surface)
        full = torch.zeros(count, 2, dtype=F.dtype).index_copy(0, self.near, F)
        if not self.pad.inertial:
            return full.expand(self.pad.material.branches, -1, -1)
        return self.pad.static_displacement(full)
