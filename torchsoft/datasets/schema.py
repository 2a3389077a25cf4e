"""The arrays of a dataset: dimensions, unit, meaning and type of each, as the rig and the
configuration decide them."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchsoft.datasets.fields import Fields
from torchsoft.datasets.rig_files import own_points, place
from torchsoft.physics.channels import declared
from torchsoft.physics.energy import names_of, stores
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.tables import line


class Variable(NamedTuple):
    """One array; `components` names the entries of a last dimension that has no coordinate."""

    unit: str
    meaning: str
    dtype: str = "float64"
    sizes: Mapping[str, int] = {}
    components: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.sizes.values())

    @property
    def kept(self) -> np.dtype[Any]:
        """Type in memory."""
        return np.dtype(object if self.dtype == "str" else self.dtype)

    @property
    def empty(self) -> Any:
        """The value of an unknown."""
        return {"O": "", "f": np.nan}.get(self.kept.kind, 0)


class Coordinate(NamedTuple):
    """Values of a dimension, or of several."""

    dimensions: tuple[str, ...]
    values: NDArray[Any]
    unit: str
    meaning: str


RUN = {
    "steps": Variable("1", "steps of the stepper", "int64"),
    "newton_iterations": Variable("1", "Newton iterations of all steps", "int64"),
    "energy_residual_rel": Variable("1", "largest energy residual over the energy injected"),
    "failed": Variable("1", "1 where the simulation failed: its series are NaN", "uint8"),
    "failure_time": Variable("s", "when it failed; NaN where it did not, or could not begin"),
    "reason": Variable("1", "why it failed; empty where it did not", "str"),
}
"""Results of every run."""

SPLIT = {"split": Variable("1", "train, validation or test", "str")}
"""Label of every trajectory of any rig."""

KIND = {"kind": Variable("1", "kind of trajectory", "str")}
"""Label of datasets with several kinds."""


def variables(config: Fields, file: RigFile, rig: Rig) -> dict[str, Variable]:
    """Every array of a dataset but its coordinates, by name. Raises `ValueError` for a name that
    two arrays would share, or that no array can have."""
    single = {"trajectory": config.trajectories}
    series = single | {"time": config.samples}
    results = [RUN, KIND if config.kinds else {}, SPLIT]
    found = [
        *((name, one._replace(sizes=series)) for name, one in kept_channels(config, rig).items()),
        *(nodal(rig, series, config.node_precision) if config.nodal else ()),
        *balance(rig, series),
        *((name, one._replace(sizes=single)) for name, one in parameters(config, file).items()),
        *((name, one._replace(sizes=single)) for part in results for name, one in part.items()),
    ]
    for name, count in Counter([*coordinates(config, rig), *(name for name, _ in found)]).items():
        if count > 1:
            raise ValueError(
                f"two arrays of the dataset would be called `{name}`; call the body's symbol, the "
                "actuator, the contact or the motion otherwise in the rig file"
            )
        if "/" in name:
            raise ValueError(f"`{line(name, 80)}` cannot be the name of an array; it has a `/`")
    return dict(found)


def channels(rig: Rig) -> dict[str, Variable]:
    """Every channel of a rig, one number each."""
    return {one.name: Variable(one.unit, one.meaning) for one in declared(rig)}


def kept_channels(config: Fields, rig: Rig) -> dict[str, Variable]:
    """Channels that the dataset keeps."""
    every, kept = channels(rig), config.channels
    return every if kept is None else {name: every[name] for name in kept}


def surfaces(rig: Rig) -> dict[str, list[str]]:
    """Pads that have contacts, and their contacts."""
    of = {pad: [name for name, one in rig.contacts.items() if one.pad == pad] for pad in rig.pads}
    return {pad: names for pad, names in of.items() if names}


def nodal(rig: Rig, series: Mapping[str, int], precision: str) -> Iterator[tuple[str, Variable]]:
    """Arrays of every contact point: forces by contact, displacements by pad."""
    for pad, contacts in surfaces(rig).items():
        point = "contact point" if rig.pads[pad].points else "surface node"
        each = f"each {point} of the {pad} pad"
        sizes = {**series, f"{pad}_point": len(rig.pads[pad].point_nodes)}
        for name in contacts:
            for kind in ("normal", "friction"):
                force = Variable("N", f"{kind} force at {each}", precision, sizes)
                yield f"{kind}_force_{name}", force
            meaning = f"1 where the {rig.contacts[name].body} penetrates {each}, else 0"
            yield f"contact_{name}", Variable("1", meaning, "uint8", sizes)
        meaning = f"displacement of {each}"
        yield f"displacement_{pad}", Variable("m", meaning, precision, sizes | {"axis": 2})


def energies(rig: Rig) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Dimension and parts of each kind of energy, by its name in a run."""
    return {
        "stored": ("store", tuple(stores(rig))),
        "dissipated": ("resistor", names_of(rig, "dissipated")),
        "supplied": ("source", names_of(rig, "supplied")),
    }


def balance(rig: Rig, series: Mapping[str, int]) -> Iterator[tuple[str, Variable]]:
    """Arrays of the energy balance."""
    for kind, (dimension, parts) in energies(rig).items():
        meaning = "energy stored" if kind == "stored" else f"{kind} since t = 0"
        sizes = {**series, dimension: len(parts)}
        yield f"{kind}_energy", Variable("J", meaning, sizes=sizes, components=parts)
    for name, meaning in (
        ("injected_energy", "positive part of what the sources supplied since t = 0"),
        ("energy_residual", "stored - supplied + dissipated since t = 0"),
    ):
        yield name, Variable("J", meaning, sizes=series)


def parameters(config: Fields, file: RigFile) -> dict[str, Variable]:
    """The drawn parameters of every trajectory, one number each."""
    out = {}
    for name in config.parameters:
        keys, _, field = place(file, name)
        described = isinstance(keys[-1], str) and field.description
        meaning = f"parameter {name} of the rig file{f': {described}' if described else ''}"
        out[name] = Variable(file.unit_of(name), meaning)
    return out


def coordinates(config: Fields, rig: Rig) -> dict[str, Coordinate]:
    """The coordinates of the arrays, by name."""
    out = dict[str, Coordinate]()
    times = np.arange(config.samples) * config.sample_interval
    out["time"] = Coordinate(("time",), times, "s", "time since the start")
    for pad in surfaces(rig) if config.nodal else ():
        places = own_points(rig, pad)
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
        meaning = f"way along the surface of the {pad} pad from its first contact point, undeformed"
        out[f"{pad}_point"] = Coordinate((f"{pad}_point",), along, "m", meaning)
        meaning = f"places of the contact points in the {pad} pad's own frame, undeformed"
        out[f"{pad}_places"] = Coordinate((f"{pad}_point", "axis"), places, "m", meaning)
    indices = np.arange(config.trajectories)
    meaning = "number of the trajectory in the design"
    out["trajectory"] = Coordinate(("trajectory",), indices, "1", meaning)
    axes = np.array(["x", "y"], np.dtypes.StringDType())
    out["axis"] = Coordinate(("axis",), axes, "1", "names of the axes")
    return out
