"""Faults and ranges of sensors, and priors, as coordinates of a fit."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from conftest import COARSE, PAPER, excited, stroked
from scipy import signal, stats
from scipy.interpolate import CubicSpline
from test_sysid import check_derivatives, fit

from torchsoft.sysid import Prior, Problem, Sensor, Unknown, record
from torchsoft.sysid.estimate import nuisance_unit
from torchsoft.sysid.prediction import Readout
from torchsoft.sysid.residual_tests import CLEAR, parts
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import FAULTS

E = "materials.rubber.E"
NOISE = {"x_C": 1e-5, "y_C": 1e-5, "theta_C": 5e-4, "effort_x": 0.1, "v_x_Br": 1e-3}
Signals = Mapping[str, Callable[..., np.ndarray]]


@pytest.fixture(scope="module")
def dense():
    """Strokes, every millisecond, without noise."""
    motion = stroked(4e-3, 0.08, duration=0.3, grasp=0.1, since=0.12)
    sensors = {name: Sensor(noise=noise) for name, noise in NOISE.items()}
    built = excited(motion, PAPER.override(COARSE))
    return record("dense", built, {}, sensors, rate=1000.0, rtol=1e-5, noise=0.0)


@pytest.fixture(scope="module")
def strokes(dense):
    """Every five milliseconds, from the middle of the grasp on."""
    samples = {name: (t[50::5], y[50::5]) for name, (t, y) in dense.samples.items()}
    return replace(dense, name="strokes", samples=samples)


def low_pass(of: Signals, lag: float, t: np.ndarray) -> np.ndarray:
    s = np.arange(0.0, t[-1] + 1e-4, 1e-4)
    y = of["x_C"](s)
    return y[0] + np.interp(t, s, signal.lsim(([1.0], [lag, 1.0]), y - y[0], s)[1])


def play(of: Signals, width: float, t: np.ndarray) -> np.ndarray:
    s = np.arange(0.0, t[-1] + 1e-3, 1e-3)
    y = of["x_C"](s)
    out = y[:1].tolist()
    for value in y[1:]:
        out.append(min(max(out[-1], value - width / 2), value + width / 2))
    return np.interp(t, s, out)


def turned(of: Signals, angle: float, t: np.ndarray) -> np.ndarray:
    return np.cos(angle) * of["x_C"](t) + np.sin(angle) * of["y_C"](t)


MIDDLE = 0.175
"""Of the samples [s]."""
READINGS = {
    "bias": ("x_C", "m", 1e-3, lambda of, size, t: of["x_C"](t) + size),
    "delay": ("x_C", "s", 4e-3, lambda of, size, t: of["x_C"](t - size)),
    "gain": ("x_C", "1", 0.2, lambda of, size, t: (1 + size) * of["x_C"](t)),
    "drift": ("x_C", "m/s", 0.01, lambda of, size, t: of["x_C"](t) + size * (t - MIDDLE)),
    "misalignment": ("x_C", "rad", 0.2, turned),
    "inertia": ("effort_x", "kg", 0.5,
                lambda of, size, t: of["effort_x"](t) - size * of["v_x_Br"](t, 1)),
    "clock": ("x_C", "1", 0.02, lambda of, size, t: of["x_C"](t - size * (t - MIDDLE))),
    "lag": ("x_C", "s", 5e-3, low_pass),
    "backlash": ("x_C", "m", 1e-3, play),
}  # fmt: skip
"""By fault: channel, unit of the fault, its size, and the reading in closed form."""


@pytest.fixture(scope="module")
def remembered(tmp_path_factory):
    """Where runs that several faults have in common are made once."""
    return tmp_path_factory.mktemp("runs")


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_reads_as_its_closed_form_and_has_its_derivatives(dense, strokes, remembered, kind):
    """By differences; its neutral value leaves the reading as it is."""
    channel, unit, size, reading = READINGS[kind]
    plain = Sensor(noise=NOISE[channel])
    faulty = plain.model_copy(update={kind: 2 * size})
    problem = Problem([strokes], {channel: faulty}, {E: Unknown()})
    c, runner = problem.coordinates, Runner([strokes], journal=remembered)
    (i,) = (k for k, one in enumerate(c.all) if one.kind == kind)
    assert nuisance_unit(c.all[i], problem) == unit
    x = c.start.copy()
    x[i] = c.all[i].to_x(c.all[i].nominal + size)
    t, of = strokes.times, {k: CubicSpline(*samples) for k, samples in dense.samples.items()}
    without = Problem([strokes], {channel: plain}, {E: Unknown()})
    at, neutral, stated = (
        plain.noise * one.residuals(runner, place, ["strokes"], 1e-4).r
        for one, place in ((problem, x), (problem, c.start), (without, c.start[:1]))
    )
    change = reading(of, size, t) - of[channel](t)
    np.testing.assert_allclose(at - neutral, change, atol=0.01 * np.abs(change).max())
    assert np.abs(neutral - stated).max() < 0.1 * plain.noise
    check_derivatives(problem, x, 1e-4, 1e-4, only=[c.labels[i], E], runner=runner)


def test_a_prior_is_one_more_measurement(strokes):
    """Where the sensor says nothing, it is all."""
    prior = Prior(median=7e5, sd=0.02, kind="log-normal")
    blind = {"x_C": Sensor(noise=1e-2)}
    unknowns, allowed = {E: Unknown(prior=prior)}, ["noise of x_C"]
    found = fit(strokes, unknowns, sensors=blind, tightenings=0, acknowledged=allowed)
    assert found[E].last == pytest.approx(7e5, rel=5e-3)
    assert found[E].relative_sd == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    ("channel", "sensor", "message"),
    [
        ("theta_C", {"misalignment": 0.1}, r"theta_C\.misalignment.*no channel at right angles"),
        ("x_C", {"inertia": 0.1}, r"x_C\.inertia.*not the force of an actuator"),
        ("x_C", {"clock": 0.1, "delay": 0.1}, r"x_C\.clock = 0\.1 is more than 0\.1 s at the ends"),
        ("effort_x", {"high": 0.0, "colour": "ar"}, "samples are at its `low` or `high`.*white"),
        ("x_C", {"low": 2.0, "high": 1.0}, r"low = 2\.0 must be below high = 1\.0"),
    ],
)
def test_what_a_sensor_cannot_have_is_rejected(strokes, channel, sensor, message):
    with pytest.raises(ValueError, match=message):
        Problem([strokes], {channel: Sensor(noise=1e-3, **sensor)}, {E: Unknown()})


def test_steps_of_a_reading_add_their_variance_to_the_noise():
    """Independent of it, and uniform over a step."""
    assert Sensor(noise=3.0, resolution=4.0 * 12**0.5).sd == pytest.approx(5.0)


def tobin(noise: float, limit: float) -> Readout:
    return Readout("effort_x", noise, -limit, limit, 1.0, 0.0, 0.0, 0.0, 0.0, ())


def test_saturated_samples_have_tobins_likelihood():
    """That of the normal distribution function; far beyond the limit they say nothing."""
    limit, noise, rng = 0.9, 0.1, np.random.default_rng(0)
    expected = 1.02 * np.sin(np.linspace(0, 12, 200))
    y = np.clip(expected + noise * rng.standard_normal(200), -limit, limit)
    r, slope = tobin(noise, limit).residuals(expected, y)
    exact = np.where(
        np.abs(y) < limit,
        stats.norm.logpdf((y - expected) / noise) + 0.5 * np.log(2 * np.pi),
        stats.norm.logsf((limit - np.sign(y) * expected) / noise),
    )
    np.testing.assert_allclose(-0.5 * r**2, exact, rtol=1e-9, atol=1e-12)
    ahead, behind = (tobin(noise, limit).residuals(expected + h, y)[0] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-6)
    far = tobin(noise, limit).residuals(np.array([50.0, -50.0]), np.array([limit, -limit]))
    assert not np.any(far)


def test_residuals_that_saturation_changed_are_not_judged(strokes):
    """Those well inside the range are, and one far from the prediction wherever it is."""
    t, y = strokes.samples["effort_x"]
    limit = float(np.quantile(np.abs(y), 0.4))
    noise = limit / 20
    rng, sensor = np.random.default_rng(0), Sensor(noise=noise, low=-limit, high=limit)
    measured = np.clip(y + noise * rng.standard_normal(len(t)), -limit, limit)
    measured[np.argmax(y)] = 0.0  # a sample that is lost
    cut = replace(strokes, samples={"effort_x": (t, measured)})
    problem = Problem([cut], {"effort_x": sensor}, {E: Unknown()})
    r, _ = tobin(noise, limit).residuals(y, measured)
    (part,) = parts(problem, r, ["strokes"])
    assert part.saturated > 0.5 * len(t)
    assert {*part.rows} == {*np.flatnonzero(np.abs(y) < limit - CLEAR * noise), int(np.argmax(y))}
    np.testing.assert_allclose(part.reading, y[part.rows], rtol=1e-6)
