"""The command `torchsoft`: rigs in files, identification from files, and materials from tests."""

import argparse
import io
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchsoft.tables import line

IDENTIFY = """\
Which parameters explain these recordings, and how sure is that?

DATA are CSV files with a heading such as `t [s], x_d [mm], y_d [mm], F_ff [N], x_C [mm], theta [deg]`, or trajectory files of
this project (.nc). CONFIG.toml states what is known, what is unknown and how good the sensors are; examples/identify has both.
Recordings that look wrong (a sign, a unit, set-points too far apart) are refused, or named, before anything is fitted.
Writes answer.json and report.html, and comparison.json where there are competing laws. Interrupted, the same command continues
where it was."""

MATERIAL_FIT = """\
Which material relaxes, or creeps, as this one did?

FILE.csv has the column `t` [s, ms, min, h], counted from when the load was put on, and one pair of these, each with its unit
in the heading: `strain` [1, %], `stretch` [1] or `elongation` [m, mm, ...] with `stress` [Pa, kPa, MPa] or `force` [N, ...],
nominal and along the one direction of the test; or alone `modulus` [Pa, ...], of a strain put on at t = 0 and held, or
`compliance` [1/Pa, ...], of such a stress. The whole history counts: ramps need not be cut off.
Fits a relaxation series (prony) to a relaxation test, a generalised Kelvin chain to a creep test, and says what the rows do
not tell. Writes material.toml, with the names of the constructor's arguments, summary.json and fit.png."""

PRESETS = """\
Rubbers from the literature, every coefficient marked `published`, with where, or `assumed`."""

RUN = """\
Simulates the rig that a TOML file describes, and writes trajectory.nc, summary.json, figures and a video to a folder.

The file is checked first, and a rig that makes no sense is not run. Interrupted, what was simulated until then is written."""

CHECK = """\
Says what is wrong or dangerous in a rig file before any run: bodies that overlap or do not fit, a loop that is unstable,
strains beyond linear elasticity, steps that are too coarse, bodies that nothing carries, recordings that end early.
The exit status is 2 where there is an error; warnings and notes are said only."""

