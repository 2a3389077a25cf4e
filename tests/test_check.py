"""What `check` reports of a rig: impossible files, rigs that make no sense, and what a run at a
loose tolerance does to pads and bodies."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from test_rig_parts import changed, coarse_tree

from torchsoft import RigFile
from torchsoft.rigs.check import check

# one pad and one body
# ----------------------------------------------------------------------

BALL = '{kind = "circle", radius = 5e-3}'
SLIP = '{kind = "smooth", mu_s = 0.8, mu_k = 0.7, v_s = 0.05}'
DRY = f"{{K_n = 1.2e5, R_n = 400.0, K_t = 1.2e5, R_t = 400.0, friction = {SLIP}}}"
ONE_PAD = f"""
[bodies.disc]
mass = 0.4
shape = {{kind = "circle", radius = 20e-3}}
start = {{x = 0.0, y = "rest"}}
[materials.rubber]
kind = "kelvin_voigt"
E = 0.75e6
nu = 0.45
tau = 10e-3
depth = 44e-3
[pads.ground]
material = "rubber"
length = 160e-3
height = 5e-3
elements_x = 80
elements_y = 2
origin = [-80e-3, 0.0]
[laws]
dry = {DRY}
[contacts]
ground = {{pad = "ground", body = "disc", law = "dry"}}
[outputs]
duration = 0.6
"""
"""A disc on a pad of 160 mm on the ground."""

FLAT = "bodies.disc.theta = 0.0\n"
TALL = """
[bodies.disc.shape]
kind = "rounded_box"
half_width = 10e-3
half_height = 20e-3
radius = 3e-3
"""
HIGH = "bodies.disc.start.y = 60e-3\n"
GEL = "materials.rubber = {E = 0.15e6, tau = 3e-3}\npads.ground.height = 12e-3\n"


def press(force: float) -> str:
    """The disc is pressed by a force [N]."""
    return f"""
actuators.y = {{pushes = "disc.y", feed_forward = "press"}}
motion.press = {{kind = "profile", times = [0.0, 0.3], values = [0.0, {-force}]}}
"""


def drag(far: float) -> str:
    """It is dragged along by so much [m]."""
    return f"""
