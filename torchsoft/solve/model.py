"""What the structure and the geometry of a rig decide: its laws compiled, the layout of its state,
the places of its parameters in one vector, its lists as plain arrays, and room to compute in.

A model is made once for all rigs that are alike in that, and never for one that is not: it is found
by comparing all that it was made of.
"""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.caller import warn
from torchsoft.codegen import Law
from torchsoft.physics.channels import recorded_slices
from torchsoft.physics.contact import SoftContact
from torchsoft.physics.energy import integrals
from torchsoft.physics.material import Material
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
from torchsoft.solve.kernel.arrays import recorded_size, scratch, system
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.laws import (
    LawSet,
    actuator_fault,
    actuator_law,
    contact_laws,
    element_law,
    friction_fault,
    material_fault,
    shape_fault,
    weight_law,
)
from torchsoft.solve.rig_arrays import (
    Key,
    Laws,
    arrays_of,
    computed,
    prepared,
    read_together,
    signal_count,
)
from torchsoft.solve.steps import CHUNK, ErrorParts, Followed

NOMINAL = 1e-3
"""Stage length a h [s] at which slip laws of users are tried."""

KEPT, KEPT_BYTES = 16, 5e7
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
    signals, signal_count: names of the reference's signals; their number with fixed coordinates
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
        rig, self.structure = self.rig, Structure(self.rig)
        rig.check_names()
        check_values(rig)
        check_groups(rig)
        self.low, self.high = ranges(modules, structure)
        self.derived = derived(modules)
        self.judged = [i for i, one in enumerate(modules) if hasattr(one, "well_posed")]
        self._key, self._geometric = structure.key, geometric(structure)
        self._geometry = self._geometry_of(values)
        shapes, matched = prepared(rig)
        made = computed(rig, shapes, matched)
        laws = compiled_laws(rig, made, shapes, matched)
        self.shared = structure.known and not laws.custom
        self.layout, self.integrals = rig.layout, integrals(rig)
        self.recorded, self.errors = recorded_slices(rig), ErrorParts(rig)
        self.signals, self.signal_count = rig.signals, signal_count(rig)
        count, firsts = 0, dict[int, int]()
        for value in (*values, *made.values()):
            firsts.setdefault(id(value), count)
            count += value.numel()
        self.places = named_places(rig, made, firsts)
        index = {
            key: [firsts[id(value)] + i for value in group for i in range(value.numel())]
            for key, group in read_together(rig, made, laws).items()
        }
        ends = np.cumsum([0, *map(len, index.values())]).tolist()
        at = {key: slice(*pair) for key, pair in zip(index, pairwise(ends))}
        self.index = torch.tensor(sum(index.values(), list[int]()), dtype=torch.int64)
        self._parts = arrays_of(rig, at, laws)
        self.bytes = sum(np.asarray(one).nbytes for part in self._parts for one in part)
        self._chains = [
            (at["chain", name].start, pad.branches)
            for name, pad in rig.pads.items() if not pad.nodal
        ]  # fmt: skip
        nodal = {name: pad for name, pad in rig.pads.items() if pad.nodal}
        self.nodal_widths = {name: 2 * pad.fields * pad.nodes for name, pad in nodal.items()}
        sizes = [one.shape.size() for one in rig.bodies.values() if one.shape is not None]
        self.smallest = min(sizes, default=np.inf)
        empty = self.system(np.zeros(len(self.index)))
        self.no_tape = scratch("Tape", empty, self.layout.size, stages=0, cap=0)
        self.widths = (
            self.layout.size, len(rig.pads) + len(rig.actuators) + len(rig.bodies) + 4,
            recorded_size(empty), sum(self.nodal_widths.values()),
        )  # fmt: skip
        self._idle: list[Room] = []
        self.last: tuple[Array, Tensor, Tensor, dict[str, float]] | None = None
        self.motion: tuple[Any, Followed] | None = None

    def _geometry_of(self, values: Sequence[Tensor]) -> bytes:
        return b"".join([values[i].detach().numpy().tobytes() for i in self._geometric])

    def serves(self, structure: Structure, values: Sequence[Tensor]) -> bool:
        """Whether this is the model of a rig with these parameters."""
        return structure.key == self._key and self._geometry == self._geometry_of(values)

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

    def system(self, p: Array) -> Any:
        """The rig's arrays with the vector of parameters p."""
        return system(*self._parts, p=p)

    def take(self, p: Array) -> Room:
        """Room for a run, as good as new, with the numbers p."""
        try:
            found = self._idle.pop()
        except IndexError:
            return Room(self.system(p.copy()), *self.widths[:2], self.signal_count)
        found.system.p[:] = p
        return found

    def give(self, used: Room) -> None:
        """Take a room back."""
        self._idle.append(used)


