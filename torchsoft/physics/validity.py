"""Requirements of a rig before anything is computed with it: numbers in float64 on the CPU, finite
and physical, materials whose fractions sum to one, shapes that measure distances, slip laws that
take no more than the effort. Every refusal is one sentence that names the fault.
"""

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch._C._functorch import is_functorch_wrapped_tensor  # private, and the only way to tell

from torchsoft.caller import warn
from torchsoft.physics.arguments import check_transforms
from torchsoft.physics.contact import slip_of
from torchsoft.physics.material import Material
from torchsoft.physics.shapes import Shape
from torchsoft.quantity import quantities, quantity_of, short

P = TypeVar("P")

LARGEST = 1e100
"""Largest magnitude of a parameter, in SI units: squares and products of a few stay finite
numbers."""

MISSING = 1e-9
"""Largest rounding error of a material's fractions."""

DEPTHS = (1e-3, -1e-3)
"""Distances from the boundary, over the body's size, at which a shape is tried: outside and
inside."""

ALIKE = 1e-3
"""Largest error of a shape's normal, of the slope of its distance, and of its support over its
size."""

ALIKE_POINTS = 1e-9
"""Largest relative difference, by rounding, between slip rates of all points at once and of each
alone."""

FALLS = 8
"""Evaluations one after the other at earlier and earlier times that only an integration backwards
makes: a step that is refused goes back once."""

EFFORTS, NORMALS = (1e-3, 0.1, 1.0, 10.0, 100.0), (0.0, 0.1, 1.0, 10.0)
"""Trial efforts and normal forces [N] at which a slip law is tried."""


def sound(part: P) -> P:
    """A part whose parameters are physical together. Raises `ValueError` where they are not."""
    well_posed = getattr(part, "well_posed", None)
    if well_posed is not None and (wrong := well_posed()):
        raise ValueError(wrong)
    return part


def check_array(name: str, x: Any) -> None:
    """Raises `ValueError` unless x is a dense float64 tensor on the CPU, without the tangents of
    forward-mode derivatives."""
    if not isinstance(x, Tensor):
        raise ValueError(f"`{name}` must be a float64 tensor, but is {type(x).__name__}")
    if is_functorch_wrapped_tensor(x):
        raise ValueError(
            f"`{name}` is inside a transform of torch.func, which a run cannot be; use "
            "gradient='discrete'"
        )
    if x.dtype != torch.float64 or x.device.type != "cpu" or x.layout != torch.strided:
        raise ValueError(
            f"`{name}` must be float64, dense and on the CPU, but is {x.dtype}, {x.layout}, on "
            f"{x.device}"
        )
    if torch.autograd.forward_ad.unpack_dual(x).tangent is not None:
        raise ValueError(
            f"`{name}` has a tangent of torch's forward mode, which runs drop; use "
            "gradient='forward'"
        )


def ordinary(tensors: Iterable[Tensor]) -> bool:
    """Whether all of them are what `check_array` takes, and not made in inference mode."""
    dual = torch.autograd.forward_ad._current_level >= 0
    return not dual and all(
        x.dtype is torch.float64 and x.layout is torch.strided and x.is_cpu
        and not x.is_inference() and not is_functorch_wrapped_tensor(x) for x in tensors
    )  # fmt: skip


def check_place() -> None:
    """Raises `ValueError` where torch makes its tensors elsewhere than on the CPU, or in a
    transform of torch.func."""
    check_transforms()
    if torch.get_default_device().type != "cpu":
        raise ValueError(
            f"torch's default device is {torch.get_default_device()}, but rigs are computed on the "
            "CPU; call torch.set_default_device('cpu')"
        )


def check_values(rig: Any) -> None:
    """Raises `ValueError` as `check_numbers` does for all parts of the rig, for parameters that are
    not physical together, and for a material without a `chain`."""
    check_place()
    check_numbers(rig, {key: other for other, key in rig.names.items()})
    for name, pad in rig.pads.items():
        check_chain(name, pad.material)
    for owner, module in rig.named_modules():
        well_posed = getattr(module, "well_posed", None)
        if well_posed is not None and (wrong := well_posed()):
            raise ValueError(f"the parameters of `{owner}` are not physical together: {wrong}")


