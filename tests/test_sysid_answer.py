"""The answer as a file: its published schema, damaged and other files, and the rig that comes back
from it."""

import json
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from math import isnan, nan
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import jsonschema
import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, excited, stroked, times
from test_sysid_friction import Viscous

from torchsoft import Rig, RigFile, simulate
from torchsoft.physics.motion import Reference
from torchsoft.sysid import (
    IdentificationResult,
    Prior,
    Problem,
    Sensor,
    Stage,
    Unknown,
    identify,
    record,
)
from torchsoft.sysid.estimate import Number, contributions, estimates
from torchsoft.sysid.fit import Fit
from torchsoft.sysid.identification import Settings
from torchsoft.sysid.result import checksum, load_answer, recorded_rigs, schema
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.unknowns import Coordinate

ROOT = Path(__file__).parents[1]
PUBLISH = "from torchsoft.files import write_json; write_json('docs/answer.schema.json', schema())"
BASE = PAPER.override(COARSE)
SENSORS = {
    "theta_C": Sensor(noise=5e-4, bias=0.02),
    "y_Br": Sensor(noise=1e-5),
    "effort_y": Sensor(noise=0.1),
}
GRASP = stroked(0.0, 0.1, duration=0.25, depth=1.08e-3, grasp=0.15, since=0.15)
E, NU, FRICTION = "materials.rubber.E", "materials.rubber.nu", "laws.steel_on_rubber.friction"
K_N, R_N, ALPHA = "laws.steel_on_rubber.K_n", "laws.steel_on_rubber.R_n", f"{FRICTION}.alpha"
MU_S, MU_K, V_S = (f"{FRICTION}.{name}" for name in ("mu_s", "mu_k", "v_s"))
UNKNOWNS = {
    R_N: Unknown(per="recording"), E: Unknown(), V_S: Unknown(),
    "pad.tau": Unknown(prior=Prior(median=0.01, sd=0.3, kind="log-normal")),
}  # fmt: skip

HOSTILE = 'a<b> & "$x_1$"'
"""What HTML or matplotlib would read as their own."""


def example(kind: Any) -> Any:
    """Something of this type, with everything in it that it can hold; numbers that need not be
    finite are not."""
    known = {
        str: HOSTILE, float: 0.25, int: 3, bool: True, Any: {"a": [1]}, Number: nan,
        Prior: Prior(median=0.25, sd=0.25),
        Unknown: Unknown(low=0.1, high=0.3), Sensor: Sensor(noise=0.1),
    }  # fmt: skip
    if kind in known:
        return known[kind]
    origin, inner = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        return kind(**{one.name: example(hints[one.name]) for one in fields(kind)})
    if origin in (Union, UnionType) or hasattr(kind, "__metadata__"):
        return example(inner[0] if inner else kind.__origin__)
    if origin is Literal:
        return inner[0]
    if origin is list:
        return [example(inner[0])]
    if origin is dict:
        return {HOSTILE: example(inner[1])}
    assert origin is tuple, kind
    return tuple(example(one) for one in inner if one is not Ellipsis)


@pytest.fixture(scope="module")
def problem():
    """Two short grasps, one of them from a place that is not known well."""
    recordings = [
        record(name, excited(GRASP, BASE), {K_N: 1.6e5}, SENSORS, rtol=1e-3, seed=seed)
        for seed, name in enumerate(("first", "second"))
    ]
    start = recordings[1].start._replace(position_sd={"disc.x": 2e-5})
    recordings[1] = replace(recordings[1], start=start)
    return Problem(recordings, SENSORS, UNKNOWNS)


@pytest.fixture(scope="module")
def result(problem):
    plan = [Stage("all", problem.names, problem.coordinates.labels, 1e-3, evaluations=3)]
    return identify(problem, plan=plan, tightenings=0, assumptions="trusted")


