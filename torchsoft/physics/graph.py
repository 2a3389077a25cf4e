"""The multibond graph of a rig as a torch module: lists of bodies, pads, contacts and actuators;
`forward(t, y)` is the right-hand side of the ODE.

The equations of motion are not written down anywhere: `forward` evaluates the ports of the
multibond graph at the state and integrates the net efforts at its 1-junctions.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchsoft.display import suggestion
from torchsoft.physics.balance import Forces, Nodes, contact_forces, corrected, newton
from torchsoft.physics.contact import (
    Frame,
    PointLaw,
    cross,
    interface_law,
    moving_frame,
    point_place,
    relative_motion,
    turned,
)
from torchsoft.physics.mesh.element import QUADRILATERAL
from torchsoft.physics.motion import Reference
from torchsoft.physics.multibond import GROUND, Block, Junction, Port, Transformer, net_efforts
from torchsoft.physics.names import check_names
from torchsoft.physics.pads import Pad, Taxels, check_taxels, free_rates, under_forces
from torchsoft.physics.parts import COORDINATES, Actuator, Body, Contact, weight
from torchsoft.physics.shapes import Shape, parameter
from torchsoft.physics.state import (
    Layout,
    State,
    ages,
    begin_states,
    body_blocks,
    law_blocks,
    law_states,
)
from torchsoft.physics.validity import Backwards
from torchsoft.quantity import Gravity

RATE_TOLERANCE, RATE_ITERATIONS = 1e-13, 30
"""Residual [m/s] to which the rates of massless pads are solved, and steps of Newton's method for
it at the most."""


class NoRates(RuntimeError):
    """Newton's iteration found no rates of a massless pad."""


class Interface(NamedTuple):
    """One contact at one state: moving frame (world axes), the law at its points, the port's
    transformer, and g', v_T (..., points, 2)."""

    frame: Frame
    law: PointLaw
    transformer: Transformer
    flow: Tensor

    @property
    def F_N(self) -> Tensor:
        """Normal forces [N] (..., points)."""
        return self.law.force[..., 0]


class Evaluation(NamedTuple):
    """The graph at one state: ports and junction flows by name, the interfaces by contact, and the
    rates (..., nodes, 2 branches) [m/s] of a pad's relaxing branches."""

    ports: dict[str, Port]
    flows: dict[str, Tensor]
    interfaces: dict[str, Interface]
    branches: dict[str, Tensor]

    def pad_rates(self, name: str) -> Tensor:
        """Rates (..., nodes, 2 fields) [m/s] of a nodal pad's displacements in its base's frame."""
        u_dot = self.ports[f"pad_{name}"].transformer.flow(self.flows)
        return torch.cat((u_dot, self.branches[name]), -1) if name in self.branches else u_dot


