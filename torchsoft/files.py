"""Files: written whole or not at all, JSON without infinities, and the findings of pydantic in one sentence."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path beside `path` to write to, which replaces `path` at the end: the file appears whole or not at all.

    Missing folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    yield partial
    partial.replace(path)


def finite(value: Any) -> Any:
    """The value with None for every number that is not finite, which JSON cannot express."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_json(path: str | Path, content: Any, indent: int = 2) -> None:
    """Write a JSON file, with null for numbers that are not finite."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(finite(content), indent=indent, allow_nan=False) + "\n")


def findings(error: ValidationError, group: str = "") -> str:
    """pydantic's findings in one line, each with its field, which stands in `group` or by itself."""
    out = []
    for one in error.errors():
        field = ".".join(str(part) for part in (group, *one["loc"]) if part != "")
        text = one["msg"].removeprefix("Value error, ").replace("Extra inputs are not permitted", "is not known here")
        out.append(f"{field}: {text}" if field else text)
    return "; ".join(out)
