"""Every declared number rejects what it cannot be, with its name, the given value and what it may
be: generated from the tables of files, and from the constructors of parts."""

import inspect
import math
import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import pytest
from conftest import RUBBER
from test_rejected_calls import TRIANGLE
from torch import Tensor

import torchsoft as ts
from torchsoft.datasets.config import Config as Dataset
from torchsoft.quantity import quantities
from torchsoft.rigs.goal import Goal
from torchsoft.sysid.configuration import Config as Identification

Wrap = Callable[[Any], Any]

NO_NUMBERS = math.nan, math.inf, -math.inf, True, "soft", 10**400


# tables of files, by their JSON schemas
# ----------------------------------------------------------------------


def least(schema: dict[str, Any], defs: dict[str, Any]) -> Any:
    """A value that a schema allows."""
    if "$ref" in schema:
        return least(defs[schema["$ref"].rpartition("/")[2]], defs)
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return least(schema[several][0], defs)
    if "const" in schema or "enum" in schema:
        return schema.get("const", schema.get("enum", [None])[0])
    match schema.get("type"):
        case "object":
            needed = {*schema.get("required", ())}
            return {
                name: least(one, defs)
                for name, one in schema.get("properties", {}).items()
                if name in needed or "const" in one
            }
        case "array":
            entry = schema.get("prefixItems") or [schema["items"]] * schema.get("minItems", 0)
            return [least(one, defs) for one in entry]
        case "number" | "integer":
            return schema.get("minimum", schema.get("exclusiveMinimum", 0) + 1)
        case kind:
            return {"string": "x", "boolean": False, "null": None}[kind or "null"]


def numbers(
    schema: dict[str, Any], defs: dict[str, Any]
) -> Iterator[tuple[str, dict[str, Any], Wrap]]:
    """Every number of a schema: its name, its own schema, and what puts a value in its place."""
    if "$ref" in schema:
        schema = defs[schema["$ref"].rpartition("/")[2]]
    for one in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from numbers(one, defs)
    if schema.get("type") in ("number", "integer"):
        yield "", schema, lambda value: value
    if "properties" in schema:
        table = least(schema, defs)
        for name, one in schema["properties"].items():
            for below, leaf, wrap in numbers(one, defs):
                yield f".{name}{below}", leaf, partial(put, table, name, wrap)
    if isinstance(entry := schema.get("additionalProperties"), dict):
        for below, leaf, wrap in numbers(entry, defs):
            yield f".NAME{below}", leaf, partial(put, {}, "NAME", wrap)
    items = schema.get("prefixItems") or [schema["items"]] if schema.get("type") == "array" else []
    for i, one in enumerate(items):
        for below, leaf, wrap in numbers(one, defs):
            row = [least(item, defs) for item in items]
            yield f".{i}{below}", leaf, partial(put, row, i, wrap)


def put(whole: Any, key: Any, wrap: Wrap, value: Any) -> Any:
    """A copy of a table or list with a value in it."""
    out = whole.copy()
    out[key] = wrap(value)
    return out


def outside(leaf: dict[str, Any]) -> list[Any]:
    """Numbers just outside the bounds of a schema."""

    def by(x):
        return 1 if leaf["type"] == "integer" else 1e-9 * abs(x) or 1e-9

    out = [leaf[key] for key in ("exclusiveMinimum", "exclusiveMaximum") if key in leaf]
    ends = ("minimum", -1), ("maximum", 1)
    return out + [leaf[key] + side * by(leaf[key]) for key, side in ends if key in leaf]


RIG = ts.RigFile.ready("drop").model_dump(exclude_unset=True)
FILES = {
    "rig": (ts.RigFile, ts.RigFile.from_tree, RIG),
    "goal": (Goal, Goal.model_validate, least(Goal.model_json_schema(), {})),
    "identification": (
        Identification, Identification.model_validate,
        {"rig": "paper", "unknowns": {}, "sensors": {}},
    ),
    "dataset": (Dataset, Dataset.model_validate, {"rig": RIG, "seed": 0, "trajectories": 1}),
}  # fmt: skip


def rows() -> Iterator[Any]:
    """Every number of every file."""
    for file, (table, _, _) in FILES.items():
        schema = table.model_json_schema()
        for name, leaf, wrap in numbers(schema, schema.get("$defs", {})):
            yield pytest.param(file, name, leaf, wrap, id=f"{file}{name}")


