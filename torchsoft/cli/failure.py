"""How a command says that it failed."""

import sys

from torchsoft.tables import line


def failed(what: str) -> int:
    print(f"torchsoft: error: {line(what, 2000)}", file=sys.stderr)
    return 2
