"""Materials of pads in a rig file. Another material is one more entry of `KINDS`."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, TypeAdapter, model_validator

from torchsoft.materials.presets import PRESETS
from torchsoft.physics.material import KINDS, Material
from torchsoft.quantity import Depth
from torchsoft.rigs.fields import Group, PartTable, at_field, one_of, table_of
from torchsoft.tables import line, read_toml, refusing

OWN = tuple(table_of(part, kind, nu=0.45, rho=1100.0) for kind, part in KINDS.items())
"""Tables that hold their own numbers."""


class PresetTable(Group):
    """A rubber from the literature; `torchsoft material presets` lists them with the source of every coefficient."""

    kind: Literal["preset"] = "preset"
    name: str = Field(description='its name, such as "Dragon Skin 20"')
    depth: Depth = Field(description="depth of the pads, out of the plane")

    @model_validator(mode="after")
    def _is_known(self) -> Self:
        if self.name not in PRESETS:
            raise ValueError(f"name: there is no preset `{line(self.name, 80)}`; there are {', '.join(PRESETS)}")
        return self

    def build(self, folder: Path) -> Material:
        return PRESETS[self.name].material(self.depth)


class FileTable(Group):
    """A material of another TOML file, such as the one that `torchsoft material fit` writes."""

    kind: Literal["file"] = "file"
    file: str = Field(description="the file, from the folder of this one")
    name: str | None = Field(default=None, description="which of its materials; not needed where it has one only")
    depth: Depth | None = Field(
        default=None, description="depth of the pads, out of the plane; that of the file if not given"
    )

    def build(self, folder: Path) -> Material:
        path = folder / self.file
        with at_field("file"):
            tree = read_toml(path).get("materials")
            found = tree if isinstance(tree, dict) else {}
            if self.name is None and len(found) != 1:
                raise ValueError(
                    f"{path} has {len(found)} tables [materials.*]; say by name which one is meant, or one"
                )
            name = next(iter(found)) if self.name is None else self.name
            if name not in found:
                raise ValueError(f"{path} has no [materials.{name}]; it has {', '.join(found) or 'none'}")
            given = {} if self.depth is None else {"depth": self.depth}
            try:
                with refusing(found[name], f"materials.{name}"):
                    table = OwnTable.validate_python(found[name])
                    table = table.model_validate(table.model_dump(exclude_unset=True) | given)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
        return table.build(path.parent)


OwnTable: TypeAdapter[PartTable] = TypeAdapter(one_of(*OWN))
"""The materials that a file may hold: no further files."""

if TYPE_CHECKING:
    MaterialTable = PartTable
else:
    MaterialTable = one_of(*OWN, PresetTable, FileTable)
