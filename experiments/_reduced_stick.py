"""Question: which equations does the motion follow while both pads stick to the disc, and does mechanics explain them?"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from _reduced_common import Config, attempt, compared, ensemble, law, rollout_time, slipping, summary_of
from scipy.signal import cont2discrete
from tqdm import tqdm

from torchsoft import Parameters, Profile, Reference, SoftGrasp, Trajectory, hold, simulate
from torchsoft.excitation import Waves, wave
from torchsoft.experiment import COARSE, grid
from torchsoft.reduced.fit import Recipe, assemble, choose, fit, score
from torchsoft.reduced.ode import ReducedModel
from torchsoft.reduced.records import STATES, Record, noisy, record, rolling_radius
from torchsoft.reduced.terms import mechanics, polynomials
from torchsoft.scenario import grasp_and_roll
from torchsoft.solve.stability import linearised

SETTLED = 1.0  # Time [s] at which the grasp has settled.


@dataclass(frozen=True)
class Grasp:
    """The paper's grasp, settled: the model, its state, and what holds it there."""

    p: Parameters
    y: torch.Tensor
    force: float

    def model(self, **changed: float) -> SoftGrasp:
        return SoftGrasp(self.p.override({f"control.{k}": v for k, v in changed.items()}))

    def move(self, x: Profile, duration: float, *, step: float, sample: float, **changed: float) -> Trajectory:
        """The run in which the disc is to follow x_d(t) from the settled grasp."""
        y, force = Profile([0.0], [self.p.scenario.y_Br_grasp]), Profile([0.0], [-self.force])
        t, reference = grid(duration, sample), Reference(x_d=x, y_d=y, F_ff=force)
        return simulate(self.model(**changed), t, y0=self.y, reference=reference, step=step)


def settle(p: Parameters) -> Grasp:
    model = SoftGrasp(p)
    whole = grasp_and_roll(model)
    grasped = Reference(x_d=Profile([0.0], [p.scenario.x_C0]), y_d=model.reference["y_d"], F_ff=model.reference["F_ff"])
    y = simulate(model, torch.tensor([0.0, SETTLED], dtype=torch.float64), y0=whole.y0, reference=grasped).y[-1]
    return Grasp(p, y, whole.grasp_force)


def sines(config: Config, p: Parameters, size: float, band: tuple[float, float], seed: int, duration: float) -> Waves:
    """A multi-sine about where the disc is, under way from the first instant."""
    n, rng = 12, np.random.default_rng((config.seed, seed))
    f = band[0] * (band[1] / band[0]) ** ((np.arange(n) + rng.random(n)) / n)
    components = wave(np.full(n, size / n**0.5), f, np.zeros(n), rng.uniform(0, 2 * np.pi, n))
    return Waves(([0.0], [p.scenario.x_C0]), -1.0, duration + 1.0, components)


def tapped(grasp: Grasp, config: Config) -> tuple[list[Record], np.ndarray]:
    """The taps, and the initial velocities of x_C, theta and x_Br that they began with (taps, 3)."""
    rng, (_, v, _), out, kicks = np.random.default_rng(config.seed), indices(grasp.model()), [], []
    for i in range(config.taps):
        kick = config.kick * rng.standard_normal(3) / (1.0, grasp.p.disc.radius, 1.0)
        y = grasp.y.clone()
        y[v] += torch.from_numpy(kick)
        x = sines(config, grasp.p, config.wave, config.band, i, config.tap_time)
        out.append(record(replace(grasp, y=y).move(x, config.tap_time, step=2.5e-4, sample=2.5e-4)))
        kicks.append(kick)
    return out, np.array(kicks)


def indices(model: SoftGrasp) -> tuple[list[int], list[int], int]:
    """Indices of x_C, theta, x_Br and of their rates in the state, and the number of internal states before them."""
    at = model.layout.slices
    starts = [(at[part, "disc"].start, at[part, "bracket"].start) for part in ("pose", "velocity")]
    q, v = ([disc, disc + 2, bracket] for disc, bracket in starts)
    return q, v, q[0]


