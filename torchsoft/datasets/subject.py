"""The subject of a dataset: the rig of a file, the drawn parameters, and the rig of each
trajectory."""

import base64
import itertools
import shutil
import weakref
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.datasets.distributions import Distribution, Kind
from torchsoft.datasets.fields import Fields
from torchsoft.datasets.rig_files import (
    differs,
    own_points,
    place,
)
from torchsoft.datasets.schema import KIND, RUN, SPLIT, Label, Variable
from torchsoft.physics.channels import declared
from torchsoft.physics.energy import Integrals, stores
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.initial import reference
from torchsoft.rigs.places import unit
from torchsoft.tables import line, shown

RTOL = 1e-4
"""Default relative tolerance of the stepper: coarse, since data are not differentiated."""

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)

SPLITS = ("train", "validation", "test")

POSITION, NODAL_FORCE = 10, 8
"""Decimals that starting poses and displacements [m] and nodal forces [N] are rounded to: linear
solvers differ in the last bits with the alignment of memory, and a run may amplify that."""

MIDDLE = 0.5
"""Quantile of the other parameters while the bounds of one are tried."""

Row = dict[str, Any]


class Task(NamedTuple):
    """One trajectory: its index, the index of its kind, parameters of the rig file by name, and the
    labels known before the simulation."""

    index: int
    kind: int
    values: dict[str, float]
    labels: Row


