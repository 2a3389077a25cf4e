"""The lists of a rig as the kernels' arrays: a function for each of the kernels' `PARTS`.

`at` has the places in the kernels' vector p of what they read together, as `read_together` lists
it. The functions read the rig only, and what is passed to them.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoft.codegen import Law
from torchsoft.physics.contact import SoftContact
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.mesh.element import QUADRILATERAL
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import Shape
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
)
from torchsoft.solve.kernel.table import Index, layout
from torchsoft.solve.laws import LawSet, motion_law

HELD = 3e-4
"""Strain up to which the derivatives of an element's forces are held while it changes, in Newton's
method."""

Key = tuple[str, str]
At = Mapping[Key, slice]


class Laws(NamedTuple):
    """The compiled laws of a rig: of actuators and then weights, of contacts by name, and of the
    elements of nodal pads by name, with their parameters; their fields; and whether a contact has a
    law that is not this package's."""

    sources: list[Law]
    contacts: dict[str, LawSet]
    elements: dict[str, tuple[Law, dict[str, Tensor]]]
    fields: int
    custom: bool


def prepared(rig: Rig) -> tuple[dict[str, Shape], dict[str, SoftContact]]:
    """Shapes that laws are compiled from where they are others than the bodies' own, by body, and
    the laws of the contacts, those that are matched to pads with their present numbers."""
    shapes = {name: body.shape for name, body in rig.bodies.items() if body.shape is not None}
    made = {name: shape.prepared() for name, shape in shapes.items()}
    laws = {id(one.law): one.law.prepared() for one in rig.contacts.values()}
    return (
        {name: shape for name, shape in made.items() if shape is not shapes[name]},
        {name: laws[id(one.law)] for name, one in rig.contacts.items()},
    )


def computed(
    rig: Rig, shapes: Mapping[str, Shape], laws: Mapping[str, SoftContact]
) -> dict[Key, Tensor]:
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
            elasticity = torch.stack((1 / (pad.E * material.depth), material.nu))
            out["chain", name] = torch.cat((*pad.chain(), elasticity))
    for name, law in laws.items():
        if law is not rig.contacts[name].law:
            out |= {(f"law of {name}", key): x for key, x in law.named_parameters()}
    for name, shape in shapes.items():
        out |= {(f"shape of {name}", key): x for key, x in shape.named_parameters()}
    return out


def read_together(rig: Rig, made: Mapping[Key, Tensor], laws: Laws) -> dict[Key, list[Tensor]]:
    """Parameters, and what is `made` of them, that the kernels read one after the other, by kind
    and part, in the order of the kernels' vector."""
    out = {("masses", name): [made["masses", name]] for name in rig.bodies}
    out |= {("actuator", name): [*one.parameters()] for name, one in rig.actuators.items()}
    out |= {("weight", name): [made["weight", name]] for name in rig.weighted}
    for name, pad in rig.pads.items():
        if pad.nodal:
            out["element", name] = [*laws.elements[name][1].values()]
            out["density", name] = [made["density", name]]
        else:
            out["chain", name] = [made["chain", name]]
    return out | {
        ("contact", name): [*one.parameters.values()] for name, one in laws.contacts.items()
    }


def arrays_of(rig: Rig, at: At, laws: Laws) -> tuple[Any, ...]:
    """One of each of the kernels' `PARTS`, in their order."""
    bodies = body_arrays(rig, at)
    pads = pad_arrays(rig, bodies.coordinate)
    return (
        bodies, port_arrays(rig, bodies), source_arrays(rig, at, laws.sources), pads,
        back_arrays([*rig.pads.values()]), condensed_arrays(rig, at), nodal_arrays(rig, at, laws),
        contact_arrays(rig, at, laws.contacts, bodies.free, pads.base),
        point_arrays(rig, pads.node_start),
    )  # fmt: skip


def starts(at: At, *kinds: str) -> list[int]:
    """Where the parts of some kinds, which are next to each other, start, and where the last one
    ends."""
    slices = [one for (kind, _), one in at.items() if kind in kinds]
    return [*(one.start for one in slices), slices[-1].stop if slices else 0]


