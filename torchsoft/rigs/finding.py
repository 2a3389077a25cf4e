"""What a check of a rig file finds."""

from typing import Literal, NamedTuple, get_args

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)


class Finding(NamedTuple):
    """An "error" makes no sense or comes to a bad end, a "warning" may, a "note" is worth knowing."""

    severity: Severity
    field: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.field}: {self.sentence}"
