"""Materials of the pads: linear viscoelastic rubber as a chain of Kelvin elements.

Every element of the chain has the same Poisson's ratio, so that a pad's displacement is u = C sum of J_b z_b: C the static
compliance of the relaxed material, J_b the fractions of it, and z_b the part of the nodal forces that has set in,
tau_b z_b' + z_b = f.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from torchsoft.physics.mesh import lame_moduli
from torchsoft.physics.shapes import parameter


class Material(nn.Module):
    """What a pad asks of its material: E [Pa] (relaxed), nu [1], rho [kg/m3], the out-of-plane depth [m], and a chain."""

    limits: ClassVar = {"E": "positive", "nu": "between -1 and 0.5", "rho": "positive", "depth": "positive"}

    def __init__(self, E: float, nu: float, rho: float, depth: float) -> None:
        super().__init__()
        self.E, self.nu, self.rho, self.depth = (parameter(value) for value in (E, nu, rho, depth))

    def chain(self) -> tuple[Tensor, Tensor]:
        """Fractions J [1], which sum to one, and retardation times tau [s] > 0, shape (branches,) each."""
        raise NotImplementedError

    def lame(self) -> tuple[Tensor, Tensor]:
        """Lame moduli (lambda, mu) [Pa]."""
        return lame_moduli(self.E, self.nu)


class KelvinVoigt(Material):
    """One retardation time tau [s]: R = tau K, the paper's constant R field."""

    limits: ClassVar = Material.limits | {"tau": "positive"}

    def __init__(self, E: float, nu: float, rho: float, tau: float, depth: float) -> None:
        super().__init__(E, nu, rho, depth)
        self.tau = parameter(tau)

    def chain(self) -> tuple[Tensor, Tensor]:
        return torch.ones_like(self.tau)[None], self.tau[None]


class StandardLinearSolid(Material):
    """A spring in series with a Kelvin element: E [Pa] relaxed, E_instant [Pa] > E at first, retardation time tau [s].

    The spring's own retardation time tau_instant [s] is small, not zero, so that the rates are functions of the state.
    """

    limits: ClassVar = Material.limits | {"E_instant": "positive", "tau": "positive", "tau_instant": "positive"}

    def __init__(
        self, E: float, E_instant: float, nu: float, rho: float, tau: float, depth: float, tau_instant: float = 1e-4
    ) -> None:
        super().__init__(E, nu, rho, depth)
        self.E_instant, self.tau, self.tau_instant = (parameter(x) for x in (E_instant, tau, tau_instant))

    def well_posed(self) -> str:
        """What is wrong with the parameters together; empty if nothing is."""
        return "E_instant is below E" if self.E_instant.item() < self.E.item() else ""

    def chain(self) -> tuple[Tensor, Tensor]:
        first = self.E / self.E_instant
        return torch.stack((first, 1 - first)), torch.stack((self.tau_instant, self.tau))
