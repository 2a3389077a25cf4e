"""Contact per surface node: detection, the moving frame, penalty normal force and stick-slip friction.

Equations of the paper in brackets. Two named departures from them keep forces and gradients continuous: the ramp
rho = g / (g + epsilon), which takes the dashpots and the tangential branch in at touch-down, and max(0, .), which
removes adhesion.
"""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torchsoft.multibond import Block, Transformer
from torchsoft.parameters import ContactParameters
from torchsoft.shapes import Shape


class Frame(NamedTuple):
    """The moving frame at each node: lever d [m], normal n, tangent t (..., n, 2), penetration g [m] (..., n)."""

    d: Tensor
    n: Tensor
    t: Tensor
    g: Tensor


class ContactState(NamedTuple):
    """Per node, shape (..., n): forces [N], stretch rate s' and slip rate gamma' [m/s], effort e [N], ramp rho [1]."""

    F_N: Tensor
    F_T: Tensor
    s_dot: Tensor
    gamma_dot: Tensor
    e: Tensor
    rho: Tensor


def cross(d: Tensor) -> Tensor:
    """z x d, the velocity of the lever d (..., 2) under unit spin."""
    return torch.stack((-d[..., 1], d[..., 0]), -1)


def moving_frame(shape: Shape, p: Tensor, r_C: Tensor, theta: Tensor) -> Frame:
    """Detection and frame (Eq. 1, 3) of nodes p (..., n, 2) [m] against the object at r_C (..., 2), turned by theta."""
    d = p - r_C[..., None, :]  # (1)
    c, s = torch.cos(theta)[..., None], torch.sin(theta)[..., None]
    body = torch.stack((c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]), -1)
    phi, m = shape.signed_distance(body)
    n = torch.stack((c * m[..., 0] - s * m[..., 1], s * m[..., 0] + c * m[..., 1]), -1)
    return Frame(d, n, cross(n), -phi)


def contact_transformer(frame: Frame, pad: str, surface: Tensor, moving_base: bool) -> Transformer:
    """MTF from the junctions to (g', v_T) per node: the object's material point against the node (Eq. 4-7)."""
    R = torch.stack((frame.n, frame.t), -2)  # world -> (normal, tangential), the rows of [iR0]
    lever = torch.einsum("...ij,...j->...i", R, cross(frame.d))[..., None]
    blocks = {"disc": Block(R), "spin": Block(lever), pad: Block(-R, surface)}
    if moving_base:
        blocks["bracket"] = Block(-R)
    return Transformer(blocks)


def ramp(g: Tensor, epsilon: Tensor | float) -> Tensor:
    """rho = g / (g + epsilon) for g > 0, else 0. Continuous; not smooth at g = 0."""
    depth = g.clamp(min=0.0)
    return depth / (depth + epsilon)


def normal_force(g: Tensor, g_dot: Tensor, rho: Tensor, K_n: Tensor, R_n: Tensor) -> Tensor:
    """F_N = max(0, K_n g + R_n g' rho) while g > 0 (Eq. 8, 9) [N]. Not smooth at g = 0 and where the max cuts."""
    return (K_n * g.clamp(min=0.0) + R_n * rho * g_dot).clamp(min=0.0)


class FrictionLaw(Protocol):
    """Slip rate |gamma'| [m/s] under a trial effort E >= 0 [N], normal force F_N [N] and dashpot R [N.s/m]."""

    def slip_rate(self, E: Tensor, F_N: Tensor, R: Tensor, eta: Tensor) -> Tensor: ...


class SmoothSlip(nn.Module):
    """The slip element: (eta + R) |gamma'| = <E - mu(gamma') F_N>+, mu = mu_k + (mu_s - mu_k) / (1 + |gamma'| / v_s).

    A quadratic in |gamma'|, with one positive root when E > mu_s F_N. Continuous, not smooth at slip onset; continuous
    only if eta + R >= (mu_s - mu_k) F_N / v_s.
    """

    def __init__(self, p: ContactParameters) -> None:
        super().__init__()
        self.mu_s, self.mu_k, self.v_s = (
            nn.Parameter(torch.tensor(value, dtype=torch.float64)) for value in (p.mu_s, p.mu_k, p.v_s)
        )

    def slip_rate(self, E: Tensor, F_N: Tensor, R: Tensor, eta: Tensor) -> Tensor:
        a = eta + R
        b = a * self.v_s - (E - self.mu_k * F_N)
        c = (self.v_s * (E - self.mu_s * F_N)).clamp(min=0.0)
        root = torch.sqrt(b * b + 4 * a * c)
        rising = b >= 0  # two forms of the same root, neither of which cancels
        w = torch.where(rising, 2 * c / torch.where(rising, b + root, 1.0), (root - b) / (2 * a))
        return torch.where(c > 0, w, 0.0)


class Coulomb(nn.Module):
    """Eq. 12-13 to the letter, with |.| around the force: stick up to mu_s F_N, then mu_k F_N.

    The spring re-anchors so that the Voigt pair carries just mu_k F_N, |gamma'| = (E - mu_k F_N) / R. The slip element's
    viscosity eta plays no part. Discontinuous at slip onset unless mu_s = mu_k: gradients across it are biased.
    """

    def __init__(self, p: ContactParameters) -> None:
        super().__init__()
        self.mu_s, self.mu_k = (nn.Parameter(torch.tensor(value, dtype=torch.float64)) for value in (p.mu_s, p.mu_k))

    def slip_rate(self, E: Tensor, F_N: Tensor, R: Tensor, eta: Tensor) -> Tensor:
        return torch.where(self.mu_s * F_N < E, (E - self.mu_k * F_N) / R, 0.0)


class Contact(nn.Module):
    """The contact elements of one surface node, per reference spacing; `share` scales them to a node's tributary length."""

    def __init__(self, p: ContactParameters) -> None:
        super().__init__()
        self.K_n, self.R_n, self.K_t, self.R_t, self.eta = (
            nn.Parameter(torch.tensor(value, dtype=torch.float64)) for value in (p.K_n, p.R_n, p.K_t, p.R_t, p.eta)
        )
        self.epsilon, self.node_spacing = p.epsilon, p.node_spacing
        self.friction: FrictionLaw = SmoothSlip(p) if p.friction == "smooth" else Coulomb(p)

    def forward(
        self, g: Tensor, g_dot: Tensor, v_T: Tensor, s: Tensor, share: Tensor, stage: float = 0.0
    ) -> ContactState:
        """Forces and rates from penetration g [m], its rate, sliding speed v_T [m/s] and stretch s [m], all (..., n).

        With `stage` = a h [s] the law at the end of an implicit stage: s is then its s*, and the stretch that acts is
        s* + a h s', which turns the dashpot R_t into R_t + a h K_t and changes nothing else.
        """
        K_n, R_n, K_t, R_t, eta = (share * k for k in (self.K_n, self.R_n, self.K_t, self.R_t, self.eta))
        R_t = R_t + stage * K_t
        rho = ramp(g, self.epsilon)
        F_N = normal_force(g, g_dot, rho, K_n, R_n)  # (8), (9)
        trial = K_t * s + R_t * rho * v_T  # (10), (11): the effort if nothing slipped
        gamma_dot = torch.sign(trial) * self.friction.slip_rate(trial.abs(), F_N, R_t, eta)  # (12), (13)
        s_dot = rho * v_T - gamma_dot
        e = K_t * s + R_t * s_dot
        return ContactState(F_N, rho * e, s_dot, gamma_dot, e, rho)
