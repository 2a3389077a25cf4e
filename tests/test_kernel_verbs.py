"""The tangent and the adjoint of a stage, as plain Python, against each other; the speed of a
run."""

import ctypes
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
import torch
from conftest import COARSE, RUBBER, coarse, grasped, random_state, still, times, turning

from torchsoft import NeoHookean, RateAndState, Rig, simulate
from torchsoft.codegen import compile_law
from torchsoft.solve.kernel import (
    adjoint,
    contacts,
    nodal,
    pads,
    sources,
    stage,
    tangent,
    transport,
)
from torchsoft.solve.kernel.arrays import GAMMA, INSTANT, scratch
from torchsoft.solve.kernel.invoke import call_linearise
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import ImplicitStepper

GRIP = COARSE | {"pad.elements_x": 30, "contact.mu_s": 0.3, "contact.mu_k": 0.2}
RIGS: dict[str, Callable[[], Rig]] = {
    "massless": lambda: still(GRIP),
    "turning": lambda: turning(pad__elements_x=30),
    "rate and state": lambda: still(GRIP, friction=RateAndState(0.4, 0.02, 0.03, 4e-5, 1e-3, 0.05)),
    "inertial": lambda: still(GRIP | {"pad.inertial": True}),
    "neo-Hookean": lambda: still(GRIP, material=NeoHookean(**RUBBER, tau=0.01)),
}
STEP = 2e-4
ANY = np.random.default_rng(0)
LAWS = {"value": "xpo", "linearise": "xpoJ", "pull": "xpwb", "push": "xpdo"}


def called(*arrays: str) -> Any:
    """A call of a compiled law from Python, in place of that from kernels."""
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(arrays))

    def call(address: int, *given: Any) -> None:
        kept = [np.ascontiguousarray(one) for one in given]
        kind(int(address))(*(one.ctypes.data for one in kept))
        for one, own in zip(given, kept):
            if own is not one:
                one[...] = own.reshape(one.shape)

    return call


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """Kernels are plain functions where nothing has compiled them; laws are called by ctypes."""
    for module in (contacts, nodal, sources, stage, transport):
        for name, arrays in LAWS.items():
            monkeypatch.setattr(module, f"call_{name}", called(*arrays), raising=False)


@pytest.mark.parametrize("forces", [False, True])
@pytest.mark.parametrize("name", RIGS)
def test_the_adjoint_of_a_stage_is_its_tangent_transposed(name, forces):
    """<bar, push(d)> = <pull(bar), d> for random directions of state and parameters, and for the
    forces of a stage of no length."""
    rig, segments = RIGS[name](), list[Segment]()
    stepper, t = ImplicitStepper(rig, step=STEP), times(10 * STEP, 2)
    with torch.no_grad():
        [*stepper.integrate(random_state(rig, 3), t, segments, float("inf"))]
    rig, size = stepper.parameters.system, stepper.layout.size
    work = scratch("Work", rig, size, columns=2)
    tapes, signals = segments[-1].tapes, segments[-1].stages
    tape, row, a = (tapes[1], 0, INSTANT) if forces else (tapes[0], 1, GAMMA * STEP)
    along, back = (scratch("Directions", rig, size, columns=n) for n in (2, 1))
    start = np.maximum(abs(tape.y[row]), 1e-6)[:, None] * ANY.normal(size=(size, 2))
    dp, dy = abs(rig.p)[:, None] * ANY.normal(size=(len(rig.p), 2)), start.copy()
    dw = 1e-3 * ANY.normal(size=(signals[row].size, 2))
    dw[2 * rig.body_signal[rig.body_signal >= 0]] = 0.0  # of fixed and driven bodies
    dw[2 * rig.body_signal[rig.body_signal >= 0] + 1] = 0.0
    pads.find_spans(rig, tape.y[row], dy, along.span)
    tangent.stage_tangent(rig, work, along, tape, row, a, signals[row], dy, dp, dw, forces)
    out = along.recorded.copy() if forces else dy
    bar = ANY.normal(size=len(out)) / np.maximum(abs(out).max(1), 1e-12)
    y_bar = np.zeros((size, 1)) if forces else bar[:, None].copy()
    p_bar, w_bar = np.zeros((len(rig.p), 1)), np.zeros((signals[row].size, 1))
    if forces:
        back.recorded[:, 0] = bar
    adjoint.stage_adjoint(
        rig, work, back, tape, row, a, signals[row], y_bar, p_bar, w_bar, forces
    )  # fmt: skip
    backwards = y_bar[:, 0] @ start + p_bar[:, 0] @ dp + w_bar[:, 0] @ dw
    assert backwards == pytest.approx(bar @ out, rel=1e-8)


CALLS, MOST, RATIO = 600_000, 2.0, 0.77
"""Calls of a law in the reference loop; the largest time of a run over what it was, which was
`RATIO` of the loop's on one processor, and up to 0.97 on another."""


def test_a_run_is_as_fast_as_it_was():
    """Compared to calls of a compiled law from machine code in this process, so that the speed of
    the machine does not matter."""

    def law(x: torch.Tensor, _: Any) -> torch.Tensor:
        return torch.stack([(x * x.roll(k)).sum() / (1 + x[k] ** 2).sqrt() for k in range(8)])

    @numba.njit
    def calls(address: int, x: Any, p: Any, out: Any, J: Any) -> None:
        for _ in range(CALLS):
            call_linearise(address, x, p, out, J)

    rig, address = coarse(), compile_law(law, times(1.0, 8), {}).linearise
    y0, x = grasped(rig, (0.02, 0.0)), np.linspace(0.1, 1, 8)
    work = (
        lambda: simulate(rig, times(0.5, 3), y0=y0, step=5e-4),
        lambda: calls(address, x, np.zeros(1), np.zeros(8), np.zeros((8, 8))),
    )
    spent = []
    for _ in range(7):
        for one in work:
            start = time.process_time()
            one()
            spent.append(time.process_time() - start)
    ratios = sorted(run / loop for run, loop in zip(spent[2::2], spent[3::2]))
    assert ratios[1] < MOST * RATIO, f"{ratios[1]:.3g} times the loop, which was {RATIO:g}"
