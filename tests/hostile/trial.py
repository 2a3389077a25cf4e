"""Counts of the hostile trial: how many attacks, at random from which seed, and those that did not
hold.

`HOSTILE_SCALE` (1 by default) multiplies every count, and `HOSTILE_SEED` (0) starts every random
choice.
"""

import os
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

SCALE = float(os.environ.get("HOSTILE_SCALE", "1"))
SEED = int(os.environ.get("HOSTILE_SEED", "0"))
LIMIT = 20.0
"""Most processor time [s] that one call may take, so that nothing hangs."""


class Late(BaseException):
    """A call that took too long."""


@contextmanager
def in_time(limit: float = LIMIT) -> Iterator[None]:
    """Raises `Late` in the body after `limit` [s] of processor time."""

    def late(*_: object) -> None:
        raise Late(f"still busy after {limit} s")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


class Tally:
    """How many attacks a test tried, and a text for each that did not hold."""

    def __init__(self) -> None:
        self.tried, self.broken = 0, list[str]()

    def held(self, holds: bool, otherwise: str = "") -> None:
        """Count one attack."""
        self.tried += 1
        if not holds:
            self.broken.append(otherwise[:2000])

    def call(
        self, attack: str, function: Callable[[], Any],
        rejections: tuple[type[Exception], ...] = (ValueError, OSError),
        blamed: Callable[[str], bool] = bool, limit: float = LIMIT,
    ) -> Any:  # fmt: skip
        """Result of one call, which must return in time or be rejected with one of `rejections`, in
        a sentence that names what is `blamed`; None where rejected."""
        try:
            with in_time(limit), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                result = function()
        except rejections as error:
            raw = isinstance(error, np.linalg.LinAlgError | torch.linalg.LinAlgError)
            right = sentence(str(error)) and not raw and blamed(str(error))
            self.held(right, f"{attack}: no sentence with the field's name: {error!r}")
        except (Exception, Late) as error:
            self.held(False, f"{attack}: {''.join(traceback.format_exception(error))[-1500:]}")
        else:
            self.held(True)
            return result
        return None


def sentence(text: str) -> bool:
    """Whether the text of a rejection is one sentence of this project's."""
    foreign = "\n" in text or "Traceback" in text or "validation error" in text
    return 0 < len(text) < 2000 and not foreign


def count(number: int) -> int:
    """How many attacks, of `number` at full scale."""
    return max(1, round(number * SCALE))


def random(name: str, number: int = 0) -> np.random.Generator:
    """A generator of its own for every name and number, the same in every trial of one seed."""
    return np.random.default_rng([SEED, number, *name.encode()])
