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
from torchsoft.codegen.graph import ScalarGraph
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
from torchsoft.physics.elements import element_potentials
from torchsoft.physics.hyperelastic import Hyperelastic, invariants
from torchsoft.physics.material import Material
from torchsoft.physics.mesh.element import QUADRILATERAL
from torchsoft.physics.motion import Reference
from torchsoft.physics.parts import Actuator, weight
from torchsoft.physics.shapes import Shape
from torchsoft.physics.state import begin_states, law_states
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
        chosen = {name: value for name, value in values.items() if name.split(".")[0] in modules}
        return torch.func.functional_call(called, chosen, (x,))

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
            graph = ScalarGraph()
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

REMEDY = "or call requires_grad_(False) on a parameter that is to be held"

STEP, UNLIKE, ROUNDED = 1e-6, 1e-3, 1e-7
"""Relative change of a parameter by which outputs are differenced, relative error of a derivative
from which on it is wrong, and rounding of a derivative, over the output's size."""

SMALL_STATE = 1e-3
"""State of a friction law at which it is tried, where it starts at zero."""

SHARES = 0.0713, 0.2391, 0.3907, 0.5579, 0.7187, 0.9103
"""Parts of a run's time at which signals are tried, off the knots that they are likely to have."""


def gradient_fault(
    what: str, law: Any, x: Tensor, inputs: Sequence[str],
    outputs: Callable[..., Tensor] | None = None, conjugates: int | None = None,
) -> str:  # fmt: skip
    """Message on the derivatives that a compiled law of `inputs` leaves out at samples x (samples,
    inputs), with respect to them and to its parameters that require a gradient; empty where there
    are none. `conjugates` are those of `compile_law`."""
    with _compiling:
        function, parameters = as_law(outputs or outputs_of, {"law": law})
        found = left_out(function, x, parameters, conjugates)
    if found is None:
        return ""
    names = [inputs[i] for i in found.inputs]
    names += [f"`{name.removeprefix('law.')}`" for name in found.parameters]
    return (
        f"the gradient of {what} is not that of its value: torch is told to record none at "
        f"{found.lines[0]}, so that derivatives by {', '.join(names)} are wrong; take detach() or "
        f"torch.no_grad() out there, {REMEDY}"
    )


def difference_fault(what: str, part: nn.Module, outputs: Callable[[Any], Tensor]) -> str:
    """The same of `outputs`, a tensor of a part that torch evaluates as it is written, by
    differences with respect to every parameter that requires a gradient."""
    law, parameters = as_law(lambda part, _: outputs(part).flatten(), {"part": part})
    generator, none = torch.Generator().manual_seed(0), torch.zeros(0, dtype=torch.float64)
    asked = {name: p for name, p in parameters.items() if p.requires_grad}
    if not asked:
        return ""
    with torch.enable_grad():
        given = {name: p.detach().clone().requires_grad_() for name, p in parameters.items()}
        here, wrong = law(none, given), list[str]()
        sizes = here.detach().abs()
        weights = torch.linspace(0.5, 1.7, len(here)).double() / torch.where(sizes > 0, sizes, 1.0)
        total = (weights * here).sum() + 0.0 * sum(p.sum() for p in given.values())
        slopes = torch.autograd.grad(total, [given[name] for name in asked])
    with torch.no_grad():
        for (name, p), slope in zip(asked.items(), slopes):
            way = torch.randn(p.shape, generator=generator, dtype=torch.float64).sign()
            way = way * torch.where(p == 0, 1.0, p)
            ends = [law(none, {**given, name: p + h * way}) for h in (STEP, -STEP)]
            after, before = ((weights * (end - here)).sum() / STEP for end in ends)
            expected = (slope * way).sum()
            differences = torch.stack((0.5 * (after - before), after, -before))  # one at a kink
            allowed = UNLIKE * torch.maximum(differences.abs(), expected.abs())
            if not bool(((differences - expected).abs() <= allowed + ROUNDED * len(here)).any()):
                wrong.append(f"`{name.removeprefix('part.')}`")
    if not wrong:
        return ""
    return (
        f"the gradient of {what} is not that of its value: derivatives by {', '.join(wrong)} are "
        "wrong; compute it from the parameters with torch's operations, without detach(), "
        f"torch.no_grad() and numbers that are read into Python, {REMEDY}"
    )


