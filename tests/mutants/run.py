"""Mutation test of the suite: which faults of `mutants.toml` do the tests notice? README.md
explains how to run it and what the results mean."""

import argparse
import ast
import importlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
NOT_COPIED = (".git", ".venv", "out", ".pytest_cache", ".ruff_cache", ".hypothesis")
OPTIONS = ("-o", "addopts=", "-p", "no:zarr", "-p", "no:typeguard", "-m", "not slow")
CONFIG = """[run]
branch = true
relative_files = true
source = torchsoft
data_file = {}
"""
FAILED = re.compile(r"^(?:FAILED|ERROR) (tests/.*?)(?: - |$)", re.MULTILINE)
KERNEL = "solve/kernel/"
KERNEL_TESTS = """kernel_verbs gradients simulate stepper ledger driven finite_strain touch
    actuators batch tolerances trajectory foreign every_rig kernels"""
"""Tests of the compiled kernels, in this order: Python does not see which lines they execute."""


def python(tree: Path, log: Path, *arguments: object, cpu_seconds: int = 0) -> int:
    """Run Python with the package of a tree, at most for `cpu_seconds` of processor time; all
    output goes to `log`. Returns the exit status."""
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}

    def limit() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # which jobs in the background ignore
        if cpu_seconds:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds + 10))

    with log.open("w", encoding="utf-8") as file:
        return subprocess.run(
            [sys.executable, *map(str, arguments)], cwd=tree, env=environment, preexec_fn=limit,
            stdout=file, stderr=subprocess.STDOUT, check=False,
        ).returncode  # fmt: skip


def cover(out: Path, processes: int) -> None:
    """Run the suite on a copy of the working tree, and keep for every line the tests that execute
    it; print the coverage."""
    tree, config = out / "clean", out / "coverage.ini"
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*NOT_COPIED))
    config.write_text(CONFIG.format(out / "coverage.data"), encoding="utf-8")
    status = python(
        tree, out / "suite.log", "-m", "pytest", *OPTIONS, "-n", processes, "--dist", "loadfile",
        "--timeout", 3000, "--durations=0", "--durations-min=0", "--cov", "torchsoft",
        "--cov-branch", "--cov-context=test", f"--cov-config={config}", "--cov-report=term",
    )  # fmt: skip
    print((out / "suite.log").read_text(encoding="utf-8"))
    print(f"the suite ended with status {status}")
    python(tree, out / "order.txt", "-m", "pytest", *OPTIONS, "-q", "--collect-only")


class Tests:
    """The tests that execute a line and passed, by the run of `cover` in a folder."""

    def __init__(self, out: Path) -> None:
        self.data = importlib.import_module("coverage").CoverageData(str(out / "coverage.data"))
        self.data.read()
        log = (out / "suite.log").read_text(encoding="utf-8", errors="replace")
        self.seconds: Counter[str] = Counter()
        for seconds, test in re.findall(r"^([\d.]+)s (?:call|setup) +(\S.*)$", log, re.MULTILINE):
            self.seconds[test] += float(seconds)  # pyright: ignore[reportArgumentType]
        order = (out / "order.txt").read_text(encoding="utf-8").splitlines()
        failed = set(FAILED.findall(log))
        self.order = [test for test in order if test.startswith("tests/") and test not in failed]

    def of(self, file: str, source: str, before: str) -> list[str]:
        """Tests of a text of a file, the likeliest to fail first: files named after the module,
        then those named after its folder, then others, the shorter ones first."""
        if file.startswith(KERNEL):
            every = [f"tests/test_{name}.py::" for name in KERNEL_TESTS.split()]
            return [test for name in every for test in self.order if test.startswith(name)]
        first = source[: source.index(before)].count("\n") + 1
        lines = range(first, first + before.rstrip("\n").count("\n") + 1)
        by_line = self.data.contexts_by_lineno(f"torchsoft/{file}")
        own = lines if inside_a_function(source, lines) else by_line
        tests = {one.rpartition("|")[0] for line in own for one in by_line.get(line, ())}
        by_file: dict[str, list[str]] = {}
        for test in self.order:
            if test in tests:
                by_file.setdefault(test.partition("::")[0], []).append(test)
        folder, stem = Path(file).parts[0], Path(file).stem
        names = {f"test_{stem}", f"test_{folder}_{stem}", f"test_{stem.rstrip('s')}"}

        def rank(name: str) -> tuple[int, float]:
            stem = Path(name).stem
            near = 0 if stem in names else 1 if stem.startswith(f"test_{folder.rstrip('s')}") else 2
            return near, sum(self.seconds[test] for test in by_file[name])

        return [test for name in sorted(by_file, key=rank) for test in by_file[name]]


