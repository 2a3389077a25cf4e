"""Environments of rig files: gymnasium's contract, states handed on, gradients, refusals."""

import copy
import importlib
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from conftest import f64
from gymnasium.utils.env_checker import check_env
from torch import Tensor, nn

import torchsoft.envs
from torchsoft import Trajectory, simulate
from torchsoft.envs import Moment, RigEnv, RigVectorEnv, TargetPose, reorient
from torchsoft.envs.rig_env import RedrawnStart, View
from torchsoft.physics.motion import Lines, Reference
from torchsoft.rigs.build import RigFile

FILE = RigFile.from_toml(torchsoft.envs.RIG)
TURN = np.array([0.4, -0.4, 0.2], np.float32)


@pytest.fixture(scope="module")
def ready():
    """One ready environment for everybody; each begins an episode of its own."""
    env = reorient()
    yield env
    env.close()


def small(**changes: Any) -> RigEnv:
    """The ready rig without the motion before the first action."""
    return reorient(**{"begin": 0.0, "interval": 0.05} | changes)


def test_check_env_passes(monkeypatch):
    """With a window that there is not here."""
    shown: list[Any] = []
    monkeypatch.setattr(View, "show", lambda self, picture: shown.append(picture.shape))
    check_env(gymnasium.make("torchsoft/Reorient-v0", render_mode="rgb_array").unwrapped)
    assert shown
    assert set(shown) == {(480, 600, 3)}


@pytest.mark.parametrize("law", [{}, {"actuators.lower_x.Ki": 2e5, "actuators.lower_x.lag": 2e-4}])
def test_an_episode_is_one_run(law):
    """States are handed on, those of actuators too: many steps are the one run along the same
    lines."""
    env = small(rig=FILE.override(law, solver={"rtol": 1e-6}))
    actions = f64(0.5, -0.3, 0.0, 0.2, 0.1, 1.0, 0.4, -0.5, -1.0).reshape(3, 3)
    actions = actions.float().double()  # as spaces hold them
    env.reset(seed=0)
    rig, start = env.dynamics.rig, env.moment
    ends = [env.step(action.numpy().astype(np.float32)) for action in actions]
    low, high = f64(-12e-3, -12e-3, -20.0), f64(12e-3, 12e-3, -6.0)
    lines = (low + 0.5 * (high - low) * (1 + torch.cat((start.action[None], actions)))).T
    times = 0.05 * torch.arange(4, dtype=torch.float64)
    signals = {k: Lines(times, x) for k, x in zip(("lower_x", "upper_x", "grip"), lines)}
    reference = Reference(upper_rate=rig.reference["upper_rate"], **signals)
    run = simulate(rig, times, y0=start.y, reference=reference, rtol=1e-6)
    assert (env.moment.y - run.y[-1]).abs().max() < 1e-4 * run.y[-1].abs().max()
    (x, theta, omega), felt = ends[-1][0][:3], ends[-1][0][5:13]
    assert x == pytest.approx(run["x_disc"][-1].item() / 10e-3, rel=1e-4)
    assert theta == pytest.approx(run["theta_disc"][-1].item(), rel=1e-4)
    assert omega == pytest.approx(run["omega_disc"][-1].item() / 3.0, rel=1e-3)
    taxels = np.array([run[f"lower_skin.normal.{i}"][-1].item() for i in range(8)])
    assert 5.0 * (felt + 1.0) == pytest.approx(taxels, abs=2e-3)


def test_any_channel_is_observed():
    """Signals and efforts too; a reward of one's own sees the run over the interval."""
    seen: list[Trajectory] = []

    def reward(run: Trajectory, action: Tensor) -> float:
        seen.append(run)
        return float(run["theta_disc"][-1]) - float(action[0])

    names = (
        "lower_x", "upper.force_y", "effort_grip", "lower_skin.centre", "y_upper", "lower_x_dot",
    )  # fmt: skip
    ranges = dict.fromkeys(names, (-1.0, 1.0))
    env = small(observations=ranges, goal=None, reward=reward, samples=5)
    env.reset(seed=0)
    observation, given, *_ = env.step(TURN)
    (run,) = seen
    assert len(run.t) == 6
    assert observation == pytest.approx([*(float(run[k][-1]) for k in names), *TURN], rel=1e-6)
    assert run["lower_x"].diff(n=2).abs().max() < 1e-15
    assert given == pytest.approx(float(run["theta_disc"][-1]) - 0.4, rel=1e-6)


