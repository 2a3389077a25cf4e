"""Assumptions of an identification: numerical constants, known parameters, properties of sensors,
laws; and a variation of each.

A variation changes the recordings or their parameters as if one assumption were wrong by a stated
amount.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from scipy.interpolate import BPoly, CubicSpline, make_interp_spline
from torch import Tensor, nn

from torchsoft.physics.contact import Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.extensions import extensions, undelayed
from torchsoft.physics.hyperelastic import NeoHookean
from torchsoft.physics.matched import Matched
from torchsoft.physics.material import KelvinVoigt
from torchsoft.physics.mesh import PadMesh
from torchsoft.physics.motion import Piecewise, Reference, Retimed, Sampled
from torchsoft.physics.names import effort_channel, rate_channel
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import COORDINATES, PD, Actuator, Load
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import parameter
from torchsoft.sysid.initial_state import SETTLE, Standing
from torchsoft.sysid.recording import Array, Recording
from torchsoft.sysid.runs import Simulated, Vary
from torchsoft.sysid.unknowns import FAULTS, NUISANCES, Nuisance, Sensor
from torchsoft.tables import Number

Kind = Literal["numerical", "known", "sensor", "law", "several"]
"""A constant of the computation, a known parameter of the rig, a property of a sensor, a law, or
several of these at once."""

PLACE = 20e-6
"""Variation of the start of a body [m]: the accuracy with which a careful hand places a disc."""

RADIUS = 1e-3
"""Relative variation of known lengths of the rig."""

KNOWN = 1e-2
"""Relative variation of the other known parameters."""

LENGTH = 1e-3
"""Relative variation of a pad's length, by which its nodes move away from its first end."""

FORCE = 0.5
"""Variation of feed-forward forces [N]."""

CENTRE, TILT = 1e-4, 1e-3
"""Variation of a centre of mass [m], and of the angle of a pad [rad]."""

CROSSTALK = 1e-3
"""Variation of the part of a channel that another reads, and of the scale of an instrument."""

CLOCK, SLOWER = 1e-4, 1e-4
"""Variation of the time of set-points [s], and of the rate of their clock [1]."""

AMOUNTS = 10.0
"""Range of a number in a repeated fit, in amounts of its variation."""

NEAR, WIDEST = 5.0, 5.0
"""Number of variation amounts, by the test to first order, within which a new fit searches for a
known parameter, and the largest factor on that range."""


@dataclass(frozen=True)
class Assumption:
    """An assumption of a fit as the clause `stated`, and its variation as the clause `otherwise`.

    A known parameter, or a property of a sensor, may be wrong by any multiple of `amount` [unit],
    of either sign unless it is `one_sided`; a law or a constant of the computation holds or does
    not. `parameter` is the name of the varied parameter: `nominal` is its stated value, and `step`
    its change in a variation by the amount.

    """

    name: str
    kind: Kind
    stated: str
    otherwise: str
    amount: float = 1.0
    unit: str = ""
    parameter: str = ""
    nominal: Number = float("nan")
    step: Number = float("nan")
    one_sided: bool = False


@dataclass(frozen=True)
class Variation(Assumption):
    """An assumption with its variation, which is a parameter of the rig, an `extension` of it, a
    `fault` of a channel's sensor, or a function of an amount [unit]: `vary` gives the varied
    recording, `read` what is added to a channel's samples (k,). One whose run is `costly` is tested
    where a fit is doubtful."""

    vary: Vary | None = None
    read: Callable[[Recording, str, float], Array] | None = None
    extension: bool = False
    costly: bool = False
    fault: tuple[str, Any] | None = None

    @property
    def bounds(self) -> tuple[float, float]:
        """Range of the amount [unit]; a law or a constant of the computation is varied or not."""
        if self.kind in ("numerical", "law"):
            return 0.0, 1.0
        return -AMOUNTS * self.amount * (not self.one_sided), AMOUNTS * self.amount

    def within(self, amount: float) -> "Variation":
        """The variation with a range for another amount, wider for a large one."""
        wider = min(max(abs(amount / self.amount) / NEAR, 1.0), WIDEST)
        if self.kind in ("numerical", "law") or self.extension or self.fault is not None:
            return self
        return replace(self, amount=wider * self.amount, step=wider * self.step)

    @property
    def label(self) -> str:
        """Label of the coordinate for this assumption."""
        if self.fault is not None:
            return f"{self.fault[1]} of {self.fault[0]}"
        return self.parameter or self.name


