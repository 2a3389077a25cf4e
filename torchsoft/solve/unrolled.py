"""The same implicit step in plain torch: the reference of the adjoint, and the path for a law written in torch.

One stage is solved by Newton's method with the Jacobian from forward-mode differentiation, and its last iteration is taken
with the gradient on, so that backpropagation through many steps is exact. Slow (tens of milliseconds a step) and for short
windows; massless pads, one state at a time. Any `FrictionLaw` works, a neural network's too.
"""

import torch
from torch import Tensor

from torchsoft.contact import cross, moving_frame
from torchsoft.solve.grid import check_times, chunks
from torchsoft.kernels.run import GAMMA
from torchsoft.model import SoftGrasp
from torchsoft.state import State

WINDOW = 3e-4
"""How near to touching [m] a node has to be at the start of a stage to be an unknown of it."""


def unrolled_solution(
    model: SoftGrasp, y0: Tensor, t: Tensor, *, step: float = 2e-3, tolerance: float = 1e-15, max_iterations: int = 40
) -> Tensor:
    """States (T, size) at the times t (T,), by the steps that `simulate` takes, every operation recorded by autograd.

    `tolerance` is Newton's, on the residual of the pads' rates times a h, and of the velocities times a h [m, rad].
    Raises `NotImplementedError` for inertial pads and `RuntimeError` when Newton's method does not converge.
    """
    check_times(t)
    if not model.massless:
        raise NotImplementedError("the unrolled step is for massless pads; set pad.fidelity = 'massless'")
    y, out = y0, [y0]
    mix = (1.0 - GAMMA) / GAMMA
    for h, starts, keep in chunks(t, step):
        for start, output in zip(starts, keep):
            Y_1 = _stage(model, y, start + GAMMA * h, GAMMA * h, tolerance, max_iterations)
            y = _stage(model, y + mix * (Y_1 - y), start + h, GAMMA * h, tolerance, max_iterations)
            if output:
                out.append(y)
    return torch.stack(out)


def _stage(model: SoftGrasp, y_star: Tensor, time: float, ah: float, tolerance: float, max_iterations: int) -> Tensor:
    """Y = y* + a h f(time, Y). Unknowns: u' of the nodes that may touch, and V = (v_C, omega, v_Br)."""
    star, tau = model.layout.unpack(y_star), model.material.tau
    stiff = tau + ah
    V_star = torch.cat((star.v_C, star.omega[None], star.v_Br))
    inertia = torch.stack((model.m_C, model.m_C, model.inertia, model.m_Br, model.m_Br))
    want = model.reference(torch.tensor(time, dtype=torch.float64))
    u_star, s_star = {"L": star.u_L, "U": star.u_U}, {"L": star.s_L, "U": star.s_U}
    with torch.no_grad():
        near = {k: torch.nonzero(model.frame(k, star).g > -WINDOW)[:, 0] for k in "LU"}
    sizes = [2 * len(near["L"]), 2 * len(near["U"]), 5]
    dofs = {k: (2 * near[k][:, None] + torch.arange(2)).flatten() for k in "LU"}
    columns = {k: model.pads[k].compliance(model.material)[:, dofs[k]] for k in "LU"}

    def interface(k: str, u_dot: Tensor, V: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Force on the near nodes of one pad, their levers, and their stretch rates, at the end of the stage."""
        pad, nodes = model.pads[k], near[k]
        p = pad.positions[nodes] + u_star[k][nodes] + ah * u_dot
        w = V[:2] - u_dot
        if k == "U":
            p, w = p + star.r_Br + ah * V[3:], w - V[3:]
        frame = moving_frame(model.shape, p, star.r_C + ah * V[:2], star.theta + ah * V[2])
        v = w + V[2] * cross(frame.d)
        flow = [(axis * v).sum(-1) for axis in (frame.n, frame.t)]
        contact = model.contact(frame.g, *flow, s_star[k][nodes], model.share(pad)[nodes], stage=ah)
        return contact.F_N[:, None] * frame.n + contact.F_T[:, None] * frame.t, frame.d, contact.s_dot

    def residual(x: Tensor) -> Tensor:
        *u_dots, V = x.split(sizes)
        pads, force, torque, on_bracket = [], torch.zeros_like(V[:2]), torch.zeros_like(V[0]), torch.zeros_like(V[:2])
        for k, part in zip("LU", u_dots):
            f, d, _ = interface(k, part.unflatten(-1, (-1, 2)), V)
            pads.append(ah * (part + (u_star[k][near[k]].flatten() - columns[k][dofs[k]] @ f.flatten()) / stiff))
            force = force - f.sum(0)  # (16), (19)
            torque = torque - (cross(d) * f).sum()  # (18)
            on_bracket = f.sum(0)
        r_C, r_Br = star.r_C + ah * V[:2], star.r_Br + ah * V[3:]
        F_x, F_y = model.controllers(want, r_C, V[:2], r_Br, V[3:])
        weight = torch.stack((torch.zeros_like(F_x), -model.m_C * model.gravity))
        load = torch.cat((force + weight, torque[None], on_bracket + torch.stack((F_x, F_y))))
        return torch.cat((*pads, ah * (V - V_star - ah * load / inertia)))

    with torch.no_grad():
        x = torch.cat((*(torch.zeros(n, dtype=torch.float64) for n in sizes[:2]), V_star))
        r = residual(x)
        for _ in range(max_iterations):
            J = torch.func.jacfwd(residual)(x)
            if float(r.abs().max()) <= tolerance:
                break
            step, part = torch.linalg.solve(J, r[:, None])[:, 0], 1.0
            while True:
                trial = residual(x - part * step)
                if float(trial.norm()) < float(r.norm()) or part < 1 / 64:
                    break
                part *= 0.5
            x, r = x - part * step, trial
        else:
            raise RuntimeError(f"the unrolled step did not converge at t = {time:.4f} s; try a smaller step")
    x = x - torch.linalg.solve(J, residual(x)[:, None])[:, 0]  # the implicit function theorem's derivative

    *u_dots, V = x.split(sizes)
    u, s = {}, {}
    zero = torch.zeros((), dtype=torch.float64)
    for k, part in zip("LU", u_dots):
        f, _, s_dot = interface(k, part.unflatten(-1, (-1, 2)), V)
        u_dot = ((columns[k] @ f.flatten()).unflatten(-1, (-1, 2)) - u_star[k]) / stiff
        far = model.contact(zero - 1.0, zero, zero, s_star[k], model.share(model.pads[k]), stage=ah).s_dot
        u[k], s[k] = u_star[k] + ah * u_dot, s_star[k] + ah * far.index_copy(0, near[k], s_dot)
    return model.layout.pack(
        State(
            u_L=u["L"],
            u_U=u["U"],
            s_L=s["L"],
            s_U=s["U"],
            r_C=star.r_C + ah * V[:2],
            theta=star.theta + ah * V[2],
            r_Br=star.r_Br + ah * V[3:],
            v_L=star.v_L,
            v_U=star.v_U,
            v_C=V[:2],
            omega=V[2],
            v_Br=V[3:],
        )
    )
