"""Question: which of torchdiffeq's verbs and methods give the gradient of a stiff rig?

The paper's rig on half the usual mesh, its disc pressed and tapped to the side: d x_C / d ln E at
the end by `odeint` and `odeint_adjoint`, with torchdiffeq's explicit methods and with the stepper
(`method="sdirk2"`), beside the discrete adjoint of `simulate` at rtol 1e-9. `odeint_adjoint`
integrates an explicit method backwards, where the pads' decay of 1/tau and faster grows.

Command: .venv/bin/python experiments/validation/torchdiffeq_methods.py [--smoke]
Expected: the stepper is right to its tolerance with both verbs, explicit methods with `odeint`
only. Seven minutes on one core.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor
from torchdiffeq import odeint, odeint_adjoint

from torchsoft import Rig, RigFile, excite, register_method, simulate
from torchsoft.experiment import COARSE, numbers, options, write
from torchsoft.rigs.excite import Excitation

CASES: tuple[tuple[str, str, float, float], ...] = (  # verb, method, rtol, longest window [s]
    ("odeint", "sdirk2", 1e-4, 0.4), ("odeint_adjoint", "sdirk2", 1e-4, 0.4),
    ("odeint", "sdirk2", 1e-6, 0.4), ("odeint_adjoint", "sdirk2", 1e-6, 0.4),
    ("odeint", "sdirk2", 1e-8, 0.4),
    ("odeint", "dopri5", 1e-5, 0.002), ("odeint", "dopri5", 1e-7, 0.002),
    ("odeint_adjoint", "dopri5", 1e-5, 0.002), ("odeint_adjoint", "dopri5", 1e-7, 0.002),
)  # fmt: skip
VERBS: dict[str, Any] = {"odeint": odeint, "odeint_adjoint": odeint_adjoint}


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/torchdiffeq_methods")
    windows: tuple[float, ...] = (0.002, 0.4)  # [s]
    outputs: int = 5  # times of output
    smoke: bool = False  # a size of seconds


def slope(model: Rig, end: Tensor) -> float:
    """d x_C / d ln E [m] of a state at the end."""
    E = model.parameter("pad.E")
    (by_E,) = torch.autograd.grad(model.unpack(end).pose["disc"][0], E)
    return float((by_E * E).detach())


def run(config: Config) -> list[dict[str, Any]]:
    register_method()
    roll = {"kind": "strokes", "travel": 4e-3, "stroke_time": 0.1}
    file = RigFile.ready("paper").override(COARSE)
    model, y0, _ = excite(file, Excitation(roll, duration=1.0)).build()
    start = simulate(model, [0.0, 0.55], y0=y0).y[-1].detach()
    start[model.layout.slices["velocity", "disc"]] += torch.tensor([2e-3, 0.0, 0.0]).double()
    rows = []
    for window in config.windows[: 1 if config.smoke else None]:
        t = torch.linspace(0, window, config.outputs).double()
        exact = slope(model, simulate(model, t, y0=start, rtol=1e-9, gradient="discrete").y[-1])
        for verb, method, rtol, longest in CASES[:1] if config.smoke else CASES:
            if window > longest:
                continue
            began = perf_counter()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the verdict is the table
                how: dict[str, Any] = {"method": method, "rtol": rtol, "atol": 0.1 * rtol}
                try:
                    error = slope(model, VERBS[verb](model, start, t, **how)[-1]) / exact - 1
                except (RuntimeError, AssertionError) as failure:  # rates that nothing solves
                    print(f"{verb}, {method}, {rtol:g}: {failure}")
                    error = float("nan")
            rows.append({
                "window_s": window, "verb": verb, "method": method, "rtol": rtol, "error": error,
                "wall_s": perf_counter() - began,
            })  # fmt: skip
    return rows


def main(config: Config) -> None:
    rows = run(config)
    shown = {
        f"{r['window_s']:g} s, {r['verb']}, {r['method']}, {r['rtol']:g}": {
            "error of the gradient": r["error"], "seconds": r["wall_s"]
        }
        for r in rows
    }  # fmt: skip
    write(config, {"rows": rows}, table=numbers("window, verb, method, rtol", shown, 2))


if __name__ == "__main__":
    main(options(Config, __doc__))
