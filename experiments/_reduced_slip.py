"""Question: how far do a few terms with a saturating friction follow strokes in which the upper pad slips?"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from _reduced_common import Config, attempt, compared, ensemble, law, rollout_time, slipping
from tqdm import tqdm

from torchsoft import Parameters, simulate
from torchsoft.excitation import Excitation, Strokes, begin
from torchsoft.experiment import COARSE, grid
from torchsoft.reduced.fit import Recipe, assemble, choose, rollout_of, score
from torchsoft.reduced.ode import ReducedModel
from torchsoft.reduced.records import Record, noisy, record, rolling_radius
from torchsoft.reduced.terms import friction, joined, mechanics


@dataclass(frozen=True)
class Stroke:
    """A run of strokes in a light grasp: its record, peak acceleration [m/s2], slipping part of the upper pad's touching
    nodes, mean normal force [N] and number of touching nodes there, and wall time of the full model [s]."""

    record: Record
    acceleration: float
    slipping: float
    load: float
    nodes: float
    wall_s: float


def strokes(config: Config, travel: float, stroke_time: float, *, depth: float | None = None, count: int = 4) -> Stroke:
    """Strokes there and back from a light grasp with the horizontal loop on the bracket."""
    motion = Strokes(travel=travel, stroke_time=stroke_time)
    e = Excitation(
        motion=motion, duration=0.5 + count * stroke_time + 0.01, depth=depth or config.depth, senses="bracket"
    )  # pyright: ignore[reportCallIssue]
    changes: dict[str, Any] = {"contact.v_s": 0.05} | (COARSE if config.smoke else {})
    model, y0 = begin(e, Parameters().override(changes))
    t, start = grid(e.duration, 5e-4), 1000
    run = simulate(model, t[: start + 1], y0=y0, step=5e-4)
    rest = simulate(model, t[start:], y0=run.y[-1], step=5e-4)
    peak = float(np.abs(np.gradient(rest["v_x_Br"].numpy(), 5e-4)).max())
    normal = rest.force["U"][..., 0]
    load, nodes = float(normal.sum(-1).mean()), float((normal > 0).sum(-1).double().mean())
    return Stroke(record(rest), peak, slipping(model, rest), load, nodes, rest.stats.wall_s)


def horizon(model: ReducedModel, on: Record, allowed: float = 0.02) -> float | None:
    """Time [s] from the start after which x_C is off by `allowed` of its range; None if it never is."""
    off = np.abs(rollout_of(model, on).y[:, 0] - on.series["x_C"]) > allowed * np.ptp(on.series["x_C"])
    return float(on.t[off.argmax()] - on.t[0]) if off.any() else None


def sticking(model: ReducedModel) -> ReducedModel:
    """The model's limit for small slip: every tanh(s' / speed) is s' / speed."""
    equations = {
        target: [
            (replace(term, factors=tuple(part._replace(shape="linear") for part in term.factors)), value)
            for term, value in pairs
        ]
        for target, pairs in model.equations().items()
    }
    return ReducedModel(
        model.states, model.inputs, model.kinematics, equations, feedback=model.feedback, scale=model.scale
    )


