"""The report: one page that stands alone, holds the whole result, and no number that the data do not determine."""

import base64
import json
import struct
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from torchsoft import Parameters
from torchsoft.excitation import Excitation, Strokes
from torchsoft.sysid import IdentificationResult, Problem, Sensor, Unknown, identify, record
from torchsoft.sysid.cost import paper_settings
from torchsoft.sysid.figures import correlation_figure, direction_name, estimates_figure, spectrum_figure, trace_figure
from torchsoft.sysid.prediction import FailedRun
from torchsoft.sysid.problem import Residuals
from torchsoft.sysid.report import report, starts, traces
from torchsoft.sysid.result import Direction, autocorrelation

STRANGE = 'a<b> & "$x_1$"'
"""A recording's name with everything in it that HTML or matplotlib would read as their own."""


@pytest.fixture(scope="module")
def found() -> tuple[IdentificationResult, Problem]:
    """A grasp, from which the viscosity of slip is not identifiable, and another one held out."""
    p = Parameters().override({"contact.v_s": 0.05})
    truth = p.override({"contact.K_n": 1.6e5, "pad.E": 0.9e6})
    sensors = {"theta": Sensor(noise=5e-4), "y_Br": Sensor(noise=1e-5), "F_y": Sensor(noise=0.1)}
    grasp = Excitation(motion=Strokes(), duration=0.25, depth=1.2e-3, senses="bracket", grasp_time=0.15)
    recordings = [
        record(name, grasp.model_copy(update={"depth": depth}), truth, p, sensors, rtol=1e-4, seed=seed)
        for seed, (name, depth) in enumerate(((STRANGE, 1.2e-3), ("held", 1e-3)))
    ]
    problem = Problem(recordings, sensors, {name: Unknown() for name in ("contact.K_n", "pad.E", "contact.eta")})
    return identify(problem, rtol=1e-3, tightenings=0, heldout=["held"]), problem


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


@pytest.fixture(scope="module")
def page(found: tuple[IdentificationResult, Problem], tmp_path_factory: pytest.TempPathFactory) -> Page:
    folder = tmp_path_factory.mktemp("report") / "new"
    report(*found, folder / "report.html")
    assert [path.name for path in folder.iterdir()] == ["report.html"]
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_the_page_stands_alone(page: Page) -> None:
    assert page.open == []
    assert {"script", "link", "iframe", "object"}.isdisjoint(tag for tag, _ in page.tags)
    pictures = [attributes for tag, attributes in page.tags if tag == "img"]
    assert len(pictures) == 3 + 2 * 3
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
    addresses = [v for _, attributes in page.tags for k, v in attributes.items() if k in ("src", "href")]
    assert len(addresses) == len(pictures)
    assert ("meta", {"name": "viewport", "content": "width=device-width,initial-scale=1"}) in page.tags


def test_the_page_holds_what_the_answer_holds(page: Page, found: tuple[IdentificationResult, Problem]) -> None:
    answer, _ = found
    known = [e for e in answer.estimates if e.identifiable]
    assert {e.name for e in known} >= {"pad.E"}
    assert not answer["contact.eta"].identifiable
    assert f"{len(known)} of {len(answer.estimates)} parameters identifiable" in page.text
    assert answer.notices
    for notice in answer.notices:
        assert notice in page.text
    assert page.text.index(answer.notices[0]) < page.text.index("Estimates")  # notices come first
    for e in known:
        for value in (e.value, *(e.ci95 or ())):
            assert value is not None
            assert f"{float(f'{value:.5g}'):.12g}" in page.text.replace("\u202f", "")
        assert "\ncontact.eta\nnot identifiable\nnone\nN.s/m\n10\nno\n" in page.text
    for channels in answer.heldout.values():
        for value in channels.values():
            assert f"{100 * value:.3g} %" in page.text
    for stage in answer.stages:
        assert stage["name"] in page.text
    assert STRANGE in page.text  # escaped once, and not twice
    assert "b" not in {tag for tag, _ in page.tags}
    decided = page.text[page.text.index("{\n") :]
    assert json.loads(decided.strip()) == json.loads(json.dumps(answer.made_by))