def compiled_laws(
    rig: Rig, made: Mapping[Key, Tensor], shapes: Mapping[str, Shape],
    matched: Mapping[str, SoftContact],
) -> Laws:  # fmt: skip
    """The laws of a rig. Raises the `ValueError`s of those that cannot be run, and warns of their
    faults."""
    fields = max((pad.fields for pad in rig.pads.values() if pad.nodal), default=1)
    sources, contacts, elements = list[Law](), dict[str, LawSet](), dict[str, Any]()
    faults, known, custom = list[str](), dict[tuple[int, int], LawSet](), False
    for name, pad in rig.pads.items():
        if structure_of(pad.material) is None:
            faults.append(material_fault(name, pad.material))
        if pad.nodal:
            elements[name] = element_law(name, pad.material, made["factors", name], fields)
    for name, actuator in rig.actuators.items():
        parameters = {f"law.{k}": v for k, v in actuator.named_parameters()}
        sources.append(actuator_law(name, actuator, parameters))
        if structure_of(actuator) is None:
            faults.append(actuator_fault(name, actuator))
    sources += [weight_law()] * len(rig.weighted)
    for name, contact in rig.contacts.items():
        law, shape = contact.law, rig.shape_of(name)
        if (key := (id(law), id(shape))) not in known:
            check_shape(contact.body, shape)
            slip, stiffness = law.friction, law.R_t.item() + NOMINAL * law.K_t.item()
            opaque = structure_of(law) is None or not type(slip).__module__.startswith("torchsoft.")
            if opaque:
                one, custom = torch.ones(()).double(), True
                slip_rates(name, slip, one, one, stiffness)
            known[key] = contact_laws(matched[name], shapes.get(contact.body, shape))
            if opaque:
                faults += check_slip(name, slip, stiffness), friction_fault(name, slip, stiffness)
            if structure_of(shape) is None:
                faults.append(shape_fault(contact.body, shape))
        contacts[name] = known[key]
    for wrong in filter(None, faults):
        warn(wrong)
    return Laws(sources, contacts, elements, fields, custom)


def named_places(
    rig: Rig, made: Mapping[Key, Tensor], firsts: Mapping[int, int]
) -> dict[str, slice]:
    """Places of the parameters by all of their names, and of what is made of them, from the first
    places of the tensors, by their id."""
    named = dict(rig.named_parameters(remove_duplicate=False))
    named |= {name: named[key] for name, key in rig.names.items() if key in named}
    named |= {f"{kind} of {part}": value for (kind, part), value in made.items()}
    return {
        name: slice(at := firsts[id(value)], at + value.numel()) for name, value in named.items()
    }


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
        stored = {name for name, value in module._parameters.items() if value is not None}
        for name in sorted(quantities(type(module)).keys() - stored):
            if isinstance(getattr(module, name, None), Tensor):
                known = quantity_of(module, name)
                assert known is not None
                out.append((i, name, known.low, known.high))
    return out


def geometric(structure: Structure) -> list[int]:
    """Which of the parameters the arrays of a model depend on: those of shapes, and Poisson's
    ratios."""
    owners = [(m, k) for m in structure.modules for k, x in m._parameters.items() if x is not None]
    return [
        i for i, (module, name) in enumerate(owners)
        if isinstance(module, Shape) or (isinstance(module, Material) and name == "nu")
    ]  # fmt: skip


_kept: deque[Model] = deque(maxlen=KEPT)
_finding = threading.RLock()


def model_of(structure: Structure, values: Sequence[Tensor]) -> Model:
    """The model of a rig with these parameters: one that is kept, or one that is made."""
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
    return found


def forget() -> None:
    """Keep nothing: models are made anew."""
    with _finding:
        _kept.clear()
