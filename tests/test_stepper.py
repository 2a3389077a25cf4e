"""The stepper: order, grids, how runs end, halved steps, driven bodies."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, coarse, grasped, paper, times, towards
from torchdiffeq import odeint

import torchsoft
from torchsoft import (
    Profile,
    Reference,
    Rig,
    RigFile,
    SamplesFailed,
    SimulationFailed,
    simulate,
    simulate_batch,
)
from torchsoft.solve.progress import Segment
from torchsoft.solve.stepper import ImplicitStepper


def test_second_order_on_a_smooth_motion(fidelity):
    """A grasped disc set moving so gently that no node slips, touches or leaves: observed order >=
    1.8."""
    model = coarse(pad__inertial=fidelity == "inertial")
    y0, t = grasped(model, (1e-4, 5e-5)), times(0.032, 2)
    place = lambda h: simulate(model, t, y0=y0, step=h).state.pose["disc"][-1, :2]
    fine = place(3.2e-2 / 2048)
    errors = [float((place(h) - fine).norm()) for h in (2e-3, 1e-3, 5e-4)]
    orders = [float(np.log2(errors[i] / errors[i + 1])) for i in range(2)]
    assert min(orders) >= 1.8, (errors, orders)


@pytest.mark.parametrize("states", [{}, {"actuators.y.lag": 1e-4, "actuators.x.Ki": 10.0}])
def test_an_unstable_loop_ends_in_an_error_that_says_so(states):
    """E = 60 kPa, tau = 5 ms with the paper's gains, and controllers with states of their own."""
    built = paper(COARSE | {"pad.E": 6e4, "pad.tau": 5e-3} | states)
    with pytest.raises(
        SimulationFailed, match=r"the run was lost at t = .* s: the closed loop is unstable"
    ) as caught:
        built.run(rtol=1e-4)
    assert 0 < caught.value.time < 1
    assert bool(torch.isfinite(caught.value.trajectory.y).all())


def test_a_disc_rolled_off_the_pad_is_reported():
    """Only the reference knows the pad's length; a model driven beyond it says where the run
    ended."""
    model = coarse()
    y0 = grasped(model)
    beyond = towards(model, Profile([0.0, 1.0], [0.06, 0.13]))
    with pytest.raises(
        SimulationFailed, match="`disc` was lost: its contact reached the end of the pad"
    ) as caught:
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
    "route", ["none", "discrete", "forward", "knots", "odeint", "batch", "neo_hookean"]
)
def test_a_body_that_passes_through_its_pad_ends_the_run(route):
    """In free flight the centre of the disc is at the surface after 0.1 ms; the time is that of the
    start of this step."""
    kind = route if route == "neo_hookean" else "kelvin_voigt"
    built, t = drop(FAST | {"materials.gel.kind": kind}), torch.linspace(0, 1e-3, 51).double()
    y0, lost, longest = built.y0, "passed through the pad `ground`", 13e-6
    if route == "odeint":
        torchsoft.register_method()
        with pytest.raises(SimulationFailed, match=lost) as caught:
            odeint(built.rig, y0, t, method="sdirk2", rtol=1e-3, atol=1e-4)
        failure = caught.value
    elif route == "batch":
        with pytest.warns(SamplesFailed, match=lost):
            failure = simulate_batch(built.rig, t, y0=y0[None]).failures[0]
    else:
        given: dict[str, Any] = {"gradient": route if route in ("discrete", "forward") else "none"}
        given |= {"wrt": ["materials.gel.E"]} if route == "forward" else {}
        if route == "knots":
            given["knots"], longest = torch.linspace(0, 1e-3, 16).double(), 1e-3 / 15
        with pytest.raises(SimulationFailed, match=lost) as caught:
            simulate(built.rig, t, y0=y0, **given)
        failure = caught.value
        assert float(failure.trajectory["y_ellipse"][-1]) >= 12e-3
    assert 1e-4 - longest <= failure.time <= 1e-4


@pytest.mark.parametrize(("x", "v_x"), [(78e-3, 0.0), (150e-3, 15.0)])
def test_a_body_that_jumps_over_its_pad_within_a_step_ends_the_run(x, v_x):
    """One step of 2 ms at 20 m/s: through the base, and through the pad's side."""
    start = {"bodies.ellipse.start": {"x": x, "y": 14e-3, "v_x": v_x, "v_y": -20.0}}
    built = drop(FAST | start | {"contacts.ground.may_leave": True})
    with pytest.raises(SimulationFailed, match=r"passed through the pad `ground`") as caught:
        built.run(torch.tensor([0.0, 1.2e-3]).double(), step=2e-3)
    assert caught.value.time == 0.0


