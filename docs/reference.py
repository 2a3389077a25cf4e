"""Reference pages, generated from the tables and declarations of the package whenever the
documentation is built. A key without a meaning is an error: write one where it is declared."""

import argparse
import inspect
import json
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin

from pydantic import BaseModel
from sphinx.pycode import ModuleAnalyzer

from torchsoft.cli import command_parser
from torchsoft.csvfile import UNITS
from torchsoft.datasets.config import Config as Dataset
from torchsoft.datasets.fields import Fields
from torchsoft.materials.presets import PRESETS
from torchsoft.physics.channels import EFFORT, POSE, RATE, Touch, declared
from torchsoft.rigs import RigFile, parts
from torchsoft.rigs.build import ready
from torchsoft.rigs.excite import CATALOGUE
from torchsoft.rigs.goal import Goal
from torchsoft.rigs.schema import RigTables
from torchsoft.sysid.configuration import Config as Identification
from torchsoft.sysid.unknowns import FAULTS
from torchsoft.tables import toml_value

ROOT = Path(__file__).parents[1]


Tables = list[tuple[str, type[BaseModel]]]


class Page(NamedTuple):
    """A page: its title, an introduction, headings and tables, and what follows them."""

    title: str
    introduction: str
    tables: Tables
    more: str = ""


