"""Question: can a friction law that is a neural network be learned inside the simulator?

`MuNetwork` is a user's law: mu(v), an unknown function of the slip speed, is a small network in
(eta + R) |gamma'| = <E - mu(|gamma'|) F_N>+, solved by a few fixed-point sweeps. It is a module of
(E, F_N, R) that gives the slip rate, and is handed to the model as its friction; nothing else of
the model changes, and it runs compiled. It learns from the disc's motion alone (pose and velocity,
a few milliseconds after a kick that makes it slip), made by the built-in law mu(v) = mu_k + (mu_s -
mu_k) / (1 + v / v_s), by the discrete adjoint of the run.

Command: .venv/bin/python experiments/learned_friction.py [--smoke]
Expected: the loss falls by more than 100 times in 40 runs of the model, and mu is learned to 0.01
on average over the slip speeds that occurred, worst (0.1) at the slowest, which leave the least
trace in the motion. Beyond them nothing is known and nothing is claimed. About twenty seconds on
one core.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from torchsoft import Parameters, SmoothSlip, SoftGrasp, Trajectory, press, simulate
from torchsoft.experiment import COARSE, at_the_points, markdown, options, write

SWEEPS = 4
"""Fixed-point sweeps for mu(v) and v; each shrinks the error by about (mu_s - mu_k) F_N / ((eta +
R) v_s), 0.1 here."""
SCALE = (1e-5, 1e-5, 1e-3, 1e-2, 1e-2, 1.0)
"""What counts as one unit of misfit: x, y [m], theta [rad], v_x, v_y [m/s], omega [rad/s]."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/learned_friction")
    evaluations: int = 40  # runs of the model that learning may take
    kick: float = 0.3  # speed of the disc at the start [m/s]
    step_ms: float = 0.5  # step, and spacing of the samples [ms]
    samples: int = 8
    seed: int = 0
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Result:
    config: Config
    losses: list[float]
    slip_speeds: Tensor
    mu_start: Tensor
    mu_learned: Tensor
    mu_true: Tensor
    excited: tuple[
        float, float
    ]  # slip speeds in the data, from the 10 % quantile to the largest [m/s]


class MuNetwork(nn.Module):
    """Friction whose coefficient is a network of the slip speed: mu(v) = 0.5 + 0.4 tanh(net(log(1 +
    v / v_0)))."""

    def __init__(self, eta: float, v_0: float = 0.01, width: int = 8) -> None:
        super().__init__()
        self.eta, self.v_0 = eta, v_0
        last = nn.Linear(width, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.net = nn.Sequential(nn.Linear(1, width), nn.Tanh(), last).double()

    def mu(self, v: Tensor) -> Tensor:
        """Friction coefficient at the slip speed v (...) [m/s]."""
        return 0.5 + 0.4 * torch.tanh(self.net(torch.log1p(v[..., None] / self.v_0))[..., 0])

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        v = torch.zeros_like(E + F_N)
        for _ in range(SWEEPS):
            v = (E - self.mu(v) * F_N).clamp(min=0.0) / (self.eta + R)
        return v


def true_mu(law: SmoothSlip, v: Tensor) -> Tensor:
    return law.mu_k + (law.mu_s - law.mu_k) / (1 + v / law.v_s)


def disc(run: Trajectory) -> Tensor:
    """(T, 6): pose and velocity of the disc, in units of `SCALE`."""
    return run.together("x_C", "y_C", "theta", "v_x", "v_y", "omega") / torch.tensor(
        SCALE, dtype=torch.float64
    )


def run(config: Config) -> Result:
    config = replace(config, evaluations=9, samples=3) if config.smoke else config
    torch.manual_seed(config.seed)
    law = {"contact.mu_s": 0.8, "contact.mu_k": 0.3, "contact.v_s": 0.05}
    model = SoftGrasp(Parameters().override(COARSE | law))
    y0 = press(model, model.settings.scenario.y_Br_grasp).detach()
    y0[model.layout.slices["velocity", "disc"]] = torch.tensor(
        [config.kick, 0.0, 0.0], dtype=torch.float64
    )
    step = 1e-3 * config.step_ms
    t = step * torch.arange(config.samples + 1, dtype=torch.float64)

    truth = model.contacts["L"].law.friction
    assert isinstance(truth, SmoothSlip)
    made = simulate(model, t, y0=y0, step=step)
    data, (_, speeds) = disc(made), at_the_points(model, t[1:], made.y[1:])
    excited = speeds[speeds > 0]

    student = MuNetwork(truth.eta.item())
    learner = SoftGrasp(model.settings, friction=student)
    v = torch.linspace(0.0, 1.3 * float(excited.max()), 100, dtype=torch.float64)
    with torch.no_grad():
        start, exact = student.mu(v), true_mu(truth, v)
    learner.requires_grad_(False)
    student.requires_grad_(True)
    optimiser = torch.optim.LBFGS(
        student.parameters(),
        max_iter=config.evaluations,
        max_eval=config.evaluations,
        line_search_fn="strong_wolfe",
    )
    losses: list[float] = []

    def misfit() -> Tensor:
        optimiser.zero_grad()
        loss = (
            (disc(simulate(learner, t, y0=y0, step=step, gradient="discrete")) - data)
            .square()
            .mean()
        )
        loss.backward()
        losses.append(loss.item())
        return loss

    optimiser.step(misfit)
    misfit()  # where it ended
    with torch.no_grad():
        learned = student.mu(v)
    return Result(
        config,
        losses,
        v,
        start,
        learned,
        exact,
        (float(excited.quantile(0.1)), float(excited.max())),
    )


def numbers(result: Result) -> dict[str, float]:
    inside = (result.slip_speeds >= result.excited[0]) & (result.slip_speeds <= result.excited[1])
    error = (result.mu_learned - result.mu_true).abs()[inside]
    return {
        "loss_start": result.losses[0],
        "loss_end": result.losses[-1],
        "fall": result.losses[0] / result.losses[-1],
        "mu_error_max": float(error.max()),
        "mu_error_mean": float(error.mean()),
        "mu_error_start_max": float((result.mu_start - result.mu_true).abs()[inside].max()),
        "slip_from_mm_s": 1e3 * result.excited[0],
        "slip_to_mm_s": 1e3 * result.excited[1],
    }


def figure(result: Result) -> Figure:
    """The loss, and the learned friction coefficient beside the true one."""
    fig = Figure(figsize=(10, 4), layout="constrained")
    left, right = fig.subplots(1, 2)
    left.semilogy(result.losses)
    left.set(
        xlabel="run of the model",
        ylabel="mean squared misfit [1]",
        title="Learning from the disc's motion",
    )
    mm_s = 1e3 * result.slip_speeds
    right.axvspan(
        1e3 * result.excited[0],
        1e3 * result.excited[1],
        color="0.93",
        label="slip speeds in the data (90 %)",
    )
    right.plot(mm_s, result.mu_true, "k-", label="truth")
    right.plot(mm_s, result.mu_start, "C0:", label="before")
    right.plot(mm_s, result.mu_learned, "C1--", label="learned")
    right.set(
        xlabel="slip speed [mm/s]", ylabel="mu [1]", title="Friction coefficient", ylim=(0.0, 1.0)
    )
    right.legend()
    return fig


def main() -> None:
    result = run(options(Config, __doc__))
    found = numbers(result)
    rows = [(name, f"{value:.4g}") for name, value in found.items()]
    table = markdown(("", "learned"), rows)
    write(
        result.config,
        {**found, "losses": result.losses},
        {"learned_friction": figure(result)},
        table,
    )


if __name__ == "__main__":
    main()
