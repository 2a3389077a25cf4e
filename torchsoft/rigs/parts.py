"""Bodies with their shapes, materials, pads, laws and contacts of a rig file. Another kind is one
more entry of its union."""

import os
import sys
from collections.abc import Mapping, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Discriminator, Field, Tag, TypeAdapter, model_validator

from torchsoft.caller import warn
from torchsoft.display import suggestion
from torchsoft.materials.presets import PRESETS, from_shore_a
from torchsoft.physics.ageing import AgeingSlip
from torchsoft.physics.contact import Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.hyperelastic import KINDS
from torchsoft.physics.matched import Matched
from torchsoft.physics.material import Material
from torchsoft.physics.mesh import CurvedPadMesh, FingertipMesh, Mesh, PadMesh, QuadMesh
from torchsoft.physics.pads import Pad, Taxels
from torchsoft.physics.parts import COORDINATES, Body, Contact
from torchsoft.physics.rate_and_state import RateAndState
from torchsoft.physics.shapes import (
    Circle,
    Contour,
    Eccentric,
    Ellipse,
    RoundedBox,
    RoundedPolygon,
    Shape,
    Superellipse,
)
from torchsoft.physics.shapes.contour import read_points
from torchsoft.physics.shapes.eccentric import Offset
from torchsoft.physics.start import RATES, REST, TOUCH
from torchsoft.quantity import Angle, Density, Depth, Inertia, InertiaRatio, Mass, Place, Quantity
from torchsoft.rigs.fields import (
    AUTO,
    Group,
    NumberOr,
    OrAuto,
    PartTable,
    at_field,
    one_of,
    table_of,
)
from torchsoft.tables import LISTED, line, read_toml, refusing


class ContourTable(PartTable):
    """A smooth closed contour through the points of a CSV file with the columns x and y, which have
    units in their headings: `x [mm],y [mm]`. They may be given about any point: the pose of the
    body is that of its centre of mass, and a note says where that is among them."""

    part = Contour
    kind: Literal["contour"] = "contour"
    file: str = Field(description="the CSV file, from the folder of this one")
    tolerance: Annotated[float, Quantity("m", 1e-9, 1e-2)] = Field(
        default=1e-6, description="largest distance of the contour from the points"
    )

    def arguments(self, folder: Path) -> tuple[tuple[str, Any], ...]:
        points = read_points(folder / self.file)
        return ("points", tuple((x, y) for x, y in points.tolist())), ("tolerance", self.tolerance)

    def build(self, folder: Path) -> Any:
        with at_field("file"):
            return super().build(folder)


if TYPE_CHECKING:
    ShapeTable = PartTable
else:
    ShapeTable = one_of(
        table_of(Circle, "circle"),
        table_of(Ellipse, "ellipse"),
        table_of(Superellipse, "superellipse"),
        table_of(RoundedBox, "rounded_box"),
        table_of(RoundedPolygon, "rounded_polygon"),
        ContourTable,
    )


class DepthTable(Group):
    """A start below "touch"."""

    depth: Annotated[float, Quantity("m", -10.0, 10.0)] = Field(
        description='how far below "touch" the body starts; negative: how far above'
    )


class ForceTable(Group):
    """A start under a load."""

    force: Annotated[float, Quantity("N", 0.0, 1e6)] = Field(
        description="force that presses the body down, in addition to its weight"
    )


def height(given: Any) -> str:
    """Kind of a height that is given."""
    table = given if isinstance(given, Mapping) else getattr(type(given), "model_fields", {})
    return "force" if "force" in table else "depth" if table else "number"