def accepted(call: Callable[[Any], object], name: str, values: Iterable[Any]) -> list[str]:
    """Values that a call takes, or rejects without naming the field, the value and the remedy."""
    wrong = []
    for value in values:
        huge = isinstance(value, int) and value > 1e300
        given = "10{9}" if huge else re.escape(f"{value}")
        try:
            call(value)
        except ValueError as error:
            must = rf"\b{name}(_\d+)*\b.*(should|must).*(not|is) [\[(']*([-.e\d]+, )?{given}"
            if re.search(must, str(error)):
                continue
            wrong.append(f"{given}: {error}")
        else:
            wrong.append(f"{given} is accepted")
    return wrong


@pytest.mark.parametrize(("file", "name", "leaf", "wrap"), [*rows()])
def test_a_number_of_a_file_is_rejected_with_its_field(file, name, leaf, wrap):
    _, read, base = FILES[file]
    group, *_, last = [key for key in name.split(".") * 2 if key and not key.isdigit()]
    values = (*NO_NUMBERS, *outside(leaf))
    assert accepted(lambda x: read(base | {group: wrap(x)[group]}), last, values) == []


# constructors of parts
# ----------------------------------------------------------------------

SERIES = {"moduli": [1e5], "times": [0.1]}
BOX = {"length": 0.04, "height": 4e-3, "elements_x": 8, "elements_y": 2}
SLIP = {"mu_s": 0.8, "mu_k": 0.7}
ENERGY = {"tau": 0.01} | SERIES | {k: x for k, x in RUBBER.items() if k != "E"}
SPRINGS = {"K_n": 1e5, "R_n": 4e2, "K_t": 1e5, "R_t": 4e2}

USUAL = {
    "shape": ts.Circle(0.02), "material": ts.KelvinVoigt(**RUBBER, tau=0.01),
    "mesh": ts.PadMesh(**BOX), "friction": ts.Coulomb(0.8, 0.7), "law": ts.PD(1.0, 1.0),
}  # fmt: skip
"""The other parts of a rig, and arguments of parts."""

PARTS = {
    "shape": {
        ts.Circle: {"radius": 0.02},
        ts.Ellipse: {"a": 0.03, "b": 0.02},
        ts.Superellipse: {"a": 0.03, "b": 0.02, "n": 3.0},
        ts.RoundedBox: {"half_width": 0.02, "half_height": 0.02, "radius": 5e-3},
        ts.RoundedPolygon: {"vertices": TRIANGLE, "radius": 2e-3},
        ts.Eccentric: {"contour": USUAL["shape"], "centre_x": 1e-3, "centre_y": 1e-3},
    },
    "body": {
        ts.Body: {"mass": 0.4, "shape": USUAL["shape"], "inertia": None, "inertia_ratio": 1.0},
    },
    "material": {
        ts.KelvinVoigt: RUBBER | {"tau": 0.01},
        ts.StandardLinearSolid: RUBBER | {"E_instant": 1e6, "tau": 0.1, "tau_instant": 1e-4},
        ts.GeneralisedKelvin: RUBBER | {"J": [0.6], "tau": [0.1], "tau_instant": 1e-4},
        ts.Prony: RUBBER | {"moduli": [1e5], "tau": [0.1], "tau_instant": 1e-4},
        ts.NeoHookean: RUBBER | {"tau": 0.01} | SERIES,
        ts.MooneyRivlin: ENERGY | {"C10": 1e5, "C01": 2e4},
        ts.Yeoh: ENERGY | {"C10": 1e5, "C20": 1e4, "C30": 1e3},
        ts.Ogden: ENERGY | {"mu": [2e5], "alpha": [2.0]},
    },
    "mesh": {
        ts.PadMesh: BOX,
        ts.CurvedPadMesh: BOX | {"radius": 0.2},
        ts.FingertipMesh: {"radius": 0.01, "elements_around": 8},
    },
    "pad": {
        ts.Pad: {"mesh": USUAL["mesh"], "material": USUAL["material"], "E_ratio": 1.0,
                 "tau_ratio": 1.0},
    },
    "friction": {
        ts.Coulomb: SLIP,
        ts.SmoothSlip: SLIP | {"v_s": 0.05, "R_pad": 100.0},
        ts.AgeingSlip: SLIP | {"v_s": 0.05, "ageing": 0.01, "D_c": 1e-5, "t_0": 0.1,
                               "age_0": 1.0},
        ts.RateAndState: {"mu_0": 0.6, "a": 0.01, "b": 0.015, "D_c": 5e-5, "V_0": 1e-6,
                          "theta_0": 1.0},
    },
    "contact": {
        ts.SoftContact: SPRINGS | {"friction": USUAL["friction"], "node_spacing": 1e-3,
                                   "power": 1.5, "adhesion": 0.1, "friction_ratio": 1.0},
    },
    "law": {
        ts.PD: {"Kp": 1.0, "Kd": 1.0},
        ts.Integral: {"law": USUAL["law"], "Ki": 1.0},
        ts.Lagging: {"law": USUAL["law"], "lag": 0.1},
    },
    "actuator": {
        ts.Actuator: {"measures": "disc.x", "pushes": "disc.x", "law": USUAL["law"],
                      "setpoint": "w", "limit": 1.0},
    },
    "controller": {ts.StateFeedback: {"gain": [[1.0, 1.0]]}},
    "taxels": {ts.Taxels: {"pad": "P", "width": 1e-3, "centres": [0.0], "spread": 1e-3}},
    "rig": {
        ts.Rig: {"bodies": {"disc": ts.Body(0.4, inertia=1e-4)}, "pads": {}, "contacts": {},
                 "gravity": 9.81},
    },
}  # fmt: skip
"""Arguments of every public part with declared numbers, by its place in a rig."""