def check_numbers(part: nn.Module, names: Mapping[str, str] = MappingProxyType({})) -> None:
    """Raises `ValueError` for a parameter or tensor of a part by the rules of `check_values`;
    `names` are other names of parameters."""
    for owner, module in part.named_modules():
        path = f"{owner}." if owner else ""
        for name, value in module.named_parameters(recurse=False):
            called = names.get(f"{path}{name}", f"{path}{name.removeprefix('own_')}")
            check_array(called, value)
            if value.is_inference():
                raise ValueError(
                    f"parameter `{called}` was made under torch.inference_mode(); make it outside"
                )
            numbers = value.detach().numpy()
            if not (np.abs(numbers) < LARGEST).all():
                finite = np.isfinite(numbers)
                must = f"below {LARGEST:g}" if finite.all() else "finite"
                bad = numbers[~(finite if must == "finite" else np.abs(numbers) < LARGEST)][0]
                raise ValueError(f"parameter `{called}` must be {must}, but is {bad:g}")
        for name, value in module.named_buffers(recurse=False):
            if value.is_floating_point():
                check_array(f"{path}{name}", value)
    for owner, module in part.named_modules():
        path = f"{owner}." if owner else ""
        for name in dict.fromkeys((*module._parameters, *quantities(type(module)))):
            called = names.get(f"{path}{name}", f"{path}{name.removeprefix('own_')}")
            declared, value = quantity_of(module, name), getattr(module, name, None)
            if declared is None or not isinstance(value, Tensor | float):
                continue
            numbers = value.detach().numpy() if isinstance(value, Tensor) else np.array(value)
            if numbers.ndim and not isinstance(module, Shape):
                raise ValueError(
                    f"parameter `{called}` must be one number, but has shape {tuple(numbers.shape)}"
                )
            wrong = numbers[~((declared.low <= numbers) & (numbers <= declared.high))]
            if wrong.size:
                raise ValueError(
                    f"parameter `{called}` must be {declared.range}, but is {short(wrong[0])}"
                )


@torch.no_grad()
def check_chain(where: str, material: Material) -> None:
    """Raises `ValueError` naming the pad `where` unless its material's chain is one: fractions J
    that sum to one, and as many positive retardation times tau."""
    given = material.chain()
    if not isinstance(given, tuple) or len(given) != 2:
        raise ValueError(
            f"`chain` of the material of `{where}` must give two tensors, J and tau, but gives "
            f"{type(given).__name__}"
        )
    J, tau = given
    for name, x in (("J", J), ("tau", tau)):
        check_array(f"{name} of the material of {where}", x)
        if x.shape != (material.branches,) or len(x) == 0:
            raise ValueError(
                f"`{name}` of the material of `{where}` must have shape (branches,) = "
                f"({material.branches},), one at least, but has {tuple(x.shape)}"
            )
    if not bool((J >= -MISSING).all()):
        raise ValueError(
            f"the fractions J of the material of `{where}` must not be negative, but are "
            f"{J.tolist()}"
        )
    if not abs(float(J.sum()) - 1) <= MISSING:
        raise ValueError(
            f"the fractions J of the material of `{where}` must sum to one, but {J.tolist()} sum "
            f"to {float(J.sum()):.10g}; divide both J and E by that sum"
        )
    if not bool((tau > 0).all()) or not bool(tau.isfinite().all()):
        raise ValueError(
            f"the retardation times tau of the material of `{where}` must be positive and finite, "
            f"but are {tau.tolist()} s"
        )


def check_groups(rig: Any) -> None:
    """Raises `ValueError` for a part of one of the rig's groups that was replaced there or in the
    lists, but not in both."""
    lists = (rig.bodies, rig.pads, rig.contacts, rig.actuators)
    known = {id(value) for parts in lists for value in parts.parameters()}
    for group in rig.groups:
        for name, value in getattr(rig, group).named_parameters():
            if id(value) not in known:
                raise ValueError(
                    f"`{group}.{name}` belongs to no body, pad, contact or actuator; put a new "
                    "part in both places, or remove the group's"
                )


