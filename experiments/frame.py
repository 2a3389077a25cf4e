"""Frame of a program: options from the command line, repetitions, tables, and `summary.json`."""

import math
import subprocess
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

COARSE: dict[str, Any] = {"pad.elements_x": 60, "pad.elements_y": 2}
"""Parameters of half the usual mesh of the paper's rig."""


def options(config: type[C], description: str | None) -> C:
    """The command line as a configuration; torch computes on one thread from here on."""
    torch.set_num_threads(1)
    commit()  # that of the code which runs, even if files change while it does
    return tyro.cli(config, description=description)


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
        (key, *(written(row[name], form) if name in row else "" for name in names))
        for key, row in rows.items()
    ]
    return Table((title, *names), cells)


def written(value: float, form: str) -> str:
    """A number in a form; "nan" and "inf" as they are, without a sign or a unit."""
    return f"{value:{form}}" if math.isfinite(value) else str(value)


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
