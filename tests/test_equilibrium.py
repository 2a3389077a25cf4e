"""Static equilibria: forces in balance, symmetry, derivatives by the implicit function theorem, and
refusals."""

import pytest
import torch
from conftest import PAPER, f64, holding_force, press, rest
from conftest import coarse as build
from torch import Tensor

from torchsoft import NoEquilibrium, Rig
from torchsoft.physics.multibond import net_efforts

GRASP = 48.6e-3
"""y_Br in the grasp [m]."""

BALANCE = 1e-9
"""Of forces, relative to the weight: residuals are below 1e-13 m, against springs of 1e5 N/m."""


def contact_force(model: Rig, y: Tensor, which: str) -> Tensor:
    """Force of one pad's contact on the disc (2,) [N], by the multibond graph and not by the
    equilibrium solver."""
    port = model.evaluate(0.0, model.unpack(y)).ports[f"contact_{which}"]
    return net_efforts({"contact": port}, model.junctions)["disc"][0]


@pytest.mark.parametrize("fidelity", ["massless", "inertial"])
@pytest.mark.parametrize("at", ["rest", "grasp"])
@torch.no_grad()
def test_nothing_but_the_bracket_accelerates(fidelity, at):
    model = build(pad__inertial=fidelity == "inertial")
    y = rest(model) if at == "rest" else press(model, GRASP)
    rate = model.unpack(model(0.0, y))
    gravity = float(model.gravity)
    assert float(rate.velocity["disc"][:2].abs().max()) < BALANCE * gravity
    assert float(rate.velocity["disc"][2].abs()) < BALANCE * gravity / float(
        model.parameter("disc.radius")
    )
    creep = 1e-12 / float(model.pad.tau)  # [m/s]: residual over tau
    for name, pad in model.pads.items():
        u_dot = rate.pads[name] if pad.inertial else model.displacement(name, rate)
        assert float(u_dot.abs().max()) < creep
        if pad.inertial:
            assert float((rate.rates[name] * pad.masses()[:, None]).abs().max()) < 1e-7  # [N]
    if at == "rest":  # hangs just clear of the disc, on its loop
        assert float(rate.velocity["bracket"][0].abs()) < 1e-9


@torch.no_grad()
def test_at_rest_the_upper_pad_just_touches_the_disc():
    model = build()
    state = model.unpack(rest(model))
    g = model.penetration("U", state)
    assert float(g.max().abs()) < 1e-15
    assert int((g > -1e-9).sum()) == 1
    assert float(state.pose["bracket"][0]) == float(state.pose["disc"][0]) == PAPER.scenario.x_C0
    assert float(state.pose["disc"][2]) == 0.0


@torch.no_grad()
@pytest.mark.parametrize("x_C0", [58.1e-3, 59.4e-3, 59.7e-3, 60.1e-3, 60.7e-3, 61e-3])
def test_a_weightless_disc_between_nodes_rests_on_them(x_C0):
    model = build(scenario__gravity=0.0, scenario__x_C0=x_C0)
    state = model.unpack(rest(model))
    assert abs(float(model.penetration("L", state).max())) <= 1e-15
    assert float(model.displacement("L", state).abs().max()) < 1e-12


@torch.no_grad()
def test_fidelities_agree():
    massless, inertial = (build(pad__fidelity=kind) for kind in ("massless", "inertial"))
    one, other = massless.unpack(press(massless, GRASP)), inertial.unpack(press(inertial, GRASP))
    assert float((one.pose["disc"] - other.pose["disc"]).abs().max()) < 1e-13
    u = massless.displacement("U", one)
    assert float((u - other.pads["U"][inertial.pads["U"].surface]).abs().max()) < 1e-13


# derivatives
# ----------------------------------------------------------------------

PARAMETERS = ("pad.E", "pad.nu", "pad.depth", "contact.K_n", "disc.radius", "disc.mass")


def outcome(model: Rig, at: str) -> Tensor:
    """Disc and bracket height, a surface displacement, and the force on the disc from below: in um
    and N."""
    y = rest(model) if at == "rest" else press(model, GRASP)
    state = model.unpack(y)
    u = model.displacement("L", state)
    middle = len(u) // 2
    lengths = torch.stack(
        (state.pose["disc"][1], state.pose["bracket"][1], u[middle, 1], u[middle + 2, 0])
    )
    return torch.cat((1e6 * lengths, contact_force(model, y, "L")[1:]))


@pytest.mark.parametrize("at", ["rest", "grasp"])
def test_derivatives_by_autograd_are_those_by_differences(at):
    """Along one direction in which every parameter counts."""
    model = build()
    leaves = [model.parameter(name) for name in PARAMETERS]
    ask = lambda row: torch.autograd.grad(row, leaves, retain_graph=True, materialize_grads=True)
    by = torch.stack([torch.stack(ask(row)) for row in outcome(model, at)])
    values = torch.stack(leaves).detach()
    ways = values * f64(1.0, -1.1, 1.2, -1.3, 1.4, -1.5)
    assert float((by * values).abs().amax(0).min()) > 0.1

    @torch.no_grad()
    def moved(h: float) -> Tensor:
        for leaf, value in zip(leaves, values + h * ways):
            leaf.copy_(value)
        return outcome(model, at)

    wide, narrow = ((moved(h) - moved(-h)) / (2 * h) for h in (1e-4, 5e-5))
    exact, differences = by @ ways, (4 * narrow - wide) / 3
    # measured: 1e-8 and 7e-7 (um, N), the residuals of 1e-13 m divided by the step
    assert torch.allclose(exact, differences, rtol=1e-7, atol=5e-6)


# refusals
# ----------------------------------------------------------------------


def test_a_bracket_above_the_sunken_disc_is_refused():
    model = build()
    with torch.no_grad():
        touching = float(model.unpack(rest(model)).pose["bracket"][1])
    p = PAPER
    assert (
        touching < 2 * (p.pad.height + p.disc.radius) + p.bracket.cm_height - 5e-5
    )  # it sinks by 0.1 mm
    with pytest.raises(NoEquilibrium, match="too high"):
        press(model, touching + 1e-6)
    with torch.no_grad():
        force = -float(contact_force(model, press(model, touching - 1e-6), "U")[1])
    assert (
        0 < force < 0.24
    )  # the middle node's spring of 0.24 N/um, in series with the pads: measured 0.018 N


def test_no_equilibrium_is_reported_when_newton_does_not_converge(
    monkeypatch,
):
    monkeypatch.setattr("torchsoft.physics.statics.ITERATIONS", 2)
    with pytest.raises(NoEquilibrium, match="no static equilibrium found"):
        press(build(), GRASP)


@pytest.mark.parametrize("fidelity", ["massless", "inertial"])
def test_holding_force_is_what_the_upper_contact_presses_with(fidelity):
    model = build(pad__inertial=fidelity == "inertial")
    y = press(model, GRASP)
    assert holding_force(model, y) == pytest.approx(
        -float(contact_force(model, y, "U")[1].detach()), rel=1e-9
    )
