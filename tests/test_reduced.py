"""Reduced models: known equations recovered, all routes through one list of terms equal, divergence
and bad data reported."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import PAPER, coarse, press, times
from scipy.integrate import solve_ivp
from torchdiffeq import odeint

from torchsoft import BuiltRig, Profile, Reference, simulate
from torchsoft.cli import main
from torchsoft.reduced.fit import Recipe, assemble, choose, contradictions, fit, loop, score
from torchsoft.reduced.ode import BEYOND, Factor, Held, ReducedModel, Term
from torchsoft.reduced.records import KINEMATICS, STATES, Record, record, rolling_radius
from torchsoft.reduced.terms import friction, joined, mechanics, variable
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
SCALE = np.array([1e-3, 5e-2, 2e-3, 5e-2, 3.0, 0.1])


def truth(extra: dict[str, list[tuple[Term, float]]] | None = None) -> ReducedModel:
    """The sticking grasp's equations with known coefficients, and further terms."""
    equations = {
        target: [(term, TRUTH[target][term.text]) for term in terms if term.text in TRUTH[target]]
        for target, terms in mechanics(R).items()
    }
    for target, pairs in (extra or {}).items():
        equations[target] = [*equations[target], *pairs]
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


RECIPE = Recipe(width=0.004, window=0.3, threshold=0.01)


def test_known_equations_are_recovered(motions):
    """Exactly the true terms, their coefficients to a few per cent."""
    model = fit(assemble(motions, mechanics(R), RECIPE), RECIPE)
    found = {
        target: {term.text: x for term, x in pairs} for target, pairs in model.equations().items()
    }
    assert {target: set(terms) for target, terms in found.items()} == {
        k: set(v) for k, v in TRUTH.items()
    }
    for target, terms in TRUTH.items():
        for text, value in terms.items():
            assert found[target][text] == pytest.approx(value, rel=0.05), text


def test_the_choice_takes_the_true_terms_and_rolls_out(motions):
    choice = choose(
        assemble(motions, mechanics(R), RECIPE),
        [motion(truth(), 50)],
        RECIPE,
        (1e-4, 0.01, 0.9),
        LAW,
    )
    assert len(choice.model.terms) == 8
    assert choice.tried[choice.index]["nrmse"] < 5e-3
    assert score(choice.model, motion(truth(), 51)).worst < 5e-3
    assert max(row["nrmse"] for row in choice.tried) > 0.05  # thresholds matter


def test_saturating_friction_is_recovered():
    """tanh(s' / v) with v known: amplitude to 5 %, and the linear terms beside it."""
    upper = friction(R, 1e-3)["v_C"][1]
    model = truth({"v_C": [(upper, 3.0)]})
    records = [motion(model, seed) for seed in range(2)]
    recipe = replace(RECIPE, threshold=0.02)
    found = fit(
        assemble(records, joined(mechanics(R), {"v_C": [upper]}), recipe), recipe
    ).equations()["v_C"]
    assert {term.text for term, _ in found} == {*TRUTH["v_C"], upper.text}
    assert found[-1][1] == pytest.approx(3.0, rel=0.05)


def test_ensembles_give_intervals_and_leave_the_global_generator(motions):
    rng = np.random.default_rng(0)
    rough = [
        replace(
            one,
            series={
                k: x + 0.005 * x.std() * rng.standard_normal(len(x)) for k, x in one.series.items()
            },
        )
        for one in motions
    ]
    recipe, before = replace(RECIPE, models=20, threshold=0.05), np.random.get_state()[1].copy()  # noqa: NPY002
    model = fit(assemble(rough, mechanics(R), recipe), recipe)
    again = fit(assemble(rough, mechanics(R), recipe), recipe)
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    assert model.intervals == again.intervals
    for row in model.coefficient_table():
        low, high = row["interval"]
        assert low < row["value"] < high
    assert model.coefficient_table()[0]["unit"] == "m/s/s per m"


