"""Alternatives to a recording as it is stated: the same run with another mesh, law, place, clock or
camera.

Every function takes a recording and, if it has one, an amount [SI], and returns the changed
recording, or None where the alternative has no meaning for it.
"""

from collections.abc import Callable, Collection, Mapping
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from scipy.interpolate import BPoly, CubicSpline, make_interp_spline
from torch import Tensor, nn

from torchsoft.physics.contact import Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.hyperelastic import NeoHookean
from torchsoft.physics.matched import Matched
from torchsoft.physics.material import KelvinVoigt
from torchsoft.physics.mesh import PadMesh
from torchsoft.physics.motion import Piecewise, Reference, Retimed, Sampled
from torchsoft.physics.pads import Pad
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import parameter
from torchsoft.physics.shapes.eccentric import Eccentric
from torchsoft.sysid.initial_state import Standing
from torchsoft.sysid.recording import Array, Recording

LEAST_LIMIT = 1e-6
"""Least limit [N or N.m] of a controller's effort."""


def with_rig(recording: Recording, change: Callable[[Rig], None]) -> Recording:
    """The recording with a changed copy of its rig."""
    rig = deepcopy(recording.rig)
    with torch.no_grad():
        change(rig)
    return replace(recording, rig=rig)


def scaled(recording: Recording, part: float, name: str) -> Recording:
    """Change a parameter of the rig by a relative amount."""

    def change(rig: Rig) -> None:
        rig.parameter(name).mul_(1 + part)

    return with_rig(recording, change)


# Laws


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
    """Pads that could be neo-Hookean with the same moduli."""
    return [
        name
        for name, pad in rig.pads.items()
        if type(pad.material) is KelvinVoigt and not pad.inertial and not len(pad.material.added)
    ]


def at_finite_strain(recording: Recording) -> Recording | None:
    """Replace linear pads by neo-Hookean ones of the same moduli and retardation time."""
    made = dict[int, NeoHookean]()

    def other(pad: Pad) -> Pad:
        old = pad.material
        assert isinstance(old, KelvinVoigt)
        E, nu, rho, tau, depth = (
            one.item() for one in (old.E, old.nu, old.rho, old.tau, old.depth)
        )
        return pad.made_of(made.setdefault(id(old), NeoHookean(E, nu, rho, tau, depth)))

    return with_pads(recording, linear_pads(recording.rig), other)


def led(recording: Recording, lead: float) -> Recording | None:
    """Place bodies in equilibrium at another time [s] before the first sample."""
    start = recording.start
    if not isinstance(start, Standing):
        return None
    return replace(recording, start=start._replace(lead=lead))


# Pads and bodies


def with_pads(
    recording: Recording, names: Collection[str], other: Callable[[Pad], Pad]
) -> Recording | None:
    """Replace some pads, also those that parameters of contact laws follow; None where the start is
    a state of the pads as they were."""
    if not isinstance(recording.start, Standing) or not {*names} <= {*recording.rig.pads}:
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


def remeshed(recording: Recording, finer: int, more: int) -> Recording | None:
    """Refine every pad's mesh by the factor `finer`, with so many `more` contact points an
    element."""
    every = tuple(recording.rig.pads)
    return with_pads(recording, every, lambda pad: pad.remeshed(finer, pad.points + more))


def shifted(recording: Recording, part: float) -> Recording:
    """Move every pad's mesh along its face by a fraction of an element."""

    def change(rig: Rig) -> None:
        for pad in rig.pads.values():
            step = part * pad.mesh.length / pad.mesh.elements_x * pad.axes[:, 0]
            pad.origin += step
            pad.positions += step

    return with_rig(recording, change)


def resized(
    recording: Recording, part: float, names: Collection[str], extent: str
) -> Recording | None:
    """Change the height or the length of blocks by a relative amount; their faces, and their first
    ends, stay where they are."""

    def other(pad: Pad) -> Pad:
        old = pad.mesh
        assert isinstance(old, PadMesh)
        mesh = replace(old, **{extent: (1 + part) * getattr(old, extent)})
        corner = np.array([0.0, old.height - mesh.height])
        return pad.reshaped(mesh, pad.placed(corner))

    return with_pads(recording, names, other)


def lifted(recording: Recording, by: float, name: str) -> Recording | None:
    """Move a pad along its normal, towards what touches it, by a distance [m]."""
    up = np.array([0.0, by])
    return with_pads(recording, [name], lambda pad: pad.reshaped(pad.mesh, pad.placed(up)))


def tilted(recording: Recording, angle: float, name: str) -> Recording | None:
    """Turn a pad about the middle of its face by an angle [rad]."""

    def other(pad: Pad) -> Pad:
        middle = pad.placed(pad.mesh.nodes[pad.mesh.face].mean(0))
        c, s = np.cos(angle), np.sin(angle)
        arm = np.array([[c, -s], [s, c]]) @ (pad.origin.numpy() - middle)
        return pad.reshaped(pad.mesh, middle + arm, angle)

    return with_pads(recording, [name], other)


def moved(recording: Recording, by: float, body: str) -> Recording | None:
    """Start a body further right by a distance [m]."""
    start = recording.start
    if not isinstance(start, Standing) or body not in start.bodies:
        return None
    (x, *others), velocity = start.bodies[body]
    bodies = {**start.bodies, body: ((x + by, *others), velocity)}
    return replace(recording, start=start._replace(bodies=bodies))


