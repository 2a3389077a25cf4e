"""Recordings made by the simulator itself: a known truth to identify."""

from collections.abc import Mapping

import numpy as np
import torch

from torchsoft.excitation import Excitation, begin
from torchsoft.parameters import Parameters
from torchsoft.physics.paper import SoftGrasp
from torchsoft.solve.simulate import simulate
from torchsoft.sysid.prediction import choice, set_parameters
from torchsoft.sysid.recording import SETTLE, Build, Recording, lying
from torchsoft.sysid.unknowns import Sensor

RIG = {
    channel: Sensor(noise=noise)
    for channel, noise in (
        ("x_C", 1e-5), ("y_C", 1e-5), ("theta", 5e-4), ("x_Br", 1e-5), ("y_Br", 1e-5), ("F_x", 0.1), ("F_y", 0.1),
    )
}  # fmt: skip
"""Sensors of a good rig: poses to 10 um and 0.5 mrad, forces to 0.1 N."""

RTOL = 1e-6
"""Relative tolerance of the runs that recordings are made of: a tenth of what a fit takes."""


def record(
    name: str, excitation: Excitation, truth: Parameters, nominal: Parameters, sensors: dict[str, Sensor], *,
    rate: float = 200.0, rtol: float = RTOL, noise: float = 1.0, seed: int = 0, build: Build = SoftGrasp,
    values: Mapping[str, float] | None = None,
) -> Recording:  # fmt: skip
    """What a rig with the parameters `truth` gives under an excitation that was planned with the `nominal` ones.

    The disc is set down, as the nominal parameters would have it lie, `SETTLE` before the first sample, as
    `Recording.begin` assumes. Sampled at `rate` [Hz] from a run whose steps `rtol` chooses, with Gaussian noise of `noise`
    times each sensor's own. `build` makes the model, and `values` are the truth of what `Parameters` does not have. The
    recording holds nothing of the truth but the samples. Raises `SimulationFailed`.
    """
    planned = begin(excitation, nominal).model
    settings, reference = planned.settings, planned.reference
    real = build(excitation.settings(truth), reference)
    set_parameters(real, values or {})
    at = np.arange(0.0, excitation.duration + 0.5 / rate, 1.0 / rate)
    t = torch.from_numpy(np.concatenate(([at[0] - SETTLE], at)))
    y0 = lying(build(settings, reference))._replace(model=real).y0.detach()
    run = simulate(real, t, y0=y0, **choice(rtol))
    rng, samples = np.random.default_rng(seed), {}
    for channel, sensor in sensors.items():
        exact = run[channel][1:].detach().numpy()
        samples[channel] = (at, exact + noise * sensor.noise * rng.standard_normal(len(at)))
    return Recording(name, settings, reference, samples, build)
