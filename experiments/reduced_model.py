"""Question: how small can an ordinary differential equation for disc and bracket be?

Both pads stick to the disc: each is a spring k and a dashpot c on its slip
(`torchsoft.reduced.terms`), so that
    m x_C''     = k (x_Br - 2 x_C) + c (...)'
    I theta''   = -r [k (x_Br + 2 r theta) + c (...)'] - c_r theta'
    m_Br x_Br'' =  F_x - k (x_Br - x_C + r theta) - c (...)'
with F_x known from the control law. What mechanics expects of k, c, r and c_r is computed from the
full model, linearised in the grasp, with pads and stretches condensed at rest: not quite a spring
and a dashpot at every frequency. The training motions are taps: small random velocities of disc and
bracket and a broad multi-sine, some micrometres large. The radius comes from one roll to the other
side. Held out: the paper's manipulation. Errors are root mean squares over the signal's range,
worst of the six states.

Command: .venv/bin/python -m experiments.reduced_model [--smoke]
Expected: 8 terms, the very ones above; held-out error 0.3 % of range (node transitions in
the spin), more than 100 times faster than the full model; k, c and the masses within 10 % of the
expectation but for the spin's k (-11 %) and c_r (-16 %). Half a minute on one core.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import nn

from experiments.frame import COARSE, Table, grid, numbers, options, write
from torchsoft import Profile, Reference, Rig, RigFile, hold, simulate
from torchsoft.files import finite
from torchsoft.physics.motion import Waves, wave
from torchsoft.reduced.fit import Recipe, assemble, choose, fit, loop, rollout_of, score
from torchsoft.reduced.ode import ReducedModel
from torchsoft.reduced.records import Record, record, rolling_radius
from torchsoft.reduced.terms import mechanics
from torchsoft.solve.diagnostics import linearised

WAVE, KICK, BAND = 1e-5, 2e-3, (3.0, 150.0)
"""Of a tap: root mean square of its multi-sine over sqrt(2) [m] and of its initial velocities
[m/s], and the multi-sine's band [Hz]."""

SETTLED = 1.0
"""Time [s] at which the grasp has settled."""

PAPER = RigFile.ready("paper")
X_0 = PAPER["bodies.disc.start.x"]
"""Place of the disc [m]."""

COARSELY = COARSE | {"motion.F_ff.values": [0.0, -75.0]}
"""Half of the usual mesh, with the force that holds its grasp [N]."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/reduced_model")
    taps: int = 12
    tap_time: float = 0.3  # length of a tap [s]
    validation: float = 5e-5  # of the multi-sine by which thresholds are chosen, as `WAVE` [m]
    scenario: float = 1.0  # the manipulation's times, as parts of the paper's
    thresholds: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3)
    models: int = 50  # members of an ensemble
    smoke: bool = False  # a size that takes seconds


def refit(
    records: Sequence[Record], model: ReducedModel, recipe: Recipe, config: Config
) -> ReducedModel:
    """A regression on just the terms of a model, in which none is left out."""
    terms = {target: [term for term, _ in pairs] for target, pairs in model.equations().items()}
    return fit(
        assemble(records, terms, recipe),
        replace(recipe, threshold=0.0, models=config.models),
        model.feedback,
    )


def rollout_time(model: ReducedModel, on: Record, repeats: int = 9) -> float:
    """Wall time of a rollout [s], the least, which other work on the machine disturbs least."""
    return min(rollout_of(model, on).wall_s for _ in range(repeats))


@dataclass(frozen=True)
class Grasp:
    """The paper's grasp, settled: the model, its state, and what holds it there."""

    model: Rig
    y: torch.Tensor
    still: Reference

    def move(self, x: nn.Module, duration: float, *, step: float, sample: float = 0.0) -> Record:
        """The record of the disc that is to follow x_d(t) from the settled grasp."""
        reference = Reference(**{**self.still.signals, "x_d": x})
        t = grid(duration, sample or step)
        return record(simulate(self.model, t, y0=self.y, reference=reference, step=step))


def settled(file: RigFile) -> Grasp:
    """The grasp in which the manipulation of a rig file begins."""
    grasp = file.override({"motion.x_d": {"kind": "hold"}}).build()
    y_d, F_ff = (file[f"motion.{name}.values"][-1] for name in ("y_d", "F_ff"))
    still = hold(x_d=X_0, y_d=y_d, F_ff=F_ff)
    return Grasp(grasp.rig, grasp.run([0.0, SETTLED]).y[-1], still)


def sines(x: float, size: float, band: tuple[float, float], seed: int, duration: float) -> Waves:
    """A multi-sine about where the disc is [m], under way from the first instant."""
    n, rng = 12, np.random.default_rng((0, seed))
    f = band[0] * (band[1] / band[0]) ** ((np.arange(n) + rng.random(n)) / n)
    components = wave(np.full(n, size / n**0.5), f, np.zeros(n), rng.uniform(0, 2 * np.pi, n))
    return Waves(([0.0], [x]), -1.0, duration + 1.0, components)


def tapped(grasp: Grasp, config: Config) -> list[Record]:
    """Small random velocities of disc and bracket, and a broad multi-sine."""
    rng, (_, v, _), out = np.random.default_rng(0), indices(grasp.model), []
    radius = PAPER["bodies.disc.shape.radius"]
    for i in range(config.taps):
        kick = KICK * rng.standard_normal(3) / (1.0, radius, 1.0)
        y = grasp.y.clone()
        y[v] += torch.from_numpy(kick)
        x = sines(X_0, WAVE, BAND, i, config.tap_time)
        out.append(replace(grasp, y=y).move(x, config.tap_time, step=2.5e-4))
    return out


