"""Question: how long does a newcomer wait for a first result?

A wheel is built from this checkout and unpacked into an empty folder, and every figure comes from
Python processes that import it from there, medians of repeats:

- imports, and commands that need no simulation;
- from the end of `import torch`: the first run of 0.3 s, then the first gradient and the first
  sensitivities, with the kernels of the wheel and, once, with none: then they are compiled. What
  many runs cost is in `validation/benchmark.py`.

Command: .venv/bin/python experiments/startup.py [--smoke]
Expected: a first result 1.5 s after `import torch`, 15 s where the kernels are compiled. Two
minutes on two cores.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from tqdm import tqdm

from torchsoft.experiment import numbers, options, timed, write
from torchsoft.solve.kernel.objects import level

ROOT = Path(__file__).resolve().parents[1]

COMMAND = "from torchsoft.cli import main; raise SystemExit(main())"

FIRST = """
import json, sys, time
import torch
torch.set_num_threads(1)
start = last = time.perf_counter()
def passed():
    global last
    now = time.perf_counter()
    out, last = now - last, now
    return out
from torchsoft import RigFile
built = RigFile.ready("paper").build()
t = torch.linspace(0, 0.3, 31, dtype=torch.float64)
prepared = passed()
built.run(t, rtol=1e-3)
times = {"model": prepared, "first run": passed(), "first result": time.perf_counter() - start}
built.run(t, rtol=1e-3)
times["second run"] = passed()
built.run(t, rtol=1e-3, gradient="discrete")["theta"].sum().backward()
times["first gradient"] = passed()
built.run(t, rtol=1e-3, gradient="forward", wrt=["contact.K_n"])
times["first sensitivities"] = passed()
print(json.dumps(times))
"""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/startup")
    repeats: int = 5  # processes of which the median is taken
    smoke: bool = False  # a size that takes seconds


def unpacked(folder: Path) -> Path:
    """The wheel of this checkout, unpacked; where to import it from."""
    build = [sys.executable, "-m", "torchsoft.solve.kernel.build"]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    made, site = folder / "wheel", folder / "site"
    wheel = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", made, ROOT]
    subprocess.run(wheel, check=True)
    install = [*pip, "install", "--no-deps", "--target", site, *made.glob("*.whl")]
    subprocess.run(install, check=True)
    return site


def python(site: Path, *arguments: object, **environment: str) -> str:
    """What a new process prints that imports the package from `site`."""
    command = [sys.executable, *map(str, arguments)]
    given = os.environ | {"PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"} | environment
    ended = subprocess.run(
        command, env=given, cwd=site.parent, capture_output=True, text=True, check=False
    )
    if ended.returncode not in (0, 2):  # 2: a file that is refused
        raise RuntimeError(ended.stderr)
    return ended.stdout


def medians(rows: Iterable[dict[str, float]]) -> dict[str, float]:
    """Of every figure."""
    every = list(rows)
    return {name: median(row[name] for row in every) for name in every[0]}


def main(config: Config) -> None:
    repeats = 1 if config.smoke else config.repeats
    result: dict[str, Any] = {"level": level()}
    with TemporaryDirectory() as name, tqdm(total=2 * repeats + 2, disable=None) as bar:
        folder = Path(name)
        site = unpacked(folder)
        wrong = folder / "wrong.toml"
        wrong.write_text("[bodies.disc]\nradius = 0.02\n", encoding="utf-8")
        commands = {
            "import torch": ("-c", "import torch"),
            "import torchsoft": ("-c", "import torchsoft"),
            "--help": ("-c", COMMAND, "--help"),
            "--version": ("-c", COMMAND, "--version"),
            "check of a wrong file": ("-c", COMMAND, "check", wrong),
        }
        bar.update()
        rows, firsts = [], []
        for _ in range(repeats):
            rows.append({k: timed(lambda v=v: python(site, *v))[1] for k, v in commands.items()})
            bar.update()
        for _ in range(repeats):
            firsts.append(json.loads(python(site, "-c", FIRST)))
            bar.update()
        result |= {"processes_s": medians(rows), "wheel_s": medians(firsts)}
        for path in (site / "torchsoft/solve/kernel/objects").rglob("*.o"):
            path.unlink()
        empty = {"TORCHSOFT_CACHE_DIR": str(folder / "cache")}
        result["fallback_s"] = json.loads(python(site, "-c", FIRST, **empty))
        bar.update()
    table = "\n\n".join(
        [
            numbers("process, wall time [s]", {"median": result["processes_s"]}, 3),
            numbers(
                "kernels, wall time [s]",
                {"of the wheel": result["wheel_s"], "compiled": result["fallback_s"]},
                3,
            ),
        ]
    )
    write(config, result, table=table)


if __name__ == "__main__":
    main(options(Config, __doc__))
