"""Static, frictionless equilibria: the disc at rest under its weight, and pressed between the pads."""

import torch
from torch import Tensor

from torchsoft.contact import normal_force
from torchsoft.model import SoftGrasp
from torchsoft.pad import Pad
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


def _solve(model: SoftGrasp, bracket_height: float | None) -> State:
    """Unknowns: the disc's height and the displacements of the nodes under (and above) it; x_C stays at `x_C0`.

    Newton with the module's own normal law; the last iteration is taken with the gradient on, so that the equilibrium's
    derivative with respect to every parameter is the implicit function theorem's.
    """
    p = model.settings
    x, height = torch.tensor(p.scenario.x_C0, dtype=torch.float64), p.pad.height
    zero = torch.zeros((), dtype=torch.float64)
    y_Br = zero + (bracket_height if bracket_height is not None else 10 * (p.disc.radius + height))
    names = "L" if bracket_height is None else "LU"
    reach = min(p.disc.radius, 3 * (p.disc.radius * height) ** 0.5)
    near = {
        k: torch.nonzero(
            (model.pads[k].positions[model.pads[k].surface, 0] + (0 if k == "L" else p.scenario.x_C0) - x).abs() < reach
        )[:, 0]
        for k in names
    }
    sizes = [2 * len(near[k]) for k in names]
    weight = torch.stack((zero, -model.m_C * model.gravity))

    def forces(z: Tensor) -> tuple[dict[str, Tensor], State]:
        """Frictionless force on each near node, (near, 2), and the state it belongs to (near nodes only displaced)."""
        blank = model.layout.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
        displaced = dict(zip(names, (part.unflatten(-1, (-1, 2)) for part in z[1:].split(sizes))))
        state = blank._replace(r_C=torch.stack((x, z[0])), r_Br=torch.stack((x, y_Br)))
        for k in names:
            nodes = model.pads[k].surface[near[k]]
            u = torch.zeros_like(getattr(state, f"u_{k}")).index_add(0, nodes, displaced[k])
            state = state._replace(**{f"u_{k}": u})
        out = {}
        for k in names:
            frame, share = model.frame(k, state, near[k]), model.share(model.pads[k])[near[k]]
            F_N = normal_force(frame.g, zero, zero, share * model.contact.K_n, zero)
            out[k] = F_N[:, None] * frame.n
        return out, state

    def compliance(pad: Pad, k: str, everywhere: bool = False) -> Tensor:
        """Displacement of the near surface nodes, or of every node, per force on the near ones."""
        columns = (2 * near[k][:, None] + torch.arange(2)).flatten()
        nodes = torch.arange(pad.nodes) if everywhere else pad.surface[near[k]]
        rows = (2 * nodes[:, None] + torch.arange(2)).flatten()
        return pad.compliance(model.material)[rows][:, columns]

    C = {k: compliance(model.pads[k], k) for k in names}
    soft = C["L"].detach().diagonal().max()

    def residual(z: Tensor) -> Tensor:
        f, _ = forces(z)
        balance = weight[1] - sum(f[k][:, 1].sum() for k in names)
        return torch.cat(
            [soft * balance[None], *(part - C[k] @ f[k].flatten() for k, part in zip(names, z[1:].split(sizes)))]
        )

    upper = 2 * p.disc.radius + height if bracket_height is None else bracket_height - p.bracket.cm_height - height
    start = height + p.disc.radius - 0.1 * height if bracket_height is None else 0.5 * (height + upper)
    z = torch.cat((zero[None] + start, torch.zeros(sum(sizes), dtype=torch.float64)))
    with torch.no_grad():
        r = residual(z)
        for _ in range(100):
            if float(r.abs().max()) <= RESIDUAL:
                break
            step = torch.linalg.lstsq(torch.func.jacfwd(residual)(z), r[:, None]).solution[:, 0]
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
        J = torch.func.jacfwd(residual)(z)
    z = z - torch.linalg.solve(J, residual(z)[:, None])[:, 0]
    f, state = forces(z)
    for k in names:
        u = (compliance(model.pads[k], k, everywhere=True) @ f[k].flatten()).unflatten(-1, (-1, 2))
        state = state._replace(**{f"u_{k}": u})
    return state
