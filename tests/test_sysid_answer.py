"""The answer of an identification: its verdict, its file, the rig that comes back from it, and the
report, one page that stands alone."""

import base64
import json
import re
from dataclasses import fields, is_dataclass, replace
from html.parser import HTMLParser
from math import isnan, nan
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch
from conftest import PAPER, excited, stroked, times
from matplotlib.backends.backend_agg import FigureCanvasAgg
from test_sysid_friction import Viscous

from torchsoft import RigFile
from torchsoft.sysid import (
    IdentificationResult,
    Prior,
    Problem,
    Sensor,
    Stage,
    Unknown,
    identify,
    load_answer,
    record,
)
from torchsoft.sysid import report as sections
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.estimate import Number, estimates
from torchsoft.sysid.fit import Combination, Fit
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Reading
from torchsoft.sysid.report import figure, report
from torchsoft.sysid.result import checksum
from torchsoft.sysid.runs import Runner
from torchsoft.sysid.sentences import Finding

BASE = PAPER.override({"pad.elements_x": 60, "pad.elements_y": 1, "contact.v_s": 0.05})
E, NU, FRICTION = "materials.rubber.E", "materials.rubber.nu", "laws.steel_on_rubber.friction"
K_N, R_N = "laws.steel_on_rubber.K_n", "laws.steel_on_rubber.R_n"
ALPHA, MU_S, MU_K, V_S = (f"{FRICTION}.{name}" for name in ("alpha", "mu_s", "mu_k", "v_s"))
SENSORS = {"y_Br": Sensor(noise=1e-5, bias=1e-3), "effort_y": Sensor(noise=0.1)}
NOISE = Autoregression((0.8,), 0.7, 5e-3)
HOSTILE = 'a<b> & "$x_1$"'
"""What HTML or matplotlib would read as their own."""

DEPTHS = {HOSTILE: 1.2e-3, "shallow": 0.9e-3, "held": 1e-3}
FITTED = (HOSTILE, "shallow")


def grasp(depth: float) -> Any:
    return excited(stroked(0.0, 0.1, duration=0.25, grasp=0.15, since=0.15, depth=depth), BASE)


@pytest.fixture(scope="module")
def problem():
    """Two grasps, of which one starts at a place that is not known well, and one to hold out; the
    viscosity of slip is not identifiable."""
    recordings = [
        record(name, grasp(depth), {K_N: 1.6e5, E: 0.9e6}, SENSORS, rtol=1e-3, seed=seed)
        for seed, (name, depth) in enumerate(DEPTHS.items())
    ]
    start = recordings[1].start._replace(position_sd={"disc.x": 2e-5})
    recordings[1] = replace(recordings[1], start=start)
    prior = Prior(median=1e6, sd=0.5, kind="log-normal")
    unknowns = {
        K_N: Unknown(), E: Unknown(prior=prior), V_S: Unknown(), R_N: Unknown(per="recording"),
    }  # fmt: skip
    return Problem(recordings, SENSORS, unknowns)


@pytest.fixture(scope="module")
def result(problem):
    plan = [Stage("all", FITTED, problem.coordinates.labels, 1e-3, evaluations=4)]
    return identify(problem, plan=plan, tightenings=0, heldout=["held"], assumptions="trusted")


@pytest.fixture(scope="module")
def full(result):
    """The result with what else an answer may hold."""
    harmless = AssumptionTest(
        "a", "known", "<b> is so", "it were not", 2.0, "%", moves={E: 0.1}, gain=0.5,
        favoured=0.3, favoured_sd=1.2, value=1.0,
    )  # fmt: skip
    heavy = replace(
        harmless, name="b", stated="the disc weighs 1 kg", moves={E: -4.2}, gain=99.0,
        favoured=-3.1, suspected=True,
    )  # fmt: skip
    other = replace(harmless, name="d", stated="the disc is round", favoured=5.0)
    lost = replace(
        harmless, name="c", kind="law", stated="slip is smooth", unchecked="a run failed"
    )
    return replace(
        result, assumptions=[harmless, heavy, lost, other],
        noise={"effort_y": NOISE},
        combinations=[Combination({E: 1.0, K_N: -0.5}, {E: 0.3, K_N: 0.4}, 0.02)],
        command="torchsoft identify '<a>.csv' rig.toml --out out",
    )  # fmt: skip


