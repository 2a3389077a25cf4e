"""Checks of recorded set-points: their spacing in time, and the agreement of rates with values.

A recorded signal is known at its rows only, with a cubic between them. The error of the cubic is
estimated from cubics through every second and every fourth row, whose larger errors show its order.
It is stated by its effect: the error of the set-point over the noise of that coordinate's sensor,
and that of the effort over the noise of the force.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.diagnostic import Diagnostic
from torchsoft.physics.motion import Sampled, spline_rates
from torchsoft.physics.parts import Actuator
from torchsoft.physics.rig import Rig
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.unknowns import Sensor


def found(code: str, recording: Recording, message: str, grave: bool = False) -> Diagnostic:
    """A diagnostic on one recording, an error if it is `grave`."""
    return Diagnostic(
        "error" if grave else "warning",
        recording.name,
        f"recording `{recording.name}`: {message}",
        code,
    )


def channel(rig: Rig, name: str) -> str:
    """Channel of a coordinate such as "disc.x", or of the effort of an actuator such as "x"."""
    body, _, axis = name.partition(".")
    own = f"{axis}_{rig.symbols[body]}" if axis else f"F_{body}"
    return rig.renamed.get(own, own)


NOTICED = 0.2
"""Error between rows, over a sensor's noise, above which a warning is given: residuals would be off
by it everywhere."""

HOPELESS, ORDERLESS = 100.0, 1.0
"""Error between rows, over a sensor's noise, that makes a fit worthless, if its order of
convergence is at most the second number."""

ORDERS = (0.5, 4.0)
"""Least and largest credible order of convergence; a cubic through exact values has the largest."""

PARTS = (0.0, 0.25, 0.5, 0.75)
"""Positions between rows at which signals are compared."""

OTHER_RATE = 0.25
"""Largest relative difference of a rate from that of the spline through the values, which must be
known to half of it."""


class Gap(NamedTuple):
    """Error between rows: rms [SI], over the noise of a channel, and its order of convergence."""

    channel: str
    error: float
    noises: float
    order: float


def cubic(signal: Sampled, every: int, derived: bool) -> Sampled:
    """The signal at every so-many-th row; rates that were `derived` from all rows are derived from
    these."""
    rates = None if derived else signal.rates.detach()[::every]
    return Sampled(signal.times[::every], signal.values.detach()[::every], rates)


def is_derived(signal: Sampled) -> bool:
    """Whether the rates are those of the spline through the values."""
    own = spline_rates(signal.times, signal.values)
    return bool(torch.allclose(own, signal.rates, rtol=1e-9, atol=1e-12))


def extrapolated(by: Mapping[int, Tensor]) -> tuple[float, float]:
    """RMS error of a quantity with every row, by Richardson extrapolation from every second and
    fourth row, and the observed order."""
    half, quarter = (float((by[2 * k] - by[k]).square().mean().sqrt()) for k in (1, 2))
    order = float(np.clip(np.log2(max(quarter, 1e-300) / max(half, 1e-300)), *ORDERS))
    return half / (2**order - 1), order


def gaps(recording: Recording, sensors: Mapping[str, Sensor], name: str) -> list[Gap]:
    """Errors between rows of an actuator's set-point, in the channels with sensors."""
    rig, out = recording.rig, []
    actuator = rig.actuators[name]
    signal = rig.reference[actuator.setpoint]
    if not isinstance(signal, Sampled) or len(signal.times) < 9:
        return []
    feed = rig.reference[actuator.feed_forward] if actuator.feed_forward else None
    t, derived = signal.times, is_derived(signal)
    inside = torch.cat([t[:-1] + part * t.diff() for part in PARTS]).sort().values
    inside = inside[inside <= t[4 * ((len(t) - 1) // 4)]]
    x, v = signal(inside)
    places, efforts = {}, {}
    for every in (1, 2, 4):
        places[every], rate = cubic(signal, every, derived)(inside)
        efforts[every] = demanded(actuator, feed, every, inside, places[every], rate, x, v)
    for own, by in ((channel(rig, actuator.measured), places), (channel(rig, name), efforts)):
        if own in sensors and own in recording.samples:
            error, order = extrapolated(by)
            out.append(Gap(own, error, error / sensors[own].sd, order))
    return out


@torch.no_grad()
def demanded(
    actuator: Actuator,
    feed: nn.Module | None,
    every: int,
    t: Tensor,
    place: Tensor,
    rate: Tensor,
    x: Tensor,
    v: Tensor,
) -> Tensor:
    """Effort (n,) of the controller for a set-point, with its coordinate at x and its rate at v."""
    known = cubic(feed, every, is_derived(feed)) if isinstance(feed, Sampled) else feed
    more = torch.zeros_like(x) if known is None else known(t)[0]
    return actuator(torch.stack((place, rate, more, x, v), -1))


def setpoint_findings(recording: Recording, sensors: Mapping[str, Sensor]) -> Iterator[Diagnostic]:
    """Diagnostics on the set-points of a recording. For controllers of several coordinates only
    rates are tested here."""
    rig = recording.rig
    recorded = {
        n
        for one in rig.actuators.values()
        for n in one.setpoints
        if isinstance(rig.reference[n], Sampled)
    }
    findings = {name: other_rate(recording, name) for name in sorted(recorded)}
    yield from (one for one in findings.values() if one is not None)
    for name, actuator in rig.loops.items():
        if actuator.setpoint in recorded and findings[actuator.setpoint] is None:
            sparse = sparse_finding(recording, sensors, name)
            if sparse is not None:
                yield sparse


def sparse_finding(
    recording: Recording, sensors: Mapping[str, Sensor], name: str
) -> Diagnostic | None:
    """Diagnostic on set-points that are too far apart in time."""
    gap_list = gaps(recording, sensors, name)
    if not gap_list or (worst := max(gap_list, key=lambda gap: gap.noises)).noises <= NOTICED:
        return None
    setpoint = recording.rig.actuators[name].setpoint
    signal = recording.rig.reference[setpoint]
    assert isinstance(signal, Sampled)
    apart = float(signal.times.diff().max())
    enough = apart * (NOTICED / worst.noises) ** (1 / worst.order)
    rates = f", and its rate is not known (no column {setpoint}_dot)" if is_derived(signal) else ""
    if worst.order <= ORDERS[0] and not is_derived(signal):  # closer rows would not help
        text = (
            f"values and rates of {setpoint} disagree however close the rows are, by "
            f"{worst.noises:.2g} times the noise of {worst.channel}: is a clock, or a unit of "
            "time, a little off?"
        )
        return found(f"rate of {setpoint}", recording, text, worst.noises > HOPELESS)
    size = (
        f"{worst.error:.2g} {recording.units[worst.channel]}, {worst.noises:.2g} times the noise "
        f"of {worst.channel}"
    )
    text = (
        f"set-points {setpoint} every {1e3 * apart:.3g} ms are too sparse for this motion"
        f"{rates}: what they leave open between them makes {size}; give them every "
        f"{1e3 * enough:.2g} ms"
    )
    return found(
        f"set-points {setpoint}",
        recording,
        text,
        grave=worst.noises > HOPELESS and worst.order <= ORDERLESS,
    )


def other_rate(recording: Recording, setpoint: str) -> Diagnostic | None:
    """Diagnostic on rates unlike those of the values."""
    signal = recording.rig.reference[setpoint]
    assert isinstance(signal, Sampled)
    times, values = signal.times, signal.values.detach()
    given, own = signal.rates.detach().numpy(), spline_rates(times, values).numpy()
    fewer = spline_rates(times[::2], values[::2]).numpy()
    size, off, unsure = (
        float(np.sqrt(np.mean(e**2))) for e in (own, given - own, fewer - own[::2])
    )
    if (
        off <= OTHER_RATE * max(size, float(np.sqrt(np.mean(given**2))))
        or unsure > OTHER_RATE / 2 * size
    ):
        return None
    factor = float(given @ own) / max(float(own @ own), 1e-300)
    looks = "its sign looks opposite" if factor < 0 else f"it is {factor:.3g} times that"
    text = (
        f"{setpoint}_dot is not the rate of {setpoint}: it differs by {off:.3g} rms from that "
        f"of a spline through it, {size:.3g}; {looks}"
    )
    return found(f"rate of {setpoint}", recording, text, grave=True)
