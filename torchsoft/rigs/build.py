"""A rig file, from TOML or from tables in Python: read, changed, and built."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from torchsoft.display import Shown, suggestion
from torchsoft.physics.rig import Rig
from torchsoft.rigs import assembly, naming
from torchsoft.rigs.built import BuiltRig
from torchsoft.rigs.fields import called_alike
from torchsoft.rigs.motion import flattened
from torchsoft.rigs.places import listed, replaced
from torchsoft.rigs.schema import RigTables
from torchsoft.tables import InvalidTable, from_toml, line

READY = Path(__file__).with_name("ready")
"""Folder of the ready rigs."""


def ready() -> list[str]:
    """Names of the ready rigs."""
    return sorted(path.stem for path in READY.glob("*.toml"))


class RigFile(Shown, RigTables):
    """A rig and its run. SI units throughout: m, kg, s, N, rad, Pa; 4.59e-3 is 4.59 mm. The model
    is planar: x to the right, y upwards, theta anticlockwise."""

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read from a TOML file. Raises `ValueError` in one sentence with the file and the field,
        and `OSError`."""
        return from_toml(path, lambda tree: cls.from_tree(tree, Path(path).parent))

    @classmethod
    def ready(cls, name: str) -> Self:
        """A ready rig, such as "paper". Raises `ValueError` naming those that there are."""
        if name not in ready():
            known = suggestion(name, ready(), "there are")
            raise ValueError(f"there is no ready rig `{line(name, 80)}`; {known}")
        return cls.from_toml(READY / f"{name}.toml")

    @staticmethod
    def path(name: str | Path, folder: Path = Path()) -> Path:
        """Path of a rig file that is named from a folder, or of a ready rig of that name. Raises
        `ValueError` for a file that is not there."""
        path = folder / name
        if not path.exists() and str(name) in ready():
            return READY / f"{name}.toml"
        if not path.exists():
            raise ValueError(
                f"{line(path)}: No such file or directory; the ready rigs are {', '.join(ready())}"
            )
        return path

    @classmethod
    def from_tree(cls, tree: Any, folder: Path = Path()) -> Self:
        """Read from the parsed TOML of a file in `folder`. Raises `ValueError`."""
        if isinstance(tree, dict) and "motion" in tree:
            tree = tree | {"motion": flattened(tree["motion"])}
        file = cls.model_validate(tree)
        file._folder = folder
        return file

    def override(
        self, values: Mapping[str, Any] | None = None, /, **groups: dict[str, Any]
    ) -> Self:
        """A copy with some entries replaced, by their names, full or short, or by tables:
        `override({"materials.rubber.E": 1e6}, outputs={"duration": 0.1})`. Entries of lists are
        counted from one: tau_2, or gain_1_3, the third of the first row.

        A name stands for what is there, of which nothing is left. Tables are merged with those that
        are there; a table of another kind replaces the old one as a whole. What was replaced loses
        its source. Raises `ValueError`.
        """
        file = self
        if groups:
            own = self.model_dump(exclude_unset=True)
            try:
                file = self._with(naming.merged(own, groups))
            except InvalidTable as error:
                raise InvalidTable(f"{error}{called_alike(str(error), own, groups)}") from None
        if values:
            full = {name: value for key, value in values.items() for name in file.full(key)}
            file = file._with(replaced(file, full))
        return file

    def _with(self, tree: dict[str, Any]) -> Self:
        """This file with other tables, and the names and sources that are still true of them."""
        bare = {key: x for key, x in tree.items() if key not in ("names", "sources")}
        made = type(self).from_tree(bare, self._folder)
        kept = naming.still_true(self, made, tree)
        known = {"names": self.names, "sources": self.sources}
        own = {key: {name: known[key].get(name) for name in x} for key, x in kept.items()}
        if listed(own) == listed(kept):  # nothing that was not validated before
            return made.model_copy(update=own)
        return type(self).from_tree(bare | kept, self._folder)

    def changed(self, settings: Mapping[str, Any], /) -> Self:
        """A copy with some entries replaced as by `override`, names and tables in one. Raises
        `ValueError`."""
        names = {key: x for key, x in settings.items() if "." in key or key in self.names}
        return self.override(names, **{key: x for key, x in settings.items() if key not in names})

    def table(self) -> dict[str, dict[str, Any]]:
        """Every number that the file states, by its name: value, unit, source ("published" or
        "assumed", and where) and meaning."""
        return naming.table(self)

    def unit_of(self, name: str) -> str:
        """Unit of an entry by its name, full or short, "1" for one without. Raises `ValueError` for
        an unknown name."""
        return naming.unit_of(self, name)

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        return f"RigFile: {self.title or 'a rig'}", [
            (name, f"{line(row['value'], 40)} {row['unit']}; {row['source']}")
            for name, row in self.table().items()
        ]

    def __reduce__(self) -> Any:  # since tables of parts are no attributes of a module
        return _again, (type(self), self.model_dump(exclude_unset=True), self._folder)

    __str__ = Shown.__repr__  # pyright: ignore[reportAssignmentType]

    def assemble(self, parts: Mapping[str, Any] | None = None) -> Rig:
        """The rig without a reference; `parts` are as of `build`. Raises `ValueError` with the
        field's name for parts that are not physical."""
        return assembly.assemble(self, parts)

    def build(self, parts: Mapping[str, Any] | None = None) -> BuiltRig:
        """The rig, its initial state and its output times, ready to `run`.

        `parts` are parts of your own, by the names of those that they replace: a friction law by
        "laws.steel.friction", a shape by "bodies.disc.shape", any other by its table, such as
        "materials.rubber". Pads are settled around the bodies where these start. Raises
        `ValueError` with the field's name: for motions that cannot be, recorded ones that cannot be
        read, bodies that find no rest, and bodies too deep in a pad for it to settle.
        """
        return assembly.build(self, parts)


def _again(kind: type[RigFile], tree: Any, folder: Path) -> RigFile:
    """The rig file that was pickled."""
    return kind.from_tree(tree, folder)
