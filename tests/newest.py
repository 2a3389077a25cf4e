"""The wheel with the newest versions of everything: built, installed without constraints into a
fresh environment outside the checkout, and used from an empty folder. `python tests/newest.py
PYTHON`; prints versions and times."""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = """
from importlib.metadata import distributions
print(*sorted(f"{one.name} {one.version}" for one in distributions() if "nvidia" not in one.name))
"""
EXTRAS = "reduced,datasets,export,learn"
GRADIENT = """
import torch
from torchsoft import RigFile
file = RigFile.ready("paper")
built = file.build()
t = torch.linspace(0, 0.05, 6, dtype=torch.float64)
run = built.run(t, gradient="discrete")
run["y_C"][-1].backward()
slope = built.rig.parameter("materials.rubber.E").grad
assert torch.isfinite(slope) and slope != 0
class Straight(torch.autograd.Function):
    forward = staticmethod(lambda ctx, x: x.clamp(max=0.5))
    backward = staticmethod(lambda ctx, g: g)
try:
    law = lambda E, F_N, R: Straight.apply(E) / R
    file.build({"laws.steel_on_rubber.friction": law}).run(t)
except TypeError as error:
    assert "the torch.autograd.Function" in str(error), error
else:
    raise SystemExit("a law with a backward of its own was not refused")
"""


def main(python: str) -> None:
    """Raises `CalledProcessError` for the first step that fails."""
    begin = time.monotonic()

    def run(*command: object, where: Path) -> None:
        start = time.monotonic()
        subprocess.run([str(one) for one in command], cwd=where, check=True)
        print(
            f"[{time.monotonic() - start:6.1f} s] {' '.join(map(str, command))[:100]}", flush=True
        )

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, work = folder / "source", folder / "empty"
        work.mkdir()
        shutil.copytree(
            ROOT,
            source,
            ignore=shutil.ignore_patterns(".venv", ".git", "out", "__pycache__", "build"),
        )
        run(python, "-m", "venv", folder / "venv", where=folder)
        bin = folder / "venv" / "bin"
        run(
            bin / "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--wheel-dir",
            folder,
            source,
            where=folder,
        )
        wheel = next(folder.glob("torchsoft*.whl"))
        run(bin / "pip", "install", "--quiet", wheel, where=folder)
        run(bin / "python", "-c", VERSIONS, where=work)
        shutil.copytree(ROOT / "examples" / "identify", work / "examples" / "identify")
        run(bin / "torchsoft", "init", "mine", where=work)
        run(bin / "torchsoft", "check", "mine.toml", where=work)
        run(bin / "torchsoft", "run", "mine.toml", "--out", "out", where=work)
        run(
            bin / "torchsoft",
            "identify",
            "examples/identify/rolling.csv",
            "examples/identify/rolling.toml",
            "--out",
            "fit",
            where=work,
        )
        run(bin / "python", "-c", GRADIENT, where=work)
        run(bin / "pip", "install", "--quiet", f"{wheel}[{EXTRAS}]", where=folder)
        run(bin / "python", "-c", VERSIONS, where=work)
        example = ROOT / "examples" / "gallery" / "reduced_model.py"
        run(bin / "python", example, where=work)
        small = ROOT / "data_gen" / "configs" / "smoke.toml"
        run(bin / "torchsoft", "dataset", "make", small, "--out", "set", where=work)
        run(bin / "torchsoft", "dataset", "check", "set", where=work)
    print(f"all of it in {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main(sys.argv[1])
