"""`torchsoft identify` killed and interrupted at random moments: the same answer in the end,
nothing left, nobody orphaned."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import pytest
from test_sysid_measured import CONFIG, EXAMPLE, write

from hostile.trial import Tally
from torchsoft.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

COMMAND = """
import signal, sys
# test runners may ignore it, which a child inherits
signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == "__main__":
    from torchsoft.cli import main
    sys.exit(main(sys.argv[1:]))
"""


class Case(NamedTuple):
    """Folder of the data, number of workers, and of an undisturbed command the answer and the time
    it took [s]."""

    folder: Path
    workers: int
    answer: str
    seconds: float


class Command:
    """The command with workers, in a process of its own, known by a word in the environment of it
    and its children.

    Without workers it is forked from this process, which has imported everything, and begins at
    once.
    """

    def __init__(self, folder: Path, out: Path, workers: int) -> None:
        self.word, self.began, self.out = uuid4().hex, time.monotonic(), out
        self.said, self.kept_before = folder / f"{self.word}.txt", self.kept
        files = [str(folder / name) for name in ("data.csv", "more.csv", "rig.toml")]
        command = [
            "identify",
            *files,
            "--out",
            str(out),
            "--workers",
            str(workers),
            "--no-progress",
        ]
        self.process: subprocess.Popen[bytes] | None = None
        self.status: int | None = None
        if workers > 1:
            (folder / "command.py").write_text(COMMAND, encoding="utf-8")
            with self.said.open("wb") as said:
                self.process = subprocess.Popen(
                    [sys.executable, str(folder / "command.py"), *command], stdout=said,
                    stderr=said, env=os.environ | {"OMP_NUM_THREADS": "1",
                    "HOSTILE_WORD": self.word},
                )  # fmt: skip
            self.id = self.process.pid
        else:
            self.id = os.fork() or self.run(command)

    def run(self, command: list[str]) -> int:
        """The command in the forked process, which it ends."""
        status = 1
        try:
            said = os.open(self.said, os.O_WRONLY | os.O_CREAT)
            os.dup2(said, 1)
            os.dup2(said, 2)
            sys.stdout = sys.stderr = os.fdopen(said, "w", encoding="utf-8")
            signal.signal(signal.SIGINT, signal.default_int_handler)
            status = main(command)
        finally:
            sys.stderr.flush()
            os._exit(status)

    @property
    def running(self) -> bool:
        if self.process is not None:
            self.status = self.process.poll()
        elif self.status is None:
            ended, status = os.waitpid(self.id, os.WNOHANG)
            self.status = os.waitstatus_to_exitcode(status) if ended else None
        return self.status is None

    @property
    def kept(self) -> int:
        return len(list(self.out.glob("unfinished/*.run")))

    def wait(self, seconds: float, runs: int) -> None:
        """Until so many seconds have passed since the start, and so many more runs are kept, or it
        has ended."""
        while self.running and (
            time.monotonic() - self.began < seconds or self.kept < self.kept_before + runs
        ):
            time.sleep(0.002)

    def end(self) -> tuple[int | None, str]:
        """Exit status and what it said."""
        self.wait(300.0, 0)
        return self.status, self.said.read_text(encoding="utf-8")

    def survivors(self) -> list[int]:
        """Processes with its word, half a minute after its end at the latest."""
        for _ in range(300):
            left = [
                int(p.name)
                for p in Path("/proc").iterdir()
                if p.name.isdigit() and self._is_mine(p)
            ]
            if not left:
                return []
            time.sleep(0.1)
        return left

    def _is_mine(self, process: Path) -> bool:
        try:
            return self.word.encode() in (process / "environ").read_bytes()
        except OSError:
            return False


def answer(out: Path) -> str:
    """The answer without what depends on how it was come by: times, how much was remembered, the
    command with its folder, and the checksum of all that."""
    content = json.loads((out / "answer.json").read_text(encoding="utf-8"))
    for key in ("checksum", "command"):
        content.pop(key)
    for entry in (content["cost"], *content["stages"]):
        entry.pop("wall_s")
    content["cost"].pop("remembered")
    return json.dumps(content)


def difference(one: str, other: str) -> str:
    """The parts of two answers that are not the same; empty where all are."""
    a, b = json.loads(one), json.loads(other)
    return (
        ""
        if one == other
        else f"another answer: {[(key, a[key], b.get(key)) for key in a if a[key] != b.get(key)]}"
    )


def left_over(out: Path) -> str:
    return ", ".join(
        sorted(
            path.name for path in out.iterdir() if path.name not in ("answer.json", "report.html")
        )
    )


@pytest.fixture(scope="module", params=[1, 2], ids=["alone", "two workers"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("kills")
    with (EXAMPLE / "rolling.csv").open(newline="", encoding="utf-8") as file:
        table = list(csv.reader(file))[:42]
    write(folder / "data.csv", table)
    write(folder / "more.csv", table[:32])
    (folder / "rig.toml").write_text(CONFIG, encoding="utf-8")
    files = [str(folder / name) for name in ("data.csv", "more.csv", "rig.toml")]
    if request.param == 1:  # so that what it compiles is there when it is forked
        assert main(["identify", *files, "--out", str(folder / "first"), "--no-progress"]) == 0
    command = Command(folder, folder / "whole", request.param)
    status, said = command.end()
    assert status == 0, said
    return Case(folder, request.param, answer(folder / "whole"), time.monotonic() - command.began)


def moment(rng: np.random.Generator, seconds: float) -> tuple[float, int]:
    """Any time from the start on, or soon after a run was kept."""
    return (seconds * rng.random(), 0) if rng.integers(2) else (0.0, int(rng.integers(1, 16)))


def rounds(
    case: Case, times: int, rng: np.random.Generator, line: Tally, ends: Callable[[Command], str]
) -> None:
    """End the command `times` times as `ends` does, which says what did not hold; after a few it
    comes to its answer."""
    number = 0
    while number < times:
        out, ended = case.folder / f"out-{uuid4().hex[:8]}", 0
        for _ in range(int(rng.integers(1, 6))):
            command = Command(case.folder, out, case.workers)
            command.wait(*moment(rng, case.seconds))
            time.sleep(0.02 * rng.random())
            if not command.running:
                break
            wrong = ends(command)
            line.held(not wrong, f"{number}: {wrong}")
            number, ended = number + 1, ended + 1
        status, said = Command(case.folder, out, case.workers).end()
        wrong = f"{status}: {said[-1000:]}" if status != 0 else difference(answer(out), case.answer)
        line.held(not (wrong or left_over(out)), f"after {ended}: {wrong or left_over(out)}")


def test_killed_it_ends_the_same(
    whole: Case, tally: Callable[[str], Tally], count: Any, random: Any
) -> None:
    """Nothing that it began outlives it, whenever it is killed."""

    def killed(command: Command) -> str:
        os.kill(command.id, signal.SIGKILL)
        command.end()
        left = command.survivors()
        return f"{len(left)} processes outlive it" if left else ""

    line = tally(f"identifications killed, {whole.workers} workers, and their answers")
    rounds(whole, count(20 if whole.workers == 1 else 10), random(94, whole.workers), line, killed)


def test_interrupted_it_ends_the_same(
    whole: Case, tally: Callable[[str], Tally], count: Any, random: Any
) -> None:
    """With one line that says how to go on, and with what was done kept."""

    def interrupted(command: Command) -> str:
        command.wait(
            0.0, 1
        )  # from then on it is the command that is interrupted, and not Python that is starting
        kept = command.kept
        if not command.running:
            return ""
        os.kill(command.id, signal.SIGINT)
        status, said = command.end()
        if status == 0:  # it was about to end
            return ""
        if status != 130 or "Traceback" in said or "the same command continues" not in said:
            return f"{status}, {said[-1000:]}"
        return (
            ""
            if command.kept >= kept and not command.survivors()
            else "something was lost, or is left"
        )

    line = tally(f"identifications interrupted, {whole.workers} workers, and their answers")
    rounds(
        whole, count(6 if whole.workers == 1 else 3), random(95, whole.workers), line, interrupted
    )
