"""Materials of the pads: linear viscoelastic rubber as a chain of Kelvin elements.

Every element of the chain has the same Poisson's ratio, so that a pad's displacement is u = C sum
of J_b z_b: C the static compliance of the relaxed material, J_b the fractions of it, and z_b the
part of the nodal forces that has set in, tau_b z_b' + z_b = f.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, ClassVar

import numpy as np
import torch
from scipy.linalg.lapack import dlasd4  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor, nn

from torchsoft.physics.arguments import number
from torchsoft.physics.shapes import parameter
from torchsoft.quantity import Density, Depth, Modulus, PoissonRatio, Quantity, Retardation

INSTANT_TIME = 1e-4
"""Retardation time [s] of an instantaneous spring, where none is given: small, not zero, so that
the rates are functions of the state."""

TERMS = 20
"""Terms of a series at the most."""

InstantRetardation = Annotated[
    Retardation, "retardation time of the instantaneous spring: below every tau"
]
Retardations = Annotated[Iterable[float], Quantity("s", 1e-9, 1e6, "times, one per term")]
Fractions = Annotated[
    Iterable[float],
    Quantity("1", 1e-9, 1.0, "fractions of the relaxed compliance, one per tau, in sum at most 1"),
]
Moduli = Annotated[Iterable[float], Quantity("Pa", 1.0, 1e13, "moduli that fade, one per tau")]

TOO_MUCH = 1e-12
"""Largest rounding error of fractions that sum to one."""


class Branch(nn.Module):
    """One more Kelvin element of a material: a `fraction` [1] of the relaxed compliance that sets
    in with a retardation `time` [s] of its own."""

    def __init__(
        self,
        fraction: Annotated[float, Quantity("1", 0.0, 0.9, "fraction of the relaxed compliance")],
        time: Retardation,
    ) -> None:
        super().__init__()
        self.fraction, self.time = parameter(fraction, "fraction"), parameter(time, "time")


class Material(nn.Module):
    """Interface of a pad's material: E [Pa] (relaxed), nu [1], rho [kg/m3], the out-of-plane depth
    [m], and a chain, to which branches may be `added`."""

    E: Tensor
    added: Sequence[Branch]
    lists: ClassVar[Mapping[str, str]] = {}
    """Parameters of which there are several, E_1, E_2, ..., and the argument that has them all."""

    def __init__(self, E: Modulus | None, nu: PoissonRatio, rho: Density, depth: Depth) -> None:
        """E is None where a material makes it of other numbers."""
        super().__init__()
        if E is not None or not isinstance(getattr(type(self), "E", None), property):
            self.E = parameter(E, "E")  # pyright: ignore[reportArgumentType]
        self.nu, self.rho, self.depth = (
            parameter(value, name) for name, value in (("nu", nu), ("rho", rho), ("depth", depth))
        )
        self.add_module("added", nn.ModuleList())

    def chain(self) -> tuple[Tensor, Tensor]:
        """Fractions J [1], which sum to one, and retardation times tau [s] > 0, shape (branches,)
        each."""
        raise NotImplementedError

    def whole_chain(self) -> tuple[Tensor, Tensor]:
        """The chain with the branches added, each of which takes its fraction from every element
        before it."""
        J, tau = self.chain()
        for one in self.added:
            J = torch.cat((J * (1 - one.fraction), one.fraction[None]))
            tau = torch.cat((tau, one.time[None]))
        return J, tau

    @property
    def branches(self) -> int:
        """Elements of the chain, without branches added."""
        return len(self.chain()[0].detach())

    def creep(self, t: Tensor) -> Tensor:
        """Strain per held stress [1/Pa] at times t (...) [s] after it was put on."""
        J, tau = self.whole_chain()
        return (J * -torch.expm1(-t[..., None] / tau)).sum(-1) / self.E

    def complex_modulus(self, omega: Tensor) -> Tensor:
        """Storage modulus + i loss modulus [Pa] at angular frequencies omega (...) [rad/s]."""
        J, tau = self.whole_chain()
        return self.E / (J / (1 + 1j * omega[..., None] * tau)).sum(-1)

    def well_posed(self) -> str:
        """Conflict between the parameters; empty where there is none."""
        return ""


class OneTime(Material):
    """Interface of a material with one retardation time tau [s]."""

    def __init__(
        self, E: Modulus | None, nu: PoissonRatio, rho: Density, tau: Retardation, depth: Depth
    ) -> None:
        super().__init__(E, nu, rho, depth)
        self.tau = parameter(tau, "tau")

    def chain(self) -> tuple[Tensor, Tensor]:
        return torch.ones_like(self.tau)[None], self.tau[None]

    @property
    def branches(self) -> int:
        return 1


class KelvinVoigt(OneTime):
    """One retardation time tau [s]: R = tau K, the paper's constant R field."""

    def __init__(
        self, E: Modulus, nu: PoissonRatio, rho: Density, tau: Retardation, depth: Depth
    ) -> None:
        super().__init__(E, nu, rho, tau, depth)


