"""Forces and moments that a run records equal the torch module's."""

import pytest
import torch
from conftest import coarse, times

from torchsoft import simulate
from torchsoft.scenario import grasp_and_roll


@torch.no_grad()
def test_recorded_forces_and_moments_equal_the_module(fidelity: str) -> None:
    """Nodal forces of a run, and the moment of the pads' efforts about the undeformed places of
    their nodes (Eq. 35)."""
    manipulation = grasp_and_roll(coarse(pad__fidelity=fidelity), grasp_force=75.0)
    model, run = (
        manipulation.model,
        simulate(manipulation.model, times(0.5, 11), y0=manipulation.y0),
    )
    for i in (0, 3, 7, 10):
        graph = model.evaluate(run.t[i], model.unpack(run.y[i], t=run.t[i]))
        for k in "LU":
            expected = graph.interfaces[k].out[..., 3:5]
            assert (
                float((run.force[k][i] - expected).abs().max()) < 1e-8
            )  # [N], ten times Newton's tolerance
        X, e = model.pads["U"].positions, graph.ports["pad_U"].effort
        moment = float((X[:, 0] * e[:, 1] - X[:, 1] * e[:, 0]).sum())
        assert float(run["bracket_moment"][i]) == pytest.approx(
            moment, abs=6e-9
        )  # ten points' 1e-8 N
