"""The command `reduce`: sparse equations from saved runs."""

import argparse
from pathlib import Path
from typing import Any

from torchsoft.cli.results import add_command, add_out, say, try_folder

LARGEST = 2.0
"""Rolling radius over the farthest point of the body that rolls."""

REDUCE = """\
Which sparse equations describe saved runs of a rig?

RUN.nc are runs of any rig with one body between two pads, written by `torchsoft run`: small waves
about a settled grasp, sampled every 0.25 ms (docs: Find a reduced model). Terms are those of
mechanics with the rolling radius --radius, or that of the first run; the loop of F_x is fitted from
its set-point. The last run, or --held-out, is predicted and not fitted. Writes reduced.json:
equations, coefficients, and the error of the prediction. The exit status is 1 if the prediction is
no better than a constant."""


def add_commands(commands: Any) -> None:
    """Add the command `reduce`."""
    one = add_command(commands, "reduce", reduce, "find sparse equations of saved runs", REDUCE)
    one.add_argument("files", type=Path, nargs="+", metavar="RUN.nc", help="runs")
    one.add_argument("--held-out", type=Path, metavar="RUN.nc", help="run that is predicted")
    one.add_argument("--begin", type=float, help="time of the first sample taken [s]")
    one.add_argument("--radius", type=float, help="rolling radius [m]")
    one.add_argument("--disc", default="disc", help="body that rolls (%(default)s)")
    one.add_argument("--bracket", default="bracket", help="body of the other pad (%(default)s)")
    meaning = "least part of a rate that a term must account for (%(default)s)"
    one.add_argument("--threshold", type=float, default=0.05, help=meaning)
    add_out(one, "reduced")


def reduce(options: argparse.Namespace) -> int:
    """Fit the runs and predict the held-out one."""
    from torchsoft.files import write_json
    from torchsoft.reduced import (
        Recipe,
        assemble,
        fit,
        loop,
        mechanics,
        record,
        rolling_radius,
        score,
    )  # fmt: skip
    from torchsoft.reduced.fit import GROSS
    from torchsoft.solve.trajectory import Trajectory

    *fitted, last = [*options.files, *([options.held_out] if options.held_out else [])]
    if not fitted:
        raise ValueError("one run is fitted and none is left to predict; give another, --held-out")
    if not 0 < options.threshold < 1:
        raise ValueError(f"--threshold must lie between 0 and 1; it is {options.threshold:g}")
    if options.radius is not None and not options.radius > 0:
        raise ValueError(f"--radius must be positive [m]; it is {options.radius:g}")
    names: dict[str, Any] = {"disc": options.disc, "bracket": options.bracket}
    runs = [Trajectory.load(file) for file in (*fitted, last)]
    records = [record(run, begin=options.begin, **names) for run in runs]
    try_folder(options.out, options.force)
    radius = options.radius or rolling_radius(records[:1])
    size = runs[0].setup.bodies[options.disc].size
    if not radius < LARGEST * size:
        raise ValueError(
            f"a rolling radius of {radius:g} m is not that of `{options.disc}`, which reaches "
            f"{size:.3g} m from its centre; give it in metres by --radius"
        )
    recipe = Recipe(threshold=options.threshold, width=0.004, window=0.3)
    model = fit(assemble(records[:-1], mechanics(radius), recipe), recipe, loop(records[:-1]))
    predicted = score(model, records[-1])
    say(f"{model}\n{predicted}")
    errors = None if predicted.rollout.diverged_at is not None else predicted.nrmse
    summary = {
        "equations": model.text(), "coefficients": model.coefficient_table(),
        "feedback": model.feedback, "rolling_radius": radius, "threshold": options.threshold,
        "fitted": [str(file) for file in fitted], "held_out": str(last), "nrmse": errors,
        "diverged_at": predicted.rollout.diverged_at,
    }  # fmt: skip
    write_json(options.out / "reduced.json", summary)
    say(f"written to {options.out / 'reduced.json'}")
    return int(max(predicted.over_deviation.values()) > GROSS)