def assumptions(
    recordings: Sequence[Recording], unknown: Collection[str], sensors: Mapping[str, Sensor]
) -> list[Variation]:
    """All assumptions of the runs of some recordings that can be varied; `unknown` are the
    identified parameters and coordinates of starts, and labels of faults of the `sensors`."""
    first = recordings[0]
    out = [*numerical(first), *of_motion(first), *of_laws(first), *of_places(first, unknown)]
    out += [*of_pads(first), *of_actuators(first)]
    for name, value in first.parameters.items():
        if name in unknown or value == 0.0 or name.startswith("start.") or "fixed" in name:
            continue
        part = RADIUS if name.endswith("radius") else KNOWN
        one = Variation(
            name, "known", f"{name} is {value:.6g}", f"{name} were {(1 + part) * value:.6g}",
            100 * part, "%", parameter=name, nominal=value, step=part * value,
        )  # fmt: skip
        if any(r.parameters.get(name) != value for r in recordings):  # each has its own
            each = f"{name} is as each recording states it"
            scaled = partial(_scaled, name=name)
            one = replace(one, stated=each, otherwise=f"{name} were larger", parameter="",
                          nominal=float("nan"), step=float("nan"), vary=scaled)  # fmt: skip
        out.append(one)
    for name, one in extensions(first.rig).items():
        if ".slow(" not in name or all(isinstance(r.start, Standing) for r in recordings):
            more = Variation(
                name, "known", one.stated, one.otherwise, one.amount, one.unit, parameter=name,
                nominal=one.neutral, step=one.amount, one_sided=one.low == one.neutral,
                extension=True,
            )  # fmt: skip
            out.append(more)
    return [*out, *of_sensors(first, unknown, sensors)]


def numerical(recording: Recording) -> Iterator[Variation]:
    """Constants of the computation."""
    pad = next(iter(recording.rig.pads.values()))
    nx, ny, points = pad.mesh.elements_x, pad.mesh.elements_y, pad.points
    at = f"{points} points an element" if points else "on the nodes"
    yield Variation(
        "mesh", "numerical", f"the pads have {nx} x {ny} elements",
        f"they had {2 * nx} x {2 * ny}", vary=lambda r, _, run: remeshed(r, 2, points),
    )  # fmt: skip
    yield Variation(
        "contact points", "numerical", f"contact is computed {at}",
        f"it were at {points + 2} points an element",
        vary=lambda r, _, run: remeshed(r, 1, points + 2),
    )  # fmt: skip
    yield Variation(
        "mesh phase", "numerical", "a node lies where the mesh puts it",
        "nodes lay a quarter of an element on", vary=lambda r, _, run: shifted(r, 0.25),
    )  # fmt: skip
    if any(isinstance(one, Sampled) for one in recording.rig.reference.signals.values()):
        yield Variation(
            "set-points", "numerical",
            "set-points are what a smooth curve through the recorded ones says",
            "the curve between them were of fifth degree", vary=lambda r, _, run: smoother(r),
        )  # fmt: skip


def of_motion(recording: Recording) -> Iterator[Variation]:
    """Clock of the set-points, and what is fed forward."""
    yield Variation(
        "clock of the set-points", "known", "set-points and sensors have one clock",
        "set-points came later", 1e3 * CLOCK, "ms", vary=lambda r, ms, run: delayed(r, 1e-3 * ms),
    )  # fmt: skip
    yield Variation(
        "scale of the clock", "known", "clocks of set-points and sensors run alike",
        "that of the set-points ran slower", 100 * SLOWER, "%",
        vary=lambda r, part, run: stretched(r, 1e-2 * part),
    )  # fmt: skip
    if any(actuator.feed_forward is not None for actuator in recording.rig.actuators.values()):
        yield Variation(
            "feed-forward", "known", "what was fed forward is known", f"it were {FORCE} N more",
            FORCE, "N", vary=lambda r, force, run: raised(r, force),
        )  # fmt: skip


