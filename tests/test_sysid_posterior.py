"""Posteriors against closed forms and quadrature; gradients and simulated data on a rig."""

import json
import os
import signal
import sys
import threading

import numpy as np
import pytest
from closed_forms import WALL, ClosedForm, optimum
from conftest import COARSE, PAPER, RIG, excited, rolled
from scipy import stats

from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import Prior, Problem, Sensor, Stage, Unknown, record
from torchsoft.sysid.fit import Fit
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.posterior import Whitened, laplace, nuts
from torchsoft.sysid.runs import Runner

STRAIGHT = np.random.default_rng(0).standard_normal((20, 3))
BENT = ClosedForm(lambda x: [np.sinh(x[0]) + 0.3 * x[0] ** 2], 1)
"""One coordinate whose posterior is narrower and more skewed than the Gaussian at its optimum."""
BANANA = ClosedForm(lambda x: [x[0] - 0.1, x[1] - x[0] ** 2], 2, low=1e-6, high=1e6)


def exact(problem: ClosedForm, parts: tuple[float, ...]) -> np.ndarray:
    """Quantiles of the one coordinate of a problem, by quadrature."""
    low, high = problem.coordinates.bounds
    x = np.linspace(low[0], high[0], 20_001)
    p = np.exp([-0.5 * float(np.sum(problem.rows(np.array([v])) ** 2)) for v in x])
    return np.interp(parts, np.cumsum(p) / p.sum(), x)


def test_laplace_of_a_linear_problem_is_the_posterior(tmp_path):
    o = optimum(ClosedForm(lambda x: STRAIGHT @ x, 3), 0, 0, 0, workers=2)
    found = laplace(o, draws=1000)
    x = np.log(found.draws[0])
    C = np.linalg.inv(STRAIGHT.T @ STRAIGHT)
    np.testing.assert_allclose(np.cov(x.T), C, atol=0.1 * C.max())
    np.testing.assert_allclose(found.weights, 1e-3, rtol=1e-6)
    assert found.notices == []
    assert found.cost["simulations"] == 0  # of formulas
    found.save(tmp_path / "draws.json")
    saved = json.loads((tmp_path / "draws.json").read_text())
    assert saved["checks"]["efficiency"] == pytest.approx(1)
    assert saved["marginals"][0]["sd"] == pytest.approx(np.exp(x[:, 0]).std(), rel=1e-6)


def test_weights_correct_laplace_where_it_is_roughly_right():
    found = laplace(optimum(BENT, 0), draws=4000)
    (one,) = found.marginals
    ends = exact(BENT, (0.025, 0.5, 0.975))
    np.testing.assert_allclose(np.log([one.ci95[0], one.median, one.ci95[1]]), ends, atol=0.12)
    assert np.log(np.quantile(found.draws, 0.975)) > ends[2] + 0.4  # without weights
    assert found.checks["k_hat"] < 0.7


def test_laplace_says_where_it_is_not_to_be_trusted_and_refuses_where_it_says_nothing():
    bent = laplace(optimum(BANANA, 0.1, 0.01))
    assert bent.checks["k_hat"] > 0.7
    assert any("not to be trusted" in notice for notice in bent.notices)
    with pytest.raises(ValueError, match="fewer than one in 1000 draws"):
        laplace(optimum(ClosedForm(lambda x: [x[0], 1e-9 * x[1], 1e-9 * x[2]], 3), 0, 0, 0))
    with pytest.raises(ValueError, match="at least 100 draws"):
        laplace(optimum(BENT, 0), draws=50)


def test_draws_that_cannot_be_simulated_have_no_weight():
    found = laplace(
        optimum(ClosedForm(lambda x: [x[0]], 1, fails=lambda x: bool(x[0] > 0.5)), 0), draws=1000
    )
    lost = found.draws[0, :, 0] > np.exp(0.5)
    assert (found.weights[0, lost] == 0).all()
    assert found.checks["failed"] == lost.sum()
    assert any(
        f"{lost.sum()} of 1000 runs failed" in notice and WALL in notice for notice in found.notices
    )


def test_residuals_too_large_for_the_noise_are_said():
    off = ClosedForm(lambda x: np.append(STRAIGHT @ x, np.full(40, 3.0)), 3)
    assert any(
        "larger than the noise" in notice for notice in laplace(optimum(off, 0, 0, 0)).notices
    )


@pytest.mark.parametrize("kind", ["normal", "log-normal"])
@pytest.mark.parametrize("scale", ["log", "linear"])
def test_the_density_that_nuts_sees_has_its_gradient(kind, scale):
    prior = Prior(median=2.0, sd=0.7, kind=kind)
    o = optimum(
        ClosedForm(
            lambda x: [x[0] * x[1], np.sin(x[0])], 2, low=0.5, high=6.0, prior=prior, scale=scale
        ),
        0.3,
        0.4,
    )
    white = Whitened.of(o)
    for z in np.random.default_rng(1).standard_normal((3, 2)):
        _, gradient = white.density(o, z)
        by = [
            (white.density(o, z + h)[0] - white.density(o, z - h)[0]) / 2e-5
            for h in 1e-5 * np.eye(2)
        ]
        np.testing.assert_allclose(gradient, by, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("kind", "scale"), [("normal", "log"), ("log-normal", "linear")])