actuators.x = {{pushes = "disc.x", setpoint = "x_d", Kp = 1e5, Kd = 400.0}}
motion.x_d = {{kind = "profile", times = [0.3, 0.5], values = ["start", {far}]}}
"""


def on_one_pad(changes: str) -> RigFile:
    return RigFile.from_tree(changed(tomllib.loads(ONE_PAD), tomllib.loads(changes)))


ALONE = {
    "pressed": (press(600.0), r"warning: pads.ground: .*compressed by 48%"),
    "pressed a little": (press(50.0), ""),
    "fallen": (HIGH + GEL + "bodies.disc.mass = 1.0",
               r"warning: pads.ground: .*at t = 0\.085\d s it is compressed by 3\d%"),
    "fallen lightly": (HIGH + GEL + "bodies.disc.mass = 0.1", ""),
    "thrown": (HIGH + "bodies.disc.start.v_y = -3.4\nmaterials.rubber.tau = 1e-3",
               r"error: pads.ground: .*at t = 0\.01\d* s it is compressed by 5\d%"
               r"|warning: solver: .*ends early|warning: pads.ground: .*compressed"),
    "thrown away": (HIGH + GEL + "bodies.disc.start.v_x = 3.0",
                    r"warning: bodies.disc: the run ends early: at t = 0\.02.* it left the space"),
    "dragged": (press(100.0) + drag(20e-3) + FLAT,
                "warning: pads.ground: .*friction shears it by 6.% of its height, and"),
    "dragged lightly": (press(10.0) + drag(20e-3) + FLAT, ""),
    "rolled": (press(50.0) + drag(20e-3), ""),
    "tipped": (press(60.0) + drag(20e-3) + TALL,
               "warning: pads.ground: .*friction shears it by "),
    "out of reach": ("bodies.disc.start.y = 0.525",
                     "error: bodies.disc: .*at t = 0.* it left the space over the pad `ground`"),
    "dragged off": (press(10.0) + drag(100e-3) + FLAT,
                    "warning: bodies.disc: .*at t = 0.42.* reached the end of the pad"),
}  # fmt: skip


@pytest.mark.parametrize("name", ALONE)
def test_one_pad_is_judged_by_its_run(name):
    changes, expected = ALONE[name]
    found = [str(one) for one in check(on_one_pad(changes)) if one.severity != "note"]
    assert bool(found) == bool(expected)
    assert len(found) < 2 or "solver" in found[0], found
    assert all(re.search(expected, one) for one in found), found


# the template, changed
# ----------------------------------------------------------------------

STONE = f"bodies.stone = {{x = 0.3e-3, y = 30e-3, theta = 0.0, shape = {BALL}}}"
STEPS = "".join(f"{0.01 * i},{round(0.03 * i, 1)}\n" for i in range(250))


def csv(text: str) -> str:
    """The motion x_d from a file with this content."""
    return f'''
motion.x_d = {{kind = "csv", file = "x.csv", column = "x_d"}}
"x.csv" = """
{text}"""
'''


def square(radius: float) -> str:
    shape = f'{{kind = "rounded_box", half_width = 20e-3, half_height = 20e-3, radius = {radius}}}'
    return f'{{shape = {shape}, start = {{theta = "rest"}}}}'


BOX, UPRIGHT = square(3e-3), "{theta = 0.0}"


def moved(disc: str, far: float, press: float, mu: float = 0.7) -> str:
    """The template's pads moved along the disc."""
    return f"""
bodies.disc = {disc}
motion.x_d.values = ["start", {far}]
motion.press.values = [0.0, {press}]
laws.dry.friction = {{mu_s = {mu}, mu_k = {mu}}}
"""


