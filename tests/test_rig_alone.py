"""What `check` says of a body on one pad: pressed, fallen onto it, dragged over it, out of its
reach. Gives in comments are those of runs."""

import re
from typing import Any

import pytest

from torchsoft import RigFile
from torchsoft.rigs.check import check

RUBBER = {"kind": "kelvin_voigt", "E": 0.75e6, "nu": 0.45, "tau": 10e-3, "depth": 44e-3}
GEL = RUBBER | {"E": 0.15e6, "tau": 3e-3}
DISC = {"kind": "circle", "radius": 20e-3}
TALL = {"kind": "rounded_box", "half_width": 10e-3, "half_height": 20e-3, "radius": 3e-3}
FRICTION = {"kind": "smooth", "mu_s": 0.8, "mu_k": 0.7, "v_s": 0.05}
X = {"pushes": "disc.x", "setpoint": "x_d", "Kp": 1e5, "Kd": 400.0}
Y = {"pushes": "disc.y", "feed_forward": "press"}


def ramp(since: float, until: float, *values: Any) -> dict[str, Any]:
    return {"kind": "profile", "times": (since, until), "values": values}


def on_one_pad(
    start: dict[str, Any], material: dict[str, Any] = RUBBER, height: float = 5e-3,
    **others: Any,
) -> RigFile:  # fmt: skip
    """A body of 0.4 kg on or over a pad of 160 mm on the ground."""
    body = {"mass": 0.4, "shape": DISC, "start": start} | others.pop("disc", {})
    pad = {
        "material": "rubber", "length": 160e-3, "height": height, "elements_x": 80,
        "elements_y": 2, "origin": (-80e-3, 0.0),
    }  # fmt: skip
    springs = {"K_n": 1.2e5, "R_n": 400.0, "K_t": 1.2e5, "R_t": 400.0}
    return RigFile.model_validate(
        {
            "bodies": {"disc": body}, "materials": {"rubber": material}, "pads": {"ground": pad},
            "laws": {"dry": {**springs, "friction": FRICTION}},
            "contacts": {"ground": {"pad": "ground", "body": "disc", "law": "dry"}},
            "outputs": {"duration": 0.6}, **others,
        }
    )  # fmt: skip


def dragged(press: float, far: float = 20e-3, **disc: Any) -> RigFile:
    motion = {"x_d": ramp(0.3, 0.5, "start", far), "press": ramp(0.0, 0.3, 0.0, -press)}
    start = {"x": 0.0, "y": "rest"}
    return on_one_pad(start, disc=disc, actuators={"x": X, "y": Y}, motion=motion)


def pressed(force: float) -> RigFile:
    motion = {"press": ramp(0.0, 0.3, 0.0, -force)}
    return on_one_pad({"x": 0.0, "y": "rest"}, actuators={"y": Y}, motion=motion)


def inclined() -> RigFile:
    """A block on a pad of a table that is inclined until it slides off, at 21.8 degrees."""
    box = {"kind": "rounded_box", "half_width": 20e-3, "half_height": 5e-3, "radius": 4e-3}
    pad = {
        "material": "rubber", "base": "table", "length": 120e-3, "height": 6e-3, "elements_x": 60,
        "elements_y": 2, "origin": (-60e-3, 0.0),
    }  # fmt: skip
    block = {"mass": 0.3, "shape": box, "start": {"x": 0.0, "y": "rest"}}
    friction = {"kind": "coulomb", "mu_s": 0.4, "mu_k": 0.4}
    springs = dict.fromkeys(("K_n", "R_n", "K_t", "R_t"), "auto")
    return on_one_pad(
        {}, bodies={"disc": block, "table": {"x": 0.0, "y": 0.0, "theta": "driven"}},
        pads={"ground": pad}, laws={"dry": {**springs, "friction": friction}},
        motion={"table.theta": ramp(0.2, 4.2, 0.0, 0.5)}, outputs={"duration": 5.0},
    )  # fmt: skip


CASES: dict[str, tuple[RigFile, str, str]] = {
    "pressed": (pressed(600.0), "pads.ground", "leaves linear elasticity: at t = 0.3 s"),  # 48 %
    "pressed a little": (pressed(50.0), "", ""),  # 11 %
    "fallen": (
        on_one_pad({"x": 0.0, "y": 60e-3}, GEL, 12e-3, disc={"mass": 1.0}),
        "pads.ground", "`disc` comes onto `ground` with 0.7",
    ),  # 31 %
    "fallen lightly": (
        on_one_pad({"x": 0.0, "y": 60e-3}, GEL, 12e-3, disc={"mass": 0.1}), "", "",
    ),  # 10 %
    "thrown": (
        on_one_pad({"x": 0.0, "y": 60e-3, "v_y": -3.0}, RUBBER | {"tau": 1e-3}),
        "bodies.disc", "`disc` comes onto `ground` with 3.1.* m/s, and a trial fails",
    ),  # Newton does not converge
    "thrown away": (on_one_pad({"x": 0.0, "y": 60e-3, "v_x": 3.0}, GEL, 12e-3), "", ""),
    "dragged": (dragged(100.0, theta=0.0), "pads.ground", "is dragged over it by 20 mm"),  # 61 %
    "dragged lightly": (dragged(10.0, theta=0.0), "", ""),  # 10 %
    "dragged a little": (dragged(100.0, 0.1e-3, theta=0.0), "", ""),  # 16 %
    "rolled": (dragged(50.0), "", ""),  # 11 %
    "tipped": (dragged(60.0, shape=TALL), "bodies.disc", "friction tips it onto an edge"),  # 45 %
    "out of reach": (
        on_one_pad({"x": 0.0, "y": 0.525}), "bodies.disc", "outside the space over the pad",
    ),  # lost at t = 0
    "inclined": (inclined(), "", ""),  # slides off
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_one_pad_is_checked_as_its_run_ends(name):
    file, where, sentence = CASES[name]
    found = [one for one in check(file) if one.severity != "note"]
    assert [one.where for one in found] == [where] * bool(where)
    for one in found:
        assert one.severity == ("error" if name == "out of reach" else "warning")
        assert re.search(sentence, one.message)
