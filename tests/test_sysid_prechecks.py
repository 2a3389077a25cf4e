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
from torchsoft.diagnostic import Diagnostic
from torchsoft.physics.motion import Profile, Sampled
from torchsoft.physics.parts import Actuator
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import Problem, Recording, Sensor, Unknown, identify, record
from torchsoft.sysid.plan import LOOSE
from torchsoft.sysid.prechecks import (
    accepted,
    controller_findings,
    findings,
    gaps,
    precheck,
    setpoint_findings,
    together,
)
from torchsoft.sysid.prediction import Signals, readout
from torchsoft.sysid.runs import Runner

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
STROKE: dict[str, Any] = {"duration": 0.9, "grasp": 0.2, "since": 0.25}
SHAKE: dict[str, Any] = {"duration": 0.9, "grasp": 0.2, "since": 0.325}
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
    made = zip(recordings.items(), Runner(problem.recordings).run(jobs))
    return {name: Signals(run.t, one.channels, run.signals, None) for (name, one), run in made}


def looked_at(
    recording: Recording, run: Signals | None = None, sensors: Mapping[str, Sensor] = SENSORS
) -> list[Diagnostic]:
    """What is found with the sensors that the recording has, against a run that is there, or one of
    its own."""
    mine = {name: sensor for name, sensor in sensors.items() if name in recording.samples}
    if run is None:
        problem = Problem([recording], mine, {E: Unknown()})
        return precheck(problem, Runner(problem.recordings))
    span = float(recording.times[0]), float(recording.times[-1])
    readouts = {
        name: readout(recording.rig, name, sensor, {}, span) for name, sensor in mine.items()
    }
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


SETPOINT = "what x_d is of"
NO_F = {"effort_x": None, "effort_y": None}
MISTAKES: dict[str, tuple[str, Callable[[Recording], Recording], str, str, bool]] = {
    "sign of a force": (
        "rolling", lambda r: changed(r, effort_x=scaled(-1)), "sign of effort_x",
        "effort_x looks as if its sign were opposite", True
    ),
    "sign of a force that only a run tells": (
        "rolling", lambda r: changed(r, effort_y=scaled(-1), y_Br=None), "sign of effort_y",
        "correlation with a run from the start", True
    ),
    "sign of an angle": (
        "rolling", lambda r: changed(r, theta_C=scaled(-1)), "sign of theta_C",
        "theta_C looks as if its sign were opposite",
                                                                            True
    ),
    "millinewtons": (
        "shaking", lambda r: changed(r, effort_x=scaled(1e3)), "unit of effort_x",
        "millinewtons taken for newtons", True
    ),
    "degrees": (
        "rolling", lambda r: changed(r, theta_C=scaled(57.3)), "unit of theta_C",
        "degrees taken for radians", True
    ),
    "an angle of zeros": (
        "rolling", lambda r: changed(r, theta_C=scaled(0.0)), "constant theta_C",
        "theta_C is constant, 0 rad in all of its ", True
    ),
    "a constant force": (
        "shaking", lambda r: changed(r, effort_x=lambda t, y: 0.0 * y + 2.5), "constant effort_x",
        "2.5 N in all of its 181 samples, but its noise is stated as 0.1 N", True
    ),
    "the disc's set-point taken for the bracket's": (
        ABOUT, lambda r: noted(r, {"control.senses": "bracket.x"}), SETPOINT,
        'set-point of the disc, not of the bracket (say measures = "disc.x" of the actuator x)',
        True,
    ),
    "the bracket's taken for the disc's": (
        "rolling", lambda r: noted(r, {"control.senses": "disc.x"}), SETPOINT,
        "of the bracket, not of the disc", True
    ),
    "the bracket's taken for the disc's, no forces": (
        "rolling", lambda r: changed(noted(r, {"control.senses": "disc.x"}), **NO_F),
        SETPOINT, "x_Br follows it to", True
    ),
    "the bracket's taken for the disc's, the disc alone": (
        "rolling", lambda r: changed(noted(r, {"control.senses": "disc.x"}), **NO_F, x_Br=None),
        SETPOINT, "x_C does not follow it", True,
    ),
    "exchanged columns": (
        "rolling", lambda r: changed(r, x_C=lambda t, x: r.samples["x_Br"][1], x_Br=lambda t,
        x: r.samples["x_C"][1]), SETPOINT, "or are x_Br and x_C exchanged?", True,
    ),
    "no force fed forward": (
        "rolling", lambda r: noted(r, F_ff=Profile([0.0], [0.0])), "F_ff",
        "was a force fed forward that F_ff does",
                                                                           False
    ),
    "its sign": (
        "pressing", lambda r: noted(r, F_ff=opposite(r)), "F_ff",
        "was a force fed forward that F_ff does", False
    ),
    "a zero": (
        "rolling", lambda r: changed(r, x_Br=lambda t, x: x + 80e-6), "loop of effort_x",
        "zeros and set-points right?", False
    ),
}  # fmt: skip


