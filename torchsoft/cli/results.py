"""Shared parts of commands: arguments, the folder of results, and messages on the terminal."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
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


def add_out(command: Any, folder: str, **more: Any) -> None:
    """Add the options on the folder of results, which is out/`folder` by default."""
    help = f"folder for the results (out/{folder})"
    command.add_argument("--out", type=Path, help=help, **{"default": Path("out", folder)} | more)
    command.add_argument(
        "--force", action="store_true", help="write to a folder that holds other files"
    )


def add_files(command: Any, help: str = "data files and a configuration") -> None:
    """Add the data files and the configuration of an identification."""
    metavar = "DATA.csv ... CONFIG.toml"
    command.add_argument("files", nargs="+", type=Path, metavar=metavar, help=help)


def add_yes(command: Any) -> None:
    """Add the option on costly work."""
    meaning = "start even if it takes hours, or much memory or disk"
    command.add_argument("--yes", action="store_true", help=meaning)


def add_progress(command: Any) -> None:
    """Add the option on progress, which is shown on terminals only."""
    command.add_argument(
        "--no-progress", dest="progress", action="store_false", default=sys.stderr.isatty(),
        help="show no progress; files never get it",
    )  # fmt: skip


def open_streams() -> None:
    """Open the standard streams that are closed, on nothing."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            nothing = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(nothing, "r" if name == "stdin" else "w"))


def say(*text: object, error: bool = False, needed: bool = False) -> None:
    """Print text without control characters. Where nobody reads it, or it cannot be written, the
    work goes on; raises `OSError` for text that is the work itself, which is `needed`."""
    stream = sys.stderr if error else sys.stdout
    try:
        print(plain(" ".join(map(str, text))), file=stream, flush=True)
    except OSError as cause:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())  # which takes what is left in the buffer
        os.close(nowhere)
        if error or isinstance(cause, BrokenPipeError):
            return
        if needed:
            raise
        say(f"torchsoft: note: the output cannot be written: {cause.strerror}", error=True)


def failed(reason: str) -> int:
    """Print the reason of a failure; returns the exit status."""
    say(f"torchsoft: error: {line(reason, 2000)}", error=True)
    return 2


def sorted_files(files: Sequence[Path]) -> tuple[Path, list[Path]]:
    """The configuration among some files, and the others, which are data. Raises `ValueError`
    unless there is one configuration."""
    configs = [file for file in files if file.suffix == ".toml"]
    if len(configs) != 1:
        raise ValueError(f"one CONFIG.toml is needed, but {len(configs)} were given")
    return configs[0], [file for file in files if file.suffix != ".toml"]


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
