"""Pads of a rig file."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from torchsoft.parameters import MEMORY, PadParameters
from torchsoft.physics.material import Material
from torchsoft.physics.mesh import PadMesh
from torchsoft.physics.pads import Pad
from torchsoft.rigs.fields import Angle, Group, Length, Place
from torchsoft.tables import LISTED


class PadTable(Group):
    """A soft pad: a rectangle of rubber, bonded along its lower side to a body or to the ground. Its own x goes along it from
    the corner, its own y through it, towards the free surface."""

    material: str = Field(description="name of one of the materials")
    length: Length = Field(description="along the surface")
    height: Length = Field(description="thickness")
    elements_x: Annotated[int, Field(ge=1, le=100_000)] = Field(
        description="finite elements along it; 1 mm each is usual"
    )
    elements_y: Annotated[int, Field(ge=1, le=1000)] = Field(description="finite elements through it")
    base: str | None = Field(default=None, description="name of the body that it is bonded to; the ground if not given")
    origin: Annotated[tuple[Place, Place], LISTED] = Field(
        default=(0.0, 0.0), description="its corner, in the base's own frame [m]"
    )
    angle: Angle = Field(default=0.0, description="by which it is turned about the corner, anticlockwise")
    mirrored: bool = Field(default=False, description="upside down: its free surface faces down (before it is turned)")
    bonded_sides: bool = Field(default=False, description="bonded at both ends as well")
    inertial: bool = Field(
        default=False, description="with mass at every node; true costs time and changes next to nothing"
    )
    points: Annotated[int, Field(ge=0, le=8)] = Field(
        default=0, description="contact points an element; 0 puts one on every node"
    )

    @model_validator(mode="after")
    def _fits_in_memory(self) -> Self:
        need = PadParameters(
            elements_x=max(4, self.elements_x), elements_y=self.elements_y,
            fidelity="inertial" if self.inertial else "massless",
        ).memory  # fmt: skip
        if need > MEMORY:
            raise ValueError(
                f"elements_x = {self.elements_x} by elements_y = {self.elements_y} take about {need:.3g} GiB of memory, but "
                f"{MEMORY:g} GiB are the most; take fewer"
            )
        return self

    def build(self, material: Material) -> Pad:
        mesh = PadMesh(self.length, self.height, self.elements_x, self.elements_y, self.bonded_sides)
        return Pad(
            mesh, material, base=self.base, origin=self.origin, angle=self.angle, mirrored=self.mirrored,
            inertial=self.inertial, points=self.points,
        )  # fmt: skip
