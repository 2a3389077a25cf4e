"""A rig's laws as compiled code: each is compiled once for all models that have it, for any values
of their parameters.

Laws of this package are identified by their structure. User code is traced again for every run,
since nothing else shows whether a number that it reads has changed.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchsoft.codegen import Law, UnknownOperation, compile_law
from torchsoft.codegen.emit import check_pointwise
from torchsoft.codegen.graph import Graph
from torchsoft.codegen.stops import left_out
from torchsoft.codegen.trace import check_backward, traced
from torchsoft.physics.contact import (
    distance_law,
    free_law,
    interface_law,
    relative_motion,
    slip_of,
    stored_law,
)
from torchsoft.physics.elements import CONSTANTS, CORNERS, element_potentials
from torchsoft.physics.hyperelastic import Hyperelastic
from torchsoft.physics.material import Material
from torchsoft.physics.parts import Actuator, weight
from torchsoft.physics.shapes import Shape
from torchsoft.physics.state import own_states
from torchsoft.physics.structure import copied, structure_of
from torchsoft.physics.validity import tried
from torchsoft.solve.kernel.arrays import LANES, MOTION, WRENCH


class LawSet(NamedTuple):
    """The compiled laws of one contact, its parameters' names and tensors in their order, and the
    number of states of a point."""

    distance: Law
    interface: Law
    free: Law
    stored: Law
    parameters: dict[str, Tensor]
    states: int


class _Called(nn.Module):
    """Modules, and the function of them and of x from which a compiled law is traced."""

    def __init__(self, function: Callable[..., Tensor], **modules: Any) -> None:
        super().__init__()
        self.function, self.names = function, tuple(modules)
        known: dict[int, nn.Module] = {}
        for name, module in modules.items():
            setattr(self, name, copied(module, known) if isinstance(module, nn.Module) else module)

    def forward(self, x: Tensor) -> Tensor:
        return self.function(*(getattr(self, name) for name in self.names), x)


def as_law(
    function: Callable[..., Tensor], modules: Mapping[str, Any]
) -> tuple[Callable[[Tensor, Mapping[str, Tensor]], Tensor], dict[str, Tensor]]:
    """A function of x and of the parameters of modules, of those only; and these parameters."""
    called = _Called(function, **modules)

    def law(x: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        own = {name: value for name, value in values.items() if name.split(".")[0] in modules}
        return torch.func.functional_call(called, own, (x,))

    return law, dict(called.named_parameters())


_laws: dict[Any, Law] = {}
"""Compiled laws, by the structure of their modules, else by their traced expressions."""

_compiling = threading.Lock()


def compiled_law(
    names: Mapping[str, Tensor],
    function: Callable[..., Tensor],
    size: int,
    linear: int,
    differentiated: int,
    points: bool = False,
    conjugates: int | None = None,
    lanes: int = 1,
    **modules: Any,
) -> Law:
    """The law of a function of modules and x (size,), differentiable in the first inputs and in the
    parameters `names`, of which it may not use all; `points` says that it is the law of a contact
    point, whatever the others do; `conjugates` and `lanes` are those of `compile_law`. Raises
    `UnknownOperation` naming the line of a law that cannot be compiled."""
    decided = tuple((name, structure_of(module)) for name, module in modules.items())
    shapes = tuple((name, tuple(value.shape)) for name, value in names.items())
    with _compiling:
        known = all(part is not None for _, part in decided)
        key = (function, decided, shapes, linear, differentiated, conjugates, lanes)
        if known and key in _laws:
            return _laws[key]
        law, _ = as_law(function, modules)
        example = torch.linspace(0.01, 0.02, size, dtype=torch.float64)

        def expressions() -> tuple[Any, ...]:
            graph = Graph()
            outputs = traced(graph, law, example, names)
            return (
                tuple(graph.ops),
                repr(graph.args),
                tuple(outputs),
                shapes,
                linear,
                differentiated,
                conjugates,
                lanes,
            )

        if not known:  # user code is known by a trace only, and may change any time
            key = expressions()
            if key in _laws:
                check_backward(law, example, names)
        if key not in _laws:
            if not known and expressions() != key:
                raise UnknownOperation(
                    "The law changed between calls; it must be stateless. It keeps something of a "
                    "call."
                )
            if points:
                check_pointwise(law, example, names)
            _laws[key] = compile_law(
                law, example, names, linear=linear, differentiated=differentiated,
                conjugates=conjugates, lanes=lanes,
            )  # fmt: skip
        return _laws[key]


# Laws of users whose derivative is not that of their value, since they detach what it is made of.


def gradient_fault(what: str, law: Any, x: Tensor, inputs: Sequence[str]) -> str:
    """Sentence on the derivatives that a law of `inputs` leaves out at samples x (samples, inputs),
    by them and by its parameters that require a gradient; empty where there are none."""
    with _compiling:
        function, parameters = as_law(outputs_of, {"law": law})
        found = left_out(function, x, parameters)
    if found is None:
        return ""
    names = [inputs[i] for i in found.inputs]
    names += [f"`{name.removeprefix('law.')}`" for name in found.parameters]
    return (
        f"the gradient of {what} is not that of its value: torch is told to record none at "
        f"{found.lines[0]}, so that derivatives by {', '.join(names)} are wrong; take detach() or "
        "torch.no_grad() out there, or call requires_grad_(False) on a parameter that is to be held"
    )


def outputs_of(law: Callable[..., Any], x: Tensor) -> Tensor:
    """Outputs of a law of tensors, of an actuator or a shape; the chain of a material."""
    if isinstance(law, Material):
        out = law.chain()
    elif isinstance(law, Actuator):
        out = response_of(law, x)
    elif own_states(law):
        out, _ = slip_of(law, *x.unbind(-1))
    else:
        out = law(x) if isinstance(law, Shape) else law(*x.unbind(-1))
    parts = out if isinstance(out, tuple) else (out,)
    return torch.cat([part.reshape(-1) for part in parts])


def tried_efforts(R: float) -> Tensor:
    """Efforts, normal forces and the dashpot R (samples, 3) at which slip laws are tried."""
    E, F_N = tried()
    return torch.stack((E, F_N, torch.full_like(E, R)), -1)


def friction_fault(where: str, slip: Any, R: float) -> str:
    """`gradient_fault` of a slip law with the dashpot R [N.s/m]."""
    inputs = ("the effort", "the normal force", "the dashpot")
    return gradient_fault(f"the slip law of `{where}`", slip, tried_efforts(R), inputs)


def tried_states(actuator: Actuator) -> Tensor:
    """Inputs (samples, inputs) of an actuator's law at which it is tried."""
    generator = torch.Generator().manual_seed(0)
    inputs = actuator.inputs + len(actuator.states)
    x = torch.randn(8, inputs, generator=generator, dtype=torch.float64)
    x = x * torch.logspace(-4, 0, 8, dtype=torch.float64)[:, None]
    return torch.cat((x, x[:, :1].abs()), -1) if actuator.states else x


