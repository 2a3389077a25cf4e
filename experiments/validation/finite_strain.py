"""Question: when are linear pads enough, and what do pads at finite strain change and cost?

A layer of the paper's thickness is pressed by its disc, without friction, deeper and deeper:
the force of neo-Hookean pads over that of linear ones of the same small-strain moduli. Then the
paper's manipulation with both: angle and force at 10 s, the push that rolling takes, the modulus
that a fit of linear pads to the force would give, time of a run and of its gradient.

Command: .venv/bin/python experiments/validation/finite_strain.py [--smoke]
Expected: at the paper's sixth of the height 17 % (nu 0.45) and 24 % (nu 0.49) more force; linear
pads of E = 0.85 MPa press as hard as neo-Hookean ones of 0.75 MPa; 10 s of the manipulation take
some 7 s, its gradient as long. About 2 min.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch

from torchsoft import KelvinVoigt, NeoHookean, Pad, PadMesh, RigFile, Trajectory
from torchsoft.experiment import grid, numbers, options, write
from torchsoft.physics.statics import net_loads, settled, unstretched

HEIGHT, RADIUS = 4.59e-3, 19.37e-3
RUBBER = {"E": 0.75e6, "rho": 1100.0, "tau": 10e-3, "depth": 44e-3}


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/finite_strain")
    duration: float = 10.0  # of the manipulation [s]
    depths: int = 6  # to which the layer is pressed
    rtol: float = 1e-4
    smoke: bool = False  # a size that takes seconds


@torch.no_grad()
def pressed(kind: type, nu: float, depth: float) -> float:
    """Force [N] on the disc, held so deep [m] in a pad."""
    rig = RigFile.ready("paper").assemble()
    rig.pads["L"] = Pad(  # pyright: ignore[reportIndexIssue]
        PadMesh(60e-3, HEIGHT, 60, 4), kind(**RUBBER, nu=nu), origin=(30e-3, 0.0)
    )
    pose = {
        "disc": torch.tensor([60e-3, HEIGHT + RADIUS - depth, 0.0], dtype=torch.float64),
        "bracket": torch.tensor([60e-3, 1.0, 0.0], dtype=torch.float64),
    }
    still = {name: torch.zeros(3, dtype=torch.float64) for name in pose}
    signals = torch.zeros(len(rig.signals), 2, dtype=torch.float64)
    state = rig.unpack(settled(rig, pose, still, unstretched(rig, ())), signals)
    weight = rig.bodies["disc"].mass * rig.gravity
    return float(net_loads(rig, state, signals, ())["disc"][1] + weight)


def manipulation(kind: str, E: float, config: Config, duration: float) -> RigFile:
    rubber = {"kind": kind, "E": E, "nu": 0.45, "tau": 10e-3, "depth": 44e-3}
    outputs = {"duration": duration, "interval": 5e-3, "snapshots": [0.0]}
    return RigFile.ready("paper").override({"materials.rubber": rubber, "outputs": outputs})


def timed(kind: str, config: Config) -> tuple[Trajectory, float, float]:
    """A run with its time and that of its gradient [s]."""
    built = manipulation(kind, 0.75e6, config, config.duration).build()
    built.run(grid(0.02), rtol=config.rtol)  # compiles
    start = time.process_time()
    run = built.run(gradient="discrete", rtol=config.rtol, progress=True)
    middle = time.process_time()
    torch.autograd.grad(run["theta_C"][-1], built.rig.parameter("materials.rubber.E"))
    return run, middle - start, time.process_time() - middle


def apparent_modulus(force: float, config: Config) -> float:
    """E [Pa] of linear pads that press with this force once the grip has closed."""
    E = [0.75e6, 0.85e6]
    found = [held("kelvin_voigt", one, config) for one in E]
    while abs(found[-1] - force) > 1e-4 * abs(force):
        slope = (found[-1] - found[-2]) / (E[-1] - E[-2])
        E.append(E[-1] + (force - found[-1]) / slope)
        found.append(held("kelvin_voigt", E[-1], config))
    return E[-1]


def held(kind: str, E: float, config: Config) -> float:
    """Force [N] between the upper pad and the disc, 0.1 s after the grip has closed."""
    end = 0.2 if config.smoke else 0.475
    run = manipulation(kind, E, config, end).build().run(rtol=config.rtol)
    return float(run.force["U"][-1, :, 0].sum().detach())


def main(config: Config) -> None:
    if config.smoke:
        config = Config(config.out, 0.2, 2, 1e-3, True)
    rows: dict[str, dict[str, Any]] = {}
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for nu in (0.45, 0.49):
        ratios = []
        parts = [0.25 * (k + 1) / config.depths for k in range(config.depths)]
        for part in parts:
            finite, linear = (pressed(k, nu, part * HEIGHT) for k in (NeoHookean, KelvinVoigt))
            ratios.append(finite / linear)
            rows[f"nu {nu}, {part:.0%} of the height"] = {
                "neo-Hookean [N]": finite, "linear [N]": linear, "more": finite / linear - 1
            }  # fmt: skip
        axes.plot([100 * p for p in parts], [100 * (r - 1) for r in ratios], "o-", label=f"{nu=}")
    axes.axvline(100 * 0.75 / 4.59, color="grey", ls=":", label="the paper's")
    axes.set(xlabel="indentation [% of the height]", ylabel="linear pads are too soft by [%]")
    axes.legend()
    both = {}
    for name, kind in (("linear", "kelvin_voigt"), ("neo-Hookean", "neo_hookean")):
        run, seconds, gradient = timed(kind, config)
        late = run.t > 0.5 * config.duration
        both[name] = {
            "theta [rad]": float(run["theta_C"][-1].detach()),
            "F_y [N]": float(run["effort_y"][-1].detach()),
            "push [N]": float(run["effort_x"][late].mean().detach()),
            "steps": run.stats.steps, "run [s]": seconds, "gradient [s]": gradient,
        }  # fmt: skip
    force = held("neo_hookean", 0.75e6, config)
    E = apparent_modulus(force, config)
    both["linear"]["E as stiff [MPa]"], both["neo-Hookean"]["E as stiff [MPa]"] = 1e-6 * E, 0.75
    tables = numbers("layer", rows), numbers("manipulation", both)
    write(
        config, {"layer": rows, "manipulation": both}, {"finite_strain": figure},
        "\n\n".join(tables),
    )  # fmt: skip


if __name__ == "__main__":
    main(options(Config, __doc__))
