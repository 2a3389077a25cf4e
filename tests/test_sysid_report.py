"""The report: one page that stands alone, holds the whole result, and no number that the data do
not determine."""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import COARSE, PAPER, excited, stroked
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from test_sysid_answer import HOSTILE

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
from torchsoft.sysid import report as sections
from torchsoft.sysid.assumption_tests import AssumptionTest
from torchsoft.sysid.estimate import Direction
from torchsoft.sysid.figures import (
    correlation_figure,
    direction_name,
    estimates_figure,
    spectrum_figure,
    trace_figure,
)
from torchsoft.sysid.fit import Combination
from torchsoft.sysid.noise import Autoregression
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.report import PAGES, cell, grouped, kept, report, traces
from torchsoft.sysid.report import page as page_of
from torchsoft.sysid.residual_tests import autocorrelation
from torchsoft.sysid.result import ChannelNoise, load_answer, undetermined
from torchsoft.sysid.runs import Runner

Found = tuple[IdentificationResult, Problem]
E, K_N, R_N = "materials.rubber.E", "laws.steel_on_rubber.K_n", "laws.steel_on_rubber.R_n"
V_S = "laws.steel_on_rubber.friction.v_s"
NOISE = Autoregression((0.8,), 0.7, 5e-3)


@pytest.fixture(scope="module")
def found():
    """Two grasps, from which the viscosity of slip is not identifiable, and another one held
    out."""
    truth = {K_N: 1.6e5, E: 0.9e6}
    sensors = {
        "theta_C": Sensor(noise=5e-4),
        "y_Br": Sensor(noise=1e-5, bias=1e-3),
        "effort_y": Sensor(noise=0.1),
    }
    depths = {HOSTILE: 1.2e-3, "shallow": 0.9e-3, "held": 1e-3}
    recordings = []
    for seed, (name, depth) in enumerate(depths.items()):
        still = stroked(0.0, 0.1, duration=0.25, grasp=0.15, since=0.15, depth=depth)
        grasp = excited(still, PAPER.override(COARSE))
        recordings.append(record(name, grasp, truth, sensors, rtol=1e-3, seed=seed))
    start = recordings[1].start._replace(position_sd={"disc.x": 2e-5})
    recordings[1] = replace(recordings[1], start=start)
    unknowns = {
        K_N: Unknown(), E: Unknown(prior=Prior(median=1e6, sd=0.5, kind="log-normal")),
        V_S: Unknown(), R_N: Unknown(per="recording"),
    }  # fmt: skip
    problem = Problem(recordings, sensors, unknowns)
    plan = [Stage("all", (HOSTILE, "shallow"), problem.coordinates.labels, 1e-3, evaluations=4)]
    return identify(
        problem, plan=plan, tightenings=0, heldout=["held"], assumptions="trusted"
    ), problem


def test_the_first_line_says_when_the_model_does_not_explain_the_data(found):
    """Whatever colour was found: it is the noise that sensors state that counts."""
    answer, problem = found
    assert answer.chi2 == pytest.approx(answer.chi2_whitened, rel=0.05)
    assert answer.headline.startswith("4 of 6 parameters identifiable, ")
    residuals = [
        replace(one, stated=29.0 if one.channel == "effort_y" else 1.0) for one in answer.residuals
    ]
    bad = replace(answer, residuals=residuals, chi2=200.0)
    first = (
        "The model does not explain the data: residuals of effort_y are 29 times the stated noise"
    )
    assert bad.table().startswith(first)
    assert "(χ² = 200), and intervals may miss the truth" in bad.headline
    assert "identifiable" not in bad.headline
    assert first in page_of(bad, *traces(bad, problem, None))
    assert (answer.verdict, bad.verdict) == ("holds", "does not explain")
    doubtful = replace(answer, doubts=["residuals are not white in x_C"])
    assert doubtful.verdict == "doubtful"
    assert doubtful.headline.startswith(
        "The model is doubtful, a note below speaks against it; if it holds, 4 of 6 parameters"
    )
    assert json.loads(doubtful.to_json())["verdict"] == "doubtful"


def test_a_prediction_with_values_that_nothing_tells_says_so(found):
    """Of the unknown that is the held-out recording's own."""
    answer, _ = found
    said = undetermined({R_N: answer.recorded("held").identified[R_N]})
    assert f"held-out recording `held` is predicted with what is {said}" in answer.notices