def of_laws(recording: Recording) -> Iterator[Variation]:
    """Laws that hold or do not."""
    if isinstance(recording.start, Standing):
        lead, other = recording.start.lead, 0.0 if recording.start.lead else SETTLE
        yield Variation(
            "lead", "law",
            f"bodies were put where they stand {lead:g} s before the first sample (lead)",
            f"it were {other:g} s", vary=lambda r, _, run: led(r, other),
        )  # fmt: skip
    if any(isinstance(law.friction, SmoothSlip) for law in laws(recording.rig)):
        yield Variation(
            "Coulomb friction", "law", 'slip is smooth (friction "smooth")', "it were Coulomb's",
            vary=lambda r, _, run: coulomb(r),
        )  # fmt: skip
    if linear_pads(recording.rig):
        yield Variation(
            "finite strain", "law", "pads are linear", "they were neo-Hookean", costly=True,
            vary=lambda r, _, run: at_finite_strain(r),
        )  # fmt: skip


def of_places(recording: Recording, unknown: Collection[str]) -> Iterator[Variation]:
    """Where bodies begin, and where their centres of mass are."""
    rig = recording.rig
    pushed = {one.pushes for one in rig.actuators.values()}
    standing = isinstance(recording.start, Standing)
    for name, axes in rig.layout.free.items():
        if standing and 0 in axes and not {f"{name}.x", f"start.{name}.x"} & {*pushed, *unknown}:
            yield Variation(
                f"start of {name}.x", "known", f"{name} begins where the start says",
                f"it began {1e6 * PLACE:g} um further right", 1e6 * PLACE, "um",
                vary=lambda r, um, run, name=name: moved(r, name, 1e-6 * um),
            )  # fmt: skip
        if axes != [0, 1, 2] or rig.bodies[name].shape is None:
            continue
        for k, axis in enumerate("xy"):
            yield Variation(
                f"bodies.{name}.centre_{axis}", "known",
                f"the centre of mass of {name} is where it is stated",
                f"it were {1e3 * CENTRE:g} mm off along {axis}", 1e3 * CENTRE, "mm",
                vary=lambda r, mm, run, name=name, k=k: off_centre(
                    r, run, name, (1e-3 * mm * (k == 0), 1e-3 * mm * (k == 1))
                ),
            )  # fmt: skip


def of_pads(recording: Recording) -> Iterator[Variation]:
    """Sizes of blocks, places and angles of pads."""
    pads = recording.rig.pads
    blocks = [name for name, pad in pads.items() if type(pad.mesh) is PadMesh]
    groups = [blocks] if len(blocks) > 1 else []
    for names in (*groups, *([name] for name in blocks)):
        who = "pads" if len(names) > 1 else f"the pad {names[0]}"
        for extent, size, stays in (("height", KNOWN, "face"), ("length", LENGTH, "first end")):
            yield Variation(
                f"{extent} of {who}", "known", f"the {extent} of {who} is as stated",
                f"it were more, each {stays} being where it is", 100 * size, "%",
                vary=lambda r, part, run, names=names, extent=extent: resized(
                    r, names, extent, 1e-2 * part
                ),
            )  # fmt: skip
    for name in pads:
        yield Variation(
            f"place of the pad {name}", "known", f"the face of the pad {name} is where it should",
            "it were nearer to what touches it", 1e6 * PLACE, "um",
            vary=lambda r, um, run, name=name: lifted(r, name, 1e-6 * um),
        )  # fmt: skip
        yield Variation(
            f"tilt of the pad {name}", "known", f"the pad {name} lies at the angle stated",
            "it were turned anticlockwise", 1e3 * TILT, "mrad",
            vary=lambda r, mrad, run, name=name: tilted(r, name, 1e-3 * mrad),
        )  # fmt: skip


def of_actuators(recording: Recording) -> Iterator[Variation]:
    """Limits of controllers."""
    for name, one in recording.rig.actuators.items():
        if isinstance(undelayed(one), PD) and one.limit is None:
            yield Variation(
                f"limit of the controller {name}", "known",
                f"the controller {name} does not saturate",
                "it were cut off below its largest effort", 10.0, "%", one_sided=True,
                vary=lambda r, part, run, name=name: limited(r, run, name, part),
            )  # fmt: skip


