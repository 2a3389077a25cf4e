"""Commands on datasets: make and check."""

import argparse
import os
from pathlib import Path
from typing import Any

from torchsoft.cli.results import add_command, add_yes, failed, say

MAKE = """\
Simulates the dataset of CONFIG.toml, shard by shard, into a folder or any URL that fsspec opens. It
may be interrupted or killed at any time; the same command then makes the missing shards. Any number
of processes may write into one folder: --part 2/8 makes every eighth shard from the second on."""

MOST = 1000
"""Most local workers."""

COARSE = 5e-3
"""Step [s] above which a note is printed."""

BRIEF = 10.0
"""Time [s] below which no estimate is printed."""

HELP = "take fewer trajectories, a looser rtol or a shorter duration"


def add_commands(commands: Any) -> None:
    """Add the command `dataset` and its subcommands."""
    group = commands.add_parser("dataset", help="make datasets, and check them")
    own = group.add_subparsers(required=True, metavar="COMMAND")

    one = add_command(own, "make", make, "make a dataset, or a part of one", MAKE)
    one.add_argument("config", type=Path, help="TOML file, see data_gen/configs")
    one.add_argument("--out", required=True, help="folder or fsspec URL of the store")
    one.add_argument("--part", type=part, default=(1, 1), metavar="I/N", help="such as 2/8")
    workers = "threads, or processes if more than a few"
    one.add_argument("--workers", type=count, default=os.cpu_count() or 1, help=workers)
    add_yes(one)
    one = add_command(
        own, "check", check, "read a dataset and say what is wrong with it", "One line a finding."
    )
    one.add_argument("store", help="folder or fsspec URL")


def part(text: str) -> tuple[int, int]:
    """Parse the number and the count of parts."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f"should be such as 2/8, from 1/8 to 8/8, not {text!r}")
    return int(number), int(count)


def count(text: str) -> int:
    """Parse the number of local workers."""
    if not (text.isdecimal() and int(text) <= MOST):
        raise argparse.ArgumentTypeError(f"should be from 0 to {MOST}, not {text}")
    return int(text)


def make(options: argparse.Namespace) -> int:
    """Make the missing shards of a dataset, or of a part."""
    from concurrent.futures.process import BrokenProcessPool

    from torchsoft.cost import agree
    from torchsoft.datasets import generate
    from torchsoft.datasets.check import failures
    from torchsoft.datasets.config import Config
    from torchsoft.datasets.files import listed
    from torchsoft.datasets.reader import open_dataset
    from torchsoft.parallel import cores

    try:
        config, mine = Config.from_toml(options.config), generate.Part(*options.part)
        price = generate.estimate(config, options.out, min(options.workers, cores()), mine)
        agree(price, options.yes, HELP)
        if price.seconds > BRIEF:
            say(price.sentence, error=True)
        if config.step is not None and config.step > COARSE:
            note = "is coarse: the energy balance may be off by percents"
            say(f"note: step = {config.step:g} s {note}", error=True)
        with generate.local_workers(options.workers) as executor:
            bad = generate.generate(config, options.out, executor, options.workers, part=mine)
    except BrokenProcessPool:
        failed("a worker was killed, perhaps for memory; start again to make what is missing")
        return 3
    except KeyboardInterrupt:
        message = "interrupted: finished shards are kept; start again to make what is missing"
        say(message, error=True)
        return 130
    made = sum(len(config.rows(shard)) for shard in mine.shards(config))
    left = generate.unfinished(config, options.out)
    say(
        f"{made} trajectories in {options.out}; of those made now "
        + (f"{bad} failed, each with its reason" if bad else "none failed")
    )
    if bad:
        say(failures(open_dataset(options.out, unfinished=True))[1])
    if left:
        say(f"of the whole set {len(left)} of {config.shards} shards are left: {listed(left)}")
    return 0


def check(options: argparse.Namespace) -> int:
    """Print the defects of a dataset; the exit status is 1 for any finding."""
    from torchsoft.datasets.check import report

    return int(report(options.store, say) > 0)
