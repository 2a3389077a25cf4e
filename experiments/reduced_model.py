"""Question: how small can an ordinary differential equation for disc and bracket be, and where does
it stop being enough?

Stick. Both pads stick to the disc: each is a spring k and a dashpot c on its slip
(`torchsoft.reduced.terms`), so that
    m x_C''     = k (x_Br - 2 x_C) + c (...)'
    I theta''   = -r [k (x_Br + 2 r theta) + c (...)'] - c_r theta'
    m_Br x_Br'' =  F_x - k (x_Br - x_C + r theta) - c (...)'
with F_x known from the control law. What mechanics expects of k, c, r and c_r is computed from the
full model, linearised in the grasp, with pads and stretches condensed at rest: not quite a spring
and a dashpot at every frequency. The training motions are taps: small random velocities of disc and
bracket and a broad multi-sine, some micrometres large. The radius comes from one roll to the other
side. Held out: the paper's manipulation.

Slip. A light grasp, the horizontal loop on the bracket, strokes ever faster: the disc rolls on the
lower pad and the upper one slips. Held out: other strokes. Errors are root mean squares over the
signal's range, worst of the six states.

Command: .venv/bin/python experiments/reduced_model.py [--smoke]
Expected: stick: 8 terms, the very ones above; held-out error 0.3 % of range (node transitions in
the spin), more than 100 times faster than the full model; k, c and the masses within 10 % of the
expectation but for the spin's k (-14 %) and c_r (-18 %). Slip: 5 terms, 1 % up to 80 m/s2, 4 % at
300 m/s2, where the normal force is no longer that of the training strokes; 7 % in a grasp of
another depth, which is another mode. Two minutes on one core.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from torchsoft import Parameters, Profile, Reference, SoftGrasp, Trajectory, hold, simulate
from torchsoft.excitation import Excitation, Strokes, begin
from torchsoft.experiment import COARSE, grid, markdown, options, timed, write
from torchsoft.files import finite
from torchsoft.physics.contact import ramp
from torchsoft.physics.motion import Waves, wave
from torchsoft.reduced.fit import Recipe, assemble, choose, fit, rollout_of, score
from torchsoft.reduced.ode import ReducedModel, Term
from torchsoft.reduced.records import Record, record, rolling_radius
from torchsoft.reduced.terms import friction, joined, mechanics
from torchsoft.scenario import grasp_and_roll
from torchsoft.solve.stability import linearised


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/reduced_model")
    taps: int = 12
    tap_time: float = 0.3  # length of a tap [s]
    wave: float = 1e-5  # root mean square of a tap's multi-sine, over sqrt(2) [m]
    kick: float = 2e-3  # root mean square of a tap's initial velocities [m/s]
    band: tuple[float, float] = (3.0, 150.0)  # of the multi-sine [Hz]
    validation: float = 5e-5  # of the multi-sine by which thresholds are chosen, as `wave` [m]
    scenario: float = 1.0  # the manipulation's times, as parts of the paper's
    thresholds: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3)
    models: int = 50  # members of an ensemble
    depth: float = 3e-4  # of the light grasp [m]
    stroke_times: tuple[float, ...] = (
        0.12,
        0.08,
        0.065,
        0.05,
        0.04,
        0.03,
    )  # of the training strokes of 20 mm [s]
    checking_times: tuple[float, ...] = (
        0.07,
        0.04,
    )  # of those of 15 mm to the other side that choose thresholds [s]
    other_times: tuple[float, ...] = (
        0.15,
        0.1,
        0.055,
        0.045,
        0.035,
        0.03,
        0.025,
        0.02,
    )  # held out [s]
    speeds: tuple[float, ...] = (0.005, 0.01, 0.02)  # that tanh(s' / speed) is tried with [m/s]
    seed: int = 0
    smoke: bool = False  # a size that takes seconds


def law(p: Parameters) -> dict[str, dict[str, float]]:
    """The horizontal loop as feedback of the reduced model (Eq. 33, 34)."""
    K, R = p.control.K_81, p.control.R_80
    x, v = ("x_C", "v_C") if p.control.senses == "disc" else ("x_Br", "v_Br")
    return {"F_x": {"x_d": K, "x_d_dot": R, x: -K, v: -R}}


def slipping(model: SoftGrasp, run: Trajectory) -> float:
    """Part of the touching nodes of the upper pad that slip faster than 1 mm/s, over time."""
    with torch.no_grad():
        at = model.evaluate(0.0, model.unpack(run.y[::20])).interfaces["U"]
        touching = at.frame.g > 0
        slip = ramp(at.frame.g, model.contacts["U"].law.epsilon) * at.flow[..., 1] - at.out[..., 2]
        return float((touching & (slip.abs() > 1e-3)).sum() / touching.sum())


def compared(model: ReducedModel, static: dict[tuple[str, str], float]) -> list[dict[str, Any]]:
    """The coefficients beside what is expected of them; None where mechanics has no such term."""
    rows = model.coefficient_table()
    for row in rows:
        value = static.get((row["equation"], row["term"]))
        row |= {"expected": value, "error": None if value is None else row["value"] / value - 1}
    return rows


def refit(
    records: Sequence[Record], model: ReducedModel, recipe: Recipe, **how: Any
) -> ReducedModel:
    """A regression on just the terms of a model, in which none is left out."""
    terms = {target: [term for term, _ in pairs] for target, pairs in model.equations().items()}
    return fit(
        assemble(records, terms, recipe), replace(recipe, threshold=0.0, **how), model.feedback
    )


def rollout_time(model: ReducedModel, on: Record, repeats: int = 9) -> float:
    """Wall time of a rollout [s], the least, which other work on the machine disturbs least."""
    return min(timed(lambda: rollout_of(model, on))[1] for _ in range(repeats))


SETTLED = 1.0  # Time [s] at which the grasp has settled.


@dataclass(frozen=True)
class Grasp:
    """The paper's grasp, settled: the model, its state, and what holds it there."""

    p: Parameters
    y: torch.Tensor
    force: float

    def move(self, x: Profile, duration: float, *, step: float, sample: float) -> Trajectory:
        """The run in which the disc is to follow x_d(t) from the settled grasp."""
        y, force = Profile([0.0], [self.p.scenario.y_Br_grasp]), Profile([0.0], [-self.force])
        t, reference = grid(duration, sample), Reference(x_d=x, y_d=y, F_ff=force)
        return simulate(SoftGrasp(self.p), t, y0=self.y, reference=reference, step=step)


