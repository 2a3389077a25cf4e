"""Reduced models: known equations recovered, all routes through one list of terms equal, divergence
and bad data reported."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import coarse, press, times
from scipy.integrate import solve_ivp
from torchdiffeq import odeint

from torchsoft import Profile, Reference, simulate
from torchsoft.cli import main
from torchsoft.reduced import (
    Recipe,
    Record,
    ReducedModel,
    assemble,
    choose,
    fit,
    friction,
    joined,
    loop,
    mechanics,
    record,
    rolling_radius,
    score,
)
from torchsoft.reduced.fit import contradictions
from torchsoft.reduced.ode import BEYOND, Factor, Held, Term
from torchsoft.reduced.records import KINEMATICS, STATES
from torchsoft.reduced.terms import variable
from torchsoft.rigs import RigFile
from torchsoft.rigs.written import template
from torchsoft.solve.trajectory import Trajectory

R = 0.0183
TRUTH = {
    "v_C": {"x_Br - 2 x_C": 1.15e5, "v_Br - 2 v_C": 1.1e3},
    "omega": {"x_Br + 2 r theta": -1.1e7, "v_Br + 2 r omega": -1.05e5, "omega": -370.0},
    "v_Br": {"x_Br - x_C + r theta": -1.15e5, "v_Br - v_C + r omega": -1.1e3, "F_x": 2.46},
}
LAW = {"F_x": {"x_d": 1.2e5, "x_d_dot": 441.7, "x_C": -1.2e5, "v_C": -441.7}}
AWAY = {"F_x": {name: -gain for name, gain in LAW["F_x"].items()}}
SCALE = np.array([1e-3, 5e-2, 2e-3, 5e-2, 3.0, 0.1])
RECIPE = Recipe(width=0.004, window=0.3, threshold=0.01)
LIBRARY = mechanics(R)


def truth(*extra: tuple[Term, float]) -> ReducedModel:
    """The sticking grasp's equations with known coefficients, and further terms of v_C'."""
    equations = {
        target: [(term, TRUTH[target][term.text]) for term in terms if term.text in TRUTH[target]]
        for target, terms in LIBRARY.items()
    }
    equations["v_C"] = [*equations["v_C"], *extra]
    return ReducedModel(STATES, ("F_x",), KINEMATICS, equations, feedback=LAW, scale=SCALE)


def motion(model: ReducedModel, seed: int, duration: float = 0.3) -> Record:
    """A record of the model, kicked and driven by eight sines."""
    rng, t = np.random.default_rng(seed), np.linspace(0.0, duration, round(duration / 1e-4) + 1)
    f, phase = np.geomspace(3, 150, 8) * rng.uniform(0.9, 1.1, 8), rng.uniform(0, 6, 8)
    x_d = 3e-6 * np.sin(2 * np.pi * f * t[:, None] + phase).sum(1)
    u = np.column_stack((x_d, np.gradient(x_d, t)))
    y0 = np.concatenate((np.zeros(3), 2e-3 * rng.standard_normal(3) / (1, R, 1)))
    y = model.rollout(t, y0, u).y
    series = dict(zip(STATES, y.T)) | {"x_d": u[:, 0], "x_d_dot": u[:, 1]}
    series["F_x"] = sum(gain * series[name] for name, gain in LAW["F_x"].items())
    return Record(t, series)


@pytest.fixture(scope="module")
def motions():
    return [motion(truth(), seed) for seed in range(6)]


def changed(one: Record, **series: np.ndarray) -> Record:
    return replace(one, series=one.series | series)


# fits
# ----------------------------------------------------------------------


@pytest.mark.parametrize("saturating", [False, True])
def test_known_equations_are_recovered(motions, saturating):
    """Exactly the true terms, their coefficients to a few per cent; tanh(s' / v) with v known."""
    upper, wanted, library, recipe = friction(R, 1e-3)["v_C"][1], TRUTH, LIBRARY, RECIPE
    if saturating:
        motions = [motion(truth((upper, 3.0)), seed, 0.15) for seed in range(2)]
        wanted = {"v_C": TRUTH["v_C"] | {upper.text: 3.0}}
        library = joined(library, {"v_C": [upper]})
        recipe = replace(RECIPE, threshold=0.02, window=0.15)
    model = fit(assemble(motions, library, recipe), recipe)
    for target, terms in wanted.items():
        found = {term.text: x for term, x in model.equations()[target]}
        assert found == pytest.approx(terms, rel=0.05)


def test_the_choice_takes_the_true_terms_and_rolls_out(motions):
    problem, other = assemble(motions, LIBRARY, RECIPE), motion(truth(), 50)
    choice = choose(problem, [other], RECIPE, (1e-4, 0.01, 0.9), LAW)
    assert len(choice.model.terms) == 8
    assert choice.tried[choice.index]["nrmse"] < 5e-3
    assert score(choice.model, motion(truth(), 51)).worst < 5e-3
    assert max(row["nrmse"] for row in choice.tried) > 0.05  # thresholds matter
    with pytest.raises(ValueError, match=r"rollouts stay bounded.*diverged at t = 0\.\d+ s"):
        choose(problem, [other], RECIPE, (0.01,), AWAY)


def test_the_bracket_may_be_the_input(motions):
    """With the bracket's motion as u only the disc has equations."""
    library = {k: v for k, v in LIBRARY.items() if k != "v_Br"}
    model = fit(assemble(motions, library, RECIPE, inputs=("x_Br", "v_Br")), RECIPE)
    assert model.states == ("x_C", "theta", "v_C", "omega")
    assert score(model, motion(truth(), 60)).worst < 1e-2


def test_ensembles_give_intervals_and_leave_the_global_generator(motions):
    rng = np.random.default_rng(0)
    noisy = lambda x: x + 0.005 * x.std() * rng.standard_normal(len(x))
    rough = [changed(one, **{k: noisy(x) for k, x in one.series.items()}) for one in motions]
    recipe, before = replace(RECIPE, models=20, threshold=0.05), np.random.get_state()[1].copy()  # noqa: NPY002
    one, other = (fit(assemble(rough, LIBRARY, recipe), recipe) for _ in range(2))
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    assert one.intervals == other.intervals
    rows = one.coefficient_table()
    assert all(row["interval"][0] < row["value"] < row["interval"][1] for row in rows)
    assert rows[0]["unit"] == "m/s/s per m"


def test_the_law_of_the_loop_is_found(motions):
    assert loop(motions)["F_x"] == pytest.approx(LAW["F_x"], rel=1e-6)
    shaken = changed(motions[0], F_x=np.random.default_rng(0).standard_normal(3001))
    with pytest.raises(ValueError, match=r"F_x is no PD law of x_d: .* N of .* N are left"):
        loop([shaken])


def test_a_fit_that_misses_its_record_warns_why(motions):
    """A law on the wrong coordinate, one that drives, no law at all; coarse samples."""
    problem, other = assemble(motions, LIBRARY, RECIPE), {"x_C": "x_Br", "v_C": "v_Br"}
    law = {"F_x": {other.get(name, name): gain for name, gain in LAW["F_x"].items()}}
    for feedback, recipe, message in (
        (law, RECIPE, r"`feedback` makes F_x off by .* N: give the gains"),
        (AWAY, RECIPE, r"record \d, it diverged at t = 0\.\d+ s; its `feedback`"),
        (None, replace(RECIPE, threshold=0.3), "give `feedback`, the law that makes F_x"),
    ):
        with pytest.warns(UserWarning, match=message):
            fit(problem, recipe, feedback)
    slow, some = Recipe(width=0.05, window=3.0), (motion(truth(), seed, 3.0) for seed in range(4))
    some = [Record(x.t[::100], {k: y[::100] for k, y in x.series.items()}) for x in some]
    with pytest.warns(UserWarning, match=r"record \d, it .*; take small taps .* a sample is 10 ms"):
        fit(assemble(some, LIBRARY, slow), slow, LAW)


def test_coefficients_that_no_rig_has_are_named(motions):
    """Against the mass that a run states; a spring and a dashpot that drive; opposite signs."""
    known = [replace(one, mass=1 / TRUTH["v_Br"]["F_x"]) for one in motions]
    assert contradictions(truth(), known) == []
    heavy = [replace(one, mass=0.6) for one in motions]
    with pytest.warns(UserWarning, match=r"mechanics: 2\.46 F_x in v_Br', where 1 / m is 1\.67\. "):
        fit(assemble(heavy, LIBRARY, RECIPE), RECIPE, LAW)
    wrong = {"v_C": list(zip(LIBRARY["v_C"][:2], (1e5, -9e2))), "omega": [], "v_Br": []}
    model = ReducedModel(STATES, ("F_x",), KINEMATICS, wrong, feedback=LAW)
    drives, opposite = contradictions(model, motions)
    assert drives == "-900 (v_Br - 2 v_C) in v_C' drives the motion"
    assert opposite.endswith("in v_C' have opposite signs")


@pytest.mark.parametrize(
    ("records", "how", "message"),
    [
        (lambda one: [changed(one, omega=np.full(3001, np.nan))], {}, "'omega' has values that ar"),
        (lambda one: [changed(one, F_x=np.full(3001, 3.0))], {}, r"`F_x` of v_Br' is constant \(3"),
        (lambda one: [one], {"domains": 40}, r"too little data for v_C'.*`v_C`; at least 10 rows"),
        (lambda one: [one], {"width": 3e-4}, r"a sample every .* ms is too seldom for the weak"),
        (lambda one: [one, Record(2 * one.t, one.series)], {}, "one time step"),
        (lambda one: [], {}, "no records to fit: give one"),
        (lambda one: [Record(one.t, {"x_C": one.series["x_C"]})], {}, "no series theta"),
        (lambda one: [Record(one.t[:9], one.series)], {}, r"has shape \(3001,\), but `t` \(9,\)"),
        (lambda one: [Record(one.t**2, one.series)], {}, "not equally spaced|a step is .* ms"),
        (lambda one: [record(one.series, one.t[::-1])], {}, "times that rise"),
    ],
)  # fmt: skip
def test_records_that_determine_nothing_are_rejected(motions, records, how, message):
    with pytest.raises(ValueError, match=message):
        assemble(records(motions[0]), LIBRARY, replace(RECIPE, **how))


def test_terms_that_depend_on_each_other_or_on_nothing_are_rejected(motions):
    terms = LIBRARY | {"v_C": [variable("x_C"), variable("x_Br"), LIBRARY["v_C"][0]]}
    with pytest.raises(ValueError, match=r"column `.*` of v_C' is a combination of the other"):
        assemble([motions[0]], terms, RECIPE)
    with pytest.raises(ValueError, match="needs the variable 'F_y'"):
        ReducedModel(("v_C",), (), {}, {"v_C": [(variable("F_y"), 1.0)]})
    with pytest.raises(ValueError, match="set `signal`"):
        truth()(0.0, torch.zeros(6, dtype=torch.float64))


# models
# ----------------------------------------------------------------------


@pytest.mark.parametrize("nonlinear", [False, True])
def test_all_routes_are_one(nonlinear):
    """Rollout, torchdiffeq and scipy through the same terms; gradients through torchdiffeq with
    respect to coefficients, gains and the start are those of differences."""
    product = Term("x_C |v_C|", "m m/s", (Factor({"x_C": 1.0}), Factor({"v_C": 1.0}, "abs")))
    extra = ((friction(R, 0.01)["v_C"][1], 5.0), (product, -1e6)) if nonlinear else ()
    model, one = truth(*extra), motion(truth(*extra), 7, duration=0.005)
    assert model.linear is not nonlinear
    t, u, y0 = one.t, 20 * one.columns(("x_d", "x_d_dot")), 20 * one.columns(STATES)[0]
    fast = model.rollout(t, y0, u).y
    model.signal = Held(torch.from_numpy(t), torch.from_numpy(u))
    given, step = (torch.from_numpy(y0), torch.from_numpy(t)), {"step_size": 2e-5}
    start = given[0].requires_grad_()
    slow = odeint(model, *given, method="rk4", options=step)
    outer = lambda when: [np.interp(when, t, column) for column in u.T]
    rates = lambda when, y: model.rates(torch.from_numpy(np.append(y, outer(when)))).detach()
    exact = solve_ivp(rates, t[[0, -1]], y0, "LSODA", t, rtol=1e-9, atol=1e-12).y.T
    for found, limit in ((slow.detach().numpy(), 1e-5), (fast, 1e-3 if nonlinear else 1e-5)):
        assert (np.abs(found - exact).max(0) < limit * np.abs(exact).max(0)).all()
    assert torch.equal(model(0.01, torch.stack((start, 2 * start)))[0], model(0.01, start))
    slow[-1, 0].backward()
    parts, ends = (model.coefficients, model.gains, start), []
    slope = sum(float((x.grad * x.detach()).sum()) for x in parts)
    with torch.no_grad():
        values = [x.clone() for x in parts]
        for h in (1e-5, -1e-5):
            for parameter, value in zip(parts, values):
                parameter.copy_(value * (1 + h))
            ends.append(odeint(model, *given, method="rk4", options=step)[-1, 0])
    assert slope == pytest.approx(float(ends[0] - ends[1]) / 2e-5, rel=1e-4)


@pytest.mark.parametrize("nonlinear", [False, True])
def test_divergence_is_reported_with_its_time(nonlinear):
    """v' = a v from v = 1 leaves 100 times its scale at ln(100) / a; v' = v^2 blows up at t = 1."""
    term, value, when = variable("v_C"), 5.0, np.log(BEYOND) / 5
    if nonlinear:
        square = Term("v_C v_C", "m2/s2", (Factor({"v_C": 1.0}), Factor({"v_C": 1.0})))
        term, value, when = square, 1.0, 1 - 1 / BEYOND
    model = ReducedModel(("v_C",), (), {}, {"v_C": [(term, value)]})
    out = model.rollout(np.linspace(0, 2, 2001), np.array([1.0]), np.empty((2001, 0)))
    assert out.diverged_at == pytest.approx(when, abs=2e-3)
    finite = np.isfinite(out.y[:, 0])
    assert finite[: int(1000 * when) - 2].all()
    assert not finite[-1]


# records
# ----------------------------------------------------------------------


def run_of(file: RigFile) -> Trajectory:
    built = file.build()
    return simulate(built.rig, built.t, y0=built.y0, rtol=1e-4)


BRIEF = {"duration": 0.02, "interval": 5e-4, "snapshots": ()}


@pytest.fixture(scope="module")
def beside():
    """A run whose loop measures the bracket, 0.3 mm beside the disc."""
    x_d = {"kind": "profile", "times": [0.0, 0.02], "values": ["start", 1e-4]}
    return run_of(template("t").override(outputs=BRIEF, motion={"x_d": x_d}))


def test_records_of_a_run_and_of_a_dataset_are_the_same():
    model = coarse()
    y0 = press(model).detach()
    x, y = (float(model.unpack(y0).pose[name][i]) for name, i in (("disc", 0), ("bracket", 1)))
    roll = Profile([0.0, 0.2], [x, x + 1e-3])
    reference = Reference(x_d=roll, y_d=Profile([0.0], [y]), F_ff=Profile([0.0], [-60.0]))
    run = simulate(model, times(0.2, 101), y0=y0, reference=reference)
    one, series = record(run), {name: x.values for name, x in run.to_xarray().items()}
    np.testing.assert_equal(record(series, run.t).series, one.series)
    assert (one.series["x_C"][0], one.series["x_d"][-1]) == pytest.approx((0.0, 1e-3))
    assert rolling_radius([one]) == pytest.approx(0.0185, rel=0.05)
    late = record(run, begin=0.1)
    assert (late.t[0], late.series["theta"][0]) == pytest.approx((0.1, 0.0))


def test_a_set_point_counts_from_where_its_coordinate_starts(beside):
    """The law of the loop holds in the variables of the record, from any begin on."""
    for begin in (None, 0.01):
        one = record(beside, begin=begin)
        s, n = one.series, len(one.t)
        offset = float(beside["x_d"][-n] - beside["x_bracket"][-n])
        assert s["x_d"][0] == pytest.approx(offset, abs=1e-12)
        law = 1e5 * (s["x_d"] - s["x_Br"]) + 400.0 * (s["x_d_dot"] - s["v_Br"])
        assert s["F_x"] == pytest.approx(law, abs=1e-6)
        assert s["F_x"].std() > 0.3
    series = {name: beside[f"{name}_disc"] for name in ("theta", "omega")}
    series |= {"x_C": beside["x_disc"], "x_Br": beside["x_bracket"], "x_d": beside["x_d"]}
    with pytest.raises(ValueError, match=r'x_C at 0\.0003 m and x_Br at 0 m may be it; .*"x_Br"'):
        record(series, beside.t)
    again = record(series, beside.t, measured="x_Br")
    assert np.array_equal(again.series["x_d"], record(beside).series["x_d"])
    assert record(beside).mass == 0.4


def test_bodies_of_a_record_have_any_names(beside):
    """Efforts on one coordinate add up; set-points of several loops are no x_d."""
    with pytest.raises(ValueError, match="`disc` = 'disk' is no body of the run; did you mean"):
        record(beside, disc="disk")
    with pytest.raises(ValueError, match=r"has none of x_C, .*, x_d.*; .* as in \{\"x_C\": data"):
        record({"x_disc": beside["x_disc"]}, beside.t)
    theta_d = {"kind": "profile", "times": [0.0, 0.02], "values": [0.0, 1e-2]}
    motion = {"theta_d": theta_d}
    run = run_of(RigFile.ready("orientation").override(outputs=BRIEF, motion=motion))
    one, turn = record(run, bracket="upper").series, run["effort_turn_upper"]
    assert np.array_equal(one["F_x"], (run["effort_carry_upper"] + turn).numpy())
    assert float(turn.abs().max()) > 0.1
    assert "x_d" not in one


@pytest.mark.slow
def test_saved_runs_are_reduced_by_a_command(tmp_path, capsys):
    """Small waves about a settled grasp; the last run is predicted."""
    files = [str(tmp_path / f"{seed}.nc") for seed in range(2)]
    for seed, path in enumerate(files):
        phases = np.random.default_rng(seed).uniform(0, 6, 8).tolist()
        waves = [
            {"amplitude": 3e-6, "frequency": f, "phase": phase}
            for f, phase in zip(np.geomspace(3, 120, 8).tolist(), phases)
        ]
        x_d = {"kind": "sines", "since": 0.6, "until": 1.0, "components": waves}
        outputs = {"duration": 0.95, "interval": 2.5e-4, "snapshots": []}
        run_of(template("t").override(motion={"x_d": x_d}, outputs=outputs)).save(path)
    command = ["reduce", *files, "--begin", "0.6", "--radius", "0.0194"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "reduced.json").read_text())
    assert max(summary["nrmse"].values()) < 0.02
    assert summary["feedback"]["F_x"]["x_Br"] == pytest.approx(-1e5, rel=1e-3)
    assert summary["held_out"] == files[1]
    assert "Score: error at most" in capsys.readouterr().out
    assert main(["reduce", files[0], "--out", str(tmp_path / "other")]) == 2
    assert "--held-out" in capsys.readouterr().err
