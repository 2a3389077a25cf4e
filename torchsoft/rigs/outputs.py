"""Output times, files to be written and steps of a rig file's run."""

from typing import Annotated, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor

from torchsoft.quantity import Quantity, Time
from torchsoft.rigs.fields import Group
from torchsoft.tables import LISTED

ROWS = 1_000_000
"""Most outputs of one run."""


class OutputsTable(Group):
    """Duration of the run, and files to be written."""

    duration: Annotated[float, Quantity("s", 1e-3, 1e5)] = Field(description="duration of the run")
    interval: Annotated[float, Quantity("s", 1e-6, 1e3)] = Field(
        default=0.01, description="time between outputs"
    )
    figures: bool = Field(default=True, description="write the figures")
    player: bool | None = Field(
        default=None, description="write player.html; as `figures` if not given"
    )
    snapshots: Annotated[tuple[Time, ...], LISTED, Field(max_length=12)] = Field(
        default=(),
        description="times of the pictures in snapshots.png; six of the whole run if none is given "
        "[s]",
    )
    video: Literal["gif", "mp4", "none"] = Field(
        default="gif", description="kind of the video, or none; mp4 needs imageio-ffmpeg"
    )
    frames: Annotated[int, Field(ge=2, le=10_000)] = Field(
        default=150, description="pictures of the video, 12 per second"
    )
    follow: str = Field(
        default="",
        description='coordinate under the video, such as "disc.x"; the one that moves most if not '
        "given",
    )

    @model_validator(mode="after")
    def _are_possible(self) -> Self:
        if self.interval > self.duration:
            raise ValueError(
                f"interval = {self.interval:g} s is longer than duration = {self.duration:g} s"
            )
        if self.duration / self.interval > ROWS:
            raise ValueError(
                f"interval = {self.interval:g} s makes more than {ROWS} outputs in "
                f"{self.duration:g} s"
            )
        if late := [time for time in self.snapshots if time > self.duration]:
            raise ValueError(
                f"snapshots: {late[0]:g} s is after the end of the run, duration = "
                f"{self.duration:g} s"
            )
        return self

    def times(self) -> Tensor:
        """Output times [s]: equal intervals, and the times of snapshots."""
        count = max(1, round(self.duration / self.interval)) + 1
        grid = torch.linspace(0, self.duration, count, dtype=torch.float64)
        more = [t for t in self.snapshots if float((grid - t).abs().min()) > 1e-6]
        return torch.cat((grid, torch.tensor(more, dtype=torch.float64))).sort().values


class SolverTable(Group):
    """Choice of steps: by tolerance, or equal ones."""

    rtol: Annotated[float, Quantity("1", 1e-9, 1e-1)] | None = Field(
        default=None, description="relative tolerance; 1e-5 if not given"
    )
    atol: Annotated[float, Quantity("1", 1e-12, 1.0)] | None = Field(
        default=None,
        description="absolute tolerance, in N, mm and rad; a tenth of rtol if not given",
    )
    step: Annotated[float, Quantity("s", 1e-7, 1.0)] | None = Field(
        default=None, description="length of equal steps at most, in place of rtol"
    )
    tolerance: Annotated[float, Quantity("N", 1e-10, 1e-3)] = Field(
        default=1e-9, description="tolerance of Newton's method on every nodal force"
    )

    @model_validator(mode="after")
    def _choose_once(self) -> Self:
        if self.step is not None and (self.rtol or self.atol) is not None:
            raise ValueError(
                "step and rtol (or atol) each say which steps to take; give one of them"
            )
        return self
