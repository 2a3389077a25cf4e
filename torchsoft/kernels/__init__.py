"""The compiled inside of the stepper and of its derivatives: plain arrays in, plain arrays out.

numba caches what it compiles by the date of the function's own file, and would keep using a caller of a function that has
changed in another. Here the cache lies in a folder named after all the kernels' sources.
"""

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import config, njit

HERE = Path(__file__).parent


def digest(folder: Path) -> str:
    """Names the sources in a folder: the same for the same sources, another for any change."""
    return sha256(b"\0".join(path.read_bytes() for path in sorted(folder.glob("*.py")))).hexdigest()[:16]


CACHE = HERE / "__pycache__" / digest(HERE)
"""Where compiled kernels are kept; where it cannot be written, numba falls back to the user's own cache."""


def compiled(function: Callable[..., Any]) -> Any:
    """`numba.njit` with the cache in `CACHE`, leaving numba's own setting as it is for everybody else."""
    settings: Any = config
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(CACHE)
    try:
        return njit(cache=True)(function)
    finally:
        settings.CACHE_DIR = before