@pytest.mark.parametrize("nonlinear", [False, True])
def test_all_routes_are_one(nonlinear):
    """Rollout, torchdiffeq and scipy through the same terms; the batched right-hand side as
    well."""
    product = Term("x_C |v_C|", "m m/s", (Factor({"x_C": 1.0}), Factor({"v_C": 1.0}, "abs")))
    extra = {"v_C": [(friction(R, 0.01)["v_C"][1], 5.0), (product, -1e6)]} if nonlinear else None
    model = truth(extra)
    assert model.linear is not nonlinear
    one = motion(truth(), 7, duration=0.005)
    t, u, y0 = one.t, 20 * one.columns(("x_d", "x_d_dot")), 20 * one.columns(STATES)[0]
    fast = model.rollout(t, y0, u).y
    model.signal = Held(torch.from_numpy(t), torch.from_numpy(u))
    with torch.no_grad():
        slow = odeint(
            model, torch.from_numpy(y0), torch.from_numpy(t), method="rk4",
            options={"step_size": 2e-5}
        ).numpy()  # fmt: skip
    rates = lambda yw: model.rates(yw).detach().numpy()
    scipys = solve_ivp(
        lambda when, y: rates(torch.from_numpy(np.concatenate((y, [np.interp(when, t,
        column) for column in u.T])))), (t[0], t[-1]), y0, "LSODA", t, rtol=1e-9, atol=1e-12,
    ).y.T  # fmt: skip
    size = np.abs(scipys).max(0)
    assert np.abs(slow - scipys).max(0) / size == pytest.approx(0, abs=1e-5)
    assert np.abs(fast - scipys).max(0) / size == pytest.approx(0, abs=1e-3 if nonlinear else 1e-5)
    batch = torch.from_numpy(np.array([y0, 2 * y0]))
    assert torch.equal(model(0.01, batch)[0], model(0.01, batch[0]))


def test_gradients_through_torchdiffeq_are_those_of_the_rollout():
    """d x_C(0.02 s) by a coefficient, a gain and y0, against central differences of the exact
    rollout."""
    model, one = truth(), motion(truth(), 3, duration=0.02)
    t, u, y0 = one.t, one.columns(model.outer), one.columns(STATES)[0]
    model.signal = Held(torch.from_numpy(t), torch.from_numpy(u))
    start = torch.from_numpy(y0).requires_grad_()
    odeint(model, start, torch.from_numpy(t), method="rk4", options={"step_size": 5e-5})[
        -1, 0
    ].backward()
    with torch.no_grad():
        values, ends = [model.coefficients.clone(), model.gains.clone()], []
        for h in (1e-5, -1e-5):  # along all coefficients, gains and the start at once
            for parameter, value in zip((model.coefficients, model.gains), values):
                parameter.copy_(value * (1 + h))
            ends.append(model.rollout(t, y0 * (1 + h), u).y[-1, 0])
    pairs = zip(
        (model.coefficients.grad, model.gains.grad, start.grad), (*values, torch.from_numpy(y0))
    )
    slope = sum(float((grad * value).sum()) for grad, value in pairs if grad is not None)
    assert slope == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)


@pytest.mark.parametrize("nonlinear", [False, True])
def test_divergence_is_reported_with_its_time(nonlinear):
    """v' = a v from v = 1 leaves 100 times its scale at ln(100) / a; v' = v^2 blows up at t = 1."""
    square = Term("v_C v_C", "m2/s2", (Factor({"v_C": 1.0}), Factor({"v_C": 1.0})))
    term, value, when = (
        (square, 1.0, 1 - 1 / BEYOND) if nonlinear else (variable("v_C"), 5.0, np.log(BEYOND) / 5)
    )
    model = ReducedModel(("v_C",), (), {}, {"v_C": [(term, value)]})
    out = model.rollout(np.linspace(0, 2, 2001), np.array([1.0]), np.empty((2001, 0)))
    assert out.diverged_at == pytest.approx(when, abs=2e-3)
    assert str(out) == f"diverged at t = {out.diverged_at:.4g} s"
    assert np.isnan(out.y[-1]).all()
    assert np.isfinite(out.y[: int(1000 * when) - 2]).all()