class StartTable(Group):
    """Free coordinates and rates of a body when the run begins."""

    x: Place | None = Field(default=None, description="centre of mass, to the right")
    y: Annotated[
        Annotated[float | str | None, NumberOr("m", REST, TOUCH, optional=True), Tag("number")]
        | Annotated[DepthTable, Tag("depth")]
        | Annotated[ForceTable, Tag("force")],
        Discriminator(height),
    ] = Field(
        default=None,
        description='centre of mass, upwards; "rest": equilibrium under its weight, controllers '
        'off; "touch": the undeformed pads bonded to it just touch what is below; '
        "`{depth = 1e-3}`: lower than that; `{force = 20.0}`: equilibrium under that load as well",
    )
    theta: Annotated[float | str | None, NumberOr("rad", REST, optional=True)] = Field(
        default=None, description='angle, anticlockwise, 0 if not given; "rest" as for y'
    )
    v_x: Annotated[float, Quantity("m/s", -1e3, 1e3)] = Field(default=0.0, description="velocity")
    v_y: Annotated[float, Quantity("m/s", -1e3, 1e3)] = Field(default=0.0, description="velocity")
    omega: Annotated[float, Quantity("rad/s", -1e5, 1e5)] = Field(
        default=0.0, description="angular velocity"
    )


class BodyTable(Group):
    """A rigid body, manipulated or carrying a pad. Each coordinate is "free", "driven" by the
    motion of that name, or a number at which it is fixed."""

    mass: Mass | None = Field(
        default=None,
        description="mass, or density and depth; not needed where no coordinate is free",
    )
    density: Density | None = Field(
        default=None,
        description="density, which gives the mass of its shape; steel has 7800, aluminium 2700",
    )
    depth: Depth | None = Field(
        default=None, description="depth out of the plane; needed with density"
    )
    x: Annotated[float | str, NumberOr("m", "free", "driven")] = Field(
        default="free", description="centre of mass, to the right"
    )
    y: Annotated[float | str, NumberOr("m", "free", "driven")] = Field(
        default="free", description="centre of mass, upwards"
    )
    theta: Annotated[float | str, NumberOr("rad", "free", "driven")] = Field(
        default="free", description="angle, anticlockwise"
    )
    inertia: Inertia | None = Field(
        default=None, description="moment of inertia; that of its shape if not given"
    )
    inertia_ratio: InertiaRatio = Field(
        default=1.0,
        description="moment of inertia over that of a body of uniform density, where inertia is "
        "not given",
    )
    weighted: bool = Field(default=True, description="whether gravity acts on it")
    symbol: str = Field(
        default="",
        description="name in its channels, x_SYMBOL and so on; the body's name if not given",
    )
    shape: ShapeTable | None = Field(
        default=None, description="contour; not needed for a body without contacts"
    )
    centre_x: Offset = Field(
        default=0.0, description="centre of mass in the frame of its shape, along the body's own x"
    )
    centre_y: Offset = Field(
        default=0.0, description="centre of mass in the frame of its shape, along the body's own y"
    )
    start: StartTable = StartTable()
    """pose and rates at the start of the run"""

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
            raise ValueError(
                f"{missing} is missing: {given} is given, and the mass is density times area times "
                "depth"
            )
        if self.density is not None and self.shape is None:
            raise ValueError(
                "shape is missing: density is given, and the mass is density times its area times "
                "depth"
            )
        if self.free and self.mass is None and self.density is None:
            raise ValueError(
                f"mass is missing, but {' and '.join(self.free)} can move freely; give it, or "
                "density and depth"
            )
        if (self.centre_x or self.centre_y) and self.shape is None:
            raise ValueError(
                "centre_x and centre_y have no meaning without a shape; leave them out"
            )
        if self.inertia_ratio != 1.0 and (self.inertia is not None or self.shape is None):
            raise ValueError(
                "inertia_ratio has no effect beside inertia, or without a shape; leave it out"
            )
        if "theta" in self.free and self.shape is None and self.inertia is None:
            raise ValueError(
                "inertia is missing: theta is free, and there is no shape to compute it from"
            )
        for (axis, kind), rate in zip(self.freedom.items(), ("v_x", "v_y", "omega")):
            for name in (axis, rate):
                if kind != "free" and getattr(self.start, name):
                    where = "the motion of that name" if kind == "driven" else "that number"
                    raise ValueError(
                        f"start.{name} has no meaning: {axis} is not free, and starts where "
                        f"{where} says"
                    )
            if kind == "free" and axis != "theta" and getattr(self.start, axis) is None:
                raise ValueError(
                    f"start.{axis} is missing: {axis} is free, so say where it starts [m]"
                )
        return self

    @property
    def given(self) -> dict[str, Any]:
        """Free coordinates and rates at the start, as `Rig.state` takes them."""
        start = self.start.model_dump(exclude_unset=True, exclude_none=True)
        known = zip(COORDINATES, RATES)
        free = [name for pair in known if pair[0] in self.free for name in pair]
        return {name: value for name, value in start.items() if name in free}

    def build(self, folder: Path, own: Shape | None = None) -> Body:
        """The body, with a shape of the user's `own`. Raises `ValueError`."""
        given: dict[str, Any] = {
            "inertia": self.inertia, "inertia_ratio": self.inertia_ratio, "weighted": self.weighted,
            **self.freedom,
        }  # fmt: skip
        if self.shape is None and own is None:
            return Body(self.mass or 1.0, **given)
        with at_field("shape"):
            shape = own if self.shape is None or own is not None else self.shape.build(folder)
        assert shape is not None
        if self.centre_x or self.centre_y:
            shape = Eccentric(shape, self.centre_x, self.centre_y)
        if self.density is not None and self.depth is not None:
            return Body.uniform(shape, self.density, self.depth, **given)
        return Body(self.mass or 1.0, shape, **given)


