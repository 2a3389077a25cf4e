"""What a rig must be before it runs: numbers, tensors, shapes and slip laws, each refused by its name."""

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from conftest import coarse, f64, grasped, times
from torch import Tensor, nn

from torchsoft import (
    Circle,
    Coulomb,
    Ellipse,
    KelvinVoigt,
    Shape,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
    StandardLinearSolid,
    rest,
    simulate,
)
from torchsoft.physics.validity import check_array, check_shape, check_slip

T = times(4e-3, 3)


class Disc(Shape):
    """A circle of 20 mm, right in every respect; what is wrong with it is put in by the test."""

    def __init__(self, **wrong: Callable[..., Tensor]) -> None:
        super().__init__()
        self.wrong = wrong

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        d = x.norm(dim=-1)
        n = x / d[..., None]
        return self.wrong.get("phi", lambda d: d - 0.02)(d), self.wrong.get("n", lambda n: n)(n)

    def gyration(self) -> Tensor:
        return self.wrong.get("gyration", lambda: f64(2e-4)[0])()

    def support(self, direction: Tensor) -> Tensor:
        return self.wrong.get("support", lambda d: 0.02 * d.norm(dim=-1))(direction)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"phi": lambda d: 0.9 * (d - 0.02)}, "phi is not a distance"),
        ({"phi": lambda d: (d * d - 4e-4) / 0.045}, "phi is not a distance"),
        ({"n": lambda n: 1.01 * n}, "its normal is not of unit length"),
        ({"n": lambda n: -n}, "its normal is not the slope of phi"),
        ({"n": lambda n: n.flip(-1)}, "its normal is not the slope of phi"),
        ({"support": lambda d: 0.019 * d.norm(dim=-1)}, "`support` is less than how far it reaches"),
        ({"support": lambda d: 0.021 * d.norm(dim=-1)}, "`support` is more than how far it reaches"),
        ({"gyration": lambda: f64(-1.0)[0]}, r"`disc.inertia` must be from 1e-24 to 1e\+06 kg.m2"),
    ],
)
def test_a_shape_that_is_none_is_refused(wrong: dict[str, Callable[..., Tensor]], match: str) -> None:
    model = SoftGrasp(coarse().settings, shape=Disc(**wrong))
    with pytest.raises(ValueError, match=match):
        simulate(model, T, y0=grasped(coarse()))


def test_an_oval_that_is_called_round_is_refused() -> None:
    class Oval(Ellipse):
        round = True

    with pytest.raises(ValueError, match="called `round`, but is not"):
        check_shape("disc", Oval(0.03, 0.02))


def test_right_shapes_pass() -> None:
    for shape in (Disc(), Circle(0.02), Ellipse(0.03, 0.02)):
        check_shape("disc", shape)


def test_a_slip_law_that_supplies_power_is_told_of() -> None:
    assert check_slip("c", SmoothSlip(0.8, 0.7, 5e-3, 10.0), 500.0) == ""
    assert check_slip("c", Coulomb(0.8, 0.7), 500.0) == ""
    assert "must be from 0 to the effort" in check_slip("c", lambda E, F_N, R: 1.5 * E / R, 500.0)
    assert "must be from 0 to the effort" in check_slip("c", lambda E, F_N, R: E - F_N, 500.0)
    model = SoftGrasp(coarse().settings, friction=lambda E, F_N, R: 1.5 * E / R)
    with pytest.warns(UserWarning, match="the slip law of `L` gives"):
        simulate(model, T, y0=grasped(model))


NUMBERS = itertools.count(1000)


def rated(change: Callable[..., Tensor], eta: float | None = None) -> Callable[..., Tensor]:
    """A slip law like Coulomb's, with another normal force; unlike any other in this process if `eta` is not given."""
    own = 10.0 + next(NUMBERS) if eta is None else eta
    return lambda E, F_N, R: (E - 0.5 * change(F_N)).clamp(min=0.0) / (R + own)


@pytest.mark.parametrize(
    ("law", "match"),
    [
        (
            rated(lambda N: N.mean().expand_as(N)),
            r"aten\.mean\.default, which couples contact points at .*test_validity",
        ),
        (rated(lambda N: N.sum() + 0 * N), r"aten\.sum\.default, which couples contact points at .*test_validity"),
        (rated(lambda N: N.reshape(-1).cumsum(0).reshape(N.shape)), r"cumsum"),
        (rated(lambda N: N.reshape(-1).flip(0).reshape(N.shape)), r"aten\.flip\.default, which couples contact points"),
        (rated(lambda N: N.reshape(-1)[0] + 0 * N), "couples contact points at .*test_validity"),
        (rated(lambda N: N / N.numel()), "several points at once other rates .*numel"),
        (rated(lambda N: (-1 - N).sqrt()), "the slip law of `L` gives nan at an effort of 0.001 N"),
        (torch.nn.Dropout(), r"the slip law of `L` must take three tensors .*TypeError"),
        (lambda E, F_N, R: None, "the slip law of `L` must give a tensor of shape .*, but gives NoneType"),
    ],
    ids=["mean", "sum", "cumsum", "flip", "first", "numel", "nan", "dropout", "none"],
)
def test_slip_laws_that_are_none_of_one_point_are_refused(law: Any, match: str) -> None:
    model = SoftGrasp(coarse().settings, friction=law)
    y0 = torch.zeros(model.layout.size, dtype=torch.float64)
    with pytest.raises((ValueError, TypeError), match=match):
        simulate(model, T, y0=y0)


