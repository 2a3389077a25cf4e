"""Every array of a dataset: name, dimensions, unit, meaning and type."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchsoft.channels import CHANNELS
from torchsoft.datasets.config import RATIO, Config
from torchsoft.paper.parameters import Parameters

KEPT = tuple(name for name in CHANNELS if name not in ("t", "angular_momentum"))
"""Channels that a dataset keeps of every trajectory."""

PADS = {"L": "lower", "U": "upper"}
"""Pads by their names, in words."""

STORES = ("strain_L", "strain_U", "normal_springs", "tangential_springs", "disc", "spin", "bracket")

SERIES = ("trajectory", "time")

SINGLE = {
    "grasp_depth": ("m", "set-point of the compression of both pads together in the grasp"),
    "grasp_force": ("N", "grasping force fed forward"),
    "steps": ("1", "steps of the stepper", "int64"),
    "newton_iterations": ("1", "Newton iterations of all steps", "int64"),
    "energy_residual_rel": ("1", "largest energy residual over the energy injected"),
    "failed": ("1", "1 where the simulation failed: its series are NaN", "uint8"),
    "failure_time": ("s", "when it failed; NaN where it did not, or could not begin"),
    "reason": ("1", "why it failed; empty where it did not", "str"),
    "kind": ("1", "kind of motion", "str"),
    "split": ("1", "train, validation or test", "str"),
}
"""Unit, meaning and type of the numbers and texts of a trajectory, parameters aside."""


@dataclass(frozen=True)
class Variable:
    """One array; `components` names the entries of its last dimension where that has no
    coordinate."""

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
        """What stands where nothing is known."""
        return {"O": "", "f": np.nan}.get(self.kept.kind, 0)


def energies(config: Config) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Dimension of each kind of energy, and its parts by their names in a run."""
    kinetic = ("kinetic_L", "kinetic_U") if config.fixed.get("pad.fidelity") == "inertial" else ()
    return {
        "stored": ("store", (*STORES, *kinetic)),
        "dissipated": ("resistor", ("pad_L", "pad_U", "contact_dashpots", "slip")),
        "supplied": ("source", ("control_x", "control_y", "gravity")),
    }


def variables(config: Config) -> dict[str, Variable]:
    """Everything that is kept of a trajectory, by name."""
    elements = int(config.fixed.get("pad.elements_x", Parameters().pad.elements_x))
    points = int(config.fixed.get("contact.points", 0))
    nodes, node = (elements * points, "contact point") if points else (elements + 1, "surface node")
    single = {"trajectory": config.trajectories}
    series = single | {"time": config.samples}
    axis, precision = {"axis": 2}, config.node_precision
    out = dict[str, Variable]()
    for name in KEPT:
        out[name] = Variable(series, CHANNELS[name].unit, CHANNELS[name].meaning)
    for pad, words in PADS.items():
        per, where = f"each {node} of the {words} pad", series | {f"{pad}_point": nodes}
        out[f"normal_force_{pad}"] = Variable(where, "N", f"normal force at {per}", precision)
        out[f"friction_force_{pad}"] = Variable(where, "N", f"friction force at {per}", precision)
        out[f"contact_{pad}"] = Variable(
            where, "1", f"1 where the disc penetrates {per}, else 0", "uint8"
        )
        out[f"displacement_{pad}"] = Variable(
            where | axis, "m", f"displacement of {per}", precision
        )
    for kind, (dimension, parts) in energies(config).items():
        meaning = "energy stored" if kind == "stored" else f"{kind} since t = 0"
        out[f"{kind}_energy"] = Variable(
            series | {dimension: len(parts)}, "J", meaning, components=parts
        )
    out["injected_energy"] = Variable(
        series, "J", "positive part of what the sources supplied since t = 0"
    )
    out["energy_residual"] = Variable(series, "J", "stored - supplied + dissipated since t = 0")
    table = Parameters().table() | {
        RATIO: {"unit": "1", "meaning": "ratio of the friction coefficients"}
    }
    for name in (*config.parameters, *(["contact.mu_k"] if RATIO in config.parameters else [])):
        row = table[name]
        out[name.replace("/", "_over_")] = Variable(
            single, row["unit"], f"parameter: {row['meaning']}"
        )
    return out | {name: Variable(single, *rest) for name, rest in SINGLE.items()}


def not_finite(config: Config, row: dict[str, Any]) -> list[str]:
    """Names of the arrays that are not finite in a trajectory, unless it is marked as failed."""
    known = (
        name
        for name, v in variables(config).items()
        if v.kept.kind == "f" and name != "failure_time"
    )
    return [] if row["failed"] else [name for name in known if not np.isfinite(row[name]).all()]