def of_sensors(
    recording: Recording, unknown: Collection[str], sensors: Mapping[str, Sensor]
) -> Iterator[Variation]:
    """Faults of single channels, and of those that share an instrument."""
    units = {channel: recording.units[channel] for channel in sensors if channel in recording.units}
    for channel, unit in units.items():
        for kind in NUISANCES:
            if FAULTS[kind].clause and f"{kind} of {channel}" not in unknown:
                yield of_fault(recording, channel, sensors[channel], kind)
    for channel, unit in units.items():
        for other in (one for one, its in units.items() if its == unit and one != channel):
            yield Variation(
                f"crosstalk {other} to {channel}", "sensor", f"{channel} does not read {other}",
                f"it read a part of {other}", 100 * CROSSTALK, "%",
                read=lambda r, at, part, channel=channel, other=other: read_across(
                    r, at, channel, other, 1e-2 * part
                ),
            )  # fmt: skip
    places = [channel for channel, unit in units.items() if unit == "m"]
    if len(places) > 1:
        yield Variation(
            "scale of the camera", "sensor", f"{', '.join(places)} have one true scale",
            "they were all too large about their first sample", 100 * CROSSTALK, "%",
            read=lambda r, at, part: rescaled(r, at, places, 1e-2 * part),
        )  # fmt: skip
    for body, symbol in recording.rig.symbols.items():
        pair = f"x_{symbol}", f"y_{symbol}"
        if {*pair} <= {*places}:
            yield Variation(
                f"angle of the camera on {body}", "sensor",
                f"{pair[0]} and {pair[1]} are along the axes of the rig",
                "their camera were turned anticlockwise about its own axis", 1e3 * TILT, "mrad",
                read=lambda r, at, mrad, pair=pair: seen_askew(r, at, pair, 1e-3 * mrad),
            )  # fmt: skip


def of_fault(recording: Recording, channel: str, sensor: Sensor, kind: Nuisance) -> Variation:
    """A fault of a channel's sensor."""
    fault, duration = FAULTS[kind], max(recording.duration, 1e-9)
    step, own = fault.amount * fault.scale(sensor, duration), recording.units[channel]
    over = (duration, f"{own} over a recording") if fault.grows else (1.0, own)
    factor, unit = {"s": (1e3, "ms"), "1": (1e2, "%")}.get(fault.unit, over)
    return Variation(
        f"{kind} {channel}", "sensor", f"{channel} has no unknown {kind}",
        f"{channel} {fault.clause}", factor * step, unit, nominal=float(kind == "gain"), step=step,
        one_sided=fault.one_sided, fault=(channel, kind),
    )  # fmt: skip


def with_rig(recording: Recording, change: Callable[[Rig], None]) -> Recording:
    """The recording with a changed copy of its rig."""
    rig = deepcopy(recording.rig)
    change(rig)
    return replace(recording, rig=rig)


def remeshed(recording: Recording, finer: int, points: int) -> Recording | None:
    """Refine every pad's mesh by the factor `finer`, with other contact points; None where the
    start is a state of this mesh."""
    every = tuple(recording.rig.pads)
    return with_pads(recording, every, lambda pad: pad.remeshed(finer, points))


def shifted(recording: Recording, part: float) -> Recording:
    """Move every pad's mesh along its face by a fraction of an element."""

    def change(rig: Rig) -> None:
        for pad in rig.pads.values():
            step = part * pad.mesh.length / pad.mesh.elements_x * pad.axes[:, 0]
            pad.origin += step
            pad.positions += step

    return with_rig(recording, change)


def moved(recording: Recording, body: str, by: float = PLACE) -> Recording:
    """Start a body further right by a distance [m]."""
    start = recording.start
    assert isinstance(start, Standing)
    (x, *others), velocity = start.bodies[body]
    bodies = {**start.bodies, body: ((x + by, *others), velocity)}
    return replace(recording, start=start._replace(bodies=bodies))


def laws(rig: Rig) -> list[SoftContact]:
    """The distinct contact laws of a rig."""
    return list({id(contact.law): contact.law for contact in rig.contacts.values()}.values())


def coulomb(recording: Recording) -> Recording:
    """Replace smooth slip by Coulomb friction with the same coefficients."""

    def change(rig: Rig) -> None:
        made = dict[int, Coulomb]()
        for law in laws(rig):
            smooth = law.friction
            if isinstance(smooth, SmoothSlip):
                new = Coulomb(smooth.mu_s.item(), smooth.mu_k.item())
                law.friction = made.setdefault(id(smooth), new)

    return with_rig(recording, change)


