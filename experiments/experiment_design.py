"""Question: which motions should a rig make, for its data to identify contact and pad parameters?

For every excitation of `torchsoft.excitation.CATALOGUE` the Fisher matrix F = J^T J of the sensors'
predicted samples (J: exact sensitivities over the sensors' noise, coordinates: logarithms of the
parameters) gives the Cramer-Rao standard deviation sqrt(diag F^-1) of each parameter; F is
additive, so combinations follow by summing. What a tenth of the tolerance changes, shifts an
estimate by F^-1 J^T of it: what an excitation is worth is the root of both squared. Steps are
frozen. Derivatives of hard slipping can be inconsistent: J is checked against a central difference
along a random direction, and an excitation that fails is dropped.

Command: .venv/bin/python experiments/experiment_design.py [--smoke]
Expected: no gentle motion identifies mu_k (above 50 %), jerks of a light grasp do to about 1 %; K_t
and R_t are the weakest, and three excitations together, 5.4 s of data, bring the worst of the eight
(R_t) to 3 % at a step of 0.5 ms; harder ones would identify more, but not at that step. About two
minutes on one core.
"""

import itertools
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from identify_contact import TRUTH
from tqdm import tqdm

from torchsoft import Parameters
from torchsoft.excitation import CATALOGUE, Excitation, Strokes, begin
from torchsoft.experiment import markdown, options, write
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid import RIG, Problem, Unknown, record
from torchsoft.sysid.fit import shift, standard_deviations
from torchsoft.sysid.plan import FINER
from torchsoft.sysid.problem import Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner

NAMES = tuple(TRUTH)
CONSISTENT = 0.01
"""Difference between J and a finite difference, over their size, above which an excitation is
dropped."""
DIFFERENCE = 1e-5  # Step of that finite difference in the logarithms.


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/experiment_design")
    rtol: float = 1e-5  # of the runs
    v_s: float = 0.05  # contact.v_s [m/s]; large, so that gross slip has a unique solution
    longest: float = 6.0  # data that a combination may take [s]
    most: int = 3  # excitations in a combination
    seed: int = 0
    smoke: bool = False  # two short excitations


@dataclass(frozen=True)
class Row:
    """Standard deviations and shifts by the steps [1] by parameter, of one excitation or of several
    together; `inconsistency` of the derivative."""

    names: tuple[str, ...]
    seconds: float
    sd: dict[str, float]
    shift: dict[str, float]
    inconsistency: float
    dropped: str = ""

    @property
    def worst(self) -> float:
        """The largest root of both squared."""
        return max(
            (float(np.hypot(self.sd[name], self.shift[name])) for name in self.sd), default=np.inf
        )


def row(
    names: tuple[str, ...],
    seconds: float,
    J: Array,
    error: Array,
    inconsistency: float,
    dropped: str = "",
) -> Row:
    """The row of a Jacobian and of what finer steps add to the residuals (m,)."""
    sd, off = standard_deviations(J), shift(J, error)
    return Row(
        names,
        seconds,
        dict(zip(NAMES, sd.tolist())),
        dict(zip(NAMES, off.tolist())),
        inconsistency,
        dropped,
    )


@dataclass(frozen=True)
class Result:
    config: Config
    single: list[Row]
    together: list[Row]


def smoke(config: Config) -> tuple[Config, dict[str, Excitation]]:
    roll = Excitation(motion=Strokes(travel=8e-3, stroke_time=0.3), duration=0.9, senses="bracket")
    jerk = Excitation(
        motion=Strokes(travel=30e-3, stroke_time=0.1), duration=0.9, depth=3e-4, senses="bracket"
    )
    return Config(config.out, 1e-4, config.v_s, 2.0, 2, config.seed, True), {
        "strokes": roll,
        "jerks, light": jerk,
    }


def check(part: Residuals) -> Residuals:
    """Raises `SimulationFailed` where there are none."""
    for lost in part.lost.values():
        raise SimulationFailed(lost.reason, lost.time)
    return part