CALLED = {"moduli": "E", "times": "tau"}
"""Parameters that have another name than the argument."""

ALLOWED = {
    (ts.CurvedPadMesh, "radius"): (math.inf, -math.inf),  # flat
    (ts.RoundedPolygon, "radius"): (10.0 + 1e-8,),  # does not fit on the polygon
}


def used(place: str, kind: type, given: dict[str, Any]) -> Tensor:
    """The start of a small rig with the part in its place."""
    part = {**USUAL, place: kind(**given)}
    body = part.get("body") or ts.Body(0.4, part["shape"])
    pad = part.get("pad") or ts.Pad(part["mesh"], part["material"])
    law = part.get("contact") or ts.SoftContact(**SPRINGS, friction=part["friction"])
    push = ts.Actuator("disc.x", "disc.x", part["law"], setpoint="w")
    actuators = {"a": part.get("actuator") or push}
    if place == "controller":
        names = {"measures": ["disc.x"], "setpoints": ["w"], "pushes": {"x": "disc.x"}}
        actuators = ts.controller(part["controller"], **names)
    rig = part.get("rig") or ts.Rig(
        bodies={"disc": body}, pads={"P": pad}, contacts={"c": ts.Contact("P", "disc", law)},
        actuators=actuators, taxels={"t": part["taxels"]} if place == "taxels" else {},
        reference=ts.hold(w=0.0),
    )  # fmt: skip
    return rig.state(disc={"x": 0.0, "y": 0.2})


def changed(given: Any, value: Any) -> Any:
    """A number, or the first of a list, replaced."""
    if isinstance(given, list | tuple):
        return [changed(given[0], value), *given[1:]]
    return value


KINDS = [(place, kind) for place, kinds in PARTS.items() for kind in kinds]
DECLARED = [
    pytest.param(place, kind, name, declared, id=f"{kind.__name__}-{name}")
    for place, kind in KINDS
    for name, declared in quantities(kind).items()
    if name in inspect.signature(kind).parameters
]


@pytest.mark.parametrize(("place", "kind"), KINDS)
def test_a_part_with_possible_numbers_is_accepted(place, kind):
    assert used(place, kind, PARTS[place][kind]).isfinite().all()


@pytest.mark.parametrize(("place", "kind", "name", "declared"), DECLARED)
def test_a_number_of_a_part_is_rejected_with_its_name(place, kind, name, declared):
    given = PARTS[place][kind]
    ends = {"type": "number", "minimum": declared.low, "maximum": declared.high}

    def call(value):
        return used(place, kind, given | {name: changed(given[name], value)})

    values = [x for x in (*NO_NUMBERS, *outside(ends)) if x not in ALLOWED.get((kind, name), ())]
    assert accepted(call, CALLED.get(name) or name, values) == []


def test_every_public_part_with_declared_numbers_is_here():
    public = (getattr(ts, name) for name in ts.__all__)
    declared = {part for part in public if isinstance(part, type) and quantities(part)}
    assert declared - {kind for _, kind in KINDS} == {ts.Hyperelastic}  # the base of the energies