@pytest.fixture(scope="module")
def path(full, tmp_path_factory):
    path = tmp_path_factory.mktemp("answer") / "answer.json"
    full.save(path)
    return path


# Numbers of an answer


@pytest.mark.parametrize(
    ("severities", "verdict", "says"),
    [
        (("note",), "holds", "^The model holds. 4 of 6 parameters identifiable, "),
        (("warning", "note"), "doubtful", "^The model is doubtful: .* If it holds: 4 of 6 "),
        (("error", "warning"), "does not explain", "^The model does not explain the data"),
    ],
)
def test_the_verdict_is_that_of_the_gravest_finding_and_the_first_line(
    result, severities, verdict, says
):
    findings = [Finding("not-converged", severity) for severity in severities]
    answer = replace(result, findings=findings)
    content = json.loads(answer.to_json())
    assert answer.verdict == content["verdict"] == verdict
    assert [one["text"] for one in content["findings"]] == [str(one) for one in findings]
    assert re.search(says, answer.headline)
    assert answer.table().startswith(answer.headline)


def test_a_prediction_with_values_of_its_own_names_them(result):
    value = result.recorded("held").identified[R_N]
    (found,) = (one for one in result.findings if one.code == "heldout-unidentified")
    assert found.facts == {"recording": "held", "values": {R_N: value}}


@pytest.mark.filterwarnings("ignore:not identifiable")
def test_draws_are_those_of_the_covariance(result):
    """The estimates come first; parameters that are not identifiable stay."""
    drawn = result.draws(2000, "shallow", seed=1)
    seen = {e.name: e for e in result.estimates if e.identifiable and e.kind == "parameter"
            and e.recording in (None, "shallow")}  # fmt: skip
    assert 0 < len(seen) < len(drawn)
    for name, values in drawn.items():
        assert values.shape == (2001,)
        assert values[0] == pytest.approx(result.recorded("shallow").identified[name])
        sd = np.log(values[1:]).std()
        expected = seen[name].relative_sd if name in seen else 0.0
        assert sd == pytest.approx(expected, rel=0.1, abs=1e-12)


def at(problem: Problem, x: np.ndarray, which: tuple[str, ...]) -> Fit:
    """A fit that is at x (n,)."""
    c = problem.coordinates
    free = tuple(one.label for one in c.within(c.free))
    return Fit(problem, Runner(problem.recordings), x, Stage("all", which, free, 1e-3))


def test_estimates_of_tied_and_of_linear_parameters_are_those_of_their_coordinates(problem):
    sure, unknowns = Prior(median=0.8, sd=0.1), {
        MU_S: Unknown(prior=Prior(median=0.8, sd=0.1)),
        MU_K: Unknown(nominal=0.5, ratio_to=MU_S, fixed=True),
        NU: Unknown(scale="linear", low=0.3, high=0.49),
    }  # fmt: skip
    own = Problem(problem.recordings[:1], {"effort_y": Sensor(noise=0.1)}, unknowns)
    x = own.coordinates.start + np.array([np.log(1.1), 0.0, -0.05 / 0.19])
    C, shift = np.diag([0.1**2, 0.0, 0.2**2]), np.array([0.05, 0.0, 0.0])
    found = {e.name: e for e in estimates(at(own, x, (HOSTILE,)), C, shift)}
    assert [e.prior for e in found.values()] == [sure, None, None]
    for name, start in ((MU_S, 0.8), (MU_K, 0.4)):
        e, ends = found[name], 1.1 * start * np.exp([-0.196, 0.196])
        assert (e.start, e.value) == pytest.approx((start, 1.1 * start))
        assert e.ci95 == pytest.approx(ends, rel=1e-4)
        assert e.step_bias_sd == pytest.approx(0.5)
    nu = found[NU]
    assert (nu.start, nu.value, nu.unit) == (0.45, pytest.approx(0.4), "1")
    assert nu.ci95 == pytest.approx((0.4 - 0.196 * 0.38, 0.4 + 0.196 * 0.38), rel=1e-4)
    assert nu.relative_sd == pytest.approx(0.2 * 0.19 / 0.4)


