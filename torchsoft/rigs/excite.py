"""Motions that make parameters visible, as changes of the file of any rig that grasps: a grasp of a
given depth, then rolls, strokes, sines, chirps or presses."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from torchsoft.display import suggestion
from torchsoft.physics.parts import COORDINATES
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.control import Loop
from torchsoft.tables import line

SINCE = 0.5
"""Begin of the motion [s], after the grasp and a pause."""

INTERVAL = 0.01
"""Time [s] between outputs."""

GRIP = 5e-5
"""Depth [m] of the grasp at the start. A run that begins at a touch has no derivative by what moves
the bodies; a body that is not gripped yet rolls on its pad to the middle of an element."""

OFF_NODE = 0.3e-3
"""Distance [m] along the pads by which a grasp is moved: a start on a node, or in the middle of a
pad, is symmetric until rounding breaks it."""


class Excitation(NamedTuple):
    """A grasp that compresses the pads together by `depth` [m] within a time `grasp` [s], then the
    tables of two motions: along the pads, `roll`, and on top of the grasp, `press`, which begin at
    `since` [s] unless they say when; until `duration` [s]. A vertical press starts at the depth
    `grip` [m]; a negative one is a gap."""

    roll: Mapping[str, Any]
    press: Mapping[str, Any] | None = None
    duration: float = 2.0
    depth: float = 1.4e-3
    grasp: float = 0.375
    since: float = SINCE
    grip: float = GRIP


def sines(amplitude: float, band: tuple[float, float], seed: int) -> dict[str, Any]:
    """A multi-sine of some amplitude [m] in a band [Hz]."""
    return {"kind": "multi_sine", "amplitude": amplitude, "band": band, "seed": seed}


def strokes(travel: float, stroke_time: float) -> dict[str, Any]:
    """Strokes of a travel [m], each way in a time [s]."""
    return {"kind": "strokes", "travel": travel, "stroke_time": stroke_time}


def roll_to(travel: float, end: float) -> dict[str, Any]:
    """One way [m] until a time [s]."""
    return {
        "kind": "profile", "times": (SINCE, end), "values": (0.0, travel), "offset": "start",
    }  # fmt: skip


def chirp(amplitude: float, first: float, last: float) -> dict[str, Any]:
    """A sine of some amplitude [m] from one frequency to another [Hz]."""
    return {"kind": "chirp", "amplitude": amplitude, "first": first, "last": last}


CATALOGUE: Mapping[str, Excitation] = {
    "slow roll": Excitation(roll_to(16e-3, 4.0), duration=4.0),
    "strokes": Excitation(strokes(20e-3, 0.75)),
    "fast strokes": Excitation(strokes(20e-3, 0.25)),
    "shaking": Excitation(sines(10e-3, (2.0, 15.0), 0), sines(2e-4, (2.0, 15.0), 1)),
    "pressing": Excitation(roll_to(10e-3, 2.0), chirp(4e-4, 8.0, 8.0)),
    "deep pressing": Excitation(roll_to(30e-3, 2.0), chirp(8e-4, 25.0, 25.0), depth=2.4e-3),
    "deep chirp": Excitation(chirp(5e-3, 1.0, 25.0), chirp(5e-4, 1.0, 25.0), depth=2.4e-3),
    "light shaking": Excitation(
        sines(6e-3, (4.0, 20.0), 0), sines(2e-4, (4.0, 20.0), 1), depth=2e-4
    ),
    "light jerks": Excitation(strokes(80e-3, 0.25), duration=1.4, depth=1e-4),
    "hard light jerks": Excitation(strokes(80e-3, 0.15), duration=1.3, depth=1e-4),
    "deep jerks": Excitation(strokes(40e-3, 0.1), duration=1.3),
}
"""Excitations by name, from gentle to hard."""


def excite(
    file: RigFile, excitation: str | Excitation, *, body: str | None = None,
    senses: str | None = None,
) -> RigFile:  # fmt: skip
    """The rig file with an excitation, one of `CATALOGUE` by name or another, in place of two of
    its motions: those that move a `body` with a pad across the pad and along it.

    A vertical press starts in a light grip, its depth counts from the touch, and the effort that
    holds it is fed forward. The loop along the pad measures the body itself, or the
    body that it `senses`; with its own the manipulated one may slip freely. All other motions stay.
    Raises `ValueError` where no body, or more than one, has both motions.
    """
    if isinstance(excitation, str):
        if excitation not in CATALOGUE:
            raise ValueError(
                f"there is no excitation `{line(excitation, 80)}`; "
                f"{suggestion(excitation, CATALOGUE, 'there are')}"
            )
        excitation = CATALOGUE[excitation]
    body, across, way = _presser(file, body)
    along = "y" if across == "x" else "x"
    loops = _loops(file)
    press_loop, roll_loop = (loops[f"{body}.{axis}"] for axis in (across, along))
    grip = {"depth": excitation.grip} if across == "y" else None
    closed = excitation.depth - (excitation.grip if grip else 0.0)
    times, values = (0.0, excitation.grasp), (0.0, way * closed)
    grasp = {"times": times, "values": values, "offset": "start"}
    press = {"kind": "profile"} | grasp | dict(excitation.press or {})
    roll = dict(excitation.roll)
    for motion in (press, roll):
        if motion["kind"] != "profile":
            motion.setdefault("since", excitation.since)
    motions = {press_loop.setpoint: press, roll_loop.setpoint: roll}
    actuators: dict[str, Any] = {}
    if (one := file.actuators.get(press_loop.actuators[0])) and one.feed_forward is not None:
        held = {"times": times, "values": ("held", "held")}
        motions[one.feed_forward] = {"kind": "profile"} | held
    if roll_loop.actuators[0] in file.actuators:
        actuators[roll_loop.actuators[0]] = {"measures": f"{senses or body}.{along}"}
    starts: dict[str, dict[str, Any]] = {body: {"y": grip} if grip else {}}
    touched = (one.body for one in file.contacts.values() if file.pads[one.pad].base == body)
    for name in {body, *touched} if senses is None else ():
        given = getattr(file.bodies[name].start, along)
        if isinstance(given, float):
            starts.setdefault(name, {})[along] = given + OFF_NODE
    return file.override(
        {f"motion.{name}": motion for name, motion in motions.items()},
        bodies={name: {"start": start} for name, start in starts.items() if start},
        actuators=actuators,
        outputs={"duration": excitation.duration, "interval": INTERVAL, "snapshots": ()},
    )


def _loops(file: RigFile) -> dict[str, Loop]:
    """Loops by the coordinates that they push."""
    return {one.pushes: one for one in file.loops()}


def _presser(file: RigFile, body: str | None) -> tuple[str, str, float]:
    """The body with a pad that loops move across the pad and along it, the axis across, and the
    sense of a press along it. Raises `ValueError`."""
    found, loops, rig = dict[str, tuple[str, float]](), _loops(file), file.assemble()
    for contact in file.contacts.values():
        base = file.pads[contact.pad].base
        if base is None or body not in (None, base):
            continue
        normal = rig.pads[contact.pad].axes[:, 1]
        if all(f"{base}.{axis}" in loops for axis in ("x", "y")):
            i = int(normal.abs().argmax())
            found[base] = COORDINATES[i], float(normal[i].sign())
    if len(found) != 1:
        there = f"{' and '.join(found)} do; set `body` to one of them" if found else "none does"
        raise ValueError(
            "an excitation needs a body with a pad that two loops move, across the pad and along "
            f"it: {there}"
        )
    return next((name, *one) for name, one in found.items())