class Subject:
    """The rig file of a configuration and the trajectories made from it. Any number of the rig file
    can be a parameter, by the names of its tables, those of its motions included."""

    def __init__(self, config: Fields) -> None:
        self.config = config

    @cached_property
    def _folder(self) -> Path:
        """A temporary folder with the files that the rig file names; it lives as long as this
        object."""
        if not self.config.files:
            return Path()
        folder = Path(mkdtemp(prefix="torchsoft-rig-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        for name, data in self.config.files.items():
            try:
                (folder / Path(name).name).write_bytes(base64.b64decode(data, validate=True))
            except ValueError:
                raise ValueError(f"files.{line(name, 80)} is not base 64") from None
        return folder

    @cached_property
    def file(self) -> RigFile:
        """The rig file with the times and the `fixed` parameters of the dataset. Raises
        `ValueError`."""
        config = self.config
        try:
            file = RigFile.from_tree(config.rig, self._folder).override(
                outputs={
                    "duration": config.duration, "interval": config.sample_interval,
                    "snapshots": (),
                }
            )  # fmt: skip
        except ValueError as error:
            raise ValueError(f"rig: {error}") from None
        return with_fixed(file, config.fixed, "fixed")

    @cached_property
    def kinds(self) -> list[tuple[RigFile, dict[str, Distribution]]]:
        """The rig file of every kind, with its `fixed` parameters, and its distributions."""
        config = self.config
        return [
            (
                with_fixed(self.file, kind.fixed, f"kinds.{i}.fixed"),
                config.parameters | kind.parameters,
            )
            for i, kind in enumerate(config.kinds or (Kind(name="any"),))
        ]

    @cached_property
    def template(self) -> Rig:
        """A rig with the parts and meshes that all trajectories share."""
        try:
            return self.file.assemble()
        except ValueError as error:
            raise ValueError(f"rig: {error}") from None

    @cached_property
    def there(self) -> dict[str, Label]:
        """Every channel of the rig."""
        return {one.name: Label(one.unit, one.meaning) for one in declared(self.template)}

    @property
    def signals(self) -> dict[str, Label]:
        """Channels that the dataset keeps."""
        kept = self.config.channels
        return self.there if kept is None else {name: self.there[name] for name in kept}

    @cached_property
    def surfaces(self) -> dict[str, list[str]]:
        """Pads that have contacts, and their contacts."""
        out: dict[str, list[str]] = {}
        for name, one in self.template.contacts.items():
            out.setdefault(one.pad, []).append(name)
        return {name: out[name] for name in self.template.pads if name in out}

    @cached_property
    def energies(self) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Dimension and parts of each kind of energy, by its name in a run."""
        integrals = Integrals(self.template)
        return {
            "stored": ("store", tuple(stores(self.template))),
            "dissipated": ("resistor", integrals.dissipated),
            "supplied": ("source", integrals.active),
        }

    def _nodal(self) -> dict[str, Variable]:
        """Arrays of every contact point: forces by contact, displacements by pad."""
        config, rig, out = self.config, self.template, dict[str, Variable]()
        series = {"trajectory": config.trajectories, "time": config.samples}
        precision = config.node_precision
        for pad, touching in self.surfaces.items():
            point = "contact point" if rig.pads[pad].points else "surface node"
            per = f"each {point} of the {pad} pad"
            where = series | {f"{pad}_point": len(rig.pads[pad].point_nodes)}
            for name in touching:
                out[f"normal_force_{name}"] = Variable(
                    where, "N", f"normal force at {per}", precision
                )
                out[f"friction_force_{name}"] = Variable(
                    where, "N", f"friction force at {per}", precision
                )
                body = rig.contacts[name].body
                meaning = f"1 where the {body} penetrates {per}, else 0"
                out[f"contact_{name}"] = Variable(where, "1", meaning, "uint8")
            meaning = f"displacement of {per}"
            out[f"displacement_{pad}"] = Variable(where | {"axis": 2}, "m", meaning, precision)
        return out

    @cached_property
    def variables(self) -> dict[str, Variable]:
        """Every array of the dataset by its name. Raises `ValueError` for a name that two arrays
        would share."""
        config, out = self.config, dict[str, Variable]()
        single = {"trajectory": config.trajectories}
        series = single | {"time": config.samples}
        for name, one in self.signals.items():
            out[name] = Variable(series, *one)
        more = self._nodal() if config.nodal else {}
        for kind, (dimension, parts) in self.energies.items():
            meaning = "energy stored" if kind == "stored" else f"{kind} since t = 0"
            more[f"{kind}_energy"] = Variable(
                series | {dimension: len(parts)}, "J", meaning, components=parts
            )
        more["injected_energy"] = Variable(
            series, "J", "positive part of what the sources supplied since t = 0"
        )
        more["energy_residual"] = Variable(
            series, "J", "stored - supplied + dissipated since t = 0"
        )
        labels = (self.labels, RUN, KIND if config.kinds else {}, SPLIT)
        rows = [
            more,
            *({name: Variable(single, *one) for name, one in some.items()} for some in labels),
        ]
        coordinates = {"time", "trajectory", "axis", *self.columns()}
        for some in rows:
            for name, variable in some.items():
                if name in out:
                    raise ValueError(taken(name))
                out[name] = variable
        if twice := sorted(coordinates & out.keys()):
            raise ValueError(taken(twice[0]))
        return out

    def not_finite(self, row: Row) -> list[str]:
        """Names of arrays with numbers that are not finite, in a trajectory that is not marked as
        failed."""
        known = (
            name
            for name, v in self.variables.items()
            if v.kept.kind == "f" and name != "failure_time"
        )
        return [] if row["failed"] else [name for name in known if not np.isfinite(row[name]).all()]

    def columns(self) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64], str, str]]:
        """Coordinates of the contact points: dimensions, values, unit and meaning."""
        out = {}
        for pad in self.surfaces if self.config.nodal else ():
            at, surface = own_points(self.template, pad), f"{pad}_point"
            along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1)))
            out[surface] = (
                (surface,), along, "m",
                f"way along the surface of the {pad} pad from its first contact point, undeformed",
            )  # fmt: skip
            out[f"{pad}_places"] = (
                (surface, "axis"), at, "m",
                f"places of the contact points in the {pad} pad's own frame, undeformed",
            )  # fmt: skip
        return out

    @property
    def labels(self) -> dict[str, Label]:
        """Labels of the drawn parameters of every trajectory."""
        return {name: self._label(name) for name in self.config.parameters}

    def _label(self, name: str) -> Label:
        keys, _, field = place(self.file, name)
        meaning = (
            f": {field.description}" if isinstance(keys[-1], str) and field.description else ""
        )
        return Label(self.file.unit_of(name), f"parameter {name} of the rig file{meaning}")

    @property
    def constants(self) -> dict[str, Any]:
        """Parameters that all trajectories share, by name."""
        values: dict[str, Any] = self.template.description()["parameters"]
        return {name: x for name, x in values.items() if name not in self.config.parameters}

    @property
    def drawn(self) -> int:
        """Dimensions of the design."""
        most = max(len(parameters) for _, parameters in self.kinds)
        return max(1, most + (1 if self.config.kinds else 0))

    @property
    def steps(self) -> dict[str, Any]:
        """Step control of `simulate`, as its keyword arguments."""
        given = {"step": self.config.step, "rtol": self.config.rtol}
        stated = {name: value for name, value in given.items() if value is not None}
        solver = self.file.solver.model_dump(exclude_unset=True, exclude_none=True)
        own = {name: x for name, x in solver.items() if name != "tolerance"}
        return {"tolerance": self.file.solver.tolerance} | (stated or own or {"rtol": RTOL})

    def task(self, index: int, u: NDArray[np.floating]) -> Task:
        """Trajectory `index` at the point u (dimensions,) of the design, whose entries are the
        common parameters, the kind, and the parameters of the kind."""
        config, kind, at = self.config, 0, u.tolist()
        if config.kinds:
            edges = np.cumsum([one.weight for one in config.kinds])
            which = at.pop(len(config.parameters)) * edges[-1]
            kind = min(int(np.searchsorted(edges, which, side="right")), len(edges) - 1)
        file, parameters = self.kinds[kind]
        drawn = {name: one.at(x) for (name, one), x in zip(parameters.items(), at)}
        values = in_ratio(file, parameters, drawn)
        labels: Row = {name: values[name] for name in config.parameters}
        labels |= {"kind": config.kinds[kind].name} if config.kinds else {}
        return Task(index, kind, values, labels | {"split": split(config, index)})

    def begin(self, task: Task) -> tuple[Rig, Tensor]:
        """The rig of a trajectory, ready to run, and its initial state (size,). Raises the errors
        of its static equilibrium."""
        rig, y0, _ = self.kinds[task.kind][0].override(task.values).build()
        return rig, rounded(rig, y0)

    def check(self) -> None:
        """Raises `ValueError` with the field's name for an impossible configuration."""
        config = self.config
        if not (config.parameters or config.kinds) and config.trajectories > 1:
            raise ValueError(
                "parameters is missing: nothing would differ between trajectories of the rig file"
            )
        for name in config.channels or ():
            if name not in self.there:
                raise ValueError(
                    f"channels: `{line(name, 80)}` is no channel of the rig; there are "
                    f"{', '.join(self.there)}"
                )
        if config.channels is not None and len({*config.channels}) < len(config.channels):
            raise ValueError("channels: every name once")
        if len({one.name for one in config.kinds}) < len(config.kinds):
            raise ValueError("kinds: every name once")
        Drawn(self, self.file, config.parameters, config.fixed, "").check(config.parameters)
        for i, (kind, (file, parameters)) in enumerate(zip(config.kinds, self.kinds)):
            drawn = Drawn(self, file, parameters, config.fixed | kind.fixed, f"kinds.{i}.")
            drawn.check([*kind.parameters, *(kind.fixed.keys() & config.parameters)])
        for name in self.variables:
            if "/" in name:
                raise ValueError(f"`{line(name, 80)}` cannot be the name of an array; it has a `/`")


class Drawn(NamedTuple):
    """The drawn and the fixed parameters of one kind, and the checks of them; messages begin with
    the table `where`."""

    subject: Subject
    file: RigFile
    parameters: Mapping[str, Distribution]
    fixed: Mapping[str, Any]
    where: str

    def check(self, names: Iterable[str]) -> None:
        """Raises `ValueError` for parameters that are not numbers, or impossible together."""
        for name in names:
            self._check_number(name)
        self._check_ends({*names})

    def _check_number(self, name: str) -> None:
        """Raises `ValueError` for a parameter that is not a number, or a ratio to something that is
        not."""
        where, parameters = f"{self.where}parameters.{line(name, 80)}", self.parameters
        if name in self.fixed:
            raise ValueError(f"{where} is in `fixed` as well; leave one of them out")
        try:
            _, value, field = place(self.file, name)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        if isinstance(value, int):
            raise ValueError(f"{where} must be the same in every trajectory; set it in `fixed`")
        word = isinstance(value, str) and unit(field)
        if not (value is None or isinstance(value, float) or word):
            raise ValueError(f"{where} is no number, but {shown(value)}")
        if (base := parameters[name].ratio_to) is None:
            return
        if base in parameters and parameters[base].ratio_to is None and base != name:
            return
        if base in parameters:
            raise ValueError(f"{where}.ratio_to: {line(base, 80)} is a ratio itself")
        try:
            of = place(self.file, base).value
        except ValueError as error:
            raise ValueError(f"{where}.ratio_to: {error}") from None
        if not isinstance(of, float):
            raise ValueError(f"{where}.ratio_to: {line(base, 80)} is no number, but {shown(of)}")

    def _check_ends(self, names: set[str]) -> None:
        """Raises `ValueError` where bounds of the distributions with these names are impossible:
        each bound alone, and pairs of bounds in one part or ratio; the other parameters are at
        their medians."""
        parameters, within = self.parameters, f"{self.where}parameters"
        middle = {name: one.at(MIDDLE) for name, one in parameters.items()}
        ends = {name: one.ends(f"{within}.{name}") for name, one in parameters.items()}
        single = [(name, where) for name in parameters if name in names for where in ends[name]]

        def check(tried: Mapping[str, str], alone: bool = False) -> None:
            drawn = {name: ends[name][where] for name, where in tried.items()}
            values = in_ratio(self.file, parameters, middle | drawn)
            own = {name: values[name] for name in self._tied(*tried)} if alone else values
            moves = {place(self.file, name).keys[0] for name in tried} == {"motion"}
            if (reason := self._impossible(own, moves)) is not None:
                drawn_ends = ", ".join(f"{tried[name]} = {x:g}" for name, x in drawn.items())
                raise ValueError(f"{drawn_ends or f'{within} in their middle'}: {reason}")

        if self._impossible(in_ratio(self.file, parameters, middle)) is not None:
            if (reason := self._impossible({})) is not None:
                raise ValueError(f"{f'{self.where}fixed' if self.where else 'rig'}: {reason}")
            for name, where in sorted(single, key=lambda one: parameters[one[0]].ratio_to is None):
                check({name: where}, alone=True)
            check({})
        for name, where in single:
            check({name: where})
        tables = {name: place(self.file, name).keys[:2] for name in parameters}
        for one, other in itertools.combinations(parameters, 2):
            related = {parameters[one].ratio_to, parameters[other].ratio_to} & {one, other}
            parts = tables[one] == tables[other] and tables[one][0] != "motion"
            if {one, other} & names and (related or parts):
                for a, b in itertools.product(extremes(ends[one]), extremes(ends[other])):
                    check({one: a, other: b})

    def _tied(self, *names: str) -> set[str]:
        """These parameters, the drawn ones that they are ratios to, and the ratios to them."""
        related = {self.parameters[name].ratio_to for name in names}
        ratios = {name for name, one in self.parameters.items() if one.ratio_to in names}
        return {*names} | {name for name in self.parameters if name in related} | ratios

    def _impossible(self, values: Mapping[str, float], moves: bool = False) -> str | None:
        """The reason why the rig file cannot have these values: they are impossible, or change
        something that all trajectories share. `moves` says that they belong to motions only."""
        template = self.subject.template
        try:
            file = self.file.override(values)
            rig = template if moves else file.assemble()
            none = torch.zeros(3, dtype=torch.float64)
            reference(file, dict.fromkeys(rig.bodies, none), lambda *_: none[0])
        except ValueError as error:
            return f"impossible: {error}"
        change = differs(template, rig)
        return change and f"it changes {change}, which all trajectories share; set it in `fixed`"


def taken(name: str) -> str:
    return (
        f"two arrays of the dataset would be called `{name}`; call the body's symbol, the "
        "actuator, the contact or the motion otherwise in the rig file"
    )


def with_fixed(file: RigFile, fixed: Mapping[str, Any], where: str) -> RigFile:
    """The rig file with these values set. Raises `ValueError`."""
    for name, value in fixed.items():
        try:
            place(file, name)
            file = file.override({name: value})
        except ValueError as error:
            raise ValueError(f"{where}.{line(name, 80)}: {error}") from None
    return file


def in_ratio(
    file: RigFile, parameters: Mapping[str, Distribution], drawn: Mapping[str, float]
) -> dict[str, float]:
    """Parameters by name from the drawn numbers, which are values or ratios to other parameters."""
    out = dict(drawn)
    for name, one in parameters.items():
        if (base := one.ratio_to) is not None:
            of = drawn[base] if base in drawn else place(file, base).value
            out[name] = drawn[name] * of
    return out


def extremes(ends: Mapping[str, float]) -> tuple[str, str]:
    """Names of the least and the largest of some numbers."""
    return min(ends, key=lambda where: ends[where]), max(ends, key=lambda where: ends[where])


def split(config: Fields, index: int) -> str:
    """Train, validation or test, by the golden-ratio sequence from a seeded start, so that small
    sets keep the fractions."""
    u = (np.random.default_rng((config.seed, 0)).random() + index * GOLDEN) % 1.0
    edges = (config.splits.train, config.splits.train + config.splits.validation)
    return SPLITS[int(np.searchsorted(edges, u, side="right"))]


def rounded(rig: Rig, y0: Tensor) -> Tensor:
    """The initial state (size,), rounded."""
    y0 = y0.detach().clone()
    for block, where, own in rig.layout.groups():
        if block.field not in ("friction", "control"):  # of any unit
            decimals = NODAL_FORCE if own == "N" else POSITION
            y0[where] = torch.round(y0[where], decimals=decimals) + 0.0  # no negative zeros
    return y0
