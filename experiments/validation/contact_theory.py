"""Question: does contact follow the closed forms of mechanics, at every size?

Slopes, stops and spins over two to four decades of size; Hertz's contact and the flat punch;
Cattaneo's and Mindlin's partial slip; Carter's rolling. The closed forms are on the page of the
documentation (`docs/contact_theory.md`).

Command: .venv/bin/python -m experiments.validation.contact_theory [--smoke]
Expected: sliding, stops and spin within 0.1 % at every mass and size; Hertz within 0.03 % in a and
0.23 % in p_0; the punch's pressure within 0.7 %; c within 0.1 % of a; creep to 0.3 % of the limit,
rolled to both sides. A minute of a core.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.frame import numbers, options, write
from experiments.validation.half_plane import (
    PEAK,
    STIFF,
    WAY,
    A,
    HalfPlane,
    carter,
    cattaneo,
    hertz,
    punch,
)
from experiments.validation.sliding import MU, Sliding
from torchsoft import SmoothSlip


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/contact_theory")
    masses_kg: tuple[float, ...] = (1e-3, 0.1, 10.0)
    sizes_mm: tuple[float, ...] = (5.0, 50.0, 500.0)  # heights of the pads
    slopes_deg: tuple[float, ...] = (10.0, 20.0, 26.0, 27.0, 30.0, 45.0)
    elements: tuple[int, ...] = (5, 10, 20, 40)  # over the half-width of the contact
    springs: tuple[float, ...] = (25.0, 100.0, 400.0)  # K per area in units of E* / a
    thick: tuple[float, ...] = (15.0, 30.0, 60.0, 120.0)  # heights of the layer over a
    tractions: tuple[float, ...] = (0.25, 0.5, 0.75, 0.9)  # Q / (mu P) of rolls
    nu: tuple[float, ...] = (0.49, 0.45)  # of rolls
    way: float = WAY  # of a roll over a
    rolled_elements: int = 20
    smoke: bool = False  # a size that takes seconds


Rows = dict[str, dict[str, float]]


Curve = Sequence[Any]
"""Two rows of numbers, x and y."""


class Panel(NamedTuple):
    """One part of the figure: title and labels, lines of theory, and what was found, by label."""

    title: str
    x: str
    y: str
    theory: list[Curve]
    found: Mapping[str, Curve]


def sliding(config: Config) -> dict[str, Rows]:
    """Slopes, and boxes and discs of every mass and size."""
    slopes = {f"{angle:g}": Sliding().slope(angle) for angle in config.slopes_deg}
    slopes["45, smooth law"] = Sliding(friction=SmoothSlip(MU, MU)).slope(45.0)
    cases = [(mass, size) for mass in config.masses_kg for size in config.sizes_mm]
    sizes = {
        f"{mass:g} kg, {size:g} mm": Sliding(mass, 1e-3 * size).errors()
        for mass, size in tqdm(cases, "sizes", leave=False, disable=None)
    }
    return {"slopes": slopes, "sizes": sizes}


def pressed(config: Config) -> dict[str, Rows]:
    """Hertz's contact, punch and partial slip, by elements, springs and heights of the layer."""
    usual = HalfPlane()
    cases = {f"{n} elements": replace(usual, elements=n) for n in config.elements}
    cases |= {f"springs {k:g} E*/a": replace(usual, springs=k) for k in config.springs}
    layers = {f"layer of {h:g} a": replace(usual, thick=h) for h in config.thick}
    both = {**cases, "40 elements, springs 400 E*/a": STIFF}
    pressure = {name: hertz(case) | punch(case) for name, case in both.items()}
    pressure |= {name: hertz(case) for name, case in layers.items()}
    every = tqdm(cases.items(), "partial slip", leave=False, disable=None)
    return {"pressure": pressure, "partial slip": {name: cattaneo(x)[0] for name, x in every}}


def rolling(config: Config) -> Rows:
    """Carter's rolling by nu and moment."""
    cases = [(nu, traction) for nu in config.nu for traction in config.tractions]
    return {
        f"{nu:g}, {traction:g}": carter(
            HalfPlane(nu, config.rolled_elements, rolled=config.way), traction
        )
        for nu, traction in tqdm(cases, "rolls", leave=False, disable=None)
    }


def panels(rolls: Rows) -> list[Panel]:
    """Partial slip, creepage of rolls and spin."""
    _, slid = cattaneo(HalfPlane())
    shears = {name: (at.x / A, at.q / (MU * PEAK)) for name, (at, _) in slid.items()}
    creep = [[row[name] for row in rolls.values()] for name in ("xi R / (mu a)", "Q / (mu P)")]
    limit, (t, spin) = np.linspace(0, 1, 101), Sliding().spun()
    return [
        Panel("partial slip (Cattaneo, Mindlin)", "x / a", "q / (mu p_0)",
              [(at.x / A, theory) for at, theory in slid.values()], shears),
        Panel("rolling (Carter)", "xi R / (mu a)", "Q / (mu P)",
              [(limit, 1 - (1 - limit) ** 2)], {"found": creep}),
        Panel("spinning disc set down", "3 mu g t / (omega_0 r)", "omega / omega_0",
              [([0, 1, 1.5], [1, 1 / 3, 1 / 3])], {"found": (t[::4], spin[::4])}),
    ]  # fmt: skip


def figure(every: list[Panel]) -> Figure:
    """Circles are found, lines are theory."""
    made = Figure(figsize=(10, 3.4), layout="constrained")
    for axes, panel in zip(made.subplots(1, 3), every):
        for x, y in panel.theory:
            axes.plot(x, y, color="k", lw=1)
        for name, (x, y) in panel.found.items():
            axes.plot(x, y, "o", ms=3, mfc="none", label=name)
        axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
        axes.legend(fontsize=7)
        if panel.x == "x / a":
            axes.set_xlim(-1.2, 1.2)
    return made


def main(config: Config) -> None:
    if config.smoke:
        config = Config(
            out=config.out, masses_kg=(0.1,), sizes_mm=(50.0,), slopes_deg=(20.0,),
            elements=(10, 20), springs=(), thick=(30.0,), tractions=(0.5,), nu=(0.49,),
            way=3.0, rolled_elements=10, smoke=True,
        )  # fmt: skip
    found = {**sliding(config), **pressed(config), "rolling": rolling(config)}
    tables = {
        "slopes": numbers("slope [deg]", found["slopes"]),
        "sizes": numbers("mass, height of the pad", found["sizes"], "+.2%"),
        "pressure": numbers("case", found["pressure"], "+.2%"),
        "partial slip": numbers("case", found["partial slip"], "+.2%"),
        "rolling": numbers("nu, moment over mu P R", found["rolling"]),
    }
    write(config, found, tables, {"contact_theory": figure(panels(found["rolling"]))})


if __name__ == "__main__":
    main(options(Config, __doc__))
