"""Rigid bodies of a rig file, and where they start."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from torchsoft.physics.parts import COORDINATES, Body
from torchsoft.rigs.fields import Group, Mass, NumberOr, Place, Within
from torchsoft.rigs.shapes import ShapeTable

REST = "rest"
"""The word for a coordinate that is to start where the body rests."""

UNITS = {"x": "m", "y": "m", "theta": "rad"}
"""Of the coordinates."""


class StartTable(Group):
    """Where a body is when the run begins, and how it moves; for coordinates that are free."""

    x: Place | None = Field(default=None, description="centre of mass, to the right")
    y: Annotated[float | str | None, NumberOr("m", REST, optional=True)] = Field(
        default=None, description='centre of mass, upwards; "rest": where it lies under its weight, the loops off'
    )
    theta: Annotated[float | str | None, NumberOr("rad", REST, optional=True)] = Field(
        default=None, description='anticlockwise, 0 if not given; "rest" as for y'
    )
    v_x: Annotated[float, Within(-1e3, 1e3, "m/s")] = Field(default=0.0, description="velocity")
    v_y: Annotated[float, Within(-1e3, 1e3, "m/s")] = Field(default=0.0, description="velocity")
    omega: Annotated[float, Within(-1e5, 1e5, "rad/s")] = Field(default=0.0, description="angular velocity")

    @property
    def velocity(self) -> tuple[float, float, float]:
        return self.v_x, self.v_y, self.omega


class BodyTable(Group):
    """A rigid body: what is manipulated, or what carries a pad. Each coordinate is "free", "driven" by the motion of that name,
    or a number at which it is fixed."""

    mass: Mass | None = Field(default=None, description="mass; not needed where no coordinate is free")
    x: Annotated[float | str, NumberOr("m", "free", "driven")] = Field(default="free", description="to the right")
    y: Annotated[float | str, NumberOr("m", "free", "driven")] = Field(default="free", description="upwards")
    theta: Annotated[float | str, NumberOr("rad", "free", "driven")] = Field(
        default="free", description="anticlockwise"
    )
    inertia: Annotated[float, Within(1e-12, 1e6, "kg.m2")] | None = Field(
        default=None, description="moment of inertia; that of its shape if not given"
    )
    weighted: bool = Field(default=True, description="whether gravity acts on it")
    symbol: str = Field(
        default="", description="what its channels are called: x_SYMBOL and so on; its name if not given"
    )
    shape: ShapeTable | None = Field(default=None, description="what touches pads; not needed where nothing touches it")
    start: StartTable = StartTable()

    @property
    def freedom(self) -> dict[str, float | str]:
        """Each coordinate's freedom."""
        return dict(zip(COORDINATES, (self.x, self.y, self.theta)))

    @property
    def free(self) -> list[str]:
        """The coordinates that are free."""
        return [axis for axis, kind in self.freedom.items() if kind == "free"]

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.free and self.mass is None:
            raise ValueError(f"mass is missing, but {' and '.join(self.free)} can move freely")
        if "theta" in self.free and self.shape is None and self.inertia is None:
            raise ValueError("inertia is missing: theta is free, and there is no shape to compute it from")
        for (axis, kind), rate in zip(self.freedom.items(), ("v_x", "v_y", "omega")):
            for name in (axis, rate):
                if kind != "free" and getattr(self.start, name):
                    where = "the motion of that name" if kind == "driven" else "that number"
                    raise ValueError(f"start.{name} has no meaning: {axis} is not free, and starts where {where} says")
            if kind == "free" and axis != "theta" and getattr(self.start, axis) is None:
                raise ValueError(f"start.{axis} is missing: {axis} is free, so say where it starts [m]")
        return self

    def build(self, folder: Path, held: dict[str, float] | None = None) -> Body:
        """The body; `held` are numbers at which coordinates are fixed in the place of their freedom."""
        freedom: dict[str, float | str] = self.freedom | (held or {})
        shape = None if self.shape is None else self.shape.build(folder)
        return Body(self.mass or 1.0, shape, inertia=self.inertia, weighted=self.weighted, **freedom)  # pyright: ignore
