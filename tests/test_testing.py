"""The public checks: they pass what is right, with right values, and say what is wrong."""

import dataclasses
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from conftest import f64, times
from rig_tester import at_random
from test_every_rig import END, RIGS, NetworkFriction, grip
from torch import Tensor, nn

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Coulomb,
    Rig,
    SmoothSlip,
    SoftContact,
    hold,
    simulate,
)
from torchsoft.physics.multibond import Junction, Transformer
from torchsoft.testing import (
    CheckFailed,
    check_energy,
    check_gradients,
    check_law,
    check_power,
    gradients,
)

LAW = Actuator("disc.x", "disc.x", lambda w, w_dot, F, q, q_dot: F, setpoint="x", feed_forward="F")


def thrown() -> Rig:
    """A disc that a constant force of 2 N pushes."""
    return Rig(
        bodies={"disc": Body(0.4, Circle(0.02), weighted=False)}, pads={}, contacts={},
        actuators={"push": LAW}, reference=hold(x=0.0, F=2.0),
    )  # fmt: skip


def test_derivatives_are_those_of_a_closed_form():
    """x = F t^2 / 2 m: its last value, and twice that as a function of the run."""
    rig, t = thrown(), times(0.3, 4)
    y0 = torch.zeros(6, dtype=torch.float64)
    x = 2.0 * 0.3**2 / (2 * 0.4)
    for of, factor in ((["x_disc"], 1.0), (lambda run: 2 * run["x_disc"][-1], 2.0)):
        wrt = ["bodies.disc.mass", "reference.signals.F.values"]
        checked = check_gradients(rig, t, y0, wrt=wrt, of=of)
        by_mass, by_force = checked.derivatives
        for one, slope in ((by_mass, -factor * x), (by_force, by_force.adjoint)):
            assert one.adjoint == pytest.approx(slope, rel=1e-7)
            assert one.difference == pytest.approx(slope, rel=1e-6)
            assert one.step_error <= 1e-5 * x
        assert abs(by_force.adjoint) == pytest.approx(factor * x, rel=1e-5)
    assert not rig.reference["F"].values.requires_grad


def test_every_derivative_has_its_own_difference_and_the_rig_is_left_as_it_was():
    rig, y0 = grip()
    before = {name: p.detach().clone() for name, p in rig.named_parameters()}
    wrt = ["rubber.E", "contact.friction.mu_s", "start"]
    checked = check_gradients(rig, times(END, 4), y0, wrt=wrt, rtol=1e-4, step_error=False)
    assert [(one.value, one.by) for one in checked.derivatives] == [
        (kind, name) for name in wrt for kind in ("motion", "forces")
    ]
    for one in checked.derivatives:
        assert one.difference == pytest.approx(one.adjoint, rel=1e-4)
        assert one.uncertainty < 1e-4 * abs(one.adjoint)
        assert one.forward == pytest.approx(one.adjoint, rel=1e-6)
    assert not checked.unclear
    assert re.match(r"\d+% stick, \d+% slip, \d+% out of contact; \d+ touch down", checked.regime)
    assert "motion by rubber.E" in repr(checked)
    assert all(torch.equal(p, before[name]) for name, p in rig.named_parameters())


def test_a_sign_that_depends_on_the_steps_is_told_of():
    """By gravity: of the other sign, and four times too small, at rtol = 1e-4; the estimate of the
    error of the steps holds the true one."""
    rig, y0 = RIGS["enclosed pad"]()
    found = {}
    for rtol in (1e-4, 1e-8):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            checked = check_gradients(
                rig, times(END, 4), y0, wrt=["gravity", "rubber.E"], rtol=rtol
            )
        found[rtol] = checked.derivatives[0], [str(w.message) for w in caught]
    (rough, said), (fine, nothing) = found.values()
    assert rough.adjoint * fine.adjoint < 0
    assert abs(rough.adjoint - fine.adjoint) < rough.step_error < 2 * abs(fine.adjoint)
    assert fine.step_error < 0.02 * fine.adjoint
    assert nothing == []
    (text,) = said
    assert "the sign of the derivative of `motion` by `gravity` depends on the steps" in text


