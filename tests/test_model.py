"""Models of rigs: shared by rigs of one structure, with rooms that are as good as new; and what a
run makes of itself later."""

import copy
import pickle

import pytest
import torch
from conftest import coarse, f64, grasped, still, times

from torchsoft import Trajectory, hold, simulate, simulate_batch
from torchsoft.envs import reorient
from torchsoft.physics.structure import Structure, structure_of
from torchsoft.solve import model as models
from torchsoft.solve.model import forget
from torchsoft.solve.system import Compiled

T = times(0.02, 5)


def same(one: Trajectory, other: Trajectory) -> bool:
    parts = [
        [run.y, run.recorded, *run.channels.values(), *run.energy.values()] for run in (one, other)
    ]
    return all(torch.equal(a.detach(), b.detach()) for a, b in zip(*parts, strict=True))


def test_rigs_of_one_structure_share_a_model():
    """Whatever their parameters; another geometry, law or attribute makes another model."""
    rig = coarse()
    first = Compiled(rig).model
    other = copy.deepcopy(rig)
    with torch.no_grad():
        other.parameter("pad.E").mul_(1.1)
    assert Compiled(other).model is Compiled(coarse(pad__E=6e5)).model is first
    with torch.no_grad():
        other.parameter("disc.radius").mul_(1.001)
    assert Compiled(other).model is not first
    other = copy.deepcopy(rig)
    other.contacts["L"].may_leave = True
    assert Compiled(other).model is not first
    assert Compiled(rig).model is first
    assert structure_of(rig) == Structure(copy.deepcopy(rig)).key


def test_a_room_is_as_good_as_new():
    """Numbers that an earlier run left do not matter."""
    rig = coarse()
    y0 = grasped(rig, (0.05, 0.0))
    forget()
    expected = simulate(rig, T, y0=y0, rtol=1e-4)
    model = Compiled(rig).model
    (used,) = model._idle
    ground = used.work.q[-3:].copy()  # which no run writes to
    for part in (*used.work, *used.step, used.system.p):
        part.fill(0.1 if part.dtype == float else 1)
    used.work.q[-3:] = ground
    assert same(simulate(rig, T, y0=y0, rtol=1e-4), expected)
    assert model._idle == [used]


def test_a_failed_run_leaves_no_room_behind():
    """Its numbers may be none."""
    rig = coarse()
    y0 = grasped(rig)
    model = Compiled(rig).model
    simulate(rig, T, y0=y0, rtol=1e-3)
    count = len(model._idle)
    y0[rig.layout.slices["velocity", "disc"]] = f64(20.0, 0.0, 0.0)
    with pytest.raises(RuntimeError, match="lost"):
        simulate(rig, times(0.2, 9), y0=y0, rtol=1e-3)
    assert len(model._idle) == count - 1


def test_what_a_run_makes_later_is_of_the_rig_that_ran():
    """Channels, energies and the description, after everything that made them has changed."""
    rig = coarse()
    y0 = grasped(rig, (0.05, 0.0))
    eager, late = (simulate(rig, T, y0=y0, rtol=1e-3) for _ in range(2))
    eager.complete()
    with torch.no_grad():
        for value in rig.parameters():
            value.mul_(1.5)
        for buffer in rig.buffers():
            buffer.zero_()
    rig.bodies["disc"].freedom["x"] = "fixed"
    rig.symbols["disc"] = "other"
    rig.reference = hold(x_d=0.0, y_d=0.0, F_ff=0.0)
    assert same(late, eager)
    assert late.channels.keys() == eager.channels.keys()
    assert late.made_by == eager.made_by
    assert late.units == eager.units


def test_a_run_can_be_pickled_and_copied_before_it_is_complete():
    rig = still({"pad.elements_x": 30, "pad.elements_y": 2})
    y0 = grasped(rig)
    for again in (copy.deepcopy, lambda run: pickle.loads(pickle.dumps(run))):
        run = simulate(rig, T, y0=y0, rtol=1e-3)
        twin = again(run)
        assert same(twin, run)
    with pytest.raises(AttributeError, match="nothing"):
        _ = run.nothing


def test_a_batch_reads_the_rig_once_and_gives_what_its_runs_give_alone():
    """Values of one run are not those of the next, though they share model and room."""
    rig = coarse()
    y0, E = grasped(rig, (0.05, 0.0)), f64(4e5, 9e5, 4e5, 6e5)
    radius = rig.parameter("disc.radius").detach() * f64(1.0, 1.0, 1.001, 1.0)
    x_d = rig.reference["x_d"].values.detach()
    own = {
        "pad.E": E,
        "disc.radius": radius,
        "reference.signals.x_d.values": x_d + 1e-12 * E[:, None],
    }
    batch = simulate_batch(rig, T, y0=y0, parameters=own, rtol=1e-3, threads=2)
    for i, run in enumerate(batch):
        alone = copy.deepcopy(rig)
        with torch.no_grad():
            for name, rows in own.items():
                alone.parameter(name).copy_(rows[i])
        assert same(simulate(alone, T, y0=y0, rtol=1e-3), run)


def test_a_step_in_the_room_of_another_is_that_of_a_graph():
    """With a gradient a step runs anew, without one in arrays of the last step."""
    env = reorient()
    env.reset(seed=0)
    dynamics, now = env.dynamics, env.moment
    for k in range(4):
        action = f64(0.1 * k, -0.2, 0.05 * k)
        with torch.no_grad():
            done = dynamics.step(now, action)
        graph = dynamics.step(now, action)
        assert torch.equal(done.moment.y, graph.moment.y.detach())
        assert torch.equal(done.moment.recorded, graph.moment.recorded.detach())
        assert torch.equal(done.observation, graph.observation.detach())
        assert torch.equal(done.knots, graph.knots)
        assert same(done.outcome.trajectory(), graph.outcome.trajectory())
        now = done.moment


def test_models_are_kept_up_to_so_many_bytes(monkeypatch):
    """The last one always."""
    forget()
    one, other = coarse(), coarse(pad__elements_x=24)
    first = Compiled(one).model
    assert Compiled(one).model is first
    monkeypatch.setattr(models, "KEPT_BYTES", first.bytes)
    second = Compiled(other).model
    assert Compiled(other).model is second
    assert Compiled(one).model is not first


def test_a_room_of_no_numbers_is_as_good_as_new():
    """Newton's scratch may be what a failure left: the run ends, with the same bits."""
    rig = coarse()
    y0 = grasped(rig, (0.05, 0.0))
    expected = simulate(rig, T, y0=y0, rtol=1e-4)
    model = Compiled(rig).model
    used = model._idle[-1]
    ground = used.work.q[-3:].copy()
    for part in (*used.work, *used.step):
        if part.dtype == float:
            part.fill(float("nan"))
    used.work.q[-3:] = ground
    assert same(simulate(rig, T, y0=y0, rtol=1e-4), expected)


def test_constants_of_elements_follow_the_buffers_of_their_pad():
    pad = coarse(pad__inertial=True).pads["L"]
    before = pad.constants
    turned = coarse(pad__inertial=True).pads["L"]
    turned.axes.neg_()
    assert (turned.constants[:, :8] == -before[:, :8]).all()
    assert (pad.constants == before).all()
