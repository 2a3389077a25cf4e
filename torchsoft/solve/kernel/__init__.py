"""The compiled inside of the stepper and of its derivatives: plain arrays in, plain arrays out, no
lock held.

Nothing here knows a law: laws are called through the addresses that `torchsoft.codegen` made of
them.
"""

from collections.abc import Callable
from typing import Any

import numba

from torchsoft.solve.kernel.cache import KernelCache

njit: Any = numba.njit


def compiled(function: Callable[..., Any], entry: bool = False) -> Any:
    """`numba.njit` without the interpreter's lock and without counting references, with a cache of
    its own.

    So a kernel can allocate nothing, nor return an array; counting the references of the arrays
    that pass through took a sixth of a run, and more where threads share a rig. Only an `entry` can
    be called from Python: wrappers take longer to compile than most kernels.
    """
    options: dict[str, Any] = (
        {} if entry else {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    )
    dispatcher: Any = njit(
        nogil=True, _nrt=False, error_model="numpy", fastmath={"contract", "reassoc"}, **options
    )(function)
    if hasattr(dispatcher, "_cache"):  # not with NUMBA_DISABLE_JIT
        dispatcher._cache = KernelCache(function)
    return dispatcher


def inlined(function: Callable[..., Any]) -> Any:
    """A part of an entry that has a name of its own: compiled inside its callers only, since every
    level of calls above the heavy kernels takes the compiler another seven seconds."""
    return njit(
        inline="always",
        nogil=True,
        _nrt=False,
        error_model="numpy",
        fastmath={"contract", "reassoc"},
    )(function)


def entry(function: Callable[..., Any]) -> Any:
    """A kernel that Python calls."""
    return compiled(function, entry=True)
