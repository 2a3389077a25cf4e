"""A friction law written by the user, learned through the compiled stepper, and a surrogate."""

import pytest
import torch
from conftest import f64, times
from test_experiments import experiment


def test_the_learned_law_solves_its_own_equation():
    """R v = E - mu(v) F_N, to the fixed-point sweeps' error, and no slip below the cap."""
    module = experiment("learn_dynamics")
    torch.manual_seed(0)
    law = module.MuNetwork()
    torch.nn.init.normal_(law.net[2].weight, std=0.1)
    E, F_N = times(30.0, 31), f64(20.0).expand(31)
    v = law(E, F_N, f64(900.0))
    stuck = law.mu(f64(0.0)) * F_N  # [N], what sticking can carry
    residual = (E - law.mu(v) * F_N).clamp(min=0.0) - 900.0 * v
    assert float(residual.detach().abs().max()) < 1e-2  # [N], of 20 N
    assert bool((v[0.9 * stuck > E] == 0).all())


@pytest.mark.slow
def test_a_residual_learns_the_coefficient():
    """From one run that slips throughout: the truth's constant, from another one."""
    module = experiment("learn_dynamics")
    student = module.Residual(0)
    t = f64(*[0.02 * i for i in range(18)])
    held = {f"{jaw}_x": module.Profile([0.2, 0.26], [0.0, 15e-3]) for jaw in module.JAWS}
    still = module.Profile([0.0], [0.0])
    reference = module.Reference(
        **held, grip=module.Profile([0.0, 0.2], [-5.0, -4.0]), upper_rate=still
    )
    given = module.Runs(t, [reference], [torch.zeros(18, 2).double()])
    scale = f64(*module.SCALE.values())
    with torch.no_grad():
        student.law.constant.fill_(-0.3)  # mu = 0.38
        given.measured[0] = student.misfit(given, 0) * scale
        student.law.constant.fill_(0.0)
    before = float(student.misfit(given, 0).square().mean())
    student.learn(module.Config(sweeps=40), given)
    assert float(student.misfit(given, 0).square().mean()) < 0.1 * before
    assert student.law.mu(f64(0.0)).item() == pytest.approx(
        0.5 - 0.4 * 0.2913, abs=0.03
    )  # from 0.5
