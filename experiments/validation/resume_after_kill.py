"""Question: does an identification that is killed at any moment come to the same answer, to the
bit, when it is started again?

`torchsoft identify`, a process of its own, fits three parameters to two noisy recordings of half a
second and keeps its runs in a checkpoint. It is killed (SIGKILL) at random moments: every other
time as soon as a file is being written, after so many runs, which may be the first, the last, the
answer's or the report's; else at any time, from the start of the process to its end. In every
fourth case the checkpoint is then damaged as well: a run's file becomes a pickle that would make a
folder if it were read as one, under a checksum that is right. The same command is started again and
ends.

The same means that `answer.json` is, number by number and word by word, that of an undisturbed
identification, but for `wall_s` (of the whole and of every stage), `cost.remembered` (the number of
runs that were read and not made), `command` (which names the folder) and the file's own `checksum`.
JSON has the shortest digits that give a number back, so that equal text is equal bits. The pages
are not compared: they show times. Nothing but both files may be left over, no process may be left,
nothing executed.

Command: .venv/bin/python experiments/validation/resume_after_kill.py [--kills 20] [--workers 1]
[--smoke] Expected: 20 of 20. About a quarter of an hour on two cores.
"""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from shutil import rmtree
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from torchsoft import Parameters
from torchsoft.channels import CHANNELS
from torchsoft.excitation import Excitation, Roll, Strokes, begin
from torchsoft.experiment import COARSE, markdown, options, write
from torchsoft.sysid import Recording, Sensor, record

