"""Rubbers from the literature. Every coefficient is `published`, with where, `fitted` here to
published tests, or `assumed`.

None of these sources gives retardation times: one Kelvin-Voigt time is assumed, and ought to be
fitted to a relaxation or creep test, or identified.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from torchsoft.physics.hyperelastic import Ogden
from torchsoft.physics.material import KelvinVoigt
from torchsoft.tables import read_toml

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
        values: dict[str, Any] = {name: one.value for name, one in self.coefficients.items()}
        if "E" in values:
            return KelvinVoigt(**values, depth=depth)
        lists = {name: [values.pop(name)] for name in ("mu", "alpha")}
        return Ogden(**lists, **values, depth=depth)

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


def preset(name: str, source: Any, origin: str, **own: float) -> Preset:
    """A rubber whose `own` coefficients have one origin; the others are assumed."""
    stated = {symbol: Coefficient(value, source, origin) for symbol, value in own.items()}
    return Preset(name, stated | ASSUMED)


PRESETS: Mapping[str, Preset] = {
    name: preset(name, **table)
    for name, table in read_toml(Path(__file__).with_name("presets.toml")).items()
}
"""Presets by name, those of `presets.toml`."""
