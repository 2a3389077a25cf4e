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
from scipy import linalg, sparse
from torch import Tensor

from torchsoft.codegen import Law
from torchsoft.physics.contact import Friction, SoftContact
from torchsoft.physics.mesh import banded, dofs_of, unit_loads
from torchsoft.physics.motion import Reference
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES
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
    GAMMA,
    Actuators,
    Bodies,
    Contacts,
    Inertia,
    Limits,
    Pads,
    Points,
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
    friction_fault,
    material_fault,
    shape_fault,
    structure,
)
from torchsoft.solve.progress import Integrals, SimulationFailed
from torchsoft.solve.steps import Followed

NOMINAL = 1e-3
"""Stage length a h [s] at which slip laws of users are tried."""


@contextmanager
def independent() -> Iterator[None]:
    """Graphs made inside keep copies of their saved tensors: later changes of the modules do not
    reach them."""
    with torch.autograd.graph.saved_tensors_hooks(lambda x: x.detach().clone(), lambda x: x):
        yield


class Compiled:
    """A rig at one moment: `p` (parameters,) with its graph, `names` of its entries, and
    `system(h)` for a step h [s]."""

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
        self._systems: dict[float, Any] = {}
        self._bodies = self._make_bodies()
        self._pads, self._inertia = self._make_pads()
        self._actuators = self._make_actuators()
        self._contacts, self._points = self._make_contacts()
        self.p = torch.cat([x.reshape(-1) for x in self._entries])
        check_array("p", self.p)
        if not bool(torch.isfinite(self.p).all()):
            raise ValueError(
                "the parameters of the rig give numbers that are not finite; some are too large or "
                "too small"
            )

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
        weighted = [rig.bodies[name].weighted and axis == "y" for name, axis in places]
        coordinate = np.flatnonzero(free)
        return filled(
            Bodies, free=np.where(free, free.cumsum() - 1, -1), signal=signal,
            coordinate=coordinate, mass_at=np.array(masses)[coordinate],
            weight=np.array(weighted)[coordinate], gravity_at=self._add(rig.gravity),
            q_start=self._start("pose"), V_start=self._start("velocity"),
        )  # fmt: skip

    @property
    def inertial(self) -> bool:
        """Whether any pad has inertia; the arrays then belong to one step."""
        return len(self._inertia.X) > 0

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

    def _make_pads(self) -> tuple[Pads, Inertia]:
        rig, slices, bodies = self.rig, self.layout.slices, list(self.rig.bodies)
        pads, sizes = rig.pads.values(), [len(pad.mesh.surface) for pad in rig.pads.values()]
        base = [3 * (len(bodies) if pad.base is None else bodies.index(pad.base)) for pad in pads]
        for name, pad in rig.pads.items():
            if structure(pad.material) is None and (wrong := material_fault(name, pad.material)):
                warnings.warn(wrong, stacklevel=2)
        chains = [pad.chain() for pad in pads]
        branches = np.array([len(fractions) for fractions, _ in chains], np.int64)
        chain_at = [self._add(torch.cat((*chain, moduli(pad)))) for chain, pad in zip(chains, pads)]
        columns = np.full((len(pads), len(self._bodies.coordinate)), -1, np.int64)
        for number, name in enumerate(rig.pads):
            touched = (3 * bodies.index(rig.contacts[key].body) for key in rig.contacts_of(name))
            mine = np.isin(self._bodies.coordinate // 3 * 3, [base[number], *touched])
            columns[number, mine] = np.arange(mine.sum())
        ends = np.cumsum([0, *rig.point_counts.values()])
        owners = [list(rig.pads).index(contact.pad) for contact in rig.contacts.values()]
        none = torch.zeros(0, dtype=torch.float64)
        units = [
            (none.new_zeros(4 * n * n),) * 2 if pad.inertial else pad.unit_compliance()
            for n, pad in zip(sizes, pads)
        ]
        C, dC = (torch.cat([none, *(unit[k].flatten() for unit in units)]) for k in (0, 1))
        made = filled(
            Pads, base=base, node_start=np.cumsum([0, *sizes]),
            point_start=ends[np.searchsorted(owners, np.arange(len(pads) + 1))],
            y_start=[slices["pads", name].start for name in rig.pads],
            v_start=[
                slices["rates", name].start if pad.inertial else -1
                for name, pad in rig.pads.items()
            ],
            chain_at=chain_at, branches=branches,
            C_start=np.cumsum([0, *(4 * n * n for n in sizes)]), C=C, dC=dC,
            reach=[1.5 * unit.abs().max() for unit, _ in units], column=columns,
            columns=(columns >= 0).sum(1),
        )  # fmt: skip
        return made, self._make_inertia(made.node_start, made.chain_at + 2 * branches)

    def _make_inertia(self, node_start: Index, material_at: Index) -> Inertia:
        moving = {i: pad for i, pad in enumerate(self.rig.pads.values()) if pad.inertial}
        dofs = np.zeros(len(material_at) + 1, np.int64)
        for i, pad in moving.items():
            dofs[i + 1] = 2 * pad.nodes
        dofs = dofs.cumsum()
        total = dofs[-1]
        X, area = np.zeros(total), np.zeros(total)
        both = {i: [pad.stiffness(1, 0), pad.stiffness(0, 1)] for i, pad in moving.items()}
        patterns = {
            i: sparse.csr_array(abs(K_lambda) + abs(K_mu)) for i, (K_lambda, K_mu) in both.items()
        }
        for pattern in patterns.values():
            pattern.eliminate_zeros()
        widest = max(
            (pattern.count_nonzero(axis=1).max() for pattern in patterns.values()), default=0
        )
        surface = np.zeros(2 * node_start[-1], np.int64)
        column, *K = (np.zeros((total, widest)) for _ in range(3))
        for i, pad in moving.items():
            here = slice(dofs[i], dofs[i + 1])
            X[here], area[here] = pad.positions.numpy().ravel(), np.repeat(pad.mesh.nodal_areas, 2)
            surface[2 * node_start[i] : 2 * node_start[i + 1]] = dofs_of(pad.surface.numpy())
            stiffness, pattern = both[i], patterns[i]
            row = np.repeat(np.arange(here.stop - here.start), np.diff(pattern.indptr))
            at = dofs[i] + row, np.arange(len(row)) - pattern.indptr[row]
            column[at] = pattern.indices
            for k in range(2):
                K[k][at] = stiffness[k][row, pattern.indices]
        return filled(
            Inertia, dof_start=dofs, surface=surface, factor=np.zeros((1, total)),
            band=np.ones(len(material_at)), X=X, area=area, K_column=column, K_lambda=K[0],
            K_mu=K[1], D=np.zeros((total, 2)), B=np.zeros((len(material_at), 2, 2)),
            material_at=material_at,
        )  # fmt: skip

    def _make_actuators(self) -> Actuators:
        rig, laws, starts = self.rig, list[Law](), list[int]()
        numbers = lambda names: [rig.signals.index(name) for name in names]
        for name, actuator in rig.actuators.items():
            parameters = {f"law.{k}": v for k, v in actuator.named_parameters()}
            laws.append(actuator_law(name, actuator, parameters))
            if structure(actuator) is None and (wrong := actuator_fault(name, actuator)):
                warnings.warn(wrong, stacklevel=2)
            starts.append(self._add_all(parameters))
        every = rig.actuators.values()
        setpoint_start, setpoint = _ragged([numbers(one.setpoints) for one in every])
        measured_start, measured = _ragged(
            [[rig.coordinate(name) for name in one.measures] for one in every]
        )
        return filled(
            Actuators, linearise=[law.linearise for law in laws],
            pullback=[law.pullback for law in laws], p_start=[*starts, self._count],
            pushed=[rig.coordinate(one.pushes) for one in every],
            feed_forward=[
                -1 if one.feed_forward is None else rig.signals.index(one.feed_forward)
                for one in every
            ],
            setpoint_start=setpoint_start, setpoint=setpoint,
            measured_start=measured_start, measured=measured,
        )  # fmt: skip

    def _laws(self, name: str, law: SoftContact, shape: Shape) -> LawSet:
        """The laws of a contact, checked where they are not this package's."""
        key = id(law), id(shape)
        if key not in self._known:
            check_shape(self.rig.contacts[name].body, shape)
            slip = law.friction
            own = structure(law) is None or not isinstance(slip, Friction)
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
            Contacts, pad=owners, body=body, number=self._bodies.free[coordinate],
            coordinate=coordinate, distance=[one.distance.value for one in laws],
            linearise=[one.interface.linearise for one in laws],
            pullback=[one.interface.pullback for one in laws],
            free=[one.free.value for one in laws],
            free_linearise=[one.free.linearise for one in laws],
            free_pullback=[one.free.pullback for one in laws], p_start=[*starts, self._count],
            point_start=np.cumsum([0, *counts]), size=[shape.size() for shape in shapes],
            limits=limits,
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
            N=joined((pad.point_shares for pad in pads), 2), y_start=self._start("stretch"),
        )  # fmt: skip

    def system(self, h: float) -> Any:
        """The arrays for steps of h [s]; only inertial pads depend on it."""
        key = float(f"{h:.12g}") if self.inertial else 0.0
        if key not in self._systems:
            if (
                len(self._systems) > 32
            ):  # an irregular output grid has many step sizes; each holds some megabytes
                self._systems.clear()
            pads, inertia = self._mobilities(GAMMA * key) if key else (self._pads, self._inertia)
            p = self.p.detach().numpy().copy()
            self._systems[key] = system(
                self._bodies, self._actuators, pads, inertia, self._contacts, self._points, p=p
            )
        return self._systems[key]

    def _mobilities(self, a: float) -> tuple[Pads, Inertia]:
        """Inertial pads' mobilities at the stage length a h [s]: surface rates per surface force,
        and per velocity of the base."""
        pads, inertia = self._pads._replace(C=self._pads.C.copy()), self._inertia
        parts, p = [], self.p.detach().numpy()
        D, B = inertia.D.copy(), inertia.B.copy()
        for i, pad in enumerate(self.rig.pads.values()):
            here = slice(inertia.dof_start[i], inertia.dof_start[i + 1])
            if not pad.inertial:
                continue
            lame_lambda, lame_mu, tau, density = p[
                inertia.material_at[i] : inertia.material_at[i] + 4
            ]
            K = pad.stiffness(lame_lambda, lame_mu)
            M = density * inertia.area[here]
            A = banded((K * (tau + a)).tocsr())
            A[0] += M / a
            factor = linalg.cholesky_banded(A, lower=True)
            surface = inertia.surface[2 * pads.node_start[i] : 2 * pads.node_start[i + 1]]
            loads = unit_loads(len(M), surface)
            P = linalg.cho_solve_banded((factor, True), loads)[surface]
            pads.C[pads.C_start[i] : pads.C_start[i + 1]] = P.ravel()
            uniform = M[:, None] * np.tile(np.eye(2), (len(M) // 2, 1)) / a
            D[here] = linalg.cho_solve_banded((factor, True), uniform)
            B[i] = np.diag(uniform.sum(0)) - uniform.T @ D[here]
            parts.append((i, here, factor))
        band = np.ones(len(self.rig.pads), np.int64)
        width = max(len(factor) for *_, factor in parts)
        factors = np.zeros((width, len(inertia.X)))
        for i, here, factor in parts:
            band[i] = len(factor)
            factors[: len(factor), here] = factor
        return pads, inertia._replace(factor=factors, band=band, D=D, B=B)


def moduli(pad: Pad) -> Tensor:
    """Numbers of a pad's material as the kernels take them: depth lambda, depth mu, tau, rho depth
    of an inertial pad, else 1 / (E depth), nu."""
    material = pad.material
    if not pad.inertial:
        return torch.stack((1 / (pad.E * material.depth), material.nu))
    lame = (material.depth * modulus for modulus in pad.lame())
    return torch.stack((*lame, pad.chain()[1][0], material.rho * material.depth))


def filled(kind: Any, **fields: Any) -> Any:
    """One of `PARTS` from its fields, as arrays of their declared types."""
    parts = []
    for name, dtype, ndim, _ in layout(kind):
        value = np.ascontiguousarray(fields[name], dtype) if ndim else fields[name]
        parts.append(value if np.ndim(value) == ndim else value.reshape((0,) * ndim))
    return kind(*parts)


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
        if compiled.inertial:
            raise NotImplementedError(
                "the rates of inertial pads are not compiled for single states; use `rig.forward`"
            )
        self._system, self._limits = compiled.system(1.0), LIMITS
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
            self._work.u_dot[:] = 0.0
            found = self._solve(t, y, out)
        if self._followed.error is not None:
            raise self._followed.error
        if not found:
            self._work.u_dot[:] = 0.0
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
