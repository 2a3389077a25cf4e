"""Frame of an experiment: options from the command line, output times, tables, the summary and the
figures."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import lfilter
from torch import Tensor
from tqdm import tqdm

from torchsoft import Rig
from torchsoft.display import markdown
from torchsoft.extras import needed
from torchsoft.files import save_text, write_json
from torchsoft.parallel import parallel_map
from torchsoft.plot.figures import save
from torchsoft.rigs.build import RigFile
from torchsoft.sysid.synthetic import good_sensors

C = TypeVar("C")
T = TypeVar("T")

STEPS = (1e-6, 0.02)
"""Shortest and longest step [s]."""

SMALLEST, LARGEST = 1e-9, 1e6
"""Bounds of all other numbers; counts, seeds and entries of lists may be zero."""

RIG = good_sensors(RigFile.ready("paper").assemble())
"""Sensors of the paper's rig, by channel."""

COARSE: dict[str, Any] = {
    "pad.elements_x": 60,
    "pad.elements_y": 2,
}  # Parameters of half the usual mesh.


def options(config: type[C], description: str | None) -> C:
    """The command line as a configuration; torch computes on one thread from here on.

    Ends with status 2 and a sentence for a number that no experiment can use.
    """
    torch.set_num_threads(1)
    given: Any = needed("tyro", "experiments").cli(config, description=description)
    for name, value in asdict(given).items():
        least = 0.0 if isinstance(value, tuple | int) else SMALLEST
        for one in value if isinstance(value, tuple) else (value,):
            low, high = STEPS if name == "step" else (least, LARGEST)
            if isinstance(one, int | float) and not low <= one <= high:
                option = f"--{name.replace('_', '-')}"
                print(
                    f"error: {option} should be from {low:g} to {high:g}, not {one!r}",
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
    out = function()
    return out, perf_counter() - start


def repeated(found: Callable[[int], T], count: int, workers: int, label: str) -> list[T]:
    """Results of so many seeds, in their order, with progress."""
    work = tqdm(parallel_map(found, count, workers), desc=label, total=count, disable=None)
    return [one for _, one in sorted(work, key=lambda pair: pair[0])]


def coloured(count: int, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise (count,) of deviation 1 whose neighbouring samples correlate by `rho`."""
    white = rng.standard_normal(count)
    white[1:] *= (1 - rho**2) ** 0.5
    return np.asarray(lfilter([1.0], [1.0, -rho], white))


@torch.no_grad()
def at_the_points(rig: Rig, t: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Penetration [m] and slip speed [m/s] of all contact points, (T, points) each, in the states y
    (T, size)."""
    state = rig.unpack(y, rig.follow(t))
    depths, speeds = [], []
    for name, interface in rig.evaluate(t, state).interfaces.items():
        depths.append(interface.frame.g)
        at = rig.contacts[name].law(
            depths[-1], *interface.flow.unbind(-1), state.stretch[name], rig.weight(name),
            z=state.friction[name].mT if name in state.friction else None,
        )  # fmt: skip
        speeds.append(at.gamma_dot.abs())
    return torch.cat(depths, -1), torch.cat(speeds, -1)


def numbers(title: str, rows: Mapping[str, Mapping[str, float]], digits: int = 4) -> str:
    """A Markdown table of numbers: a line for each of the rows, a column for each name in the first
    of them."""
    names = list(next(iter(rows.values())))
    cells = [
        (key, *(f"{row[name]:.{digits}g}" if name in row else "" for name in names))
        for key, row in rows.items()
    ]
    return markdown((title, *names), cells)


def write(
    config: Any,
    content: Mapping[str, Any],
    figures: Mapping[str, Figure] | None = None,
    table: str = "",
) -> None:
    """Write to the configured folder `summary.json`, with version and configuration at the top,
    figures by name, and `table.md` if there is a table, which is printed too; each file appears
    whole or not at all."""
    options = {
        name: str(one) if isinstance(one, Path) else one for name, one in asdict(config).items()
    }
    write_json(
        config.out / "summary.json",
        {"torchsoft": version("torchsoft"), "config": options, **content},
    )
    for name, figure in (figures or {}).items():
        save(figure, config.out / f"{name}.png")
    if table:
        print(f"\n{table}\n")
        save_text(config.out / "table.md", table + "\n")
    print(f"written to {config.out}")
