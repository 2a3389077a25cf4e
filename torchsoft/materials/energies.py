"""Strain energies fitted to pulls, compressions and shears: least squares of the nominal stress,
dW / d(stretch) of the incompressible material, in every table at once.

The stress is linear in all coefficients but Ogden's exponents: the iteration is over these alone,
the others are solved for (variable projection).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torchsoft.materials.fit import Fit, arguments, covariance_root, hardly_determined
from torchsoft.materials.kinds import ENERGIES
from torchsoft.materials.measured import Array, Pull, instant_time
from torchsoft.physics.hyperelastic import KINDS, Hyperelastic, Ogden
from torchsoft.physics.material import Material
from torchsoft.quantity import quantities

EXPONENTS = (2.0, -2.0, 5.0, -5.0, 1.0)
"""Exponents of Ogden's terms that a fit starts from, rotated for each of its starts."""

STEP = 1e-4
"""Change of an exponent by which the derivative of stresses is taken."""

DEPENDENT = 1e-10
"""Relative singular value below which coefficients count as dependent."""

SMALLEST = 0.5
"""Smallest stretch, and the inverse of the largest, in which stability is looked for, if the tables
do not go further."""

AT_ONE_SPEED = (
    "the modulus is that at the speed of this test (a slower one gives less, a faster one more); "
    "for the time dependence, fit a relaxation, creep or frequency test"
)
"""Sentence on the modulus of a tensile test."""


@dataclass(frozen=True)
class PullFit:
    """A material fitted to `pulls`, one or more tables: `values` of its coefficients with their
    standard deviations `sd`, those of branches behind them; the `fitted` nominal stress, table by
    table; the `relaxation` test's series that the branches are of, if any."""

    pulls: tuple[Pull, ...]
    kind: str
    values: Mapping[str, float]
    sd: Mapping[str, float]
    fitted: tuple[Array, ...]
    notices: tuple[str, ...]
    relaxation: Fit | None = None

    @property
    def measured(self) -> Pull:
        """The first table."""
        return self.pulls[0]

    @property
    def test(self) -> str:
        """Kinds of tests."""
        return " and ".join(dict.fromkeys(pull.test for pull in self.pulls))

    @property
    def described(self) -> str:
        """What was fitted, and how well."""
        return f"{self.kind}, residual {self.rms:.2%} of the largest stress"

    def method(self) -> dict[str, Any]:
        """How the coefficients were found, and how well they fit, for a summary in JSON."""
        line = self.kind == "kelvin_voigt"
        model = "of a straight line" if line else "of an incompressible specimen"
        own: dict[str, Any] = {
            "method": f"least squares of the nominal stress {model}",
            "tables": [
                {
                    "file": pull.path.name,
                    "test": pull.test,
                    "rows": len(pull.strain),
                    "strains": list(pull.strains),
                }
                for pull in self.pulls
            ],
            "residual_rms": self.rms,
            "residual_of": "of the largest",
        }
        if self.relaxation is not None:
            path = self.relaxation.measured.path
            own["relaxation"] = {
                "file": path.name,
                "sha256": sha256(path.read_bytes()).hexdigest(),
                **self.relaxation.method(),
            }
        return own

    @property
    def rms(self) -> float:
        """Root mean square of the residuals over the largest stress of their table."""
        parts = [(p.stress - f) / np.abs(p.stress).max() for p, f in zip(self.pulls, self.fitted)]
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

    def table(self) -> dict[str, Any]:
        """The arguments of the material's constructor that the tests determine, and with branches a
        tau that is small beside their times."""
        own = arguments(self.values, BRANCHES)
        return own | ({"tau": instant_time(own["times"])} if self.relaxation else {})

    def relaxing(self, series: Fit, fast: bool) -> "PullFit":
        """The energy with the branches of a relaxation test: strengths over its relaxed modulus,
        and times. Pulls that were `fast` against them determine the instantaneous energy, which is
        that of the relaxed material times 1 + the sum of these strengths; others determine the
        relaxed one."""
        strengths = [name for name in series.values if name.startswith("E_")]
        E = series.values["E"]
        total = 1 + sum(series.values[name] for name in strengths) / E
        values, sd = (
            {k: x if k.startswith("alpha") or not fast else x / total for k, x in of.items()}
            for of in (self.values, self.sd)
        )
        relaxed = made(self.kind, arguments(values), nu=0.45, **UNIT).E.item()
        for own, of_series in ((values, series.values), (sd, series.sd)):
            own |= {name: relaxed * of_series[name] / E for name in strengths}
            own |= {name: x for name, x in of_series.items() if name.startswith("tau_")}
        meaning = (
            "1 + the sum of its strengths over its relaxed modulus times the relaxed energy, which "
            "is written"
            if fast
            else "the relaxed energy"
        )
        count_as = (
            f"the pulls count as {'fast' if fast else 'slow'} against the times of "
            f"{series.measured.path.name}, so that they determine {meaning}"
        )
        notices = (*self.notices[:-1], count_as, *series.notices)
        return replace(self, values=values, sd=sd, notices=notices, relaxation=series)

    def material(self, **others: float) -> Material:
        """The material, with stated values of nu, rho, depth, and without branches tau, of which
        these tests have no information."""
        return KINDS[self.kind](**self.table(), **others)


