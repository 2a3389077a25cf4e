"""The answer of a comparison of laws, as plain data: how well each explains the recordings, and
which one did.

The rule. Against every other law b, a law a has the evidence, in nats,

    E = LR_fitted / c + LR_heldout / c - max(0, k_a - k_b) ln(n) / 2,        z = LR / sd(LR),

LR being the logarithm of the ratio of the likelihoods, k the number of what each has fitted, n the
samples that were fitted. That is the logarithm of Bayes' factor, with Schwarz's approximation for
the recordings that were fitted and the predictive density for those that were held out, but that no
law is named for having fewer parameters. LR changes with the noise by sd(LR), which is the whitened
distance D of the two predictions where the noise is as stated; c >= 1 is how much its variance
grows by what the residuals of a have of size and colour (quasi-likelihood: Burnham and Anderson
2002, section 2.5). z is Vuong's statistic (1989) for given motions: with samples drawn at random it
would take evidence that stands in a few of them, as of one slip, for luck.

Law a is named if against every other law E >= `EVIDENCE` and z >= `APART`, whatever a tenth of the
tolerance changes in E, if the held-out recordings do not speak against it (z_heldout > -`APART`),
if every fit has converged, and if its own residuals are as large as the noise (chi-squared, p >=
`FITS`) and do not follow the motion (`misfit`). With noise as stated a wrong law is named with a
probability of at most 6e-4, whatever D, and the right one with 95 % from D = 7.3 on. Else the
answer is that the data cannot tell, or that no law fits.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from torchsoft.display import suggestion
from torchsoft.files import write_json

EVIDENCE = 5.0
"""Logarithm of Bayes' factor from which evidence is very strong (Kass and Raftery 1995)."""

APART = 2.0
"""Standard deviations by which a likelihood ratio must differ from zero."""

FITS = 1e-3
"""p-value of the sum of squared residuals below which a law does not explain the data."""

Outcome = Literal["law", "cannot tell", "none fits"]


@dataclass(frozen=True)
class LawFit:
    """Results of one law: the number of its parameters, the log likelihood of the fitted samples in
    SI units, the reduced chi-squared with its p-value, information criteria, Akaike weight (of
    AICc), and the log density per sample of held-out recordings, with the p-value of their sum of
    squares. `numerical` is the change of the log likelihood by a tenth of the tolerance; `left` has
    sentences on deviations of the residuals from the stated noise, by the tests of
    `torchsoft.sysid.residual_tests`, and `patterned` is whether residuals follow the motion."""

    name: str
    parameters: int
    estimates: dict[str, float]
    log_likelihood: float
    chi2: float
    p: float
    aic: float
    aicc: float
    bic: float
    weight: float
    heldout: float | None
    heldout_p: float | None
    numerical: float
    converged: bool
    left: list[str]
    patterned: bool

    @property
    def misses(self) -> str:
        """Why the law does not explain the data, as the end of a sentence; empty if it does."""
        if self.p < FITS:
            return f"has chi2 = {self.chi2:.3g} (p = {self.p:.1g})"
        if self.heldout_p is not None and self.heldout_p < FITS:
            return f"misses the held-out recordings (p = {self.heldout_p:.1g})"
        return "leaves residuals that follow the motion" if self.patterned else ""

    @property
    def fits(self) -> bool:
        """Whether the law explains the fitted and the held-out recordings."""
        return not self.misses


