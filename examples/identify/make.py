"""Make the recordings of this folder: the paper's rig, its parameters `TRUTH` by the names of
`Parameters`, measured by noisy sensors. Takes some seconds.

python examples/identify/make.py
"""

import csv
from pathlib import Path

import numpy as np
import torch

from torchsoft import Parameters
from torchsoft.channels import CHANNELS
from torchsoft.excitation import Chirp, Excitation, Strokes, begin
from torchsoft.sysid import Recording, Sensor, record

HERE = Path(__file__).parent

NOMINAL = Parameters().override({"contact.v_s": 0.05})
TRUTH = {
    "contact.K_n": 1.6e5, "contact.mu_s": 0.6, "contact.mu_k": 0.5, "contact.R_t": 300.0,
    "pad.E": 0.9e6, "pad.tau": 12e-3,
}  # fmt: skip
SENSORS = {"x_C": 10e-6, "theta": 0.5e-3, "x_Br": 10e-6, "y_Br": 10e-6, "F_x": 0.1, "F_y": 0.1}
GRASP = {"duration": 1.2, "depth": 1.2e-3, "grasp_time": 0.25, "settle": 0.05, "senses": "bracket"}
RECORDINGS = {
    "rolling": Excitation(motion=Strokes(travel=12e-3, stroke_time=0.25), **GRASP),
    "checking": Excitation(motion=Chirp(amplitude_x=3e-3, start=1.0, end=6.0), **GRASP),
}
UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "N": ("N", 1.0), "m/s": ("mm/s", 1e3)}


def table(recording: Recording) -> dict[str, tuple[str, np.ndarray]]:
    """Unit and values in SI by column: time, set-points with their rates, then what was
    measured."""
    t = recording.times
    with torch.no_grad():
        d = (
            recording.rig.reference(torch.from_numpy(t), ("x_d", "y_d", "F_ff"))
            .flatten(1)
            .T.numpy()
        )
    reference = dict(zip(("x_d", "x_d_dot", "y_d", "y_d_dot", "F_ff"), d))
    out = {name: (CHANNELS[name].unit, value) for name, value in reference.items()}
    return out | {
        name: (CHANNELS[name].unit, values) for name, (_, values) in recording.samples.items()
    }


def write(recording: Recording, path: Path, digits: int = 7) -> None:
    """A CSV file with the units of `UNITS` in the heading."""
    columns = table(recording)
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(
            ["t [s]", *(f"{name} [{UNITS[unit][0]}]" for name, (unit, _) in columns.items())]
        )
        for i, t in enumerate(recording.times):
            cells = [values[i] * UNITS[unit][1] for unit, values in columns.values()]
            out.writerow([f"{t:.9g}", *(f"{cell + 0.0:.{digits}g}" for cell in cells)])


def make(name: str, seed: int) -> Recording:
    sensors = {channel: Sensor(noise=noise) for channel, noise in SENSORS.items()}
    return record(name, begin(RECORDINGS[name], NOMINAL), TRUTH, sensors, seed=seed)


if __name__ == "__main__":
    for seed, name in enumerate(RECORDINGS):
        write(make(name, seed), HERE / f"{name}.csv")