def linear_pads(rig: Rig) -> list[str]:
    """Pads that could be neo-Hookean with the same numbers."""
    return [
        name
        for name, pad in rig.pads.items()
        if type(pad.material) is KelvinVoigt and not pad.inertial and not len(pad.material.added)
    ]


def at_finite_strain(recording: Recording) -> Recording | None:
    """Replace linear pads by neo-Hookean ones of the same moduli and retardation time; None where
    the start is a state of the pads as they were."""
    made = dict[int, NeoHookean]()

    def other(pad: Pad) -> Pad:
        old = pad.material
        assert isinstance(old, KelvinVoigt)
        E, nu, rho, tau, depth = (
            one.item() for one in (old.E, old.nu, old.rho, old.tau, old.depth)
        )
        return pad.made_of(made.setdefault(id(old), NeoHookean(E, nu, rho, tau, depth)))

    return with_pads(recording, linear_pads(recording.rig), other)


def signals_by_name(rig: Rig) -> dict[str, nn.Module]:
    """Signals of a rig's reference by name."""
    return {name.replace(":", "."): one for name, one in rig.reference.signals.items()}


def follow_also(rig: Rig, signals: Mapping[str, nn.Module]) -> None:
    """Replace signals of a rig's reference, or add them."""
    rig.reference = Reference(**(signals_by_name(rig) | dict(signals)))


def signals_of(recording: Recording) -> dict[str, nn.Module]:
    """Signals of a recording's reference by name."""
    return signals_by_name(recording.rig)


def with_reference(recording: Recording, **signals: nn.Module) -> Recording:
    """The recording with some signals replaced."""
    return with_rig(recording, lambda rig: follow_also(rig, signals))


def smoother(recording: Recording) -> Recording:
    """Join the recorded set-points by curves of fifth degree: what these change is about the error
    of cubics."""
    signals = {
        name: of_fifth_degree(one)
        for name, one in signals_of(recording).items()
        if isinstance(one, Sampled) and len(one.times) > 5
    }
    return with_reference(recording, **signals)


def of_fifth_degree(one: Sampled) -> Sampled:
    """The spline of fifth degree through values, or the curve through values, rates and the rates'
    slopes, as cubics of a quarter of their length."""
    t, y = one.times.numpy(), one.values.detach().numpy()
    if one.given is None:
        curve = make_interp_spline(t, y, k=5)
    else:
        rates = one.given.numpy()
        slopes = CubicSpline(t, rates)(t, 1)
        curve = BPoly.from_derivatives(t, np.stack((y, rates, slopes), 1))
    fine = np.append((t[:-1, None] + np.diff(t)[:, None] * np.arange(4) / 4).ravel(), t[-1])
    return signal(fine, curve(fine), curve(fine, 1))


def retimed(recording: Recording, rate: float, shift: float) -> Recording | None:
    """Evaluate every signal at rate * t + shift [s]; None where a signal is not piecewise
    polynomial."""
    signals = signals_of(recording)
    known = {name: one for name, one in signals.items() if isinstance(one, Piecewise)}
    if len(known) < len(signals):
        return None
    return with_reference(
        recording, **{name: Retimed(deepcopy(one), rate, shift) for name, one in known.items()}
    )


def led(recording: Recording, lead: float) -> Recording | None:
    """Place bodies in equilibrium at another time [s] before the first sample."""
    start = recording.start
    return (
        replace(recording, start=start._replace(lead=lead)) if isinstance(start, Standing) else None
    )


def delayed(recording: Recording, by: float) -> Recording | None:
    """Delay every signal by a time [s]; None where a signal is not piecewise polynomial."""
    return retimed(recording, 1.0, by)


def stretched(recording: Recording, part: float) -> Recording | None:
    """Change the rate of every signal by a relative amount from the first sample on; None where a
    signal is not piecewise polynomial."""
    return retimed(recording, 1 + part, -part * float(recording.times[0]))


