"""Strain energies fitted to pulls, compressions and shears: least squares of the nominal stress,
dW / d(stretch) of the incompressible material, in every table at once.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torchsoft.materials.fit import UNSURE, Fit
from torchsoft.materials.kinds import ENERGIES
from torchsoft.materials.measured import Array, Pull, instant_time
from torchsoft.physics.hyperelastic import KINDS, Hyperelastic

EXPONENTS = (2.0, -2.0, 5.0, -5.0, 1.0)
"""Exponents of Ogden's terms that a fit begins from, turned round for each of its beginnings."""

SMALLEST = 0.5
"""Smallest stretch, and the inverse of the largest, in which stability is looked for, if the tables
do not go further."""


@dataclass(frozen=True)
class EnergyFit:
    """An energy fitted to `pulls`, one or more tables: `values` of its coefficients with their
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
    def rms(self) -> float:
        """Root mean square of the residuals over the largest stress of their table."""
        parts = [(p.stress - f) / np.abs(p.stress).max() for p, f in zip(self.pulls, self.fitted)]
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

    def table(self) -> dict[str, Any]:
        """The arguments of the material's constructor that the tests tell, and with branches a tau
        that is small beside their times."""
        values, count = list(self.values.values()), self.relaxation.terms if self.relaxation else 0
        own = arguments(self.kind, values[: len(values) - 2 * count])
        if not count:
            return own
        moduli, times = values[-2 * count : -count], values[-count:]
        return own | {"moduli": moduli, "times": times, "tau": instant_time(times)}

    def relaxing(self, series: Fit, fast: bool) -> "EnergyFit":
        """The energy with the branches of a relaxation test: strengths over its relaxed modulus,
        and times. Pulls that were `fast` against them tell the energy at first, which is that of
        the relaxed material times 1 + the sum of these strengths, others the relaxed one."""
        count, E = series.terms, series.values["E"]
        shares = {f"E_{k}": series.values[f"E_{k}"] / E for k in range(1, count + 1)}
        part = 1 / (1 + sum(shares.values())) if fast else 1.0
        scaled = lambda of: {k: x if k.startswith("alpha") else part * x for k, x in of.items()}
        values, sd = scaled(self.values), scaled(self.sd)
        table = arguments(self.kind, list(values.values()))
        relaxed = made(self.kind, table, nu=0.45, rho=1e3, tau=1.0, depth=1.0).E.item()
        times = [f"tau_{k}" for k in range(1, count + 1)]
        values |= {name: relaxed * share for name, share in shares.items()}
        sd |= {name: relaxed * series.sd[name] / E for name in shares}
        values |= {name: series.values[name] for name in times}
        sd |= {name: series.sd[name] for name in times}
        said = (
            f"fast against the times of {series.measured.path.name}, so that they tell 1 + the sum "
            "of its strengths over its relaxed modulus times the relaxed energy, which is written"
            if fast
            else f"slow against the times of {series.measured.path.name}, so that they tell the "
            "relaxed energy"
        )
        own = (*self.notices[:-1], f"the pulls count as {said}", *series.notices)
        return replace(self, values=values, sd=sd, notices=own, relaxation=series)

    def material(self, **others: float) -> Hyperelastic:
        """The material, with stated values of nu, rho, depth, and without branches tau, of which
        these tests have no information."""
        return made(self.kind, self.table(), **others)


def arguments(kind: str, values: Sequence[float]) -> dict[str, Any]:
    """Coefficients by the names of the constructor's arguments."""
    if kind == "ogden":
        half = len(values) // 2
        return {"mu": list(values[:half]), "alpha": list(values[half:])}
    return dict(zip(ENERGIES[kind], values))


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


