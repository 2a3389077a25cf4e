"""Area, centre of mass and radius of gyration of what a closed contour surrounds, by Green's theorem."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class Moments(NamedTuple):
    """Area [m2], centre of mass (2,) [m], and squared radius of gyration about it [m2]."""

    area: Tensor
    centre: Tensor
    gyration: Tensor


def gauss(points: int) -> tuple[Tensor, Tensor]:
    """Places and weights (points,) of Gauss' quadrature from 0 to 1."""
    place, weight = np.polynomial.legendre.leggauss(points)
    return torch.from_numpy(0.5 * (1 + place)), torch.from_numpy(0.5 * weight)


def moments(x: Tensor, dx: Tensor) -> Moments:
    """Of what lies to the left of a closed contour, from points x (points, 2) [m] of a quadrature along it, and its tangents
    there times their weights, dx (points, 2) [m]: the integral of x^k dA is that of x^(k+1) dy / (k+1)."""
    middle = x.detach().mean(0)
    x, y = (x - middle).unbind(-1)
    dx, dy = dx.unbind(-1)
    area = 0.5 * (x * dy - y * dx).sum()
    centre = torch.stack(((x**2 * dy).sum(), -(y**2 * dx).sum())) / (2 * area)
    square = ((x**3 * dy).sum() - (y**3 * dx).sum()) / (3 * area)
    return Moments(area, centre + middle, square - (centre**2).sum())
