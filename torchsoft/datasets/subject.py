"""The subject of a dataset: the rig of a file, the drawn parameters, and the rig of each
trajectory."""

import base64
import shutil
import weakref
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsoft.datasets import schema
from torchsoft.datasets.bounds import Drawn
from torchsoft.datasets.distributions import Kind, in_ratio
from torchsoft.datasets.fields import Fields
from torchsoft.datasets.rig_files import place
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.fields import at_field
from torchsoft.tables import line

RTOL = 1e-4
"""Default relative tolerance of the stepper: coarse, since data are not differentiated."""

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)

SPLITS = ("train", "validation", "test")

POSITION, NODAL_FORCE = 10, 8
"""Decimals that starting poses and displacements [m] and nodal forces [N] are rounded to: linear
solvers differ in the last bits with the alignment of memory, and a run may amplify that."""

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
        outputs = {
            "duration": config.duration, "interval": config.sample_interval, "snapshots": (),
        }  # fmt: skip
        with at_field("rig"):
            file = RigFile.from_tree(config.rig, self._folder).override(outputs=outputs)
        return with_fixed(file, config.fixed, "fixed")

    @cached_property
    def kinds(self) -> list[Drawn]:
        """The rig file of every kind, with its `fixed` parameters, and its distributions."""
        config, out = self.config, list[Drawn]()
        for i, kind in enumerate(config.kinds or (Kind(name="any"),)):
            file = with_fixed(self.file, kind.fixed, f"kinds.{i}.fixed")
            parameters, fixed = config.parameters | kind.parameters, config.fixed | kind.fixed
            out.append(Drawn(self.template, file, parameters, fixed, f"kinds.{i}."))
        return out

    @cached_property
    def template(self) -> Rig:
        """A rig with the parts and meshes that all trajectories share."""
        file = self.file  # which names the field of its own errors
        with at_field("rig"):
            return file.assemble()

    @cached_property
    def variables(self) -> dict[str, schema.Variable]:
        """Every array of the dataset but its coordinates, by name. Raises `ValueError`."""
        return schema.variables(self.config, self.file, self.template)

    @property
    def channels(self) -> dict[str, schema.Variable]:
        """Channels that the dataset keeps."""
        return schema.kept_channels(self.config, self.template)

    def not_finite(self, row: Row) -> list[str]:
        """Names of arrays with numbers that are not finite, in a trajectory that is not marked as
        failed."""
        numbers = [name for name, one in self.variables.items() if one.kept.kind == "f"]
        known = [] if row["failed"] else [name for name in numbers if name != "failure_time"]
        return [name for name in known if not np.isfinite(row[name]).all()]

    @property
    def constants(self) -> dict[str, Any]:
        """Parameters that all trajectories share, by name."""
        values: dict[str, Any] = self.template.description()["parameters"]
        return {name: x for name, x in values.items() if name not in self.config.parameters}

    @property
    def dimensions(self) -> int:
        """Dimensions of the design."""
        most = max(len(one.parameters) for one in self.kinds)
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
        of = self.kinds[kind]
        drawn = {name: one.at(x) for (name, one), x in zip(of.parameters.items(), at)}
        values = in_ratio(of.file, of.parameters, drawn)
        labels: Row = {name: values[name] for name in config.parameters}
        labels |= {"kind": config.kinds[kind].name} if config.kinds else {}
        return Task(index, kind, values, labels | {"split": split(config, index)})

    def begin(self, task: Task) -> tuple[Rig, Tensor]:
        """The rig of a trajectory, ready to run, and its initial state (size,). Raises the errors
        of its static equilibrium."""
        rig, y0, _ = self.kinds[task.kind].file.override(task.values).build()
        return rig, rounded(rig, y0)

    def check(self) -> None:
        """Raises `ValueError` with the field's name for an impossible configuration."""
        config = self.config
        if not (config.parameters or config.kinds) and config.trajectories > 1:
            raise ValueError(
                "parameters is missing: nothing would differ between trajectories of the rig file"
            )
        there = schema.channels(self.template)
        for name in config.channels or ():
            if name not in there:
                raise ValueError(
                    f"channels: `{line(name, 80)}` is no channel of the rig; there are "
                    f"{', '.join(there)}"
                )
        for field, names in (
            ("channels", config.channels or ()),
            ("kinds", [one.name for one in config.kinds]),
        ):
            if len(set(names)) < len(names):
                raise ValueError(f"{field}: every name once")
        Drawn(self.template, self.file, config.parameters, config.fixed, "").check(
            config.parameters
        )
        for kind, drawn in zip(config.kinds, self.kinds):
            drawn.check(kind.parameters)
        self.variables  # noqa: B018 -- raises


def with_fixed(file: RigFile, fixed: Mapping[str, Any], where: str) -> RigFile:
    """The rig file with these values set. Raises `ValueError`."""
    for name, value in fixed.items():
        with at_field(f"{where}.{line(name, 80)}"):
            place(file, name)
            file = file.override({name: value})
    return file


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
