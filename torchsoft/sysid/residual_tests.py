"""Tests of the residuals of a fit, each with a p-value for the number of independent samples.

The residuals r (m,) are whitened with the assumed noise, J (m, n) is their Jacobian. With the right
model and noise they are independent and normal with variance one, but for the n fitted directions.
Tests are of one channel in one recording where possible:

    level     the sum of squares is chi-squared: residuals are as large as the stated noise
    white     Ljung and Box: no correlation is left from sample to sample
    motion    F: no correlation with the predicted reading, its rates, or other channels
    channels  Bartlett: no correlation between channels at one time
    onset     Mann and Whitney: residuals are not larger from a certain time on
    outliers  kurtosis (Anscombe and Glynn): tails are those of a normal distribution
    priors    normal: estimates are where their priors expect them

p-values are adjusted by Holm's method: with a right model, the probability that any falls below
`LEVEL` is at most `LEVEL`. Declared colour is not tested again. Undeclared colour is a finding,
although intervals allow for it: it may come from a sensor, or from a wrong model.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import CubicSpline
from scipy.sparse.linalg import spsolve_triangular
from scipy.special import ndtri_exp

from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Array
from torchsoft.sysid.sentences import Finding, Severity
from torchsoft.sysid.unknowns import Sensor

CLEAR = 4.0
"""Distance of a prediction from the end of a saturated sensor's range, in standard deviations of
the noise, at which its residual is normally distributed; a sample farther than this from its
prediction always counts."""

FEWEST = 4
"""Fewest remaining samples of a saturated sensor for a test."""

FAINT = 0.5
"""Residuals over the noise below which their pattern is not tested, since the noise is
overstated."""


class Part(NamedTuple):
    """Residuals of one channel in one recording, without samples changed by saturation: times t
    (m,) [s], their rows (m,) in r and J, the residuals `raw` (m,) over the stated noise, the
    predicted `reading` (m,) [unit], the estimated noise (None for white noise as stated), and the
    number of `saturated` samples."""

    recording: str
    channel: str
    t: Array
    rows: NDArray[np.int_]
    raw: Array
    reading: Array
    noise: Autoregression | None = None
    saturated: int = 0

    @property
    def faint(self) -> bool:
        """Whether the residuals are far smaller than the stated noise."""
        return float(np.mean(self.raw**2)) < FAINT**2

    def result(self, test: "Test", p: float, size: float, **facts: Any) -> "ResidualTest":
        """The result of a test of this part."""
        return ResidualTest(test, self.recording, self.channel, p, size, facts)


def parts(problem: Problem, r: Array, which: Sequence[str]) -> list[Part]:
    """The parts of residuals r of `Problem.residuals`, whitened by the problem's noise; none of a
    channel with fewer than `FEWEST` samples left by saturation.

    For a saturated sensor, samples are left out where the prediction is near the end of its range
    or beyond, saturated or not: the noise of the unsaturated ones there is not normal. Samples far
    from the prediction stay.
    """
    out, at = [], 0
    for recording, channel, sensor in problem.measured(which):
        t, measured = recording.samples[channel]
        rows, noise = at + np.arange(len(t)), problem.noise.get(channel)
        at += len(t)
        raw = r[rows] if noise is None else spsolve_triangular(noise.whitener(t), r[rows])
        reading = predicted(sensor, measured, raw)
        saturated = int(sensor.saturated(measured).sum())
        if saturated:
            ends = (reading + sign * CLEAR * sensor.sd for sign in (-1, 1))
            near = np.logical_or(*map(sensor.saturated, ends))
            kept = ~near | (np.abs(raw) > CLEAR)
            if kept.sum() < FEWEST:
                continue
            t, rows, raw, reading = t[kept], rows[kept], raw[kept], reading[kept]
        out.append(Part(recording.name, channel, t, rows, raw, reading, noise, saturated))
    return out


def predicted(sensor: Sensor, measured: Array, raw: Array) -> Array:
    """Noiseless readings (m,), from samples and residuals over the noise; infinite where a
    saturated sample has no residual."""
    y = measured + sensor.sd * raw
    for limit, sign in ((sensor.high, 1.0), (sensor.low, -1.0)):
        if limit is not None:
            at = sign * measured >= sign * limit
            y[at] = limit + sign * sensor.sd * ndtri_exp(-0.5 * raw[at] ** 2)
    return y


# Tests


LEVEL = 0.01
"""Probability of a false alarm in an identification with the right model and noise."""

LAGS = 20
"""Most autocorrelations in figures, and at most a quarter of the samples."""

TESTED = 10
"""Most autocorrelations in a test, and at most one in twenty samples: the sum of more is not yet
chi-squared in its tail, where alarms are."""

MEDIAN = 0.37
"""Efficiency of the level by the median residual, relative to the mean square."""

SUDDEN, BEFORE, BEYOND = 3.0, 2.0, 5.0
"""Least ratio of rms residuals after a time to those before it at which a misfit starts there,
largest rms residual before it, and the residual that shows it first, which one sample in a million
exceeds by chance; over the noise."""

TINY = 1e-300
"""What keeps quotients and logarithms of noise-free residuals finite."""

Test = Literal["level", "white", "motion", "channels", "onset", "outliers", "priors"]


class ResidualTest(NamedTuple):
    """Result of one test of one channel in one recording (None for all): its p-value, the size of
    the effect with further facts, and the p-value adjusted for all tests."""

    test: Test
    recording: str | None
    channel: str | None
    p: float
    size: float
    facts: Mapping[str, Any] = MappingProxyType({})
    adjusted: float = 1.0

    @property
    def alarming(self) -> bool:
        return self.adjusted < LEVEL

    @property
    def code(self) -> str:
        """Code of its finding."""
        if self.test != "level":
            return self.test
        return "larger" if self.size > 1 else "smaller"

    @property
    def case(self) -> dict[str, Any]:
        """Its facts as a case of a finding."""
        where = {"recording": self.recording, "channel": self.channel}
        return {name: one for name, one in where.items() if one} | {"size": self.size, **self.facts}


def systematic(tests: Sequence[ResidualTest]) -> list[ResidualTest]:
    """The alarms that a wrong model causes, the clearest first: residuals that are too large,
    coloured, follow the motion, or belong together."""
    kinds = ("larger", "white", "motion", "channels")
    return sorted((t for t in tests if t.alarming and t.code in kinds), key=lambda one: one.p)


def judge_residuals(
    parts: Sequence[Part], r: Array, J: Array, *, robust: bool = False, priors: Sequence[str] = ()
) -> list[ResidualTest]:
    """All tests of a fit's whitened residuals r (m,), with the Jacobian J (m, n) by the free
    coordinates; the last rows are those of the named `priors`.

    With a `robust` loss outliers are expected: the level is that of the median residual, and tails
    are not tested.
    """
    Q, R = np.linalg.qr(J)
    size = np.abs(np.diag(R))
    Q = Q[:, size > 1e-9 * max(size.max(initial=0.0), TINY)]
    out = levels(parts, r, Q, robust)
    for recording in dict.fromkeys(part.recording for part in parts):
        mine = [part for part in parts if part.recording == recording]
        started = onset(mine)
        out += started
        for part in (part for part in mine if not part.faint):
            out += [white(part, r), *follow_motion(part, mine, r, Q)]
            if not robust and not started:  # what follows are no outliers
                out.append(outliers(part, r))
        out += correlated_channels(recording, mine, r, Q)
    first = len(r) - len(priors)
    out += [contradicted(name, r[first + k], Q[first + k]) for k, name in enumerate(priors)]
    return holm(out)


def holm(tests: Sequence[ResidualTest]) -> list[ResidualTest]:
    """Tests with p-values adjusted by Holm's method, in the same order."""
    p, n = np.array([one.p for one in tests]), len(tests)
    order = np.argsort(p)
    adjusted = np.empty(n)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * (n - np.arange(n))), 1.0)
    return [one._replace(adjusted=float(a)) for one, a in zip(tests, adjusted)]


