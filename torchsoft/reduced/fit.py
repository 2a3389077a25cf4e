"""Sparse reduced models from records, with pysindy: regressions, fits, rollouts against records,
the choice of thresholds.

Records come from `records`, candidate terms from `terms`, the model is `ode.ReducedModel`. Nothing
here uses the simulator: records are data. pysindy takes seconds to import, so it is imported where
it is used.
"""

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from torchsoft.caller import warn
from torchsoft.display import Shown, amount
from torchsoft.extras import needed
from torchsoft.reduced.ode import UNITS, ReducedModel, Rollout, Term
from torchsoft.reduced.records import KINEMATICS, STATES, Record
from torchsoft.reduced.terms import Candidates

GROSS = 1.0
"""Root mean square error of a rollout, in standard deviations of the record, above which the model
is useless: a constant would do as well."""

LAW_OFF = 0.3
"""Root mean square error of a control law's effort, in standard deviations of the record's, above
which the record has another law."""

MASS_OFF = 0.1
"""Relative error of the coefficient of F_x above which it is not 1 / m."""

ROWS_PER_TERM = 10
"""Fewest rows of a regression per candidate term."""

DEPENDENT = 1e-9
"""Least part of a scaled column that the other columns leave unexplained."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a fit. `threshold` is the smallest part of a rate's root mean square for which a
    term may account.

    Rows are integrals against test functions of half-width `width` [s], `domains` in each window of
    `window` [s]. `models` is the number of ensemble members, 0 for none. Coefficients of an
    ensemble are medians; their intervals are the 5th and 95th percentiles, the spread over the
    choice of overlapping rows, and not the error of the equation's form.
    """

    threshold: float = 0.02
    models: int = 0
    width: float = 0.015
    window: float = 0.5
    domains: int = 60
    seed: int = 0


SAMPLED = 4
"""Samples in half of a test function of the weak form at the least."""


@dataclass(frozen=True, repr=False)
class Regression:
    """The scaled regression of one equation: columns (rows, terms) and rate (rows,) of unit root
    mean square, and their original sizes."""

    terms: list[Term]
    columns: np.ndarray
    rate: np.ndarray
    column_size: np.ndarray
    rate_size: float


@dataclass(frozen=True, repr=False)
class Problem(Shown):
    """The regressions of all equations, shared by all thresholds, and their records."""

    regressions: dict[str, Regression]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    scale: np.ndarray
    records: tuple[Record, ...]

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        return f"Problem: {len(self.records)} records, inputs {', '.join(self.inputs)}", [
            (f"{target}'", f"{len(one.rate)} rows, {len(one.terms)} candidate terms")
            for target, one in self.regressions.items()
        ]


