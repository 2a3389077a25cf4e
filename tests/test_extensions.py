"""Extensions of a rig: neutral until they are moved, named like its own parameters, and unknowns of
an identification."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import COARSE, paper, rest, still, times

from torchsoft import simulate
from torchsoft.physics.contact import Coulomb, SoftContact
from torchsoft.physics.extensions import extend, extensions
from torchsoft.rigs.build import RigFile
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown

MODEL = still(COARSE)
POWER = "laws.steel_on_rubber.power"
NAMES = tuple(extensions(MODEL))


def test_what_a_rig_may_be_extended_by():
    assert NAMES == (
        "pads.L.E_ratio", "pads.L.tau_ratio", "pads.U.E_ratio", "pads.U.tau_ratio",
        "materials.rubber.fast(0.0001 s)", "materials.rubber.slow(0.1 s)",
        "materials.rubber.slow(1 s)", POWER, "laws.steel_on_rubber.adhesion",
            "laws.steel_on_rubber.friction.ageing",
        "contacts.L.friction_ratio", "contacts.U.friction_ratio",
        "guides.bracket.x.friction", "guides.bracket.x.damping", "guides.bracket.y.friction",
        "guides.bracket.y.damping", "actuators.lag", "actuators.x.lag", "actuators.y.lag",
        "gravity_tilt",
    )  # fmt: skip


def test_neutral_extensions_change_nothing():
    """All of them at once, at the ends of steps: between them an effort that may lag is a state,
    and others follow from the coordinates."""
    built = paper(COARSE)
    knots = built.run(times(0.3, 31)).knots
    before = simulate(built.rig, knots, y0=built.start(), knots=knots)
    model = deepcopy(built.rig)
    extend(model, NAMES)
    start = replace(built, rig=model).start()
    after = simulate(model, knots, y0=start, knots=knots)
    for channel in ("x_C", "y_C", "theta", "F_x", "F_y"):
        moved = (after[channel] - before[channel]).abs().max()
        assert float(moved) <= 1e-8 * float(before[channel].abs().max() + 1e-3), channel
    for name in NAMES:
        assert model.parameter(name).item() == extensions(MODEL)[name].neutral
    assert not extensions(model)


def test_parts_that_are_shared_are_extended_once():
    model = deepcopy(MODEL)
    extend(model, [POWER, "materials.rubber.slow(1 s)", "gravity_tilt"])
    assert model.contacts["L"].law.power is model.contacts["U"].law.power
    assert model.pads["L"].branches == model.pads["U"].branches == 2
    assert model.quantity(POWER) is not None
    extend(model, [POWER])  # is there already
    with pytest.raises(ValueError, match=r"`contact.colour` is not a parameter of this rig"):
        extend(model, ["contact.colour"])


def test_names_are_those_of_a_rig_file():
    rig = RigFile.ready("two_fingers").assemble()
    groups = {name.partition(".")[0] for name in extensions(rig)}
    assert groups == {
        "materials", "laws", "contacts", "pads", "guides", "actuators", "gravity_tilt"
    }  # fmt: skip
    names = dict.fromkeys(name for name in extensions(rig) if name.endswith(".power"))
    extend(rig, list(names))
    for name in names:
        assert rig.parameter(name).item() == 1.0


def test_an_extension_may_be_unknown():
    """With the bounds of its own search, or with those that are given."""
    t = times(0.1, 11).numpy()
    recording = Recording("one", deepcopy(MODEL), {"F_y": (t, 0 * t)}, Known(rest(MODEL)))
    unknowns = {
        "guides.bracket.x.friction": Unknown(),
        "pads.U.E_ratio": Unknown(low=0.8, high=1.2),
        "gravity_tilt": Unknown(low=-0.01, high=0.01, scale="linear"),
    }
    problem = Problem([recording], {"F_y": Sensor(noise=0.1)}, unknowns)
    found = {c.name: (c.low, c.nominal, c.high, c.scale) for c in problem.coordinates.all}
    assert found == {
        "guides.bracket.x.friction": (0.0, 0.0, 50.0, "linear"),
        "pads.U.E_ratio": (0.8, 1.0, 1.2, "log"),
        "gravity_tilt": (-0.01, 0.0, 0.01, "linear"),
    }
    assert recording.rig.extended == {}  # the recording's own rig is left alone


def test_the_friction_of_a_contact_differs_from_its_law():
    """Both contacts keep the numbers of the law, and 1.2 of its friction is 1.2 times mu_s and
    mu_k."""
    model, other = deepcopy(MODEL), deepcopy(MODEL)
    extend(model, ["contacts.U.friction_ratio", POWER])
    law, mine = model.contacts["L"].law, model.contacts["U"].law
    assert law.K_n is mine.K_n
    assert law.power is mine.power
    assert law.friction is mine.friction
    with torch.no_grad():
        model.parameter("contacts.U.friction_ratio").fill_(1.2)
        for name in ("mu_s", "mu_k"):
            other.parameter(f"laws.steel_on_rubber.friction.{name}").mul_(1.2)
    g, g_dot, v, s = torch.tensor([1e-4, 0.0, 0.3, 2e-5], dtype=torch.float64)
    assert mine(g, g_dot, v, s).F_T.item() == pytest.approx(
        other.contacts["U"].law(g, g_dot, v, s).F_T.item(), rel=1e-12
    )
    assert law(g, g_dot, v, s).F_T.item() < 0.9 * mine(g, g_dot, v, s).F_T.item()


def test_adhesion_pulls_and_is_stored():
    """A pull of A at any depth far above the one over which it sets in; F_N is the slope of the
    stored energy, and friction follows the compression that adhesion adds to."""
    plain, law = (
        SoftContact(1e5, 0.0, 1e5, 400.0, friction=Coulomb(0.5, 0.5), adhesion=A)
        for A in (None, 0.05)
    )
    g = torch.tensor([1e-5, 1e-4], dtype=torch.float64, requires_grad=True)
    zero = torch.zeros_like(g)
    at, without = (one(g, zero, zero + 0.5, zero) for one in (law, plain))
    np.testing.assert_allclose((without.F_N - at.F_N).detach(), 0.05, rtol=0.1)
    np.testing.assert_allclose(at.F_T.detach(), without.F_T.detach(), rtol=1e-12)
    energy, _ = law.stored(g, zero, torch.ones_like(g))
    (slope,) = torch.autograd.grad(energy.sum(), g)
    np.testing.assert_allclose(slope.detach(), at.F_N.detach(), rtol=1e-9)
    lost = [one.dissipated(x, g, zero + 0.1, 1.0)[0] for one, x in ((law, at), (plain, without))]
    np.testing.assert_allclose(*(one.detach() for one in lost), rtol=1e-9)
