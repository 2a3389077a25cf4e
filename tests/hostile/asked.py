"""One trial of an input: accepted and finite, or refused in one sentence that names what is wrong,
in good time."""

import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hostile.mutation import NOT_NUMBERS, Mutant
from hostile.trial import Tally, sentence

LIMIT = 20.0
"""Longest time [s] that one input may take."""


class Hang(BaseException):
    """An input that took too long."""


@contextmanager
def in_time(limit: float = LIMIT) -> Iterator[None]:
    def late(*_: object) -> None:
        raise Hang(f"still busy after {limit} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def names(text: str, mutant: Mutant) -> bool:
    """Whether a refusal names the only place that was changed, by its last name (a tuple's entry by
    the tuple's)."""
    words = [part for part in mutant.place if isinstance(part, str)]
    if not words:
        return True
    last = words[-1]
    if last == "kind" or last in ("low", "high"):  # a range or a table is named by itself
        return any(word in text for word in words)
    return last in text or last.rpartition(".")[2] in text


def ask(
    tally: Tally,
    what: str,
    mutant: Mutant,
    function: Callable[[], Any],
    follow: Callable[[Any], Any] | None = None,
) -> Any:
    """Count one input; what `function` makes of it, or None where it was refused. `follow` raises
    `AssertionError` for what is accepted and is nonsense, and may refuse with a sentence too."""
    shown = f"{what} {mutant.place} = {mutant.new!r:.60}"
    try:
        with in_time(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = function()
    except (ValueError, OSError) as refusal:
        text = str(refusal)
        if not sentence(text):
            tally.held(False, f"{shown}: not one sentence: {text!r}")
        else:
            tally.held(names(text, mutant), f"{shown}: another field is blamed: {text}")
        return None
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        tally.held(False, f"{shown}: {''.join(traceback.format_exception(error))[-1500:]}")
        return None
    number = isinstance(mutant.old, int | float) and not isinstance(mutant.old, bool)
    if number and isinstance(mutant.new, NOT_NUMBERS):
        tally.held(False, f"{shown}: accepted in the place of a number")
        return None
    if follow is None:
        tally.held(True)
        return made

    def later() -> None:
        with in_time(6 * LIMIT), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            follow(made)

    tally.call(f"{shown}, later", later, (ValueError, RuntimeError))
    return made
