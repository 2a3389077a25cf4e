"""Shared parts of commands: arguments, the folder of results, and messages on the terminal."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from torchsoft.files import claim
from torchsoft.tables import line, plain


def add_command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], int], help: str, description: str
) -> argparse.ArgumentParser:
    """Add a command that `run` carries out; the help shows its description verbatim."""
    one = commands.add_parser(
        name, help=help, description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    one.set_defaults(run=run)
    return one


def add_out(command: Any, **more: Any) -> None:
    """Add the options on the folder of results."""
    command.add_argument("--out", type=Path, **more)
    command.add_argument(
        "--force", action="store_true", help="write to a folder that holds other files"
    )


def add_progress(command: Any) -> None:
    """Add the option on progress, which is shown on terminals only."""
    command.add_argument(
        "--no-progress", dest="progress", action="store_false", default=sys.stderr.isatty(),
        help="show no progress; only a terminal is shown any",
    )  # fmt: skip


def say(*text: object, error: bool = False) -> None:
    """Print text without control characters."""
    print(plain(" ".join(map(str, text))), file=sys.stderr if error else sys.stdout)


def failed(reason: str) -> int:
    """Print the reason of a failure; returns the exit status."""
    print(f"torchsoft: error: {line(reason, 2000)}", file=sys.stderr)
    return 2


def try_folder(out: Path, force: bool) -> None:
    """Make the folder and test that files can be written to it. Raises `ValueError` where they
    cannot, and for a folder with other files unless `force` is set."""
    try:
        claim(out, force)
        with TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ValueError(
            f"--out: results cannot be written to {out} ({error.filename or out}: "
            f"{error.strerror}); name a folder, a new one or one that may be written to"
        ) from None
