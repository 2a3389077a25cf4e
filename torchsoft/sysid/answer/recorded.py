"""The rigs of recordings as plain data, from which those of this package are built again."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.rig import Rig
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array, identity
from torchsoft.sysid.problem.start import PREFIX
from torchsoft.tables import line


@dataclass(frozen=True)
class RecordedRig:
    """A recording and its rig: what tells it from others, its length [s], where it began, the rig's class, its numbers and laws
    before the fit (`description`), and the values that were `identified` of it, with those of where it `began`.

    `settings` are those from which `SoftGrasp` makes the very same rig; none where another rig, or laws of the user's own, are
    needed.
    """

    name: str
    fitted: bool
    fingerprint: str
    samples: int
    duration: float
    start: str
    rig: str
    description: dict[str, Any]
    settings: Parameters | None
    identified: dict[str, float]
    began: dict[str, float]

    @property
    def known(self) -> dict[str, Any]:
        """Numbers and laws that were not identified, without those of a scenario."""
        return known(self.description, self.identified)

    def rebuilt(self) -> Rig:
        """The rig before the fit, whose reference holds still. Raises `ValueError` where only its maker has its laws."""
        if self.settings is None:
            raise ValueError(
                f"the rig of recording `{self.name}` is a {self.rig} with parts of its own, which no file holds: build it "
                "as it was built for the fit, and call `applied_to(rig)`"
            )
        return SoftGrasp(self.settings)


def known(description: dict[str, Any], identified: dict[str, float]) -> dict[str, Any]:
    """A rig's description as one table, without what is identified and without the scenario."""
    parameters = {name: value for name, value in description["parameters"].items() if name not in identified}
    parts = {part: laws for part, laws in description.items() if part != "parameters"}
    laws = {f"{part} of {name}": law for part, laws in parts.items() for name, law in laws.items()}
    scenario = {name for name in parameters if name.startswith("scenario.") and name != "scenario.gravity"}
    return {name: value for name, value in (parameters | laws).items() if name not in scenario}


def untold(values: Mapping[str, float]) -> str:
    """What is said of values that the data do not tell."""
    said = ", ".join(f"{name} = {value:.3g}" for name, value in values.items())
    return f"not identifiable from the data, and so only where the search ended: {said}"


def rebuildable(rig: Rig) -> bool:
    """Whether `SoftGrasp` makes the same rig from its settings, and these are valid."""
    if type(rig) is not SoftGrasp:
        return False
    settings = rig.settings
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a steep friction law
            Parameters.model_validate(settings.model_dump())
    except ValueError:
        return False
    return identity(SoftGrasp(settings)) == identity(rig)


def recorded_rigs(problem: Problem, x: Array, fitted: Sequence[str]) -> list[RecordedRig]:
    """Of every recording, with its values at x (n,)."""
    out, seen = list[RecordedRig](), dict[bytes, bool]()
    for k, recording in enumerate(problem.recordings):
        values, rig, key = problem.values(x, k), recording.rig, identity(recording.rig)
        if key not in seen:
            seen[key] = rebuildable(rig)
        settings = rig.settings if isinstance(rig, SoftGrasp) and seen[key] else None
        identified = {name: value for name, value in values.items() if not name.startswith(PREFIX)}
        began = {name: value for name, value in values.items() if name.startswith(PREFIX)}
        start = line(repr(recording.start), 300)
        one = RecordedRig(
            recording.name, recording.name in fitted, recording.fingerprint, problem.samples([recording.name]),
            recording.duration, start, type(rig).__qualname__, rig.description(), settings, identified, began,
        )  # fmt: skip
        out.append(one)
    return out
