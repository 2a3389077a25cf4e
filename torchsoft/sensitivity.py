"""Forward sensitivities: the derivative of a whole run with respect to a handful of parameters, in one pass.

The Jacobian that Gauss-Newton and Fisher information need. The tangent sweep is compiled (`kernels.sensitivity`) and uses
one factorisation for all parameters; what the laws contribute comes from the module's own functions by forward-mode
differentiation.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.implicit import ImplicitStepper, Progress, Segment
from torchsoft.kernels.sensitivity import Explicit, Tangent, forward
from torchsoft.model import SoftGrasp
from torchsoft.stage_laws import decay_rate, law_rows, rigid_loads


class Sensitivities(NamedTuple):
    """States y (T, size), their derivatives dy (T, size, n) by the n parameters, the parameters' names, the run."""

    y: Tensor
    dy: Tensor
    names: tuple[str, ...]
    run: Progress


class _Scope(nn.Module):
    """Makes any function of a model callable with other values for its parameters, by `torch.func.functional_call`."""

    def __init__(self, model: SoftGrasp, function: Callable[[], Tensor]) -> None:
        super().__init__()
        self.model, self.function = model, function

    def forward(self) -> Tensor:
        return self.function()


def _derivatives(model: SoftGrasp, names: Sequence[str], function: Callable[[], Tensor]) -> Tensor:
    """d function / d parameters at the model's own values, parameters last."""
    scope, value = _Scope(model, function), dict(model.named_parameters())

    def at(theta: Tensor) -> Tensor:
        return torch.func.functional_call(scope, {f"model.{name}": x for name, x in zip(names, theta)}, ())

    return torch.func.jacfwd(at)(torch.stack([value[name].detach() for name in names]))


def _compliance_derivatives(model: SoftGrasp, names: Sequence[str], which: str) -> np.ndarray:
    """dC/d parameters of one pad, (surface dofs, dofs, n): C is proportional to 1 / (E depth), and linear about nu."""
    pad, material = model.pads[which], model.material
    parameters = dict(model.named_parameters())
    with torch.enable_grad():
        C = pad.compliance(material)
        out = np.zeros((*C.mT.shape, len(names)))
        for k, name in enumerate(names):
            if name in ("material.E", "material.depth"):
                out[..., k] = (-C / parameters[name]).mT.detach().numpy()
            elif name == "material.nu":
                out[..., k] = pad.compliance_by_nu(material).mT.detach().numpy()
    return out


@torch.no_grad()
def sensitivities(
    model: SoftGrasp,
    y0: Tensor,
    t: Tensor,
    names: Sequence[str],
    *,
    step: float = 2e-3,
    tolerance: float = 1e-9,
    dy0: Tensor | None = None,
) -> Sensitivities:
    """Run from y0 (size,) through t (T,) [s] and differentiate every state by the scalar parameters `names`.

    Names are those of `model.named_parameters()`, such as "contact.K_n" or "material.E". `dy0` (size, n) is the
    derivative of the initial state, zero by default. Raises `ValueError` for a name that is not a scalar parameter,
    `NotImplementedError` for inertial pads, `SimulationFailed` as `simulate` does.
    """
    known = {name: p for name, p in model.named_parameters() if p.ndim == 0}
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ValueError(f"`names` must be scalar parameters, but holds {unknown}; known: {', '.join(known)}")
    if not model.massless:
        raise NotImplementedError("sensitivities are for massless pads; set pad.fidelity = 'massless'")
    n, size = len(names), model.layout.size
    start = torch.zeros(size, n, dtype=torch.float64) if dy0 is None else dy0
    if start.shape != (size, n):
        raise ValueError(f"`dy0` must have shape ({size}, {n}), but has {tuple(start.shape)}")
    stepper = ImplicitStepper(model, step=step, tolerance=tolerance)
    dys = np.zeros((len(t), size, n))
    dys[0] = start.numpy()
    n_u = 2 * (model.pad_L.nodes + model.pad_U.nodes)
    n_s = len(model.pad_L.surface) + len(model.pad_U.surface)
    cuts = np.cumsum([n_u, n_s, 5])
    x = Tangent(*(part.copy() for part in np.split(dys[0], cuts)))
    C_L, C_U = (_compliance_derivatives(model, names, k) for k in "LU")
    tau = np.array([1.0 if name == "material.tau" else 0.0 for name in names])
    segments: list[Segment] = []
    run = None
    for run in stepper.integrate(y0.detach(), t, segments, tape_bytes=float("inf")):
        segment = segments.pop()
        chunk, tape = segment.chunk, stepper.tape(segment)
        law = np.zeros((*tape.force.shape[:3], 3, n))
        for p in range(2):
            at = law_rows(model, tape, p, chunk.h)[1]
            law[at[0], p, at[1]] = _derivatives(
                model, names, lambda p=p, tape=tape, h=chunk.h: law_rows(model, tape, p, h)[0]
            ).numpy()
        load = _derivatives(model, names, lambda chunk=chunk, tape=tape: rigid_loads(model, chunk, tape)).numpy()
        decay = _derivatives(model, names, lambda h=chunk.h: decay_rate(model, h)).numpy()
        explicit = Explicit(law, np.ascontiguousarray(load), C_L, C_U, tau, np.ascontiguousarray(decay))
        rate = decay_rate(model, chunk.h).item()
        forward(
            stepper.pad_arrays(chunk.h), chunk.h, stepper.constants, tape, chunk.keep, x, explicit, rate, dys[segment.rows]
        )  # fmt: skip
    assert run is not None
    return Sensitivities(torch.from_numpy(run.y), torch.from_numpy(dys), tuple(names), run)
