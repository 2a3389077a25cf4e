"""Mutation test of the suite: which faults of `mutants.toml` do the tests notice? README.md says
how to run it and what the results mean."""

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
FAILED = re.compile(r"^(tests/.*?) (?:FAILED|ERROR)", re.MULTILINE)
KERNEL = "solve/kernel/"
KERNEL_TESTS = """kernel_verbs gradients simulate stepper ledger driven finite_strain relaxing touch
    actuators_with_states batch tolerances trajectory foreign every_rig kernels"""
"""Tests of the compiled kernels, in this order: Python does not see which lines they execute."""


def python(tree: Path, *arguments: object, cpu_seconds: int = 0, **options: Any) -> int:
    """Run Python with the package of a tree; at most `cpu_seconds` of processor time. Returns the
    exit status."""
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}

    def begin() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # which jobs in the background ignore
        if cpu_seconds:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds + 10))

    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=tree, env=environment, preexec_fn=begin,
        stderr=subprocess.STDOUT, check=False, **options,
    ).returncode  # fmt: skip


def cover(out: Path, processes: int) -> None:
    """Run the suite on a copy of the working tree, and keep for every line the tests that execute
    it; print line and branch coverage."""
    tree = out / "clean"
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*NOT_COPIED))
    config = out / "coverage.ini"
    config.write_text(CONFIG.format(out / "coverage.data"), encoding="utf-8")
    with (out / "suite.log").open("w", encoding="utf-8") as log:
        status = python(
            tree, "-m", "pytest", *OPTIONS, "-n", processes, "--dist", "loadfile",
            "--timeout", 3000, "--durations=0", "--durations-min=0", "--cov", "torchsoft",
            "--cov-branch", "--cov-context=test", f"--cov-config={config}", "--cov-report=",
            stdout=log,
        )  # fmt: skip
    print(f"the suite ended with status {status}, see {log.name}")
    with (out / "order.txt").open("w", encoding="utf-8") as file:
        python(tree, "-m", "pytest", *OPTIONS, "-q", "--collect-only", stdout=file)
    coverage_table(out)


def coverage_table(out: Path) -> None:
    """Print line and branch coverage [%] by folder, and of the package; the kernels are compiled,
    so that theirs is not known."""
    report = out / "coverage.json"
    config = f"--rcfile={out / 'coverage.ini'}"
    python(out / "clean", "-m", "coverage", "json", config, "-q", "-o", report)
    totals: dict[str, Counter[str]] = {}
    for name, one in json.loads(report.read_text(encoding="utf-8"))["files"].items():
        inside = name.removeprefix("torchsoft/")
        kernel = inside.startswith(KERNEL)
        folder = "solve/kernel" if kernel else inside.partition("/")[0] if "/" in inside else "."
        for key in (folder, "all" if kernel else "all but solve/kernel", "all")[: 2 + (not kernel)]:
            totals.setdefault(key, Counter()).update(one["summary"])
    print(f"{'folder':22s}{'statements':>11s}{'lines':>8s}{'branches':>10s}")
    for key, one in sorted(totals.items()):
        lines = 100 * one["covered_lines"] / one["num_statements"]
        branches = 100 * one["covered_branches"] / max(one["num_branches"], 1)
        print(f"{key:22s}{one['num_statements']:11d}{lines:8.2f}{branches:10.2f}")


class Tests:
    """The tests that execute a line, by the run of `cover` in a folder."""

    def __init__(self, out: Path) -> None:
        self.data = importlib.import_module("coverage").CoverageData(str(out / "coverage.data"))
        self.data.read()
        log = (out / "suite.log").read_text(encoding="utf-8", errors="replace")
        found = re.findall(r"^([\d.]+)s (?:call|setup) +(\S.*)$", log, re.MULTILINE)
        self.seconds: Counter[str] = Counter()
        for seconds, test in found:
            self.seconds[test] += float(seconds)  # pyright: ignore[reportArgumentType]
        order = (out / "order.txt").read_text(encoding="utf-8").splitlines()
        self.order = [test for test in order if test.startswith("tests/")]

    def of(self, file: str, source: str, before: str) -> list[str]:
        """Tests of a text of a file, the likeliest to fail first: files named after the module,
        then those named after its folder, then others, the shorter ones first."""
        if file.startswith(KERNEL):
            every = [f"tests/test_{name}.py" for name in KERNEL_TESTS.split()]
            return [test for name in every for test in self.order if test.startswith(f"{name}::")]
        first = source[: source.index(before)].count("\n") + 1
        lines = range(first, first + before.rstrip("\n").count("\n") + 1)
        by_line = self.data.contexts_by_lineno(f"torchsoft/{file}")
        own = lines if inside_a_function(source, lines) else by_line
        contexts = {one for line in own for one in by_line.get(line, ())}
        tests = {one.rpartition("|")[0] for one in contexts} - {""}
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