REPORTED = {
    # what no file may say
    "freedom": ('bodies.bracket.theta = "locked"',
        r'bodies\.bracket\.theta: should be "free", "driven" or a number'),
    "no mass": ("bodies.rod.start = {x = 0.0, y = 0.1}",
        r"bodies\.rod: mass is missing, but x and y"),
    "no start": ("bodies.rod = {mass = 1.0, theta = 0.0, start = {x = 0.0}}",
        r"rod: start\.y is missing: y is free"),
    "start of what is fixed": ("bodies.bracket.start.theta = 0.1",
        r"bodies\.bracket: start\.theta has no meaning"),
    "no such base": ('pads.upper.base = "braket"', r"pads\.upper\.base: .* `braket` .* is disc"),
    "pad on its own body": ('pads.lower.base = "disc"',
        r"contacts\.lower: the pad `lower` is bonded to the body `disc`"),
    "nothing to touch with": ('contacts.lower.body = "bracket"',
        r"contacts\.lower\.body: `bracket` has no shape"),
    "no such motion": ('actuators.x.setpoint = "w"', r"motion\.w is missing: .* of bracket\.x"),
    "motion of nothing": ('motion.wave.kind = "hold"', r"motion\.wave: nothing follows it"),
    "law of nothing": (f"laws.wet = {DRY}",
        r"laws\.wet: no contact follows it; name it as the law"),
    "two units": ('actuators.y.feed_forward = "x_d"',
        r"motion\.(x_d would be in two units|press: nothing)"),
    "two steps": ("solver = {step = 1e-3, rtol = 1e-4}", r"solver: step and rtol .*each say"),
    "two masses": ("bodies.disc = {density = 7800.0, depth = 1e-2}",
        r"mass and density each say how heavy it is; give one"),
    "no density": ("bodies.disc.depth = 1e-2", r"density is missing: depth is given"),
    "two moduli": ("materials.rubber.shore_a = 30", r"E and shore_a each say how stiff it is"),
    "inertial": ("pads.lower.inertial = true\nmaterials.rubber = "
        '{kind = "prony", E = 0.75e6, depth = 44e-3, moduli = [1e5], tau = [0.1]}',
        r"lower\.inertial: an inertial pad has one retardation time"),
    # what cannot be built
    "loop over nothing": ('actuators.x = {measures = "disc.theta", Kp = 1000.0, Kd = 4.0}',
        "nothing that touches ties disc.theta"),
    "memory": ('pads.lower = {kind = "fingertip", material = "rubber", radius = 1e-2, '
        "elements_around = 4000}", r"elements_around = 4000 take about"),
    "no mesh": ('"x.csv" = "x"\npads.lower = '
        '{kind = "mesh", material = "rubber", unit = "mm", file = "x.csv"}',
        r"error: pads\.lower\.file:"),
    "program": ('actuators.x.network = "law.pt"',
        r"error: actuators\.x\.network: .*law\.pt is not an \.npz file: weights are data"),
    "no file": ('motion.x_d = {kind = "csv", file = "x.csv", column = "x_d"}',
        r"error: motion\.x_d\.file: .*x\.csv: No such"),
    "start of an effort": ('motion.press.values = ["start", -30.0]',
        r'error: motion\.press\.values: "start" stands for where the one free'),
    "no time for waves": ('motion.x_d = {kind = "sines", since = 1.9, '
        "components = [{amplitude = 1e-3, frequency = 5.0}]}",
        r"error: motion\.x_d\.since = 1\.9 s leaves 0\.1 s until 2 s, but waves take 0\.3 s"),
    "no pad below": ("bodies.disc.start.x = 0.1",
        r'bodies\.disc\.start\.y: "rest", but no pad'),
    "between points": ("bodies.disc.shape.radius = 1e-5",
        r"error: bodies\.disc\.start\.y: 0\.02 mm wide, it falls between points of `lower`"),
    "too stiff": ("laws.dry.K_n = 1e9",
        r"error: laws\.dry\.K_n: no rest .* 1e\+09 N/m, .* take 4e\+05 N/m or less"),
    "too heavy": ("bodies.disc.mass = 400.0",
        r"error: bodies\.disc\.start\.y: .*no rest under its weight of 3\.92e\+03 N is found"),
    # what will not go well
    "overlap": (STONE,
        r"error: bodies\.disc: it and bodies\.stone overlap by .* mm at t = 0 s"),
    "no room": ('motion.y_d.values = ["start", 40e-3]',
        r"warning: pads\.upper: .*it is compressed by 4\d%"),
    "not carried": (f"bodies.ball = {{mass = 0.1, shape = {BALL}, start = {{x = 0.0, y = 0.1}}}}",
        r"error: bodies\.ball: nothing carries it: it has no contact with any pad"),
    "beside the pad": ("bodies.disc.start = {x = 0.1, y = 0.03}",
        r"error: bodies\.disc: nothing carries it: no pad that it has a contact with lies under"),
    "never touches": ('motion = {y_d.values = ["start", 50.05e-3], press.values = [0.0, 0.0]}',
        r"warning: contacts\.upper: `upper` never touches `disc`"),
    "lets go": ('motion.y_d = {times = [0.0, 0.4, 1.0], values = ["start", 49e-3, 72e-3]}',
        r"note: contacts\.upper: `upper` lets go of `disc`: they touch last at t = 0\.5"),
    "a meganewton": ("motion.press.values = [0.0, -1e6]",
        r"error: bodies\.disc: the run ends early: at t = 0\.04.* down to its bonded base; press"),
    "through the disc": ('motion.y_d.values = ["start", -0.05]',
        r"error: bodies\.disc: the run ends early: at t = 0\.15.* down to its bonded base"),
    "pads beside a thin rod": ("""
bodies.disc = {shape = {kind = "circle", radius = 1.5e-3}, start = {y = "rest"}}
bodies.bracket.start.y = 13.1e-3
motion.y_d.values = ["start", 9.9e-3]
motion.press.values = [0.0, -80.0]
motion.x_d.values = ["start", "start"]""",
        r"error: pads\.lower: it and pads\.upper overlap by 0\.\d* mm at t = "),
    "unstable": ("""
materials.rubber.tau = 1e-4
bodies.bracket.start.y = 49.5e-3
actuators.x = {measures = "disc.x", Kp = 1e6, Kd = 10.0}
motion.y_d = {kind = "hold"}""", r"the rig is unstable at t = "),
    "jump, corners, steps, slip, outputs": (f"""
bodies.disc = {square(5e-4)}
solver.step = 0.05
laws.dry.friction.v_s = 1e-4
[motion.x_d]
kind = "chirp"
amplitude = 1e-3
first = 1.0
last = 50.0
values = [10e-3]""",
        r"warning: motion\.x_d: it begins at 0\.01 m, but .* `actuators\.x` pushes with 1e\+03",
        r"warning: bodies\.disc\.shape: its sharpest corner has a radius of 0\.5 mm",
        r"warning: solver\.step: steps of 0\.05 s are too coarse: motion\.y_d goes",
        r"warning: laws\.dry\.friction: slip is not single-valued",
        r"warning: outputs\.interval: outputs every 0\.01 s .* up to 50 Hz; take 0\.005 s"),
    "cannot roll": (moved(BOX, 20e-3, -30.0), "warning: pads.upper: .*friction shears it by 9.%"),
    "cannot roll, pressed": (moved(UPRIGHT, 20e-3, -200.0),
        "warning: pads.lower: .*friction shears it by 5.% of its height, and",
        "warning: pads.upper: .*friction shears it by 5.%"),
    # recorded motions
    "early end": (csv("t [s],x_d [mm]\n0,0\n1,1\n"), r"x\.csv ends at 1 s, .* lasts until 2 s"),
    "no column": (csv("t [s],x [mm]\n0,0\n1,1\n"),
        r"no column `x_d \[m\]`, in this unit .*; it has `t`, `x`; .* in `column`"),
    "a gap": (csv("t [s],x_d [mm]\n0,0\n1,\n"), r"row 3, column `x_d` is empty"),
    "backwards": (csv("t [s],x_d [mm]\n1,0\n0,1\n"), r"row 3, .* 0 s follows 1 s; times must incr"),
    "a clock": (csv("t [s],x_d [mm]\n1.7e9,0\n1.7000001e9,1\n"),
        r"begins at 1\.7e\+09 s, and the run ends at 2 s: .* set from_first = true"),
    "an encoder, strain": (
        csv(f"t [s],x_d [mm]\n{STEPS}") + 'motion.y_d.values = ["start", 44e-3]',
        r"warning: motion\.x_d\.file: .*in steps of 0\.0001 m, as of an encoder: .*0\.01 m/s",
        r"warning: pads\.\w+: the strain leaves linear elasticity: at"),
    "milliseconds": (csv("t [s],x_d [m]\n0,0\n1000,1e-3\n2000,0\n"),
        r"warning: motion\.x_d\.file: .*lasts 2000 s.*millisec"),
    "millimetres": (csv("t [s],x_d [m]\n0,0\n1,12\n2,0\n"),
        r"warning: bodies\.disc: the run ends early: at t = 0\.0\d+ s `disc` was lost: it left"),
}  # fmt: skip
"""Changes of the template, with the content of a file that it names, and what is reported."""