"""What is wrong with a recording of one of the motions, what is said of it, and whether it is
refused."""


def opposite(recording: Recording) -> Profile:
    feed = recording.rig.reference["F_ff"]
    return Profile(feed.times, -feed.values.detach())


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_gets_the_sentence_that_helps(recordings, runs, name):
    motion, change, what, words, grave = MISTAKES[name]
    one = change(recordings[motion])
    (found,) = looked_at(one, runs[motion] if one.rig is recordings[motion].rig else None)
    assert found.code == what
    assert words in found.message, found.message
    assert found.message.startswith(f"recording `{motion}`: ")
    assert (found.severity == "error") == grave


def test_noise_in_another_unit_is_told_by_samples_that_are_too_near_to_each_other(recordings, runs):
    one = recordings["rolling"]
    (found,) = looked_at(one, runs["rolling"], SENSORS | {"x_C": Sensor(noise=10.0)})
    assert (found.code, found.severity) == ("noise of x_C", "error")
    assert "the noise of x_C is stated as 10 m, but all of its samples are within" in found.message


def test_a_constant_channel_of_a_coarse_sensor_is_compared_with_the_run(recordings, runs):
    """Where steps of the resolution exceed the noise, samples may be constant, unless the run
    moves by several steps."""
    one = changed(recordings["rolling"], theta_C=scaled(0.0))
    fine, coarse = (Sensor(noise=5e-4, resolution=q) for q in (1e-3, 1.0))
    (found,) = looked_at(one, runs["rolling"], SENSORS | {"theta_C": fine})
    assert (found.code, found.severity) == ("constant theta_C", "error")
    assert "a run with the parameters of the start moves it by 0." in found.message
    assert looked_at(one, runs["rolling"], SENSORS | {"theta_C": coarse}) == []


@pytest.mark.parametrize("motion", MOTIONS)
def test_nothing_is_said_of_what_is_right(recordings, runs, motion):
    """With a start that is off by a factor of three, with fewer sensors, and with faults that were
    declared."""
    one, run = recordings[motion], runs[motion]
    assert looked_at(one, run) == []
    assert looked_at(changed(one, **NO_F), run) == []
    assert looked_at(changed(one, x_Br=None, y_Br=None), run) == []
    declared = SENSORS | {
        "x_Br": Sensor(noise=1e-5, bias=1e-4), "theta_C": Sensor(noise=5e-4, bias=0.1, delay=0.08),
        "effort_x": Sensor(noise=0.1, delay=6e-3), "effort_y": Sensor(noise=0.1, gain=0.2),
    }  # fmt: skip
    faulty = changed(
        one,
        x_Br=lambda t, x: x + 40e-6,
        theta_C=lambda t, y: late(60e-3)(t, y) + 0.02,
        effort_x=late(5e-3),
        effort_y=scaled(1.15),
    )
    assert looked_at(faulty, run, declared) == []