def indices(model: Rig) -> tuple[list[int], list[int], int]:
    """Indices of x_C, theta, x_Br and of their rates in the state, and the number of internal
    states before them."""
    at = model.layout.slices
    starts = [(at[part, "disc"].start, at[part, "bracket"].start) for part in ("pose", "velocity")]
    q, v = ([disc, disc + 2, bracket] for disc, bracket in starts)
    return q, v, q[0]


def expected(grasp: Grasp, frequency: float = 1.0) -> tuple[float, dict[tuple[str, str], float]]:
    """The rolling radius r [m], and what mechanics expects of every coefficient, by equation and
    term: k, c, r and c_r are those of the linearised full model, pads and stretches condensed at a
    low frequency [Hz]."""
    model, w = grasp.model, 2j * np.pi * frequency
    q, v, first = indices(model)
    inner = slice(0, first)
    disc, bracket = model.bodies["disc"], model.bodies["bracket"]
    m, inertia, m_Br = masses = [x.item() for x in (disc.mass, disc.inertia, bracket.mass)]
    A = linearised(model, grasp.y, grasp.still).numpy()
    followed = np.linalg.solve(w * np.eye(first) - A[inner, inner], A[inner, q] + w * A[inner, v])
    forces = np.array(masses)[:, None] * (
        A[np.ix_(v, q)] + w * A[np.ix_(v, v)] + A[v, inner] @ followed
    )  # force, moment per motion
    spring = -forces[0, 0] / 2  # k + i omega c
    r = float((forces[1, 2] / -spring).real)
    c_r = -(forces[1, 1] + 2 * r**2 * spring).imag / w.imag
    k, c = spring.real, spring.imag / w.imag
    return r, {
        ("v_C", "x_Br - 2 x_C"): k / m,
        ("v_C", "v_Br - 2 v_C"): c / m,
        ("omega", "x_Br + 2 r theta"): -r * k / inertia,
        ("omega", "v_Br + 2 r omega"): -r * c / inertia,
        ("omega", "omega"): -c_r / inertia,
        ("v_Br", "x_Br - x_C + r theta"): -k / m_Br,
        ("v_Br", "v_Br - v_C + r omega"): -c / m_Br,
        ("v_Br", "F_x"): 1 / m_Br,
    }


def study(config: Config) -> dict[str, Any]:
    file = PAPER.override(COARSELY if config.smoke else {})
    times = [config.scenario * time for time in file["motion.x_d.times"]]
    whole = file.override({"motion.x_d.times": times}).build()
    grasp, time = settled(file), 5.0 * max(config.scenario, 0.2)
    far = Profile([0.0, time], [X_0, X_0 + 20e-3])
    r = rolling_radius([grasp.move(far, 1.1 * time, step=2e-3, sample=4e-3)])
    aside = Profile([0.0, 1.0], [X_0, X_0 + 6e-3])
    waves = sines(X_0, config.validation, (2.0, 60.0), 1000, 1.0)
    tests = [
        grasp.move(waves, 1.0, step=5e-4, sample=1e-3),
        grasp.move(aside, 1.2, step=2e-3, sample=4e-3),
    ]
    taps, recipe = tapped(grasp, config), Recipe(width=0.004, window=config.tap_time)
    problem = assemble(taps, mechanics(r), recipe)
    choice = choose(problem, tests, recipe, config.thresholds, loop(taps))
    reduced = refit(taps, choice.model, recipe, config)
    full = [
        whole.run(grid(config.scenario * file.outputs.duration, 2e-3))
        for _ in range(1 if config.smoke else 3)
    ]
    held, (radius, mechanical) = record(full[0]), expected(grasp)
    coefficients = reduced.coefficient_table()
    for row in coefficients:
        value = mechanical.get((row["equation"], row["term"]))
        row |= {"expected": value, "error": None if value is None else row["value"] / value - 1}
    return {
        "terms": len(reduced.terms), "heldout_nrmse": score(reduced, held).worst,
        "speedup": min(run.stats.wall_s for run in full) / rollout_time(reduced, held),
        "equations": reduced.text(),
        "rolling_radius_mm": {"found": 1e3 * r, "expected": 1e3 * radius},
        "coefficients": coefficients,
    }  # fmt: skip


def tables(found: dict[str, Any]) -> dict[str, Table]:
    """The model in numbers; the coefficients beside mechanics."""
    names = {"terms": "terms", "heldout_nrmse": "held-out error", "speedup": "speed-up"}
    coefficients = [
        (
            f"{row['equation']}' of {row['term']}", f"{row['value']:.4g}",
            "{:.4g} .. {:.4g}".format(*row["interval"]),
            "-" if row["error"] is None else f"{row['error']:+.1%}",
        )
        for row in found["coefficients"]
    ]  # fmt: skip
    head = ("coefficient", "found", "90 % interval", "over mechanics less one")
    return {
        "model": numbers("regime", {"stick": {shown: found[k] for k, shown in names.items()}}),
        "coefficients": Table(head, coefficients),
    }


def main(config: Config) -> None:
    if config.smoke:
        config = replace(
            config, taps=6, tap_time=0.15, validation=2e-4, scenario=0.2,
            thresholds=(0.03, 0.07, 0.14), models=10,
        )  # fmt: skip
    with threadpool_limits(1):  # what is timed, is timed on one core
        found = finite(study(config))
    print(*found["equations"], sep="\n")
    write(config, found, tables(found))


if __name__ == "__main__":
    main(options(Config, __doc__))
