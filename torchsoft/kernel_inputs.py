"""A model as the compiled kernel takes it: scalars, pad mobilities, and pad states as plain arrays."""

import math

import numpy as np
import torch
from scipy import linalg

from torchsoft.contact import Coulomb, SmoothSlip
from torchsoft.kernels.node import Constants
from torchsoft.kernels.pad import PadArrays, PadState
from torchsoft.model import SoftGrasp
from torchsoft.pad import banded
from torchsoft.state import State


def constants(m: SoftGrasp) -> Constants:
    """The model's scalars as the kernel takes them. Raises `TypeError` for a friction law that it does not have."""
    c, friction, control = m.contact, m.contact.friction, m.controllers
    if not isinstance(friction, SmoothSlip | Coulomb):
        raise TypeError(
            f"the compiled stepper knows the friction laws SmoothSlip and Coulomb, but `contact.friction` is "
            f"{type(friction).__name__}; for a law written in torch use `torchsoft.unrolled.unrolled_solution`"
        )
    return Constants(
        *(x.item() for x in (c.K_n, c.R_n, c.K_t, c.R_t, c.eta, friction.mu_s, friction.mu_k)),
        v_s=math.inf if isinstance(friction, Coulomb) else friction.v_s.item(),
        epsilon=c.epsilon,
        coulomb=isinstance(friction, Coulomb),
        tau=m.material.tau.item(),
        radius=m.shape.radius.item(),
        m_C=m.m_C.item(),
        I_C=m.inertia.item(),
        m_Br=m.m_Br.item(),
        gravity=m.gravity.item(),
        K_81=control.K_81.item(),
        R_80=control.R_80.item(),
        K_98=control.K_98.item(),
        R_99=control.R_99.item(),
        sensed=0 if control.senses == "disc" else 3,
        pad_length=m.settings.pad.length,
    )


@torch.no_grad()
def pad_arrays(model: SoftGrasp, which: str, ah: float) -> PadArrays:
    """The mobility of one pad at the stage length a h [s]."""
    pad, material = model.pads[which], model.material
    size = 2 * pad.nodes
    stiff = material.tau.item() + ah
    if pad.massless:
        P = np.ascontiguousarray((pad.compliance(material) / stiff).numpy().T)
        D, B, M, factor = np.zeros((size, 2)), np.zeros((2, 2)), np.zeros(0), np.zeros((0, 0))
    else:
        M = np.repeat(pad.masses(material).numpy(), 2)
        K_lambda, K_mu, _ = pad.mesh.matrices
        lame_lambda, lame_mu = (x.item() for x in material.lame())
        mirror = np.tile(pad.mirror.numpy(), pad.nodes)
        K = pad.mesh.assemble(material.depth.item() * (lame_lambda * K_lambda + lame_mu * K_mu))
        A = banded(K.multiply(mirror[:, None] * mirror[None, :]).tocsr() * stiff)
        A[0] += M / ah
        factor = linalg.cholesky_banded(A, lower=True)
        dofs = (2 * pad.surface.numpy()[:, None] + np.arange(2)).ravel()
        loads = np.zeros((size, len(dofs)))
        loads[dofs, np.arange(len(dofs))] = 1.0
        P = np.ascontiguousarray(linalg.cho_solve_banded((factor, True), loads).T)
        uniform = M[:, None] * np.tile(np.eye(2), (pad.nodes, 1)) / ah
        D = linalg.cho_solve_banded((factor, True), uniform)
        B = np.diag(uniform.sum(0)) - uniform.T @ D
        factor = np.ascontiguousarray(factor)
    share = model.share(pad).numpy()
    return PadArrays(pad.positions.numpy(), pad.surface.numpy(), share, P, D, B, M, factor, which == "U")


@torch.no_grad()
def pad_state(model: SoftGrasp, which: str, state: State) -> PadState:
    """One pad's part of a single state, copied."""
    pad, u, v, s = model.pads[which], *(getattr(state, f"{part}_{which}") for part in "uvs")
    force = pad.elastic_force(model.material, u)
    return PadState(*(x.flatten().clone().numpy() for x in (u, v, force, s)))
