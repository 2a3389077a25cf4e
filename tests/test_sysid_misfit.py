"""What a fit leaves: no false alarms where model and noise are right, and for each fault the
sentence that names it."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import signal, stats
from test_sysid_noise import made

from torchsoft.sysid.colour import colour_findings, colours, correlation
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.residual_tests import (
    LEVEL,
    Part,
    ResidualTest,
    autocorrelation,
    holm,
    judge_residuals,
    residual_findings,
    whiteness,
)

H = 5e-3
CHANNELS = ("x_C", "theta_C", "effort_x")


@dataclass
class Case:
    """A linear fit of four unknowns to recordings of three channels, with noise and with what is
    done to it."""

    seed: int
    lengths: tuple[int, ...] = (300, 400)
    noise: Autoregression | None = None
    assumed: Autoregression | None = None
    fault: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    scale: float = 1.0

    def judged(self, robust: bool = False) -> list[ResidualTest]:
        parts, r, J = self.fitted()
        return judge_residuals(parts, r, J, robust=robust)

    def fitted(self) -> tuple[list[Part], np.ndarray, np.ndarray]:
        rng, found, J, y = np.random.default_rng(self.seed), [], [], []

        def slow(*shape):
            return signal.lfilter(*signal.butter(2, 0.1), rng.standard_normal(shape), axis=0)[200:]

        for k, m in enumerate(self.lengths):
            for channel in CHANNELS:
                t, reading = np.arange(m) * H, slow(m + 200)
                e = rng.standard_normal(m) if self.noise is None else made(self.noise, m, rng)
                raw = self.scale * e + self.fault.get((f"run {k}", channel), 0.0)
                j, rows = slow(m + 200, 4), np.arange(m) + sum(map(len, y))
                W = np.eye(m) if self.assumed is None else self.assumed.whitener(t)
                J.append(W @ j)
                y.append(W @ raw)
                found.append((Part(f"run {k}", channel, t, rows, raw, reading, self.assumed), j))
        J, y = np.concatenate(J), np.concatenate(y)
        x = np.linalg.lstsq(J, y, rcond=None)[0]
        return [part._replace(raw=part.raw - j @ x) for part, j in found], y - J @ x, J


def alarms(verdicts: list[ResidualTest], test: str) -> list[ResidualTest]:
    return [f for f in verdicts if f.alarming and f.test == test]


def said(tests: list[ResidualTest]) -> dict[str, str]:
    """Findings in words, by code."""
    return {one.code: str(one) for one in residual_findings(tests)}


def reading(case: Case, where: tuple[str, str]) -> np.ndarray:
    """The undisturbed reading of a case."""
    return next(p.reading for p in case.fitted()[0] if (p.recording, p.channel) == where)


def test_a_right_model_raises_no_alarm_more_often_than_it_says():
    """p-values are uniform, by test; of 80 cases about one raises an alarm."""
    found = [Case(seed, lengths=(120, 150)).judged() for seed in range(80)]
    assert sum(any(f.alarming for f in one) for one in found) <= 3
    for test in ("level", "white", "motion", "channels", "outliers"):
        p = np.array([f.p for one in found for f in one if f.test == test])
        assert np.mean(p < 0.05) < 0.07, test
        assert np.mean(p < 0.001) < 0.008, test
        if test in ("motion", "channels", "white"):
            assert stats.kstest(p, "uniform").pvalue > 1e-3, test


def test_a_right_colour_raises_none_either():
    noise = Autoregression.stated((0.9,), H)
    found = [Case(seed, noise=noise, assumed=noise).judged() for seed in range(20)]
    assert sum(any(f.alarming for f in one) for one in found) <= 2
    p = np.array([f.p for one in found for f in one if f.test == "level"])
    assert 0.01 < np.mean(p < 0.05) < 0.1


def test_the_level_is_judged_by_how_many_samples_there_are():
    """1.12 in 7600 samples is seven standard deviations, and in 76 nothing."""
    many, few = (Case(0, lengths=2 * (n,), scale=1.12**0.5).judged() for n in (1267, 13))
    (overall,) = [f for f in alarms(many, "level") if f.recording is None]
    assert overall.p < 1e-9
    assert overall.size == pytest.approx(1.058, abs=0.02)
    assert "Residuals are larger than the stated noise" in said(many)["larger"]
    assert not alarms(few, "level")


def test_one_channel_that_is_too_loud_is_named_and_one_too_quiet_as_well():
    rng, where = np.random.default_rng(5), ("run 1", "theta_C")
    loud = Case(1, fault={where: 0.9 * rng.standard_normal(400)}).judged()
    assert [(f.recording, f.channel) for f in alarms(loud, "level") if f.recording] == [where]
    assert "theta_C of `run 1` 1.27 times" in said(loud)["larger"]
    quiet = said(Case(1, scale=0.4).judged())
    assert [*quiet] == ["smaller"]  # its pattern is not judged


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("offset", "an offset"),
        ("drift", "a drift"),
        ("gain", "the reading itself, as an error of its gain"),
        ("delay", "its rate, as a delay"),
        ("other", "the rate of theta_C"),
        ("inertia", "the acceleration of theta_C"),
    ],
)
def test_what_follows_the_motion_is_named(kind, words):
    """Each fault is of half a standard deviation, and shows in no other recording."""
    where, t = ("run 1", "effort_x"), np.arange(400) * H
    own, other = (reading(Case(2), ("run 1", channel)) for channel in ("effort_x", "theta_C"))
    fault = {
        "offset": np.ones(400), "drift": t - t.mean(), "gain": own, "delay": np.gradient(own, H),
        "other": np.gradient(other, H), "inertia": np.gradient(np.gradient(other, H), H),
    }[kind]  # fmt: skip
    found = Case(2, fault={where: 0.5 * fault / (fault.std() or 1.0)}).judged()
    named = alarms(found, "motion")
    assert {(f.recording, f.channel) for f in named} == {where}
    assert any(f"most like {words}" in notice for notice in said(found).values())


def test_colour_is_noticed_found_allowed_for_and_named():
    noise = Autoregression.stated((0.6,), H)
    case = Case(3, noise=noise)
    assert alarms(case.judged(), "white")
    parts, _, J = case.fitted()
    found = colours(parts, J)
    assert {*found} == {*CHANNELS}
    for fit in found.values():
        assert fit.noise.sd >= 1 - 1e-12
        assert 0.5 < correlation(fit.noise) < 0.7
    (sentence,) = map(str, colour_findings(found))
    words = f"order 1, neighbouring samples correlate by {correlation(found['x_C'].noise):.2f}"
    assert f"x_C ({words})" in sentence
    assert not colour_findings({})
    assert not residual_findings(Case(3, noise=noise, assumed=found["theta_C"].noise).judged())


def test_white_noise_is_hardly_ever_called_coloured():
    """Where nobody declared it; with declared colour the order is the criterion's, usually none."""
    found = []
    for seed in range(8):
        parts, _, J = Case(seed, lengths=(150, 200)).fitted()
        found.append((len(colours(parts, J)), len(colours(parts, J, CHANNELS))))
    unasked, declared = np.array(found).sum(0)
    assert unasked == 0
    assert declared <= 3
    faint, _, J = Case(3, noise=Autoregression.stated((0.6,), H), scale=0.1).fitted()
    assert not colours(faint, J)


