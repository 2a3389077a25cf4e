"""The compiled right-hand side equals the torch module's, and other integrators reach the stepper's solution with it."""

import numpy as np
import pytest
import torch
from conftest import coarse, grasped, random_state, times
from scipy.integrate import solve_ivp

from torchsoft import Profile, Reference, Sampled, SimulationFailed, simulate
from torchsoft.solve.rates import Rates


def test_another_integrator_reaches_the_steppers_solution() -> None:
    """scipy's LSODA on the rates, and the stepper by a tight tolerance, over a piece of a roll."""
    model = coarse()
    y0 = grasped(model)
    place = model.unpack(y0).pose
    x, y = float(place["disc"][0]), float(place["bracket"][1])
    model.reference = Reference(
        x_d=Profile([0.0, 0.1], [x, x + 1e-4]), y_d=Sampled(times(1.0, 2), torch.full((2,), y).double()),
        F_ff=Profile([0.0, 1.0], [-80.0, -80.0]),
    )  # fmt: skip
    wanted = simulate(model, times(0.02, 3), y0=y0, rtol=1e-7).y[-1].numpy()
    size = 1e-9 * np.maximum(np.abs(wanted), 1e-6)
    run = solve_ivp(Rates(model), (0.0, 0.02), y0.numpy(), method="LSODA", rtol=1e-9, atol=size)
    for (kind, _), here in model.layout.slices.items():
        if kind != "velocity":
            change = np.abs(wanted[here] - y0.numpy()[here]).max()
            assert np.abs(run.y[here, -1] - wanted[here]).max() < 1e-4 * change + 1e-12


def test_rates_refuse_what_they_cannot_give() -> None:
    """Inertial pads, and states at which there are no forces."""
    with pytest.raises(NotImplementedError, match="inertial pads"):
        Rates(coarse(pad__fidelity="inertial"))
    model = coarse()
    f, y = Rates(model), random_state(model, 0).numpy()
    fine = f(0.0, y)
    with pytest.raises(SimulationFailed, match="no forces"):
        f(0.0, np.full_like(y, np.nan))
    np.testing.assert_allclose(f(0.0, y), fine, rtol=1e-9, atol=1e-9 * np.abs(fine).max())  # and goes on after that
