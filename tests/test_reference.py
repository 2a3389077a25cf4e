"""The paper's manipulation, its gradients and its statics as the engine computed them when its
friction law last changed (`made_by`)."""

import json
from pathlib import Path

import pytest
import torch
from conftest import grasp, holding_force, paper, press, rest, still, times
from torch import Tensor

from torchsoft import Rig, Trajectory, simulate
from torchsoft.solve.diagnostics import NEUTRAL, modes

REFERENCE = json.loads((Path(__file__).parent / "reference.json").read_text())

OF_RANGE = 1e-9
"""Of the range of a quantity over the run."""
RELATIVE = 1e-8
"""Of a gradient, where the reference itself is that good."""


def held_displacements(model: Rig, y0: Tensor) -> Tensor:
    """y0 as a function of E, nu and depth that leaves the pads where they are: the reference's
    gradients hold displacements."""
    y = y0.clone()
    for name, pad in model.pads.items():
        C, where = pad.compliance(), model.layout.slices["pads", name]
        u = C.detach() @ y0[where]
        y = torch.cat((y[: where.start], torch.linalg.solve(C, u), y[where.stop :]))
    return y


def series(run: Trajectory) -> dict[str, Tensor]:
    """Every quantity of the reference over the run."""
    out = dict(run.channels)
    for kind in ("energy", "dissipated", "supplied"):
        out |= {f"{kind}.{name}": value for name, value in getattr(run, kind).items()}
    out |= {
        f"sum_{n}_{k}": run.force[k][..., i].sum(1)
        for k in "LU"
        for i, n in enumerate(("F_N", "F_T"))
    }
    return {name: value.detach() for name, value in (out | {"injected": run.injected}).items()}


@pytest.fixture(scope="module")
def manipulation():
    """The 30 s with the gradient behind them, pads' initial displacements held."""
    force = REFERENCE["manipulation"]["grasp_force"]
    rig, y0, _ = paper({"motion.F_ff.values": [0.0, -force]})
    y0 = held_displacements(rig, y0)
    return rig, simulate(rig, times(30, 3001), y0=y0, step=2e-3, gradient="discrete")


def test_the_manipulation_is_the_reference(manipulation):
    """Poses, rates, efforts, sums of nodal forces, energies, dissipation and work at seven
    moments."""
    _, run = manipulation
    found, reference = series(run), REFERENCE["manipulation"]
    rows = [run.at(time) for time in reference["t"]]
    for name, values in reference["values"].items():
        off = (found[name][rows] - torch.tensor(values, dtype=torch.float64)).abs().max()
        extent = found[name].max() - found[name].min()
        assert float(off) <= OF_RANGE * float(extent), (name, float(off / extent))
    assert run.stats.steps == 15000
    assert run.stats.failed_steps == 0
    assert run.energy_residual_rel == pytest.approx(2.782e-5, rel=1e-3)
    for k in "LU":  # eleven nodes touch where the disc stands
        touching = (run.force[k][rows, :, 0] > 0).sum(1).tolist()
        assert touching == [9, 11, 11 if k == "L" else 10, 10, 11, 11, 11]


def test_gradients_of_the_manipulation_are_the_references(manipulation):
    model, run = manipulation
    reference = REFERENCE["gradient_of_theta_C_10s"]
    names = list(reference["by"])
    found = torch.autograd.grad(run["theta_C"][1000], [model.parameter(name) for name in names])
    sure = [name for name in names if reference["uncertainty"][name] <= RELATIVE]
    assert len(sure) == 19
    for name, gradient in zip(names, found):
        bound = RELATIVE + 2 * reference["uncertainty"][name]
        assert gradient.item() == pytest.approx(
            reference["by"][name], rel=RELATIVE if name in sure else bound
        ), name


CASES = {"default": {}, "E = 60e3": {"pad.E": 60e3}}


@pytest.fixture(params=CASES)
def case(request):
    """The model, and what the reference says of it."""
    model = still(CASES[request.param])
    return model, REFERENCE["statics"][request.param]


@torch.no_grad()
def test_statics_are_the_references(case):
    model, expected = case
    y = press(model)
    for name, state in (("rest_y_C", rest(model)), ("press_y_C", y)):
        height = float(model.unpack(state).pose["disc"][1])
        assert height == pytest.approx(expected[name], abs=1e-12)
    assert holding_force(model, y) == pytest.approx(expected["holding_force"], rel=1e-9)


@pytest.mark.slow
def test_loop_modes_are_the_references(case):
    model, expected = case
    y, held = grasp(model)
    found = modes(model, y, held).values
    assert int((found.abs() < NEUTRAL).sum()) == expected["neutral_modes"]
    creep = (found + 1 / model.parameter("pad.tau").item()).abs() < 1e-3  # clear of the disc
    leading = found[(found.abs() > NEUTRAL) & ~creep & (found.imag >= 0)][:4]
    got = torch.stack((leading.real, leading.imag), -1)
    assert torch.allclose(
        got, torch.tensor(expected["leading_modes"], dtype=torch.float64), rtol=1e-4, atol=1e-2
    )