def assess(excitation: Excitation, p: Parameters, config: Config) -> tuple[Array, Array, float]:
    """Whitened Jacobian (m, parameters), what finer steps add to the residuals (m,), and how far
    the Jacobian is, relatively, from a central difference along one direction. Raises
    `SimulationFailed`."""
    recording = record("one", begin(excitation, p), {}, RIG, rtol=config.rtol, noise=0.0)
    friction = 0.5 * (
        p.contact.mu_k + p.contact.mu_s
    )  # bounds that do not cross; nothing is searched here
    apart = {"contact.mu_k": Unknown(high=friction), "contact.mu_s": Unknown(low=friction)}
    problem = Problem([recording], RIG, {name: Unknown() for name in NAMES} | apart)
    x, v = problem.coordinates.start, np.random.default_rng(config.seed).standard_normal(len(NAMES))
    runner = Runner(problem.recordings)
    at, steps = problem.freeze(runner, x, ["one"], config.rtol, problem.coordinates.free)
    check(at)
    ahead, behind = (
        check(problem.residuals(runner, x + s * DIFFERENCE * v, ["one"], steps))
        for s in (1.0, -1.0)
    )
    finer = check(problem.freeze(runner, x, ["one"], FINER * config.rtol)[0])
    slope = (ahead.r - behind.r) / (2 * DIFFERENCE)
    return at.J, finer.r - at.r, float(np.linalg.norm(at.J @ v - slope) / np.linalg.norm(slope))


def run(config: Config) -> Result:
    catalogue = CATALOGUE
    if config.smoke:
        config, catalogue = smoke(config)
    p = Parameters().override({"contact.v_s": config.v_s})
    single: list[Row] = []
    usable: dict[str, tuple[Array, Array]] = {}
    for name, excitation in tqdm(catalogue.items(), desc="excitations"):
        try:
            J, error, wrong = assess(excitation, p, config)
        except SimulationFailed as failure:
            single.append(Row((name,), excitation.duration, {}, {}, np.inf, failure.reason))
            continue
        dropped = "" if wrong < CONSISTENT else f"derivatives inconsistent by {wrong:.1%}"
        single.append(row((name,), excitation.duration, J, error, wrong, dropped))
        if not dropped:
            usable[name] = J, error
    together = []
    for count in range(2, config.most + 1):
        for names in itertools.combinations(usable, count):
            seconds = sum(catalogue[name].duration for name in names)
            if seconds <= config.longest:
                J, error = (np.concatenate([usable[name][k] for name in names]) for k in (0, 1))
                off = max(r.inconsistency for r in single if r.names[0] in names)
                together.append(row(names, seconds, J, error, off))
    return Result(
        config, sorted(single, key=lambda r: r.worst), sorted(together, key=lambda r: r.worst)
    )


def percent(value: float, sign: str = "") -> str:
    """Two digits, without powers of ten."""
    value *= 100
    digits = ".0f" if abs(value) >= 10 else ".2g" if abs(value) >= 0.01 else ".2f"
    return f"{value:{sign}{digits}}"


def table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        cells = [
            f"{percent(row.sd[name])} ({percent(row.shift[name], sign='+')})"
            if row.sd.get(name, np.inf) < 1
            else "-"
            for name in NAMES
        ]
        off = row.dropped or f"{row.inconsistency:.0e}"
        lines.append((" + ".join(row.names), f"{row.seconds:.1f}", *cells, off))
    return markdown(
        ("excitation", "s", *(name.split(".")[1] for name in NAMES), "derivative off by"), lines
    )


def main(config: Config) -> None:
    result = run(config)
    rows = {"single": result.single, "together": result.together[:20]}
    summary = {name: [asdict(row) for row in some] for name, some in rows.items()}
    tables = f"{table(result.single)}\n\n{table(result.together[:8])}"
    write(result.config, summary, table=tables)


if __name__ == "__main__":
    main(options(Config, __doc__))
