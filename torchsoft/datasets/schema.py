"""What is said of the arrays of a dataset: dimensions, unit, meaning and type."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np


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
        """The value of an unknown."""
        return {"O": "", "f": np.nan}.get(self.kept.kind, 0)
