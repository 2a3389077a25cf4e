"""What a fit leaves: no false alarms where model and noise are right, and for each fault the
sentence that names it."""

import re
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import signal, stats
from test_sysid_noise import made

from torchsoft.sysid.colour import colour_notices, colours, correlation
from torchsoft.sysid.fit import Colour
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.residual_tests import (
    LEVEL,
    Part,
    Verdict,
    autocorrelation,
    holm,
    judge_residuals,
    residual_notices,
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

    def judged(self, robust: bool = False) -> list[Verdict]:
        parts, r, J = self.fitted()
        return judge_residuals(parts, r, J, robust=robust)

    def fitted(self) -> tuple[list[Part], np.ndarray, np.ndarray]:
        rng, at = np.random.default_rng(self.seed), 0
        filtered = signal.butter(2, 0.1)
        columns, rows, known = [], [], []
        for k, m in enumerate(self.lengths):
            for channel in CHANNELS:
                reading = signal.lfilter(*filtered, rng.standard_normal(m + 200))[200:]
                e = rng.standard_normal(m) if self.noise is None else made(self.noise, m, rng)
                columns.append(
                    signal.lfilter(*filtered, rng.standard_normal((m + 200, 4)), axis=0)[200:]
                )
                rows.append(self.scale * e + self.fault.get((f"run {k}", channel), 0.0))
                known.append(
                    (f"run {k}", channel, np.arange(m) * H, np.arange(at, at + m), reading)
                )
                at += m
        W = [None if self.assumed is None else self.assumed.whitener(t) for _, _, t, _, _ in known]
        J = np.concatenate([j if w is None else w @ j for w, j in zip(W, columns)])
        y = np.concatenate([x if w is None else w @ x for w, x in zip(W, rows)])
        x = np.linalg.lstsq(J, y, rcond=None)[0]
        parts = [
            Part(
                *one[:4],
                raw=raw - j @ x,
                reading=one[4],
                noise=self.assumed,
                whitened=(lambda rows: rows) if w is None else w.__matmul__,
            )
            for one, raw, j, w in zip(known, rows, columns, W)
        ]
        return parts, y - J @ x, J


def alarms(verdicts: list[Verdict], test: str) -> list[Verdict]:
    return [f for f in verdicts if f.alarming and f.test == test]


def reading(case: Case, where: tuple[str, str]) -> np.ndarray:
    """The undisturbed reading of a case."""
    return next(p.reading for p in case.fitted()[0] if (p.recording, p.channel) == where)


def test_a_right_model_raises_no_alarm_more_often_than_it_says():
    """p-values are uniform, by test; of 120 cases about one raises an alarm."""
    found = [Case(seed, lengths=(120, 150)).judged() for seed in range(120)]
    assert sum(any(f.alarming for f in one) for one in found) <= 4
    for test in ("level", "white", "motion", "channels", "outliers"):
        p = np.array([f.p for one in found for f in one if f.test == test])
        assert np.mean(p < 0.05) < 0.065, test
        assert np.mean(p < 0.001) < 0.0065, test
        if test in ("motion", "channels", "white"):
            assert stats.kstest(p, "uniform").pvalue > 1e-3, test


def test_a_right_colour_raises_none_either():
    noise = Autoregression.stated((0.9,), H)
    found = [Case(seed, noise=noise, assumed=noise).judged() for seed in range(30)]
    assert sum(any(f.alarming for f in one) for one in found) <= 2
    p = np.array([f.p for one in found for f in one if f.test == "level"])
    assert 0.01 < np.mean(p < 0.05) < 0.1


def test_the_level_is_judged_by_how_many_samples_there_are():
    """1.12 in 7600 samples is seven standard deviations, and in 76 nothing."""
    many = Case(0, lengths=(1267, 1267), scale=1.12**0.5).judged()
    (overall,) = [f for f in alarms(many, "level") if f.recording is None]
    assert overall.p < 1e-9
    assert overall.size == pytest.approx(1.058, abs=0.02)
    assert residual_notices(many)["larger"].startswith(
        "residuals are larger than the noise that was stated"
    )
    assert "all of them together 1.0" in residual_notices(many)["larger"]
    few = Case(0, lengths=(13, 13), scale=1.12**0.5).judged()
    assert not alarms(few, "level")


def test_one_channel_that_is_too_loud_is_named_and_one_too_quiet_as_well():
    rng = np.random.default_rng(5)
    loud = Case(1, fault={("run 1", "theta_C"): 0.9 * rng.standard_normal(400)}).judged()
    named = [f for f in alarms(loud, "level") if f.recording]
    assert [(f.recording, f.channel) for f in named] == [("run 1", "theta_C")]
    assert "theta_C of `run 1` 1.27 times" in residual_notices(loud)["larger"]
    quiet = residual_notices(Case(1, scale=0.4).judged())
    assert len(quiet) == 1  # its pattern is not judged
    assert quiet["smaller"].startswith("residuals are smaller than the noise that was stated")
    assert "and 4 more" in quiet["smaller"]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("offset", "most like an offset"),
        ("drift", "most like a drift"),
        ("gain", "most like the reading itself, as an error of its gain"),
        ("delay", "most like its rate, as a delay"),
        ("other", "most like the rate of theta_C"),
        ("inertia", "most like the acceleration of theta_C"),
    ],
)
def test_what_follows_the_motion_is_named(kind, words):
    """Each fault is of half a standard deviation, and shows in no other recording."""
    case, where, t = Case(2), ("run 1", "effort_x"), np.arange(400) * H
    own, other = reading(case, where), reading(case, ("run 1", "theta_C"))
    fault = {
        "offset": np.ones(400), "drift": t - t.mean(), "gain": own, "delay": np.gradient(own, H),
        "other": np.gradient(other, H), "inertia": np.gradient(np.gradient(other, H), H),
    }[kind]  # fmt: skip
    found = Case(
        2, fault={where: 0.5 * fault / fault.std() if kind != "offset" else 0.5 * fault}
    ).judged()
    named = alarms(found, "motion")
    assert {(f.recording, f.channel) for f in named} == {where}
    assert any(words in f.words for f in named), [f.words for f in named]
    assert any(words in notice for notice in residual_notices(found).values())


