"""Motions that make parameters visible, as changes of the file of any rig that grasps: a grasp of a
given depth, then rolls, strokes, sines, chirps or presses."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from torchsoft.display import suggestion
from torchsoft.physics.parts import COORDINATES
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.control import Loop
from torchsoft.tables import line

GRASP, SINCE = 0.375, 0.5
"""End of the grasp, and begin of the motion after a pause [s]."""

INTERVAL = 0.01
"""Time [s] between outputs."""

OFF_NODE = 0.3e-3
"""Distance [m] along the pads by which a grasp is moved: a start on a node, or in the middle of a
pad, is symmetric until rounding breaks it."""


class Excitation(NamedTuple):
    """A grasp that compresses the pads together by `depth` [m], then the tables of two motions:
    along the pads, `roll`, and on top of the grasp, `press`; until `duration` [s]."""

    roll: Mapping[str, Any]
    press: Mapping[str, Any] | None = None
    duration: float = 2.0
    depth: float = 1.5e-3


def _sines(amplitude: float, band: tuple[float, float], seed: int) -> dict[str, Any]:
    return {"kind": "multi_sine", "amplitude": amplitude, "band": band, "seed": seed}


def _strokes(travel: float, stroke_time: float) -> dict[str, Any]:
    return {"kind": "strokes", "travel": travel, "stroke_time": stroke_time}


def _roll(travel: float, end: float) -> dict[str, Any]:
    return {
        "kind": "profile", "times": (SINCE, end), "values": (0.0, travel), "offset": "start",
    }  # fmt: skip


def _chirp(amplitude: float, first: float, last: float) -> dict[str, Any]:
    return {"kind": "chirp", "amplitude": amplitude, "first": first, "last": last}


CATALOGUE: Mapping[str, Excitation] = {
    "slow roll": Excitation(_roll(16e-3, 4.0), duration=4.0),
    "strokes": Excitation(_strokes(20e-3, 0.75)),
    "fast strokes": Excitation(_strokes(20e-3, 0.25)),
    "shaking": Excitation(_sines(10e-3, (2.0, 15.0), 0), _sines(2e-4, (2.0, 15.0), 1)),
    "pressing": Excitation(_roll(10e-3, 2.0), _chirp(4e-4, 8.0, 8.0)),
    "deep pressing": Excitation(_roll(30e-3, 2.0), _chirp(8e-4, 25.0, 25.0), depth=2.5e-3),
    "deep chirp": Excitation(_chirp(5e-3, 1.0, 25.0), _chirp(5e-4, 1.0, 25.0), depth=2.5e-3),
    "light shaking": Excitation(
        _sines(6e-3, (4.0, 20.0), 0), _sines(2e-4, (4.0, 20.0), 1), depth=2e-4
    ),
    "light jerks": Excitation(_strokes(80e-3, 0.25), duration=1.4, depth=1e-4),
    "hard light jerks": Excitation(_strokes(80e-3, 0.15), duration=1.3, depth=1e-4),
    "deep jerks": Excitation(_strokes(40e-3, 0.1), duration=1.3),
}
"""Excitations by name, from gentle to hard; `experiments/experiment_design.py` ranks them."""


def excite(
    file: RigFile, excitation: str | Excitation, *, body: str | None = None,
    senses: str | None = None,
) -> RigFile:  # fmt: skip
    """The rig file with an excitation, one of `CATALOGUE` by name or another, in place of two of
    its motions: those that move a `body` with a pad across the pad and along it.

    A vertical press starts where the body's pads touch, and the effort that holds it is fed
    forward. The loop along the pad measures the body itself, or the body that it `senses`; with its
    own the manipulated one may slip freely. All other motions stay. Raises `ValueError` where no
    body, or more than one, has both motions.
    """
    if isinstance(excitation, str):
        if excitation not in CATALOGUE:
            raise ValueError(
                f"there is no excitation `{line(excitation, 80)}`; "
                f"{suggestion(excitation, CATALOGUE, 'there are')}"
            )
        excitation = CATALOGUE[excitation]
    body, across, along = _grasping(file, body)
    grasp = {"times": (0.0, GRASP), "values": (0.0, across.way * excitation.depth)}
    grasp = {"kind": "profile", "offset": "start"} | grasp
    press = grasp | dict(excitation.press or {})
    roll = dict(excitation.roll)
    for motion in (press, roll):
        if motion["kind"] in ("strokes", "chirp", "multi_sine"):
            motion["since"] = SINCE
    changes: dict[str, Any] = {
        f"motion.{across.loop.setpoint}": press,
        f"motion.{along.loop.setpoint}": roll,
    }
    if across.loop.field.startswith("actuators."):
        fed = file.actuators[across.loop.field.removeprefix("actuators.")].feed_forward
        if fed is not None:
            values = {"times": (0.0, GRASP), "values": (0.0, "held")}
            changes[f"motion.{fed}"] = {"kind": "profile"} | values
    outputs = {"duration": excitation.duration, "interval": INTERVAL, "snapshots": ()}
    groups: dict[str, Any] = {"outputs": outputs}
    if along.loop.field.startswith("actuators."):
        name = along.loop.field.removeprefix("actuators.")
        groups["actuators"] = {name: {"measures": f"{senses or body}.{along.axis}"}}
    touched = {one.body for one in file.contacts.values() if file.pads[one.pad].base == body}
    starts: dict[str, Any] = {}
    for name in sorted({body, *touched}):
        given = getattr(file.bodies[name].start, along.axis)
        if senses is None and isinstance(given, float) and along.axis in file.bodies[name].free:
            starts[name] = {"start": {along.axis: given + OFF_NODE}}
    if across.axis == "y":
        starts.setdefault(body, {}).setdefault("start", {})["y"] = "touch"
    return file.override(changes, bodies=starts, **groups)


class Follower(NamedTuple):
    """A loop of a grasp: the axis of the coordinate, its sense [1], and the loop."""

    axis: str
    way: float
    loop: Loop


def _grasping(file: RigFile, body: str | None) -> tuple[str, Follower, Follower]:
    """The body with a pad that is pressed and moved along, and its loops across and along the pad.
    Raises `ValueError`."""
    loops = {one.pushes: one for one in file.loops() if one.pushes.partition(".")[2] != "theta"}
    found: dict[str, tuple[Follower, Follower]] = {}
    rig = file.assemble()
    for contact in file.contacts.values():
        base = file.pads[contact.pad].base
        if base is None or (body is not None and base != body):
            continue
        normal = rig.pads[contact.pad].axes[:, 1]
        i = int(normal.abs().argmax())
        across, along = COORDINATES[i], COORDINATES[1 - i]
        if all(f"{base}.{axis}" in loops for axis in (across, along)):
            press, roll = (loops[f"{base}.{axis}"] for axis in (across, along))
            found[base] = (
                Follower(across, float(normal[i].sign()), press),
                Follower(along, 1.0, roll),
            )
    if len(found) != 1:
        there = f"{' and '.join(found)} do; say which `body`" if found else "none does"
        raise ValueError(
            "an excitation needs a body with a pad that two loops move, across the pad and along "
            f"it: {there}"
        )
    name, (press, roll) = next(iter(found.items()))
    return name, press, roll