def assemble(
    records: Sequence[Record],
    candidates: Candidates,
    recipe: Recipe,
    *,
    inputs: Sequence[str] = ("F_x",),
) -> Problem:
    """Columns and rates of the records in weak form.

    States without candidates are rates of none: with inputs ("x_Br", "v_Br") and candidates for v_C
    and omega, the bracket drives. Raises `ValueError` for records of different steps, values that
    are not finite, constant columns, columns that the others already span, and too few rows, naming
    the column.
    """
    states = tuple(name for name in STATES if name not in inputs)
    steps = [one.step for one in records]
    if not steps:
        raise ValueError("there are no records to fit: give one at least, as `record(run)`")
    if max(steps) > min(steps) * (1 + 1e-6):
        raise ValueError(f"the records must have one time step, but have {sorted(set(steps))} s")
    names, kinematics = (*states, *inputs), {k: v for k, v in KINEMATICS.items() if k in states}
    every = {target: [(term, 1.0) for term in terms] for target, terms in candidates.items()}
    model = ReducedModel(states, inputs, kinematics, every)
    data = [one.columns(names) for one in records]
    for one in data:
        broken = ~np.isfinite(one).all(0)
        if broken.any():
            raise ValueError(
                f"series {names[int(broken.argmax())]!r} has values that are not finite"
            )
    targets = list(candidates)
    columns = [model.phi(one) for one in data]
    velocities = [one[:, [names.index(target) for target in targets]] for one in data]
    for i, (target, term) in enumerate(zip(model.targets, model.terms)):
        values = np.concatenate([column[:, i] for column in columns])
        if np.ptp(values) <= 1e-12 * np.abs(values).max():
            raise ValueError(
                f"column `{term.text}` of {target}' is constant ({values[0]:g}); leave it out, or "
                "excite it"
            )
    phi, rate = _weak(columns, velocities, steps[0], recipe)
    out = {}
    for j, target in enumerate(targets):
        mine = [i for i, name in enumerate(model.targets) if name == target]
        terms = [model.terms[i] for i in mine]
        if len(phi) < ROWS_PER_TERM * len(mine):
            raise ValueError(
                f"too little data for {target}': {len(phi)} rows for {len(mine)} candidate terms, "
                f"the last of which is `{terms[-1].text}`; at least {ROWS_PER_TERM} rows a term "
                "are needed"
            )
        size, rate_size = (
            np.sqrt((phi[:, mine] ** 2).mean(0)),
            float(np.sqrt((rate[:, j] ** 2).mean())),
        )
        scaled = phi[:, mine] / size
        pivoted: Any = scipy.linalg.qr(scaled, mode="economic", pivoting=True)
        _, R, order = pivoted
        if abs(R[-1, -1]) < DEPENDENT * abs(R[0, 0]):
            raise ValueError(
                f"column `{terms[order[-1]].text}` of {target}' is a combination of the other "
                "columns in these data; leave it out, or excite the system more richly"
            )
        out[target] = Regression(terms, scaled, rate[:, j] / rate_size, size, rate_size)
    scale = np.max([np.abs(one[:, : len(states)]).max(0) for one in data], axis=0)
    return Problem(out, states, tuple(inputs), scale, tuple(records))


class Equation(NamedTuple):
    """(term, coefficient) pairs of one rate in SI units, and intervals of the coefficients from an
    ensemble."""

    pairs: list[tuple[Term, float]]
    intervals: list[tuple[float, float]]


def solve(problem: Problem, target: str, recipe: Recipe) -> Equation:
    """The sparse equation of one state at the recipe's threshold, without terms whose coefficient
    is zero."""
    rows, optimizer = problem.regressions[target], _optimizer(recipe)
    with _quiet_pysindy(recipe.seed):
        optimizer.fit(rows.columns, rows.rate[:, None])
    unit = rows.rate_size / rows.column_size
    values, intervals = np.asarray(optimizer.coef_).ravel() * unit, []
    kept = np.flatnonzero(values)
    if recipe.models:
        members = np.array([np.ravel(member) for member in optimizer.coef_list]) * unit
        low, high = np.percentile(members, (5, 95), axis=0)
        intervals = [(float(low[i]), float(high[i])) for i in kept]
    return Equation([(rows.terms[i], float(values[i])) for i in kept], intervals)


def build(
    problem: Problem,
    equations: Mapping[str, Equation],
    feedback: Mapping[str, Mapping[str, float]] | None = None,
) -> ReducedModel:
    """The model with these equations, one for each velocity."""
    intervals = [interval for equation in equations.values() for interval in equation.intervals]
    return ReducedModel(
        problem.states, problem.inputs,
        {k: v for k, v in KINEMATICS.items() if k in problem.states},
        {target: equation.pairs for target, equation in equations.items()}, feedback=feedback,
        scale=problem.scale, intervals=intervals or None,
    )  # fmt: skip


def fit(
    problem: Problem, recipe: Recipe, feedback: Mapping[str, Mapping[str, float]] | None = None
) -> ReducedModel:
    """The sparse model of a problem at the recipe's threshold.

    Warns where a rollout of the model diverges or misses a record of the problem by more than
    `GROSS` standard deviations, where `feedback` is not the law of the record's effort, and where
    coefficients contradict mechanics.
    """
    model = build(
        problem,
        {target: solve(problem, target, recipe) for target in problem.regressions},
        feedback,
    )
    scores = [score(model, one) for one in problem.records]
    if not _warn_of_misses(model, problem.records, scores):
        _warn_of_mechanics(model, problem.records)
    return model