def test_predictions_are_the_models(found: tuple[IdentificationResult, Problem]) -> None:
    answer, problem = found
    drawn, lost = traces(answer, problem, None)
    assert not lost
    rms = {(t.recording, t.channel): float(np.sqrt(np.mean(t.residual**2))) for t in drawn}
    for channel in answer.residuals:
        assert rms[channel.recording, channel.channel] == pytest.approx(channel.rms, rel=1e-6)
    for trace in drawn:
        noise = problem.sensors[trace.channel].noise
        np.testing.assert_allclose(trace.predicted - trace.measured, noise * trace.residual, atol=1e-12)
        held = answer.heldout.get(trace.recording)
        if held is not None:
            nrmse = rms[trace.recording, trace.channel] * noise / np.ptp(trace.measured)
            assert nrmse == pytest.approx(held[trace.channel], rel=1e-6)


def test_starts_are_the_settings_values(found: tuple[IdentificationResult, Problem]) -> None:
    answer, problem = found
    table = paper_settings(problem.recordings[0]).table()
    assert starts(answer, problem) == pytest.approx([table[e.name]["value"] for e in answer.estimates])


def test_an_answer_to_other_data_is_refused(found: tuple[IdentificationResult, Problem], tmp_path: Path) -> None:
    answer, problem = found
    other = Problem(problem.recordings[:1], problem.sensors, problem.unknowns)
    with pytest.raises(ValueError, match="other recordings"):
        report(answer, other, tmp_path / "report.html")
    assert not any(tmp_path.iterdir())


def test_a_lost_recording_is_named_and_a_clean_answer_has_no_warnings(
    found: tuple[IdentificationResult, Problem], tmp_path: Path
) -> None:
    answer, problem = found

    class Losing(Problem):
        def residuals(self, runner: Any, x: Any, which: Any, steps: Any, free: Any = None) -> Residuals:
            got = super().residuals(runner, x, which, steps, free)
            return got._replace(lost={"held": FailedRun("it < went", 0.1)}) if "held" in which else got

    losing = Losing(problem.recordings, problem.sensors, problem.unknowns)
    report(replace(answer, notices=[]), losing, tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    text, alts = page.text, " ".join(str(attributes.get("alt")) for _, attributes in page.tags)
    assert "Could not be simulated: it < went" in text
    assert f"theta of {STRANGE}" in alts
    assert "theta of held" not in alts
    assert "nothing to warn of" in text


def test_directions_are_named_by_their_largest_parts() -> None:
    parts = {"pad.E": -0.8, "contact.K_n": 0.5, "pad.tau": -0.25, "contact.mu_s": 0.21}
    assert direction_name(Direction(0.1, True, parts)) == "0.80 pad.E − 0.50 contact.K_n + 0.25 pad.tau …"
    assert direction_name(Direction(0.1, True, {"pad.E": -0.9999})) == "pad.E"


def test_autocorrelation_is_numpys() -> None:
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
            beyond |= {id(tick.label1) for tick in axis.get_major_ticks() if not low <= tick.get_loc() <= high}
            beyond |= {id(tick.label1) for tick in axis.get_minor_ticks()}
    out = []
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_visible() and text.get_text().strip() and id(text) not in beyond:
            out.append((text.get_text(), text.get_window_extent(canvas.get_renderer())))
    return out


@pytest.mark.parametrize("which", ["estimates", "correlation", "spectrum", "trace"])
def test_no_text_of_a_picture_is_cut_or_overlaps(found: tuple[IdentificationResult, Problem], which: str) -> None:
    answer, problem = found
    figures = {
        "estimates": lambda: estimates_figure(answer, starts(answer, problem)),
        "correlation": lambda: correlation_figure(answer),
        "spectrum": lambda: spectrum_figure(answer),
        "trace": lambda: trace_figure(traces(answer, problem, None)[0][0], answer.residuals[0]),
    }
    figure = figures[which]()
    assert figure is not None
    drawn, (width, height) = texts(figure), figure.canvas.get_width_height()
    assert len(drawn) > 5
    for i, (text, box) in enumerate(drawn):
        assert box.x0 > -1, text
        assert box.y0 > -1, text
        assert box.x1 < width + 1, text
        assert box.y1 < height + 1, text
        for other, its in drawn[:i]:
            apart = box.x1 <= its.x0 + 1 or its.x1 <= box.x0 + 1 or box.y1 <= its.y0 + 1 or its.y1 <= box.y0 + 1
            assert apart, f"{text!r} lies over {other!r}"