def test_channels_that_err_together_are_named():
    common = np.random.default_rng(9).standard_normal(300)
    fault = {("run 0", "x_C"): 0.6 * common, ("run 0", "effort_x"): -0.6 * common}
    (found,) = alarms(Case(4, fault=fault).judged(), "channels")
    assert found.facts["channels"] == "x_C and effort_x"
    assert found.size < -0.3


def test_an_outlier_is_named_with_its_time_and_expected_of_a_robust_loss():
    spike, many = np.where(np.arange(300) == 100, 9.0, 0.0), 8.0 * (np.arange(300) % 12 == 0)
    (found,) = alarms(Case(4, fault={("run 0", "theta_C"): spike}).judged(), "outliers")
    assert (found.recording, found.channel) == ("run 0", "theta_C")
    assert found.facts["time"] == pytest.approx(100 * H)
    case = Case(4, fault={("run 0", "theta_C"): many})
    assert alarms(case.judged(), "level")
    robust = case.judged(robust=True)
    assert not alarms(robust, "outliers")
    assert not alarms(robust, "level")  # the median is what was stated
    assert alarms(Case(4, scale=1.4).judged(robust=True), "level")


@pytest.mark.parametrize("robust", [False, True])
def test_a_misfit_that_begins_at_a_certain_time_is_named_with_that_time(robust):
    """In place of outliers. One that is there from the first sample on, or a few outliers at the
    end, does not begin."""
    wave, k = 6.0 * np.sin(40 * np.arange(300) * H), np.arange(300)
    judged = lambda fault: Case(4, fault={("run 0", "theta_C"): fault}).judged(robust=robust)
    verdicts = judged(wave * (k >= 240))
    (found,) = alarms(verdicts, "onset")
    assert found.facts["time"] == pytest.approx(240 * H, abs=2 * H)
    assert found.size == pytest.approx((1 + 18) ** 0.5, rel=0.15)
    assert not alarms(verdicts, "outliers")
    assert "The misfit starts in `run 0` at t = " in said(verdicts)["onset"]
    for other in (wave, 30.0 * (k >= 295)):
        assert not alarms(judged(other), "onset")


