"""Extensions of a rig: numbers that its model holds at a neutral value, without a parameter for
them until one is added.

With all of them at their neutral values a rig moves as it did before. An identification takes them
for granted; each may be one of its unknowns.
"""

from collections.abc import Callable, Collection, Iterator
from copy import copy
from functools import partial
from typing import NamedTuple, TypeVar

from torch import nn

from torchsoft.physics.ageing import AgeingSlip
from torchsoft.physics.contact import REFERENCE_DEPTH, SmoothSlip, SoftContact
from torchsoft.physics.material import Branch, Material
from torchsoft.physics.parts import PD, Actuator, Guide, Lagging, Tilt
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import parameter

M = TypeVar("M", bound=nn.Module)

FASTER, SLOWER = 0.01, (10.0, 100.0)
"""Retardation time of a fast branch over the shortest one of the material, and those of slow
branches over the longest."""


class Extension(NamedTuple):
    """A number that may be added: its `neutral` value, the `amount` of a variation and the interval
    of a search [`unit`], clauses for the neutral value and for any other, and the function that
    adds the parameter and returns it."""

    neutral: float
    amount: float
    low: float
    high: float
    unit: str
    stated: str
    otherwise: str
    add: Callable[[Rig], nn.Parameter]


def extensions(rig: Rig) -> dict[str, Extension]:
    """Numbers that may be added to a rig, by the name of the parameter."""
    kinds = of_pads, of_materials, of_laws, of_guides, of_controllers, of_gravity
    known = {*rig.names, *(own for own, _ in rig.named_parameters())}
    return {name: one for kind in kinds for name, one in kind(rig) if name not in known}


Named = Iterator[tuple[str, Extension]]
"""Extensions with the names of their parameters."""


def of_pads(rig: Rig) -> Named:
    """Ratios of pads to their material."""
    for name in rig.pads if len(rig.pads) > 1 else ():
        for ratio, comparison, reach in (
            ("E_ratio", "as stiff", 2.0),
            ("tau_ratio", "as viscous", 4.0),
        ):
            yield f"pads.{name}.{ratio}", Extension(
                1.0, 0.01, 1 / reach, reach, "", f"the pad {name} is {comparison} as its material",
                f"the pad {name} were 1.01 times {comparison} as its material",
                partial(_pad_ratio, name=name, ratio=ratio),
            )  # fmt: skip


def of_materials(rig: Rig) -> Named:
    """Branches of materials, faster and slower than their own."""
    for stem, material in _shared(rig, Material):
        if any(pad.nodal for pad in rig.pads.values() if pad.material is material):
            continue
        own = material.chain()[1].detach()
        branches = {"fast": [FASTER * float(own.min())]}
        branches["slow"] = [factor * float(own.max()) for factor in SLOWER]
        for kind, time in ((kind, time) for kind, times in branches.items() for time in times):
            yield f"{stem}.{kind}({time:.3g} s)", Extension(
                0.0, 0.01, 0.0, 0.5, "", f"{stem} has no {kind}er branch",
                f"0.01 of the compliance of {stem} set in over {time:.3g} s",
                partial(_branch, stem=stem, time=time),
            )  # fmt: skip


def of_laws(rig: Rig) -> Named:
    """Laws of contacts, and friction of single contacts that share one."""
    laws = list[SoftContact]()
    for stem, law in _shared(rig, SoftContact):
        if any(same_law(law, one) for one in laws):
            continue
        laws.append(law)
        yield f"{stem}.power", Extension(
            1.0, 0.01, 0.6, 2.5, "", f"the penalty force of {stem} is linear in the depth",
            f"it grew with the depth to the power 1.01, the same at {REFERENCE_DEPTH:g} m",
            partial(_of_law, stem=stem, name="power", neutral=1.0),
        )  # fmt: skip
        yield f"{stem}.adhesion", Extension(
            0.0, 1e-3, 0.0, 1.0, "N", f"{stem} does not adhere",
            f"a point that touches adhered with 0.001 N per {1e3 * law.node_spacing:g} mm",
            partial(_of_law, stem=stem, name="adhesion", neutral=0.0),
        )  # fmt: skip
        for key in law.matched:
            value = float(getattr(law, key).detach())
            yield f"{stem}.{key}", Extension(
                value, 0.01 * value, 0.01 * value, 100.0 * value, "N/m" if "K" in key else "N.s/m",
                f"{key} of {stem} is matched to the pads", f"it were {1.01 * value:.6g}",
                partial(_of_law, stem=stem, name=key, neutral=value),
            )  # fmt: skip
        friction = law.friction  # of this class, and none that a user derives from it
        if type(friction) is SmoothSlip and friction.R_pad is None:
            yield f"{stem}.friction.ageing", Extension(
                0.0, 2e-3, 0.0, 0.5, "", f"friction of {stem} does not age",
                "static friction grew by 0.002 for every factor e of the time at rest",
                partial(_ageing, stem=stem),
            )  # fmt: skip
        users = [name for name, one in rig.contacts.items() if same_law(one.law, law)]
        for name in users if len(users) > 1 else ():
            yield f"contacts.{name}.friction_ratio", Extension(
                1.0, 0.01, 0.2, 5.0, "", f"friction of the contact {name} is that of its law",
                f"friction of the contact {name} were 1.01 times that of its law",
                partial(_friction_ratio, name=name),
            )  # fmt: skip


