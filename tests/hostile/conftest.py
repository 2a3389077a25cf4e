"""The fixtures that count and that are quick to write to, and the table at the end."""

import os
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from hostile.trial import Tally

ATTACKS = "attacks"
"""Under this name a test reports how many attacks it tried, and how many did not hold."""


@pytest.fixture
def memory(tmp_path):
    """A folder that is flushed at once, where there is one: waiting for a disk would take most of
    the trial's time."""
    if os.access("/dev/shm", os.W_OK):
        with TemporaryDirectory(dir="/dev/shm") as folder:
            yield Path(folder)
    else:
        yield tmp_path


@pytest.fixture
def tally(record_property):
    """Counts the attacks of a test, which fails if any of them did not hold."""
    made = Tally()
    yield made
    record_property(ATTACKS, (made.tried, len(made.broken)))
    assert made.tried, "nothing was tried"
    assert not made.broken, f"{len(made.broken)} did not hold, the first: {made.broken[0]}"


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """A line for every test that counts attacks."""
    for report in chain.from_iterable(terminalreporter.stats.values()):
        for name, value in getattr(report, "user_properties", ()):
            if name == ATTACKS:
                line = f"{report.nodeid}: tried {value[0]}, not held {value[1]}"
                terminalreporter.write_line(line)
