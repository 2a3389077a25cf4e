"""The command `profile`: likelihood profiles of an identification's estimates."""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchsoft.cli.results import (
    add_command,
    add_files,
    add_out,
    add_progress,
    failed,
    say,
    sorted_files,
    try_folder,
)

PROFILE = """\
How far may an estimate move before the data contradict it?

Takes the DATA and the CONFIG.toml of an identification, and its answer. Holds one parameter at a
series of values, fits the others again, and finds the ends of its 95 % interval, also where
the likelihood is not Gaussian. Writes profile.json."""


def add_commands(commands: Any) -> None:
    """Add the command `profile`."""
    one = add_command(
        commands, "profile", profile, "find intervals by likelihood profiles", PROFILE
    )
    add_files(one)
    one.add_argument(
        "--answer", type=Path, default=Path("out/identify/answer.json"),
        help="answer of the identification (%(default)s)",
    )  # fmt: skip
    one.add_argument("--of", nargs="+", default=None, metavar="NAME", help="parameters (all)")
    one.add_argument("--workers", type=int, default=1, help="threads (%(default)s)")
    add_out(one, "profile")
    add_progress(one)


def profile(options: argparse.Namespace) -> int:
    """Compute profiles and write them."""
    config, data = sorted_files(options.files)
    from torchsoft.files import write_json
    from torchsoft.sysid import measured
    from torchsoft.sysid.fit import Unreachable
    from torchsoft.sysid.profile import optimum, profiles
    from torchsoft.sysid.result import load_answer

    case, answer = measured.load(data, config), load_answer(options.answer)
    try_folder(options.out, options.force)
    try:
        end = optimum(case.problem, answer, options.workers)
    except Unreachable as error:
        return failed(measured.unreachable(error, case.tables))
    labels = None if options.of is None else [labelled(end.labels, case, one) for one in options.of]
    found = profiles(end, labels, progress=options.progress)
    for one in found:
        ends = ["open" if end is None else f"{end:.5g}" for end in one.ci95]
        say(f"{one.label:34s} {one.best:12.5g}   {' .. '.join(ends)}")
        for finding in one.findings:
            say(f"{finding.severity}: {finding}")
    path = options.out / "profile.json"
    write_json(path, [asdict(one) for one in found])
    say(f"written to {path}")
    return 0


def labelled(labels: tuple[str, ...], case: Any, name: str) -> str:
    """Label of the coordinate of a parameter, by its full or short name."""
    full = case.problem.recordings[0].rig.full(name)
    return next((one for one in labels if one == full or one.startswith(f"{full} /")), name)
