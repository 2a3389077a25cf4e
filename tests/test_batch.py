"""Batches: what one call gives for many runs is what each would give alone, and one that fails
disturbs none."""

from time import sleep
from typing import Any

import pytest
import torch
from conftest import COARSE, coarse, f64, grasped, still, times

from torchsoft import (
    Circle,
    Reference,
    Rig,
    SamplesFailed,
    SimulationFailed,
    Taxels,
    Trajectory,
    hold,
    simulate,
    simulate_batch,
)
from torchsoft.parallel import parallel_map

T = times(0.1, 5)
VALUES = {
    "contact.K_n": f64(2e4, 3e4, 4.5e4),
    "contact.mu_s": f64(0.75, 0.95, 0.85),
    "disc.radius": 19.37e-3 * f64(1.0, 1.001, 1.0),
    "reference.signals.x_d.values": 0.06 + f64(0.0, 1e-6, 2e-6)[:, None],
}
WRT = ["contact.K_n", "pad.E"]


@pytest.fixture
def start():
    model = coarse()
    model.taxels["skin"] = Taxels("L", 3e-3, count=40)
    y0 = torch.stack([grasped(model, (0.02, 0.0))] * 3)
    y0[1, model.layout.slices["velocity", "disc"]] = f64(-0.01, 0.0, 0.5)
    return model, y0


def alone(model: Rig, i: int, y0: torch.Tensor, **options: Any) -> Trajectory:
    with torch.no_grad():
        for name, values in VALUES.items():
            model.parameter(name).copy_(values[i])
    return simulate(model, T, y0=y0, rtol=1e-4, **options)


@pytest.mark.parametrize("threads", [1, 2])
def test_every_run_is_the_one_it_would_be_alone(start, threads):
    """Values of one run are not those of the next; gradients with respect to parameters of each
    run, a shared one and the starts, and sensitivities."""
    model, y0 = start
    rows, starts = VALUES["contact.K_n"].clone().requires_grad_(), y0.clone().requires_grad_()
    given, E = VALUES | {"contact.K_n": rows}, model.parameter("pad.E")
    how = {"parameters": given, "rtol": 1e-4, "threads": threads}
    batch = simulate_batch(model, T, y0=starts, gradient="discrete", **how)
    ahead = simulate_batch(model, T, y0=y0, gradient="forward", wrt=WRT, rigid=True, **how)
    assert model.parameter("contact.K_n").item() == 1.2e5
    assert batch.y.shape == (3, 5, model.layout.size)
    assert batch["theta"].shape == batch.mask.shape == (3, 5)
    assert batch.mask.all()
    weights = torch.linspace(1, 2, 15, dtype=torch.float64).reshape(3, 5)
    felt = lambda run: run["theta"] + run["skin.normal.20"] + run["bracket_moment"]
    by_rows, by_starts, by_E = torch.autograd.grad((weights * felt(batch)).sum(), [rows, starts, E])
    shared = torch.zeros((), dtype=torch.float64)
    for i in range(3):
        one = y0[i].clone().requires_grad_()
        run = alone(model, i, one, gradient="discrete")
        assert torch.equal(batch.y[i], run.y)
        wanted = [model.parameter("contact.K_n"), one, E]
        by_K, by_start, more = torch.autograd.grad((weights[i] * felt(run)).sum(), wanted)
        assert torch.allclose(by_rows[i], by_K, rtol=1e-12, atol=0)
        assert torch.allclose(by_starts[i], by_start, rtol=1e-12, atol=1e-30)
        shared += more
        one = alone(model, i, y0[i], gradient="forward", wrt=WRT, rigid=True)
        assert torch.equal(ahead.sensitivities[i], one.sensitivities)
    assert torch.allclose(by_E, shared, rtol=1e-12, atol=0)


