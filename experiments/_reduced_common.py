"""What the parts of `reduced_model.py` share: its configuration, the control law, choices of a model and their summaries."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchsoft import Parameters, SoftGrasp, Trajectory
from torchsoft.experiment import timed
from torchsoft.physics.contact import ramp
from torchsoft.reduced.fit import Choice, Recipe, assemble, choose, fit, rollout_of, score
from torchsoft.reduced.ode import ReducedModel
from torchsoft.reduced.records import Record


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/reduced_model")
    taps: int = 12
    tap_time: float = 0.3  # length of a tap [s]
    wave: float = 1e-5  # root mean square of a tap's multi-sine, over sqrt(2) [m]
    kick: float = 2e-3  # root mean square of a tap's initial velocities [m/s]
    band: tuple[float, float] = (3.0, 150.0)  # of the multi-sine [Hz]
    amplitudes: tuple[float, ...] = (5e-5, 2e-4, 5e-4, 1e-3)  # of held-out multi-sines in the same grasp, as `wave` [m]
    scenario: float = 1.0  # the manipulation's times, as parts of the paper's
    thresholds: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3)
    models: int = 50  # members of an ensemble
    noise: tuple[float, ...] = (0.0, 0.005, 0.01, 0.02, 0.05)
    """standard deviations of the noise, in parts of the signals' own"""
    draws: int = 3  # of the noise
    depth: float = 3e-4  # of the light grasp [m]
    stroke_times: tuple[float, ...] = (0.12, 0.08, 0.065, 0.05, 0.04, 0.03)  # of the training strokes of 20 mm [s]
    checking_times: tuple[float, ...] = (0.07, 0.04)
    """of the strokes of 15 mm to the other side by which thresholds are chosen [s]"""
    other_times: tuple[float, ...] = (0.15, 0.1, 0.055, 0.045, 0.035, 0.03, 0.025, 0.02)
    """of those that are held out [s]"""
    speeds: tuple[float, ...] = (0.005, 0.01, 0.02)  # that tanh(s' / speed) is tried with [m/s]
    gains: int = 60  # of the sweep
    seed: int = 0
    smoke: bool = False  # a size that takes seconds


def smoke(config: Config) -> Config:
    return replace(
        config, taps=6, tap_time=0.15, amplitudes=(2e-4,), scenario=0.2, thresholds=(0.03, 0.07, 0.14), models=10,
        noise=(0.0, 0.02), draws=1, stroke_times=(0.08, 0.05, 0.03), checking_times=(0.06,), other_times=(0.025,),
        speeds=(0.01,), gains=8,
    )  # fmt: skip


def law(p: Parameters, **changed: float) -> dict[str, dict[str, float]]:
    """The horizontal loop as feedback of the reduced model (Eq. 33, 34)."""
    K, R = changed.get("K_81", p.control.K_81), changed.get("R_80", p.control.R_80)
    x, v = ("x_C", "v_C") if p.control.senses == "disc" else ("x_Br", "v_Br")
    return {"F_x": {"x_d": K, "x_d_dot": R, x: -K, v: -R}}


def slipping(model: SoftGrasp, run: Trajectory, start: int = 0) -> float:
    """Part of the touching nodes of the upper pad that slip faster than 1 mm/s, over time."""
    with torch.no_grad():
        at = model.evaluate(0.0, model.unpack(run.y[start::20])).interfaces["U"]
        touching = at.frame.g > 0
        slip = ramp(at.frame.g, model.contacts["U"].law.epsilon) * at.flow[..., 1] - at.out[..., 2]
        return float((touching & (slip.abs() > 1e-3)).sum() / touching.sum())


def compared(
    model: ReducedModel, static: dict[tuple[str, str], float], banded: ReducedModel | None = None
) -> list[dict[str, Any]]:
    """The coefficients beside what is expected of them; None where mechanics has no such term."""
    rows = model.coefficient_table()
    for i, row in enumerate(rows):
        value = static.get((row["equation"], row["term"]))
        row["expected"] = value
        row["error"] = None if value is None else row["value"] / value - 1
        if banded is not None:
            row["expected_in_band"] = banded.coefficient_table()[i]["value"]
            row["error_in_band"] = row["value"] / row["expected_in_band"] - 1
    return rows


def ensemble(problem: Any, model: ReducedModel, recipe: Recipe, models: int, feedback: Any) -> ReducedModel:
    """The chosen terms with intervals: the medians of an ensemble of regressions on just these terms."""
    names = {target: {term.text for term, _ in pairs} for target, pairs in model.equations().items()}
    narrowed = {}
    for target, rows in problem.regressions.items():
        keep = [i for i, term in enumerate(rows.terms) if term.text in names[target]]
        narrowed[target] = replace(
            rows, terms=[rows.terms[i] for i in keep], columns=rows.columns[:, keep], column_size=rows.column_size[keep]
        )
    narrow = replace(problem, regressions=narrowed, scale=model.scale)
    return fit(narrow, replace(recipe, threshold=0.0, models=models), feedback)


def rollout_time(model: ReducedModel, on: Record, repeats: int = 9) -> float:
    """Wall time of a rollout [s], the least, which other work on the machine disturbs least."""
    return min(timed(lambda: rollout_of(model, on))[1] for _ in range(repeats))


def summary_of(choice: Choice, held: Record) -> dict[str, Any]:
    result = score(choice.model, held)
    return {
        "terms": len(choice.model.terms), "heldout_nrmse": result.worst, "rollout": str(result.rollout),
        "equations": choice.model.text()[3:],
    }  # fmt: skip


def attempt(
    records: Sequence[Record], library: Any, recipe: Recipe, tests: Sequence[Record], config: Config, feedback: Any,
    held: Record, **how: Any,
) -> dict[str, Any]:  # fmt: skip
    """A choice, or why there was none."""
    try:
        return summary_of(
            choose(assemble(records, library, recipe), tests, recipe, config.thresholds, feedback, **how), held
        )
    except ValueError as error:
        return {"terms": None, "heldout_nrmse": None, "rollout": str(error), "equations": []}