class StandardLinearSolid(Material):
    """A spring in series with a Kelvin element: E [Pa] relaxed, E_instant [Pa] > E at first,
    retardation time tau [s].

    The spring's own retardation time tau_instant [s] is small, not zero, so that the rates are
    functions of the state.
    """

    def __init__(
        self, E: Modulus, E_instant: Annotated[Modulus, "Young's modulus at first, above E"],
        nu: PoissonRatio, rho: Density, tau: Retardation, depth: Depth,
        tau_instant: InstantRetardation = INSTANT_TIME,
    ) -> None:  # fmt: skip
        super().__init__(E, nu, rho, depth)
        self.E_instant = parameter(E_instant, "E_instant")
        self.tau = parameter(tau, "tau")
        self.tau_instant = parameter(tau_instant, "tau_instant")

    def well_posed(self) -> str:
        return "E_instant is below E" if self.E_instant.item() < self.E.item() else ""

    def chain(self) -> tuple[Tensor, Tensor]:
        first = self.E / self.E_instant
        return torch.stack((first, 1 - first)), torch.stack((self.tau_instant, self.tau))

    @property
    def branches(self) -> int:
        return 2


class Series(Material):
    """A material of any number of terms, each a strength and a time, as its `lists` call them.

    An instantaneous spring stands before them in the chain, with the retardation time tau_instant
    [s], below every tau. Raises `ValueError` unless there are as many strengths as times, and at
    least one.
    """

    def __init__(
        self, E: Modulus, nu: PoissonRatio, rho: Density, depth: Depth, strengths: Iterable[float],
        tau: Retardations, tau_instant: InstantRetardation,
    ) -> None:  # fmt: skip
        super().__init__(E, nu, rho, depth)
        self.terms = numbered(self, "a series", self.lists, strengths, tau)
        self.tau_instant = parameter(tau_instant, "tau_instant")

    def series(self) -> tuple[Tensor, Tensor]:
        """Strengths and times [s] of the terms, (terms,) each."""
        one, other = zip(*pairs(self, self.terms, *self.lists))
        return torch.stack(one), torch.stack(other)

    def well_posed(self) -> str:
        shortest, instant = float(self.series()[1].detach().min()), self.tau_instant.item()
        if instant >= shortest:
            return f"tau_instant = {instant:g} s must be below the shortest tau, {shortest:g} s"
        return ""

    @property
    def branches(self) -> int:
        return self.terms + 1


class GeneralisedKelvin(Series):
    """A spring in series with Kelvin elements: under a held stress, the fractions J (terms,) [1] of
    the relaxed compliance 1/E set in with the retardation times tau (terms,) [s], and the rest at
    once.

    Parameters are called J_1, tau_1 and so on.
    """

    lists: ClassVar[Mapping[str, str]] = {"J": "J", "tau": "tau"}

    def __init__(
        self, E: Modulus, nu: PoissonRatio, rho: Density, depth: Depth, J: Fractions,
        tau: Retardations, tau_instant: InstantRetardation = INSTANT_TIME,
    ) -> None:  # fmt: skip
        super().__init__(E, nu, rho, depth, J, tau, tau_instant)

    def well_posed(self) -> str:
        total = float(self.series()[0].detach().sum())
        return (
            f"the fractions J sum to {total:.6g}, above one"
            if total > 1 + TOO_MUCH
            else super().well_posed()
        )

    def chain(self) -> tuple[Tensor, Tensor]:
        J, tau = self.series()
        return torch.cat((1 - J.sum()[None], J)), torch.cat((self.tau_instant[None], tau))


class Prony(Series):
    """A relaxation series: after a step of strain the modulus is E + sum of E_i exp(-t / tau_i),
    with the relaxed modulus E [Pa], `moduli` E_i (terms,) [Pa] that fade, and relaxation times tau
    (terms,) [s], no two of them equal.

    Parameters are called E_1, tau_1 and so on. The chain is this same solid, exactly (`retarded`),
    but for the instantaneous spring, which takes tau_instant [s] to give way.
    """

    lists: ClassVar[Mapping[str, str]] = {"E": "moduli", "tau": "tau"}

    def __init__(
        self, E: Modulus, nu: PoissonRatio, rho: Density, depth: Depth, moduli: Moduli,
        tau: Retardations, tau_instant: InstantRetardation = INSTANT_TIME,
    ) -> None:  # fmt: skip
        super().__init__(E, nu, rho, depth, moduli, tau, tau_instant)

    def well_posed(self) -> str:
        times = self.series()[1].detach().tolist()
        return (
            "two relaxation times are equal"
            if len(set(times)) < len(times)
            else super().well_posed()
        )

    def relaxation(self, t: Tensor) -> Tensor:
        """Stress per held strain [Pa] at times t (...) [s] after it was put on."""
        moduli, tau = self.series()
        return self.E + (moduli * torch.exp(-t[..., None] / tau)).sum(-1)

    def chain(self) -> tuple[Tensor, Tensor]:
        moduli, times = self.series()
        J, tau = retarded(moduli / self.E, times)
        return J, torch.cat((self.tau_instant[None], tau))


