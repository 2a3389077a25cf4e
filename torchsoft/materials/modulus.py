"""Young's modulus of a pull or a compression over a range of strains."""

import numpy as np

from torchsoft.materials.energies import AT_ONE_SPEED, PullFit
from torchsoft.materials.measured import SMALL_STRAIN, Pull

CURVED = 0.1
"""Change of the slope over the range, relative to its mean, from which it is said."""


def modulus(pull: Pull) -> PullFit:
    """The slope E [Pa] of a pull's nominal stress over its strains, by least squares with an
    offset. Raises `ValueError` where the stress does not grow with strain."""
    if pull.test not in ("tension", "compression"):
        raise ValueError(
            f"{pull.path}: the modulus of a {pull.test} test is not E; use --energy neo_hookean"
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
    sentences = tuple(notices(pull, float(E)))
    return PullFit((pull,), "kelvin_voigt", {"E": float(E)}, {"E": sd}, (fitted,), sentences)


def notices(pull: Pull, E: float) -> list[str]:
    """Sentences on assumptions."""
    sentences = [AT_ONE_SPEED]
    parabola = np.polyder(np.polyfit(pull.strain, pull.stress, 2))
    first, last = np.polyval(parabola, pull.strain[[0, -1]]).tolist()
    if abs(last - first) > CURVED * E:
        sentences.append(
            f"the slope goes from {1e-6 * first:.3g} to {1e-6 * last:.3g} MPa between these "
            "strains: E is the mean slope of this range only"
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