def settle(p: Parameters) -> Grasp:
    model = SoftGrasp(p)
    whole = grasp_and_roll(model)
    grasped = Reference(
        x_d=Profile([0.0], [p.scenario.x_C0]),
        y_d=model.reference["y_d"],
        F_ff=model.reference["F_ff"],
    )
    y = simulate(
        model, torch.tensor([0.0, SETTLED], dtype=torch.float64), y0=whole.y0, reference=grasped
    ).y[-1]
    return Grasp(p, y, whole.grasp_force)


def sines(
    config: Config,
    p: Parameters,
    size: float,
    band: tuple[float, float],
    seed: int,
    duration: float,
) -> Waves:
    """A multi-sine about where the disc is, under way from the first instant."""
    n, rng = 12, np.random.default_rng((config.seed, seed))
    f = band[0] * (band[1] / band[0]) ** ((np.arange(n) + rng.random(n)) / n)
    components = wave(np.full(n, size / n**0.5), f, np.zeros(n), rng.uniform(0, 2 * np.pi, n))
    return Waves(([0.0], [p.scenario.x_C0]), -1.0, duration + 1.0, components)


def tapped(grasp: Grasp, config: Config) -> list[Record]:
    """The taps."""
    rng, (_, v, _), out = np.random.default_rng(config.seed), indices(SoftGrasp(grasp.p)), []
    for i in range(config.taps):
        kick = config.kick * rng.standard_normal(3) / (1.0, grasp.p.disc.radius, 1.0)
        y = grasp.y.clone()
        y[v] += torch.from_numpy(kick)
        x = sines(config, grasp.p, config.wave, config.band, i, config.tap_time)
        out.append(record(replace(grasp, y=y).move(x, config.tap_time, step=2.5e-4, sample=2.5e-4)))
    return out


def indices(model: SoftGrasp) -> tuple[list[int], list[int], int]:
    """Indices of x_C, theta, x_Br and of their rates in the state, and the number of internal
    states before them."""
    at = model.layout.slices
    starts = [(at[part, "disc"].start, at[part, "bracket"].start) for part in ("pose", "velocity")]
    q, v = ([disc, disc + 2, bracket] for disc, bracket in starts)
    return q, v, q[0]


