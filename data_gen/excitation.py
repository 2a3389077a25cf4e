"""The motions that are asked for: one `Reference` per task."""

import numpy as np
import torch
from torch import Tensor

from data_gen.config import Config, MultiSine
from data_gen.design import Task
from torchsoft.control import Profile, Reference

FADE = 0.15
"""Time [s] over which waves come and go."""


class Waves(Profile):
    """A profile with sines on top: sum of a sin(phi + 2 pi (f tau + r tau^2 / 2)), faded in and out.

    amplitude a [m], frequency f [Hz], sweep r [Hz/s], phase phi [rad], each (components,); tau is the time since `begin`
    [s], and the waves are over at `end` [s].
    """

    def __init__(
        self,
        profile: tuple[list[float], list[float]],
        begin: float,
        end: float,
        waves: tuple[Tensor, Tensor, Tensor, Tensor],
    ) -> None:
        super().__init__(*profile)
        self.begin, self.end, self.waves = begin, end, waves
        self.window = Profile([begin, begin + FADE, end - FADE, end], [0.0, 1.0, 1.0, 0.0])

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Value and rate at t (...)."""
        amplitude, frequency, sweep, phase = self.waves
        value, rate = super().forward(t)
        w, w_dot = self.window(t)
        tau = (t - self.begin)[..., None]
        angle = phase + 2 * torch.pi * (frequency * tau + 0.5 * sweep * tau**2)
        angle_dot = 2 * torch.pi * (frequency + sweep * tau)
        wave, wave_dot = (amplitude * angle.sin()).sum(-1), (amplitude * angle.cos() * angle_dot).sum(-1)
        return value + w * wave, rate + w_dot * wave + w * wave_dot


def excitation(config: Config, task: Task, start: tuple[float, float], grasp_force: float) -> Reference:
    """The grasp from `start` (x_C, y_Br) [m] with `grasp_force` [N] fed forward, then the task's own motion."""
    p, e = task.parameters.scenario, task.excitation
    rng = np.random.default_rng(task.seed)
    begin, end = p.grasp_time + config.settle, config.duration
    x_0, y_0 = start
    rest, grasp = ([0.0], [x_0]), ([0.0, p.grasp_time], [y_0, p.y_Br_grasp])
    x, y = Profile(*rest), Profile(*grasp)
    side = float(rng.choice((-1.0, 1.0)))
    match task.kind.kind:
        case "slow_roll":
            x = Profile([begin, end], [x_0, x_0 + side * e["travel"]])
        case "strokes":
            count = max(1, int((end - begin) / e["stroke_time"]))
            times = [begin + i * e["stroke_time"] for i in range(count + 1)]
            x = Profile(times, [x_0 + (i % 2) * side * e["travel"] for i in range(count + 1)])
        case "multi_sine":
            assert isinstance(task.kind, MultiSine)
            band, n = task.kind.frequency, task.kind.components

            def sines(amplitude: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
                frequency = [band.at((i + rng.random()) / n) for i in range(n)]
                return waves(np.full(n, amplitude / n), np.array(frequency), np.zeros(n), rng.uniform(0, 2 * np.pi, n))

            x, y = Waves(rest, begin, end, sines(e["amplitude_x"])), Waves(grasp, begin, end, sines(e["amplitude_y"]))
        case "chirp":
            sweep = (e["end"] - e["start"]) / (end - begin)
            x, y = (
                Waves(
                    profile, begin, end, waves([a], [e["start"]], [sweep], rng.uniform(0, 2 * np.pi, 1))
                ) for profile, a in ((rest, e["amplitude_x"]), (grasp, e["amplitude_y"]))
            )  # fmt: skip
        case "press":
            x = Profile([begin, end], [x_0, x_0 + side * e["travel"]])
            phase = rng.uniform(0, 2 * np.pi, 1)
            y = Waves(grasp, begin, end, waves([e["amplitude"]], [e["frequency"]], [0.0], phase))
    return Reference(x, y, Profile([0.0, p.grasp_time], [0.0, -grasp_force]))


def waves(*columns: object) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Amplitudes, frequencies, sweeps and phases as tensors."""
    a, f, r, phi = (torch.as_tensor(np.asarray(column), dtype=torch.float64) for column in columns)
    return a, f, r, phi