@pytest.fixture(scope="module")
def full(found):
    """The result with whatever else an answer may hold."""
    answer, _ = found
    harmless = AssumptionTest(
        "a", "known", "<b> is so", "it were not", 2.0, "%", moves={E: 0.1}, gain=0.5,
        favoured=0.3, favoured_sd=1.2, value=1.0,
    )  # fmt: skip
    checks = [
        harmless,
        replace(
            harmless, name="b", stated="the disc weighs 1 kg", moves={E: -4.2}, gain=99.0,
            favoured=-3.1, suspected=True
        ),
        replace(harmless, name="c", kind="law", stated="slip is smooth", moves={},
        unchecked="a run failed"),
    ]  # fmt: skip
    return replace(
        answer, assumptions=checks, noise=[ChannelNoise("effort_y", NOISE, [])],
        combinations=[Combination({E: 1.0, K_N: -0.5}, {E: 0.3, K_N: 0.4}, 0.02)],
        command="torchsoft identify '<a>.csv' rig.toml --out out",
    )  # fmt: skip


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
def page(full, found, tmp_path_factory):
    return written(full, found[1], tmp_path_factory.mktemp("report") / "new")


def test_the_page_stands_alone(page):
    assert page.open == []
    assert {"script", "link", "iframe", "object", "b", "a", "cannot", "open"}.isdisjoint(
        tag for tag, _ in page.tags
    )
    pictures = [attributes for tag, attributes in page.tags if tag == "img"]
    assert len(pictures) == 3 + 3 * 3
    for attributes in pictures:
        source, alt = str(attributes["src"]), str(attributes["alt"])
        kind, _, data = source.partition(",")
        assert kind == "data:image/png;base64"
        png = base64.b64decode(data)
        width, height = struct.unpack(">II", png[16:24])
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        assert 600 < width < 1200
        assert 200 < height < 1600
        assert len(alt) > 20
    addresses = [
        v for _, attributes in page.tags for k, v in attributes.items() if k in ("src", "href")
    ]
    assert len(addresses) == len(pictures)
    assert (
        "meta",
        {"name": "viewport", "content": "width=device-width,initial-scale=1"},
    ) in page.tags


def test_the_page_holds_what_the_answer_holds(page, full):
    parameters = [e for e in full.estimates if e.kind == "parameter"]
    known = [e for e in full.estimates if e.identifiable]
    assert {e.name for e in known} >= {E, "start.disc.x", "bias of y_Br"}
    assert not full[V_S].identifiable
    assert (
        f"{sum(e.identifiable for e in parameters)} of {len(parameters)} parameters identifiable"
        in page.text
    )
    for e in known:
        for value in (e.value, *(e.ci95 or ())):
            assert f"{float(f'{value:.5g}'):.12g}" in page.text.replace("\u202f", "").replace(
                "−", "-"
            )
    assert f"\n{V_S}\nnot identifiable\nnone\nm/s\n" in page.text
    for channels in full.heldout.values():
        for value in channels.values():
            assert f"{100 * value:.3g} %" in page.text
    for stage in full.stages:
        assert stage["name"] in page.text
    assert HOSTILE in page.text  # escaped once, and not twice
    assert "\ntorchsoft identify '<a>.csv' rig.toml --out out\n" in page.text
    decided = page.text[page.text.index("{\n") :]
    assert json.loads(decided.strip()) == json.loads(json.dumps(full.made_by))


def test_warnings_come_first_and_all_of_them(page, full):
    assert full.notices
    places = [page.text.index(f"\n{notice}\n") for notice in full.notices]
    assert sorted(places) == places
    assert places[-1] < page.text.index("\nEstimates\n")


def test_starts_and_sensors_are_apart_from_parameters(page):
    order = [
        "\nEstimates\n", f"\n{E}\n", f"\n{V_S}\n",
        "\nParameters of which each recording has its own\n",
        f"\n{R_N}\n{HOSTILE}\n", f"\n{R_N}\nshallow\n", "\nWhere the runs began\n",
        "\nstart.disc.x\nshallow\n", "\nWhat the sensors add\n", "\nbias of y_Br\n",
        "\nContribution of each recording\n",
    ]  # fmt: skip
    places = [page.text.index(text) for text in order]
    assert sorted(places) == places
    assert "×/÷ 1.65" in page.text  # the prior: a factor of exp(0.5)


def test_what_recordings_told_is_in_the_table(page, full):
    assert [one.source for one in full.contributions] == [HOSTILE, "shallow", None]
    for label in (E, f"{R_N} in shallow"):
        cells = []
        for one in full.contributions:
            factor = one.without[label]
            cells.append(
                f"{100 * one.shares[label]:.0f} % "
                f"({'only here' if factor is None else f'× {factor:.2f}'})"
            )
        assert "\n".join((label, *cells)) in page.text
    assert full.contributions[1].without[f"{R_N} in shallow"] is None
    assert (
        f"only {E} / {K_N}^0.5 is determined (2 %), not each ({E} 30 %, {K_N} 40 %)\n" in page.text
    )
    weak = [direction_name(d) for d in full.directions if not d.identifiable]
    assert V_S in weak
    for name in weak:
        assert f"\n{name} may change without a trace in the data\n" in page.text


