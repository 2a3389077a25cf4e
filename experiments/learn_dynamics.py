"""Question: what can be learned of contact from a dataset, inside the simulator and instead of it?

A dataset of two soft jaws that carry a heavy disc to and fro, so fast that it slips, is made by a
law whose friction coefficient falls with the slip speed. Two networks learn from its training
split, and are held against its test split:

- a **residual** inside the simulator: mu(v), a network of the slip speed in the friction law,
  learned from noisy x and theta of the disc by the gradient of whole runs; besides it a coefficient
  that is constant, as it is and fitted the same way;
- a **surrogate** instead of it: the friction on both pads, which a skin of normal taxels does not
  feel, from 120 ms of the jaws' motion and of those taxels.

Command: .venv/bin/python experiments/learn_dynamics.py [--smoke]
Expected: see experiments/README.md. About five minutes on one core.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from torchsoft import Profile, Reference, SmoothSlip, simulate
from torchsoft.datasets import Trajectories, open_dataset
from torchsoft.datasets.config import Config as Dataset
from torchsoft.datasets.generate import Serial, generate
from torchsoft.envs import RIG
from torchsoft.experiment import at_the_points, markdown, options, write
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.written import to_toml
from torchsoft.solve.progress import SimulationFailed

JAWS = ("lower", "upper")

TIMES = [0.2, 0.26, 0.31, 0.37]
"""Of a jaw's motion [s]: from rest to one place, a wait, to another place."""

NOISE = {"x_disc": 10e-6, "theta_disc": 0.5e-3}
"""Standard deviations [m, rad] of what the residual learns from."""

SCALE = {"x_disc": 0.2e-3, "theta_disc": 10e-3}
"""Misfits [m, rad] that count as one."""

TAXEL, TAXELS, TAXEL_NOISE = 6e-3, 8, 0.02
"""Width [m] and number of each skin's, and the standard deviation [N] of what they feel."""

SWEEPS = 4
"""Fixed-point sweeps for mu(v) and v; each shrinks the error by about (mu_s - mu_k) F_N / (R v_s),
0.1 here."""

MOTION = tuple(f"{channel}_{jaw}" for channel in ("x", "v_x") for jaw in JAWS) + (
    "y_upper", "v_y_upper",
)  # fmt: skip


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/learn_dynamics")
    trajectories: int = 320
    learned: int = 32  # trajectories that the residual learns from, 16 a step
    held_out: int = 24  # on which it is tried
    sweeps: int = 25  # of these
    window: int = 30  # samples that the surrogate sees, 4 ms apart
    epochs: int = 40
    hidden: int = 48
    seed: int = 0
    smoke: bool = False  # a size that takes seconds


class MuNetwork(nn.Module):
    """Friction whose coefficient is a network of the slip speed: mu(v) = 0.5 + 0.4 tanh(net(log(1 +
    v / v_0))), with R |gamma'| = <E - mu(|gamma'|) F_N>+. Without hidden neurons the
    coefficient is a constant."""

    def __init__(self, width: int = 8, v_0: float = 0.01) -> None:
        super().__init__()
        self.v_0 = v_0
        self.constant = nn.Parameter(torch.zeros((), dtype=torch.float64))
        self.net = None
        if width:
            last = nn.Linear(width, 1, bias=False)
            nn.init.zeros_(last.weight)
            self.net = nn.Sequential(nn.Linear(1, width), nn.Tanh(), last).double()

    def mu(self, v: Tensor) -> Tensor:
        """Friction coefficient at the slip speed v (...) [m/s]."""
        raw = self.constant + 0.0 * v
        if self.net is not None:
            raw = raw + self.net(torch.log1p(v[..., None] / self.v_0))[..., 0]
        return 0.5 + 0.4 * torch.tanh(raw)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        v = torch.zeros_like(E + F_N)
        for _ in range(SWEEPS):
            v = (E - self.mu(v) * F_N).clamp(min=0.0) / R
        return v


def true_mu(law: SmoothSlip, v: Tensor) -> Tensor:
    return law.mu_k + (law.mu_s - law.mu_k) / (1 + v / law.v_s)


def rig_file() -> RigFile:
    slip = {"kind": "smooth", "mu_s": 0.8, "mu_k": 0.35, "v_s": 50e-3}
    carried = {"kind": "profile", "times": TIMES, "values": [0.0, 0.0, 0.0, 0.0]}
    return RigFile.from_toml(RIG).override(
        bodies={"disc": {"mass": 1.0, "start": {"y": "rest"}}},
        laws={"dry": {"friction": slip}},
        motion={f"{jaw}_x": carried for jaw in JAWS},
    )


