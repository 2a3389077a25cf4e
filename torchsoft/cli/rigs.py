"""The commands `run`, `check` and `init` on rig files."""

import argparse
import os
import shlex
from pathlib import Path
from typing import Any

from torchsoft.cli.results import (
    add_command,
    add_out,
    add_progress,
    add_yes,
    failed,
    say,
    try_folder,
)

RUN = """\
Simulates the rig of a TOML file, and writes trajectory.nc, summary.json, figures and a video to a
folder.

The file is checked first, and a rig with errors is not run. After Ctrl-C the results so far are
written."""

CHECK = """\
Reports errors and warnings for a rig file: bodies that overlap or that nothing carries, loops
that cannot work, recordings that end early. It then runs the rig at a loose tolerance, and reports
lost bodies, strains beyond linear elasticity, contacts that never touch, unstable loops and long
steps. The exit status is 2 if there is an error, and 0 if there are only warnings and notes."""

INIT = """\
Writes NAME.toml, a rig to start from: a disc between two pads, with the unit and the meaning of
every number in a comment. Missing folders are created."""


def add_commands(commands: Any) -> None:
    """Add the commands `run`, `check` and `init`."""
    one = add_command(commands, "run", run_rig, "simulate a rig file", RUN)
    one.add_argument("file", type=Path, metavar="RIG.toml", help="the rig")
    add_out(one, "RIG", default=None)
    one.add_argument("--anyway", action="store_true", help="run in spite of errors of the check")
    add_progress(one)
    add_yes(one)
    one = add_command(commands, "check", check_rig, "report what is wrong in a rig file", CHECK)
    one.add_argument("file", type=Path, metavar="RIG.toml", help="the rig")
    add_yes(one)
    one = add_command(commands, "init", init_rig, "write a rig file to start from", INIT)
    one.add_argument("name", metavar="NAME", help="the file's name, with or without .toml")
    one.add_argument("--material", help="a rubber of `torchsoft material presets` for its pads")


def run_rig(options: argparse.Namespace) -> int:
    """Check a rig file, simulate it and write the results."""
    from torchsoft.cost import agree
    from torchsoft.rigs import RigFile
    from torchsoft.rigs.check import check
    from torchsoft.rigs.run import cost, run
    from torchsoft.solve.progress import SimulationFailed

    out: Path = options.out or Path("out") / options.file.stem
    file = RigFile.from_toml(RigFile.path(options.file))
    agree(
        cost(file, runs=True),
        options.yes,
        "take fewer elements, a larger rtol or step, or a shorter duration",
    )
    found = check(file)
    for one in found:
        say(one, error=True)
    if any(one.severity == "error" for one in found) and not options.anyway:
        return failed(f"{options.file} is not run; fix what is wrong, or use --anyway")
    try_folder(out, options.force)
    done = run(file, out, found=found, progress=options.progress)
    if isinstance(done.stopped, SimulationFailed):
        return failed(f"{done.stopped.reason}; what was simulated until then is in {out}")
    if done.stopped is not None:
        say(f"\ninterrupted; what was simulated until then is in {out}", error=True)
        return 130
    stats = done.trajectory.stats
    say(
        f"{float(done.trajectory.t[-1]):g} s simulated in {stats.wall_s:.2g} s ({stats.steps} "
        f"steps), energies balanced to {done.trajectory.energy_residual_rel:.1e} of what was "
        f"injected; written to {out}"
    )
    return 0


def check_rig(options: argparse.Namespace) -> int:
    """Print the findings on a rig file."""
    from torchsoft.cost import agree
    from torchsoft.rigs import RigFile
    from torchsoft.rigs.check import check
    from torchsoft.rigs.run import cost

    file = RigFile.from_toml(RigFile.path(options.file))
    agree(cost(file, runs=False), options.yes, "take fewer elements")
    found = check(file)
    for one in found:
        say(one)
    count = {kind: sum(one.severity == kind for one in found) for kind in ("error", "warning")}
    say(f"{options.file}: {count['error']} errors, {count['warning']} warnings")
    return 2 if count["error"] else 0


def init_rig(options: argparse.Namespace) -> int:
    """Write a rig file to start from."""
    from torchsoft.files import save_text
    from torchsoft.rigs.written import template, to_toml

    path = Path(options.name.removesuffix(".toml") + ".toml")
    if not path.name.removesuffix(".toml").strip("."):
        return failed(
            f"NAME should be the name of a file, such as mine or mine.toml, not {options.name!r}"
        )
    if os.path.lexists(path):
        return failed(f"{path} is there already; take another name")
    rig = template(os.fsencode(path.stem).decode("utf-8", "replace"))
    if options.material is not None:
        rubber = {"kind": "preset", "name": options.material, "depth": 44e-3}
        rig = rig.override(materials={"rubber": rubber})
    save_text(path, to_toml(rig))
    check, run = (shlex.join(["torchsoft", command, str(path)]) for command in ("check", "run"))
    say(f"written to {path}; {check} looks it over, {run} simulates it")
    return 0
