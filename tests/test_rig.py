"""A rig as an ODE's right-hand side: batches, gradients, names, and what cannot be put together."""

from collections.abc import Callable

import pytest
import torch
from conftest import coarse, random_state

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Rig,
    RoundedBox,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
)  # fmt: skip
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import NAMES


def test_a_rig_of_lists_is_the_papers() -> None:
    """The same parts put together by hand have the same right-hand side."""
    model, p = coarse(), coarse().settings
    rubber = KelvinVoigt(p.pad.E, p.pad.nu, p.pad.rho, p.pad.tau, p.pad.depth)
    c, k = p.contact, p.control
    law = SoftContact(c.K_n, c.R_n, c.K_t, c.R_t, friction=SmoothSlip(c.mu_s, c.mu_k, c.v_s, c.eta))
    mesh = PadMesh(p.pad.length, p.pad.height, p.pad.elements_x, p.pad.elements_y)
    rig = Rig(
        bodies={"disc": Body(p.disc.mass, Circle(p.disc.radius)), "bracket": Body(p.bracket.mass, theta=0.0, weighted=False)},
        pads={"L": Pad(mesh, rubber),
              "U": Pad(mesh, rubber, base="bracket", origin=(-p.pad.length / 2, -p.bracket.cm_height), mirrored=True)},
        contacts={"U": Contact("U", "disc", law), "L": Contact("L", "disc", law)},
        actuators={"x": Actuator("disc.x", "bracket.x", PD(k.K_81, k.R_80), setpoint="x_d"),
                   "y": Actuator("bracket.y", "bracket.y", PD(k.K_98, k.R_99), setpoint="y_d", feed_forward="F_ff")},
        reference=model.reference,
    )  # fmt: skip
    y = random_state(model, 4)
    with torch.no_grad():
        assert torch.equal(rig(0.0, y), model(0.0, y))


# names --------------------------------------------------------------------------------------------------------------


def test_the_radius_of_a_box_is_not_the_discs() -> None:
    """A box has a radius, too, that of its corners: it must not be read as the object's."""
    model = SoftGrasp(shape=RoundedBox(20e-3, 19e-3, radius=5e-3))
    assert model.settings.compression == Parameters().compression
    with pytest.raises(ValueError, match=r"`disc\.radius` is not a parameter"):
        model.parameter("disc.radius")
    said = model.description()["parameters"]
    assert "disc.radius" not in said
    assert said["disc.shape.radius"] == 5e-3


def test_parameters_have_the_names_of_the_settings() -> None:
    """Every number of `Parameters` that is a module's parameter, read back where it is."""
    model = coarse()
    table = model.settings.table()
    assert {name for name in NAMES if table[name]["value"] != model.parameter(name).item()} == set()
    own = {own for own, p in model.named_parameters() if p.ndim == 0 and p.requires_grad}
    assert own == {NAMES[name] for name in NAMES} - {NAMES["contact.epsilon"]}
    for name, module_name in NAMES.items():
        assert model.parameter(name) is model.parameter(module_name) is model.get_parameter(module_name)
    with pytest.raises(ValueError, match=r"`pad.Young` is not a parameter of this rig; known: .*pad\.E"):
        model.parameter("pad.Young")
    rolling = SoftGrasp(Parameters().override({"contact.friction": "coulomb"}))
    with pytest.raises(ValueError, match=r"`contact.v_s` is not a parameter"):
        rolling.parameter("contact.v_s")


def small(**changes: object) -> Rig:
    """A disc on a pad on the ground."""
    mesh, rubber = PadMesh(0.04, 4e-3, 8, 2), KelvinVoigt(7e5, 0.45, 1100.0, 0.01, 0.044)
    law = SoftContact(1e5, 400.0, 1e5, 400.0, friction=SmoothSlip(0.8, 0.7, 0.05, 10.0))
    parts: dict[str, dict[str, torch.nn.Module]] = {
        "bodies": {"disc": Body(0.4, Circle(0.02))}, "pads": {"P": Pad(mesh, rubber)},
        "contacts": {"c": Contact("P", "disc", law)}, "actuators": {},
    }  # fmt: skip
    for name, change in changes.items():
        parts[name] |= change(mesh, rubber, law)  # pyright: ignore[reportCallIssue]
    return Rig(**parts)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        (
            {"pads": lambda m, r, c: {"P": Pad(m, r, base="hand")}},
            "pad `P` is bonded to `hand`, but the bodies are disc",
        ),
        ({"pads": lambda m, r, c: {"P": Pad(m, r, base="disc")}}, "is bonded to the body `disc` itself"),
        (
            {"contacts": lambda m, r, c: {"d": Contact("Q", "disc", c)}},
            "contact `d` is between `Q` and `disc`, which are not",
        ),
        (
            {"contacts": lambda m, r, c: {"d": Contact("P", "dish", c)}},
            "contact `d` is between `P` and `dish`, which are not",
        ),
        (
            {"contacts": lambda m, r, c: {"d": Contact("P", "disc", c)}},
            r"contacts\.d: it is between the same pad and body as `c`; leave one out",
        ),
        (
            {"bodies": lambda m, r, c: {"disc": Body(0.4, theta=0.0)}},
            "contact `c` needs a shape, but the body `disc` has none",
        ),
        (
            {"actuators": lambda m, r, c: {"a": Actuator("disc.x", "disc.up", PD(1.0, 1.0), setpoint="w")}},
            r"actuator `a` speaks of `disc\.up`, which is not a coordinate; there are disc\.x, disc\.y, disc\.theta",
        ),
    ],
)
def test_names_that_do_not_fit_are_refused(changes: dict[str, Callable[..., object]], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        small(**changes)
    assert small().layout.size == 9 * 3 + 6


def test_a_signal_that_is_not_there_is_named() -> None:
    rig = small(actuators=lambda m, r, c: {"a": Actuator("disc.x", "disc.x", PD(1.0, 1.0), setpoint="w")})
    with pytest.raises(ValueError, match="the reference has no signal `w`; it has none"):
        rig(0.0, torch.zeros(rig.layout.size, dtype=torch.float64))