def reported(changes: str, folder: Path) -> list[str]:
    """Findings on the template, changed, or the error with which it is rejected."""
    tree = tomllib.loads(changes)
    if "x.csv" in tree:
        (folder / "x.csv").write_text(tree.pop("x.csv"), encoding="utf-8")
    try:
        file = RigFile.from_tree(changed(coarse_tree(), tree), folder)
        return [str(one) for one in check(file)]
    except ValueError as error:
        return [f"error: {error}"]


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    found = reported("", tmp_path_factory.mktemp("quiet"))
    assert all(one.startswith("note: ") for one in found)
    return "\n".join(found)


@pytest.mark.parametrize("name", REPORTED)
def test_what_is_wrong_is_reported_with_its_field(name, quiet, tmp_path):
    changes, *expected = REPORTED[name]
    found = reported(changes, tmp_path)
    for one in expected:
        assert any(re.search(one, finding) for finding in found), found
        assert not re.search(one, quiet)


@pytest.mark.parametrize(
    "changes",
    [
        moved(UPRIGHT, 20e-3, -30.0),
        moved(BOX, 2e-3, -30.0),
        moved(BOX, 20e-3, -30.0, mu=0.2),  # it slides
        moved("{}", 20e-3, -300.0),  # it rolls
    ],
)
def test_pads_that_are_moved_gently_are_not_warned_about(changes, tmp_path):
    assert not [one for one in reported(changes, tmp_path) if one.startswith(("warn", "err"))]


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"0.weight": np.zeros((1, 3)), "0.bias": np.zeros(1)}, r"0\.weight has .* \(1, 3\)"),
        ({"0.weight": np.zeros((600, 4)), "0.bias": np.zeros(600)}, "more than 2000 numbers"),
        ({"0.weight": np.array([object()]), "0.bias": np.zeros(1)}, "no.* file of numbers: Object"),
    ],
)
def test_weights_that_are_no_network_are_reported(tmp_path, arrays, expected):
    np.savez(tmp_path / "law.npz", allow_pickle=True, **arrays)
    (found,) = reported('actuators.x.network = "law.npz"', tmp_path)
    assert re.search(rf"^error: actuators\.x\.network: .*{expected}", found), found


