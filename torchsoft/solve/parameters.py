"""The parameters of a rig at one moment, as one vector with a table of names.

They are copied when a run begins, so that later changes of the modules do not matter;
where a derivative is wanted the vector keeps its graph, and so gradients reach the tensors that the
values were made of.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.physics.motion import Reference, polynomial
from torchsoft.physics.rig import Rig
from torchsoft.physics.structure import Structure, copied, described
from torchsoft.physics.validity import check_place, check_values, ordinary
from torchsoft.solve.kernel.table import Array
from torchsoft.solve.model import model_of
from torchsoft.solve.rig_arrays import computed, prepared
from torchsoft.solve.steps import Followed, rig_units


@contextmanager
def independent() -> Iterator[None]:
    """Graphs made inside keep copies of their saved tensors: later changes of the modules do not
    reach them."""
    with torch.autograd.graph.saved_tensors_hooks(lambda x: x.detach().clone(), lambda x: x):
        yield


class Parameters:
    """The parameters of a rig at one moment, with `values` in the place of some, by their id.

    vector (n,): the parameters and then what is computed from them, in SI units, of which
    `parameters["materials.rubber.E"]` is a slice (`model.places` has all names); p (m,): the same
    in the order in which the kernels read it, `numbers` without its graph, which it has where it is
    to be `differentiable`. rig: a copy of the rig with these parameters; model: what its structure
    determines; reference: that of the run, a copy of it in that case; units: of `atol`
    (`rig_units`).

    Raises the `ValueError`s of a rig that cannot be run.
    """

    def __init__(
        self, rig: Rig, reference: Reference | None = None, *, structure: Structure | None = None,
        values: Mapping[int, Tensor] | None = None, differentiable: bool = True,
    ) -> None:  # fmt: skip
        check_place()
        values = values or {}
        structure = structure or Structure(rig)
        given = [values.get(id(x), x) for x in structure.parameters]
        differentiable = differentiable or not structure.known  # whose gradients are judged
        followed = rig.reference if reference is None else reference
        if not ordinary(given):
            odd = structure.copy(given)[0]
            odd._modules["reference"] = rig.reference
            check_values(odd)  # which names the parameter
        apart = independent() if differentiable else nullcontext()
        with torch.inference_mode(False), torch.set_grad_enabled(differentiable), apart:
            theta, copies = taken(structure.parameters, given, differentiable)
            tensors = [copies[id(x)] for x in structure.parameters]
            self.model = model = model_of(structure, tensors)
            modules = model.structure.copy(tensors, apart=False)
            self.rig: Rig = modules[0]
            touched = lambda one: not values.keys().isdisjoint(map(id, one.parameters()))
            change = lambda one: differentiable or (values and touched(one))
            self.reference = copy_of(followed, copies, values) if change(followed) else followed
            self.rig._modules["reference"] = (
                self.reference if followed is rig.reference
                else copy_of(rig.reference, copies, values) if change(rig.reference)
                else rig.reference
            )  # fmt: skip
            self._evaluate(modules, theta)
        self.layout = model.layout

    def _evaluate(self, modules: Sequence[Any], theta: Tensor) -> None:
        """Find the vector of parameters; the last one again for the same values without a graph."""
        model, values = self.model, theta.detach().numpy()
        if not theta.requires_grad and model.last is not None and model.shared:
            known, self.vector, self.p, self.units = model.last
            if np.array_equal(known, values):
                self.numbers: Array = self.p.numpy()
                return
        if not model.within(modules, values):
            check_values(self.rig)
        made = computed(self.rig, *prepared(self.rig)).values()
        self.vector = torch.cat([theta, *(x.double().reshape(-1) for x in made)])
        self.p, self.units = self.vector[model.index], rig_units(self.rig, model.smallest)
        self.numbers = self.p.detach().numpy()
        if not np.isfinite(self.numbers).all():
            raise ValueError(
                "the parameters of the rig give numbers that are not finite; some are too large or "
                "too small"
            )
        if not model.chained(self.numbers):
            check_values(self.rig)
        if not self.p.requires_grad:
            model.last = values, self.vector, self.p, self.units

    def __getitem__(self, name: str) -> Tensor:
        """Values (.,) of a parameter, by its name in the module or the rig file."""
        return self.vector[self.model.places[name]]

    @cached_property
    def system(self) -> Any:
        """The rig's arrays."""
        return self.model.system(self.numbers.copy())

    def kernel_signals(self, reference: Reference, origin: float) -> Followed:
        """A reference as the kernels evaluate it, with time counted from `origin` [s]."""
        fixed = [float(one.detach()) for one in self.rig.fixed_values]
        structure = Structure(reference)
        key = structure.key, *map(described, structure.parameters), *fixed
        if structure.known and self.model.motion is not None and self.model.motion[0] == key:
            return self.model.motion[1].since(origin)
        since = lambda t: self.signals(t, reference.since(origin))
        found = Followed(reference, self.model.signals, fixed, since)
        if structure.known and found.known:
            self.model.motion = key, found
        return found.since(origin)

    @independent()
    def signals(self, t: Tensor, reference: Reference | None = None) -> Tensor:
        """The signals that the kernels follow, fixed coordinates last: values and rates (...,
        signals, 2)."""
        fixed, used = self.rig.fixed_values, self.reference if reference is None else reference
        followed = self.rig.follow(t, used)
        if not bool(torch.isfinite(followed).all()):
            bad = torch.nonzero(~torch.isfinite(followed))[0].tolist()
            name, time = self.rig.signals[bad[-2]], used.origin + float(t[tuple(bad[:-2])])
            raise ValueError(
                f"the signal `{name}` of the reference is not finite at t = {time:.10g} s"
            )
        if not used.is_plain(self.rig.signals) and not torch.equal(
            followed, self.rig.follow(t, used)
        ):
            raise ValueError(
                "the reference gives other values when asked again; signals must be functions of "
                "time alone"
            )
        if not fixed:
            return followed
        held = torch.stack([torch.stack(fixed), torch.zeros(len(fixed), dtype=torch.float64)], -1)
        return torch.cat((followed, held.expand(*t.shape, -1, -1)), -2)