def of_guides(rig: Rig) -> Named:
    """Friction and damping of guides."""
    for coordinate in _guided(rig):
        turns = coordinate.endswith(".theta")
        for kind, size, most in (("friction", 0.1, 50.0), ("damping", 1.0, 500.0)):
            unit = ("N.m" if turns else "N") + (
                "" if kind == "friction" else ".s/rad" if turns else ".s/m"
            )
            part = 0.02 if turns else 1.0  # m: of the arm at which a guide acts
            yield f"guides.{coordinate}.{kind}", Extension(
                0.0, part * size, 0.0, part * most, unit, f"{coordinate} has no {kind}",
                f"its guide had a {kind} of {part * size:g} {unit}",
                partial(_guide, coordinate=coordinate, kind=kind),
            )  # fmt: skip


def of_controllers(rig: Rig) -> Named:
    """Lags of controllers."""
    loops = [name for name, one in rig.actuators.items() if isinstance(undelayed(one), PD)]
    several = {"actuators": loops} if len(loops) > 1 else {}
    for stem, names in (several | {f"actuators.{name}": [name] for name in loops}).items():
        who = "controllers push" if len(names) > 1 else f"the controller {names[0]} pushes"
        yield f"{stem}.lag", Extension(
            0.0, 1e-4, 0.0, 0.02, "s", f"{who} without delay",
            "it came late, by a lag, a delay or half the period of a hold",
            partial(_lag, names=names),
        )  # fmt: skip


def of_gravity(rig: Rig) -> Named:
    """Direction of gravity."""
    tilted = [name for name, body in rig.bodies.items() if body.weighted and _free(rig, name, "x")]
    if tilted and rig.gravity.item() > 0:
        yield "gravity_tilt", Extension(
            0.0, 1e-3, -0.2, 0.2, "rad", "gravity acts along -y",
            "it were turned by 1 mrad, anticlockwise", partial(_tilt, bodies=tilted),
        )  # fmt: skip


def extend(rig: Rig, names: Collection[str]) -> None:
    """Add parameters to a rig, at their neutral values, by the names of its `extensions`; those
    that it has are left alone. Raises `ValueError` for a name that is neither."""
    for name in names:
        known = extensions(rig)
        if name in known:
            made = known[name].add(rig)
            own = next(own for own, value in rig.named_parameters() if value is made)
            rig.extended = {**rig.extended, name: own}
        else:
            rig.parameter(name)


def _shared(rig: Rig, kind: type[M]) -> list[tuple[str, M]]:
    """The rig's parts of a kind, each once, with the stem of their parameters' names."""
    aliases = {own: name for name, own in {**rig.aliases, **rig.matched}.items()}
    found = []
    for own, module in rig.named_modules():
        if isinstance(module, kind):
            mine = (f"{own}.{key}" for key in module._parameters)
            name = next((aliases[one] for one in mine if one in aliases), f"{own}.")
            found.append((name.rpartition(".")[0], module))
    return found


def _part(rig: Rig, kind: type[M], stem: str) -> M:
    return next(module for name, module in _shared(rig, kind) if name == stem)


def _free(rig: Rig, body: str, axis: str) -> bool:
    return rig.bodies[body].freedom[axis] == "free"


def _guided(rig: Rig) -> list[str]:
    """Free coordinates that actuators push, other than by resistance of a guide."""
    pushed = [one.pushes for one in rig.actuators.values() if not isinstance(one.law, Guide | Tilt)]
    return [one for one in dict.fromkeys(pushed) if _free(rig, *one.split("."))]


