"""Environments of rig files: gymnasium's contract, states handed on, gradients, rejections."""

import copy
import importlib
import re
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from conftest import f64
from gymnasium.utils.env_checker import check_env
from torch import Tensor, nn

import torchsoft.envs
from torchsoft import simulate
from torchsoft.envs import RigEnv, TargetPose, reorient
from torchsoft.envs.rig_env import RedrawnStart
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


def test_check_env_passes():
    check_env(gymnasium.make("torchsoft/Reorient-v0", render_mode="rgb_array").unwrapped)


def lines(env: RigEnv, actions: Tensor, **others: Any) -> Reference:
    """The set-points of actions (actions, times), as the file's signals in SI units."""
    low, high = f64(-12e-3, -12e-3, -20.0), f64(12e-3, 12e-3, -6.0)
    times = 0.05 * torch.arange(actions.shape[1], dtype=torch.float64)
    values = low[:, None] + 0.5 * (high - low)[:, None] * (1 + actions)
    signals = {name: Lines(times, x) for name, x in zip(("lower_x", "upper_x", "grip"), values)}
    return env.dynamics.rig.reference.replaced(signals | others)


PUSHED = {"actuators": {"push": {"pushes": "disc.x", "feed_forward": "push"}},
          "motion": {"push": {"kind": "hold", "value": 0.5}}}  # fmt: skip


@pytest.mark.parametrize(
    "changes", [{}, {"actuators": {"lower_x": {"Ki": 2e5, "lag": 2e-4}}}, PUSHED]
)
def test_an_episode_is_one_run(changes):
    """States are handed on, those of actuators too: many steps are the one run along the same
    lines, with the peak of a disturbance, which is another one in every episode."""
    disturbances = {"push": (-4.0, 4.0)} if changes is PUSHED else {}
    file = FILE.override(**changes, solver={"rtol": 1e-6})
    env = small(rig=file, disturbances=disturbances, duration=0.15)
    actions = f64(0.5, -0.3, 0.0, 0.2, 0.1, 1.0, 0.4, -0.5, -1.0).reshape(3, 3)
    actions = actions.float().double()  # as spaces hold them
    env.reset(seed=0)
    start, others = env.moment, {}
    times = 0.05 * torch.arange(4, dtype=torch.float64)
    if disturbances:
        ((when, peak),) = start.peaks.tolist()
        assert 1 <= when <= 2
        assert -4.0 <= peak <= 4.0
        others = {"push": Lines(times, 0.5 + peak * (torch.arange(4) == when))}
    ends = [env.step(action.numpy().astype(np.float32)) for action in actions]
    reference = lines(env, torch.cat((start.action[None], actions)).T, **others)
    run = simulate(env.dynamics.rig, times, y0=start.y, reference=reference, rtol=1e-6)
    assert (env.moment.y - run.y[-1]).abs().max() < 1e-4 * run.y[-1].abs().max()
    seen = ends[-1][0]
    for name, scale, value in zip(("x", "theta", "omega"), (10e-3, 1.0, 3.0), seen):
        assert value == pytest.approx(float(run[f"{name}_disc"][-1]) / scale, rel=1e-3)
    taxels = [float(run[f"lower_skin.normal.{i}"][-1]) for i in range(8)]
    assert 5.0 * (seen[5:13] + 1.0) == pytest.approx(np.array(taxels), abs=2e-3)
    env.reset()
    assert not disturbances or env.moment.peaks.tolist() != [[when, peak]]


def test_any_channel_is_observed():
    """Signals and efforts too; a reward of one's own sees the run over the interval."""
    seen = []

    def reward(run, action):
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
    hung = FILE.override({"bodies.disc.start.y": 40e-3, "bodies.upper.start.y": 0.08})
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
        assert 0.3e6 <= E <= 0.8e6
        drawn.append([E, float(at), float(env.moment.target[0])])
    assert drawn[0] == drawn[2]
    assert (np.array(drawn[0]) != drawn[1]).all()


def test_starts_that_cannot_be_are_drawn_again():
    lying = FILE.override({"bodies.disc.start.y": "rest"})
    env = small(rig=lying, parameters={"bodies.disc.start.x": (0.0, 0.05)})
    with pytest.warns(RedrawnStart, match=r"no episode begins with bodies.disc.start.x = 0.0.*pad"):
        env.reset(seed=0)
    assert float(env.moment.y[env.dynamics.coordinates["disc.x"]]) < 0.025
    nowhere = small(rig=lying, parameters={"bodies.disc.start.x": (0.03, 0.05)})
    with pytest.raises(ValueError, match="narrow the ranges of `parameters`"):
        nowhere.reset(seed=0)