def first_state(rig: Rig, part: str) -> int:
    """Index at which a part of the state starts."""
    return min((s.start for (of, _), s in rig.layout.slices.items() if of == part), default=0)


def joined(parts: Any, *shape: int) -> Any:
    """Arrays (., *shape) one after the other, or none."""
    return np.concatenate([np.zeros((0, *shape)), *parts])


def signal_count(rig: Rig) -> int:
    """Number of the reference's signals and fixed coordinates."""
    return len(rig.signals) + len(rig.fixed_values)


def body_arrays(rig: Rig, at: At) -> Bodies:
    places = [(name, axis) for name in rig.bodies for axis in COORDINATES]
    kinds = np.array([rig.bodies[name].freedom[axis] for name, axis in places] + 3 * ["ground"])
    free, fixed, driven = (kinds == kind for kind in ("free", "fixed", "driven"))
    signal = np.full(len(kinds), -1)
    signal[fixed] = len(rig.signals) + np.arange(fixed.sum())
    for c in np.flatnonzero(driven):
        signal[c] = rig.signals.index(".".join(places[c]))
    masses = [at["masses", name].start for name in rig.bodies]
    masses = np.add.outer(np.array(masses, np.int64), np.arange(3)).ravel()
    coordinate = np.flatnonzero(free)
    return filled(
        Bodies, free=np.where(free, free.cumsum() - 1, -1), signal=signal,
        coordinate=coordinate, mass_at=masses[coordinate],
        q_start=first_state(rig, "pose"), V_start=first_state(rig, "velocity"),
    )  # fmt: skip


def port_arrays(rig: Rig, bodies: Bodies) -> Ports:
    """What laws of sources read."""
    free, signal = bodies.free, bodies.signal
    states = [
        i for (of, _), s in rig.layout.slices.items() if of == "control"
        for i in range(s.start, s.stop)
    ]  # fmt: skip
    none, signals = np.full_like(free, -1), np.arange(2 * signal_count(rig))
    follows = [np.where(signal < 0, -1, 2 * signal + k) for k in (0, 1)]
    join = lambda *parts: np.concatenate([np.full(len(signals), -1), *parts])
    after = np.full(len(states), -1)
    return filled(
        Ports, y=join(np.where(free < 0, -1, bodies.q_start + free), none, states),
        number=join(free, none, after),
        signal=np.concatenate((signals, *follows, after)),
    )  # fmt: skip


