"""Structure of a rig or of a part of it: everything but the values of its parameters.

Two parts of one structure have the same laws and layout; what is made of a structure serves every
part that has it, and is made anew for any other.
"""

from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from types import FunctionType
from typing import Any

import numpy as np
from torch import Tensor, nn

from torchsoft.physics.graph import Graph
from torchsoft.physics.mesh import Mesh
from torchsoft.physics.pads import Taxels

PACKAGES = "torchsoft.", "torch.nn."
"""Packages whose modules say all of themselves."""

HOOKS = "_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks"

PLAIN = frozenset((bool, int, float, str, type(None)))

IDLE: Mapping[type, frozenset[str]] = {Graph: frozenset(("watch", "tables", "reference"))}
"""Attributes of modules that decide nothing of a run; the reference is given to it."""


class Unknown(Exception):
    """Something that does not say all of itself."""


class Structure:
    """Modules of a part, each once, its parameters' tensors in their order, and a `key` that is
    equal for equal structures, until something changes. `known` is False where that is not certain:
    for code that is neither this package's nor torch's, hooks, other attributes than numbers, text,
    arrays and functions of this package. Such a part is like no other, nor like itself later."""

    def __init__(self, part: nn.Module) -> None:
        self.modules: list[nn.Module] = []
        self.children: list[dict[str, int | None]] = []
        self.parameters: list[Tensor] = []
        self.known = True
        self._key: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._visit(part)
        first: dict[int, int] = {}
        self._key += [first.setdefault(id(x), i) for i, x in enumerate(self.parameters)]
        self.key = tuple(self._key)

    def _visit(self, module: nn.Module) -> int:
        if (found := self._numbers.get(id(module))) is not None:
            return found
        number = self._numbers[id(module)] = len(self.modules)
        children: dict[str, int | None] = {}
        self.modules.append(module)
        self.children.append(children)
        attributes, kind = module.__dict__, type(module)
        names, numbers, known = _traits(kind, tuple(attributes))
        key = self._key
        key.append((kind, kind.forward, names, *[getattr(kind, name) for name in numbers]))
        if not known or any(map(attributes.get, HOOKS)):
            self.known = False
        try:
            for name in names:
                value = attributes[name]
                key.append(value if type(value) in PLAIN else described(value))
            for name, value in attributes["_buffers"].items():
                key.append((name, None if value is None else described(value)))
        except Unknown:
            self.known = False
        for name, value in attributes["_parameters"].items():
            key.append(name)
            key.append(None if value is None else value.shape)
            if value is not None:
                self.parameters.append(value)
        for name, child in attributes["_modules"].items():
            if name not in _idle(kind):
                children[name] = None if child is None else self._visit(child)
        key.append(tuple(children.items()))
        return number

    def copy(self, values: Sequence[Tensor], apart: bool = True) -> list[Any]:
        """The modules of a copy with these parameters, in the structure's order; the part itself
        comes first. Its buffers, lists and arrays are copies too where it is `apart`."""
        out: list[Any] = [type(module).__new__(type(module)) for module in self.modules]
        given = iter(values)
        for module, new, children in zip(self.modules, out, self.children):
            attributes = new.__dict__
            attributes.update(module.__dict__)
            if apart:
                for name, value in module.__dict__.items():
                    if type(value) in (dict, list, np.ndarray):
                        attributes[name] = value.copy()
                attributes["_buffers"] = {
                    name: None if buffer is None else buffer.detach().clone()
                    for name, buffer in module._buffers.items()
                }
            attributes["_parameters"] = {
                name: None if value is None else next(given)
                for name, value in module._parameters.items()
            }
            attributes["_modules"] = {
                name: None if number is None else out[number] for name, number in children.items()
            }
        return out


@cache
def _idle(kind: type) -> frozenset[str]:
    """Names of attributes that decide nothing."""
    bases = [base for base in kind.__mro__ if base not in (nn.Module, object)]
    idle = frozenset().union(*(names for base, names in IDLE.items() if issubclass(kind, base)))
    every = (item for base in bases for item in vars(base).items())
    return idle | {name for name, value in every if isinstance(value, cached_property)}


@cache
def _traits(kind: type, keys: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Names of attributes, among `keys`, that decide something, names of the numbers of a class,
    and whether its objects say all of themselves."""
    bases = [base for base in kind.__mro__ if base not in (nn.Module, object)]
    numbers = {k: 0 for base in bases for k, v in vars(base).items() if isinstance(v, int | float)}
    names = tuple(name for name in keys if name[0] != "_" and name not in _idle(kind))
    return names, tuple(numbers), kind.__module__.startswith(PACKAGES)


def described(value: Any) -> Any:
    """A value as it is now, hashable. Raises `Unknown` where nobody can tell."""
    if type(value) in PLAIN or isinstance(value, Mesh | Taxels):
        return value
    if isinstance(value, Tensor):
        try:
            value = value.detach().numpy()
        except (TypeError, RuntimeError):
            raise Unknown from None
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return value.dtype.str, value.shape, value.tobytes()
    if type(value) in (tuple, list):
        return tuple([described(one) for one in value])
    if type(value) is dict:
        return tuple([(key, described(one)) for key, one in value.items()])
    if (
        isinstance(value, FunctionType)
        and (value.__module__ or "").startswith("torchsoft.")
        and value.__closure__ is None
    ):
        return value
    raise Unknown


def values_of(part: nn.Module, *given: Tensor) -> tuple[Any, ...]:
    """Key of the structure of a part, of the values of its parameters and of `given` tensors: equal
    for parts that behave alike; empty where the structure is not known."""
    structure = Structure(part)
    values = [x.detach().numpy().tobytes() for x in (*structure.parameters, *given)]
    return (b"".join(values), structure.key) if structure.known else ()


def structure_of(part: object) -> Any:
    """Key of the structure of a part, hashable; None where it is not known."""
    found = Structure(part) if isinstance(part, nn.Module) else None
    return found.key if found is not None and found.known else None


def copied(module: nn.Module, known: dict[int, nn.Module]) -> nn.Module:
    """The same modules over the same tensors, beside those in `known`, by their id: tracing puts
    others in their place, which other threads must not meet."""
    if id(module) not in known:
        out = known[id(module)] = module.__class__.__new__(module.__class__)
        attributes = out.__dict__
        attributes.update(module.__dict__)
        attributes["_parameters"] = dict(module._parameters)
        attributes["_buffers"] = dict(module._buffers)
        attributes["_modules"] = {
            k: m if m is None else copied(m, known) for k, m in module._modules.items()
        }
    return known[id(module)]
