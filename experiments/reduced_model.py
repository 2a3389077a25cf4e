"""Question: how small can an ordinary differential equation for disc and bracket be, and where does it stop being enough?

Stick. Both pads stick to the disc: each is a spring k and a dashpot c on its slip (`torchsoft.reduced.terms`), so that
    m x_C''     =  k (x_Br - 2 x_C) + c (...)'
    I theta''   = -r [k (x_Br + 2 r theta) + c (...)'] - c_r theta'
    m_Br x_Br'' =  F_x - k (x_Br - x_C + r theta) - c (...)'
with F_x known from the control law. What mechanics expects of k, c, r and c_r is computed from the full model, linearised in
the grasp: pads and stretches condensed at rest ("static"), and, because that condensation is not quite a spring and a dashpot
at every frequency, the same regression on the linearised full model under the same motions ("in band"). Slow rolling does not
excite k and c (m x_C'' is nothing), so the training motions are taps: small random velocities of disc and bracket and a broad
multi-sine, some micrometres large. The radius comes from one roll to the other side. Held out: the paper's manipulation.

Slip. A light grasp, the horizontal loop on the bracket, strokes ever faster: the disc rolls on the lower pad and the upper one
slips. Then F_U = mu_k N_U + eta n s_U' and x_C = -r theta, so that x_C'' = 2 F_U / (m + I / r^2). Held out: other strokes.

Errors are root mean squares over the signal's range, worst of the six states; `summary.json` has those over the standard
deviation as well.

Command: .venv/bin/python experiments/reduced_model.py [--smoke]
Expected: stick: 8 terms, the very ones above; held-out error 0.3 % of range (node transitions in the spin), more than 100 times
faster than the full model; k, c and the masses within 10 % of the static expectation but for the spin's k (-14 %) and c_r
(-18 %), all within 4 % of that in band. Noise up to 5 % leaves the rollouts as they are and spoils the spin's coefficients
first. Slip: 5 terms, 1 % up to 80 m/s2, 4 % at 300 m/s2, where the normal force is no longer that of the training strokes; 7 %
in a grasp of another depth, which is another mode. Two minutes on one core.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from scipy.optimize import brentq
from scipy.signal import cont2discrete
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from torchsoft import Parameters, SimulationFailed, SoftGrasp, Trajectory, simulate
from torchsoft.control import Profile, Reference, hold
from torchsoft.excitation import Excitation, Strokes, Waves, begin, wave
from torchsoft.reduced.fit import Choice, Recipe, assemble, choose, fit, rollout_of, score
from torchsoft.reduced.ode import ReducedModel
from torchsoft.reduced.records import STATES, Record, noisy, record, rolling_radius
from torchsoft.reduced.terms import friction, joined, mechanics, polynomials
from torchsoft.scenario import grasp_and_roll
from torchsoft.stability import DISPLACEMENT, VELOCITY

SETTLED = 1.0
"""Time [s] at which the grasp has settled."""

COARSE = {"pad.elements_x": 60, "pad.elements_y": 2}


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/reduced_model")
    taps: int = 12
    tap_time: float = 0.3
    """length of a tap [s]"""
    wave: float = 1e-5
    """root mean square of a tap's multi-sine, over sqrt(2) [m]"""
    kick: float = 2e-3
    """root mean square of a tap's initial velocities [m/s]"""
    band: tuple[float, float] = (3.0, 150.0)
    """of the multi-sine [Hz]"""
    amplitudes: tuple[float, ...] = (5e-5, 2e-4, 5e-4, 1e-3)
    """of held-out multi-sines in the same grasp, as `wave` [m]"""
    scenario: float = 1.0
    """the manipulation's times, as parts of the paper's"""
    thresholds: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3)
    models: int = 50
    """members of an ensemble"""
    noise: tuple[float, ...] = (0.0, 0.005, 0.01, 0.02, 0.05)
    """standard deviations of the noise, in parts of the signals' own"""
    draws: int = 3
    """of the noise"""
    depth: float = 3e-4
    """of the light grasp [m]"""
    stroke_times: tuple[float, ...] = (0.12, 0.08, 0.065, 0.05, 0.04, 0.03)
    """of the training strokes of 20 mm [s]"""
    checking_times: tuple[float, ...] = (0.07, 0.04)
    """of the strokes of 15 mm to the other side by which thresholds are chosen [s]"""
    other_times: tuple[float, ...] = (0.15, 0.1, 0.055, 0.045, 0.035, 0.03, 0.025, 0.02)
    """of those that are held out [s]"""
    speeds: tuple[float, ...] = (0.005, 0.01, 0.02)
    """that tanh(s' / speed) is tried with [m/s]"""
    gains: int = 60
    """of the sweep"""
    seed: int = 0
    smoke: bool = False
    """a size that takes seconds"""


