"""Extensions of a rig: neutral until they are moved, named like its own parameters, and unknowns of
an identification."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from conftest import COARSE, paper, rest, still, times

from torchsoft import simulate
from torchsoft.rigs.build import RigFile
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown
from torchsoft.sysid.extensions import extend, extensions

MODEL = still(COARSE)
POWER = "laws.steel_on_rubber.power"
AGEING = "laws.steel_on_rubber.friction.ageing"
NAMES = tuple(extensions(MODEL))


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
    extend(model, [POWER, AGEING, "materials.rubber.slow(1 s)", "gravity_tilt"])
    for part in ("power", "friction"):
        lower, upper = (getattr(model.contacts[name].law, part) for name in "LU")
        assert lower is upper
    assert model.pads["L"].branches == model.pads["U"].branches == 2
    assert model.quantity(POWER) is not None
    extend(model, [POWER])  # is there already
    with pytest.raises(ValueError, match=r"`contact.colour` is not a parameter of this rig"):
        extend(model, ["contact.colour"])


def test_names_are_those_of_a_rig_file():
    rig = RigFile.ready("two_fingers").assemble()
    names = [name for name in extensions(rig) if name.endswith(".power")]
    assert all(name.startswith("laws.") for name in names)
    extend(rig, names)
    assert [rig.parameter(name).item() for name in names] == [1.0] * len(names)


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