def raised(recording: Recording, by: float) -> Recording | None:
    """Add a feed-forward force [N] to every feed-forward; None where a signal is not piecewise
    polynomial."""
    names = {a.feed_forward for a in recording.rig.actuators.values() if a.feed_forward is not None}
    known = {name: recording.rig.reference[name] for name in names}
    if not all(isinstance(one, Piecewise) for one in known.values()):
        return None
    signals = deepcopy(known)
    for one in signals.values():
        values: Tensor = one.values  # pyright: ignore[reportAssignmentType]
        values.data.add_(by)
    return with_reference(recording, **signals)


def _scaled(recording: Recording, part: float, run: Simulated, name: str) -> Recording:
    """Change a number of the rig by a part [%]."""

    @torch.no_grad()
    def change(rig: Rig) -> None:
        rig.parameter(name).mul_(1 + 1e-2 * part)

    return with_rig(recording, change)


def resized(
    recording: Recording, names: Collection[str], extent: str, part: float
) -> Recording | None:
    """Change the height or the length of blocks by a relative amount; their faces, and the ends at
    which their coordinates begin, stay where they are. None where the start is a state of the pads
    as they were."""

    def other(pad: Pad) -> Pad:
        old = pad.mesh
        assert isinstance(old, PadMesh)
        mesh = replace(old, **{extent: (1 + part) * getattr(old, extent)})
        corner = np.array([0.0, old.height - mesh.height])
        return pad.reshaped(mesh, pad.placed(corner))

    return with_pads(recording, names, other)


def lifted(recording: Recording, name: str, by: float) -> Recording | None:
    """Move a pad along its normal, towards what touches it, by a distance [m]; None where the start
    is a state of the pads as they were."""
    up = np.array([0.0, by])
    return with_pads(recording, [name], lambda pad: pad.reshaped(pad.mesh, pad.placed(up)))


def tilted(recording: Recording, name: str, angle: float) -> Recording | None:
    """Turn a pad about the middle of its face by an angle [rad]; None where the start is a state of
    the pads as they were."""

    def other(pad: Pad) -> Pad:
        middle = pad.placed(pad.mesh.nodes[pad.mesh.face].mean(0))
        c, s = np.cos(angle), np.sin(angle)
        arm = np.array([[c, -s], [s, c]]) @ (pad.origin.numpy() - middle)
        return pad.reshaped(pad.mesh, middle + arm, angle)

    return with_pads(recording, [name], other)


def with_pads(
    recording: Recording, names: Collection[str], other: Callable[[Pad], Pad]
) -> Recording | None:
    """Replace some pads, also those that numbers of contact laws follow; None where the start is a
    state of the pads as they were."""
    if not isinstance(recording.start, Standing):
        return None

    def change(rig: Rig) -> None:
        modules: nn.ModuleDict = rig.pads  # pyright: ignore[reportAssignmentType]
        made = dict[nn.Module, nn.Module]()
        for name in names:
            old, modules[name] = rig.pads[name], other(rig.pads[name])
            made[old] = modules[name]
        for part in rig.contacts.modules():  # pyright: ignore[reportAttributeAccessIssue]
            if isinstance(part, Matched):
                part.pads = nn.ModuleList(made.get(pad, pad) for pad in part.pads)

    return with_rig(recording, change)


# Forces along a run: what a fault adds to the forces of the rig as it is stated, computed from
# runs with what it added before


LEAST_EFFORT = 1e-6
"""Least limit [N or N.m] of a controller's effort."""

FIXED_POINT, CLOSE = 6, 3e-3
"""Most times that such forces are computed, and their relative change at which they are not once
more. To first order in a fault once is exact."""


def forces_converged(now: Array, before: Array | None) -> bool:
    """Whether forces (..., G) have converged."""
    return before is not None and float(np.abs(now - before).max()) <= CLOSE * np.abs(now).max()


def limited(recording: Recording, run: Simulated, name: str, part: float) -> Recording:
    """Cut off a controller's effort at a part [%] below the largest one of the run as stated, with
    which the limit moves."""
    made, channel = run(recording, True), recording.channels.index(effort_channel(name))
    effort, left = made.signals[:, channel], 1 - 1e-2 * part
    k = int(np.abs(effort).argmax())
    limit, tied = max(left * abs(effort[k]), LEAST_EFFORT), dict(recording.tied)
    if made.derivatives is not None:
        tied[f"actuators.{name}.limit"] = left * np.sign(effort[k]) * made.derivatives[k, channel]

    def change(rig: Rig) -> None:
        rig.actuators[name].limit = parameter(limit)

    return replace(with_rig(recording, change), tied=tied)


