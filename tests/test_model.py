"""Models of rigs: shared by rigs of one structure, with rooms that are as good as new; and what a
run makes of itself later."""

import copy
import pickle

import pytest
import torch
from conftest import coarse, f64, grasped, times

from torchsoft import SimulationFailed, Trajectory, simulate
from torchsoft.envs import reorient
from torchsoft.solve import model as models
from torchsoft.solve.parameters import Parameters

T = times(0.02, 5)


def same(one: Trajectory, other: Trajectory) -> bool:
    parts = [
        [run.y, run.recorded, *run.channels.values(), *run.energy.values(),
         *run.contact_state.values()] for run in (one, other)
    ]  # fmt: skip
    return all(torch.equal(a.detach(), b.detach()) for a, b in zip(*parts, strict=True))


def test_rigs_of_one_structure_share_a_model(monkeypatch):
    """Whatever their parameters; another geometry or attribute makes another model. As many are
    kept as fit, the last one always."""
    rig = coarse()
    first = Parameters(rig).model
    with torch.no_grad():
        (other := copy.deepcopy(rig)).parameter("pad.E").mul_(1.1)
    assert Parameters(other).model is Parameters(coarse(pad__E=6e5)).model is first
    with torch.no_grad():
        other.parameter("disc.radius").mul_(1.001)
    leaving = copy.deepcopy(rig)
    leaving.contacts["L"].may_leave = True
    assert first not in (Parameters(other).model, Parameters(leaving).model)
    assert Parameters(rig).model is first
    monkeypatch.setattr(models, "KEPT_BYTES", first.bytes)
    second = Parameters(coarse(pad__elements_x=24)).model
    assert Parameters(coarse(pad__elements_x=24)).model is second
    assert Parameters(rig).model is not first


def test_the_vector_of_parameters_has_a_table_of_names():
    """By the names in the file and in the module, with what is computed of them and its graph."""
    rig = coarse()
    found = Parameters(rig)
    E = rig.parameter("materials.rubber.E")
    for name in ("materials.rubber.E", "pads.L.material.E"):
        assert found[name].tolist() == [E.item()]
    softness = 1 / (E * rig.pads["L"].material.depth)
    assert found["chain of L"].tolist() == pytest.approx([1.0, 0.01, softness.item(), 0.45])
    (slope,) = torch.autograd.grad(found["chain of L"][2], E)
    assert slope.item() == pytest.approx((-softness / E).item())


@pytest.mark.parametrize("left", [0.1, float("nan")])
def test_a_room_is_as_good_as_new(left):
    """Numbers that an earlier run left do not matter; a run that failed leaves no room behind."""
    rig = coarse()
    y0 = grasped(rig, (0.05, 0.0))
    models.forget()
    expected = simulate(rig, T, y0=y0, rtol=1e-4)
    model = Parameters(rig).model
    (used,) = model._idle
    ground = used.work.q[-3:].copy()  # which no run writes to
    for part in (*used.work, *used.step, used.system.p):
        if part.dtype == float or left == left:
            part.fill(left if part.dtype == float else 1)
    used.work.q[-3:] = ground
    assert same(simulate(rig, T, y0=y0, rtol=1e-4), expected)
    assert model._idle == [used]
    y0[rig.layout.slices["velocity", "disc"]] = f64(20.0, 0.0, 0.0)
    with pytest.raises(SimulationFailed):
        simulate(rig, times(0.2, 9), y0=y0, rtol=1e-3)
    assert model._idle == []


def test_a_copy_of_a_run_makes_the_rest_of_the_rig_that_ran():
    """Of one that is complete, and of those that make it later, when the rig is another."""
    rig = coarse(pad__elements_x=30)
    y0 = grasped(rig, (0.05, 0.0))
    eager, late, other = (simulate(rig, T, y0=y0, rtol=1e-3) for _ in range(3))
    eager.complete()
    with torch.no_grad():
        for value in (*rig.parameters(), *rig.buffers()):
            value.zero_()
    for one in (copy.deepcopy(late), pickle.loads(pickle.dumps(other))):
        assert same(one, eager)
        assert (one.made_by, one.units) == (eager.made_by, eager.units)
    with pytest.raises(AttributeError, match="nothing"):
        _ = late.nothing


def test_a_step_in_the_room_of_another_is_that_of_a_graph():
    """With a gradient a step runs anew, without one in arrays of the last step."""
    env = reorient()
    env.reset(seed=0)
    dynamics, now = env.dynamics, env.moment
    for k in range(3):
        action = f64(0.1 * k, -0.2, 0.05 * k)
        with torch.no_grad():
            done = dynamics.step(now, action)
        graph = dynamics.step(now, action)
        for name in ("y", "recorded"):
            one, other = (getattr(step.moment, name) for step in (done, graph))
            assert torch.equal(one, other.detach())
        assert torch.equal(done.observation, graph.observation.detach())
        assert torch.equal(done.knots, graph.knots)
        assert same(Trajectory.of(done.solved), Trajectory.of(graph.solved))
        now = done.moment
