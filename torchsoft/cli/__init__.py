"""The command `torchsoft`: rig files, identification, materials, datasets, and pictures of runs."""

import argparse
import io
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version

from torchsoft.cli import dataset, design, identify, material, plan, plot, profile, reduce, rigs
from torchsoft.cli.results import failed, open_streams, say

GRACE = 1.5
"""Time [s] from Ctrl-C to the forced end of the process, for a long library call that cannot be
interrupted."""

ENDS = signal.SIGINT, signal.SIGTERM
"""Signals that interrupt the work, which keeps what is done: Ctrl-C, and the one of a scheduler."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Turn the signals `ENDS` into `KeyboardInterrupt`, and end the process `GRACE` after one that
    Python has not handled, because it is inside a library's long call."""
    default = signal.default_int_handler, signal.SIG_DFL
    before = {one: how for one in ENDS for how in [signal.getsignal(one)] if how in default}
    if not before or threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, (read, write) = threading.Event(), os.pipe()
    os.set_blocking(write, False)

    def hear(*_: object) -> None:
        heard.set()
        raise KeyboardInterrupt

    def watch() -> None:
        if os.read(read, 1)[0] in before and not heard.wait(GRACE):
            os.write(2, b"\ninterrupted\n")
            os._exit(130)

    watcher = threading.Thread(target=watch, daemon=True)
    wakeup = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    for one in before:
        signal.signal(one, hear)
    watcher.start()
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
        signal.set_wakeup_fd(wakeup)
        os.write(write, b"\0")
        watcher.join()
        os.close(read)
        os.close(write)


def note_once() -> Callable[..., None]:
    """A `warnings.showwarning` that prints a sentence once: a fit makes hundreds of runs."""
    said = set[str]()

    def show(message: Warning | str, *_: object, **__: object) -> None:
        if (sentence := f"torchsoft: note: {message}") not in said:
            said.add(sentence)
            say(sentence, error=True)

    return show


def command_parser() -> argparse.ArgumentParser:
    """The parser of `torchsoft` and of all its commands."""
    parser = argparse.ArgumentParser(
        prog="torchsoft", description="A differentiable simulator of soft contact manipulation."
    )
    parser.add_argument("--version", action="version", version=f"torchsoft {version('torchsoft')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (rigs, plan, identify, profile, design, material, dataset, reduce, plot):
        group.add_commands(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. The exit status is 0, 2 for an error that the user can fix, 130 for an
    interruption."""
    open_streams()
    for stream in (sys.stdout, sys.stderr):  # a terminal that cannot show a sign gets its number
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # before torch is imported: its threads wait for each other where a core is busy
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "agg"  # pictures go to files, whatever windows are configured
    given = sys.argv[1:] if arguments is None else arguments
    options = command_parser().parse_args(given)
    if broken := [one for one in given if "\n" in one]:
        return failed(f"{broken[0]!r} has a line break in it; leave it out")
    options.command = shlex.join(
        ["torchsoft", *(os.fsencode(one).decode("utf-8", "replace") for one in given)]
    )
    with warnings.catch_warnings(), interruptible():
        warnings.showwarning = note_once()
        try:
            return options.run(options)
        except (ValueError, RuntimeError, ModuleNotFoundError) as error:
            return failed(str(error))
        except OSError as error:
            return failed(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        except KeyboardInterrupt:
            say("\ninterrupted", error=True)
            return 130
