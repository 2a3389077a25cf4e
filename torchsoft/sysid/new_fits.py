"""New fits of what a model does not explain: with one suspect after the other, until one explains
the data."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from tqdm import tqdm

from torchsoft.display import hidden
from torchsoft.sysid.assumption_tests import FIRST_ORDER, RIVAL, Again, AssumptionTest, Judge
from torchsoft.sysid.assumptions import Variation
from torchsoft.sysid.fit import Fit
from torchsoft.sysid.refits import (
    EVIDENT,
    REFITS,
    carried_on,
    far_off,
    first_step,
    joint_fit,
    likeness,
    refit,
    shares,
)
from torchsoft.tables import plain

MOST = 12
"""Most suspects with which a fit is repeated, besides laws and constants of the computation, and
numbers of a joint fit."""

MOSTLY = 0.5
"""Part of a misfit that a suspect explains to first order with which new fits begin, and of the
gain of the best short fit that another must have."""

TRIALS = 10
"""Evaluations that a new fit takes, as a rule; more are not spent on the others once one suspect
explains the misfit."""

LONGER = 4
"""Evaluations after the first step of the short fits by which suspects are ranked where the first
fit ended far off: the true cause leads by them where tests to first order have it tenth."""

COMPARABLE = 2 * EVIDENT
"""Sum of squares that a new fit may leave beyond the best one and still go on until it is at rest:
what is evident, and as much for the steps of the first fit, which are not its own."""

FAINT = 0.05
"""Part of a misfit that a suspect must explain to first order to have a short fit; those that were
the cause had 0.16 and more."""


class NewFits:
    """New fits of a doubtful fit, with one suspect of the `candidates` after the other. The
    iteration yields those that have been tried; their tests in `checks` are replaced.

    Costly suspects come last. Where the misfit is far off, one that explains most of it to first
    order is tried; where that is not the cause, short fits of all that were `tested` rank them, and
    the best is if it explains most; then some numbers are fitted at once, which comes before short
    fits where the first was a sensor. Sensors that explain the misfit by one kind of fault then
    come first, in one fit; where the numbers leave more than `RIVAL` of the misfit, or are at rest
    far off, none is the cause alone, and they are left out. Effects too small for the misfit are
    left out always. Where one suspect explains it, those with much smaller gains are left out, and
    costly ones; where none has passed its tests, those that act like the likeliest are tried. At
    the end the best go on until they are at rest. No fit is begun with which all would take more
    than `effort` times the work of the fit itself: `late` has the names of the suspects that are
    left.
    """

    def __init__(
        self,
        end: Fit,
        candidates: Sequence[Variation],
        tested: Sequence[Variation],
        judge: Judge,
        checks: dict[str, AssumptionTest],
        effort: float = float("inf"),
    ) -> None:
        self.judge, self.tested, self.checks = judge, tested, checks
        self.linear, self.far, self.late = dict(checks), far_off(end), list[str]()
        self.gains = {one.name: checks[one.name].gain for one in candidates}
        self.stated = end
        """The new fit with all assumptions as stated."""
        self.enough = 0.0
        """Least gain of a suspect that is tried, once one explains the misfit."""
        self.candidates, self.tried, self.likened = list(candidates), set[str](), False
        self.queue, self.short = list[list[Variation]](), dict[str, Fit]()
        ways: list[Callable[[], Fit | None]] = [self.screen, self.joint]
        self.rankings = ways if self.far else []
        self.bar = tqdm(total=len(candidates) + 1, unit="fit", disable=hidden(end.progress))
        self.end = end._replace(notify=lambda chi2: self.bar.set_postfix_str(f"chi2 = {chi2:.4g}"))
        self.most = end.runner.work * (1.0 + effort)

    def __iter__(self) -> Iterator[Variation]:
        with warnings.catch_warnings(action="ignore"), self.bar:
            self.say("new fit with all assumptions")
            as_stated = refit(self.end, ())
            self.bar.update()
            if as_stated is None:
                return
            self.stated = as_stated
            self.queue = self.ordered(self.candidates)
            near = None
            if self.evident():  # a sensor: readings are linear in several faults
                self.rankings = self.rankings[self.queue[0][0].kind == "sensor" :]
            elif self.rankings:
                near = self.rank()
            while self.queue or self.widened():
                some = self.queue.pop(0)
                if not self.promising(some):
                    continue
                if self.tried and self.end.runner.work + self.expected(some) > self.most:
                    self.late.append(named(some))
                    continue
                self.say(f"new fit with another {named(some)} ({len(self.queue)} more)")
                self.tried |= {one.name for one in some}
                self.fit(some, near, as_stated)
                self.bar.update()
                if len(some) == 1:
                    yield some[0]
                found = self.checks.get(named(some))
                if found is not None and self.judge.nearly(found):
                    self.rankings = []
                    self.limit(some)
                elif self.rankings:
                    near = self.rank()
            self.finish(as_stated)

    def say(self, text: str) -> None:
        """Describe the work on the progress bar."""
        self.bar.set_description(plain(text))

    def ordered(self, candidates: Sequence[Variation]) -> list[list[Variation]]:
        """Suspects in the order in which they are likely."""
        large = [one for one in candidates if self.judge.of_size(one)]
        return [[one] for one in sorted(large, key=lambda one: (one.costly, -self.gains[one.name]))]

    def evident(self) -> bool:
        """Whether the misfit is far off, and the likeliest suspect explains most of it."""
        most = MOSTLY * self.judge.misfit(self.judge.square)
        return self.far and bool(self.queue) and self.gain(self.queue[0]) >= most

    def rank(self) -> Fit | None:
        """Rank the suspects by the next way, and by the one after it if no suspect is evident; a
        joint fit that explains the misfit is returned."""
        near = self.rankings.pop(0)()
        return self.rank() if self.rankings and not self.evident() else near

    def screen(self) -> None:
        """Fill the queue by short fits: one step of every suspect, then more of the best, and of
        laws and constants of the computation, which begin far from where they end. Where one
        explains most of what a new fit as stated leaves, the queue has laws and those that gain
        half as much."""
        least = FAINT * self.judge.misfit(self.judge.square)
        left = [one for one in self.tested if one.name not in self.tried]
        left = [one for one in left if one.kind == "law" or self.linear[one.name].gain > least]
        left = [one for one in left if self.judge.of_size(one)]
        self.say("short fits with one suspect each")
        self.bar.total += len(left)
        fits = dict[Variation, Fit]()
        for one in left:
            fit = first_step(self.end, one.within(self.linear[one.name].favoured))
            if fit is not None:
                fits[one] = fit
            self.bar.update()
        ranked = sorted(fits, key=lambda one: fits[one].square)
        best = [one for one in ranked if one.kind in ("law", "numerical")]
        best += [one for one in ranked if one not in best][:MOST]
        self.short = {one.name: carried_on(fits[one], LONGER) for one in best}
        square, stated = self.judge.square, min(self.judge.square, self.stated.square)
        self.gains |= {name: max(square - fit.square, 0.0) for name, fit in self.short.items()}
        fell = {name: stated - fit.square for name, fit in self.short.items()}
        most = max(fell.values(), default=0.0)
        least = MOSTLY * most if most > MOSTLY * self.judge.misfit(stated) else 0.0
        best = [one for one in best if one.kind == "law" or fell[one.name] >= least]
        self.candidates = [*best, *(one for one in self.candidates if one.costly)]
        self.queue = self.ordered(self.candidates)

    def joint(self) -> Fit | None:
        """Fit at once the numbers that complement each other in explaining the misfit, and fill the
        queue by what that tells, or by short fits if they do not explain it and there were none;
        the fit is returned if it explains the misfit."""
        end, judge, checks, left = self.end, self.judge, self.checks, self.candidates
        self.say("new fit with many suspects unknown at once")
        every = [one for one in self.tested if one.parameter or one.fault is not None]
        numbers = judge.complementary(every, MOST)
        joint = joint_fit(end, numbers, judge.explained_chi2)
        explains = joint is not None and joint.square <= judge.explained_chi2
        several = list[list[str]]()
        if joint is not None:
            parts, several = shares(end, joint, numbers)
            self.gains |= {name: judge.square * parts[name] for name in parts if explains}
            much = judge.misfit(joint.square) > RIVAL * judge.misfit(judge.square)
            if not explains and (much or (joint.converged and far_off(joint))):
                for one in every:
                    checks[one.name] = replace(checks[one.name], suspected=False)
                left = [one for one in left if one not in every]
        if not explains and not self.short:
            return self.screen()
        left = [one for one in left if one.name not in self.tried]
        if explains:
            left = [one for one in left if one.name not in parts]
            left += [one for one in numbers if one.name in parts]
        self.queue = self.ordered(left)
        alone = {one.name: self.linear[one.name].gain for one in self.tested}
        sets = [alike(self.tested, one, alone) for one in several if explains and len(one) > 1]
        self.queue = [*next(filter(None, sets), []), *self.queue]
        return joint if explains else None

    def gain(self, some: Sequence[Variation]) -> float:
        """Expected fall of the sum of squares with some suspects at once."""
        return self.gains.get(named(some), self.judge.square)

    def expected(self, some: Sequence[Variation]) -> float:
        """Least work of a fit with some suspects, which matters where their runs are costly."""
        return TRIALS * sum(self.judge.work.get(one.name, 0.0) for one in some)

    def promising(self, some: Sequence[Variation]) -> bool:
        """Whether suspects can explain about as much as the one that explains the misfit, if
        any."""
        return self.gain(some) >= self.enough and not (self.enough and some[0].costly)

    def fit(self, some: Sequence[Variation], near: Fit | None, as_stated: Fit) -> None:
        """Repeat the fit with some suspects at once, from its end or from one `near`."""
        name, linear = named(some), [self.checks[one.name] for one in some]
        tried = [one.within(test.favoured) for one, test in zip(some, linear)]
        start, enough = near or self.short.get(name), self.judge.explained_chi2
        anew = near is None and not self.enough  # a second start is to find a cause
        most = TRIALS if self.enough else REFITS
        if (fit := refit(self.end, tried, start, enough, anew, most)) is None:
            return
        again = Again(name, tried, linear, fit)
        found = self.judge.fit(again, as_stated)
        if found.refitted:
            self.checks[name] = found

    def limit(self, some: Sequence[Variation]) -> None:
        """Leave out, where some suspects explain the misfit, those that gain much less: in short
        fits or, where there were none and the first end was too far off, or is too far from the
        first such fit, by what they can have of the effect at the end of that."""
        name = named(some)
        gain = self.gain(some)
        first = len(some) == 1 and some[0].kind in ("known", "sensor") and not self.enough
        if first and name in self.judge.ends and (self.far or self.left_behind(name)):
            gain = self.checks[name].gain
            if not self.short:
                self.add_alike(name)
        self.enough = max(self.enough, RIVAL * gain)
        self.queue.sort(key=self.gain, reverse=True)

    def left_behind(self, name: str) -> bool:
        """Whether estimates under a suspect, by its test to first order or by its new fit, are too
        far from the end of the first fit for tests to first order there."""
        return self.linear[name].far or abs(self.checks[name].shift[1]) > FIRST_ORDER

    def add_alike(self, name: str) -> None:
        """Gains of all suspects by what they can have of the effect of one that was tried; the
        queue with the likeliest of those that were left out of it."""
        self.say(f"effects of the others under another {name}")
        self.likened = True
        end, gain = self.judge.ends[name], self.checks[name].gain
        left = [one for one in self.tested if one.name not in self.tried]
        parts = likeness(end.fit, end.tried[0], left)
        self.gains |= {other: part * gain for other, part in parts.items()}
        queued = {one.name for some in self.queue for one in some}
        more = [one for one in left if one.name in parts.keys() - queued]
        more = sorted(more, key=lambda one: -self.gains[one.name])[:MOST]
        self.queue += [[one] for one in more]
        self.bar.total += len(more)

    def widened(self) -> bool:
        """Whether the queue has others, that act like the likeliest suspect tried: where that one
        explains most of the misfit, none has passed its tests, and effort is left."""
        names, late = self.explaining() or self.likeliest(), self.end.runner.work > self.most
        if late or self.likened or not names or any(self.checks[name].passed for name in names):
            return False
        one, *more = self.judge.ends[names[0]].tried
        most = MOSTLY * self.judge.misfit(self.judge.square)
        if not more and one.kind in ("known", "sensor") and self.checks[one.name].gain >= most:
            self.add_alike(one.name)
        return bool(self.queue)

    def explaining(self) -> list[str]:
        """Suspects whose new fits explain the misfit, the one that leaves least first."""
        names = [name for name in self.judge.ends if self.judge.nearly(self.checks[name])]
        return sorted(names, key=lambda name: self.checks[name].left)

    def finish(self, as_stated: Fit) -> None:
        """Continue new fits until they are at rest, the one that leaves least first: of suspects
        that explain the misfit about as well as that one does and, while none has passed its tests,
        of others that explain and passed them; where none explains it, of the likeliest alone."""
        checks, done = self.checks, list[str]()
        names = self.explaining() or self.likeliest()
        most = min((checks[name].left for name in names), default=0.0) + COMPARABLE
        for name in names:
            needed = checks[name].passed and not any(checks[one].passed for one in done)
            if checks[name].left <= most or needed:
                self.say(f"new fit with another {name}, by finer steps")
                checks[name] = self.judge.refined(self.judge.ends[name], as_stated)
                done.append(name)

    def likeliest(self) -> list[str]:
        """The suspect whose new fit gains most, if any may be the cause; those that pass their
        tests come first."""
        near = [name for name, one in self.judge.ends.items() if not far_off(one.fit)]
        left = [name for name in near if self.checks[name].suspected]
        return sorted(left, key=lambda k: (self.checks[k].passed, self.checks[k].gain))[-1:]


def named(some: Sequence[Variation]) -> str:
    """Name of suspects that are tried at once."""
    return " and ".join(one.name for one in some)


def alike(
    candidates: Sequence[Variation], together: Sequence[str], gains: Mapping[str, float]
) -> list[list[Variation]]:
    """The sensors whose faults explain the misfit `together`, with faults of one kind: of each kind
    that explains about as much of it alone, since to first order a lag is a delay."""
    some = [one for one in candidates if one.name in together]
    faults = {one.fault: one for one in candidates if one.fault is not None}
    if any(one.fault is None for one in some):
        return []
    out = list[list[Variation]]()
    for kind in dict.fromkeys(kind for _, kind in faults):
        pairs = [(one, faults.get((one.fault[0], kind))) for one in some if one.fault]
        if all(other and gains[other.name] > RIVAL * gains[one.name] for one, other in pairs):
            out.append([*{other.name: other for _, other in pairs if other}.values()])
    return out
