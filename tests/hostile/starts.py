"""New starts of Python: as another user, with another package, in other surroundings."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import torchsoft
from torchsoft.solve.kernel import cache

ROOT, HERE = Path(torchsoft.__file__).parents[1], Path(__file__).parent

USER = 23456
"""Of no name, home or rights."""

TINY = """
import json
from tiny import kernels, remembered
kernel = kernels()
print(json.dumps([kernel(3.0, 4.0), remembered(kernel)]))
"""

ROLLING = """
import json, sys, threading, torch
from torchsoft import Parameters, SoftGrasp, simulate
from torchsoft.scenario import grasp_and_roll
torch.set_num_threads(1)
def roll(_=0):
    coarse = {"pad.elements_x": 40, "pad.elements_y": 1, "contact.v_s": 0.05}
    model = SoftGrasp(Parameters().override(coarse))
    rig = grasp_and_roll(model, grasp_force=75.0)
    run = simulate(model, torch.linspace(0, 0.3, 7, dtype=torch.float64), y0=rig.y0)
    return [float(value).hex() for value in run["y_Br"]]
"""


def python(
    program: str, user: int | None = None, path: Path = ROOT, **environment: str | None
) -> tuple[int, str, str]:
    """Exit status and both outputs of a new Python in a folder that it cannot write; as another
    user if one is given.

    None takes a variable away. Whatever that user may write belongs to everybody, and what he may
    read is everything.
    """
    given = (
        os.environ
        | {"OMP_NUM_THREADS": "1", "PYTHONPATH": f"{path}:{HERE}", "PYTHONDONTWRITEBYTECODE": "1"}
        | environment
    )
    rights = ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]
    asked = (
        ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", *rights]
        if user is not None
        else []
    )
    ended = subprocess.run(
        [*asked, sys.executable, "-c", program], capture_output=True, check=False, timeout=600,
        cwd="/", env={name: value for name, value in given.items() if value is not None},
    )  # fmt: skip
    return ended.returncode, ended.stdout.decode(), ended.stderr.decode()


def need_users() -> None:
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can run programs as another user, with `setpriv`")
    probe = python("print(1)", USER)
    if probe[0] != 0:
        pytest.skip(f"another user cannot run this Python: {probe[2][-200:]}")


def package(folder: Path, warm: bool) -> Path:
    """A copy of the package, with its compiled kernels if `warm`; the folder to import it from."""
    shutil.copytree(
        ROOT / "torchsoft", folder / "torchsoft", ignore=shutil.ignore_patterns("__pycache__")
    )
    if warm:
        shutil.copytree(
            cache.FOLDERS[0], folder / "torchsoft" / "solve" / "kernel" / "__pycache__" / cache.NAME
        )
    return folder
