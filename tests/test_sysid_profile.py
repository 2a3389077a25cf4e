"""Profiles against closed forms, and combinations of parameters."""

import numpy as np
import pytest
from closed_forms import WALL, ClosedForm, optimum

from torchsoft.sysid.fit import Combination, combinations
from torchsoft.sysid.profile import profiles

STRAIGHT = np.random.default_rng(0).standard_normal((20, 3))
Z95 = 1.959964
"""Of the normal distribution, the half width of the 95 % interval."""


@pytest.mark.parametrize("variance", [1.0, 4.0])
def test_of_a_linear_problem_the_profile_is_the_parabola_of_the_covariance(variance):
    """Wider where the residuals exceed the noise."""
    o = optimum(ClosedForm(lambda x: STRAIGHT @ x, 3), 0, 0, 0, variance=variance)
    sd = np.sqrt(variance * np.diag(np.linalg.inv(STRAIGHT.T @ STRAIGHT)))
    for i, one in enumerate(profiles(o)):
        np.testing.assert_allclose(one.rises, (np.log(one.values) / sd[i]) ** 2, atol=1e-6)
        np.testing.assert_allclose(np.log(one.ci95), [-Z95 * sd[i], Z95 * sd[i]], rtol=1e-5)
        np.testing.assert_allclose(one.wald95, one.ci95, rtol=1e-6)
        assert one.values == sorted(one.values)
        assert not one.findings


def test_a_curved_profile_has_the_exact_ends():
    """(e^x - 1) / 0.3 is one residual, and p1 follows x^2: the others bend, the profile of p0 is
    known."""
    bent = ClosedForm(lambda x: [(np.exp(x[0]) - 1) / 0.3, 5 * (x[1] - x[0] ** 2)], 2)
    one, _ = profiles(optimum(bent, 0, 0, workers=2))
    assert one.ci95 == pytest.approx((1 - 0.3 * Z95, 1 + 0.3 * Z95), rel=2e-3)
    np.testing.assert_allclose(one.others["p1"], np.exp(np.log(one.values) ** 2), rtol=2e-2)
    np.testing.assert_allclose(one.rises, ((np.array(one.values) - 1) / 0.3) ** 2, atol=1e-2)


@pytest.mark.parametrize(
    ("problem", "low", "why"),
    [
        (ClosedForm(lambda x: [1.5 * np.tanh(x[0])], 1), None, "within 100: p0 may not be larger"),
        (ClosedForm(lambda x: [x[0]], 1, fails=lambda x: bool(x[0] > 1.2)), np.exp(-Z95), WALL),
    ],
)
def test_an_end_that_does_not_exist_is_open_with_its_reason(problem, low, why):
    (one,) = profiles(optimum(problem, 0))
    assert one.ci95[1] is None
    assert one.ci95[0] == (low and pytest.approx(low, rel=1e-6))
    assert any("no upper bound" in str(finding) and why in str(finding) for finding in one.findings)


def test_a_fit_that_was_not_at_its_optimum_is_found_out():
    (one,) = profiles(optimum(ClosedForm(lambda x: [x[0] - 0.5], 1), 0))
    assert any("fit did not end at the optimum" in str(finding) for finding in one.findings)
    assert one.ci95[1] is None


def test_a_profile_of_what_is_not_free_is_rejected():
    o = optimum(ClosedForm(lambda x: STRAIGHT @ x, 3), 0, 0, 0, free=("p0", "p1"))
    with pytest.raises(ValueError, match="no free coordinate 'p2' to profile; there are p0, p1"):
        profiles(o, ["p2"])


def seen(*rows: list[float]) -> list[Combination]:
    """Combinations in the covariance of three parameters of which only some directions are seen,
    each to 1 %."""
    J = np.array([*[[100 * v for v in row] for row in rows], *np.eye(3).tolist()])
    return combinations(["E", "K", "R"], np.linalg.inv(J.T @ J), 0.3)


def test_a_combination_names_what_is_seen_in_place_of_its_parameters():
    (ratio,) = seen([0, 1, -1], [1, 0, 0])
    assert ratio.exponents == {"K": 1.0, "R": -1.0}
    assert ratio.sd == pytest.approx(0.01, rel=1e-2)
    assert ratio.sentence == "only K / R is determined (1 %), not each (K 71 %, R 71 %)"
    (product,) = seen([1, 0.42, 0], [0, 0, 1])
    assert product.formula == "E * K^0.4"
    assert seen(*np.eye(3).tolist()) == []  # all of them are seen
    assert seen([1, 0, 0]) == []  # K and R are not seen at all
    J = np.array([[100, 2.4], [0, 0.05]])  # no coarse exponent of what is hardly known is as good
    (fine,) = combinations(["E", "K"], np.linalg.inv(J.T @ J), 0.3)
    assert fine.formula == "E * K^0.024"
