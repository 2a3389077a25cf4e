"""The commands `identify`, `explain` and `rehearse`."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchsoft.cli.results import (
    add_command,
    add_out,
    add_progress,
    add_yes,
    failed,
    say,
    sorted_files,
    try_folder,
)

IDENTIFY = """\
Which parameters explain these recordings, and with which uncertainty?

DATA are CSV files with a heading such as `t [s], x_d [mm], y_d [mm], F_ff [N], x_C [mm], theta
[deg]`, or runs of torchsoft (.nc, .mcap). CONFIG.toml states the rig, the unknowns and the noise of
the sensors; examples/identify has both. Recordings with a wrong sign or unit, or with set-points
too far apart, are rejected or reported before the fit. Writes answer.json and report.html, and
comparison.json if laws compete. After an interruption the same command continues."""


EXPLAIN = """\
Why does the model not explain these recordings?

Identifies as `identify` does. If no test of an assumption explains the misfit, refits the data
with one assumption free at a time, until one explains the data or the refits took --effort
times the work of the fit. With the checkpoint of an identification it continues from there."""


REHEARSE = """\
What would this experiment identify?

Simulates the recordings that CONFIG.toml plans (a rig file, its motions, sensors with their noise,
[rehearsal] with the rate), identifies from them, and shows which parameters are identifiable, with
their intervals. The CSV files that it writes are templates for the recordings."""


def add_commands(commands: Any) -> None:
    """Add the commands `identify`, `explain` and `rehearse`."""
    for name, help, description in (
        ("identify", "find parameters in recordings", IDENTIFY),
        ("explain", "find what is wrong where a model does not explain recordings", EXPLAIN),
        ("rehearse", "find what an experiment would identify, before it is done", REHEARSE),
    ):
        add_arguments(add_command(commands, name, identify, help, description))


def add_arguments(one: argparse.ArgumentParser) -> None:
    """Add the arguments of any of these commands."""
    metavar, explanation = "DATA.csv ... CONFIG.toml", "data files and a configuration"
    if one.prog.endswith("rehearse"):
        metavar, explanation = "CONFIG.toml", "the configuration"
    one.add_argument("files", nargs="+", type=Path, metavar=metavar, help=explanation)
    add_out(one, "identify")
    one.add_argument("--workers", type=int, help="threads, one recording each (fit.workers)")
    one.add_argument(
        "--rtol",
        type=float,
        help="relative tolerance that chooses the simulation's steps (fit.rtol)",
    )
    one.add_argument("--checkpoint", type=Path, help="folder for unfinished work (OUT/unfinished)")
    add_yes(one)
    add_progress(one)
    verb = one.prog.split()[-1]
    if verb == "explain":
        one.add_argument(
            "--effort",
            type=float,
            help="most work of refits, as a multiple of that of the fit (fit.effort)",
        )
    one.set_defaults(explains=verb == "explain", rehearses=verb == "rehearse")


def identify(options: argparse.Namespace) -> int:
    config, data = sorted_files(options.files)
    unfinished: Path = options.checkpoint or options.out / "unfinished"
    try:
        # these take seconds to import, so that `--help` does without
        from torchsoft.cost import agree
        from torchsoft.sysid import measured
        from torchsoft.sysid.fit import Unreachable
        from torchsoft.sysid.identification import Settings, identify
        from torchsoft.sysid.measured import cost, one_by_one
        from torchsoft.sysid.report import report
        from torchsoft.sysid.runs import forget

        tables: dict[str, Any] = {}
        try:
            stated = None
            if options.rehearses:
                from torchsoft.sysid.design import rehearsed

                if data:
                    return failed(f"a rehearsal makes its own data: leave {data[0]} out")
                try_folder(options.out, options.force)
                planned = measured.read_config(config)
                stated, data = rehearsed(config, planned, options.out)
            case = measured.load(data, config, stated)
            fit, tables = case.config.fit, case.tables
            changed = {
                "rtol": options.rtol, "workers": options.workers,
                "assumptions": "explained" if options.explains else None,
                "effort": options.effort if options.explains else None,
            }  # fmt: skip
            fit = Settings.model_validate(
                fit.model_dump() | {k: v for k, v in changed.items() if v is not None}
            )
            problems, heldout = list(case.laws.values()) or [case.problem], case.config.heldout
            priced = (fit.rtol, fit.starts, fit.workers, heldout)
            expected = one_by_one(cost(problem, *priced) for problem in problems)
            agree(expected, options.yes, "take a larger rtol, fewer starts or less data")
            if stated is None:
                try_folder(options.out, options.force)
            result = identify(
                case.problem, heldout=heldout, acknowledged=case.config.acknowledged,
                checkpoint=unfinished, progress=options.progress, **fit.model_dump(),
            )  # fmt: skip
            result = replace(result, command=options.command)
            result.save(options.out / "answer.json")
            written, verdict = [options.out / "answer.json"], ""
            interrupted = any(one.code == "interrupted" for one in result.findings)
            if not interrupted:  # else nobody waits for pictures
                written.append(options.out / "report.html")
                report(result, case.problem, written[-1], checkpoint=unfinished)
                verdict = compared(case, fit, options, unfinished) if case.laws else ""
                forget(unfinished)
        except Unreachable as error:
            return failed(measured.unreachable(error, tables))
    except KeyboardInterrupt:
        say(
            f"\ninterrupted; what is done so far is in {unfinished}, and the same command "
            "continues",
            error=True,
        )
        return 130
    say(result.table())
    for finding in result.findings:
        say(f"{finding.severity}: {finding}")
    if verdict:
        say(verdict)
    if interrupted:
        say(f"\ninterrupted; the same command continues with what is in {unfinished}", error=True)
    say(f"fitted in {result.cost['wall_s']:.0f} s; written to {' and '.join(map(str, written))}")
    return 130 if interrupted else 0


def compared(case: Any, fit: Any, options: argparse.Namespace, unfinished: Path) -> str:
    """Fit the competing laws, that of the file with the runs of its identification, which are in
    the folder `unfinished`, and write the comparison; returns its table and verdict."""
    from torchsoft.sysid.compare import compare
    from torchsoft.sysid.measured import STATED
    from torchsoft.sysid.runs import forget

    folder = unfinished.with_name(f"{unfinished.name}-laws")
    folders = {name: folder / name for name in case.laws if name != STATED}
    answer = compare(
        case.laws, heldout=case.config.heldout, rtol=fit.rtol, starts=fit.starts,
        workers=fit.workers, checkpoint={STATED: unfinished, **folders}, progress=options.progress,
    )  # fmt: skip
    answer.save(options.out / "comparison.json")
    for one in folders.values():
        forget(one)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    return f"{answer.table()}\n{answer.verdict}\nwritten to {options.out / 'comparison.json'}"