def loop(records: Sequence[Record]) -> dict[str, dict[str, float]]:
    """The PD law of F_x, by least squares over records, on the coordinate that it follows best, in
    the form of `feedback` of `fit`. Raises `ValueError` where F_x is no PD law of x_d."""
    best: tuple[float, dict[str, float]] = np.inf, {}
    (F,) = np.concatenate([one.columns(["F_x"]) for one in records]).T
    for x, v in (("x_C", "v_C"), ("x_Br", "v_Br")):
        x_d, own, rate_d, rate = np.concatenate(
            [one.columns(["x_d", x, "x_d_dot", v]) for one in records]
        ).T
        errors = np.column_stack((x_d - own, rate_d - rate))
        (K, D), *_ = np.linalg.lstsq(errors, F, rcond=None)
        left = float(np.sqrt(np.mean((F - errors @ (K, D)) ** 2)))
        if left < best[0]:
            best = left, {"x_d": float(K), "x_d_dot": float(D), x: -float(K), v: -float(D)}
    if best[0] > LAW_OFF * F.std():
        raise ValueError(
            f"F_x is no PD law of x_d: {amount(best[0], 'N')} of {amount(float(F.std()), 'N')} are "
            "left; give `feedback` to `fit`"
        )
    return {"F_x": best[1]}


@dataclass(frozen=True, repr=False)
class Score(Shown):
    """A rollout against its record: root mean square error by state, over the record's range and
    over its standard deviation; infinite where it diverged."""

    nrmse: dict[str, float]
    over_deviation: dict[str, float]
    rollout: Rollout

    def shown(self) -> tuple[str, list[tuple[str, str]]]:
        if self.rollout.diverged_at is not None:
            return f"Score: the rollout {self.rollout}", []
        return f"Score: error at most {100 * self.worst:.3g} % of the range", [
            (name, f"{100 * error:.3g} % of the range, {self.over_deviation[name]:.3g} deviations")
            for name, error in self.nrmse.items()
        ]

    @property
    def worst(self) -> float:
        return max(self.nrmse.values())


def rollout_of(model: ReducedModel, on: Record) -> Rollout:
    """Rollout of the model from the record's first sample, with the record's inputs."""
    inputs, states = (
        on.columns(model.outer) if model.outer else np.empty((len(on.t), 0)),
        on.columns(model.states),
    )
    return model.rollout(on.t, states[0], inputs, scale=np.abs(states).max(0))


def score(model: ReducedModel, on: Record) -> Score:
    """Rollout error over the whole record, for each state."""
    out, exact = rollout_of(model, on), on.columns(model.states)
    error = np.sqrt(((out.y - exact) ** 2).mean(0))
    error = np.where(np.isfinite(error), error, np.inf)
    over_range, over_deviation = (
        dict(zip(model.states, (error / size).tolist()))
        for size in (np.ptp(exact, axis=0), exact.std(0))
    )
    return Score(over_range, over_deviation, out)


def _warn_of_misses(
    model: ReducedModel, records: Sequence[Record], scores: Sequence[Score]
) -> bool:
    """Warn of the record with the worst rollout, with the remedy, if it is a gross miss or has
    another control law. Returns whether it does."""
    misses = [max(one.over_deviation.values()) for one in scores]
    i = int(np.argmax(misses))
    on, out = records[i], scores[i]
    state = max(out.over_deviation, key=out.over_deviation.__getitem__)
    miss = (
        f"misses it: the error of {state} is {misses[i]:.3g} of its standard deviations"
        if out.rollout.diverged_at is None
        else str(out.rollout)
    )
    wrong = []
    for name, law in model.feedback.items():
        if name in on.series:
            error = on.columns(list(law)) @ list(law.values()) - on.series[name]
            if np.sqrt((error**2).mean()) > LAW_OFF * on.series[name].std():
                wrong.append(
                    f"{name} off by {amount(float(np.abs(error).max()), UNITS.get(name, name))}"
                )
    if misses[i] <= GROSS and not wrong:
        return False
    if "F_x" in model.outer:
        remedy = (
            "give `feedback`, the law that makes F_x: under a recorded F_x nothing holds the "
            "position, and it drifts"
        )
    elif wrong:
        remedy = (
            f"its `feedback` makes {', '.join(wrong)}: give the gains of the rig, on the "
            "coordinate that its loop measures, and count x_d from where this one starts"
        )
    else:
        remedy = (
            "take small taps of a settled grasp, sampled every 0.25 ms, that begin at rest, and "
            f"no coarse samples of a large motion; here a sample is {1e3 * on.step:.3g} ms"
        )
    warn(
        f"the reduced model is not to be trusted: rolled out on record {i}, it {miss}; {remedy}",
    )
    return True


