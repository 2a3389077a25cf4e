"""Question: does the grasping force against indentation converge with the mesh and with the
penalty?

The disc is pressed between the pads without friction, K_pad u = sum_i F_i n_i with F_i = K_n <g_i>+
per node (Eq. 8), at bracket heights from first touch to the paper's y_Br = 48.6 mm. Compression is
how much the two pads together give way. K_n refers to 1 mm of surface and scales with a node's
tributary length, so a finer mesh has the same springs per length and the force should converge to
that of a continuous layer of springs, with the square of the spacing. Stiffer springs should
converge to a rigid contact, with 1 / K_n.

Command: .venv/bin/python experiments/validation/statics.py [--smoke]
Expected: at the full grasp 70.16 N on the upper pad with the default 1 mm nodes and K_n, 0.5 %
below the limit of fine meshes (70.54 N), the difference falling fourfold per mesh; y_C between
23.194 and 23.197 mm on every mesh. The default K_n is not stiff enough to count as a mere penalty:
a rigid contact takes 79.3 N, 13 % more. Light grasps, in which only a few nodes touch, are far less
accurate: at 0.15 mm, 0.53 N on 1 mm nodes against 0.79 N on the finest. 15 s on one core.
"""

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchsoft import RigFile
from torchsoft.experiment import numbers, options, write

MILLI, MICRO = 1e3, 1e6
PAPER = RigFile.ready("paper")
TOUCH, GRASP = 50.1e-3, 48.6e-3
"""Height of the bracket [m] where undeformed pads just touch the disc, and in the full grasp."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/statics")
    elements_x: tuple[int, ...] = (
        60,
        120,
        240,
        480,
    )  # elements along the pad; a thirtieth of that through it
    stiffenings: tuple[float, ...] = (
        0.25,
        1.0,
        4.0,
        16.0,
    )  # multiples of the default K_n, on the default mesh
    points: int = 10  # compressions, in equal steps up to the full grasp's
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Curve:
    """One mesh and penalty, each (points,): compression [m], force on the upper pad [N], half-width
    of its contact [m], largest penetration [m], y_C [m], and nodes of the upper pad that touch."""

    compression: Tensor
    force: Tensor
    half_width: Tensor
    penetration: Tensor
    y_C: Tensor
    touching: Tensor


@dataclass(frozen=True)
class Family:
    """Curves that approach a limit, how far each is from it, and the expected order of the
    approach."""

    curves: dict[str, Curve]
    coarseness: list[float]
    order: int

    @property
    def limit(self) -> float:
        """Force at the full grasp [N], extrapolated from the last two curves at the expected
        order."""
        before, last = (c.force[-1].item() for c in list(self.curves.values())[-2:])
        return last + (last - before) / (
            (self.coarseness[-2] / self.coarseness[-1]) ** self.order - 1
        )


@dataclass(frozen=True)
class Result:
    config: Config
    meshes: dict[str, Curve]
    penalties: dict[str, Curve]

    @property
    def families(self) -> dict[str, Family]:
        """Both families of curves: node spacing [mm], second order; default K_n over K_n, first
        order."""
        length = MILLI * PAPER["pads.U.length"]
        return {
            "mesh": Family(self.meshes, [length / n for n in self.config.elements_x], 2),
            "penalty": Family(self.penalties, [1 / k for k in self.config.stiffenings], 1),
        }


def half_width(x: Tensor, g: Tensor) -> Tensor:
    """Where the penetration g (nodes,) falls through zero right of the disc's centre [m], between
    nodes at x [m]."""
    last = torch.nonzero(g > 0).max()
    inside, outside = g[last], g[last + 1]
    return x[last] + (x[last + 1] - x[last]) * inside / (inside - outside)


@torch.no_grad()
def indent(elements_x: int, stiffening: float, compressions: Tensor) -> Curve:
    """Press the disc to each of the compressions (points,) [m]."""
    K_n = stiffening * PAPER["laws.steel_on_rubber.K_n"]
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    model = PAPER.override(mesh | {"contact.K_n": K_n}).build().rig
    pad, rows = model.pads["U"], []
    for compression in compressions.tolist():
        bracket = {"x": 60e-3, "y": TOUCH - compression}
        state = model.unpack(model.state(disc={"x": 60e-3, "y": "rest"}, bracket=bracket))
        disc, bracket, g = state.pose["disc"], state.pose["bracket"], model.penetration("U", state)
        x = (pad.positions + model.displacement("U", state))[:, 0] + bracket[0] - disc[0]
        force = state.pads["U"][0, :, 1].sum()
        rows.append((force, half_width(x, g), g.max(), disc[1], (g > 0).sum()))
    force, width, penetration, y_C, touching = (torch.stack(column) for column in zip(*rows))
    return Curve(compressions, force, width, penetration, y_C, touching)


def run(config: Config) -> Result:
    if config.smoke:
        config = Config(
            out=config.out, elements_x=(60, 120), stiffenings=(1.0, 4.0), points=3, smoke=True
        )
    fraction = torch.arange(1, config.points + 1, dtype=torch.float64) / config.points
    compressions = fraction * (TOUCH - GRASP)
    default = PAPER["pads.U.elements_x"]
    cases = [(n, 1.0) for n in config.elements_x] + [(default, k) for k in config.stiffenings]
    curves = {
        case: indent(*case, compressions)
        for case in tqdm(dict.fromkeys(cases), unit="curve", disable=None)
    }
    meshes = {f"{n} x {n // 30}": curves[n, 1.0] for n in config.elements_x}
    return Result(config, meshes, {f"{k:g}": curves[default, k] for k in config.stiffenings})


def full_grasp(curves: dict[str, Curve]) -> dict[str, dict[str, float]]:
    """The last point of every curve, and the relative difference of its force from the next finer
    (or stiffer) curve's."""
    rows = {
        name: {
            "force_N": c.force[-1].item(),
            "y_C_mm": MILLI * c.y_C[-1].item(),
            "half_width_mm": MILLI * c.half_width[-1].item(),
            "penetration_um": MICRO * c.penetration[-1].item(),
            "nodes_touching": c.touching[-1].item(),
        }
        for name, c in curves.items()
    }
    for one, following in pairwise(rows.values()):
        one["to the next"] = abs(one["force_N"] / following["force_N"] - 1)
    return rows


def table(result: Result) -> str:
    """The full grasps as Markdown tables."""
    return "\n\n".join(
        f"{numbers(name, full_grasp(family.curves), 5)}\n\nlimit: {family.limit:.2f} N"
        for name, family in result.families.items()
    )


def summary(result: Result) -> dict[str, Any]:
    """What `summary.json` holds."""
    return {
        name: {
            "full_grasp": full_grasp(family.curves),
            "force_limit_N": family.limit,
            "curves": {
                key: {k: v.tolist() for k, v in asdict(c).items()}
                for key, c in family.curves.items()
            },
        }
        for name, family in result.families.items()
    }


def main(config: Config) -> None:
    result = run(config)
    write(config, summary(result), table=table(result))


if __name__ == "__main__":
    main(options(Config, __doc__))
