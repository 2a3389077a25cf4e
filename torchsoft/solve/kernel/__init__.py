"""The compiled inside of the stepper and of its derivatives: plain arrays in, plain arrays out, no lock held.

Nothing here knows a law: laws are called through the addresses that `torchsoft.codegen` made of them. numba's cache does not
notice a changed function in another file, so the cache folder is named after all the kernels' sources, wherever it lies.
"""

import logging
import os
import sys
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import config, njit

log = logging.getLogger("torchsoft")

HERE = Path(__file__).parent


def digest(*folders: Path) -> str:
    """Names the sources in some folders: the same for the same sources, another for any change."""
    paths = sorted(path for folder in folders for path in folder.glob("*.py"))
    return sha256(b"\0".join(path.name.encode() + b"\0" + path.read_bytes() for path in paths)).hexdigest()[:16]


def writable_cache() -> Path | None:
    """The folder for compiled kernels: beside the sources, else in the user's cache; None where neither can be written."""
    name = digest(HERE, HERE.parents[1] / "codegen")
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    for folder in (HERE / "__pycache__" / name, home / "torchsoft" / name):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    print("torchsoft: note: no folder for compiled kernels can be written; compiling at every start", file=sys.stderr)
    return None


CACHE = writable_cache()


def compiled(function: Callable[..., Any], entry: bool = False) -> Any:
    """`numba.njit` without the interpreter's lock, cached in `CACHE`; numba's own setting is left as it is for others.

    Only an `entry` can be called from Python: wrappers take longer to compile than most kernels.
    """
    settings: Any = config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(CACHE) if CACHE is not None else before
    options: dict[str, Any] = {} if entry else {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    try:
        return njit(
            cache=CACHE is not None, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"}, **options
        )(function)
    finally:
        settings.CACHE_DIR = before


def entry(function: Callable[..., Any]) -> Any:
    """A kernel that Python calls."""
    return compiled(function, entry=True)