def fit_energy(
    pulls: Sequence[Pull], kind: str, *, nu: float, terms: int | None = None
) -> EnergyFit:
    """The energy of a kind that fits the tables best, every row relative to the largest stress of
    its table; `terms` are those of Ogden's, one by default. Poisson's ratio `nu` makes E of a shear
    modulus.

    Raises `ValueError` for `terms` of another kind, for more of them than the rows tell, and where
    no fit has a positive shear modulus.
    """
    if terms is not None and kind != "ogden":
        raise ValueError(f"`terms` are those of ogden, but the energy is {kind}")
    count = 2 * (terms or 1) if kind == "ogden" else len(ENERGIES[kind])
    rows = sum(len(pull.strain) for pull in pulls)
    if rows < 2 * count or not 1 <= (terms or 1) <= len(EXPONENTS):
        raise ValueError(f"{rows} rows do not tell {count} coefficients; take fewer terms")
    x = [stretches(pull) for pull in pulls]
    sizes = [float(np.abs(pull.stress).max()) for pull in pulls]
    units = scales(kind, pulls[0], count, nu)

    def material(z: Array) -> Hyperelastic:
        table = arguments(kind, (z * units).tolist())
        return made(kind, table, nu=nu, rho=1e3, tau=1.0, depth=1.0)

    def stresses(z: Array) -> list[Array]:
        own = material(z)
        signs = [-1.0 if pull.test == "compression" else 1.0 for pull in pulls]
        return [s * nominal_stress(own, p.test, at) for s, p, at in zip(signs, pulls, x)]

    def residuals(z: Array) -> Array:
        parts = zip(stresses(z), pulls, sizes)
        return np.concatenate([(own - pull.stress) / size for own, pull, size in parts])

    found = [
        done
        for begin in beginnings(kind, count)
        for done in [least_squares(residuals, begin, x_scale="jac", max_nfev=500)]
        if np.isfinite(done.fun).all() and done.x[: (count + 1) // 2].sum() > 0
    ]
    if not found:
        raise ValueError(f"{pulls[0].path}: no {kind} energy with a positive modulus fits")
    best = min(found, key=lambda one: one.cost)
    _, s, V = np.linalg.svd(best.jac, full_matrices=False)
    spread = ((V.T / np.maximum(s, 1e-300)) ** 2).sum(1)
    sd = units * np.sqrt(spread * 2 * best.cost / max(rows - count, 1))
    half = range(1, count // 2 + 1)
    names = (
        [f"{symbol}_{k}" for symbol in ENERGIES[kind] for k in half]
        if kind == "ogden"
        else list(ENERGIES[kind])
    )
    own = dict(zip(names, (best.x * units).tolist())), dict(zip(names, sd.tolist()))
    said = tuple(notices(pulls, material(best.x), *own))
    return EnergyFit(tuple(pulls), kind, *own, tuple(stresses(best.x)), said)


def scales(kind: str, pull: Pull, count: int, nu: float) -> Array:
    """Units of the coefficients: the pull's modulus [Pa], for E what it is at Poisson's ratio nu,
    and 1 for exponents."""
    modulus = np.full(count, float(pull.strain @ pull.stress / (pull.strain @ pull.strain)))
    if kind == "ogden":
        modulus[count // 2 :] = 1.0
    return modulus * (1 + nu) if kind == "neo_hookean" else modulus


def beginnings(kind: str, count: int) -> list[Array]:
    """Coefficients, in their units, that a fit begins from."""
    if kind != "ogden":
        return [np.concatenate(([0.3], np.full(count - 1, 0.01)))]
    terms = count // 2
    mu = np.concatenate(([0.3], np.full(terms - 1, 0.02)))
    return [np.concatenate((mu, np.roll(EXPONENTS, -k)[:terms])) for k in range(len(EXPONENTS))]


def notices(
    pulls: Sequence[Pull], material: Hyperelastic, values: Mapping[str, float],
    sd: Mapping[str, float],
) -> Iterator[str]:  # fmt: skip
    """Sentences on the range of the tables, on stability, and on unidentifiable coefficients."""
    for pull in pulls:
        x = stretches(pull)
        what = "amounts of shear" if pull.test == "shear" else "stretches"
        yield f"{pull.test}: {what} from {x.min():.3g} to {x.max():.3g}; beyond them W is a guess"
    if len({pull.test for pull in pulls}) == 1 and len(values) > 1:
        yield (
            "one kind of test does not tell an energy of several coefficients in others: a pad "
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
                "pad that comes there gives way at once, so take fewer terms or more tests"
            )
    unsure = [name for name in values if not sd[name] <= UNSURE * abs(values[name])]
    if unsure:
        names = ", ".join(unsure)
        yield f"hardly determined, with a standard deviation above {UNSURE:.0%}: {names}"
    yield (
        "the specimen counts as incompressible and at the speed of the test: what the rubber does "
        "over time is of a relaxation, a creep or a frequency test"
    )