# The file


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
    if origin in (Literal, list, dict):
        first = inner[0] if origin is Literal else example(inner[-1])
        return {Literal: first, list: [first], dict: {HOSTILE: first}}[origin]
    return tuple(example(one) for one in inner if one is not Ellipsis)


def test_what_is_saved_comes_back(full, path, tmp_path):
    whole = example(IdentificationResult)
    whole.save(tmp_path / "answer.json")
    for one, file in ((full, path), (whole, tmp_path / "answer.json")):
        text = file.read_text(encoding="utf-8")
        content = json.loads(text)
        assert content["verdict"] == one.verdict
        answer = load_answer(file)
        assert answer.to_json() == text == one.to_json()
        assert answer.table() == one.table()
        assert not answer.rigs
    assert isnan(answer.chi2)
    assert answer.noise == whole.noise
    began = load_answer(path).recordings[1].initial
    assert began == {"start.disc.x": full["start.disc.x"].last}


def test_an_answer_states_what_was_asked_for(result):
    """The tolerance too, beside the one at which the fit ended."""
    asked = {"tightenings": 0, "assumptions": "trusted", "rtol": 1e-3, "rtol_asked": 1e-3}
    assert asked.items() <= result.made_by.items()


def forge(content: dict[str, Any]) -> None:
    """A damaged content, and its checksum."""
    content["x"].append("0")
    rest = {name: value for name, value in content.items() if name not in ("schema", "checksum")}
    content["checksum"] = checksum(rest)


DAMAGE = {
    "a digit": (lambda c: c["estimates"][1].update(last=1.25), "is damaged"),
    "no checksum": (lambda c: c.pop("checksum"), "is damaged"),
    "another form": (lambda c: c.update(schema="torchsoft-answer-99"), "'torchsoft-answer-99'"),
    "an old one": (lambda c: c.pop("schema"), "identify again"),
    "forged": (forge, r"\.x\.\d+ should be a valid number, not '0'"),
}