def actuator_fault(name: str, actuator: Actuator) -> str:
    """`gradient_fault` of an actuator's law."""
    read = (*actuator.reads, *actuator.measures)
    inputs = [x for one in read for x in (one, f"{one}'s rate")]
    inputs += [*actuator.states, "the stage"] if actuator.states else []
    return gradient_fault(
        f"the law of `actuators.{name}`", actuator, tried_states(actuator), inputs
    )


def shape_fault(body: str, shape: Shape) -> str:
    """`gradient_fault` of a shape: of its distance and its normal."""
    angle = torch.linspace(0.1, 6.2, 12, dtype=torch.float64)
    x = shape.size() * torch.stack((angle.cos(), angle.sin()), -1)
    return gradient_fault(f"the shape of `{body}`", shape, x, ("x", "y"))


def material_fault(pad: str, material: Material) -> str:
    """`gradient_fault` of a material's chain."""
    with suppress(UnknownOperation):  # it is not compiled, so that it may do what it likes
        return gradient_fault(f"the material of `{pad}`", material, torch.zeros(1, 0).double(), ())
    return ""


def response_of(actuator: Actuator, x: Tensor) -> tuple[Tensor, ...]:
    """Effort, and rates of states if there are any, of what the law reads and its states with the
    length of the stage."""
    n, states = actuator.inputs, len(actuator.states)
    if not states:
        return (actuator(x),)
    return actuator.response(x[..., :n], x[..., n : n + states], x[..., n + states])