def smoke(config: Config) -> Config:
    return replace(
        config, taps=6, tap_time=0.15, amplitudes=(2e-4,), scenario=0.2, thresholds=(0.03, 0.07, 0.14), models=10,
        noise=(0.0, 0.02), draws=1, stroke_times=(0.08, 0.05, 0.03), checking_times=(0.06,), other_times=(0.025,),
        speeds=(0.01,), gains=8,
    )  # fmt: skip


@dataclass(frozen=True)
class Result:
    config: Config
    stick: dict[str, Any]
    slip: dict[str, Any]
    gain: dict[str, Any]
    traces: dict[str, Any] = field(repr=False)


def times(duration: float, step: float) -> torch.Tensor:
    return torch.linspace(0, duration, round(duration / step) + 1, dtype=torch.float64)


def law(p: Parameters, **changed: float) -> dict[str, dict[str, float]]:
    """The horizontal loop as feedback of the reduced model (Eq. 33, 34)."""
    K, R = changed.get("K_81", p.control.K_81), changed.get("R_80", p.control.R_80)
    x, v = ("x_C", "v_C") if p.control.senses == "disc" else ("x_Br", "v_Br")
    return {"F_x": {"x_d": K, "x_d_dot": R, x: -K, v: -R}}


def slipping(model: SoftGrasp, run: Trajectory, start: int = 0) -> float:
    """Part of the touching nodes of the upper pad that slip faster than 1 mm/s, over time."""
    with torch.no_grad():
        at = model.evaluate(0.0, model.layout.unpack(run.y[start::20])).interfaces["U"]
        touching = at.frame.g > 0
        return float((touching & (at.contact.gamma_dot.abs() > 1e-3)).sum() / touching.sum())


@dataclass(frozen=True)
class Grasp:
    """The paper's grasp, settled: the model, its state, and what holds it there."""

    p: Parameters
    y: torch.Tensor
    force: float

    def model(self, **changed: float) -> SoftGrasp:
        return SoftGrasp(self.p.override({f"control.{k}": v for k, v in changed.items()}))

    def move(self, x: Profile, duration: float, *, step: float, sample: float, **changed: float) -> Trajectory:
        """The disc asked to follow x_d(t) from the settled grasp."""
        model, s = self.model(**changed), self.p.scenario
        model.reference = Reference(x, Profile([0.0], [s.y_Br_grasp]), Profile([0.0], [-self.force]))
        return simulate(model, times(duration, sample), y0=self.y, step=step)


def settle(p: Parameters) -> Grasp:
    model = SoftGrasp(p)
    whole = grasp_and_roll(model)
    model.reference = Reference(Profile([0.0], [p.scenario.x_C0]), model.reference.y, model.reference.F_y)
    y = simulate(model, torch.tensor([0.0, SETTLED], dtype=torch.float64), y0=whole.y0).y[-1]
    return Grasp(p, y, whole.grasp_force)


def sines(config: Config, p: Parameters, size: float, band: tuple[float, float], seed: int, duration: float) -> Waves:
    """A multi-sine about where the disc is, under way from the first instant."""
    n, rng = 12, np.random.default_rng((config.seed, seed))
    f = band[0] * (band[1] / band[0]) ** ((np.arange(n) + rng.random(n)) / n)
    components = wave(np.full(n, size / n**0.5), f, np.zeros(n), rng.uniform(0, 2 * np.pi, n))
    return Waves(([0.0], [p.scenario.x_C0]), -1.0, duration + 1.0, components)


