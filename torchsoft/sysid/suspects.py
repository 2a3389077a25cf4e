"""Sentences on the tests of assumptions: the likeliest suspects, further effects, the remaining
misfit, constants of the computation that affect the estimates, and what would not be noticed."""

from collections.abc import Sequence
from typing import NamedTuple

from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.assumptions import AMOUNTS
from torchsoft.sysid.sensitivity import Checked

LIKELY = 0.01
"""Least odds of a suspect that is named."""

NAMED = 6
"""Most suspects that a sentence names where only new fits can tell them apart."""

UNDER = 8
"""Most estimates that a sentence states under an alternative."""

ALLOWED = 1.05
"""Least factor by which an interval is wider that allows for a constant of the computation."""

MOVED = 0.5
"""Largest shift of an estimate by a constant of the computation, in standard deviations, that gets
no notice."""


HINT = 10.0
"""Significance above which the data favour an assumption though not evidently: three standard
deviations."""

OFF = 3.0
"""Shift of an estimate, in standard deviations, from which on every such assumption is named."""

WORST = 3
"""Most sentences on assumptions of each kind that the data would not show to be wrong."""


def assumption_notices(checked: Checked) -> list[str]:
    """Sentences on what was not tried, and on constants of the computation that affect the
    estimates."""
    out = list[str]()
    if checked.untried:
        out.append(
            f"interrupted, so these were not tried: {', '.join(checked.untried)}; the same command "
            "tries them"
        )
    if checked.late:
        more = f" and {len(checked.late) - NAMED} more" if len(checked.late) > NAMED else ""
        out.append(
            "new fits took as much work as `effort` allows, so there was none with another "
            f"{', '.join(checked.late[:NAMED])}{more}; a larger one tries them"
        )
    return out + constant_notices(checked)


def assumption_doubts(checked: Checked) -> list[str]:
    """Sentences on what the data hold against the assumptions, the strongest first. A suspect is
    the cause where nothing is left under it; else the misfit stands for something else."""
    favoured, candidates = checked.favoured, len(checked.candidates)
    again = f": `explain` fits again with each of {candidates} and compares them"
    if favoured and checked.explained and favoured[0].far and len(checked.candidates) < 2:
        label, move = favoured[0].shift
        return [
            f"something is not as stated, most like {favoured[0].name}: the sum of squares "
            f"{favoured[0].falls}{favoured[0].found}; {label} would move by {abs(move):.2g} "
            "standard deviations, too far for a test to first order: `explain` fits again with it, "
            "and with what acts alike there"
        ]
    if favoured and checked.explained:
        near = [c for c in checked.checks if c.name in checked.candidates]
        return contradictions(favoured, near)
    if favoured and not checked.as_stated:
        near = [f"{c.name}{c.found}" for c in favoured if c.odds > LIKELY][:NAMED]
        return [
            f"something is not as stated, most like {favoured[0].name}: the sum of squares "
            f"{favoured[0].falls}{favoured[0].found}, which is more than chance. Residuals pass "
            "every test without it, so that nothing confirms the cause"
            + (f"; others may be it: {'; '.join(near[1:])}" if near[1:] else "")
        ]
    looks = "; ".join(SHORT[one.test].format(one.words) for one in checked.alarms[:WORST])
    if favoured:
        best = favoured[0]
        says = "the misfit stands for something that is none of the assumptions tested: with the "
        says += f"nearest one, {best.name}"
        if not best.refitted:  # a score test excludes nothing
            says = "the likeliest suspect, which only a new fit can exclude, is "
            says += f"{best.name}: with it"
        return [
            f"{says}, the sum of squares {best.falls}{best.found}, but "
            f"{looks}{several(checked)}{again * bool(candidates)}"
        ]
    if candidates:
        square = max((c.left + c.gain for c in checked.checks), default=1.0)
        near = ", ".join(
            f"{c.name} ({c.gain / square:.0%} of the sum of squares)"
            for c in sorted(checked.checks, key=lambda c: -c.gain)[:WORST]
        )
        return [
            f"no suspect explains to first order all that the fit left; nearest come {near}{again}"
        ]
    if checked.alarms and any(c.refitted for c in checked.checks):
        return [f"none of {len(checked.checks)} suspects explains the misfit: {looks}"]
    return []


def several(checked: Checked) -> str:
    """A clause on effects besides the likeliest suspect that would leave nothing."""
    if checked.left or not checked.besides:
        return ""
    others = " and".join(f" {c.name}{c.found}" for c in checked.besides)
    return f"; nothing would be left with{others} besides"


SHORT = {
    "level": "residuals are larger than the noise, {}",
    "white": "residuals are not white in {}",
    "motion": "residuals follow the motion in {}",
    "channels": "residuals belong together, {}",
}
"""Alarms of residuals under a suspect."""


