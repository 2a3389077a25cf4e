"""The command `torchsoft`: rigs in files, identification from files, and materials from tests."""

import argparse
import io
import os
import shlex
import sys
import warnings
from collections.abc import Sequence

from torchsoft.cli import identify, material, rigs
from torchsoft.cli.failure import failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 0, 2 for what the user can mend, 130 for an interruption."""
    parser = argparse.ArgumentParser(
        prog="torchsoft", description="A differentiable simulator of soft contact manipulation."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (rigs, identify, material):
        group.add_commands(commands)
    for stream in (sys.stdout, sys.stderr):  # a terminal that cannot show a sign gets its number
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    given = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(given)
    options.command = shlex.join(["torchsoft", *(os.fsencode(one).decode("utf-8", "replace") for one in given)])
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print(f"torchsoft: note: {message}", file=sys.stderr)
        try:
            return options.run(options)
        except (ValueError, RuntimeError) as error:
            return failed(str(error))
        except OSError as error:
            return failed(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        except KeyboardInterrupt:
            print("\ninterrupted", file=sys.stderr)
            return 130
