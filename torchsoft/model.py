"""The whole system as one torch module: `SoftGrasp.forward(t, y)` is the right-hand side of the ODE.

The equations of motion are not written down anywhere: `forward` evaluates the ports of the multibond graph at the state
and integrates what is left over at its 1-junctions.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchsoft.contact import Contact, ContactState, Frame, contact_transformer, cross, moving_frame
from torchsoft.control import Controllers, Reference, hold
from torchsoft.multibond import Block, Junction, Port, Transformer, identity, net_efforts
from torchsoft.pad import Material, Pad, build_pads
from torchsoft.parameters import Parameters
from torchsoft.shapes import Circle
from torchsoft.state import Layout, State

RATE_TOLERANCE = 1e-15
"""Residual of tau u' + u = C f [m] to which the massless pads' rates are solved in `forward`."""

RATE_ITERATIONS = 30

PARAMETERS = {
    **{f"pad.{name}": f"material.{name}" for name in ("E", "nu", "rho", "tau", "depth")},
    **{f"contact.{name}": f"contact.{name}" for name in ("K_n", "R_n", "K_t", "R_t", "eta")},
    **{f"contact.{name}": f"contact.friction.{name}" for name in ("mu_s", "mu_k", "v_s")},
    **{f"control.{name}": f"controllers.{name}" for name in ("K_81", "R_80", "K_98", "R_99")},
    "disc.radius": "shape.radius",
    "disc.mass": "m_C",
    "bracket.mass": "m_Br",
    "scenario.gravity": "gravity",
}
"""What a number of `Parameters` is called among the module's parameters, for those that gradients reach."""

PAPER_BONDS = {"L": ("28", "29", "23", "24"), "U": ("64", "65", "59", "60")}


class Interface(NamedTuple):
    """One contact interface at one state: frame and contact state per surface node, and its transformer."""

    frame: Frame
    contact: ContactState
    transformer: Transformer


class Evaluation(NamedTuple):
    """The graph at one state: ports and junction flows by name, and the interfaces "L" and "U"."""

    ports: dict[str, Port]
    flows: dict[str, Tensor]
    interfaces: dict[str, Interface]


