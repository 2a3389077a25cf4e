"""The interactive player, in a real browser where there is one."""

import base64
import copy
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import MISSING, browser
from conftest import COARSE, fingers, paper, times
from matplotlib.figure import Figure
from PIL import Image

from torchsoft import Trajectory
from torchsoft.plot.animation import charts, frame_rows, player
from torchsoft.plot.scene import Scene, curve_height, instants

SEEN = "return [...document.querySelectorAll('.chart span')].map(x => x.textContent)"
SLIDE = """const s = document.getElementById('slider'); s.value = arguments[0];
s.dispatchEvent(new Event('input')); return document.getElementById('clock').textContent"""
SPOT = """const c = data.contacts[arguments[0]], i = arguments[1], o = 2 * (frame * c.count + i);
const at = place(pose(data.pads[c.pad].base, frame), c.points[o], c.points[o + 1]);
const r = document.getElementById('scene').getBoundingClientRect();
const q = toScreen(at, r.width, r.height);
return [r.x + q[0], r.y + q[1]]"""


@pytest.fixture(scope="module")
def run():
    return paper(COARSE).run(times(0.5, 51))


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    if MISSING:
        pytest.skip(MISSING)
    path = tmp_path_factory.mktemp("player") / "run.html"
    player(run, path, frames=30, title="A grasp & </script> more")
    with browser() as page:
        page.open(path)
        yield page


def held(path: Path) -> dict[str, Any]:
    """The data in a page."""
    return json.loads(re.search(r"const data = (\{.*\});\n", path.read_text("utf-8"))[1])


def test_the_file_holds_everything(run, tmp_path):
    """And asks for nothing: no address, no module, no other file. No title holds the script open:
    a comment that begins a script lasts to the end of the page."""
    title = "<!--<script></script><script>alert(1)</script> & friends"
    run.animate(path := tmp_path / "run.html", frames=20, title=title)
    text, data = path.read_text(encoding="utf-8"), held(path)
    shell = text.replace(json.dumps(data), "")
    assert text.count("</script>") == 1
    assert not re.search(r"https?://|src=|import |fetch\(|XMLHttp|@import|url\(", shell)
    assert data["title"] == title
    assert len(data["times"]) <= 20
    assert {"disc", "bracket"} == {*data["bodies"]}


def test_the_file_holds_the_pressure_in_every_element(run, tmp_path):
    player(run, tmp_path / "run.html", frames=10)
    shown, pad = held(tmp_path / "run.html")["pads"]["L"]["fields"]["pressure"], run.setup.pads["L"]
    codes = np.frombuffer(base64.b64decode(shown["codes"]), "<u2").reshape(shown["shape"])
    stress = pad.stress(pad.displacement(run.displacement["L"][frame_rows(run, 10)].numpy()))
    expected = -1e-3 * stress[..., :3].mean(-1)
    np.testing.assert_allclose(shown["low"] + shown["step"] * codes, expected, atol=shown["step"])


def with_forces(run: Trajectory, force: dict[str, torch.Tensor]) -> Trajectory:
    changed = copy.copy(run)
    changed.force = force
    return changed


def first_shown(run: Trajectory, path: Path) -> int:
    player(run, path, frames=30)
    data = held(path)
    row = run.at(data["times"][data["opening"]])
    largest = max(float(x[row].abs().max()) for x in run.force.values())
    assert data["scale"] * largest <= curve_height(run.setup) * (1 + 1e-9)  # it fits the picture
    return row


def test_it_opens_when_all_contacts_are_closed(run, tmp_path):
    row = first_shown(run, tmp_path / "run.html")
    lower, upper = (run.force[name][..., 0].sum(-1) for name in "LU")
    assert min(lower[row], upper[row]) > 10.0
    assert 0 < row < run.at(0.375)
    never = run.force | {"U": torch.zeros_like(run.force["U"])}
    row = first_shown(with_forces(run, never), tmp_path / "run.html")
    assert lower[row] > 0.5 * lower.max() > lower[row - 2]
    impact = torch.ones(51, 1, 1)
    impact[24:27] = 100.0
    struck = with_forces(run, {name: impact * x for name, x in run.force.items()})
    assert 24 <= first_shown(struck, tmp_path / "run.html") <= 26


NODE = shutil.which("node")
LOADED = re.compile(r"<script>\n(.*?)const whole = extent\(\);", re.S)
CURVES = """const curves = Object.fromEntries(Object.entries(data.contacts).map(
  ([name, c]) => [name, data.times.map((_, f) => [0, 1].map(j => curve(c, f, j)))]));
console.log(JSON.stringify({ scale: data.scale, curves }));"""