def inside_a_function(source: str, lines: range) -> bool:
    """Whether lines are executed by calls; others are executed once, by whichever test imports the
    module first."""
    kinds = ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda
    every = [node for node in ast.walk(ast.parse(source)) if isinstance(node, kinds)]
    bodies = [one.body if isinstance(one, ast.Lambda) else one.body[0] for one in every]
    return any(
        body.lineno <= lines[0] and lines[-1] <= (one.end_lineno or 0)
        for one, body in zip(every, bodies)
    )


def tried(mutant: dict[str, str], tests: Tests, out: Path, seconds: int) -> dict[str, Any]:
    """Result of one mutant."""
    clean, tree, log, began = out / "clean", out / "mutant", out / "mutant.log", time.monotonic()
    source = (clean / "torchsoft" / mutant["file"]).read_text(encoding="utf-8")
    if source.count(mutant["before"]) != 1:
        return {"result": "gone"}
    if not (chosen := tests.of(mutant["file"], source, mutant["before"])):
        return {"result": "not covered"}
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(clean, tree)
    changed = source.replace(mutant["before"], mutant["after"])
    (tree / "torchsoft" / mutant["file"]).write_text(changed, encoding="utf-8")
    kernel = mutant["file"].startswith(KERNEL)
    if kernel and python(tree, log, "-m", "torchsoft.solve.kernel.build"):
        return {"result": "not built"}
    (out / "tests.txt").write_text("\n".join(chosen), encoding="utf-8")
    how = (*OPTIONS, "-x", "-v", "-n", "0", "-p", "no:cacheprovider", "--tb=line", "--timeout", 300)
    status = python(
        tree, log, "-m", "pytest", *how, f"@{out / 'tests.txt'}", cpu_seconds=seconds
    )  # fmt: skip
    text = log.read_text(encoding="utf-8", errors="replace")
    done = {
        "tests": len(chosen), "passed": text.count(" PASSED"),
        "seconds": round(time.monotonic() - began, 1),
    }  # fmt: skip
    if status in (0, -signal.SIGXCPU, -signal.SIGKILL):
        return {"result": "survived", "limit": None if status == 0 else seconds, **done}
    failed = FAILED.findall(text)  # none where the package cannot be imported
    return {"result": "killed", "by": failed[0] if failed else f"status {status}", **done}


def run(out: Path, to: Path, only: list[str], seconds: int) -> None:
    """Try the mutants that have no result in the file `to`, and add theirs to it."""
    tests, known = Tests(out), results(to)
    for mutant in tomllib.loads((HERE / "mutants.toml").read_text(encoding="utf-8"))["mutant"]:
        name = mutant["name"]
        if name not in known and (not only or name in only):
            found = {"name": name, "file": mutant["file"]} | tried(mutant, tests, out, seconds)
            with to.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")
            print(*found.values(), flush=True)


def results(path: Path) -> dict[str, dict[str, Any]]:
    """The result of every mutant in a file; none where it is not there."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {one["name"]: one for one in map(json.loads, lines)}


def summary(path: Path, before: Path | None) -> None:
    """Print the numbers of results, those that survived, and those that a run `before` killed and
    this one did not."""
    found, was = results(path), results(before) if before else {}
    print(*(f"{n} {kind}" for kind, n in Counter(x["result"] for x in found.values()).items()))
    for name, one in found.items():
        if one["result"] != "killed":
            part = f", {one['passed']} of {one['tests']} tests" if one.get("limit") else ""
            lost = ", was killed" if was.get(name, {}).get("result") == "killed" else ""
            print(f"{name}: {one['result']}{part}{lost} ({one['file']})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=["cover", "run", "summary"])
    parser.add_argument("paths", type=Path, nargs="+", help="OUT; OUT and TO; or results [before]")
    parser.add_argument("-n", type=int, default=2, help="processes of `cover`")
    parser.add_argument("--only", nargs="*", default=[], help="names of mutants")
    limit = "most processor time for the tests of one mutant [s]"
    parser.add_argument("--seconds", type=int, default=180, help=limit)
    given = parser.parse_args()
    first, second = (*given.paths, None)[:2]
    if given.command == "summary":
        return summary(first, second)
    out = first.resolve()
    out.mkdir(parents=True, exist_ok=True)
    if given.command == "cover":
        return cover(out, given.n)
    if second is None:
        parser.error("run needs two paths, OUT and TO")
    return run(out, second, given.only, given.seconds)


if __name__ == "__main__":
    main()
