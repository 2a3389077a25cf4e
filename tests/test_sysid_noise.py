"""Coloured noise: whitening against dense algebra, orders that are found, intervals that keep their
coverage; robust losses."""

import numpy as np
import pytest
from scipy import linalg, optimize, signal, stats

from torchsoft.sysid.fit import (
    EFFICIENCY,
    REACH,
    Loss,
    covariance,
    fisher,
    rho,
    robust_loss_except_priors,
)
from torchsoft.sysid.noise import (
    Autoregression,
    coefficients,
    fit_noise,
    log_det,
    reflections,
    spacing,
)

H = 5e-3
PROCESSES = {"one": (0.9,), "two": (1.6, -0.8), "four": (0.5, -0.3, 0.2, 0.1)}
ROBUST: tuple[Loss, ...] = ("soft_l1", "huber", "cauchy", "arctan")


def made(noise: Autoregression, m: int, rng: np.random.Generator) -> np.ndarray:
    """Samples (m,), after it has forgotten how it began."""
    e = noise.scale * rng.standard_normal(m + 500)
    return signal.lfilter([1.0], np.concatenate(([1.0], -np.array(noise.phi))), e)[500:]


@pytest.mark.parametrize("phi", PROCESSES.values(), ids=PROCESSES)
@pytest.mark.parametrize("kept", [1.0, 0.9, 0.5])
def test_whitening_is_that_of_the_dense_covariance(phi, kept):
    """To rounding, with gaps."""
    noise = Autoregression(phi, 0.7, H)
    at = np.sort(np.random.default_rng(1).permutation(400)[: int(400 * kept)])
    W = noise.whitener(at * H + 3.0)
    K = linalg.toeplitz(noise.autocovariance(400))[np.ix_(at, at)]
    np.testing.assert_allclose(W @ K @ W.T, np.eye(len(at)), atol=1e-12)
    assert log_det(W) == pytest.approx(np.linalg.slogdet(K)[1], rel=1e-12)
    assert W.nnz < 12 * len(at)


def test_a_half_empty_grid_looks_back_as_far_as_the_memory_goes():
    """Every other sample never makes a run of two; what is left out does not matter."""
    noise, at = Autoregression((1.6, -0.8), 1.0, H), np.concatenate(([0, 1], np.arange(2, 1200, 2)))
    W = noise.whitener(at * H)
    K = linalg.toeplitz(noise.autocovariance(1200))[np.ix_(at, at)]
    assert W.nnz < 201 * len(at)
    np.testing.assert_allclose(W @ K @ W.T, np.eye(len(at)), atol=1e-9)


def test_autocovariance_of_known_processes():
    np.testing.assert_allclose(
        Autoregression((0.9,), 2.0, H).autocovariance(5), 4 / 0.19 * 0.9 ** np.arange(5)
    )
    a, b = 1.6, -0.8  # Yule and Walker by hand
    gamma = Autoregression((a, b), 1.0, H).autocovariance(4)
    rho1 = a / (1 - b)
    np.testing.assert_allclose(
        gamma[1:] / gamma[0], [rho1, a * rho1 + b, a * (a * rho1 + b) + b * rho1]
    )
    assert gamma[0] == pytest.approx((1 - b) / ((1 + b) * ((1 - b) ** 2 - a**2)))
    np.testing.assert_allclose(Autoregression((), 0.5, H).autocovariance(3), [0.25, 0, 0])
    assert Autoregression.stated((a, b), H).sd == pytest.approx(1.0)
    assert Autoregression((0.5,), 1.0, H).at_least(3.0).sd == pytest.approx(3.0)
    assert Autoregression((0.5,), 1.0, H).at_least(1.0).scale == 1.0


