"""The rig of a file as the subject of a dataset: any number of its tables may be drawn."""

import base64
import itertools
import re
import shutil
import weakref
from collections.abc import Iterator, Mapping
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic.fields import FieldInfo

from torchsoft.datasets.schema import Label
from torchsoft.datasets.subject import (
    RTOL,
    Begun,
    Subject,
    Task,
    rounded,
    split,
    stated_steps,
)
from torchsoft.files import check_file
from torchsoft.physics.energy import stores
from torchsoft.physics.parts import COORDINATES, PD, Actuator
from torchsoft.physics.rig import Rig
from torchsoft.quantity import metadata, quantity
from torchsoft.rigs import places
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import NumberOr
from torchsoft.rigs.places import Place, replaced
from torchsoft.solve.progress import Integrals
from torchsoft.solve.trajectory import channels, units
from torchsoft.tables import line, read_toml, shown

EMBEDDED = 2e6
"""Size [B] of all files that a rig file names, at the most: they are part of the configuration."""

OWN = {"title": "title", "outputs": "duration and sample_interval", "solver": "rtol and step"}
"""Tables of a rig file that have no part in a dataset, and what stands in their place there."""

MIDDLE = 0.5
"""Where other numbers are while the ends of one are tried."""


def embedded(tree: Any, folder: Path) -> Any:
    """The configuration with the rig file that it names in it, and the files that this one names.
    Raises `ValueError` naming the file, and `OSError`."""
    name = tree.get("rig") if isinstance(tree, Mapping) else None
    if name is None:
        return tree
    if not isinstance(name, str):
        raise ValueError(f"rig should be the name of a rig file, not {shown(name)}")
    path, contents = folder / name, dict[str, str]()
    RigFile.from_toml(path)

    def stored(file: str) -> str:
        data = check_file(path.parent / file, EMBEDDED).read_bytes()
        own = f"{sha256(data).hexdigest()[:16]}{Path(file).suffix}"
        contents[own] = base64.b64encode(data).decode()
        if (total := sum(map(len, contents.values()))) > EMBEDDED:
            raise ValueError(
                f"{path}: the files that it names have {total / 1e6:.3g} MB in base 64, but a "
                f"dataset's configuration holds {EMBEDDED / 1e6:g} MB at most; take smaller ones"
            )
        return own

    rig = places.files_renamed(read_toml(path), stored)
    return {**tree, "rig": rig} | ({"files": contents} if contents else {})


def outputs_of(rig: Any) -> dict[str, Any]:
    """Times of a dataset that are those of the rig file, as far as it states them."""
    outputs = rig.get("outputs")
    given = outputs if isinstance(outputs, Mapping) else {}
    named = {"duration": given.get("duration"), "sample_interval": given.get("interval", 0.01)}
    return {name: x for name, x in named.items() if x is not None}


def place(file: RigFile, name: str) -> Place:
    """The place of a name in the rig file of a dataset. Raises `ValueError` for one that leads
    nowhere, and for what the dataset decides."""
    found = places.place(file, name)
    if (own := OWN.get(str(found.keys[0]))) is not None:
        raise ValueError(f"`{line(name, 80)}` has no part in a dataset, whose own {own} decide it")
    return found