def tapped(grasp: Grasp, config: Config) -> tuple[list[Record], np.ndarray]:
    """The taps, and the initial velocities of x_C, theta and x_Br that they began with (taps, 3)."""
    rng, at, out, kicks = np.random.default_rng(config.seed), SoftGrasp(grasp.p).layout.slices, [], []
    for i in range(config.taps):
        kick = config.kick * rng.standard_normal(3) / (1.0, grasp.p.disc.radius, 1.0)
        y = grasp.y.clone()
        y[at["v_C"].start] += kick[0]
        y[at["omega"]] += kick[1]
        y[at["v_Br"].start] += kick[2]
        x = sines(config, grasp.p, config.wave, config.band, i, config.tap_time)
        out.append(record(replace(grasp, y=y).move(x, config.tap_time, step=2.5e-4, sample=2.5e-4)))
        kicks.append(kick)
    return out, np.array(kicks)


def linearised(grasp: Grasp) -> np.ndarray:
    """dy'/dy of the full model in its settled grasp, contact and sticking as they are there."""
    model, s = grasp.model(), grasp.p.scenario
    model.reference = hold(s.x_C0, s.y_Br_grasp, -grasp.force)
    size = torch.full((model.layout.size,), DISPLACEMENT, dtype=torch.float64)
    size[model.layout.slices["v_L"].start :] = VELOCITY
    with torch.no_grad():
        ahead, behind = (model(0.0, grasp.y + sign * torch.diag(size)) for sign in (1.0, -1.0))
    return ((ahead - behind) / (2 * size[:, None])).mT.numpy()


def places(model: SoftGrasp) -> tuple[list[int], list[int], int]:
    """Where x_C, theta, x_Br and their rates stand in the state, and how many internal states come before."""
    at = model.layout.slices
    q = [at["r_C"].start, at["theta"].start, at["r_Br"].start]
    return q, [at["v_C"].start, at["omega"].start, at["v_Br"].start], at["r_C"].start


def expected(grasp: Grasp, A: np.ndarray, frequency: float = 1.0) -> dict[str, float]:
    """k, c, r and c_r of the linearised full model, pads and stretches condensed at a low frequency [Hz]."""
    model, w = grasp.model(), 2j * np.pi * frequency
    q, v, inner = places(model)
    masses, inner = np.array([model.m_C.item(), model.inertia.item(), model.m_Br.item()]), slice(0, inner)
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
    q, v, _ = places(model)
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


def compared(
    model: ReducedModel, static: dict[tuple[str, str], float], banded: ReducedModel | None = None
) -> list[dict[str, Any]]:
    """The coefficients beside what is expected of them; None where mechanics has no such term."""
    rows = model.coefficient_table()
    for i, row in enumerate(rows):
        want = static.get((row["equation"], row["term"]))
        row["expected"] = want
        row["error"] = None if want is None else row["value"] / want - 1
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


def timed(model: ReducedModel, on: Record, repeats: int = 9) -> float:
    """Wall time of a rollout [s], the least, which other work on the machine disturbs least."""
    walls = []
    for _ in range(repeats):
        began = perf_counter()
        rollout_of(model, on)
        walls.append(perf_counter() - began)
    return min(walls)


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
    shares = {name: slipping(grasp.model(), run) for name, run in moving.items()}
    others = {name: record(run) for name, run in moving.items()}
    stroke = record(grasp.move(Profile([0.0, 1.0, 1.2], [x_0, x_0 + 6e-3, x_0 + 6e-3]), 1.2, step=2e-3, sample=4e-3))
    model = SoftGrasp(p)
    whole = grasp_and_roll(model, grasp_force=grasp.force)
    runs = [simulate(model, times(p.scenario.duration, 2e-3), y0=whole.y0) for _ in range(1 if config.smoke else 3)]
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
    A = linearised(grasp)
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

    fast = timed(model_, held)
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
            name: {"nrmse": score(model_, one).worst, "slipping": shares[name]} for name, one in others.items()
        },
        "thresholds": choice.tried,
    }
    return summary, {"held": held, "rollout": result.rollout}, grasp, A, model_


def summary_of(choice: Choice, held: Record) -> dict[str, Any]:
    result = score(choice.model, held)
    return {
        "terms": len(choice.model.terms), "heldout_nrmse": result.worst, "rollout": str(result.rollout),
        "equations": choice.model.text()[3:],
    }  # fmt: skip