class RubberTable(PartTable):
    """A material, of which `shore_a` may stand for E."""

    @model_validator(mode="before")
    @classmethod
    def _has_a_modulus(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or "shore_a" not in data:
            return data
        if "E" in data:
            raise ValueError("E and shore_a each say how stiff it is; give one of them")
        with at_field("shore_a"):
            hardness = NumberOr("Shore A").check(data["shore_a"])
            assert isinstance(hardness, float)
            E = from_shore_a(hardness)
        warn(
            f"shore_a = {hardness:g} is taken for E = {1e-6 * E:.3g} MPa, the estimate of Gent "
            "(1958); where it matters, identify E or fit a test",
        )
        return {name: x for name, x in data.items() if name != "shore_a"} | {"E": E}


OWN = tuple(table_of(part, kind, RubberTable, nu=0.45, rho=1100.0) for kind, part in KINDS.items())
"""Tables of materials with numbers of their own."""


class PresetTable(Group):
    """A rubber from the literature; `torchsoft material presets` lists them with the source of
    every coefficient."""

    kind: Literal["preset"] = "preset"
    name: str = Field(description='its name, such as "Dragon Skin 20"')
    depth: Depth = Field(description="depth of the pads, out of the plane")

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        if self.name not in PRESETS:
            raise ValueError(
                f"name: there is no preset `{line(self.name, 80)}`; "
                f"{suggestion(self.name, PRESETS, 'there are')}"
            )
        return self

    def build(self, folder: Path) -> Material:
        return PRESETS[self.name].material(self.depth)


class FileTable(Group):
    """A material of another TOML file, such as the one that `torchsoft material fit` writes."""

    kind: Literal["file"] = "file"
    file: str = Field(description="the file, from the folder of this one")
    name: str | None = Field(
        default=None, description="which of its materials; not needed where it has one only"
    )
    depth: Depth | None = Field(
        default=None,
        description="depth of the pads, out of the plane; that of the file if not given",
    )

    def build(self, folder: Path) -> Material:
        path = folder / self.file
        with at_field("file"):
            tree = read_toml(path).get("materials")
            found = tree if isinstance(tree, dict) else {}
            if self.name is None and len(found) != 1:
                raise ValueError(
                    f"{path} has {len(found)} tables [materials.*]; set `name` to the one "
                    "that is meant"
                )
            name = next(iter(found)) if self.name is None else self.name
            if name not in found:
                raise ValueError(
                    f"{path} has no [materials.{name}]; it has {', '.join(found) or 'none'}"
                )
            given = {} if self.depth is None else {"depth": self.depth}
            try:
                with refusing(found[name], f"materials.{name}"):
                    table = OwnTable.validate_python(found[name])
                    table = table.model_validate(table.model_dump(exclude_unset=True) | given)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
        return table.build(path.parent)


OwnTable: TypeAdapter[PartTable] = TypeAdapter(one_of(*OWN))
"""Validator of the materials that a file may hold; they refer to no further files."""

if TYPE_CHECKING:
    MaterialTable = PartTable
else:
    MaterialTable = one_of(*OWN, PresetTable, FileTable)


class PadTable(PartTable):
    """A soft pad, bonded to a body or to the ground. In its own frame its free surface looks up,
    along y; x goes along it."""

    material: str = Field(description="name of one of the materials")
    base: str | None = Field(
        default=None, description="name of the body that it is bonded to; the ground if not given"
    )
    origin: Annotated[tuple[Place, Place], LISTED] = Field(
        default=(0.0, 0.0), description="position of its origin in the frame of its base [m]"
    )
    angle: Angle = Field(default=0.0, description="rotation about its origin, anticlockwise")
    mirrored: bool = Field(
        default=False,
        description="true: upside down, the free surface faces down before the rotation",
    )
    inertial: bool = Field(
        default=False,
        description="true: every node has mass; slower, with nearly the same result",
    )
    points: Annotated[int, Field(ge=0, le=8)] = Field(
        default=0, description="contact points per element; 0 puts one on every node"
    )

    def mesh(self, folder: Path) -> Mesh:
        """The finite elements; `folder` is the base of relative file names. Raises `ValueError`."""
        mesh = PartTable.build(self, folder)
        mesh.check_memory()
        return mesh

    def build(self, material: Material, folder: Path) -> Pad:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The pad. Raises `ValueError`."""
        if self.inertial and material.branches > 1:
            with at_field("inertial"):
                raise ValueError(
                    'an inertial pad has one retardation time (kind = "kelvin_voigt"), but '
                    f"`{self.material}` has "
                    f"{material.branches}; set inertial = false, or take such a material"
                )
        return Pad(
            self.mesh(folder), material, base=self.base, origin=self.origin, angle=self.angle,
            mirrored=self.mirrored, inertial=self.inertial, points=self.points,
        )  # fmt: skip

    @model_validator(mode="after")
    def _is_sound(self) -> Self:
        if "file" not in type(self).model_fields:
            self.mesh(Path())
        return self


class MeshTable(PadTable):
    """A pad of quadrilaterals from a mesh file that meshio reads (gmsh, vtk, abaqus, ...), with
    named groups of lines; their coordinates are its own frame, in which its face looks up."""

    part = QuadMesh.read
    kind: Literal["mesh"] = "mesh"
    file: str = Field(description="the mesh file, from the folder of this one")
    unit: Literal["m", "cm", "mm"] = Field(description="unit of the coordinates in the file")
    face: str = Field(default="face", description="group of lines that is the free surface")
    bonded_edges: Annotated[tuple[str, ...], LISTED, Field(min_length=1, max_length=100)] = Field(
        default=("base",), description="groups of lines that are bonded"
    )

    def mesh(self, folder: Path) -> Mesh:
        with at_field("file"):
            mesh = QuadMesh.read(
                folder / self.file, unit=self.unit, face=self.face, bonded=self.bonded_edges
            )
            mesh.check_memory()
            return mesh


def a_block_by_default(given: Any) -> Any:
    """The table, of the kind "block" if it states none."""
    return (
        {"kind": "block"} | dict(given)
        if isinstance(given, Mapping) and "kind" not in given
        else given
    )


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


TRUST = "TORCHSOFT_RUN_CODE"
"""Environment variable that is 1 where rig files may run the Python files that they name."""


class CodeTable(PartTable):
    """A friction law of your own: a function, a module, or its class, of a Python file."""

    kind: Literal["python"] = "python"
    file: str = Field(description="the Python file, from the folder of this one; it is run")
    law: str = Field(description="name of the law in it")

    def build(self, folder: Path) -> Any:
        path = folder / self.file
        with at_field("file"):
            if os.environ.get(TRUST) != "1":
                raise ValueError(
                    f"{path} is a program, which may do all that you may; read it, and set "
                    f"{TRUST}=1 to run it"
                )
            spec = spec_from_file_location(f"torchsoft_rig_{path.stem}", path)
            if spec is None or spec.loader is None or not path.is_file():
                raise ValueError(f"{path} is not a Python file")
            module = module_from_spec(spec)
            sys.modules[spec.name] = module  # for pickle
            spec.loader.exec_module(module)
        with at_field("law"):
            if not callable(found := getattr(module, self.law, None)):
                raise ValueError(f"{path} has no function or module called `{line(self.law, 80)}`")
            return found() if isinstance(found, type) else found


class SpringsTable(PartTable):
    """A law of contact points. A spring "auto" is `STIFFER` times as stiff as the surface of the
    stiffest pad that has the law; a dashpot "auto" is that pad's shortest retardation time times
    its spring. Both follow the pad's parameters (`Matched`). Smooth friction on a pad whose
    instantaneous dashpot is that of `tau_instant`, a regularisation, falls with slip no faster than
    this dashpot balances (`SmoothSlip.R_pad`)."""

    def matched_to(self, pads: Sequence[Pad], folder: Path, friction: Any = None) -> SoftContact:
        """The law of contacts with these pads, with another friction if one is given."""
        given = {} if friction is None else {"friction": friction}
        law: SoftContact = self.part(**dict(self.arguments(folder)) | given)
        law.match(Matched(pads, law.node_spacing), self.auto)
        soft = [pad for pad in pads if hasattr(pad.material, "tau_instant")]
        slip = law.friction
        if soft and friction is None and type(slip) is SmoothSlip and slip.R_pad is None:
            slip.match(Matched(soft, law.node_spacing), ["R_pad"])
        return law

    @property
    def auto(self) -> list[str]:
        """Names of the numbers that are "auto"."""
        return [name for name in signature(self.part).parameters if getattr(self, name) == AUTO]

    def arguments(self, folder: Path) -> tuple[tuple[str, Any], ...]:
        given = super().arguments(folder)
        return tuple((name, 1.0 if name in self.auto else value) for name, value in given)


if TYPE_CHECKING:
    LawTable = SpringsTable
else:
    LawTable = table_of(
        SoftContact,
        base=SpringsTable,
        friction=Annotated[
            one_of(
                table_of(SmoothSlip, "smooth"),
                table_of(Coulomb, "coulomb"),
                table_of(RateAndState, "rate_and_state"),
                table_of(AgeingSlip, "ageing"),
                CodeTable,
            ),
            "law of friction",
        ],
        **{
            name: Annotated[signature(SoftContact).parameters[name].annotation, OrAuto()]
            for name in ("K_n", "R_n", "K_t", "R_t")
        },
    )


TaxelsTable = table_of(Taxels)


class ContactTable(Group):
    """A pair that may touch: a pad and a body. Others pass through each other."""

    pad: str = Field(description="name of one of the pads")
    body: str = Field(description="name of one of the bodies, with a shape")
    law: str = Field(description="name of one of the laws")
    may_leave: bool = Field(
        default=False,
        description="true: the run goes on where the body leaves the space over the pad or touches "
        "its ends, which a wider body does",
    )

    def build(self, laws: dict[str, SoftContact]) -> Contact:
        return Contact(self.pad, self.body, laws[self.law], may_leave=self.may_leave)
