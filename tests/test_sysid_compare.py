"""Which law: the rule, how often it is right where the answer is known, and densities in closed
form."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from test_sysid_assumptions import thrown

from torchsoft.sysid import Problem, Sensor, Stage, Unknown
from torchsoft.sysid.compare import Density, LawFit, compare, density, judged, versus
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.residual_tests import Part

T = np.arange(300) * 5e-3


def law(name: str, r: np.ndarray, k: int = 3, held: np.ndarray | None = None) -> Any:
    """A law that left these residuals, as far as the rule looks at it."""

    def said(residuals, recording):
        part = Part(recording, "effort_x", T, slice(0, len(residuals)), residuals, residuals)
        return Density([part], residuals, residuals, -0.5 * float(residuals @ residuals))

    heldout = None if held is None else said(held, "other")
    return SimpleNamespace(
        name=name, fitted=said(r, "one"), heldout=heldout, parameters=k, numerical=0.0
    )


def apart(D: float) -> np.ndarray:
    """A difference of two predictions, of norm D, as of one slip."""
    shape = np.exp(-0.5 * ((T - 0.7) / 0.05) ** 2)
    return D * shape / np.linalg.norm(shape)


def named(D: float, noise: np.ndarray) -> str:
    """Which of two laws that differ by D is named, where the first one made the data."""
    right, wrong = law("right", noise), law("wrong", noise + apart(D))
    best, other = sorted((right, wrong), key=lambda one: -one.fitted.log)
    return "cannot tell" if versus(best, other).doubts else best.name


def shares(D: float, draws: list[np.ndarray]) -> dict[str, float]:
    said = [named(D, noise) for noise in draws]
    return {one: said.count(one) / len(said) for one in ("right", "wrong", "cannot tell")}


@pytest.mark.parametrize(
    ("D", "least", "most"), [(0.5, 0.0, 0.0), (5.0, 0.45, 0.9), (9.0, 0.97, 1)]
)
def test_a_wrong_law_is_never_named_and_the_right_one_where_predictions_differ(D, least, most):
    """As a normal distribution has it: z is (D / 2, 1) where the first law made the data."""
    rng = np.random.default_rng(0)
    found = shares(D, list(rng.standard_normal((30, len(T)))))
    assert found["wrong"] == 0.0
    assert least <= found["right"] <= most


def test_under_coloured_noise_that_is_called_white_a_wrong_law_is_not_named():
    """The likelihood ratio is then some standard deviations of the stated noise from zero by
    chance."""
    rng, lags = np.random.default_rng(1), np.abs(np.subtract.outer(*2 * [np.arange(len(T))]))
    colour = Autoregression.stated((0.95,), 5e-3).autocovariance(len(T))
    draws = np.linalg.cholesky(colour[lags]) @ rng.standard_normal((len(T), 30))
    assert shares(5.0, list(draws.T))["wrong"] == 0.0


def test_a_law_is_not_named_for_having_fewer_parameters_and_pays_for_more():
    r = np.random.default_rng(2).standard_normal(len(T))
    same = versus(law("a", r, k=1), law("b", r.copy(), k=9))
    assert same.evidence == same.z == 0.0
    assert "cannot tell them apart" in str(same.doubts[0])
    fewer, more = (versus(law("a", r, k=k), law("b", r + apart(6.0), k=3)) for k in (1, 6))
    assert fewer.evidence - more.evidence == pytest.approx(1.5 * np.log(len(T)))


def test_heldout_recordings_count_and_may_contradict():
    rng = np.random.default_rng(3)
    r, held = rng.standard_normal((2, len(T)))
    alone = versus(law("a", r), law("b", r + apart(3.0)))
    both = versus(law("a", r, held=held), law("b", r + apart(3.0), held=held + apart(8.0)))
    assert both.evidence - alone.evidence == pytest.approx(both.heldout, rel=0.2)
    assert alone.doubts
    assert not both.doubts
    torn = versus(law("a", r, held=held + apart(8.0)), law("b", r + apart(20.0), held=held))
    assert torn.z_heldout < -2
    assert "Held-out recordings speak for `b`" in str(torn.doubts[0])


def fitted(name: str, **more: Any) -> LawFit:
    numbers = dict.fromkeys(("log_likelihood", "bic", "numerical"), 0.0)
    usual = {"parameters": 2, "estimates": {}, "chi2": 1.0, "p": 0.5, "left": [],
             "heldout": None, "heldout_p": None, "converged": True, "patterned": False}  # fmt: skip
    return LawFit(name, **usual | numbers | more)


@pytest.mark.parametrize(
    ("a", "b", "rough", "outcome", "says"),
    [
        ({}, {"p": 0.0}, 0.0, "law", "`a`"),
        (
            {"p": 1e-6},
            {},
            0.0,
            "none fits",
            "It is nearer than `b`, but that does not make it right",
        ),
        ({"heldout_p": 1e-9}, {}, 0.0, "none fits", "misses the held-out recordings"),
        ({"patterned": True}, {}, 0.0, "none fits", "leaves residuals that follow the motion"),
        ({}, {"converged": False}, 0.0, "cannot tell", "The fit of `b` has not converged"),
        ({}, {}, 1.0, "cannot tell", "take a tighter tolerance"),
    ],
)
def test_the_conclusion_is_that_of_the_numbers(a, b, rough, outcome, says):
    """Two laws of which one leaves much more; `rough` is the part of the evidence that a tenth of
    the tolerance changes."""
    r = np.random.default_rng(4).standard_normal(len(T))
    clear = versus(law("a", r), law("b", r + apart(30.0)))
    clear = replace(clear, numerical=rough * clear.evidence)
    found, named, findings = judged([fitted("a", **a), fitted("b", **b)], [clear])
    assert (found, named) == (outcome, "a" if outcome == "law" else None)
    assert says in " ".join(map(str, findings))


def test_laws_that_were_not_given_the_same_data_are_refused():
    recording = replace(thrown(), name="one")
    sensors = dict.fromkeys(recording.samples, Sensor(noise=1e-5))
    one = Problem([recording], sensors, {"laws.dry.friction.mu_s": Unknown()})

    def other(sensors=sensors, **changes):
        return Problem([replace(recording, **changes)], sensors, {"materials.gel.E": Unknown()})

    noisier = {channel: (t, y + 1e-9) for channel, (t, y) in recording.samples.items()}
    elsewhere = {"a": [Stage("all", (), (), 1e-4)]}
    for others, how, message in (
        ({}, {}, "needs two laws or more, not 1"),
        ({"b": other(name="two")}, {}, "`a` and `b` have other recordings: one and two"),
        ({"b": other(samples=noisier)}, {}, "`one` of the laws `a` and `b` has other samples"),
        ({"b": other({"x_ellipse": Sensor(noise=1e-5)})}, {}, "have other sensors"),
        (
            {"b": other()},
            {"heldout": ["one"]},
            r"`heldout` must name some of \['one'\], but not all",
        ),
        ({"b": other()}, {"plans": elsewhere}, "the last stage of the plan of `a` must fit one"),
    ):
        with pytest.raises(ValueError, match=message):
            compare({"a": one, **others}, **how)


def test_densities_are_those_of_the_normal_distribution():
    """With coloured noise and uncertain estimates, as scipy has it."""
    rng, n = np.random.default_rng(6), 40
    t = np.arange(n) * 5e-3
    sigma, noise = 0.3, Autoregression.stated((0.6, 0.2), 5e-3)
    sensor = Sensor(noise=sigma)
    recording = SimpleNamespace(name="one", samples={"effort_x": (t, t)})
    problem = SimpleNamespace(
        measured=lambda which: [(recording, "effort_x", sensor)], sensors={"effort_x": sensor},
        noise={"effort_x": noise}, whitened=print,
    )  # fmt: skip
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    J = rng.standard_normal((n, 2))
    K = sigma**2 * noise.autocovariance(n)[lags]
    e, W = rng.standard_normal(n), noise.whitener(t)
    plain = density(problem, ["one"], W @ e / sigma)
    assert plain.log == pytest.approx(stats.multivariate_normal(cov=K).logpdf(e), rel=1e-12)
    wide = density(problem, ["one"], W @ e / sigma, W @ J / sigma)
    S = K + J @ J.T
    assert wide.log == pytest.approx(stats.multivariate_normal(cov=S).logpdf(e), rel=1e-12)
    assert wide.p == pytest.approx(stats.chi2.sf(e @ np.linalg.solve(S, e), n))
