"""What the stranger's simulator under `tests/foreign` gives for an excitation, kept on disk, and how a sensor samples it."""

import json
import sys
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from torchsoft import Parameters, Reference
from torchsoft.excitation import Chirp, Excitation, MultiSine, Press, Strokes, begin
from torchsoft.experiment import COARSE
from torchsoft.files import replacing
from torchsoft.sysid import RIG
from torchsoft.sysid.problem.recording import Array
from torchsoft.threads import parallel_map

TESTS = Path(__file__).parents[2] / "tests"
sys.path.insert(0, str(TESTS))

from foreign import Numbers, simulate  # noqa: E402  # pyright: ignore[reportMissingImports]

TRUTH = {
    "contact.K_n": 1.6e5, "contact.R_n": 300.0, "contact.K_t": 0.8e5, "contact.R_t": 600.0, "contact.mu_s": 0.65,
    "contact.mu_k": 0.5, "pad.E": 0.9e6, "pad.tau": 0.012,
}  # fmt: skip

SMOKE_UNKNOWNS = ("contact.mu_s", "contact.K_n", "pad.E", "pad.tau")

SIGNALS = ("x_d", "y_d", "F_ff")

SETTLE = 0.2
"""Time [s] that the rig is simulated before the first sample: the disc has been put down then."""

KEPT = 1e-3
"""Spacing [s] of the rows that are kept."""

RATE = 200.0
"""Samples a second."""


def excitations(smoke: bool) -> dict[str, Excitation]:
    """Motions of a second or so: three gentle ones, which show all eight parameters together, and hard ones."""
    if smoke:
        return {
            "pressing": Excitation(motion=Press(amplitude=4e-4, frequency=12.0, travel=8e-3), duration=0.7, grasp_time=0.15),
            "shaking": Excitation(
                motion=MultiSine(amplitude_x=6e-3, amplitude_y=2e-4, frequency=(4.0, 17.0)), duration=0.7, depth=4e-4,
                grasp_time=0.15,
            ),
        }  # fmt: skip
    shaking = MultiSine(amplitude_x=6e-3, amplitude_y=2e-4, frequency=(4.0, 20.0))
    return {
        "deep pressing": Excitation(
            motion=Press(amplitude=8e-4, frequency=17.0, travel=20e-3), duration=1.2, depth=2.5e-3
        ),
        "light shaking": Excitation(motion=shaking, duration=1.2, depth=3e-4),
        "light jerks": Excitation(motion=Strokes(travel=80e-3, stroke_time=0.2), duration=1.0, depth=2e-4),
        "deep chirp": Excitation(
            motion=Chirp(amplitude_x=5e-3, amplitude_y=5e-4, start=1.0, end=25.0), duration=1.3, depth=2.5e-3
        ),
        "hard shaking": Excitation(
            motion=MultiSine(amplitude_x=12.5e-3, amplitude_y=2e-4, frequency=(4.0, 20.0)), duration=1.2, depth=3e-4
        ),
    }


def nominal(smoke: bool) -> Parameters:
    """What the laboratory knows; the unknown numbers are the usual ones."""
    known = [name for name in TRUTH if name not in SMOKE_UNKNOWNS]
    less = COARSE | {name: TRUTH[name] for name in known} if smoke else {}
    return Parameters().override({"contact.v_s": 0.05} | less)


class Made(NamedTuple):
    """One run: times (n,) [s] every `KEPT`, channels (n,) by name, the fastest slip [m/s], and the wall time [s]."""

    t: Array
    channels: dict[str, Array]
    slip: float
    wall_s: float


class Order(NamedTuple):
    """One run that is to be made: an excitation by name, and how the rig differs, by the names of `foreign.Numbers`."""

    excitation: str
    differs: tuple[tuple[str, Any], ...] = ()


def planned(excitation: Excitation, smoke: bool) -> tuple[Parameters, Reference]:
    """What the laboratory has planned with the nominal numbers: settings and reference."""
    model = begin(excitation, nominal(smoke)).model
    return model.settings, model.reference


