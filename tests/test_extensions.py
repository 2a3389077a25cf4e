"""Extensions of a rig: neutral until they are moved, named like its own parameters, and unknowns of
an identification."""

from copy import deepcopy
from dataclasses import replace

import pytest
from conftest import COARSE, paper, rest, still, times

from torchsoft import simulate
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


@pytest.mark.parametrize(("name", "late"), [("actuators.lag", "xy"), ("actuators.y.lag", "y")])
def test_loops_lag_together_or_alone(name, late):
    """Behind laws whose numbers keep their names."""
    model = deepcopy(MODEL)
    extend(model, [name])
    lag = model.parameter(name)
    assert {k for k, one in model.actuators.items() if getattr(one.law, "lag", 0) is lag} == {*late}
    assert model.parameter("actuators.y.Kp") is model.actuators["y"].law.law.Kp


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
    """Both contacts keep the numbers of the law; `test_friction` has the forces."""
    model = deepcopy(MODEL)
    extend(model, ["contacts.U.friction_ratio", POWER])
    law, mine = model.contacts["L"].law, model.contacts["U"].law
    for name in ("K_n", "power", "friction"):
        assert getattr(law, name) is getattr(mine, name)
    assert mine.friction_ratio is model.parameter("contacts.U.friction_ratio")
    assert law.friction_ratio is None