class RigOfFile(Subject):
    """Runs of the rig of a file. Parameters are any of its numbers, by the names of its tables;
    what moves are its own motions, whose numbers are among them."""

    @cached_property
    def _folder(self) -> Path:
        """The files that the rig file names, as long as this object is there."""
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
        """The rig file with the times of the dataset and what is fixed. Raises `ValueError`."""
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
        for name, value in config.fixed.items():
            try:
                place(file, name)
                file = replaced(file, {name: value})
            except ValueError as error:
                raise ValueError(f"fixed.{line(name, 80)}: {error}") from None
        return file

    @cached_property
    def template(self) -> Rig:  # pyright: ignore[reportIncompatibleVariableOverride]
        try:
            return self.file.assemble()
        except ValueError as error:
            raise ValueError(f"rig: {error}") from None

    @cached_property
    def there(self) -> dict[str, Label]:
        """Every channel of the rig."""
        rig = self.template
        nothing = torch.zeros(len(rig.signals), 2, dtype=torch.float64)
        state = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64), nothing)
        moments = {name: torch.zeros((), dtype=torch.float64) for name in rig.pads}
        with torch.no_grad():
            known = channels(rig, state, nothing, moments)
        meanings, of = dict(channel_meanings(rig)), units(rig)
        return {key: Label(of[key], meanings[key]) for key in known}

    @property
    def signals(self) -> dict[str, Label]:  # pyright: ignore[reportIncompatibleVariableOverride]
        kept = self.config.channels
        return self.there if kept is None else {name: self.there[name] for name in kept}

    def columns(self) -> dict[str, tuple[tuple[str, ...], NDArray[np.float64], str, str]]:
        out = {}
        for pad, name in self.surfaces.items() if self.config.nodal else ():
            at, surface = own_points(self.template, pad), f"{name}_point"
            along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1)))
            out[surface] = (
                (surface,), along, "m",
                f"way along the surface of the {name} pad from its first contact point, undeformed",
            )  # fmt: skip
            out[f"{name}_places"] = (
                (surface, "axis"), at, "m",
                f"places of the contact points in the {name} pad's own frame, undeformed",
            )  # fmt: skip
        return out

    @property
    def labels(self) -> dict[str, Label]:
        return {name: self._label(name) for name in self.config.parameters}

    def _label(self, name: str) -> Label:
        keys, _, field = place(self.file, name)
        declared = quantity(hint(field)) or number_or_word(field)
        unit = declared.unit if declared else "1"
        if re.search(r",| or ", unit):  # it depends on what the number is of
            unit = self._unit_of(name, keys) or unit
        said = f": {field.description}" if isinstance(keys[-1], str) and field.description else ""
        return Label(unit, f"parameter {name} of the rig file{said}")

    def _unit_of(self, name: str, keys: tuple[Any, ...]) -> str | None:
        """Unit of a number whose field takes several: of a motion, or of a gain."""
        group, part, *way = keys
        if group == "motion":
            return self.file.unit(part)
        if group == "controllers" and way[:1] == ["gain"]:
            one, (row, column) = self.file.controllers[part], way[1:]
            n = len(one.measures)
            pushed = one.pushes[row]
            loop = Actuator(one.measures[column % n], pushed, PD(1.0, 1.0), setpoint=part)
            return loop.gain_unit(column >= n)
        known = self.template.quantity(name) if name in self.template.aliases else None
        return known and known.unit

    @property
    def constants(self) -> dict[str, Any]:
        rig = self.template
        names = {own: name for name, own in rig.aliases.items()}
        parameters: dict[str, Any] = rig.description()["parameters"]
        values = {names.get(own, own): x for own, x in parameters.items()}
        return {name: x for name, x in values.items() if name not in self.config.parameters}

    @property
    def drawn(self) -> int:
        return max(1, len(self.config.parameters))

    @property
    def steps(self) -> dict[str, Any]:
        solver = self.file.solver.model_dump(exclude_unset=True, exclude_none=True)
        stated = stated_steps(self.config)
        own = {name: x for name, x in solver.items() if name != "tolerance"}
        return {"tolerance": self.file.solver.tolerance} | (stated or own or {"rtol": RTOL})

    def values(self, drawn: Mapping[str, float]) -> dict[str, float]:
        """Parameters by name, of what is drawn for each: the number, or its ratio to another."""
        out = dict(drawn)
        for name, one in self.config.parameters.items():
            if (base := one.ratio_to) is not None:
                of = drawn[base] if base in drawn else place(self.file, base).value
                out[name] = drawn[name] * of
        return out

    def task(self, index: int, u: list[float]) -> Task:
        drawn = zip(self.config.parameters.items(), u)
        values = self.values({name: one.at(x) for (name, one), x in drawn})
        return Task(index, values, values | {"split": split(self.config, index)})

    def begin(self, task: Task) -> Begun:
        rig, y0, _ = replaced(self.file, task.given).build()
        return Begun(rig, rounded(rig, y0), rig.reference, {})

    def check(self) -> None:
        config, names = self.config, list(self.config.parameters)
        if not names and config.trajectories > 1:
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
        for name in names:
            self._check_number(name)
        self._check_ends()
        for name in self.variables:
            if "/" in name:
                raise ValueError(f"`{line(name, 80)}` cannot be the name of an array; it has a `/`")

    def _check_number(self, name: str) -> None:
        """Raises `ValueError` for a name that is no number, and for a ratio to none."""
        where, parameters = f"parameters.{line(name, 80)}", self.config.parameters
        if name in self.config.fixed:
            raise ValueError(f"{where} is in `fixed` as well; leave one of them out")
        try:
            _, value, field = place(self.file, name)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        if isinstance(value, int):
            raise ValueError(f"{where} must be the same in every trajectory; set it in `fixed`")
        word = isinstance(value, str) and number_or_word(field)
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

    def _check_ends(self) -> None:
        """Raises `ValueError` where ends of distributions are impossible, each alone and those of
        one table or ratio together, the others in their middle."""
        parameters = self.config.parameters
        middle = {name: one.at(MIDDLE) for name, one in parameters.items()}
        ends = {name: one.ends(f"parameters.{name}") for name, one in parameters.items()}
        single = [(name, where) for name, some in ends.items() for where in some]

        def check(tried: Mapping[str, str], alone: bool = False) -> None:
            drawn = {name: ends[name][where] for name, where in tried.items()}
            values = self.values(middle | drawn)
            own = {name: values[name] for name in tried} if alone else values
            if (why := self._impossible(own)) is not None:
                said = ", ".join(f"{tried[name]} = {x:g}" for name, x in drawn.items())
                raise ValueError(f"{said or 'parameters in their middle'}: {why}")

        if self._impossible(self.values(middle)) is not None:
            for name, where in single:
                check({name: where}, alone=True)
            check({})
        for name, where in single:
            check({name: where})
        tables = {name: place(self.file, name).keys[:2] for name in parameters}
        for one, other in itertools.combinations(parameters, 2):
            related = {parameters[one].ratio_to, parameters[other].ratio_to} & {one, other}
            if related or tables[one] == tables[other]:
                for a, b in itertools.product(extremes(ends[one]), extremes(ends[other])):
                    check({one: a, other: b})

    def _impossible(self, values: Mapping[str, float]) -> str | None:
        """Why the rig file cannot have these values, or what they change that all trajectories
        share."""
        try:
            rig = replaced(self.file, values).assemble()
        except ValueError as error:
            return f"impossible: {error}"
        change = differs(self.template, rig)
        return change and f"it changes {change}, which all trajectories share; set it in `fixed`"


