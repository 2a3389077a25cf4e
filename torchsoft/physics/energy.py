"""Power and energy of the graph: what is stored, dissipated and supplied, element by element.

Everything is read off the ports that `SoftGrasp.evaluate` made, so the ledger has no physics of its own.
"""

import torch
from torch import Tensor

from torchsoft.model import Evaluation, SoftGrasp
from torchsoft.state import State


def stored(model: SoftGrasp, state: State) -> dict[str, Tensor]:
    """Energies [J], each shaped like the batch: C fields (strain, springs) and I fields (kinetic)."""
    energies = {}
    for k, pad in model.pads.items():
        u = state.u_L if k == "L" else state.u_U
        energies[f"strain_{k}"] = 0.5 * (u * pad.elastic_force(model.material, u)).sum((-2, -1))
    normal, tangential = torch.zeros_like(state.theta), torch.zeros_like(state.theta)
    for k, pad in model.pads.items():
        share, s = model.share(pad), state.s_L if k == "L" else state.s_U
        depth = model.frame(k, state).g.clamp(min=0.0)
        normal = normal + 0.5 * (share * model.contact.K_n * depth**2).sum(-1)
        tangential = tangential + 0.5 * (share * model.contact.K_t * s**2).sum(-1)
    energies["normal_springs"], energies["tangential_springs"] = normal, tangential
    energies["disc"] = 0.5 * model.m_C * (state.v_C**2).sum(-1)
    energies["spin"] = 0.5 * model.inertia * state.omega**2
    energies["bracket"] = 0.5 * model.m_Br * (state.v_Br**2).sum(-1)
    if not model.massless:
        for k, v in (("L", state.v_L), ("U", state.v_U)):
            energies[f"kinetic_{k}"] = 0.5 * (model.nodal_masses(k) * v**2).sum((-2, -1))
    return energies


def dissipated(model: SoftGrasp, state: State, graph: Evaluation) -> dict[str, Tensor]:
    """Powers [W] that the R elements take out, each shaped like the batch and never negative."""
    powers, dashpots, slip = {}, torch.zeros_like(state.theta), torch.zeros_like(state.theta)
    for k, pad in model.pads.items():
        port, u = graph.ports[f"pad_{k}"], state.u_L if k == "L" else state.u_U
        u_dot = port.transformer.flow(graph.flows)
        powers[f"pad_{k}"] = ((port.effort - pad.elastic_force(model.material, u)) * u_dot).sum((-2, -1))
        frame, contact, transformer = graph.interfaces[k]
        share, g_dot = model.share(pad), transformer.flow(graph.flows)[..., 0]
        spring = share * model.contact.K_n * frame.g.clamp(min=0.0)
        dashpots = dashpots + ((contact.F_N - spring) * g_dot).sum(-1)
        dashpots = dashpots + (share * model.contact.R_t * contact.s_dot**2).sum(-1)
        slip = slip + (contact.e * contact.gamma_dot).sum(-1)
    return powers | {"contact_dashpots": dashpots, "slip": slip}


def supplied(graph: Evaluation) -> dict[str, Tensor]:
    """Powers [W] that the sources put in, each shaped like the batch."""
    names = {"control_x": "control_x", "control_y": "control_y", "gravity": "weight"}
    return {name: graph.ports[port].power(graph.flows) for name, port in names.items()}