INIT = """\
Writes NAME.toml, a rig to start from: a disc between two pads, with the unit and the meaning of every number in a comment."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 0, 2 for what the user can mend, 130 for an interruption."""
    parser = argparse.ArgumentParser(
        prog="torchsoft", description="A differentiable simulator of soft contact manipulation."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    add_rigs(commands)
    one = commands.add_parser(
        "identify", help="find parameters in recordings", description=IDENTIFY,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    one.add_argument(
        "files", nargs="+", type=Path, metavar="DATA.csv ... CONFIG.toml", help="data files and one configuration"
    )
    one.add_argument("--out", type=Path, default=Path("out/identify"), help="folder for the results (%(default)s)")
    one.add_argument("--workers", type=int, help="threads, one recording each (fit.workers)")
    one.add_argument("--rtol", type=float, help="relative tolerance that chooses the simulation's steps (fit.rtol)")
    one.add_argument("--checkpoint", type=Path, help="folder for what is unfinished (OUT/unfinished)")
    one.add_argument("--yes", action="store_true", help="begin even what takes hours, or much memory")
    one.add_argument("--no-progress", action="store_true", help="show no progress")
    one.set_defaults(run=identify)
    material = commands.add_parser(
        "material", help="fit a material to a test, or list some", description="Materials of pads."
    )
    add_material_commands(material.add_subparsers(required=True, metavar="COMMAND"))
    for stream in (sys.stdout, sys.stderr):  # a terminal that cannot show a sign gets its number
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    given = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(given)
    options.command = shlex.join(["torchsoft", *(os.fsencode(one).decode("utf-8", "replace") for one in given)])
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print(f"torchsoft: note: {message}", file=sys.stderr)
        try:
            return options.run(options)
        except (ValueError, RuntimeError) as error:
            return failed(str(error))
        except OSError as error:
            return failed(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        except KeyboardInterrupt:
            print("\ninterrupted", file=sys.stderr)
            return 130


def add_material_commands(commands: Any) -> None:
    one = commands.add_parser(
        "fit", help="fit a material to a relaxation or creep test", description=MATERIAL_FIT,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    one.add_argument("file", type=Path, metavar="FILE.csv", help="the test")
    one.add_argument("--out", type=Path, default=Path("out/material"), help="folder for the results (%(default)s)")
    one.add_argument(
        "--test", choices=("relaxation", "creep"), help="what was put on: strain, or stress (what was held)"
    )
    one.add_argument("--terms", type=int, help="terms of the series (as many as the data call for)")
    one.add_argument("--length", type=float, help="gauge length [m], which `elongation` is divided by")
    one.add_argument("--area", type=float, help="cross-section before the test [m2], which `force` is divided by")
    for name, meaning in (
        ("nu", "Poisson's ratio [1]"),
        ("rho", "density [kg/m3]"),
        ("depth", "depth of the pads [m]"),
    ):
        one.add_argument(f"--{name}", type=float, help=f"{meaning}, which the test does not tell (as the paper's pads)")
    one.set_defaults(run=fit_material)
    one = commands.add_parser("presets", help="list rubbers from the literature", description=PRESETS)
    one.set_defaults(run=list_presets)


def fit_material(options: argparse.Namespace) -> int:
    """Fit a material to a test, and write what came of it."""
    from torchsoft.materials.fit import fit
    from torchsoft.materials.measured import read
    from torchsoft.materials.written import FILES, printed, write
    from torchsoft.parameters import Parameters

    asked = {name: getattr(options, name) for name in ("test", "length", "area")}
    given = {name: getattr(options, name) for name in ("nu", "rho", "depth")}
    pad = Parameters().override({f"pad.{name}": x for name, x in given.items() if x is not None}).pad
    found = fit(read(options.file, **asked), terms=options.terms)
    write(found, options.out, {name: getattr(pad, name) for name in given}, {**asked, "terms": options.terms, **given})
    print(printed(found))
    print(f"written to {', '.join(str(options.out / name) for name in FILES)}")
    return 0


def list_presets(options: argparse.Namespace) -> int:
    from torchsoft.materials.presets import PRESETS as presets

    print("\n".join(one.described() for one in presets.values()))
    return 0


def add_rigs(commands: Any) -> None:
    """The commands on rig files."""
    one = commands.add_parser(
        "run", help="simulate a rig file", description=RUN, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    one.add_argument("file", type=Path, metavar="RIG.toml", help="the rig")
    one.add_argument("--out", type=Path, help="folder for the results (out/RIG)")
    one.add_argument("--anyway", action="store_true", help="run even what the check finds wrong")
    one.add_argument("--no-progress", action="store_true", help="show no progress")
    one.set_defaults(run=run_rig)
    one = commands.add_parser(
        "check", help="say what is wrong in a rig file", description=CHECK,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    one.add_argument("file", type=Path, metavar="RIG.toml", help="the rig")
    one.set_defaults(run=check_rig)
    one = commands.add_parser(
        "init", help="write a rig file to start from", description=INIT,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    one.add_argument("name", type=Path, metavar="NAME", help="the file's name, with or without .toml")
    one.set_defaults(run=init_rig)


def run_rig(options: argparse.Namespace) -> int:
    """Check a rig file, simulate it, and write what came of it."""
    from torchsoft.rigs import RigFile
    from torchsoft.rigs.check import check
    from torchsoft.rigs.run import run
    from torchsoft.solve.progress import SimulationFailed

    out: Path = options.out or Path("out") / options.file.stem
    file = RigFile.from_toml(options.file)
    found = check(file)
    for one in found:
        print(one, file=sys.stderr)
    if any(one.severity == "error" for one in found) and not options.anyway:
        return failed(f"{options.file} is not run; mend what is wrong, or say --anyway")
    done = run(file, out, found=found, progress=not options.no_progress)
    if isinstance(done.stopped, SimulationFailed):
        return failed(f"{done.stopped.reason}; what was simulated until then is in {out}")
    if done.stopped is not None:
        print(f"\ninterrupted; what was simulated until then is in {out}", file=sys.stderr)
        return 130
    stats = done.trajectory.stats
    print(
        f"{float(done.trajectory.t[-1]):g} s simulated in {stats.wall_s:.2g} s ({stats.steps} steps), energies balanced to "
        f"{done.trajectory.energy_residual_rel:.1e} of what was injected; written to {out}"
    )
    return 0


def check_rig(options: argparse.Namespace) -> int:
    """Say what is wrong in a rig file."""
    from torchsoft.rigs import RigFile
    from torchsoft.rigs.check import check

    found = check(RigFile.from_toml(options.file))
    for one in found:
        print(one)
    count = {kind: sum(one.severity == kind for one in found) for kind in ("error", "warning")}
    print(f"{options.file}: {count['error']} errors, {count['warning']} warnings")
    return 2 if count["error"] else 0


def init_rig(options: argparse.Namespace) -> int:
    """Write a rig file to start from."""
    from torchsoft.rigs.template import template
    from torchsoft.rigs.written import to_toml

    path: Path = options.name.with_suffix(".toml")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(to_toml(template(path.stem)))
    except FileExistsError:
        return failed(f"{path} is there already; take another name")
    print(f"written to {path}; torchsoft check {path} looks it over, torchsoft run {path} simulates it")
    return 0


def identify(options: argparse.Namespace) -> int:
    configs = [file for file in options.files if file.suffix == ".toml"]
    data = [file for file in options.files if file.suffix != ".toml"]
    unfinished: Path = options.checkpoint or options.out / "unfinished"
    if len(configs) != 1:
        return failed(f"one CONFIG.toml is needed, but {len(configs)} were given")
    try:
        # these take seconds to import, so that `--help` does without
        from torchsoft.cost import agree
        from torchsoft.sysid.files import measured
        from torchsoft.sysid.files.configuration import Settings
        from torchsoft.sysid.files.cost import cost, one_by_one
        from torchsoft.sysid.fit.fit import Unreachable
        from torchsoft.sysid.problem.journal import forget
        from torchsoft.sysid.report.report import report
        from torchsoft.sysid.solve import identify

        tables: dict[str, Any] = {}
        try:
            case = measured.load(data, configs[0])
            fit, tables = case.config.fit, case.tables
            changed = {"rtol": options.rtol, "workers": options.workers}
            fit = Settings.model_validate(fit.model_dump() | {k: v for k, v in changed.items() if v is not None})
            problems, heldout = list(case.laws.values()) or [case.problem], case.config.heldout
            priced = (fit.rtol, fit.starts, fit.workers, heldout, fit.method)
            expected = one_by_one(cost(problem, *priced) for problem in problems)
            agree(expected, options.yes, "take a larger rtol, fewer starts or less data")
            options.out.mkdir(parents=True, exist_ok=True)
            result = identify(
                case.problem, heldout=heldout, meant=case.config.meant, checkpoint=unfinished,
                progress=not options.no_progress, **fit.model_dump(),
            )  # fmt: skip
            result = replace(result, command=options.command)
            result.save(options.out / "answer.json")
            report(result, case.problem, options.out / "report.html", checkpoint=unfinished)
            forget(unfinished)
            verdict = compared(case, fit, options) if case.laws else ""
        except Unreachable as error:
            return failed(measured.unreachable(error, tables))
        except (ValueError, RuntimeError) as error:  # a model without equilibrium, a worker that was killed
            return failed(str(error))
        except OSError as error:
            return failed(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except KeyboardInterrupt:
        print(f"\ninterrupted; what is done so far is in {unfinished}, and the same command continues", file=sys.stderr)
        return 130
    print(result.table())
    for notice in result.notices:
        print(f"note: {notice}")
    print(verdict, end="")
    print(f"{result.cost['wall_s']:.0f} s; written to {options.out / 'answer.json'} and {options.out / 'report.html'}")
    return 0


def compared(case: Any, fit: Any, options: argparse.Namespace) -> str:
    """Fits the competing laws, and says which one made the data."""
    from torchsoft.sysid.laws.compare import compare
    from torchsoft.sysid.problem.journal import forget

    unfinished: Path = options.checkpoint or options.out / "unfinished"
    folder = unfinished.with_name(f"{unfinished.name}-laws")
    answer = compare(
        case.laws, heldout=case.config.heldout, rtol=fit.rtol, starts=fit.starts, workers=fit.workers,
        checkpoint=folder, progress=not options.no_progress,
    )  # fmt: skip
    answer.save(options.out / "comparison.json")
    for name in case.laws:
        forget(folder / name)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    return f"{answer.table()}\n{answer.verdict}\nwritten to {options.out / 'comparison.json'}\n"


def failed(what: str) -> int:
    print(f"torchsoft: error: {line(what, 2000)}", file=sys.stderr)
    return 2
