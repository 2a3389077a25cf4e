"""Identification under coloured noise: what is found, and what intervals allow for."""

from dataclasses import replace

import numpy as np
import pytest
from test_sysid_noise import made
from test_sysid_suspects import BALL, K_N, SENSORS, TRUTH, E

from torchsoft.sysid import (
    Problem,
    Recording,
    Stage,
    Unknown,
    identify,
    record,
)
from torchsoft.sysid.colour import rewhitened
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.residual_tests import parts
from torchsoft.sysid.runs import Runner

AR = Autoregression.stated((0.8,), 1e-3)


@pytest.fixture(scope="module")
def coloured():
    """Every millisecond, with noise of a colour."""
    how = {"rtol": 1e-6, "noise": 0.0, "rate": 1000.0}
    exact, rng = record("press", BALL.build(), TRUTH, SENSORS, **how), np.random.default_rng(0)
    samples = {
        channel: (t, y + SENSORS[channel].noise * made(AR, len(t), rng))
        for channel, (t, y) in exact.samples.items()
    }
    return replace(exact, samples=samples)


def problem(recording: Recording, colour: str = "white") -> Problem:
    sensors = {k: one.model_copy(update={"colour": colour}) for k, one in SENSORS.items()}
    unknowns = {name: Unknown(nominal=1.01 * value) for name, value in TRUTH.items()}
    return Problem([recording], sensors, unknowns)


@pytest.mark.parametrize("colour", ["white", "ar"])
def test_intervals_hold_under_coloured_noise_which_is_named_unless_it_was_declared(
    coloured, colour
):
    own = problem(coloured, colour)
    stage = Stage("all", own.names, (E, K_N), 1e-4)
    answer = identify(own, plan=[stage], assumptions="trusted", tightenings=0)
    assert answer.noise.keys() == (set(SENSORS) if colour == "ar" else set())
    assert all(one.order in (1, 2) for one in answer.noise.values())
    said = [str(one) for one in answer.findings if one.code == "colour"]
    assert len(said) == (colour == "white")
    assert all("coloured in x_ball (order" in text for text in said)
    assert answer.verdict == "holds"
    for name, truth in TRUTH.items():
        assert abs(np.log(answer[name].last / truth)) < 3 * answer[name].relative_sd, name
    x, free, runner = np.array(answer.x), own.coordinates.free, Runner(own.recordings)
    J = own.residuals(runner, x, own.names, 1e-4, free).J
    white = np.linalg.inv(J.T @ J)  # the covariance if the noise were white
    assert answer[E].relative_sd > 1.3 * white[0, 0] ** 0.5


def test_residuals_are_whitened_at_once_and_again_from_other_noise(coloured):
    gaps = {
        c: (np.delete(t, slice(20, 30)), np.delete(y, slice(20, 30)))
        for c, (t, y) in coloured.samples.items()
    }
    plain = problem(replace(coloured, samples=gaps))
    noisy = plain.with_noise({"x_ball": AR, "effort_y": Autoregression((1.2, -0.5), 0.7, 1e-3)})
    runner, which, x = Runner(plain.recordings), plain.names, plain.coordinates.start
    free = plain.coordinates.free
    steps = plain.residuals(runner, x, which, 1e-4).steps
    one = plain.residuals(runner, x, which, steps, free)
    other = noisy.residuals(runner, x, which, steps, free)
    again = rewhitened(noisy, one, parts(plain, one.r, which))
    back = rewhitened(plain, other, parts(noisy, other.r, which))
    for a, b in ((again.r, other.r), (again.J, other.J), (back.r, one.r), (back.J, one.J)):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