def test_without_data_nuts_gives_the_prior_back(kind, scale):
    """Whatever the coordinate's scale: densities of values, not of coordinates."""
    pytest.importorskip("nutpie")
    prior = Prior(median=2.0, sd=0.4, kind=kind)
    c = ClosedForm(lambda x: [0.0], 1, low=0.05, high=40.0, prior=prior, scale=scale)
    found = nuts(optimum(c, c.coordinates.all[0].to_x(2.0)), chains=2, draws=400, tune=60)
    own = stats.norm(2.0, 0.4) if kind == "normal" else stats.lognorm(0.4, scale=2.0)
    u = own.cdf(found.draws[:, ::5].ravel())
    assert stats.kstest(u, "uniform").pvalue > 1e-3


def test_nuts_finds_the_quantiles_and_the_same_draws_by_the_same_seed():
    pytest.importorskip("nutpie")
    found = nuts(optimum(BENT, 0, workers=2), chains=2, draws=500)
    ends = exact(BENT, (0.025, 0.5, 0.975))
    (one,) = found.marginals
    np.testing.assert_allclose(np.log([one.ci95[0], one.median, one.ci95[1]]), ends, atol=0.3)
    assert one.r_hat < 1.02
    assert one.effective > 200
    again = nuts(optimum(BENT, 0), chains=2, draws=500)
    np.testing.assert_array_equal(again.draws, found.draws)
    assert found.cost["gradients"] > 1000


def test_nuts_follows_a_banana():
    """p1 is p0^2, give or take one: its mean is 1.01, where Laplace has 0.01."""
    pytest.importorskip("nutpie")
    found = nuts(optimum(BANANA, 0.1, 0.01), chains=4, draws=300, accept=0.9)
    x = np.log(found.draws).reshape(-1, 2)
    assert x[:, 0].mean() == pytest.approx(0.1, abs=0.15)
    assert x[:, 1].mean() == pytest.approx(1.01, abs=0.3)
    assert x[:, 1].std() == pytest.approx(3.04**0.5, rel=0.2)


def test_nuts_says_where_it_has_not_arrived():
    pytest.importorskip("nutpie")
    thin = ClosedForm(lambda x: [x[0] - 0.1, 5 * (x[1] - x[0] ** 2)], 2, low=1e-6, high=1e6)
    found = nuts(optimum(thin, 0.1, 0.01), chains=2, draws=100, tune=60)
    assert any("diverged" in notice for notice in found.notices)
    assert any("have not mixed" in notice for notice in found.notices)


def test_nuts_takes_failing_runs_for_walls_and_says_so():
    pytest.importorskip("nutpie")
    found = nuts(
        optimum(ClosedForm(lambda x: [x[0]], 1, fails=lambda x: bool(x[0] > 0.5)), 0),
        chains=2,
        draws=200,
    )
    assert np.log(found.draws).max() <= 0.5
    assert found.checks["failed"] > 0
    assert any("runs failed" in notice and WALL in notice for notice in found.notices)


@pytest.fixture
def heard():
    """Ctrl-C is heard, which test runners in the background ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heard")
def test_an_interruption_keeps_the_draws_so_far():
    pytest.importorskip("nutpie")
    count, lock = 0, threading.Lock()

    def slowly(x: np.ndarray) -> list[float]:
        nonlocal count
        with lock:
            count += 1
            if count == 5 * 400:
                os.kill(os.getpid(), signal.SIGINT)
        return [x[0]]

    found = nuts(optimum(ClosedForm(slowly, 1), 0), chains=1, draws=100_000, tune=30)
    assert 10 < found.draws.shape[1] < 2000
    assert any("interrupted" in notice for notice in found.notices)
    count = 5 * 400 - 30  # in the middle of the tuning
    with pytest.raises(KeyboardInterrupt):
        nuts(optimum(ClosedForm(slowly, 1), 0), chains=1, draws=100_000, tune=1000)


def test_nuts_says_what_it_needs(monkeypatch):
    with pytest.raises(ValueError, match="4 draws and 20 for tuning"):
        nuts(optimum(BENT, 0), tune=5)
    monkeypatch.setitem(sys.modules, "nutpie.compiled_pyfunc", None)
    with pytest.raises(ImportError, match=r"pip install 'torchsoft\[nuts\]'"):
        nuts(optimum(BENT, 0))


@pytest.fixture(scope="module")
def rolling():
    """A quarter of a second on the coarse rig, with coloured noise of the force, a bias and a
    saturated sensor."""
    motion = Excitation(rolled(4e-3, 0.25, since=0.1), duration=0.25, grasp=0.1)
    roll = excited(motion, PAPER.override(COARSE))
    sensors = RIG | {
        "effort_x": Sensor(noise=0.1, bias=1.0),
        "effort_y": Sensor(noise=0.1, low=-60.0),
    }
    data = record("roll", roll, {}, sensors, noise=0.0)
    prior = Prior(median=0.75e6, sd=0.1, kind="log-normal")
    unknowns = {"pad.E": Unknown(prior=prior), "pad.tau": Unknown(low=5e-3, high=20e-3)}
    return Problem([data], sensors, unknowns, {"F_x": Autoregression.stated((0.8,), 5e-3)})


def test_the_density_on_a_rig_has_its_gradient(rolling):
    c = rolling.coordinates
    stage = Stage("all", rolling.names, c.labels, 1e-4)
    o = Fit(rolling, Runner(rolling.recordings), c.start, stage).begun()
    white, z = Whitened.of(o), np.array([0.4, -0.3, 0.2])
    _, gradient = white.density(o, z)
    by = [
        (white.density(o, z + h)[0] - white.density(o, z - h)[0]) / 2e-4 for h in 1e-4 * np.eye(3)
    ]
    np.testing.assert_allclose(gradient, by, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())
