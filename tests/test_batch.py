"""Batches: what one call gives for many runs is what each would give alone, and one that fails
disturbs none."""

from time import sleep
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse, f64, grasped, still, times
from torch import Tensor

from torchsoft import (
    Batch,
    Circle,
    Reference,
    Rig,
    SamplesFailed,
    SimulationFailed,
    hold,
    simulate,
    simulate_batch,
)
from torchsoft.parallel import parallel_map

T = times(0.2, 9)
K_n = f64(2e4, 3e4, 4.5e4)
mu_s = f64(0.75, 0.95, 0.85)


@pytest.fixture
def start():
    model = coarse()
    y0 = grasped(model, (0.02, 0.0))
    return model, torch.stack([y0, y0, y0])


def alone(model: Rig, i: int, y0: Tensor, **options: Any) -> Any:
    with torch.no_grad():
        for name, values in (("contact.K_n", K_n), ("contact.mu_s", mu_s)):
            model.parameter(name).fill_(values[i])
    return simulate(model, T, y0=y0, rtol=1e-4, **options)


@pytest.mark.parametrize("threads", [1, 2])
def test_every_run_is_the_one_it_would_be_alone(start, threads):
    model, y0 = start
    y0[1, model.layout.slices["velocity", "disc"]] = f64(-0.01, 0.0, 0.5)
    batch = simulate_batch(
        model,
        T,
        parameters={"contact.K_n": K_n, "contact.mu_s": mu_s},
        y0=y0,
        rtol=1e-4,
        threads=threads,
    )
    assert model.parameter("contact.K_n").item() == coarse().parameter("contact.K_n").item()
    for i in range(3):
        assert torch.equal(batch.y[i], alone(model, i, y0[i]).y)
    assert batch.y.shape == (3, 9, model.layout.size)
    assert batch["theta"].shape == (3, 9)
    assert batch.mask.all()
    assert len(batch) == 3


def test_gradients_reach_what_differs_from_run_to_run(start):
    """The same as of the runs one by one, by parameters of each run, a shared one and the
    starts."""
    model, y0 = start
    rows, starts = K_n.clone().requires_grad_(), y0.clone().requires_grad_()
    E = model.parameter("pad.E")
    weights = torch.linspace(1, 2, 27, dtype=torch.float64).reshape(3, 9)
    batch = simulate_batch(
        model,
        T,
        parameters={"contact.K_n": rows, "contact.mu_s": mu_s},
        y0=starts,
        rtol=1e-4,
        gradient="discrete",
    )
    got = torch.autograd.grad((weights * batch["theta"]).sum(), [rows, starts, E])
    by_E = torch.zeros((), dtype=torch.float64)
    for i in range(3):
        one = y0[i].clone().requires_grad_()
        run = alone(model, i, one, gradient="discrete")
        by_K, by_start, more = torch.autograd.grad(
            (weights[i] * run["theta"]).sum(), [model.parameter("contact.K_n"), one, E]
        )
        assert torch.allclose(got[0][i], by_K, rtol=1e-12, atol=0)
        assert torch.allclose(got[1][i], by_start, rtol=1e-12, atol=1e-30)
        by_E += more
    assert torch.allclose(got[2], by_E, rtol=1e-12, atol=0)


def test_sensitivities_are_stacked(start):
    model, y0 = start
    wrt = ["contact.K_n", "pad.E"]
    batch = simulate_batch(
        model, T, parameters={"contact.K_n": K_n.clone().requires_grad_(), "contact.mu_s": mu_s},
        y0=y0, rtol=1e-4, gradient="forward", wrt=wrt, rigid=True,
    )  # fmt: skip
    for i in range(3):
        one = alone(model, i, y0[i], gradient="forward", wrt=wrt, rigid=True)
        assert torch.equal(batch.sensitivities[i], one.sensitivities)
    with pytest.raises(ValueError, match="run without sensitivities"):
        _ = simulate_batch(model, T, y0=y0, rtol=1e-3).sensitivities


