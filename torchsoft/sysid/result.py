"""Result of an identification as plain data, with the rigs of its recordings; `answer.json` holds
it.

A checksum of the content tells a damaged file.
"""

import json
import warnings
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter

from torchsoft.caller import warn
from torchsoft.display import Shown, suggestion
from torchsoft.files import check_file, finite, save_text
from torchsoft.physics.arguments import whole
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.written import files_renamed
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.estimate import ChannelResiduals, Estimate
from torchsoft.sysid.fit import Combination, Fit, combinations
from torchsoft.sysid.initial_state import PREFIX
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.prediction import set_parameters
from torchsoft.sysid.recording import Array
from torchsoft.sysid.sentences import HEADLINES, IDENTIFIED, Finding
from torchsoft.sysid.unknowns import Coordinate, Sensor, Unknown
from torchsoft.tables import Number, line, refusing, shown


@dataclass(frozen=True)
class RecordedRig:
    """A recording and its rig: fingerprint, length [s], start, the rig's class, its parameters and
    laws before the fit (`description`), the `identified` parameters, and the `initial` values of
    the start's coordinates.

    `tables` are those of the rig file that it was built from; None for a rig with parts of its own,
    or with files beside its own.
    """

    name: str
    fitted: bool
    fingerprint: str
    samples: int
    duration: float
    start: str
    rig: str
    description: dict[str, Any]
    tables: dict[str, Any] | None
    identified: dict[str, float]
    initial: dict[str, float]

    @property
    def known(self) -> dict[str, Any]:
        """Parameters and laws that were not identified."""
        return known(self.description, self.identified)

    def rebuilt(self) -> Rig:
        """The rig before the fit, with the motions of its file. Raises `ValueError` for one with
        parts of its own, which a file cannot hold."""
        rig = None if self.tables is None else RigFile.from_tree(self.tables).build().rig
        if rig is None or laws(rig.description()) != laws(self.description):
            raise ValueError(
                f"the rig of recording `{self.name}` is a {self.rig} with parts of its own, which "
                "the answer does not hold: build it as it was built for the fit, as in "
                "RigFile.from_toml(FILE).build().rig, and call `applied_to(rig)`"
            )
        for name, value in self.description["parameters"].items():
            with torch.no_grad():
                rig.parameter(name).copy_(torch.tensor(value, dtype=torch.float64))
        return rig


def known(description: dict[str, Any], identified: dict[str, float]) -> dict[str, Any]:
    """A rig's description as one table, without the identified parameters."""
    parameters = {
        name: value for name, value in description["parameters"].items() if name not in identified
    }
    return parameters | laws(description)


def laws(description: dict[str, Any]) -> dict[str, Any]:
    """Laws, shapes and meshes of a rig's description as one table."""
    parts = {part: laws for part, laws in description.items() if part != "parameters"}
    return {f"{part} of {name}": law for part, laws in parts.items() for name, law in laws.items()}


def undetermined(values: Mapping[str, float]) -> str:
    """A clause on values that the data do not determine."""
    listed = ", ".join(f"{name} = {value:.3g}" for name, value in values.items())
    return f"not identifiable from the data, and so only where the search ended: {listed}"


def recorded_rigs(fit: Fit) -> list[RecordedRig]:
    """Every recording with its rig, at the end of a fit."""
    out, problem = list[RecordedRig](), fit.problem
    for k, recording in enumerate(problem.recordings):
        values, rig = problem.values(fit.x, k), recording.rig
        files = list[str]()  # beside the rig file, which an answer does not hold
        files_renamed(dict(rig.tables or {}), lambda name, files=files: files.append(name) or name)
        tables = None if rig.tables is None or files else dict(rig.tables)
        identified = {name: value for name, value in values.items() if not name.startswith(PREFIX)}
        initial = {name: value for name, value in values.items() if name.startswith(PREFIX)}
        start = line(str(recording.start), 300)
        one = RecordedRig(
            recording.name,
            recording.name in fit.which,
            recording.fingerprint,
            problem.samples([recording.name]),
            recording.duration,
            start,
            type(rig).__qualname__,
            rig.description(),
            tables,
            identified,
            initial,
        )
        out.append(one)
    return out


# The result


SCHEMA = "torchsoft-answer-10"
"""Name and version of the file format."""


LARGEST = 1e9
"""Largest size [B] of an answer's file."""

Verdict = Literal["holds", "doubtful", "does not explain"]