class Graph(nn.Module):
    """Lists of bodies, pads, contacts and actuators, and the equations of motion that their
    multibond graph makes. `Rig` tells of the arguments and of `forward`."""

    def __init__(
        self, *, bodies: Mapping[str, Body], pads: Mapping[str, Pad],
        contacts: Mapping[str, Contact], actuators: Mapping[str, Actuator] | None = None,
        reference: Reference | None = None, gravity: Gravity = 9.81,
        symbols: Mapping[str, str] | None = None, groups: Mapping[str, nn.Module] | None = None,
        taxels: Mapping[str, Taxels] | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.groups = tuple(groups or {})
        for name, module in (groups or {}).items():
            self.add_module(name, module)
        order = sorted(
            contacts,
            key=lambda k: list(pads).index(contacts[k].pad) if contacts[k].pad in pads else -1,
        )
        lists: Any = bodies, pads, {name: contacts[name] for name in order}, actuators or {}
        for name, parts in zip(("bodies", "pads", "contacts", "actuators"), lists):
            check_names(name, parts)
            self.add_module(name, nn.ModuleDict(parts))
        self.gravity = parameter(gravity, "gravity")
        self.reference = reference or Reference()
        self.taxels = dict(taxels or {})
        self.symbols = {name: (symbols or {}).get(name, name) for name in bodies}
        self.watch = Backwards()
        self.check_names()

    bodies: Mapping[str, Body]
    pads: Mapping[str, Pad]
    contacts: Mapping[str, Contact]
    actuators: Mapping[str, Actuator]

    def check_names(self) -> None:
        """Raises the errors of the class for parts that do not fit together."""
        for name, pad in self.pads.items():
            if pad.base is not None and pad.base not in self.bodies:
                raise ValueError(
                    f"pad `{name}` is bonded to `{pad.base}`, "
                    f"{suggestion(pad.base, self.bodies, 'but the bodies are')}"
                )
            pad.check_chain(name)
            if not pad.inertial:
                continue
            if pad.base is not None and self.bodies[pad.base].freedom["theta"] != "fixed":
                raise NotImplementedError(
                    f"pad `{name}` is inertial and its base `{pad.base}` may turn: nodal "
                    "accelerations in a turning frame are not modelled; fix the base's theta or "
                    "take a massless pad"
                )
        self._check_pairs()
        check_names("taxels", self.taxels)
        check_names("symbols", self.symbols.values())
        check_taxels(self.taxels, self.pads, self.contacts)
        for name, actuator in self.actuators.items():
            for coordinate in (*actuator.measures, actuator.pushes):
                self.coordinate(coordinate, f"actuator `{name}`")
        check_names("motion", self.signals, dotted=True)

    def _check_pairs(self) -> None:
        """Raises `ValueError` for contacts of parts that are missing or cannot touch, or twins."""
        between = {(contact.pad, contact.body): name for name, contact in self.contacts.items()}
        for name, contact in self.contacts.items():
            if (twin := between[contact.pad, contact.body]) != name:
                raise ValueError(
                    f"contacts.{twin}: it is between the same pad and body as `{name}`; leave one "
                    "out"
                )
            if contact.pad not in self.pads or contact.body not in self.bodies:
                raise ValueError(
                    f"contact `{name}` is between `{contact.pad}` and `{contact.body}`, which are "
                    "not both there"
                )
            if self.bodies[contact.body].shape is None:
                raise ValueError(
                    f"contact `{name}` needs a shape, but the body `{contact.body}` has none"
                )
            if self.pads[contact.pad].base == contact.body:
                raise ValueError(
                    f"contact `{name}`: the pad `{contact.pad}` is bonded to the body "
                    f"`{contact.body}` itself"
                )

    def coordinate(self, name: str, owner: str = "`name`") -> int:
        """Number of a coordinate such as "disc.x" among those of all bodies. Raises
        `ValueError`."""
        body, _, axis = name.partition(".")
        if body not in self.bodies or axis not in COORDINATES:
            known = [f"{b}.{axis}" for b in self.bodies for axis in COORDINATES]
            raise ValueError(
                f"{owner} speaks of `{name}`, which is not a coordinate; "
                f"{suggestion(name, known, 'there are')}"
            )
        return 3 * list(self.bodies).index(body) + COORDINATES.index(axis)

    def named_modules(
        self, memo: Any = None, prefix: str = "", remove_duplicate: bool = True
    ) -> Any:
        """Each module once, with any arguments: `torch.func.functional_call` would put back the
        wrong tensors of a part that several of the lists share."""
        return super().named_modules(memo, prefix, True)

    @property
    def loops(self) -> dict[str, Actuator]:
        """The actuators that are loops of one coordinate; the others are laws of several."""
        return {name: one for name, one in self.actuators.items() if one.is_loop}

    aliases: Mapping[str, str] = {}
    """Parameters by their names in the rig file."""

    extended: Mapping[str, str] = {}
    """Parameters that were added to the rig, by name."""

    @property
    def names(self) -> dict[str, str]:
        """Names of parameters by their other names."""
        return {**self.aliases, **self.extended}

    def weight(self, name: str) -> Tensor:
        """Factors of a contact's law at its points: their lengths of surface over its spacing."""
        contact = self.contacts[name]
        return torch.from_numpy(self.pads[contact.pad].point_lengths / contact.law.node_spacing)

    @property
    def layout(self) -> Layout:
        """Layout of the state vector."""
        counts, free = self.point_counts, {name: body.free for name, body in self.bodies.items()}
        blocks = [block for name, pad in self.pads.items() for block in pad.blocks(name)]
        for name, contact in self.contacts.items():
            blocks += contact.blocks(name, counts[name])
        for name, axes in free.items():
            blocks += body_blocks(name, axes)
        for name, actuator in self.actuators.items():
            blocks += law_blocks("control", name, [*actuator.states.values()])
        return Layout(free, blocks)

    @property
    def signals(self) -> tuple[str, ...]:
        """The reference's signals that the rig follows: setpoints, feed-forward efforts, driven
        coordinates."""
        names: list[str | None] = []
        for actuator in self.actuators.values():
            names += [*actuator.setpoints, actuator.feed_forward]
        for body_name, body in self.bodies.items():
            names += [
                f"{body_name}.{axis}" for axis in COORDINATES if body.freedom[axis] == "driven"
            ]
        return tuple(dict.fromkeys(name for name in names if name is not None))

    @property
    def fixed_values(self) -> list[Tensor]:
        """Values of the fixed coordinates, in the order of all coordinates."""
        every = [(body.fixed, axis) for body in self.bodies.values() for axis in COORDINATES]
        return [fixed[axis] for fixed, axis in every if axis in fixed]

    def follow(self, t: Tensor | float, reference: Reference | None = None) -> Tensor:
        """The signals at t (...) [s]: values and rates (..., signals, 2)."""
        followed = self.reference if reference is None else reference
        return followed(torch.as_tensor(t, dtype=torch.float64), self.signals)

    def held(self, signals: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Fixed and driven coordinates and their rates by body (..., 3), zero where a coordinate is
        free."""
        pose, velocity = {}, {}
        for name, body in self.bodies.items():
            rows = []
            for axis in COORDINATES:
                zero = signals.new_zeros(signals.shape[:-2])
                if body.freedom[axis] == "driven":
                    at = signals[..., self.signals.index(f"{name}.{axis}"), :]
                    rows.append((at[..., 0], at[..., 1]))
                else:
                    rows.append((zero + body.fixed[axis] if axis in body.fixed else zero, zero))
            pose[name], velocity[name] = (torch.stack(part, -1) for part in zip(*rows))
        return pose, velocity

    def unpack(self, y: Tensor, signals: Tensor | None = None, t: Tensor | float = 0.0) -> State:
        """The state's parts by name; `signals` (..., signals, 2) place driven bodies, by default
        those of the reference at t."""
        return self.layout.unpack(y, *self.held(self.follow(t) if signals is None else signals))

    def pack(self, state: State, t: float = 0.0, reference: Reference | None = None) -> Tensor:
        """The flat vector (..., size) of a state; states of friction and of actuators that it lacks
        are those that they start with, at t [s] of a reference, by default the rig's; ages only at
        points that touch."""
        friction = {name: self.friction_of(name, state) for name in self.contacts}
        friction_states = {name: both[0] for name, both in friction.items() if both}
        for name, z in friction_states.items():
            if name not in state.friction and ages(self.contacts[name].law.friction):
                touches = (self.penetration(name, state) > 0)[..., None, :]
                friction_states[name] = torch.where(touches, z, 0.0)
        control = dict(state.control)
        if missing := [k for k, one in self.actuators.items() if one.states and k not in control]:
            signals = self.follow(t, reference).expand(
                *state.pose[next(iter(self.bodies))].shape[:-1], -1, -1
            )
            control |= {k: self.actuator_response(k, state, signals)[2] for k in missing}
        return self.layout.pack(state._replace(friction=friction_states, control=control))

    def base_motion(self, name: str, state: State) -> tuple[Tensor, Tensor]:
        """Pose and velocity (..., 3) of a pad's base."""
        base = self.pads[name].base
        if base is None:
            like = next(iter(state.pose.values()))
            return torch.zeros_like(like), torch.zeros_like(like)
        return state.pose[base], state.velocity[base]

    def displacement(self, name: str, state: State) -> Tensor:
        """Displacements of the nodes of a pad's state in its base's frame (..., nodes, 2) [m]."""
        pad, part = self.pads[name], state.pads[name]
        if pad.nodal:
            return part if pad.fields == 1 else part[..., :2]
        fractions, _ = pad.chain()
        return under_forces(pad.compliance(), (fractions[:, None, None] * part).sum(-3))

    def penetration(self, name: str, state: State, u: Tensor | None = None) -> Tensor:
        """Depth of the points of a contact in the body [m], (..., points); negative where they are
        apart. `u` are the pad's displacements, where they are known already."""
        pad = self.contacts[name].pad
        u = self.displacement(pad, state) if u is None else u
        p = self.pads[pad].point_positions + self.pads[pad].at_points(u)
        motion = self.relative(name, state)[..., None, :]
        x = torch.cat((p, motion[..., :3].expand(*p.shape[:-1], 3)), -1)
        return moving_frame(self.shape_of(name), *point_place(x)).g

    def relative(self, name: str, state: State) -> Tensor:
        """Pose and rates (..., 6) of a contact's body in the frame of the pad's base."""
        contact = self.contacts[name]
        (r_B, v_B), r_C = self.base_motion(contact.pad, state), state.pose[contact.body]
        none = torch.zeros_like(r_C)
        both = torch.cat((r_C, r_B, state.velocity[contact.body], v_B, none), -1)
        return relative_motion(both)[..., :6]

    def shape_of(self, name: str) -> Shape:
        """Shape of a contact's body."""
        shape = self.bodies[self.contacts[name].body].shape
        assert shape is not None
        return shape

    def contacts_of(self, pad: str) -> list[str]:
        """Names of the contacts of a pad."""
        return [name for name, contact in self.contacts.items() if contact.pad == pad]

    @property
    def weighted(self) -> dict[str, Body]:
        """Bodies that gravity pulls along a free coordinate."""
        free = {name: one for name, one in self.bodies.items() if one.freedom["y"] == "free"}
        return {name: one for name, one in free.items() if one.weighted}

    @property
    def point_counts(self) -> dict[str, int]:
        """Numbers of contact points, by contact."""
        return {name: len(self.pads[c.pad].point_nodes) for name, c in self.contacts.items()}

    def forward(self, t: Tensor | float, y: Tensor, reference: Reference | None = None) -> Tensor:
        """dy/dt, shaped like y. Raises `ValueError` for a state of another length or dtype."""
        self.layout.check(y)
        self.watch.see(t)
        signals = self.follow(
            torch.as_tensor(t, dtype=torch.float64).expand(y.shape[:-1]), reference
        )
        state = self.unpack(y, signals)
        graph = self.evaluate(t, state, signals)
        effort = net_efforts(graph.ports, self.junctions)
        pads, rates = {}, {}
        for name, pad in self.pads.items():
            if pad.inertial:
                angle = self.base_motion(name, state)[0][..., 2]
                rates[name] = (
                    turned(effort[f"pad_{name}"], -angle[..., None]) / pad.masses()[:, None]
                )
            if pad.nodal:
                pads[name] = graph.pad_rates(name)
            else:
                f, (_, times) = graph.ports[f"pad_{name}"].effort, pad.chain()
                pads[name] = (f[..., None, :, :] - state.pads[name]) / times[:, None, None]
        loads = self.loads(graph, effort)
        velocity = {
            name: loads[name] / torch.stack(body.masses) for name, body in self.bodies.items()
        }  # (17), (18)
        points = {name: one.law.rates.mT for name, one in graph.interfaces.items()}
        stretch = {name: rate[..., 0, :] for name, rate in points.items()}
        friction = {name: rate[..., 1:, :] for name, rate in points.items()}
        control = {name: self.actuator_response(name, state, signals)[1] for name in state.control}
        return self.pack(State(pads, stretch, state.velocity, rates, velocity, friction, control))

    def loads(self, graph: Evaluation, effort: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Net forces and moments on the bodies (..., 3) [N, N, N.m], of the net efforts at the
        graph's junctions."""
        out = {}
        for name in self.bodies:
            force, moment = (
                effort.get(k, torch.zeros_like(graph.flows[k])) for k in (name, f"{name}_spin")
            )
            out[name] = torch.cat((force[..., 0, :], moment[..., 0, :]), -1)
        return out

    @property
    def junctions(self) -> dict[str, Junction]:
        """The graph's 1-junctions: the nodes of every pad, the ground, every body and its spin."""
        out = {}
        for name, pad in self.pads.items():
            element = f"I: [I_{name}]" if pad.inertial else "R: tau K"
            out[f"pad_{name}"] = Junction(pad.nodes, element, f"1: nodes of pad {name}")
        out[GROUND] = Junction(1, "Sf: 0", "1: ground")
        for name, body in self.bodies.items():
            free = [body.freedom[axis] for axis in COORDINATES]
            source = {"driven": "Sf: drive", "fixed": "Sf: 0"}
            flow = f"I: m_{self.symbols[name]}" if "free" in free[:2] else source[free[0]]
            spin = f"I: I_{self.symbols[name]}" if free[2] == "free" else source[free[2]] + " "
            out[name] = Junction(1, flow, f"1: {name}")
            out[f"{name}_spin"] = Junction(1, spin, f"1: {name} spin")
        return out

    def evaluate(
        self, t: Tensor | float, state: State, signals: Tensor | None = None, settled: bool = False
    ) -> Evaluation:
        """The multibond graph at time t [s] and one state: every port with its transformer and
        effort, world axes. `settled` takes pads to have no rates, which are solved for otherwise
        where a pad is massless."""
        like = next(iter(state.pose.values()))
        signals = (
            self.follow(torch.as_tensor(t, dtype=torch.float64).expand(like.shape[:-1]))
            if signals is None
            else signals
        )
        flows = {GROUND: torch.zeros_like(like)[..., None, :2]}
        for name in self.bodies:
            flows[name] = state.velocity[name][..., None, :2]
            flows[f"{name}_spin"] = state.velocity[name][..., None, 2:]
        ports, interfaces, branches = {}, {}, {}
        for name, pad in self.pads.items():
            contacts = self.contacts_of(name)
            r_B, v_B = self.base_motion(name, state)
            u, angle = self.displacement(name, state), r_B[..., 2, None]
            moment_arm = turned(pad.positions + u, angle)
            base_rate = v_B[..., None, :2] + v_B[..., None, 2:] * cross(moment_arm)
            if pad.inertial and not settled:
                flows[f"pad_{name}"] = turned(state.rates[name], angle)
                u_dot = turned(flows[f"pad_{name}"] - base_rate, -angle)
            else:
                u_dot = torch.zeros_like(u) if settled else self._rates(name, contacts, state, u)
                if not settled and pad.fields > 1:
                    branches[name] = self._branch_rates(name, state)
                flows[f"pad_{name}"] = base_rate + turned(u_dot, angle)
            for key in contacts:
                interfaces[key] = self._interface(key, state, u, u_dot, flows)
                element = (
                    f"C: K_n,{key}",
                    f"R: R_n,{key}",
                    f"C: K_t,{key}",
                    f"R: R_t,{key}",
                    f"R: slip_{key}",
                )
                ports[f"contact_{key}"] = Port(
                    interfaces[key].transformer, interfaces[key].law.force, element
                )
            effort = (
                pad.internal_force(u, u_dot)
                if pad.inertial and not settled
                else self._left(name, contacts, ports, u, angle)
            )
            ports[f"pad_{name}"] = self._pad_port(name, effort, moment_arm, angle)
        return Evaluation(ports | self._sources(state, signals), flows, interfaces, branches)

    def point_inputs(
        self,
        key: str,
        state: State,
        u: Tensor,
        u_dot: Tensor,
        which: Tensor | None = None,
    ) -> Tensor:
        """Inputs x (..., points, 12 + states) of a contact's law: u and u_dot (..., points, 2) are
        the points' own, in the base's frame. `which` takes some of the points."""
        contact = self.contacts[key]
        u, u_dot = torch.broadcast_tensors(u, u_dot)
        X, weight = self.pads[contact.pad].point_positions, self.weight(key)
        states = [state.stretch[key][..., None, :], *self.friction_of(key, state)]
        states = torch.cat(states, -2).mT
        if which is not None:
            X, weight, states = X[which], weight[which], states[..., which, :]
        motion = self.relative(key, state)[..., None, :]
        parts = (X + u, motion[..., :3], u_dot, motion[..., 3:], states, weight[..., None])
        zero = 0.0 * (parts[0][..., :1] + motion[..., :1] + states[..., :1])  # of all dimensions
        return torch.cat([part + zero for part in (*parts, zero)], -1)

    def friction_of(self, key: str, state: State) -> list[Tensor]:
        """States (..., states, points) of a contact's law of friction, as they begin where `state`
        has none; an empty list for a law without."""
        friction = self.contacts[key].law.friction
        if not law_states(friction):
            return []
        if key in state.friction:
            return [state.friction[key]]
        return [begin_states(friction, state.stretch[key].shape).mT]

    def point_forces(
        self, contacts: Sequence[str], state: State, u: Tensor, u_dot: Tensor
    ) -> Tensor:
        """Sum of the forces of some contacts on the points of their pad (..., points, 2) [N], in
        the base's frame."""
        total = torch.zeros_like(u)
        for key in contacts:
            x = self.point_inputs(key, state, u, u_dot)
            total = total + interface_law(self.contacts[key].law, self.shape_of(key), x)[..., :2]
        return total

    def _rates(self, name: str, contacts: Sequence[str], state: State, u: Tensor) -> Tensor:
        """Rates u' (..., nodes, 2) [m/s] of a massless pad's nodes; u their displacements. Raises
        `NoRates` where Newton's method does not converge."""
        pad = self.pads[name]
        law = lambda rate: self.point_forces(contacts, state, pad.interpolation @ u, rate)
        if pad.nodal:
            return self._field_rates(name, state, 0, law if contacts else None)
        free, P = free_rates(pad, state.pads[name], 0.0)
        if not contacts:
            return free
        with torch.no_grad():  # without rates the springs alone push: that holds the pad nearly
            first = law(torch.zeros_like(pad.interpolation @ free))
        F, left = contact_forces(
            P, pad.interpolation, free, law, RATE_TOLERANCE, RATE_ITERATIONS, first
        )
        self._check_rates(name, left)
        return free + under_forces(P, F)

    def _branch_rates(self, name: str, state: State) -> Tensor:
        """Rates (..., nodes, 2 branches) [m/s] of the relaxing branches of a nodal pad."""
        numbers = range(1, self.pads[name].fields)
        return torch.cat([self._field_rates(name, state, k) for k in numbers], -1)

    def _field_rates(
        self, name: str, state: State, field: int, law: Forces | None = None
    ) -> Tensor:
        """Rates (..., nodes, 2) [m/s] of one field of a massless nodal pad: of its nodes, field 0,
        under the forces of a law of contact points, or of a branch. No dashpot is between two of
        them."""
        pad, part = self.pads[name], state.pads[name]
        at, dofs = pad.at_corners(part), QUADRILATERAL.dofs
        entries = slice(dofs * field, dofs * (field + 1))
        others = entries.start, at.shape[-1] - entries.stop
        internal = lambda rate: pad.element_forces(at, functional.pad(rate, others))[..., entries]
        nodes, none = Nodes(pad, internal, law), torch.zeros_like(part[..., :2])
        try:
            rate, solve, left = newton(nodes, none, RATE_TOLERANCE, RATE_ITERATIONS)
        except FloatingPointError:
            raise NoRates(
                f"the massless pad `{name}` has no rates in this state; is an element inside out?"
            ) from None
        self._check_rates(name, left)
        return corrected(nodes, rate, solve)

    def _check_rates(self, name: str, left: float) -> None:
        """Raises `NoRates` for rates of a massless pad with a residual [m/s]."""
        if not left <= 1e3 * RATE_TOLERANCE:
            raise NoRates(
                f"the rates of the massless pad `{name}` did not converge: residual {left:.2g} m/s "
                f"after {RATE_ITERATIONS} iterations; is v_s large enough for the pads' damping to "
                "balance the fall of friction with slip?"
            )

    def _interface(
        self, key: str, state: State, u: Tensor, u_dot: Tensor, flows: Mapping[str, Tensor]
    ) -> Interface:
        contact = self.contacts[key]
        pad, shape = self.pads[contact.pad], self.shape_of(key)
        r_B, _ = self.base_motion(contact.pad, state)
        x = self.point_inputs(key, state, pad.interpolation @ u, pad.interpolation @ u_dot)
        (d, theta), angle = point_place(x), r_B[..., 2, None]
        local = moving_frame(shape, d, theta)
        n, moment_arm = turned(local.n, angle), turned(d, angle)
        R = torch.stack((n, cross(n)), -2)  # world -> (normal, tangential), the rows of [iR0]
        arm = torch.einsum("...ij,...j->...i", R, cross(moment_arm))[..., None]
        transformer = Transformer(
            {
                contact.body: Block(R),
                f"{contact.body}_spin": Block(arm),
                f"pad_{contact.pad}": Block(-R, pad.interpolation),
            }
        )
        frame = Frame(moment_arm, n, cross(n), local.g)
        law = PointLaw.of(interface_law(contact.law, shape, x))
        return Interface(frame, law, transformer, transformer.flow(flows))

    def _left(
        self, name: str, contacts: list[str], ports: Mapping[str, Port], u: Tensor, angle: Tensor
    ) -> Tensor:
        """Effort (..., nodes, 2) [N] of the field of a pad without an I field, in its base's axes:
        what the contacts leave at the junction."""
        efforts = net_efforts({k: ports[f"contact_{k}"] for k in contacts}, self.junctions)
        return turned(efforts[f"pad_{name}"], -angle) if contacts else torch.zeros_like(u)

    def _pad_port(self, name: str, effort: Tensor, moment_arm: Tensor, angle: Tensor) -> Port:
        """The pad's viscoelastic field on its strain rate: node velocities less those of its base
        (Fig. 7)."""
        pad, key = self.pads[name], f"pad_{name}"
        eye = torch.eye(2, dtype=effort.dtype).expand(*angle.shape, 2, 2)
        Q_T = torch.stack((turned(eye[..., 0], -angle), turned(eye[..., 1], -angle)), -1)
        blocks = {key: Block(Q_T)}
        if pad.base is None:
            blocks[GROUND] = Block(-Q_T)
        else:
            blocks[pad.base] = Block(-Q_T)
            blocks[f"{pad.base}_spin"] = Block(
                -turned(cross(moment_arm), -angle)[..., None]
            )  # (35)
        return Port(Transformer(blocks), effort, pad.bond_elements(name))

    def _sources(self, state: State, signals: Tensor) -> dict[str, Port]:
        """Weights and actuators, which are sources unless they resist."""
        out = {}
        for name, body in self.weighted.items():
            force = weight(body.mass, self.gravity).expand(signals.shape[:-2])
            down = Transformer({name: Block(torch.eye(2, dtype=torch.float64)[None, 1:])})
            out[f"weight_{name}"] = Port(
                down, force[..., None, None], (f"Se: m_{self.symbols[name]} g",), True
            )
        for name, actuator in self.actuators.items():
            body, _, axis = actuator.pushes.partition(".")
            measured = (coordinate.partition(".") for coordinate in actuator.measures)
            sensed = dict.fromkeys(
                f"{one}_spin" if of == "theta" else one for one, _, of in measured
            )
            force = self.actuator_effort(name, state, signals)[..., None, None]
            eye = torch.eye(3, dtype=torch.float64)[None, COORDINATES.index(axis), None]
            key, row = (f"{body}_spin", eye[..., 2:]) if axis == "theta" else (body, eye[..., :2])
            blocks, senses = {key: Block(row)}, tuple(one for one in sensed if one != key)
            if actuator.resists:  # what the coordinate does to the ground, which does not turn
                blocks[GROUND] = Block(-eye[..., :2])
            out[f"control_{name}"] = Port(
                Transformer(blocks), -force if actuator.resists else force, actuator.elements,
                not actuator.resists, senses,
            )  # fmt: skip
        return out

    def actuator_effort(self, name: str, state: State, signals: Tensor) -> Tensor:
        """Effort (...) [N or N.m] of an actuator on the coordinate that it pushes; states that it
        lacks in `state` are those that they begin with."""
        return self.actuator_response(name, state, signals)[0]

    def actuator_response(
        self, name: str, state: State, signals: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Effort of an actuator, rates of its states (..., states), and the states themselves."""
        actuator, rows = self.actuators[name], dict(zip(self.signals, signals.unbind(-2)))
        x = actuator.seen(rows, state, signals.shape[:-2])
        z = state.control[name] if name in state.control else actuator.begin(x)
        return *actuator.response(x, z), z
