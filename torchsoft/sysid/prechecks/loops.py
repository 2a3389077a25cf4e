"""Do the measured force, the measured coordinate and the set-point of a control loop belong together?

The law of an actuator is known. So a recording that has its force and the coordinate that it measures is held against it
without a run: means over windows of time of both sides agree within the sensors' noise. Where they do not, one thing at a
time is taken to be otherwise: the sign of the force, the body that the loop senses, a zero, a factor, a time, what is fed
forward.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.parts import Actuator, coordinate_unit
from torchsoft.physics.rig import Rig
from torchsoft.sysid.prechecks.closed_loop import Loop, channel, sampled, windows
from torchsoft.sysid.prechecks.finding import Finding, confusions
from torchsoft.sysid.problem.recording import Array, Recording
from torchsoft.sysid.problem.unknowns import Sensor

ROUGH = 0.03
"""Part of the force by which both sides may differ besides the noise: drives are not exact."""

SURE = 5.0
"""Standard deviations from which a mean, a factor or a time is called different."""

EXPLAINED = 0.15
"""Part of a disagreement, and of the force, that may be left by what explains it."""

SLOW = 0.3
"""Part of a disagreement by which it may change from window to window where a force fed forward is missing."""

AS_GOOD = 1.15
"""What fits as well: so many times what the best leaves."""

LATE = 1e-3
"""Shift in time [s] from which something is said."""

SHIFTS = 41
"""Shifts in time that are tried, of which the best one is made better."""

RESIZED = 5.0
"""Largest factor on a force that is not one of mistaken units."""


class Change(NamedTuple):
    """One thing that may be otherwise: what, as a clause, what is left of the disagreement [N], and whether it is grave."""

    what: str
    said: str
    left: Array
    grave: bool = False


def rms(e: Array) -> float:
    return float(np.sqrt(np.mean(e**2)))


def loop_findings(
    recording: Recording, sensors: Mapping[str, Sensor], unknown: Collection[str] = ()
) -> Iterator[Finding]:
    """What looks wrong with the control loops of a recording whose force and coordinate were measured; `unknown` are the
    parameters whose values are not known."""
    rig = recording.rig
    tensors = {id(rig.parameter(name)) for name in unknown}
    for name, actuator in rig.loops.items():
        F = sampled(recording, sensors, name)
        loop = windows(recording, actuator, F, sampled(recording, sensors, actuator.measured))
        if loop is None:
            continue
        body, _, axis = actuator.measured.partition(".")
        others = {one: f"{one}.{axis}" for one in rig.bodies if one != body}
        rivals = {o: windows(recording, actuator, F, sampled(recording, sensors, x)) for o, x in others.items()}
        loop, rivals = with_its_lag(loop), {o: with_its_lag(its) for o, its in rivals.items() if its is not None}
        free = any(id(p) in tensors for p in actuator.parameters())
        found = disagreement_of_signs(rig, loop, body, rivals) if free else disagreement(rig, loop, body, rivals)
        if found is not None:
            e = loop.force() - loop.given(loop.asked(), loop.found())
            text = (
                f"recording `{recording.name}`: {found.said} (what the controller makes of {actuator.setpoint} and "
                f"{loop.x.channel} differs from {loop.F.channel} by {rms(e):.3g} {actuator.effort_unit} rms, and would by "
                f"{rms(found.left):.3g})"
            )
            yield Finding(found.what, recording.name, text, found.grave)


def with_its_lag(loop: Loop) -> Loop:
    """The loop with the force as late as fits best, of what its sensors declare."""
    reach = loop.F.sensor.delay + loop.x.sensor.delay
    given = loop.given(loop.asked(), loop.found())
    return replace(loop, lag=best_shift(loop, lambda late: loop.force(late) - given, reach)[0]) if reach > 0 else loop


def disagreement_of_signs(rig: Rig, loop: Loop, body: str, rivals: Mapping[str, Loop]) -> Change | None:
    """What is wrong with a loop about a body whose gains are not known: its sign, or what it senses."""
    F, given = loop.force(), loop.given(loop.asked(), loop.found())
    as_it_is, changes = rms(scaled(F, given)), [flipped(loop, F, given)._replace(left=scaled(-F, given))]
    for other, its in rivals.items():
        e = scaled(its.force(), its.given(its.asked(), its.found()))
        changes.append(another_sense(rig, loop.actuator, body, other, e))
    best = min(changes, key=left)
    clear = as_it_is > 2 * loop.noise.white + ROUGH * rms(F) and left(best) < 0.5 * min(as_it_is, rms(F))
    return best if clear else None


def scaled(F: Array, given: Array) -> Array:
    """What is left of forces if the law's gains may all be larger, or smaller."""
    return F - given * max(over(float(F @ given), float(given @ given)), 0.0)


