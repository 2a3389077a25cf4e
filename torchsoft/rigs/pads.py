"""Pads of a rig file. Another one is another class here, and one more name in `PadTable`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from torchsoft.parameters import MEMORY, condensation_memory
from torchsoft.physics.material import Material
from torchsoft.physics.mesh import CurvedPadMesh, FingertipMesh, Mesh, PadMesh, QuadMesh
from torchsoft.physics.pads import Pad
from torchsoft.rigs.fields import Angle, Group, Length, Place, Within, at_field
from torchsoft.tables import LISTED

Elements = Annotated[int, Field(ge=1, le=100_000)]

Names = Annotated[tuple[str, ...], LISTED, Field(min_length=1, max_length=100)]


class Placed(Group):
    """A soft pad, bonded to a body or to the ground. In its own frame its free surface looks up, along y; x goes along it."""

    material: str = Field(description="name of one of the materials")
    base: str | None = Field(default=None, description="name of the body that it is bonded to; the ground if not given")
    origin: Annotated[tuple[Place, Place], LISTED] = Field(
        default=(0.0, 0.0), description="where its own origin is, in the base's own frame [m]"
    )
    angle: Angle = Field(default=0.0, description="by which it is turned about its origin, anticlockwise")
    mirrored: bool = Field(default=False, description="upside down: its free surface faces down (before it is turned)")
    inertial: bool = Field(
        default=False, description="with mass at every node; true costs time and changes next to nothing"
    )
    points: Annotated[int, Field(ge=0, le=8)] = Field(
        default=0, description="contact points an element; 0 puts one on every node"
    )

    def size(self) -> tuple[int, int, int]:
        """Nodes on its free surface, nodes that move, and how far apart those of one element are in their order, about; zeros
        where that is in a file."""
        raise NotImplementedError

    def mesh(self, folder: Path) -> Mesh:
        """Its finite elements; `folder` is where a file that a table names lies. Raises `ValueError`."""
        raise NotImplementedError

    def numbers(self) -> str:
        """The fields that say how many elements it has, for messages."""
        raise NotImplementedError

    def fits_in_memory(self, surface: int, free: int, band: int) -> None:
        """Raises `ValueError` for more nodes than can be computed with: inertial pads are condensed too, to find the start."""
        need = condensation_memory(surface, free, band)
        if need > MEMORY:
            raise ValueError(
                f"{self.numbers()} take about {need:.3g} GiB of memory, but {MEMORY:g} GiB are the most; take fewer"
            )

    @model_validator(mode="after")
    def _fits_in_memory(self) -> Self:
        self.fits_in_memory(*self.size())
        return self

    def build(self, material: Material, folder: Path) -> Pad:
        """The pad. Raises `ValueError`."""
        if self.inertial and material.branches > 1:
            with at_field("inertial"):
                raise ValueError(
                    f'an inertial pad has one retardation time (kind = "kelvin_voigt"), but `{self.material}` has '
                    f"{material.branches}; say inertial = false, or take such a material"
                )
        mesh = self.mesh(folder)
        self.fits_in_memory(len(mesh.face), len(mesh.free), mesh.band)
        return Pad(
            mesh, material, base=self.base, origin=self.origin, angle=self.angle, mirrored=self.mirrored,
            inertial=self.inertial, points=self.points,
        )  # fmt: skip


class Rectangular(Placed):
    """What blocks have."""

    length: Length = Field(description="along the surface")
    height: Length = Field(description="thickness")
    elements_x: Elements = Field(description="finite elements along it; 1 mm each is usual")
    elements_y: Annotated[int, Field(ge=1, le=1000)] = Field(description="finite elements through it")

    def size(self) -> tuple[int, int, int]:
        return self.elements_x + 1, (self.elements_x + 1) * self.elements_y, self.elements_y + 2

    def numbers(self) -> str:
        return f"elements_x = {self.elements_x} by elements_y = {self.elements_y}"


class BlockTable(Rectangular):
    """A pad that is a rectangle, bonded along its lower side. Its own origin is the left corner of that side."""

    kind: Literal["block"] = "block"
    bonded_sides: bool = Field(default=False, description="bonded at both ends as well")

    def mesh(self, folder: Path) -> Mesh:
        return PadMesh(self.length, self.height, self.elements_x, self.elements_y, self.bonded_sides)


class CurvedTable(Rectangular):
    """A pad like a block whose face is an arc: `height` thick in the middle, thinner at the ends; thicker, if it is hollow."""

    kind: Literal["curved"] = "curved"
    radius: Annotated[float, Within(-1e3, 1e3, "m")] = Field(
        description="of the face, half of the length at least; negative: it is hollow"
    )
    bonded_edges: Names = Field(default=("base",), description='edges that are bonded: of "base", "left", "right"')

    def mesh(self, folder: Path) -> Mesh:
        return CurvedPadMesh(
            self.length,
            self.height,
            self.elements_x,
            self.elements_y,
            radius=self.radius,
            bonded_edges=self.bonded_edges,
        )


class FingertipTable(Placed):
    """A pad that is half of a disc, bonded along its diameter. Its own origin is the left end of that."""

    kind: Literal["fingertip"] = "fingertip"
    radius: Length = Field(description="radius")
    elements_around: Annotated[int, Field(ge=4, le=100_000, multiple_of=4)] = Field(
        description="finite elements along the half circle, a multiple of 4; 1 mm each is usual"
    )

    def size(self) -> tuple[int, int, int]:
        k, layers = self.elements_around // 4, FingertipMesh(self.radius, self.elements_around).layers
        return 4 * k + 1, (2 * k + 1) * k + layers * (4 * k - 1), 4 * k + 2

    def numbers(self) -> str:
        return f"elements_around = {self.elements_around}"

    def mesh(self, folder: Path) -> Mesh:
        return FingertipMesh(self.radius, self.elements_around)


class MeshTable(Placed):
    """A pad of quadrilaterals from a mesh file that meshio reads (gmsh, vtk, abaqus, ...), with named groups of lines; their
    coordinates are its own frame, in which its face looks up."""

    kind: Literal["mesh"] = "mesh"
    file: str = Field(description="the mesh file, from the folder of this one")
    unit: Literal["m", "cm", "mm"] = Field(description="of the coordinates in the file")
    face: str = Field(default="face", description="group of lines that is the free surface")
    bonded_edges: Names = Field(default=("base",), description="groups of lines that are bonded")

    def size(self) -> tuple[int, int, int]:
        return 0, 0, 0

    def numbers(self) -> str:
        return f"the elements of {self.file}"

    def mesh(self, folder: Path) -> Mesh:
        with at_field("file"):
            return QuadMesh.read(folder / self.file, unit=self.unit, face=self.face, bonded=self.bonded_edges)


def a_block_by_default(given: Any) -> Any:
    """A table without a kind is a block's."""
    return {"kind": "block"} | dict(given) if isinstance(given, Mapping) and "kind" not in given else given


PadTable = Annotated[
    Annotated[BlockTable | CurvedTable | FingertipTable | MeshTable, Field(discriminator="kind")],
    BeforeValidator(a_block_by_default),
]