def test_gains_that_are_unknown_still_leave_a_sign_and_a_set_point_to_the_run(
    recordings,
):
    flipped = changed(recordings["rolling"], effort_y=scaled(-1))
    assert list(controller_findings(flipped, SENSORS))
    assert not list(controller_findings(flipped, SENSORS, GAINS))
    for one, code in (
        (flipped, "sign of effort_y"),
        (noted(recordings["rolling"], {"control.senses": "disc.x"}), SETPOINT),
    ):
        problem = Problem([one], SENSORS, {name: Unknown() for name in GAINS})
        assert [f.code for f in precheck(problem, Runner(problem.recordings))] == [code]


def test_recordings_are_checked_where_assumptions_are_trusted(recordings):
    flipped = changed(recordings["rolling"], effort_y=scaled(-1))
    with pytest.raises(ValueError, match="effort_y looks as if its sign were opposite"):
        identify(Problem([flipped], SENSORS, {E: Unknown()}), rtol=1e-3, assumptions="trusted")


def test_a_law_of_several_coordinates_is_compared_with_its_effort_or_the_gap_is_named(
    recordings,
):
    one = recordings["rolling"]
    rig: Any = deepcopy(one.rig)
    loop = rig.actuators["x"]

    def both(w: Any, w_dot: Any, feed: Any, q: Any, q_dot: Any) -> Any:
        return loop.law(w[..., 0], w_dot[..., 0], feed, q[..., 0], q_dot[..., 0]) + 0.0 * q[..., 1]

    rig.actuators["x"] = Actuator(
        [loop.measured, "disc.theta"], loop.pushes, both, setpoint=[loop.setpoint]
    )
    same = replace(one, rig=rig)
    assert not list(controller_findings(same, SENSORS))
    more = changed(same, effort_x=lambda t, F: F + 20.0)
    assert [f.code for f in controller_findings(more, SENSORS)] == ["loop of effort_x"]
    assert (
        "effort_x is +20 N more, on the average,"
        in next(controller_findings(more, SENSORS)).message
    )
    (note,) = controller_findings(changed(same, theta_C=None), SENSORS)
    assert note.severity == "note"
    assert (
        "effort_x is not compared with its controller, since theta_C is not recorded"
        in note.message
    )


def test_coloured_noise_is_no_mistake(recordings, runs):
    """First-order autoregressions of 0.9, where the fit does not know it."""
    rng = np.random.default_rng(0)
    for motion, one in recordings.items():
        for _ in range(3):
            samples = {
                name: (
                    t,
                    y
                    + lfilter([0.43], [1, -0.9], SENSORS[name].noise * rng.standard_normal(len(t))),
                )
                for name, (t, y) in one.samples.items()
            }
            assert looked_at(replace(one, samples=samples), runs[motion]) == []


def test_gaps_and_other_rates_of_samples_are_no_mistake(recordings, runs):
    """A force with a hole in it, and a camera at 50 Hz."""
    one, samples = recordings["rolling"], dict(recordings["rolling"].samples)
    t, F = samples["effort_x"]
    there = (t < 0.4) | (t > 0.5)
    samples |= {"effort_x": (t[there], F[there]), "x_C": tuple(x[::4] for x in samples["x_C"])}
    assert looked_at(replace(one, samples=samples), runs["rolling"]) == []


def at_rows(recording: Recording, rate: float, *, rates: bool = False) -> Recording:
    """With a reference that is known at `rate` [Hz]."""
    t = torch.arange(0.0, recording.duration + 0.5 / rate, 1 / rate, dtype=torch.float64)
    d = recording.rig.reference(t, ("x_d", "y_d", "F_ff")).detach()
    x_d, y_d, F_ff = (Sampled(t, d[:, i, 0], d[:, i, 1] if rates else None) for i in range(3))
    return noted(recording, x_d=x_d, y_d=y_d, F_ff=F_ff)