def tried(mutant: dict[str, str], chosen: list[str], out: Path, seconds: int) -> dict[str, Any]:
    """Result of one mutant: killed by one of the chosen tests, survived, or not built."""
    tree, log, began = out / "mutant", out / "mutant.log", time.monotonic()
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(out / "clean", tree)
    path = tree / "torchsoft" / mutant["file"]
    source = path.read_text(encoding="utf-8")
    path.write_text(source.replace(mutant["before"], mutant["after"]), encoding="utf-8")
    if mutant["file"].startswith(KERNEL):
        with log.open("w", encoding="utf-8") as file:
            if python(tree, "-m", "torchsoft.solve.kernel.build", stdout=file):
                return {"result": "not built"}
    status, text = tested(tree, chosen, out, log, "-x", cpu_seconds=seconds)
    done = {
        "tests": len(chosen), "passed": text.count(" PASSED"),
        "seconds": round(time.monotonic() - began, 1),
    }  # fmt: skip
    if status in (0, -signal.SIGXCPU, -signal.SIGKILL):
        return {"result": "survived", "limit": None if status == 0 else seconds, **done}
    failed = FAILED.findall(text)  # none where the package cannot be imported
    return {"result": "killed", "by": failed[0] if failed else f"status {status}", **done}


def tested(
    tree: Path, chosen: list[str], out: Path, log: Path, *options: str, **limits: int
) -> tuple[int, str]:
    """Run the chosen tests with the package of a tree, in their order: the exit status, and what
    pytest printed."""
    (out / "tests.txt").write_text("\n".join(chosen), encoding="utf-8")
    how = (*OPTIONS, *options, "-v", "-n", "0", "-p", "no:cacheprovider", "--tb=line")
    with log.open("w", encoding="utf-8") as file:
        status = python(
            tree, "-m", "pytest", *how, "--timeout", 300, f"@{out / 'tests.txt'}", stdout=file,
            **limits,
        )  # fmt: skip
    return status, log.read_text(encoding="utf-8", errors="replace")


def run(out: Path, to: Path, only: list[str], seconds: int) -> None:
    """Try the mutants that have no result yet, or survived a shorter time limit, and add theirs to
    the file `to`. In the end the tests that killed one are run without any: those that fail then
    are left out, and what they killed is tried again."""
    every = tomllib.loads((HERE / "mutants.toml").read_text(encoding="utf-8"))["mutant"]
    every = [one for one in every if not only or one["name"] in only]
    tests, doubtful, trusted = Tests(out), set[str](), set[str]()
    while True:
        for mutant in every:
            known = results(to).get(mutant["name"], {"result": "none"})
            short = known["result"] == "survived" and (known["limit"] or seconds) < seconds
            if known["result"] != "none" and not short and known.get("by") not in doubtful:
                continue
            source = (out / "clean/torchsoft" / mutant["file"]).read_text(encoding="utf-8")
            found: dict[str, Any] = {"result": "gone"}
            if source.count(mutant["before"]) == 1:
                chosen = tests.of(mutant["file"], source, mutant["before"])
                chosen = [test for test in chosen if test not in doubtful]
                found = {"result": "not covered"}
                if chosen:
                    found = tried(mutant, chosen, out, seconds)
            found = {key: mutant[key] for key in ("name", "file")} | found
            with to.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")
            print(*found.values(), flush=True)
        killers = {one["by"] for one in results(to).values() if "::" in one.get("by", "")}
        if not (new := sorted(killers - trusted - doubtful)):
            return
        failed = set(FAILED.findall(tested(out / "clean", new, out, out / "again.log")[1]))
        print(f"{len(failed)} of {len(new)} tests fail without a mutant:", *failed, flush=True)
        trusted, doubtful = trusted | set(new) - failed, doubtful | failed


def results(path: Path) -> dict[str, dict[str, Any]]:
    """The last result of every mutant in a file; none where it is not there."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {one["name"]: one for one in map(json.loads, lines)}


def summary(path: Path, before: Path | None) -> None:
    """Print the numbers of results by folder, those that survived, and those that a run `before`
    killed and this one did not."""
    found, kinds = results(path), ("killed", "survived", "not covered", "gone", "not built")
    groups: dict[str, Counter[str]] = {}
    for name, one in found.items():
        for key in (name.rpartition("-")[0], "all"):
            groups.setdefault(key, Counter())[one["result"]] += 1
    print(f"{'':12s}" + "".join(f"{kind:>13s}" for kind in kinds))
    for key in (*(key for key in groups if key != "all"), "all"):
        print(f"{key:12s}" + "".join(f"{groups[key][kind]:13d}" for kind in kinds))
    was = results(before) if before else {}
    for name, one in found.items():
        if one["result"] != "killed":
            part = f", {one['passed']} of {one['tests']} tests" if one.get("limit") else ""
            lost = ", was killed" if was.get(name, {}).get("result") == "killed" else ""
            print(f"{name}: {one['result']}{part}{lost} ({one['file']})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True, dest="command")
    for name, about in (("cover", cover.__doc__), ("run", run.__doc__)):
        one = commands.add_parser(name, description=about)
        one.add_argument("out", type=Path, help="folder for the copies, the coverage and the logs")
    commands.choices["cover"].add_argument("-n", type=int, default=2, help="processes")
    commands.choices["run"].add_argument("to", type=Path, help="file of the results, JSON lines")
    commands.choices["run"].add_argument("--only", nargs="*", default=[], help="names of mutants")
    limit = "most processor time for the tests of one mutant [s]"
    commands.choices["run"].add_argument("--seconds", type=int, default=180, help=limit)
    one = commands.add_parser("summary", description=summary.__doc__)
    one.add_argument("results", type=Path)
    one.add_argument("before", type=Path, nargs="?", help="results to compare with")
    given = parser.parse_args()
    if given.command == "summary":
        summary(given.results, given.before)
        return
    given.out = given.out.resolve()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.command == "cover":
        cover(given.out, given.n)
    else:
        run(given.out, given.to, given.only, given.seconds)


if __name__ == "__main__":
    main()