def attempt(
    records: Sequence[Record],
    library: Any,
    recipe: Recipe,
    tests: Sequence[Record],
    config: Config,
    feedback: Any,
    held: Record,
    **how: Any,
) -> dict[str, Any]:
    """A choice, or why there was none."""
    try:
        return summary_of(
            choose(assemble(records, library, recipe), tests, recipe, config.thresholds, feedback, **how), held
        )
    except ValueError as error:
        return {"terms": None, "heldout_nrmse": None, "rollout": str(error), "equations": []}


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
    t, start = times(e.duration, 5e-4), 1000
    run = simulate(model, t[: start + 1], y0=y0, step=5e-4)
    rest = simulate(model, t[start:], y0=run.y[-1], step=5e-4)
    peak = float(np.abs(np.gradient(rest.state.v_Br[:, 0].numpy(), 5e-4)).max())
    normal = rest.force_U[..., 0]
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
    fast = {T: timed(model, one.record, 3) for T, one in other.items()}
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

    _, v, _ = places(grasp.model())

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
            x_C = (run.state.r_C[:, 0] - run.state.r_C[0, 0]).numpy()
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


def run(config: Config) -> Result:
    config = smoke(config) if config.smoke else config
    bar = tqdm(total=12, unit="part")
    stick, traces, grasp, A, model = study_stick(config, bar)
    gain = study_gain(config, grasp, A, model, bar)
    slip, more = study_slip(config, bar)
    bar.close()
    return Result(config, stick, slip, gain, {"stick": traces, "slip": more})


def summary(result: Result) -> dict[str, Any]:
    made = {
        "torchsoft": version("torchsoft"), "pysindy": version("pysindy"), "seed": result.config.seed,
        "config": {k: str(v) for k, v in asdict(result.config).items()},
    }  # fmt: skip
    return finite({"stick": result.stick, "slip": result.slip, "gain_sweep": result.gain, "made_by": made})


