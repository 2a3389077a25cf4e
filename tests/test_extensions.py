"""Extensions of a rig: neutral until they are moved, named like its own parameters, and unknowns of
an identification."""

from copy import deepcopy

import pytest
from conftest import COARSE, paper, rest, still, times

from torchsoft import simulate
from torchsoft.physics.extensions import extend, extensions
from torchsoft.rigs.build import RigFile
from torchsoft.sysid import Known, Problem, Recording, Sensor, Unknown

MODEL = still(COARSE)
POWER = "laws.steel_on_rubber.power"
NAMES = tuple(extensions(MODEL))


def test_what_a_rig_may_be_extended_by():
    assert NAMES == (
        "pads.L.E_ratio", "pads.L.tau_ratio", "pads.U.E_ratio", "pads.U.tau_ratio",
        "materials.rubber.slow(0.1 s)", "materials.rubber.slow(1 s)", POWER,
        "guides.bracket.x.friction", "guides.bracket.x.damping", "guides.bracket.y.friction",
        "guides.bracket.y.damping", "gravity_tilt",
    )  # fmt: skip


@pytest.mark.parametrize("slow", ["materials.rubber.slow(0.1 s)", "materials.rubber.slow(1 s)"])
def test_neutral_extensions_change_nothing(slow):
    """All of them at once; of slow branches a pad has one."""
    built = paper(COARSE)
    model, before = built.rig, built.run(times(0.3, 31))
    names = [name for name in NAMES if name == slow or ".slow(" not in name]
    extend(model, names)
    after = simulate(model, before.t, y0=built.start(), knots=before.knots)
    for channel in ("x_C", "y_C", "theta", "F_x", "F_y"):
        moved = (after[channel] - before[channel]).abs().max()
        assert float(moved) <= 1e-8 * float(before[channel].abs().max() + 1e-3), channel
    for name in names:
        assert model.parameter(name).item() == extensions(MODEL)[name].neutral
    assert not extensions(model)


def test_parts_that_are_shared_are_extended_once():
    model = deepcopy(MODEL)
    extend(model, [POWER, "materials.rubber.slow(1 s)", "gravity_tilt"])
    assert model.contacts["L"].law.power is model.contacts["U"].law.power
    assert model.pads["L"].branches == model.pads["U"].branches == 2
    assert not any(".slow(" in name for name in extensions(model))
    assert model.quantity(POWER) is not None
    extend(model, [POWER])  # is there already
    with pytest.raises(ValueError, match=r"`contact.colour` is not a parameter of this rig"):
        extend(model, ["contact.colour"])


def test_names_are_those_of_a_rig_file():
    rig = RigFile.ready("two_fingers").assemble()
    groups = {name.partition(".")[0] for name in extensions(rig)}
    assert groups == {"materials", "laws", "pads", "guides", "gravity_tilt"}
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