def study_slip(config: Config, bar: tqdm) -> tuple[dict[str, Any], dict[str, Any]]:
    train = [strokes(config, -20e-3, T) for T in config.stroke_times]
    other = {T: strokes(config, 15e-3, T) for T in (*config.checking_times, *config.other_times)}
    bar.update()
    p = Parameters().override({"control.senses": "bracket"})
    gentle = max(config.stroke_times)
    r, feedback = rolling_radius([train[config.stroke_times.index(gentle)].record]), law(p)
    recipe = Recipe(width=0.004, window=min(config.stroke_times) * 4, seed=config.seed)
    records, checks = [one.record for one in train], [other[T].record for T in config.checking_times]
    held = {T: other[T] for T in config.other_times}

    choices = []
    for speed in config.speeds:
        library = joined(mechanics(r, alike=False), friction(r, speed))
        problem = assemble(records, library, recipe)
        choices.append((choose(problem, checks, recipe, config.thresholds, feedback, each=False), problem, library))
    errors = [choice.tried[choice.index]["nrmse"] for choice, *_ in choices]
    good = [one for one, error in zip(choices, errors) if error <= 1.1 * min(errors)]
    choice, problem, library = min(good, key=lambda one: len(one[0].model.terms))
    model = ensemble(problem, choice.model, recipe, config.models, feedback)
    bar.update()
    linear = attempt(records, mechanics(r), recipe, checks, config, feedback, checks[-1])
    limit = sticking(model)
    bar.update()

    scores = {T: score(model, one.record) for T, one in other.items()}
    deep = strokes(config, 15e-3, 0.04, depth=5 / 3 * config.depth)
    long = strokes(config, 15e-3, 0.04, count=4 if config.smoke else 20)
    noise = []
    for level in config.noise:
        rough = [noisy(one, level, config.seed + i) for i, one in enumerate(records)]
        row = attempt(rough, library, recipe, checks, config, feedback, held[min(held)].record, each=False)
        noise.append({"noise": level, **row})
    fast = {T: rollout_time(model, one.record, 3) for T, one in other.items()}
    settings = Parameters()
    m, inertia = settings.disc.mass, 0.5 * settings.disc.mass * settings.disc.radius**2
    pushed = 2 / (m + inertia / r**2)  # acceleration of the disc per friction above, while it rolls below
    load, nodes = (float(np.mean(x)) for x in zip(*((one.load, one.nodes) for one in train)))
    static = {}
    for name, force in (
        ("v_Br - v_C + r omega", settings.contact.eta * nodes),
        *((f"tanh((v_Br - v_C + r omega)/{speed:g})", settings.contact.mu_k * load) for speed in config.speeds),
    ):
        static["v_C", name], static["omega", name] = pushed * force, -pushed / r * force
    bar.update()
    by_stroke = [
        {
            "stroke_time_s": T, "acceleration_m_s2": one.acceleration, "slipping": one.slipping, "load_N": one.load,
            "held_out": T in held, "nrmse": scores[T].worst, "rollout": str(scores[T].rollout),
            "nrmse_linear": score(limit, one.record).worst, "speedup": one.wall_s / fast[T],
        }
        for T, one in sorted(other.items(), reverse=True)
    ]  # fmt: skip
    heldout = [row["nrmse"] for row in by_stroke if row["held_out"]]

    def enough(key: str, allowed: float) -> float:
        """Largest acceleration [m/s2] up to which all strokes are within `allowed`."""
        fine = 0.0
        for row in sorted(by_stroke, key=lambda row: row["acceleration_m_s2"]):
            if row[key] > allowed:
                break
            fine = row["acceleration_m_s2"]
        return fine

    summary = {
        "terms": len(model.terms),
        "heldout_nrmse": float(np.mean(heldout)),
        "heldout_nrmse_worst": float(np.max(heldout)),
        "speedup": float(np.median([row["speedup"] for row in by_stroke])),
        "equations": model.text(),
        "latex": model.latex(),
        "rolling_radius_mm": 1e3 * r,
        "coefficients": compared(model, static),
        "by_stroke": by_stroke,
        "enough_up_to_m_s2": {
            f"{allowed:.0%}": {"with friction": enough("nrmse", allowed), "small-slip limit": enough("nrmse_linear", allowed)}
            for allowed in (0.01, 0.02)
        },
        "linear_terms_on_slip": linear,
        "another_grasp": {
            "depth_mm": 5 / 3 * 1e3 * config.depth, "load_N": deep.load, "slipping": deep.slipping,
            "nrmse": score(model, deep.record).worst, "rollout": str(score(model, deep.record).rollout),
        },
        "long_run": {
            "strokes": 4 if config.smoke else 20, "nrmse": score(model, long.record).worst,
            "horizon_2_percent_s": horizon(model, long.record),
        },
        "noise": noise,
        "thresholds": [row for choice, *_ in choices for row in choice.tried],
    }  # fmt: skip
    return summary, {"other": other, "model": model}