def two_sided(square: float, dof: float) -> float:
    """Two-sided p-value of a chi-squared sum."""
    return float(min(1.0, 2 * min(stats.chi2.sf(square, dof), stats.chi2.cdf(square, dof))))


def levels(parts: Sequence[Part], r: Array, Q: Array, robust: bool) -> list[ResidualTest]:
    """Tests of sums of squares against the stated noise: of every part, and of all together whose
    noise was not estimated.

    Where the noise's level was estimated from these residuals, the raw ones are tested, which are
    worth `Autoregression.effective` samples (Satterthwaite).
    """
    out, squares, dofs = list[ResidualTest](), list[float](), list[float]()
    for part in parts:
        rows = r[part.rows] if part.noise is None else part.raw
        n = len(rows)
        free = max(1.0 - float(np.sum(Q[part.rows] ** 2)) / n, 1 / n)  # what the fit left of them
        mean, worth = float(rows @ rows) / n, float(n)
        if robust:
            mean = (float(np.median(np.abs(rows))) / float(stats.norm.ppf(0.75))) ** 2
            worth = MEDIAN * n
        if part.noise is not None:
            worth *= part.noise.effective(n) / n
        dof = worth * free
        out.append(part.result("level", two_sided(mean * worth, dof), float((mean / free) ** 0.5)))
        if part.noise is None:
            squares.append(mean * worth)
            dofs.append(dof)
    if len(dofs) > 1:
        square, dof = sum(squares), sum(dofs)
        facts = {"samples": dof}
        p = two_sided(square, dof)
        out.append(ResidualTest("level", None, None, p, (square / dof) ** 0.5, facts))
    return out


