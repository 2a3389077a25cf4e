"""The stepper: order, how runs end, halved steps."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse, grasped, paper, times, towards

from torchsoft import (
    Body,
    Circle,
    Contact,
    Coulomb,
    CurvedPadMesh,
    FingertipMesh,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    RigFile,
    RoundedBox,
    SimulationFailed,
    SoftContact,
    Trajectory,
    simulate,
)
from torchsoft.solve.stepper import ImplicitStepper


@pytest.mark.parametrize("inertial", [False, True])
def test_second_order_on_a_smooth_motion(inertial):
    """A grasped disc set moving so gently that no node slips, touches or leaves."""
    model = coarse(pad__inertial=inertial)
    y0, t = grasped(model, (1e-4, 5e-5)), times(0.032, 2)
    place = lambda h: simulate(model, t, y0=y0, step=h).state.pose["disc"][-1, :2]
    fine = place(3.2e-2 / 1024)
    errors = [float((place(h) - fine).norm()) for h in (2e-3, 1e-3, 5e-4)]
    assert min(np.log2(errors[:2]) - np.log2(errors[1:])) >= 1.8, errors


@pytest.mark.parametrize("step", [3e-3, 4.9e-3, 5e-3])
def test_steps_are_never_longer_than_asked_for(step):
    model = coarse(pad__elements_x=24)
    h = simulate(model, times(0.02, 5), y0=grasped(model), step=step).knots.diff()
    assert h.max() <= step * (1 + 1e-9)
    assert h.min() > 0.5 * step


# how runs end
# ----------------------------------------------------------------------


@pytest.mark.parametrize("states", [{}, {"actuators.y.lag": 1e-4, "actuators.x.Ki": 10.0}])
def test_an_unstable_loop_ends_in_an_error_that_says_so(states):
    """E = 60 kPa, tau = 5 ms with the paper's gains, and controllers with states of their own."""
    built = paper(COARSE | {"pad.E": 6e4, "pad.tau": 5e-3} | states)
    with pytest.raises(SimulationFailed, match=r"lost at t = .*closed loop is unstable") as caught:
        built.run(rtol=1e-3)
    assert 0 < caught.value.time < 1
    assert bool(torch.isfinite(caught.value.trajectory.y).all())


def test_a_disc_rolled_off_the_pad_is_reported():
    model = coarse()
    y0 = grasped(model)
    beyond = towards(model, Profile([0.0, 1.0], [0.06, 0.13]))
    with pytest.raises(SimulationFailed, match=r"`disc` .* reached the end of the pad") as caught:
        simulate(model, times(1.0, 101), y0=y0, reference=beyond)
    run = caught.value.trajectory
    assert len(run.t) == len(run.y) == len(run["x_C"]) < 101
    assert float(run.t[-1]) <= caught.value.time


FAST = {
    "pads.ground.elements_x": 40, "pads.ground.elements_y": 3,
    "bodies.ellipse.shape": {"kind": "circle", "radius": 1e-3},
    "bodies.ellipse.start": {"x": 78e-3, "y": 14e-3, "v_x": 0.0, "v_y": -20.0},
}  # fmt: skip
"""A disc of 1 mm between two contact points that are 4 mm apart, thrown at a pad of 12 mm."""


def drop(changes: dict[str, object]) -> Any:
    return RigFile.ready("drop").override(changes, outputs={"snapshots": []}).build()


@pytest.mark.parametrize(
    ("kind", "how", "longest"),
    [
        ("kelvin_voigt", {}, 13e-6),
        ("neo_hookean", {}, 13e-6),
        ("kelvin_voigt", {"knots": times(1e-3, 16)}, 1e-3 / 15),
    ],
)
def test_a_body_that_passes_through_its_pad_ends_the_run(kind, how, longest):
    """In free flight the centre of the disc is at the surface after 0.1 ms; the time is that of the
    start of this step."""
    built = drop(FAST | {"materials.gel.kind": kind})
    with pytest.raises(SimulationFailed, match="passed through the pad `ground`") as caught:
        simulate(built.rig, times(1e-3, 51), y0=built.y0, **how)
    assert 1e-4 - longest <= caught.value.time <= 1e-4


