"""A friction law written by the user: learned through the plain step, refused by the compiled one."""

import pytest
import torch
from conftest import coarse
from test_experiments import experiment

from torchsoft import press, simulate
from torchsoft.contact import SmoothSlip


def test_learned_friction_smoke() -> None:
    """The misfit falls at least tenfold and the friction coefficient comes nearer to the truth."""
    module = experiment("learned_friction")
    result = module.run(module.Config(smoke=True))
    numbers = module.numbers(result)
    assert numbers["fall"] >= 10
    assert len(result.losses) <= 20
    assert numbers["mu_error_mean"] < 0.5 * numbers["mu_error_start_max"]
    assert numbers["slip_to_mm_s"] > 50


def test_the_learned_law_solves_its_own_equation() -> None:
    """(eta + R) v = E - mu(v) F_N, to the fixed-point sweeps' error, and no slip below the cap."""
    module = experiment("learned_friction")
    torch.manual_seed(0)
    law = module.MuNetwork()
    torch.nn.init.normal_(law.net[2].weight, std=0.1)
    E, F_N = torch.linspace(0.0, 30.0, 31, dtype=torch.float64), torch.full((31,), 20.0, dtype=torch.float64)
    R, eta = (torch.tensor(x, dtype=torch.float64) for x in (880.0, 20.0))
    v = law.slip_rate(E, F_N, R, eta)
    stuck = law.mu(torch.zeros(1, dtype=torch.float64)) * F_N  # [N], what sticking can carry
    residual = (E - law.mu(v) * F_N).clamp(min=0.0) - (eta + R) * v
    assert float(residual.detach().abs().max()) < 1e-2  # [N], of 20 N
    assert bool((v[0.9 * stuck > E] == 0).all())


def test_the_true_law_in_the_learned_one_s_place_is_the_built_in_one() -> None:
    module = experiment("learned_friction")
    model = coarse()
    law = model.contact.friction
    assert isinstance(law, SmoothSlip)
    v = torch.tensor([0.0, law.v_s.item()], dtype=torch.float64)
    mu = module.true_mu(law, v)
    assert mu.tolist() == pytest.approx([0.8, 0.75])


def test_the_compiled_stepper_refuses_a_law_that_it_does_not_have() -> None:
    module = experiment("learned_friction")
    model = coarse()
    y0 = press(model, model.settings.scenario.y_Br_grasp).detach()
    model.contact.friction = module.MuNetwork()
    with pytest.raises(TypeError, match=r"SmoothSlip and Coulomb.*MuNetwork.*unrolled_solution"):
        simulate(model, torch.linspace(0, 0.01, 3, dtype=torch.float64), y0=y0)
