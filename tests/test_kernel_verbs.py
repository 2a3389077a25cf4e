"""The kernels' verbs one by one, as plain Python: banded solves and the block of a pad against
dense algebra, the tangent and the adjoint of a stage against each other; and their speed."""

import ctypes
import time
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
import torch
from test_every_rig import RIGS

from torchsoft import simulate
from torchsoft.codegen import compile_law
from torchsoft.solve.kernel import (
    adjoint,
    contacts,
    linear,
    nodal,
    pads,
    sources,
    stage,
    tangent,
)
from torchsoft.solve.kernel.arrays import GAMMA, INSTANT, LANES, scratch
from torchsoft.solve.kernel.invoke import call_linearise
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import ImplicitStepper

CALLED = [
    "circle", "turning jaws", "loops", "rate and state", "inertial pads", "neo-Hookean pads",
    "three pads",
]  # fmt: skip
STEP = 2e-4
ANY = np.random.default_rng(0)


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
    for module in (contacts, nodal, sources, stage, tangent, adjoint):
        for name, arrays in (
            ("value", "xpo"),
            ("linearise", "xpoJ"),
            ("pullback", "xpwb"),
            ("push", "xpdo"),
        ):
            if hasattr(module, f"call_{name}"):
                monkeypatch.setattr(module, f"call_{name}", called(*arrays))


class Stage(NamedTuple):
    """The first stage of a step of a rig from the tape: its arrays, scratch, and length."""

    rig: Any
    work: Any
    tape: Any
    out_tape: Any
    signals: Any
    size: int
    a: float


def first_stage(name: str) -> Stage:
    rig, y0 = RIGS[name]()
    segments: list[Segment] = []
    stepper = ImplicitStepper(rig, step=STEP)
    t = torch.tensor([0.0, 10 * STEP], dtype=torch.float64)
    with torch.no_grad():
        *_, _ = stepper.integrate(y0, t, segments, float("inf"))
    tapes = segments[-1].tapes
    assert tapes is not None
    tape, out_tape = tapes
    rig, size = stepper.compiled.system, stepper.layout.size
    return Stage(
        rig, scratch("Work", rig, size, columns=2), tape, out_tape, segments[-1].stages, size,
        GAMMA * STEP,
    )  # fmt: skip


@pytest.mark.parametrize(("n", "band"), [(1, 1), (7, 2), (12, 30), (40, 5)])
def test_banded_solves_are_the_dense_ones(n, band):
    distance = np.subtract.outer(np.arange(n), np.arange(n))
    A = np.where(abs(distance) <= band, ANY.normal(size=(n, n)), 0.0) + 4 * band * np.eye(n)
    stored = np.zeros((n, 2 * band + 1))
    for i, j in zip(*np.nonzero(abs(distance) <= band)):
        stored[i, j - i + band] = A[i, j]
    b = ANY.normal(size=(n, 3))
    factor, x, back = stored.ravel().copy(), b.ravel().copy(), b[:, 0].copy()
    linear.factor_banded(factor, n, band)
    linear.solve_banded(factor, n, band, x, 3, 0)
    linear.solve_transposed(factor, n, band, back)
    assert x.reshape(n, 3) == pytest.approx(np.linalg.solve(A, b), rel=1e-10)
    assert back == pytest.approx(np.linalg.solve(A.T, b[:, 0]), rel=1e-10)


