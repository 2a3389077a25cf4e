"""Materials at finite strain: a strain energy W(F) of the deformation gradient, a retardation time,
and relaxing branches.

W is of a distortion and of a change of volume, kappa (J - 1)^2 / 2 with J = det F. Viscous stresses
are those of a quadratic potential of the rates of J and of the distorted Cauchy-Green tensor, with
the moduli of small strains times tau: no turning costs anything, what is dissipated is never
negative, and small strains are those of `KelvinVoigt`.

A branch adds the same energy, times E_i / E, of what has not relaxed: after a step of strain the
stress is 1 + sum of E_i exp(-t / tau_i) / E times that of W, at first and at last exactly, between
them as far as the strain is small (`physics/elements` has the equations).
"""

from collections.abc import Iterable, Mapping
from inspect import signature
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from torchsoft.physics.material import (
    LINEAR,
    GeneralisedKelvin,
    KelvinVoigt,
    Material,
    OneTime,
    creeping,
    numbered,
    pairs,
)
from torchsoft.physics.shapes import parameter
from torchsoft.quantity import Density, Depth, Modulus, PoissonRatio, Quantity, Retardation

Coefficient = Annotated[float, Quantity("Pa", -1e13, 1e13, "coefficient of the strain energy")]
Coefficients = Annotated[
    Iterable[float], Quantity("Pa", -1e13, 1e13, "shear moduli, one per exponent, in sum positive")
]
Exponents = Annotated[Iterable[float], Quantity("1", -50.0, 50.0, "exponents of the stretches")]
Moduli = Annotated[
    Iterable[float],
    Quantity("Pa", 1.0, 1e13, "Young's moduli at small strains that fade, one per time"),
]
Times = Annotated[Iterable[float], Quantity("s", 1e-9, 1e6, "relaxation times, no two equal")]

ALIKE = 1e-6
"""Largest relative difference between the moduli that a material states and those of its energy,
and largest stress of the undeformed material over its shear modulus."""

SERIES, SMALL = 8, 0.005
"""Terms of the series for sums of powers of two stretches, and up to what difference between them
it is taken: their closed form has no derivative where they are equal."""


class Hyperelastic(OneTime):
    """Interface of a material at finite strain, W(F) = `distortion`(F) + `dilatation`(det F); E and
    nu are the moduli of small strains.

    Relaxing branches have `moduli` E_i [Pa], by which the modulus of small strains is higher at
    first, and relaxation `times` tau_i [s]; parameters are called E_1, tau_1 and so on. The
    retardation time tau [s] is that of the relaxed energy. Raises `ValueError` unless there are as
    many moduli as times.

    A material of one's own gives `distortion`, for example a network of `invariants`, without
    stress at F = 1 and with the shear modulus E / (2 (1 + nu)) there. What depends on the volume
    should stand in `dilatation`, which elements take at their centre: elsewhere it makes nearly
    incompressible elements too stiff.
    """

    lists: ClassVar[Mapping[str, str]] = {"E": "moduli", "tau": "times"}

    def __init__(
        self, E: Modulus | None, nu: PoissonRatio, rho: Density, tau: Retardation, depth: Depth,
        moduli: Moduli = (), times: Times = (),
    ) -> None:  # fmt: skip
        super().__init__(E, nu, rho, tau, depth)
        self.relaxing = numbered(self, "a relaxing energy", self.lists, moduli, times, least=0)

    def relaxation(self) -> list[tuple[Tensor, Tensor]]:
        """Of every branch the modulus over the relaxed one [1], and the relaxation time [s]."""
        return [(E / self.E, tau) for E, tau in pairs(self, self.relaxing, *self.lists)]

    def chain(self) -> tuple[Tensor, Tensor]:
        """The chain of small strains."""
        if not self.relaxing:
            return super().chain()
        shares, times = (torch.stack(part) for part in zip(*self.relaxation()))
        times, order = times.sort()
        first = self.tau[None]
        w = torch.cat((first, shares[order] * times))
        return creeping(w, torch.cat((torch.zeros_like(first), times)))

    @property
    def branches(self) -> int:
        return 1 + self.relaxing

    def distortion(self, F: Tensor) -> Tensor:
        """Strain energy (...) [J/m3] of the distortion by F (..., 3, 3), in plane strain: F_zz = 1,
        and xz, yz, zx and zy are zero."""
        raise NotImplementedError

    def dilatation(self, J: Tensor) -> Tensor:
        """Strain energy (...) [J/m3] of a volume J (...) times as large."""
        return 0.5 * self.bulk * (J - 1) ** 2

    def energy(self, F: Tensor) -> Tensor:
        """Strain energy W (...) [J/m3] of F (..., 3, 3)."""
        _, _, J = invariants(F)
        return self.distortion(F) + self.dilatation(J)

    @property
    def shear(self) -> Tensor:
        """Shear modulus [Pa] of small strains."""
        return self.E / (2 * (1 + self.nu))

    @property
    def bulk(self) -> Tensor:
        """Bulk modulus [Pa] of small strains."""
        return 2 * self.shear * (1 + self.nu) / (3 * (1 - 2 * self.nu))

    def linear(self) -> KelvinVoigt | GeneralisedKelvin:
        """The material at small strains, as it is now."""
        E, nu, rho, depth = (x.item() for x in (self.E, self.nu, self.rho, self.depth))
        J, (first, *tau) = (x.tolist() for x in self.chain())
        if not tau:
            return KelvinVoigt(E, nu, rho, first, depth)
        return GeneralisedKelvin(E, nu, rho, depth, J[1:], tau, first)

    def well_posed(self) -> str:
        with torch.enable_grad():
            shear, bulk = float(self.shear.detach()), float(self.bulk.detach())
            if not shear > 0:
                return f"the shear modulus of small strains is {shear:.6g} Pa; make it positive"
            F = torch.eye(3, dtype=torch.float64, requires_grad=True)
            (P,) = torch.autograd.grad(self.energy(F), F, create_graph=True)
            if float(P.detach().abs().max()) > ALIKE * shear:
                return "the energy has a stress without strain; make its slope zero at F = 1"
            times = [tau.item() for _, tau in self.relaxation()]
            if len(set(times)) < len(times):
                return "two relaxation times are equal"
            found = {}
            for name, (i, j) in {"xx": (0, 0), "xy": (0, 1)}.items():
                (row,) = torch.autograd.grad(P[i, j], F, retain_graph=True)
                found[name] = float(row[i, j])
        own = {"xx": bulk + 4 / 3 * shear, "xy": shear}
        for name, modulus in own.items():
            if not abs(found[name] - modulus) <= ALIKE * modulus:
                return (
                    f"the energy's modulus in {name} at small strains is {found[name]:.6g} Pa, but "
                    f"{modulus:.6g} Pa of its E and nu; make them agree"
                )
        return ""


