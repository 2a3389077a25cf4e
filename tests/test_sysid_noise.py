"""Coloured noise against dense algebra, orders that are found, intervals that keep their coverage;
robust losses."""

import numpy as np
import pytest
from scipy import linalg, optimize, signal, stats

from torchsoft.sysid.colour import colours, spread
from torchsoft.sysid.fit import (
    EFFICIENCY,
    REACH,
    Loss,
    covariance,
    fisher,
    robust_loss_except_priors,
)
from torchsoft.sysid.noise import Autoregression, fit_noise, log_det
from torchsoft.sysid.residual_tests import Part

H = 5e-3
PROCESSES = {"white": (), "one": (0.9,), "two": (1.6, -0.8), "four": (0.5, -0.3, 0.2, 0.1)}


def made(noise: Autoregression, m: int, rng: np.random.Generator) -> np.ndarray:
    """Samples (m,), after it has forgotten its first values."""
    e = noise.scale * rng.standard_normal(m + 500)
    return signal.lfilter([1.0], np.concatenate(([1.0], -np.array(noise.phi))), e)[500:]


GRIDS = {
    "whole": (np.arange(400), 12, 1e-12),
    "half": (np.sort(np.random.default_rng(1).permutation(400)[:200]), 12, 1e-12),
    "every other": (np.append([0, 1], np.arange(2, 1000, 2)), 201, 1e-9),
}
"""Steps at which there are samples, numbers in a row of the whitener, and the rounding."""


@pytest.mark.parametrize("phi", PROCESSES.values(), ids=PROCESSES)
@pytest.mark.parametrize("grid", GRIDS)
def test_whitening_is_that_of_the_dense_covariance(phi, grid):
    """To rounding, with gaps; every other sample never makes a run of two, and is whitened from as
    far back as the memory reaches."""
    noise, (at, most, atol) = Autoregression(phi, 0.7, H), GRIDS[grid]
    W = noise.whitener(at * H + 3.0)
    K = linalg.toeplitz(noise.autocovariance(1000))[np.ix_(at, at)]
    np.testing.assert_allclose(W @ K @ W.T, np.eye(len(at)), atol=atol)
    assert log_det(W) == pytest.approx(np.linalg.slogdet(K)[1], rel=atol)
    assert W.nnz < most * len(at)


def test_autocovariance_of_known_processes():
    """The second by Yule and Walker."""
    one = Autoregression((0.9,), 2.0, H)
    np.testing.assert_allclose(one.autocovariance(5), 4 / 0.19 * 0.9 ** np.arange(5))
    a, b = 1.6, -0.8
    gamma = Autoregression((a, b), 1.0, H).autocovariance(4)
    first = a / (1 - b)
    second = a * first + b
    np.testing.assert_allclose(gamma[1:] / gamma[0], [first, second, a * second + b * first])
    assert gamma[0] == pytest.approx((1 - b) / ((1 + b) * ((1 - b) ** 2 - a**2)))
    assert Autoregression.stated((a, b), H).sd == pytest.approx(1.0)
    assert Autoregression((0.5,), 1.0, H).at_least(3.0).sd == pytest.approx(3.0)


@pytest.mark.parametrize("phi", PROCESSES.values(), ids=PROCESSES)
def test_so_many_independent_samples_determine_the_variance_as_well(phi):
    """Of a sample variance the variance is twice the sum of squared covariances, over n^2."""
    noise = Autoregression(phi, 1.3, H)
    K = linalg.toeplitz(noise.autocovariance(300))
    assert noise.effective(300) == pytest.approx((300 * K[0, 0]) ** 2 / np.sum(K**2))


def test_off_a_grid_noise_decays_with_time():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.3, 1.7, 300)) * H
    K = 0.9 ** (np.abs(np.subtract.outer(t, t)) / H)
    W = Autoregression.stated((0.9,), H).whitener(t)
    np.testing.assert_allclose(W @ K @ W.T, np.eye(300), atol=1e-10)
    with pytest.raises(ValueError, match="not on such a grid"):
        Autoregression((1.6, -0.8), 1.0, H).whitener(t)
    L = np.linalg.cholesky(K)
    found = fit_noise([(t, L @ rng.standard_normal(300)) for _ in range(3)]).noise
    assert found.phi[0] ** (H / found.spacing) == pytest.approx(0.9, abs=0.04)
    assert fit_noise([(t, rng.standard_normal(300))]).noise.order == 0


@pytest.mark.parametrize("phi", [(1.0,), (0.5, 0.6)])
def test_noise_that_grows_is_rejected(phi):
    with pytest.raises(ValueError, match="not stationary"):
        Autoregression(phi, 1.0, H)