@pytest.mark.parametrize("start", [{}, {"x": 150e-3, "v_x": 15.0}], ids=["base", "side"])
def test_a_body_that_passes_through_its_pad_within_a_step_ends_the_run(start):
    thrown = {f"bodies.ellipse.start.{name}": value for name, value in start.items()}
    with pytest.raises(SimulationFailed, match="passed through the pad `ground`") as caught:
        drop(FAST | thrown | {"contacts.ground.may_leave": True}).run(times(1.2e-3, 2), step=2e-3)
    assert caught.value.time == 0.0


def test_a_body_that_is_pressed_in_by_the_height_of_its_pad_ends_the_run():
    heavy = {
        "bodies.ellipse.shape": {"kind": "ellipse", "a": 18e-3, "b": 11e-3},
        "bodies.ellipse.mass": 50.0, "contacts.ground.may_leave": True,
        "bodies.ellipse.start": {"x": 80e-3, "y": 31e-3, "v_x": 0.0, "v_y": -2.0},
    }  # fmt: skip
    with pytest.raises(SimulationFailed, match=r"12 mm high, .* base") as caught:
        drop(FAST | heavy).run(times(0.02, 101))
    assert 11e-3 <= float(caught.value.trajectory["y_ellipse"][-1]) < 11.5e-3


BLOCK = 80e-3, 10e-3, 40, 4


@pytest.mark.parametrize(
    ("mesh", "left", "x", "y", "theta"),
    [
        (CurvedPadMesh(*BLOCK, radius=0.1), 40e-3, 0.0, (25e-3, -35e-3), (0.0, 0.0)),
        (FingertipMesh(40e-3, 64), 40e-3, 0.0, (55e-3, -35e-3), (0.0, 0.0)),
        (PadMesh(*BLOCK), 0.0, -40e-3, (0.0, 0.0), (1.0, -1.0)),
    ],
    ids=["curved", "fingertip", "turning"],
)
def test_a_moving_pad_ends_the_run_where_its_base_reaches_a_fixed_body(mesh, left, x, y, theta):
    """The base is 10 mm above the table's origin; the stone's top 5 mm above that of the world."""
    ways = {"x": (x, x), "y": y, "theta": theta}
    motion = {f"table.{axis}": Profile([0.0, 0.1], way) for axis, way in ways.items()}
    gel = KelvinVoigt(2e5, 0.45, 1e3, 1e-3, 0.04)
    law = SoftContact(4e4, 40.0, 4e4, 40.0, friction=Coulomb(0.1, 0.1))
    rig = Rig(
        bodies={"stone": Body(shape=Circle(5e-3), x=0.0, y=0.0, theta=0.0),
                "table": Body(**dict.fromkeys(ways, "driven"))},
        pads={"sole": Pad(mesh, gel, base="table", origin=(-left, 10e-3), mirrored=True)},
        contacts={"sole": Contact("sole", "stone", law)}, reference=Reference(**motion),
        gravity=0.0,
    )  # fmt: skip
    with pytest.raises(SimulationFailed, match=r"`stone` .*compressed the pad `sole`") as caught:
        simulate(rig, times(0.1, 101), y0=rig.state())
    time = torch.tensor(caught.value.time).double()
    height, angle = (motion[f"table.{axis}"](time)[0] for axis in ("y", "theta"))
    assert float(height * angle.cos() - x * angle.sin()) == pytest.approx(-5e-3, abs=1e-3)


def test_a_centre_of_mass_below_the_surface_is_no_loss():
    """A disc that rests on its pad, with its centre of mass 5 mm under the pad's surface."""
    changes = {
        "bodies.ellipse.shape": {"kind": "circle", "radius": 10e-3},
        "bodies.ellipse.centre_y": -15e-3, "bodies.ellipse.start": {"x": 80e-3, "y": "rest"},
    }  # fmt: skip
    run = drop(changes).run(times(0.05, 6))
    assert 6e-3 < float(run["y_ellipse"][-1]) < 7e-3


