"""The command `design`: motions for an identification."""

import argparse
from typing import Any

from torchsoft.cli.results import (
    add_command,
    add_files,
    add_out,
    add_progress,
    say,
    sorted_files,
    try_folder,
)

DESIGN = """\
Which motion of the rig should be recorded?

CONFIG.toml plans an identification (a rig file, unknowns, sensors with their noise). Its [design]
lists candidates for the motion, and bounds within which the knots of profiles may move. The command
ranks the candidates by how well they identify the unknowns, improves the knots of the best one by
gradient, and writes it as motion.toml, a rig file that runs, with design.json. It runs this file
again; the exit status is 1 if the result differs. DATA are existing recordings."""


def add_commands(commands: Any) -> None:
    """Add the command `design`."""
    one = add_command(
        commands, "design", design, "find a motion that identifies parameters", DESIGN
    )
    add_files(one, "recordings, if there are any, and one configuration")
    add_out(one, "design")
    one.add_argument("--workers", type=int, default=1, help="threads of the search (%(default)s)")
    add_progress(one)


def design(options: argparse.Namespace) -> int:
    """Choose a motion and write it."""
    config, data = sorted_files(options.files)
    from torchsoft.files import write_json
    from torchsoft.rigs import written
    from torchsoft.sysid import measured
    from torchsoft.sysid.design import choose

    stated = measured.read_config(config)
    recorded = measured.load(data, config).problem.recordings if data else ()
    try_folder(options.out, options.force)
    chosen = choose(config, stated, recorded, workers=options.workers, progress=options.progress)
    written.save(chosen.file, options.out / "motion.toml")
    write_json(options.out / "design.json", chosen.summary())
    say(chosen.table())
    if chosen.found is not None:
        say(f"\n{chosen.rated[0].name}, its knots moved:\n{chosen.found.table()}")
        for limit in chosen.found.limits:
            say(f"note: {limit}")
        for finding in chosen.found.findings:
            say(f"{finding.severity}: {finding}")
    say(f"written to {options.out / 'motion.toml'} and {options.out / 'design.json'}")
    return 0 if chosen.found is None or chosen.found.confirmed else 1
