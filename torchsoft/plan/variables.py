"""Free variables of a plan: knots of motions, and parameters of a rig of any shape."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.plan.knots import Array, Bounds, Moves

Free = Mapping[str, Bounds | tuple[float, float]]
"""Bounds of a motion's knots by its name, or lower and upper bound of a parameter by its name."""


class Variables:
    """The vector z (n,) of a plan's free variables. Each is over a unit of its own: for knots the
    distance that speed allows between two of them, for parameters their range, or their largest
    value where the range is infinite.

    Raises `ValueError` for names that the rig does not have, and for bounds that leave no freedom.
    """

    def __init__(self, rig: Rig, reference: Reference, free: Free, end: float) -> None:
        if not free:
            raise ValueError("`free` names no motion and no parameter: there is nothing to plan")
        self.moves = Moves(
            reference, {k: one for k, one in free.items() if isinstance(one, Bounds)}, end
        )
        self.shapes: dict[str, torch.Size] = {}
        z, low, high, units = [self.moves.start], [], [], []
        for name, one in free.items():
            if isinstance(one, Bounds):
                continue
            value = rig.parameter(name).detach()
            least, most = one
            if not least < most:
                raise ValueError(f"free.{name} = ({least:g}, {most:g}): low must be below high")
            if not bool(((value >= least) & (value <= most)).all()):
                raise ValueError(
                    f"free.{name}: its value in the rig is not between {least:g} and {most:g}; "
                    "begin within the bounds"
                )
            self.shapes[name] = value.shape
            finite = np.isfinite([least, most]).all()
            unit = most - least if finite else float(value.abs().max()) or 1.0
            flat = value.double().reshape(-1).numpy()
            z.append(flat / unit)
            units.append(np.full(len(flat), unit))
            low.append(np.full(len(flat), least / unit))
            high.append(np.full(len(flat), most / unit))
        self.unit = np.concatenate([np.ones(self.moves.n), *units])
        self.start: Array = np.concatenate(z)
        self.n = len(self.start)
        unbounded = np.full(self.moves.n, np.inf)
        self.low = np.concatenate([-unbounded, *low])
        self.high = np.concatenate([unbounded, *high])
        # D z holds the ways between knots, so that a small change of it is a smooth one
        self.D = np.eye(self.n)
        self.D[: self.moves.n, : self.moves.n] = self.moves.ways()
        # A z <= b keeps knots within their bounds
        self.A = np.pad(self.moves.A, ((0, 0), (0, self.n - self.moves.n)))
        self.b = self.moves.b

    def reference(self, z: Tensor) -> Reference:
        """The motion, differentiable by z (n,)."""
        return self.moves.reference(z[: self.moves.n])

    def parameters(self, z: Tensor) -> dict[str, Tensor]:
        """Parameters by name for one or more z (..., n), differentiable by z."""
        out, at = {}, self.moves.n
        physical = z * torch.from_numpy(self.unit)
        for name, shape in self.shapes.items():
            count = shape.numel()
            out[name] = physical[..., at : at + count].reshape(*z.shape[:-1], *shape)
            at += count
        return out

    def nearest(self, z: Array) -> Array:
        """The nearest z within all bounds."""
        k = self.moves.n
        return np.concatenate(
            (self.moves.nearest(z[:k]), np.clip(z[k:], self.low[k:], self.high[k:]))
        )

    def spread(self, u: Array) -> Array:
        """The z at a point u (n,) of the unit cube, which is mapped to the bounds. Raises
        `ValueError` for parameters without bounds."""
        low, high = self.low.copy(), self.high.copy()
        for i, (least, most) in enumerate(self.moves.box()):
            low[i], high[i] = least, most
        if not (np.isfinite(low) & np.isfinite(high)).all():
            raise ValueError(
                "several starts need finite bounds of every parameter; give them, or `starts = 1`"
            )
        return self.nearest(low + u * (high - low))

    def active(self, z: Array) -> list[str]:
        """Active bounds at z, in words."""
        out, at = self.moves.active(z[: self.moves.n]), self.moves.n
        for name, shape in self.shapes.items():
            part = slice(at, at + shape.numel())
            at = part.stop
            for bound, side in ((self.low[part], "low"), (self.high[part], "high")):
                if (np.abs(z[part] - bound) < 1e-3).any():
                    out.append(f"{name} at its {side} = {bound[0] * self.unit[part][0]:g}")
        return out