def expected(grasp: Grasp, A: np.ndarray, frequency: float = 1.0) -> dict[str, float]:
    """k, c, r and c_r of the linearised full model, pads and stretches condensed at a low frequency
    [Hz]."""
    model, w = SoftGrasp(grasp.p), 2j * np.pi * frequency
    q, v, inner = indices(model)
    inner = slice(0, inner)
    disc, bracket = model.bodies["disc"], model.bodies["bracket"]
    masses = np.array([disc.mass.item(), disc.inertia.item(), bracket.mass.item()])
    followed = np.linalg.solve(
        w * np.eye(inner.stop) - A[inner, inner], A[inner, q] + w * A[inner, v]
    )
    Z = masses[:, None] * (
        A[np.ix_(v, q)] + w * A[np.ix_(v, v)] + A[v, inner] @ followed
    )  # force, moment per motion
    spring = -Z[0, 0] / 2  # k + i omega c
    r = (Z[1, 2] / -spring).real
    rolling = -(Z[1, 1] + 2 * r**2 * spring)
    names = ("m", "I", "m_Br", "k", "c", "r", "c_r")
    return dict(zip(names, (*masses, spring.real, spring.imag / w.imag, r, rolling.imag / w.imag)))


def by_mechanics(e: dict[str, float]) -> dict[tuple[str, str], float]:
    """What mechanics expects of every coefficient, by equation and term."""
    spin = -e["r"] / e["I"]
    return {
        ("v_C", "x_Br - 2 x_C"): e["k"] / e["m"],
        ("v_C", "v_Br - 2 v_C"): e["c"] / e["m"],
        ("omega", "x_Br + 2 r theta"): spin * e["k"],
        ("omega", "v_Br + 2 r omega"): spin * e["c"],
        ("omega", "omega"): -e["c_r"] / e["I"],
        ("v_Br", "x_Br - x_C + r theta"): -e["k"] / e["m_Br"],
        ("v_Br", "v_Br - v_C + r omega"): -e["c"] / e["m_Br"],
        ("v_Br", "F_x"): 1 / e["m_Br"],
    }


def study_stick(config: Config) -> dict[str, Any]:
    changes: dict[str, Any] = COARSE if config.smoke else {}
    times = {"roll_time": 10.0, "hold_time": 5.0, "rest_time": 5.0}
    p = Parameters().override(
        changes | {f"scenario.{name}": config.scenario * value for name, value in times.items()}
    )
    grasp = settle(p)
    x_0, far = p.scenario.x_C0, p.scenario.x_C0 + 20e-3
    taps = tapped(grasp, config)
    roll_time = 5.0 * max(config.scenario, 0.2)
    far_roll = Profile([0.0, roll_time, 1.1 * roll_time], [x_0, far, far])
    roll = record(grasp.move(far_roll, 1.1 * roll_time, step=2e-3, sample=4e-3))
    waves = record(
        grasp.move(
            sines(config, p, config.validation, (2.0, 60.0), 1000, 1.0), 1.0, step=5e-4, sample=1e-3
        )
    )
    stroke = record(
        grasp.move(
            Profile([0.0, 1.0, 1.2], [x_0, x_0 + 6e-3, x_0 + 6e-3]), 1.2, step=2e-3, sample=4e-3
        )
    )
    model = SoftGrasp(p)
    whole = grasp_and_roll(model, grasp_force=grasp.force)
    runs = [
        simulate(model, grid(p.scenario.duration, 2e-3), y0=whole.y0)
        for _ in range(1 if config.smoke else 3)
    ]
    full, wall = runs[0], min(run.stats.wall_s for run in runs)
    held = record(full)

    r, feedback = rolling_radius([roll]), law(p)
    recipe = Recipe(width=0.004, window=config.tap_time, seed=config.seed)
    tests, library = [waves, stroke], mechanics(r)
    choice = choose(assemble(taps, library, recipe), tests, recipe, config.thresholds, feedback)
    model_ = refit(taps, choice.model, recipe, models=config.models)
    A = linearised(
        model, grasp.y, hold(x_d=x_0, y_d=p.scenario.y_Br_grasp, F_ff=-grasp.force)
    ).numpy()
    parts = expected(grasp, A)
    result = score(model_, held)
    fast = rollout_time(model_, held)
    return {
        "terms": len(model_.terms), "heldout_nrmse": result.worst,
        "heldout_nrmse_by_state": result.nrmse,
        "validation_nrmse": choice.tried[choice.index]["nrmse"], "speedup": wall / fast,
        "wall_full_s": wall, "wall_reduced_s": fast, "equations": model_.text(),
        "latex": model_.latex(),
        "rolling_radius_mm": {"found": 1e3 * r, "expected": 1e3 * parts["r"]}, "mechanics": parts,
        "coefficients": compared(model_, by_mechanics(parts)), "thresholds": choice.tried,
    }  # fmt: skip


