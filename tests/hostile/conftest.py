"""Counts what the hostile trial tried and what did not hold, and prints the table at the end."""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hostile import trial
from hostile.trial import Tally

TABLE = Path(os.environ.get("HOSTILE_OUT", "out/hostile"))


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Iterator[Callable[[str], Tally]]:
    """`tally("kind")` begins a line of the table; the test fails if anything in it did not hold."""
    lines: list[Tally] = []

    def begin(kind: str) -> Tally:
        lines.append(Tally(kind))
        return lines[-1]

    yield begin
    TABLE.mkdir(parents=True, exist_ok=True)
    for line in lines:
        name = "".join(c if c.isalnum() else "_" for c in line.kind)
        content = {
            "kind": line.kind,
            "tried": line.tried,
            "not_held": len(line.broken),
            "broken": line.broken,
        }
        (TABLE / f"{name}.json").write_text(json.dumps(content, indent=1))
    broken = [text for line in lines for text in line.broken]
    assert all(line.tried for line in lines), "nothing was tried"
    assert not broken, f"{len(broken)} did not hold, the first: {broken[0]}"


@pytest.fixture
def count() -> Callable[[int], int]:
    """How many trials, of so many at full scale (`hostile.trial.count`)."""
    return trial.count


@pytest.fixture
def random() -> Callable[..., np.random.Generator]:
    """Makes a generator of its own for every key (`hostile.trial.random`)."""
    return trial.random


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The table of what was tried, of every process."""
    rows = (
        [json.loads(file.read_text()) for file in sorted(TABLE.glob("*.json"))]
        if TABLE.is_dir()
        else []
    )
    if rows:
        terminalreporter.write_sep("-", "hostile trial")
        for row in rows:
            held = row["tried"] - row["not_held"]
            terminalreporter.write_line(
                f"{row['kind']:<60} tried {row['tried']:>6}  held {held:>6}  not held "
                f"{row['not_held']:>4}"
            )