def expected(grasp: Grasp, A: np.ndarray, frequency: float = 1.0) -> dict[str, float]:
    """k, c, r and c_r of the linearised full model, pads and stretches condensed at a low frequency [Hz]."""
    model, w = grasp.model(), 2j * np.pi * frequency
    q, v, inner = indices(model)
    bodies, inner = model.bodies, slice(0, inner)
    masses = np.array([bodies["disc"].mass.item(), bodies["disc"].inertia.item(), bodies["bracket"].mass.item()])
    followed = np.linalg.solve(w * np.eye(inner.stop) - A[inner, inner], A[inner, q] + w * A[inner, v])
    Z = (A[np.ix_(v, q)] + w * A[np.ix_(v, v)] + A[v, inner] @ followed) * masses[
        :, None
    ]  # force and moment per motion
    spring = -Z[0, 0] / 2  # k + i omega c
    r = (Z[1, 2] / -spring).real
    rolling = -(Z[1, 1] + 2 * r**2 * spring)
    names = ("m", "I", "m_Br", "k", "c", "r", "c_r")
    return dict(zip(names, (*masses, spring.real, spring.imag / w.imag, r, rolling.imag / w.imag)))


def in_band(grasp: Grasp, A: np.ndarray, taps: Sequence[Record], kicks: np.ndarray) -> list[Record]:
    """The taps as the linearised full model makes them."""
    model, p = grasp.model(), grasp.p
    q, v, _ = indices(model)
    B = np.zeros((len(A), 2))
    B[v[2]] = np.array([p.control.K_81, p.control.R_80]) / p.bracket.mass
    discrete: Any = cont2discrete((A, B, np.eye(len(A)), 0 * B), taps[0].step, method="foh")
    F, G, _, D, _ = discrete
    u = np.stack([tap.columns(("x_d", "x_d_dot")) for tap in taps], 1)  # (T, taps, 2)
    x = np.zeros((len(taps), len(A)))
    x[:, v] = kicks
    x -= u[0] @ D.T
    rows = []
    for now in u:
        rows.append((x + now @ D.T)[:, [*q, *v]])
        x = x @ F.T + now @ G.T
    out = []
    for i, tap in enumerate(taps):
        series = dict(zip(STATES, np.array(rows)[:, i].T))
        desired = {name: tap.series[name] for name in ("x_d", "x_d_dot")}
        force = p.control.K_81 * (desired["x_d"] - series["x_C"]) + p.control.R_80 * (
            desired["x_d_dot"] - series["v_C"]
        )
        out.append(Record(tap.t, {**series, "F_x": force, **desired}))
    return out


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


def refitted(
    records: Sequence[Record], terms: Any, recipe: Recipe, static: dict[tuple[str, str], float]
) -> dict[str, float]:
    """Coefficients over what mechanics expects, with the terms given."""
    model = fit(assemble(records, terms, recipe), replace(recipe, threshold=0.0))
    return {
        f"{row['equation']}: {row['term']}": row["value"] / static[key]
        for row in model.coefficient_table()
        if (key := (row["equation"], row["term"])) in static
    }


