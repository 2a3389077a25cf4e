"""Recordings that do not mean what the model takes them to mean get the sentence that helps; those
that do get none."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RIG, excited, rolled, stroked, waves
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from torchsoft import Reference, RigFile
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.physics.parts import Actuator
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import Problem, Recording, Sensor, Unknown, identify, record
from torchsoft.sysid.prechecks import (
    accepted,
    controller_findings,
    findings,
    gaps,
    precheck,
    setpoint_findings,
    together,
)
from torchsoft.sysid.prediction import Prediction, readout
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding
from torchsoft.sysid.stages import LOOSE

NOMINAL = PAPER.override(COARSE)
SENSORS = RIG | {"omega_C": Sensor(noise=0.02)}
LAW, RUBBER = "laws.steel_on_rubber", "materials.rubber"
E, GAINS = f"{RUBBER}.E", ["actuators.y.Kp", "actuators.y.Kd", "actuators.x.Kp"]
FAR = {
    f"{LAW}.K_n": 3.0, f"{LAW}.R_n": 0.4, f"{LAW}.K_t": 0.4, f"{LAW}.R_t": 2.5,
    f"{LAW}.friction.mu_s": 0.7, f"{LAW}.friction.mu_k": 0.6, E: 0.5, f"{RUBBER}.tau": 2.5,
}  # fmt: skip
"""How far the truth is from where a fit would start."""

PRESS = {"kind": "sines", "components": [{"amplitude": 5e-4, "frequency": 12.0}]}
ABOUT = "about the disc"
STROKE = {"duration": 0.9, "grasp": 0.2, "since": 0.25}
SHAKE = {"duration": 0.9, "grasp": 0.2, "since": 0.325}
MOTIONS = {
    "rolling": stroked(15e-3, stroke_time=0.2, **STROKE),
    "shaking": Excitation(*waves(6e-3, 2e-4, (4.0, 17.0)), depth=2.8e-4, **SHAKE),
    "pressing": Excitation(rolled(10e-3, 0.9, since=0.325), PRESS, **SHAKE),
    ABOUT: stroked(8e-3, stroke_time=0.25, **STROKE),
}


@pytest.fixture(scope="module")
def recordings():
    """What rigs with parameters far from the nominal ones give."""
    table = NOMINAL.table()
    truth = {name: factor * table[name]["value"] for name, factor in FAR.items()}
    found = {}
    for k, (name, motion) in enumerate(MOTIONS.items()):
        planned = excited(motion, NOMINAL, senses="disc" if name == ABOUT else None)
        found[name] = record(name, planned, truth, SENSORS, seed=k, rtol=1e-4)
    return found


@pytest.fixture(scope="module")
def runs(recordings):
    """Runs with the nominal parameters."""
    problem = Problem(list(recordings.values()), SENSORS, {E: Unknown()})
    jobs = problem.jobs(problem.coordinates.start, problem.names, LOOSE, None)
    return dict(zip(recordings, Runner(problem.recordings).run(jobs)))


def looked_at(
    recording: Recording, run: Prediction | None = None, sensors: Mapping[str, Sensor] = SENSORS
) -> list[Finding]:
    """What is found with the sensors that the recording has, against a run that is there, or one of
    its own."""
    mine = {name: sensor for name, sensor in sensors.items() if name in recording.samples}
    if run is None:
        problem = Problem([recording], mine, {E: Unknown()})
        return precheck(problem, Runner(problem.recordings))
    readouts = {name: readout(recording, name, sensor, {}) for name, sensor in mine.items()}
    return findings(recording, mine, {name: (one, run) for name, one in readouts.items()})


def changed(recording: Recording, **channels: Callable[[Any, Any], Any] | None) -> Recording:
    """With other values of some channels, which are functions of times and values; None leaves a
    channel out."""
    samples = dict(recording.samples)
    for name, change in channels.items():
        t, y = samples.pop(name)
        if change is not None:
            samples[name] = (t, change(t, y))
    return replace(recording, samples=samples)


def noted(
    recording: Recording, settings: Mapping[str, Any] | None = None, **signals: Any
) -> Recording:
    """With other settings, and other signals of the reference."""
    rig, old = RigFile.from_tree(recording.rig.tables).override(settings).assemble(), recording.rig
    own = {name: signals.get(name, old.reference[name]) for name in ("x_d", "y_d", "F_ff")}
    rig.reference = Reference(**own)
    return replace(recording, rig=rig)


def scaled(factor: float) -> Callable[[Any, Any], Any]:
    return lambda t, y: factor * y


def late(by: float) -> Callable[[Any, Any], Any]:
    return lambda t, y: CubicSpline(t, y)(np.maximum(t - by, t[0]))


NO_F = {"effort_x": None, "effort_y": None}
MISTAKES = {
    "sign of a force": (
        "rolling", lambda r: changed(r, effort_x=scaled(-1)), "sign of effort_x", "opposite"
    ),
    "sign of a force that only a run tells": (
        "rolling", lambda r: changed(r, effort_y=scaled(-1), y_Br=None), "sign of effort_y",
        "correlation with a run from the start",
    ),
    "sign of an angle": (
        "rolling", lambda r: changed(r, theta_C=scaled(-1)), "sign of theta_C", "opposite"
    ),
    "millinewtons": (
        "shaking", lambda r: changed(r, effort_x=scaled(1e3)), "unit of effort_x",
        "millinewtons taken for newtons",
    ),
    "radians": (
        "rolling", lambda r: changed(r, theta_C=scaled(1 / 57.3)), "unit of theta_C",
        "radians taken for degrees",
    ),
    "degrees": (
        "rolling", lambda r: changed(r, theta_C=scaled(57.3)), "unit of theta_C",
        "degrees taken for radians",
    ),
    "an angle of zeros": (
        "rolling", lambda r: changed(r, theta_C=scaled(0.0)), "constant theta_C", "0 rad in all of"
    ),
    "a constant force": (
        "shaking", lambda r: changed(r, effort_x=lambda t, y: 0.0 * y + 2.5), "constant effort_x",
        "2.5 N in all of its 181 samples. Its noise is stated as 0.1 N",
    ),
    "no force fed forward": (
        "rolling", lambda r: noted(r, F_ff=Profile([0.0], [0.0])), "F_ff", "Was a force fed forward"
    ),
    "its sign": (
        "pressing", lambda r: noted(r, F_ff=opposite(r)), "F_ff", "Was a force fed forward"
    ),
    "a zero": (
        "rolling", lambda r: changed(r, x_Br=lambda t, x: x + 80e-6), "loop of effort_x", "zeros"
    ),
}  # fmt: skip
"""What is wrong with a recording of one of the motions, and what is found."""


def opposite(recording: Recording) -> Profile:
    feed = recording.rig.reference["F_ff"]
    return Profile(feed.times, -feed.values.detach())


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_the_one_finding_and_rejects_unless_it_may_be_meant(recordings, runs, name):
    motion, change, code, words = MISTAKES[name]
    one = change(recordings[motion])
    (found,) = looked_at(one, runs[motion] if one.rig is recordings[motion].rig else None)
    assert found.facts["name"] == code
    assert words in str(found), found
    assert str(found).startswith(f"Recording `{motion}`: ")
    assert (found.severity == "error") == (not code.startswith(("F_ff", "loop")))


def test_a_noise_that_samples_or_a_run_contradict_is_an_error(recordings, runs):
    """All samples within the noise; a constant channel, whose steps of resolution exceed the noise,
    unless the run moves by less than these."""
    one, run = recordings["rolling"], runs["rolling"]
    flat = changed(one, theta_C=scaled(0.0))
    fine, coarse = (Sensor(noise=5e-4, resolution=q) for q in (1e-3, 1.0))
    for recording, sensor, code, words in (
        (one, {"x_C": Sensor(noise=10.0)}, "noise of x_C", "is stated as 10 m, but all of its"),
        (flat, {"theta_C": fine}, "constant theta_C", "A run with the parameters of the start"),
    ):
        (found,) = looked_at(recording, run, SENSORS | sensor)
        assert (found.facts["name"], found.severity) == (code, "error")
        assert words in str(found)
    assert looked_at(flat, run, SENSORS | {"theta_C": coarse}) == []


@pytest.mark.parametrize("motion", MOTIONS)
def test_nothing_is_found_in_what_is_right(recordings, runs, motion):
    """With a start that is off by a factor of three, with fewer sensors, coloured noise, a hole in
    a force, a camera at 50 Hz, and with faults that were declared."""
    one, run = recordings[motion], runs[motion]
    assert looked_at(one, run) == []
    assert looked_at(changed(one, **NO_F), run) == []
    assert looked_at(changed(one, x_Br=None, y_Br=None), run) == []
    rng, samples = np.random.default_rng(0), dict(one.samples)
    for name, (t, y) in samples.items():
        e = lfilter([0.43], [1, -0.9], SENSORS[name].noise * rng.standard_normal(len(t)))
        samples[name] = t, y + e
    assert looked_at(replace(one, samples=samples), run) == []
    there = np.abs(one.samples["effort_x"][0] - 0.45) > 0.05
    holes = {"effort_x": tuple(x[there] for x in one.samples["effort_x"])}
    holes |= {"x_C": tuple(x[::4] for x in one.samples["x_C"])}
    assert looked_at(replace(one, samples=one.samples | holes), run) == []
    declared = SENSORS | {
        "x_Br": Sensor(noise=1e-5, bias=1e-4), "theta_C": Sensor(noise=5e-4, bias=0.1, delay=0.08),
        "effort_x": Sensor(noise=0.1, delay=6e-3), "effort_y": Sensor(noise=0.1, gain=0.2),
    }  # fmt: skip
    faulty = changed(
        one, x_Br=lambda t, x: x + 40e-6, theta_C=lambda t, y: late(60e-3)(t, y) + 0.02,
        effort_x=late(5e-3), effort_y=scaled(1.15),
    )  # fmt: skip
    assert looked_at(faulty, run, declared) == []


def test_recordings_are_checked_where_gains_are_unknown_and_assumptions_trusted(recordings):
    flipped = changed(recordings["rolling"], effort_y=scaled(-1))
    assert list(controller_findings(flipped, SENSORS))
    assert not list(controller_findings(flipped, SENSORS, GAINS))
    problem = Problem([flipped], SENSORS, {name: Unknown() for name in GAINS})
    found = precheck(problem, Runner(problem.recordings))
    assert [f.facts["name"] for f in found] == ["sign of effort_y"]
    with pytest.raises(ValueError, match="the sign of effort_y looks opposite"):
        identify(Problem([flipped], SENSORS, {E: Unknown()}), rtol=1e-3, assumptions="trusted")


def test_a_law_of_several_coordinates_is_compared_with_its_effort_or_the_gap_is_named(recordings):
    rig = deepcopy(recordings["rolling"].rig)
    loop = rig.actuators["x"]

    def both(w, w_dot, feed, q, q_dot):
        return loop.law(w[..., 0], w_dot[..., 0], feed, q[..., 0], q_dot[..., 0]) + 0.0 * q[..., 1]

    senses = [loop.measured, "disc.theta"]
    rig.actuators["x"] = Actuator(senses, loop.pushes, both, setpoint=[loop.setpoint])
    same = replace(recordings["rolling"], rig=rig)
    assert not list(controller_findings(same, SENSORS))
    for change, severity, words in (
        ({"effort_x": lambda t, F: F + 20.0}, "warning", "effort_x differs by +20 N, on average"),
        ({"theta_C": None}, "note", "not compared with its controller, since theta_C is not rec"),
    ):
        (found,) = controller_findings(changed(same, **change), SENSORS)
        assert found.severity == severity
        assert words in str(found)


def at_rows(recording: Recording, rate: float, *, rates: bool = False) -> Recording:
    """With a reference that is known at `rate` [Hz]."""
    t = torch.arange(0.0, recording.duration + 0.5 / rate, 1 / rate, dtype=torch.float64)
    d = recording.rig.reference(t, ("x_d", "y_d", "F_ff")).detach()
    x_d, y_d, F_ff = (Sampled(t, d[:, i, 0], d[:, i, 1] if rates else None) for i in range(3))
    return noted(recording, x_d=x_d, y_d=y_d, F_ff=F_ff)


@pytest.mark.parametrize("rates", [False, True])
def test_sparse_set_points_are_judged_by_what_they_do(recordings, rates):
    """The estimate from the rows alone against what the exact set-points would have had the
    controller do."""
    one, t = recordings["shaking"], torch.linspace(0.05, 0.85, 4001, dtype=torch.float64)
    for rate in (200.0, 500.0):
        sparse, zero, efforts = at_rows(one, rate, rates=rates), torch.zeros_like(t), []
        for reference in (sparse.rig.reference, one.rig.reference):
            d = reference(t, ("x_d",)).detach()[:, 0].unbind(-1)
            efforts += [one.rig.actuators["x"](torch.stack((*d, zero, zero, zero), -1)).detach()]
        real = float((efforts[0] - efforts[1]).square().mean().sqrt())
        gap = {gap.channel: gap for gap in gaps(sparse, SENSORS, "x")}["effort_x"]
        assert 0.5 * real < gap.error < 2.5 * real
        assert gap.noises == gap.error / SENSORS["effort_x"].noise
    for rate, severity in ((500.0, None), (100.0, "warning"), (30.0, "error")):
        found = list(setpoint_findings(at_rows(one, rate, rates=rates), SENSORS))
        mine = [f for f in found if f.facts["name"] == "set-points x_d"]
        assert [f.severity for f in mine] == ([severity] if severity else [])
        assert all(("no column x_d_dot" in str(f)) == (not rates) for f in mine)


@pytest.mark.parametrize(
    ("motion", "clock", "factor", "words"),
    [
        ("rolling", 1.0, -1.0, "Its sign looks opposite"),
        ("rolling", 1.0, 1e3, "It is 1e+03 times that"),
        ("shaking", 1.003, 1.0, "x_d_dot is not quite their rate (is a clock a little off?)"),
    ],
)
def test_a_rate_that_is_not_that_of_its_set_point_is_named(
    recordings, motion, clock, factor, words
):
    one = at_rows(recordings[motion], 1000.0, rates=True)
    x_d = one.rig.reference["x_d"]
    other = Sampled(clock * x_d.times, x_d.values.detach(), factor * x_d.rates)
    (found,) = setpoint_findings(noted(one, x_d=other), SENSORS)
    assert found.facts["name"] == ("rate of x_d" if clock == 1.0 else "set-points x_d")
    assert (found.severity == "error") == (clock == 1.0)
    assert words in str(found)


def test_findings_of_a_kind_are_reported_once_and_reject_unless_acknowledged():
    def finding(code, severity, name, recording):
        facts = {"name": name, "recording": recording, "channel": "F_x", "correlation": -0.9}
        return Finding(code, severity, facts | {"ratio": 20.0})

    found = together([
        finding("sign", "error", "sign of F_x", "a"),
        finding("size", "warning", "size of F_x", "a"),
        finding("sign", "error", "sign of F_x", "b"),
    ])  # fmt: skip
    assert [f.facts["name"] for f in found] == ["sign of F_x", "size of F_x"]
    assert str(found[0]).endswith("The same holds for recording `b`.")
    for some, given, says in (
        (found, [], r'set acknowledged = \["sign of F_x"\]'),
        (found, ["sign of F_x", "nonsense"], "'nonsense'.* the findings are sign of F_x, size of"),
        ([], ["nonsense"], "acknowledged: .*'nonsense', .* nothing looks wrong"),
    ):
        with pytest.raises(ValueError, match=says):
            accepted(some, given)
    assert [one.severity for one in accepted(found, ["sign of F_x"])] == ["note", "note"]
