"""Posteriors against closed forms and quadrature; their density on a rig."""

import numpy as np
import pytest
from closed_forms import WALL, ClosedForm, optimum
from conftest import COARSE, PAPER, RIG, excited, rolled

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


def exact(problem: ClosedForm) -> np.ndarray:
    """The median and the ends of the 95 % interval of the one coordinate, by quadrature."""
    (low,), (high,) = problem.coordinates.bounds
    x = np.linspace(low, high, 20_001)
    p = np.exp([-0.5 * float(np.sum(problem.rows(np.array([v])) ** 2)) for v in x])
    return np.interp((0.025, 0.5, 0.975), np.cumsum(p) / p.sum(), x)


def test_laplace_of_a_linear_problem_is_the_posterior():
    o = optimum(ClosedForm(lambda x: STRAIGHT @ x, 3), 0, 0, 0, workers=2)
    found = laplace(o, draws=1000)
    x, C = np.log(found.draws[0]), np.linalg.inv(STRAIGHT.T @ STRAIGHT)
    np.testing.assert_allclose(np.cov(x.T), C, atol=0.1 * C.max())
    np.testing.assert_allclose(found.weights, 1e-3, rtol=1e-6)
    assert found.notices == []
    assert found.marginals[0].sd == pytest.approx(np.exp(x[:, 0]).std(), rel=1e-6)


def test_weights_correct_laplace_or_report_that_it_is_not_to_be_trusted():
    found = laplace(optimum(BENT, 0), draws=4000)
    (one,) = found.marginals
    np.testing.assert_allclose(
        np.log([one.ci95[0], one.median, one.ci95[1]]), exact(BENT), atol=0.12
    )
    bent = laplace(optimum(BANANA, 0.1, 0.01))
    assert found.checks["k_hat"] < 0.7 < bent.checks["k_hat"]
    assert any("not to be trusted" in notice for notice in bent.notices)
    with pytest.raises(ValueError, match="fewer than one in 1000 draws"):
        laplace(optimum(ClosedForm(lambda x: [x[0], 1e-9 * x[1], 1e-9 * x[2]], 3), 0, 0, 0))


def test_nuts_finds_the_quantiles_the_same_by_the_same_seed_and_reports_failing_runs():
    pytest.importorskip("nutpie")
    found, again = (nuts(optimum(BENT, 0, workers=k), chains=2, draws=400) for k in (2, 1))
    (one,) = found.marginals
    np.testing.assert_allclose(
        np.log([one.ci95[0], one.median, one.ci95[1]]), exact(BENT), atol=0.3
    )
    assert one.r_hat < 1.02
    np.testing.assert_array_equal(again.draws, found.draws)
    walled = ClosedForm(lambda x: [x[0]], 1, fails=lambda x: bool(x[0] > 0.5))
    stopped = nuts(optimum(walled, 0), chains=2, draws=100)
    assert np.log(stopped.draws).max() <= 0.5
    assert any("runs failed" in notice and WALL in notice for notice in stopped.notices)


def check_density(o: Fit, z: np.ndarray, h: float, rtol: float) -> None:
    """Its gradient against differences."""
    white = Whitened.of(o)
    _, gradient = white.density(o, z)
    ahead, behind = (
        np.array([white.density(o, z + s * h * e)[0] for e in np.eye(len(z))]) for s in (1, -1)
    )
    atol = rtol * np.abs(gradient).max()
    np.testing.assert_allclose(gradient, (ahead - behind) / (2 * h), rtol=rtol, atol=atol)


@pytest.mark.parametrize("kind", ["normal", "log-normal"])
@pytest.mark.parametrize("scale", ["log", "linear"])
def test_the_density_has_its_gradient(kind, scale):
    bent = ClosedForm(
        lambda x: [x[0] * x[1], np.sin(x[0])], 2, low=0.5, high=6.0,
        prior=Prior(median=2.0, sd=0.7, kind=kind), scale=scale,
    )  # fmt: skip
    for z in np.random.default_rng(1).standard_normal((3, 2)):
        check_density(optimum(bent, 0.3, 0.4), z, 1e-5, 1e-5)


def test_the_density_on_a_rig_has_its_gradient():
    """With coloured noise of a force, a bias, a saturated sensor and a prior."""
    motion = Excitation(rolled(4e-3, 0.25, since=0.1), duration=0.25, grasp=0.1)
    sensors = RIG | {
        "effort_x": Sensor(noise=0.1, bias=1.0),
        "effort_y": Sensor(noise=0.1, low=-60.0),
    }
    data = record("roll", excited(motion, PAPER.override(COARSE)), {}, sensors, rtol=1e-4, noise=0)
    prior = Prior(median=0.74e6, sd=0.01, kind="log-normal")
    unknowns = {"pad.E": Unknown(prior=prior), "pad.tau": Unknown(low=5e-3, high=20e-3)}
    problem = Problem([data], sensors, unknowns, {"F_x": Autoregression.stated((0.8,), 5e-3)})
    c = problem.coordinates
    stage = Stage("all", problem.names, c.labels, 1e-3)
    o = Fit(problem, Runner([data]), c.start, stage).begun()
    check_density(o, np.array([0.4, -0.3, 0.2]), 1e-4, 1e-3)
