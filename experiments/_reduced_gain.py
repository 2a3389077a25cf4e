"""Question: does the reduced model predict what a gain of the horizontal loop does to the full one?"""

from time import perf_counter
from typing import Any

import numpy as np
import torch
from _reduced_common import Config, law
from _reduced_stick import Grasp, indices
from scipy.optimize import brentq
from tqdm import tqdm

from torchsoft import Profile, SimulationFailed
from torchsoft.reduced.ode import ReducedModel


def step_response(t: np.ndarray, x: np.ndarray, height: float, begun: float) -> dict[str, float]:
    """Overshoot over the step's height, and the time after which x stays within 2 % of it [s]."""
    away = np.abs(x - height) > 0.02 * height
    last = len(x) - 1 - int(away[::-1].argmax()) if away.any() else 0
    return {"overshoot": float(x.max() / height - 1), "settling_s": float(t[last] - begun)}


def study_gain(config: Config, grasp: Grasp, A: np.ndarray, model: ReducedModel, bar: tqdm) -> dict[str, Any]:
    """R_80 swept on the reduced model; a step of 50 um and the stability limits, confirmed on the full one."""
    p, height, begun = grasp.p, 5e-5, 0.01
    x = Profile([begun, 2 * begun], [0.0, height])
    t = np.linspace(0.0, 0.4, 1601)
    u = np.column_stack([part.numpy() for part in x(torch.from_numpy(t))])

    def closed(R: float) -> ReducedModel:
        return model.with_feedback(law(p, R_80=R))

    def growth(R: float) -> float:
        modes = np.linalg.eigvals(closed(R).state_space()[0])
        return float(modes[np.abs(modes) > 1.0].real.max())

    began = perf_counter()
    gains = np.geomspace(3.0, 30_000.0, config.gains)
    rows = []
    for R in gains:
        out = closed(R).rollout(t, np.zeros(6), u)
        response = step_response(t, out.y[:, 0], height, begun) if growth(R) < 0 else {}
        rows.append({"R_80": float(R), "growth_1_s": growth(R), "rollout": str(out), **response})
    cost = perf_counter() - began
    signs = np.sign([row["growth_1_s"] for row in rows])
    limits: list[Any] = [brentq(growth, a, b) for a, b, s in zip(gains, gains[1:], np.diff(signs)) if s]
    stable = [row for row in rows if "settling_s" in row]
    best = min(stable, key=lambda row: row["settling_s"])
    bar.update()

    _, v, _ = indices(grasp.model())

    def growth_full(R: float) -> float:
        changed = A.copy()
        changed[v[2], v[0]] -= (R - p.control.R_80) / p.bracket.mass  # the one entry that R_80 makes
        modes = np.linalg.eigvals(changed)
        return float(modes[np.abs(modes) > 1.0].real.max())

    points = [100.0, p.control.R_80, best["R_80"], *(factor * limit for limit in limits for factor in (0.3, 2.0))]
    confirmed = []
    for R in points[1:2] if config.smoke else sorted(points):
        x_full = Profile([begun, 2 * begun], [p.scenario.x_C0, p.scenario.x_C0 + height])
        row: dict[str, Any] = {"R_80": R, "growth_reduced_1_s": growth(R)}
        expected_ = step_response(t, closed(R).rollout(t, np.zeros(6), u).y[:, 0], height, begun)
        row["growth_full_1_s"] = growth_full(R)
        try:
            run = grasp.move(x_full, 0.4, step=2.5e-4, sample=2.5e-4, R_80=R)
            x_C = (run["x_C"] - run["x_C"][0]).numpy()
            early, late = (np.ptp(x_C[i:j]) for i, j in ((600, 1000), (1200, 1600)))
            row["full"] = step_response(t, x_C, height, begun)
            row["full_dies_out"] = bool(late < max(early, 1e-2 * height))
        except SimulationFailed as failure:
            row["full"], row["full_dies_out"], row["failure"] = {}, False, f"t = {failure.time:.3f} s"
        row["reduced"] = expected_ if row["growth_reduced_1_s"] < 0 else {}
        confirmed.append(row)
    ends = [] if config.smoke else [(0.1 * limit, 3 * limit) for limit in limits]
    limits_full: list[Any] = [
        brentq(growth_full, *pair, xtol=1e-2) for pair in ends if np.prod([growth_full(x) for x in pair]) < 0
    ]
    bar.update()
    return {
        "gain": "R_80 [N.s/m]", "limits": limits, "limits_full": limits_full, "best": best, "sweep": rows, "sweep_wall_s": cost,
        "confirmed": confirmed,
    }  # fmt: skip