@pytest.mark.parametrize("name", CALLED)
def test_the_block_of_a_pad_is_that_of_dense_algebra(name):
    """A F = b + Hc dV with the points' own derivatives: A = 1 - N^T H_u N P, and elimination is
    that of the whole system."""
    now = first_stage(name)
    rig, work = now.rig, now.work
    contacts.restore(rig, work, now.tape, 1, now.a, False)
    linear.put(now.tape.rate[1], work.rate)
    free = len(rig.body_coordinate)
    for pad in range(len(rig.pad_base)):
        Rv, r = np.zeros((free, free)), np.zeros((free, 1))
        pads.assemble(rig, work, pad, now.tape.y[1], now.a, Rv)
        n, at = 2 * work.counts[pad], rig.pad_point_start[pad]
        active = work.active[at : at + work.actives[pad]]
        assert n > 0
        N = np.zeros((2 * len(active), n))
        H = np.zeros((2 * len(active), 2 * len(active)))
        for i, k in enumerate(active):
            for j in range(2):
                slot = work.slot[rig.point_node[k, j]]
                N[2 * i : 2 * i + 2, 2 * slot : 2 * slot + 2] += rig.point_N[k, j] * np.eye(2)
            H[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = work.H[at + i, :2, :2]
        A = np.eye(n) - N.T @ H @ N @ work.P[:n, :n]
        assert work.A[:n, :n] == pytest.approx(A, rel=1e-11, abs=1e-13)

        columns = rig.pad_columns[pad]
        Hc, Rf = work.Hc[:n, :columns].copy(), work.Rf[:columns, :n].copy()
        b, own = ANY.normal(size=n), rig.pad_column[pad] >= 0
        first, before = 2 * rig.pad_node_start[pad], Rv.copy()
        work.X[first : first + n, 0] = b
        contacts.eliminate(rig, work, pad, 1, r, Rv)
        number = rig.pad_column[pad][own]
        schur, load = np.zeros((free, free)), np.zeros(free)
        schur[np.ix_(own, own)] = (Rf @ np.linalg.solve(A, Hc))[np.ix_(number, number)]
        load[own] = (Rf @ np.linalg.solve(A, b))[number]
        assert Rv - before == pytest.approx(schur, rel=1e-9, abs=1e-12 * abs(schur).max())
        assert r[:, 0] == pytest.approx(load, rel=1e-9, abs=1e-12 * abs(load).max())


def test_a_nodal_pad_is_the_inverse_of_its_own_matrix():
    """P between the touched nodes, from the elements' derivatives assembled densely."""
    now = first_stage("inertial pads")
    rig, work, pad = now.rig, now.work, 0
    contacts.restore(rig, work, now.tape, 1, now.a, False)
    linear.put(now.tape.rate[1], work.rate)
    nodal.relation(rig, work, pad, now.tape.y[1], now.a)
    dofs = rig.nodal_dof_start[1]
    A = np.diag([nodal.mass_rate(rig, pad, i, now.a) for i in range(dofs)])
    for e in range(rig.nodal_element_start[1]):
        nodal.element_inputs(rig, work, pad, e // LANES, now.tape.y[1], now.a)
        own = rig.p[nodal.element_parameters(rig, pad)]
        four, out = np.zeros((8, 16, LANES)), np.zeros((9, LANES))
        nodal.call_linearise(rig.nodal_linearise[pad], work.element_x[e // LANES], own, out, four)
        J = four[..., e % LANES]
        held = rig.nodal_dof[e] >= 0
        A[np.ix_(rig.nodal_dof[e][held], rig.nodal_dof[e][held])] += (now.a * J[:, :8] + J[:, 8:])[
            np.ix_(held, held)
        ]
    touched = work.touched[: work.counts[pad]]
    places = rig.nodal_surface.reshape(-1, 2)[touched].ravel()
    P = np.linalg.inv(A)[np.ix_(places, places)]
    n = len(places)
    assert work.P[:n, :n] == pytest.approx(P, rel=1e-9, abs=1e-12 * abs(P).max())
    assert abs(A - A.T).max() < 1e-12 * abs(A).max()


@pytest.mark.parametrize("felt", [False, True])
@pytest.mark.parametrize("name", CALLED)
def test_the_adjoint_of_a_stage_is_its_tangent_transposed(name, felt):
    """<bar, push(d)> = <pull(bar), d> for random directions of state and parameters, and for the
    forces of a stage of no length."""
    now = first_stage(name)
    rig, size, m = now.rig, now.size, 2
    tape, row, a = (now.out_tape, 0, INSTANT) if felt else (now.tape, 1, now.a)
    signals = now.signals[row]
    z, back = scratch("Tangents", rig, size, columns=m), scratch("Cotangents", rig, size)
    scale = np.maximum(abs(tape.y[row]), 1e-6)
    start, dp = (
        scale[:, None] * ANY.normal(size=(size, m)),
        abs(rig.p)[:, None] * ANY.normal(size=(len(rig.p), m)),
    )
    dy = start.copy()
    pads.find_spans(rig, tape.y[row], dy, z.span)
    tangent.stage_tangent(rig, now.work, z, tape, row, a, signals, dy, dp, felt)
    out = z.recorded.copy() if felt else dy
    bar = ANY.normal(size=len(out)) / np.maximum(abs(out).max(1), 1e-12)
    y_bar = np.zeros(size) if felt else bar.copy()
    p_bar, signals_bar = np.zeros(len(rig.p)), np.zeros(signals.shape)
    adjoint.stage_adjoint(
        rig, now.work, back, tape, row, a, signals, y_bar, p_bar, signals_bar,
        bar if felt else np.zeros(0),
    )  # fmt: skip
    forwards = bar @ out
    backwards = y_bar @ start + p_bar @ dp
    assert backwards == pytest.approx(forwards, rel=1e-8)


CALLS, MOST = 600_000, 1.5
"""Calls of a law in the reference loop, and the largest time of a run over what it was."""

RATIO = 0.95
"""Time of the run below over that of the reference loop, as measured."""


def reference_loop() -> Any:
    """A loop of calls of a compiled law from machine code."""

    def law(x: torch.Tensor, _: Any) -> torch.Tensor:
        return torch.stack([(x * x.roll(k)).sum() / (1 + x[k] ** 2).sqrt() for k in range(8)])

    address = compile_law(law, torch.linspace(0.1, 1, 8, dtype=torch.float64), {}).linearise

    @numba.njit
    def loop(address: int, x: Any, p: Any, out: Any, J: Any) -> None:
        for _ in range(CALLS):
            call_linearise(address, x, p, out, J)

    x, p, out, J = np.linspace(0.1, 1, 8), np.zeros(1), np.zeros(8), np.zeros((8, 8))
    return lambda: loop(address, x, p, out, J)


def test_a_run_is_as_fast_as_it_was():
    """Over its own reference loop on this machine, so that a slower machine is none."""
    rig, y0 = RIGS["loops"]()
    t = torch.linspace(0, 0.5, 3, dtype=torch.float64)
    loop = reference_loop()

    def seconds(work: Any) -> float:
        begin = time.process_time()
        work()
        return time.process_time() - begin

    @torch.no_grad()
    def run() -> None:
        simulate(rig, t, y0=y0, step=5e-4)

    run(), loop()
    ratios = sorted(seconds(run) / seconds(loop) for _ in range(9))
    assert ratios[1] < MOST * RATIO, f"{ratios[1]:.3g} times the loop, which was {RATIO:g}"
