"""Mutated configurations of every kind: accepted and then finite, or refused in a sentence that
names the field."""

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from hostile.asked import ask
from hostile.mutation import Mutant, written
from hostile.trial import SEED, Tally, count, random
from torchsoft import Parameters, SoftGrasp, rest, simulate
from torchsoft.cost import Costly, agree
from torchsoft.datasets.config import Config
from torchsoft.datasets.generate import cost
from torchsoft.datasets.simulation import points, task
from torchsoft.excitation import Excitation, begin
from torchsoft.tables import Table, from_toml

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
COARSE = {"elements_x": 20, "elements_y": 1}
SMALL = 1e-3
"""Meshes whose stiffness takes more memory than this [GiB] are not built here."""

PARAMETERS: dict[str, Any] = Parameters().model_dump()
PARAMETERS["pad"] |= COARSE

MOTIONS: tuple[dict[str, Any], ...] = (
    {"kind": "slow_roll", "travel": 5e-3},
    {"kind": "strokes", "travel": 5e-3, "stroke_time": 0.2},
    {
        "kind": "multi_sine",
        "amplitude_x": 1e-3,
        "amplitude_y": 1e-4,
        "frequency": [0.5, 8.0],
        "components": 3,
        "seed": 1,
    },
    {"kind": "chirp", "amplitude_x": 1e-3, "amplitude_y": 1e-4, "start": 0.3, "end": 8.0},
    {"kind": "press", "amplitude": 2e-4, "frequency": 2.0, "travel": 5e-3},
)

Follow = Callable[[Any], None]


def excitations() -> list[dict[str, Any]]:
    common = {
        "duration": 1.0,
        "depth": 1.5e-3,
        "senses": "bracket",
        "grasp_time": 0.3,
        "settle": 0.1,
        "x_C0": 60.3e-3,
    }
    return [{**common, "motion": motion} for motion in MOTIONS]


def datasets() -> list[dict[str, Any]]:
    out = [
        tomllib.loads(path.read_text())
        for path in sorted((ROOT / "data_gen" / "configs").glob("*.toml"))
    ]
    for tree in out:
        tree.setdefault("fixed", {}).update(
            {"pad.elements_x": 20, "pad.elements_y": 1, "pad.height": 4.6e-3}
        )
        tree["kinds"].append({"kind": "jerk", "depth": {"low": 2e-4, "high": 4e-4}})
    return out


def is_finite(*tensors: torch.Tensor) -> bool:
    return all(bool(torch.isfinite(x).all()) for x in tensors)


def run_briefly(p: Parameters) -> None:
    """The rig at rest and three steps on."""
    if p.pad.memory > SMALL or p.pad.elements_x * p.contact.points > 500:
        return
    model = SoftGrasp(p)
    y0 = rest(model).detach()
    assert is_finite(y0), "the state at rest is not finite"
    run = simulate(model, torch.tensor([0.0, 2e-3, 6e-3], dtype=torch.float64), y0=y0, step=2e-3)
    assert is_finite(run.y, *run.channels.values()), "the run is not finite"


def excite_briefly(e: Excitation) -> None:
    """The grasp, and its reference to the end."""
    p = Parameters().override({f"pad.{name}": value for name, value in COARSE.items()})
    begun = begin(e, p)
    t = torch.linspace(0, e.duration, 101, dtype=torch.float64)
    assert is_finite(begun.y0, begun.model.follow(t)), "the reference is not finite"
    run = simulate(begun.model, t[:1].new_tensor([0.0, 2e-3, 6e-3]), y0=begun.y0, step=2e-3)
    assert is_finite(run.y), "the run is not finite"


def design_briefly(config: Config) -> None:
    """The cost, the first tasks of the design, and one of their references; a costly set needs the
    user's word."""
    expected = cost(config, 2)
    assert np.isfinite(expected).all(), f"no estimate: {expected}"
    try:
        agree(expected, False, "take less")
    except Costly:
        assert expected.seconds > 3600 or expected.memory > 1
    few = config.model_copy(update={"trajectories": min(config.trajectories, 4)})
    for i, u in enumerate(points(few)):
        one = task(few, i, u)
        assert np.isfinite(
            [value for value in one.labels.values() if not isinstance(value, str)]
        ).all()
    if one.parameters.pad.memory <= SMALL:
        excite_briefly(one.excitation)


