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

from torchsoft.physics.contact import Friction
from torchsoft.physics.mesh import banded, dofs_of, unit_loads
from torchsoft.physics.motion import Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.physics.validity import (
    check_array,
    check_groups,
    check_shape,
    check_slip,
    check_values,
    slip_rates,
)
from torchsoft.solve.kernel.arrays import (
    GAMMA,
    Actuators,
    Bodies,
    Contacts,
    Inertia,
    Pads,
    Points,
    system,
)
from torchsoft.solve.kernel.table import Index
from torchsoft.solve.laws import LawSet, actuator_law, contact_laws, structure

NOMINAL = 1e-3
"""Stage length a h [s] with which slip laws of one's own are tried."""


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
        gravity_at = self._add(rig.gravity)
        mass_at = [[self._add(mass) for mass in body.masses] for body in rig.bodies.values()]
        self._bodies = self._make_bodies(gravity_at, mass_at)
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
        return self._add(
            torch.cat(
                [torch.zeros(0).double(), *(value.reshape(-1) for value in parameters.values())]
            )
        )

    def _make_bodies(self, gravity_at: int, mass_at: list[list[int]]) -> Bodies:
        rig, free, signal, coordinate, masses, weight = self.rig, [], [], [], [], []
        fixed = len(rig.signals)
        for b, (name, body) in enumerate(rig.bodies.items()):
            for i, axis in enumerate(COORDINATES):
                kind = body.freedom[axis]
                free.append(len(coordinate) if kind == "free" else -1)
                signal.append(
                    rig.signals.index(f"{name}.{axis}")
                    if kind == "driven"
                    else fixed
                    if kind == "fixed"
                    else -1
                )
                fixed += kind == "fixed"
                if kind == "free":
                    coordinate.append(3 * b + i)
                    masses.append(mass_at[b][i])
                    weight.append(float(axis == "y" and body.weighted))
        slices = self.layout.slices
        starts = [
            min((s.start for (part, _), s in slices.items() if part == kind), default=0)
            for kind in ("pose", "velocity")
        ]
        return Bodies(
            _ints([*free, -1, -1, -1]), _ints([*signal, -1, -1, -1]), _ints(coordinate),
            _ints(masses), np.array(weight), gravity_at, *starts,
        )  # fmt: skip

    @property
    def inertial(self) -> bool:
        """Whether any pad has inertia; the arrays then belong to one step."""
        return len(self._inertia.X) > 0

    @property
    def signal_count(self) -> int:
        """How many signals the kernels follow, fixed coordinates included."""
        return len(self.rig.signals) + sum(len(body.fixed) for body in self.rig.bodies.values())

    @independent()
    def signals(self, t: Tensor, reference: Reference | None = None) -> Tensor:
        """The signals that the kernels follow, fixed coordinates last: values and rates (...,
        signals, 2)."""
        fixed = [
            body.fixed[axis]
            for body in self.rig.bodies.values()
            for axis in COORDINATES
            if axis in body.fixed
        ]
        followed = self.rig.follow(t, reference)
        if not bool(torch.isfinite(followed).all()):
            bad = torch.nonzero(~torch.isfinite(followed))[0].tolist()
            name, time = self.rig.signals[bad[-2]], float(t[tuple(bad[:-2])])
            raise ValueError(
                f"the signal `{name}` of the reference is not finite at t = {time:g} s"
            )
        used = self.rig.reference if reference is None else reference
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
        rig, slices = self.rig, self.layout.slices
        rows: dict[str, list[Any]] = {name: [] for name in Pads._fields}
        node_start, C_start, dofs, material_at = [0], [0], [0], []
        contact_pads = [list(rig.pads).index(contact.pad) for contact in rig.contacts.values()]
        columns = np.full((len(rig.pads), len(self._bodies.coordinate)), -1, np.int64)
        for number, (name, pad) in enumerate(rig.pads.items()):
            material, n = pad.material, len(pad.mesh.surface)
            fractions, times = pad.chain()
            rows["base"].append(
                3 * (len(rig.bodies) if pad.base is None else list(rig.bodies).index(pad.base))
            )
            rows["branches"].append(len(fractions))
            rows["chain_at"].append(self._add(fractions))
            self._add(times)
            if pad.inertial:
                lame_lambda, lame_mu = pad.lame()
                density = material.rho * material.depth
                material_at.append(
                    self._add(
                        torch.stack(
                            (
                                material.depth * lame_lambda,
                                material.depth * lame_mu,
                                times[0],
                                density,
                            )
                        )
                    )
                )
            else:
                material_at.append(
                    self._add(torch.stack((1 / (pad.E * material.depth), material.nu)))
                )
            rows["y_start"].append(slices["pads", name].start)
            rows["v_start"].append(slices["rates", name].start if pad.inertial else -1)
            node_start.append(node_start[-1] + n)
            C_start.append(C_start[-1] + 4 * n * n)
            dofs.append(dofs[-1] + (2 * pad.nodes if pad.inertial else 0))
            involved = {
                3 * list(rig.bodies).index(c.body) for c in rig.contacts.values() if c.pad == name
            } | {rows["base"][-1]}
            mine = [i for i, c in enumerate(self._bodies.coordinate) if c // 3 * 3 in involved]
            columns[number, mine] = np.arange(len(mine))
        points = np.cumsum([0, *rig.point_counts.values()])
        point_start = points[np.searchsorted(contact_pads, np.arange(len(rig.pads) + 1))]
        C, dC, reach = np.zeros(C_start[-1]), np.zeros(C_start[-1]), []
        for i, pad in enumerate(rig.pads.values()):
            if pad.inertial:
                reach.append(0.0)
                continue
            with torch.no_grad():
                unit, by_nu = pad.unit_compliance()
                C[C_start[i] : C_start[i + 1]] = unit.numpy().ravel()
                dC[C_start[i] : C_start[i + 1]] = by_nu.numpy().ravel()
            reach.append(1.5 * np.abs(C[C_start[i] : C_start[i + 1]]).max())
        pads = Pads(
            _ints(rows["base"]), _ints(node_start), _ints(point_start), _ints(rows["y_start"]),
            _ints(rows["v_start"]), _ints(rows["chain_at"]), _ints(rows["branches"]),
            _ints(C_start), C, dC, np.array(reach), columns, (columns >= 0).sum(1),
        )  # fmt: skip
        return pads, self._make_inertia(dofs, node_start, material_at)

    def _make_inertia(
        self, dofs: list[int], node_start: list[int], material_at: list[int]
    ) -> Inertia:
        total = dofs[-1]
        X, area, D = np.zeros(total), np.zeros(total), np.zeros((total, 2))
        moving = {i: pad for i, pad in enumerate(self.rig.pads.values()) if pad.inertial}
        both = {i: [pad.stiffness(1, 0), pad.stiffness(0, 1)] for i, pad in moving.items()}
        patterns = {
            i: sparse.csr_array(abs(K_lambda) + abs(K_mu)) for i, (K_lambda, K_mu) in both.items()
        }
        for pattern in patterns.values():
            pattern.eliminate_zeros()
        widest = max(
            (pattern.count_nonzero(axis=1).max() for pattern in patterns.values()), default=0
        )
        surface, column = (
            np.zeros(2 * node_start[-1], np.int64),
            np.zeros((total, widest), np.int64),
        )
        K = [np.zeros((total, widest)) for _ in range(2)]
        for i, pad in moving.items():
            here = slice(dofs[i], dofs[i + 1])
            X[here], area[here] = pad.positions.numpy().ravel(), np.repeat(pad.mesh.nodal_areas, 2)
            own = dofs_of(pad.surface.numpy())
            surface[2 * node_start[i] : 2 * node_start[i + 1]] = own
            stiffness, pattern = both[i], patterns[i]
            row = np.repeat(np.arange(here.stop - here.start), np.diff(pattern.indptr))
            at = dofs[i] + row, np.arange(len(row)) - pattern.indptr[row]
            column[at] = pattern.indices
            for k in range(2):
                K[k][at] = stiffness[k][row, pattern.indices]
        make: Any = Inertia
        return make(
            _ints(dofs), surface, np.zeros((1, total)), np.ones(len(dofs) - 1, np.int64), X, area,
            column, *K, D, np.zeros((len(dofs) - 1, 2, 2)), _ints(material_at),
        )  # fmt: skip

    def _make_actuators(self) -> Actuators:
        rig, rows, starts, setpoints, measured = self.rig, [], [], [], []
        for name, actuator in rig.actuators.items():
            parameters = {f"law.{k}": v for k, v in actuator.named_parameters()}
            law = actuator_law(name, actuator, parameters)
            starts.append(self._add_all(parameters))
            feed = (
                rig.signals.index(actuator.feed_forward)
                if actuator.feed_forward is not None
                else -1
            )
            rows.append((law.linearise, law.pullback, rig.coordinate(actuator.pushes), feed))
            setpoints.append([rig.signals.index(one) for one in actuator.setpoints])
            measured.append([rig.coordinate(one) for one in actuator.measures])
        linearise, pullback, pushed, feed_forward = (
            np.ascontiguousarray(x) for x in _ints(rows).reshape(-1, 4).T
        )
        make: Any = Actuators
        return make(
            linearise,
            pullback,
            _ints([*starts, self._count]),
            pushed,
            feed_forward,
            *_ragged(setpoints),
            *_ragged(measured),
        )

    def _make_contacts(self) -> tuple[Contacts, Points]:
        rig, rows, starts, point_start, sizes, limits = self.rig, [], [], [0], [], []
        X, weight, node, N = [], [], [], []
        for name, contact in rig.contacts.items():
            pad, shape = rig.pads[contact.pad], rig.shape_of(name)
            key = id(contact.law), id(shape)
            if key not in self._known:
                check_shape(contact.body, shape)
                slip = contact.law.friction
                own = structure(contact.law) is None or not isinstance(slip, Friction)
                stiffness = contact.law.R_t.item() + NOMINAL * contact.law.K_t.item()
                if own:
                    slip_rates(
                        name, slip, torch.ones(()).double(), torch.ones(()).double(), stiffness
                    )
                self._known[key] = contact_laws(contact.law, shape.prepared())
                if own and (wrong := check_slip(name, slip, stiffness)):
                    warnings.warn(wrong, stacklevel=2)
            laws = self._known[key]
            starts.append(self._add_all(laws.parameters))
            rows.append(
                (list(rig.pads).index(contact.pad), 3 * list(rig.bodies).index(contact.body),
                laws.distance.value,
                 laws.interface.linearise, laws.interface.pullback, laws.free.value,
                 laws.free.linearise, laws.free.pullback)
            )  # fmt: skip
            first = self._pads.node_start[rows[-1][0]]
            X.append(pad.point_positions.numpy())
            weight.append(rig.weight(name).detach().numpy())
            node.append(first + pad.point_nodes)
            N.append(pad.point_shares)
            point_start.append(point_start[-1] + len(pad.point_nodes))
            sizes.append(shape.size())
            corners = pad.placed(np.stack(np.meshgrid(*pad.mesh.space.T), -1).reshape(-1, 2))
            box = (
                *corners[:, 0][[corners[:, 0].argmin(), corners[:, 0].argmax()]],
                *np.sort(corners[:, 1])[[0, -1]],
            )
            limits.append((-np.inf, np.inf, -np.inf, np.inf) if contact.may_leave else box)
        columns = [np.ascontiguousarray(x) for x in _ints(rows).reshape(-1, 8).T]
        coordinate = np.stack((columns[1], self._pads.base[columns[0]]), 1)[..., None] + np.arange(
            3
        )
        coordinate = np.ascontiguousarray(coordinate.reshape(-1, 6))
        make: Any = Contacts
        contacts = make(
            *columns[:2],
            self._bodies.free[coordinate],
            coordinate,
            *columns[2:],
            _ints([*starts, self._count]),
            _ints(point_start),
            np.array(sizes),
            np.array(limits).reshape(-1, 4),
        )
        start = min(
            (s.start for (part, _), s in self.layout.slices.items() if part == "stretch"), default=0
        )
        points = Points(
            np.repeat(np.arange(len(rows)), np.diff(point_start)),
            np.concatenate([*X, np.zeros((0, 2))]), np.concatenate([*weight, np.zeros(0)]),
            np.concatenate([*node, np.zeros((0, 2), np.int64)]),
            np.concatenate([*N, np.zeros((0, 2))]), start,
        )  # fmt: skip
        return contacts, points

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


def _ragged(lists: list[list[int]]) -> tuple[Index, Index]:
    """The ends of lists that are put one after the other, and all their numbers."""
    return _ints([0, *np.cumsum([len(one) for one in lists])]), _ints(
        [number for one in lists for number in one]
    )


def _ints(values: Any) -> Index:
    return np.array(values, dtype=np.int64)
