"""What is wrong with sensors, and where runs begin, as coordinates: derivatives by both routes, priors, saturation, any rig."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE

from torchsoft import (
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Parameters,
    Profile,
    Reference,
    Rig,
    SmoothSlip,
    SoftContact,
    simulate,
)
from torchsoft.excitation import Excitation, Strokes
from torchsoft.sysid import AtRest, Known, Prior, Problem, Recording, Sensor, Stage, Unknown, identify, record
from torchsoft.sysid.problem.workers import Runner

BASE = Parameters().override(COARSE)
STROKES = Excitation(motion=Strokes(travel=8e-3, stroke_time=0.2), duration=0.9)
FAULTY = {
    "x_C": Sensor(noise=1e-5, gain=0.05, drift=1e-3),
    "y_C": Sensor(noise=1e-5, misalignment=0.05),
    "theta": Sensor(noise=5e-4, bias=1e-2, per="recording", delay=4e-3),
    "F_x": Sensor(noise=0.1, inertia=0.5, misalignment=0.02, high=1.0),
    "F_y": Sensor(noise=0.1),
}


@pytest.fixture(scope="module")
def strokes() -> Recording:
    return record("strokes", STROKES, BASE.override({"pad.E": 0.9e6}), BASE, FAULTY)


def test_every_kind_of_coordinate_has_its_derivative(strokes: Recording) -> None:
    """Of parameters, a place of the disc, and of everything that a sensor may have; by differences, and by the adjoint."""
    moved = replace(strokes, name="moved", start=AtRest(x_sd=1e-4))
    unknowns = {
        "pad.E": Unknown(prior=Prior(median=8e5, sd=1e5)),
        "contact.epsilon": Unknown(prior=Prior(median=1e-6, sd=1.0, kind="log-normal")),
        "contact.R_n": Unknown(per="recording"),
    }
    problem = Problem([strokes, moved], FAULTY, unknowns)
    c, runner = problem.coordinates, Runner(problem.recordings)
    assert c.labels == (
        "pad.E", "contact.epsilon", "contact.R_n in strokes", "contact.R_n in moved", "start.disc.x in moved", "gain of x_C",
        "drift of x_C", "misalignment of y_C", "bias of theta in strokes", "bias of theta in moved",
        "delay of theta in strokes", "delay of theta in moved", "misalignment of F_x", "inertia of F_x",
    )  # fmt: skip
    low, high = c.bounds
    x = c.start + 0.05 * np.random.default_rng(0).standard_normal(len(c)) * np.minimum(1, high - low)
    _, steps = problem.freeze(runner, x, problem.names, 1e-4, c.free)
    at = problem.residuals(runner, x, problem.names, steps, c.free)
    assert len(at.r) == problem.samples() + 3  # of the priors, the place's own among them
    assert (at.r[: problem.samples()] == 0).any()  # of saturated samples
    for i, label in enumerate(c.labels):
        h = 1e-5 * np.eye(len(c))[i]
        ahead, behind = (problem.residuals(runner, x + s * h, problem.names, steps).r for s in (1, -1))
        slope = (ahead - behind) / 2e-5
        assert np.linalg.norm(at.J[:, i] - slope) < 2e-5 * np.linalg.norm(slope), label
    loss, gradient, lost = problem.misfit(runner, x, problem.names, steps, c.free)
    assert not lost
    assert loss == pytest.approx(0.5 * at.r @ at.r, rel=1e-12)
    np.testing.assert_allclose(gradient, at.J.T @ at.r, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())


def test_a_prior_is_one_more_measurement(strokes: Recording) -> None:
    prior = Prior(median=7e5, sd=0.02, kind="log-normal")
    problem = Problem([strokes], {"x_C": Sensor(noise=1e-2)}, {"pad.E": Unknown(prior=prior)})
    answer = identify(problem, plan=[Stage("all", ("strokes",), ("pad.E",), 1e-3)])
    assert answer["pad.E"].last == pytest.approx(7e5, rel=5e-3)  # the sensor says nothing
    assert answer["pad.E"].relative_sd == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    ("channel", "sensor", "sentence"),
    [
        ("theta", Sensor(noise=1e-3, misalignment=0.1), "no channel at right angles"),
        ("x_C", Sensor(noise=1e-3, inertia=0.1), "not the force of an actuator"),
    ],
)
def test_what_a_channel_cannot_have_is_refused(strokes: Recording, channel: str, sensor: Sensor, sentence: str) -> None:
    with pytest.raises(ValueError, match=rf"sensors\.{channel}\..*{sentence}"):
        Problem([strokes], {channel: sensor}, {"pad.E": Unknown()})


def test_tables_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match=r"low = 2\.0 must be below high = 1\.0"):
        Sensor(noise=1.0, low=2.0, high=1.0)
    with pytest.raises(ValueError, match="log-normal prior needs median > 0"):
        Prior(median=-1.0, sd=1.0, kind="log-normal")
    with pytest.raises(ValueError, match="a fixed unknown needs no prior"):
        Unknown(fixed=True, prior=Prior(median=1.0, sd=1.0))


@pytest.fixture(scope="module")
def jaws() -> Rig:
    """A disc between two driven pads, without controllers."""
    mesh, names = PadMesh(length=60e-3, height=4.59e-3, elements_x=30, elements_y=2), ("lower", "upper")
    rubber = KelvinVoigt(E=0.75e6, nu=0.45, rho=1100.0, tau=10e-3, depth=44e-3)
    law = SoftContact(K_n=1.2e5, R_n=440.0, K_t=1.2e5, R_t=440.0, friction=SmoothSlip(0.8, 0.7, v_s=0.05, eta=10.0))
    driven: dict[str, Any] = {"x": "driven", "y": "driven", "theta": "driven"}
    motion = {f"{jaw}.{axis}": Profile([0.0], [0.0]) for jaw in names for axis in driven}
    motion["upper.y"] = Profile([0.0, 0.06], [47.92e-3, 46.92e-3])
    motion["upper.x"] = Profile([0.06, 0.2], [0.0, 8e-3])
    return Rig(
        bodies={"disc": Body(0.4065, Circle(19.37e-3)), **{jaw: Body(**driven) for jaw in names}},
        pads={jaw: Pad(mesh, rubber, base=jaw, origin=(-30e-3, 0.0), mirrored=jaw == "upper") for jaw in names},
        contacts={jaw: Contact(jaw, "disc", law) for jaw in names},
        reference=Reference(**motion),
        groups={"rubber": rubber, "contact": law},
    )


def test_another_rig_is_identified_by_its_own_names(jaws: Rig) -> None:
    y0 = torch.zeros(jaws.layout.size, dtype=torch.float64)
    y0[jaws.layout.slices["pose", "disc"]] = torch.tensor([3e-4, 23.94e-3, 0.0], dtype=torch.float64)
    t = np.linspace(0.0, 0.2, 81)
    run, rng = simulate(jaws, torch.from_numpy(t), y0=y0, rtol=1e-6), np.random.default_rng(1)
    sensors = {"x_disc": Sensor(noise=1e-5), "theta_disc": Sensor(noise=5e-4), "y_disc": Sensor(noise=1e-5)}
    samples = {k: (t, run[k].numpy() + s.noise * rng.standard_normal(len(t))) for k, s in sensors.items()}
    data = Recording("jaws", jaws, samples, Known(y0))
    unknowns = {"rubber.E": Unknown(nominal=0.9e6), "contact.K_n": Unknown(nominal=0.9e5)}
    answer = identify(Problem([data], sensors, unknowns), plan=[Stage("all", ("jaws",), tuple(unknowns), 1e-5)])
    assert answer.converged
    for name, truth in (("rubber.E", 0.75e6), ("contact.K_n", 1.2e5)):
        low, high = answer[name].ci95 or (0.0, 0.0)
        assert low < truth < high, name
    with pytest.raises(ValueError, match="`x_C` is not a channel of the rig of `jaws`; known: x_disc, y_disc"):
        replace(data, samples={"x_C": samples["x_disc"]})
    with pytest.raises(ValueError, match="only the paper's rig has a rest of its own"):
        Problem([replace(data, start=AtRest())], sensors, unknowns)
