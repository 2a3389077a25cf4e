"""Whether a custom law is valid: a friction law, or that of an actuator."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.codegen import compile_law
from torchsoft.codegen.stops import evaluate
from torchsoft.physics.contact import SlipLaw, SoftContact, sharp_onset
from torchsoft.physics.parts import Actuator
from torchsoft.physics.shapes import Circle
from torchsoft.physics.validity import NORMALS, check_slip, slip_rates
from torchsoft.solve.laws import (
    actuator_fault,
    actuator_law,
    as_law,
    contact_laws,
    friction_fault,
    outputs_of,
    response_of,
    tried_efforts,
    tried_states,
)
from torchsoft.testing.energy import conclude

ALIKE = 1e-9
"""Part of the largest value, or derivative, by which compiled code may differ from torch's."""


def check_law(
    law: SlipLaw | SoftContact | Actuator | Mapping[str, Actuator], *, R: float = 500.0
) -> None:
    """Try a friction law, a function or module of (E, F_N, R), with the dashpot R [N.s/m] or that
    of the contact that has it; or an actuator, the law of one, such as a `PD`, a function or module
    of (w, w', feed-forward, q, q'), or all of a `controller` or of a rig.

    A friction law is to be of one point, to dissipate, to leave no effort where nothing presses,
    and to begin to slip without a jump. Every law is to have a derivative that is its value's, and
    to be compiled as it is written. Raises `CheckFailed` with a sentence on every fault.
    """
    every: Any = law
    if isinstance(law, Actuator):
        every = {law.pushes: law}
    elif isinstance(law, SoftContact):
        law, R = law.friction, law.R_t.item()
    elif (loop := _loop(law)) is not None:
        every = {_name(law): loop}
    if isinstance(every, Mapping | nn.ModuleDict):
        loops: Any = every.items()
        conclude([fault for name, one in loops for fault in _actuator_faults(name, one)])
        return
    conclude(list(_friction_faults(law, R)))


def _loop(law: Any) -> Actuator | None:
    """The actuator of a law of one; None for a law that takes the arguments of friction, or neither
    these nor those of a loop."""
    one = torch.ones((), dtype=torch.float64)
    with suppress(ValueError):
        slip_rates("", law, one, one, 1.0)
        return None
    with suppress(Exception):  # any error of user code
        loop = Actuator("body.x", "body.x", law, setpoint="x_d", feed_forward="F_ff")
        loop(torch.zeros(6, dtype=torch.float64))
        return loop
    return None


def _name(law: Any) -> str:
    return getattr(law, "__name__", type(law).__name__)


def _friction_faults(slip: Any, R: float) -> Iterator[str]:
    name = _name(slip)
    try:
        wrong = check_slip(name, slip, R)
        contact_laws(SoftContact(1e5, 0.0, 1e5, R, friction=slip), Circle(0.02))
    except (TypeError, ValueError) as error:
        yield str(error)
        return
    yield from filter(None, (wrong, _jump(name, slip, R), friction_fault(name, slip, R)))
    yield from _otherwise(f"the slip law of `{name}`", slip, tried_efforts(slip, R))


def _actuator_faults(name: str, actuator: Actuator) -> Iterator[str]:
    parameters = {f"law.{k}": v for k, v in actuator.named_parameters()}
    try:
        actuator_law(name, actuator, parameters)
    except TypeError as error:
        yield str(error)
        return
    if wrong := actuator_fault(name, actuator):
        yield wrong
    x = tried_states(actuator)
    what = f"the law of `actuators.{name}`"
    with torch.no_grad():
        together = response_of(actuator, x)[0]
        alone = torch.stack([response_of(actuator, row)[0] for row in x])
    if together.shape != alone.shape or not torch.allclose(together, alone, rtol=ALIKE, atol=0.0):
        yield f"{what} gives several states at once other efforts than each of them alone"
    yield from _otherwise(what, actuator, x)


def _otherwise(what: str, law: Callable[..., Any], x: Tensor) -> Iterator[str]:
    """Whether compiled values and derivatives are torch's at samples x (samples, inputs)."""
    function, parameters = as_law(outputs_of, {"law": law})
    compiled = compile_law(function, x[0], parameters)
    weights = np.linspace(0.5, 1.7, compiled.outputs)
    found = evaluate(compiled, x, parameters, weights)
    kept = {name: p.detach().requires_grad_() for name, p in parameters.items()}
    values, slopes, by_parameter = list[Tensor](), list[Tensor](), list[Tensor]()
    for row in x:
        given = row.clone().requires_grad_()
        out = function(given, kept)
        wanted = [given, *kept.values()]
        nothing = 0.0 * torch.stack([w.sum() for w in wanted]).sum()  # without a graph of its own
        ask = lambda scalar, wanted=wanted, nothing=nothing: torch.autograd.grad(
            scalar + nothing, wanted, retain_graph=True
        )
        values.append(out.detach())
        slopes.append(torch.stack([ask(one)[0] for one in out]))
        bars = ask((out * torch.from_numpy(weights)).sum())[1:]
        by_parameter.append(torch.cat([torch.zeros(0).double(), *(g.flatten() for g in bars)]))
    parts = ("values", "derivatives", "derivatives by parameters")
    for part, one, rows in zip(parts, found, (values, slopes, by_parameter)):
        other = torch.stack(rows).numpy()
        scale = np.nanmax(np.abs(other), initial=0.0)
        if not np.allclose(one, other, rtol=ALIKE, atol=ALIKE * scale, equal_nan=True):
            yield f"{what} has other {part} once compiled than in torch"


def _jump(name: str, slip: Any, R: float) -> str:
    """Sentence on an effort at which the slip rate jumps, under one of several normal forces; empty
    where there is none."""
    for F_N in NORMALS[1:]:
        if (onset := sharp_onset(slip, F_N, R)) is not None:
            return (
                f"the slip rate of `{name}` jumps by {onset.jump:.3g} m/s at an effort "
                f"of {onset.effort:.3g} N under a normal force of {F_N:g} N with a dashpot of "
                f"{R:.3g} N.s/m: gradients across it are biased, and Newton's iteration may fail; "
                "let friction fall steadily with slip, as SmoothSlip does, or use a larger R_t"
            )
    return ""
