"""Excitations: motions of any rig that grasps, in place of two of its own."""

import math
from typing import Any

import numpy as np
import pytest
from conftest import f64

from torchsoft import BuiltRig, RigFile
from torchsoft.rigs.excite import CATALOGUE, GRIP, OFF_NODE, SINCE, Excitation, excite

RIGS = (
    "paper",
    "light_grasp",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("ellipse", "rounded_box")),
)
COARSE = {"elements_x": 40, "elements_y": 1}
ROLL = {"kind": "profile", "times": [0.5, 0.8], "values": [0.0, 4e-3], "offset": "start"}


def coarse(name: str) -> RigFile:
    file = RigFile.ready(name)
    return file.override(pads=dict.fromkeys(file.pads, COARSE))


def followed(built: BuiltRig, *times: float) -> dict[str, list[float]]:
    """Values of the motions at these times."""
    values = built.rig.follow(f64(*times))[..., 0].T.tolist()
    return dict(zip(built.rig.signals, values))


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_entry_of_the_catalogue_builds(name):
    one = CATALOGUE[name]
    built = excite(coarse("paper"), name).build()
    assert float(built.t[-1]) == one.duration
    values = followed(built, *built.t.tolist())
    heights = values["y_d"]
    assert heights[0] - heights[40] == pytest.approx(one.depth - GRIP, abs=1e-12)
    assert all(math.isfinite(x) for row in values.values() for x in row)
    moved = max(values["x_d"]) - min(values["x_d"])
    assert moved > 1e-3
    assert values["x_d"][:50] == pytest.approx([values["x_d"][0]] * 50, abs=1e-12)  # the grasp


@pytest.mark.parametrize("rig", RIGS)
def test_a_rig_that_grasps_is_excited(rig):
    """Its bracket begins in a light grip, comes down to the depth from the touch and moves to the
    side by its own loop, and the force that holds it is fed forward."""
    file = coarse(rig)
    before = file.bodies["bracket"].start
    changed = excite(file, Excitation(ROLL, duration=1.0, depth=1e-3))
    assert changed.actuators["x"].measured == "bracket.x"
    built = changed.build()
    state = built.rig.unpack(built.y0)
    x, y, _ = state.pose["bracket"].tolist()
    (upper,) = (one for one in built.rig.contacts if built.rig.pads[one].base == "bracket")
    assert 0.0 < built.rig.penetration(upper, state).max().item() < GRIP
    assert x == pytest.approx(before.x + OFF_NODE)
    body = built.rig.contacts[upper].body
    assert state.pose[body][0].item() == pytest.approx(file.bodies[body].start.x + OFF_NODE)
    values = followed(built, 0.0, 0.375, SINCE, 0.8, 1.0)
    assert values["y_d"] == pytest.approx([y, *[y + GRIP - 1e-3] * 4], abs=1e-15)
    assert values["x_d"] == pytest.approx([x, x, x, x + 4e-3, x + 4e-3], abs=1e-15)
    held = built.rig.state({body: {"x": state.pose[body][0].item(), "y": "rest"},
                            "bracket": {"x": x, "y": {"depth": 1e-3}}})  # fmt: skip
    light, force = (
        float(one.pads[upper][0][:, 1].detach().sum()) for one in (state, built.rig.unpack(held))
    )
    assert values["F_ff"] == pytest.approx([-light, *[-force] * 4], rel=1e-6)
    assert changed.names.keys() == file.names.keys()
    assert changed.materials == file.materials


def test_a_loop_may_sense_the_manipulated_body():
    """Then nothing is moved off the nodes."""
    file = coarse("paper")
    changed = excite(file, "strokes", senses="disc")
    assert changed.actuators["x"].measured == "disc.x"
    assert changed.bodies["disc"].start.x == changed.bodies["bracket"].start.x == 60e-3
    assert excite(file, "strokes").actuators["x"].measured == "bracket.x"


def test_shaking_is_along_and_across():
    """By phases of their own, from the seeds."""
    file = coarse("paper")
    times = [0.01 * i for i in range(50, 200)]
    one, again = (followed(excite(file, "shaking").build(), *times) for _ in range(2))
    assert one == again
    x, y = (np.subtract(one[name], one[name][0]) for name in ("x_d", "y_d"))
    assert 1e-3 < abs(x).max() <= 10e-3
    assert 2e-5 < abs(y).max() <= 2e-4
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.9


# rejections
# ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rig", "how", "words"),
    [
        ("two_fingers", {}, "left and right do; set `body` to one of them"),
        ("drop", {}, "across the pad and along it: none does"),
        ("paper", {"body": "disc"}, "along it: none does"),
    ],
)
def test_a_rig_without_one_body_that_grasps_is_rejected(rig, how, words):
    with pytest.raises(ValueError, match=r"needs a body with a pad that two loops move") as error:
        excite(RigFile.ready(rig), "strokes", **how)
    assert words in str(error.value)


def test_one_of_two_fingers_is_excited():
    """The left one presses to the right, and moves upwards."""
    file = RigFile.ready("two_fingers")
    changed = excite(file, Excitation(ROLL, depth=5e-3, duration=1.0), body="left")
    assert changed.motion["left_close"].values == (0.0, 5e-3)
    assert changed.motion["left_lift"].values == (0.0, 4e-3)
    assert changed.motion["right_close"] == file.motion["right_close"]
    assert excite(file, "slow roll", body="right").motion["right_close"].values == (0.0, -1.4e-3)


@pytest.mark.parametrize(
    ("roll", "duration", "message"),
    [
        ({"kind": "multi_sine", "amplitude": 1e-3, "band": [0.5, 1e5]}, 9.0,
         "motion.x_d has more than 100000 periods"),
        ({"kind": "strokes", "travel": 1e-3, "stroke_time": 1e-5}, 9.0,
         "motion.x_d.stroke_time = 1e-05 s makes 850000 strokes"),
    ],
)  # fmt: skip
def test_an_impossible_excitation_is_rejected_by_its_field(roll: Any, duration, message):
    with pytest.raises(ValueError, match=message):
        excite(coarse("paper"), Excitation(roll, duration=duration)).build()
