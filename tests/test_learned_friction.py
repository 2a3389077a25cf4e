"""A friction law written by the user: learned through the compiled stepper, which gives its exact
gradient."""

import pytest
import torch
from conftest import coarse, f64
from test_experiments import experiment

from torchsoft import SmoothSlip


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
    law = module.MuNetwork(20.0)
    torch.nn.init.normal_(law.net[2].weight, std=0.1)
    E, F_N = (
        torch.linspace(0.0, 30.0, 31, dtype=torch.float64),
        torch.full((31,), 20.0, dtype=torch.float64),
    )
    v = law(E, F_N, f64(880.0))
    stuck = law.mu(f64(0.0)) * F_N  # [N], what sticking can carry
    residual = (E - law.mu(v) * F_N).clamp(min=0.0) - 900.0 * v
    assert float(residual.detach().abs().max()) < 1e-2  # [N], of 20 N
    assert bool((v[0.9 * stuck > E] == 0).all())


def test_the_true_law_in_the_learned_one_s_place_is_the_built_in_one() -> None:
    module = experiment("learned_friction")
    model = coarse()
    law = model.contacts["L"].law.friction
    assert isinstance(law, SmoothSlip)
    v = torch.tensor([0.0, law.v_s.item()], dtype=torch.float64)
    mu = module.true_mu(law, v)
    assert mu.tolist() == pytest.approx([0.8, 0.75])
