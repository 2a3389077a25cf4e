"""Young's modulus of a pull or a compression over a range of strains."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchsoft.materials.measured import SMALL_STRAIN, Array, Pull
from torchsoft.physics.material import KelvinVoigt

CURVED = 0.1
"""Change of the slope over the range, relative to its mean, from which it is said."""


@dataclass(frozen=True)
class Modulus:
    """The slope E [Pa] of a pull's nominal stress over its strains, by least squares with an
    offset; the `fitted` stress (n,) and the slopes [Pa] at both ends by a parabola."""

    measured: Pull
    values: Mapping[str, float]
    sd: Mapping[str, float]
    fitted: Array
    ends: tuple[float, float]
    notices: tuple[str, ...]
    kind: str = "kelvin_voigt"

    @property
    def rms(self) -> float:
        """Root mean square of the residual over the largest stress."""
        stress = self.measured.stress
        return float(np.sqrt(np.mean((stress - self.fitted) ** 2)) / np.abs(stress).max())

    @property
    def test(self) -> str:
        """Kind of test."""
        return self.measured.test

    @property
    def described(self) -> str:
        """What was fitted, and how well."""
        low, high = self.measured.strains
        return f"strains from {low:g} to {high:g}, residual {self.rms:.2%} of the largest"

    def method(self) -> dict[str, Any]:
        """How the modulus was found, and how well it fits, for a summary in JSON."""
        return {
            "method": "slope of a straight line by least squares",
            "rows": len(self.fitted),
            "strains": list(self.measured.strains),
            "slopes_at_ends": list(self.ends),
            "residual_rms": self.rms,
            "residual_of": "of the largest",
        }

    def table(self) -> dict[str, Any]:
        """The argument of the material's constructor that the test determines."""
        return dict(self.values)

    def material(self, *, nu: float, rho: float, depth: float, tau: float) -> KelvinVoigt:
        """The material, with stated values where a pull has no information."""
        return KelvinVoigt(**self.values, nu=nu, rho=rho, depth=depth, tau=tau)


def modulus(pull: Pull) -> Modulus:
    """The modulus of a pull. Raises `ValueError` where the stress does not grow with strain."""
    if pull.test not in ("tension", "compression"):
        raise ValueError(
            f"{pull.path}: the modulus of a {pull.test} test is not E; say --energy neo_hookean"
        )
    x, y = pull.strain, pull.stress
    (E, offset), spread = np.polyfit(x, y, 1, cov="unscaled")
    fitted = E * x + offset
    sd = float(np.sqrt(spread[0, 0] * ((y - fitted) ** 2).sum() / (len(x) - 2)))
    if E <= 0:
        raise ValueError(
            f"{pull.path}: the slope of the stress is {E:.4g} Pa between strains of "
            f"{pull.strains[0]:g} and {pull.strains[1]:g}, but must be positive: take another range"
        )
    curve = np.polyder(np.polyfit(x, y, 2))
    ends = (float(np.polyval(curve, x[0])), float(np.polyval(curve, x[-1])))
    return Modulus(pull, {"E": float(E)}, {"E": sd}, fitted, ends, tuple(notices(pull, E, ends)))


def notices(pull: Pull, E: float, ends: tuple[float, float]) -> list[str]:
    """Sentences on assumptions."""
    sentences = [
        "a modulus at the speed of this test: a slower one gives less, a faster one more; what the "
        "rubber does over time is of a relaxation, a creep or a frequency test"
    ]
    if abs(ends[1] - ends[0]) > CURVED * E:
        sentences.append(
            f"the slope goes from {1e-6 * ends[0]:.3g} to {1e-6 * ends[1]:.3g} MPa between these "
            "strains: E is their mean, and holds for no others"
        )
    if pull.strains[1] > SMALL_STRAIN:
        sentences.append(
            f"strains go up to {pull.strains[1]:.0%}, and pads are linear in small ones: a pad "
            "that is pressed less is stiffer or softer than this E"
        )
    if pull.test == "compression":
        sentences.append(
            "between plates that hold its ends a specimen is stiffer than its rubber, the flatter "
            "the more: lubricate them, or take a tall one"
        )
    return [*sentences, *pull.notices]
