"""Identification under coloured noise and under outliers: what is found, what intervals allow for,
and what is said."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import COARSE, PAPER, excited, rolled
from test_sysid_noise import made

from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import IdentificationResult, Problem, Recording, Sensor, Stage, Unknown, identify, record
from torchsoft.sysid.colour import rewhitened
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.residual_tests import parts
from torchsoft.sysid.runs import Runner

BASE = PAPER.override(COARSE)
E, TAU = "materials.rubber.E", "materials.rubber.tau"
TRUTH = {E: 0.8e6, TAU: 0.011}
NOISE = {"x_C": 1e-5, "theta_C": 5e-4, "effort_x": 0.1}
ROLL = Excitation(rolled(8e-3, 0.55, since=0.25), duration=0.6, grasp=0.2)
AR = Autoregression.stated((0.8,), 5e-3)
STAGE = Stage("all", ("strokes",), (E, TAU), 1e-4)


def sensors(colour: str = "white") -> dict[str, Sensor]:
    return {channel: Sensor(noise=noise, colour=colour) for channel, noise in NOISE.items()}


@pytest.fixture(scope="module")
def exact():
    return record(
        "strokes", excited(ROLL, BASE, senses="bracket"), TRUTH, sensors(), rtol=1e-6, noise=0.0
    )


def noisy(
    exact: Recording, seed: int, noise: Autoregression | None, outliers: float = 0.0
) -> Recording:
    """With noise as stated, of a colour, or with so many samples that are ten times off."""
    rng, samples = np.random.default_rng(seed), {}
    for channel, (t, y) in exact.samples.items():
        e = rng.standard_normal(len(t)) if noise is None else made(noise, len(t), rng)
        e = e + 20 * rng.standard_normal(len(t)) * (rng.random(len(t)) < outliers)
        samples[channel] = (t, y + NOISE[channel] * e)
    return replace(exact, samples=samples)


def problem(recording: Recording, colour: str = "white") -> Problem:
    return Problem(
        [recording],
        sensors(colour),
        {name: Unknown(nominal=1.01 * value) for name, value in TRUTH.items()},
    )


@pytest.mark.slow
def test_colour_of_coarse_steps_is_gone_with_them(exact):
    """White samples: what a first tolerance leaves is coloured, what the last leaves is not."""
    rng, quiet = np.random.default_rng(0), {name: 0.1 * noise for name, noise in NOISE.items()}
    samples = {
        name: (t, y + quiet[name] * rng.standard_normal(len(t)))
        for name, (t, y) in exact.samples.items()
    }
    fine = Problem(
        [replace(exact, samples=samples)],
        {name: Sensor(noise=noise) for name, noise in quiet.items()},
        {name: Unknown(nominal=1.01 * value) for name, value in TRUTH.items()},
    )
    plan = [replace(STAGE, rtol=1e-2)]
    assert identify(fine, plan=plan, assumptions="trusted", tightenings=0).noise
    answer = identify(fine, plan=plan, assumptions="trusted")
    assert answer.made_by["rtol"] < 1e-2
    assert not answer.noise
    assert not answer.notices
    assert answer.converged


@pytest.mark.parametrize("colour", ["white", "ar"])
def test_intervals_hold_under_coloured_noise_which_is_named_unless_it_was_declared(exact, colour):
    own = problem(noisy(exact, 0, AR), colour)
    answer = identify(own, plan=[STAGE], assumptions="trusted", tightenings=0)
    white = np.linalg.inv(fisher(own, answer))
    assert {one.channel for one in answer.noise} == set(NOISE)
    for one in answer.noise:
        assert one.model.order in (1, 2)
        assert one.tried[0].order == 0
        assert min(one.tried, key=lambda score: score.bic).order == one.model.order
    said = [notice for notice in answer.notices if "coloured in x_C (order" in notice]
    assert len(said) == (colour == "white")
    for name, truth in TRUTH.items():
        assert abs(np.log(answer[name].last / truth)) < 3 * answer[name].relative_sd, name
    assert answer[TAU].relative_sd > 1.3 * white[1, 1] ** 0.5


def fisher(own: Problem, answer: IdentificationResult) -> np.ndarray:
    """Fisher's matrix at an answer as if the noise were white."""
    x, free, runner = np.array(answer.x), own.coordinates.free, Runner(own.recordings)
    J = own.residuals(runner, x, own.names, 1e-4, free).J
    return J.T @ J


def test_residuals_and_the_adjoint_agree_on_coloured_noise(exact):
    """Rows whitened at once, and again from other noise; the gradient of half their squares."""
    gaps = {
        c: (np.delete(t, slice(20, 30)), np.delete(y, slice(20, 30)))
        for c, (t, y) in exact.samples.items()
    }
    plain = problem(replace(exact, samples=gaps))
    coloured = plain.with_noise({"x_C": AR, "effort_x": Autoregression((1.2, -0.5), 0.7, 5e-3)})
    runner, which, x = Runner(plain.recordings), ["strokes"], plain.coordinates.start
    free = plain.coordinates.free
    steps = plain.residuals(runner, x, which, 1e-4).steps
    one = plain.residuals(runner, x, which, steps, free)
    other = coloured.residuals(runner, x, which, steps, free)
    again = rewhitened(coloured, one, parts(plain, one.r, which))
    back = rewhitened(plain, other, parts(coloured, other.r, which))
    for a, b in ((again.r, other.r), (again.J, other.J), (back.r, one.r), (back.J, one.J)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
    loss, gradient, failed = coloured.misfit(runner, x, which, steps, free)
    assert not failed
    assert loss == pytest.approx(0.5 * other.r @ other.r, rel=1e-12)
    np.testing.assert_allclose(gradient, other.J.T @ other.r, rtol=1e-8)


@pytest.mark.slow
def test_a_robust_loss_sees_through_outliers(exact):
    """Every twentieth sample is off by twenty standard deviations: least squares says so, and a
    robust loss is as exact as the rest of the samples allow."""
    bad = problem(noisy(exact, 2, None, outliers=0.05))
    exactly = replace(STAGE, rtol=1e-5)  # by 1e-4 a derivative by tau is off by some percent
    clean, plain, robust = (
        identify(one, plan=[exactly], loss=loss, assumptions="trusted")
        for one, loss in (
            (problem(noisy(exact, 2, None)), "linear"),
            (bad, "linear"),
            (bad, "cauchy"),
        )
    )
    assert any("outliers" in notice for notice in plain.notices)
    assert any(
        "larger than the noise" in notice and "intervals are widened by" in notice
        for notice in plain.notices
    )
    assert not robust.notices
    for name, truth in TRUTH.items():
        assert abs(np.log(robust[name].last / truth)) < 3 * robust[name].relative_sd, name
        # nine tenths as efficient, by an estimate from the residuals themselves, which scatters by
        # some percent
        assert 0.9 < robust[name].relative_sd / clean[name].relative_sd < 1.25
        assert plain[name].relative_sd > 2 * robust[name].relative_sd