@pytest.mark.parametrize("how", [*DAMAGE, "", "[1, 2]", '{"a": 1}', "\xff", "[" * 100_000, "cut"])
def test_damaged_and_other_files_are_rejected_by_name(path, tmp_path, how):
    whole, other = path.read_bytes(), tmp_path / "answer.json"
    data, says = how.encode("latin-1"), "is not an answer"
    if how in DAMAGE:
        change, says = DAMAGE[how]
        content = json.loads(whole)
        change(content)
        data = json.dumps(content).encode()
    other.write_bytes(whole[: len(whole) // 2] if how == "cut" else data)
    with pytest.raises(ValueError, match=says) as caught:
        load_answer(other)
    assert str(other) in str(caught.value)
    assert len(str(caught.value)) < 600


# The rig of an answer


@pytest.mark.filterwarnings("ignore:not identifiable")
def test_the_rig_of_a_file_has_the_bits_of_that_of_the_result(full, path):
    mine, its = full.model("shallow"), load_answer(path).model("shallow")
    for name, value in mine.named_parameters():
        if not name.startswith("reference."):
            assert torch.equal(its.parameter(name), value), name
    assert float(its.parameter(E).detach()) == full[E].last
    own = [e.last for e in full.estimates if e.name == R_N and e.recording in FITTED]
    assert own == [float(full.model(name).parameter(R_N).detach()) for name in FITTED]
    assert own[0] != own[1]
    t, began = times(0.2, 30), full.rigs["shallow"]
    assert float(began.parameter(E).detach()) != full[E].last
    assert torch.equal(mine.follow(t), began.follow(t))


def test_what_is_not_identifiable_is_named_when_it_is_used(full, path):
    """So is what only a recording that was not fitted would tell."""
    assert not full[V_S].identifiable
    assert full[V_S].value is full[V_S].ci95 is None
    weak = [one.facts["estimate"] for one in full.findings if one.code == "not-identifiable"]
    assert weak == [V_S, f"{R_N} in held"]
    for answer in (full, load_answer(path)):
        with pytest.warns(UserWarning, match=rf"search ended: .*{V_S} = \S+$") as caught:
            answer.model(HOSTILE)
        assert [Path(one.filename).name for one in caught] == [Path(__file__).name]
        assert E not in str(caught[0].message)
        assert R_N not in str(caught[0].message)
    with pytest.warns(UserWarning, match=rf"search ended: .*{R_N} = \S+"):
        full.model("held")


@pytest.mark.parametrize(
    ("given", "says"), [((), "say in which one, of `"), (("third",), "'third'; there are `")]
)
def test_a_recording_must_be_named_where_rigs_differ(result, given, says):
    with pytest.raises(ValueError, match=says):
        result.model(*given)


def slide(file: RigFile, like: Any) -> Any:
    rig = file.assemble({FRICTION: Viscous(0.6, 30.0)})
    rig.reference = like.reference
    return rig


def test_a_custom_law_needs_the_rig_of_the_user(problem, tmp_path):
    """Of which alpha is not identifiable."""
    own = [replace(r, rig=slide(BASE, r.rig)) for r in problem.recordings]
    mine = Problem(own, SENSORS, {ALPHA: Unknown(), E: Unknown()})
    plan = [Stage("all", FITTED, mine.coordinates.labels, 1e-3, evaluations=2)]
    slippery = identify(mine, plan=plan, tightenings=0, assumptions="trusted", heldout=["held"])
    slippery.save(tmp_path / "answer.json")
    answer, like = load_answer(tmp_path / "answer.json"), own[0].rig
    with pytest.raises(ValueError, match=r"parts of its own.*`applied_to\(rig\)`"):
        answer.model(HOSTILE)
    weak, given = rf"search ended: {ALPHA} = 0\.\d+$", slide(BASE, like)
    with pytest.warns(UserWarning, match=weak) as caught:
        its = answer.applied_to(given, HOSTILE)
    assert len(caught) == 1  # it is the right rig
    assert float(its.parameter(ALPHA).detach()) == slippery[ALPHA].last
    assert float(its.parameter(E).detach()) == slippery[E].last != 0.75e6
    assert float(given.parameter(E).detach()) == 0.75e6  # it is a copy that was changed
    another = slide(BASE.override({"pad.nu": 0.4}), like)
    with (
        pytest.warns(UserWarning, match=weak),
        pytest.warns(UserWarning, match=rf"may mislead: {NU} is 0\.4 and was 0\.45$"),
    ):
        answer.applied_to(another, HOSTILE)
    with pytest.raises(ValueError, match=f"`{ALPHA}` is not a parameter of this rig"):
        answer.applied_to(BASE.assemble(), HOSTILE)


# The report


class Page(HTMLParser):
    """Tags with their attributes, the text, and whether every tag that was opened was closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.open = "", []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.text += data + "\n"


def written(answer: IdentificationResult, problem: Problem, folder: Path) -> Page:
    report(answer, problem, folder / "report.html")
    assert [path.name for path in folder.iterdir()] == ["report.html"]
    return Page((folder / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(path, problem, tmp_path_factory):
    """Of the answer that was loaded from its file."""
    return written(load_answer(path), problem, tmp_path_factory.mktemp("report"))


def test_the_page_stands_alone(page):
    assert page.open == []
    tags = {tag for tag, _ in page.tags}
    assert tags.isdisjoint({"script", "link", "iframe", "object", "b", "a"})
    addresses = [str(own[k]) for _, own in page.tags for k in own if k in ("src", "href")]
    assert len(addresses) == len(DEPTHS) * len(SENSORS)
    for address in addresses:
        kind, _, data = address.partition(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data)[:8] == b"\x89PNG\r\n\x1a\n"


def test_the_page_holds_what_the_answer_holds(page, full):
    text = page.text.replace("\u202f", "").replace("−", "-")
    known = [e for e in full.estimates if e.identifiable]
    assert {e.name for e in known} >= {E, "start.disc.x", "bias of y_Br"}
    numbers = [float(f"{v:.5g}") for e in known for v in (e.value, *(e.ci95 or ()))]
    for shown in (
        *(f"{number:.12g}" for number in numbers),
        f"\n{V_S}\nnot identifiable\nnone\nm/s\n",
        *(f"{100 * value:.3g} %" for one in full.heldout.values() for value in one.values()),
        HOSTILE,  # escaped once, and not twice
        f"\n{full.command}\n",
        "×/÷ 1.65",  # the prior: a factor of exp(0.5)
        f"only {E} / {K_N}^0.5 is determined (2 %), not each ({E} 30 %, {K_N} 40 %)\n",
    ):
        assert shown in text


def test_warnings_come_first_then_parameters_starts_and_sensors(page, full):
    assert full.findings
    order = [
        *(f"\n{one.severity}: {one}\n" for one in full.findings),
        "\nEstimates\n", f"\n{E}\n", f"\n{V_S}\n",
        f"\n{R_N}\n{HOSTILE}\n", f"\n{R_N}\nshallow\n", "\nstart.disc.x\nshallow\n",
        "\nbias of y_Br\n",
    ]  # fmt: skip
    places = [page.text.index(text) for text in order]
    assert sorted(places) == places


def test_assumptions_that_matter_stand_open_and_others_are_folded(page):
    folded = page.text.index("\n1 that shift no estimate by more than 0.5 standard deviations\n")
    assert (
        page.text.index(f"\n−4.2 sd of {E}\n−3.1 ± 1.2 %\nsuspected: lowers the sum of ") < folded
    )
    assert page.text.index("\nnot checked: a run failed\n") < folded
    assert page.text.index(f"\n<b> is so\nit were not\n+0.1 sd of {E}\n+0.3 ± 1.2 %\n") > folded
    assert "\n+5 ± 1.2 %\ndiffers by more than chance; other suspects explain more\n" in page.text


def test_the_page_draws_the_readings_of_the_model(problem, full, tmp_path, monkeypatch):
    drawn = list[Reading]()
    monkeypatch.setattr(sections, "figure", lambda one, unit: drawn.append(one))
    monkeypatch.setattr(sections, "png", lambda figure: "")
    written(full, problem, tmp_path)
    assert len(drawn) == len(DEPTHS) * len(SENSORS)
    runner, x = Runner(problem.recordings), np.array(full.x)
    own = problem.residuals(runner, x, problem.names, full.made_by["rtol"]).r
    r = np.concatenate([one.r for one in drawn])
    np.testing.assert_array_equal(r, own[: problem.samples()])


def test_an_answer_to_other_data_is_rejected(problem, result, tmp_path):
    other = Problem(problem.recordings[:1], problem.sensors, problem.unknowns)
    with pytest.raises(ValueError, match="other recordings"):
        report(result, other, tmp_path / "report.html")
    assert not any(tmp_path.iterdir())


def test_a_lost_recording_is_named(problem, result, tmp_path, monkeypatch):
    run = Runner.run

    def losing(self, jobs):
        lost = FailedRun("it < went", 0.1)
        return [lost if job.recording == 2 else one for job, one in zip(jobs, run(self, jobs))]

    monkeypatch.setattr(Runner, "run", losing)
    monkeypatch.setattr(sections, "png", lambda figure: "")
    answer = replace(result, findings=[])
    page = written(answer, problem, tmp_path)
    alts = " ".join(str(attributes.get("alt")) for _, attributes in page.tags)
    assert "Could not be simulated: it < went" in page.text
    assert f"y_Br of {HOSTILE}" in alts
    assert "y_Br of held" not in alts
    assert "The fit converged, residuals are white" in page.text
    assert "\nAssumptions\n" not in page.text  # where there is nothing to report


def test_no_part_of_a_picture_is_cut():
    t, e = np.linspace(0.0, 1.0, 50), np.ones(50)
    drawn = figure(Reading(HOSTILE, t, 0.0123 * t, 0.0123 * t, None, {}, 50 * t, e), "m")
    canvas = FigureCanvasAgg(drawn)
    canvas.draw()
    box = drawn.get_tightbbox(canvas.get_renderer())
    assert min(*box.min, *(drawn.get_size_inches() - box.max)) > 0
