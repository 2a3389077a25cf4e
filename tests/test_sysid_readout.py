"""What is wrong with sensors, and where runs begin, as coordinates: derivatives by both routes,
priors, saturation, any rig."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, dry, excited, f64
from scipy import stats
from scipy.optimize import least_squares
from test_sysid import check_derivatives

from torchsoft import (
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    simulate,
)
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import (
    Known,
    Prior,
    Problem,
    Recording,
    Sensor,
    Stage,
    Unknown,
    identify,
    record,
)
from torchsoft.sysid.prediction import Readout
from torchsoft.sysid.residual_tests import CLEAR, parts, predicted
from torchsoft.sysid.runs import Runner

E, LAW = "materials.rubber.E", "laws.steel_on_rubber"
MU_S, MU_K = f"{LAW}.friction.mu_s", f"{LAW}.friction.mu_k"
FAULTY = {
    "x_C": Sensor(noise=1e-5, gain=0.05, drift=1e-3),
    "y_C": Sensor(noise=1e-5, misalignment=0.05),
    "theta_C": Sensor(noise=5e-4, bias=1e-2, per="recording", delay=4e-3),
    "effort_x": Sensor(noise=0.1, inertia=0.5, misalignment=0.02, high=1.0),
    "effort_y": Sensor(noise=0.1),
}


@pytest.fixture(scope="module")
def strokes():
    roll = {"kind": "strokes", "travel": 8e-3, "stroke_time": 0.15}
    motion = Excitation(roll, duration=0.45, grasp=0.15, since=0.2)
    built = excited(motion, PAPER.override(COARSE))
    return record("strokes", built, {E: 0.9e6}, FAULTY)


@pytest.mark.slow
def test_every_kind_of_coordinate_has_its_derivative(strokes):
    """Of parameters, a place of the disc, and of everything that a sensor may have; by differences,
    and by the adjoint."""
    moved = replace(
        strokes, name="moved", start=strokes.start._replace(position_sd={"disc.x": 1e-4})
    )
    unknowns = {
        E: Unknown(prior=Prior(median=8e5, sd=1e5)),
        f"{LAW}.friction.v_s": Unknown(prior=Prior(median=5e-3, sd=1.0, kind="log-normal")),
        f"{LAW}.R_n": Unknown(per="recording"),
        MU_S: Unknown(),
        MU_K: Unknown(ratio_to=MU_S, high=1.0, low=0.3),
        "bodies.disc.mass": Unknown(scale="linear", low=0.3, high=0.5),
        "actuators.x.Kd": Unknown(),
    }
    problem = Problem([strokes, moved], FAULTY, unknowns)
    c = problem.coordinates
    assert c.labels == (
        E, f"{LAW}.friction.v_s", f"{LAW}.R_n in strokes", f"{LAW}.R_n in moved",
        MU_S, f"{MU_K} / {MU_S}", "bodies.disc.mass", "actuators.x.Kd",
        "start.disc.x in moved", "gain of x_C", "drift of x_C", "misalignment of y_C",
        "bias of theta_C in strokes", "bias of theta_C in moved", "delay of theta_C in strokes",
        "delay of theta_C in moved", "misalignment of effort_x", "inertia of effort_x",
    )  # fmt: skip
    low, high = c.bounds
    x = c.start + 0.05 * np.random.default_rng(0).standard_normal(len(c)) * np.minimum(
        1, high - low
    )
    rows = len(problem.residuals(Runner(problem.recordings), x, problem.names, 1e-3).r)
    assert rows == problem.samples() + 3  # of the priors, the place's own among them
    assert any(one.saturated(strokes.samples[channel][1]).any() for channel, one in FAULTY.items())
    check_derivatives(problem, x, 1e-3, 2e-5, adjoint=1e-9)


def test_a_prior_is_one_more_measurement(strokes):
    prior = Prior(median=7e5, sd=0.02, kind="log-normal")
    problem = Problem([strokes], {"x_C": Sensor(noise=1e-2)}, {E: Unknown(prior=prior)})
    answer = identify(
        problem, plan=[Stage("all", ("strokes",), (E,), 1e-3)], assumptions="trusted",
        acknowledged=["noise of x_C"],
    )  # fmt: skip
    assert answer[E].last == pytest.approx(7e5, rel=5e-3)  # the sensor says nothing
    assert answer[E].relative_sd == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    ("channel", "sensor", "sentence"),
    [
        ("theta_C", Sensor(noise=1e-3, misalignment=0.1), "no channel at right angles"),
        ("x_C", Sensor(noise=1e-3, inertia=0.1), "not the force of an actuator"),
    ],
)
def test_what_a_channel_cannot_have_is_refused(strokes, channel, sensor, sentence):
    with pytest.raises(ValueError, match=rf"sensors\.{channel}\..*{sentence}"):
        Problem([strokes], {channel: sensor}, {E: Unknown()})


def test_tables_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match=r"low = 2\.0 must be below high = 1\.0"):
        Sensor(noise=1.0, low=2.0, high=1.0)
    with pytest.raises(ValueError, match="log-normal prior needs median > 0"):
        Prior(median=-1.0, sd=1.0, kind="log-normal")
    with pytest.raises(ValueError, match="a fixed unknown needs no prior"):
        Unknown(fixed=True, prior=Prior(median=1.0, sd=1.0))


@pytest.fixture(scope="module")
def jaws():
    """A disc between two driven pads, without controllers."""
    mesh, names = (
        PadMesh(length=60e-3, height=4.59e-3, elements_x=30, elements_y=2),
        ("lower", "upper"),
    )
    rubber, law = KelvinVoigt(**RUBBER, tau=0.01), dry()
    driven: dict[str, Any] = {"x": "driven", "y": "driven", "theta": "driven"}
    motion = {f"{jaw}.{axis}": Profile([0.0], [0.0]) for jaw in names for axis in driven}
    motion["upper.y"] = Profile([0.0, 0.06], [47.92e-3, 46.92e-3])
    motion["upper.x"] = Profile([0.06, 0.2], [0.0, 8e-3])
    return Rig(
        bodies={"disc": Body(0.4065, Circle(19.37e-3)), **{jaw: Body(**driven) for jaw in names}},
        pads={
            jaw: Pad(mesh, rubber, base=jaw, origin=(-30e-3, 0.0), mirrored=jaw == "upper")
            for jaw in names
        },
        contacts={jaw: Contact(jaw, "disc", law) for jaw in names},
        reference=Reference(**motion),
        groups={"rubber": rubber, "contact": law},
    )


def test_another_rig_is_identified_by_its_own_names(jaws):
    y0 = torch.zeros(jaws.layout.size, dtype=torch.float64)
    y0[jaws.layout.slices["pose", "disc"]] = f64(3e-4, 23.94e-3, 0.0)
    t = np.linspace(0.0, 0.2, 81)
    run, rng = simulate(jaws, torch.from_numpy(t), y0=y0, rtol=1e-6), np.random.default_rng(1)
    sensors = {
        "x_disc": Sensor(noise=1e-5),
        "theta_disc": Sensor(noise=5e-4),
        "y_disc": Sensor(noise=1e-5),
    }
    samples = {
        k: (t, run[k].numpy() + s.noise * rng.standard_normal(len(t))) for k, s in sensors.items()
    }
    data = Recording("jaws", jaws, samples, Known(y0))
    unknowns = {"rubber.E": Unknown(nominal=0.9e6), "contact.K_n": Unknown(nominal=0.9e5)}
    answer = identify(
        Problem([data], sensors, unknowns),
        plan=[Stage("all", ("jaws",), tuple(unknowns), 1e-5)],
        assumptions="trusted",
    )
    assert answer.converged
    for name, truth in (("rubber.E", 0.75e6), ("contact.K_n", 1.2e5)):
        low, high = answer[name].ci95 or (0.0, 0.0)
        assert low < truth < high, name
    with pytest.raises(
        ValueError, match="`x_C` is not a channel of the rig of `jaws`; did you mean `x_disc`"
    ):
        replace(data, samples={"x_C": samples["x_disc"]})


def test_saturated_samples_have_tobins_likelihood():
    """An amplitude, of which a sensor cuts a third off: its likelihood is that of the normal
    distribution function, and with many seeds errors are standard normal."""
    t, limit, noise = np.arange(200) * 5e-3, 0.9, 0.1
    shape, z = np.sin(4 * np.pi * t), []
    one = Readout("effort_x", noise, -limit, limit, 1.0, 0.0, 0.0, 0.0, 0.0, ())
    for seed in range(200):
        y = np.clip(
            shape + noise * np.random.default_rng(seed).standard_normal(len(t)), -limit, limit
        )
        fit = least_squares(
            lambda a, y=y: one.residuals(a * shape, y)[0], [1.0],
            jac=lambda a, y=y: (one.residuals(a * shape, y)[1] * shape)[:, None],
        )  # fmt: skip
        z.append((fit.x[0] - 1.0) * float(np.linalg.norm(fit.jac)))
        if seed < 3:
            expected = 1.02 * shape
            mine = np.where(
                np.abs(y) < limit,
                stats.norm.logpdf((y - expected) / noise) + 0.5 * np.log(2 * np.pi),
                stats.norm.logsf((limit - np.sign(y) * expected) / noise),
            )  # fmt: skip
            np.testing.assert_allclose(
                -0.5 * one.residuals(expected, y)[0] ** 2, mine, rtol=1e-9, atol=1e-12
            )
    assert abs(np.mean(z)) < 3 / len(z) ** 0.5
    assert stats.kstest(z, "norm").pvalue > 0.01
    far, slope = one.residuals(np.array([50.0, -50.0]), np.array([limit, -limit]))
    assert not far.any()
    assert not slope.any()


def test_saturated_samples_cannot_have_coloured_noise(strokes):
    sensors = {
        "effort_x": Sensor(noise=0.1, high=float(strokes.samples["effort_x"][1].max()), colour="ar")
    }
    with pytest.raises(
        ValueError, match=r"sensors\.effort_x: in `strokes` samples are at its `low` or `high`"
    ):
        Problem([strokes], sensors, {E: Unknown()})


def test_what_saturation_has_changed_is_not_judged(strokes):
    """Noise as stated and a sensor that is saturated most of the time: residuals near its range's
    end are not normal, those well inside are; and one far from the prediction counts wherever it
    is."""
    t, y = strokes.samples["effort_x"]
    limit = float(np.quantile(np.abs(y), 0.4))
    noise = limit / 20
    sensor, rng = Sensor(noise=noise, low=-limit, high=limit), np.random.default_rng(0)
    measured = np.clip(y + noise * rng.standard_normal(len(t)), -limit, limit)
    measured[np.argmax(y)] = 0.0  # a sample that is lost
    cut = replace(strokes, samples={"effort_x": (t, measured)})
    problem = Problem([cut], {"effort_x": sensor}, {E: Unknown()})
    r, _ = Readout("effort_x", noise, -limit, limit, 1.0, 0.0, 0.0, 0.0, 0.0, ()).residuals(
        y, measured
    )
    (part,) = parts(problem, r, ["strokes"])
    assert part.saturated > 0.5 * len(t)
    inside = np.flatnonzero(np.abs(y) < limit - CLEAR * noise)
    assert set(part.rows) == {*inside, int(np.argmax(y))}
    np.testing.assert_allclose(part.reading, y[part.rows], rtol=1e-6)
    near = np.abs(y) < limit + CLEAR * noise
    np.testing.assert_allclose(predicted(sensor, measured, r)[near], y[near], rtol=1e-5, atol=1e-6)