@dataclass(frozen=True, repr=False)
class IdentificationResult(Shown):
    """Estimates, correlations, residuals, predictions, and their provenance.

    `x` and `covariance` are in `coordinates`, `correlation` in the free ones (`labels`). `noise` is
    the colour by channel that whitened residuals. `rigs` are those of the recordings, with their
    laws and references; a file does not hold them.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)

    estimates: list[Estimate]
    labels: list[str]
    x: list[float]
    correlation: list[list[Number]]
    # sum of squared residuals over the stated noise, per degree of freedom: 1 where both are right
    chi2: Number
    # the same of residuals whitened by the colour that was found, with those of the priors
    chi2_whitened: Number
    converged: bool
    residuals: list[ChannelResiduals]
    heldout: dict[
        str, dict[str, Number]
    ]  # NRMSE of recordings that were not fitted, by recording and channel
    findings: list[Finding]  # the gravest first
    stages: list[dict[str, Any]]
    cost: dict[str, Number]
    made_by: dict[str, Any]
    covariance: list[list[Number]] = field(repr=False)
    recordings: list[RecordedRig] = field(default_factory=list, repr=False)
    unknowns: dict[str, Unknown] = field(default_factory=dict, repr=False)
    sensors: dict[str, Sensor] = field(default_factory=dict, repr=False)
    coordinates: list[Coordinate] = field(default_factory=list, repr=False)
    combinations: list[Combination] = field(default_factory=list, repr=False)
    noise: dict[str, Autoregression] = field(default_factory=dict, repr=False)
    assumptions: list[AssumptionTest] = field(default_factory=list, repr=False)
    versions: dict[str, str] = field(default_factory=dict, repr=False)
    command: str = ""
    rigs: Annotated[dict[str, Any], Field(exclude=True)] = field(
        default_factory=dict, repr=False, compare=False
    )

    def __getitem__(self, name: str) -> Estimate:
        """The first estimate of that name, full or short."""
        for one in self.recordings:
            rig, tables = self.rigs.get(one.name), one.tables or {}
            short = rig.short if rig is not None else tables.get("names", {})
            name = short.get(name, name)
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(
            f"no estimate of `{name}`; "
            f"{suggestion(name, [e.name for e in self.estimates], 'there are')}"
        )

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [(one.label, one.found) for one in self.estimates]
        rows += [(one.severity, str(one)) for one in self.findings]
        return self.headline, rows

    def table(self) -> str:
        """The headline, and a line for each estimate."""
        return "\n".join([self.headline, *(f"{e.label:34s} {e.found}" for e in self.estimates)])

    @property
    def verdict(self) -> Verdict:
        """Whether the model holds, is in doubt, or does not explain the data."""
        severities = {one.severity for one in self.findings}
        if "error" in severities:
            return "does not explain"
        return "doubtful" if "warning" in severities else "holds"

    @property
    def headline(self) -> str:
        """First line of a report: the verdict, and the number of identifiable parameters."""
        mine = [e for e in self.estimates if e.kind == "parameter"]
        count = sum(e.identifiable for e in mine)
        identified = IDENTIFIED.format(count=count, parameters=len(mine), chi2=self.chi2)
        return HEADLINES[self.verdict].format(identified=identified, chi2=self.chi2)

    def recorded(self, recording: str | None = None) -> RecordedRig:
        """A recording and its rig, by default the first. Raises `ValueError` for an unknown one,
        and, without a name, where rigs differ between recordings."""
        known = ", ".join(f"`{one.name}`" for one in self.recordings)
        if recording is None and self.recordings:
            first = self.recordings[0]
            if any(
                (one.identified, one.known) != (first.identified, first.known)
                for one in self.recordings
            ):
                raise ValueError(
                    f"the rig is not the same in all recordings: say in which one, of {known}"
                )
            return first
        for one in self.recordings:
            if one.name == recording:
                return one
        raise ValueError(f"there is no recording {shown(recording)}; there are {known or 'none'}")

    def model(self, recording: str | None = None) -> Rig:
        """The identified rig, ready to run: that of a recording, which is needed where they differ.

        Warns of parameters that are not identifiable. Raises `ValueError` for a rig that a file
        cannot hold: `applied_to` says what to do then.
        """
        one = self.recorded(recording)
        rig = deepcopy(self.rigs[one.name]) if one.name in self.rigs else one.rebuilt()
        set_parameters(rig, one.identified)
        self._warn_unidentifiable(one)
        return rig

    def applied_to(self, rig: Rig, recording: str | None = None) -> Rig:
        """A copy of `rig` with the values that were identified: those of a recording, which is
        needed where they differ.

        Warns of parameters that are not identifiable, and of numbers and laws that are not those of
        the fit. Raises `ValueError` for a rig that has no such parameters.
        """
        one, mine = self.recorded(recording), known(rig.description(), {})
        for name in one.identified:
            rig.parameter(name)
        other = [name for name, value in one.known.items() if mine.get(name) != value]
        if other:
            changes = ", ".join(
                f"{name} is {shown(mine.get(name))} and was {shown(one.known[name])}"
                for name in other
            )
            warn(
                "this rig is not the one of the fit, so its values may mislead: "
                f"{line(changes, 300)}",
            )
        rig = deepcopy(rig)
        set_parameters(rig, one.identified)
        self._warn_unidentifiable(one)
        return rig

    def draws(
        self, count: int, recording: str | None = None, seed: int = 0
    ) -> dict[str, NDArray[np.float64]]:
        """Draws (1 + count,) [unit] of the uncertain parameters by name, first the estimates, then
        draws from the normal distribution of the coordinates within their bounds. `torchsoft.plan`
        takes them as `over`.

        Warns of parameters that are not identifiable, which stay at the end of the search. Raises
        `ValueError` for no count, and where no parameter is identifiable.
        """
        whole("count", count, 1)
        one = self.recorded(recording)
        determined = self._warn_unidentifiable(one)
        mine = [
            (i, c)
            for i, c in enumerate(self.coordinates)
            if c.kind == "parameter" and c.recording in (None, one.name)
        ]
        free = [i for i, c in mine if c.name in determined]
        if not free:
            raise ValueError("no parameter is identifiable, so that there is nothing to draw")
        x = np.tile(self.x, (1 + count, 1))
        C = np.array(self.covariance, dtype=float)[np.ix_(free, free)]
        rng = np.random.default_rng(seed)
        x[1:, free] += rng.multivariate_normal(np.zeros(len(free)), C, count)
        values = {
            c.name: np.clip([c.to_value(one) for one in x[:, i]], c.low, c.high) for i, c in mine
        }
        for i, c in mine:
            if c.ratio_to:  # to another unknown, or to a number that is known
                known_one = one.identified[c.name] / c.to_value(self.x[i])
                values[c.name] = values[c.name] * values.get(c.ratio_to, known_one)
        return values

    def _warn_unidentifiable(self, one: RecordedRig) -> set[str]:
        """Names of the identifiable parameters. Warns of the others, including those of a held-out
        recording."""
        mine = [
            e for e in self.estimates if e.kind == "parameter" and e.recording in (None, one.name)
        ]
        identifiable, named = {e.name for e in mine if e.identifiable}, {e.name for e in mine}
        weak = {
            c.name: one.identified[c.name]
            for c in self.coordinates
            if c.kind == "parameter"
            and c.recording in (None, one.name)
            and c.name not in identifiable
            and (c.name in named or not self.unknowns[c.name].fixed)
        }
        if weak:
            warn(undetermined(weak))
        return identifiable

    def to_json(self) -> str:
        """Content of the file."""
        content = {"verdict": self.verdict}
        content |= finite(adapter().dump_python(self, mode="json"))
        for one, finding in zip(content["findings"], self.findings):
            one["text"] = str(finding)
        return json.dumps(
            {"schema": SCHEMA, "checksum": checksum(content)} | content, indent=1, allow_nan=False
        )

    def save(self, path: str | Path) -> None:
        """Write the JSON file. It appears whole or not at all."""
        save_text(path, self.to_json())


@cache
def adapter() -> TypeAdapter[IdentificationResult]:
    return TypeAdapter(IdentificationResult)


def checksum(content: Any) -> str:
    """Checksum of JSON content, independent of the order of names."""
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def load_answer(path: str | Path) -> IdentificationResult:
    """The answer in a file. Raises `ValueError` naming the file for one that is damaged or not an
    answer, and `OSError`."""
    check_file(path, LARGEST)
    try:
        content = json.loads(Path(path).read_bytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} is not an answer of torchsoft, or was cut: it is not JSON ({line(error, 200)})"
        ) from None
    form = content.pop("schema", None) if isinstance(content, dict) else None
    if form != SCHEMA:
        raise ValueError(
            f"{path} is not an answer that this torchsoft reads, which are called {SCHEMA!r}: its "
            f"`schema` is {shown(form)}; if an older version wrote it, identify again"
        )
    if content.pop("checksum", None) != checksum(content):
        raise ValueError(
            f"{path} is damaged: its content is not what was saved; restore it from a copy, or "
            "identify again"
        )
    content.pop("verdict", None)  # it follows from the rest, as texts do
    findings = content.get("findings")
    for one in findings if isinstance(findings, list) else ():
        if isinstance(one, dict):
            one.pop("text", None)
    # of a steep friction law, which was fitted nevertheless
    with refusing(content, str(path)), warnings.catch_warnings(action="ignore"):
        return adapter().validate_json(json.dumps(content))


BLURRED = 0.1
"""Relative standard deviation of a combination of parameters above which identifiable products are
reported in its place."""


def seen_together(fit: Fit, C: Array) -> list[Combination]:
    """Products of powers of parameters that the data determine better than each of them, by the
    covariance C (n, n) of all coordinates."""
    mine = {
        one.label: i
        for i, one in enumerate(fit.problem.coordinates.all)
        if fit.free[i] and one.kind == "parameter" and one.scale == "log"
    }
    at = [*mine.values()]
    return combinations([*mine], C[np.ix_(at, at)], BLURRED) if len(mine) > 1 else []
