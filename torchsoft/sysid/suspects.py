"""Sentences on the tests of assumptions: the likeliest suspects, further effects, the remaining
misfit, and constants of the computation that affect the estimates."""

from collections.abc import Sequence

from torchsoft.sysid.sensitivity import AssumptionTest, Checked

LIKELY = 0.01
"""Least odds of a suspect that is named."""

UNEXPLAINED = 1.15
"""Least RMS residual of a channel, over its noise, that is reported as unexplained."""

NO_CAUSE = 5.0
"""RMS residual of a channel, over its noise, left by the new fit with the likeliest suspect, from
which on that suspect explains nothing."""

UNDER = 8
"""Most estimates that a sentence states under an alternative."""

MOVED = 0.5
"""Largest shift of an estimate by a constant of the computation, in standard deviations, that gets
no notice."""


def assumption_notices(checked: Checked) -> list[str]:
    """Sentences on suspected assumptions, the strongest first, on those that were not tried, and on
    constants of the computation that affect the estimates."""
    out = assumption_doubts(checked)
    if checked.untried:
        out.append(
            f"interrupted, so these were not tried: {', '.join(checked.untried)}; the same command "
            "tries them"
        )
    return out + constant_notices(checked.checks)


def assumption_doubts(checked: Checked) -> list[str]:
    """Sentences on what the data hold against the assumptions, the strongest first."""
    out, checks = [], checked.checks
    favoured = sorted((c for c in checks if c.odds > 0), key=lambda c: -c.odds)
    if checked.candidates and not favoured:
        square = max((c.left + c.gain for c in checks), default=1.0)
        near = ", ".join(
            f"{c.name} ({c.gain / square:.0%} of the sum of squares)"
            for c in sorted((c for c in checks if c.suspected), key=lambda c: -c.gain)[:4]
        )
        nearest = f"nearest come {near}" if near else "the data favour none"
        out.append(
            f"no suspect explains to first order all that the fit left; {nearest}: `explain` fits "
            f"again with each of {len(checked.candidates)} and compares them"
        )
    if favoured and favoured[0].refitted and max(checked.left.values(), default=0.0) > NO_CAUSE:
        best = favoured[0]
        out.append(
            f"no suspect explains these data: the sum of squares {best.falls}{best.found}, which "
            "leaves too much to be the cause"
        )
    elif favoured:
        out += contradictions(favoured, [c for c in checks if c.name in checked.candidates])
    out += [
        f"besides, the data contradict that {c.stated}: the sum of squares would fall by another "
        f"{c.gain:.0f}{c.found}"
        for c in checked.besides
    ]
    left = {channel: size for channel, size in checked.left.items() if size > UNEXPLAINED}
    if left and any(c.refitted for c in checks):
        sizes = ", ".join(
            f"{channel}: {size:.2g} times the noise left"
            for channel, size in sorted(left.items(), key=lambda item: -item[1])
        )
        out.append(f"none of {len(checks)} suspects explains {sizes}")
    return out


def constant_notices(checks: Sequence[AssumptionTest]) -> list[str]:
    """Sentences on constants of the computation that affect the estimates."""
    out = list[str]()
    moved_on = any(c.refitted and c.suspected for c in checks)  # to another end than the fit's
    for c in checks:
        if c.kind == "numerical" and c.unchecked:
            out.append(f"it could not be checked what it does that {c.stated}: {c.unchecked}")
        elif c.kind == "numerical" and not c.suspected and c.favoured_sd > MOVED:
            label, move = c.most_moved
            if abs(move) > MOVED and not moved_on:
                out.append(
                    f"{label} hangs on a constant of the computation: {c.stated}; if {c.otherwise} "
                    f"it would move by {abs(move):.2g} standard deviations, and the data cannot "
                    "tell: the interval allows for that"
                )
    return out


def contradictions(
    favoured: Sequence[AssumptionTest], candidates: Sequence[AssumptionTest]
) -> list[str]:
    """A sentence on the suspect with the best odds, and on those that the data, or tests to first
    order, cannot tell from it."""
    best = favoured[0]
    label, move = best.most_moved
    text = f"the data contradict that {best.stated}: the sum of squares {best.falls}{best.found}"
    if best.kind in ("known", "sensor") and not best.refitted:
        move *= best.favoured / best.amount
    if label:
        under = ", ".join(
            f"{name} = {value:.4g}" for name, value in list(best.under.items())[:UNDER]
        )
        text += (
            f"; {label} would move by {abs(move):.2g} standard deviations; estimates under it: "
            f"{under}"
        )
    if candidates:
        others = sorted((c for c in candidates if c is not best), key=lambda c: -c.gain)
        near = ", ".join(f"{c.name} (by {c.gain:.0f})" for c in others)
        return [f"{text}. Nearly as much falls with {near}: `explain` compares them by new fits"]
    rivals = [c for c in favoured[1:] if c.odds > LIKELY]
    if rivals:
        listed = "; ".join(f"{c.name}{c.found}, odds {c.odds:.2g}" for c in rivals)
        text += f". The data cannot tell it (odds {best.odds:.2g}) from: {listed}"
    return [text]
