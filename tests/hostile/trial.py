"""What the hostile trial counts with: how many, at random from which seed, and what did not hold.

`HOSTILE_SCALE` (1 by default) multiplies every count, `HOSTILE_SEED` (0) begins every random
choice.
"""

import os
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

SCALE = float(os.environ.get("HOSTILE_SCALE", "1"))
SEED = int(os.environ.get("HOSTILE_SEED", "0"))


class Tally:
    """One line of the table: how many were tried, and a line for each that did not hold."""

    def __init__(self, kind: str) -> None:
        self.kind, self.tried = kind, 0
        self.broken: list[str] = []

    def held(self, holds: bool, otherwise: str = "") -> None:
        """Count one trial."""
        self.tried += 1
        if not holds:
            self.broken.append(otherwise[:2000])

    def call(
        self, what: str, function: Callable[[], Any], refusals: tuple[type[BaseException], ...]
    ) -> Any:
        """Count one call, which must return or be refused with one sentence of a kind in
        `refusals`; None when refused."""
        try:
            result = function()
        except refusals as refusal:
            raw = isinstance(refusal, np.linalg.LinAlgError | torch.linalg.LinAlgError)
            self.held(
                sentence(str(refusal)) and not raw, f"{what}: not one sentence: {str(refusal)!r}"
            )
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt | SystemExit):
                raise
            self.held(False, f"{what}: {''.join(traceback.format_exception(error))[-1500:]}")
        else:
            self.held(True)
            return result
        return None


def sentence(text: str) -> bool:
    """Whether a refusal is one sentence of this project's."""
    return (
        0 < len(text) < 2000
        and "\n" not in text
        and "Traceback" not in text
        and "validation error" not in text
    )


def count(number: int) -> int:
    """How many trials, of `number` at full scale."""
    return max(1, round(number * SCALE))


def random(*key: int) -> np.random.Generator:
    """A generator of its own for every key, the same in every run of one seed."""
    return np.random.default_rng([SEED, *key])
