"""A rig as the kernels take it: its laws compiled, its parameters as one vector, its lists as plain
arrays.

Everything is read from the modules when a run begins, so that later changes of them do not matter;
the vector of parameters keeps its graph, and so gradients reach the tensors that the values were
made of.
"""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.codegen import Law
from torchsoft.physics.contact import Friction, SoftContact
from torchsoft.physics.elements import CONSTANTS
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.mesh import dofs_of
from torchsoft.physics.motion import Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rate_and_state import RateAndState
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import Shape
from torchsoft.physics.validity import (
    check_array,
    check_groups,
    check_shape,
    check_slip,
    check_values,
    slip_rates,
)
from torchsoft.solve.kernel import arrays
from torchsoft.solve.kernel.arrays import (
    CONDENSED,
    LANES,
    NODAL,
    Bodies,
    Condensed,
    Contacts,
    Limits,
    Nodal,
    Pads,
    Points,
    Sources,
    room,
    system,
)
from torchsoft.solve.kernel.objects import call
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
    structure,
    weight_law,
)
from torchsoft.solve.progress import Integrals, SimulationFailed
from torchsoft.solve.steps import Followed

NOMINAL = 1e-3
"""Stage length a h [s] at which slip laws of users are tried."""


HELD = 3e-4
"""Strain up to which the derivatives of an element's forces are held while it changes, in Newton's
method."""


@contextmanager
def independent() -> Iterator[None]:
    """Graphs made inside keep copies of their saved tensors: later changes of the modules do not
    reach them."""
    with torch.autograd.graph.saved_tensors_hooks(lambda x: x.detach().clone(), lambda x: x):
        yield


