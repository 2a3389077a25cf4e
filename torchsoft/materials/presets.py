"""Rubbers from the literature. Every coefficient is `published`, with where, `fitted` here to
published tests, or `assumed`.

None of these sources gives retardation times: one Kelvin-Voigt time is assumed, and ought to be
fitted to a relaxation or creep test, or identified. Those at finite strain are Ogden's energy of
one term, fitted here (`material fit --energy ogden --range 0 1`) to the pulls of a database.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from torchsoft.physics.hyperelastic import Ogden
from torchsoft.physics.material import KelvinVoigt

GENT = (
    "A. N. Gent, On the relation between indentation hardness and Young's modulus, Rubber Chem. "
    "Technol. 31 (1958) 896-906"
)
LINDLEY = (
    "P. B. Lindley, Engineering Design with Natural Rubber, 4th ed., Malaysian Rubber Producers' "
    "Research Association"
)
JOHNSTON = (
    "I. D. Johnston et al., Mechanical characterization of bulk Sylgard 184 for microfluidics and "
    "microengineering, J. Micromech. Microeng. 24 (2014) 035017"
)
MARECHAL = (
    "pulls to failure of ASTM D412 dumb-bells, Soft Robotics Materials Database (L. Marechal et "
    "al., Toward a common framework and database of materials for soft robotics, Soft Robotics 8 "
    "(2021) 284-297; data under ODbL)"
)
SMOOTH_ON = "Smooth-On Inc., Dragon Skin series, technical bulletin"

SHORE_A = (20.0, 80.0)
"""Hardnesses for which the relation between Shore A and Young's modulus is taken: at the ends of
the scale it is not one."""


class Coefficient(NamedTuple):
    """A number of a preset [SI], whether it is published, and where, fitted here to published data,
    or why it was assumed."""

    value: float
    source: Literal["published", "fitted", "assumed"]
    origin: str


def from_shore_a(hardness: float) -> float:
    """Young's modulus [Pa] of rubber of a Shore A hardness S, 0.0981 (56 + 7.62336 S) / (0.137505
    (254 - 2.54 S)) MPa (Gent 1958). Raises `ValueError` outside `SHORE_A`."""
    low, high = SHORE_A
    if not low <= hardness <= high:
        raise ValueError(
            f"the hardness must be from {low:g} to {high:g} Shore A, but is {hardness:g}; for "
            "softer rubbers, also those of the scale 00, no relation holds: pull a strip, and take "
            "the modulus of `torchsoft material fit PULL.csv --test tension --range 0 0.1`"
        )
    return 1e6 * 0.0981 * (56 + 7.62336 * hardness) / (0.137505 * (254 - 2.54 * hardness))


@dataclass(frozen=True)
class Preset:
    """A rubber of one retardation time with its coefficients by name: E, or Ogden's mu and alpha,
    nu, rho and tau."""

    name: str
    coefficients: Mapping[str, Coefficient]

    def material(self, depth: float) -> KelvinVoigt | Ogden:
        """Pads of it, so deep [m] out of the plane."""
        values = {name: one.value for name, one in self.coefficients.items()}
        if "E" in values:
            return KelvinVoigt(**values, depth=depth)
        lists = {name: [values.pop(name)] for name in ("mu", "alpha")}
        return Ogden(**lists, nu=values["nu"], rho=values["rho"], tau=values["tau"], depth=depth)

    def described(self) -> str:
        """Every coefficient with its unit, its source and where that is."""
        units = {"E": "Pa", "mu": "Pa", "alpha": "1", "nu": "1", "rho": "kg/m3", "tau": "s"}
        rows = [
            f"  {k:<6}{c.value:<9.4g} {units[k]:<6} {c.source}: {c.origin}"
            for k, c in self.coefficients.items()
        ]
        return "\n".join([self.name, *rows])


ASSUMED = {
    "nu": Coefficient(0.49, "assumed", "nearly incompressible, as rubber is"),
    "rho": Coefficient(1100.0, "assumed", "of silicone; counts for inertial pads only"),
    "tau": Coefficient(10e-3, "assumed", "fit it to a test, or identify it"),
}
"""Coefficients that none of the sources gives."""


def rubber(name: str, source: Literal["published", "fitted"], origin: str, **own: float) -> Preset:
    """A rubber whose `own` coefficients are of one origin; the others are assumed."""
    coefficients = {symbol: Coefficient(value, source, origin) for symbol, value in own.items()}
    return Preset(name, coefficients | ASSUMED)


def silicone(name: str, hardness: float, secant: float) -> Preset:
    """A silicone by the Shore A hardness in its data sheet, whose modulus at 100 % strain is a
    `secant` [Pa]."""
    origin = (
        f"{hardness:g} Shore A ({SMOOTH_ON}), by the relation of {GENT}: of small strains, good to "
        f"some tens of per cent; the sheet's secant at 100 % strain is {1e-6 * secant:.2g} MPa, "
        "and strips of it that were pulled so far are as soft"
    )
    return rubber(name, "published", origin, E=from_shore_a(hardness))


def stretched(name: str, mu: float, alpha: float, residual: float) -> Preset:
    """A silicone at finite strain, by Ogden's energy of one term, with what is left of the stress
    [1]."""
    origin = f"to stretches from 1 to 2, {residual:.1%} of the largest stress left, of {MARECHAL}"
    return rubber(f"{name}, finite strain", "fitted", origin, mu=mu, alpha=alpha)


CURED = "of curing temperatures from 25 to 200 C"
HARDNESS = f"table of hardness and elastic moduli, {LINDLEY}"

PRESETS: Mapping[str, Preset] = {
    one.name: one
    for one in (
        silicone("Dragon Skin 20", 20.0, 0.34e6),
        silicone("Dragon Skin 30", 30.0, 0.59e6),
        rubber(
            "Sylgard 184, softest", "published", f"44 Shore A, least {CURED}, {JOHNSTON}", E=1.32e6
        ),
        rubber(
            "Sylgard 184, hardest", "published", f"54 Shore A, most {CURED}, {JOHNSTON}", E=2.97e6
        ),
        rubber("natural rubber 40 IRHD", "published", HARDNESS, E=1.50e6),
        rubber("natural rubber 50 IRHD", "published", HARDNESS, E=2.20e6),
        rubber("natural rubber 60 IRHD", "published", HARDNESS, E=4.45e6),
        stretched("Dragon Skin 10 Medium", 40.2e3, 3.25, 0.0066),
        stretched("Dragon Skin 20", 112e3, 3.29, 0.009),
        stretched("Dragon Skin 30", 168e3, 3.06, 0.0029),
        stretched("Ecoflex 00-30", 14.5e3, 2.42, 0.0126),
        stretched("Ecoflex 00-50", 19.8e3, 2.49, 0.0155),
    )
}
"""Presets by name."""