class SoftGrasp(nn.Module):
    """A rigid disc between two soft pads, the upper one in a bracket under two PD controllers.

    `forward(t, y)` follows torchdiffeq: y has shape (..., `layout.size`), float64, any batch dimensions. Every physical
    parameter is an `nn.Parameter` that gradients reach. `reference` is what the controllers follow; by default
    the bracket and the disc stay where they start. Not smooth where a node touches, where the normal force is cut at
    zero and where a node begins to slip; continuous there with the smooth law.
    """

    def __init__(self, settings: Parameters | None = None, reference: Reference | None = None) -> None:
        super().__init__()
        p = self.settings = settings or Parameters()
        self.material = Material(p.pad)
        self.pad_L, self.pad_U = build_pads(p.pad, p.bracket.cm_height)
        self.shape = Circle(p.disc.radius)
        self.contact = Contact(p.contact)
        self.controllers = Controllers(p.control)
        self.m_C, self.m_Br, self.gravity = (
            nn.Parameter(torch.tensor(value, dtype=torch.float64))
            for value in (p.disc.mass, p.bracket.mass, p.scenario.gravity)
        )
        self.reference = reference or hold(p.scenario.x_C0, 2 * (p.pad.height + p.disc.radius) + p.bracket.cm_height)
        pads = self.pads.values()
        surfaces = [len(pad.surface) for pad in pads]
        self.massless = self.pad_L.massless
        self.layout = Layout((self.pad_L.nodes, self.pad_U.nodes), (surfaces[0], surfaces[1]), self.massless)
        body = "R: tau K" if self.massless else "I: [I_{}]"
        self.junctions = {
            "pad_L": Junction(self.pad_L.nodes, 2, body.format("L"), "1: lower pad nodes"),
            "pad_U": Junction(self.pad_U.nodes, 2, body.format("U"), "1: upper pad nodes"),
            "ground": Junction(1, 2, "Sf: 0", "1: ground"),
            "disc": Junction(1, 2, "I: m", "1: disc"),
            "spin": Junction(1, 1, "I: I_C", "1: disc spin"),
            "bracket": Junction(1, 2, "I: m_Br", "1: bracket"),
            "bracket_spin": Junction(1, 1, "Sf: 0 ", "1: bracket spin"),
        }

    @property
    def pads(self) -> dict[str, Pad]:
        return {"L": self.pad_L, "U": self.pad_U}

    @property
    def inertia(self) -> Tensor:
        """Moment of inertia of the disc about its centre [kg.m2]."""
        return 0.5 * self.m_C * self.shape.radius**2

    def forward(self, t: Tensor | float, y: Tensor) -> Tensor:
        """dy/dt, shaped like y. Raises `ValueError` for a state of another length or dtype."""
        state = self.layout.unpack(y)
        graph = self.evaluate(t, state)
        effort = net_efforts(graph.ports, self.junctions)
        flows, contact = graph.flows, {k: interface.contact for k, interface in graph.interfaces.items()}
        v_dot = {k: state.v_L if self.massless else effort[f"pad_{k}"] / self.nodal_masses(k) for k in "LU"}
        return self.layout.pack(
            State(
                u_L=graph.ports["pad_L"].transformer.flow(flows),
                u_U=graph.ports["pad_U"].transformer.flow(flows),
                s_L=contact["L"].s_dot,
                s_U=contact["U"].s_dot,
                r_C=state.v_C,
                theta=state.omega,
                r_Br=state.v_Br,
                v_L=v_dot["L"],
                v_U=v_dot["U"],
                v_C=effort["disc"][..., 0, :] / self.m_C,  # (17)
                omega=effort["spin"][..., 0, 0] / self.inertia,  # (18)
                v_Br=effort["bracket"][..., 0, :] / self.m_Br,
            )
        )

    def nodal_masses(self, which: str) -> Tensor:
        return self.pads[which].masses(self.material)[:, None]

    def evaluate(self, t: Tensor | float, state: State) -> Evaluation:
        """The multibond graph at time t [s] and one state: every port with its transformer and effort."""
        junction_flows = {
            "ground": torch.zeros_like(state.v_C)[..., None, :],
            "disc": state.v_C[..., None, :],
            "spin": state.omega[..., None, None],
            "bracket": state.v_Br[..., None, :],
            "bracket_spin": torch.zeros_like(state.omega)[..., None, None],
        }
        ports, interfaces = {}, {}
        for k, pad in self.pads.items():
            frame = self.frame(k, state)
            transformer = contact_transformer(frame, f"pad_{k}", pad.surface, moving_base=False)
            if self.massless:
                base = junction_flows["bracket"] if k == "U" else 0.0
                junction_flows[f"pad_{k}"] = base + self._condensed_rates(k, state, frame)
            else:
                junction_flows[f"pad_{k}"] = state.v_L if k == "L" else state.v_U
            contact = self._contact(k, state, frame, transformer.flow(junction_flows))
            interfaces[k] = Interface(frame, contact, transformer)
            K_n, R_n, K_t, R_t = PAPER_BONDS[k]
            ports[f"contact_{k}"] = Port(
                transformer,
                torch.stack((contact.F_N, contact.F_T), -1),
                (f"C: K_{K_n}^-1", f"R: R_{R_n}", f"C: K_{K_t}^-1", f"R: R_{R_t}", f"R: slip_{k}"),
            )
            ports[f"pad_{k}"] = self._pad_port(k, state, ports[f"contact_{k}"], junction_flows)
        weight = torch.stack((torch.zeros_like(state.theta), -self.m_C * self.gravity.expand_as(state.theta)), -1)
        ports["weight"] = Port(
            Transformer({"disc": Block(identity(2, weight))}), weight[..., None, :], ("Se: mg",), True
        )
        ports |= self._control_ports(t, state)
        return Evaluation(ports, junction_flows, interfaces)

    def share(self, pad: Pad) -> Tensor:
        return pad.tributary / self.contact.node_spacing

    def frame(self, which: str, state: State, nodes: Tensor | None = None) -> Frame:
        """Moving frame of the surface nodes of one pad, or of some of them."""
        pad, u = self.pads[which], state.u_L if which == "L" else state.u_U
        surface = pad.surface if nodes is None else pad.surface[nodes]
        p = pad.positions[surface] + u[..., surface, :]
        if which == "U":
            p = p + state.r_Br[..., None, :]
        return moving_frame(self.shape, p, state.r_C, state.theta)

    def _contact(
        self, which: str, state: State, frame: Frame, flow: Tensor, nodes: Tensor | None = None
    ) -> ContactState:
        s, share = state.s_L if which == "L" else state.s_U, self.share(self.pads[which])
        if nodes is not None:
            s, share = s[..., nodes], share[nodes]
        return self.contact(frame.g, flow[..., 0], flow[..., 1], s, share)

    def _pad_port(self, which: str, state: State, contact: Port, flows: dict[str, Tensor]) -> Port:
        """The pad's Kelvin-Voigt field on its strain rate: node velocities less those of what it is bonded to (Fig. 7)."""
        pad, name = self.pads[which], f"pad_{which}"
        blocks = {name: Block(identity(2, pad.positions))}
        if which == "L":
            blocks["ground"] = Block(identity(2, pad.positions, -1.0))
        else:
            spin = cross(pad.positions)[..., None]
            blocks["bracket"] = Block(identity(2, pad.positions, -1.0))
            blocks["bracket_spin"] = Block(-spin)  # (35)
        transformer = Transformer(blocks)
        if self.massless:  # no I field: the field's effort is whatever the other ports leave at the junction
            effort = net_efforts({"contact": contact}, self.junctions)[name]
        else:
            u, u_dot = state.u_L if which == "L" else state.u_U, transformer.flow(flows)
            effort = pad.elastic_force(self.material, u + self.material.tau * u_dot)
        return Port(transformer, effort, (f"C: [K_{which}]^-1", f"R: [R_{which}]"))

    def _control_ports(self, t: Tensor | float, state: State) -> dict[str, Port]:
        when = torch.as_tensor(t, dtype=torch.float64).expand(state.theta.shape)
        F_x, F_y = self.controllers(self.reference(when), state.r_C, state.v_C, state.r_Br, state.v_Br)
        axis = {i: Transformer({"bracket": Block(identity(2, F_x)[:, i : i + 1])}) for i in (0, 1)}
        sensed = ("disc",) if self.controllers.senses == "disc" else ()
        return {
            "control_x": Port(axis[0], F_x[..., None, None], ("C: K_81^-1", "R: R_80"), True, senses=sensed),
            "control_y": Port(axis[1], F_y[..., None, None], ("C: K_98^-1", "R: R_99", "Se: F_y"), True),
        }

    def _condensed_rates(self, which: str, state: State, frame: Frame) -> Tensor:
        """Surface rates u' (..., surface, 2) [m/s] of a massless pad: tau u' + u = C f(u'), by semi-smooth Newton.

        Only touching nodes carry force, so only they are unknowns. The last iteration is taken with the gradient on,
        which makes the result's derivative the implicit function theorem's.
        """
        u = state.u_L if which == "L" else state.u_U
        pad, tau = self.pads[which], self.material.tau
        C = pad.compliance(self.material)
        touching = torch.nonzero((frame.g > 0).reshape(-1, len(pad.surface)).any(0))[:, 0]
        if len(touching) == 0:
            return -u / tau
        dofs = (2 * touching[:, None] + torch.arange(2)).flatten()
        d, n, t = (x[..., touching, :] for x in (frame.d, frame.n, frame.t))
        part = Frame(d, n, t, frame.g[..., touching])
        C_columns, u_a = C[:, dofs], u[..., touching, :]
        C_aa = C_columns[dofs]
        R = torch.stack((part.n, part.t), -2)
        base = state.v_C - state.v_Br if which == "U" else state.v_C
        gliding = (R @ (base[..., None, :] + state.omega[..., None, None] * cross(part.d))[..., None])[..., 0]

        def force(u_dot: Tensor) -> Tensor:
            flow = gliding - (R @ u_dot[..., None])[..., 0]
            contact = self._contact(which, state, part, flow, touching)
            return (R.mT @ torch.stack((contact.F_N, contact.F_T), -1)[..., None])[..., 0]

        def residual(u_dot: Tensor, f: Tensor) -> Tensor:
            return (tau * u_dot + u_a).flatten(-2) - f.flatten(-2) @ C_aa.mT

        def linearise(u_dot: Tensor) -> tuple[Tensor, Tensor]:
            """Residual and its Jacobian, whose only non-linear part is the 2 x 2 block G of each node."""
            axes = torch.stack([torch.zeros_like(u_dot) + axis for axis in torch.eye(2, dtype=u.dtype)])
            f, df = torch.func.jvp(  # pyright: ignore[reportAssignmentType]
                force, (torch.stack((u_dot, u_dot)),), (axes,)
            )
            CG = torch.einsum("ikc,d...kc->...ikd", C_aa.unflatten(-1, (-1, 2)), df).flatten(-2)
            return residual(u_dot, f[0]), tau * torch.eye(len(dofs), dtype=u.dtype) - CG

        def newton_step(r: Tensor, J: Tensor) -> Tensor:
            return torch.linalg.solve(J, r[..., None])[..., 0].unflatten(-1, (-1, 2))

        with torch.no_grad():
            u_dot = torch.zeros_like(u_a)
            r, J = linearise(u_dot)
            size = r.abs().amax(-1)
            for _ in range(RATE_ITERATIONS):
                going = size > RATE_TOLERANCE
                if not bool(going.any()):
                    break
                step = newton_step(r, J) * going[..., None, None]
                for _ in range(8):  # halve, sample by sample, until the residual falls
                    r, J = linearise(u_dot - step)
                    worse = going & (r.abs().amax(-1) >= size)
                    if not bool(worse.any()):
                        break
                    step = step * torch.where(worse, 0.5, 1.0)[..., None, None]
                u_dot = u_dot - step
                size = r.abs().amax(-1)
            if bool((size > 1e3 * RATE_TOLERANCE).any()):
                raise RuntimeError(
                    f"the massless {'lower' if which == 'L' else 'upper'} pad's rates did not converge: residual "
                    f"{float(size.max()):.2g} m after {RATE_ITERATIONS} iterations; is contact.v_s large enough for the "
                    "pads' damping to balance the fall of friction with slip?"
                )
        u_dot = u_dot - newton_step(residual(u_dot, force(u_dot)), J)
        return ((force(u_dot).flatten(-2) @ C_columns.mT).unflatten(-1, (-1, 2)) - u) / tau