def test_a_pad_that_is_pressed_in_by_its_height_ends_the_run():
    """50 kg at 2 m/s, which sank by 111 mm into a pad of 12 mm."""
    changes = FAST | {
        "bodies.ellipse.shape": {"kind": "ellipse", "a": 18e-3, "b": 11e-3},
        "bodies.ellipse.mass": 50.0,
        "bodies.ellipse.start": {"x": 80e-3, "y": 31e-3, "v_x": 0.0, "v_y": -2.0},
    }  # fmt: skip
    with pytest.raises(SimulationFailed, match="12 mm high, down to its bonded base") as caught:
        drop(changes).run(torch.linspace(0, 0.02, 101).double())
    low = caught.value.trajectory["y_ellipse"] - 11e-3
    assert 0 <= float(low[-1]) < 0.5e-3


STONE = {"kind": "circle", "radius": 5e-3}
BLOCK = {"length": 80e-3, "height": 10e-3, "elements_x": 40, "elements_y": 4}
ON_A_TABLE: dict[str, tuple[dict[str, Any], dict[str, tuple[float, float]]]] = {
    "block": (BLOCK, {"y": (25e-3, -35e-3)}),
    "curved": (BLOCK | {"kind": "curved", "radius": 0.1}, {"y": (25e-3, -35e-3)}),
    "fingertip": (
        {"kind": "fingertip", "radius": 40e-3, "elements_around": 64}, {"y": (55e-3, -35e-3)},
    ),
    "turning": (BLOCK, {"x": (-40e-3, -40e-3), "y": (0.0, 0.0), "theta": (1.0, -1.0)}),
}  # fmt: skip


@pytest.mark.parametrize("name", ON_A_TABLE)
def test_a_moving_pad_ends_the_run_where_its_base_reaches_a_fixed_body(name):
    """The base is 10 mm above the table's origin; the stone's top 5 mm above that of the world."""
    pad, ways = ON_A_TABLE[name]
    ways = {"x": (0.0, 0.0), "y": (0.0, 0.0), "theta": (0.0, 0.0)} | ways
    left = 40e-3 if name != "turning" else 0.0
    soft = {"material": "gel", "base": "table", "origin": (-left, 10e-3), "mirrored": True}
    springs = dict.fromkeys(("K_n", "R_n", "K_t", "R_t"), "auto")
    file = RigFile.from_tree(
        {
            "gravity": 0.0,
            "bodies": {
                "stone": {"x": 0.0, "y": 0.0, "theta": 0.0, "shape": STONE},
                "table": dict.fromkeys(("x", "y", "theta"), "driven"),
            },
            "materials": {"gel": {"kind": "kelvin_voigt", "E": 2e5, "nu": 0.45, "tau": 1e-3,
                                  "depth": 0.04}},
            "pads": {"sole": soft | pad},
            "laws": {"dry": {**springs, "friction": {"kind": "coulomb", "mu_s": 0.1, "mu_k": 0.1}}},
            "contacts": {"sole": {"pad": "sole", "body": "stone", "law": "dry"}},
            "motion": {f"table.{axis}": {"kind": "profile", "times": [0.0, 0.1], "values": way}
                       for axis, way in ways.items()},
            "outputs": {"duration": 0.1, "interval": 1e-3},
        }
    )  # fmt: skip
    with pytest.raises(
        SimulationFailed, match="`stone` was lost: it compressed the pad `sole`"
    ) as e:
        file.build().run()
    at = {axis: file.build().rig.reference[f"table.{axis}"](torch.tensor(e.value.time).double())[0]
          for axis in ways}  # fmt: skip
    normal = torch.stack((-at["theta"].sin(), at["theta"].cos()))
    off = float(normal @ torch.stack((at["x"], at["y"]))) + 10e-3
    assert off == pytest.approx(STONE["radius"], abs=1e-3)


def test_a_centre_of_mass_below_the_surface_is_no_loss():
    """A disc that rests on its pad, with its centre of mass 5 mm under the pad's surface."""
    changes = {
        "bodies.ellipse.shape": {"kind": "circle", "radius": 10e-3},
        "bodies.ellipse.centre_y": -15e-3, "bodies.ellipse.start": {"x": 80e-3, "y": "rest"},
    }  # fmt: skip
    built = RigFile.ready("drop").override(changes, outputs={"snapshots": []}).build()
    run = built.run(torch.linspace(0, 0.05, 6).double())
    assert 6e-3 < float(run["y_ellipse"][-1]) < 7e-3


