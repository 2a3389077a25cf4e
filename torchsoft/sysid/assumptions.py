"""Assumptions of an identification: numerical constants, known parameters, properties of sensors,
laws; and a variation of each.

A variation changes the recordings or their parameters as if one assumption were wrong by a stated
amount.
"""

from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

from torch import Tensor, nn

from torchsoft.physics.contact import Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.extensions import extensions
from torchsoft.physics.motion import Piecewise, Reference, Retimed, Sampled
from torchsoft.physics.rig import Rig
from torchsoft.sysid.initial_state import SETTLE, Standing
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.unknowns import Nuisance, Sensor
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

FORCE = 0.5
"""Variation of feed-forward forces [N]."""

CLOCK, SLOWER = 1e-4, 1e-4
"""Variation of the time of set-points [s], and of the rate of their clock [1]."""

NEAR, WIDEST = 5.0, 5.0
"""Number of variation amounts, by the test to first order, within which a new fit searches for a
known parameter, and the largest factor on that range."""


class Fault(NamedTuple):
    """A possible fault of a sensor that is not among the unknowns: its amount in a variation, the
    unit of the amount, and its name in a sentence."""

    amount: float
    per: str
    verb: str

    def size(self, sensor: Sensor, recording: Recording) -> float:
        """The amount in SI units."""
        noise = {"noise": sensor.noise, "noise/s": sensor.noise / max(recording.duration, 1e-9)}
        return self.amount * noise.get(self.per, 1.0)

    def assumption(
        self, channel: str, kind: Nuisance, unit: str, sensor: Sensor, recording: Recording
    ) -> "Variation":
        scale = {"s": (1e3, "ms"), "1": (1e2, "%"), "noise": (sensor.noise, unit)}
        factor, shown = scale.get(self.per, (sensor.noise, f"{unit} over a recording"))
        return Variation(
            f"{kind} {channel}",
            "sensor",
            f"{channel} has no unknown {kind}",
            f"{channel} {self.verb}",
            factor * self.amount,
            shown,
            nominal=float(kind == "gain"),
            step=self.size(sensor, recording),
            fault=(channel, kind),
        )


FAULTS: dict[Nuisance, Fault] = {
    "bias": Fault(0.1, "noise", "read too much"),
    "delay": Fault(1e-4, "s", "came late"),
    "gain": Fault(1e-3, "1", "were too sensitive"),
    "drift": Fault(0.1, "noise/s", "drifted upwards"),
    "clock": Fault(1e-4, "1", "ran too fast"),
}
"""Faults of sensors that are tested where they are not unknowns."""


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
    """An assumption with its variation: `vary` gives the varied recording, None where the variation
    does not apply to it, and `by` does so for any amount [unit]. An `extension` is a parameter that
    the rig does not have yet; a `fault` belongs to a channel's sensor."""

    vary: Callable[[Recording], Recording | None] | None = None
    by: Callable[[Recording, float], Recording | None] | None = None
    extension: bool = False
    fault: tuple[str, Any] | None = None

    def of(self, amount: float) -> "Variation":
        """The variation by another amount, if it has one; the range of a known parameter becomes
        wider for a large amount."""
        by = self.by
        if self.parameter and not self.extension:
            wider = min(max(abs(amount / self.amount) / NEAR, 1.0), WIDEST)
            return replace(self, amount=wider * self.amount, step=wider * self.step)
        if by is None:
            return self
        return replace(self, amount=amount, vary=lambda recording: by(recording, amount))

    @property
    def label(self) -> str:
        """Label of the coordinate for this assumption, if it were an unknown; empty for a law."""
        return f"{self.fault[1]} of {self.fault[0]}" if self.fault is not None else self.parameter