def dataset(config: Config) -> str:
    """The store, made or completed."""
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "rig.toml").write_text(to_toml(rig_file()), encoding="utf-8")
    ranges = []
    for jaw in JAWS:
        at = f"motion.{jaw}_x.values"
        ranges += [
            f'"{at}.1" = {{ low = -15e-3, high = 15e-3 }}',
            f'"{at}.2" = {{ choices = [1.0], ratio_to = "{at}.1" }}',
            f'"{at}.3" = {{ low = -15e-3, high = 15e-3 }}',
        ]
    path = config.out / "dataset.toml"
    path.write_text("\n".join((
        'title = "A heavy disc between two fast jaws"', 'rig = "rig.toml"',
        f"seed = {config.seed}", f"trajectories = {config.trajectories}",
        "trajectories_per_shard = 16", "duration = 0.48", "sample_interval = 4e-3", "nodal = true",
        "[parameters]", *ranges, '"motion.grip.values_2" = { low = -8.0, high = -4.0 }',
    )), encoding="utf-8")  # fmt: skip
    url = str(config.out / "data")
    generate(Dataset.from_toml(path), url, Serial())
    return url


# the residual


@dataclass(frozen=True)
class Runs:
    """Trajectories of a split: motions, and what is measured of the disc, (T, 2) each."""

    t: Tensor
    references: list[Reference]
    measured: list[Tensor]


def runs(config: Config, url: str, split: str, count: int) -> Runs:
    data, draws = open_dataset(url), np.random.default_rng(config.seed)
    use = np.flatnonzero((data["split"] == split).values & ~data["failed"].values.astype(bool))
    references, measured = list[Reference](), list[Tensor]()
    for one in (data.isel(trajectory=i).load() for i in use[:count]):
        held = {
            f"{jaw}_x": Profile(TIMES, [0.0] + [
                float(one[f"motion.{jaw}_x.values.{k}"]) for k in (1, 2, 3)])
            for jaw in JAWS
        }  # fmt: skip
        grip = Profile([0.0, 0.2], [-5.0, float(one["motion.grip.values_2"])])
        references.append(Reference(**held, grip=grip, upper_rate=Profile([0.0], [0.0])))
        columns = [
            one[name].values + sd * draws.standard_normal(one.sizes["time"])
            for name, sd in NOISE.items()
        ]
        measured.append(torch.from_numpy(np.stack(columns, -1)))
    return Runs(torch.tensor(data["time"].values), references, measured)