def _effort(actuator: Actuator, x: Tensor) -> Tensor:
    parts, shapes = response_of(actuator, x), ((), (len(actuator.states),))
    for part, shape, what in zip(parts, shapes, ("effort", "rates of its states")):
        if not isinstance(part, Tensor) or part.shape != shape:
            tensor = isinstance(part, Tensor)
            shown = f"a tensor of shape {tuple(part.shape)}" if tensor else repr(part)
            raise TypeError(f"for one state it gives {shown} for the {what}")
    return torch.cat([part.reshape(-1) for part in parts])


def actuator_law(name: str, actuator: Actuator, parameters: Mapping[str, Tensor]) -> Law:
    """The law of an actuator: its effort by set-points and their rates, feed-forward, coordinates
    and their rates.

    Raises `UnknownOperation` for one that cannot be compiled, `TypeError` for one that fails or
    gives no effort; with its name.
    """
    try:
        states, read = len(actuator.states), actuator.inputs
        size, inputs = read + states + bool(states), read + states
        return compiled_law(parameters, _effort, size, 1 + states, inputs, law=actuator)
    except UnknownOperation as error:
        raise UnknownOperation(f"`actuators.{name}`: {error}") from error
    except Exception as error:  # any error of user code
        raise TypeError(
            f"the law of `actuators.{name}` must take five tensors (set-point, its rate, "
            "feed-forward, coordinate, its rate), with states of its own these and the stage's "
            "length too, and return the effort, a tensor of a coordinate's shape, with states "
            f"their rates too, but {type(error).__name__}: {error}"
        ) from error


def contact_laws(law: Any, shape: Any) -> LawSet:
    """The laws of a contact of `law` on a body of `shape`."""
    _, parameters = as_law(interface_law, {"law": law, "shape": shape})
    states = 1 + len(own_states(law.friction))
    inputs, rows = MOTION + states + 2, WRENCH + states + 2
    return LawSet(
        compiled_law(parameters, distance_law, inputs, 0, 0, shape=shape),
        compiled_law(
            parameters, interface_law, inputs, rows, MOTION + states, points=True, law=law,
            shape=shape,
        ),
        compiled_law(parameters, free_law, states + 2, states, states, law=law),
        compiled_law(parameters, stored_law, 3, 0, 0, law=law),
        parameters,
        states,
    )  # fmt: skip


@cache
def motion_law() -> Law:
    """The law of relative motion, of every contact."""
    x = torch.linspace(0.1, 1.5, 15, dtype=torch.float64)
    return compile_law(lambda x, _: relative_motion(x), x, {})


@cache
def weight_law() -> Law:
    """The law of a weight; its parameters are mass and gravity."""
    numbers = torch.tensor([0.5, 9.81], dtype=torch.float64)
    law = lambda _, own: weight(*own["numbers"].unbind())[None]
    return compile_law(law, torch.zeros(0, dtype=torch.float64), {"numbers": numbers})


class Factors(nn.Module):
    """Numbers of a pad's elements besides the material's energy, as a module's parameter."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = nn.Parameter(values.detach())


def element(material: Material, factors: Factors, x: Tensor) -> Tensor:
    """Potentials of an element, from the modules that a compiled law is made of."""
    return element_potentials(material, factors.values, x)


def element_law(
    name: str, material: Material, factors: Tensor, fields: int
) -> tuple[Law, dict[str, Tensor]]:
    """The law of the elements of the pad called `name`, of at least so many fields as it has, and
    its parameters.

    Raises `UnknownOperation` for an energy that cannot be compiled, with the pad's name.
    """
    own = dict(material.named_parameters()) if isinstance(material, Hyperelastic) else {}
    parameters: dict[str, Tensor] = {f"material.{key}": value for key, value in own.items()}
    parameters["factors.values"] = factors
    corners = CORNERS * fields
    try:
        law = compiled_law(
            parameters, element, 2 * corners + CONSTANTS, corners, 2 * corners, conjugates=corners,
            lanes=LANES, material=material, factors=Factors(factors),
        )  # fmt: skip
    except UnknownOperation as error:
        raise UnknownOperation(f"the material of the pad `{name}`: {error}") from error
    return law, parameters