def test_the_reward_is_of_the_goal(ready):
    ready.reset(seed=0, options={"target": {"theta": 0.3}})
    before = ready.moment.action
    _, reward, *_, info = ready.step(TURN)
    q = ready.moment.y[[ready.dynamics.coordinates[k] for k in ("disc.theta", "disc.x")]]
    distance = (f64(0.3, 0.0) - q) / f64(0.1, 2e-3)
    change = torch.from_numpy(TURN).double() - before
    expected = 1 / (1 + distance.square().sum()) - 0.01 * change.square().sum()
    assert reward == pytest.approx(float(expected), rel=1e-12)
    assert info["distance"] == pytest.approx(float(distance.norm()), rel=1e-12)


def test_an_episode_is_disturbed():
    """By a peak that a run along the same lines has, and by another one in every episode."""
    push = {"pushes": "disc.x", "feed_forward": "push"}
    file = FILE.override(
        solver={"rtol": 1e-6},
        actuators={"push": push},
        motion={"push": {"kind": "hold", "value": 0.5}},
    )
    env = small(rig=file, disturbances={"push": (-4.0, 4.0)}, duration=0.2)
    env.reset(seed=0)
    begun = env.moment
    ((when, peak),) = begun.peaks.tolist()
    assert 1 <= when <= 3
    assert -4.0 <= peak <= 4.0
    held = {k: Lines([0.0], x[None]) for k, x in zip(env.dynamics.actions, f64(0.0, 0.0, -6.0))}
    env.moment = begun._replace(action=f64(0.0, 0.0, 1.0))  # -6 N; the file's -5 N are out of range
    for _ in range(4):
        env.step(np.array([0.0, 0.0, 1.0], np.float32))
    times = 0.05 * torch.arange(5, dtype=torch.float64)
    values = 0.5 + peak * (torch.arange(5) == when)
    own = env.dynamics.rig.reference
    reference = Reference(upper_rate=own["upper_rate"], push=Lines(times, values), **held)
    run = simulate(env.dynamics.rig, times, y0=begun.y, reference=reference, rtol=1e-6)
    assert run["x_disc"].abs().max() > 1e-5
    assert (env.moment.y - run.y[-1]).abs().max() < 1e-4 * run.y[-1].abs().max()
    env.reset()
    assert env.moment.peaks.tolist() != [[when, peak]]


def test_steps_are_judged_like_runs(monkeypatch):
    env = small(judged=True, duration=0.1)
    env.reset(seed=0)
    assert env.step(TURN)[-1]["doubts"] == []
    monkeypatch.setattr("torchsoft.solve.diagnostics.COMPRESSED", 1e-3)
    (*_, said) = env.step(TURN)[-1]["doubts"]
    assert "beyond linear elasticity" in said


def test_time_is_limited(ready):
    env = small(duration=0.1)
    env.reset(seed=0)
    assert [env.step(TURN)[3] for _ in range(2)] == [False, True]
    with pytest.raises(ValueError, match="the episode is over, or has not begun; call `reset`"):
        env.step(TURN)


def test_episodes_end_with_a_sentence():
    env = small(bounds={"disc.theta": (-0.01, 0.01)})
    env.reset(seed=0)
    *_, terminated, _, info = env.step(TURN)
    assert terminated
    assert "disc.theta = " in info["ended"]
    hung = FILE.override(bodies={"disc": {"start": {"y": 40e-3}}, "upper": {"start": {"y": 0.08}}})
    env = small(rig=hung, interval=0.01, failure_reward=-7.0)
    env.reset(seed=0)
    _, reward, terminated, _, info = env.step(np.zeros(3, np.float32))
    assert (reward, terminated) == (-7.0, True)
    assert info["ended"] == "disc was dropped: no contact touches it"


def test_a_failing_run_ends_its_episode_only():
    far = {"lower_x": (-80e-3, 80e-3), "upper_x": (-80e-3, 80e-3)}
    env = small(actions=far, bounds={}, duration=1.0)
    env.reset(seed=0)
    for _ in range(20):
        observation, _, terminated, _, info = env.step(np.array([1.0, -1.0], np.float32))
        if terminated:
            break
    assert "lost" in info["failure"]
    assert observation in env.observation_space
    env.reset()
    assert not env.step(np.zeros(2, np.float32))[2]