def test_a_loop_that_is_about_to_close_is_not_judged():
    """The bracket does not hold the disc yet, so that the loop over both is unstable there."""
    file = RigFile.ready("paper")
    file = file.override({"pad.elements_x": 60, "pad.elements_y": 2})
    ready = file.build()
    top = float(ready.rig.unpack(ready.y0).pose["bracket"][1])
    found = check(file.override({"bodies.bracket.start.y": top + 5e-5}))
    assert [str(one) for one in found if one.severity != "note"] == []


@pytest.mark.parametrize(("step", "is_coarse"), [(1.5e-3, False), (3e-3, True)])
def test_steps_are_held_against_the_modes(step, is_coarse):
    """With less damping the paper's loops swing with 600 rad/s: five steps a period are 2 ms."""
    less = {"pad.tau": 2e-3, "pad.elements_x": 60, "pad.elements_y": 2}
    less |= {"outputs.duration": 1.0, "outputs.snapshots": []}
    file = RigFile.ready("paper").override(less, solver={"step": step})
    swings = [one for one in check(file) if "a mode of the rig swings with" in one.message]
    assert bool(swings) == is_coarse


def test_a_body_that_falls_freely_asks_for_finer_steps():
    """It comes down with sqrt(2 g h), though it starts at rest."""
    file = on_one_pad(HIGH + GEL + "bodies.disc.mass = 0.1\nsolver.step = 0.05")
    (found,) = (one for one in check(file) if "a body comes flying" in one.message)
    assert re.search(r"take 0\.006[789] s or less", found.message)  # a quarter of its radius


def test_a_long_run_is_checked_until_it_takes_too_long():
    """Shaken quickly for minutes; the time until which it was checked is reported."""
    shake = {"kind": "chirp", "amplitude": 1e-3, "first": 20.0, "last": 20.0}
    file = RigFile.from_tree(coarse_tree()).override(
        motion={"x_d": shake}, outputs={"duration": 300.0, "interval": 0.01}
    )
    (found,) = (one for one in check(file) if one.where == "solver")
    assert found.severity == "note"
    assert re.search(r"what happens after t = \d+(\.\d+)? s is not checked", found.message)
