"""What the tests of assumptions say, as findings: the cause of a misfit, numerical settings that
matter, and errors that the data would not show."""

from collections.abc import Sequence
from typing import Any

from torchsoft.sysid.assumption_checks import Checked
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.assumptions import AMOUNTS
from torchsoft.sysid.search import RIVAL
from torchsoft.sysid.sentences import TESTS, Finding, Severity

LIKELY = 0.01
"""Least score of a suspect that is named beside the best."""

UNDER = 8
"""Most estimates that a finding states under an alternative."""

ALLOWED = 1.05
"""Least factor by which an interval is wider that allows for a numerical setting."""

MOVED = 0.5
"""Largest shift of an estimate by a numerical setting, in standard deviations, that gets no
finding."""

CONTRADICTED = 3.0
"""Standard deviations from its stated value from which on an assumption is named."""

NEAREST = 3
"""Most suspects that are named where none is likely."""


def suspect_findings(checked: Checked, unexplained: Severity) -> list[Finding]:
    """What the data hold against the assumptions; `unexplained` is the severity of a misfit that no
    suspect explains.

    A suspect is the cause where residuals under it pass the tests of a fit, and fail them without
    it. A score test alone excludes nothing: a suspect that was not refitted is only likely.
    """
    if not checked.favoured:
        return without_suspect(checked, unexplained)
    best, *others = checked.favoured
    facts: dict[str, Any] = {"cases": [best.case], "gain": best.gain}
    estimate, shift = best.shift
    if not checked.fails_as_stated:
        facts["others"] = [one.name for one in others if one.score > LIKELY]
        return [Finding("unconfirmed", "error", facts)]
    if checked.fails_best:
        facts |= {"alarms": alarms_of(checked)}
        if not checked.fails_besides:
            facts["besides"] = [one.name for one in checked.besides]
        return [Finding("nearest" if best.refitted else "likeliest", "error", facts)]
    rivals = [one for one in checked.checks if one.suspected and one.gain > RIVAL * best.gain]
    if not best.refitted and len(rivals) > 1:
        cases = [one.case for one in sorted(rivals, key=lambda one: -one.gain)]
        return [Finding("rivals", "warning", {"cases": cases, "count": len(cases)})]
    if best.far:
        return [Finding("far", "warning", facts | {"estimate": estimate, "shift": abs(shift)})]
    likely = [best, *(one for one in others if one.score > LIKELY and one.passed)]
    return [cause(best) if len(likely) == 1 else causes(likely)]


def cause(best: AssumptionTest) -> Finding:
    """The finding of one cause."""
    estimate, shift = best.shift
    facts: dict[str, Any] = {"cases": [best.case], "stated": best.stated, "left": best.left}
    facts |= {"before": best.left + best.gain, "unknown": best.parameter}
    if best.under:
        under = dict(list(best.under.items())[:UNDER])
        facts |= {"estimate": estimate, "shift": abs(shift), "under": under}
    elif estimate:
        facts["unconverged"] = best.name
    return Finding("cause", "warning", facts)


def causes(likely: Sequence[AssumptionTest]) -> Finding:
    """The finding of causes that the data cannot tell apart, the likeliest first."""
    cases = [one.case | {"score": one.score} for one in likely]
    facts = {"cases": cases, "gain": likely[0].gain, "count": len(likely)}
    return Finding("causes", "warning", facts | {"between": between(likely)})


def without_suspect(checked: Checked, severity: Severity) -> list[Finding]:
    """A finding where the data favour no suspect, and residuals fail a test."""
    refitted = [one for one in checked.checks if one.refitted]
    if checked.fails_best and not checked.searched:
        nearest = sorted(checked.checks, key=lambda one: -one.gain)[:NEAREST]
        square = max((one.left + one.gain for one in checked.checks), default=1.0)
        cases = [{"name": one.name, "part": one.gain / square} for one in nearest]
        return [Finding("no-suspect", severity, {"cases": cases})]
    if checked.fails_best:
        facts = {"count": len(refitted), "total": len(checked.checks)}
        facts |= {"alarms": alarms_of(checked)}
        return [Finding("none", severity, facts)]
    return []