def test_seeds_draw_goals_and_parameters():
    name = "materials.rubber.E"
    env = small(parameters={name: (0.3e6, 0.8e6), "bodies.disc.start.x": (-2e-3, 2e-3)})
    drawn = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        at = env.moment.y[env.dynamics.coordinates["disc.x"]]
        E = env.dynamics.rig.parameter(name).item()
        drawn.append((E, float(at), float(env.moment.target[0])))
    assert drawn[0] == drawn[2]
    assert all(abs(a - b) > 1e-6 for a, b in zip(drawn[0], drawn[1]))
    assert 0.3e6 <= drawn[0][0] <= 0.8e6


def test_starts_that_cannot_be_are_drawn_again():
    lying = FILE.override(bodies={"disc": {"start": {"y": "rest"}}})
    env = small(rig=lying, parameters={"bodies.disc.start.x": (0.0, 0.05)})
    with pytest.warns(RedrawnStart, match=r"no episode begins with bodies.disc.start.x = 0.0.*pad"):
        env.reset(seed=0)
    assert float(env.moment.y[env.dynamics.coordinates["disc.x"]]) < 0.025
    nowhere = small(rig=lying, parameters={"bodies.disc.start.x": (0.03, 0.05)})
    with pytest.raises(ValueError, match="narrow the ranges of `parameters`"):
        nowhere.reset(seed=0)


def differs(function: Callable[[Tensor], Tensor], x: Tensor, way: Tensor, h: float) -> float:
    """Central difference of a function along a way."""
    with torch.no_grad():
        return float(function(x + h * way) - function(x - h * way)) / (2 * h)