def test_assumptions_that_matter_stand_open_and_others_are_folded(page):
    folded = page.text.index("\n1 that move nothing by more than 0.5 standard deviations\n")
    said = (
        f"\nthe disc weighs 1 kg\nit were not\n−4.2 sd of {E}\nyes −3.1 ± 1.2 %: the sum of "
        "squares would fall by 99, but is not the cause\n"
    )
    assert page.text.index(said) < folded
    assert page.text.index("\nslip is smooth\nit were not\nnot checked: a run failed\n") < folded
    assert page.text.index(f"\n<b> is so\nit were not\n+0.1 sd of {E}\nno: +0.3 ± 1.2 %\n") > folded
    assert ("details", {}) in page.tags


def test_predictions_are_the_models(found):
    answer, problem = found
    drawn, lost = traces(answer, problem, None)
    assert not lost
    assert len(drawn) == 3 * 3
    own = problem.residuals(
        Runner(problem.recordings), np.array(answer.x), problem.names, answer.made_by["rtol"]
    ).r
    np.testing.assert_array_equal(
        np.concatenate([one.residual for one in drawn]), own[: problem.samples()]
    )
    rms = {(one.recording, one.channel): float(np.sqrt(np.mean(one.residual**2))) for one in drawn}
    for channel in answer.residuals:
        assert rms[channel.recording, channel.channel] == pytest.approx(channel.rms, rel=1e-6)
    for trace in drawn:
        noise = problem.sensors[trace.channel].noise
        np.testing.assert_allclose(
            trace.predicted - trace.measured, noise * trace.residual, atol=1e-12
        )
        np.testing.assert_array_equal(trace.white, trace.residual)
        held = answer.heldout.get(trace.recording)
        if held is not None:
            nrmse = rms[trace.recording, trace.channel] * noise / np.ptp(trace.measured)
            assert nrmse == pytest.approx(held[trace.channel], rel=1e-6)


def test_coloured_residuals_are_whitened_by_the_noise_of_the_result(full, found):
    drawn, _ = traces(full, found[1], None)
    for one in drawn:
        if one.channel == "effort_y":
            later = (one.residual[1:] - 0.8 * one.residual[:-1]) / 0.7
            np.testing.assert_allclose(one.white[1:], later, rtol=1e-9, atol=1e-9)
            assert one.white[0] == pytest.approx(one.residual[0] / NOISE.sd)
        else:
            np.testing.assert_array_equal(one.white, one.residual)


def test_starts_are_the_settings_values(found):
    answer, problem = found
    known = problem.recordings[0].parameters | {"start.disc.x": 60.3e-3, "bias of y_Br": 0.0}
    for e in answer.estimates:
        assert e.start == known[e.name]


def test_an_answer_to_other_data_is_refused(found, tmp_path):
    answer, problem = found
    other = Problem(problem.recordings[:1], problem.sensors, problem.unknowns)
    with pytest.raises(ValueError, match="other recordings"):
        report(answer, other, tmp_path / "report.html")
    assert not any(tmp_path.iterdir())


def undrawn(figure: Figure) -> str:
    """What `png` makes, without the pixels."""
    return ""


def test_a_loaded_answer_makes_the_same_page(
    full,
    found,
    page,
    tmp_path,
    monkeypatch,
):
    monkeypatch.setattr(sections, "png", undrawn)
    full.save(tmp_path / "answer.json")
    (tmp_path / "page").mkdir()
    again = written(load_answer(tmp_path / "answer.json"), found[1], tmp_path / "page")
    when = page.text.index("\nwritten\n")
    assert again.text[:when] == page.text[:when]


def test_a_lost_recording_is_named_and_a_clean_answer_has_no_warnings(found, tmp_path, monkeypatch):
    answer, problem = found
    run = Runner.run

    def losing(self: Runner, jobs: Any) -> list[Any]:
        return [
            FailedRun("it < went", 0.1) if job.recording == 2 else one
            for job, one in zip(jobs, run(self, jobs))
        ]

    monkeypatch.setattr(Runner, "run", losing)
    monkeypatch.setattr(sections, "png", undrawn)
    page = written(
        replace(answer, notices=[], contributions=answer.contributions[:1]), problem, tmp_path
    )
    alts = " ".join(str(attributes.get("alt")) for _, attributes in page.tags)
    assert "Could not be simulated: it < went" in page.text
    assert f"theta_C of {HOSTILE}" in alts
    assert "theta_C of held" not in alts
    assert "nothing to warn of" in page.text
    for heading in ("Contribution of each recording", "Assumptions"):
        assert f"\n{heading}\n" not in page.text  # where there is nothing to say