def test_a_plate_wider_than_its_pad_may_leave_it():
    """A plate with friction that holds compresses the pad: its force is that of the compliance."""
    rubber = {"kind": "kelvin_voigt", "E": 0.75e6, "nu": 0.45, "tau": 1e-3, "depth": 44e-3}
    springs = {"K_n": 1e8, "R_n": 1e4, "K_t": 1e8, "R_t": 1e4}
    tree: dict[str, Any] = {
        "bodies": {"plate": {"x": 0.0, "theta": 0.0, "y": "driven", "shape": {
            "kind": "rounded_box", "half_width": 26e-3, "half_height": 10e-3, "radius": 2e-3}}},
        "materials": {"rubber": rubber},
        "pads": {"lower": {"material": "rubber", "origin": (-20e-3, 0.0), "length": 40e-3,
                           "height": 5e-3, "elements_x": 40, "elements_y": 5}},
        "laws": {"stiff": springs | {"friction": {"kind": "coulomb", "mu_s": 5.0, "mu_k": 5.0}}},
        "contacts": {"lower": {"pad": "lower", "body": "plate", "law": "stiff"}},
        "motion": {
            "plate.y": {"kind": "profile", "times": [0.0, 0.2], "values": [15e-3, 14.95e-3]},
        },
        "outputs": {"duration": 0.3, "interval": 0.05},
    }  # fmt: skip
    with pytest.raises(SimulationFailed, match=r"is 40 mm long; .* may_leave = true"):
        RigFile.from_tree(tree).build().run()
    tree["contacts"]["lower"]["may_leave"] = True
    built = RigFile.from_tree(tree).build()
    pushed = torch.tensor([0.0, -50e-6]).double().repeat(len(built.rig.pads["lower"].positions))
    force = torch.linalg.solve(built.rig.pads["lower"].compliance().detach(), pushed)[1::2].sum()
    assert float(built.run().force["lower"][-1, :, 0].sum()) == pytest.approx(
        -float(force), rel=0.01
    )


def test_a_step_that_newton_does_not_solve_is_halved():
    """Too few iterations for the hardest steps: those are cut, the others are not, and the run ends
    where it should."""
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t = grasped(model, (0.5, 0.0)), times(0.02, 11)
    runs = []
    for iterations in (40, 12):
        stepper = ImplicitStepper(model, step=2e-3, max_iterations=iterations)
        segments: list[Segment] = []
        *_, last = stepper.integrate(y0, t, segments)
        assert sum(len(segment.plan.h) for segment in segments) == last.steps
        assert last.rows == len(t)
        runs.append(last)
    free, cut = runs
    assert free.failed == 0
    assert cut.failed > 0
    assert 10 < cut.steps < 10 + 64 * cut.failed
    fine = simulate(model, t, y0=y0, step=6.25e-5).y.numpy()
    place = model.layout.slices["pose", "disc"]
    off_cut, off_free = (np.abs(run.y - fine)[:, place][:, :2].max() for run in (cut, free))
    assert off_cut < 1.2 * off_free


def test_the_adjoint_follows_halved_steps(monkeypatch):
    """Where steps were cut, the gradient is still that of the run; differences small enough to cut
    the same steps."""
    model = coarse(contact__mu_s=0.3, contact__mu_k=0.2)
    y0, t = grasped(model, (0.5, 0.0)), times(0.01, 6)
    E = model.parameter("pad.E")

    class Hasty(ImplicitStepper):
        def __init__(self, rig: Rig, reference: Reference | None = None, **options: float) -> None:
            super().__init__(rig, reference, max_iterations=12, **options)

    monkeypatch.setattr("torchsoft.solve.simulate.ImplicitStepper", Hasty)

    def angle() -> tuple[torch.Tensor, int]:
        run = simulate(model, t, y0=y0, step=2e-3, tolerance=1e-10, gradient="discrete")
        return run["theta"][-1], run.stats.failed_steps

    theta, failed = angle()
    (slope,) = torch.autograd.grad(theta, E)
    run = simulate(
        model, t, y0=y0, step=2e-3, tolerance=1e-10, gradient="forward", wrt=["pad.E"], rigid=True
    )
    assert float(run.sensitivities[-1, 2, 0]) == pytest.approx(slope.item(), rel=1e-9)
    assert failed == run.stats.failed_steps > 0
    with torch.no_grad():
        value, h = E.clone(), 1e-5 * E.item()
        ahead, behind = (
            angle() for E_near in (value + h, value - h) if E.copy_(E_near) is not None
        )
        E.copy_(value)
    assert ahead[1] == behind[1] == failed
    assert slope.item() == pytest.approx((ahead[0] - behind[0]).item() / (2 * h), rel=1e-4)