class Stroke(NamedTuple):
    """Strokes in a light grasp: peak acceleration [m/s2], slipping part of the upper pad's touching
    nodes, mean normal force there [N], and wall time of the full model [s]."""

    record: Record
    acceleration: float
    slipping: float
    load: float
    wall_s: float


def strokes(
    config: Config, travel: float, stroke_time: float, *, depth: float | None = None
) -> Stroke:
    """Strokes there and back from a light grasp with the horizontal loop on the bracket."""
    motion = Strokes(travel=travel, stroke_time=stroke_time)
    e = Excitation(
        motion=motion,
        duration=0.5 + 4 * stroke_time + 0.01,
        depth=depth or config.depth,
        senses="bracket",
    )  # pyright: ignore[reportCallIssue]
    changes: dict[str, Any] = {"contact.v_s": 0.05} | (COARSE if config.smoke else {})
    model, y0, _ = begin(e, Parameters().override(changes))
    t, start = grid(e.duration, 5e-4), 1000
    run = simulate(model, t[: start + 1], y0=y0, step=5e-4)
    rest = simulate(model, t[start:], y0=run.y[-1], step=5e-4)
    peak = float(np.abs(np.gradient(rest["v_x_Br"].numpy(), 5e-4)).max())
    load = float(rest.force["U"][..., 0].sum(-1).mean())
    return Stroke(record(rest), peak, slipping(model, rest), load, rest.stats.wall_s)


def sticking(model: ReducedModel) -> ReducedModel:
    """The model's limit for small slip: every tanh(s' / speed) is s' / speed."""

    def straight(term: Term) -> Term:
        return replace(term, factors=tuple(part._replace(shape="linear") for part in term.factors))

    equations = {
        name: [(straight(term), x) for term, x in pairs]
        for name, pairs in model.equations().items()
    }
    return ReducedModel(
        model.states,
        model.inputs,
        model.kinematics,
        equations,
        feedback=model.feedback,
        scale=model.scale,
    )


def study_slip(config: Config) -> dict[str, Any]:
    train = [strokes(config, -20e-3, T) for T in config.stroke_times]
    other = {T: strokes(config, 15e-3, T) for T in (*config.checking_times, *config.other_times)}
    p = Parameters().override({"control.senses": "bracket"})
    gentle = max(config.stroke_times)
    r, feedback = rolling_radius([train[config.stroke_times.index(gentle)].record]), law(p)
    recipe = Recipe(width=0.004, window=min(config.stroke_times) * 4, seed=config.seed)
    records, checks = (
        [one.record for one in train],
        [other[T].record for T in config.checking_times],
    )
    held = {T: other[T] for T in config.other_times}

    choices = []
    for speed in config.speeds:
        library = joined(mechanics(r, alike=False), friction(r, speed))
        problem = assemble(records, library, recipe)
        choices.append(choose(problem, checks, recipe, config.thresholds, feedback, each=False))
    errors = [choice.tried[choice.index]["nrmse"] for choice in choices]
    good = [one.model for one, error in zip(choices, errors) if error <= 1.1 * min(errors)]
    model = refit(records, min(good, key=lambda one: len(one.terms)), recipe, models=config.models)
    limit = sticking(model)

    scores = {T: score(model, one.record) for T, one in other.items()}
    deep = strokes(config, 15e-3, 0.04, depth=5 / 3 * config.depth)
    fast = {T: rollout_time(model, one.record, 3) for T, one in other.items()}
    by_stroke = [
        {
            "stroke_time_s": T, "acceleration_m_s2": one.acceleration, "slipping": one.slipping,
            "load_N": one.load, "held_out": T in held, "nrmse": scores[T].worst,
            "rollout": str(scores[T].rollout), "nrmse_linear": score(limit, one.record).worst,
            "speedup": one.wall_s / fast[T],
        }
        for T, one in sorted(other.items(), reverse=True)
    ]  # fmt: skip
    heldout = [row["nrmse"] for row in by_stroke if row["held_out"]]

    def enough(key: str, allowed: float) -> float:
        """Largest acceleration [m/s2] up to which all strokes are within `allowed`."""
        rising = sorted(by_stroke, key=lambda row: row["acceleration_m_s2"])
        fine = list(takewhile(lambda row: row[key] <= allowed, rising))
        return fine[-1]["acceleration_m_s2"] if fine else 0.0

    return {
        "terms": len(model.terms), "heldout_nrmse": float(np.mean(heldout)),
        "heldout_nrmse_worst": float(np.max(heldout)),
        "speedup": float(np.median([row["speedup"] for row in by_stroke])),
        "equations": model.text(), "latex": model.latex(), "rolling_radius_mm": 1e3 * r,
        "coefficients": model.coefficient_table(), "by_stroke": by_stroke, "enough_up_to_m_s2": {
            f"{allowed:.0%}": {"with friction": enough("nrmse", allowed),
            "small-slip limit": enough("nrmse_linear", allowed)}
            for allowed in (0.01, 0.02)
        },
        "another_grasp": {
            "depth_mm": 5 / 3 * 1e3 * config.depth, "load_N": deep.load, "slipping": deep.slipping,
            "nrmse": score(model, deep.record).worst,
            "rollout": str(score(model, deep.record).rollout),
        },
        "thresholds": [row for choice in choices for row in choice.tried],
    }  # fmt: skip