class Residual:
    """The rig with a friction law of one's own, and its misfits."""

    def __init__(self, width: int) -> None:
        built = rig_file().build()
        self.rig, self.y0 = built.rig, built.y0.detach()
        laws = {id(one.law): one.law for one in self.rig.contacts.values()}.values()
        truth = next(iter(laws)).friction
        assert isinstance(truth, SmoothSlip)
        self.truth, self.law = truth, MuNetwork(width)
        self.rig.requires_grad_(False)
        for one in laws:
            one.friction = self.law

    def misfit(self, given: Runs, i: int, gradient: Literal["none", "discrete"] = "none") -> Tensor:
        """Run i less its measurement (T, 2), over `SCALE`. Raises `SimulationFailed`."""
        run = simulate(
            self.rig,
            given.t,
            y0=self.y0,
            reference=given.references[i],
            rtol=1e-4,
            gradient=gradient,
        )
        scale = torch.tensor(list(SCALE.values()), dtype=torch.float64)
        return (run.together(*SCALE) - given.measured[i]) / scale

    def learn(self, config: Config, given: Runs) -> list[float]:
        """Mean losses of the sweeps; a run that fails is left out of its step."""
        optimiser = torch.optim.Adam(self.law.parameters(), lr=0.03)
        steps = config.sweeps * max(len(given.references) // 16, 1)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        draws, losses = np.random.default_rng(config.seed), list[float]()
        for _ in tqdm(range(config.sweeps), desc="sweeps of the residual", disable=None):
            order, found = draws.permutation(len(given.references)), list[float]()
            for part in np.array_split(order, max(len(order) // 16, 1)):
                optimiser.zero_grad()
                for i in part:
                    try:
                        # far off, a misfit counts by its size: runs end elsewhere altogether then
                        loss = (1 + self.misfit(given, i, "discrete").square()).sqrt().mean()
                    except SimulationFailed:
                        continue
                    (loss / len(part)).backward()
                    found.append(loss.item())
                optimiser.step()
                schedule.step()
            losses.append(float(np.mean(found)))
        return losses

    def errors(self, given: Runs) -> dict[str, float]:
        """Root mean square misfits on runs, by channel [m, rad]."""
        with torch.no_grad():
            squares = [self.misfit(given, i).square().mean(0) for i in range(len(given.references))]
        rms = torch.stack(squares).mean(0).sqrt().tolist()
        return {name: x * scale for (name, scale), x in zip(SCALE.items(), rms)}


def slip_speeds(residual: Residual, given: Runs) -> tuple[float, float]:
    """Slip speeds [m/s] in the first of the runs: their 10 and 95 % quantiles."""
    speeds = []
    for reference in given.references[:4]:
        run = simulate(residual.rig, given.t, y0=residual.y0, reference=reference, rtol=1e-4)
        speeds.append(at_the_points(residual.rig, run.t, run.y)[1].flatten())
    every = torch.cat(speeds)
    low, high = every[every > 1e-4].quantile(torch.tensor([0.1, 0.95]).double()).tolist()
    return low, high


# the surrogate


class Surrogate(nn.Module):
    """Friction on both pads [sd] at the end of a history (B, T, inputs) [sd]."""

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.memory = nn.GRU(inputs, hidden, batch_first=True)
        self.last = nn.Linear(hidden, 2)

    def forward(self, history: Tensor) -> Tensor:
        return self.last(self.memory(history)[0][:, -1])


@dataclass(frozen=True)
class Histories:
    """Windows: the jaws' motion (N, T, 6), taxels (N, T, 16) [N], friction at their end (N, 2)
    [N]; and how many a second the loader gave."""

    motion: Tensor
    touch: Tensor
    friction: Tensor
    per_second: float


def histories(config: Config, url: str, split: str) -> Histories:
    forces = [f"{sort}_force_{jaw}" for sort in ("normal", "friction") for jaw in JAWS]
    windows = Trajectories(
        url, [*MOTION, *forces], split=split, window=config.window, stride=5, dtype=torch.float32
    )
    places = [open_dataset(url)[f"{jaw}_places"].values[:, 0] for jaw in JAWS]
    bins = [torch.from_numpy(np.clip(x // TAXEL + TAXELS // 2, 0, TAXELS - 1)).long()
            for x in places]  # fmt: skip
    torch.manual_seed(config.seed)
    motion, touch, friction = list[Tensor](), list[Tensor](), list[Tensor]()
    begin = perf_counter()
    batches = list(DataLoader(windows, batch_size=128, shuffle=True))
    per_second = len(windows) / (perf_counter() - begin)
    for batch in batches:
        motion.append(torch.stack([batch[name] for name in MOTION], -1))
        felt = [
            torch.zeros(*batch[f"normal_force_{jaw}"].shape[:2], TAXELS).index_add(
                -1, at, batch[f"normal_force_{jaw}"])
            for jaw, at in zip(JAWS, bins)
        ]  # fmt: skip
        touch.append(torch.cat(felt, -1))
        friction.append(torch.stack(
            [batch[f"friction_force_{jaw}"][:, -1].sum(-1) for jaw in JAWS], -1))  # fmt: skip
    all_touch = torch.cat(touch)
    noise = TAXEL_NOISE * torch.randn(all_touch.shape)
    return Histories(torch.cat(motion), all_touch + noise, torch.cat(friction), per_second)


def surrogates(config: Config, url: str) -> tuple[dict[str, float], float]:
    """Held-out error over the standard deviation of the friction, by method and senses; windows a
    second."""
    train, test = (histories(config, url, split) for split in ("train", "test"))
    senses = {
        "motion": lambda one: one.motion, "touch": lambda one: one.touch,
        "motion and touch": lambda one: torch.cat((one.motion, one.touch), -1),
    }  # fmt: skip
    mean, sd = train.friction.mean(0), train.friction.std(0)
    target, truth = (train.friction - mean) / sd, (test.friction - mean) / sd
    out: dict[str, float] = {}
    for name, of in senses.items():
        middle, spread = of(train).mean((0, 1)), of(train).std((0, 1)).clamp(min=1e-9)
        x, held = ((of(one) - middle) / spread for one in (train, test))
        flat = [torch.cat((one.flatten(1), torch.ones(len(one), 1)), 1).double()
                for one in (x, held)]  # fmt: skip
        ridge = flat[0].T @ flat[0] + 1e-2 * len(x) * torch.eye(flat[0].shape[1]).double()
        linear = flat[1] @ torch.linalg.solve(ridge, flat[0].T @ target.double())
        out[f"linear, {name}"] = float((linear - truth).square().mean().sqrt())
        network = trained(config, x, target)
        with torch.no_grad():
            out[f"network, {name}"] = float((network(held) - truth).square().mean().sqrt())
    return out, train.per_second


def trained(config: Config, x: Tensor, target: Tensor) -> Surrogate:
    torch.manual_seed(config.seed)
    network = Surrogate(x.shape[-1], config.hidden)
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.epochs)
    for _ in tqdm(range(config.epochs), desc="epochs of the surrogate", disable=None):
        for part in torch.randperm(len(x)).split(128):
            optimiser.zero_grad()
            (network(x[part]) - target[part]).square().mean().backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
        schedule.step()
    return network


# all of it


def run(config: Config) -> tuple[dict[str, Any], Figure]:
    if config.smoke:
        config = replace(
            config, trajectories=16, learned=2, held_out=1, sweeps=2, epochs=1, hidden=8
        )
    torch.manual_seed(config.seed)
    url = dataset(config)
    learn = runs(config, url, "train", config.learned)
    held = runs(config, url, "test", config.held_out)
    found: dict[str, Any] = {}
    students = {"mu = 0.5": Residual(0), "constant, fitted": Residual(0), "network": Residual(8)}
    for name, one in students.items():
        if name != "mu = 0.5":
            found[f"losses, {name}"] = one.learn(config, learn)
    found["held out"] = {name: one.errors(held) for name, one in students.items()}
    network, fitted = students["network"], students["constant, fitted"]
    low, high = slip_speeds(network, learn)
    with torch.no_grad():
        v = torch.linspace(low, high, 100, dtype=torch.float64)
        off = (network.law.mu(v) - true_mu(network.truth, v)).abs()
    found |= {
        "mu_error_mean": float(off.mean()),
        "mu_error_max": float(off.max()),
        "slip_mm_s": [1e3 * low, 1e3 * high],
    }
    found["surrogate"], found["windows_per_second"] = surrogates(config, url)
    return found, figure(network, fitted, (low, high), found)


def table(found: dict[str, Any]) -> str:
    rows = [(name, f"{1e3 * one['x_disc']:.3f}", f"{1e3 * one['theta_disc']:.2f}")
            for name, one in found["held out"].items()]  # fmt: skip
    noise = (f"{1e3 * NOISE['x_disc']:.3f}", f"{1e3 * NOISE['theta_disc']:.2f}")
    head = ("friction coefficient", "x held out, rms [mm]", "theta held out, rms [mrad]")
    others = [(name, f"{100 * x:.1f} %") for name, x in found["surrogate"].items()]
    low, high = found["slip_mm_s"]
    return "\n\n".join((
        markdown(head, [*rows, ("noise", *noise)]),
        f"mu off by {found['mu_error_mean']:.3f} in the mean, {found['mu_error_max']:.3f} at most, "
        f"from {low:.1f} to {high:.0f} mm/s.",
        markdown(("friction on the pads from", "error held out / standard deviation"), others),
        f"{found['windows_per_second']:.0f} windows a second.",
    ))  # fmt: skip


def figure(network: Residual, fitted: Residual, slip: Sequence[float], found: Any) -> Figure:
    """The learned friction coefficients beside the true one, and the surrogates' errors."""
    fig = Figure(figsize=(7.2, 3.0), layout="constrained")
    left, right = fig.subplots(1, 2)
    v = torch.linspace(0, 1.3 * slip[1], 200, dtype=torch.float64)
    left.axvspan(1e3 * slip[0], 1e3 * slip[1], color="0.86", label="slip speeds in the data")
    with torch.no_grad():
        left.plot(1e3 * v, true_mu(network.truth, v), "k-", label="truth")
        left.plot(1e3 * v, fitted.law.mu(v), "C0:", label="constant, fitted")
        left.plot(1e3 * v, network.law.mu(v), "C1--", label="network")
    left.set(xlabel="slip speed [mm/s]", ylabel="friction coefficient [1]", ylim=(0, 1))
    left.legend(frameon=False)
    names = list(found["surrogate"])
    right.barh(names[::-1], [100 * found["surrogate"][name] for name in names[::-1]])
    right.set(xlabel="friction held out: error / sd [%]")
    return fig


def main(config: Config) -> None:
    found, picture = run(config)
    write(config, found, {"learn_dynamics": picture}, table(found))


if __name__ == "__main__":
    main(options(Config, __doc__))
