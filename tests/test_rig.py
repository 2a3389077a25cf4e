"""A rig as an ODE's right-hand side: batches, gradients, names, and what cannot be put together."""

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
