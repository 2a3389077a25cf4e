"""Pads of a rig file. Another pad is one more entry of `AnyPad`."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from torchsoft.physics.material import Material
from torchsoft.physics.mesh import CurvedPadMesh, FingertipMesh, Mesh, PadMesh, QuadMesh
from torchsoft.physics.pads import Pad
from torchsoft.quantity import Angle, Place
from torchsoft.rigs.fields import PartTable, at_field, one_of, table_of
from torchsoft.tables import LISTED


class PadTable(PartTable):
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

    def mesh(self, folder: Path) -> Mesh:
        """Finite elements; `folder` is where a file that a table names lies. Raises `ValueError`."""
        mesh = PartTable.build(self, folder)
        mesh.check_memory()
        return mesh

    def build(self, material: Material, folder: Path) -> Pad:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The pad. Raises `ValueError`."""
        if self.inertial and material.branches > 1:
            with at_field("inertial"):
                raise ValueError(
                    f'an inertial pad has one retardation time (kind = "kelvin_voigt"), but `{self.material}` has '
                    f"{material.branches}; say inertial = false, or take such a material"
                )
        return Pad(
            self.mesh(folder), material, base=self.base, origin=self.origin, angle=self.angle, mirrored=self.mirrored,
            inertial=self.inertial, points=self.points,
        )  # fmt: skip

    @model_validator(mode="after")
    def _is_sound(self) -> Self:
        if "file" not in type(self).model_fields:
            self.mesh(Path())
        return self


class MeshTable(PadTable):
    """A pad of quadrilaterals from a mesh file that meshio reads (gmsh, vtk, abaqus, ...), with named groups of lines; their
    coordinates are its own frame, in which its face looks up."""

    part = QuadMesh.read
    kind: Literal["mesh"] = "mesh"
    file: str = Field(description="the mesh file, from the folder of this one")
    unit: Literal["m", "cm", "mm"] = Field(description="of the coordinates in the file")
    face: str = Field(default="face", description="group of lines that is the free surface")
    bonded_edges: Annotated[tuple[str, ...], LISTED, Field(min_length=1, max_length=100)] = Field(
        default=("base",), description="groups of lines that are bonded"
    )

    def mesh(self, folder: Path) -> Mesh:
        with at_field("file"):
            mesh = QuadMesh.read(folder / self.file, unit=self.unit, face=self.face, bonded=self.bonded_edges)
            mesh.check_memory()
            return mesh


def a_block_by_default(given: Any) -> Any:
    """A table without a kind is a block's."""
    return {"kind": "block"} | dict(given) if isinstance(given, Mapping) and "kind" not in given else given


if TYPE_CHECKING:
    AnyPad = PadTable
else:
    AnyPad = Annotated[
        one_of(
            table_of(PadMesh, "block", PadTable),
            table_of(CurvedPadMesh, "curved", PadTable, radius=...),
            table_of(FingertipMesh, "fingertip", PadTable),
            MeshTable,
        ),
        BeforeValidator(a_block_by_default),
    ]