class NeoHookean(Hyperelastic):
    """W = mu (I1 - 3) / 2 of the distortion's first invariant, mu = E / (2 (1 + nu))."""

    def __init__(
        self, E: Modulus, nu: PoissonRatio, rho: Density, tau: Retardation, depth: Depth,
        moduli: Moduli = (), times: Times = (),
    ) -> None:  # fmt: skip
        super().__init__(E, nu, rho, tau, depth, moduli, times)

    def distortion(self, F: Tensor) -> Tensor:
        I1, _, _ = invariants(F)
        return 0.5 * self.shear * (I1 - 3)


class _ByShear(Hyperelastic):
    """A material whose stiffness is its energy's."""

    @property
    def E(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Young's modulus [Pa] of small strains."""
        return 2 * (1 + self.nu) * self.shear


class MooneyRivlin(_ByShear):
    """W = C10 (I1 - 3) + C01 (I2 - 3) [Pa] of the distortion's invariants; the shear modulus is
    2 (C10 + C01)."""

    def __init__(
        self, C10: Coefficient, C01: Coefficient, nu: PoissonRatio, rho: Density, tau: Retardation,
        depth: Depth, moduli: Moduli = (), times: Times = (),
    ) -> None:  # fmt: skip
        super().__init__(None, nu, rho, tau, depth, moduli, times)
        self.C10, self.C01 = parameter(C10), parameter(C01)

    @property
    def shear(self) -> Tensor:
        return 2 * (self.C10 + self.C01)

    def distortion(self, F: Tensor) -> Tensor:
        I1, I2, _ = invariants(F)
        return self.C10 * (I1 - 3) + self.C01 * (I2 - 3)


class Yeoh(_ByShear):
    """W = C10 (I1 - 3) + C20 (I1 - 3)^2 + C30 (I1 - 3)^3 [Pa] of the distortion's first invariant;
    the shear modulus is 2 C10."""

    def __init__(
        self, C10: Coefficient, nu: PoissonRatio, rho: Density, tau: Retardation, depth: Depth,
        C20: Coefficient = 0.0, C30: Coefficient = 0.0, moduli: Moduli = (), times: Times = (),
    ) -> None:  # fmt: skip
        super().__init__(None, nu, rho, tau, depth, moduli, times)
        self.C10, self.C20, self.C30 = (parameter(x) for x in (C10, C20, C30))

    @property
    def shear(self) -> Tensor:
        return 2 * self.C10

    def distortion(self, F: Tensor) -> Tensor:
        I1, _, _ = invariants(F)
        x = I1 - 3
        return x * (self.C10 + x * (self.C20 + x * self.C30))


class Ogden(_ByShear):
    """W = sum of 2 mu_i / alpha_i^2 (l_1^alpha_i + l_2^alpha_i + l_3^alpha_i - 3) of the
    distortion's stretches l; the shear modulus is the sum of mu_i [Pa].

    Parameters are called mu_1, alpha_1 and so on. Raises `ValueError` unless there are as many
    moduli as exponents, and at least one, and for an exponent of zero.
    """

    def __init__(
        self, mu: Coefficients, alpha: Exponents, nu: PoissonRatio, rho: Density, tau: Retardation,
        depth: Depth, moduli: Moduli = (), times: Times = (),
    ) -> None:  # fmt: skip
        super().__init__(None, nu, rho, tau, depth, moduli, times)
        own = {"mu": "mu", "alpha": "alpha"}
        self.terms = numbered(self, "Ogden's energy", own, mu, alpha)
        if any(exponent.item() == 0.0 for _, exponent in self.series()):
            raise ValueError("an exponent `alpha` is zero; leave that term out")

    def series(self) -> list[tuple[Tensor, Tensor]]:
        """Moduli [Pa] and exponents."""
        return [(mu, alpha) for mu, alpha in pairs(self, self.terms, "mu", "alpha")]

    @property
    def shear(self) -> Tensor:
        return torch.stack([mu for mu, _ in self.series()]).sum()

    def distortion(self, F: Tensor) -> Tensor:
        _, _, J = invariants(F)
        zz = F[..., 2, 2]
        area = J / zz
        apart = ((F[..., 0, 0] - F[..., 1, 1]) ** 2 + (F[..., 0, 1] + F[..., 1, 0]) ** 2) / (
            2 * area
        )
        total = torch.zeros_like(J)
        for mu, alpha in self.series():
            plane = 2 * power(area, alpha / 2) * _cosh_multiple(alpha / 2, apart)
            stretches = power(J, -alpha / 3) * (plane + power(zz, alpha))
            total = total + 2 * mu / alpha**2 * (stretches - 3)
        return total


def _cosh_multiple(k: Tensor, x: Tensor) -> Tensor:
    """cosh(k arcosh(1 + x)) of x >= 0: half the sum of r^k and r^-k with r + 1 / r = 2 (1 + x)."""
    series, term = torch.ones_like(x), torch.ones_like(x)
    for n in range(SERIES):
        term = term * x * (k**2 - n**2) / ((2 * n + 1) * (n + 1))
        series = series + term
    small = x < SMALL
    away = torch.where(small, SMALL, x)
    r = power(1 + away + torch.sqrt(away * (2 + away)), k)
    return torch.where(small, series, 0.5 * (r + 1 / r))


def power(x: Tensor, exponent: Tensor | float) -> Tensor:
    """x^exponent of x > 0, not a number elsewhere. All of its derivatives share one logarithm and
    one exponential."""
    return torch.exp(exponent * torch.log(x))


def invariants(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First and second invariant of the distortion, J^(-2/3) tr C and J^(-4/3) (tr^2 C - tr C^2) /
    2 with C = F^T F, and J = det F, (...) each, of F (..., 3, 3) with the entries xx, xy, yx, yy
    and zz."""
    xx, xy, yx, yy, zz = (F[..., i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2)))
    area = xx * yy - xy * yx
    J, trace = area * zz, xx**2 + xy**2 + yx**2 + yy**2
    scale = power(J, -2 / 3)
    return scale * (trace + zz**2), scale**2 * (trace * zz**2 + area**2), J


KINDS: Mapping[str, type[Material]] = {
    **LINEAR,
    "neo_hookean": NeoHookean,
    "mooney_rivlin": MooneyRivlin,
    "yeoh": Yeoh,
    "ogden": Ogden,
}
"""The materials by their names in files; their tables have the names of the constructors'
arguments."""


def described(material: Material) -> dict[str, Any] | None:
    """Kind and numbers of a material of this package, None for one of the user's own."""
    kind = next((name for name, own in KINDS.items() if type(material) is own), None)
    if kind is None:
        return None
    numbers, lists = dict[str, Any](), dict[tuple[str, str], Any]()
    if isinstance(material, Ogden):
        lists["mu", "alpha"] = material.series()
    if isinstance(material, Hyperelastic):
        lists["moduli", "times"] = pairs(material, material.relaxing, *material.lists)
    for names, rows in lists.items():
        numbers |= {name: [row[i].item() for row in rows] for i, name in enumerate(names)}
    for name in signature(KINDS[kind]).parameters:
        if name not in numbers:
            numbers[name] = getattr(material, name).item()
    return {"kind": kind, **{name: value for name, value in numbers.items() if value != []}}


def again(described: Mapping[str, Any]) -> Any:
    """The material of a kind with its numbers."""
    numbers = {name: value for name, value in described.items() if name != "kind"}
    return KINDS[described["kind"]](**numbers)