def outputs_of(law: Callable[..., Any], x: Tensor) -> Tensor:
    """Outputs of a law of tensors, of an actuator or a shape."""
    if isinstance(law, Actuator):
        out = response_of(law, x)
    elif law_states(law):
        E, F_N, R, *_ = x.unbind(-1)
        out = slip_of(law, E, F_N, R, x[..., 3:-1], x[..., -1])
    else:
        out = law(x) if isinstance(law, Shape) else law(*x.unbind(-1))
    parts = out if isinstance(out, tuple) else (out,)
    return torch.cat([part.reshape(-1) for part in parts if part is not None])


def tried_efforts(slip: Any, R: float) -> Tensor:
    """Efforts, normal forces and the dashpot R, for a slip law with states these and the stage's
    length too, (samples, inputs) at which it is tried."""
    E, F_N = tried()
    x = torch.stack((E, F_N, torch.full_like(E, R)), -1)
    if not law_states(slip):
        return x
    z = begin_states(slip, E.shape).detach()
    share = torch.linspace(0.5, 1.5, len(E), dtype=torch.float64)[:, None]
    return torch.cat((x, torch.where(z == 0, SMALL_STATE, z) * share, 1e-3 * share), -1)


def friction_fault(where: str, slip: Any, R: float) -> str:
    """`gradient_fault` of a slip law with the dashpot R [N.s/m]."""
    inputs = ("the effort", "the normal force", "the dashpot", *law_states(slip), "the stage")
    return gradient_fault(f"the slip law of `{where}`", slip, tried_efforts(slip, R), inputs)


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
    """`gradient_fault` of the energy of a material at finite strain; else `difference_fault` of its
    chain and its numbers."""
    what = f"the material of `{pad}`"
    if isinstance(material, Hyperelastic):
        generator = torch.Generator().manual_seed(0)
        x = 0.1 * torch.randn(8, 8, generator=generator, dtype=torch.float64)
        names = [f"F_{name} (a stress)" for name in ("xx", "xy", "yx", "yy")]
        with suppress(UnknownOperation):  # `element_law` raises it
            if wrong := gradient_fault(what, material, x, names, energy_of, conjugates=4):
                return wrong
    return difference_fault(what, material, numbers_of)


def energy_of(material: Hyperelastic, x: Tensor) -> Tensor:
    """Potentials, as those of an element, of F - 1 in plane strain and its rate, x (8,)."""
    none, one = torch.zeros_like(x[0]), torch.ones_like(x[0])
    rows = (1 + x[0], x[1], none), (x[2], 1 + x[3], none), (none, none, one)
    F = torch.stack([torch.stack(row) for row in rows])
    return torch.stack((material.distortion(F) + material.dilatation(invariants(F)[2]), none))


def numbers_of(material: Material) -> Tensor:
    """The numbers (n,) of a material that runs read."""
    parts = [*material.chain(), material.E, material.nu, material.rho, material.depth]
    if isinstance(material, Hyperelastic):
        parts += [material.tau, *(part for branch in material.relaxation() for part in branch)]
    return torch.cat([part.reshape(-1) for part in parts])


def reference_fault(reference: Reference, names: Sequence[str], t: Tensor) -> str:
    """`difference_fault` of the signals called `names`, in a run through the times t."""
    at = t[0] + (t[-1] - t[0]) * torch.tensor(SHARES, dtype=torch.float64)
    return difference_fault("the reference", reference, lambda one: one(at, names))


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
    states = 1 + len(law_states(law.friction))
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
    law = lambda _, values: weight(*values["numbers"].unbind())[None]
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
    numbers = dict(material.named_parameters()) if isinstance(material, Hyperelastic) else {}
    parameters: dict[str, Tensor] = {f"material.{key}": value for key, value in numbers.items()}
    parameters["factors.values"] = factors
    corners = QUADRILATERAL.dofs * fields
    try:
        law = compiled_law(
            parameters, element, 2 * corners + QUADRILATERAL.constants, corners, 2 * corners,
            conjugates=corners, lanes=LANES, material=material, factors=Factors(factors),
        )  # fmt: skip
    except UnknownOperation as error:
        raise UnknownOperation(f"the material of the pad `{name}`: {error}") from error
    return law, parameters
