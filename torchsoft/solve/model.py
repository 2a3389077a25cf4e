"""What the structure and the geometry of a rig decide: its laws compiled, the layout of its state,
the places of its parameters in one vector, its lists as plain arrays, and room to compute in.

A model is made once for all rigs that are alike in that, and never for one that is not: it is found
by comparing all that it was made of.
"""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.codegen import Law
from torchsoft.physics.channels import recorded_slices
from torchsoft.physics.contact import SoftContact
from torchsoft.physics.energy import integrals
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.material import Material
from torchsoft.physics.mesh.element import QUADRILATERAL
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import Shape
from torchsoft.physics.structure import Structure, structure_of
from torchsoft.physics.validity import (
    LARGEST,
    MISSING,
    check_groups,
    check_shape,
    check_slip,
    check_values,
    slip_rates,
)
from torchsoft.quantity import quantities, quantity_of
from torchsoft.solve.kernel.arrays import (
    CONDENSED,
    LANES,
    NODAL,
    SIDE,
    Backs,
    Bodies,
    Condensed,
    Contacts,
    Nodal,
    Pads,
    Points,
    Ports,
    Sources,
    recorded_size,
    scratch,
    system,
)
from torchsoft.solve.kernel.table import Array, Index, layout
from torchsoft.solve.laws import (
    LawSet,
    actuator_fault,
    actuator_law,
    contact_laws,
    element_law,
    friction_fault,
    material_fault,
    motion_law,
    shape_fault,
    weight_law,
)
from torchsoft.solve.steps import CHUNK, ErrorParts, Followed

NOMINAL = 1e-3
"""Stage length a h [s] at which slip laws of users are tried."""

HELD = 3e-4
"""Strain up to which the derivatives of an element's forces are held while it changes, in Newton's
method."""

KEPT, KEPT_BYTES = 8, 5e7
"""Most models that are kept, and arrays of theirs [bytes] beyond the last one's."""


class Room:
    """What one run at a time computes in: the arrays of a rig with a vector of parameters of its
    own, scratch for the kernels, and a chunk of steps (starts, lengths, signals)."""

    def __init__(self, system: Any, state: int, integrals: int, signals: int) -> None:
        self.system, self._state = system, state
        self._known = dict[str, tuple[dict[str, int], Any]]()
        self.work, self.step = self.of("Work", columns=1), self.of("Step", integrals=integrals)
        self.chunk = np.zeros(CHUNK), np.zeros(CHUNK), np.zeros((CHUNK, 2, signals, 2))

    def of(self, kind: str, **sizes: int) -> Any:
        """Scratch of a kind, the last one again where that had the same sizes."""
        if kind not in self._known or self._known[kind][0] != sizes:
            self._known[kind] = sizes, scratch(kind, self.system, self._state, **sizes)
        return self._known[kind][1]


