"""Finding of a check of an input: severity, place and message."""

from typing import Literal, NamedTuple, get_args

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)


class Diagnostic(NamedTuple):
    """An "error" makes a result worthless, a "warning" may, a "note" is worth knowing.

    `where` is the field of a file, or the recording; `code` is the name by which a user may
    acknowledge it.
    """

    severity: Severity
    where: str
    message: str
    code: str = ""

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.message}"
