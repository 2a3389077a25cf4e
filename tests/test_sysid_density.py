"""The posterior density with its gradient: by differences on formulas and on a rig."""

import numpy as np
import pytest
from closed_forms import ClosedForm
from conftest import COARSE, PAPER, RIG, excited, rolled

from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import Prior, Problem, Sensor, Unknown, record
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.runs import Runner


def check_gradient(problem: Problem | ClosedForm, x: np.ndarray, steps: object, h: float) -> None:
    """Against central differences; both functions have the same values."""
    runner = Runner(problem.recordings)
    density = lambda x: problem.log_density(x, steps, runner)
    value, gradient = problem.log_density_and_gradient(x, steps, runner)
    assert value == pytest.approx(density(x), rel=1e-12)
    slopes = [(density(x + h * e) - density(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-4, atol=1e-4 * np.abs(slopes).max())


@pytest.mark.parametrize("kind", ["normal", "log-normal"])
@pytest.mark.parametrize("scale", ["log", "linear"])
def test_the_density_is_that_of_samples_and_priors_in_the_coordinates(kind, scale):
    prior, of = Prior(median=2.0, sd=0.7, kind=kind), lambda x: [x[0] * x[1], np.sin(x[0])]
    problem = ClosedForm(of, 2, low=0.5, high=6.0, prior=prior, scale=scale)
    a, b = np.random.default_rng(1).uniform(0.2, 0.9, (2, 2))
    for x in (a, b):
        check_gradient(problem, x, 1e-4, 1e-5)
    every = problem.coordinates.all
    change = problem.log_density(b) - problem.log_density(a)
    volume = [
        sum(np.log(c.slope(v) * prior.row(c.to_value(v))[1]) for c, v in zip(every, x))
        for x in (a, b)
    ]  # of (ln) value by x, which is what the prior is normal in
    half = [-0.5 * float(problem.rows(x) @ problem.rows(x)) for x in (a, b)]
    assert change == pytest.approx(half[1] - half[0] + volume[1] - volume[0], rel=1e-9)


def test_there_is_no_density_beyond_the_bounds_and_where_a_run_fails():
    walled = ClosedForm(lambda x: [x[0]], 1, fails=lambda x: bool(x[0] > 0.5), high=10.0)
    for x in (0.6, 3.0):
        value, gradient = walled.log_density_and_gradient(np.array([x]))
        assert value == walled.log_density(np.array([x])) == -np.inf
        assert np.isnan(gradient).all()
    assert walled.log_density(np.array([0.4])) == pytest.approx(-0.08)


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
    x, runner = problem.coordinates.start + np.array([4e-3, -2e-2, 1e-3]), Runner([data])
    steps = problem.residuals(runner, x, problem.names, 1e-3).steps
    check_gradient(problem, x, steps, 1e-5)
