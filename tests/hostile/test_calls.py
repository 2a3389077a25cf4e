"""Odd calls of `simulate` and what it returns: wrong types, shapes, dtypes and names. Each is
rejected with one sentence; what a declared quantity may be is tested for
all of them in `tests/test_rejections.py`."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from conftest import PAPER, coarse, f64, grasp, times
from torch import nn

from torchsoft import (
    NoEquilibrium,
    Profile,
    Reference,
    SimulationFailed,
    hold,
    simulate,
)
from torchsoft.solve.gradients import GradientFailed

pytestmark = pytest.mark.slow

REFUSALS = (
    ValueError, TypeError, KeyError, NotImplementedError, SimulationFailed, NoEquilibrium,
    GradientFailed,
)  # fmt: skip
T = times(4e-3, 3)
NO_NUMBER: list[Any] = [
    None, "3", "abc", True, [], {}, object(), 1j, math.nan, math.inf, np.zeros(2), f64(1.0, 2.0),
]  # fmt: skip
Attack = tuple[Callable[..., Any], dict[str, Any], dict[str, list[Any]]]
"""A call, its right arguments, and odd values of some of them."""


def of_runs() -> Iterator[Attack]:
    model = coarse(pad__elements_x=24)
    y0, model.reference = grasp(model, (0.01, 0.0))
    right = {"rig": model, "t": T, "y0": y0}
    tensors: list[Any] = [
        None, 3, "x", {}, object(), True, y0 / 0, y0.to(torch.complex128), y0.to("meta"),
        y0.to_sparse(), f64(), f64(1.0), y0[None], y0.bool(), torch.stack((y0, y0)), y0[:-1],
    ]  # fmt: skip
    lengths = [*NO_NUMBER[1:], -1.0, 1e-300]
    rigs = [None, 3, "model", PAPER, nn.Linear(1, 1), model.pads["L"], model.forward]
    yield simulate, right, {
        "y0": tensors[1:], "t": [*tensors, T * 1e300, T + 1e16, T * 1e-320], "rig": rigs,
        "reference": [3, "x", Profile([0.0], [1.0]), Reference(), hold(x_d=0.06), model],
        "gradient": [None, "", "adjoint", 3, True, ["none"], {}],
        "step": lengths, "tolerance": lengths, "rtol": lengths, "atol": lengths,
    }  # fmt: skip
    names = [None, 3, [3], ["pad.Q"], ["E"], [""], [model.parameter("pad.E")], {"pad.E": 1}]
    zeros, ones = torch.zeros(len(y0), 1, dtype=torch.float64), torch.ones_like(y0)
    rows = [y0, zeros / 0, 3, "x", torch.cat((zeros, zeros))]
    yield simulate, right | {"gradient": "forward", "wrt": ["pad.E"]}, {"wrt": names, "dy0": rows}
    discrete = right | {"gradient": "discrete"}
    yield simulate, discrete, {"wrt": [["pad.E"]], "dy0": [zeros], "rigid": [True]}
    of_y0 = lambda y: simulate(**discrete | {"y0": y})["theta"][-1]
    yield lambda y: torch.func.grad(of_y0)(y), {}, {"y": [y0]}
    yield lambda y: torch.func.vmap(of_y0)(torch.stack((y, y))), {}, {"y": [y0]}
    yield lambda y: torch.func.jvp(of_y0, (y,), (ones,)), {}, {"y": [y0]}
    ended = simulate(**right)
    yield lambda channel: ended[channel], {}, {"channel": ["", "x", "xC", 3, None, "theta_"]}
    yield model.parameter, {}, {"name": ["", "E", 3, None]}
    kinds = [torch.float16, torch.complex128]
    yield lambda dtype: simulate(model.to(dtype), T, y0=y0), {}, {"dtype": kinds}


def accepted(call: Callable[..., Any], given: dict[str, Any]) -> bool:
    call(**given)
    return True


def test_odd_calls_are_rejected_with_a_sentence(tally):
    line = tally("odd calls of runs")
    for call, right, odds in of_runs():
        for name, odd in ((name, odd) for name, values in odds.items() for odd in values):
            attack = partial(accepted, call, right | {name: odd})
            done = line.call(f"{call.__name__} {[*right]}: {name} = {odd!r:.40}", attack, REFUSALS)
            line.held(not done, f"{call.__name__}: {name} = {odd!r:.40} was accepted")