@dataclass(frozen=True)
class Result:
    config: Config
    stick: dict[str, Any]
    slip: dict[str, Any]


def run(config: Config) -> Result:
    if config.smoke:
        config = replace(
            config, taps=6, tap_time=0.15, validation=2e-4, scenario=0.2,
            thresholds=(0.03, 0.07, 0.14), models=10, stroke_times=(0.08, 0.05, 0.03),
            checking_times=(0.06,), other_times=(0.025,), speeds=(0.01,),
        )  # fmt: skip
    return Result(config, study_stick(config), study_slip(config))


def summary(result: Result) -> dict[str, Any]:
    return finite({"stick": result.stick, "slip": result.slip, "pysindy": version("pysindy")})


def table(result: Result) -> str:
    """Markdown: both regimes, and the coefficients beside mechanics."""
    regimes = [
        (name, one["terms"], f"{one['heldout_nrmse']:.2%}", f"{one['speedup']:.0f} x")
        for name, one in (("stick", result.stick), ("slip", result.slip))
    ]
    rows = []
    for row in result.stick["coefficients"]:
        low, high = row["interval"]
        static = (
            ("-", "-")
            if row["expected"] is None
            else (f"{row['expected']:.4g}", f"{row['error']:+.1%}")
        )
        found = f"{row['value']:.4g}", f"{low:.4g} to {high:.4g}"
        rows.append((f"{row['equation']}'", row["term"], *found, *static))
    head = ("equation", "term", "found", "5 to 95 %", "expected", "error")
    return (
        markdown(("regime", "terms", "held-out NRMSE", "speed-up"), regimes)
        + "\n\n"
        + markdown(head, rows)
    )


def figure(result: Result) -> Figure:
    """Errors under slip."""
    fig = Figure(figsize=(6, 4.5), layout="constrained")
    axes, by = fig.subplots(), result.slip["by_stroke"]
    for key, label in (
        ("nrmse", "with friction"),
        ("nrmse_linear", "its limit for small slip (linear)"),
    ):
        errors = [100 * min(row[key], 10.0) for row in by]
        axes.loglog([row["acceleration_m_s2"] for row in by], errors, "o-", label=label)
    axes.set(xlabel="peak acceleration of the bracket [m/s$^2$]", ylabel="NRMSE [%]")
    axes.legend()
    return fig


def main() -> None:
    config = options(Config, __doc__)
    with threadpool_limits(1):  # what is timed, is timed on one core
        result = run(config)
    print("\n".join(["stick:", *result.stick["equations"], "", "slip:", *result.slip["equations"]]))
    write(result.config, summary(result), {"reduced_model": figure(result)}, table(result))


if __name__ == "__main__":
    main()