def test_colour_is_noticed_found_allowed_for_and_named():
    noise = Autoregression.stated((0.6,), H)
    case = Case(3, noise=noise)
    assert alarms(case.judged(), "white")
    parts, _, J = case.fitted()
    found = colours(parts, J)
    assert set(found) == set(CHANNELS)
    assert all(
        fit.noise.sd >= 1 - 1e-12 and 0.5 < correlation(fit.noise) < 0.7 for fit in found.values()
    )
    (sentence,) = colour_notices(found, Colour())
    assert (
        f"x_C (order 1, neighbouring samples correlate by {correlation(found['x_C'].noise):.2f})"
        in sentence
    )
    assert not colour_notices({}, Colour())
    assert not residual_notices(Case(3, noise=noise, assumed=found["theta_C"].noise).judged())


def test_white_noise_is_hardly_ever_called_coloured():
    """Where nobody declared it; with declared colour the order is the criterion's, usually none."""
    found = []
    for seed in range(15):
        parts, _, J = Case(seed, lengths=(150, 200)).fitted()
        found.append((len(colours(parts, J)), len(colours(parts, J, CHANNELS))))
    unasked, declared = np.array(found).sum(0)
    assert unasked == 0
    assert declared <= 4
    faint, _, J = Case(3, noise=Autoregression.stated((0.6,), H), scale=0.1).fitted()
    assert not colours(faint, J)


def test_channels_that_err_together_are_named():
    common = np.random.default_rng(9).standard_normal(300)
    fault = {("run 0", "x_C"): 0.6 * common, ("run 0", "effort_x"): -0.6 * common}
    (found,) = alarms(Case(4, fault=fault).judged(), "channels")
    assert "x_C and effort_x of `run 0` (correlation -0." in found.words


def test_an_outlier_is_named_with_its_time_and_expected_of_a_robust_loss():
    spike = np.zeros(300)
    spike[100] = 9.0
    case = Case(4, fault={("run 0", "theta_C"): spike})
    (found,) = alarms(case.judged(), "outliers")
    assert "theta_C of `run 0` (the largest" in found.words
    assert f"t = {100 * H:g} s" in found.words
    many = Case(4, fault={("run 0", "theta_C"): np.where(np.arange(300) % 12, 0.0, 8.0)})
    assert alarms(many.judged(), "level")
    assert not alarms(many.judged(robust=True), "outliers")
    assert not alarms(many.judged(robust=True), "level")  # the median is what was stated
    loud = Case(4, scale=1.4)
    assert alarms(loud.judged(robust=True), "level")