def _added(rig: Rig, name: str, actuator: Actuator) -> None:
    actuators: nn.ModuleDict = rig.actuators  # pyright: ignore[reportAssignmentType]
    actuators[name] = actuator


def _pad_ratio(rig: Rig, name: str, ratio: str) -> nn.Parameter:
    setattr(rig.pads[name], ratio, parameter(1.0))
    return getattr(rig.pads[name], ratio)


def _branch(rig: Rig, stem: str, time: float) -> nn.Parameter:
    branches: nn.ModuleList = _part(rig, Material, stem).added  # pyright: ignore[reportAssignmentType]
    branches.append(branch := Branch(0.0, time))
    return branch.fraction


def same_law(one: SoftContact, other: SoftContact) -> bool:
    """Whether two laws have the same numbers, but for the ratio of friction."""
    parts = [(law._parameters["K_n"], law._modules.get("source")) for law in (one, other)]
    return all(mine is theirs for mine, theirs in zip(*parts))


def _of_law(rig: Rig, stem: str, name: str, neutral: float) -> nn.Parameter:
    law, made = _part(rig, SoftContact, stem), parameter(neutral)
    for contact in rig.contacts.values():
        if same_law(contact.law, law):
            setattr(contact.law, name, made)
    return made


def _ageing(rig: Rig, stem: str) -> nn.Parameter:
    """Put friction that ages in the place of the smooth friction with the same parameters."""
    friction, made = _part(rig, SoftContact, stem).friction, AgeingSlip(1.0, 1.0)
    assert isinstance(friction, SmoothSlip)
    made._parameters.update(friction._parameters)
    for contact in rig.contacts.values():
        if contact.law.friction is friction:
            contact.law.friction = made
    return made.ageing


def _friction_ratio(rig: Rig, name: str) -> nn.Parameter:
    """Give a contact a law of its own, of the same parameters and the same friction."""
    law = copy(rig.contacts[name].law)
    law._parameters, law._modules = dict(law._parameters), dict(law._modules)
    law.friction_ratio = parameter(1.0)
    rig.contacts[name].law = law
    return law.friction_ratio


def _guide(rig: Rig, coordinate: str, kind: str) -> nn.Parameter:
    name = f"guide_{coordinate.replace('.', '_')}"
    if name not in rig.actuators:
        _added(
            rig,
            name,
            Actuator(
                coordinate,
                coordinate,
                Guide(),
                setpoint=(),
                elements=(f"R: guide of {coordinate}",),
            ),
        )
    return getattr(rig.actuators[name].law, kind)


def undelayed(actuator: Actuator) -> object:
    """The law of an actuator without its lags."""
    law: object = actuator.law
    while isinstance(law, Lagging):
        law = law.law
    return law


def _lag(rig: Rig, names: Collection[str]) -> nn.Parameter:
    """Let the efforts of some loops lag, all by one time. Numbers of their laws keep their
    names."""
    lag, known = parameter(0.0), {own: name for name, own in rig.names.items()}
    for name in names:
        actuator, here = rig.actuators[name], f"actuators.{name}.law."
        every = [own for own, _ in rig.named_parameters(remove_duplicate=False)]
        moved = {known.get(own, own): own for own in every if own.startswith(here)}
        moved = {key: own.replace(here, f"{here}law.", 1) for key, own in moved.items()}
        rig.extended = {key: moved.get(key, own) for key, own in rig.extended.items()}
        rig.aliases = {**rig.aliases, **moved}
        law = actuator.law
        assert isinstance(law, nn.Module)
        actuator.law = Lagging(law, 1.0)
        actuator.law.lag = lag
        actuator.elements = tuple(dict.fromkeys((*actuator.elements, "Se: lag")))
    return lag


def _tilt(rig: Rig, bodies: Collection[str]) -> nn.Parameter:
    tilt = parameter(0.0)
    for name in bodies:
        body = rig.bodies[name]
        for axis in ("x", "y"):
            if _free(rig, name, axis):
                law = Tilt(axis, tilt, body.mass, rig.gravity)
                coordinate = f"{name}.{axis}"
                _added(
                    rig,
                    f"tilt_{name}_{axis}",
                    Actuator(coordinate, coordinate, law, setpoint=(), elements=("Se: m g",)),
                )
    return tilt
