"""The command `material`: fits to tests, and presets from the literature."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchsoft.cli.results import add_command, add_out, say, try_folder
from torchsoft.materials.kinds import ENERGIES, PULLS

if TYPE_CHECKING:
    from torchsoft.materials.energies import PullFit
    from torchsoft.materials.fit import Fit

MATERIAL_FIT = """\
Which material belongs to this test?

FILE is a table (CSV, or an Excel workbook) whose headings have units, `stress [MPa]`, in any order:

- relaxation or creep: `t`, one of `strain`, `stretch`, `elongation`, and one of `stress`, `force`,
nominal and along the direction of the test; or `t` with `modulus` or `compliance` alone, for a step
at t = 0;
- a frequency sweep: `frequency` with `storage_modulus` and `loss_modulus`, or
`storage_shear_modulus` and `loss_shear_modulus`, or `tan_delta` as the second;
- tension, compression or shear, with or without `t`: --range states the strains of the modulus, or
--energy the strain energy, with --also for further tables and --relaxation for its branches.

Ramps need not be cut off: the fit uses the whole history.

Relaxation tests and sweeps give a relaxation series (prony), creep tests a generalised Kelvin
chain, tension tests a modulus (kelvin_voigt). Reports what the test does not determine. Writes
material.toml, summary.json and fit.png."""

PRESETS = """\
Lists rubbers from the literature. Every coefficient is marked `published`, with its source,
`fitted` to published tests, or `assumed`."""


def add_commands(commands: Any) -> None:
    """Add the command `material`."""
    material = commands.add_parser(
        "material", help="fit a material to a test, or list some", description="Materials of pads."
    )
    commands = material.add_subparsers(required=True, metavar="COMMAND")
    help = "fit a material to a test"
    one = add_command(commands, "fit", fit_material, help, MATERIAL_FIT)
    one.add_argument("file", type=Path, metavar="FILE", help="the test")
    add_out(one, "material")
    one.add_argument(
        "--test",
        choices=("relaxation", "creep", "sweep", *PULLS),
        help="kind of test (by default from the columns); planar is tension at constant width, "
        "biaxial tension in two directions",
    )
    one.add_argument(
        "--energy", choices=ENERGIES,
        help="strain energy that is fitted to a test in tension, compression or shear",
    )  # fmt: skip
    one.add_argument(
        "--also", action="append", default=[], metavar="TEST=FILE",
        help="a further table for the energy, such as shear=FILE.csv; may be repeated",
    )  # fmt: skip
    one.add_argument(
        "--relaxation", metavar="FILE",
        help="a relaxation test, whose series gives the branches of the energy",
    )  # fmt: skip
    one.add_argument(
        "--fast", action="store_true",
        help="the tests of the energy were fast compared with the relaxation, not slow",
    )  # fmt: skip
    one.add_argument(
        "--true", action="store_true",
        help="stresses are true, not nominal",
    )  # fmt: skip
    one.add_argument(
        "--terms", type=int,
        help="terms of the series (by the Bayesian information criterion), or of ogden (one)",
    )  # fmt: skip
    for name, meaning in SIZES.items():
        one.add_argument(f"--{name}", type=float, help=meaning)
    one.add_argument(
        "--range", type=float, nargs=2, metavar=("LOW", "HIGH"),
        help="strains [1] between which the modulus is fitted",
    )  # fmt: skip
    one.add_argument(
        "--column", action="append", default=[], metavar="NAME=HEADING",
        help="heading of a column in the file, such as force=Standardkraft; may be repeated",
    )  # fmt: skip
    one.add_argument(
        "--ignore", action="append", default=[], metavar="HEADING",
        help="a column to leave out; may be repeated",
    )  # fmt: skip
    for name, (value, meaning) in ASSUMED.items():
        one.add_argument(f"--{name}", type=float, help=f"{meaning} (assumed: {value:g})")
    add_command(commands, "presets", list_presets, "list rubbers from the literature", PRESETS)


SIZES = {
    "length": "gauge length [m], which `elongation` is divided by",
    "area": "cross-section before the test [m2], which `force` is divided by",
}
ASSUMED = {
    "nu": (0.45, "Poisson's ratio [1], which no test in one dimension determines"),
    "rho": (1100.0, "density [kg/m3], which no test determines"),
    "depth": (44e-3, "depth of the pads [m]"),
    "tau": (10e-3, "retardation time [s], which a tension test does not determine"),
}
"""Values that a test may not determine: assumed values and meanings."""


def fit_material(options: argparse.Namespace) -> int:
    """Fit a material to a test, and write it."""
    from torchsoft.materials.written import FILES, printed, write
    from torchsoft.physics.material import KelvinVoigt
    from torchsoft.quantity import quantities

    given = {name: getattr(options, name) for name in ASSUMED}
    values = {name: value for name, (value, _) in ASSUMED.items()}
    for name, value in given.items():
        if value is not None:
            try:
                values[name] = quantities(KelvinVoigt)[name].check(value)
            except ValueError as error:
                raise ValueError(f"--{name} {error}") from None
    found = tested(options, values["nu"])
    assumed = {
        name: value
        for name, value in values.items()
        if name not in found.table() and (name != "tau" or found.kind in TIMELESS)
    }
    for name, value in given.items():
        if value is not None and name not in assumed:
            raise ValueError(f"{options.file}: the test determines {name}: leave --{name} out")
    try_folder(options.out, options.force)
    others = ("file", "out", "force", "run", "command")
    stated = {name: x for name, x in vars(options).items() if name not in others}
    write(found, options.out, assumed, stated)
    say(printed(found))
    say(f"written to {', '.join(str(options.out / name) for name in FILES)}")
    return 0


TIMELESS = ("kelvin_voigt", *ENERGIES)
"""Kinds of materials whose tests determine no time."""


def tested(options: argparse.Namespace, nu: float) -> "Fit | PullFit":
    """The material of a test. Raises `ValueError`."""
    from torchsoft.materials.fit import fit
    from torchsoft.materials.measured import Pull, read
    from torchsoft.materials.modulus import modulus

    pairs = [one.partition("=")[::2] for one in options.column]
    if not all(name and heading for name, heading in pairs):
        raise ValueError("--column must be NAME=HEADING, as force=Standardkraft")
    given: dict[str, Any] = {
        "length": options.length, "area": options.area, "nu": nu,
        "strains": None if options.range is None else tuple(options.range),
        "headings": {heading: name for name, heading in pairs}, "ignore": options.ignore,
        "true": options.true, "whole": options.energy is not None,
    }  # fmt: skip
    test = read(options.file, test=options.test, **given)
    if options.energy is not None:
        return energy(options, test, given)
    for name in ("also", "relaxation", "fast"):
        if getattr(options, name):
            raise ValueError(f"--{name} is of energies: state which, such as --energy yeoh")
    if not isinstance(test, Pull):
        return fit(test, terms=options.terms)
    if options.terms is not None:
        raise ValueError(f"{options.file}: a pull gives a modulus, and no --terms")
    return modulus(test)


def energy(options: argparse.Namespace, test: Any, given: dict[str, Any]) -> "PullFit":
    """The strain energy of a table and of those of --also. Raises `ValueError`."""
    from torchsoft.materials.energies import fit_energy
    from torchsoft.materials.fit import fit
    from torchsoft.materials.measured import Measured, Pull, read

    if not isinstance(test, Pull):
        raise ValueError(
            f"{options.file}: an energy is of a pull, a compression or a shear; use --test tension"
        )
    pulls = [test]
    for name, file in (one.partition("=")[::2] for one in options.also):
        if name not in PULLS or not file:
            raise ValueError(f"--also must be TEST=FILE, with a test of {', '.join(PULLS)}")
        other = read(file, test=name, **given)
        assert isinstance(other, Pull)
        pulls.append(other)
    found = fit_energy(pulls, options.energy, nu=given["nu"], terms=options.terms)
    if options.relaxation is None:
        if options.fast:
            raise ValueError("--fast is against a relaxation test: state it, --relaxation FILE")
        return found
    given |= {"whole": False, "true": False, "strains": None}
    over_time = read(options.relaxation, test="relaxation", **given)
    assert isinstance(over_time, Measured)
    return found.relaxing(fit(over_time), options.fast)


def list_presets(options: argparse.Namespace) -> int:
    from torchsoft.materials.presets import PRESETS as presets

    say("\n".join(one.described() for one in presets.values()), needed=True)
    return 0