def test_a_choice_of_divergent_models_fails_with_the_time(motions):
    away = {"F_x": {name: -gain for name, gain in LAW["F_x"].items()}}
    with pytest.raises(ValueError, match=r"rollouts stay bounded.*diverged at t = 0\.\d+ s"):
        choose(
            assemble(motions, mechanics(R), RECIPE), [motion(truth(), 50)], RECIPE, (0.01,), away
        )


def changed(one: Record, name: str, values: np.ndarray) -> Record:
    return Record(one.t, one.series | {name: values})


BAD: list[tuple[Callable[[Record, dict[str, list[Term]]], object], str]] = [
    (lambda one, terms: assemble([changed(one, "omega", np.where(one.t > 0.1, np.nan, 0.0))], terms,
    RECIPE),
     "'omega' has values that are not finite"),
    (lambda one, terms: assemble([changed(one, "F_x", np.full(len(one.t), 3.0))], terms, RECIPE),
     r"column `F_x` of v_Br' is constant \(3\)"),
    (lambda one, terms: assemble([one], terms | {"v_C": [variable("x_C"), variable("x_Br"),
    terms["v_C"][0]]}, RECIPE),
     r"column `.*` of v_C' is a combination of the other columns"),
    (lambda one, terms: assemble([one], terms, replace(RECIPE, domains=40)),
     r"too little data for v_C'.*`v_C`; at least 10 rows"),
    (lambda one, terms: assemble([one, Record(one.t[:10], {k: x[:10] for k,
    x in one.series.items()})], terms, RECIPE),
     "the shortest record is 10 samples"),
    (lambda one, terms: assemble([one], terms, replace(RECIPE, width=3 * one.step)),
     r"a sample every .* ms is too seldom for the weak form's test functions"),
    (lambda one, terms: assemble([], terms, RECIPE), "no records to fit: give one"),
    (lambda one, terms: assemble([one, Record(2 * one.t, one.series)], terms, RECIPE),
    "one time step"),
    (lambda one, terms: assemble([Record(one.t, {k: v for k,
    v in one.series.items() if k != "F_x"})], terms, RECIPE),
     "no series F_x"),
    (lambda one, terms: ReducedModel(("v_C",), (), {}, {"v_C": [(variable("F_y"), 1.0)]}),
    "needs the variable 'F_y'"),
    (lambda one, terms: truth()(0.0, torch.zeros(6, dtype=torch.float64)), "set `signal`"),
]  # fmt: skip


UNEVEN: list[tuple[Callable[[np.ndarray], np.ndarray], str]] = [
    (
        lambda t: np.r_[t[:400], t[520:]],
        r"after t = 0\.0399 s a step is 12\.1 ms, and others are 0\.1",
    ),
    (lambda t: np.r_[t[:1], t[500:]], r"after t = 0 s a step is 50 ms, and others are 0\.1 ms"),
    (lambda t: t + 1e-6 * np.sin(9 * t), "not equally spaced"),
    (lambda t: t[::-1], "times that rise"),
    (lambda t: t[:2], "at least three"),
]


@pytest.mark.parametrize(("kept", "sentence"), UNEVEN)
def test_a_gap_is_no_equal_spacing(motions, kept, sentence):
    """Of a record that is made by hand, as of one of a run."""
    one, t = motions[0], kept(motions[0].t)
    series = {name: x[: len(t)] for name, x in one.series.items()}
    with pytest.raises(ValueError, match=sentence):
        Record(t, series)
    with pytest.raises(ValueError, match=sentence):
        record(series, t)
    with pytest.raises(ValueError, match=r"series 'x_C' has shape \(3001,\), but `t` \(9,\)"):
        Record(one.t[:9], one.series)


