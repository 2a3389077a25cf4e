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

from torchsoft.cli import dataset, design, identify, material, plan, plot, reduce, rigs
from torchsoft.cli.results import failed, say

GRACE = 1.5
"""Time [s] from Ctrl-C to the forced end of the process, for a long library call that cannot be
interrupted."""


@contextmanager
def interruptible() -> Iterator[None]:
    """End the process `GRACE` after a Ctrl-C that Python has not handled, because it is inside a
    library's long call."""
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, (read, write) = threading.Event(), os.pipe()
    os.set_blocking(write, False)

    def hear(*_: object) -> None:
        heard.set()
        raise KeyboardInterrupt

    def watch() -> None:
        if os.read(read, 1) == bytes([signal.SIGINT]) and not heard.wait(GRACE):
            os.write(2, b"\ninterrupted\n")
            os._exit(130)

    watcher = threading.Thread(target=watch, daemon=True)
    before = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, hear)
    watcher.start()
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.set_wakeup_fd(before)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. The exit status is 0, 2 for an error that the user can fix, 130 for an
    interruption."""
    parser = argparse.ArgumentParser(
        prog="torchsoft", description="A differentiable simulator of soft contact manipulation."
    )
    parser.add_argument("--version", action="version", version=f"torchsoft {version('torchsoft')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (rigs, plan, identify, design, material, dataset, reduce, plot):
        group.add_commands(commands)
    for stream in (sys.stdout, sys.stderr):  # a terminal that cannot show a sign gets its number
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # before torch is imported: its threads wait for each other where a core is busy
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    given = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(given)
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
            print("\ninterrupted", file=sys.stderr)
            return 130