@pytest.fixture(scope="module")
def path(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("answer") / "answer.json"
    result.save(path)
    return path


def test_draws_are_those_of_the_covariance(result):
    """The estimates first; parameters that are not identifiable stay, and a ratio is multiplied."""
    with pytest.warns(UserWarning, match="not identifiable"):
        drawn = result.draws(2000, "second", seed=1)
    seen = {e.name: e for e in result.estimates if e.identifiable and e.kind == "parameter"
            and e.recording in (None, "second")}  # fmt: skip
    assert 0 < len(seen) < len(drawn)
    for name, values in drawn.items():
        assert values.shape == (2001,)
        assert values[0] == pytest.approx(result.recorded("second").identified[name])
        if name in seen:
            sd = np.log(values[1:]).std()
            assert sd == pytest.approx(seen[name].relative_sd, rel=0.1)
        else:
            assert (values == values[0]).all()
    at = next(i for i, c in enumerate(result.coordinates) if c.name == E)
    ratio = replace(result.coordinates[at], ratio_to=K_N)
    others = [ratio if i == at else c for i, c in enumerate(result.coordinates)]
    with pytest.warns(UserWarning, match="not identifiable"):
        ends = [one.draws(3, "second", seed=1)[E]
                for one in (result, replace(result, coordinates=others))]  # fmt: skip
    assert ends[0] == pytest.approx(ends[1])  # K_n is known
    with pytest.raises(ValueError, match="`count`"):
        result.draws(0, "second")


def test_the_published_schema_is_current():
    published = json.loads((ROOT / "docs" / "answer.schema.json").read_text(encoding="utf-8"))
    assert published == schema(), f"write it anew: {PUBLISH}"
    jsonschema.Draft202012Validator.check_schema(published)


def test_files_are_what_the_schema_says(path):
    check = jsonschema.Draft202012Validator(schema())
    for text in (path.read_text(encoding="utf-8"), example(IdentificationResult).to_json()):
        content = json.loads(text)
        assert [error.message for error in check.iter_errors(content)] == []
        assert "more" in next(check.iter_errors(content | {"more": 1})).message
        content["estimates"][0]["seen"] = "yes"
        assert [list(error.path) for error in check.iter_errors(content)] == [
            ["estimates", 0, "seen"]
        ]


def test_what_was_saved_comes_back(result, path):
    answer = load_answer(path)
    assert type(answer) is IdentificationResult
    assert not answer.rigs
    assert replace(answer, rigs=result.rigs) == result
    assert answer.to_json() == path.read_text(encoding="utf-8")
    assert answer.table() == result.table()
    assert answer.recordings[1].began == {"start.disc.x": result["start.disc.x"].last}


def test_an_answer_says_what_was_asked_for(result):
    """The tolerance too, beside the one at which the fit ended."""
    asked = Settings(tightenings=0, assumptions="trusted").model_dump() | {
        "rtol_asked": 1e-3,
        "acknowledged": [],
    }
    assert {name: result.made_by[name] for name in asked} == asked | {"rtol": 1e-3}


def test_everything_that_an_answer_can_hold_comes_back(tmp_path):
    whole = example(IdentificationResult)
    assert all(getattr(whole, one.name) for one in fields(IdentificationResult))
    whole.save(tmp_path / "answer.json")
    answer = load_answer(tmp_path / "answer.json")
    assert isnan(answer.chi2)
    assert isnan(answer.assumptions[0].favoured_sd)
    assert answer.to_json() == whole.to_json()
    assert answer.noise == whole.noise


def test_a_file_may_be_written_otherwise(path, tmp_path):
    content = json.loads(path.read_text(encoding="utf-8"))
    text = json.dumps(dict(sorted(content.items())))
    assert "7500000.0," in text
    (tmp_path / "answer.json").write_text(text.replace("7500000.0,", "7500000,"), encoding="utf-8")
    assert load_answer(tmp_path / "answer.json") == load_answer(path)


def forge(content: dict[str, Any]) -> None:
    """A damaged content, and its checksum."""
    content["x"].append("0")
    rest = {name: value for name, value in content.items() if name not in ("schema", "checksum")}
    content["checksum"] = checksum(rest)


DAMAGE: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a digit": (lambda c: c["estimates"][1].update(last=1.25),
        "is damaged: its content is not what was saved"),
    "no checksum": (lambda c: c.pop("checksum"), "is damaged: its content is not what was saved"),
    "another form": (lambda c: c.update(schema="torchsoft-answer-9"),
        "its `schema` is 'torchsoft-answer-9'"),
    "an old one": (lambda c: c.pop("schema"), "an older version wrote it, so identify again"),
    "forged": (forge, r"\.x\.\d+ should be a valid number, not '0'"),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_file_is_refused_with_a_sentence(path, tmp_path, how):
    change, said = DAMAGE[how]
    content, other = json.loads(path.read_text(encoding="utf-8")), tmp_path / "answer.json"
    change(content)
    other.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ValueError, match=said) as caught:
        load_answer(other)
    assert str(other) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1, 2]", '{"a": 1}', "\xff", "[" * 100_000, "cut"])
def test_other_files_are_refused_with_a_sentence(path, tmp_path, text):
    other = tmp_path / "other.json"
    whole = path.read_bytes()
    other.write_bytes(whole[: len(whole) // 2] if text == "cut" else text.encode("latin-1"))
    with pytest.raises(ValueError, match=re.escape(f"{other} is not an answer")) as caught:
        load_answer(other)
    assert len(str(caught.value)) < 600
    with pytest.raises(FileNotFoundError):
        load_answer(tmp_path / "nothing.json")


@pytest.mark.filterwarnings("ignore:not identifiable")
def test_the_rig_of_a_file_runs_to_the_bit_like_that_of_the_result(result, path):
    mine, its = result.model("second"), load_answer(path).model("second")
    for name, value in mine.named_parameters():
        if not name.startswith("reference."):
            assert torch.equal(its.parameter(name), value), name
    assert float(its.parameter(E).detach()) == result[E].last
    own = [e.last for e in result.estimates if e.name == R_N]
    assert [
        float(result.model(name).parameter(R_N).detach()) for name in ("first", "second")
    ] == own
    assert own[0] != own[1]
    t = times(0.2, 30)
    begun = result.rigs["second"]
    y0 = excited(GRASP, BASE).y0
    runs = [simulate(rig, t, y0=y0, reference=begun.reference, rtol=1e-3).y for rig in (mine, its)]
    assert torch.equal(*runs)
    assert not torch.equal(runs[0], simulate(begun, t, y0=y0, rtol=1e-3).y)
    assert torch.equal(
        mine.follow(t), begun.follow(t)
    )  # the result's rig follows what the recording followed
    assert mine is not begun


def test_what_is_not_identifiable_is_named_when_it_is_used(result, path):
    assert not result[V_S].identifiable
    for answer in (result, load_answer(path)):
        with pytest.warns(
            UserWarning, match=rf"only where the search ended: .*{V_S} = \S+$"
        ) as caught:
            answer.model("first")
        assert [Path(one.filename).name for one in caught] == [Path(__file__).name]
        assert E not in str(caught[0].message)


def test_a_recording_that_was_not_fitted_has_no_values_of_its_own(
    result,
):
    def left_out(c: Coordinate) -> Coordinate:
        return replace(c, fixed=True) if c.recording == "second" else c

    out = [e for e in result.estimates if e.recording != "second"]
    answer = replace(result, estimates=out, coordinates=[left_out(c) for c in result.coordinates])
    with pytest.warns(
        UserWarning, match=rf"only where the search ended: {R_N} = \S+, {V_S} = \S+$"
    ):
        answer.model("second")
    with pytest.warns(UserWarning, match=rf"only where the search ended: .*{V_S} = \S+$"):
        answer.model("first")


def test_a_recording_must_be_named_where_rigs_differ(result):
    for given, said in (
        ((), "not the same in all recordings: say in which one, of `first`, `second`"),
        (("third",), "there is no recording 'third'; there are `first`, `second`"),
    ):
        with pytest.raises(ValueError, match=said):
            result.model(*given)


def at(problem: Problem, x: np.ndarray) -> Fit:
    """A fit that is at x (n,)."""
    c = problem.coordinates
    free = tuple(one.label for one in c.within(c.free))
    return Fit(problem, Runner(problem.recordings), x, Stage("all", problem.names, free, 1e-3))


@pytest.fixture(scope="module")
def slippery(problem, result):
    """A result for rigs with a law of the user's own, whose alpha is not identifiable."""
    own = [replace(r, rig=slide(BASE, r.rig.reference)) for r in problem.recordings]
    mine = Problem(own, SENSORS, {ALPHA: Unknown(), E: Unknown()})
    c, C = mine.coordinates, np.zeros((len(mine.coordinates),) * 2)
    x, C[0, 0] = c.start + 0.1, 1.0
    fit = at(mine, x)
    found = estimates(fit, C, np.zeros(len(x)))
    rigs = {r.name: r.rig for r in own}
    recordings = recorded_rigs(fit)
    return replace(
        result, estimates=found, x=x.tolist(), coordinates=list(c.all), unknowns=mine.unknowns,
        recordings=recordings, rigs=rigs,
    )  # fmt: skip


def slide(file: RigFile, reference: Reference) -> Rig:
    rig = file.assemble({FRICTION: Viscous(0.6, 30.0)})
    rig.reference = reference
    return rig


def test_a_law_of_the_users_own_needs_the_users_rig(slippery, tmp_path):
    slippery.save(tmp_path / "answer.json")
    answer, reference = load_answer(tmp_path / "answer.json"), slippery.rigs["first"].reference
    said = r"Rig with parts of its own, which the answer does not hold: .* `applied_to\(rig\)`"
    with pytest.raises(ValueError, match=said):
        answer.model()
    mine, weak = (
        slide(BASE, reference),
        rf"only where the search ended: {ALPHA} = 0\.663$",
    )
    with pytest.warns(UserWarning, match=weak) as caught:
        its = answer.applied_to(mine)
    assert len(caught) == 1  # it is the right rig
    with pytest.warns(UserWarning, match=weak):
        own = slippery.model()
    for name, value in own.named_parameters():
        assert torch.equal(its.parameter(name), value), name
    assert float(its.parameter(E).detach()) == slippery[E].last != 0.75e6
    assert float(mine.parameter(E).detach()) == 0.75e6  # it is a copy that was changed
    another = slide(BASE.override({"pad.nu": 0.4}), reference)
    with (
        pytest.warns(UserWarning, match=weak),
        pytest.warns(UserWarning, match=rf"its values may mislead: {NU} is 0\.4 and was 0\.45$"),
    ):
        answer.applied_to(another)
    with pytest.raises(ValueError, match=f"`{ALPHA}` is not a parameter of this rig"):
        answer.applied_to(BASE.assemble())


def test_contributions_are_those_of_the_inverse_matrices(problem, result):
    """Against numpy's inverses of what Fisher's matrices of the recordings add up to."""
    fit = at(problem, np.array(result.x)).begun()
    J = fit.at.J
    m, k = problem.samples(["first"]), list(problem.coordinates.labels)
    parts = {"first": J[:m], "second": J[m:-2], None: J[-2:]}
    known = [i for i, label in enumerate(k) if label != V_S]
    J[:, k.index(V_S)] = 0.0
    stage = replace(fit.stage, free=tuple(k[i] for i in known))
    F = {name: rows[:, known].T @ rows[:, known] for name, rows in parts.items()}
    C = np.linalg.inv(sum(F.values()))
    for one in contributions(fit._replace(stage=stage)):
        left = np.linalg.pinv(sum(part for name, part in F.items() if name != one.source))
        for i, label in enumerate(k[i] for i in known):
            assert one.shares[label] == pytest.approx(
                (C @ F[one.source] @ C)[i, i] / C[i, i], rel=1e-6, abs=1e-9
            )
            if one.without[label] is not None:
                assert one.without[label] == pytest.approx(
                    (left[i, i] / C[i, i]) ** 0.5, rel=1e-6
                ), label
        if one.source == "second":
            assert one.without[f"{R_N} in second"] is None  # nothing else sees it
            assert one.without[E] > 1.1
    assert [one.source for one in result.contributions] == list(parts)


def test_estimates_of_tied_and_of_linear_parameters_are_those_of_their_coordinates(
    problem,
):
    sure, unknowns = Prior(median=0.8, sd=0.1), {
        MU_S: Unknown(prior=Prior(median=0.8, sd=0.1)),
        MU_K: Unknown(nominal=0.5, ratio_to=MU_S, fixed=True),
        NU: Unknown(scale="linear", low=0.3, high=0.49),
    }  # fmt: skip
    own = Problem(problem.recordings[:1], {"theta_C": Sensor(noise=5e-4)}, unknowns)
    c = own.coordinates
    x = c.start + np.array([np.log(1.1), 0.0, -0.05 / 0.19])
    found = {
        e.name: e
        for e in estimates(at(own, x), np.diag([0.1**2, 0.0, 0.2**2]), np.array([0.05, 0.0, 0.0]))
    }
    assert list(found) == list(unknowns)
    for name, start in ((MU_S, 0.8), (MU_K, 0.4)):
        e = found[name]
        assert (e.start, e.value) == pytest.approx((start, 1.1 * start))
        assert e.ci95 == pytest.approx(
            (1.1 * start * np.exp(-0.196), 1.1 * start * np.exp(0.196)), rel=1e-4
        )
        assert e.step_bias_sd == pytest.approx(0.5)
    assert [e.prior for e in found.values()] == [sure, None, None]
    nu = found[NU]
    assert (nu.start, nu.value, nu.unit) == (0.45, pytest.approx(0.4), "1")
    assert nu.ci95 == pytest.approx((0.4 - 0.196 * 0.38, 0.4 + 0.196 * 0.38), rel=1e-4)
    assert nu.relative_sd == pytest.approx(0.2 * 0.19 / 0.4)