def contradictions(model: ReducedModel, records: Sequence[Record]) -> list[str]:
    """Coefficients that no rig of springs and dashpots has: that of F_x is 1 / m of the bracket, a
    slip of a body's own acts against it, a dashpot has the sign of its spring. A linear term beside
    a friction of the same slip is part of that friction's curve, and none of these."""
    out, found = list[str](), dict[tuple[str, tuple[tuple[str, float], ...]], tuple[str, float]]()
    masses = [one.mass for one in records if one.mass is not None]
    rates = {rate: name for name, rate in KINEMATICS.items()}
    curved = {
        (target, tuple(factor.form.items()))
        for target, term in zip(model.targets, model.terms)
        for factor in term.factors if not term.linear
    }  # fmt: skip
    for target, term, value in zip(model.targets, model.terms, model.coefficients.tolist()):
        form = dict(term.factors[0].form) if term.linear else {}
        if form.keys() == {"F_x"} and target == "v_Br" and masses:
            right = 1 / float(np.mean(masses))
            if abs(value / right - 1) > MASS_OFF:
                out.append(f"{value:.3g} F_x in v_Br', where 1 / m is {right:.3g}")
        if len(form) < 2 or (target, tuple(form.items())) in curved:
            continue
        spring = form.keys() <= rates.keys() and {rates[name]: x for name, x in form.items()}
        place = spring or form
        if value * place.get(rates[target], 0.0) > 0:
            out.append(f"{value:.3g} ({term.text}) in {target}' drives the motion")
        other, its = found.setdefault((target, tuple(place.items())), (term.text, value))
        if its * value < 0:
            out.append(f"({other}) and ({term.text}) in {target}' have opposite signs")
    return out


def _warn_of_mechanics(model: ReducedModel, records: Sequence[Record]) -> None:
    if wrong := contradictions(model, records):
        warn(
            f"the reduced model contradicts mechanics: {'; '.join(wrong)}. Its coefficients are "
            "not those of the rig, although it may predict well: kick disc and bracket at the "
            "start of the taps, sample them every 0.25 ms, and keep them to some micrometres",
        )


@dataclass(frozen=True)
class Choice:
    """The chosen model, its index among those tried, and the results of each: thresholds, number of
    terms, NRMSE, diverged rollouts."""

    model: ReducedModel
    index: int
    tried: list[dict[str, Any]] = field(repr=False)