@dataclass(frozen=True)
class Versus:
    """The best law against another one: log likelihood ratios of fitted and of held-out samples,
    the whitened distance D of the predictions, the inflation c of the variance, E and z of the
    rule, z of held-out recordings alone, and the change of E by a tenth of the tolerance."""

    best: str
    other: str
    fitted: float
    heldout: float | None
    distance: float
    inflation: float
    evidence: float
    z: float
    z_heldout: float | None
    numerical: float

    @property
    def doubts(self) -> list[str]:
        """Clauses on why the other law is not refuted; empty if it is."""
        a, b, out = f"`{self.best}`", f"`{self.other}`", []
        if self.z_heldout is not None and self.z_heldout <= -APART:
            out.append(
                f"held-out recordings speak for {b} and fitted ones for {a}, each by more than "
                "noise does"
            )
        sure = self.evidence - self.numerical
        if sure < EVIDENCE or self.z < APART:
            said = (
                f"the evidence for {a} over {b} is {self.evidence:.2g} nats ({EVIDENCE:g} are "
                f"needed), and z = {self.z:.2g} ({APART:g} is needed)"
            )
            if self.evidence >= EVIDENCE > sure and self.z >= APART:
                said += (
                    f", but the steps of the simulation move that by {self.numerical:.2g}: take a "
                    "tighter tolerance"
                )
            elif self.distance < 2 * APART:
                said += (
                    f"; their predictions differ by {self.distance:.2g} times the noise over all "
                    "samples together, so that these motions and sensors cannot tell them apart"
                )
            out.append(said)
        return out


@dataclass(frozen=True)
class Comparison:
    """Competing laws, the best first, and the best against every other. `law` is the law named by
    the data, if any, and `verdict` the conclusion in plain words."""

    outcome: Outcome
    law: str | None
    verdict: str
    laws: list[LawFit]
    against: list[Versus]
    samples: int
    heldout: list[str]

    def __getitem__(self, name: str) -> LawFit:
        for one in self.laws:
            if one.name == name:
                return one
        raise KeyError(
            f"no law `{name}` was compared; "
            f"{suggestion(name, [one.name for one in self.laws], 'there are')}"
        )

    def save(self, path: str | Path) -> None:
        """Write the JSON file. It appears whole or not at all."""
        write_json(path, asdict(self))

    def table(self) -> str:
        """A line for each law, with differences from the best."""
        head = ("law", "k", "log L", "chi2", "dAIC", "dAICc", "dBIC", "weight", "held out")
        rows = ["{:20s} {:>3s} {:>11s} {:>7s} {:>9s} {:>9s} {:>9s} {:>7s} {:>9s}".format(*head)]
        least = {key: min(getattr(one, key) for one in self.laws) for key in ("aic", "aicc", "bic")}
        for one in self.laws:
            own = f"{one.name:20s} {one.parameters:3d} {one.log_likelihood:11.1f} {one.chi2:7.3f}"
            delta = " ".join(f"{getattr(one, key) - least[key]:9.1f}" for key in least)
            told = "" if one.heldout is None else f" {one.heldout:9.3f}"
            rows.append(f"{own} {delta} {one.weight:7.3f}{told}")
        return "\n".join(rows)


def judged(laws: list[LawFit], against: list[Versus]) -> tuple[Outcome, str | None, str]:
    """Outcome, named law, and verdict, by the rule."""
    best = laws[0]
    doubts = [doubt for versus in against for doubt in versus.doubts]
    unsure = [
        f"the fit of `{one.name}` has not converged, so it may be better than it looks"
        for one in laws
        if not one.converged
    ]
    ahead = [v.other for v in against if not v.doubts]
    if not best.fits:
        said = f"none of the laws explains these data: the best, `{best.name}`, {best.misses}"
        if ahead:
            said += f"; it is nearer than {listed(ahead)}, but that does not make it right"
        return (
            "none fits",
            None,
            f"{said}. Or the noise is not as it was stated: it is larger, or coloured.",
        )
    if doubts or unsure:
        return "cannot tell", None, "the data cannot tell: " + "; ".join((*doubts, *unsure)) + "."
    said = [f"`{best.name}` made these data"]
    for versus in against:
        said.append(
            f"`{versus.other}` is behind by {versus.evidence:.3g} nats, {versus.z:.2g} standard "
            "deviations"
        )
    said += [f"But beware: {sentence}" for sentence in best.left]
    return "law", best.name, ". ".join(said) + "."


def listed(names: list[str]) -> str:
    return " and ".join(f"`{name}`" for name in names)
