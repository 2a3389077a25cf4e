"""Question: do exact gradients teach a policy faster than samples of its return do?

Two soft jaws on soft loops bring a disc to an angle that each episode draws, while it is pushed and
turned by forces that the policy does not see. A network of one hidden layer sees the disc, its
velocity and the goal ten times a second, and sets both set-points and the grip. It learns three
times over, from the same start, on the same environment, for the same processor time of a core:

- by gradient: analytic gradients over horizons of a few steps, closed by a critic (Xu et al.,
  Accelerated policy learning with parallel differentiable simulation, 2022);
- by PPO of stable-baselines3;
- by CMA-ES of pycma, on the weights.

The mean return of ten episodes that no training sees is measured along the way, outside of the
clock. The last policy of the first seed becomes the weights of a controller of the rig file, which
runs compiled and continuously, and a TorchScript program.

Command: .venv/bin/python experiments/learn_policy.py [--seeds 5] [--seconds 200] [--smoke]
Expected: the gradient is at 95 % of the last return of PPO in a fifth of the samples, and PPO ends
4 % higher; experiments/README.md has the table. Five seeds of three methods take an hour on a core.
"""

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from tqdm import tqdm

from torchsoft import simulate
from torchsoft.envs import RIG, RigEnv, reorient
from torchsoft.envs.dynamics import limits
from torchsoft.experiment import markdown, options, timed, write
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.written import to_toml
from torchsoft.solve.progress import SimulationFailed

GAINS = {"Kp": 2e3, "Kd": 60.0}
"""Of the loops of both jaws [N/m, N.s/m]: soft ones, which pushes move."""

READY = RigFile.from_toml(RIG)

FORCES = {"push_x": (-14.0, 14.0), "push_theta": (-0.15, 0.15)}
"""Peaks of what pushes the disc [N] and turns it [N.m]."""

PUSHES = {
    "push_x": {"pushes": "disc.x", "feed_forward": "push_x"},
    "push_theta": {"pushes": "disc.theta", "feed_forward": "push_theta"},
}
QUIET = {push: {"kind": "hold", "value": 0.0} for push in PUSHES}

OBSERVED = {
    "x_disc": (-10e-3, 10e-3), "theta_disc": (-1.0, 1.0), "v_x_disc": (-0.1, 0.1),
    "omega_disc": (-3.0, 3.0),
}  # fmt: skip
SEEN = len(OBSERVED) + 2
"""What the policy sees: these, and the distances to the goal; not its last action."""

DISCOUNT, TRACE = 0.95, 0.95
"""Of later rewards, and of later estimates in the critic's targets."""