def tabulated(*given: Any) -> Page:
    macros, _, _ = PAGES.loader.get_source(PAGES, "report.html")[0].partition("<!doctype html>")
    made = PAGES.from_string(f"{macros}{{{{ table(*given) }}}}")
    return Page(made.render(given=given, kept=kept, cell=cell))


def test_tables_leave_out_what_is_empty_and_escape_the_rest():
    page = tabulated(
        ["<h>", "none", "n"], [["1&b", "", "−1.5"], [("weak", "<i>"), "", "0.5 … 3"]], "<c>"
    )
    assert page.text.split("\n")[:-1] == ["<c>", "<h>", "n", "1&b", "−1.5", "<i>", "0.5 … 3"]
    cells = [attributes for tag, attributes in page.tags if tag == "td"]
    assert [one["class"] for one in cells] == ["", "n", "weak", "n"]
    assert cells[0]["data-label"] == "<h>"
    words = tabulated(["name", "if"], [["a", "2 points"], ["b", "they had"], ["c", "it were"]])
    assert {one["class"] for tag, one in words.tags if tag in ("th", "td")} == {""}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (159090.4, "159\u202f090"),
        (-12345.6, "−12\u202f346"),
        (-1.5e-7, "−1.5e-07"),
        (0.0, "0"),
        (12.3456789, "12.346"),
    ],
)
def test_numbers_have_five_digits(value, text):
    assert grouped(value) == text


def test_directions_are_named_by_their_largest_parts():
    parts = {E: -0.8, K_N: 0.5, "pad.tau": -0.25, "contact.mu_s": 0.21}
    assert direction_name(Direction(0.1, True, parts)) == f"0.80 {E} − 0.50 {K_N} + 0.25 pad.tau …"
    assert direction_name(Direction(0.1, True, {E: -0.9999})) == E


def test_autocorrelation_is_numpys():
    r = np.cumsum(np.random.default_rng(0).standard_normal(200))
    rho = autocorrelation(r)
    assert len(rho) == 20
    for k in (1, 7, 20):
        c = r - r.mean()
        assert rho[k - 1] == pytest.approx(np.correlate(c, c, "full")[199 + k] / (c @ c), rel=1e-12)
    assert len(autocorrelation(r[:3])) == 0
    assert not autocorrelation(np.ones(100)).any()


def texts(figure: Figure) -> list[tuple[str, Any]]:
    """Visible texts with the boxes [px] they are drawn in."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    beyond = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):  # ticks that are there but not drawn
            low, high = sorted(axis.get_view_interval())
            beyond |= {
                id(tick.label1)
                for tick in axis.get_major_ticks()
                if not low <= tick.get_loc() <= high
            }
            beyond |= {id(tick.label1) for tick in axis.get_minor_ticks()}
    out = []
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and id(text) not in beyond:
            out.append((text.get_text(), text.get_window_extent(canvas.get_renderer())))
    return out


FIGURES: dict[str, Callable[[IdentificationResult, Problem], Figure | None]] = {
    "estimates": lambda answer, _: estimates_figure(answer.estimates),
    "correlation": lambda answer, _: correlation_figure(answer),
    "spectrum": lambda answer, _: spectrum_figure(answer),
    "trace": lambda answer, problem: trace_figure(
        traces(answer, problem, None)[0][0], answer.residuals[0]
    ),
    "coloured": lambda answer, problem: trace_figure(
        traces(answer, problem, None)[0][2], answer.residuals[2], NOISE
    ),
}


@pytest.mark.parametrize("which", FIGURES)
def test_no_text_of_a_picture_is_cut_or_overlaps(full, found, which):
    figure = FIGURES[which](full, found[1])
    drawn, (width, height) = texts(figure), figure.canvas.get_width_height()
    assert len(drawn) > 5
    for i, (text, box) in enumerate(drawn):
        assert box.x0 > -1, text
        assert box.y0 > -1, text
        assert box.x1 < width + 1, text
        assert box.y1 < height + 1, text
        for other, its in drawn[:i]:
            apart = (
                box.x1 <= its.x0 + 1
                or its.x1 <= box.x0 + 1
                or box.y1 <= its.y0 + 1
                or its.y1 <= box.y0 + 1
            )
            assert apart, f"{text!r} lies over {other!r}"
