"""Every array of a dataset: name, dimensions, unit, meaning and type."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchsoft.physics.energy import stores
from torchsoft.solve.progress import Integrals

if TYPE_CHECKING:
    from torchsoft.datasets.config import Config
    from torchsoft.datasets.subject import Subject


class Label(NamedTuple):
    """Unit, meaning and type of a channel, or of a number or text of every trajectory."""

    unit: str
    meaning: str
    dtype: str = "float64"


RUN = {
    "steps": Label("1", "steps of the stepper", "int64"),
    "newton_iterations": Label("1", "Newton iterations of all steps", "int64"),
    "energy_residual_rel": Label("1", "largest energy residual over the energy injected"),
    "failed": Label("1", "1 where the simulation failed: its series are NaN", "uint8"),
    "failure_time": Label("s", "when it failed; NaN where it did not, or could not begin"),
    "reason": Label("1", "why it failed; empty where it did not", "str"),
}
SPLIT = {"split": Label("1", "train, validation or test", "str")}
"""Labels of every trajectory of any rig."""

KIND = {"kind": Label("1", "kind of trajectory", "str")}
"""Label of datasets with several kinds."""


@dataclass(frozen=True)
class Variable:
    """One array; `components` names the entries of a last dimension that has no coordinate."""

    sizes: dict[str, int]
    unit: str
    meaning: str
    dtype: str = "float64"
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
        """The value that stands for an unknown."""
        return {"O": "", "f": np.nan}.get(self.kept.kind, 0)


def energies(subject: "Subject") -> dict[str, tuple[str, tuple[str, ...]]]:
    """Dimension and parts of each kind of energy, by its name in a run."""
    integrals = Integrals(subject.template)
    active = tuple(name for name in integrals.supplied if name in integrals.active)
    return {
        "stored": ("store", stores(subject.template)),
        "dissipated": ("resistor", integrals.dissipated),
        "supplied": ("source", active),
    }


def nodal(subject: "Subject") -> dict[str, Variable]:
    """Arrays of every contact point: forces by contact, displacements by pad."""
    config, rig, out = subject.config, subject.template, dict[str, Variable]()
    series = {"trajectory": config.trajectories, "time": config.samples}
    precision = config.node_precision
    for pad, touching in subject.surfaces.items():
        point = "contact point" if rig.pads[pad].points else "surface node"
        per = f"each {point} of the {pad} pad"
        where = series | {f"{pad}_point": len(rig.pads[pad].point_nodes)}
        for name in touching:
            out[f"normal_force_{name}"] = Variable(where, "N", f"normal force at {per}", precision)
            out[f"friction_force_{name}"] = Variable(
                where, "N", f"friction force at {per}", precision
            )
            body = rig.contacts[name].body
            meaning = f"1 where the {body} penetrates {per}, else 0"
            out[f"contact_{name}"] = Variable(where, "1", meaning, "uint8")
        meaning = f"displacement of {per}"
        out[f"displacement_{pad}"] = Variable(where | {"axis": 2}, "m", meaning, precision)
    return out


def arrays(subject: "Subject") -> dict[str, Variable]:
    """Every array of the dataset by name. Raises `ValueError` for a name that two arrays would
    share."""
    config, out = subject.config, dict[str, Variable]()
    single = {"trajectory": config.trajectories}
    series = single | {"time": config.samples}
    for name, one in subject.signals.items():
        out[name] = Variable(series, *one)
    more = nodal(subject) if config.nodal else {}
    for kind, (dimension, parts) in energies(subject).items():
        meaning = "energy stored" if kind == "stored" else f"{kind} since t = 0"
        more[f"{kind}_energy"] = Variable(
            series | {dimension: len(parts)}, "J", meaning, components=parts
        )
    more["injected_energy"] = Variable(
        series, "J", "positive part of what the sources supplied since t = 0"
    )
    more["energy_residual"] = Variable(series, "J", "stored - supplied + dissipated since t = 0")
    labels = (subject.labels, RUN, KIND if config.kinds else {}, SPLIT)
    rows = [
        more,
        *({name: Variable(single, *one) for name, one in some.items()} for some in labels),
    ]
    coordinates = {"time", "trajectory", "axis", *subject.columns()}
    for some in rows:
        for name, variable in some.items():
            if name in out:
                raise ValueError(taken(name))
            out[name] = variable
    if twice := sorted(coordinates & out.keys()):
        raise ValueError(taken(twice[0]))
    return out


def taken(name: str) -> str:
    return (
        f"two arrays of the dataset would be called `{name}`; call the body's symbol, the "
        "actuator, the contact or the motion otherwise in the rig file"
    )


def variables(config: "Config") -> dict[str, Variable]:
    """Every array of the dataset by name."""
    return config.subject.variables


def not_finite(config: "Config", row: dict[str, Any]) -> list[str]:
    """Names of arrays with numbers that are not finite, in a trajectory that is not marked as
    failed."""
    known = (
        name
        for name, v in variables(config).items()
        if v.kept.kind == "f" and name != "failure_time"
    )
    return [] if row["failed"] else [name for name in known if not np.isfinite(row[name]).all()]