@pytest.mark.parametrize(("name", "kept"), [("white", 0.9), ("two", 1.0), ("four", 0.9)])
def test_order_and_coefficients_are_found_over_several_recordings(name, kept):
    phi, rng, series = PROCESSES[name], np.random.default_rng(3), []
    for m in (600, 900, 700):
        at = np.sort(rng.permutation(m)[: int(kept * m)])
        series.append((at * H + 1.0, made(Autoregression(phi, 1.3, H), m, rng)[at]))
    found = fit_noise(series)
    assert found.noise.order == len(phi)
    np.testing.assert_allclose(found.noise.phi, phi, atol=0.08)
    assert found.noise.scale == pytest.approx(1.3, rel=0.05)
    assert found.noise.spacing == pytest.approx(H)


def test_intervals_keep_their_coverage_under_coloured_noise():
    """A linear model of three slow signals: with colour that is declared, and with the sandwich
    covariance where it is not. White intervals would hold the truth in about half the cases."""
    rng, t = np.random.default_rng(0), np.arange(400) * H
    z = {"declared": [], "undeclared": [], "ignored": []}
    for _ in range(120):
        J = signal.lfilter(*signal.butter(2, 0.08), rng.standard_normal((600, 3)), axis=0)[200:]
        r = made(Autoregression.stated((0.9,), H), 400, rng)
        white = np.linalg.lstsq(J, r, rcond=None)[0]
        z["ignored"].append(white / np.sqrt(np.diag(fisher(J)[0])))
        part, C = Part("run", "x", t, np.arange(400), r - J @ white, r), fisher(J)[0]
        found = colours([part], J)
        z["undeclared"].append(white / np.sqrt(np.diag(C + spread(J, C, [part], found))))
        W = found["x"].noise.whitener(t)
        best = np.linalg.lstsq(W @ J, W @ r, rcond=None)[0]
        z["declared"].append(best / np.sqrt(np.diag(fisher(W @ J)[0])))
    inside = {k: float(np.mean(np.abs(some) < stats.norm.ppf(0.975))) for k, some in z.items()}
    assert 0.92 < inside["declared"] < 0.98
    assert 0.9 < inside["undeclared"] < 0.99
    assert inside["ignored"] < 0.7


@pytest.mark.parametrize("loss", ["soft_l1", "huber"])
def test_losses_are_scipys_and_leave_priors_quadratic(loss: Loss):
    rng = np.random.default_rng(0)
    J, y = rng.standard_normal((60, 2)), 3 * rng.standard_normal(60)

    def fit(by, prior=0.0):
        return optimize.least_squares(
            lambda x: np.append(J @ x - y, prior * (x - 2.0)), [0.0, 0.0], loss=by,
            f_scale=REACH[loss], xtol=1e-14, ftol=1e-14,
        )  # fmt: skip

    one, other = fit(loss), fit(robust_loss_except_priors(loss, 0))
    np.testing.assert_allclose(other.x, one.x, rtol=1e-5, atol=1e-7)
    assert other.cost == pytest.approx(one.cost, rel=1e-12)
    assert np.abs(fit(robust_loss_except_priors(loss, 2), 50.0).x - 2.0).max() < 0.1


@pytest.mark.parametrize(("loss", "bad"), [("huber", 0.0), ("soft_l1", 0.1)])
def test_robust_covariance_is_that_of_many_fits(loss: Loss, bad):
    """With Gaussian noise, at the efficiency that its reach was made for; and with one outlier in
    ten, ten times as large."""
    rng = np.random.default_rng(0)
    J = rng.standard_normal((300, 4))
    outliers = np.where(rng.random((300, 300)) < bad, 10.0, 1.0)
    y = rng.standard_normal((300, 300)) * outliers
    plain = np.linalg.lstsq(J, y.T, rcond=None)[0].T
    fits = [
        optimize.least_squares(
            lambda x, one=one: J @ x - one, start, jac=lambda x: J, f_scale=REACH[loss],
            loss=robust_loss_except_priors(loss, 0),
        )
        for one, start in zip(y, 0.9 * plain)
    ]  # fmt: skip
    stated = np.array([np.diag(covariance(J, fit.fun, loss)) for fit in fits])
    ends = np.array([fit.x for fit in fits])
    assert np.mean(ends**2) == pytest.approx(np.mean(stated), rel=0.1)
    inside = np.mean(np.abs(ends) < stats.norm.ppf(0.975) * np.sqrt(stated))
    assert 0.93 < inside < 0.97
    gain = np.mean(plain**2) / np.mean(ends**2)
    assert gain > 3 if bad else gain == pytest.approx(EFFICIENCY, abs=0.03)


def test_robust_covariance_where_no_sample_counts_is_rejected():
    with pytest.raises(ValueError, match="holds on to nothing"):
        covariance(np.ones((40, 1)), np.full(40, 50.0), "huber")


def test_a_covariance_has_the_priors_and_the_degrees_of_freedom():
    J = np.array([[1.0]] * 40 + [[10.0]])
    assert covariance(J, np.zeros(41), "linear", 1)[0, 0] == pytest.approx(1 / 140)
    J, r = np.random.default_rng(0).standard_normal((12, 4)), np.full(12, 9.0)
    expected = np.linalg.inv(J.T @ J) * (r @ r) / (12 - 4)
    np.testing.assert_allclose(covariance(J, r, "linear"), expected, rtol=1e-9)