def tables(annotation: Any) -> Iterator[type[BaseModel]]:
    """The tables within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for one in get_args(annotation):
        yield from tables(one)


def kind_of(table: type[BaseModel]) -> str:
    """Kind of a table, or its name where it has none."""
    field = table.model_fields.get("kind")
    return field.default if field else table.__name__.removesuffix("Table").lower()


def kinds(table: type[BaseModel], field: str) -> Tables:
    """Tables that a field accepts, by their kind, and the tables within them."""
    found = tables(table.model_fields[field].annotation)
    return [pair for one in found for pair in nested(one, f"`{kind_of(one)}`")]


def nested(table: type[BaseModel], heading: str = "Top level", path: str = "") -> Tables:
    """A table and all tables within it, by headings, which are the paths of their keys."""
    found: Tables = [(heading, table)]
    for name, field in table.model_fields.items():
        inner = [*tables(field.annotation)]
        within = f"{path}.{name}".lstrip(".") + ".*" * (get_origin(field.annotation) is dict)
        for one in inner:
            kind = f": {kind_of(one)}" if len(inner) > 1 else ""
            place = f"[[{within}]]" if get_origin(field.annotation) is tuple else f"[{within}]"
            found += nested(one, f"`{place}`{kind}", within)
    return found


def prose(text: str) -> str:
    """Text of a docstring as markdown; code between backticks stays as it is."""
    pieces = re.split(r"(`[^`]+`)", text)
    pieces[::2] = [re.sub(r"[\\*<>$|\[\]]", r"\\\g<0>", piece) for piece in pieces[::2]]
    pieces[1::2] = [piece.replace("|", r"\|") for piece in pieces[1::2]]
    return "".join(pieces)


def described(thing: Any, paragraphs: int | None = None) -> str:
    """The docstring of a class as markdown, or some paragraphs of it; formulas as blocks, without
    what it raises."""
    kept = []
    for one in re.split(r"\n\s*\n", inspect.getdoc(thing) or "")[:paragraphs]:
        if one.startswith("    "):
            kept.append(f"```text\n{inspect.cleandoc(one)}\n```")
        elif text := re.sub(r"\s*\bRaises\b.*", "", one, flags=re.DOTALL):
            kept.append(prose(" ".join(text.split())))
    return "\n\n".join(kept)


def grid(heading: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in markdown."""
    lines = [list(heading)]
    lines += [["---"] * len(lines[0]), *([cell.replace("\n", " ") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@cache
def attribute_docstrings(module: str) -> dict[tuple[str, str], list[str]]:
    """The docstrings below attributes of a module, by class and attribute."""
    words = ModuleAnalyzer.for_module(module)
    words.analyze()
    return words.attr_docs


def attribute_meaning(table: type[BaseModel], name: str) -> str:
    """The docstring below a field, in the table or one that it inherits from."""
    for owner in table.__mro__:
        if owner.__module__.startswith("torchsoft"):
            found = attribute_docstrings(owner.__module__).get((owner.__name__, name), [])
            if found:
                return " ".join(found).strip()
    return ""


def unit_of(row: Any) -> str:
    """Unit of a value, from its JSON schema."""
    if isinstance(row, dict):
        return row.get("unit") or next(filter(None, map(unit_of, row.values())), "")
    return next(filter(None, map(unit_of, row)), "") if isinstance(row, list) else ""


SIGNS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def bounds(row: dict[str, Any]) -> str:
    """Bounds of a number, from its JSON schema."""
    known = [key for key in SIGNS if key in row]
    inner = [key for key in known if key[0] == "e" or f"exclusive{key.capitalize()}" not in known]
    return ", ".join(f"{SIGNS[key]} {row[key]:g}" for key in inner)


def value(row: dict[str, Any], where: dict[str, str]) -> str:
    """What a key accepts, from its JSON schema; `where` has the places of tables."""
    if "$ref" in row:
        return where[row["$ref"].rpartition("/")[2]]
    if choices := row.get("anyOf") or row.get("oneOf"):
        found = [value(one, where) for one in choices if one.get("type") != "null"]
        places = {one.rpartition("(")[2].partition("#")[0] for one in found}
        if len(found) > 4 and len(places) == 1:
            return f"[one of its kinds]({places.pop()})"
        return " or ".join(dict.fromkeys(found))
    if words := row.get("enum") or ([row["const"]] if "const" in row else []):
        return " or ".join(f"`{json.dumps(word)}`" for word in words)
    kind = row.get("type", "any")
    if kind == "array" and "prefixItems" in row:
        return f"{len(row['prefixItems'])} of: {value(row['prefixItems'][0], where)}"
    if kind == "array":
        return f"list of: {value(row['items'], where)}"
    if kind == "object" and isinstance(row.get("additionalProperties"), dict):
        entry = value(row["additionalProperties"], where)
        return entry if "](" in entry else f"by name: {entry}"
    names = {"boolean": "`true` or `false`", "string": "text", "object": "table", "any": "any"}
    return " ".join(filter(None, (names.get(kind, kind), bounds(row))))


def default(table: type[BaseModel], name: str, meaning: str) -> str:
    """Default of a key as TOML has it, where its meaning does not state it."""
    field = table.model_fields[name]
    if "if not given" in meaning:
        return ""
    if field.is_required():
        return "required"
    given = field.get_default(call_default_factory=True)
    empty = given in (None, "", (), {}) or isinstance(given, BaseModel) or given != given
    return "" if empty else f"`{toml_value(given)}`"


def keys(table: type[BaseModel], where: dict[str, str]) -> str:
    """Every key of a table: what it accepts, unit, default and meaning. Raises `ValueError` for a
    key without a meaning."""
    rows = []
    for name, row in table.model_json_schema()["properties"].items():
        if "const" in row or (name == "files" and issubclass(table, Fields)):
            continue  # the kind, which is the heading, and what the command fills in
        text, unit = row.get("description") or attribute_meaning(table, name), unit_of(row)
        if not text:
            raise ValueError(
                f"{table.__name__}.{name} has no meaning; write one where it is declared"
            )
        stated = re.search(r" \[([^\[\]]+)\]$", text)
        if stated and unit in ("", stated[1]):
            text, unit = text[: stated.start()], stated[1]
        shown = default(table, name, text)
        rows.append((f"`{name}`", value(row, where), unit, shown, prose(text)))
    return grid(("key", "accepts", "unit", "default", "meaning"), rows)


def declared_pages() -> dict[str, Page]:
    """The pages by the names of their files."""
    laws = [("Contact laws", parts.LawTable), *kinds(parts.LawTable, "friction")]
    elsewhere = {
        "shapes": Page("Shapes", SHAPES, kinds(parts.BodyTable, "shape")),
        "pads": Page("Pads", PADS, kinds(RigTables, "pads")),
        "materials": Page("Materials", MATERIALS, kinds(RigTables, "materials"), presets()),
        "laws": Page("Contact and friction laws", LAWS, laws),
        "motions": Page("Motions", MOTIONS, kinds(RigTables, "motion")),
    }
    there = {table for page in elsewhere.values() for _, table in page.tables}
    rigs = [(heading, table) for heading, table in nested(RigTables) if table not in there]
    return {
        "rigs": Page("Rig files", RIGS, rigs, ready_rigs()),
        **elsewhere,
        "channels": Page("Channels", CHANNELS, [], channels()),
        "identification": Page("Identification files", STUDY, nested(Identification), faults()),
        "goals": Page("Goals of a plan", GOALS, nested(Goal)),
        "datasets": Page("Dataset files", SETS, nested(Dataset), arrays()),
        "commands": Page("Commands", "Every command has `--help`.", [], command_line()),
    }


SHAPES = "Values of `shape` in `[bodies.*]`, by their `kind`."
PADS = "Tables `[pads.*]`, by their `kind`; a block if none is given."
MOTIONS = "Tables `[motion.*]`, by their `kind`."
GOALS = "A goal is the second file of `torchsoft plan`."
RIGS = """\
A rig and its run are one TOML file, in SI units. The model is planar: x points to the right, y
upwards, and angles are positive anticlockwise. A table `[bodies.*]` is written `[bodies.disc]` for
a body called `disc`. `torchsoft init` writes a commented file, and [Rigs and laws](../rigs.md)
shows how to use the tables."""
MATERIALS = """\
Tables `[materials.*]`, by their `kind`. `shore_a` may be given in place of E: the modulus is then
estimated from the hardness."""
LAWS = """\
A contact law is a table `[laws.*]`, whose `friction` is one of the kinds below. A value `"auto"` is
computed from the pads that have the law: springs are ten times as stiff as the pad's surface
over one contact point, and dashpots are scaled to its shortest retardation time."""
CHANNELS = """\
A channel is the series of one number in a run, such as `run["x_C"]`. Channels are named after the
bodies (or their `symbol`), motions, actuators, contacts and pads of the rig file."""
FORCES = """\
Contact forces, which sensors can measure too: `normal` and `shear` are the forces at each contact
point or taxel, `centre` is the centre of pressure along the undeformed surface, from its middle,
`force` is the force of the pad on its base in the base's axes, and `load` is the force and moment
of all contacts and pads on a body in world axes."""
STUDY = """\
An identification is one TOML file beside the data, in SI units. Headings of CSV files state the
[units of their columns](#units-of-columns)."""
SETS = """\
A dataset is one TOML file. A number in `[parameters]` is a table with `low` and `high`, with `mean`
and `sd`, or with `choices`."""
INDEX = """\
These pages are generated from the declarations in the code. They list every key with the values
that it accepts, its unit, its default and its meaning. Other values are rejected with an error that
names the key. The [Python API](../api/index.md) is described separately."""


def ready_rigs() -> str:
    """The ready rigs by name."""
    rows = ((f"`{name}`", prose(RigFile.ready(name).title)) for name in ready())
    text = "The name of a ready rig may be given wherever a rig file is expected."
    return f"## Ready rigs\n\n{text}\n\n{grid(('name', 'content'), rows)}"


def presets() -> str:
    """Rubbers from the literature."""
    rows = []
    for name, one in PRESETS.items():
        known = {k: c for k, c in one.coefficients.items() if c.source != "assumed"}
        numbers = ", ".join(f"{symbol} = {c.value:.4g}" for symbol, c in known.items())
        rows.append((name, numbers, prose(next(iter(known.values())).origin)))
    text = 'Names for `kind = "preset"`, with the values that have a source (E and mu in Pa).'
    return f"## Presets\n\n{text}\n\n{grid(('name', 'values', 'source'), rows)}"


def channels() -> str:
    """Channels of two ready rigs."""
    text = []
    for name in ("paper", "two_fingers"):
        rig = RigFile.ready(name).assemble()
        found = {one.name: one for one in reversed([*declared(rig)])}
        rows = [
            (f"`{one.name}`", one.unit, prose(one.meaning),
             "yes" if one.kind in (POSE, RATE, EFFORT) else "")
            for one in reversed(found.values())
        ]  # fmt: skip
        text += [f"## Of the rig `{name}`", grid(("channel", "unit", "meaning", "sensor"), rows)]
        touch = Touch(rig)
        single = [(f"`{key}`", one.unit) for key, one in touch.single.items() if key not in found]
        single += [(f"`{key}.0` to `{key}.{n - 1}`", "N") for key, n in touch.arrays.items()]
        text += [FORCES, grid(("channel", "unit"), single)]
    return "\n\n".join(text)


def faults() -> str:
    """Faults of sensors, units of columns, and excitations."""
    rows = [
        (
            f"`{name}`",
            one.unit.format("its unit"),
            "yes" * one.one_sided,
            one.clause or "not tested",
        )
        for name, one in FAULTS.items()
    ]
    text = (
        "A fault is identified if the sensor states its largest size. Others are tested after the "
        "fit, as assumptions."
    )
    heading = ("fault", "unit", "not negative", "tested as: the readings ...")
    units = [(f"`{si}`", ", ".join(f"`{one}`" for one in known)) for si, known in UNITS.items()]
    named = [(f"`{name}`",) for name in CATALOGUE]
    return "\n\n".join((
        "## Faults of sensors", text, grid(heading, rows),
        "## Units of columns", "Units that headings of CSV files may have.",
        grid(("SI unit", "in headings"), units),
        "## Excitations", "Motions that `design.candidates` may name.", grid(("name",), named),
    ))  # fmt: skip


def arrays() -> str:
    """Arrays of a dataset."""
    made = Dataset.from_toml(ROOT / "data_gen" / "configs" / "smoke.toml")
    rows = [
        (f"`{name}`", ", ".join(one.sizes), one.unit, prose(one.meaning))
        for name, one in made.subject.variables.items()
    ]
    text = (
        "Arrays of `data_gen/configs/smoke.toml`, whose rig is `paper`. Those of other rigs are "
        "named after their bodies, motions, contacts and pads in the same way."
    )
    heading = ("array", "dimensions", "unit", "meaning")
    return f"## Arrays\n\n{text}\n\n{grid(heading, rows)}"


def command_line() -> str:
    """Every command with its arguments."""
    return "\n\n".join(of_parser(command_parser()))


def argument(one: argparse.Action) -> str:
    """An argument of a command as it is written."""
    names = ", ".join(one.option_strings)
    values = "" if one.nargs == 0 else str(one.metavar or one.dest.upper())
    values = " ".join(one.metavar) if isinstance(one.metavar, tuple) else values
    return f"{names} {values}".strip()


def of_parser(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Sections of a command, or of the commands below it."""
    groups = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    if not groups:
        usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
        yield f"## `{parser.prog}`\n\n```text\n{usage}\n```"
        yield from (prose(one) for one in re.split(r"\n\s*\n", parser.description or ""))
        show = parser._get_formatter()
        rows = [
            (f"`{argument(one)}`", prose(show._expand_help(one) if one.help else ""))
            for one in parser._actions
            if not isinstance(one, argparse._HelpAction)
        ]
        if rows:
            yield grid(("argument", "meaning"), rows)
    for group in groups:
        for one in dict.fromkeys(group.choices.values()):
            yield from of_parser(one)


def pages() -> dict[str, str]:
    """Markdown of every page of the reference, by the name of its file. Raises `ValueError` for a
    key without a meaning, `KeyError` for a table that is on no page."""
    every, where = declared_pages(), dict[str, dict[str, str]]()
    for name, page in every.items():
        for heading, table in page.tables:
            slug = re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
            link = f"[{heading}]({name}.md#{slug})"
            where.setdefault(table.__name__, {}).setdefault(name, link)
    out = {}
    for name, page in every.items():
        near = {table: own.get(name, next(iter(own.values()))) for table, own in where.items()}
        sections = [f"# {page.title}", page.introduction]
        first = {table: heading for heading, table in reversed(page.tables)}
        for heading, table in page.tables:
            if first[table] == heading:
                text = described(table, 1 if name == "shapes" else None)
                sections += [f"## {heading}", text, keys(table, near)]
        out[f"{name}.md"] = "\n\n".join(filter(None, (*sections, page.more))) + "\n"
    contents = "```{toctree}\n" + "\n".join(every) + "\n```\n"
    out["index.md"] = f"# Files, channels and commands\n\n{INDEX}\n\n{contents}"
    return out


def write(folder: Path) -> None:
    """Write the pages to a folder; unchanged ones stay as they are, so that nothing is built
    again."""
    folder.mkdir(exist_ok=True)
    for name, text in pages().items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