def test_off_a_grid_noise_decays_with_time():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.3, 1.7, 300)) * H
    noise = Autoregression.stated((0.9,), H)
    K = 0.9 ** (np.abs(np.subtract.outer(t, t)) / H)
    W = noise.whitener(t)
    np.testing.assert_allclose(W @ K @ W.T, np.eye(300), atol=1e-10)
    with pytest.raises(ValueError, match="not on such a grid"):
        Autoregression((1.6, -0.8), 1.0, H).whitener(t)
    found = fit_noise(
        [(t, np.linalg.cholesky(K) @ rng.standard_normal(300)) for _ in range(3)]
    ).noise
    assert found.phi[0] ** (H / found.spacing) == pytest.approx(0.9, abs=0.04)
    assert fit_noise([(t, rng.standard_normal(300))]).noise.order == 0


def test_what_grows_is_refused():
    with pytest.raises(ValueError, match="not stationary"):
        Autoregression((1.0,), 1.0, H)
    with pytest.raises(ValueError, match="not stationary"):
        Autoregression((0.5, 0.6), 1.0, H)
    with pytest.raises(ValueError, match="must be positive"):
        Autoregression((0.5,), 0.0, H)
    walk = np.cumsum(np.random.default_rng(0).standard_normal(500))
    found = fit_noise([(np.arange(500) * H, walk)]).noise
    assert 0.95 < found.phi[0] < 1 if found.order == 1 else found.order > 1  # it can be made at all
    kappa = np.array([0.5, -0.9, 0.3])
    np.testing.assert_allclose(reflections(tuple(coefficients(kappa))), kappa)


@pytest.mark.parametrize("kept", [1.0, 0.9])
@pytest.mark.parametrize("phi", [(), *PROCESSES.values()], ids=["white", *PROCESSES])
def test_order_and_coefficients_are_found_over_several_recordings(phi, kept):
    rng, noise = np.random.default_rng(3), Autoregression(phi, 1.3, H)
    series = []
    for m in (600, 900, 700):
        at = np.sort(rng.permutation(m)[: int(kept * m)])
        series.append((at * H + 1.0, made(noise, m, rng)[at]))
    found = fit_noise(series)
    assert found.noise.order == len(phi)
    assert [score.order for score in found.scores] == list(range(13))
    np.testing.assert_allclose(found.noise.phi, phi, atol=0.08)
    assert found.noise.scale == pytest.approx(1.3, rel=0.05)
    assert found.noise.spacing == pytest.approx(H)
    true = sum(
        2 * len(t) * np.log(1.3)
        + log_det(W := Autoregression(phi, 1.0, H).whitener(t))
        + np.sum((W @ r / 1.3) ** 2)
        for t, r in series
    )  # near the maximum of the likelihood, at which half the ratio's logarithm is chi-squared
    assert -1.0 < true - found.scores[len(phi)].deviance < stats.chi2.isf(1e-3, len(phi) + 1)


@pytest.mark.slow
def test_recordings_at_half_the_rate_take_part():
    rng, noise = np.random.default_rng(0), Autoregression((1.6, -0.8), 1.0, H)
    t = np.arange(1000) * H
    found = fit_noise([(t, made(noise, 1000, rng)), (t[::2], made(noise, 1000, rng)[::2])])
    assert found.noise.order == 2
    assert found.noise.spacing == pytest.approx(H)
    assert spacing(np.delete(t, [5, 6, 300])) == pytest.approx(H)


def test_so_many_samples_tell_the_level():
    """The variance of the sample variance, by Monte Carlo."""
    noise, rng = Autoregression.stated((0.9,), H), np.random.default_rng(0)
    squares = [np.mean(made(noise, 400, rng) ** 2) for _ in range(2000)]
    assert 2 / np.var(squares) == pytest.approx(noise.effective(400), rel=0.12)
    assert Autoregression((), 1.0, H).effective(400) == 400


def test_intervals_keep_their_coverage_under_coloured_noise():
    """A linear model of three slow signals; white intervals would hold the truth in about half the
    cases."""
    rng, t, z = np.random.default_rng(0), np.arange(400) * H, {"found": [], "ignored": []}
    for _ in range(120):
        J = signal.lfilter(*signal.butter(2, 0.08), rng.standard_normal((600, 3)), axis=0)[200:]
        r = made(Autoregression.stated((0.9,), H), 400, rng)
        white = np.linalg.lstsq(J, r, rcond=None)[0]
        z["ignored"].append(white / np.sqrt(np.diag(fisher(J)[0])))
        W = fit_noise([(t, r - J @ white)], 3).noise.at_least(1.0).whitener(t)
        z["found"].append(
            np.linalg.lstsq(W @ J, W @ r, rcond=None)[0] / np.sqrt(np.diag(fisher(W @ J)[0]))
        )
    inside = {
        name: float(np.mean(np.abs(some) < stats.norm.ppf(0.975))) for name, some in z.items()
    }
    assert 0.92 < inside["found"] < 0.98
    assert inside["ignored"] < 0.7