def numbers(settings: Parameters, differs: Mapping[str, Any]) -> Numbers:
    """The stranger's rig: the known numbers, the truth of the unknown ones, and what differs."""
    pad, contact, control = settings.pad, settings.contact, settings.control
    known = {
        "v_s": contact.v_s, "eta": contact.eta, "epsilon": contact.epsilon, "spacing": contact.node_spacing, "nu": pad.nu,
        "length": pad.length, "height": pad.height, "depth": pad.depth, "across": pad.elements_x, "through": pad.elements_y,
        "radius": settings.disc.radius, "mass": settings.disc.mass, "bracket_mass": settings.bracket.mass,
        "cm_height": settings.bracket.cm_height, "gravity": settings.scenario.gravity, "x_C0": settings.scenario.x_C0,
        "K_x": control.K_81, "R_x": control.R_80, "K_y": control.K_98, "R_y": control.R_99,
        "senses_disc": control.senses == "disc",
    }  # fmt: skip
    return Numbers(**known | {name.split(".")[1]: value for name, value in TRUTH.items()} | dict(differs))


def make(order: Order, step: float, smoke: bool, folder: Path) -> Made:
    """A run of the stranger's simulator, read where it has been made before: on steps of `step` and of twice that, extrapolated
    to none, for the error of backward Euler is of first order. The literal law jumps, and is not extrapolated."""
    fine = stepped(order, step, smoke, folder)
    if dict(order.differs).get("literal"):
        return fine
    coarse = stepped(order, 2 * step, smoke, folder)
    channels = {name: 2 * value - coarse.channels[name] for name, value in fine.channels.items()}
    return fine._replace(channels=channels, wall_s=fine.wall_s + coarse.wall_s)


def stepped(order: Order, step: float, smoke: bool, folder: Path) -> Made:
    """A run of the stranger's simulator on steps of `step` [s]."""
    excitation = excitations(smoke)[order.excitation]
    settings, reference = planned(excitation, smoke)
    p = numbers(settings, dict(order.differs))
    source = b"".join(path.read_bytes() for path in sorted((TESTS / "foreign").glob("*.py")))
    about = json.dumps([p._asdict(), excitation.model_dump(mode="json"), step])
    file = folder / f"{sha256(about.encode() + source).hexdigest()[:16]}.npz"
    if not file.is_file():
        count = round((excitation.duration + SETTLE) / step)
        t = step * (np.arange(count + 1) - round(SETTLE / step))
        signals = reference(torch.from_numpy(t), SIGNALS).detach().numpy()
        began = perf_counter()
        run = simulate(p, t, signals, round(KEPT / step))
        rows = {"t": run.t, "slip": run.slip, "wall_s": np.array(perf_counter() - began), **run.channels}
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(file) as partial, partial.open("wb") as stream:
            np.savez(stream, **rows)
    with np.load(file) as kept:
        rows = {name: kept[name] for name in kept.files}
    t, slip, wall = rows.pop("t"), rows.pop("slip"), float(rows.pop("wall_s"))
    return Made(t, rows, float(slip.max()), wall)


def make_all(orders: Sequence[Order], step: float, smoke: bool, folder: Path, workers: int) -> dict[Order, Made]:
    """All runs, side by side in threads."""
    every = list(dict.fromkeys(orders))
    work = parallel_map(lambda i: make(every[i], step, smoke, folder), len(every), workers)
    return {every[i]: made for i, made in tqdm(work, desc="recordings", total=len(every), unit=" runs")}


Samples = dict[str, tuple[Array, Array]]
"""Times (k,) [s] and values (k,) by channel."""


def sampled(made: Made, seed: int, delay: Mapping[str, float], colour: float) -> Samples:
    """What the sensors `RIG` give at `RATE` from t = 0 on, some of them late by a `delay` [s] (a multiple of `KEPT`).

    Their noise has their own deviation and the first autocorrelation `colour`; it is the same for the same seed.
    """
    rng, out = np.random.default_rng(seed), {}
    every, first = round(1 / RATE / KEPT), int(np.searchsorted(made.t, -0.5 * KEPT))
    for channel, sensor in RIG.items():
        at = np.arange(first, len(made.t), every)
        white = rng.standard_normal(len(at))
        noise = white.copy()
        for i in range(1, len(at)):
            noise[i] = colour * noise[i - 1] + np.sqrt(1 - colour**2) * white[i]
        exact = made.channels[channel][at - round(delay.get(channel, 0.0) / KEPT)]
        out[channel] = (made.t[at], exact + sensor.noise * noise)
    return out
