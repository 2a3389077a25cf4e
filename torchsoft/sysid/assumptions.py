"""Assumptions of an identification, and suspects: what would be free if one of them were wrong.

A suspect is an additional coordinate with a neutral value, whose derivative is exact (a parameter
or an extension of the rig, a fault of a sensor), or an alternative: a function that changes the
recording, by an amount or as a whole (a mesh, a law). Both are compared with the data in the same
way.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from torchsoft.physics.contact import SmoothSlip
from torchsoft.physics.mesh import PadMesh
from torchsoft.physics.motion import Sampled
from torchsoft.physics.parts import PD
from torchsoft.sysid.alternatives import (
    at_finite_strain,
    coulomb,
    delayed,
    laws,
    led,
    lifted,
    limited,
    linear_pads,
    moved,
    off_centre,
    raised,
    remeshed,
    resized,
    scaled,
    shifted,
    smoother,
    stretched,
    tilted,
    turned,
    zoomed,
)
from torchsoft.sysid.extensions import extensions, undelayed
from torchsoft.sysid.initial_state import SETTLE, Standing
from torchsoft.sysid.prediction import partner
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.unknowns import FAULTS, NUISANCES, Nuisance, Sensor
from torchsoft.tables import Number

Kind = Literal["numerical", "known", "sensor", "law"]
"""A numerical setting, a known parameter of the rig, a property of a sensor, or a law."""

PLACE = 20e-6
"""Amount of the place of a body or a pad [m]: how accurately a careful hand places a disc."""

KNOWN, RADIUS, LENGTH = 1e-2, 1e-3, 1e-3
"""Relative amounts of known parameters, of radii, and of the length of a pad, by which its nodes
move away from its first end."""

FORCE = 0.5
"""Amount of feed-forward forces [N]."""

CENTRE, TILT = 1e-4, 1e-3
"""Amounts of a centre of mass [m], and of the angle of a pad or a camera [rad]."""

ZOOM = 1e-3
"""Relative amount of the scale of a camera."""

CLOCK, SLOWER = 1e-4, 1e-4
"""Amounts of the time of set-points [s], and of the rate of their clock [1]."""

CUT = 0.1
"""Amount by which a limit is below the largest effort, relative to it."""

AMOUNTS = 10.0
"""Range of a suspect in a refit, in amounts."""

NEAR, WIDEST = 5.0, 5.0
"""Amounts, by the score test, within which a refit searches in that range, and the largest factor
on it."""

PERCENT, MILLI, MICRO = 100.0, 1e3, 1e6


@dataclass(frozen=True)
class Assumption:
    """An assumption of a fit as the clause `stated`, and what it means to be wrong as the clause
    `otherwise`.

    A known parameter, or a property of a sensor, may be wrong by any multiple of `amount` [unit],
    of either sign unless it is `one_sided`; a law or a numerical setting holds or does not.
    `parameter` is the name of the rig's parameter, if it is one; `nominal` is the neutral value of
    the coordinate, and `step` its change by the amount [SI].
    """

    name: str
    kind: Kind
    stated: str
    otherwise: str
    amount: float = 1.0
    unit: str = ""
    parameter: str = ""
    nominal: Number = 0.0
    step: Number = 1.0
    one_sided: bool = False

    @property
    def has_amount(self) -> bool:
        """Whether it may be wrong by an amount; otherwise it holds or does not."""
        return self.kind in ("known", "sensor")


@dataclass(frozen=True)
class Suspect(Assumption):
    """An assumption with what makes it free: a `parameter`, which may be an `extension` of the rig,
    a `fault` of a channel's sensor, or a `change` of the recordings by an amount [SI], which may be
    one `of_samples` too. A `costly` one has much longer runs than the rig as stated."""

    extension: bool = False
    fault: tuple[str, Nuisance] | None = None
    change: Callable[[Recording, float], Recording | None] | None = None
    of_samples: bool = False
    costly: bool = False

    @property
    def bounds(self) -> tuple[float, float]:
        """Range [SI] of the amount of an alternative."""
        if not self.has_amount:
            return 0.0, 1.0
        return -AMOUNTS * self.step * (not self.one_sided), AMOUNTS * self.step

    def within(self, favoured: float) -> "Suspect":
        """The suspect with a wider range where the data favour a large amount [unit]."""
        wider = min(max(abs(favoured / self.amount) / NEAR, 1.0), WIDEST)
        if not self.has_amount or self.extension or self.fault is not None:
            return self
        return replace(self, amount=wider * self.amount, step=wider * self.step)

    @property
    def label(self) -> str:
        """Label of its coordinate."""
        if self.fault is not None:
            return f"{self.fault[1]} of {self.fault[0]}"
        return self.parameter or self.name


def by_amount(
    name: str, stated: str, otherwise: str, step: float, per_unit: float, unit: str,
    change: Callable[..., Recording | None], **more: Any,
) -> Suspect:  # fmt: skip
    """An alternative by an amount: `step` in SI units is shown as `per_unit` times that in the
    `unit`."""
    kind: Kind = more.pop("kind", "known")
    return Suspect(
        name, kind, stated, otherwise, per_unit * step, unit, step=step, change=change, **more
    )


def either_or(
    name: str, kind: Kind, stated: str, otherwise: str,
    change: Callable[[Recording], Recording | None], **more: Any,
) -> Suspect:  # fmt: skip
    """An alternative that holds or does not."""
    return Suspect(name, kind, stated, otherwise, change=lambda r, _: change(r), **more)


def suspects(
    recordings: Sequence[Recording], unknown: Collection[str], sensors: Mapping[str, Sensor],
    efforts: Mapping[str, float],
) -> list[Suspect]:  # fmt: skip
    """All suspects of some recordings. `unknown` are the identified parameters, coordinates of
    starts, and labels of faults of the `sensors`; `efforts` is the largest effort [N or N.m] of
    every controller."""
    first = recordings[0]
    out = [*numerical(first), *of_motion(first), *of_laws(first), *of_bodies(first, unknown)]
    out += [*of_pads(first), *of_controllers(first, efforts), *of_parameters(recordings, unknown)]
    every_rests = all(isinstance(r.start, Standing) for r in recordings)
    for name, one in extensions(first.rig).items():
        if ".slow(" not in name or every_rests:
            out.append(Suspect(
                name, "known", one.stated, one.otherwise, one.amount, one.unit, parameter=name,
                nominal=one.neutral, step=one.amount, one_sided=one.low == one.neutral,
                extension=True,
            ))  # fmt: skip
    return [*out, *of_sensors(first, unknown, sensors), *of_cameras(first, sensors)]


def numerical(recording: Recording) -> Iterator[Suspect]:
    """Numerical settings."""
    pad = next(iter(recording.rig.pads.values()))
    nx, ny, points = pad.mesh.elements_x, pad.mesh.elements_y, pad.points
    at = f"{points} points an element" if points else "on the nodes"
    yield either_or(
        "mesh", "numerical", f"the pads have {nx} x {ny} elements",
        f"they had {2 * nx} x {2 * ny}", lambda r: remeshed(r, 2, 0),
    )  # fmt: skip
    yield either_or(
        "contact points", "numerical", f"contact is computed {at}",
        f"it were at {points + 2} points an element", lambda r: remeshed(r, 1, 2),
    )  # fmt: skip
    yield either_or(
        "mesh phase", "numerical", "a node lies where the mesh puts it",
        "nodes lay a quarter of an element on", lambda r: shifted(r, 0.25),
    )  # fmt: skip
    if any(isinstance(one, Sampled) for one in recording.rig.reference.signals.values()):
        yield either_or(
            "set-points", "numerical", "set-points lie on a smooth curve through the recorded ones",
            "the curve between them were of fifth degree", smoother,
        )  # fmt: skip


def of_motion(recording: Recording) -> Iterator[Suspect]:
    """Clock of the set-points, and what is fed forward."""
    yield by_amount(
        "clock of the set-points", "set-points and sensors have one clock", "set-points came later",
        CLOCK, MILLI, "ms", delayed,
    )  # fmt: skip
    yield by_amount(
        "scale of the clock", "clocks of set-points and sensors run equally fast",
        "that of the set-points ran slower", SLOWER, PERCENT, "%", stretched,
    )  # fmt: skip
    if any(actuator.feed_forward is not None for actuator in recording.rig.actuators.values()):
        yield by_amount(
            "feed-forward", "the feed-forward is known", f"it were {FORCE} N more", FORCE, 1.0, "N",
            raised,
        )  # fmt: skip


def of_laws(recording: Recording) -> Iterator[Suspect]:
    """Laws that hold or do not."""
    if isinstance(recording.start, Standing):
        lead, other = recording.start.lead, 0.0 if recording.start.lead else SETTLE
        yield either_or(
            "lead", "law", f"bodies were placed {lead:g} s before the first sample (lead)",
            f"it were {other:g} s", lambda r: led(r, other),
        )  # fmt: skip
    if any(isinstance(law.friction, SmoothSlip) for law in laws(recording.rig)):
        yield either_or(
            "Coulomb friction", "law", 'slip is smooth (friction "smooth")', "it were Coulomb's",
            coulomb,
        )  # fmt: skip
    if linear_pads(recording.rig):
        yield either_or(
            "finite strain", "law", "pads are linear", "they were neo-Hookean", at_finite_strain,
            costly=True,
        )  # fmt: skip


def of_bodies(recording: Recording, unknown: Collection[str]) -> Iterator[Suspect]:
    """Where bodies start, and where their centres of mass are."""
    rig = recording.rig
    pushed = {one.pushes for one in rig.actuators.values()}
    standing = isinstance(recording.start, Standing)
    for name, axes in rig.layout.free.items():
        if standing and 0 in axes and not {f"{name}.x", f"start.{name}.x"} & {*pushed, *unknown}:
            yield by_amount(
                f"start of {name}.x", f"{name} starts where the start states",
                f"it started {MICRO * PLACE:g} um further right", PLACE, MICRO, "um",
                partial(moved, body=name),
            )  # fmt: skip
        driven = any(one.startswith(f"{name}.") for one in pushed)
        if axes != [0, 1, 2] or rig.bodies[name].shape is None or driven or not standing:
            continue
        for k, axis in enumerate("xy"):
            yield by_amount(
                f"bodies.{name}.centre_{axis}",
                f"the centre of mass of {name} is where it is stated",
                f"it were {MILLI * CENTRE:g} mm off along {axis}", CENTRE, MILLI, "mm",
                partial(off_centre, body=name, axis=k), of_samples=True,
            )  # fmt: skip


def of_pads(recording: Recording) -> Iterator[Suspect]:
    """Sizes of blocks, places and angles of pads."""
    pads = recording.rig.pads
    blocks = [name for name, pad in pads.items() if type(pad.mesh) is PadMesh]
    groups = [blocks] if len(blocks) > 1 else []
    for names in (*groups, *([name] for name in blocks)):
        who = "pads" if len(names) > 1 else f"the pad {names[0]}"
        for extent, size, stays in (("height", KNOWN, "face"), ("length", LENGTH, "first end")):
            yield by_amount(
                f"{extent} of {who}", f"the {extent} of {who} is as stated",
                f"it were more, each {stays} being where it is", size, PERCENT, "%",
                partial(resized, names=names, extent=extent),
            )  # fmt: skip
    for name in pads:
        yield by_amount(
            f"place of the pad {name}", f"the face of the pad {name} is where it is stated",
            "it were nearer to what touches it", PLACE, MICRO, "um", partial(lifted, name=name),
        )  # fmt: skip
        yield by_amount(
            f"tilt of the pad {name}", f"the pad {name} lies at the angle stated",
            "it were turned anticlockwise", TILT, MILLI, "mrad", partial(tilted, name=name),
        )  # fmt: skip


def of_controllers(recording: Recording, efforts: Mapping[str, float]) -> Iterator[Suspect]:
    """Limits of controllers."""
    for name, one in recording.rig.actuators.items():
        if isinstance(undelayed(one), PD) and one.limit is None and efforts.get(name, 0.0) > 0.0:
            yield by_amount(
                f"limit of the controller {name}", f"the controller {name} does not saturate",
                f"it were cut off below {efforts[name]:.3g}, its largest effort", CUT, PERCENT, "%",
                partial(limited, name=name, largest=efforts[name]), one_sided=True,
            )  # fmt: skip


def of_parameters(recordings: Sequence[Recording], unknown: Collection[str]) -> Iterator[Suspect]:
    """Parameters of the rig that are known, and not zero."""
    for name, value in recordings[0].parameters.items():
        if name in unknown or value == 0.0 or name.startswith("start.") or ".fixed." in name:
            continue
        if any(name not in r.parameters for r in recordings):
            continue
        part = RADIUS if name.endswith("radius") else KNOWN
        if all(r.parameters[name] == value for r in recordings):
            yield Suspect(
                name, "known", f"{name} is {value:.6g}", f"{name} were {(1 + part) * value:.6g}",
                PERCENT * part, "%", parameter=name, nominal=value, step=part * value,
            )  # fmt: skip
        else:
            yield by_amount(
                name, f"{name} is as each recording states it", f"{name} were larger", part,
                PERCENT, "%", partial(scaled, name=name),
            )  # fmt: skip


def of_sensors(
    recording: Recording, unknown: Collection[str], sensors: Mapping[str, Sensor]
) -> Iterator[Suspect]:
    """Faults of the sensors."""
    duration = max(recording.duration, 1e-9)
    for channel in (one for one in sensors if one in recording.units):
        for kind in NUISANCES:
            fault = FAULTS[kind]
            if not fault.clause or f"{kind} of {channel}" in unknown:
                continue
            if kind == "misalignment" and not has_partner(recording, channel):
                continue
            step, own = fault.amount * fault.scale(sensors[channel], duration), recording.units
            over = (1.0, own[channel])
            if fault.grows:
                over = duration, f"{own[channel]} over a recording"
            factor, unit = {
                "s": (MILLI, "ms"), "1": (PERCENT, "%"), "rad": (MILLI, "mrad"),
            }.get(fault.unit, over)  # fmt: skip
            yield Suspect(
                f"{kind} {channel}", "sensor", f"{channel} has no unknown {kind}",
                f"{channel} {fault.clause}", factor * step, unit, nominal=float(kind == "gain"),
                step=step, one_sided=fault.one_sided, fault=(channel, kind),
            )  # fmt: skip


def has_partner(recording: Recording, channel: str) -> bool:
    """Whether a channel has one at right angles."""
    with suppress(ValueError):
        return bool(partner(recording.rig, channel))
    return False


def of_cameras(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Suspect]:
    """Scale and angle of cameras: one that measures the places of all bodies, or of one."""
    places = [channel for channel in sensors if recording.units.get(channel) == "m"]
    symbols = recording.rig.symbols.items()
    pairs = {f"the camera on {body}": (f"x_{one}", f"y_{one}") for body, one in symbols}
    pairs = {camera: pair for camera, pair in pairs.items() if {*pair} <= {*places}}
    others = {camera: pair for camera, pair in pairs.items() if {*pair} != {*places}}
    seen: dict[str, Sequence[str]] = {"the camera": places} if len(places) > 1 else {}
    for camera, channels in (seen | others).items():
        for name, about in (("scale", "zero"), ("scale about the start", "their first sample")):
            yield by_amount(
                f"{name} of {camera}", f"{', '.join(channels)} have one true scale",
                f"they were all too large about {about}", ZOOM, PERCENT, "%",
                partial(zoomed, channels=channels, about_start=about != "zero"), kind="sensor",
                of_samples=True,
            )  # fmt: skip
    for camera, pair in pairs.items():
        yield by_amount(
            f"angle of {camera}", f"{pair[0]} and {pair[1]} are along the axes of the rig",
            "their camera were turned anticlockwise about its own axis", TILT, MILLI, "mrad",
            partial(turned, pair=pair), kind="sensor", of_samples=True,
        )  # fmt: skip
