"""Findings of an identification, and all of their wording.

The text of a finding is that of `SENTENCES` by its code, filled in with its facts. A sentence, or a
clause of a case, is left out where a fact that it names is absent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from string import Formatter
from typing import Any, Literal, get_args

Severity = Literal["error", "warning", "note"]
"""An error makes the estimates worthless, a warning speaks against the model, a note limits what
the estimates mean."""

SEVERITIES: tuple[Severity, ...] = get_args(Severity)

Facts = Mapping[str, Any]
"""Numbers and names by the name of the fact; `cases` is a list of facts, one for each case."""

EXPLAIN = "Run `torchsoft explain`, which refits with each suspect free and compares the fits."

SUSPECT = ("{name}", " = {value:.6g}", " ({favoured:+.3g}", " {unit}", " ± {sd:.2g})")

SENTENCES: dict[str, tuple[str, ...]] = {
    # recordings, before the fit
    "sign": (
        "Recording `{recording}`: the sign of {channel} looks opposite.",
        "Its correlation with a run from the start is {correlation:.2f}.",
    ),
    "unit": (
        "Recording `{recording}`: {channel} looks as if it were in another unit, {confusion}.",
        "It moves {ratio:.3g} times as much as in a run with the parameters of the start.",
    ),
    "size": (
        "Recording `{recording}`: {channel} moves {ratio:.3g} times as much as in a run with the "
        "parameters of the start.",
        "Check its unit, and these parameters.",
    ),
    "constant": (
        "Recording `{recording}`: {channel} is constant, {value:.6g} {unit} in all of its "
        "{samples} samples.",
        "Its noise is stated as {noise:.3g} {unit}.",
        "A run with the parameters of the start moves it by {run:.3g} {unit} rms.",
        "Was it recorded? Leave out its sensor, or correct the column.",
    ),
    "noise": (
        "Recording `{recording}`: the noise of {channel} is stated as {noise:.3g} {unit}, but all "
        "of its samples are within {range:.3g} {unit}.",
        "Is it in the right unit?",
    ),
    "resolution": (
        "Recording `{recording}`: {channel} comes in steps of {step:.3g} {unit}, {ratio:.2g} times "
        "its noise.",
        "State its `resolution`.",
    ),
    "set-points": (
        "Recording `{recording}`: set-points {setpoint} every {apart:.3g} ms are too sparse for "
        "this motion: the error between them is {error:.2g} {unit}, {noises:.2g} times the noise "
        "of {channel}.",
        "Record them every {enough:.2g} ms, or with their rates (there is no column {lacking}).",
        "Record them every {enough:.2g} ms; or {given} is not quite their rate (is a clock a "
        "little off?).",
    ),
    "rate": (
        "Recording `{recording}`: {setpoint}_dot is not the rate of {setpoint}: it differs by "
        "{off:.3g} rms from that of a spline through it, {size:.3g}.",
        "Its sign looks opposite (a factor of {opposite:.3g}).",
        "It is {factor:.3g} times that.",
    ),
    "controller": (
        "Recording `{recording}`: {force} differs by {off:+.3g} {unit}, on average, from what its "
        "controller gives.",
        "Was a force fed forward that {feed} does not have?",
        "Are the gains, units, zeros and set-points of {loop} right?",
    ),
    "not-compared": (
        "Recording `{recording}`: {force} is not compared with its controller, since {lacking} is "
        "not recorded.",
    ),
    # the fit
    "stalled": (
        "The fit stopped improving: over {evaluations} evaluations chi2 fell by less than "
        "{part:.0%}, to {chi2:.3g}.",
        "The model lacks something that these data show.",
    ),
    "stage-failed": (
        "The fit ended at rtol = {rtol:g}: with a finer tolerance {reason}.",
        "The model may lack something that drives its parameters to where it has no solution.",
    ),
    "not-converged": ("The last stage stopped before it converged.", "Allow more evaluations."),
    "not-identifiable": (
        "{estimate} is not identifiable from these data: a change by {change} would not show.",
    ),
    "at-bound": (
        "{estimate} ended at a bound ({value:.4g}).",
        "{known} = {known_value:.4g}, which is stated, holds it there; is that right?",
        "Widen the bound of {name}, or question the model.",
    ),
    "steps-unchecked": (
        "The tolerance rtol = {rtol:g} could not be checked: a run with finer steps failed.",
    ),
    "steps-too-coarse": (
        "The tolerance rtol = {rtol:g} is too coarse: it shifts {estimate} by {shift:.2g} standard "
        "deviations ({size}).",
        "Take rtol = {finer:g}.",
    ),
    "steps-not-refined": (
        "Time steps were checked but not refined, since chi2 = {chi2:.3g} is far above the noise.",
    ),
    "noisy-derivatives": (
        "The tolerance rtol = {rtol:g} is too coarse for derivatives: their error is {error:.2g} "
        "of the noise.",
        "Estimates scatter more than their intervals say; take rtol = {finer:g}.",
    ),
    "not-smooth": (
        "The fit has not converged: contact points touch, leave or start to slip at its end, and "
        "samples are not smooth in {coordinates}.",
        "Intervals may be too narrow.",
        "Use profile likelihoods (`torchsoft profile`) of {profiled}.",
        "Measure {measured} when the recording starts, state what is known of it in start.given, "
        "or start at rest.",
    ),
    "run": ("The run of recording `{recording}`: {text}.",),
    "heldout-failed": ("Held-out recording `{recording}` could not be simulated: {reason}.",),
    "heldout-unidentified": (
        "Held-out recording `{recording}` is predicted with values that the data do not determine, "
        "and so with the ends of the search: {values}.",
    ),
    # residuals
    "unexplained": (
        "Residuals of {channel} are {ratio:.2g} times the stated noise.",
        "Intervals may miss the truth.",
    ),
    "onset": (
        "The misfit starts in {cases}.",
        "Look for what happened then (lost samples, a clock that jumped, a knock, a motion that "
        "the model does not describe), or fit the data before it.",
    ),
    "larger": (
        "Residuals are larger than the stated noise: {cases}.",
        "The model may be wrong, or the noise larger.",
        "Intervals are widened by {widened:.3g}.",
    ),
    "smaller": (
        "Residuals are smaller than the stated noise: {cases}.",
        "State less noise, or intervals are too wide and faults of the model stay hidden.",
    ),
    "white": (
        "Residuals are not white in {cases}.",
        "Something systematic is left, and intervals may be too narrow.",
    ),
    "motion": (
        "Residuals follow the motion in {cases}.",
        "A sensor differs from what is stated, or the model is wrong.",
    ),
    "channels": (
        "Residuals of different channels correlate: {cases}.",
        "The model leaves out something that moves both.",
    ),
    "outliers": (
        "There are outliers in {cases}.",
        "Look at these samples, or take a robust loss.",
    ),
    "priors": (
        "The data contradict the prior of {cases}.",
        "The prior is wrong, or the model.",
    ),
    "colour": (
        "Residuals are coloured in {cases}, and no sensor declares it; intervals allow for it.",
        "A wrong model leaves such residuals too: where it is the sensor, declare its `colour`.",
    ),
    # assumptions
    "interrupted": ("Interrupted before these tests: {names}.", "The same command continues."),
    "effort": (
        "Refits took as much work as `effort` allows, so {names} were not refitted.",
        "A larger `effort` refits them.",
    ),
    "numerical-unchecked": (
        "The effect of a numerical setting could not be checked ({stated}): {reason}.",
    ),
    "numerical": (
        "{estimate} depends on a numerical setting: {stated}; if {otherwise} it would move by "
        "{shift:.2g} standard deviations, and the data cannot tell.",
        "The interval, {wider:.2g} times as wide, allows for that.",
        "The interval does not allow for that: refine {setting}.",
    ),
    "undetectable": (
        "The largest undetectable shift is {shift:.2g} standard deviations of {estimate}.",
        "It occurs if {name} differs by {size} from what is stated ({stated}).",
    ),
    "untestable": (
        "{estimate} depends on {name}, which these data cannot test: an error of {size} shifts it "
        "by {shift:.2g} standard deviations.",
    ),
    "undetectable-others": (
        "{count} more would shift an estimate by up to {shift:.2g} standard deviations without "
        "being detected: {names}.",
    ),
    "contradicted": (
        "The data contradict the stated values of {cases} by three standard deviations or more.",
        "That may be chance: {tested} assumptions were tested.",
    ),
    "cause": (
        "Of the assumptions tested, the data contradict that {stated}: the sum of squares falls "
        "from {before:.4g} to {left:.4g} with {cases}.",
        "{estimate} would move by {shift:.2g} standard deviations; estimates under it: {under}.",
        "The refit with {unconverged} free has not converged, so it has no estimates.",
        "Check it, and correct it: what is not tested, such as a parameter that changes within a "
        "recording, may look alike.",
        'To estimate it, add [unknowns."{unknown}"].',
    ),
    "causes": (
        "The data contradict one of {count} assumptions, and cannot tell which: {cases}.",
        "The sum of squares falls by {gain:.0f}; estimates under one or another: {between}.",
        "Measure one of them, or record a motion that tells them apart.",
    ),
    "rivals": (
        "The data contradict one of {count} assumptions: {cases}.",
        "The sum of squares would fall about as far with each.",
        EXPLAIN,
    ),
    "far": (
        "Something differs from its stated value, most likely {cases}: the sum of squares would "
        "fall by {gain:.0f}.",
        "{estimate} would move by {shift:.2g} standard deviations, too far for a score test.",
        EXPLAIN,
    ),
    "unconfirmed": (
        "Something differs from its stated value, most likely {cases}: the sum of squares falls by "
        "{gain:.0f}, which is more than chance.",
        "Residuals pass every test without it, so nothing confirms the cause.",
        "It may also be {others}.",
    ),
    "likeliest": (
        "The likeliest suspect, which only a refit can confirm or exclude, is {cases}: the sum of "
        "squares would fall by {gain:.0f}.",
        "To first order residuals still fail a test ({alarms}).",
        "With {besides} also free nothing would be left.",
        EXPLAIN,
    ),
    "nearest": (
        "No tested assumption explains the misfit.",
        "With the nearest, {cases}, the sum of squares falls by {gain:.0f}, but residuals still "
        "fail a test ({alarms}).",
        "With {besides} also free nothing would be left.",
    ),
    "no-suspect": (
        "No single suspect explains the misfit to first order.",
        "The nearest are {cases}.",
        EXPLAIN,
    ),
    "none": (
        "{count} of {total} suspects were refitted, and none explains the misfit.",
        "Residuals still fail a test ({alarms}).",
        "Look at their plots in the report: the cause may not be among the suspects.",
    ),
    # profiles
    "profile-open": (
        "{estimate} has no {end} bound of its 95 % interval within {value:.4g}: {reason}.",
    ),
    "profile-steps": (
        "The {end} end of the profile of {estimate} is uncertain: steps chosen anew there change "
        "|r|^2 by {change:.2g}.",
        "Take a tighter tolerance than rtol = {rtol:g}.",
    ),
    # laws
    "law": ("`{law}` made these data: {cases}.",),
    "no-law": (
        "None of the laws explains these data.",
        "The best, `{best}`, has chi2 = {chi2:.3g} (p = {p:.1g}).",
        "The best, `{best}`, misses the held-out recordings (p = {heldout_p:.1g}).",
        "The best, `{best}`, leaves residuals that follow {patterned}.",
        "It is nearer than {ahead}, but that does not make it right.",
        "Or the noise is not as it was stated: it is larger, or coloured.",
    ),
    "laws-alike": ("The data cannot tell which law made them.",),
    "law-contradicted": (
        "Held-out recordings speak for `{other}` and fitted ones for `{best}`, each by more than "
        "noise does.",
    ),
    "law-evidence": (
        "The evidence for `{best}` over `{other}` is {evidence:.2g} nats ({enough:g} are needed), "
        "and z = {z:.2g} ({apart:g} is needed).",
        "The steps of the simulation change the evidence by {numerical:.2g}: take a tighter "
        "tolerance.",
        "Their predictions differ by {distance:.2g} times the noise over all samples together: "
        "these motions and sensors cannot tell them apart.",
    ),
    "law-unconverged": (
        "The fit of `{law}` has not converged, so it may be better than it looks.",
    ),
    # designs
    "design-interrupted": ("Interrupted after {done} of {iterations} iterations.",),
    "design-limit": ("{channel} reaches {part:.1%} of the way to its limits.",),
    "design-nonlinear": (
        "A fit with rtol = {rtol:g} that starts a standard deviation from the truth ends {off:.2g} "
        "of them from it in `{estimate}`.",
        "Take finer steps, and count intervals that hold before this motion is used.",
    ),
    "design-failed": ("{count} motions that the search tested could not be run.",),
    "design-file": (
        "The written file cannot be run: {failure}.",
        "motion.{signal} of the written file is up to {off:.3g} off what the search found, of "
        '{most:.3g}: the file makes "start" or "held" anew with the new motion; give numbers in '
        "their place.",
    ),
}
"""Sentences by code, the first one short. A sentence without a fact in it is always there."""

PLACE = "{channel} of `{recording}`"

CASES: dict[str, tuple[str, ...]] = {
    "onset": (
        "`{recording}` at t = {time:.4g} s",
        ", where {first} is off by {off:.2g} times the noise",
        " (rms residuals of {channel} rise from {before:.2g} to {size:.2g} times the noise)",
    ),
    "larger": (PLACE, "all channels together ({samples:.0f} samples)", " {size:.3g} times"),
    "white": (PLACE, " (neighbouring samples correlate by {size:.2f})"),
    "motion": (PLACE, " ({size:.0%} of it, most like {like})"),
    "channels": ("{channels} of `{recording}`", " (correlation {size:.2f})"),
    "outliers": (PLACE, " (the largest {size:.1f} times the noise, at t = {time:.4g} s)"),
    "priors": ("{prior}", " by {size:.2g} standard deviations"),
    "colour": (
        "{channel}",
        " (order {order}, neighbouring samples correlate by {correlation:.2f})",
    ),
    "alarms": ("{test}", " in {channel} of `{recording}`", " in {samples:.0f} samples together"),
    "no-suspect": ("{name}", " ({part:.0%} of the misfit)"),
    "causes": (*SUSPECT, ", score {score:.2g}"),
    "law": ("`{other}` is behind by {evidence:.3g} nats, {z:.2g} standard deviations",),
}
CASES |= {"smaller": CASES["larger"]}
"""Clauses of one case by the code of its finding; suspects are the default."""

HEADLINES = {
    "holds": "The model holds. {identified}",
    "doubtful": "The model is doubtful: see the warnings below. If it holds: {identified}",
    "does not explain": "The model does not explain the data: see the findings below. Intervals "
    "may miss the truth. χ² = {chi2:.3g}",
}
"""First line of a report by its verdict."""

IDENTIFIED = "{count} of {parameters} parameters identifiable, χ² = {chi2:.3g}"

TESTS = {
    "level": "size",
    "white": "whiteness",
    "motion": "correlation with the motion",
    "channels": "correlation of channels",
}
"""Names of tests of residuals."""

LISTED = 3
"""Most cases that a sentence lists; it counts the others."""


@dataclass(frozen=True)
class Finding:
    """One thing that an identification found: a code, its severity, and the facts."""

    code: str
    severity: Severity
    facts: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return text(self.code, self.facts)


def text(code: str, facts: Facts) -> str:
    """The sentences of a finding; the code alone where it is not one of `SENTENCES`."""
    if code not in SENTENCES:
        return code
    words = {
        name: worded(value, CASES.get(code if name == "cases" else name, SUSPECT))
        for name, value in facts.items()
    }
    every = (*SENTENCES[code], "The same holds for recording {others_alike}.")
    return " ".join(one.format(**words) for one in every if complete(one, words))


def complete(template: str, facts: Facts) -> bool:
    """Whether every fact that a template names is there."""
    names = [name for _, name, _, _ in Formatter().parse(template) if name]
    return all(facts.get(name) not in (None, "") for name in names)


def worded(value: Any, clauses: Sequence[str]) -> Any:
    """A list of names or of cases with these clauses, or a table of values, in words; other facts
    as they are."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} = {ranged(one)}" for name, one in value.items())
    if isinstance(value, list | tuple):
        names = [one for one in value if isinstance(one, str)]
        return listed(names or [case(clauses, one) for one in value])
    return value


def case(clauses: Sequence[str], facts: Facts) -> str:
    """One case in words."""
    return "".join(clause.format(**facts) for clause in clauses if complete(clause, facts))


def ranged(value: Any) -> str:
    """A value, or the ends of a range."""
    ends = value if isinstance(value, list | tuple) else [value]
    return " to ".join(f"{end:.4g}" for end in ends)


def listed(cases: Sequence[str]) -> str:
    """The first cases, and the number of the others."""
    more = len(cases) - LISTED
    return ", ".join(cases[:LISTED]) + (f" and {more} more" if more > 0 else "")