def over(a: float, b: float) -> float:
    """a / b for b from zero on; large, where that is zero."""
    return a / max(b, 1e-300)


def disagreement(rig: Rig, loop: Loop, body: str, rivals: Mapping[str, Loop]) -> Change | None:
    """What is wrong with a loop about a body, if anything is."""
    F, given = loop.force(), loop.given(loop.asked(), loop.found())
    e, noise = loop.beyond(F - given), loop.noise
    limit, coloured = (2 * sd + ROUGH * rms(F) for sd in (noise.white, noise.coloured))
    if rms(e) <= limit:
        return fine(loop, F, given)
    changes = [flipped(loop, F, given)]
    for other, its in rivals.items():
        left_by_it = its.beyond(its.force() - its.given(its.asked(), its.found()))
        changes.append(another_sense(rig, loop.actuator, body, other, left_by_it))
    missing = fed_forward(loop, e) if loop.unfed or rms(e) > coloured else None
    if missing is not None and loop.unfed:
        return min((missing, *changes), key=left)
    changes += [*resized(loop, F, given), *feed_flipped(loop, F), *([offset(loop, e)] if is_off(loop, F, e) else [])]
    for more in (lambda: [], lambda: [shifted(loop)]):  # which takes longer
        changes += more()
        best = min(changes, key=left)
        if left(best) <= max(limit, EXPLAINED * min(rms(e), rms(F))) and left(best) < 0.5 * rms(e):
            return best
    if missing is not None or rms(e) <= coloured:
        return missing
    said = f"{loop.F.channel} is not what the controller gives: are its gains right, the units, and the set-points?"
    return Change(f"loop of {loop.F.channel}", said, e)


def left(change: Change) -> float:
    return rms(change.left)


def flipped(loop: Loop, F: Array, given: Array) -> Change:
    name = loop.F.channel
    return Change(f"sign of {name}", f"{name} looks as if its sign were opposite", loop.beyond(-F - given), True)


def another_sense(rig: Rig, actuator: Actuator, body: str, other: str, left: Array) -> Change:
    paper = isinstance(rig, SoftGrasp) and actuator.measured.endswith(".x")
    axis = actuator.measured.partition(".")[2]
    remedy = f' (say control.senses = "{other}")' if paper else ""
    said = (
        f"{actuator.setpoint} looks like the set-point of the {other}, not of the {body}{remedy}; or are "
        f"{channel(rig, f'{body}.{axis}')} and {channel(rig, f'{other}.{axis}')} exchanged?"
    )
    return Change("control.senses" if paper else f"what {actuator.setpoint} is of", said, left, True)


def offset(loop: Loop, e: Array) -> Change:
    """A constant more of the force, or of the coordinate."""
    loops, gain = loop.actuator, loop.noise.gain
    F, x, mean, unit, own = (
        loop.F.channel,
        loop.x.channel,
        float(e.mean()),
        loops.effort_unit,
        coordinate_unit(loops.measured),
    )
    zeros = f", or {x} and {loops.setpoint} have zeros {abs(mean) / gain:.3g} {own} apart" if gain > 0 else ""
    return Change(f"zero of {x}", f"{F} reads {mean:+.3g} {unit} too much{zeros}", e - mean)


def resized(loop: Loop, F: Array, given: Array) -> Iterator[Change]:
    """A factor on the force: of a mistaken unit, or not much of one."""
    g, name = over(float(F @ given), float(given @ given)), loop.F.channel
    for factor, words in confusions(loop.actuator.effort_unit):
        said = f"{name} looks as if it were in another unit: {words}"
        yield Change(f"unit of {name}", said, loop.beyond(F / factor - given), True)
    if 1 / RESIZED < g < RESIZED:
        said = f"{name} is {g:.4g} times what it should be: is that its gain, or the controller's?"
        yield Change(f"size of {name}", said, loop.beyond(F / g - given))


def feed_flipped(loop: Loop, F: Array) -> Iterator[Change]:
    """The opposite of what is fed forward."""
    if name := loop.actuator.feed_forward:
        given = loop.given(loop.asked() * [1, 1, -1], loop.found())
        yield Change(f"sign of {name}", f"{name} looks as if its sign were opposite", loop.beyond(F - given), True)


