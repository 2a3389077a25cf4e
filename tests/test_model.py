"""The module as an ODE right-hand side: batches, gradients, errors."""

import pytest
import torch
from conftest import coarse, random_state

from torchsoft import SoftGrasp, rest
from torchsoft.control import Profile, hold

STEP = 1e-5
"""Relative step of the central differences."""


def test_batches_equal_single_states(fidelity: str) -> None:
    """Any leading dimensions; a sample does not depend on its neighbours."""
    model = coarse(pad__fidelity=fidelity)
    y = torch.stack([random_state(model, seed) for seed in range(6)]).reshape(2, 3, -1)
    with torch.no_grad():
        together = model(torch.tensor(0.1, dtype=torch.float64), y)
        alone = torch.stack([model(0.1, sample) for sample in y.reshape(6, -1)]).reshape(2, 3, -1)
    scale = alone.abs().amax(-1, keepdim=True)
    assert together.shape == y.shape
    assert float(((together - alone) / scale).abs().max()) < 1e-12


def test_gradient_reaches_every_parameter(fidelity: str) -> None:
    """Autograd through forward against central differences, parameter by parameter (the law is smooth at this state)."""
    model = coarse(pad__fidelity=fidelity)
    model.reference.requires_grad_(True)
    y = random_state(model, 5)
    weight = torch.randn(model.layout.size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad():
        weight /= model(0.0, y).abs().clamp(min=1e-3)
    (weight * model(0.0, y)).sum().backward()
    skipped = {"material.rho"} if fidelity == "massless" else set()
    for name, parameter in model.named_parameters():
        if name in skipped:
            assert parameter.grad is None
            continue
        h = STEP * max(abs(float(parameter.detach().flatten()[0])), 1e-3)
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter += sign * h
                values.append(float((weight * model(0.0, y)).sum()))
                parameter -= sign * h
        expected = (values[0] - values[1]) / (2 * h)
        assert parameter.grad is not None, name
        got = float(parameter.grad.flatten()[0])
        assert got == pytest.approx(expected, rel=2e-5, abs=1e-8 * max(abs(v) for v in values) / h), name


def test_gradient_reaches_the_state() -> None:
    model = coarse()
    y = random_state(model, 7).requires_grad_(True)
    direction = random_state(model, 8).detach() - y.detach()
    rate = model(0.0, y)
    weight = 1 / rate.detach().abs().clamp(min=1e-3)
    (gradient,) = torch.autograd.grad((weight * rate).sum(), y)
    with torch.no_grad():
        h = 1e-6
        ahead, behind = ((weight * model(0.0, y + s * h * direction)).sum() for s in (1, -1))
    assert float(gradient @ direction) == pytest.approx(float((ahead - behind) / (2 * h)), rel=1e-5)


def test_rest_is_an_equilibrium_of_forward(fidelity: str) -> None:
    """At rest nothing accelerates; gravity is what a kilogram feels otherwise, 9.81."""
    model = coarse(pad__fidelity=fidelity)
    y = rest(model).detach()
    model.reference = hold(0.06, float(model.layout.unpack(y).r_Br[1]))
    with torch.no_grad():
        rate = model.layout.unpack(model(0.0, y))
    assert float(rate.v_C.abs().max()) < 1e-8
    assert float(rate.omega.abs()) < 1e-8
    assert float(rate.v_Br.abs().max()) < 1e-8


@pytest.mark.parametrize("wrong", ["short", "float32"])
def test_wrong_states_are_refused(wrong: str) -> None:
    model = coarse()
    y = torch.zeros(model.layout.size - 1, dtype=torch.float64) if wrong == "short" else torch.zeros(model.layout.size)
    with pytest.raises(ValueError, match="`y` must be float64 of shape"):
        model(0.0, y)


def test_profile_is_the_papers_seventh_order_polynomial() -> None:
    """Ends where it should, at rest with zero acceleration and jerk; peak speed 4.375 mm/s for 20 mm in 10 s."""
    profile = Profile([0.0, 10.0], [0.06, 0.04])
    t = torch.linspace(0, 10, 1001, dtype=torch.float64)
    value, rate = profile(t)
    assert float(value[0]) == 0.06
    assert float(value[-1]) == pytest.approx(0.04, abs=1e-15)
    assert float(rate.abs().max()) == pytest.approx(4.375e-3, rel=1e-12)
    for time in (0.0, 10.0):
        derivative = lambda t: profile(t)[1].sum()
        t0 = torch.tensor(time + (1e-9 if time == 0 else -1e-9), dtype=torch.float64)
        acceleration = torch.func.grad(derivative)
        assert float(profile(t0)[1].abs()) < 1e-12
        assert float(acceleration(t0).abs()) < 1e-12
        assert float(torch.func.grad(acceleration)(t0).abs()) < 1e-9
    slope = torch.func.grad(lambda t: profile(t)[0].sum())(t[123])
    assert float(slope) == pytest.approx(float(rate[123]), rel=1e-12)


@pytest.mark.parametrize(
    ("times", "values", "match"),
    [([0.0, 0.0], [1.0, 2.0], "increase strictly"), ([0.0, 1.0], [1.0], "per time"), ([0.0], [float("nan")], "finite")],
)
def test_bad_profiles_are_refused(times: list[float], values: list[float], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Profile(times, values)


def test_state_dict_round_trip() -> None:
    model, other = coarse(), coarse(contact__K_n=2e5)
    other.load_state_dict(model.state_dict())
    y = random_state(model, 1)
    with torch.no_grad():
        assert torch.equal(model(0.0, y), other(0.0, y))
    assert isinstance(other, SoftGrasp)
