"""What an answer keeps of posterior draws."""

from dataclasses import dataclass

from torchsoft.tables import Number


@dataclass(frozen=True)
class MarginalSummary:
    """One coordinate's marginal posterior in physical units."""

    label: str
    mean: Number
    sd: Number
    median: Number
    ci95: tuple[Number, Number]
    effective: Number
    r_hat: Number | None


@dataclass(frozen=True)
class PosteriorSummary:
    """Marginals of posterior draws, what was checked of them, and what a reader must know."""

    method: str
    draws: int
    marginals: list[MarginalSummary]
    checks: dict[str, Number]
    notices: list[str]
