"""Question: do 5.4 s of noisy rolling determine all eight contact and pad parameters, from starts
off by factors of 2 to 3?

A rig with known parameters (K_n, R_n, K_t, R_t, mu_s, mu_k, E, tau) makes the three recordings that
`experiment_design.py` ranks first, with sensor noise of 10 um, 0.5 mrad and 0.1 N at 200 Hz and a
tenth of the fit's tolerance; `torchsoft.sysid` finds the parameters in stages, on exact
sensitivities, and predicts a fourth recording. The same once more without noise, and with the same
stages on finite differences: `scipy.optimize.least_squares` with a Jacobian of one more run a
parameter, all of them at once in the workers.

Command: .venv/bin/python experiments/identify_contact.py [--smoke] [--workers 2]
Expected: without noise every parameter within a tenth of the standard deviation that noise would
give it, what the steps shift it by; with noise within what the Fisher matrix predicts, R_t the
worst of them with a standard deviation of 3 %; both starts end at the same place. Each
identification takes some 45 runs with sensitivities and 20 without.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchsoft import RigFile, excite
from torchsoft.experiment import COARSE, RIG, coloured, numbers, options, write
from torchsoft.rigs.excite import CATALOGUE, Excitation
from torchsoft.sysid import IdentificationResult, Problem, Recording, Unknown, identify, record
from torchsoft.sysid.problem import Residuals, StepsByName
from torchsoft.sysid.recording import Array
from torchsoft.sysid.report import report
from torchsoft.sysid.runs import Runner, forget
from torchsoft.sysid.unknowns import Sensor

LAW, RUBBER = "laws.steel_on_rubber", "materials.rubber"
MU_S, MU_K = f"{LAW}.friction.mu_s", f"{LAW}.friction.mu_k"
TRUTH = {
    f"{LAW}.K_n": 1.6e5, f"{LAW}.R_n": 300.0, f"{LAW}.K_t": 0.8e5, f"{LAW}.R_t": 600.0,
    MU_S: 0.65, MU_K: 0.5, f"{RUBBER}.E": 0.9e6, f"{RUBBER}.tau": 0.012,
}  # fmt: skip
FITTED, HELD_OUT = ("deep pressing", "light shaking", "light jerks"), "shaking"
DIFFERENCE = 1e-4  # Step of the finite differences in the logarithms.


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/identify_contact")
    rtol: float = 1e-5  # of the fit's last stage; data have a tenth of it
    starts: tuple[int, ...] = (0, 1)  # seeds of the starts
    workers: int = 2
    smoke: bool = False  # four parameters from two short recordings on a coarse mesh


class FiniteDifferences(Problem):
    """The same problem with differences in place of sensitivities, inwards at an upper bound, all
    perturbed runs handed over at once."""

    def residuals(
        self,
        runner: Runner,
        x: Array,
        which: Sequence[str],
        steps: StepsByName,
        free: NDArray[np.bool_] | None = None,
    ) -> Residuals:
        if free is None or isinstance(steps, float):  # each would choose its own
            return super().residuals(runner, x, which, steps, free)
        inside = x + DIFFERENCE <= self.coordinates.bounds[1]
        step = np.where(inside, DIFFERENCE, -DIFFERENCE)
        moved = [x, *(x + step[i] * np.eye(len(x))[i] for i in np.flatnonzero(free))]
        jobs = [self.jobs(z, which, steps, None) for z in moved]
        results = iter(runner.run([job for some in jobs for job in some]))
        at, *ahead = (
            self.gather(z, some, [next(results) for _ in some]) for z, some in zip(moved, jobs)
        )
        J = np.zeros((len(at.r), len(x)))
        for i, one in zip(np.flatnonzero(free), ahead):
            J[:, i] = (one.r - at.r) / step[i]
        failed = at.failed | {name: run for one in ahead for name, run in one.failed.items()}
        return Residuals(at.r, J, failed, at.steps)


def excitations(config: Config) -> dict[str, Excitation]:
    if not config.smoke:
        return {name: CATALOGUE[name] for name in (*FITTED, HELD_OUT)}
    strokes = {"kind": "strokes", "travel": 8e-3, "stroke_time": 0.2}
    shake = {"kind": "multi_sine", "band": (2.0, 12.0)}
    roll, press = shake | {"amplitude": 6e-3, "seed": 0}, shake | {"amplitude": 1e-4, "seed": 1}
    return {
        "strokes": Excitation(strokes, duration=0.9),
        "shaking": Excitation(roll, press, duration=0.9, depth=7e-4),
    }


def truths(smoke: bool) -> dict[str, float]:
    few = f"{RUBBER}.E", f"{RUBBER}.tau", f"{LAW}.K_n", MU_S
    return {name: TRUTH[name] for name in few} if smoke else TRUTH


def record_all(config: Config, noise: float) -> list[Recording]:
    """What the rig gives; the last one is to be predicted."""
    coarse = COARSE | {MU_K: 0.5} if config.smoke else {}
    nominal = RigFile.ready("paper").override({"contact.v_s": 0.05} | coarse)
    options: dict[str, Any] = {"rtol": 0.1 * config.rtol, "noise": noise}
    return [
        record(name, excite(nominal, e).build(), truths(config.smoke), RIG, seed=k, **options)
        for k, (name, e) in enumerate(excitations(config).items())
    ]


def start(truth: dict[str, float], seed: int) -> dict[str, float]:
    """Every parameter off by a factor of 2 to 3; mu_k not above mu_s."""
    rng, out = np.random.default_rng(seed), {}
    for name, value in truth.items():
        out[name] = float(value * rng.uniform(2.0, 3.0) ** rng.choice((-1.0, 1.0)))
    if MU_K in out:
        out[MU_K] = min(out[MU_K], 0.95 * out[MU_S])
    return out


def noisy(
    recording: Recording, seed: int | np.random.Generator, rho: float = 0.0
) -> Recording:  # fmt: skip
    """A recording without noise, with that of `RIG`, whose neighbouring samples correlate by
    `rho`."""
    rng, samples = np.random.default_rng(seed), {}
    for channel, (t, y) in recording.samples.items():
        samples[channel] = (t, y + RIG[channel].noise * coloured(len(t), rho, rng))
    return replace(recording, samples=samples)


def problem(
    recordings: list[Recording], begin: dict[str, float], sensors: dict[str, Sensor] = RIG,
    kind: type[Problem] = Problem,
) -> Problem:  # fmt: skip
    """Unknowns that begin there, mu_k as a part of mu_s."""
    unknowns = {name: Unknown(nominal=value) for name, value in begin.items()}
    if MU_K in begin:
        ratio = begin[MU_K] / begin[MU_S]
        unknowns[MU_K] = Unknown(nominal=ratio, ratio_to=MU_S, low=0.1, high=1.0)
    return kind(recordings, sensors, unknowns)


def compared(found: IdentificationResult, truth: dict[str, float], begin: dict[str, float]) -> Any:
    """Estimates beside the truth, by parameter."""
    out = {}
    for name, value in truth.items():
        e = found[name]
        out[name] = {
            "truth": value, "start": begin[name], "estimate": e.value, "ci95": e.ci95,
            "relative_sd": e.relative_sd, "relative_error": e.last / value - 1,
            "seen": e.identifiable,
        }  # fmt: skip
    return out


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, workers=1, starts=(0,))
    truth, held = truths(config.smoke), [list(excitations(config))[-1]]
    measured, exact = record_all(config, 1.0), record_all(config, 0.0)
    rows = list[dict[str, Any]]()
    for name, recordings, seeds, kind in (
        ("noisy", measured, config.starts, Problem),
        ("noise-free", exact, config.starts, Problem),
        ("finite differences", measured, config.starts[:1], FiniteDifferences),
    ):
        for seed in seeds:
            begin = start(truth, seed)
            factors = (f"{v / truth[k]:.2f}" for k, v in begin.items())
            print(f"\n{name}, start {seed}: off by factors of", *factors)
            folder = config.out / f"runs-{name.replace(' ', '-')}-{seed}"
            stated = problem(recordings, begin, kind=kind)
            found = identify(
                stated, rtol=config.rtol, workers=config.workers, heldout=held, checkpoint=folder,
                progress=not config.smoke,
            )  # fmt: skip
            forget(folder)
            print(found.table(), *found.findings, sep="\n")
            if name == "noisy":
                report(found, stated, config.out / "report.html")
            rows.append(
                {
                    "case": name, "parameters": compared(found, truth, begin), "chi2": found.chi2,
                    "heldout_nrmse": found.heldout, "findings": [*map(str, found.findings)],
                    **found.cost,
                }
            )  # fmt: skip
    cells = {
        f"{row['case']}, {i}": {
            "worst error": max(abs(one["relative_error"]) for one in row["parameters"].values()),
            "worst predicted sd": max(one["relative_sd"] for one in row["parameters"].values()),
            "simulations": row["simulations"], "Jacobians": row["jacobians"],
            "wall [s]": row["wall_s"],
        }
        for i, row in enumerate(rows)
    }  # fmt: skip
    write(config, {"cases": rows}, table=numbers("case", cells, 3))


if __name__ == "__main__":
    main(options(Config, __doc__))