def check_shape(where: str, shape: Shape) -> None:
    """Raises `ValueError` unless phi is a distance with the normal n as its slope, and `support`
    and `size` are the body's.

    Tried at some points near the boundary, which is searched for along rays from outside. The
    package's own are not tried.
    """
    if type(shape).__module__.startswith("torchsoft."):
        return
    size = shape.size()
    if not (math.isfinite(size) and size > 0):
        raise ValueError(
            f"the shape of `{where}` has the size {size}; `support` must be the body's reach"
        )
    with torch.enable_grad():
        angle = torch.linspace(0.1, 0.1 + 2 * torch.pi, 182, dtype=torch.float64)[:-1]
        ray = torch.stack((angle.cos(), angle.sin()), -1)
        r = torch.full_like(angle, 2 * size)
        with torch.no_grad():
            for _ in range(60):  # a distance never oversteps the boundary
                r = r - shape(r[:, None] * ray)[0]
        boundary = r[:, None] * ray
        x = torch.cat([(r + depth * size)[:, None] * ray for depth in DEPTHS]).requires_grad_()
        phi, n = shape(x)
        if phi.shape != x.shape[:-1] or n.shape != x.shape:
            raise ValueError(
                f"the shape of `{where}` must give phi (...) and n (..., 2) at x (..., 2), but "
                f"gives {tuple(phi.shape)} and {tuple(n.shape)} at {tuple(x.shape)}"
            )
        slope = torch.autograd.grad(phi.sum(), x)[0] if phi.requires_grad else torch.zeros_like(x)
    n, support = n.detach(), shape.support(ray).detach()
    reach = (boundary @ ray.mT).amax(0)
    faults = {
        "its normal is not of unit length": (n.norm(dim=-1) - 1).abs(),
        "phi is not a distance: its slope is not 1": (slope.norm(dim=-1) - 1).abs(),
        "its normal is not the slope of phi": (slope - n).norm(dim=-1),
        "the boundary is not where phi is zero": shape(boundary)[0].detach().abs() / size,
        "`support` is less than how far it reaches": (reach - support) / size,
        "`support` is more than how far it reaches": 0.1
        * (support - reach)
        / size,  # found at some points only
        "it is called `round`, but is not": (boundary.norm(dim=-1) / size - 1).abs()
        * float(shape.round),
        "`size` is smaller than it is": (boundary.norm(dim=-1).max() - size)[None] / size,
    }
    for fault, error in faults.items():
        worst = float(error.max())
        if not worst <= ALIKE:
            raise ValueError(
                f"the shape of `{where}` ({type(shape).__name__}) cannot be used: {fault} (off by "
                f"{worst:.2g})"
            )


def check_points(rig: Any) -> None:
    """Raises `ValueError` for a slip law that does not take several contact points at once."""
    several = torch.ones(3, dtype=torch.float64)
    for name, contact in rig.contacts.items():
        slip_rates(name, contact.law.friction, several, several, 1.0)


def tried() -> tuple[Tensor, Tensor]:
    """Efforts and normal forces [N] at which a slip law is tried."""
    every = (torch.tensor(x).double() for x in (EFFORTS, NORMALS))
    E, F_N = torch.meshgrid(*every, indexing="ij")
    return E.flatten(), F_N.flatten()


