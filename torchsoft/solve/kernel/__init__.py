"""The compiled inside of the stepper and of its derivatives: tables of arrays in, tables of arrays
out, no lock held.

Nothing here knows a law: laws are called through the addresses that `torchsoft.codegen` made of
them. `objects` calls the kernels and `build` compiles them; nobody else imports their modules.
"""

from collections.abc import Callable
from typing import Any


def compiled(function: Callable[..., Any]) -> Any:
    """Mark of a kernel. A kernel allocates nothing and counts no references; `build` puts the
    compiler in the place of this."""
    return function