@pytest.mark.skipif(NODE is None, reason="node is not installed")
@pytest.mark.parametrize("rig", ["grasp", "fingers"])
def test_force_curves_are_those_of_the_snapshots(rig, run, tmp_path):
    """They stand on a straight line behind the pad, wherever the surface has given way."""
    shown = run if rig == "grasp" else fingers()[1]
    player(shown, tmp_path / "run.html", frames=10)
    script = LOADED.search((tmp_path / "run.html").read_text(encoding="utf-8"))
    assert NODE
    assert script
    stub = "const document = { getElementById: () => ({ getContext: () => null }) };\n"
    done = subprocess.run(
        [NODE, "-"], input=stub + script[1] + CURVES, capture_output=True, text=True, check=True
    )
    drawn, rows = json.loads(done.stdout), frame_rows(shown, 10)
    compared, reversed_ = 0, 0
    for f, instant in enumerate(instants(shown, shown.t[rows].tolist())):
        scene = Scene(Figure().subplots(), shown.setup, [instant])
        scene.force_scale = drawn["scale"]
        scene.show(instant)
        for name in shown.setup.contacts:
            for j, areas in enumerate((scene.normal, scene.friction)):
                lines = np.array(drawn["curves"][name][f][j])
                if not len(lines):
                    continue
                around = np.concatenate((lines[:1, 0], lines[:, 1], lines[-1:, 0]))
                expected = areas[name].get_xy()[:-1]
                assert around == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())
                compared += 1
                reversed_ += float(instant.force[name][:, j].min()) < -1e-3
    assert compared > 20
    assert reversed_ > 0


def test_frames_are_denser_where_steps_are_short(run):
    rows = frame_rows(run, 20)
    assert (rows[0], rows[-1]) == (0, 50)
    assert np.all(np.diff(rows) > 0)
    t, knots = run.t.numpy()[rows], run.knots.numpy()
    middle = np.median(knots)
    assert (t < middle).sum() / middle > (t >= middle).sum() / (0.5 - middle)


def test_the_page_opens_with_its_first_frame_and_without_errors_or_a_network(page):
    assert page.run("return document.title") == "A grasp & </script> more"
    shown = page.run("return [frame, +$('slider').value, data.opening, time, data.times[frame]]")
    assert shown[0] == shown[1] == shown[2] > 0
    assert shown[3] == shown[4]
    assert [one for one in page.log("browser") if one["level"] == "SEVERE"] == []
    asked = [json.loads(one["message"])["message"] for one in page.log("performance")]
    asked = [one["params"] for one in asked if one["method"] == "Network.requestWillBeSent"]
    assert all(one["request"]["url"].startswith(("file:", "data:")) for one in asked), asked


def test_charts_follow_the_slider(page, run):
    choose = """const s = document.querySelector('.chart select');
    s.value = [...s.options].findIndex(o => o.textContent.startsWith(arguments[0]));
    s.dispatchEvent(new Event('change'))"""
    page.run(choose, "y of bracket")
    for frame in (0, 12, 29):
        clock = page.run(SLIDE, frame)
        time = float(clock.removeprefix("t = ").removesuffix(" s"))
        shown = {x.rsplit(" ", 1)[0]: float(x.rsplit(" ", 1)[1]) for x in page.run(SEEN)[:2]}
        row = run.at(time)
        assert shown["actual"] == pytest.approx(1e3 * float(run["y_Br"][row]), rel=1e-3)
        assert shown["set-point"] == pytest.approx(1e3 * float(run["y_d"][row]), rel=1e-3)


def test_forces_of_nothing_are_none(run):
    still = with_forces(run, {k: x * torch.tensor([1.0, 1e-13]) for k, x in run.force.items()})
    series = {one["name"]: one["series"] for one in charts(still, [*range(51)])}
    assert all(one["values"]["step"] == one["values"]["low"] == 0 for one in series["friction"])
    assert all(one["values"]["step"] > 0 for one in series["normal force"])


def test_a_point_tells_its_forces(page, run):
    page.run(SLIDE, 29)
    point = int(run.force["L"][-1, :, 0].argmax())
    x, y = page.run(SPOT, "L", point)
    page.act({"type": "pointerMove", "x": round(x), "y": round(y), "origin": "viewport"})
    tip = page.run("return document.getElementById('tip').textContent")
    normal, friction = run.force["L"][-1, point].tolist()
    said = dict(re.findall(r"^(.*?)\s\s+([-\d.e]+) N", tip, re.M))
    assert f"contact L, point {point}: sticks" in tip
    assert float(said["normal force"]) == pytest.approx(normal, rel=1e-3)
    assert abs(float(said["friction"])) == pytest.approx(abs(friction), abs=1e-3 * normal)
    assert float(said["cone"]) == pytest.approx(0.8 * normal, rel=1e-3)


def test_it_plays_zooms_and_switches(page, tmp_path):
    page.run(SLIDE, 0)
    before = page.run("return view.k")
    turn = {"type": "scroll", "x": 300, "y": 300, "deltaX": 0, "deltaY": -240, "origin": "viewport"}
    page.act(turn)
    assert page.run("return view.k") > 1.3 * before
    page.run("document.getElementById('fit').click()")
    assert page.run("return view.k") == pytest.approx(before)
    pictures = []
    for quantity in ("von Mises stress", "displacement", "plain"):
        page.run(SLIDE, 29)
        page.run(
            "const q = document.getElementById('quantity'); q.value = arguments[0]; q.onchange()",
            quantity,
        )
        (tmp_path / "page.png").write_bytes(page.picture())
        with Image.open(tmp_path / "page.png") as picture:
            pictures.append(np.asarray(picture.convert("RGB"), dtype=float))
    for one, other in ((0, 1), (1, 2)):
        assert np.abs(pictures[one] - pictures[other]).max() > 50
    page.run(SLIDE, 0)
    page.run("document.getElementById('speed').value = '0.5'; toggle()")
    assert any(page.run("return frame") > 3 for _ in range(40))
    page.run("stop()")
    assert [one for one in page.log("browser") if one["level"] == "SEVERE"] == []