def test_a_misfit_that_begins_at_a_certain_time_is_named_with_that_time():
    """In place of outliers. One that is there from the first sample on, or a few outliers at the
    end, does not begin."""
    wave, late = 6.0 * np.sin(40 * np.arange(300) * H), np.arange(300) >= 240
    for robust in (False, True):
        fault = {("run 0", "theta_C"): wave * late}
        verdicts = Case(4, fault=fault).judged(robust=robust)
        (found,) = alarms(verdicts, "onset")
        time = float(re.search(r"t = (\S+) s", found.words)[1])  # pyright: ignore[reportOptionalSubscript]
        assert time == pytest.approx(240 * H, abs=2 * H)
        assert found.size == pytest.approx((1 + 18) ** 0.5, rel=0.15)
        assert not alarms(verdicts, "outliers")
        assert residual_notices(verdicts)["onset"].startswith(
            "the misfit begins in `run 0` at t = "
        )
    for other in (wave, 30.0 * (np.arange(300) >= 295)):
        assert not alarms(Case(4, fault={("run 0", "theta_C"): other}).judged(), "onset")


def test_saturated_samples_and_ends_that_cannot_be_tested():
    parts, r, J = Case(0).fitted()
    quiet = np.where(np.arange(len(r)) % 3 == 0, 0.0, r)  # a third is far beyond the range
    cut = lambda p, rows: {name: getattr(p, name)[rows] for name in ("t", "rows", "raw", "reading")}
    some = [p._replace(**cut(p, p.rows % 3 != 0), saturated=100) for p in parts]
    judged = judge_residuals(some, quiet, np.where((quiet == 0)[:, None], 0.0, J))
    assert not any(f.alarming for f in judged)
    assert not colours(some, J)
    short = [
        p._replace(**cut(p, slice(3)) | {"rows": np.arange(3 * i, 3 * i + 3)})
        for i, p in enumerate(parts)
    ]
    assert not any(f.alarming for f in judge_residuals(short, r[:18], np.zeros((18, 4))))


def test_a_prior_that_the_data_contradict_is_named():
    """The first unknown is known beforehand to 0.05, and to be zero, or to be 0.4."""
    for far in (0.0, 0.4):
        (parts, r, J), row = Case(6).fitted(), np.eye(4)[:1] / 0.05
        both, at = np.concatenate((J, row)), np.append(r, -far / 0.05)
        x = np.linalg.lstsq(both, -at, rcond=None)[0]
        verdicts = judge_residuals(parts, at + both @ x, both, priors=["materials.rubber.E"])
        z = abs(far - 0.0) / np.hypot(
            0.05, np.linalg.inv(J.T @ J)[0, 0] ** 0.5
        )  # the fit without it is at zero
        (one,) = [v for v in verdicts if v.test == "priors"]
        assert one.size == pytest.approx(z, rel=1e-6, abs=1e-9)
        assert one.alarming == (far > 0)
        assert any(
            "contradict what was known before, materials.rubber.E by" in notice
            for notice in residual_notices(verdicts).values()
        ) == (far > 0)
    unseen = judge_residuals(
        parts,
        np.append(r, 0.0),
        np.concatenate((np.delete(J, 0, 1) @ np.eye(4)[1:], np.eye(4)[:1])),
        priors=["materials.rubber.E"],
    )
    assert not alarms(unseen, "priors")


def test_holm_by_hand():
    p = (0.01, 0.04, 0.03, 0.005)
    adjusted = [f.adjusted for f in holm([Verdict("level", None, None, one, 1.0, "") for one in p])]
    np.testing.assert_allclose(adjusted, [0.03, 0.06, 0.06, 0.02])
    assert LEVEL == 0.01


def test_whiteness_counts_fitted_coefficients():
    noise = np.random.default_rng(0).standard_normal(500)
    rho, p = whiteness(noise)
    assert rho == autocorrelation(noise)[0]
    assert whiteness(noise, 5)[1] < p
    assert whiteness(noise[:3], 5) == (0.0, 1.0)
    assert whiteness(np.cumsum(noise))[1] < 1e-6