def off_centre(recording: Recording, by: float, body: str, axis: int) -> Recording | None:
    """Put a body's centre of mass at a distance [m] along an axis of its contour.

    Coordinates of the changed rig are those of the centre of mass, and so are the changed samples:
    None without samples of the angle, and with samples of the body's speeds.
    """
    start, symbol = recording.start, recording.rig.symbols.get(body, body)
    turn, speeds = f"theta_{symbol}", (f"v_x_{symbol}", f"v_y_{symbol}")
    if not isinstance(start, Standing) or turn not in recording.samples or body not in start.bodies:
        return None
    if any(speed in recording.samples for speed in speeds):
        return None
    centre = by * np.eye(2)[axis]

    def change(rig: Rig) -> None:
        shape, (x, y) = rig.bodies[body].shape, centre.tolist()
        assert shape is not None
        rig.bodies[body].shape = Eccentric(shape, x, y)

    (x, y, angle), (v_x, v_y, spin) = start.bodies[body]
    (c_x,), (c_y,) = rotated(centre, np.array([angle]))
    pose, velocity = (x + c_x, y + c_y, angle), (v_x - spin * c_y, v_y + spin * c_x, spin)
    samples, angles = dict(recording.samples), recording.samples[turn]
    for k, channel in enumerate((f"x_{symbol}", f"y_{symbol}")):
        if channel in samples:
            t, measured = samples[channel]
            samples[channel] = t, measured + rotated(centre, np.interp(t, *angles))[k]
    bodies = {**start.bodies, body: (pose, velocity)}
    changed = replace(recording, samples=samples, start=start._replace(bodies=bodies))
    return with_rig(changed, change)


def rotated(v: Array, angle: Array) -> tuple[Array, Array]:
    """Components (k,) of a vector (2,) turned by angles (k,) [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return c * v[0] - s * v[1], s * v[0] + c * v[1]


# Controllers and set-points


def limited(recording: Recording, part: float, name: str, largest: float) -> Recording | None:
    """Cut a controller's effort off at a part below its `largest` one [N or N.m]."""
    if name not in recording.rig.actuators:
        return None

    def change(rig: Rig) -> None:
        rig.actuators[name].limit = parameter(max((1 - part) * largest, LEAST_LIMIT))

    return with_rig(recording, change)


def signals_of(rig: Rig) -> dict[str, nn.Module]:
    """Signals of a rig's reference by name."""
    return {name.replace(":", "."): one for name, one in rig.reference.signals.items()}


def with_signals(recording: Recording, signals: Mapping[str, nn.Module]) -> Recording:
    """The recording with some signals replaced."""

    def change(rig: Rig) -> None:
        rig.reference = Reference(**(signals_of(rig) | dict(signals)))

    return with_rig(recording, change)


def smoother(recording: Recording) -> Recording:
    """Join the recorded set-points by curves of fifth degree: the difference is about the error of
    cubics."""
    signals = {
        name: of_fifth_degree(one)
        for name, one in signals_of(recording.rig).items()
        if isinstance(one, Sampled) and len(one.times) > 5
    }
    return with_signals(recording, signals)


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
    values, rates = (torch.from_numpy(curve(fine, k)) for k in (0, 1))
    return Sampled(torch.from_numpy(fine), values, rates)


def retimed(recording: Recording, rate: float, shift: float) -> Recording | None:
    """Let the value of every signal at t come at rate * t + shift [s]; None where one is not
    piecewise polynomial."""
    signals = signals_of(recording.rig)
    known = {name: one for name, one in signals.items() if isinstance(one, Piecewise)}
    if len(known) < len(signals):
        return None
    later = {name: Retimed(deepcopy(one), rate, shift) for name, one in known.items()}
    return with_signals(recording, later)


def delayed(recording: Recording, by: float) -> Recording | None:
    """Delay every signal by a time [s]."""
    return retimed(recording, 1.0, by)


def stretched(recording: Recording, part: float) -> Recording | None:
    """Change the rate of every signal by a relative amount from the first sample on."""
    return retimed(recording, 1 + part, -part * float(recording.times[0]))


def raised(recording: Recording, by: float) -> Recording | None:
    """Add a force [N] to every feed-forward; None where one is not piecewise polynomial."""
    names = {a.feed_forward for a in recording.rig.actuators.values() if a.feed_forward is not None}
    known = {name: recording.rig.reference[name] for name in names}
    if not all(isinstance(one, Piecewise) for one in known.values()):
        return None
    signals = deepcopy(known)
    for one in signals.values():
        values: Tensor = one.values  # pyright: ignore[reportAssignmentType]
        values.data.add_(by)
    return with_signals(recording, signals)


# Cameras


def zoomed(
    recording: Recording, part: float, channels: Collection[str], about_start: bool
) -> Recording:
    """Correct the scale of a camera whose readings are too large by a part, about zero or about its
    first samples."""
    samples = dict(recording.samples)
    for channel in samples.keys() & {*channels}:
        t, y = samples[channel]
        zero = y[0] if about_start else 0.0
        samples[channel] = t, y - part * (y - zero)
    return replace(recording, samples=samples)


def turned(recording: Recording, angle: float, pair: tuple[str, str]) -> Recording:
    """Correct a camera that sees a pair of coordinates and is turned anticlockwise by an angle
    [rad], about its first samples."""
    samples = dict(recording.samples)
    for channel, other, part in ((*pair, -angle), (*pair[::-1], angle)):
        if pair[0] in samples and pair[1] in samples:
            (t, y), (times, z) = (recording.samples[name] for name in (channel, other))
            samples[channel] = t, y + part * (np.interp(t, times, z) - z[0])
    return replace(recording, samples=samples)