@pytest.mark.parametrize(("call", "sentence"), BAD)
def test_bad_data_are_refused_by_name(motions, call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call(motions[0], mechanics(R))


def test_the_bracket_may_be_the_input(motions):
    """With the bracket's motion as u only the disc has equations."""
    library = {k: v for k, v in mechanics(R).items() if k != "v_Br"}
    model = fit(assemble(motions, library, RECIPE, inputs=("x_Br", "v_Br")), RECIPE)
    assert model.states == ("x_C", "theta", "v_C", "omega")
    assert model.outer == ("x_Br", "v_Br")
    assert score(model, motion(truth(), 60)).worst < 1e-2


def test_equations_read_in_text_and_latex():
    model = truth()
    assert model.text()[0] == "x_C' = v_C"
    assert model.with_feedback(None).text() == model.text()
    assert model.with_feedback(None).outer == ("F_x",)
    assert "v_C' = 1.15e+05 (x_Br - 2 x_C) + 1100 (v_Br - 2 v_C)" in model.text()
    latex = model.latex()
    assert r"1.15\cdot 10^{5}\,(x_{Br} - 2 x_C)" in latex
    assert r"\frac{d}{dt} \dot\theta &= - 1.1\cdot 10^{7}\,(x_{Br} + 2 r \theta)" in latex
    assert (
        friction(R, 0.01)["v_Br"][0].latex == r"\tanh((\dot x_{Br} - \dot x_C + r \dot\theta)/0.01)"
    )


def test_records_of_a_run_and_of_a_dataset_are_the_same():
    model = coarse()
    y0 = press(model).detach()
    x_0, y_Br = (float(model.unpack(y0).pose[name][i]) for name, i in (("disc", 0), ("bracket", 1)))
    roll = Profile([0.0, 0.2], [x_0, x_0 + 1e-3])
    reference = Reference(x_d=roll, y_d=Profile([0.0], [y_Br]), F_ff=Profile([0.0], [-60.0]))
    run = simulate(model, times(0.2, 101), y0=y0, reference=reference)
    one, series = record(run), run.to_xarray()
    other = record({name: torch.from_numpy(series[name].values) for name in series}, run.t)
    assert all(np.array_equal(one.series[name], other.series[name]) for name in one.series)
    assert one.series["x_C"][0] == 0.0
    assert one.series["x_d"][-1] == pytest.approx(1e-3)
    assert rolling_radius([one]) == pytest.approx(0.0185, rel=0.05)
    late = record(run, begin=0.1)
    assert (late.t[0], late.series["theta"][0]) == (pytest.approx(0.1), 0.0)
    values = series["omega_C"].values.copy()
    values[50] = np.nan
    with pytest.raises(ValueError, match=r"'omega' \(omega_C\) .* first at t = 0.1 s"):
        record({name: series[name].values for name in series} | {"omega_C": values}, run.t)


def run_of(file: RigFile, **motion: dict[str, object]) -> tuple[BuiltRig, Trajectory]:
    """A file's rig and its first 20 ms."""
    outputs = {"duration": 0.02, "interval": 5e-4, "snapshots": ()}
    ready = file.override(outputs=outputs, motion=motion).build()
    return ready, simulate(ready.rig, ready.t, y0=ready.y0, step=5e-4)


@pytest.fixture(scope="module")
def beside():
    """A run whose loop measures the bracket, 0.3 mm beside the disc."""
    x_d = {"kind": "profile", "times": [0.0, 0.02], "values": ["start", 1e-4]}
    return run_of(template("t"), x_d=x_d)[1]


def test_a_set_point_counts_from_where_its_coordinate_starts(beside, tmp_path):
    """The law of the loop holds in the variables of the record, from any begin on."""
    for begin in (None, 0.01):
        one = record(beside, begin=begin)
        e, e_dot = (
            one.series[a] - one.series[b] for a, b in (("x_d", "x_Br"), ("x_d_dot", "v_Br"))
        )
        offset = float(beside["x_d"][-len(one.t)] - beside["x_bracket"][-len(one.t)])
        assert one.series["x_d"][0] == pytest.approx(offset, abs=1e-12)
        assert one.series["F_x"] == pytest.approx(1e5 * e + 400.0 * e_dot, abs=1e-6)
        assert one.series["F_x"].std() > 0.3
    series = {name: beside[f"{name}_disc"] for name in ("theta", "omega")}
    series |= {"x_C": beside["x_disc"], "x_Br": beside["x_bracket"], "x_d": beside["x_d"]}
    with pytest.raises(ValueError, match=r'x_C at 0\.0003 m and x_Br at 0 m may be it; .*"x_Br"'):
        record(series, beside.t)
    again = record(series, beside.t, measured="x_Br").series["x_d"]
    assert np.array_equal(again, record(beside).series["x_d"])
    beside.save(tmp_path / "run.nc")
    loaded = record(Trajectory.load(tmp_path / "run.nc"))
    assert np.array_equal(again, loaded.series["x_d"])
    with pytest.raises(ValueError, match="`measured` = 'x' is not in `source`"):
        record(series, beside.t, measured="x")


def test_bodies_of_a_record_have_any_names(beside):
    """Efforts on one coordinate add up; set-points of several loops are no x_d."""
    with pytest.raises(
        ValueError, match="`disc` = 'disk' is no body of the run; did you mean `disc"
    ):
        record(beside, disc="disk")
    with pytest.raises(ValueError, match=r"has none of x_C, .*, x_d.*; .* as in \{\"x_C\": data"):
        record({"x_disc": beside["x_disc"]}, beside.t)
    theta_d = {"kind": "profile", "times": [0.0, 0.02], "values": [0.0, 1e-2]}
    ready, run = run_of(RigFile.ready("orientation"), theta_d=theta_d)
    one = record(run, bracket="upper")
    efforts = run["effort_carry_upper"] + run["effort_turn_upper"]
    assert np.array_equal(one.series["F_x"], efforts.numpy())
    assert float(run["effort_turn_upper"].abs().max()) > 0.1
    assert np.array_equal(one.series["v_Br"], run["v_x_upper"].numpy())
    assert "x_d" not in one.series
    assert ready.rig.actuators["turn_upper"].pushes == "upper.x"


def test_the_law_of_the_loop_is_found(motions):
    assert loop(motions)["F_x"] == pytest.approx(LAW["F_x"], rel=1e-6)
    shaken = np.random.default_rng(0).standard_normal(len(motions[0].t))
    with pytest.raises(ValueError, match=r"F_x is no PD law of x_d: .* N of .* N are left"):
        loop([replace(motions[0], series=motions[0].series | {"F_x": shaken})])


def test_saved_runs_are_reduced_by_a_command(tmp_path, capsys):
    """Small waves about a settled grasp; the last run is predicted."""
    files = []
    for seed in range(2):
        phases = np.random.default_rng(seed).uniform(0, 6, 10).tolist()
        waves = [
            {"amplitude": 3e-6, "frequency": float(f), "phase": phase}
            for f, phase in zip(np.geomspace(3, 120, 10), phases)
        ]
        x_d = {"kind": "sines", "since": 0.6, "until": 1.2, "components": waves}
        outputs = {"duration": 1.1, "interval": 2.5e-4, "snapshots": []}
        ready = template("t").override(motion={"x_d": x_d}, outputs=outputs).build()
        files.append(str(tmp_path / f"{seed}.nc"))
        simulate(ready.rig, ready.t, y0=ready.y0, rtol=1e-4).save(files[-1])
    command = ["reduce", *files, "--begin", "0.6", "--radius", "0.0194"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "reduced.json").read_text())
    assert max(summary["nrmse"].values()) < 0.02
    assert summary["feedback"]["F_x"]["x_Br"] == pytest.approx(-1e5, rel=1e-3)
    assert summary["held_out"] == files[1]
    assert "Score: error at most" in capsys.readouterr().out
    refused = {
        "--held-out": ["reduce", files[0]],
        "--threshold": [*command, "--threshold", "2"],
        "--radius": [*command, "--radius", "-1"],
    }
    for said, wrong in refused.items():
        assert main([*wrong, "--out", str(tmp_path / "other")]) == 2
        assert said in capsys.readouterr().err


