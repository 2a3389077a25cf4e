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
    hold,
    rest,
)  # fmt: skip
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import NAMES

STEP = 1e-5
"""Relative step of the central differences."""


def test_batches_equal_single_states(build: Callable[..., Rig]) -> None:
    """Any leading dimensions; a sample does not depend on its neighbours."""
    rig = build()
    y = torch.stack([random_state(rig, seed) for seed in range(6)]).reshape(2, 3, -1)
    with torch.no_grad():
        together = rig(torch.tensor(0.1, dtype=torch.float64), y)
        alone = torch.stack([rig(0.1, sample) for sample in y.reshape(6, -1)]).reshape(2, 3, -1)
    scale = alone.abs().amax(-1, keepdim=True)
    assert together.shape == y.shape
    assert float(((together - alone) / scale).abs().max()) < 1e-12


def test_gradient_reaches_every_parameter(build: Callable[..., Rig]) -> None:
    """Autograd through forward against central differences, parameter by parameter (the law is smooth at this state)."""
    rig = build()
    rig.requires_grad_(True)
    y = random_state(rig, 5)
    weight = torch.randn(rig.layout.size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad():
        weight /= rig(0.0, y).abs().clamp(min=1e-3)
    (weight * rig(0.0, y)).sum().backward()
    inertial = any(pad.inertial for pad in rig.pads.values())
    for name, parameter in rig.named_parameters():
        if name.endswith(".rho") and not inertial:
            assert parameter.grad is None
            continue
        h = STEP * (1e-2 if name.endswith("radius") else 1.0) * max(abs(float(parameter.detach().flatten()[0])), 1e-3)
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter += sign * h
                values.append(float((weight * rig(0.0, y)).sum()))
                parameter -= sign * h
        expected = (values[0] - values[1]) / (2 * h)
        assert parameter.grad is not None, name
        got = float(parameter.grad.flatten()[0])
        assert got == pytest.approx(expected, rel=2e-5, abs=1e-8 * max(abs(v) for v in values) / h), name


def test_gradient_reaches_the_state(build: Callable[..., Rig]) -> None:
    rig = build()
    y = random_state(rig, 7).requires_grad_(True)
    direction = random_state(rig, 8).detach() - y.detach()
    rate = rig(0.0, y)
    weight = 1 / rate.detach().abs().clamp(min=1e-3)
    (gradient,) = torch.autograd.grad((weight * rate).sum(), y)
    with torch.no_grad():
        h = 1e-6
        ahead, behind = ((weight * rig(0.0, y + s * h * direction)).sum() for s in (1, -1))
    assert float(gradient @ direction) == pytest.approx(float((ahead - behind) / (2 * h)), rel=1e-5)


def test_rest_is_an_equilibrium_of_forward(fidelity: str) -> None:
    """At rest nothing accelerates; gravity is what a kilogram feels otherwise, 9.81."""
    model = coarse(pad__fidelity=fidelity)
    y = rest(model).detach()
    model.reference = hold(x_d=0.06, y_d=float(model.unpack(y).pose["bracket"][1]), F_ff=0.0)
    with torch.no_grad():
        rate = model.unpack(model(0.0, y))
    assert max(float(v.abs().max()) for v in rate.velocity.values()) < 1e-8


def test_state_dict_round_trip() -> None:
    model, other = coarse(), coarse(contact__K_n=2e5)
    other.load_state_dict(model.state_dict())
    y = random_state(model, 1)
    with torch.no_grad():
        assert torch.equal(model(0.0, y), other(0.0, y))
    assert isinstance(other, SoftGrasp)


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


def test_an_inertial_pad_on_a_base_that_turns_is_refused() -> None:
    with pytest.raises(NotImplementedError, match="pad `P` is inertial and its base `hand` may turn"):
        small(
            bodies=lambda m, r, c: {"hand": Body(0.4, inertia=1e-3)},
            pads=lambda m, r, c: {"P": Pad(m, r, base="hand", inertial=True)},
        )


def test_a_signal_that_is_not_there_is_named() -> None:
    rig = small(actuators=lambda m, r, c: {"a": Actuator("disc.x", "disc.x", PD(1.0, 1.0), setpoint="w")})
    with pytest.raises(ValueError, match="the reference has no signal `w`; it has none"):
        rig(0.0, torch.zeros(rig.layout.size, dtype=torch.float64))