def test_a_coupled_law_is_refused_after_its_pointwise_twin() -> None:
    """For one point both have the same expression, which is compiled already."""
    for change, refused in ((lambda N: N, False), (lambda N: N.sum().expand_as(N), True)):
        model = SoftGrasp(coarse().settings, friction=rated(change, eta=9.0))
        y0 = torch.zeros(model.layout.size, dtype=torch.float64)
        if refused:
            with pytest.raises(ValueError, match="several points at once other rates"):
                simulate(model, T, y0=y0)
        else:
            simulate(model, T, y0=rest(model).detach())


def test_no_law_is_refused() -> None:
    with pytest.raises(ValueError, match="`friction` must be a function or a module"):
        SoftContact(1e5, 1.0, 1e5, 1.0, friction=None)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda m: m.float(), "`gravity` must be float64"),
        (lambda m: m.to("meta"), "on meta"),
        (lambda m: setattr(m.pad.E, "data", torch.ones(2).double()), r"parameter `pad.E` must be one number"),
        (lambda m: m.pad.E.data.fill_(1e308), r"parameter `pad.E` must be below 1e\+100"),
        (lambda m: setattr(m, "pad", KelvinVoigt(7e5, 0.4, 1e3, 0.01, 0.04)), "`pad.E` belongs to no body, pad"),
        (lambda m: setattr(m.contact, "friction", Coulomb(0.3, 0.4)), "mu_k = 0.4 > mu_s = 0.3"),
        (lambda m: [m.contact.R_t.data.zero_(), m.contact.friction.eta.data.zero_()], r"eta \+ R_t must be positive"),
        (lambda m: setattr(m.contacts["L"], "body", "dish"), "contact `L` is between `L` and `dish`"),
    ],
)
def test_models_that_were_spoilt_are_refused(spoil: Callable[[SoftGrasp], object], match: str) -> None:
    model = coarse()
    y0 = grasped(model)
    spoil(model)
    with pytest.raises(ValueError, match=match):
        simulate(model, T, y0=y0)


def test_statics_refuse_what_runs_refuse() -> None:
    model = coarse()
    with torch.no_grad():
        model.pad.E.fill_(-1.0)
    with pytest.raises(ValueError, match=r"parameter `pad.E` must be from 1 to 1e"):
        rest(model)
    with torch.inference_mode(), pytest.raises(ValueError, match=r"use torch.no_grad\(\)"):
        rest(coarse())
    p = coarse().settings.pad
    soft = StandardLinearSolid(p.E, 0.5 * p.E, p.nu, p.rho, p.tau, p.depth)
    with pytest.raises(ValueError, match="E_instant is below E"):
        rest(SoftGrasp(coarse().settings, material=soft))
    with pytest.raises(ValueError, match="differ by more than a factor of 3"):
        rest(SoftGrasp(coarse().settings, shape=Ellipse(5e-3, 19e-3)))


def test_tensors_that_runs_cannot_take_are_refused() -> None:
    x = f64(1.0, 2.0)
    check_array("x", x)
    for bad in (x.numpy(), [1.0], x.float(), x.to("meta"), x.to_sparse(), x.to(torch.complex128)):
        with pytest.raises(ValueError, match="`x` must be "):
            check_array("x", bad)
    with torch.autograd.forward_ad.dual_level(), pytest.raises(ValueError, match="has a tangent"):
        check_array("x", torch.autograd.forward_ad.make_dual(x, x))
    with pytest.raises(ValueError, match=r"inside a transform of torch.func"):
        torch.func.grad(lambda x: check_array("x", x) or x.sum())(x)


def test_another_default_device_is_refused() -> None:
    model = coarse()
    y0 = grasped(model)
    with torch.device("meta"), pytest.raises(ValueError, match=r"call torch.set_default_device\('cpu'\)"):
        simulate(model, T, y0=y0)


class Dropping(nn.Module):
    """A law with a dropout."""

    def __init__(self) -> None:
        super().__init__()
        self.dropout = nn.Dropout(0.5)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.dropout((E - 0.5 * F_N).clamp(min=0.0)) / (R + 10.0)


def test_a_law_in_training_is_refused_after_it_ran_in_evaluation() -> None:
    model = SoftGrasp(coarse().settings, friction=Dropping())
    y0 = grasped(model)
    model.eval()
    simulate(model, T, y0=y0)
    model.train()
    with pytest.raises(TypeError, match="the random operation"):
        simulate(model, T, y0=y0)
