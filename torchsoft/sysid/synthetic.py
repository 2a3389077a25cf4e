"""Synthetic recordings by the simulator, with a known truth."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch

from torchsoft.physics.channels import measurable, units
from torchsoft.physics.rig import Rig
from torchsoft.rigs.built import BuiltRig
from torchsoft.sysid.initial_state import Standing, Start
from torchsoft.sysid.prediction import predict
from torchsoft.sysid.recording import Grid, Recording
from torchsoft.sysid.unknowns import Sensor, by_channel

NOISE = {"m": 1e-5, "rad": 5e-4, "N": 0.1, "N.m": 1e-3}
"""Noise of good sensors by the unit of what they measure."""


def good_sensors(rig: Rig) -> dict[str, Sensor]:
    """Sensors of all free coordinates and efforts of a rig, to 10 um, 0.5 mrad, 0.1 N and
    1 N.mm."""
    known = units(rig)
    return {
        name: Sensor(noise=NOISE[known[name]]) for name in measurable(rig) if known[name] in NOISE
    }


RTOL = 1e-6
"""Relative tolerance of the runs behind synthetic recordings, a tenth of a fit's."""


def record(
    name: str,
    planned: BuiltRig,
    truth: Mapping[str, float] | Rig,
    sensors: Mapping[str, Sensor],
    *,
    start: Start | None = None,
    rate: float = 200.0,
    rtol: float = RTOL,
    noise: float = 1.0,
    seed: int | np.random.Generator = 0,
) -> Recording:
    """A synthetic recording of a rig with the parameters of the `truth`, which follows the motion
    `planned`.

    `planned` is the result of `RigFile.build`; `truth` holds parameters that differ, by the names
    of `Rig.parameter`, or is a rig with other laws and the same pads. The run starts at `start`, by
    default with bodies that stand, or rest, as planned. Samples are taken at `rate` [Hz] from a run
    with the tolerance `rtol`, with Gaussian noise of `noise` times each sensor's own. The recording
    holds nothing of the truth but the samples. Raises `ValueError` for an unknown name or channel,
    and `SimulationFailed`.
    """
    rig, _, t = planned
    sensors = by_channel([rig], sensors)
    initial = start or Standing.built(planned)
    at = np.arange(float(t[0]), float(t[-1]) + 0.5 / rate, 1.0 / rate)
    made = Recording(name, rig, {one: (at, np.zeros_like(at)) for one in sensors}, initial)
    context, early = made.run_context(), int(initial.lead > 0)
    if isinstance(truth, Rig):
        own, truth = deepcopy(truth), {}
        own.reference = rig.reference
        context = context._replace(rig=own, y0=initial.initial_state(own, made.samples))
    grid = Grid(torch.from_numpy(np.append([at[0] - initial.lead] * early, at)), early)
    exact, rng = predict(context, truth, grid, (), rtol).signals, np.random.default_rng(seed)
    samples = {}
    for channel, sensor in sensors.items():
        error = noise * sensor.noise * rng.standard_normal(len(at))
        samples[channel] = at, exact[:, made.channels.index(channel)] + error
    return replace(made, samples=samples)