def pad_arrays(rig: Rig, coordinate: Index) -> Pads:
    """`coordinate` (free,) are the coordinates that are free."""
    for name, pad in rig.pads.items():
        if pad.mesh.element.side != SIDE:
            raise NotImplementedError(
                f"an element of the pad `{name}` has {pad.mesh.element.side} nodes on a side, but "
                f"the kernels are compiled for {SIDE}; set `SIDE` in solve/kernel/arrays.py"
            )
    slices, bodies = rig.layout.slices, list(rig.bodies)
    pads, sizes = rig.pads.values(), [len(pad.mesh.surface) for pad in rig.pads.values()]
    base = [3 * (len(bodies) if pad.base is None else bodies.index(pad.base)) for pad in pads]
    columns = np.full((len(pads), len(coordinate)), -1, np.int64)
    for number, name in enumerate(rig.pads):
        touched = (3 * bodies.index(rig.contacts[key].body) for key in rig.contacts_of(name))
        involved = np.isin(coordinate // 3 * 3, [base[number], *touched])
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


def back_arrays(pads: Sequence[Pad]) -> Backs:
    backs = [(pad.placed(corners), bonded) for pad in pads for corners, bonded in (pad.mesh.back,)]
    every = [np.concatenate((x, pad.point_positions)) for pad, (x, _) in zip(pads, backs)]
    return filled(
        Backs, start=np.cumsum([0, *(len(x) for x, _ in backs)]),
        box=[np.stack((x.min(0), x.max(0)), 1).ravel() for x in every],
        X=joined((x for x, _ in backs), 2),
        bonded=joined(np.append(bonded, False) for _, bonded in backs),
    )  # fmt: skip


def condensed_arrays(rig: Rig, at: At) -> Condensed:
    """Chains and compliances of the pads that are condensed; a nodal pad has none."""
    pads, none = list(rig.pads.values()), torch.zeros(0, dtype=torch.float64)
    units = [(none, none) if pad.nodal else pad.unit_compliance() for pad in pads]
    C, dC = (torch.cat([none, *(unit[k].flatten() for unit in units)]) for k in (0, 1))
    return filled(
        Condensed,
        chain_at=[at["chain", name].start if ("chain", name) in at else 0 for name in rig.pads],
        branches=[0 if pad.nodal else pad.branches for pad in pads],
        C_start=np.cumsum([0, *(len(unit.flatten()) for unit, _ in units)]), C=C, dC=dC,
        reach=[0.0 if pad.nodal else 1.5 * unit.abs().max()
               for pad, (unit, _) in zip(pads, units)],
    )  # fmt: skip


def nodal_arrays(rig: Rig, at: At, laws: Laws) -> Nodal:
    """Elements of the pads that are not condensed."""
    pads, none = rig.pads.values(), slice(0, 0)
    nodal, width = [pad for pad in pads if pad.nodal], QUADRILATERAL.dofs * laws.fields
    dofs = [2 * pad.fields * pad.nodes if pad.nodal else 0 for pad in pads]
    band = [bandwidth(field_dofs(pad)) if pad.nodal else 0 for pad in pads]
    elements = [-(-len(pad.corners) // LANES) * LANES if pad.nodal else 0 for pad in pads]
    element_laws = [laws.elements[name][0] if pad.nodal else None for name, pad in rig.pads.items()]
    address = lambda kind: [getattr(law, kind, 0) for law in element_laws]
    parameters = [at.get(("element", name), none) for name in rig.pads]
    surface = [
        np.full(2 * len(pad.mesh.surface), -1)
        if not pad.nodal
        else (2 * pad.fields * pad.surface.numpy()[:, None] + np.arange(2)).ravel()
        for pad in pads
    ]
    return filled(
        Nodal, dof_start=np.cumsum([0, *dofs]),
        element_start=np.cumsum([0, *elements]),
        v_start=[rig.layout.slices["rates", name].start if pad.inertial else -1
                 for name, pad in rig.pads.items()],
        density_at=[at.get(("density", name), slice(-1, 0)).start for name in rig.pads],
        hold=[HELD if isinstance(pad.material, Hyperelastic) else np.inf for pad in pads],
        band=band,
        band_start=np.cumsum([0, *(n * (2 * b + 1) for n, b in zip(dofs, band))])[:-1],
        value=address("value"), linearise=address("linearise"), push=address("push"),
        pull=address("pull"),
        p_first=[one.start for one in parameters], p_last=[one.stop for one in parameters],
        X=joined(np.tile(pad.positions.numpy(), pad.fields).ravel() for pad in nodal),
        area=joined(np.repeat(pad.mesh.areas[pad.mesh.free], 2 * pad.fields) for pad in nodal),
        dof=joined((filled_up(lengthened(field_dofs(pad), -1), width) for pad in nodal), width),
        constants=joined(
            (lengthened(pad.constants, 0.0) for pad in nodal), QUADRILATERAL.constants
        ),
        surface=joined(surface), field=QUADRILATERAL.dofs,
    )  # fmt: skip


def source_arrays(rig: Rig, at: At, laws: Sequence[Law]) -> Sources:
    """Actuators, and weights of the bodies that move along y."""
    every, others = rig.actuators.values(), [[]] * len(rig.weighted)
    first, count = 2 * signal_count(rig), 3 * len(rig.bodies) + 3
    inputs, states = [], first + 2 * count
    for one in every:
        read = [2 * rig.signals.index(name) + k for name in one.reads for k in (0, 1)]
        read += [first + rig.coordinate(name) + k * count for name in one.measures for k in (0, 1)]
        inputs.append([*read, *range(states, states + len(one.states))])
        states += len(one.states)
    return filled(
        Sources, linearise=[law.linearise for law in laws], push=[law.push for law in laws],
        pull=[law.pull for law in laws], p_start=starts(at, "actuator", "weight"),
        pushed=[rig.coordinate(one.pushes) for one in every]
        + [rig.coordinate(f"{name}.y") for name in rig.weighted],
        power=[*range(len(every)), *[len(every)] * len(rig.weighted)],
        input_start=np.cumsum([0, *map(len, inputs + others)]), input=sum(inputs, list[int]()),
        states=[len(one.states) for one in every] + [0] * len(others),
        y_start=[
            rig.layout.slices["control", name].start if one.states else 0
            for name, one in rig.actuators.items()
        ] + [0] * len(others),
    )  # fmt: skip


def contact_arrays(
    rig: Rig, at: At, laws: Mapping[str, LawSet], free: Index, base: Index
) -> Contacts:
    """`free` (coordinates,) numbers the free coordinates; `base` (pads,) are the first coordinates
    of the pads' bases."""
    contacts, law_sets = rig.contacts.values(), list(laws.values())
    shapes, anywhere = [rig.shape_of(name) for name in rig.contacts], (-np.inf, np.inf) * 2
    limits = [anywhere if one.may_leave else rig.pads[one.pad].space.T.ravel() for one in contacts]
    owners = [list(rig.pads).index(contact.pad) for contact in contacts]
    body = np.array([3 * list(rig.bodies).index(contact.body) for contact in contacts], np.int64)
    both = np.stack((body, base[owners]), 1)[..., None] + np.arange(3)
    coordinate = both.reshape(-1, 6)
    address = lambda law, kind: [getattr(getattr(one, law), kind) for one in law_sets]
    return filled(
        Contacts, pad=owners, number=free[coordinate], coordinate=coordinate,
        states=[one.states for one in law_sets], distance=address("distance", "value"),
        value=address("interface", "value"), linearise=address("interface", "linearise"),
        push=address("interface", "push"), pull=address("interface", "pull"),
        free_linearise=address("free", "linearise"), free_push=address("free", "push"),
        free_pull=address("free", "pull"),
        stored=address("stored", "value"), p_start=starts(at, "contact"),
        point_start=np.cumsum([0, *rig.point_counts.values()]),
        size=[shape.size() for shape in shapes],
        inner=[shape.deepest() for shape in shapes], limits=limits, relative=motion_law().value,
        relative_linearise=motion_law().linearise,
    )  # fmt: skip


def point_arrays(rig: Rig, node_start: Index) -> Points:
    """`node_start` (pads,) numbers the first surface node of every pad."""
    counts = list(rig.point_counts.values())
    pads = [rig.pads[contact.pad] for contact in rig.contacts.values()]
    firsts = dict(zip(rig.pads, node_start))
    owners = [firsts[contact.pad] for contact in rig.contacts.values()]
    return filled(
        Points, contact=np.repeat(np.arange(len(counts)), counts),
        X=joined((pad.point_positions for pad in pads), 2),
        weight=joined(rig.weight(name).detach() for name in rig.contacts),
        node=joined((first + pad.point_nodes for first, pad in zip(owners, pads)), SIDE),
        N=joined((pad.point_shares for pad in pads), SIDE), y_start=joined(
            np.arange(*rig.layout.slices["stretch", name].indices(rig.layout.size))
            for name in rig.contacts
        ),
    )  # fmt: skip


def field_dofs(pad: Pad) -> Index:
    """Dofs of the corners of every element of a nodal pad (elements, 8 fields), field by field, -1
    where they are bonded. A node's are side by side."""
    node, axis = np.divmod(pad.corners, 2)
    numbers = [2 * (pad.fields * node + k) + axis for k in range(pad.fields)]
    return np.concatenate([np.where(pad.corners < 0, -1, dofs) for dofs in numbers], 1)


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
