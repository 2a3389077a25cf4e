"""The command `material`: fits to tests, and presets from the literature."""

import argparse
from pathlib import Path
from typing import Any

from torchsoft.cli.results import add_command, add_out, say, try_folder

MATERIAL_FIT = """\
Which material relaxes, or creeps, as this one did?

FILE.csv has the column `t` [s, ms, min, h], counted from when the load was put on, and one pair
of these, each with its unit in the heading: `strain` [1, %], `stretch` [1] or `elongation` [m,
mm, ...] with `stress` [Pa, kPa, MPa] or `force` [N, ...], nominal and along the one direction of
the test; or alone `modulus` [Pa, ...], of a strain put on at t = 0 and held, or `compliance`
[1/Pa, ...], of such a stress. The whole history counts: ramps need not be cut off. Fits a
relaxation series (prony) to a relaxation test, a generalised Kelvin chain to a creep test, and
says what the rows do not tell. Writes material.toml, with the names of the constructor's
arguments, summary.json and fit.png."""

PRESETS = """\
Rubbers from the literature, every coefficient marked `published`, with where, or `assumed`."""


def add_commands(commands: Any) -> None:
    """Add the command `material`."""
    material = commands.add_parser(
        "material", help="fit a material to a test, or list some", description="Materials of pads."
    )
    commands = material.add_subparsers(required=True, metavar="COMMAND")
    help = "fit a material to a relaxation or creep test"
    one = add_command(commands, "fit", fit_material, help, MATERIAL_FIT)
    one.add_argument("file", type=Path, metavar="FILE.csv", help="the test")
    add_out(one, "material")
    one.add_argument(
        "--test",
        choices=("relaxation", "creep"),
        help="what was put on: strain, or stress (what was held)",
    )
    one.add_argument("--terms", type=int, help="terms of the series (as many as the data call for)")
    one.add_argument(
        "--length", type=float, help="gauge length [m], which `elongation` is divided by"
    )
    one.add_argument(
        "--area", type=float, help="cross-section before the test [m2], which `force` is divided by"
    )
    for name, meaning in (
        ("nu", "Poisson's ratio [1]"),
        ("rho", "density [kg/m3]"),
        ("depth", "depth of the pads [m]"),
    ):
        one.add_argument(
            f"--{name}",
            type=float,
            help=f"{meaning}, which the test does not tell (as the paper's pads)",
        )
    add_command(commands, "presets", list_presets, "list rubbers from the literature", PRESETS)


def fit_material(options: argparse.Namespace) -> int:
    """Fit a material to a test, and write the result."""
    from torchsoft.materials.fit import fit, read
    from torchsoft.materials.written import FILES, printed, write
    from torchsoft.paper.parameters import Parameters

    settings = {name: getattr(options, name) for name in ("test", "length", "area")}
    given = {name: getattr(options, name) for name in ("nu", "rho", "depth")}
    pad = (
        Parameters().override({f"pad.{name}": x for name, x in given.items() if x is not None}).pad
    )
    found = fit(read(options.file, **settings), terms=options.terms)
    try_folder(options.out, options.force)
    write(
        found,
        options.out,
        {name: getattr(pad, name) for name in given},
        {**settings, "terms": options.terms, **given},
    )
    say(printed(found))
    say(f"written to {', '.join(str(options.out / name) for name in FILES)}")
    return 0


def list_presets(options: argparse.Namespace) -> int:
    from torchsoft.materials.presets import PRESETS as presets

    say("\n".join(one.described() for one in presets.values()), needed=True)
    return 0