def retarded(m: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Fractions J (n + 1,) [1] of the relaxed compliance, which sum to one, and retardation times
    tau (n,) [s] of the solid with moduli E m (n,), m > 0, and distinct relaxation times t (n,) [s];
    J[0] is the instantaneous spring's. Raises `ValueError` for moduli or times that are not
    positive, and equal times.
    """
    t, order = t.sort()
    if not (bool((m > 0).all()) and bool((t > 0).all()) and bool((t.diff() > 0).all())):
        raise ValueError(
            "a relaxation series needs positive moduli and positive times, no two of them equal"
        )
    m = m[order]
    J, tau = creeping(m * t, t)
    return torch.cat((1 / (1 + m.sum())[None], J)), tau


def creeping(w: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Fractions J (n,) [1] of the relaxed compliance and retardation times tau (n,) [s] of the
    solid with relaxation times t (n,) [s] that increase, and moduli over the relaxed one that are w
    / t, w > 0; a time of zero is that of a dashpot with the retardation time w [s] beside the
    relaxed spring.

    Stress over strain is E (1 + sum of s w_i / (1 + s t_i)) at a complex frequency s. Its zeros s =
    -1/tau are the rates of creep: tau are the roots of 1 = sum of w_i / (tau - t_i), the
    eigenvalues of diag(t) + v v^T with v_i^2 = w_i. Each lies above its own relaxation time and
    below the next one.

    The roots come from LAPACK's secular equation, with the distances tau - t_i to full relative
    precision, whatever decades the times span; one Newton step with the gradient on makes their
    derivative the implicit function theorem's (so a second derivative is not exact).
    """
    with torch.no_grad():
        apart = distances(w, t)  # tau_k - t_i
        slope = (w / apart**2).sum(-1)
        roots = t + apart.diagonal()
    apart = apart - (t - t.detach())
    step = ((w / apart).sum(-1) - 1) / slope
    tau, apart = roots + step, apart + step[:, None]
    return 1 / (tau * (w / apart**2).sum(-1)), tau


def distances(w: Tensor, t: Tensor) -> Tensor:
    """tau_k - t_i (n, n) [s] for increasing times t (n,)."""
    if len(t) == 1:
        return w[:, None]
    v, d = w.sqrt().numpy(), t.sqrt().numpy()
    size = float(np.linalg.norm(v))
    rows = []
    for k in range(len(d)):
        minus, _, plus, failed = dlasd4(k, d, v / size, size**2)  # t_i^1/2 -+ tau_k^1/2
        assert not failed
        rows.append(-minus * plus)
    return torch.from_numpy(np.stack(rows))


def numbered(
    module: nn.Module, what: str, lists: Mapping[str, str], *given: Iterable[float], least: int = 1
) -> int:
    """Give a module the parameters <symbol>_1, <symbol>_2, ... of two lists, which arguments call
    as `lists` says; returns their length. Raises `ValueError` unless they are as long as each
    other, with at least so many entries."""
    one, other = (terms(symbol, values) for symbol, values in zip(lists, given))
    if len(one) != len(other) or not least <= len(one) <= TERMS:
        names = " as ".join(f"`{name}`" for name in lists.values())
        raise ValueError(
            f"{what} needs as many {names}, from {least} to {TERMS}, but has {len(one)} and "
            f"{len(other)}"
        )
    for k, values in enumerate(zip(one, other), 1):
        for symbol, value in zip(lists, values):
            module.register_parameter(f"{symbol}_{k}", parameter(value))
    return len(one)


def pairs(module: nn.Module, count: int, *symbols: str) -> list[tuple[Tensor, ...]]:
    """The parameters that `numbered` gave, one of each symbol a number."""
    numbers = range(1, count + 1)
    return [tuple(getattr(module, f"{symbol}_{k}") for symbol in symbols) for k in numbers]


def terms(name: str, values: Iterable[float]) -> list[float]:
    """Raises `ValueError` unless a value is a list of numbers."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"`{name}` must be a list of numbers, but is {values!r}")
    return [number(f"{name}_{k}", value) for k, value in enumerate(values, 1)]


LINEAR: Mapping[str, type[Material]] = {
    "kelvin_voigt": KelvinVoigt,
    "standard_linear_solid": StandardLinearSolid,
    "generalised_kelvin": GeneralisedKelvin,
    "prony": Prony,
}
"""Linear materials by their names in files."""