def extremes(ends: Mapping[str, float]) -> tuple[str, str]:
    """The least and the largest of some numbers, by what messages call them."""
    return min(ends, key=lambda where: ends[where]), max(ends, key=lambda where: ends[where])


def hint(field: FieldInfo) -> Any:
    """The annotation of a field."""
    return Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


def number_or_word(field: FieldInfo) -> NumberOr | None:
    """What a field says that takes a number or a word."""
    return next((one for one in metadata(hint(field)) if isinstance(one, NumberOr)), None)


def own_points(rig: Rig, name: str) -> NDArray[np.float64]:
    """Places (points, 2) [m] of a pad's contact points in its own frame."""
    pad = rig.pads[name]
    surface = pad.mesh.nodes[pad.mesh.free[pad.mesh.surface]]
    return np.einsum("pk,pkj->pj", pad.point_shares, surface[pad.point_nodes])


def differs(one: Rig, other: Rig) -> str | None:
    """What two rigs do not have in common of what the arrays of a dataset are made for."""
    for name in one.pads:
        a, b = own_points(one, name), own_points(other, name)
        if a.shape != b.shape or np.abs(a - b).max() > 1e-12:
            return f"the contact points of pads.{name}"
        if one.pads[name].state_shape != other.pads[name].state_shape:
            return f"the state of pads.{name}"
    for kind in (units, stores, lambda rig: Integrals(rig).active, lambda rig: rig.layout.free):
        if kind(one) != kind(other):
            return "the coordinates and energies of the rig"
    return None


def channel_meanings(rig: Rig) -> Iterator[tuple[str, str]]:
    """Every channel that a rig may have, and what it is."""
    rates = ("v_x", "v_y", "omega")
    for name, symbol in rig.symbols.items():
        for axis, rate in zip(COORDINATES, rates):
            what = f"{axis} of the centre of mass of {name}"
            what = f"rotation of {name}, anticlockwise" if axis == "theta" else what
            yield f"{axis}_{symbol}", what
            yield f"{rate}_{symbol}", f"rate of {axis} of {name}"
        yield f"L_{symbol}", f"angular momentum of {name}"
    for name in rig.signals:
        yield name, f"motion {name}"
        yield f"{name}_dot", f"rate of the motion {name}"
    for name, actuator in rig.actuators.items():
        yield f"F_{name}", f"effort of the actuator {name} on {actuator.pushes}"
    for name in rig.pads:
        yield f"M_{name}", f"moment of the pad {name} about the centre of its base"
