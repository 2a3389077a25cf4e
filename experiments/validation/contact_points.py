"""Question: should contact points stand on the nodes or between them?

The paper puts one contact point on every surface node, so that a rolling disc picks nodes up and
drops them one at a time. With `contact.points` = n they lie at n Gauss points an element, and the
pad's shape functions carry displacements and forces between them and the nodes. Compared on 1 mm
and 0.5 mm elements; a ripple is half of the peak-to-peak.
  static    the disc pressed 0 to 1 mm beside a node, without friction: ripples of the force along
            the lower pad and of y_C (the upper pad stays centred over the disc)
  rolling   the manipulation: peak of F_x, its ripple between 5 and 7 s less a cubic trend, theta,
            energy residual

Command: .venv/bin/python experiments/validation/contact_points.py [--smoke]
Expected, 1 mm elements, nodes / 2 / 3 / 4 points: ripple of F_x 122 / 51 / 24 / 19 mN. Nodes 0.5 mm
apart: 16 mN. Some three minutes on one core.
"""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchsoft import BuiltRig, Rig, RigFile
from torchsoft.experiment import grid, numbers, options, write

Key = tuple[int, int]  # elements along the pad, contact points an element


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/contact_points")
    elements_x: tuple[int, ...] = (
        120,
        240,
    )  # elements along the pad; a thirtieth of that through it
    points: tuple[int, ...] = (0, 1, 2, 3, 4)  # contact points an element; 0 is one on every node
    node_mm: float = 60.0  # place of a node [mm]
    places: int = 21  # of the disc, equally spaced over 1 mm from there
    duration: float = 10.0  # of the manipulation [s]
    window: tuple[float, float] = (5.0, 7.0)  # in which the ripple of F_x is taken [s]
    smoke: bool = False  # a size that takes seconds


def build(elements_x: int, points: int) -> BuiltRig:
    mesh = {"pad.elements_x": elements_x, "pad.elements_y": elements_x // 30}
    return RigFile.ready("paper").override(mesh | {"contact.points": points}).build()


def ripple(t: Tensor, x: Tensor, window: tuple[float, float]) -> float:
    """Half of the peak-to-peak of a signal in the window, less its cubic trend."""
    t, x = (signal[(t >= window[0]) & (t <= window[1])] for signal in (t, x))
    return 0.5 * float(np.ptp(x.numpy() - np.polyval(np.polyfit(t, x, 3), t.numpy())))


@torch.no_grad()
def static(config: Config, rig: Rig) -> dict[str, float]:
    """Ripples of the force along the lower pad and of the height of the disc pressed at the
    places."""
    places = np.linspace(config.node_mm, config.node_mm + 1, config.places)
    states = [
        rig.unpack(rig.state(disc={"x": x, "y": "rest"}, bracket={"x": x, "y": 48.6e-3}))
        for x in (1e-3 * places).tolist()
    ]
    force, y_C = (
        torch.stack(x)
        for x in zip(*((s.pads["L"][0, :, 0].sum(), s.pose["disc"][1]) for s in states))
    )
    return {
        "static ripple of the force along the pad [mN]": 0.5e3 * float(np.ptp(force.numpy())),
        "static ripple of y_C [um]": 0.5e6 * float(np.ptp(y_C.numpy())),
    }


def run(config: Config) -> dict[str, dict[str, float]]:
    """Numbers of every case by its label."""
    if config.smoke:
        config = replace(
            config, elements_x=(120,), points=(0, 2), places=5, duration=0.8, window=(0.5, 0.8)
        )
    out = {}
    for case in tqdm(list(product(config.elements_x, config.points)), unit="case", disable=None):
        built = build(*case)
        rolled = built.run(grid(config.duration, 5e-3))
        F_x = rolled["effort_x"]
        out[f"{120 / case[0]:g} mm, {case[1] or 'nodes'}"] = static(config, built.rig) | {
            "peak of F_x [mN]": 1e3 * F_x.abs().max().item(),
            "ripple of F_x [mN]": 1e3 * ripple(rolled.t, F_x, config.window),
            "theta at the end [rad]": rolled["theta_C"][-1].item(),
            "energy residual, relative": rolled.energy_residual_rel,
            "points that touch at the end": sum(
                (force[-1, :, 0] > 0).sum().item() for force in rolled.force.values()
            ),
            "Newton iterations a step": rolled.stats.newton_per_step,
        }
    return out


def main(config: Config) -> None:
    cases = run(config)
    rows = {
        name: {case: one[name] for case, one in cases.items()}
        for name in next(iter(cases.values()))
    }
    write(config, {"cases": cases}, table=numbers("elements, points", rows))


if __name__ == "__main__":
    main(options(Config, __doc__))