def test_a_wrong_gradient_is_named():
    """Of a friction law that detaches its coefficient, and of a signal that does."""

    class Held(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.mu = nn.Parameter(f64(0.3)[0])

        def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
            return (E - (0.5 * self.mu + 0.5 * self.mu.detach()) * F_N).clamp(min=0.0) / R

    rig, y0 = grip(friction=Held())
    name = "contact.friction.mu"
    run = {"rtol": 1e-4, "step_error": False, "wrt": [name]}
    with (
        pytest.warns(UserWarning, match="is not that of its value"),
        pytest.raises(CheckFailed) as failed,
    ):
        check_gradients(rig, times(END, 4), y0, **run)
    assert re.search(
        rf"`motion` by `{name}` is (\S+) by the adjoint and (\S+) \+-", str(failed.value)
    )
    half, whole = map(
        float, re.search(r"is (\S+) by the adjoint and (\S+) ", str(failed.value)).groups()
    )
    assert whole == pytest.approx(2 * half, rel=1e-3)


def test_noise_that_agrees_by_chance_does_not_make_a_derivative_wrong():
    """Of a value with noise of 1e-11 the two shortest differences agree, and are off by 5e-3."""
    slope, noise = 0.1, {1e-10: 3e-2, 1e-9: -5e-3, 3e-9: -5.01e-3, 1e-8: 1e-3, 3e-8: -3e-4}
    differenced = lambda h: {"value": slope + noise.get(h, 1e-12 / h)}
    ((found, by),) = gradients._judged(differenced, {"value": slope}, {"value": 1.0}, 1e-5).values()
    assert abs(found - slope) <= 2 * by
    assert by < 1e-4


def test_a_wrong_derivative_is_found_beside_larger_ones():
    """Zero by the adjoint, 0.0435 by differences: of itself all of it is wrong, alone or beside a
    derivative of 1e4."""
    run = simulate(thrown(), times(0.1, 2), y0=torch.zeros(6).double())
    wrong = gradients.Derivative("value", "c", 0.0, None, 0.0435, 9e-9, None, 0.0435)
    for by, scale in (("c", 0.0435), ("c", 1e4), (gradients.TOGETHER, 0.0)):
        check = gradients.GradientCheck((wrong._replace(by=by, scale=scale),), run, 1e-5)
        assert (check.unclear, check.without_effect, check.unchecked) == ((), (), ())
        (fault,) = gradients._faults(check, 1e-5)
        assert f"`{by}` is 0 by the adjoint and 0.0435" in fault
    vague = gradients.GradientCheck((wrong._replace(uncertainty=1e-2),), run, 1e-5)
    assert (len(vague.unclear), vague.unchecked) == (1, ("c",))
    noise = gradients.GradientCheck((wrong._replace(difference=9e-9, scale=1.0),), run, 1e-5)
    assert (noise.unclear, noise.without_effect) == ((), ("c",))


def test_parameters_without_effect_fail_where_they_are_named_and_are_reported_elsewhere():
    """In 1 ms of the grasp no point slips: nothing depends on friction."""
    rig, y0 = grip()
    friction = [f"contact.friction.{name}" for name in ("mu_s", "mu_k", "v_s")]
    run = {"rig": rig, "t": times(1e-3, 3), "y0": y0, "step_error": False}
    with pytest.raises(CheckFailed, match=r"`contact.friction.mu_s`.*zero.*never slip") as failed:
        check_gradients(**run, wrt=["rubber.E", *friction])
    assert "rubber.E" not in str(failed.value)
    with pytest.warns(UserWarning, match=r"`contact.friction.mu_s`.*were not checked.*never slip"):
        checked = check_gradients(**run)
    assert set(friction) <= set(checked.without_effect)
    assert "slip" in checked.absent
    y0 = torch.zeros(6, dtype=torch.float64)
    wrt, of = ["gravity", "bodies.disc.mass"], ["y_disc"]
    with pytest.raises(CheckFailed, match=r"`gravity`, `bodies.disc.mass` were not checked"):
        check_gradients(thrown(), times(0.1, 2), y0, wrt=wrt, of=of, each=False)


@pytest.mark.parametrize("of", ["x_disc", 3.0])
def test_what_is_differentiated_is_a_list_or_a_function(of):
    with pytest.raises(ValueError, match="`of` must be a list of channels or a function"):
        check_gradients(thrown(), times(0.1, 2), torch.zeros(6).double(), of=of)


# energies


class Springy(nn.Module):
    """A slip law that gives back what it takes."""

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return 1.9 * E / R


def test_energies_balance_and_a_law_that_supplies_power_is_named():
    rig, y0 = grip()
    assert check_energy(rig, times(END, 4), y0).energy_residual_rel < 0.01
    with pytest.raises(CheckFailed, match="injected since is missing or too much"):
        check_energy(rig, times(END, 4), y0, residual=0.0)
    rig, y0 = grip(friction=Springy())
    with pytest.raises(
        CheckFailed, match=r"at t = 0 s `(dashpots|slip)` is to dissipate energy, but"
    ):
        check_power(rig, at_random((rig, y0), 0))


class Half(Transformer):
    """Gives back half of the effort."""

    def effort(self, e: Tensor, junctions: Mapping[str, Junction]) -> dict[str, Tensor]:
        return super().effort(0.5 * e, junctions)


def lossy(graph: Any) -> None:
    port = graph.ports["contact_lower"]
    graph.ports["contact_lower"] = dataclasses.replace(
        port, transformer=Half(port.transformer.blocks)
    )


def dragging(graph: Any) -> None:
    """The lower contact feels the body's velocity twice."""
    blocks = graph.ports["contact_lower"].transformer.blocks
    blocks["disc"] = blocks["disc"]._replace(matrix=2 * blocks["disc"].matrix)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lossy, "the transformer of `contact_lower` does not return the power that it takes"),
        (lossy, "stored energy changes by"),
        (dragging, "`contact_lower` resists a velocity that all parts share"),
    ],
)
def test_a_graph_that_is_not_one_is_named(monkeypatch, change, sentence):
    start = grip()
    rig, y = start[0], at_random(start, 0)
    check_power(rig, y)
    whole = type(rig).evaluate

    def evaluate(self: Rig, *given: Any, **how: Any) -> Any:
        graph = whole(self, *given, **how)
        change(graph)
        return graph

    monkeypatch.setattr(Rig, "evaluate", evaluate)
    with pytest.raises(CheckFailed, match=re.escape(sentence)):
        check_power(rig, y)


