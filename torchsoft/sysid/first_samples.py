"""Initial state of a run from the first samples of its recording, which then do not count in the
fit.

Measured coordinates and their rates come from a cubic through the samples, with several times its
error and with the possible faults of the sensor. Stretches of contacts are anything that friction
can hold.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from torchsoft.display import suggestion
from torchsoft.physics.channels import measurable
from torchsoft.physics.contact import cross, point_place, slip_of
from torchsoft.physics.parts import COORDINATES, PD, Contact
from torchsoft.physics.rig import Rig
from torchsoft.physics.start import above
from torchsoft.physics.state import State
from torchsoft.physics.statics import NoEquilibrium, resting, settled
from torchsoft.sysid.extensions import undelayed
from torchsoft.sysid.initial_state import (
    LEAD,
    PREFIX,
    MovingStart,
    Normal,
    Stretch,
    along,
    free_coordinates,
    placed,
)
from torchsoft.sysid.prediction import partner
from torchsoft.sysid.recording import SAME, Array, Recording
from torchsoft.sysid.unknowns import Sensor

DEGREE = 3
"""Degree of the polynomial through the first samples of a channel."""

WIDER = 4.0
"""Standard deviation of a prior over the error of that polynomial, whose noise is estimated from a
few samples."""

BALANCED, FOLLOWED, SPEED = 2e-4, 1e-3, 0.05
"""Standard deviations without a sensor: of a body in balance on its pads [m], of a coordinate that
follows a set-point [m], of a rate by which the contacts roll [m/s]. Those of angles are over the
size of the body."""

SHORTEST, LONGEST = 1e-9, 1e-3
"""Standard deviations of stretches [m]: without friction, and where friction does not bound
them."""


def estimate_initial_state(
    recording: Recording,
    sensors: Mapping[str, Sensor],
    *,
    lead: float = LEAD,
    given: Mapping[str, Normal] | None = None,
) -> Recording:
    """The recording with a moving start at its first sample; the samples of the first `lead` [s]
    determine its initial state, and are left out.

    Coordinates that `sensors` do not measure are `given`, by mean and standard deviation under the
    names of `MovingStart.bodies`, or assumed: a coordinate measured by an actuator follows its
    set-point, a height is that at which the body is in balance on its pads or between them, the
    angle of a round body is zero, and other rates are those by which the contacts roll.

    Raises `ValueError` for fewer than four early samples of a channel or two later ones, a
    coordinate that is neither measured nor given nor can be assumed, a delay that may be longer
    than `lead`, and pads that cannot be settled.
    """
    rig, first, owner = recording.rig, float(recording.times[0]), f"recording `{recording.name}`"
    sensors = {rig.full(name): sensor for name, sensor in sensors.items()}
    every, early, late = recording.samples, {}, {}
    for name in given or {}:
        if name not in (known := free_coordinates(rig)):
            raise ValueError(f"`given` speaks of `{name}`; {suggestion(name, known, 'there are')}")
    for channel, (t, y) in every.items():
        kept = t >= first + lead - SAME
        late[channel] = t[kept], y[kept]
        if kept.sum() < 2:
            raise ValueError(
                f"{owner} has no two samples of `{channel}` left after `lead` = {lead:g} s"
            )
        if channel in sensors:
            early[channel] = t[~kept] - first, y[~kept]
            if (delay := sensors[channel].delay) > lead:
                raise ValueError(
                    f"`{channel}` may come late by {delay:g} s, but runs are known only from "
                    f"{lead:g} s before the samples that count; take a longer `lead`"
                )
    lead = min(float(t[0]) for t, _ in late.values()) - first
    efforts = [abs(y).max() for c, (_, y) in early.items() if recording.units[c] == "N"]
    weight = sum(one.mass.item() for one in rig.bodies.values()) * rig.gravity.item()
    load = float(max(efforts, default=weight))
    bodies = completed(rig, measured(rig, early, sensors, owner) | dict(given or {}), first, load)
    start = MovingStart(bodies, stretches(rig, bodies, first, lead), lead)
    return replace(recording, samples=late, start=start)


def measured(
    rig: Rig, early: Mapping[str, tuple[Array, Array]], sensors: Mapping[str, Sensor], owner: str
) -> dict[str, Normal]:
    """Coordinates and rates at time zero from the `early` samples, each by the most accurate
    channel."""
    names, found = free_coordinates(rig), dict[str, Normal]()
    for k, (name, channel) in enumerate(zip(names, measurable(rig))):
        if channel not in early:
            continue
        other = 0.0
        if sensors[channel].misalignment > 0:
            beside, _ = partner(rig, channel)
            other = float(np.abs(early[beside][1]).max()) if beside in early else np.inf
        fits = first_value(f"`{channel}` of {owner}", *early[channel], sensors[channel], other)
        mine = (name, *names[k + len(names) // 2 :][:1])  # a coordinate and its rate, or a rate
        for end, (mean, sd) in zip(mine, fits):
            if sd < found.get(end, (0.0, np.inf))[1]:
                found[end] = mean, sd
    return found


def first_value(
    subject: str, t: Array, y: Array, sensor: Sensor, other: float
) -> tuple[Normal, Normal]:
    """Value and rate at t = 0 of a channel, by a polynomial through the samples y (k,) at t (k,)
    [s]; `other` is the size of the perpendicular channel that a misaligned sensor sees. Raises
    `ValueError` for too few samples."""
    inside = ~sensor.saturated(y)
    t, y = t[inside], y[inside]
    if len(t) < DEGREE + 1:
        raise ValueError(
            f"{subject} has {len(t)} samples in the beginning, but at least {DEGREE + 1} are "
            "needed to tell where the run begins; take a longer `lead`"
        )
    degree, span = min(DEGREE, len(t) - 2), float(t[-1])
    V = np.vander(t / span, degree + 1, increasing=True)
    fit, *_ = np.linalg.lstsq(V, y, rcond=None)
    noise = max(sensor.sd, float(np.sqrt(np.sum((V @ fit - y) ** 2) / (len(t) - degree - 1))))
    sd = WIDER * noise * np.sqrt(np.diag(np.linalg.inv(V.T @ V)))
    value, rate, bend = fit[0], fit[1] / span, 2 * fit[2] / span**2
    turned = sensor.misalignment * other if sensor.misalignment > 0 else 0.0
    wrong = sensor.bias + sensor.gain * abs(value) + sensor.delay * abs(rate) + turned
    wrong_rate = sensor.drift + sensor.gain * abs(rate) + sensor.delay * abs(bend) + turned / span
    return (float(value), float(np.hypot(sd[0], wrong))), (
        float(rate),
        float(np.hypot(sd[1] / span, wrong_rate)),
    )


def completed(rig: Rig, known: Mapping[str, Normal], at: float, load: float) -> dict[str, Normal]:
    """All coordinates of the bodies at a time [s], from the known ones; loops deflect under a
    `load` [N]. Raises `ValueError` for a coordinate that is neither known nor can be assumed."""
    out, names, signals = dict(known), free_coordinates(rig), rig.follow(at).detach()
    pairs = [pair for a in rig.actuators.values() for pair in a.follows]
    followed = {coordinate: rig.signals.index(setpoint) for coordinate, setpoint in pairs}
    for name in sorted(names[: len(names) // 2], key=lambda name: name not in followed):
        body, axis = name.split(".")
        shape, size = rig.bodies[body].shape, reach(rig, body, axis)
        if name in out:
            continue
        if name in followed:
            value, rate = signals[followed[name]].tolist()
            sd = float(np.hypot(FOLLOWED / size, load * yielding(rig, name)))
            out = {f"{body}.v_{axis}": (rate, SPEED / size)} | out | {name: (value, sd)}
        elif axis == "theta" and shape is not None and shape.round:
            out[name] = 0.0, 0.0
        elif axis == "y" and (height := balanced(rig, body, out, signals)) is not None:
            out[name] = height, BALANCED
        else:
            raise ValueError(
                f"no sensor tells where `{name}` is when the run begins: give its mean and "
                "standard deviation"
            )
    missing = [name for name in names if name not in out]
    out |= rolling(rig, out, missing, signals)
    return {name: out[name] for name in names}


def balanced(rig: Rig, body: str, known: Mapping[str, Normal], signals: Tensor) -> float | None:
    """Height [m] of a body in balance on its pads, with others at their known places; None where
    these are not known, or there is no balance."""
    pose = {name: x.clone() for name, x in rig.held(signals)[0].items()}
    for name, axes in rig.layout.free.items():
        for i in axes:
            mean, _ = known.get(f"{name}.{COORDINATES[i]}", (0.0 if i == 2 else np.nan, 0.0))
            pose[name][i] = mean
    pose[body][1] = 0.0
    if any(bool(x.isnan().any()) for x in pose.values()):
        return None
    try:
        pose[body][1] = above(rig, pose, body)
        still = torch.zeros_like(signals)
        with torch.no_grad():
            return float(resting(rig, pose, {body: [1]}, signals=still, actuators=())[body][1])
    except NoEquilibrium:
        return None


def yielding(rig: Rig, coordinate: str) -> float:
    """Compliance of a coordinate's loop [m/N or rad/N], at the moment arm of its body for an angle;
    zero where no stiffness is known."""
    arm = reach(rig, *coordinate.split(".")) if coordinate.endswith(".theta") else 1.0
    gains = [
        law.Kp.item()
        for actuator in rig.actuators.values()
        if isinstance(law := undelayed(actuator), PD) and coordinate in dict(actuator.follows)
    ]
    return max((arm / gain for gain in gains if gain > 0), default=0.0)


def reach(rig: Rig, body: str, axis: str) -> float:
    """Divisor of a standard deviation in metres for a coordinate: the size of the body [m], or of
    the largest pad without a shape, for an angle; 1 otherwise."""
    shape = rig.bodies[body].shape
    pads = [0.5 * float(pad.mesh.length) for pad in rig.pads.values() if pad.base == body]
    if axis != "theta":
        return 1.0
    return shape.size() if shape is not None else max(pads, default=1.0)


def rolling(
    rig: Rig, known: Mapping[str, Normal], missing: list[str], signals: Tensor
) -> dict[str, Normal]:
    """The `missing` rates that minimise gliding at the touching points, weighted with their normal
    forces."""
    if not missing:
        return {}
    bodies = dict(known) | dict.fromkeys(missing, (0.0, 0.0))
    state = unstretched(rig, *placed(rig, signals, bodies, {}))
    forces, none = loads(rig, state), torch.zeros(len(missing), dtype=torch.float64)

    def glide(rates: Tensor) -> Tensor:
        """Weighted velocities of the bodies' points relative to the pads', linear in the missing
        rates."""
        values = {PREFIX + name: rate for name, rate in zip(missing, rates)}
        moving = state._replace(velocity=placed(rig, signals, bodies, values)[1])
        rows = [rates.new_zeros(1, 2)]
        for name, F_N in forces.items():
            pad = rig.contacts[name].pad
            u = rig.pads[pad].at_points(rig.displacement(pad, state))
            x = rig.point_inputs(name, moving, u, torch.zeros_like(u))
            v = x[:, 7:9] + x[:, 9:10] * cross(point_place(x)[0]) - x[:, 5:7]
            rows.append(F_N.sqrt()[:, None] * v)
        return torch.cat(rows).ravel()

    J: Tensor = torch.autograd.functional.jacobian(glide, none)  # pyright: ignore[reportAssignmentType]
    rates = np.linalg.lstsq(J.numpy(), -glide(none).detach().numpy(), rcond=None)[0]
    return {
        name: (float(rate), SPEED / reach(rig, *name.split(".v_")))
        for name, rate in zip(missing, rates)
    }


def unstretched(rig: Rig, pose: dict[str, Tensor], velocity: dict[str, Tensor]) -> State:
    """The state with pads settled around the bodies, without stretch. Raises `ValueError` where
    they do not settle."""
    none = {name: torch.zeros_like(rig.weight(name)) for name in rig.contacts}
    try:
        y = settled(rig, pose, velocity, none).detach()
    except (NoEquilibrium, NotImplementedError) as error:
        raise ValueError(f"the run cannot begin there: {error}") from None
    return rig.unpack(y)._replace(pose=pose, velocity=velocity)


def loads(rig: Rig, state: State) -> dict[str, Tensor]:
    """Normal forces (points,) [N] by contact, of bodies at rest there."""
    out = {}
    for name, contact in rig.contacts.items():
        g = rig.penetration(name, state).detach()
        still = torch.zeros_like(g)
        out[name] = contact.law(g, still, still, still, rig.weight(name)).F_N.detach()
    return out


def stretches(rig: Rig, bodies: Mapping[str, Normal], at: float, time: float) -> dict[str, Stretch]:
    """Possible stretches at the start of a run at the time `at` [s], with bodies at their means: of
    each contact at the loaded nodes and their neighbours, up to the stretch that friction holds for
    a `time` [s]."""
    out, state = {}, unstretched(rig, *placed(rig, rig.follow(at).detach(), bodies, {}))
    for name, F_N in loads(rig, state).items():
        contact, weight = rig.contacts[name], rig.weight(name)
        pad = rig.pads[contact.pad]
        loaded = np.flatnonzero((pad.interpolation[F_N > 0] != 0).any(0).numpy())
        if not len(loaded):
            continue
        places = np.sort(along(pad, pad.positions[pad.surface]))
        touched = np.searchsorted(places, along(pad, pad.positions[loaded]))
        near = places[max(touched.min() - 1, 0) : touched.max() + 2]
        out[name] = Stretch(
            tuple(near.tolist()), lasting_stretch(contact, float((F_N / weight).max()), time)
        )
    return out


def lasting_stretch(contact: Contact, F_N: float, time: float) -> float:
    """Largest stretch [m] that friction holds for a `time` [s], under a normal force [N] per
    reference spacing; mu_s F_N / K_t by Coulomb's law."""
    law = contact.law

    def slips(s: float) -> float:
        """Slip [m] of a stretch s in that time, less s."""
        N = torch.tensor(F_N, dtype=torch.float64)
        return float(slip_of(law.friction, law.K_t * s, N, law.R_t)[0]) * time - s

    with torch.no_grad():
        if slips(SHORTEST) > 0:
            return SHORTEST
        if slips(LONGEST) <= 0:
            return LONGEST
        return float(brentq(slips, SHORTEST, LONGEST, xtol=SHORTEST))  # pyright: ignore[reportArgumentType]
