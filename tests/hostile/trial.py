"""Counts of the hostile trial: how many attacks, at random from which seed, and those that did not
hold.

`HOSTILE_SCALE` (1 by default) multiplies every count, `HOSTILE_SEED` (0) begins every random
choice, and `HOSTILE_OUT` (out/hostile) is the folder of the table.
"""

import json
import os
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

SCALE = float(os.environ.get("HOSTILE_SCALE", "1"))
SEED = int(os.environ.get("HOSTILE_SEED", "0"))
TABLE = Path(os.environ.get("HOSTILE_OUT", "out/hostile"))
LIMIT = 20.0
"""Most processor time [s] that one call may take, so that nothing hangs."""


class Late(BaseException):
    """A call that took too long."""


@contextmanager
def in_time(limit: float = LIMIT) -> Iterator[None]:
    """Raises `Late` in the body after `limit` [s] of processor time."""

    def late(*_: object) -> None:
        raise Late(f"still busy after {limit} s")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


class Tally:
    """A line of the table: how many attacks, and a text for each that did not hold."""

    def __init__(self, kind: str) -> None:
        self.kind, self.tried = kind, 0
        self.broken: list[str] = []

    def held(self, holds: bool, otherwise: str = "") -> None:
        """Count one attack."""
        self.tried += 1
        if not holds:
            self.broken.append(otherwise[:2000])

    def call(
        self,
        attack: str,
        function: Callable[[], Any],
        refusals: tuple[type[Exception], ...] = (ValueError, OSError),
        blamed: Callable[[str], bool] = bool,
        limit: float = LIMIT,
    ) -> Any:
        """Result of one call, which must return in time or be refused with one of `refusals`, in a
        sentence that names what is `blamed`; None where refused."""
        try:
            with in_time(limit), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                result = function()
        except refusals as refusal:
            raw = isinstance(refusal, np.linalg.LinAlgError | torch.linalg.LinAlgError)
            right = sentence(str(refusal)) and not raw and blamed(str(refusal))
            self.held(right, f"{attack}: no sentence with the field's name: {refusal!r}")
        except (Exception, Late) as error:
            self.held(False, f"{attack}: {''.join(traceback.format_exception(error))[-1500:]}")
        else:
            self.held(True)
            return result
        return None


def sentence(text: str) -> bool:
    """Whether a refusal is one sentence of this project's."""
    foreign = "\n" in text or "Traceback" in text or "validation error" in text
    return 0 < len(text) < 2000 and not foreign


def count(number: int) -> int:
    """How many attacks, of `number` at full scale."""
    return max(1, round(number * SCALE))


def random(name: str, number: int = 0) -> np.random.Generator:
    """A generator of its own for every name and number, the same in every trial of one seed."""
    return np.random.default_rng([SEED, number, *name.encode()])


@pytest.fixture
def tally():
    """`tally("kind")` begins a line of the table; the test fails if anything in it did not hold."""
    lines: list[Tally] = []

    def begin(kind: str) -> Tally:
        lines.append(Tally(kind))
        return lines[-1]

    yield begin
    TABLE.mkdir(parents=True, exist_ok=True)
    for line in lines:
        name = "".join(c if c.isalnum() else "_" for c in line.kind)
        (TABLE / f"{name}.json").write_text(json.dumps(vars(line), indent=1))
    broken = [text for line in lines for text in line.broken]
    assert all(line.tried for line in lines), "nothing was tried"
    assert not broken, f"{len(broken)} did not hold, the first: {broken[0]}"


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The table of what was tried, of every process."""
    if files := sorted(TABLE.glob("*.json")):
        terminalreporter.write_sep("-", "hostile trial")
    for file in files:
        line = json.loads(file.read_text())
        tried, broken = line["tried"], len(line["broken"])
        terminalreporter.write_line(
            f"{line['kind']:<60} tried {tried:>6}  held {tried - broken:>6}  not held {broken:>4}"
        )