def study_stick(config: Config, bar: tqdm) -> tuple[dict[str, Any], dict[str, Any], Grasp, np.ndarray, ReducedModel]:
    changes: dict[str, Any] = COARSE if config.smoke else {}
    part = {
        f"scenario.{k}": config.scenario * v for k, v in (("roll_time", 10.0), ("hold_time", 5.0), ("rest_time", 5.0))
    }
    p = Parameters().override(changes | part)
    grasp = settle(p)
    bar.update()
    x_0, far = p.scenario.x_C0, p.scenario.x_C0 + 20e-3
    taps, kicks = tapped(grasp, config)
    bar.update()
    roll_time = 5.0 * max(config.scenario, 0.2)
    roll = record(
        grasp.move(Profile([0.0, roll_time, 1.1 * roll_time], [x_0, far, far]), 1.1 * roll_time, step=2e-3, sample=4e-3)
    )
    moving = {
        f"multi-sine, {1e6 * size:g} um": grasp.move(
            sines(config, p, size, (2.0, 60.0), 1000 + i, 1.0), 1.0, step=5e-4, sample=1e-3
        )
        for i, size in enumerate(config.amplitudes)
    }
    slipping_parts = {name: slipping(grasp.model(), run) for name, run in moving.items()}
    others = {name: record(run) for name, run in moving.items()}
    stroke = record(grasp.move(Profile([0.0, 1.0, 1.2], [x_0, x_0 + 6e-3, x_0 + 6e-3]), 1.2, step=2e-3, sample=4e-3))
    model = SoftGrasp(p)
    whole = grasp_and_roll(model, grasp_force=grasp.force)
    runs = [simulate(model, grid(p.scenario.duration, 2e-3), y0=whole.y0) for _ in range(1 if config.smoke else 3)]
    full, wall = runs[0], min(run.stats.wall_s for run in runs)
    held = record(full)
    bar.update()

    r, feedback = rolling_radius([roll]), law(p)
    recipe = Recipe(width=0.004, window=config.tap_time, seed=config.seed)
    tests = [next(iter(others.values())), stroke]  # validation; the rest is held out
    library = mechanics(r)
    problem = assemble(taps, library, recipe)
    choice = choose(problem, tests, recipe, config.thresholds, feedback)
    model_ = ensemble(problem, choice.model, recipe, config.models, feedback)
    still = hold(x_d=x_0, y_d=p.scenario.y_Br_grasp, F_ff=-grasp.force)
    A = linearised(model, grasp.y, still).numpy()
    static = expected(grasp, A)
    chosen = {target: [term for term, _ in pairs] for target, pairs in model_.equations().items()}
    banded = fit(assemble(in_band(grasp, A, taps, kicks), chosen, recipe), replace(recipe, threshold=0.0))
    bar.update()

    result = score(model_, held)
    other_fits = {}
    for name, changed in (
        ("STLSQ, weak form", {}), ("SR3, weak form", {"optimizer": "sr3"}), ("STLSQ, differences", {"form": "derivative"}),
    ):  # fmt: skip
        how = replace(recipe, **changed)
        other_fits[name] = summary_of(
            choose(assemble(taps, library, how), tests, how, config.thresholds, feedback), held
        )
    raw = polynomials((*STATES, "F_x"), 1)
    same = dict.fromkeys(("v_C", "omega", "v_Br"), raw)
    other_fits["polynomials of degree 1"] = attempt(taps, same, recipe, tests, config, feedback, held)
    if not config.smoke:
        both = dict.fromkeys(same, polynomials((*STATES, "F_x"), 2))
        other_fits["polynomials of degree 2"] = attempt(taps, both, recipe, tests, config, feedback, held, each=False)
    bar.update()
    noise = []
    for level in config.noise:
        rows = []
        for draw in range(config.draws if level else 1):
            rough = [noisy(tap, level, config.seed + 100 * draw + i) for i, tap in enumerate(taps)]
            row: dict[str, Any] = attempt(rough, library, recipe, tests, config, feedback, held)
            row["refitted"] = refitted(rough, chosen, recipe, by_mechanics(static))
            rows.append(row)
        noise.append({"noise": level, "draws": rows})
    bar.update()

    fast = rollout_time(model_, held)
    F_x = held.series["F_x"]
    y = result.rollout.y
    made = law(p)["F_x"]
    ours = sum(gain * (held.series[k] if k.startswith("x_d") else y[:, STATES.index(k)]) for k, gain in made.items())
    summary = {
        "terms": len(model_.terms),
        "heldout_nrmse": result.worst,
        "heldout_nrmse_by_state": result.nrmse,
        "heldout_over_deviation_by_state": result.over_deviation,
        "heldout_F_x_over_range": float(np.sqrt(np.mean((ours - F_x) ** 2)) / np.ptp(F_x)),
        "validation_nrmse": choice.tried[choice.index]["nrmse"],
        "speedup": wall / fast,
        "wall_full_s": wall,
        "wall_reduced_s": fast,
        "equations": model_.text(),
        "latex": model_.latex(),
        "rolling_radius_mm": {"found": 1e3 * r, "expected": 1e3 * static["r"]},
        "mechanics": static,
        "coefficients": compared(model_, by_mechanics(static), banded),
        "other_fits": other_fits,
        "noise": noise,
        "held_out_amplitudes": {
            name: {"nrmse": score(model_, one).worst, "slipping": slipping_parts[name]} for name, one in others.items()
        },
        "thresholds": choice.tried,
    }
    return summary, {"held": held, "rollout": result.rollout}, grasp, A, model_