@pytest.mark.parametrize("rates", [False, True])
def test_sparse_set_points_are_told_by_what_they_do(recordings, rates):
    """The estimate from the rows alone against what the exact set-points would have had the
    controller do."""
    one, exact = recordings["shaking"], recordings["shaking"].rig.reference
    actuator = one.rig.actuators["x"]
    for rate in (200.0, 500.0):
        sparse = at_rows(one, rate, rates=rates)
        t = torch.linspace(0.05, 0.85, 4001, dtype=torch.float64)
        signals = [d(t, ("x_d",)).detach()[:, 0] for d in (sparse.rig.reference, exact)]
        zero = torch.zeros_like(t)
        efforts = [
            actuator(torch.stack((*d.unbind(-1), zero, zero, zero), -1)).detach() for d in signals
        ]
        real = float((efforts[0] - efforts[1]).square().mean().sqrt())
        told = {gap.channel: gap for gap in gaps(sparse, SENSORS, "x")}["effort_x"]
        assert 0.5 * real < told.error < 2.5 * real
        assert told.noises == told.error / SENSORS["effort_x"].noise
        assert 2.5 < told.order <= 4.0
    enough, few, hardly = (
        list(setpoint_findings(at_rows(one, rate, rates=rates), SENSORS))
        for rate in (500.0, 100.0, 30.0)
    )
    assert enough == []
    (said,) = [f for f in few if f.code == "set-points x_d"]
    assert "set-points x_d every 10 ms are too sparse for this motion" in said.message
    assert ("no column x_d_dot" in said.message) == (not rates)
    assert said.severity == "warning"
    assert any(f.code == "set-points x_d" and f.severity == "error" for f in hardly)


def test_a_rate_that_is_not_that_of_its_set_point_is_named(
    recordings,
):
    one = at_rows(recordings["rolling"], 500.0, rates=True)
    x_d = one.rig.reference["x_d"]
    for factor, words in ((-1.0, "its sign looks opposite"), (1e3, "it is 1e+03 times that")):
        other: Any = Sampled(x_d.times, x_d.values.detach(), factor * x_d.rates)
        (found,) = setpoint_findings(noted(one, x_d=other), SENSORS)
        assert found.code == "rate of x_d"
        assert found.severity == "error"
        assert "x_d_dot is not the rate of x_d" in found.message
        assert words in found.message


def test_a_clock_that_is_off_is_no_reason_for_closer_rows(recordings):
    one = at_rows(recordings["shaking"], 1000.0, rates=True)
    x_d = one.rig.reference["x_d"]
    other: Any = Sampled(1.001 * x_d.times, x_d.values.detach(), x_d.rates)
    found = list(setpoint_findings(noted(one, x_d=other), SENSORS))
    assert [f.code for f in found] == ["rate of x_d"]
    assert "is a clock, or a unit of time, a little off?" in found[0].message


def test_findings_of_a_kind_are_said_once_and_refused_unless_they_are_meant():
    found = together([
        Diagnostic("error", "a", "F_x looks wrong", "sign of F_x"),
        Diagnostic("warning", "a", "F_y is off", "loop of F_y"),
        Diagnostic("error", "b", "F_x looks wrong too", "sign of F_x"),
    ])  # fmt: skip
    assert [f.code for f in found] == ["sign of F_x", "loop of F_y"]
    assert found[0].message == "F_x looks wrong; so it is in `b`"
    with pytest.raises(ValueError, match=r'if it is so, say acknowledged = \["sign of F_x"\]'):
        accepted(found, [])
    with pytest.raises(
        ValueError,
        match=r"called 'nonsense', so leave it out; what was found is sign of F_x, loop of F_y$",
    ):
        accepted(found, ["sign of F_x", "nonsense"])
    with pytest.raises(
        ValueError,
        match=r"^acknowledged: nothing was found that is called 'nonsense', .* nothing looks "
        r"wrong$",
    ):
        accepted([], ["nonsense"])
    first, second = accepted(found, ["sign of F_x"])
    assert first == "F_x looks wrong; so it is in `b` (acknowledged)"
    assert second == "F_y is off"