def constant_notices(checked: Checked) -> list[str]:
    """Sentences on constants of the computation that affect the estimates."""
    out, checks = list[str](), checked.checks
    moved_on = any(c.refitted and c.suspected for c in checks)  # to another end than the fit's
    for c in checks:
        if c.kind == "numerical" and c.unchecked:
            out.append(f"it could not be checked what it does that {c.stated}: {c.unchecked}")
        elif c.kind == "numerical" and not c.suspected and c.favoured_sd > MOVED:
            label, move = c.most_moved
            if abs(move) > MOVED and not moved_on:
                wide = checked.wider[label]
                allowed = f"the interval, {wide:.2g} times as wide, allows for that"
                if wide < ALLOWED:
                    allowed = "the interval does not allow for that"
                out.append(
                    f"{label} hangs on a constant of the computation: {c.stated}; if {c.otherwise} "
                    f"it would move by {abs(move):.2g} standard deviations, and the data cannot "
                    f"tell: {allowed}"
                )
    return out


class Unseen(NamedTuple):
    """An assumption that the data would not show to be wrong: whether they favour it though not
    evidently, the largest shift of an estimate at a size that they would not show, in standard
    deviations, its name, and a sentence."""

    hinted: bool
    move: float
    name: str
    text: str


def unseen(checked: Checked) -> list[str]:
    """Sentences on assumptions that the data would not show to be wrong though estimates move by
    more than a standard deviation, the worst first: those with a size from which on they would,
    above all those that the data favour though not evidently; those that only a change of the
    estimates could tell; and the names of the others that move an estimate by `OFF`."""
    hidden, priced = list[Unseen](), list[Unseen]()
    for c in checked.checks:
        label, move, size = c.impact
        if c.kind not in ("known", "sensor") or c.unchecked or c.suspected or abs(move) < 1.0:
            continue
        if c.detectable <= AMOUNTS * c.amount:
            text = (
                f"{c.name}: {size:.2g} {c.unit}".rstrip() + " more or less than stated would not "
                f"be seen, and moves {label} by {abs(move):.2g} standard deviations"
            )
            if hinted := c.significance > HINT:
                text += (
                    f"; the data favour {c.favoured:+.2g} {c.unit}".rstrip()
                    + f" +- {c.favoured_sd:.2g}, which may be chance"
                )
            hidden.append(Unseen(hinted, abs(move), c.name, text))
        else:
            part = 100 * c.moves[label] * checked.sd[label]
            text = f"{label} takes {c.name} as exact: {c.amount:.2g} {c.unit}".rstrip()
            text += f" of it is {part:+.2g} % of {label}"
            priced.append(Unseen(False, abs(move), c.name, text))
    worst = [one for some in (hidden, priced) for one in sorted(some, reverse=True)[:WORST]]
    others = sorted({*hidden, *priced} - {*worst}, key=lambda one: -one.move)
    out, others = [one.text for one in worst], [one for one in others if one.move >= OFF]
    if others:
        out.append(
            f"{len(others)} more would move an estimate by up to {others[0].move:.2g} standard "
            f"deviations without being seen: {', '.join(one.name for one in others)}"
        )
    return out


def contradictions(
    favoured: Sequence[AssumptionTest], candidates: Sequence[AssumptionTest]
) -> list[str]:
    """A sentence on the suspect with the best odds, and on those that the data cannot tell from it;
    on all of them alike, where tests to first order cannot."""
    best = favoured[0]
    if len(candidates) > 1:
        order = sorted(candidates, key=lambda c: -c.gain)
        listed = "; ".join(f"{c.name} (by {c.gain:.0f})" for c in order[:NAMED])
        more = f"; {len(order) - NAMED} more" * (len(order) > NAMED)
        return [
            f"the data contradict one of {len(order)} assumptions, with which to first order the "
            f"sum of squares would fall about as far: {listed}{more}: `explain` compares them by "
            "new fits"
        ]
    rivals = [c for c in favoured[1:] if c.odds > LIKELY and c.passed]
    if rivals:
        some = [best, *rivals]
        listed = "; ".join(f"{c.name}{c.found}, odds {c.odds:.2g}" for c in some)
        return [
            f"the data contradict one of {len(some)} assumptions, or what acts alike, and do not "
            f"tell which: the sum of squares {best.falls} under {listed}{between(some)}"
        ]
    label, move = best.shift
    text = f"the data contradict that {best.stated}: the sum of squares {best.falls}{best.found}"
    if label and not best.under:
        return [f"{text}; the fit under it has not come to rest, and tells no estimates"]
    if label:
        under = list(best.under.items())[:UNDER]
        text += f"; {label} would move by {abs(move):.2g} standard deviations; estimates under it: "
        text += ", ".join(f"{name} = {x:.4g}" for name, x in under)
    return [text]


def between(some: Sequence[AssumptionTest]) -> str:
    """A clause on where estimates lie under each of some suspects; empty where tests to first order
    are too far off, or a fit has not come to rest."""
    if any(one.far or not one.under for one in some):
        return ""
    shown = []
    for label in [*some[0].under][:UNDER]:
        values = [one.under[label] for one in some if label in one.under]
        shown.append(f"{label} = {min(values):.4g} to {max(values):.4g}")
    return f"; estimates under one or another: {', '.join(shown)}" if shown else ""
