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
    Series,
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
"""Largest difference, over the shear modulus, between the moduli that a material states and those
of its energy, between its stresses before and after a rotation, and of the undeformed material's
stress from zero."""

ENTRIES = "xx", "xy", "yx", "yy"
"""Entries of a deformation gradient, or of a stress, in the plane."""

TRIED = torch.tensor(
    [[[1.0, 0.0], [0.0, 1.0]], [[1.1, 0.0], [0.0, 0.95]], [[0.98, 0.1], [0.03, 0.9]]]
).double()
"""Deformation gradients in the plane at which an energy is checked when it is built."""

TURNS = 0.3, -1.2, 2.5
"""Angles [rad] of rotations that must not change an energy."""

DIRECTIONS = 12
"""Directions in which the stiffness of an energy is checked."""

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

    A custom material defines `distortion`, for example a network of `invariants`, without stress
    at F = 1 and with the shear modulus E / (2 (1 + nu)) there, in every direction. A rotation R
    must not change it: `distortion`(R F) = `distortion`(F). What depends on the volume belongs in
    `dilatation`, which elements take at their centre: elsewhere it makes nearly incompressible
    elements too stiff.
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
        shear, bulk = float(self.shear.detach()), float(self.bulk.detach())
        if not shear > 0:
            return f"the shear modulus of small strains is {shear:.6g} Pa; make it positive"
        times = [tau.item() for _, tau in self.relaxation()]
        if len(set(times)) < len(times):
            return "two relaxation times are equal"
        F = plane(TRIED)
        P, A = self.stress_and_moduli(F)
        if not float(P[0].abs().max()) <= ALIKE * shear:
            return "the energy has a stress without strain; make its slope zero at F = 1"
        if wrong := self._rotation_fault(F, P):
            return wrong
        one = torch.eye(2, dtype=torch.float64)
        wanted = torch.einsum("ij,kl->ijkl", one, one) * (bulk - 2 / 3 * shear)
        wanted = wanted + shear * torch.einsum("ik,jl->ijkl", one, one)
        wanted = (wanted + shear * torch.einsum("il,jk->ijkl", one, one)).reshape(4, 4)
        off = (A[0] - wanted).abs().nan_to_num(torch.inf)
        if not float(off.max()) <= ALIKE * shear:
            i, j = divmod(int(off.argmax()), 4)
            return (
                f"the energy's modulus of the stress P_{ENTRIES[i]} by F_{ENTRIES[j]} at small "
                f"strains is {A[0, i, j]:.6g} Pa, but {wanted[i, j]:.6g} Pa of its E and nu; make "
                "them agree"
            )
        return self._stability_fault(F, A)

    def fault_at(self, F: Tensor) -> str:
        """Fault of the energy at F (n, 3, 3): a rotation changes it, or it is not stable there;
        empty where there is none."""
        P, A = self.stress_and_moduli(F)
        return self._rotation_fault(F, P) or self._stability_fault(F, A)

    def stress_and_moduli(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """P = dW/dF (n, 4) and dP/dF (n, 4, 4) [Pa] at F (n, 3, 3), with the entries xx, xy, yx
        and yy."""
        with torch.enable_grad():
            P, F = self._stress(F)
            rows = [torch.autograd.grad(p.sum(), F, retain_graph=True)[0] for p in P.unbind(-1)]
        return P.detach(), torch.stack([row[:, :2, :2].flatten(1) for row in rows], 1)

    def _stress(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """P (n, 4) [Pa] with its graph, and the F (n, 3, 3) that it is of."""
        F = F.detach().requires_grad_()
        (P,) = torch.autograd.grad(self.energy(F).sum(), F, create_graph=True)
        return P[:, :2, :2].flatten(1), F

    def _rotation_fault(self, F: Tensor, P: Tensor) -> str:
        """Whether P (n, 4) is not that of an energy of which rotations change nothing: P(R F) = R
        P(F). The package's energies are functions of invariants."""
        if type(self).__module__.startswith("torchsoft."):
            return ""
        angle = torch.tensor(TURNS, dtype=torch.float64)
        c, s = angle.cos(), angle.sin()
        R = torch.stack((c, -s, s, c), -1).unflatten(-1, (2, 2))[:, None]
        with torch.enable_grad():
            turned = self._stress((plane(R) @ F).flatten(0, 1))[0].detach()
        off = turned.reshape(len(TURNS), -1, 2, 2) - R @ P.unflatten(-1, (2, 2))
        off = off.abs().amax((0, 2, 3)).nan_to_num(torch.inf)
        largest = max(float(self.shear.detach()), float(P.abs().max()))
        if float(off.max()) <= ALIKE * largest:
            return ""
        k = int(off.argmax())
        return (
            f"the energy changes with a rotation of the material: after one, the stress at "
            f"{shown(F[k])} is off by {float(off[k]):.3g} Pa; make the energy a function of "
            "C = F^T F, or of `invariants`(F)"
        )

    def _stability_fault(self, F: Tensor, A: Tensor) -> str:
        """Whether A (n, 4, 4) resists no further strain in some direction: strong ellipticity."""
        angle = torch.pi / DIRECTIONS * torch.arange(DIRECTIONS, dtype=torch.float64)
        n = torch.stack((angle.cos(), angle.sin()), -1)
        A = A.unflatten(2, (2, 2)).unflatten(1, (2, 2))
        xx, xy, yx, yy = torch.einsum("eijkl,nj,nl->iken", A, n, n).flatten(0, 1)
        least = 0.5 * (xx + yy) - torch.hypot(0.5 * (xx - yy), 0.5 * (xy + yx))
        least = least.amin(-1).nan_to_num(-torch.inf)
        if float(least.min()) > 0:
            return ""
        k = int(least.argmin())
        return (
            f"the energy is not stable at {shown(F[k])}: in some direction its stiffness is "
            f"{float(least[k]):.3g} Pa, but must be positive; take other coefficients, or let it "
            "be strained less"
        )


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
        self.C10, self.C01 = parameter(C10, "C10"), parameter(C01, "C01")

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
        self.C10 = parameter(C10, "C10")
        self.C20 = parameter(C20, "C20")
        self.C30 = parameter(C30, "C30")

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
        lists = {"mu": "mu", "alpha": "alpha"}
        self.terms = numbered(self, "Ogden's energy", lists, mu, alpha)
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


def plane(F: Tensor) -> Tensor:
    """Deformation gradients (..., 3, 3) in plane strain of those in the plane (..., 2, 2)."""
    whole = torch.eye(3, dtype=torch.float64).repeat(*F.shape[:-2], 1, 1)
    whole[..., :2, :2] = F
    return whole


def shown(F: Tensor) -> str:
    """The entries of one deformation gradient in the plane, in words."""
    return f"F = {[[float(f'{x:.4g}') for x in row] for row in F[:2, :2].tolist()]}"


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
    """Kind and numbers of a material of this package, None for a custom one."""
    kind = next((name for name, cls in KINDS.items() if type(material) is cls), None)
    if kind is None:
        return None
    numbers, lists = dict[str, Any](), dict[tuple[str, ...], Any]()
    if isinstance(material, Ogden):
        lists["mu", "alpha"] = material.series()
    if isinstance(material, Series):
        lists[tuple(material.lists.values())] = pairs(material, material.terms, *material.lists)
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
