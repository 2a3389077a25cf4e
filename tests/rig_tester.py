"""What is checked of a rig beyond `torchsoft.testing`, whatever it is made of."""

import warnings

import torch
from conftest import shaken
from torch import Tensor

from torchsoft import Coulomb, Rig, Trajectory
from torchsoft.physics.contact import cross
from torchsoft.testing import check_gradients

Start = tuple[Rig, Tensor]
"""A rig with a reference that moves, and its initial state (size,)."""


def at_random(start: Start, seed: int) -> Tensor:
    """The initial state shaken about: touching and separated points, stick and slip, stretched
    springs."""
    rig, y0 = start
    return shaken(rig, rig.unpack(y0), seed)


@torch.no_grad()
def assert_forces_are_the_modules(rig: Rig, run: Trajectory) -> None:
    """Nodal forces of a run, and the moment of every pad's efforts about the undeformed places of
    its nodes (Eq. 35)."""
    graph = rig.evaluate(run.t, rig.unpack(run.y, t=run.t))
    for name, face in graph.interfaces.items():
        off, most = (float(x.abs().max()) for x in (run.force[name] - face.law.force, face.F_N))
        assert off < max(1e-8, 6e-10 * most), name
    for name, pad in rig.pads.items():
        moment = (cross(pad.positions) * graph.ports[f"pad_{name}"].effort).sum((-2, -1))
        assert torch.allclose(run[f"M_{name}"], moment, rtol=0, atol=1e-9), name


def assert_gradients_exact(
    start: Start, t: Tensor, rtol: float = 1e-4, centres: bool = False
) -> Trajectory:
    """A run whose ledger closes and whose forces are the module's, and `check_gradients` of it
    along one direction of the start, of every parameter and of every value of the reference."""
    (rig, y0), bound = start, 2e-6
    with warnings.catch_warnings():  # some parameters have no effect
        warnings.filterwarnings("ignore", "the derivatives by .* were not checked")
        checked = check_gradients(
            rig, t, y0, rtol=rtol, bound=bound, dy0=at_random(start, 0) - y0, each=False,
            step_error=False, centres=centres,
        )  # fmt: skip
    assert checked.run.energy_residual_rel < 2e-3
    if not any(isinstance(part, Coulomb) for part in rig.modules()):  # on which side of its jump?
        assert_forces_are_the_modules(rig, checked.run)
    judged = [one for one in checked.derivatives if one.difference is not None]
    assert len(judged) == 2
    for one in judged:
        assert abs(one.difference - one.adjoint) <= bound * one.scale, checked
    return checked.run