KINDS: dict[str, tuple[type[Table], Callable[[], list[dict[str, Any]]], int, int, Follow]] = {
    "parameters": (Parameters, lambda: [PARAMETERS], 6000, 3, run_briefly),
    "excitations": (Excitation, excitations, 3000, 3, excite_briefly),
    "dataset configurations": (Config, datasets, 4000, 3, design_briefly),
}
"""Of every kind of table what reads it, valid ones, how many mutants, the share of the accepted
that is followed, and how."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", ["values", "text"])
def test_a_mutated_table_is_finite_or_refused_by_its_field(
    kind: str, way: str, tally: Callable[[str], Tally], tmp_path: Path
) -> None:
    table, valid, number, every, follow = KINDS[kind]
    line, rng, trees = tally(f"{kind}: {way}"), random(1, *map(ord, kind + way)), valid()
    path = tmp_path / "mutant.toml"
    for i in range(count(number if way == "values" else number // 4)):
        tree = trees[i % len(trees)]
        changed = written(path, tree, way, i, rng)
        check = follow if i % every == 0 else None
        ask(line, kind, changed, lambda: from_toml(path, table.model_validate), check)


def scalars() -> st.SearchStrategy[Any]:
    return st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20),
        st.binary(max_size=5), st.lists(st.floats(), max_size=3),
        st.dictionaries(st.text(max_size=5), st.floats(), max_size=2),
    )  # fmt: skip


def from_schema(schema: dict[str, Any], root: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Values near those of a JSON schema: mostly of the right kind and near the bounds, sometimes
    anything."""
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rpartition("/")[2]]
    match schema:
        case {"oneOf": options} | {"anyOf": options}:
            right = st.one_of(*(from_schema(one, root) for one in options))
        case {"const": only}:
            right = st.just(only)
        case {"enum": options}:
            right = st.sampled_from(options)
        case {"type": "object", "properties": fields}:
            right = st.fixed_dictionaries(
                {}, optional={name: from_schema(one, root) for name, one in fields.items()}
            )
            needed = schema.get("required", [])
            if needed:
                right = st.fixed_dictionaries(
                    {name: from_schema(fields[name], root) for name in needed},
                    optional={
                        name: from_schema(one, root)
                        for name, one in fields.items()
                        if name not in needed
                    },
                )
        case {"type": "object"}:
            inner = schema.get("additionalProperties")
            known = st.sampled_from([*Parameters().table(), "pad.Young"])
            right = st.dictionaries(
                known,
                from_schema(inner, root) if isinstance(inner, dict) else scalars(),
                max_size=3,
            )
        case {"type": "array"}:
            inner = schema.get("items") or schema.get("prefixItems", [{}])[0]
            right = st.lists(from_schema(inner, root), min_size=1, max_size=3)
        case {"type": "number"}:
            low, high = schema.get("minimum", -1.0), schema.get("maximum", 1e3)
            right = st.one_of(st.sampled_from([low, high]), st.floats(low, high))
        case {"type": "integer"}:
            low, high = schema.get("minimum", 0), schema.get("maximum", 1000)
            right = st.one_of(st.sampled_from([low, high]), st.integers(low, high))
        case {"type": "boolean"}:
            right = st.booleans()
        case _:
            right = st.text(max_size=10)
    return st.integers(0, 19).flatmap(lambda odd: scalars() if odd == 0 else right)


@pytest.mark.parametrize("kind", KINDS)
def test_tables_from_their_schema(kind: str, tally: Callable[[str], Tally]) -> None:
    table, _, number, every, follow = KINDS[kind]
    line = tally(f"{kind}: from the schema")
    schema = table.model_json_schema()
    tried = 0

    @seeded(SEED)
    @settings(
        max_examples=count(number // 3), database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(tree=from_schema(schema, schema))
    def every_one(tree: Any) -> None:
        nonlocal tried
        tried += 1
        ask(
            line,
            kind,
            Mutant(tree, (), new=tree),
            lambda: table.model_validate(tree),
            follow if tried % every == 0 else None,
        )

    every_one()