def test_references_times_and_rigs_of_their_own(start):
    """Shorter runs end in NaN behind the mask; frozen steps go in one by one."""
    model, y0 = start
    other = still(COARSE, shape=Circle(20.5e-3))
    references = [
        model.reference,
        hold(x_d=0.06, y_d=float(y0[0, model.layout.slices["pose", "bracket"]][-1]), F_ff=-50.0),
    ]
    ts = [T, times(0.1, 4)]
    batch = simulate_batch([model, other], ts, y0=y0[:2], reference=references, rtol=1e-3)
    assert batch.mask.sum(1).tolist() == [9, 4]
    assert torch.isnan(batch["x_C"][1, 4:]).all()
    assert torch.isnan(batch.t[1, 4:]).all()
    assert torch.equal(
        batch.y[1, :4], simulate(other, ts[1], y0=y0[1], reference=references[1], rtol=1e-3).y
    )
    loss = batch["y_C"][batch.mask].square().sum()
    assert torch.isfinite(loss)
    knots = [run.knots for run in batch.trajectories if run is not None]
    again = simulate_batch([model, other], ts, y0=y0[:2], reference=references, knots=knots)
    assert float((again.y - batch.y)[batch.mask].abs().max()) < 1e-9


def test_a_run_that_fails_leaves_the_others_alone(start):
    """One that is lost on its way, with what it did until then, and one whose number is no
    parameter."""
    model, y0 = start
    y0[1, model.layout.slices["velocity", "disc"]] = f64(20.0, 0.0, 0.0)
    E = f64(5e5, 5e5, -1.0).requires_grad_()
    with pytest.warns(SamplesFailed, match="2 of 3 runs failed; run 1: at t = ") as caught:
        batch = simulate_batch(
            model, T, parameters={"pad.E": E}, y0=y0, rtol=1e-3, gradient="discrete"
        )
    assert caught[0].filename == __file__
    assert sorted(batch.failures) == [1, 2]
    lost = batch.failures[1]
    assert isinstance(lost, SimulationFailed)
    assert 0 < len(lost.trajectory.t) < len(T)
    assert "pad.E" in str(batch.failures[2]) or "E` must be from 1" in str(batch.failures[2])
    assert batch.mask.sum(1).tolist() == [9, 0, 0]
    batch["theta"][batch.mask].sum().backward()
    assert E.grad.isfinite().all()
    assert E.grad[1] == E.grad[2] == 0.0 != E.grad[0]


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({}, "nothing differs from run to run"),
        (
            {"parameters": {"contact.K_n": K_n}, "reference": [Reference()] * 2},
            "reference 2, contact.K_n 3",
        ),
        ({"parameters": {"contact.K": K_n}}, "`contact.K` is not a parameter of this rig"),
        (
            {"parameters": {"contact.K_n": K_n[:, None]}},
            r"`contact.K_n` has shape \(\), but is given rows of shape \(1,\)",
        ),
        ({"parameters": {"contact.K_n": K_n[0]}}, "must have one entry a run"),
        ({"parameters": {"contact.K_n": K_n + 0j}}, "float64"),
        (
            {"parameters": {"contact.K_n": K_n}, "gradient": "continuous"},
            "`gradient` must be one of none, discrete, forward",
        ),
        (
            {"parameters": {"contact.K_n": K_n}, "threads": 0},
            "`threads` must be a whole number from 1 on, but is",
        ),
    ],
)
def test_what_no_batch_can_be_is_refused(start, options, match):
    model, y0 = start
    with pytest.raises(ValueError, match=match):
        simulate_batch(model, T, y0=y0[0], **options)


def test_rigs_of_different_sizes_have_channels_in_common_only(
    start,
):
    model, y0 = start
    finer = coarse(pad__elements_x=80)
    batch: Batch = simulate_batch([model, finer], T, y0=[y0[0], grasped(finer)], rtol=1e-3)
    assert batch["x_C"].shape == (2, 9)
    with pytest.raises(ValueError, match="rows have different shapes"):
        _ = batch.y


def test_side_by_side_waits_and_stops():
    """Results of every number; grad mode as outside; an exception ends what has not begun."""
    begun: list[int] = []

    def work(i: int) -> tuple[int, bool]:
        begun.append(i)
        if i == 2:
            raise KeyError(i)
        sleep(2e-3)
        return i * i, torch.is_grad_enabled()

    with torch.no_grad():
        assert dict(parallel_map(work, 2, 2)) == {0: (0, False), 1: (1, False)}
    with pytest.raises(KeyError):
        list(parallel_map(work, 500, 2))
    assert len(begun) < 400
    assert np.array_equal(sorted(k for k, _ in parallel_map(lambda i: i, 30, 4)), np.arange(30))
