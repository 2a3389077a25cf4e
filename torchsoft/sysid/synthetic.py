"""Recordings made by the simulator itself: a known truth to identify."""

from collections.abc import Callable, Mapping

import numpy as np
import torch

from torchsoft.excitation import Excitation, begin
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.motion import Reference
from torchsoft.solve.simulate import simulate
from torchsoft.sysid.initial_state import AtRest, held_start
from torchsoft.sysid.prediction import choice, set_parameters
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.unknowns import Sensor

Build = Callable[[Parameters, Reference], SoftGrasp]
"""Makes a rig from settings and a reference: `SoftGrasp` itself, or a function that gives it laws
of the user's own, such as a friction law."""

RIG = {
    channel: Sensor(noise=noise)
    for channel, noise in (
        ("x_C", 1e-5), ("y_C", 1e-5), ("theta", 5e-4), ("x_Br", 1e-5), ("y_Br", 1e-5), ("F_x", 0.1),
        ("F_y", 0.1),
    )
}  # fmt: skip
"""Sensors of a good rig: poses to 10 um and 0.5 mrad, forces to 0.1 N."""

RTOL = 1e-6
"""Relative tolerance of the runs that recordings are made of: a tenth of what a fit takes."""


def record(
    name: str, excitation: Excitation, truth: Parameters, nominal: Parameters,
    sensors: dict[str, Sensor], *, rate: float = 200.0, rtol: float = RTOL, noise: float = 1.0,
    seed: int = 0, build: Build = SoftGrasp, values: Mapping[str, float] | None = None,
) -> Recording:  # fmt: skip
    """What a rig with the parameters `truth` gives under an excitation that was planned with the
    `nominal` ones.

    The disc is set down, as the nominal parameters would have it lie, before the first sample, as
    `AtRest` assumes. Sampled at `rate` [Hz] from a run whose steps `rtol` chooses, with Gaussian
    noise of `noise` times each sensor's own. `build` makes the rig, and `values` are the truth of
    what `Parameters` does not have. The recording holds nothing of the truth but the samples.
    Raises `SimulationFailed`.
    """
    planned = begin(excitation, nominal).model
    rig = build(planned.settings, planned.reference)
    real = build(excitation.settings(truth), planned.reference)
    set_parameters(real, values or {})
    at, start = np.arange(0.0, excitation.duration + 0.5 / rate, 1.0 / rate), AtRest()
    t = torch.from_numpy(np.concatenate(([at[0] - start.lead], at)))
    run = simulate(real, t, y0=held_start(rig, real).detach(), **choice(rtol))
    rng, samples = np.random.default_rng(seed), {}
    for channel, sensor in sensors.items():
        exact = run[channel][1:].detach().numpy()
        samples[channel] = (at, exact + noise * sensor.noise * rng.standard_normal(len(at)))
    return Recording(name, rig, samples, start)