class Compiled:
    """A rig at one moment: `p` (parameters,) with its graph, and the arrays of its `system`."""

    def __init__(self, rig: Rig) -> None:
        rig.check_names()
        check_values(rig)
        check_groups(rig)
        with torch.enable_grad(), independent():
            self._read(rig)

    def _read(self, rig: Rig) -> None:
        self.rig, self.layout = rig, rig.layout
        self._entries: list[Tensor] = []
        self._known: dict[tuple[int, int], LawSet] = {}
        self._count = 0
        self._bodies = self._make_bodies()
        self._pads = self._make_pads()
        parts = self._bodies, self._make_sources(), self._pads, self._make_condensed()
        parts = *parts, self._make_nodal(), *self._make_contacts()
        self.p = torch.cat([x.reshape(-1) for x in self._entries])
        check_array("p", self.p)
        if not bool(torch.isfinite(self.p).all()):
            raise ValueError(
                "the parameters of the rig give numbers that are not finite; some are too large or "
                "too small"
            )
        self.system = system(*parts, p=self.p.detach().numpy().copy())

    def _add(self, value: Tensor) -> int:
        """Append a tensor to the vector of parameters; where it begins."""
        at = self._count
        self._entries.append(value.double())
        self._count += value.numel()
        return at

    def _add_all(self, parameters: Mapping[str, Tensor]) -> int:
        """Append the parameters of a law."""
        values = [value.reshape(-1) for value in parameters.values()]
        return self._add(torch.cat([torch.zeros(0).double(), *values]))

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
        masses = [self._add(mass) for body in rig.bodies.values() for mass in body.masses]
        coordinate = np.flatnonzero(free)
        return filled(
            Bodies, free=np.where(free, free.cumsum() - 1, -1), signal=signal,
            coordinate=coordinate, mass_at=np.array(masses)[coordinate],
            q_start=self._start("pose"), V_start=self._start("velocity"),
        )  # fmt: skip

    @property
    def signal_count(self) -> int:
        """Number of signals of the kernels, fixed coordinates included."""
        return len(self.rig.signals) + len(self.rig.fixed_values)

    @independent()
    def signals(self, t: Tensor, reference: Reference | None = None) -> Tensor:
        """The signals that the kernels follow, fixed coordinates last: values and rates (...,
        signals, 2)."""
        fixed, used = self.rig.fixed_values, self.rig.reference if reference is None else reference
        followed = self.rig.follow(t, reference)
        if not bool(torch.isfinite(followed).all()):
            bad = torch.nonzero(~torch.isfinite(followed))[0].tolist()
            name, time = self.rig.signals[bad[-2]], used.origin + float(t[tuple(bad[:-2])])
            raise ValueError(
                f"the signal `{name}` of the reference is not finite at t = {time:.10g} s"
            )
        if used.plain(self.rig.signals) is None and not torch.equal(
            followed, self.rig.follow(t, reference)
        ):
            raise ValueError(
                "the reference gives other values when asked again; signals must be functions of "
                "time alone"
            )
        if not fixed:
            return followed
        held = torch.stack([torch.stack(fixed), torch.zeros(len(fixed), dtype=torch.float64)], -1)
        return torch.cat((followed, held.expand(*t.shape, -1, -1)), -2)

    def _make_pads(self) -> Pads:
        rig, slices, bodies = self.rig, self.layout.slices, list(self.rig.bodies)
        pads, sizes = rig.pads.values(), [len(pad.mesh.surface) for pad in rig.pads.values()]
        base = [3 * (len(bodies) if pad.base is None else bodies.index(pad.base)) for pad in pads]
        for name, pad in rig.pads.items():
            if structure(pad.material) is None and (wrong := material_fault(name, pad.material)):
                warnings.warn(wrong, stacklevel=2)
        columns = np.full((len(pads), len(self._bodies.coordinate)), -1, np.int64)
        for number, name in enumerate(rig.pads):
            touched = (3 * bodies.index(rig.contacts[key].body) for key in rig.contacts_of(name))
            mine = np.isin(self._bodies.coordinate // 3 * 3, [base[number], *touched])
            columns[number, mine] = np.arange(mine.sum())
        ends = np.cumsum([0, *rig.point_counts.values()])
        owners = [list(rig.pads).index(contact.pad) for contact in rig.contacts.values()]
        return filled(
            Pads, kind=[NODAL if pad.nodal else CONDENSED for pad in pads], base=base,
            node_start=np.cumsum([0, *sizes]),
            point_start=ends[np.searchsorted(owners, np.arange(len(pads) + 1))],
            y_start=[slices["pads", name].start for name in rig.pads], column=columns,
            columns=(columns >= 0).sum(1),
        )  # fmt: skip

    def _make_condensed(self) -> Condensed:
        """Chains and compliances of the pads that are condensed; a nodal pad has none."""
        pads, none = list(self.rig.pads.values()), torch.zeros(0, dtype=torch.float64)
        units = [(none, none) if pad.nodal else pad.unit_compliance() for pad in pads]
        C, dC = (torch.cat([none, *(unit[k].flatten() for unit in units)]) for k in (0, 1))
        own = lambda pad: (1 / (pad.E * pad.material.depth), pad.material.nu)
        numbers = [
            none if pad.nodal else torch.cat((*pad.chain(), torch.stack(own(pad)))) for pad in pads
        ]
        return filled(
            Condensed, chain_at=[self._add(values) for values in numbers],
            branches=[0 if pad.nodal else pad.branches for pad in pads],
            C_start=np.cumsum([0, *(len(unit.flatten()) for unit, _ in units)]), C=C, dC=dC,
            reach=[0.0 if pad.nodal else 1.5 * unit.abs().max()
                   for pad, (unit, _) in zip(pads, units)],
        )  # fmt: skip

    def _make_nodal(self) -> Nodal:
        """Elements of the pads that are not condensed."""
        rig, slices = self.rig, self.layout.slices
        pads = [pad if pad.nodal else None for pad in rig.pads.values()]
        dofs = [0 if pad is None else 2 * pad.nodes for pad in pads]
        band = [0 if pad is None else 2 * spread(pad.corners // 2) + 1 for pad in pads]
        elements = [0 if pad is None else -(-len(pad.corners) // LANES) * LANES for pad in pads]
        laws, starts, ends, density = list[Law | None](), list[int](), list[int](), list[int]()
        for name, pad in rig.pads.items():
            law, parameters = (
                (None, {}) if not pad.nodal else element_law(name, pad.material, pad.factors())
            )
            laws.append(law)
            starts.append(self._add_all(parameters))
            ends.append(self._count)
            own = pad.material.rho * pad.material.depth
            density.append(self._add(own) if pad.nodal else -1)
        joined = lambda kind, *shape: np.concatenate(
            [np.zeros((0, *shape)), *(kind(pad) for pad in pads if pad is not None)]
        )
        surface = [
            np.full(2 * len(pad.mesh.surface), -1)
            if not pad.nodal
            else dofs_of(pad.surface.numpy())
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
            value=address("value"), linearise=address("linearise"), pullback=address("pullback"),
            push=address("push"),
            p_first=starts, p_last=ends,
            X=joined(lambda pad: pad.positions.numpy().ravel()),
            area=joined(lambda pad: np.repeat(pad.mesh.nodal_areas, 2)),
            dof=joined(lambda pad: lengthened(pad.corners, -1), 8),
            constants=joined(lambda pad: lengthened(pad.constants, 0.0), CONSTANTS),
            surface=np.concatenate([np.zeros(0), *surface]),
        )  # fmt: skip

    def _make_sources(self) -> Sources:
        """Actuators, and weights of the bodies that move along y."""
        rig, laws, starts = self.rig, list[Law](), list[int]()
        for name, actuator in rig.actuators.items():
            parameters = {f"law.{k}": v for k, v in actuator.named_parameters()}
            laws.append(actuator_law(name, actuator, parameters))
            if structure(actuator) is None and (wrong := actuator_fault(name, actuator)):
                warnings.warn(wrong, stacklevel=2)
            starts.append(self._add_all(parameters))
        for body in rig.weighted.values():
            laws.append(weight_law())
            starts.append(self._add(torch.stack((body.mass, rig.gravity))))
        every, others = rig.actuators.values(), [[]] * len(rig.weighted)
        signal_start, signal = _ragged(
            [[rig.signals.index(name) for name in one.reads] for one in every] + others
        )
        coordinate_start, coordinate = _ragged(
            [[rig.coordinate(name) for name in one.measures] for one in every] + others
        )
        return filled(
            Sources, linearise=[law.linearise for law in laws],
            pullback=[law.pullback for law in laws], p_start=[*starts, self._count],
            pushed=[rig.coordinate(one.pushes) for one in every]
            + [rig.coordinate(f"{name}.y") for name in rig.weighted],
            power=[*range(len(every)), *[len(every)] * len(rig.weighted)],
            signal_start=signal_start, signal=signal, coordinate_start=coordinate_start,
            coordinate=coordinate,
        )  # fmt: skip

    def _laws(self, name: str, law: SoftContact, shape: Shape) -> LawSet:
        """The laws of a contact, checked where they are not this package's."""
        key = id(law), id(shape)
        if key not in self._known:
            check_shape(self.rig.contacts[name].body, shape)
            slip = law.friction
            own = structure(law) is None or not isinstance(slip, Friction | RateAndState)
            stiffness = law.R_t.item() + NOMINAL * law.K_t.item()
            if own:
                one = torch.ones(()).double()
                slip_rates(name, slip, one, one, stiffness)
            self._known[key] = contact_laws(law, shape.prepared())
            faults = list[str]()
            if own:
                faults += check_slip(name, slip, stiffness), friction_fault(name, slip, stiffness)
            if structure(shape) is None:
                faults.append(shape_fault(self.rig.contacts[name].body, shape))
            for wrong in filter(None, faults):
                warnings.warn(wrong, stacklevel=2)
        return self._known[key]

    def _make_contacts(self) -> tuple[Contacts, Points]:
        rig, contacts = self.rig, self.rig.contacts.values()
        laws, starts, limits = list[LawSet](), list[int](), list[Any]()
        shapes = [rig.shape_of(name) for name in rig.contacts]
        for (name, contact), shape in zip(rig.contacts.items(), shapes):
            laws.append(self._laws(name, contact.law, shape))
            starts.append(self._add_all(laws[-1].parameters))
            pad = rig.pads[contact.pad]
            corners = pad.placed(np.stack(np.meshgrid(*pad.mesh.space.T), -1).reshape(-1, 2))
            box = np.stack((corners.min(0), corners.max(0)), 1).ravel()
            limits.append((-np.inf, np.inf, -np.inf, np.inf) if contact.may_leave else box)
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
            pullback=[one.interface.pullback for one in laws],
            free_linearise=[one.free.linearise for one in laws],
            free_pullback=[one.free.pullback for one in laws], p_start=[*starts, self._count],
            point_start=np.cumsum([0, *counts]), size=[shape.size() for shape in shapes],
            limits=limits, relative=motion_law().value,
            relative_linearise=motion_law().linearise,
        )  # fmt: skip
        pads = [rig.pads[contact.pad] for contact in contacts]
        joined = lambda parts, *shape: np.concatenate([np.zeros((0, *shape)), *parts])
        return made, filled(
            Points, contact=np.repeat(np.arange(len(counts)), counts),
            X=joined((pad.point_positions for pad in pads), 2),
            weight=joined(rig.weight(name).detach() for name in rig.contacts),
            node=joined(
                (self._pads.node_start[k] + pad.point_nodes for k, pad in zip(owners, pads)), 2
            ),
            N=joined((pad.point_shares for pad in pads), 2), y_start=joined(
                np.arange(*self.layout.slices["stretch", name].indices(self.layout.size))
                for name in rig.contacts
            ),
        )  # fmt: skip


def lengthened(rows: Any, value: float) -> Any:
    """Rows of a pad's elements, with rows of one value up to a multiple of `LANES`."""
    more = -len(rows) % LANES
    return np.concatenate((rows, np.full((more, rows.shape[1]), value, rows.dtype)))


def spread(corners: Index) -> int:
    """Largest difference between the nodes of one element, bonded ones (below zero) apart."""
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


def _ragged(lists: list[list[int]]) -> tuple[Index, list[int]]:
    """Ends of concatenated lists, and their numbers."""
    return np.cumsum([0, *map(len, lists)]), [number for one in lists for number in one]


# The compiled right-hand side of a rig, as a function of numpy arrays, for other integrators.


LIMITS = Limits(1e-10, 40, 2e-3)
"""Newton's tolerance [N] and iterations, and how near [m] a point has to be to count as one that
may touch."""


class Rates:
    """dy/dt = f(t, y) of a rig and its reference as they are now, compiled: tens of microseconds a
    call.

    The same as `rig.forward` to Newton's tolerance, for one state y (size,) of numpy. `calls`
    counts. An object keeps scratch of its own and the last forces as Newton's guess: one thread may
    call it at a time.

    Raises `NotImplementedError` for inertial pads.
    """

    def __init__(self, rig: Rig, reference: Reference | None = None) -> None:
        compiled = Compiled(rig)
        if any(pad.inertial for pad in rig.pads.values()):
            raise NotImplementedError(
                "the rates of inertial pads are not compiled for single states; use `rig.forward`"
            )
        self._system, self._limits = compiled.system, LIMITS
        self._work = room("Work", self._system, compiled.layout.size, columns=1)
        followed = rig.reference if reference is None else reference
        self._followed = Followed(lambda t: compiled.signals(t, followed), rig, followed)
        self._signals = np.zeros((1, compiled.signal_count, 2))
        self._powers, self._wrenches = (
            np.zeros(len(Integrals(rig).names)),
            np.zeros((len(rig.pads), 3)),
        )
        self.calls = 0

    def __call__(self, t: float, y: Array) -> Array:
        """dy/dt (size,) at t [s]. Raises `SimulationFailed` where Newton finds no forces."""
        out, y = np.empty(len(y)), np.ascontiguousarray(y)
        self.calls += 1
        found = self._solve(t, y, out)
        if not found:  # once more without the last call's guess
            self._work.u_dot[:], self._work.rate[:] = 0.0, 0.0
            found = self._solve(t, y, out)
        if self._followed.error is not None:
            raise self._followed.error
        if not found:
            self._work.u_dot[:], self._work.rate[:] = 0.0, 0.0
            raise SimulationFailed(
                f"at t = {t:.6g} s Newton's iteration found no forces for the state", float(t)
            )
        return out

    def _solve(self, t: float, y: Array, out: Array) -> bool:
        """Whether Newton found the forces; the rates go to `out`."""
        converged = np.zeros(1, np.int64)
        table = arrays.Rates(
            self._system, self._work, self._followed.arrays, self._limits, float(t), y,
            self._signals, self._powers, self._wrenches, out, converged,
        )  # fmt: skip
        call("rates", table)
        return bool(converged[0])
