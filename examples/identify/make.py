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

GRASP = {"times": [0.0, 0.25], "values": [0.0, -1.2e-3], "offset": "start"}
NOMINAL = RigFile.ready("paper").override({
    "contact.v_s": 0.05, "control.senses": "bracket.x",
    "bodies.disc.start.x": 60.3e-3, "bodies.bracket.start.x": 60.3e-3,
    "motion.y_d": {"kind": "profile"} | GRASP,
    "motion.F_ff.times": [0.0, 0.25], "motion.F_ff.values": [0.0, "held"],
    "outputs.duration": 1.2, "outputs.snapshots": [],
})  # fmt: skip
TRUTH = {
    "contact.K_n": 1.6e5, "contact.mu_s": 0.6, "contact.mu_k": 0.5, "contact.R_t": 300.0,
    "pad.E": 0.9e6, "pad.tau": 12e-3,
}  # fmt: skip
SENSORS = {"x_C": 10e-6, "theta": 0.5e-3, "x_Br": 10e-6, "y_Br": 10e-6, "F_x": 0.1, "F_y": 0.1}
SWEEP = {"kind": "chirp", "since": 0.3, "first": 1.0, "last": 6.0}
RECORDINGS = {
    "rolling": {
        "motion.x_d": {"kind": "strokes", "since": 0.3, "travel": 12e-3, "stroke_time": 0.25}
    },
    "checking": {
        "motion.x_d": SWEEP | {"amplitude": 3e-3}, "motion.y_d": SWEEP | GRASP | {"amplitude": 1e-4}
    },
}  # fmt: skip
UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "N": ("N", 1.0), "m/s": ("mm/s", 1e3)}


def table(recording: Recording) -> dict[str, np.ndarray]:
    """Values in SI by column: set-points with their rates, then what was measured."""
    names = "x_d", "y_d", "F_ff"
    with torch.no_grad():
        signals = recording.rig.reference(torch.from_numpy(recording.times), names)
    columns = {
        f"{name}{rate}": signals[:, i, k].numpy()
        for i, name in enumerate(names) for k, rate in enumerate(("", "_dot"))
    }  # fmt: skip
    columns.pop("F_ff_dot")
    short = {full: name for name, full in recording.rig.short.items()}
    return columns | {short.get(name, name): y for name, (_, y) in recording.samples.items()}


def write(recording: Recording, path: Path, digits: int = 7) -> None:
    """A CSV file with the units of `UNITS` in the heading."""
    columns = table(recording)
    units = [UNITS[recording.units[recording.rig.full(name)]] for name in columns]
    heads = (f"{name} [{unit}]" for name, (unit, _) in zip(columns, units))
    rows = np.array([size * column for column, (_, size) in zip(columns.values(), units)]).T
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["t [s]", *heads])
        for t, cells in zip(recording.times, rows):
            out.writerow([f"{t:.9g}", *(f"{cell + 0.0:.{digits}g}" for cell in cells)])


def make(name: str, seed: int) -> Recording:
    sensors = {channel: Sensor(noise=noise) for channel, noise in SENSORS.items()}
    return record(name, NOMINAL.override(RECORDINGS[name]).build(), TRUTH, sensors, seed=seed)


if __name__ == "__main__":
    for seed, name in enumerate(RECORDINGS):
        write(make(name, seed), HERE / f"{name}.csv")
