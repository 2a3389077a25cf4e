"""Every array of a dataset: name, dimensions, unit, meaning and type."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchsoft.channels import PADS, VARIABLES
from torchsoft.datasets.config import RATIO, Config
from torchsoft.paper.parameters import Parameters

KEPT = tuple(name for name in VARIABLES if name not in ("time", "angular_momentum"))
"""Variables of the rig's channels that a dataset keeps of every trajectory."""

STORES = ("strain_L", "strain_U", "normal_springs", "tangential_springs", "disc", "spin", "bracket")

MOTION = ("trajectory", "time", "axis")
SERIES = ("trajectory", "time")
SINGLE = ("trajectory",)


@dataclass(frozen=True)
class Variable:
    """One array; `components` names the entries of its last dimension where that has no coordinate."""

    dims: tuple[str, ...]
    unit: str
    meaning: str
    dtype: str = "float64"
    components: tuple[str, ...] = ()


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
    out = {
        name: Variable(MOTION if len(v.symbols) > 1 else SERIES, v.unit, v.meaning)
        for name, v in VARIABLES.items() if name in KEPT
    }  # fmt: skip
    for pad in PADS.values():
        point = "contact point" if config.fixed.get("contact.points") else "surface node"
        node, per = ("trajectory", "time", f"{pad}_surface"), f"each {point} of the {pad} pad"
        out[f"normal_force_{pad}"] = Variable(node, "N", f"normal force at {per}", config.node_precision)
        out[f"friction_force_{pad}"] = Variable(node, "N", f"friction force at {per}", config.node_precision)
        out[f"contact_{pad}"] = Variable(node, "1", f"1 where the disc penetrates {per}, else 0", "uint8")
        out[f"displacement_{pad}"] = Variable((*node, "axis"), "m", f"displacement of {per}", config.node_precision)
    for kind, (dimension, parts) in energies(config).items():
        meaning = "energy stored" if kind == "stored" else f"{kind} since t = 0"
        out[f"{kind}_energy"] = Variable((*SERIES, dimension), "J", meaning, components=parts)
    out["injected_energy"] = Variable(SERIES, "J", "positive part of what the sources supplied since t = 0")
    out["energy_residual"] = Variable(SERIES, "J", "stored - supplied + dissipated since t = 0")
    table = Parameters().table()
    for name in config.parameters:
        row = table.get(name, {"unit": "1", "meaning": "ratio of the friction coefficients"})
        out[name.replace("/", "_over_")] = Variable(SINGLE, row["unit"], f"parameter: {row['meaning']}")
    if RATIO in config.parameters:
        out["contact.mu_k"] = Variable(SINGLE, "1", f"parameter: {table['contact.mu_k']['meaning']}")
    return out | {
        "grasp_depth": Variable(SINGLE, "m", "set-point of the compression of both pads together in the grasp"),
        "grasp_force": Variable(SINGLE, "N", "grasping force fed forward"),
        "steps": Variable(SINGLE, "1", "steps of the stepper", "int64"),
        "newton_iterations": Variable(SINGLE, "1", "Newton iterations of all steps", "int64"),
        "energy_residual_rel": Variable(SINGLE, "1", "largest energy residual over the energy injected"),
        "failed": Variable(SINGLE, "1", "1 where the simulation failed: its series are NaN", "uint8"),
        "failure_time": Variable(SINGLE, "s", "when it failed; NaN where it did not, or could not begin"),
        "reason": Variable(SINGLE, "1", "why it failed; empty where it did not", "str"),
        "kind": Variable(SINGLE, "1", "kind of motion", "str"),
        "split": Variable(SINGLE, "1", "train, validation or test", "str"),
    }


def sizes(config: Config) -> dict[str, int]:
    """Length of every dimension."""
    elements = int(config.fixed.get("pad.elements_x", Parameters().pad.elements_x))
    nodes = elements * int(config.fixed.get("contact.points", 0)) or elements + 1
    return {
        "trajectory": config.trajectories, "time": config.samples, "axis": 2, "lower_surface": nodes, "upper_surface": nodes,
        **{dimension: len(parts) for dimension, parts in energies(config).values()},
    }  # fmt: skip


def not_finite(config: Config, row: dict[str, Any]) -> list[str]:
    """Names of the arrays that are not finite in a trajectory, unless it is marked as failed."""
    expected = (name for name, v in variables(config).items() if v.dtype.startswith("float") and name != "failure_time")
    return [] if row["failed"] else [name for name in expected if not np.isfinite(row[name]).all()]
