"""Frame of a program: options from the command line, repetitions, tables, and `summary.json`."""

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import torch
import tyro
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from torchsoft.display import markdown
from torchsoft.files import write_json
from torchsoft.parallel import parallel_map
from torchsoft.plot.figures import save

C = TypeVar("C")
T = TypeVar("T")

STEPS = (1e-6, 0.02)
"""Shortest and longest step [s]."""

SMALLEST, LARGEST = 1e-9, 1e6
"""Bounds of all other numbers; counts, seeds and entries of lists may be zero."""

COARSE: dict[str, Any] = {"pad.elements_x": 60, "pad.elements_y": 2}
"""Parameters of half the usual mesh of the paper's rig."""


def options(config: type[C], description: str | None) -> C:
    """The command line as a configuration; torch computes on one thread from here on.

    Ends with status 2 and an error for a number that no program can use.
    """
    torch.set_num_threads(1)
    commit()  # that of the code which runs, even if files change while it does
    given: Any = tyro.cli(config, description=description)
    for name, value in asdict(given).items():
        low, high = STEPS if name == "step" else (SMALLEST, LARGEST)
        if name != "step" and isinstance(value, tuple | int):
            low = 0.0
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, int | float) and not low <= one <= high:
                option = f"--{name.replace('_', '-')}"
                print(
                    f"error: {option} must be from {low:g} to {high:g}, not {one!r}",
                    file=sys.stderr,
                )
                raise SystemExit(2)
    return given


def grid(duration: float, spacing: float = 0.01) -> Tensor:
    """Equally spaced output times from 0 to `duration` [s], both included."""
    return torch.linspace(0, duration, round(duration / spacing) + 1, dtype=torch.float64)


def timed(function: Callable[[], T]) -> tuple[T, float]:
    """Result of a function, and its wall time [s]."""
    start = perf_counter()
    return function(), perf_counter() - start


def repeated(function: Callable[[int], T], count: int, workers: int, label: str) -> list[T]:
    """Results of a function of the seeds 0 to `count` - 1, in their order, with progress."""
    results = tqdm(parallel_map(function, count, workers), desc=label, total=count, disable=None)
    return [one for _, one in sorted(results, key=lambda pair: pair[0])]


@dataclass(frozen=True)
class Table:
    """A table for a page: its head and its rows."""

    head: Sequence[str]
    rows: Sequence[Sequence[object]]

    def __str__(self) -> str:
        return markdown(self.head, self.rows)


def numbers(title: str, rows: Mapping[str, Mapping[str, float]], form: str = ".4g") -> Table:
    """A table of numbers: one row for each of `rows`, one column for each name in the first."""
    names = list(next(iter(rows.values())))
    cells = [
        (key, *(f"{row[name]:{form}}" if name in row else "" for name in names))
        for key, row in rows.items()
    ]
    return Table((title, *names), cells)


@cache
def commit() -> str:
    """The commit of the checkout when it was first asked for, ending in "-dirty" where files
    differ; "unknown" without git."""
    command = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    done = subprocess.run(
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"


def write(
    config: Any,
    content: Mapping[str, Any],
    tables: Mapping[str, Table],
    figures: Mapping[str, Figure] | None = None,
) -> None:
    """Write `summary.json` and the figures to the folder `config.out`, and print the tables.

    The summary starts with version, commit and configuration, and ends with the tables. Each file
    appears whole or not at all. `python -m experiments.tables` puts the tables into the pages.
    """
    chosen = {name: str(x) if isinstance(x, Path) else x for name, x in asdict(config).items()}
    about = {"torchsoft": version("torchsoft"), "commit": commit(), "config": chosen}
    rows = {name: asdict(table) for name, table in tables.items()}
    write_json(config.out / "summary.json", {**about, **content, "tables": rows})
    for name, figure in (figures or {}).items():
        save(figure, config.out / f"{name}.png")
    for name, table in tables.items():
        print(f"\n{name}\n\n{table}")
    print(f"\nwritten to {config.out}")
