"""The result of an identification: its answer, and the rigs that it speaks of."""

import platform
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchsoft.physics.rig import Rig
from torchsoft.sysid.answer.answer import Answer, AssumptionCheck, ChannelNoise, FittedCoordinate, OrderTried
from torchsoft.sysid.answer.contribution import contributions
from torchsoft.sysid.answer.recorded import RecordedRig, recorded_rigs
from torchsoft.sysid.checks.checks import Check
from torchsoft.sysid.fit.information import Combination, combinations
from torchsoft.sysid.problem.noise import Score
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array

BLURRED = 0.1
"""Relative standard deviation of a combination of parameters from which it is looked for what the data see in its place."""


@dataclass(frozen=True)
class IdentificationResult(Answer):
    """The result of `identify`: an `Answer`, and the recordings' rigs, so that `model` gives back any of them, with its laws
    and the reference that it followed."""

    rigs: Mapping[str, Rig] = field(default_factory=dict, repr=False, compare=False)

    def _rig(self, one: RecordedRig) -> Rig:
        return deepcopy(self.rigs[one.name]) if one.name in self.rigs else super()._rig(one)


def described(
    problem: Problem, x: Array, free: NDArray[np.bool_], J: Array, C: Array, fitted: Sequence[str], *,
    tried: Mapping[str, Sequence[Score]] | None = None, checks: Sequence[Check] = (),
) -> dict[str, Any]:  # fmt: skip
    """Fields of a result that say what was fitted and how, at x (n,) with covariance C (n, n): `problem` has the noise that was
    found, J (m, n) is the Jacobian of the residuals of the recordings `fitted`, `tried` the orders of noise by channel."""
    c, tried = problem.coordinates, tried or {}
    coordinates = [
        FittedCoordinate(
            one.label, one.name, one.kind, one.recording, one.nominal, one.low, one.high, one.scale, one.ratio_to,
            not is_free, one.prior, one.to_value(x[i]), float(np.sqrt(C[i, i])),
        )
        for i, (one, is_free) in enumerate(zip(c.all, free))
    ]  # fmt: skip
    noise = [
        ChannelNoise(channel, model, [OrderTried(*score) for score in tried.get(channel, ())])
        for channel, model in problem.noise.items()
    ]
    packages = ("torchsoft", "torch", "numpy", "scipy", "numba")
    return {
        "recordings": recorded_rigs(problem, x, fitted), "unknowns": dict(problem.unknowns), "sensors": dict(problem.sensors),
        "coordinates": coordinates, "contributions": contributions(problem, x, free, J, fitted),
        "combinations": seen_together(problem, free, C), "noise": noise,
        "assumptions": [
            AssumptionCheck(
                one.name, one.kind, one.stated, one.otherwise, one.amount, one.unit, dict(one.moves), one.gain, one.asked,
                one.asked_sd, one.wanted, one.unchecked, one.value, dict(one.under),
            )
            for one in checks
        ],
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        "rigs": {recording.name: recording.rig for recording in problem.recordings},
    }  # fmt: skip


def seen_together(problem: Problem, free: NDArray[np.bool_], C: Array) -> list[Combination]:
    """Products of powers of parameters that the data see better than each of them."""
    mine = [
        i for i, one in enumerate(problem.coordinates.all) if free[i] and one.kind == "parameter" and one.scale == "log"
    ]
    labels = [problem.coordinates.labels[i] for i in mine]
    return combinations(labels, C[np.ix_(mine, mine)], BLURRED) if len(mine) > 1 else []