def signal(t: Array, *columns: Array) -> Sampled:
    """A signal through values, with rates if they are given, at times t (G,) [s]."""
    at, values, *rates = (torch.tensor(one, dtype=torch.float64) for one in (t, *columns))
    return Sampled(at, values, rates[0] if rates else None)


def off_centre(
    recording: Recording, run: Simulated, body: str, centre: tuple[float, float]
) -> Recording:
    """A body whose centre of mass is at a place [m] in the frame of its contour; coordinates are
    those of the contour.

    With c the place turned by the body's angle, its inertia adds -m c'' to the forces on the
    contour's centre, and its weight and inertia the moment c x m (g - r'' - c'').
    """
    made, symbol = recording, recording.rig.symbols[body]
    mass, gravity = recording.rig.bodies[body].mass.item(), recording.rig.gravity.item()
    weight, loads = np.array([0.0, -gravity * recording.rig.bodies[body].weighted]), None
    for _ in range(FIXED_POINT):
        at, before = run(made), loads

        def channel(name: str) -> Array:
            return at.signals[:, recording.channels.index(name)]  # noqa: B023

        angle, spin = channel(f"theta_{symbol}"), channel(rate_channel(f"theta_{symbol}"))
        speeds = [channel(rate_channel(f"{axis}_{symbol}")) for axis in "xy"]
        faster, *pulls = (CubicSpline(at.t, one)(at.t, 1) for one in (spin, *speeds))
        c = np.stack([np.cos(angle) * centre[0] - np.sin(angle) * centre[1],
                      np.sin(angle) * centre[0] + np.cos(angle) * centre[1]], -1)  # fmt: skip
        across = np.stack((-c[:, 1], c[:, 0]), -1)
        bent = faster[:, None] * across - spin[:, None] ** 2 * c
        force = -mass * bent
        free = mass * (weight - np.stack(pulls, -1) - bent)
        moment = c[:, 0] * free[:, 1] - c[:, 1] * free[:, 0]
        loads = np.column_stack((force, moment))
        made = with_loads(recording, at.t, body, loads)
        if forces_converged(loads, before):
            break
    return made


def with_loads(recording: Recording, t: Array, body: str, loads: Array) -> Recording:
    """A force and a moment (G, 3) [N, N, N.m] at times t (G,) [s] on a body."""

    def change(rig: Rig) -> None:
        actuators: nn.ModuleDict = rig.actuators  # pyright: ignore[reportAssignmentType]
        more = dict[str, nn.Module]()
        for axis, load in zip(COORDINATES, loads.T):
            name = f"load_{body}_{axis}"
            more[name] = signal(t, load)
            actuators[name] = Actuator(
                f"{body}.{axis}", f"{body}.{axis}", Load(), setpoint=(), feed_forward=name,
                elements=("Se: load",),
            )  # fmt: skip
        follow_also(rig, more)

    return with_rig(recording, change)


# Readings of channels


def read_across(recording: Recording, at: str, channel: str, other: str, part: float) -> Array:
    """What a channel's samples lose, if they read a part of another channel."""
    t, _ = recording.samples[at]
    if at != channel or other not in recording.samples:
        return np.zeros(len(t))
    return -part * np.interp(t, *recording.samples[other])


def rescaled(recording: Recording, at: str, channels: Collection[str], part: float) -> Array:
    """What a channel's samples lose, if they are too large about the first of them."""
    t, y = recording.samples[at]
    return -part * (y - y[0]) if at in channels else np.zeros(len(t))


def seen_askew(recording: Recording, at: str, pair: tuple[str, str], angle: float) -> Array:
    """What a channel's samples lose, if a camera that sees a `pair` of coordinates is turned
    anticlockwise by an angle [rad], about where the first samples are."""
    (x, y), (t, _) = pair, recording.samples[at]
    other, part = {x: (y, -angle), y: (x, angle)}.get(at, (at, 0.0))
    if part == 0.0 or other not in recording.samples:
        return np.zeros(len(t))
    times, z = recording.samples[other]
    return part * (np.interp(t, times, z) - z[0])