BRANCHES = {"E": "moduli", "tau": "times"}
"""Arguments of the numbered coefficients of relaxing branches."""

UNIT = {"rho": 1e3, "tau": 1.0, "depth": 1.0}
"""Values of a material whose stress at rest is asked for, which does not depend on them."""


def made(kind: str, table: Mapping[str, Any], **others: float) -> Hyperelastic:
    material = KINDS[kind](**table, **others)
    assert isinstance(material, Hyperelastic)
    return material


def deformed(test: str, x: Tensor) -> Tensor:
    """Deformation gradients (n, 3, 3) of an incompressible specimen at stretches x (n,), or at
    amounts of shear."""
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    if test == "shear":
        rows = (one, x, zero), (zero, one, zero), (zero, zero, one)
    else:
        across = {"biaxial": (x, x**-2), "planar": (1 / x, one)}.get(test, (x**-0.5, x**-0.5))
        rows = (x, zero, zero), (zero, across[0], zero), (zero, zero, across[1])
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def nominal_stress(material: Hyperelastic, test: str, stretch: Array) -> Array:
    """Nominal stress (n,) [Pa] of an incompressible specimen at stretches (n,) [1], or at amounts
    of shear; negative in compression."""
    x = torch.from_numpy(stretch).clone().requires_grad_()
    with torch.enable_grad():
        (slope,) = torch.autograd.grad(material.distortion(deformed(test, x)).sum(), x)
    return (0.5 if test == "biaxial" else 1.0) * slope.numpy()


def stretches(pull: Pull) -> Array:
    """Stretches (n,) of a table's rows, or amounts of shear."""
    if pull.test == "shear":
        return pull.strain
    return 1 - pull.strain if pull.test == "compression" else 1 + pull.strain


def fit_energy(pulls: Sequence[Pull], kind: str, *, nu: float, terms: int | None = None) -> PullFit:
    """The energy of a kind that fits the tables best, every row relative to the largest stress of
    its table; `terms` are those of Ogden's, one by default. Poisson's ratio `nu` makes E of a shear
    modulus.

    Raises `ValueError` for `terms` of another kind, for more of them than the rows determine, and
    where the shear modulus of the best fit is not positive.
    """
    if terms is not None and kind != "ogden":
        raise ValueError(f"`terms` are those of ogden, but the energy is {kind}")
    numbers = range(1, (terms or 1) + 1)
    names = list(ENERGIES[kind])
    if kind == "ogden":
        names = [f"{symbol}_{k}" for symbol in names for k in numbers]
    rows = sum(len(pull.strain) for pull in pulls)
    if rows < 2 * len(names) or not 1 <= (terms or 1) <= len(EXPONENTS):
        raise ValueError(
            f"{rows} rows do not determine {len(names)} coefficients; take fewer terms"
        )
    sizes = np.concatenate([np.full(len(p.stress), np.abs(p.stress).max()) for p in pulls])
    target = np.concatenate([pull.stress for pull in pulls]) / sizes

    @cache
    def column(*unit: tuple[str, Any]) -> Array:
        return measured_stress(made(kind, arguments(dict(unit)), nu=nu, **UNIT), pulls) / sizes

    def columns(exponents: Array) -> Array:
        """Stresses per coefficient in which they are linear, over `sizes`: (rows, coefficients)."""
        if kind == "ogden":
            units = [{"mu_1": 1.0, "alpha_1": alpha} for alpha in not_zero(exponents).tolist()]
        else:
            units = [dict.fromkeys(names, 0.0) | {name: 1.0} for name in names]
        return np.stack([column(*one.items()) for one in units], 1)

    def residuals(exponents: Array) -> Array:
        A = columns(exponents)
        return A @ solved(A, target) - target

    exponents = np.empty(0)
    if kind == "ogden":
        allowed = quantities(Ogden)["alpha"]
        bounds = allowed.low, allowed.high
        starts = [np.roll(EXPONENTS, -k)[: len(numbers)] for k in range(len(EXPONENTS))]
        found = [least_squares(residuals, start, bounds=bounds, max_nfev=100) for start in starts]
        exponents = not_zero(
            min(found, key=lambda one: (solved(columns(one.x), target).sum() <= 0, one.cost)).x
        )
    jacobian = A = columns(exponents)
    linear = solved(A, target)
    if kind == "ogden":
        slopes = (columns(exponents + STEP) - columns(exponents - STEP)) / (2 * STEP) * linear
        jacobian = np.column_stack((A, slopes))
    values = dict(zip(names, [*linear.tolist(), *exponents.tolist()]))
    energy, fitted = made(kind, arguments(values), nu=nu, **UNIT), A @ linear
    if not (shear := energy.shear.item()) > 0:
        raise ValueError(
            f"{pulls[0].path}: the {kind} energy that fits best has a shear modulus of "
            f"{shear:.4g} Pa at small strains, but it must be positive: take another "
            "energy or fewer terms, or look at the stresses of the smallest strains"
        )
    variance = ((fitted - target) ** 2).sum() / max(rows - len(names), 1)
    sd = np.sqrt((covariance_root(jacobian) ** 2).sum(1) * variance)
    curves = np.split(fitted * sizes, np.cumsum([len(pull.stress) for pull in pulls])[:-1])
    deviations = dict(zip(names, sd.tolist()))
    sentences = tuple(notices(pulls, energy, values, deviations))
    return PullFit(tuple(pulls), kind, values, deviations, tuple(curves), sentences)


