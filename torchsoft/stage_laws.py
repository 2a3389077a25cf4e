"""The laws at the taped stages, by the module's own functions: what adjoint and sensitivities differentiate in parameters.

Everything that moves is held at its taped value, so these are functions of the parameters only.
"""

import numpy as np
import torch
from torch import Tensor

from torchsoft.contact import cross, moving_frame
from torchsoft.grid import Chunk
from torchsoft.kernels.run import GAMMA, Tape
from torchsoft.model import SoftGrasp


def touching(tape: Tape, pad_number: int) -> tuple[np.ndarray, np.ndarray]:
    """The (stage, slot) of every touching node of one pad on the tape, in the order of `law_rows`."""
    stage, slot = np.nonzero(np.arange(tape.node.shape[2]) < tape.count[:, pad_number, None])
    return stage, slot


def law_rows(model: SoftGrasp, tape: Tape, pad_number: int, h: float) -> Tensor:
    """(f_x, f_y, s') of every touching node of one pad (rows, 3) [N, N, m/s]."""
    p, pad, ah = pad_number, model.pads["LU"[pad_number]], GAMMA * h
    stage, slot = touching(tape, p)
    place, node = torch.from_numpy(tape.place[stage, p, slot]), torch.from_numpy(tape.node[stage, p, slot])
    d, w, s = place[:, :2], place[:, 2:4], place[:, 4]
    theta = torch.from_numpy((tape.q_star[:, 2] + ah * tape.V[:, 2])[stage])
    frame = moving_frame(model.shape, d[:, None], torch.zeros_like(d), theta)
    n, t = frame.n[:, 0], frame.t[:, 0]
    v = w + torch.from_numpy(tape.V[stage, 2])[:, None] * cross(d)
    out = model.contact(frame.g[:, 0], (n * v).sum(-1), (t * v).sum(-1), s, model.share(pad)[node], stage=ah)
    force = out.F_N[:, None] * n + out.F_T[:, None] * t
    return torch.cat((force, out.s_dot[:, None]), -1)


def rigid_loads(model: SoftGrasp, chunk: Chunk, tape: Tape) -> Tensor:
    """Weight and control forces less M V' at every stage, without the contacts (stages, 5) [N, N.m]."""
    ah = GAMMA * chunk.h
    times = chunk.starts[:, None] + chunk.h * np.array([GAMMA, 1.0])
    want = model.reference(torch.from_numpy(times.ravel()))
    V = torch.from_numpy(tape.V)
    q, V_dot = torch.from_numpy(tape.q_star) + ah * V, (V - torch.from_numpy(tape.V_star)) / ah
    F_x, F_y = model.controllers(want, q[:, :2], V[:, :2], q[:, 3:], V[:, 3:])
    zero = torch.zeros_like(F_x)
    forces = torch.stack((zero, zero - model.m_C * model.gravity, zero, F_x, F_y), -1)
    return forces - V_dot * torch.stack((model.m_C, model.m_C, model.inertia, model.m_Br, model.m_Br))


def decay_rate(model: SoftGrasp, h: float) -> Tensor:
    """r of s' = -r s away from contact at a stage [1/s], from the law itself."""
    zero, one = (torch.full((1,), x, dtype=torch.float64) for x in (0.0, 1.0))
    return -model.contact(zero - 1.0, zero, zero, one, one, stage=GAMMA * h).s_dot[0]