def check_slip(where: str, law: Any, R: float) -> str:
    """Fault of a slip law at some efforts and normal forces, with the dashpot R [N.s/m]; empty
    where there is none.

    A slip that takes more than the effort, R gamma' > E, supplies power; one that leaves some of it
    at F_N = 0 makes friction jump at touch-down; one that is not decided by F_N and by the effort
    that it leaves, E - R gamma', depends on the length of steps, which a stage adds to R. Raises
    `ValueError` for a function that is no law of three tensors, gives no number, or gives several
    points at once other rates than each alone.
    """
    E, F_N = tried()
    together, alone = (
        slip_rates(where, law, E, F_N, R),
        torch.stack([slip_rates(where, law, e, f, R) for e, f in zip(E, F_N)]),
    )
    if bool(alone.isnan().any()):
        k = int(alone.isnan().int().argmax())
        raise ValueError(
            f"the slip law of `{where}` gives nan at an effort of {E[k]:g} N, a normal force of "
            f"{F_N[k]:g} N and a dashpot of {R:.3g} N.s/m; make it finite there"
        )
    if not torch.allclose(together, alone, rtol=ALIKE_POINTS, atol=0.0):
        raise ValueError(
            f"the slip law of `{where}` gives other rates for several points together than for "
            "each alone; a law describes one point, so it must not use the number of points "
            "(numel, shape, len) or mix them"
        )
    wrong = torch.nonzero((R * alone < 0) | (R * alone > E * (1 + 1e-9)))[:, 0]
    if len(wrong):
        k = int(wrong[0])
        return (
            f"the slip law of `{where}` gives {alone[k]:.3g} m/s at an effort of {E[k]:g} N and a "
            f"normal force of {F_N[k]:g} N: times the dashpot, {R:.3g} N.s/m, that must be from 0 "
            "to the effort, or slip supplies power"
        )
    left = E - R * alone
    loose = torch.nonzero((F_N == 0.0) & (left > ALIKE * E))[:, 0]
    if len(loose):
        k = int(loose[0])
        return (
            f"the slip law of `{where}` leaves {left[k]:.3g} N of an effort of {E[k]:g} N "
            "where nothing presses, so that friction jumps at touch-down and exceeds mu F_N under "
            "light loads; divide by R alone, or make a viscosity proportional to F_N"
        )
    same = slip_rates(where, law, E + R * alone, F_N, 2 * R)
    if len(others := torch.nonzero((same - alone).abs() > ALIKE * alone)[:, 0]):
        k = int(others[0])
        return (
            f"the slip law of `{where}` gives {alone[k]:.6g} m/s at an effort of {E[k]:g} N, a "
            f"normal force of {F_N[k]:g} N and a dashpot of {R:.3g} N.s/m, and {same[k]:.6g} m/s "
            "where a dashpot twice as large leaves the same effort, so that friction depends on "
            "the length of steps and gradients of forces are off; let friction be a function of "
            "the normal force, or of the slip rate"
        )
    return ""


@torch.no_grad()
def slip_rates(where: str, law: Any, E: Tensor, F_N: Tensor, R: float) -> Tensor:
    """Slip rates [m/s] of efforts and normal forces (...). Raises `ValueError` for a law that gives
    no such tensor."""
    try:
        rate, _ = slip_of(law, E, F_N, torch.tensor(R, dtype=torch.float64))
    except Exception as error:  # any error of user code
        raise ValueError(
            f"the slip law of `{where}` must take three tensors (effort, normal force, dashpot) "
            f"and give the slip rate, but {type(error).__name__}: {error}"
        ) from error
    if not isinstance(rate, Tensor) or rate.shape != E.shape:
        given = f"shape {tuple(rate.shape)}" if isinstance(rate, Tensor) else type(rate).__name__
        raise ValueError(
            f"the slip law of `{where}` must give a tensor of shape {tuple(E.shape)}, but gives "
            f"{given}"
        )
    return rate


class Backwards:
    """Watch of a rig's right-hand side: warns once where a solver integrates it backwards, as
    torchdiffeq's explicit methods do through decreasing times and in `odeint_adjoint`: pads decay,
    and backwards they grow."""

    def __init__(self) -> None:
        self.last, self.falls, self.said = -math.inf, 0, False

    def see(self, t: Tensor | float) -> None:
        """An evaluation at a time [s]."""
        if self.said:
            return
        if isinstance(t, Tensor):
            if t.ndim or is_functorch_wrapped_tensor(t):
                return
            t = t.item()
        self.falls = self.falls + 1 if t < self.last else self.falls if t == self.last else 0
        self.last = t
        if self.falls >= FALLS:
            self.said = True
            warn(
                "the rig is integrated backwards, where its stiff pads grow: states at decreasing "
                "times, and gradients of `odeint_adjoint` with an explicit method, may be wrong by "
                'any factor; use increasing times and method="sdirk2" (after '
                "`torchsoft.register_method()`), or `torchsoft.simulate`",
            )