def assumptions(recordings: Iterable[Recording], unknown: set[str]) -> list[Variation]:
    """All assumptions of the runs of some recordings that can be varied; `unknown` are the
    identified parameters and coordinates of starts."""
    first, *others = recordings
    rig = first.rig
    pad = next(iter(rig.pads.values()))
    nx, ny, points = pad.mesh.elements_x, pad.mesh.elements_y, pad.points
    at = f"{points} points an element" if points else "on the nodes"
    out = [
        Variation(
            "mesh",
            "numerical",
            f"the pads have {nx} x {ny} elements",
            f"they had {2 * nx} x {2 * ny}",
            vary=lambda r: remeshed(r, 2, points),
        ),
        Variation(
            "contact points",
            "numerical",
            f"contact is computed {at}",
            f"it were at {points + 2} points an element",
            vary=lambda r: remeshed(r, 1, points + 2),
        ),
        Variation(
            "mesh phase",
            "numerical",
            "a node lies where the mesh puts it",
            "nodes lay a quarter of an element on",
            vary=lambda r: shifted(r, 0.25),
        ),
    ]
    if any(isinstance(one, Sampled) for one in rig.reference.signals.values()):
        out.append(
            Variation(
                "set-points",
                "numerical",
                "set-points are what a smooth curve through the recorded ones says",
                "only every second one were known",
                vary=sparser,
            )
        )
    out += [
        Variation("clock of the set-points", "known", "set-points and sensors have one clock",
                  "set-points came later", 1e3 * CLOCK, "ms", vary=lambda r: delayed(r, CLOCK),
                  by=lambda r, amount: delayed(r, 1e-3 * amount)),
        Variation("scale of the clock", "known", "clocks of set-points and sensors run alike",
                  "that of the set-points ran slower", 100 * SLOWER, "%",
                  vary=lambda r: stretched(r, SLOWER),
                  by=lambda r, amount: stretched(r, 1e-2 * amount)),
    ]  # fmt: skip
    if any(actuator.feed_forward is not None for actuator in rig.actuators.values()):
        out.append(
            Variation(
                "feed-forward",
                "known",
                "what was fed forward is known",
                f"it were {FORCE} N more",
                FORCE,
                "N",
                vary=lambda r: raised(r, FORCE),
                by=raised,
            )
        )
    if isinstance(first.start, Standing):
        lead, other = first.start.lead, 0.0 if first.start.lead else SETTLE
        stated = f"bodies were put where they stand {lead:g} s before the first sample (lead)"
        out.append(
            Variation("lead", "law", stated, f"it were {other:g} s", vary=partial(led, lead=other))
        )
    if any(isinstance(law.friction, SmoothSlip) for law in laws(rig)):
        out.append(
            Variation(
                "Coulomb friction",
                "law",
                'slip is smooth (friction "smooth")',
                "it were Coulomb's",
                vary=coulomb,
            )
        )
    pushed = {one.pushes for one in rig.actuators.values()}
    for name, axes in rig.layout.free.items() if isinstance(first.start, Standing) else ():
        if 0 in axes and f"{name}.x" not in pushed and f"start.{name}.x" not in unknown:
            stated = f"{name} begins where the start says"
            otherwise, by = f"it began {1e6 * PLACE:g} um further right", partial(moved, body=name)
            out.append(
                Variation(
                    f"start of {name}.x",
                    "known",
                    stated,
                    otherwise,
                    1e6 * PLACE,
                    "um",
                    vary=by,
                    by=lambda r, amount, name=name: moved(r, name, 1e-6 * amount),
                )
            )
    for name, value in first.parameters.items():
        if name in unknown or value == 0.0 or name.startswith("start.") or "fixed" in name:
            continue
        part = RADIUS if name.endswith("radius") else KNOWN
        out.append(
            Variation(
                name,
                "known",
                f"{name} is {value:.6g}",
                f"{name} were {(1 + part) * value:.6g}",
                100 * part,
                "%",
                parameter=name,
                nominal=value,
                step=part * value,
            )
        )
    for name, one in extensions(rig).items():
        if ".slow(" not in name or all(isinstance(r.start, Standing) for r in (first, *others)):
            out.append(
                Variation(
                    name,
                    "known",
                    one.stated,
                    one.otherwise,
                    one.amount,
                    one.unit,
                    parameter=name,
                    nominal=one.neutral,
                    step=one.amount,
                    one_sided=one.low == one.neutral,
                    extension=True,
                )
            )
    return out


def with_rig(recording: Recording, change: Callable[[Rig], None]) -> Recording:
    """The recording with a changed copy of its rig."""
    rig = deepcopy(recording.rig)
    change(rig)
    return replace(recording, rig=rig)


def remeshed(recording: Recording, finer: int, points: int) -> Recording | None:
    """Refine every pad's mesh by the factor `finer`, with other contact points; None where the
    start is a state of this mesh."""
    if not isinstance(recording.start, Standing):
        return None

    def change(rig: Rig) -> None:
        modules: nn.ModuleDict = rig.pads  # pyright: ignore[reportAssignmentType]
        for name, pad in rig.pads.items():
            modules[name] = pad.remeshed(finer, points)

    return with_rig(recording, change)


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
        for law in laws(rig):
            smooth = law.friction
            if isinstance(smooth, SmoothSlip):
                law.friction = Coulomb(smooth.mu_s.item(), smooth.mu_k.item())

    return with_rig(recording, change)


def signals_of(recording: Recording) -> dict[str, nn.Module]:
    """Signals of a recording's reference by name."""
    return {name.replace(":", "."): one for name, one in recording.rig.reference.signals.items()}


def with_reference(recording: Recording, **signals: nn.Module) -> Recording:
    """The recording with some signals replaced."""

    def change(rig: Rig) -> None:
        rig.reference = Reference(**(signals_of(recording) | signals))

    return with_rig(recording, change)


def sparser(recording: Recording) -> Recording:
    """Omit every second set-point of the recorded signals."""
    signals = {
        name: Sampled(one.times[::2], one.values[::2])
        for name, one in signals_of(recording).items()
        if isinstance(one, Sampled) and len(one.times) > 3
    }
    return with_reference(recording, **signals)


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
    """Add a feed-forward force [N] to every actuator; None where a signal is not piecewise
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