def test_a_policy_gradient_includes_the_start():
    """Of an episode's reward and of its first observation, with respect to the weights of a policy
    and to E, on which the equilibrium at its start depends; against differences on frozen steps."""
    dynamics = small().dynamics
    E, draw = dynamics.rig.parameter("materials.rubber.E"), torch.Generator().manual_seed(1)
    torch.manual_seed(0)
    policy = nn.Sequential(nn.Linear(dynamics.size, 30), nn.Tanh(), nn.Linear(30, 3), nn.Tanh())
    policy.double()
    weights = nn.utils.parameters_to_vector(policy.parameters()).detach()
    by_seen, frozen = torch.randn(dynamics.size, generator=draw).double(), list[Tensor]()

    def episode(values, first=False):
        nn.utils.vector_to_parameters(values[1:], policy.parameters())
        E.data.fill_(float(values[0]) * 0.5e6)
        moment, total, taken = dynamics.begin(f64(0.3, 0.0)), f64(0.0)[0], list[Tensor]()
        observation = dynamics.observe(moment)
        if first:
            return by_seen @ observation
        for i in range(3):
            done = dynamics.step(moment, policy(observation), frozen[i] if frozen else None)
            moment, observation, total = done.moment, done.observation, total + done.reward
            taken.append(done.knots)
        frozen[:] = frozen or taken
        return total

    at = torch.cat((f64(1.0), weights))
    only_E = torch.zeros_like(at).index_fill_(0, torch.tensor(0), 1.0)
    for first, way in (
        (True, only_E), (False, only_E), (False, torch.randn(len(at), generator=draw).double()),
    ):  # fmt: skip
        episode(at)
        E.grad = None
        policy.zero_grad()
        episode(at, first).backward()
        grads = [torch.zeros_like(x) if x.grad is None else x.grad for x in policy.parameters()]
        slope = torch.cat((E.grad.reshape(1) * 0.5e6, nn.utils.parameters_to_vector(grads)))
        with torch.no_grad():
            more, less = (float(episode(at + h * way, first)) for h in (1e-6, -1e-6))
        expected = (more - less) / 2e-6
        assert float(slope @ way) == pytest.approx(expected, rel=1e-4)
        assert abs(expected) > 1e-4


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


REJECTED = [
    ({"actions": {"lower_y": (0, 1)}}, "`actions` names `lower_y`; did you mean `lower_"),
    ({"disturbances": {"grip": (0.0, 1.0)}}, "signals that no action sets are upper_rate"),
    ({"actions": {}}, "`actions` is empty; name signals of lower_x"),
    ({"actions": {"grip": (1.0, 1.0)}}, "a pair of finite numbers, low below high"),
    ({"observations": {"x_disk": (0, 1)}}, "names `x_disk`; did you mean `x_disc`"),
    ({"interval": 1e-6}, "`interval` must be at least 0.0001 s"),
    ({"duration": 0.25}, "must be a multiple of `interval` = 0.1 s, but is 0.25 s"),
    ({"begin": 2.25}, "but is 0.05 s, the rest of the run after `begin`"),
    ({"begin": 9.0, "duration": 0.5}, "9 s is not before the end of the rig's own motion"),
    ({"reward": lambda *_: 0.0}, "give either `goal` or `reward`: each defines"),
    ({"goal": TargetPose("disk", {"x": 0.0}, {"x": 1.0})}, "`goal.target` names `disk.x`; did"),
    ({"goal": TargetPose("disc", {"x": 0.0}, {"y": 1.0})}, "must have the coordinates of"),
    ({"bounds": {"lower.y": (0, 1)}}, "`lower.y`; did you mean `lower.x`? (free are disc.x"),
    ({"held": ["disk"]}, "`held` names `disk`; did you mean `disc`"),
    ({"parameters": {"materials.rubber.e": (1, 2)}}, "is not in the rig file"),
    ({"parameters": {"materials.rubber.nu": (0.4, 0.6)}}, "= 0.6: "),
    ({"render_mode": "human"}, "`render_mode` must be 'rgb_array' or None, but is 'human'"),
    ({"rig": 3}, "`rig` must be a rig file, its path"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), REJECTED)
def test_arguments_that_do_not_fit_together_are_rejected(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        reorient(**changes)


@pytest.mark.parametrize(
    ("action", "target", "message"),
    [
        ([np.nan, 0, 0], None, "sets `lower_x` to nan, but must be from -1 to 1"),
        ([0, 1.5, 0], None, "sets `upper_x` to 1.5, but must be from -1 to 1; clip it, or wrap"),
        ([0, 0], None, "must hold 3 numbers, for lower_x, upper_x, grip"),
        (None, {"taget": {}}, "`options` names `taget`; did you mean `target`"),
        (None, {"target": {"y": 0.0}}, "`target` names `y`; the goal has theta, x"),
        (None, {"target": {"x": np.inf}}, "`target` must be finite"),
    ],
)
def test_actions_and_options_are_checked(ready, action, target, message):
    ready.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        ready.reset(options=target) if target else ready.step(np.array(action, np.float32))


def test_gymnasium_is_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchsoft\[learn\]'"):
        importlib.reload(torchsoft.envs)


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
