"""Question: do 5.4 s of noisy rolling determine all eight contact and pad parameters, from starts
off by factors of 2 to 3?

A rig with known parameters (K_n, R_n, K_t, R_t, mu_s, mu_k, E, tau) makes three recordings, with
sensor noise of 10 um, 0.5 mrad and 0.1 N at 200 Hz and a tenth of the fit's tolerance.
`torchsoft.sysid` finds the parameters in stages, on exact sensitivities, and predicts a fourth
recording. The same once more without noise.

Command: .venv/bin/python -m experiments.identify_contact [--smoke] [--workers 2]
Expected: without noise every parameter within a tenth of the standard deviation that noise would
give it, what the steps shift it by; with noise within what the Fisher matrix predicts, R_t the
worst of them with a standard deviation of 3 %; both starts end at the same place. Each
identification takes some 45 runs with sensitivities and 20 without.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from experiments.frame import COARSE, Table, options, write
from torchsoft import RigFile, excite
from torchsoft.rigs.excite import CATALOGUE, Excitation, sines, strokes
from torchsoft.sysid import IdentificationResult, Problem, Recording, Unknown, identify, record
from torchsoft.sysid.report import report
from torchsoft.sysid.runs import forget
from torchsoft.sysid.synthetic import good_sensors

LAW, RUBBER = "laws.steel_on_rubber", "materials.rubber"
MU_S, MU_K = f"{LAW}.friction.mu_s", f"{LAW}.friction.mu_k"
TRUTH = {
    f"{LAW}.K_n": 1.6e5, f"{LAW}.R_n": 300.0, f"{LAW}.K_t": 0.8e5, f"{LAW}.R_t": 600.0,
    MU_S: 0.65, MU_K: 0.5, f"{RUBBER}.E": 0.9e6, f"{RUBBER}.tau": 0.012,
}  # fmt: skip
FEW = {name: TRUTH[name] for name in (f"{RUBBER}.E", f"{RUBBER}.tau", f"{LAW}.K_n", MU_S)}
"""The truth of a smoke run."""

FITTED, HELD_OUT = ("deep pressing", "light shaking", "light jerks"), "shaking"

SENSORS = good_sensors(RigFile.ready("paper").assemble())
"""Sensors of the paper's rig, by channel."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/identify_contact")
    rtol: float = 1e-5  # of the fit's last stage; data have a tenth of it
    starts: tuple[int, ...] = (0, 1)  # seeds of the starts
    workers: int = 2
    smoke: bool = False  # four parameters from two short recordings on a coarse mesh


def nominal(smoke: bool) -> RigFile:
    """What is known of the rig before the fit."""
    return RigFile.ready("paper").override(
        {"contact.v_s": 0.05} | (COARSE | {MU_K: 0.5} if smoke else {})
    )


def motions(smoke: bool) -> dict[str, Excitation]:
    """Motions of the recordings, by their names; the last one is to be predicted."""
    if not smoke:
        return {name: CATALOGUE[name] for name in (*FITTED, HELD_OUT)}
    band = 2.0, 12.0
    shaking = sines(6e-3, band, 0), sines(1e-4, band, 1)
    return {
        "strokes": Excitation(strokes(8e-3, 0.2), duration=0.9),
        "shaking": Excitation(*shaking, duration=0.9, depth=7e-4),
    }


def coloured(count: int, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise (count,) of deviation 1 whose neighbouring samples correlate by `rho`."""
    white = rng.standard_normal(count)
    white[1:] *= (1 - rho**2) ** 0.5
    return np.asarray(lfilter([1.0], [1.0, -rho], white))


def start(truth: Mapping[str, float], seed: int) -> dict[str, float]:
    """Every parameter off by a factor of 2 to 3; mu_k not above mu_s."""
    rng, out = np.random.default_rng(seed), {}
    for name, value in truth.items():
        out[name] = float(value * rng.uniform(2.0, 3.0) ** rng.choice((-1.0, 1.0)))
    if MU_K in out:
        out[MU_K] = min(out[MU_K], 0.95 * out[MU_S])
    return out


def problem(recordings: list[Recording], initial: Mapping[str, float]) -> Problem:
    """Unknowns with initial values, mu_k as a part of mu_s."""
    unknowns = {name: Unknown(nominal=value) for name, value in initial.items()}
    if MU_K in initial:
        ratio = initial[MU_K] / initial[MU_S]
        unknowns[MU_K] = Unknown(nominal=ratio, ratio_to=MU_S, low=0.1, high=1.0)
    return Problem(recordings, SENSORS, unknowns)


def judged(found: IdentificationResult, truth: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Estimates beside the truth, by parameter; one without an interval claims nothing."""
    out = {}
    for name, value in truth.items():
        e = found[name]
        out[name] = {
            "truth": value, "estimate": e.value, "ci95": e.ci95, "relative_sd": e.relative_sd,
            "error": None if e.value is None else e.value / value - 1,
            "inside": None if e.ci95 is None else bool(e.ci95[0] <= value <= e.ci95[1]),
        }  # fmt: skip
    return out


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, workers=1, starts=(0,))
    file, every = nominal(config.smoke), motions(config.smoke)
    truth, held_out = FEW if config.smoke else TRUTH, [list(every)[-1]]
    cases, cells = [], []
    for name, noise in (("noisy", 1.0), ("noise-free", 0.0)):
        recordings = [
            record(
                motion, excite(file, excitation).build(), truth, SENSORS, seed=seed, noise=noise,
                rtol=0.1 * config.rtol,
            )
            for seed, (motion, excitation) in enumerate(every.items())
        ]  # fmt: skip
        for seed in config.starts:
            stated = problem(recordings, start(truth, seed))
            runs = config.out / f"runs-{name}-{seed}"
            found = identify(
                stated, rtol=config.rtol, workers=config.workers, heldout=held_out,
                checkpoint=runs, progress=not config.smoke,
            )  # fmt: skip
            forget(runs)
            print(f"\n{name}, start {seed}", found.table(), *found.findings, sep="\n")
            if name == "noisy":
                report(found, stated, config.out / "report.html")
            rows = judged(found, truth)
            cases.append({
                "case": name, "start": seed, "parameters": rows, "chi2": found.chi2,
                "heldout_nrmse": found.heldout, "findings": [*map(str, found.findings)],
                **found.cost,
            })  # fmt: skip
            cells += [
                (f"{name}, {seed}", parameter, one["truth"], f"{one['estimate']:.4g}",
                 "{:.4g} .. {:.4g}".format(*one["ci95"]), f"{one['error']:+.2%}",
                 f"{one['relative_sd']:.2%}")
                for parameter, one in rows.items() if one["ci95"] is not None
            ]  # fmt: skip
    head = (
        "case, start", "parameter", "truth", "found", "95 % interval", "error",
        "predicted standard deviation",
    )  # fmt: skip
    write(config, {"cases": cases}, {"eight parameters": Table(head, cells)})


if __name__ == "__main__":
    main(options(Config, __doc__))