def taken(
    tensors: Sequence[Tensor], given: Sequence[Tensor], differentiable: bool
) -> tuple[Tensor, dict[int, Tensor]]:
    """Copies of the values `given` for some tensors: in one vector, and by the tensors' id."""
    if differentiable:
        copies = {id(x): value for x, value in zip(tensors, given)}
        copies = {key: value.clone() for key, value in copies.items()}
        flat = [copies[id(x)].reshape(-1) for x in tensors]
        return torch.cat([torch.zeros(0, dtype=torch.float64), *flat]), copies
    if given and not any(x.ndim for x in given):  # scalars, as most parameters are
        theta = torch.stack([*given])
        return theta, dict(zip(map(id, tensors), theta.unbind()))
    flat = [x.reshape(-1) for x in given]
    theta = torch.cat([torch.zeros(0, dtype=torch.float64), *flat])
    parts = theta.split([len(x) for x in flat])
    return theta, {id(x): part.view(value.shape) for x, value, part in zip(tensors, given, parts)}


def copy_of(
    reference: Reference, copies: dict[int, Tensor], values: Mapping[int, Tensor]
) -> Reference:
    """A reference with copies of its parameters, those `copies` where they are the rig's too, and
    `values` in the place of some. Signals that are not this package's are kept as they are."""
    foreign = [one for one in reference.signals.values() if not polynomial(one)]
    known: dict[int, nn.Module] = {id(one): one for one in foreign}
    if reference.overridden:
        return reference
    out = copied(reference, known)
    for one in known.values():
        if one not in foreign:
            for name, x in one._parameters.items():
                if x is not None and id(x) not in copies:
                    copies[id(x)] = values.get(id(x), x).clone()
                parameters: dict[str, Any] = one._parameters
                parameters[name] = x if x is None else copies[id(x)]
    return out  # pyright: ignore[reportReturnType]
