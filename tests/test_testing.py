"""The public checks: they pass what is right, with right values, and name what is wrong."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from conftest import RUBBER, f64, times
from torch import Tensor, nn

from torchsoft import (
    PD,
    Actuator,
    Body,
    Circle,
    Contact,
    Coulomb,
    KelvinVoigt,
    Pad,
    PadMesh,
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
T = times(0.01, 4)


def slider(friction: Any = None, v: float = 0.3) -> tuple[Rig, Tensor]:
    """A disc that rests on a pad and starts to slide at v [m/s]."""
    rubber = KelvinVoigt(**RUBBER, tau=0.01)
    law = SoftContact(1.2e5, 440.0, 1.2e5, 440.0, friction=friction or SmoothSlip(0.5, 0.4, 5e-2))
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(0.02))},
        pads={"P": Pad(PadMesh(0.03, 4e-3, 15, 2), rubber)},
        contacts={"P": Contact("P", "disc", law)},
        groups={"rubber": rubber, "contact": law},
    )
    y0 = rig.state(disc={"x": 0.015, "y": "rest"}).detach()
    y0[rig.layout.slices["velocity", "disc"]] = f64(v, 0.0, 0.0)
    return rig, y0


def thrown() -> tuple[Rig, Tensor]:
    """A disc that a constant force of 2 N pushes from rest."""
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(0.02), weighted=False)}, pads={}, contacts={},
        actuators={"push": LAW}, reference=hold(x=0.0, F=2.0),
    )  # fmt: skip
    return rig, torch.zeros(6, dtype=torch.float64)


# gradients


def test_derivatives_are_those_of_a_closed_form():
    """x = F t^2 / 2 m: its last value, and twice that as a function of the run."""
    (rig, y0), x = thrown(), 2.0 * 0.3**2 / (2 * 0.4)
    wrt = ["bodies.disc.mass", "reference.signals.F.values"]
    for of, factor in ((["x_disc"], 1.0), (lambda run: 2 * run["x_disc"][-1], 2.0)):
        checked = check_gradients(rig, times(0.3, 4), y0, wrt=wrt, of=of)
        by_mass, by_force = checked.derivatives
        for one, slope in ((by_mass, -factor * x), (by_force, by_force.adjoint)):
            assert one.adjoint == pytest.approx(slope, rel=1e-7)
            assert one.difference == pytest.approx(slope, rel=1e-6)
            assert one.step_error <= 1e-5 * x
        assert abs(by_force.adjoint) == pytest.approx(factor * x, rel=1e-5)
    assert not rig.reference["F"].values.requires_grad
    for of in ("x_disc", 3.0):
        with pytest.raises(ValueError, match="`of` must be a list of channels or a function"):
            check_gradients(rig, times(0.1, 2), y0, of=of)


def test_every_derivative_has_its_difference_and_the_rig_is_left_as_it_was():
    rig, y0 = slider()
    before = {name: p.detach().clone() for name, p in rig.named_parameters()}
    wrt = ["rubber.E", "contact.friction.mu_k", "start"]
    checked = check_gradients(rig, T, y0, wrt=wrt, rtol=1e-4, step_error=False)
    assert {(one.value, one.by) for one in checked.derivatives} == {
        (kind, name) for name in wrt for kind in ("motion", "forces")
    }
    for one in checked.derivatives:
        assert one.difference == pytest.approx(one.adjoint, rel=1e-4)
        assert one.uncertainty < 1e-4 * abs(one.adjoint)
        assert one.forward == pytest.approx(one.adjoint, rel=1e-6)
    assert not checked.unclear
    assert re.match(r"\d+% stick, \d+% slip, \d+% out of contact; \d+ touch down", checked.regime)
    assert "motion by rubber.E" in repr(checked)
    assert all(torch.equal(p, before[name]) for name, p in rig.named_parameters())


class Held(nn.Module):
    """A slip law that detaches half of its coefficient."""

    def __init__(self) -> None:
        super().__init__()
        self.mu = nn.Parameter(f64(0.3)[0])

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return (E - (0.5 * self.mu + 0.5 * self.mu.detach()) * F_N).clamp(min=0.0) / R


def test_a_wrong_gradient_is_named():
    rig, y0 = slider(Held())
    run = {"rtol": 1e-4, "step_error": False, "wrt": ["contact.friction.mu"]}
    with (
        pytest.warns(UserWarning, match="is not that of its value"),
        pytest.raises(CheckFailed) as failed,
    ):
        check_gradients(rig, T, y0, **run)
    found = re.search(
        r"`motion` by `contact.friction.mu` is (\S+) by the adjoint and (\S+) \+-",
        str(failed.value),
    )
    half, whole = map(float, found.groups() if found else (0, 1))
    assert whole == pytest.approx(2 * half, rel=1e-3)


@pytest.mark.parametrize(
    "noise",
    [
        {1e-10: 3e-2, 1e-9: -5e-3, 3e-9: -5.01e-3, 1e-8: 1e-3, 3e-8: -3e-4},
        {  # the forces of a run of 1900 steps: those at 1e-8 and 3e-8 agree
            1e-10: 7.8e-3, 1e-9: -6.68e-4, 3e-9: -3.97e-4, 1e-8: -5.7e-5, 3e-8: -7.52e-5,
            1e-7: 3.42e-5, 1e-6: 2e-7,
        },
    ],
)  # fmt: skip
def test_noise_that_agrees_by_chance_does_not_make_a_derivative_wrong(noise):
    slope = 0.1
    differenced = lambda h: {"value": slope + noise.get(h, 1e-12 / h)}
    ((found, by),) = gradients._judged(differenced, {"value": slope}, {"value": 1.0}, 1e-5).values()
    assert abs(found - slope) <= 2 * by
    assert by < 1e-4


@pytest.mark.parametrize(
    ("changed", "faults", "unsigned", "without_effect", "unchecked"),
    [
        ({}, 1, 0, (), ()),
        ({"scale": 1e4}, 1, 0, (), ()),
        ({"by": gradients.TOGETHER, "scale": 0.0}, 1, 0, (), ()),
        ({"uncertainty": 1e-2}, 0, 0, (), ("c",)),
        ({"difference": 9e-9, "scale": 1.0}, 0, 0, ("c",), ()),
        ({"adjoint": 0.0435, "forward": 0.0434}, 1, 0, (), ()),
        ({"adjoint": 0.0435, "forward": 0.0435, "step_error": 0.05}, 0, 1, (), ()),
    ],
)
def test_a_derivative_is_judged_by_its_own_size(
    changed, faults, unsigned, without_effect, unchecked
):
    """Zero by the adjoint, 0.0435 by differences: all of it is wrong, alone or beside a derivative
    of 1e4."""
    rig, y0 = thrown()
    run = simulate(rig, times(0.1, 2), y0=y0)
    one = gradients.Derivative("value", "c", 0.0, None, 0.0435, 9e-9, None, 0.0435)
    check = gradients.GradientCheck((one._replace(**changed),), run, 1e-5)
    assert len(gradients._faults(check, 1e-5)) == faults
    assert len(check.unsigned) == unsigned
    assert (check.without_effect, check.unchecked) == (without_effect, unchecked)


def test_parameters_without_effect_fail_where_they_are_named_and_are_reported_elsewhere():
    """At rest no point slips: nothing depends on friction."""
    rig, y0 = slider(v=0.0)
    friction = [f"contact.friction.{name}" for name in ("mu_s", "mu_k", "v_s")]
    run = {"rig": rig, "t": times(1e-3, 3), "y0": y0, "step_error": False}
    with pytest.raises(CheckFailed, match=r"friction.mu_s`.*zero.*never slip") as failed:
        check_gradients(**run, wrt=["rubber.E", *friction])
    assert "rubber.E" not in str(failed.value)
    with pytest.warns(UserWarning, match=r"friction.mu_s`.*were not checked.*never slip"):
        checked = check_gradients(**run)
    assert set(friction) <= set(checked.without_effect)
    (rig, y0), wrt = thrown(), ["gravity", "bodies.disc.mass"]
    with pytest.raises(CheckFailed, match=r"`gravity`, `bodies.disc.mass` were not checked"):
        check_gradients(rig, times(0.1, 2), y0, wrt=wrt, of=["y_disc"], each=False)


# energies


springy = lambda E, F_N, R: 1.9 * E / R
"""A slip law that gives back what it takes."""


def test_energies_balance_and_a_law_that_supplies_power_is_named():
    rig, y0 = slider()
    check_energy(rig, T, y0)
    with pytest.raises(CheckFailed, match="injected since is missing or too much"):
        check_energy(rig, T, y0, residual=0.0)
    rig, y0 = slider(springy)
    with pytest.raises(CheckFailed, match=r"at t = 0 s `(dashpots|slip)` is to dissipate energy"):
        check_power(rig, y0)


class Half(Transformer):
    """Gives back half of the effort."""

    def effort(self, e: Tensor, junctions: Mapping[str, Junction]) -> dict[str, Tensor]:
        return super().effort(0.5 * e, junctions)


def lossy(graph: Any) -> None:
    port = graph.ports["contact_P"]
    half = Half(port.transformer.blocks)
    graph.ports["contact_P"] = dataclasses.replace(port, transformer=half)


def dragging(graph: Any) -> None:
    """The lower contact feels the body's velocity twice."""
    blocks = graph.ports["contact_P"].transformer.blocks
    blocks["disc"] = blocks["disc"]._replace(matrix=2 * blocks["disc"].matrix)