def alarms_of(checked: Checked) -> list[dict[str, Any]]:
    """Tests that residuals under the likeliest suspect fail, as cases."""
    return [{"test": TESTS[one.test]} | one.case for one in checked.fails_best]


def between(some: Sequence[AssumptionTest]) -> dict[str, list[float]]:
    """Ranges of the estimates under each of some suspects; empty where score tests are too far off,
    or a fit has not converged."""
    if any(one.far or not one.under for one in some):
        return {}
    out = dict[str, list[float]]()
    for label in [*some[0].under][:UNDER]:
        values = [one.under[label] for one in some if label in one.under]
        out[label] = [min(values), max(values)]
    return out


def test_findings(checked: Checked) -> list[Finding]:
    """What was not tested, and numerical settings that affect the estimates."""
    out, checks = list[Finding](), checked.checks
    if checked.untried:
        out.append(Finding("interrupted", "note", {"names": [*checked.untried]}))
    if checked.not_refitted:
        out.append(Finding("effort", "note", {"names": [*checked.not_refitted]}))
    moved_on = any(c.refitted and c.suspected for c in checks)  # to another end than the fit's
    for c in (c for c in checks if c.kind == "numerical"):
        estimate, shift = c.most_moved
        if c.unchecked:
            facts = {"stated": c.stated, "reason": c.unchecked}
            out.append(Finding("numerical-unchecked", "note", facts))
        elif not (c.suspected or moved_on) and c.favoured_sd > MOVED and abs(shift) > MOVED:
            wider = checked.wider[estimate]
            allowed = {"wider": wider} if wider >= ALLOWED else {"setting": c.name}
            facts = {"stated": c.stated, "otherwise": c.otherwise, "shift": abs(shift)}
            facts |= {"estimate": estimate} | allowed
            out.append(Finding("numerical", "note", facts))
    return out


def risk_findings(checked: Checked) -> list[Finding]:
    """Errors of the assumptions that the data would not show though an estimate would move by more
    than a standard deviation: the largest shift, and the assumptions that the data contradict,
    though not evidently."""
    measured = [c for c in checked.checks if c.has_amount and not c.unchecked]
    known = [c for c in measured if not c.suspected]
    hidden = [c for c in known if c.detectable <= AMOUNTS * c.amount and abs(c.impact[1]) >= 1.0]
    exact = [c for c in known if c.detectable > AMOUNTS * c.amount and abs(c.most_moved[1]) >= 1.0]
    hidden.sort(key=lambda c: -abs(c.impact[1]))
    exact.sort(key=lambda c: -abs(c.most_moved[1]))
    out = [risk("undetectable", c, *c.impact) for c in hidden[:1]]
    out += [risk("untestable", c, *c.most_moved, c.amount) for c in exact[:1]]
    if more := [c for c in hidden[1:] if abs(c.impact[1]) >= CONTRADICTED]:
        facts: dict[str, Any] = {"count": len(more), "shift": abs(more[0].impact[1])}
        out.append(
            Finding("undetectable-others", "note", facts | {"names": [c.name for c in more]})
        )
    contradicted = [c for c in measured if abs(c.favoured) > CONTRADICTED * c.favoured_sd]
    if evident := [c for c in contradicted if c.favoured > 0 or not c.one_sided]:
        facts = {"cases": [c.case for c in evident], "tested": len(measured)}
        out.append(Finding("contradicted", "note", facts))
    return out


def risk(code: str, one: AssumptionTest, estimate: str, shift: float, size: float) -> Finding:
    """A note that an amount of an assumption shifts an estimate by so many standard deviations."""
    facts: dict[str, Any] = {"estimate": estimate, "shift": abs(shift), "name": one.name}
    facts |= {"stated": one.stated}
    return Finding(code, "note", facts | {"size": f"{size:.2g} {one.unit}".strip()})