def test_a_fit_that_misses_its_record_says_why(motions):
    """Coarse samples of a large motion; a law on the wrong coordinate; no law at all."""
    coarse_ones = [
        Record(one.t[::100], {k: x[::100] for k, x in one.series.items()})
        for one in (motion(truth(), seed, 3.0) for seed in range(4))
    ]
    slow = Recipe(width=0.05, window=3.0)
    with pytest.warns(UserWarning, match=r"record \d, it .*; take small taps .* a sample is 10 ms"):
        fit(assemble(coarse_ones, mechanics(R), slow), slow, LAW)
    problem = assemble(motions, mechanics(R), RECIPE)
    other = {"x_C": "x_Br", "v_C": "v_Br"}
    law = {"F_x": {other.get(name, name): gain for name, gain in LAW["F_x"].items()}}
    with pytest.warns(UserWarning, match=r"`feedback` makes F_x off by .* N: give the gains"):
        fit(problem, RECIPE, law)
    with pytest.warns(UserWarning, match=r"rolled out on record 0, it misses it.*`feedback` makes"):
        choose(problem, [motions[0]], RECIPE, (0.01,), law)
    away = {"F_x": {name: -gain for name, gain in LAW["F_x"].items()}}
    with pytest.warns(UserWarning, match=r"record \d, it diverged at t = 0\.\d+ s; its `feedback`"):
        fit(problem, RECIPE, away)
    with pytest.warns(UserWarning, match="give `feedback`, the law that makes F_x"):
        fit(problem, replace(RECIPE, threshold=0.3))


