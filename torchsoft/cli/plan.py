"""The command `plan`: a motion that reaches a goal."""

import argparse
from pathlib import Path
from typing import Any

from torchsoft.cli.results import add_command, add_out, add_progress, say, try_folder

PLAN = """\
Which motion brings the rig to its goal?

RIG.toml is a rig file with an initial motion. GOAL.toml has [free.NAME] for every
motion whose knots may move (low, high, speed, after) and every number of the file that may change
(low, high), [targets.NAME] (channel, value, tolerance, at) and [limits.NAME] (channel, low, high,
since, until). With [uncertain."NUMBER"] (low, high) the plan is made for draws of them; with
--answer, the file of an identification with `rig = "RIG.toml"`, for draws of its estimates.
Writes the plan as motion.toml, a rig file, with plan.json, and the run of that file as run.nc and
run.png. The exit status is 1 if this run misses a target or exceeds a limit."""


def add_commands(commands: Any) -> None:
    """Add the command `plan`."""
    one = add_command(commands, "plan", plan, "find a motion that reaches a goal", PLAN)
    one.add_argument("rig", type=Path, metavar="RIG.toml", help="the rig")
    one.add_argument("goal", type=Path, metavar="GOAL.toml", help="the goal")
    meaning = "plan for draws of the estimates of an identification"
    one.add_argument("--answer", type=Path, metavar="ANSWER.json", help=meaning)
    add_out(one, "plan")
    add_progress(one)


def plan(options: argparse.Namespace) -> int:
    """Plan and write the motion."""
    from torchsoft.files import write_json
    from torchsoft.plot import figures
    from torchsoft.plot.dashboard import dashboard
    from torchsoft.rigs.build import RigFile
    from torchsoft.rigs.goal import Goal, plan_file
    from torchsoft.rigs.written import save

    file, goal = RigFile.from_toml(RigFile.path(options.rig)), Goal.from_toml(options.goal)
    known = None
    if options.answer is not None:
        from torchsoft.sysid.result import load_answer

        known = load_answer(options.answer).draws(goal.draws, seed=goal.seed)
    try_folder(options.out, options.force)
    found, written = plan_file(file, goal, known, progress=options.progress)
    save(written, options.out / "motion.toml")
    write_json(options.out / "plan.json", found.summary())
    found.trajectory.save(options.out / "run.nc")
    figures.save(dashboard(found.trajectory, title=written.title), options.out / "run.png")
    say(found)
    say(f"written to {options.out / 'motion.toml'}, plan.json, run.nc and run.png")
    return 0 if found.reached else 1
