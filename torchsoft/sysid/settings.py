"""How to fit: what may be said of it in a call and in a file, and what goes together."""

from typing import Any, Literal

from pydantic import Field, model_validator

from torchsoft.sysid.fit.robust import Loss
from torchsoft.sysid.fit.stages import Method
from torchsoft.tables import SEED, Table

RTOL = 1e-5
"""Relative tolerance of the last stage: derivatives are then right to some percent, and estimates to a fraction of a standard
deviation where sensors are as good as `RIG`."""

Assumed = Literal["checked", "explained", "trusted"]
"""Whether assumptions are tested to first order, tested and followed by new fits that look for a cause, or believed."""


class Settings(Table):
    """How to fit: the arguments of `identify` by the same names."""

    rtol: float = Field(RTOL, ge=1e-8, le=1e-2)
    starts: int = Field(1, ge=1, le=2**20)
    loss: Loss = "linear"
    method: Method = "gauss_newton"
    workers: int = Field(1, ge=1, le=1000)
    seed: int = Field(0, ge=0, le=SEED)
    tightenings: int = Field(2, ge=0, le=10)
    assumptions: Assumed = "checked"

    @model_validator(mode="before")
    @classmethod
    def _has_no_step(cls, given: Any) -> Any:
        if isinstance(given, dict) and "step" in given:
            raise ValueError(
                "there is no `step` any more: tolerances choose the steps; leave it out, or give the relative tolerance `rtol` "
                f"({RTOL:g})"
            )
        return given

    @model_validator(mode="after")
    def _the_method_has_the_loss(self) -> "Settings":
        if self.loss != "linear" and self.method != "gauss_newton":
            raise ValueError(
                f"the method '{self.method}' has no robust loss: for loss = '{self.loss}' take method = 'gauss_newton'"
            )
        return self
