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
from torchsoft.kernels.node import Array
from torchsoft.kernels.sensitivity import Explicit, Tangent, forward
from torchsoft.model import SoftGrasp
from torchsoft.stage_laws import decay_rate, law_rows, rigid_loads, touching

IN_LAWS = ("contact.", "shape.")
IN_LOADS = ("m_", "gravity", "shape.", "controllers.", "reference.")
"""Parameters that the node law and the rigid loads contain, by the beginnings of their names."""


class Sensitivities(NamedTuple):
    """States y (T, size), their derivatives dy (T, size, n) by the n parameters, the parameters' names, the run.

    With `rigid` dy is (T, 10, n): poses (x_C, y_C, theta, x_Br, y_Br) and their rates only."""

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


def parameter_derivatives(
    model: SoftGrasp, names: Sequence[str], only: tuple[str, ...], function: Callable[[], Tensor]
) -> Array:
    """d function / d parameters at the model's own values, parameters last; zero for names that do not start like `only`."""
    scope, value = _Scope(model, function), dict(model.named_parameters())
    some = [name for name in names if name.startswith(only)]

    def at(theta: Tensor) -> Tensor:
        return torch.func.functional_call(scope, {f"model.{name}": x for name, x in zip(some, theta)}, ())

    if not some:
        return np.zeros((*function().shape, len(names)))
    part = torch.func.jacfwd(at)(torch.stack([value[name].detach() for name in some])).numpy()
    out = np.zeros((*part.shape[:-1], len(names)))
    out[..., [names.index(name) for name in some]] = part
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
    rigid: bool = False,
) -> Sensitivities:
    """Run from y0 (size,) through t (T,) [s] and differentiate every state by the scalar parameters `names`.

    Names are those of `model.named_parameters()`, such as "contact.K_n" or "material.E". `dy0` (size, n) is the
    derivative of the initial state, zero by default; `rigid` leaves the pads out of the result. Raises `ValueError` for a
    name that is not a scalar parameter, `NotImplementedError` for inertial pads, `SimulationFailed` as `simulate` does.
    """
    known = {name: p for name, p in model.named_parameters() if p.ndim == 0}
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ValueError(f"`names` must be scalar parameters, but holds {unknown}; known: {', '.join(known)}")
    if not model.massless:
        raise NotImplementedError("sensitivities are for massless pads; set pad.fidelity = 'massless'")
    names, n, size = list(names), len(names), model.layout.size
    start = torch.zeros(size, n, dtype=torch.float64) if dy0 is None else dy0
    if start.shape != (size, n):
        raise ValueError(f"`dy0` must have shape ({size}, {n}), but has {tuple(start.shape)}")
    stepper = ImplicitStepper(model, step=step, tolerance=tolerance)
    n_u = 2 * (model.pad_L.nodes + model.pad_U.nodes)
    n_s = len(model.pad_L.surface) + len(model.pad_U.surface)
    cuts = np.cumsum([n_u, n_s, 5])
    x = Tangent(*(part.copy() for part in np.split(start.numpy(), cuts)))
    dys = np.zeros((len(t), 10 if rigid else size, n))
    dys[0] = start.numpy()[-dys.shape[1] :]
    by_nu = [pad.compliance_by_nu(model.material).mT.numpy() for pad in model.pads.values()]
    C_L, C_U = (np.ascontiguousarray(C) if "material.nu" in names else np.zeros((0, 0)) for C in by_nu)
    parameters = dict(model.named_parameters())  # C is proportional to 1 / (E depth)
    scales = [name in ("material.E", "material.depth") for name in names]
    softening = np.array([-1 / parameters[name].item() if scale else 0.0 for name, scale in zip(names, scales)])
    nu = names.index("material.nu") if "material.nu" in names else -1
    tau = np.array([1.0 if name == "material.tau" else 0.0 for name in names])
    segments: list[Segment] = []
    run = None
    for run in stepper.integrate(y0.detach(), t, segments, tape_bytes=float("inf")):
        if not segments:  # the first step of a chunk was not solved, and is to be halved
            continue
        segment = segments.pop()
        chunk, tape = segment.chunk, stepper.tape(segment)
        law = np.zeros((*tape.force.shape[:3], 3, n))
        for p in range(2):
            at = touching(tape, p)
            law[at[0], p, at[1]] = parameter_derivatives(
                model, names, IN_LAWS, lambda p=p, tape=tape, h=chunk.h: law_rows(model, tape, p, h)
            )
        load = parameter_derivatives(
            model, names, IN_LOADS, lambda chunk=chunk, tape=tape: rigid_loads(model, chunk, tape)
        )
        decay = parameter_derivatives(model, names, IN_LAWS, lambda h=chunk.h: decay_rate(model, h))
        explicit = Explicit(law, load, C_L, C_U, nu, softening, tau, decay)
        rate = decay_rate(model, chunk.h).item()
        forward(
            stepper.pad_arrays(chunk.h), chunk.h, stepper.constants, tape, chunk.keep, x, explicit, rate, dys[segment.rows]
        )  # fmt: skip
    assert run is not None
    return Sensitivities(torch.from_numpy(run.y), torch.from_numpy(dys), tuple(names), run)