LEVEL = 0.95
"""Part of PPO's mean return at the end, which is to be reached."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/learn_policy")
    seeds: int = 5
    seconds: float = 200.0  # processor time of each training
    methods: tuple[str, ...] = ("gradient", "PPO", "CMA-ES")
    hidden: int = 32  # neurons
    horizon: int = 5  # steps of a gradient
    actors: int = 4  # episodes side by side for a gradient
    episodes: int = 10  # of an evaluation
    evaluations: int = 10  # along a training
    smoke: bool = False  # seconds


@dataclass
class History:
    """A training: samples, processor time [s] and mean return at every evaluation."""

    method: str
    seed: int
    samples: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)


def environment() -> RigEnv:
    loops = dict.fromkeys(("lower_x", "upper_x"), GAINS)
    rig = READY.override(actuators=loops | PUSHES, motion=QUIET)
    env = reorient(rig=rig, disturbances=FORCES, observations=OBSERVED)
    env.dynamics.rig.requires_grad_(False)
    return env


def network(hidden: int, actions: int, seed: int) -> nn.Sequential:
    """A policy: what is seen, to actions in [-1, 1]; small ones at the start."""
    torch.manual_seed(seed)
    last = nn.Linear(hidden, actions)
    policy = nn.Sequential(nn.Linear(SEEN, hidden), nn.Tanh(), last, nn.Tanh())
    with torch.no_grad():
        last.weight *= 0.1
    return policy.double()


class Training:
    """The clock of a training, which stops while the policy is evaluated."""

    def __init__(self, config: Config, method: str, seed: int, env: RigEnv) -> None:
        self.config, self.env, self.history = config, env, History(method, seed)
        self._begin, self._next = process_time(), 0
        self._bar = tqdm(
            total=round(config.seconds), desc=f"{method} {seed}", unit="s", disable=None
        )

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return process_time() - self._begin >= self.config.seconds

    def over(self, samples: int, act: Callable[[np.ndarray], np.ndarray]) -> bool:
        """Evaluate where it is time to; whether the time is up."""
        now = process_time() - self._begin
        self._bar.update(min(round(now), self._bar.total) - self._bar.n)
        over = now >= self.config.seconds
        if over or now >= self._next * self.config.seconds / self.config.evaluations:
            mean = float(
                np.mean([episode(self.env, act, 1000 + i) for i in range(self.config.episodes)])
            )
            self.history.samples.append(samples)
            self.history.seconds.append(now)
            self.history.returns.append(mean)
            self._bar.set_postfix_str(f"return {mean:.2f}")
            self._next += 1
            self._begin = process_time() - now
        if over:
            self._bar.close()
        return over


def episode(env: RigEnv, act: Callable[[np.ndarray], np.ndarray], seed: int) -> float:
    """Sum of the rewards of one episode."""
    seen, _ = env.reset(seed=seed)
    total, over = 0.0, False
    while not over:
        seen, reward, *ends, _ = env.step(act(seen[:SEEN]))
        total, over = total + reward, any(ends)
    return total


def acting(policy: nn.Module) -> Callable[[np.ndarray], np.ndarray]:
    def act(seen: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return policy(torch.from_numpy(seen).double()).numpy().astype(np.float32)

    return act


def by_gradient(config: Config, seed: int) -> tuple[History, nn.Module]:
    """Short horizons of episodes side by side; the critic tells what comes after them."""
    env, evaluated = environment(), environment()
    policy = network(config.hidden, len(env.dynamics.actions), seed)
    critic = nn.Sequential(nn.Linear(SEEN, 64), nn.Tanh(), nn.Linear(64, 1)).double()
    slow = deepcopy(critic)
    learners = [torch.optim.Adam(one.parameters(), lr=5e-3) for one in (policy, critic)]
    training, samples = Training(config, "gradient", seed, evaluated), 0
    env.reset(seed=seed)
    moments = [begun(env) for _ in range(config.actors)]
    while not training.over(samples, acting(policy)):
        total, seen, targets = torch.zeros(()).double(), list[Tensor](), list[Tensor]()
        for i in range(config.actors):
            walked = walk(env, policy, slow, moments[i], config.horizon)
            total = total + walked.value
            moments[i] = walked.moment
            seen += walked.seen
            targets += walked.targets
            samples += len(walked.seen)
        learners[0].zero_grad()
        (-total / config.actors).backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        learners[0].step()
        left = 1 - training.history.seconds[-1] / config.seconds
        learners[0].param_groups[0]["lr"] = 5e-3 * max(left, 0.02)
        for _ in range(8):
            learners[1].zero_grad()
            misfit = critic(torch.stack(seen))[:, 0] - torch.stack(targets)
            misfit.square().mean().backward()
            learners[1].step()
        with torch.no_grad():
            for old, new in zip(slow.parameters(), critic.parameters()):
                old.lerp_(new, 0.2)
    return training.history, policy


def begun(env: RigEnv) -> Any:
    env.reset()
    return env.moment


@dataclass
class Walk:
    """A horizon: its discounted return () with the critic's estimate of the rest, where it ended,
    what was seen, and what the critic is to say there."""

    value: Tensor
    moment: Any
    seen: list[Tensor]
    targets: list[Tensor]


def walk(env: RigEnv, policy: nn.Module, critic: nn.Module, moment: Any, horizon: int) -> Walk:
    dynamics, rewards, seen = env.dynamics, list[Tensor](), list[Tensor]()
    now = moment._replace(
        y=moment.y.detach(), action=moment.action.detach(), recorded=moment.recorded.detach()
    )
    observed, failed, values = dynamics.observe(now)[:SEEN], False, list[Tensor]()
    for _ in range(horizon):
        seen.append(observed.detach())
        noise = 0.1 * torch.randn(len(dynamics.actions), dtype=torch.float64)
        try:
            now, after, reward, _ = dynamics.step(now, (policy(observed) + noise).clamp(-1, 1))
            failed = bool(env.ended(now))
            observed = after[:SEEN]
        except (SimulationFailed, np.linalg.LinAlgError):
            failed = True
        rewards.append(torch.tensor(env.failure_reward).double() if failed else reward)
        values.append(torch.zeros(()).double() if failed else critic(observed)[0])
        if failed or now.steps >= env.limit:
            now = begun(env)
            break
    value = sum((DISCOUNT**k * r for k, r in enumerate(rewards)), torch.zeros(()).double())
    value = value + DISCOUNT ** len(rewards) * values[-1]
    targets, later = list[Tensor](), values[-1].detach()
    for reward, estimate in zip(reversed(rewards), reversed(values)):
        later = reward.detach() + DISCOUNT * ((1 - TRACE) * estimate.detach() + TRACE * later)
        targets.insert(0, later)
    return Walk(value, now, seen, targets)


def by_ppo(config: Config, seed: int) -> tuple[History, nn.Module]:
    import gymnasium
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    env, evaluated = environment(), environment()
    part = gymnasium.spaces.Box(-np.inf, np.inf, (SEEN,), np.float32)
    short = gymnasium.wrappers.TransformObservation(env, lambda seen: seen[:SEEN], part)
    layers = {"net_arch": [config.hidden], "log_std_init": -1.0}
    learner = PPO(
        "MlpPolicy", short, learning_rate=1e-3, n_steps=400, batch_size=80, gamma=DISCOUNT,
        policy_kwargs=layers, seed=seed, device="cpu",
    )  # fmt: skip
    training = Training(config, "PPO", seed, evaluated)

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            return not training.over(
                self.num_timesteps, lambda seen: learner.predict(seen, deterministic=True)[0]
            )

    learner.learn(10**9, Watch())
    return training.history, learner.policy


def by_evolution(config: Config, seed: int) -> tuple[History, nn.Module]:
    """Weights that are drawn, two episodes each, the same for all of a generation."""
    import cma

    env, evaluated = environment(), environment()
    policy = network(config.hidden, len(env.dynamics.actions), seed)
    start = nn.utils.parameters_to_vector(policy.parameters()).detach().numpy()
    options = {"seed": seed + 1, "popsize": 16, "verbose": -9, "CMA_diagonal": True}
    search = cma.CMAEvolutionStrategy(start, 0.2, options)
    training, samples, mean = Training(config, "CMA-ES", seed, evaluated), 0, deepcopy(policy)
    draws = np.random.default_rng(seed)

    def load(one: nn.Module, weights: np.ndarray) -> nn.Module:
        nn.utils.vector_to_parameters(torch.from_numpy(weights), one.parameters())
        return one

    while not training.over(samples, acting(load(mean, search.mean))):
        weights, seeds = search.ask(), draws.integers(2**30, size=2).tolist()
        costs = []
        for one in weights:
            acts = acting(load(policy, one))
            costs.append(-float(np.mean([episode(env, acts, k) for k in seeds])))
            samples += len(seeds) * env.limit
            if training.late:
                break
        if len(costs) < len(weights):
            continue
        search.tell(weights, costs)
    return training.history, load(mean, search.mean)


METHODS = {"gradient": by_gradient, "PPO": by_ppo, "CMA-ES": by_evolution}


def weights(policy: nn.Module, env: RigEnv) -> dict[str, np.ndarray]:
    """The policy as a network of a rig file's controller: the ranges of what is seen are part of
    the first layer, those of the actions of a last one, which gives efforts [N] on both jaws."""
    (low, half), (origin, span) = limits(env.dynamics.actions), limits(OBSERVED)
    scale = env.dynamics.goal.scale  # pyright: ignore[reportOptionalMemberAccess]
    # set-points theta, x; their rates; theta, x of the disc, three of the jaws; their rates
    seen = torch.zeros(SEEN, 14, dtype=torch.float64)
    for row, column in enumerate((5, 4, 10, 9)):  # x, theta, v_x, omega
        seen[row, column] = 1 / span[row]
    for row, (axis, at) in enumerate((("theta", 0), ("x", 1)), len(OBSERVED)):
        seen[row, at], seen[row, at + 4] = 1 / scale[axis], -1 / scale[axis]
    offset = torch.zeros(SEEN, dtype=torch.float64)
    offset[: len(OBSERVED)] = -origin / span - 1
    first, second = (one for one in policy.children() if isinstance(one, nn.Linear))
    force = torch.tensor([GAINS["Kp"], GAINS["Kp"], 1.0]).double()
    layers = {
        "0.weight": first.weight @ seen, "0.bias": first.bias + first.weight @ offset,
        "2.weight": second.weight, "2.bias": second.bias,
        "4.weight": torch.diag(force * half), "4.bias": force * (low + half),
    }  # fmt: skip
    return {name: x.detach().numpy() for name, x in layers.items()}


def deployed(config: Config, policy: nn.Module, env: RigEnv) -> RigFile:
    """The rig file with the policy as its controller, continuous in time, and its weights."""
    np.savez(config.out / "policy.npz", **weights(policy, env))  # pyright: ignore[reportArgumentType]
    given = READY.model_dump(exclude_unset=True)
    del given["actuators"]["lower_x"], given["actuators"]["upper_x"]
    del given["actuators"]["grip"]["feed_forward"]
    for name in ("grip", "lower_x", "upper_x"):
        del given["motion"][name]
    gain = np.zeros((3, 10))
    gain[(0, 1), (2, 3)], gain[(0, 1), (7, 8)] = GAINS["Kp"], GAINS["Kd"]
    given["controllers"] = {"policy": {
        "measures": ["disc.theta", "disc.x", "lower.x", "upper.x", "upper.y"],
        "setpoints": ["theta_d", "x_d"], "pushes": ["lower.x", "upper.x", "upper.y"],
        "gain": gain.tolist(), "network": "policy.npz",
    }}  # fmt: skip
    given["motion"] |= QUIET | {name: {"kind": "hold", "value": 0.0} for name in ("theta_d", "x_d")}
    given["actuators"] |= PUSHES
    path = config.out / "policy.toml"
    path.write_text(to_toml(RigFile.model_validate(given)), encoding="utf-8")
    return RigFile.from_toml(path)


def exported(config: Config, policy: nn.Module) -> Path:
    """The policy as a TorchScript program, which needs neither this file nor torchsoft."""
    path, seen = config.out / "policy.pt", torch.randn(5, SEEN).double()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.trace(policy, seen), path)
        same = torch.equal(torch.jit.load(path)(seen), policy(seen))
    if not same:
        raise AssertionError(f"{path} does not act as the policy does")
    return path


def in_engine(config: Config, policy: nn.Module) -> dict[str, Any]:
    """Angles that are missed where a push of 8 N passes, by the policy ten times a second and as
    a controller of the rig file; and the wall time of a run of the latter [s]."""
    env = environment()
    rig, act = deployed(config, policy, env), acting(policy)
    missed: dict[str, list[float]] = {"ten times a second": [], "in the engine": []}
    passing = {"kind": "profile", "times": [1.0, 1.1, 1.2], "values": [0.0, 8.0, 0.0]}
    seconds = []
    for target in (-0.5, -0.25, 0.0, 0.25, 0.5):
        env.reset(options={"target": {"theta": target}})
        peak = torch.tensor([[8.0, 8.0], [0.0, 0.0]]).double()  # 1.1 s: eight steps after 0.3 s
        env.moment = env.moment._replace(peaks=peak)  # pyright: ignore[reportOptionalMemberAccess]
        seen, over = env.dynamics.observe(env.moment).numpy(), False
        while not over:
            seen, _, *ends, _ = env.step(act(seen[:SEEN]))
            over = any(ends)
        there = float(env.moment.y[env.dynamics.coordinates["disc.theta"]])
        built = rig.override(motion={"theta_d": {"value": target}, "push_x": passing}).build()
        run, wall = timed(partial(simulate, built.rig, built.t, y0=built.y0, rtol=1e-3))
        seconds.append(wall)
        for name, theta in zip(missed, (there, run["theta_disc"][-1].item())):
            missed[name].append(abs(theta - target))
    return {"missed_rad": missed, "run_s": float(np.median(seconds))}


def run(config: Config) -> None:
    if config.smoke:
        config = replace(config, seconds=3.0, seeds=1, evaluations=1, episodes=1)
    config.out.mkdir(parents=True, exist_ok=True)
    every, content = list[History](), dict[str, Any]()
    for seed in range(config.seeds):
        for name in config.methods:
            history, policy = METHODS[name](config, seed)
            every.append(history)
            if name == "gradient" and seed == 0:
                exported(config, policy)
                content["deployed"] = in_engine(config, policy)
            content |= {"trainings": [asdict(one) for one in every], "reached": reached(every)}
            write(config, content, {"learn_policy": figure(every)}, table(every, content))


def reached(every: Sequence[History]) -> dict[str, Any]:
    """By method: returns at the end, and samples and seconds until the mean return is PPO's at its
    end, for the seeds that get there."""
    ends = [one.returns[-1] for one in every if one.method == "PPO"]
    level = float(np.mean(ends)) if ends else float("nan")
    out: dict[str, Any] = {"level": level}
    for name in dict.fromkeys(one.method for one in every):
        mine = [one for one in every if one.method == name]
        first = [
            next((i for i, x in enumerate(one.returns) if x >= LEVEL * level), None) for one in mine
        ]
        there = [(one, i) for one, i in zip(mine, first) if i is not None]
        out[name] = {
            "returns": [one.returns[-1] for one in mine], "reached": len(there),
            "samples": [one.samples[i] for one, i in there],
            "seconds": [one.seconds[i] for one, i in there],
        }  # fmt: skip
    return out


def table(every: Sequence[History], content: dict[str, Any]) -> str:
    def middle(values: Sequence[float]) -> str:
        spread = f" ({min(values):.0f} .. {max(values):.0f})" if len(values) > 1 else ""
        return f"{np.median(values):.0f}{spread}" if values else "-"

    found, rows = content["reached"], []
    for name in dict.fromkeys(one.method for one in every):
        one, mine = found[name], [h for h in every if h.method == name]
        returns = " ".join(f"{x:.1f}" for x in sorted(one["returns"]))
        rows.append(
            (
                name,
                returns,
                middle([h.samples[-1] for h in mine]),
                f"{one['reached']} of {len(mine)}",
                middle(one["samples"]),
                middle(one["seconds"]),
            )
        )
    head = ("method", "returns at the end", "samples", f"reach {LEVEL:.0%} of PPO's",
            "after samples", "after seconds")  # fmt: skip
    parts = [markdown(head, rows)]
    if "deployed" in content:
        rows = [(name, *(f"{1e3 * x:.0f}" for x in values))
                for name, values in content["deployed"]["missed_rad"].items()]  # fmt: skip
        head = ("angle missed [mrad] at a target of", "-0.5", "-0.25", "0", "0.25", "0.5 rad")
        parts.append(markdown(head, rows))
    return "\n\n".join(parts)


def figure(every: Sequence[History]) -> Figure:
    """Return against samples and against processor time, a line a seed."""
    fig = Figure(figsize=(7.2, 3.2), layout="constrained")
    left, right = fig.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(one.method for one in every))
    for one in every:
        colour = f"C{names.index(one.method)}"
        label = one.method if one is next(h for h in every if h.method == one.method) else None
        left.semilogx(np.maximum(one.samples, 100), one.returns, colour, lw=1, label=label)
        right.plot(one.seconds, one.returns, colour, lw=1)
    left.set(xlabel="samples", ylabel="mean return of ten episodes")
    right.set(xlabel="processor time [s]")
    left.legend(frameon=False)
    return fig


if __name__ == "__main__":
    run(options(Config, __doc__))
