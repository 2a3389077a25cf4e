"""Make the recordings of this folder: the paper's rig with the parameters `TRUTH`, measured by
noisy sensors. Takes some seconds.

python examples/identify/make.py
"""

import csv
from pathlib import Path

import numpy as np
import torch

from torchsoft import RigFile
from torchsoft.sysid import Recording, Sensor, record

HERE = Path(__file__).parent

GRASP = {"kind": "profile", "times": [0.0, 0.25], "values": ["start", 48.9e-3]}
NOMINAL = RigFile.ready("paper").override(
    {
        "contact.v_s": 0.05,
        "control.senses": "bracket.x",
        "bodies.disc.start.x": 60.3e-3,
        "bodies.bracket.start": {"x": 60.3e-3, "y": 50.1e-3},
        "motion.y_d": GRASP,
        "motion.F_ff": GRASP | {"values": [0.0, "held"]},
    },
    outputs={"duration": 1.2, "snapshots": []},
)
TRUTH = {
    "contact.K_n": 1.6e5, "contact.mu_s": 0.6, "contact.mu_k": 0.5, "contact.R_t": 300.0,
    "pad.E": 0.9e6, "pad.tau": 12e-3,
}  # fmt: skip
SENSORS = {"x_C": 10e-6, "theta": 0.5e-3, "x_Br": 10e-6, "y_Br": 10e-6, "F_x": 0.1, "F_y": 0.1}
WAVE = {"kind": "chirp", "first": 1.0, "last": 6.0, "since": 0.3}
MOTIONS = {
    "rolling": {"x_d": {"kind": "strokes", "travel": 12e-3, "stroke_time": 0.25, "since": 0.3}},
    "checking": {
        "x_d": WAVE | {"amplitude": 3e-3},
        "y_d": GRASP | WAVE | {"amplitude": 1e-4},
    },
}
UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "N": ("N", 1.0), "m/s": ("mm/s", 1e3)}


def table(recording: Recording) -> dict[str, tuple[str, np.ndarray]]:
    """Unit and values in SI by column: time, set-points with their rates, then what was
    measured."""
    signals = recording.rig.reference(torch.from_numpy(recording.times), ("x_d", "y_d", "F_ff"))
    d = signals.detach().flatten(1).T.numpy()
    columns = dict(zip(("x_d", "x_d_dot", "y_d", "y_d_dot", "F_ff"), d))
    columns |= {name: y for name, (_, y) in recording.samples.items()}
    short = {full: name for name, full in recording.rig.short.items()}
    return {short.get(name, name): (recording.units[name], y) for name, y in columns.items()}


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
    motion = {f"motion.{one}": table for one, table in MOTIONS[name].items()}
    return record(name, NOMINAL.override(motion).build(), TRUTH, sensors, seed=seed)


if __name__ == "__main__":
    for seed, name in enumerate(MOTIONS):
        write(make(name, seed), HERE / f"{name}.csv")