def test_gradients_of_a_step(ready):
    """Of state, observation and reward, by state and actions, against differences on frozen
    knots."""
    dynamics, generator = ready.dynamics, torch.Generator().manual_seed(0)
    draw = lambda n: torch.randn(n, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        begin = dynamics.begin(f64(0.3, 0.0))
        start, then = dynamics.step(begin, f64(0.2, -0.3, 0.1)).moment, f64(0.3, -0.5, 0.2)
        knots = dynamics.step(start, then).knots
    by_y, by_seen = draw(len(start.y)), draw(dynamics.size)

    def total(y: Tensor, before: Tensor, action: Tensor) -> Tensor:
        done = dynamics.step(start._replace(y=y, action=before), action, knots)
        return done.moment.y @ by_y + done.observation @ by_seen + 3 * done.reward

    inputs = [x.clone().requires_grad_() for x in (start.y, start.action, then)]
    dynamics.begin()
    slopes = torch.autograd.grad(total(*inputs), inputs)
    for i, (x, slope) in enumerate(zip(inputs, slopes)):
        way = draw(len(x)) * (x.detach().abs() if i == 0 else 1.0)
        of_one = lambda given, i=i: total(*(given if j == i else one.detach()
                                            for j, one in enumerate(inputs)))  # fmt: skip
        expected = differs(of_one, x.detach(), way, 1e-7 if i == 0 else 1e-6)
        assert float(slope @ way) == pytest.approx(expected, rel=1e-5)


def test_parameters_are_read_at_the_begin():
    """By torch and by gymnasium, with their gradient."""
    env = small()
    dynamics, E = env.dynamics, env.dynamics.rig.parameter("materials.rubber.E")
    action, start, frozen = f64(0.2, -0.3, 0.1), dynamics.begin(), list[Tensor]()
    start = Moment(*(x.detach() if isinstance(x, Tensor) else x for x in start))

    def total(value: float) -> Tensor:
        with torch.no_grad():
            E.fill_(value)
        dynamics.begin()
        done = dynamics.step(start, action, frozen[0] if frozen else None)
        frozen[:] = frozen or [done.knots]
        return done.observation.sum()

    total(0.5e6).backward()
    expected = differs(lambda x: total(x.item()), f64(0.5e6)[0], f64(1.0)[0], 5.0)
    assert E.grad.item() == pytest.approx(expected, rel=1e-4)
    seen = []
    for value in (0.5e6, 0.6e6, 0.5e6):
        with torch.no_grad():
            E.fill_(value)
        env.reset(seed=0)
        seen.append(env.step(TURN)[0])
    assert np.array_equal(seen[0], seen[2])
    assert not np.array_equal(seen[0], seen[1])


def test_gradient_of_an_episode_by_a_policy(ready):
    dynamics = ready.dynamics
    torch.manual_seed(0)
    policy = nn.Sequential(nn.Linear(dynamics.size, 30), nn.Tanh(), nn.Linear(30, 3), nn.Tanh())
    policy.double()
    frozen: list[Tensor] = []

    def episode(weights: Tensor) -> Tensor:
        nn.utils.vector_to_parameters(weights, policy.parameters())
        moment, total = dynamics.begin(f64(0.3, 0.0)), f64(0.0)[0]
        observation, taken = dynamics.observe(moment), list[Tensor]()
        for i in range(4):
            done = dynamics.step(moment, policy(observation), frozen[i] if frozen else None)
            moment, observation, total = done.moment, done.observation, total + done.reward
            taken.append(done.knots)
        frozen[:] = frozen or taken
        return total

    weights = nn.utils.parameters_to_vector(policy.parameters()).detach()
    with torch.no_grad():
        episode(weights)
    episode(weights).backward()
    slope = torch.cat([x.grad.flatten() for x in policy.parameters()])
    way = torch.randn(len(weights), generator=torch.Generator().manual_seed(1)).double()
    assert len(weights) == 903
    # the warm-up is not frozen, but no weight reaches it
    assert float(slope @ way) == pytest.approx(differs(episode, weights, way, 1e-6), rel=1e-5)


def test_a_copy_in_the_middle_of_an_episode_goes_on_alike_and_apart():
    """With the gradient by the parameters of its own rig."""
    env = small(duration=0.2)
    env.reset(seed=3)
    env.step(TURN)
    copied = copy.deepcopy(gymnasium.wrappers.ClipAction(env))
    ends = [one.step(-TURN) for one in (env, copied)]
    assert np.array_equal(ends[0][0], ends[1][0])
    copied.step(TURN)
    assert (env.moment.steps, copied.unwrapped.moment.steps) == (2, 3)
    E = [one.unwrapped.dynamics.rig.parameter("materials.rubber.E") for one in (env, copied)]
    copied.unwrapped.dynamics.step(env.moment, f64(0.2, -0.3, 0.1)).reward.backward()
    assert E[0].grad is None
    assert E[1].grad != 0.0
    several = RigVectorEnv([lambda: small(duration=0.1)] * 2, threads=2)
    several.reset(seed=3)
    others = copy.deepcopy(several)
    actions = np.stack((TURN, -TURN))
    assert np.array_equal(several.step(actions)[0], others.step(actions)[0])
    several.close()
    others.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_threads_do_not_change_results(mode):
    ends = []
    for threads in (1, 2):
        envs = RigVectorEnv([lambda: small(duration=0.1)] * 2, threads=threads, autoreset_mode=mode)
        envs.reset(seed=3)
        ends.append([envs.step(np.stack((TURN, -TURN))) for _ in range(3)])
        envs.close()
    for one, other in zip(*ends):
        for a, b in zip(one[:4], other[:4]):
            assert np.array_equal(a, b)
    assert ends[0][1][3].all()
    over = ends[0][2] if mode == "NextStep" else ends[0][1]
    assert (over[0][:, -3:] != TURN).any()  # of the begin of the next episode
    assert ("final_obs" in over[4]) == (mode == "SameStep")


def test_make_vec_takes_threads():
    envs = gymnasium.make_vec("torchsoft/Reorient-v0", 2, vector_kwargs={})
    assert isinstance(envs, RigVectorEnv)
    envs.close()


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "signal": ({"actions": {"lower_y": (0, 1)}}, "`actions` names `lower_y`; did you mean `lower_"),
    "disturbed": (
        {"disturbances": {"grip": (0.0, 1.0)}},
        "`disturbances` names `grip`; signals that no action sets are upper_rate",
    ),
    "no action": ({"actions": {}}, "`actions` is empty; name signals of lower_x"),
    "range": ({"actions": {"grip": (1.0, 1.0)}}, "a pair of finite numbers, low below high"),
    "reversed target": (
        {"goal": TargetPose("disc", {"theta": (0.6, -0.6)}, {"theta": 0.1})},
        "`goal.target['theta']` must be a pair of finite numbers, low below high, but is (0.6",
    ),
    "channel": ({"observations": {"x_disk": (0, 1)}}, "names `x_disk`; did you mean `x_disc`"),
    "interval": ({"interval": 0.0}, "`interval` must be positive and finite, but is 0.0"),
    "rate": ({"interval": 1e-6}, "`interval` must be at least 0.0001 s"),
    "duration": ({"duration": 0.25}, "must be a multiple of `interval` = 0.1 s, but is 0.25 s"),
    "short": ({"begin": 2.25}, "but is 0.05 s, the rest of the run after `begin`"),
    "late": ({"begin": 9.0, "duration": 0.5}, "9 s is not before the end of the rig's own motion"),
    "begin": ({"begin": -1.0}, "`begin` must be a time from 0 s on"),
    "both": ({"reward": lambda *_: 0.0}, "give either a `goal` or a `reward`"),
    "body": (
        {"goal": TargetPose("disk", {"x": 0.0}, {"x": 1.0})},
        "`goal.target` names `disk.x`; did",
    ),
    "scale": ({"goal": TargetPose("disc", {"x": 0.0}, {"y": 1.0})}, "must have the coordinates of"),
    "bounds": ({"bounds": {"lower.y": (0, 1)}}, "`bounds` names `lower.y`; free are disc.x"),
    "held": ({"held": ["disk"]}, "`held` names `disk`; did you mean `disc`"),
    "parameter": ({"parameters": {"materials.rubber.e": (1, 2)}}, "is not in the rig file"),
    "physics": ({"parameters": {"materials.rubber.nu": (0.4, 0.6)}}, "= 0.6: "),
    "mode": ({"render_mode": "ansi"}, "`render_mode` is 'ansi'"),
    "rig": ({"rig": 3}, "`rig` must be a rig file, its path"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_sense_is_refused(case):
    changes, sentence = REFUSED[case]
    with pytest.raises(ValueError) as refusal:  # noqa: PT011 -- the sentence is compared
        reorient(**changes)
    assert sentence in str(refusal.value)


@pytest.mark.parametrize(
    ("call", "given", "sentence"),
    [
        ("step", [np.nan, 0, 0], "sets `lower_x` to nan, but must be from -1 to 1"),
        ("step", [0, 1.5, 0], "sets `upper_x` to 1.5, but must be from -1 to 1; clip it, or wrap"),
        ("step", [0, 0], "must hold 3 numbers, for lower_x, upper_x, grip"),
        ("reset", {"taget": {}}, "`options` names `taget`; did you mean `target`"),
        ("reset", {"target": {"y": 0.0}}, "`target` names `y`; the goal has theta, x"),
        ("reset", {"target": {"x": np.inf}}, "`target` must be finite"),
    ],
)
def test_actions_and_options_are_checked(ready, call, given, sentence):
    ready.reset(seed=0)
    how = {"options": given} if call == "reset" else {"action": np.array(given, np.float32)}
    with pytest.raises(ValueError, match=sentence):
        getattr(ready, call)(**how)


def test_gymnasium_is_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchsoft\[learn\]'"):
        importlib.reload(torchsoft.envs)


def test_human_needs_a_window(monkeypatch):
    from matplotlib import pyplot

    pyplot.switch_backend("agg")
    env = small(render_mode="human")
    with pytest.raises(ValueError, match="needs a window, which matplotlib's `agg` has not"):
        env.reset(seed=0)
    shown: list[Any] = []
    monkeypatch.setattr("matplotlib.get_backend", lambda: "tkagg")
    for name in ("show", "pause"):
        monkeypatch.setattr(pyplot, name, lambda *_, **how: shown.append(how))
    env.reset(seed=0)
    first = pyplot.gcf().images[0].get_array().copy()
    env.step(TURN)
    assert shown == [{"block": False}, {}, {}]
    assert (pyplot.gcf().images[0].get_array() != first).any()
    env.close()
    assert pyplot.get_fignums() == []


def test_pictures_follow_the_episode():
    env = small(render_mode="rgb_array")
    with pytest.raises(ValueError, match="call `reset` first"):
        env.render()
    env.reset(seed=0)
    first = env.render()
    env.step(TURN)
    assert first.shape == env.render().shape == (480, 600, 3)
    assert (env.render() != first).any()


@pytest.mark.slow
def test_a_library_trains_unchanged():
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env("torchsoft/Reorient-v0", 2, seed=0)
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=32, n_epochs=2, seed=0, device="cpu")
    before = nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()
    model.learn(256)
    after = nn.utils.parameters_to_vector(model.policy.parameters())
    assert model.num_timesteps == 256
    assert float((after.detach() - before).abs().max()) > 1e-4
    action, _ = model.predict(envs.reset())
    assert action.shape == (2, 3)