SENSORS = {
    "x_C": Sensor(noise=1e-5),
    "theta": Sensor(noise=5e-4),
    "y_Br": Sensor(noise=1e-5),
    "F_y": Sensor(noise=0.1),
}
GRASP: dict[str, Any] = {"duration": 0.5, "depth": 1e-3, "grasp_time": 0.15, "settle": 0.05}
MOTIONS = {
    "strokes": Excitation(motion=Strokes(travel=6e-3, stroke_time=0.15), **GRASP),
    "rolling": Excitation(motion=Roll(travel=6e-3), **GRASP),
}
NOMINAL = Parameters().override({"contact.v_s": 0.05, "contact.mu_k": 0.5} | COARSE)
TRUTH = {"pad.E": 0.9e6, "pad.tau": 0.012, "contact.K_n": 1.6e5}
CONFIG = """
[settings]
pad.elements_x = 60
pad.elements_y = 2
contact.v_s = 0.05
contact.mu_k = 0.5
control.senses = "bracket"
scenario.x_C0 = 60.3e-3
[unknowns."pad.E"]
nominal = 0.6e6
[unknowns."pad.tau"]
[unknowns."contact.K_n"]
[sensors]
x_C.noise = 1e-5
theta.noise = 5e-4
y_Br.noise = 1e-5
F_y.noise = 0.1
[fit]
rtol = 1e-4
"""
DAMAGED = 4
"""In every so many cases a run's file is replaced by a pickle."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/resume_after_kill")
    kills: int = 20
    seed: int = 0
    workers: int = 1
    limit: float = 3600.0  # [s] for one command
    smoke: bool = False  # two kills


class Killed(NamedTuple):
    """One case: when it was killed [s], the runs kept by then of all that are, whether a file was
    being written, whether a pickle was planted, how many runs were read when it went on, how long
    that took [s], and what was wrong."""

    at: float
    kept: int
    writing: bool
    planted: bool
    remembered: int
    resumed_s: float
    wrong: str


class Result(NamedTuple):
    config: Config
    seconds: float
    runs: int
    cases: list[Killed]


def table(recording: Recording, path: Path) -> None:
    """A recording as a CSV file."""
    t = recording.times
    with torch.no_grad():
        x_d, y_d, F_ff = recording.rig.reference(torch.from_numpy(t), ("x_d", "y_d", "F_ff"))[
            ..., 0
        ].T.numpy()
    known = {"t [s]": t, "x_d [m]": x_d, "y_d [m]": y_d, "F_ff [N]": F_ff}
    columns = known | {
        f"{name} [{CHANNELS[name].unit}]": y for name, (_, y) in recording.samples.items()
    }
    head = ",".join(columns)
    np.savetxt(
        path, np.stack(list(columns.values()), -1), "%.17g", delimiter=",", header=head, comments=""
    )


class Command:
    """`torchsoft identify` in a process of its own, and what it has written."""

    def __init__(self, folder: Path, out: Path, workers: int) -> None:
        files = [*(str(folder / f"{name}.csv") for name in MOTIONS), str(folder / "rig.toml")]
        command = [
            sys.executable,
            "-m",
            "torchsoft",
            "identify",
            *files,
            "--out",
            str(out),
            "--workers",
            str(workers),
        ]
        self.out, self.began, self.said = out, time.monotonic(), folder / f"{out.name}.txt"
        with self.said.open("ab") as said:
            env = os.environ | {"OMP_NUM_THREADS": "1"}
            self.process = subprocess.Popen(
                [*command, "--no-progress", "--yes"], stdout=said, stderr=said, env=env
            )

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    @property
    def kept(self) -> int:
        """Runs in the checkpoint."""
        return sum(name.endswith(".run") for name in names(self.out / "unfinished"))

    @property
    def writing(self) -> bool:
        return any(
            name.endswith(".partial")
            for place in (self.out, self.out / "unfinished")
            for name in names(place)
        )

    def end(self, limit: float) -> None:
        """Wait for it. Raises `RuntimeError` where it fails."""
        if self.process.wait(limit) != 0:
            raise RuntimeError(
                f"torchsoft identify failed: {self.said.read_text(encoding='utf-8')[-2000:]}"
            )


def names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []


def answer(out: Path) -> tuple[str, int]:
    """All of the answer that data decide, as text, and the number of runs that were read."""
    content = json.loads((out / "answer.json").read_text(encoding="utf-8"))
    for key in ("checksum", "command"):
        content.pop(key)
    for entry in (content["cost"], *content["stages"]):
        entry.pop("wall_s")
    return json.dumps(content | {"cost": {**content["cost"], "remembered": None}}), int(
        content["cost"]["remembered"]
    )


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.folder),)


def plant(out: Path, folder: Path, rng: np.random.Generator) -> bool:
    """Replace one of the runs that are kept; whether there is any."""
    runs = sorted((out / "unfinished").glob("*.run"))
    if not runs:
        return False
    chosen, content = runs[int(rng.integers(len(runs)))], pickle.dumps(Trap(folder))
    chosen.write_bytes(sha256(bytes.fromhex(chosen.stem) + content).digest() + content)
    return True


def survivors(command: Command) -> list[int]:
    """Processes of its group that are left."""
    found = []
    for process in Path("/proc").iterdir():
        try:
            if (
                process.name.isdigit()
                and str(command.out).encode() in (process / "cmdline").read_bytes()
            ):
                found.append(int(process.name))
        except OSError:
            continue
    return found


def case(config: Config, number: int, whole: tuple[str, float, int]) -> Killed:
    """Kill, damage perhaps, start again, compare with the undisturbed identification (its answer,
    time [s] and runs)."""
    expected, seconds, runs = whole
    rng, out = np.random.default_rng([config.seed, number]), config.out / f"case-{number}"
    trap, in_a_write = config.out / f"executed-{number}", number % 2 == 1
    while True:  # until it is killed, and has not ended before
        after, later = int(rng.integers(0, runs + 1)), seconds * rng.random()
        rmtree(out, ignore_errors=True)
        command = Command(config.out, out, config.workers)
        while command.process.poll() is None:
            if (
                command.kept >= after and command.writing
                if in_a_write
                else command.seconds >= later
            ):
                break
            time.sleep(0 if in_a_write else 1e-3)
        command.process.send_signal(signal.SIGKILL)
        at, writing = command.seconds, command.writing
        if command.process.wait() == -signal.SIGKILL:
            break
    kept, wrong = (
        command.kept,
        [f"{len(left)} processes are left"] if (left := survivors(command)) else [],
    )
    planted = number % DAMAGED == DAMAGED - 1 and plant(out, trap, rng)
    began = time.monotonic()
    Command(config.out, out, config.workers).end(config.limit)
    resumed = time.monotonic() - began
    found, remembered = answer(out)
    if found != expected:
        a, b = json.loads(found), json.loads(expected)
        wrong.append(f"another answer: {[key for key in b if a.get(key) != b[key]]}")
    if extra := sorted(set(names(out)) - {"answer.json", "report.html"}):
        wrong.append(f"left over: {', '.join(extra)}")
    if trap.exists():
        wrong.append("a pickle was executed")
    return Killed(at, kept, writing, planted, remembered, resumed, "; ".join(wrong))


def run(config: Config) -> Result:
    config = replace(config, kills=2) if config.smoke else config
    config.out.mkdir(parents=True, exist_ok=True)
    for seed, (name, excitation) in enumerate(MOTIONS.items()):
        table(
            record(name, begin(excitation, NOMINAL), TRUTH, SENSORS, rtol=1e-5, seed=seed),
            config.out / f"{name}.csv",
        )
    (config.out / "rig.toml").write_text(CONFIG, encoding="utf-8")
    Command(config.out, config.out / "compiled", config.workers).end(
        config.limit
    )  # what it compiles is there from now on
    command, runs = Command(config.out, config.out / "undisturbed", config.workers), 0
    while command.process.poll() is None:
        runs = max(runs, command.kept)
        time.sleep(5e-3)
    command.end(config.limit)
    whole = answer(command.out)[0], command.seconds, runs
    cases = [
        case(config, k, whole)
        for k in tqdm(range(config.kills), desc="kills", disable=config.smoke)
    ]
    return Result(config, whole[1], runs, cases)


def main(config: Config) -> None:
    result = run(config)
    same = sum(not one.wrong for one in result.cases)
    rows = [
        (k, f"{one.at:.1f}", one.kept, "yes" if one.writing else "", "yes" if one.planted else "",
        one.remembered,
         f"{one.resumed_s:.1f}", one.wrong or "same")
        for k, one in enumerate(result.cases)
    ]  # fmt: skip
    head = (
        "case",
        "killed at [s]",
        "runs kept",
        "in a write",
        "pickle planted",
        "runs read",
        "going on took [s]",
        "answer",
    )
    shown = markdown(head, rows)
    print(
        f"{same} of {len(result.cases)} the same to the bit; undisturbed {result.seconds:.1f} s, "
        f"{result.runs} runs"
    )
    summary = {
        "undisturbed_s": result.seconds, "runs": result.runs, "same": same,
        "cases": [one._asdict() for one in result.cases],
    }  # fmt: skip
    write(result.config, summary, table=shown)


if __name__ == "__main__":
    main(options(Config, __doc__))
