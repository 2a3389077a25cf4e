"""A rig put together by hand, the names of its parameters, its bodies, loops and states."""

import pytest
import torch
from conftest import COARSE, PAPER, coarse, f64, grasped, still, turning

from torchsoft import Body, Circle, Ellipse, Rig, hold

# names
# ----------------------------------------------------------------------


def test_parameters_have_the_names_of_the_file():
    """Every number of the file that is a module's parameter, read back where it is, by its full
    name and by its short one."""
    model, file = coarse(), PAPER.override(COARSE)
    own = {name: p for name, p in model.named_parameters() if p.ndim == 0 and p.requires_grad}
    names = {full: name for full, name in model.names.items() if name in own}
    table = file.table()
    assert {
        table[full]["value"] - model.parameter(full).item() for full in names.keys() & table.keys()
    } == {0.0}
    assert {name for name in own if name not in names.values()} <= table.keys() | {
        "bodies.disc.inertia_ratio"
    }
    for full, name in names.items():
        assert model.parameter(full) is model.parameter(name) is model.get_parameter(name)
    shorts = {short: full for short, full in model.short.items() if "." in short}
    assert len(shorts) == 18
    for short, full in shorts.items():
        assert model.parameter(short) is model.parameter(full)
    sharp = still({"laws.steel_on_rubber.friction": {"kind": "coulomb", "mu_s": 0.8, "mu_k": 0.7}})
    with pytest.raises(ValueError, match=r"`contact.v_s` is not a parameter"):
        sharp.parameter("contact.v_s")


def test_a_change_keeps_short_names_of_entries_that_are_there_by_default():
    """And drops those of entries that are gone."""
    file = PAPER.override({"pad.elements_x": 60})
    assert file.names == PAPER.names
    assert file.override({"pad.inertial": True}).pads["L"].inertial
    friction = {"kind": "coulomb", "mu_s": 0.8, "mu_k": 0.7}
    other = file.override({"laws.steel_on_rubber.friction": friction})
    assert file.names.keys() - other.names.keys() == {"contact.v_s"}


# bodies, loops and states
# ----------------------------------------------------------------------


@torch.no_grad()
def test_the_papers_controllers():
    """Eq. 31-34: the horizontal loop measures the disc, the vertical one the bracket, and both push
    the bracket."""
    model = coarse()
    state = model.unpack(grasped(model, (0.02, -0.01)))
    state = state._replace(
        pose=state.pose | {"bracket": state.pose["bracket"] + f64(1e-3, 2e-3, 0.0)}
    )
    t = f64(0.0)[0]
    signals = model.follow(t)
    F_x, F_y = (float(model.actuator_effort(name, state, signals)) for name in "xy")
    x_d, y_d, F_ff = (float(model.reference[name](t)[0]) for name in ("x_d", "y_d", "F_ff"))
    x, y = float(state.pose["disc"][0]), float(state.pose["bracket"][1])
    assert F_x == pytest.approx(1.2e5 * (x_d - x) - 441.7149 * 0.02, rel=1e-13)
    assert F_y == pytest.approx(1.2e5 * (y_d - y) + F_ff, rel=1e-13)


def test_bodies_know_their_inertia():
    assert Body(2.0, Circle(0.1)).inertia.item() == pytest.approx(0.5 * 2.0 * 0.01, rel=1e-15)
    assert Body(2.0, Ellipse(0.3, 0.1)).inertia.item() == pytest.approx(
        0.25 * 2.0 * (0.09 + 0.01), rel=1e-15
    )
    assert Body(2.0, Circle(0.1), inertia=0.7).inertia.item() == 0.7
    radius = Body(2.0, Circle(0.1))
    (slope,) = torch.autograd.grad(radius.inertia, radius.shape.radius)
    assert float(slope) == pytest.approx(2.0 * 0.1, rel=1e-15)


def test_sizes_of_the_papers_rig():
    """61 surface nodes a pad: forces and stretches, five free coordinates and their rates."""
    layout = coarse().layout
    assert layout.size == 2 * (2 * 61 + 61) + 2 * 5
    assert layout.blocks["pads", "L"].shape == (1, 61, 2)
    assert layout.free == {"disc": [0, 1, 2], "bracket": [0, 1]}
    inertial = coarse(pad__inertial=True).layout.blocks
    shapes = [inertial[field, "U"].shape for field in ("pads", "rates")]
    assert shapes == [(122, 2)] * 2  # two elements high, the base held
    assert turning().layout.size == layout.size + 2


def test_what_is_not_free_is_filled_in():
    """A driven coordinate comes from its signal at t, a fixed one from its number; neither is in
    the vector."""
    rig = Rig(
        bodies={"a": Body(1.0, Circle(0.01), x="driven", y=0.25), "b": Body(1.0, theta=0.1)},
        pads={}, contacts={}, reference=hold(**{"a.x": 0.7}),
    )  # fmt: skip
    assert rig.signals == ("a.x",)
    assert rig.layout.size == 2 * (1 + 2)
    state = rig.unpack(f64(0.5, 3.0, 4.0, 0.05, 0.3, 0.4))
    assert state.pose["a"].tolist() == [0.7, 0.25, 0.5]
    assert state.pose["b"].tolist() == [3.0, 4.0, 0.1]
    assert state.velocity["a"].tolist() == [0.0, 0.0, 0.05]
    assert state.velocity["b"].tolist() == [0.3, 0.4, 0.0]
    moved = rig.unpack(torch.zeros(6, dtype=torch.float64), f64(0.9, -2.0).reshape(1, 2))
    assert moved.pose["a"].tolist() == [0.9, 0.25, 0.0]
    assert moved.velocity["a"].tolist() == [-2.0, 0.0, 0.0]