def best_shift(loop: Loop, rest: Callable[[float], Array], reach: float) -> tuple[float, Array]:
    """The shift in time [s], up to `reach` to each side, that leaves least of a disagreement, and what it leaves."""

    def still(late: float) -> Array:
        return loop.beyond(rest(late))[loop.inner]

    times = np.linspace(-reach, reach, SHIFTS)
    near, step = float(min(times, key=lambda late: rms(still(late)))), float(times[1] - times[0])
    found = minimize_scalar(lambda late: rms(still(late)), bounds=(near - step, near + step), options={"xatol": 1e-5})
    late = float(np.clip(found.x, -reach, reach))
    return late, still(late)


def shifted(loop: Loop) -> Change:
    """Samples of the force, of the coordinate, or set-points, that are late or early: one of them, or what fits as well."""
    asked, found, force = loop.asked(), loop.found(), loop.force()
    tried: dict[str, Callable[[float], Array]] = {
        loop.F.channel: lambda late: loop.force(late) - loop.given(asked, found),
        loop.x.channel: lambda late: force - loop.given(asked, loop.found(late)),
        loop.actuator.setpoint: lambda late: force - loop.given(loop.asked(late), found),
    }
    made = []
    for name, rest in tried.items():
        late, e = best_shift(loop, rest, loop.reach)
        made.append(Change(name, f"{name} is {1e3 * abs(late):.3g} ms {'late' if late > 0 else 'early'}", e))
    best = min(made, key=left)
    return best._replace(
        what=f"time of {best.what}", said=" or ".join(one.said for one in made if left(one) <= AS_GOOD * left(best))
    )


def fed_forward(loop: Loop, e: Array) -> Change | None:
    """A force that was fed forward and is not in the recording: a disagreement that is slow, and not there from the start."""
    name, F = loop.actuator.feed_forward, loop.F.channel
    slow, began = np.diff(e) / np.sqrt(2), float(e[: max(2, len(e) // 20)].mean())
    if name is None or rms(slow) > max(SLOW * rms(e), 2 * loop.noise.white) or abs(began) > 0.5 * rms(e):
        return None
    said = (
        f"{F} is {float(e.mean()):+.3g} {loop.actuator.effort_unit} more, on the average, than the controller gives: was a "
        f"force fed forward that {name} does not have?"
    )
    return Change(name, said, slow)


def inflated(e: Array) -> float:
    """How much larger the standard deviation of a mean of e (n,) is for their correlation: that of coloured noise, say."""
    d = e - e.mean()
    rho = np.correlate(d, d, "full")[len(d) - 1 :] / max(float(d @ d), 1e-300)
    until = int(np.argmax(rho <= 0)) if (rho <= 0).any() else len(rho)
    return float(np.sqrt(max(1.0, 1 + 2 * rho[1:until].sum())))


def is_off(loop: Loop, F: Array, e: Array) -> bool:
    """Whether the mean of a disagreement is not that of noise. Where nothing was fed forward, noise is taken to be white."""
    sd = loop.noise.white if loop.unfed else max(loop.noise.white, rms(e - e.mean())) * inflated(e)
    return bool(abs(e.mean()) > SURE * sd / np.sqrt(len(e)) + 0.02 * rms(F))


def fine(loop: Loop, F: Array, given: Array) -> Change | None:
    """A zero, a factor or a time that is off by more than its own uncertainty, where both sides agree roughly."""
    e = loop.beyond(F - given)
    noise = loop.noise.white * inflated(e)
    if is_off(loop, F, e):
        return fed_forward(loop, e) or offset(loop, e)
    off, by_noise = over(float(e @ given), float(given @ given)), over(noise, rms(given))
    if abs(off) > ROUGH + SURE * by_noise / np.sqrt(len(F)) + 2 * by_noise**2:
        return next((one for one in resized(loop, F, given) if not one.grave), None)
    slope = ((loop.force(LATE) - loop.force(-LATE)) / (2 * LATE))[loop.inner]
    late, sd = over(float(e[loop.inner] @ slope), float(slope @ slope)), over(noise, float(np.sqrt(slope @ slope)))
    if abs(late) > LATE + SURE * sd:
        return best if left(best := shifted(loop)) < 0.8 * rms(e) else None
    return None
