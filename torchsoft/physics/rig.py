"""A rig as people use it: its parameters by their names, starts, and what it shows of itself."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from torchsoft.display import Shown, amount, suggestion
from torchsoft.physics.graph import Graph
from torchsoft.physics.namespace import check_unique
from torchsoft.physics.parts import gain_unit, law_name
from torchsoft.physics.start import start
from torchsoft.quantity import Quantity, quantity_of

NUMBERS = ("E", "tau", "K_n", "K_t", "mu_s", "mu_k", "Kp", "Kd", "limit")
"""Parameters of laws that are shown."""


class Rig(Shown, Graph):
    """Rigid bodies, soft pads, contacts between them, and actuators.

    Names are the mappings' keys; contacts are ordered by their pad. Every physical parameter is an
    `nn.Parameter` that gradients reach. `reference` gives the signals that actuators and driven
    coordinates follow; a run may be given another. `symbols` are the suffixes of the bodies'
    channels, the name by default; `groups` are parts that several of the lists share, whose
    parameters are then called by the group's name. `taxels` are arrays of areas that feel the
    forces on pads.

    `forward(t, y)` follows torchdiffeq: y has shape (..., `layout.size`), float64, any batch
    dimensions. Not smooth where a point touches, where the normal force is cut at zero and where a
    point begins to slip; continuous there with smooth laws. Raises `ValueError` for names that do
    not fit together, and `NotImplementedError` for an inertial pad whose base turns, and for one
    that is inertial or at finite strain with several retardation times.
    """

    short: Mapping[str, str] = {}
    """Parameters and channels by their short names; a convenience of typing, in no result."""

    matched: Mapping[str, str] = {}
    """Numbers of laws that follow from the pads ("auto"), by their names in the file: their names
    in the module."""

    tables: Mapping[str, Any] | None = None
    """Tables of the rig file that it was built from, None for a rig with other parts."""

    def check_names(self) -> None:
        super().check_names()
        check_unique(self)

    def state(
        self, bodies: Mapping[str, Mapping[str, Any]] | None = None, /, **more: Mapping[str, Any]
    ) -> Tensor:
        """A start (size,) from coordinates x, y [m] and theta [rad] and rates v_x, v_y, omega of
        the bodies, with massless pads settled around them:
        `rig.state(disc={"x": 0.06, "y": "rest"}, bracket={"x": 0.06, "y": 0.05})`.

        y and theta may be "rest": where the body lies under its weight, the loops open. y may be
        "touch": where the pads bonded to the body, undeformed, come down upon what they touch;
        {"depth": d}: lower than that by d [m]; {"force": F}: where the body is in balance when it
        is pushed down by F [N]. theta and the rates are zero where they are not given.
        Differentiable. Raises `ValueError` for names and coordinates that do not fit,
        `NoEquilibrium` where there is no rest.
        """
        return start(self, {**(bodies or {}), **more})

    def full(self, name: str) -> str:
        """The full name of a parameter or channel."""
        return self.short.get(name, name)

    def parameter(self, name: str) -> Tensor:
        """A parameter by its name, in the module, the rig file or `short`. Raises `ValueError` for
        one that is not there."""
        known, name = dict(self.named_parameters(remove_duplicate=False)), self.full(name)
        found = known.get(self.names.get(name, name), known.get(name))
        if found is None and name in self.matched:
            raise ValueError(
                f'`{name}` is "auto", a function of the parameters of its pads, such as E, and no '
                f"parameter; to change it alone, build the rig with a number: override({{{name!r}: "
                f"{self.matched_value(name):.4g}}})"
            )
        if found is None:
            file_names = {key: other for other, key in self.names.items()}
            names = dict.fromkeys(file_names.get(key, key) for key, _ in self.named_parameters())
            names |= {short: full for short, full in self.short.items() if full in names}
            raise ValueError(
                f"`{name}` is not a parameter of this rig; {suggestion(name, names, 'known:')}"
            )
        return found

    def matched_value(self, name: str) -> float:
        """The present value of a number that follows from the pads."""
        owner, _, key = self.matched[name].rpartition(".")
        return float(getattr(self.get_submodule(owner), key).detach())

    def quantity(self, name: str) -> Quantity | None:
        """Unit, bounds and meaning of a parameter by its name, where its part declares them."""
        name = self.full(name)
        owner, _, last = self.names.get(name, name).rpartition(".")
        part = self.get_submodule(owner)
        found = quantity_of(part, last)
        users = [one for one in self.actuators.values() if part in one.modules()]
        unit = gain_unit(part, last, users) if users else None
        return found if found is None or unit is None else replace(found, unit=unit)

    @property
    def ordered(self) -> dict[str, str]:
        """Parameters that must not exceed another one, with the name of that one."""
        names = {key: name for name, key in self.names.items()}
        pairs = [
            [f"{k}.{one}" for one in m.ordered]
            for k, m in self.named_modules()
            if k and hasattr(m, "ordered")
        ]
        return {names.get(lower, lower): names.get(upper, upper) for lower, upper in pairs}

    def description(self) -> dict[str, Any]:
        """The numbers and laws of the rig as they are now, saved with a run."""
        names, values = {key: name for name, key in self.names.items()}, dict[str, Any]()
        for key, value in self.named_parameters():
            if key.startswith("reference."):
                continue
            owner, behind, last = key.partition(".parametrizations.")
            if behind:  # the value, not what it is made of
                last = last.partition(".")[0]
                key, value = f"{owner}.{last}", getattr(self.get_submodule(owner), last)
            values[names.get(key, key)] = value.detach().tolist()
        values |= {name: self.matched_value(name) for name in self.matched}
        return {
            "parameters": values,
            "friction": {
                name: law_name(contact.law.friction) for name, contact in self.contacts.items()
            },
            "control": {name: law_name(actuator.law) for name, actuator in self.actuators.items()},
            "shape": {
                name: type(body.shape).__name__
                for name, body in self.bodies.items()
                if body.shape is not None
            },
            "material": {name: type(pad.material).__name__ for name, pad in self.pads.items()},
            "mesh": {
                k: f"{type(pad.mesh).__name__}, {len(pad.mesh.nodes)} nodes"
                for k, pad in self.pads.items()
            },
        }

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = []
        for name, body in self.bodies.items():
            kinds: dict[str, list[str]] = {}
            for axis, kind in body.freedom.items():
                kinds.setdefault(kind, []).append(axis)
            freedom = ", ".join(f"{' '.join(axes)} {kind}" for kind, axes in kinds.items())
            shape = "no shape" if body.shape is None else type(body.shape).__name__
            if body.shape is not None:
                shape += f" of radius {amount(body.shape.size(), 'm')}"
            rows.append(
                (f"body {name}", f"{shape}, {amount(float(body.mass.detach()), 'kg')}; {freedom}")
            )
        for name, pad in self.pads.items():
            mesh, material = pad.mesh, pad.material
            sizes = f"{1e3 * mesh.length:g} x {1e3 * mesh.height:g} mm"
            law = self._numbers(f"pads.{name}.material", material)
            rows.append(
                (
                    f"pad {name}",
                    f"{type(mesh).__name__} {sizes}, {len(mesh.elements)} elements, on "
                    f"{pad.base or 'the ground'}, {'inertial' if pad.inertial else 'massless'}; "
                    f"{type(material).__name__} {law}",
                )
            )
        for name, contact in self.contacts.items():
            owner, law = f"contacts.{name}.law", contact.law
            rows.append(
                (
                    f"contact {name}",
                    f"{contact.body} on {contact.pad}; {self._numbers(owner, law)}; "
                    f"{law_name(law.friction)} "
                    f"{self._numbers(f'{owner}.friction', law.friction)}".rstrip(),
                )
            )
        for name, actuator in self.actuators.items():
            follows = ", ".join(f"{at} to {signal}" for at, signal in actuator.follows)
            numbers = (
                self._numbers(f"actuators.{name}.law", actuator.law),
                self._numbers(f"actuators.{name}", actuator),
            )
            law = ", ".join(filter(None, numbers))
            rows.append(
                (
                    f"actuator {name}",
                    f"pushes {actuator.pushes}, brings {follows or ', '.join(actuator.measures)}; "
                    f"{law_name(actuator.law)} {law}".rstrip(),
                )
            )
        rows.append(("reference", ", ".join(self.signals) or "no signals"))
        counts = ", ".join(
            f"{len(parts)} {one if len(parts) == 1 else several}"
            for one, several, parts in (
                ("body", "bodies", self.bodies), ("pad", "pads", self.pads),
                ("contact", "contacts", self.contacts), ("actuator", "actuators", self.actuators),
            )
        )  # fmt: skip
        return f"{type(self).__name__}: {counts}, a state of {self.layout.size} numbers", rows

    def _numbers(self, owner: str, part: object) -> str:
        """Parameters of a part with their units."""
        shown = []
        for name in NUMBERS:
            value = getattr(part, name, None)
            if isinstance(value, Tensor) and not value.ndim:
                quantity = self.quantity(f"{owner}.{name}")
                shown.append(
                    f"{name} {amount(float(value.detach()), quantity.unit if quantity else '')}"
                )
        return ", ".join(shown)