def finite(x: Any) -> Any:
    """x with None for what is not finite; what diverged says so beside it."""
    if isinstance(x, dict):
        return {k: finite(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [finite(v) for v in x]
    return None if isinstance(x, float) and not np.isfinite(x) else x


def table(result: Result) -> str:
    """Markdown: both regimes, and the coefficients beside mechanics."""
    lines = ["| regime | terms | held-out NRMSE | speed-up |", "|---|---|---|---|"]
    for name, one in (("stick", result.stick), ("slip", result.slip)):
        lines.append(f"| {name} | {one['terms']} | {one['heldout_nrmse']:.2%} | {one['speedup']:.0f} x |")
    lines += ["", "| equation | term | found | 5 to 95 % | static | error | in band | error |", "|---" * 8 + "|"]
    for row in result.stick["coefficients"]:
        low, high = row["interval"]
        static = "- | -" if row["expected"] is None else f"{row['expected']:.4g} | {row['error']:+.1%}"
        lines.append(
            f"| {row['equation']}' | {row['term']} | {row['value']:.4g} | {low:.4g} to {high:.4g} | {static} | "
            f"{row['expected_in_band']:.4g} | {row['error_in_band']:+.1%} |"
        )
    return "\n".join(lines)


def figure(result: Result) -> Figure:
    """Held-out manipulation, its error, the choice of the threshold; coefficients, slip, gain sweep."""
    fig = Figure(figsize=(15, 8.5), layout="constrained")
    (a, b, c), (d, e, f) = fig.subplots(2, 3)
    held, out = result.traces["stick"]["held"], result.traces["stick"]["rollout"]
    shown = (("x_C", 1e3, "mm"), ("x_Br", 1e3, "mm"), ("theta", 10.0, "0.1 rad"))
    for i, (name, size, unit) in enumerate(shown):
        a.plot(held.t, size * held.series[name], f"C{i}", lw=3, alpha=0.35)
        a.plot(held.t, size * out.y[:, STATES.index(name)], f"C{i}--", lw=1, label=f"{name} [{unit}]")
    a.set(xlabel="time [s]", title="Stick: held out; wide full, dashed reduced")
    a.legend()
    for i, name in enumerate(STATES):
        scale = np.ptp(held.series[name])
        b.plot(held.t, 100 * (out.y[:, i] - held.series[name]) / scale, lw=0.7, label=name)
    b.set(xlabel="time [s]", ylabel="error over range [%]", title="Stick: error of the held-out rollout")
    b.legend(ncols=3, fontsize="small")
    tried = [row for row in result.stick["thresholds"] if np.isfinite(row["nrmse"])]
    c.semilogy([row["terms"] for row in tried], [100 * row["nrmse"] for row in tried], ".", color="0.6", label="tried")
    c.semilogy(
        result.stick["terms"],
        100 * result.stick["validation_nrmse"],
        "o",
        mfc="none",
        ms=12,
        color="C3",
        label="chosen",
    )
    c.set(xlabel="terms", ylabel="NRMSE of validation rollouts [%]", title="Stick: thresholds by rollout error")
    c.legend()
    rows = [row for row in result.stick["coefficients"] if row["expected"]]
    for i, row in enumerate(rows):
        low, high = sorted(x / row["expected"] for x in row["interval"])
        d.plot([low, high], [i, i], "C0", lw=3, alpha=0.5)
        d.plot(row["value"] / row["expected"], i, "oC0", label="found" if i == 0 else None)
        d.plot(row["expected_in_band"] / row["expected"], i, "xC1", label="expected in band" if i == 0 else None)
    d.axvspan(0.9, 1.1, color="0.92", zorder=0)
    d.axvline(1.0, color="k", lw=0.8)
    d.set_yticks(range(len(rows)), [f"{row['equation']}': {row['term']}" for row in rows])
    d.invert_yaxis()
    d.set(xlabel="over the static expectation", title="Stick: coefficients and mechanics")
    d.legend(loc="best", fontsize="small")
    by = result.slip["by_stroke"]
    acceleration = [row["acceleration_m_s2"] for row in by]
    e.loglog(
        acceleration, [100 * row["nrmse"] for row in by], "o-C0", label=f"with friction, {result.slip['terms']} terms"
    )
    linear = [row["nrmse_linear"] for row in by]
    e.loglog(acceleration, [100 * min(x, 10.0) for x in linear], "s-C1", label="its limit for small slip (linear)")
    deep = result.slip["another_grasp"]
    e.axhline(100 * min(deep["nrmse"], 10.0), color="C3", ls=":", label=f"same, grasp of {deep['depth_mm']:.2g} mm")
    e.set(
        xlabel="peak acceleration of the bracket [m/s$^2$]", ylabel="NRMSE [%]", title="Slip: rollouts of other strokes"
    )
    share = e.twinx()
    share.fill_between(acceleration, [100 * row["slipping"] for row in by], color="0.5", alpha=0.2, lw=0)
    share.set(ylabel="slipping nodes of the upper pad [%] (grey)", ylim=(0, 100))
    e.set_zorder(share.get_zorder() + 1)
    e.patch.set_visible(False)
    e.legend(loc="upper left", fontsize="small")
    sweep = result.gain["sweep"]
    f.semilogx([row["R_80"] for row in sweep], [row["growth_1_s"] for row in sweep], "C0", label="reduced")
    f.axhline(0.0, color="k", lw=0.8)
    for i, row in enumerate(result.gain["confirmed"]):
        label = None if i else "full, linearised\n(filled: dies out in a run)"
        f.plot(row["R_80"], row["growth_full_1_s"], "oC3", mfc="C3" if row["full_dies_out"] else "w", label=label)
    f.set(
        xlabel="gain $R_{80}$ [N s/m]", ylabel="growth of the slowest mode [1/s]", title="Gain sweep", ylim=(None, 30)
    )
    f.legend(fontsize="small", loc="upper center")
    return fig


def main() -> None:
    torch.set_num_threads(1)
    with threadpool_limits(1):  # what is timed, is timed on one core
        result = run(tyro.cli(Config, description=__doc__))
    out = result.config.out
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").write_text(json.dumps(summary(result), indent=2))
    figure(result).savefig(out / "reduced_model.png", dpi=150)
    print("\n" + table(result) + "\n")
    print("\n".join(["stick:", *result.stick["equations"], "", "slip:", *result.slip["equations"]]))
    print(f"\nwritten to {out}")


if __name__ == "__main__":
    main()
