"""Identification under coloured noise: what is found, and what intervals allow for."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import COARSE, PAPER, excited, rolled
from test_sysid_noise import made

from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import (
    IdentificationResult,
    Problem,
    Recording,
    Sensor,
    Stage,
    Unknown,
    identify,
    record,
)
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


def noisy(exact: Recording) -> Recording:
    """With noise of a colour."""
    rng, samples = np.random.default_rng(0), {}
    for channel, (t, y) in exact.samples.items():
        samples[channel] = (t, y + NOISE[channel] * made(AR, len(t), rng))
    return replace(exact, samples=samples)


def problem(recording: Recording, colour: str = "white") -> Problem:
    return Problem(
        [recording],
        sensors(colour),
        {name: Unknown(nominal=1.01 * value) for name, value in TRUTH.items()},
    )


@pytest.mark.parametrize("colour", ["white", "ar"])
def test_intervals_hold_under_coloured_noise_which_is_named_unless_it_was_declared(exact, colour):
    own = problem(noisy(exact), colour)
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