@pytest.mark.parametrize("loss", ROBUST)
def test_losses_are_scipys(loss):
    z = np.linspace(0.0, 9.0, 200)
    h = 1e-6
    near = np.abs(z - 1) > 0.05  # of Huber's kink
    np.testing.assert_allclose(
        ((rho(loss, z + h) - rho(loss, z)) / h)[:2, near], rho(loss, z)[1:, near], atol=1e-4
    )
    rng = np.random.default_rng(0)
    J, y = rng.standard_normal((60, 2)), 3 * rng.standard_normal(60)
    options: dict = {
        "x0": np.zeros(2),
        "jac": lambda x: J,
        "f_scale": REACH[loss],
        "xtol": 1e-14,
        "ftol": 1e-14,
    }
    one = optimize.least_squares(lambda x: J @ x - y, loss=loss, **options)
    other = optimize.least_squares(
        lambda x: J @ x - y, loss=robust_loss_except_priors(loss, 0), **options
    )
    np.testing.assert_allclose(other.x, one.x, rtol=1e-12)
    assert other.cost == pytest.approx(one.cost, rel=1e-12)
    prior = optimize.least_squares(
        lambda x: np.append(J @ x - y, 50.0 * (x - 2.0)),
        loss=robust_loss_except_priors(loss, 2),
        x0=np.zeros(2),
    )
    assert np.abs(prior.x - 2.0).max() < 0.1  # however far off, a prior is no outlier


@pytest.mark.parametrize(
    ("loss", "bad"), [*((loss, 0.0) for loss in ROBUST), ("huber", 0.1), ("cauchy", 0.1)]
)
def test_robust_covariance_is_that_of_many_fits(loss, bad):
    """With Gaussian noise, at the efficiency that its reach was made for; and with one outlier in
    ten, ten times as large."""
    rng = np.random.default_rng(0)
    J = rng.standard_normal((300, 4))
    ends, said, plain = [], [], []
    for _ in range(300):
        y = rng.standard_normal(300) * np.where(rng.random(300) < bad, 10.0, 1.0)
        start = np.linalg.lstsq(J, y, rcond=None)[0]
        fit = optimize.least_squares(
            lambda x, y=y: J @ x - y, start if bad == 0 else 0 * start, jac=lambda x: J,
            loss=robust_loss_except_priors(loss, 0), f_scale=REACH[loss],
        )  # fmt: skip
        ends.append(fit.x)
        plain.append(start)
        said.append(np.diag(covariance(J, fit.fun, loss)))
    ends, said, plain = np.array(ends), np.array(said), np.array(plain)
    assert np.mean(ends**2) == pytest.approx(
        np.mean(said), rel=0.1
    )  # 1200 squares: a standard deviation is 4 %
    inside = np.mean(np.abs(ends) < stats.norm.ppf(0.975) * np.sqrt(said))
    assert 0.93 < inside < 0.97
    if bad:
        assert np.mean(ends**2) < 0.3 * np.mean(plain**2)
    else:
        assert np.mean(plain**2) / np.mean(ends**2) == pytest.approx(EFFICIENCY, abs=0.03)


def test_robust_covariance_of_what_nothing_holds_is_refused():
    r = np.full(40, 50.0)
    with pytest.raises(ValueError, match="holds on to nothing"):
        covariance(np.ones((40, 1)), r, "cauchy")
    J = np.array([[1.0]] * 40 + [[10.0]])
    assert covariance(J, np.zeros(41), "linear", 1)[0, 0] == pytest.approx(1 / 140)