# laws


def sliding(change: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda E, F_N, R: change(E, F_N).clamp(min=0.0) / R


def pushing(law: Callable[..., Any]) -> Actuator:
    return Actuator("disc.x", "disc.x", law, setpoint="x")


def test_laws_that_are_right_pass():
    for law in (
        SmoothSlip(0.5, 0.4, 5e-2), Coulomb(0.4, 0.4), NetworkFriction(),
        SoftContact(1e5, 400.0, 1e5, 400.0, friction=SmoothSlip(0.5, 0.4, 5e-2)),
        sliding(lambda E, F_N: E - 0.3 * F_N), pushing(PD(1e3, 10.0)), PD(1e3, 10.0), LAW,
        RIGS["policy"]()[0].actuators,
    ):  # fmt: skip
        check_law(law)


class DetachedPD(PD):
    def forward(self, w: Any, w_dot: Any, feed_forward: Any, q: Any, q_dot: Any) -> Any:
        return super().forward(w.detach(), w_dot, feed_forward, q, q_dot)


WRONG = [
    (Coulomb(0.5, 0.4), r"the slip rate of `Coulomb` jumps by 2e-05 m/s at an effort of 0.05 N"),
    (SoftContact(1e5, 1.0, 1e5, 1.0, friction=SmoothSlip(0.8, 0.3, 1e-3)), "use a larger R_t"),
    (Springy(), "or slip supplies power"),
    (sliding(lambda E, F_N: 0.9 * E - F_N), "friction jumps at touch-down"),
    (sliding(lambda E, F_N: E - F_N.mean()), "uses? the number of points|mix them"),
    (sliding(lambda E, F_N: E - F_N if float(E.sum()) > -1 else E), "reading a value into Python"),
    (sliding(lambda E, F_N: E.detach() - F_N), "is not that of its value.* by the effort"),
    (lambda E, F_N: E, "must take three tensors"),
    (pushing(lambda w, w_dot, F, q, q_dot: (w - q).detach()), "by x, disc.x are wrong"),
    (pushing(lambda w, w_dot, F, q, q_dot: 0 * w + q.sum()), "several states at once"),
    (pushing(lambda w: w), "must take five tensors"),
    (DetachedPD(1.0, 1.0), "the law of `actuators.DetachedPD` .*by x_d.* wrong"),
]  # fmt: skip


@pytest.mark.parametrize("k", range(len(WRONG)))
def test_laws_that_are_wrong_are_named(k):
    law, sentence = WRONG[k]
    with pytest.raises(CheckFailed, match=sentence):
        check_law(law)


def test_all_routes_take_steps_that_are_solved_as_they_are_given(monkeypatch):
    """Where rounding halves a step of the first run along the knots, every other route takes the
    halves too: else adjoint and forward are of different steps."""
    along, taken = gradients._along, list[Tensor]()

    def halved(rig: Rig, t: Tensor, knots: Tensor, **how: Any) -> Any:
        taken.append(knots)
        if len(taken) > 1:
            return along(rig, t, knots, **how)
        middle = 0.5 * (knots[-2:-1] + knots[-1:])
        run = along(rig, t, torch.cat((knots[:-1], middle, knots[-1:])), **how)
        return dataclasses.replace(run, stats=dataclasses.replace(run.stats, failed_steps=1))

    monkeypatch.setattr(gradients, "_along", halved)
    y0 = torch.zeros(6, dtype=torch.float64)
    check_gradients(thrown(), times(0.3, 4), y0, wrt=["bodies.disc.mass"], of=["x_disc"])
    first, *others = taken
    assert len(others) > 2
    assert all(len(knots) == len(first) + 1 for knots in others[:3])