def choose(
    problem: Problem, validation: Sequence[Record], recipe: Recipe, thresholds: Sequence[float],
    feedback: Mapping[str, Mapping[str, float]] | None = None, *, slack: float = 1.1,
) -> Choice:  # fmt: skip
    """The fit with the fewest terms among those whose rollouts of the validation records come
    within `slack` of the best.

    Every equation has its own threshold: all combinations that differ in their terms are rolled
    out. The error of a combination is the mean over the records of the states' worst NRMSE. Warns
    as `fit` does, of the validation records. Raises `ValueError`, with the time, when all rollouts
    diverge.
    """
    fits: dict[str, dict[tuple[str, ...], tuple[float, Equation]]] = {
        target: {} for target in problem.regressions
    }
    for threshold in thresholds:
        for target, found in fits.items():
            equation = solve(problem, target, replace(recipe, threshold=threshold))
            terms = tuple(term.text for term, _ in equation.pairs)
            found.setdefault(terms, (threshold, equation))
    options = [dict(zip(fits, chosen)) for chosen in product(*(x.values() for x in fits.values()))]
    scale = np.max(
        [problem.scale, *(np.abs(one.columns(problem.states)).max(0) for one in validation)], axis=0
    )
    problem, tried, models, every, last = replace(problem, scale=scale), [], [], [], ""
    for option in options:
        model = build(
            problem, {target: equation for target, (_, equation) in option.items()}, feedback
        )
        scores = [score(model, one) for one in validation]
        diverged = [str(one.rollout) for one in scores if one.rollout.diverged_at is not None]
        last = diverged[0] if diverged else last
        models.append(model)
        every.append(scores)
        tried.append({
            "thresholds": {target: float(threshold) for target, (threshold, _) in option.items()},
            "terms": len(model.terms), "nrmse": float(np.mean([one.worst for one in scores])),
            "diverged": diverged,
        })  # fmt: skip
    best = min(row["nrmse"] for row in tried)
    if not np.isfinite(best):
        raise ValueError(
            f"no threshold gives a model whose rollouts stay bounded: the last one {last}"
        )
    good = [i for i, row in enumerate(tried) if row["nrmse"] <= slack * best]
    chosen = min(good, key=lambda i: (tried[i]["terms"], tried[i]["nrmse"]))
    if not _warn_of_misses(models[chosen], validation, every[chosen]):
        _warn_of_mechanics(models[chosen], problem.records)
    return Choice(models[chosen], chosen, tried)


def _weak(
    columns: list[np.ndarray], velocities: list[np.ndarray], step: float, recipe: Recipe
) -> tuple[np.ndarray, np.ndarray]:
    """Integrals of columns and rates against pysindy's test functions, over windows of equal
    length."""
    pysindy = needed("pysindy", "reduced")
    length = min(round(recipe.window / step) + 1, *(len(one) for one in columns))
    if recipe.width < SAMPLED * step:
        raise ValueError(
            f"a sample every {1e3 * step:g} ms is too seldom for the weak form's test functions, "
            f"{1e3 * recipe.width:g} ms to each side; sample every "
            f"{1e3 * recipe.width / SAMPLED:g} ms or faster, or take a larger `width`"
        )
    if 2 * recipe.width > 0.9 * (length - 1) * step:
        raise ValueError(
            f"too little data: the shortest record is {length} samples, {(length - 1) * step:g} s, "
            f"shorter than the weak form's test functions, {2 * recipe.width:g} s"
        )
    axes: Any = {"ax_time": 0, "ax_coord": 1}

    def windows(series: list[np.ndarray]) -> list[Any]:
        starts = [(one, i) for one in series for i in range(0, len(one) - length + 1, length - 1)]
        return [pysindy.AxesArray(one[i : i + length], axes) for one, i in starts]

    with _quiet_pysindy(recipe.seed):
        library = pysindy.WeakPDELibrary(
            function_library=pysindy.IdentityLibrary(),
            spatiotemporal_grid=step * np.arange(length), K=recipe.domains, H_xt=[recipe.width],
            p=4,
        )  # fmt: skip
        phi = library.fit_transform(windows(columns))
        rates = [library.convert_u_dot_integral(one) for one in windows(velocities)]
    return np.concatenate([np.asarray(x) for x in phi]), np.concatenate(
        [np.asarray(x) for x in rates]
    )


def _optimizer(recipe: Recipe) -> Any:
    pysindy = needed("pysindy", "reduced")
    one: Any = pysindy.STLSQ(threshold=recipe.threshold, alpha=1e-10)
    return (
        pysindy.EnsembleOptimizer(one, bagging=True, n_models=recipe.models)
        if recipe.models
        else one
    )


@contextlib.contextmanager
def _quiet_pysindy(seed: int) -> Iterator[None]:
    """Seed numpy's global generator, from which pysindy draws, and restore it; silence pysindy's
    warnings."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="pysindy")
            yield
    finally:
        np.random.set_state(before)  # noqa: NPY002