def test_references_times_and_rigs_of_their_own(start):
    """Shorter runs end in NaN behind the mask; frozen steps go in one by one; rigs of different
    sizes have channels in common only."""
    model, y0 = start
    other, ts = still(COARSE, shape=Circle(20.5e-3)), [T, times(0.05, 3)]
    top = float(y0[0, model.layout.slices["pose", "bracket"]][-1])
    references = [model.reference, hold(x_d=0.06, y_d=top, F_ff=-50.0)]
    how = {"y0": y0[:2], "reference": references}
    batch = simulate_batch([model, other], ts, rtol=1e-3, **how)
    assert batch.mask.sum(1).tolist() == [5, 3]
    assert torch.isnan(batch["x_C"][1, 3:]).all()
    assert torch.isnan(batch.t[1, 3:]).all()
    one = simulate(other, ts[1], y0=y0[1], reference=references[1], rtol=1e-3)
    assert torch.equal(batch.y[1, :3], one.y)
    knots = [run.knots for run in batch.trajectories if run is not None]
    again = simulate_batch([model, other], ts, knots=knots, **how)
    assert float((again.y - batch.y)[batch.mask].abs().max()) < 1e-9
    finer = coarse(pad__elements_x=80)
    batch = simulate_batch([model, finer], T, y0=[y0[0], grasped(finer)], rtol=1e-3)
    assert batch["x_C"].shape == (2, 5)
    with pytest.raises(ValueError, match="rows have different shapes"):
        _ = batch.y
    with pytest.raises(ValueError, match="run without sensitivities"):
        _ = batch.sensitivities


def test_a_run_that_fails_leaves_the_others_alone(start):
    """One that is lost on its way, with what it did until then, and one whose value is no
    parameter's."""
    model, y0 = start
    y0[1, model.layout.slices["velocity", "disc"]] = f64(20.0, 0.0, 0.0)
    E = f64(5e5, 5e5, -1.0).requires_grad_()
    with pytest.warns(SamplesFailed, match="2 of 3 runs failed; run 1: at t = ") as caught:
        batch = simulate_batch(
            model, times(0.2, 9), parameters={"pad.E": E}, y0=y0, rtol=1e-3, gradient="discrete"
        )
    assert caught[0].filename == __file__
    assert sorted(batch.failures) == [1, 2]
    lost = batch.failures[1]
    assert isinstance(lost, SimulationFailed)
    assert 0 < len(lost.trajectory.t) < 9
    assert "E` must be from 1" in str(batch.failures[2])
    assert batch.mask.sum(1).tolist() == [9, 0, 0]
    batch["theta"][batch.mask].sum().backward()
    assert E.grad[0].isfinite()
    assert E.grad[1] == E.grad[2] == 0.0 != E.grad[0]


K_n = VALUES["contact.K_n"]


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({}, "nothing differs from run to run"),
        ({"contact.K_n": K_n, "reference": [Reference()] * 2}, "reference 2, contact.K_n 3"),
        ({"contact.K": K_n}, "`contact.K` is not a parameter of this rig"),
        ({"contact.K_n": K_n[:, None]}, r"has shape \(\), but is given rows of shape \(1,\)"),
        ({"contact.K_n": K_n[0]}, "must have one entry a run"),
        ({"contact.K_n": K_n, "gradient": "continuous"}, "one of none, discrete, forward"),
    ],
)
def test_what_no_batch_can_be_is_rejected(given, match):
    model = coarse(pad__elements_x=24)
    values = {name: value for name, value in given.items() if "." in name}
    how = {"parameters": values} | {k: x for k, x in given.items() if "." not in k}
    with pytest.raises(ValueError, match=match):
        simulate_batch(model, T, y0=grasped(model), **how)


def test_work_side_by_side_waits_and_stops():
    """Results of every number; grad mode as outside; an exception ends what has not started."""
    started = []

    def work(i):
        started.append(i)
        if i == 2:
            raise KeyError(i)
        sleep(2e-3)
        return i * i, torch.is_grad_enabled()

    with torch.no_grad():
        assert dict(parallel_map(work, 2, 2)) == {0: (0, False), 1: (1, False)}
    with pytest.raises(KeyError):
        list(parallel_map(work, 500, 2))
    assert len(started) < 400
    assert sorted(k for k, _ in parallel_map(lambda i: i, 30, 4)) == [*range(30)]