def autocorrelation(r: Array) -> Array:
    """Autocorrelation of residuals r (m,) at lags 1, 2, ..., up to `LAGS` and a quarter of the
    samples."""
    c = r - r.mean()
    power = max(float(c @ c), TINY)
    return np.array([c[k:] @ c[:-k] / power for k in range(1, min(LAGS, len(r) // 4) + 1)])


def whiteness(r: Array, coefficients: int = 0) -> tuple[float, float]:
    """First autocorrelation and Ljung-Box p-value of one channel's residuals (m,), after a fit of
    `coefficients`."""
    rho, m = autocorrelation(r), len(r)
    lags = min(max(TESTED, coefficients + 3), m // 20)
    if not rho.any() or lags <= coefficients:
        return float(rho[0]) if len(rho) else 0.0, 1.0
    Q = m * (m + 2) * float((rho[:lags] ** 2 / (m - np.arange(1, lags + 1))).sum())
    return float(rho[0]), float(stats.chi2.sf(Q, lags - coefficients))


def white(part: Part, r: Array) -> ResidualTest:
    """Test of whiteness of the whitened residuals."""
    rho, p = whiteness(r[part.rows], part.noise.order if part.noise is not None else 0)
    return part.result("white", p, rho)


def explained(part: Part, Z: Array, r: Array, Q: Array) -> tuple[float, float, Array]:
    """F test of residuals against Z (m, k), signals at the samples of a part: the p-value of
    fitting them besides the unknowns, relative to the variance of the part, the share of that
    variance that they explain, and the signed effect of each alone (k,)."""
    size, columns = np.linalg.norm(Z, axis=0), np.zeros((len(r), Z.shape[1]))
    Z = Z / np.where(size > 0, size, 1.0)
    columns[part.rows] = Z if part.noise is None else part.noise.whitener(part.t) @ Z
    before = np.linalg.norm(columns, axis=0)
    columns -= Q @ (Q.T @ columns)  # what the unknowns could not have explained themselves
    after = np.linalg.norm(columns, axis=0)
    new = after > 1e-3 * np.where(before > 0, before, np.inf)
    unit = columns[:, new] / after[new]
    U, s, _ = np.linalg.svd(unit, full_matrices=False)
    U, own = U[:, s > 1e-3], float(np.sum(r[part.rows] ** 2))
    k, taken, alone = U.shape[1], float(np.sum((U.T @ r) ** 2)), np.zeros(Z.shape[1])
    left = len(part.t) - float(np.sum(Q[part.rows] ** 2)) - k
    if k == 0 or left < 1:
        return 1.0, 0.0, alone
    alone[new] = unit.T @ r
    p = float(stats.f.sf((taken / k) / max((own - taken) / left, TINY), k, left))
    return p, min(taken / max(own, TINY), 1.0), alone


def follow_motion(part: Part, beside: Sequence[Part], r: Array, Q: Array) -> list[ResidualTest]:
    """Tests of correlation with the predicted reading, as a wrong sensor would cause it, and with
    other channels and their rates, as a wrong law would."""
    out, t = [], part.t
    y = CubicSpline(t, part.reading)
    own = {
        "an offset": np.ones(len(t)),
        "a drift": t - t.mean(),
        "the reading itself, as an error of its gain would be": y(t),
        "its rate, as a delay would be": y(t, 1),
        "its acceleration": y(t, 2),
    }
    others = dict[str, Array]()
    for one in beside:
        covers = one.t[0] <= t[0] + 0.05 and one.t[-1] >= t[-1] - 0.05
        if one.channel != part.channel and covers:
            s = CubicSpline(one.t, one.reading)
            for order, of in enumerate(("", "the rate of ", "the acceleration of ")):
                others[f"{of}{one.channel}"] = s(t, order)
    for signals in (own, others):
        if signals and len(t) >= 4 * len(signals):
            p, share, alone = explained(part, np.stack([*signals.values()], 1), r, Q)
            like = [*signals][int(np.argmax(np.abs(alone)))]
            out.append(part.result("motion", p, share, like=like))
    return out


def largest_change(part: Part) -> ResidualTest:
    """The change of the variance of the raw residuals with the largest likelihood, with at least
    `LAGS` samples on either side, tested by ranks, so that single outliers do not count."""
    m, squares, size = len(part.raw), np.cumsum(part.raw**2), np.abs(part.raw)
    if m < 2 * LAGS:
        return part.result("onset", 1.0, 0.0)
    k = np.arange(LAGS, m - LAGS + 1)
    before, after = squares[k - 1] / k, (squares[-1] - squares[k - 1]) / (m - k)
    i = int(np.argmin(k * np.log(before + TINY) + (m - k) * np.log(after + TINY)))
    rank = stats.mannwhitneyu(size[: k[i]], size[k[i] :], alternative="less")
    facts = {"time": float(part.t[k[i]]), "before": float(before[i]) ** 0.5}
    p = min(1.0, len(k) * float(rank.pvalue))
    return part.result("onset", p, float(after[i]) ** 0.5, **facts)


def onset(mine: Sequence[Part]) -> list[ResidualTest]:
    """Test of a misfit that starts at a certain time, of the parts of one recording; empty where
    none does. It starts with the first residual beyond `BEYOND` in any channel that fits until
    then."""
    changes = [
        one
        for one in map(largest_change, mine)
        if one.p < LEVEL
        and one.facts["before"] < BEFORE
        and one.size > SUDDEN * max(one.facts["before"], 1.0)
    ]
    if not changes:
        return []
    clear = min(changes, key=lambda one: (one.p, one.facts["time"]))
    first = [(clear.facts["time"], clear.channel or "", clear.size)]
    for part in mine:
        for i in np.flatnonzero(np.abs(part.raw) > BEYOND)[:1]:
            if np.sum(part.raw[:i] ** 2) < BEFORE**2 * i:
                first.append((float(part.t[i]), part.channel, float(np.abs(part.raw[i]))))
    time, channel, size = min(first)
    facts = {"time": time, "first": channel, "off": size}
    return [clear._replace(facts={**clear.facts, **facts})]


def outliers(part: Part, r: Array) -> ResidualTest:
    """Test of heavy tails (Anscombe and Glynn)."""
    rows = r[part.rows]
    if len(rows) < LAGS or np.ptp(rows) == 0:
        return part.result("outliers", 1.0, 0.0)
    at = int(np.argmax(np.abs(rows)))
    tails = float(stats.kurtosistest(rows, alternative="greater").pvalue)
    return part.result("outliers", tails, abs(float(rows[at])), time=float(part.t[at]))


def correlated_channels(
    recording: str, parts: Sequence[Part], r: Array, Q: Array
) -> list[ResidualTest]:
    """Test of correlation between channels sampled at the same times (Bartlett)."""
    longest = max((p.t for p in parts), key=len)
    alike = [p for p in parts if np.array_equal(p.t, longest) and not p.faint]
    k = len(alike)
    if k < 2:
        return []
    rows = np.stack([r[p.rows] for p in alike])
    n = rows.shape[1] - sum(float(np.sum(Q[p.rows] ** 2)) for p in alike) / k
    if n < 4 * k or (rows.std(1) == 0).any():
        return []
    C = np.atleast_2d(np.corrcoef(rows))
    square = -(n - 1 - (2 * k + 5) / 6) * float(np.linalg.slogdet(C)[1])
    i, j = np.unravel_index(int(np.argmax(np.abs(np.triu(C, 1)))), C.shape)
    facts = {"channels": f"{alike[i].channel} and {alike[j].channel}"}
    p = float(stats.chi2.sf(square, k * (k - 1) / 2))
    return [ResidualTest("channels", recording, None, p, float(C[i, j]), facts)]


def contradicted(name: str, r: float, q: Array) -> ResidualTest:
    """Test of the residual r of a prior, whose row of Q is q (n,)."""
    free = max(1.0 - float(q @ q), 0.0)
    z = abs(float(r)) / free**0.5 if free > 1e-9 else 0.0  # without data it is where the prior is
    return ResidualTest("priors", None, None, 2 * float(stats.norm.sf(z)), z, {"prior": name})


def residual_findings(
    tests: Sequence[ResidualTest], widened: float = 1.0, severity: Severity = "warning"
) -> list[Finding]:
    """A finding for each kind of alarm, with its cases, the clearest first. `severity` is that of
    what a wrong model causes; `widened` [1] is the factor on intervals for residuals that are too
    large."""
    out, model = list[Finding](), [one.code for one in systematic(tests)]
    order = sorted((one for one in tests if one.alarming), key=lambda t: (t.recording is None, t.p))
    for code in ("onset", "larger", "smaller", "white", "motion", "channels", "outliers", "priors"):
        if cases := [one.case for one in order if one.code == code]:
            facts: dict[str, Any] = {"cases": cases}
            if code == "larger" and widened >= 1.005:
                facts["widened"] = widened
            usual: Severity = "note" if code == "smaller" else "warning"
            out.append(Finding(code, severity if code in model else usual, facts))
    return out