class Model:
    """What the structure and the geometry of a rig determine, made of a copy of a rig with
    parameters `values`, one for each of its structure; fixed from then on.

    rig, structure: that copy and its structure, of which runs take copies of their own
    layout: places of the parts of the state (size,)
    recorded: places in the forces (recorded,) of an output, by kind and name
    integrals: energies [J] that are integrated beside the state
    signals, followed: names of the reference's signals; their number with fixed coordinates
    places: places in the vector of parameters, by their names
    index (m,): places in that vector of the numbers p that the kernels read
    low, high (parameters,): least and largest values of the parameters, each in its unit
    derived: numbers made of parameters, as number of a module, name and range; judged: numbers of
        modules that judge their parameters together
    errors: components of the state whose error is judged together
    smallest: size of the smallest body [m]
    widths: numbers of an output: of the state, of integrals, forces and rates of nodal pads
    nodal_widths: numbers of rates of each nodal pad
    bytes: size of the kernels' arrays; no_tape: a tape for nothing
    shared: whether it may serve other runs
    last, motion: vectors of parameters and signals of the last run, with what they were made of

    Raises the `ValueError`s of a rig that cannot be run, and warns of its laws' faults.
    """

    def __init__(self, structure: Structure, values: Sequence[Tensor]) -> None:
        modules = structure.copy(values)
        self.rig: Rig = modules[0]
        self.structure = Structure(self.rig)
        self.rig.check_names()
        check_values(self.rig)
        check_groups(self.rig)
        self.low, self.high = ranges(modules, structure)
        self.derived = derived(modules)
        self.judged = [i for i, one in enumerate(modules) if hasattr(one, "well_posed")]
        self.shared = structure.known
        self._key, self._geometric = structure.key, geometric(modules, structure)
        self._geometry = self._geometry_of(values)
        self._read(values)
        self._idle: list[Room] = []
        self.last: tuple[Array, Tensor, Tensor, dict[str, float]] | None = None
        self.motion: tuple[Any, Followed] | None = None

    def _geometry_of(self, values: Sequence[Tensor]) -> bytes:
        return b"".join([values[i].detach().numpy().tobytes() for i in self._geometric])

    def alike(self, values: Sequence[Tensor]) -> bool:
        """Whether a rig of the same structure with these parameters has the same geometry."""
        return self._geometry == self._geometry_of(values)

    def serves(self, structure: Structure, values: Sequence[Tensor]) -> bool:
        """Whether this is the model of a rig with these parameters."""
        return structure.key == self._key and self.alike(values)

    def within(self, modules: Sequence[Any], theta: Array) -> bool:
        """Whether the values of a rig's parameters, theta, are physical; its own checks are to say
        in words why they are not."""
        fine = bool(((self.low <= theta) & (theta <= self.high)).all())
        for number, name, low, high in self.derived if fine else ():
            value = getattr(modules[number], name)
            fine = fine and bool(((low <= value) & (value <= high)).all())
        return fine and not any(modules[i].well_posed() for i in self.judged)

    def chained(self, p: Array) -> bool:
        """The same of the chains of condensed pads in the kernels' vector."""
        for at, branches in self._chains:
            J, tau = p[at : at + branches], p[at + branches : at + 2 * branches]
            if (J < 0.0).any() or abs(J.sum() - 1.0) > MISSING or (tau <= 0.0).any():
                return False
        return True

    def _read(self, values: Sequence[Tensor]) -> None:
        rig = self.rig
        self.layout, self.integrals, self.signals = rig.layout, integrals(rig), rig.signals
        self.recorded = recorded_slices(rig)
        self.followed = len(rig.signals) + len(rig.fixed_values)
        self.errors = ErrorParts(rig)
        self._known: dict[tuple[int, int], LawSet] = {}
        self._shapes, self._index = prepared_shapes(rig), list[int]()
        self._matched = prepared_laws(rig)
        self._made = computed(rig, self._shapes, self._matched)
        self._places: dict[int, int] = {}
        count = 0
        for value in (*values, *self._made.values()):
            self._places.setdefault(id(value), count)
            count += value.numel()
        self.places = self._named_places()
        self._bodies = self._make_bodies()
        self._pads = self._make_pads()
        parts = (
            self._bodies, self._make_ports(), self._make_sources(), self._pads, self._make_backs()
        )  # fmt: skip
        self._condensed = self._make_condensed()
        self._parts = *parts, self._condensed, self._make_nodal(), *self._make_contacts()
        self.bytes = sum(np.asarray(one).nbytes for part in self._parts for one in part)
        self.index = torch.tensor(self._index, dtype=torch.int64)
        self.nodal_widths = {
            name: 2 * pad.fields * pad.nodes for name, pad in rig.pads.items() if pad.nodal
        }
        self._chains = [
            (at, n) for at, n in zip(self._condensed.chain_at, self._condensed.branches) if n
        ]
        sizes = [one.shape.size() for one in rig.bodies.values() if one.shape is not None]
        self.smallest = min(sizes, default=np.inf)
        none = self.system(np.zeros(len(self._index)))
        self.no_tape = scratch("Tape", none, self.layout.size, stages=0, cap=0)
        self.widths = (
            self.layout.size, len(rig.pads) + len(rig.actuators) + len(rig.bodies) + 4,
            recorded_size(none),
            int(none.nodal_dof_start[-1]),
        )  # fmt: skip
        del self._made, self._places, self._shapes, self._matched, self._known, self._index

    def _named_places(self) -> dict[str, slice]:
        """Places of the parameters by all of their names, and of what is computed from them."""
        named = dict(self.rig.named_parameters(remove_duplicate=False))
        named |= {name: named[own] for name, own in self.rig.names.items() if own in named}
        named |= {f"{kind} of {part}": value for (kind, part), value in self._made.items()}
        firsts = {name: self._places[id(value)] for name, value in named.items()}
        return {name: slice(at, at + named[name].numel()) for name, at in firsts.items()}

    def system(self, p: Array) -> Any:
        """The rig's arrays with the vector of parameters p."""
        return system(*self._parts, p=p)

    def take(self, p: Array) -> Room:
        """Room for a run, as good as new, with the numbers p."""
        try:
            found = self._idle.pop()
        except IndexError:
            return Room(self.system(p.copy()), *self.widths[:2], self.followed)
        found.system.p[:] = p
        return found

    def give(self, used: Room) -> None:
        """Take a room back."""
        self._idle.append(used)

    def _add(self, *values: Tensor) -> int:
        """Append parameters, or what was computed of them, to the kernels' vector; where they
        begin."""
        at = len(self._index)
        for value in values:
            first = self._places[id(value)]
            self._index += range(first, first + value.numel())
        return at

    def _start(self, part: str) -> int:
        """Index at which a part of the state begins."""
        return min((s.start for (of, _), s in self.layout.slices.items() if of == part), default=0)

    def _make_bodies(self) -> Bodies:
        rig = self.rig
        places = [(name, axis) for name in rig.bodies for axis in COORDINATES]
        kinds = np.array([rig.bodies[name].freedom[axis] for name, axis in places] + 3 * ["ground"])
        free, fixed, driven = (kinds == kind for kind in ("free", "fixed", "driven"))
        signal = np.full(len(kinds), -1)
        signal[fixed] = len(rig.signals) + np.arange(fixed.sum())
        for c in np.flatnonzero(driven):
            signal[c] = rig.signals.index(".".join(places[c]))
        masses = [self._add(self._made["masses", name]) for name in rig.bodies]
        masses = np.add.outer(np.array(masses, np.int64), np.arange(3)).ravel()
        coordinate = np.flatnonzero(free)
        return filled(
            Bodies, free=np.where(free, free.cumsum() - 1, -1), signal=signal,
            coordinate=coordinate, mass_at=masses[coordinate],
            q_start=self._start("pose"), V_start=self._start("velocity"),
        )  # fmt: skip

    def _make_ports(self) -> Ports:
        """What laws of sources read."""
        free, signal = self._bodies.free, self._bodies.signal
        states = [
            i for (of, _), s in self.layout.slices.items() if of == "control"
            for i in range(s.start, s.stop)
        ]  # fmt: skip
        none, signals = np.full_like(free, -1), np.arange(2 * self.followed)
        follows = [np.where(signal < 0, -1, 2 * signal + k) for k in (0, 1)]
        join = lambda *parts: np.concatenate([np.full(len(signals), -1), *parts])
        after = np.full(len(states), -1)
        return filled(
            Ports, y=join(np.where(free < 0, -1, self._bodies.q_start + free), none, states),
            number=join(free, none, after),
            signal=np.concatenate((signals, *follows, after)),
        )  # fmt: skip

    def _make_pads(self) -> Pads:
        rig, slices, bodies = self.rig, self.layout.slices, list(self.rig.bodies)
        pads, sizes = rig.pads.values(), [len(pad.mesh.surface) for pad in rig.pads.values()]
        base = [3 * (len(bodies) if pad.base is None else bodies.index(pad.base)) for pad in pads]
        for name, pad in rig.pads.items():
            if structure_of(pad.material) is None and (wrong := material_fault(name, pad.material)):
                warn(wrong)
        columns = np.full((len(pads), len(self._bodies.coordinate)), -1, np.int64)
        for number, name in enumerate(rig.pads):
            touched = (3 * bodies.index(rig.contacts[key].body) for key in rig.contacts_of(name))
            involved = np.isin(self._bodies.coordinate // 3 * 3, [base[number], *touched])
            columns[number, involved] = np.arange(involved.sum())
        ends = np.cumsum([0, *rig.point_counts.values()])
        owners = [list(rig.pads).index(contact.pad) for contact in rig.contacts.values()]
        return filled(
            Pads, kind=[NODAL if pad.nodal else CONDENSED for pad in pads], base=base,
            node_start=np.cumsum([0, *sizes]),
            point_start=ends[np.searchsorted(owners, np.arange(len(pads) + 1))],
            y_start=[slices["pads", name].start for name in rig.pads], column=columns,
            columns=(columns >= 0).sum(1),
        )  # fmt: skip

    def _make_backs(self) -> Backs:
        pads = list(self.rig.pads.values())
        backs = [
            (pad.placed(corners), bonded) for pad in pads for corners, bonded in (pad.mesh.back,)
        ]
        every = [np.concatenate((x, pad.point_positions)) for pad, (x, _) in zip(pads, backs)]
        return filled(
            Backs, start=np.cumsum([0, *(len(x) for x, _ in backs)]),
            box=[np.stack((x.min(0), x.max(0)), 1).ravel() for x in every],
            X=np.concatenate([np.zeros((0, 2)), *(x for x, _ in backs)]),
            bonded=np.concatenate([np.zeros(0), *(np.append(own, False) for _, own in backs)]),
        )  # fmt: skip

    def _make_condensed(self) -> Condensed:
        """Chains and compliances of the pads that are condensed; a nodal pad has none."""
        pads, none = list(self.rig.pads.values()), torch.zeros(0, dtype=torch.float64)
        units = [(none, none) if pad.nodal else pad.unit_compliance() for pad in pads]
        C, dC = (torch.cat([none, *(unit[k].flatten() for unit in units)]) for k in (0, 1))
        numbers = [self._made.get(("chain", name)) for name in self.rig.pads]
        return filled(
            Condensed,
            chain_at=[len(self._index) if one is None else self._add(one) for one in numbers],
            branches=[0 if pad.nodal else pad.branches for pad in pads],
            C_start=np.cumsum([0, *(len(unit.flatten()) for unit, _ in units)]), C=C, dC=dC,
            reach=[0.0 if pad.nodal else 1.5 * unit.abs().max()
                   for pad, (unit, _) in zip(pads, units)],
        )  # fmt: skip

    def _make_nodal(self) -> Nodal:
        """Elements of the pads that are not condensed."""
        rig, slices = self.rig, self.layout.slices
        pads = [pad if pad.nodal else None for pad in rig.pads.values()]
        dofs = [0 if pad is None else 2 * pad.fields * pad.nodes for pad in pads]
        numbers = [None if pad is None else field_dofs(pad) for pad in pads]
        band = [0 if dof is None else bandwidth(dof) for dof in numbers]
        fields = max((pad.fields for pad in rig.pads.values() if pad.nodal), default=1)
        elements = [0 if pad is None else -(-len(pad.corners) // LANES) * LANES for pad in pads]
        laws, starts, ends, density = list[Law | None](), list[int](), list[int](), list[int]()
        for name, pad in rig.pads.items():
            law, parameters = None, dict[str, Tensor]()
            if pad.nodal:
                factors = self._made["factors", name]
                law, parameters = element_law(name, pad.material, factors, fields)
            laws.append(law)
            starts.append(self._add(*parameters.values()))
            ends.append(len(self._index))
            density.append(self._add(self._made["density", name]) if pad.nodal else -1)
        joined = lambda kind, *shape: np.concatenate(
            [np.zeros((0, *shape)), *(kind(pad) for pad in pads if pad is not None)]
        )
        surface = [
            np.full(2 * len(pad.mesh.surface), -1)
            if not pad.nodal
            else (2 * pad.fields * pad.surface.numpy()[:, None] + np.arange(2)).ravel()
            for pad in rig.pads.values()
        ]
        address = lambda name: [0 if law is None else getattr(law, name) for law in laws]
        return filled(
            Nodal, dof_start=np.cumsum([0, *dofs]),
            element_start=np.cumsum([0, *elements]),
            v_start=[slices["rates", name].start if pad.inertial else -1
                     for name, pad in rig.pads.items()],
            density_at=density, hold=[HELD if isinstance(pad.material, Hyperelastic) else np.inf
                                      for pad in rig.pads.values()], band=band,
            band_start=np.cumsum([0, *(n * (2 * b + 1) for n, b in zip(dofs, band))])[:-1],
            value=address("value"), linearise=address("linearise"), push=address("push"),
            pull=address("pull"),
            p_first=starts, p_last=ends,
            X=joined(lambda pad: np.tile(pad.positions.numpy(), pad.fields).ravel()),
            area=joined(lambda pad: np.repeat(pad.mesh.areas[pad.mesh.free], 2 * pad.fields)),
            dof=np.concatenate([np.zeros((0, QUADRILATERAL.dofs * fields)), *(
                filled_up(lengthened(dof, -1), QUADRILATERAL.dofs * fields) for dof in numbers
                if dof is not None
            )]),
            constants=joined(lambda pad: lengthened(pad.constants, 0.0), QUADRILATERAL.constants),
            surface=np.concatenate([np.zeros(0), *surface]), field=QUADRILATERAL.dofs,
        )  # fmt: skip

    def _make_sources(self) -> Sources:
        """Actuators, and weights of the bodies that move along y."""
        rig, laws, starts = self.rig, list[Law](), list[int]()
        for name, actuator in rig.actuators.items():
            parameters = {f"law.{k}": v for k, v in actuator.named_parameters()}
            laws.append(actuator_law(name, actuator, parameters))
            if structure_of(actuator) is None and (wrong := actuator_fault(name, actuator)):
                warn(wrong)
            starts.append(self._add(*parameters.values()))
        for name in rig.weighted:
            laws.append(weight_law())
            starts.append(self._add(self._made["weight", name]))
        every, others = rig.actuators.values(), [[]] * len(rig.weighted)
        first, count = 2 * self.followed, len(self._bodies.free)
        inputs, states = [], first + 2 * count
        for one in every:
            read = [2 * rig.signals.index(name) + k for name in one.reads for k in (0, 1)]
            read += [
                first + rig.coordinate(name) + k * count for name in one.measures for k in (0, 1)
            ]
            inputs.append([*read, *range(states, states + len(one.states))])
            states += len(one.states)
        return filled(
            Sources, linearise=[law.linearise for law in laws], push=[law.push for law in laws],
            pull=[law.pull for law in laws], p_start=[*starts, len(self._index)],
            pushed=[rig.coordinate(one.pushes) for one in every]
            + [rig.coordinate(f"{name}.y") for name in rig.weighted],
            power=[*range(len(every)), *[len(every)] * len(rig.weighted)],
            input_start=np.cumsum([0, *map(len, inputs + others)]), input=sum(inputs, list[int]()),
            states=[len(one.states) for one in every] + [0] * len(others),
            y_start=[
                self.layout.slices["control", name].start if one.states else 0
                for name, one in rig.actuators.items()
            ] + [0] * len(others),
        )  # fmt: skip

    def _laws(self, name: str, law: SoftContact, shape: Shape) -> LawSet:
        """The laws of a contact, checked where they are not this package's."""
        key = id(law), id(shape)
        if key not in self._known:
            check_shape(self.rig.contacts[name].body, shape)
            slip = law.friction
            own = structure_of(law) is None or not type(slip).__module__.startswith("torchsoft.")
            stiffness = law.R_t.item() + NOMINAL * law.K_t.item()
            if own:
                self.shared = False
                one = torch.ones(()).double()
                slip_rates(name, slip, one, one, stiffness)
            self._known[key] = contact_laws(
                self._matched[name], self._shapes.get(self.rig.contacts[name].body, shape)
            )
            faults = list[str]()
            if own:
                faults += check_slip(name, slip, stiffness), friction_fault(name, slip, stiffness)
            if structure_of(shape) is None:
                faults.append(shape_fault(self.rig.contacts[name].body, shape))
            for wrong in filter(None, faults):
                warn(wrong)
        return self._known[key]

    def _make_contacts(self) -> tuple[Contacts, Points]:
        rig, contacts = self.rig, self.rig.contacts.values()
        laws, starts, limits = list[LawSet](), list[int](), list[Any]()
        shapes = [rig.shape_of(name) for name in rig.contacts]
        for (name, contact), shape in zip(rig.contacts.items(), shapes):
            laws.append(self._laws(name, contact.law, shape))
            starts.append(self._add(*laws[-1].parameters.values()))
            pad = rig.pads[contact.pad]
            anywhere = (-np.inf, np.inf, -np.inf, np.inf)
            limits.append(anywhere if contact.may_leave else pad.space.T.ravel())
        owners = [list(rig.pads).index(contact.pad) for contact in contacts]
        body = np.array(
            [3 * list(rig.bodies).index(contact.body) for contact in contacts], np.int64
        )
        both = np.stack((body, self._pads.base[owners]), 1)[..., None] + np.arange(3)
        coordinate = both.reshape(-1, 6)
        counts = list(rig.point_counts.values())
        made = filled(
            Contacts, pad=owners, number=self._bodies.free[coordinate], coordinate=coordinate,
            states=[one.states for one in laws], distance=[one.distance.value for one in laws],
            value=[one.interface.value for one in laws],
            linearise=[one.interface.linearise for one in laws],
            push=[one.interface.push for one in laws], pull=[one.interface.pull for one in laws],
            free_linearise=[one.free.linearise for one in laws],
            free_push=[one.free.push for one in laws], free_pull=[one.free.pull for one in laws],
            stored=[one.stored.value for one in laws], p_start=[*starts, len(self._index)],
            point_start=np.cumsum([0, *counts]), size=[shape.size() for shape in shapes],
            inner=[shape.deepest() for shape in shapes], limits=limits, relative=motion_law().value,
            relative_linearise=motion_law().linearise,
        )  # fmt: skip
        pads = [rig.pads[contact.pad] for contact in contacts]
        joined = lambda parts, *shape: np.concatenate([np.zeros((0, *shape)), *parts])
        return made, filled(
            Points, contact=np.repeat(np.arange(len(counts)), counts),
            X=joined((pad.point_positions for pad in pads), 2),
            weight=joined(rig.weight(name).detach() for name in rig.contacts),
            node=joined(
                (self._pads.node_start[k] + pad.point_nodes for k, pad in zip(owners, pads)),
                SIDE,
            ),
            N=joined((pad.point_shares for pad in pads), SIDE), y_start=joined(
                np.arange(*self.layout.slices["stretch", name].indices(self.layout.size))
                for name in rig.contacts
            ),
        )  # fmt: skip


def field_dofs(pad: Pad) -> Index:
    """Dofs of the corners of every element of a nodal pad (elements, 8 fields), field by field, -1
    where they are bonded. A node's are side by side."""
    node, axis = np.divmod(pad.corners, 2)
    numbers = [2 * (pad.fields * node + k) + axis for k in range(pad.fields)]
    return np.concatenate([np.where(pad.corners < 0, -1, own) for own in numbers], 1)


def lengthened(rows: Any, value: float) -> Any:
    """Rows of a pad's elements, with rows of one value up to a multiple of `LANES`."""
    more = -len(rows) % LANES
    return np.concatenate((rows, np.full((more, rows.shape[1]), value, rows.dtype)))


def filled_up(rows: Index, width: int) -> Index:
    """Rows with -1 after their entries, up to a width."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=-1)


def bandwidth(corners: Index) -> int:
    """Largest difference between the dofs of one element, bonded ones (below zero) apart."""
    free = corners >= 0
    most = np.where(free, corners, -1).max(1) - np.where(free, corners, corners.max()).min(1)
    return int(most.max())


def filled(part: Any, /, **fields: Any) -> Any:
    """One of `PARTS` from its fields, as arrays of their declared types."""
    parts = []
    for name, dtype, ndim, _ in layout(part):
        value = np.ascontiguousarray(fields[name], dtype) if ndim else fields[name]
        parts.append(value if np.ndim(value) == ndim else value.reshape((0,) * ndim))
    return part(*parts)


def prepared_shapes(rig: Rig) -> dict[str, Shape]:
    """Shapes that laws are compiled from where they are others than the bodies' own, by body."""
    shapes = {name: body.shape for name, body in rig.bodies.items() if body.shape is not None}
    made = {name: shape.prepared() for name, shape in shapes.items()}
    return {name: shape for name, shape in made.items() if shape is not shapes[name]}


def prepared_laws(rig: Rig) -> dict[str, SoftContact]:
    """The laws of the contacts, those that are matched to pads with their present numbers."""
    made = {id(one.law): one.law.prepared() for one in rig.contacts.values()}
    return {name: made[id(one.law)] for name, one in rig.contacts.items()}


def computed(
    rig: Rig, shapes: Mapping[str, Shape], laws: Mapping[str, SoftContact]
) -> dict[tuple[str, str], Tensor]:
    """Numbers that the kernels read and that are made of parameters, by kind and part."""
    out = {("masses", name): torch.stack(body.masses) for name, body in rig.bodies.items()}
    out |= {
        ("weight", name): torch.stack((body.mass, rig.gravity))
        for name, body in rig.weighted.items()
    }
    for name, pad in rig.pads.items():
        material = pad.material
        if pad.nodal:
            out["factors", name] = pad.factors()
            out["density", name] = material.rho * material.depth
        else:
            own = torch.stack((1 / (pad.E * material.depth), material.nu))
            out["chain", name] = torch.cat((*pad.chain(), own))
    for name, law in laws.items():
        if law is not rig.contacts[name].law:
            out |= {(f"law of {name}", key): x for key, x in law.named_parameters()}
    for name, shape in shapes.items():
        out |= {(f"shape of {name}", key): x for key, x in shape.named_parameters()}
    return out


def ranges(modules: Sequence[Any], structure: Structure) -> tuple[Array, Array]:
    """Least and largest value of every number of a structure's parameters."""
    ends = list[Array]()
    for module in modules:
        for name, value in module._parameters.items():
            if value is not None:
                known = quantity_of(module, name)
                low, high = (-np.inf, np.inf) if known is None else (known.low, known.high)
                most = np.nextafter(LARGEST, 0.0)
                ends.append(np.tile([max(low, -most), min(high, most)], (value.numel(), 1)))
    both = np.concatenate([np.zeros((0, 2)), *ends])
    return both[:, 0].copy(), both[:, 1].copy()


def derived(modules: Sequence[Any]) -> list[tuple[int, str, float, float]]:
    """Numbers with a range that are made of parameters: of which module, names and ranges."""
    out = []
    for i, module in enumerate(modules):
        own = {name for name, value in module._parameters.items() if value is not None}
        for name in sorted(quantities(type(module)).keys() - own):
            if isinstance(getattr(module, name, None), Tensor):
                known = quantity_of(module, name)
                assert known is not None
                out.append((i, name, known.low, known.high))
    return out


def geometric(modules: Sequence[Any], structure: Structure) -> list[int]:
    """Which of the parameters the arrays of a model depend on: those of shapes, and Poisson's
    ratios; all of them where it is not known."""
    owners = [(m, k) for m in modules for k, x in m._parameters.items() if x is not None]
    if not structure.known:
        return [*range(len(owners))]
    return [
        i for i, (module, name) in enumerate(owners)
        if isinstance(module, Shape) or (isinstance(module, Material) and name == "nu")
    ]  # fmt: skip


_kept: deque[Model] = deque(maxlen=KEPT)
_finding = threading.RLock()


def model_of(structure: Structure, values: Sequence[Tensor]) -> Model:
    """The model of a rig with these parameters: the last one of this reading of its structure, one
    that is kept, or one that is made."""
    if (last := structure.model) is not None and last.shared and last.alike(values):
        return last
    with _finding:
        kept = _kept if structure.known else ()
        found = next((one for one in kept if one.serves(structure, values)), None)
        if found is None:
            found = Model(structure, values)
        elif found is not _kept[0]:
            _kept.remove(found)
        if found.shared and (not _kept or found is not _kept[0]):
            _kept.appendleft(found)
            while len(_kept) > 1 and sum(one.bytes for one in _kept) > KEPT_BYTES:
                _kept.pop()
    structure.model = found
    return found


def forget() -> None:
    """Keep nothing: models are made anew."""
    with _finding:
        _kept.clear()
