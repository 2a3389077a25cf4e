"""Question: which motions should a rig make, for its data to identify contact and pad parameters?

For every excitation of `torchsoft.rigs.excite.CATALOGUE` the Fisher matrix F = J^T J of the
sensors' predicted samples (J: exact sensitivities over the sensors' noise, coordinates: logarithms
of the parameters) gives the Cramer-Rao standard deviation sqrt(diag F^-1) of each parameter; F is
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
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from identify_contact import MU_K, MU_S, TRUTH
from tqdm import tqdm

from torchsoft import RigFile, excite
from torchsoft.experiment import RIG, markdown, options, write
from torchsoft.rigs.excite import CATALOGUE, Excitation
from torchsoft.solve.progress import SimulationFailed
from torchsoft.sysid import Problem, Unknown, record
from torchsoft.sysid.fit import percent, shift, standard_deviations
from torchsoft.sysid.plan import FINER
from torchsoft.sysid.problem import Residuals
from torchsoft.sysid.recording import Array
from torchsoft.sysid.runs import Runner

NAMES = tuple(TRUTH)
CONSISTENT = 0.01
"""Difference between J and a finite difference, over their size, above which an excitation is
dropped."""
V_S = 0.05
"""contact.v_s [m/s]; large, so that gross slip has a unique solution."""
DIFFERENCE = 1e-5  # Step of that finite difference in the logarithms.


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/experiment_design")
    rtol: float = 1e-5  # of the runs
    longest: float = 6.0  # data that a combination may take [s]
    most: int = 3  # excitations in a combination
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
        return max((np.hypot(self.sd[name], self.shift[name]) for name in self.sd), default=np.inf)


class Information(NamedTuple):
    """What an excitation shows: whitened Jacobian (m, parameters), what finer steps add to the
    residuals (m,), and how far the Jacobian is, relatively, from a central difference."""

    J: Array
    error: Array
    inconsistency: float


def row(
    catalogue: Mapping[str, Excitation], parts: Mapping[str, Information], dropped: str = ""
) -> Row:
    """The row of excitations together."""
    J, error = (np.concatenate([part[k] for part in parts.values()]) for k in (0, 1))
    sd, off = (dict(zip(NAMES, x.tolist())) for x in (standard_deviations(J), shift(J, error)))
    seconds = sum(catalogue[name].duration for name in parts)
    return Row(
        tuple(parts), seconds, sd, off, max(x.inconsistency for x in parts.values()), dropped
    )


SMOKE = {
    "strokes": Excitation({"kind": "strokes", "travel": 8e-3, "stroke_time": 0.3}, duration=0.9),
    "jerks, light": Excitation(
        {"kind": "strokes", "travel": 30e-3, "stroke_time": 0.1}, duration=0.9, depth=2e-4
    ),
}


def check(part: Residuals) -> Residuals:
    """Raises `SimulationFailed` where there are none."""
    for failed in part.failed.values():
        raise SimulationFailed(failed.reason, failed.time)
    return part


def assess(excitation: Excitation, rtol: float) -> Information:
    """Raises `SimulationFailed`."""
    built = excite(RigFile.ready("paper").override({"contact.v_s": V_S}), excitation).build()
    recording = record("one", built, {}, RIG, rtol=rtol, noise=0.0)
    # bounds that do not cross; nothing is searched here
    friction = 0.5 * sum(built.rig.parameter(name).item() for name in (MU_K, MU_S))
    apart = {MU_K: Unknown(high=friction), MU_S: Unknown(low=friction)}
    problem = Problem([recording], RIG, {name: Unknown() for name in NAMES} | apart)
    x, v = problem.coordinates.start, np.random.default_rng(0).standard_normal(len(NAMES))
    runner = Runner(problem.recordings)
    at = check(problem.residuals(runner, x, ["one"], rtol, problem.coordinates.free))
    ahead, behind = (
        check(problem.residuals(runner, x + s * DIFFERENCE * v, ["one"], at.steps))
        for s in (1.0, -1.0)
    )
    finer = check(problem.residuals(runner, x, ["one"], FINER * rtol))
    slope = (ahead.r - behind.r) / (2 * DIFFERENCE)
    return Information(
        at.J, finer.r - at.r, float(np.linalg.norm(at.J @ v - slope) / np.linalg.norm(slope))
    )


def table(rows: list[Row]) -> str:
    lines = []
    for one in rows:
        cells = [
            f"{percent(one.sd[name])} ({percent(one.shift[name])})" if one.sd.get(name, 1) < 1
            else "-"
            for name in NAMES
        ]  # fmt: skip
        off = one.dropped or f"{one.inconsistency:.0e}"
        lines.append((" + ".join(one.names), f"{one.seconds:.1f}", *cells, off))
    return markdown(
        ("excitation", "s", *(name.rpartition(".")[2] for name in NAMES), "derivative off by"),
        lines,
    )


def main(config: Config) -> None:
    catalogue = CATALOGUE
    if config.smoke:
        catalogue, config = SMOKE, replace(config, rtol=1e-4, longest=2.0, most=2)
    single, usable = list[Row](), dict[str, Information]()
    for name, excitation in tqdm(catalogue.items(), desc="excitations", disable=None):
        try:
            found = assess(excitation, config.rtol)
        except SimulationFailed as failure:
            single.append(Row((name,), excitation.duration, {}, {}, np.inf, failure.reason))
            continue
        wrong = found.inconsistency
        dropped = "" if wrong < CONSISTENT else f"derivatives inconsistent by {wrong:.1%}"
        single.append(row(catalogue, {name: found}, dropped))
        if not dropped:
            usable[name] = found
    together = [
        row(catalogue, {name: usable[name] for name in names})
        for count in range(2, config.most + 1)
        for names in itertools.combinations(usable, count)
        if sum(catalogue[name].duration for name in names) <= config.longest
    ]
    single, together = (sorted(some, key=lambda r: r.worst) for some in (single, together))
    rows = {"single": single, "together": together[:20]}
    summary = {name: [asdict(one) for one in some] for name, some in rows.items()}
    write(config, summary, table=f"{table(single)}\n\n{table(together[:8])}")


if __name__ == "__main__":
    main(options(Config, __doc__))