@pytest.mark.parametrize(
    ("change", "messages"),
    [
        (lossy, ["transformer of `contact_P` does not return", "stored energy changes by"]),
        (dragging, ["`contact_P` resists a velocity that all parts share"]),
    ],
)
def test_a_graph_that_is_not_one_is_named(monkeypatch, change, messages):
    rig, y0 = slider()
    check_power(rig, y0)
    whole = type(rig).evaluate

    def evaluate(self, *given, **how):
        graph = whole(self, *given, **how)
        change(graph)
        return graph

    monkeypatch.setattr(Rig, "evaluate", evaluate)
    with pytest.raises(CheckFailed) as failed:
        check_power(rig, y0)
    assert all(one in str(failed.value) for one in messages)


# laws


def sliding(change: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda E, F_N, R: change(E, F_N).clamp(min=0.0) / R


def pushing(law: Callable[..., Any]) -> Actuator:
    return Actuator("disc.x", "disc.x", law, setpoint="x")


RIGHT = [
    SmoothSlip(0.5, 0.4, 5e-2), Coulomb(0.4, 0.4),
    SoftContact(1e5, 400.0, 1e5, 400.0, friction=SmoothSlip(0.5, 0.4, 5e-2)),
    sliding(lambda E, F_N: E - 0.3 * F_N), pushing(PD(1e3, 10.0)), PD(1e3, 10.0), LAW,
    {"one": LAW, "other": pushing(PD(1e3, 10.0))},
]  # fmt: skip


@pytest.mark.parametrize("law", RIGHT)
def test_laws_that_are_right_pass(law):
    check_law(law)


class DetachedPD(PD):
    def forward(self, w: Any, w_dot: Any, feed_forward: Any, q: Any, q_dot: Any) -> Any:
        return super().forward(w.detach(), w_dot, feed_forward, q, q_dot)


WRONG = [
    (Coulomb(0.5, 0.4), r"the slip rate of `Coulomb` jumps by 2e-05 m/s at an effort of 0.05 N"),
    (SoftContact(1e5, 1.0, 1e5, 1.0, friction=SmoothSlip(0.8, 0.3, 1e-3)), "use a larger R_t"),
    (springy, "or slip supplies power"),
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


@pytest.mark.parametrize(("law", "message"), WRONG, ids=[message for _, message in WRONG])
def test_laws_that_are_wrong_are_named(law, message):
    with pytest.raises(CheckFailed, match=message):
        check_law(law)