def test_coefficients_that_no_rig_has_are_named(motions):
    """Against the mass that a run says; a spring and a dashpot that drive; opposite signs."""
    known = [replace(one, mass=1 / TRUTH["v_Br"]["F_x"]) for one in motions]
    assert contradictions(truth(), known) == []
    with pytest.warns(UserWarning, match=r"mechanics: 2\.46 F_x in v_Br', where 1 / m is 1\.67\. "):
        fit(
            assemble([replace(one, mass=0.6) for one in motions], mechanics(R), RECIPE), RECIPE, LAW
        )
    library = mechanics(R)
    wrong = {
        "v_C": list(zip(library["v_C"][:2], (1e5, -9e2))),
        "omega": list(zip(library["omega"][2:4], (2e6, -5e3))),
    }
    model = ReducedModel(STATES, ("F_x",), KINEMATICS, wrong | {"v_Br": []}, feedback=LAW)
    drives, opposite, others = contradictions(model, motions)
    assert drives == "-900 (v_Br - 2 v_C) in v_C' drives the motion"
    assert opposite == "(x_Br - 2 x_C) and (v_Br - 2 v_C) in v_C' have opposite signs"
    assert others == "(x_Br - 2 x_C) and (v_Br - 2 v_C) in omega' have opposite signs"


def test_a_run_says_what_its_bracket_weighs(beside, tmp_path):
    assert record(beside).mass == 0.4
    beside.save(tmp_path / "run.nc")
    assert record(Trajectory.load(tmp_path / "run.nc")).mass == 0.4
    model = coarse()
    run = simulate(model, times(0.01, 5), y0=press(model, 49.6e-3))
    assert record(run).mass == PAPER.bodies["bracket"].mass


def test_objects_show_themselves_in_a_few_lines(motions):
    problem = assemble(motions, mechanics(R), RECIPE)
    done = score(fit(problem, RECIPE, LAW), motions[0])
    for thing in (motions[0], done, done.rollout, problem):
        assert len(repr(thing).splitlines()) <= 10, thing
        assert len(repr(thing)) < 700
    assert repr(motions[0]).startswith("Record: 0 to 0.3 s, 3001 samples, one every 0.1 ms\n  x_C ")
    assert f"{100 * done.nrmse['omega']:.3g} % of the range" in repr(done)
    assert "omega'  360 rows, 5 candidate terms" in repr(problem)