def not_zero(exponents: Array) -> Array:
    """Exponents, with a small one in place of zero, which is none."""
    return np.where(abs(exponents) < STEP, STEP, exponents)


def solved(A: Array, target: Array) -> Array:
    """The least-squares solution x (n,) of A x = target."""
    scale = np.linalg.norm(A, axis=0)
    return np.linalg.lstsq(A / scale, target, DEPENDENT)[0] / scale


def measured_stress(material: Hyperelastic, pulls: Sequence[Pull]) -> Array:
    """Nominal stress [Pa] of a material in the rows of all tables, in the direction of the load."""
    signs = [-1.0 if pull.test == "compression" else 1.0 for pull in pulls]
    parts = [nominal_stress(material, pull.test, stretches(pull)) for pull in pulls]
    return np.concatenate([sign * part for sign, part in zip(signs, parts)])


def notices(
    pulls: Sequence[Pull], material: Hyperelastic, values: Mapping[str, float],
    sd: Mapping[str, float],
) -> Iterator[str]:  # fmt: skip
    """Sentences on the range of the tables, on stability, and on unidentifiable coefficients."""
    for pull in pulls:
        x = stretches(pull)
        what = "amounts of shear" if pull.test == "shear" else "stretches"
        yield f"{pull.test}: {what} from {x.min():.3g} to {x.max():.3g}; beyond them W is a guess"
        yield from (f"{pull.test}: {notice}" for notice in pull.notices)
    if len({pull.test for pull in pulls}) == 1 and len(values) > 1:
        yield (
            "one kind of test does not determine an energy of several coefficients: a pad "
            "that is pressed is sheared too; add a table of compression, shear or biaxial tension"
        )
    reached = [x for pull in pulls if pull.test != "shear" for x in stretches(pull)] or [1.0]
    span = np.linspace(min(SMALLEST, *reached), max(1 / SMALLEST, *reached), 200)
    for test in ("tension", "planar", "biaxial"):
        falls = span[1:][np.diff(nominal_stress(material, test, span)) <= 0]
        if len(falls):
            nearest = falls[np.abs(np.log(falls)).argmin()]
            yield (
                f"not stable: in {test} the nominal stress falls at a stretch of {nearest:.3g}; a "
                "pad that comes there collapses, so take fewer terms or more tests"
            )
    yield from hardly_determined(values, sd)
    limit = quantities(Ogden)["alpha"].high
    extreme = [
        name for name in values if name.startswith("alpha") and abs(values[name]) > 0.99 * limit
    ]
    if extreme:
        yield f"at the limit of exponents, {limit:g}: {', '.join(extreme)}; take fewer terms"
    yield f"the specimen is taken as incompressible; {AT_ONE_SPEED}"
