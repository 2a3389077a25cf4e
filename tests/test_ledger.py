"""What a run says of itself at its end."""

import re
import warnings
from collections.abc import Callable

import pytest
import torch
from conftest import coarse, grasped, times, towards
from torch import Tensor, nn

from torchsoft import (
    Body,
    Circle,
    Profile,
    Rig,
    SoftGrasp,
    hold,
    simulate,
    simulate_batch,
)
from torchsoft.excitation import CATALOGUE, begin
from torchsoft.solve.diagnostics import RESIDUAL, doubts


def told(model: Rig, run: Callable[..., object] = simulate, **options: object) -> list[str]:
    """The warnings of a run, or of many."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(model, **options)
    return [str(w.message) for w in caught]


@pytest.mark.parametrize("name", ["deep jerks", "light jerks"])
def test_hard_motions_pass_at_the_default_step_and_at_what_is_advised(name):
    """The hardest of the ready excitations, and the same as coarse as nobody should take them."""
    excitation = CATALOGUE[name]
    begun = begin(excitation, coarse(contact__v_s=5e-3).settings)
    t = times(excitation.duration, 2)
    assert told(begun.rig, t=t, y0=begun.y0) == []
    begun.rig.reference = towards(begun.rig, Profile([0.6, 0.68, 0.76], [0.06, 0.08, 0.06]))
    (text,) = told(begun.rig, t=t, y0=begun.y0, step=0.05)
    assert "the energies of the run do not balance" in text
    advised = float(re.search(r"try steps of (\S+) s", text)[1])
    assert told(begun.rig, t=t, y0=begun.y0, step=advised) == []


class Springy(nn.Module):
    """A slip law that gives back what it takes: more slip than the effort allows."""

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return 1.9 * E / R


def test_a_slip_law_that_supplies_power_is_seen_in_the_ledger():
    model = SoftGrasp(coarse().settings, friction=Springy())
    said = told(model, t=times(0.01, 6), y0=grasped(model, (0.05, 0.0)))
    assert any("`slip` is to dissipate energy, but gave" in text for text in said), said
    assert any("the slip law of `L` gives" in text for text in said), said


def test_a_pad_pressed_flat_is_told_of():
    model = coarse()
    y0 = grasped(model)
    model.reference = hold(x_d=0.06, y_d=0.044, F_ff=-1000.0)
    said = told(model, t=times(0.2, 5), y0=y0, step=5e-4)
    assert any("gave way by" in text and "beyond linear elasticity" in text for text in said), said


def test_a_batch_tells_every_doubt_once_with_all_its_runs():
    model = coarse()
    y0 = grasped(model)
    pressed = hold(x_d=0.06, y_d=0.044, F_ff=-1000.0)
    references = [model.reference, pressed, model.reference, pressed]
    said = told(model, simulate_batch, t=times(0.02, 3), y0=y0, step=5e-4, reference=references)
    for pad, text in zip("LU", said, strict=True):
        assert re.match(
            rf"runs 1, 3 \(numbers of run 1\): the pad `{pad}` of height .* gave way by", text
        ), text
    assert told(
        model, simulate_batch, t=times(0.02, 3), y0=y0, step=5e-4, reference=references[:2]
    )[0].startswith("run 1: the pad")


def test_a_body_without_contact_or_energy_passes():
    """Nothing moves, nothing is stored: no division by nothing."""
    rig = Rig(bodies={"disc": Body(1.0, Circle(0.02), weighted=False)}, pads={}, contacts={})
    run = simulate(rig, times(0.1, 3), y0=torch.zeros(6, dtype=torch.float64))
    assert doubts(run, rig) == {}
    assert 0 < RESIDUAL < 0.1
