"""Rigid bodies of a rig file, and where they start."""

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from torchsoft.physics.parts import COORDINATES, Body
from torchsoft.quantity import Density, Depth, Inertia, InertiaRatio, Mass, Place, Quantity
from torchsoft.rigs.fields import Group, NumberOr, at_field
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
    v_x: Annotated[float, Quantity("m/s", -1e3, 1e3)] = Field(default=0.0, description="velocity")
    v_y: Annotated[float, Quantity("m/s", -1e3, 1e3)] = Field(default=0.0, description="velocity")
    omega: Annotated[float, Quantity("rad/s", -1e5, 1e5)] = Field(default=0.0, description="angular velocity")

    @property
    def velocity(self) -> tuple[float, float, float]:
        return self.v_x, self.v_y, self.omega


class BodyTable(Group):
    """A rigid body: what is manipulated, or what carries a pad. Each coordinate is "free", "driven" by the motion of that name,
    or a number at which it is fixed."""

    mass: Mass | None = Field(
        default=None, description="mass, or density and depth; not needed where no coordinate is free"
    )
    density: Density | None = Field(
        default=None, description="density, which gives the mass of its shape; steel has 7800, aluminium 2700"
    )
    depth: Depth | None = Field(default=None, description="how deep it is, out of the plane; goes with density")
    x: Annotated[float | str, NumberOr("m", "free", "driven")] = Field(default="free", description="to the right")
    y: Annotated[float | str, NumberOr("m", "free", "driven")] = Field(default="free", description="upwards")
    theta: Annotated[float | str, NumberOr("rad", "free", "driven")] = Field(
        default="free", description="anticlockwise"
    )
    inertia: Inertia | None = Field(default=None, description="moment of inertia; that of its shape if not given")
    inertia_ratio: InertiaRatio = Field(
        default=1.0, description="moment of inertia over that of a body of uniform density, where inertia is not given"
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
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density each say how heavy it is; give one of them")
        if (self.density is None) != (self.depth is None):
            given, missing = ("density", "depth") if self.depth is None else ("depth", "density")
            raise ValueError(f"{missing} is missing: {given} is given, and the mass is density times area times depth")
        if self.density is not None and self.shape is None:
            raise ValueError("shape is missing: density is given, and the mass is density times its area times depth")
        if self.free and self.mass is None and self.density is None:
            raise ValueError(
                f"mass is missing, but {' and '.join(self.free)} can move freely; give it, or density and depth"
            )
        if self.inertia_ratio != 1.0 and (self.inertia is not None or self.shape is None):
            raise ValueError("inertia_ratio has no effect beside inertia, or without a shape; leave it out")
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
        """The body; `held` are numbers at which coordinates are fixed in the place of their freedom. Raises `ValueError`."""
        freedom: dict[str, Any] = self.freedom | (held or {})
        given: dict[str, Any] = {
            "inertia": self.inertia,
            "inertia_ratio": self.inertia_ratio,
            "weighted": self.weighted,
            **freedom,
        }
        if self.shape is None:
            return Body(self.mass or 1.0, **given)
        with at_field("shape"):
            shape = self.shape.build(folder)
        if self.density is not None and self.depth is not None:
            return Body.uniform(shape, self.density, self.depth, **given)
        return Body(self.mass or 1.0, shape, **given)