def test_saturated_samples_do_not_count():
    parts, r, J = Case(0).fitted()
    quiet = np.where(np.arange(len(r)) % 3 == 0, 0.0, r)  # a third is far beyond the range
    cut = lambda p: {k: getattr(p, k)[p.rows % 3 != 0] for k in ("t", "rows", "raw", "reading")}
    some = [p._replace(**cut(p), saturated=100) for p in parts]
    verdicts = judge_residuals(some, quiet, np.where((quiet == 0)[:, None], 0.0, J))
    assert not any(f.alarming for f in verdicts)
    assert not colours(some, J)


@pytest.mark.parametrize("far", [0.0, 0.4])
def test_a_prior_that_the_data_contradict_is_named(far):
    """The first unknown is known beforehand to 0.05, and to be zero, or to be 0.4."""
    (parts, r, J), row = Case(6).fitted(), np.eye(4)[:1] / 0.05
    both, at = np.concatenate((J, row)), np.append(r, -far / 0.05)
    x = np.linalg.lstsq(both, -at, rcond=None)[0]
    verdicts = judge_residuals(parts, at + both @ x, both, priors=["E"])
    z = far / np.hypot(0.05, np.linalg.inv(J.T @ J)[0, 0] ** 0.5)  # the fit without it is at zero
    (one,) = [v for v in verdicts if v.test == "priors"]
    assert one.size == pytest.approx(z, rel=1e-6, abs=1e-9)
    assert (
        one.alarming
        == ("contradict the prior of E by" in said(verdicts).get("priors", ""))
        == (far > 0)
    )
    unseen = np.concatenate((J * [0, 1, 1, 1], np.eye(4)[:1]))  # by the data
    assert not alarms(judge_residuals(parts, np.append(r, 0.0), unseen, priors=["E"]), "priors")


def test_holm_by_hand():
    p = (0.01, 0.04, 0.03, 0.005)
    adjusted = [
        f.adjusted for f in holm([ResidualTest("level", None, None, one, 1.0) for one in p])
    ]
    np.testing.assert_allclose(adjusted, [0.03, 0.06, 0.06, 0.02])
    assert LEVEL == 0.01


def test_whiteness_counts_fitted_coefficients():
    noise = np.random.default_rng(0).standard_normal(500)
    rho, p = whiteness(noise)
    assert rho == autocorrelation(noise)[0]
    assert whiteness(noise, 5)[1] < p
    assert whiteness(noise[:3], 5) == (0.0, 1.0)
    assert whiteness(np.cumsum(noise))[1] < 1e-6