def plate(may_leave: bool) -> tuple[Rig, Trajectory]:
    """A plate wider than its pad, whose friction holds, compresses it by 50 um."""
    rubber = KelvinVoigt(0.75e6, 0.45, 1e3, 1e-3, 44e-3)
    law = SoftContact(1e8, 1e4, 1e8, 1e4, friction=Coulomb(5.0, 5.0))
    body = Body(shape=RoundedBox(26e-3, 10e-3, 2e-3), x=0.0, y="driven", theta=0.0)
    rig = Rig(
        bodies={"plate": body},
        pads={"lower": Pad(PadMesh(40e-3, 5e-3, 40, 5), rubber, origin=(-20e-3, 0.0))},
        contacts={"lower": Contact("lower", "plate", law, may_leave=may_leave)},
        reference=Reference(**{"plate.y": Profile([0.0, 0.2], [15e-3, 14.95e-3])}),
    )  # fmt: skip
    return rig, simulate(rig, times(0.3, 7), y0=rig.state())


def test_a_plate_wider_than_its_pad_may_leave_it():
    """Its force is that of the compliance."""
    with pytest.raises(SimulationFailed, match=r"is 40 mm long; .* may_leave = true"):
        plate(may_leave=False)
    rig, run = plate(may_leave=True)
    pad = rig.pads["lower"]
    pushed = torch.tensor([0.0, -50e-6]).double().repeat(len(pad.positions))
    force = torch.linalg.solve(pad.compliance().detach(), pushed)[1::2].sum()
    found = float(run.force["lower"][-1, :, 0].sum())
    assert found == pytest.approx(-float(force), rel=0.01)


# halved steps
# ----------------------------------------------------------------------


def test_a_step_that_newton_does_not_solve_is_halved_and_differentiated(monkeypatch):
    """Too few iterations for the hardest steps: those are cut, the others are not, the run ends
    where it should, and the gradient is that of the run."""
    make, iterations = ImplicitStepper.__init__, {"max_iterations": 12}
    monkeypatch.setattr(
        ImplicitStepper, "__init__", lambda *given, **how: make(*given, **how | iterations)
    )
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t, E = grasped(model, (0.5, 0.0)), times(0.01, 6), model.parameter("pad.E")
    go = lambda step=2e-3, **how: simulate(model, t, y0=y0, step=step, tolerance=1e-10, **how)
    run = go(gradient="discrete")
    failed = run.stats.failed_steps
    assert failed > 0
    assert 5 < run.stats.steps < 5 + 64 * failed
    again = simulate(model, t, y0=y0, knots=run.knots, tolerance=1e-10)
    assert float((again.y - run.y).detach().abs().max()) < 1e-8
    with pytest.warns(UserWarning, match="halved"):  # four outputs a step
        within = simulate(model, times(0.01, 21), y0=y0, knots=t, tolerance=1e-10)
    assert within.stats.failed_steps == failed
    np.testing.assert_allclose(within.y.detach()[::4], run.y.detach(), atol=1e-8)
    (slope,) = torch.autograd.grad(run["theta"][-1], E)
    ahead = go(gradient="forward", wrt=["pad.E"], rigid=True)
    assert ahead.stats.failed_steps == failed
    assert float(ahead.sensitivities[-1, 2, 0]) == pytest.approx(slope.item(), rel=1e-9)
    ends, h = [], 1e-5 * E.item()
    for by in (h, -2 * h):  # small enough to cut the same steps
        with torch.no_grad():
            E.add_(by)
        ends.append(go())
        assert ends[-1].stats.failed_steps == failed
    with torch.no_grad():
        E.add_(h)
    difference = float(ends[0]["theta"][-1] - ends[1]["theta"][-1]) / (2 * h)
    assert slope.item() == pytest.approx(difference, rel=1e-4)
    iterations["max_iterations"] = 40
    free, fine = go(), go(step=6.25e-5)
    assert free.stats.failed_steps == 0
    off = [float((one["y_C"] - fine["y_C"]).detach().abs().max()) for one in (run, free)]
    assert off[0] < 1.2 * off[1]
