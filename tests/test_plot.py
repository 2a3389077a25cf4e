"""Figures, diagram and animation of a short run: the reconstructed meshes are right, and everything
draws something."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from conftest import COARSE, coarse, fingers, paper, times
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.distance import pdist

from torchsoft import Rig, Trajectory
from torchsoft.physics.mesh import lame_moduli
from torchsoft.physics.pads import von_mises
from torchsoft.plot import figures
from torchsoft.plot.animation import animate, frame_times
from torchsoft.plot.dashboard import dashboard, energy_groups
from torchsoft.plot.diagram import LAYER, graph_of, multibond_graph, positions
from torchsoft.plot.scene import instants


def manipulated(changes: Mapping[str, Any] = {}) -> tuple[Rig, Trajectory]:
    """The first 0.2 s of the grasp on a coarse mesh."""
    built = paper(COARSE | changes)
    return built.rig, built.run(times(0.2, 21))


@pytest.fixture(scope="module")
def done():
    return manipulated()


@pytest.fixture(scope="module")
def held():
    return fingers()


@pytest.mark.parametrize("enclosed", [False, True])
def test_a_deformed_mesh_is_the_surface_and_an_interior_in_equilibrium(enclosed):
    model, run = manipulated({f"pads.{name}.bonded_sides": enclosed for name in "LU"})
    moduli = lame_moduli(1.0, model.parameter("pad.nu").item())
    for name, pad in model.pads.items():
        mesh, own, u = pad.mesh, run.setup.pads[name], run.displacement[name]
        nodes = own.placed(mesh.nodes + own.displacement(u.numpy()))
        surface = nodes[:, mesh.free[mesh.surface]]
        np.testing.assert_allclose(surface, (pad.positions + u).numpy(), rtol=1e-9, atol=1e-15)
        moved = nodes @ pad.axes.numpy()
        moved = moved - moved[:, :1] - (mesh.nodes - mesh.nodes[0])
        assert np.abs(moved[:, mesh.bonded]).max() < 1e-15
        K = mesh.stiffness(*moduli)
        force = (K @ moved[-1, mesh.free].ravel()).reshape(-1, 2)
        inside = np.delete(force, mesh.surface, axis=0)
        assert np.abs(inside).max() < 1e-11 * np.abs(force).max()


def test_stress_of_a_uniform_strain_is_hookes(done):
    """Plane strain: every element of a pad that is stretched and sheared alike."""
    pad = done[1].setup.pads["U"]
    gradient = np.array([[0.01, 0.004], [0.002, -0.02]])
    u = pad.mesh.nodes @ gradient.T
    strain = pad.strain(u)
    np.testing.assert_allclose(strain, np.tile([0.01, -0.02, 0.003], (len(strain), 1)), atol=1e-14)
    lame_lambda, mu = lame_moduli(pad.E.item(), pad.material.nu.item())
    stress = lame_lambda * np.trace(gradient) * np.eye(3)
    stress[:2, :2] += mu * (gradient + gradient.T)
    expected = [*np.diag(stress), stress[0, 1]]
    np.testing.assert_allclose(pad.stress(u)[3], expected, rtol=1e-10)
    deviator = stress - np.eye(3) * np.trace(stress) / 3
    mises = np.sqrt(1.5 * (deviator**2).sum())
    np.testing.assert_allclose(von_mises(pad.stress(u)), mises, rtol=1e-9)


def test_friction_is_drawn_towards_the_right(done):
    """In the grasp the pads are squeezed outwards, so friction on them points inwards, whichever
    pad."""
    (instant,) = instants(done[1], [0.2])
    for k in "LU":
        x, friction = instant.points[k][:, 0], instant.force[k][:, 1]
        left, right = friction[x < 59], friction[x > 61]
        assert left.sum() > 0 > right.sum()


def test_any_rig_is_drawn_where_its_bodies_are(held):
    """A pad with the finger that carries it, and loaded points inside the disc."""
    rig, run = held
    (instant,) = instants(run, [0.5])
    assert all(bool((force[:, 0] > 0).any()) for force in instant.force.values())
    turned = lambda a: np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    x, y, angle = run.state.pose["left"][-1].tolist()
    assert angle > 0.01
    mesh = rig.pads["left_tip"].mesh
    face = mesh.nodes[mesh.bonded] @ turned(-np.pi / 2) + [0.0, 18e-3]
    expected = 1e3 * (face @ turned(angle) + [x, y])
    np.testing.assert_allclose(instant.mesh["left_tip"][mesh.bonded], expected, atol=1e-9)
    for name, force in instant.force.items():
        loaded = instant.points[name][force[:, 0] > 0]
        assert np.linalg.norm(loaded - instant.pose["disc"][:2], axis=1).max() < 15.0


def test_energies_of_any_rig_are_all_in_the_balance(held):
    _, run = held
    drawn = sum(part for _, part, _ in energy_groups(run))
    total = sum([*run.energy.values(), *run.dissipated.values()])
    np.testing.assert_allclose(drawn, 1e3 * total.numpy(), rtol=1e-12)


DRAWN = {
    "dashboard": ("held", dashboard),
    "page": ("done", lambda run: dashboard(run, look="page")),
    "column": ("held", lambda run: dashboard(run, look="column", only=("scene", "left.x"))),
    "snapshots": ("held", lambda run: figures.snapshots(run, (0.1, 0.2, 0.3, 0.4))),
    "snapshots by default": ("done", figures.snapshots),
    "multibond graph": ("held", lambda run: multibond_graph(run.rig)),
}


@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_holds_all_that_it_draws(name, request):
    """With labels, and without a title where it is for print."""
    rig, draw = DRAWN[name]
    figure = draw(request.getfixturevalue(rig)[1])
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert float(np.asarray(canvas.buffer_rgba())[..., :3].std()) > 5
    assert bool(figure.get_suptitle()) == (name not in ("page", "column"))
    if name == "multibond graph":
        return
    titles = [title[0] for axes in figure.axes if (title := axes.get_title(loc="left"))]
    assert titles == sorted(titles)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert all(axes.has_data() for axes in shown if axes.get_label() != "<colorbar>")
    box = figure.get_tightbbox(canvas.get_renderer()).transformed(figure.dpi_scale_trans)
    assert min(*box.min, *(figure.bbox.size - box.max)) >= -2


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda run: run.plot(look="pgae"), "one of screen, page, column.* did you mean `page`"),
        (lambda run: run.plot(only=["disc.yy"]), "no panel `disc.yy`; did you mean `disc.y`"),
        (lambda run: run.plot(time=40.0), "nothing at 40 s: the run goes from 0 to 0.2 s"),
        (lambda run: run.animate("run.avi"), r"must end in \.gif or \.mp4"),
        (lambda run: run.animate("run.gif", follow="disk.x"), r"`follow` is .* mean `disc\.x`"),
        (lambda run: run.animate("run.html", frames=1), "`frames` must be 2 or more"),
    ],
)
def test_a_picture_that_there_is_not_is_rejected(done, draw, message):
    with pytest.raises(ValueError, match=message):
        draw(done[1])


def test_text_of_a_saved_page_is_text_in_a_font_that_journals_take(done, tmp_path):
    dashboard(done[1], look="page", only=["disc.y"]).savefig(tmp_path / "page.pdf")
    assert b"Type3" not in (tmp_path / "page.pdf").read_bytes()


def test_panels_show_what_their_axes_name(done, held):
    """The friction over the largest that the cone allows [%], and moments [N mm]."""
    run, mu = done[1], done[0].parameter("contact.mu_s").item()
    lines = dashboard(run, only=["share of the friction limit"]).axes[0].lines
    for force, line in zip(run.force.values(), lines):
        share = 100 * force[..., 1].abs().sum(-1) / (mu * force[..., 0].sum(-1))
        np.testing.assert_allclose(line.get_ydata()[5:], share[5:], rtol=1e-9)
    run = held[1]
    axes = dashboard(run, only=["effort_left_turn"]).axes[0]
    assert "N mm" in axes.get_ylabel()
    moment = 1e3 * run["effort_left_turn"]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), moment, rtol=1e-9)
    assert float(moment.abs().max()) > 1.0


@pytest.mark.parametrize(
    ("curve", "length"),
    [
        (lambda t: np.minimum(t / 0.4, 1.0) + 0.01 * np.sin(20 * t), 0.5),  # a grasp, and ripples
        (lambda t: np.where(t > 0.1, np.minimum(t / 0.2, 1.0), np.nan), 0.2),  # no value at first
        (np.sin, None),  # as much change everywhere
        (lambda t: 0.0 * t, None),
    ],
)
def test_a_start_with_most_of_the_change_gets_a_third_of_the_time_axis(curve, length):
    t = np.linspace(0.0, 30.0, 3001)
    axes = Figure().subplots()
    axes.plot(t, curve(t))
    axes.set_xlim(0.0, 30.0)
    figures.finish_time_axis(axes)
    place = axes.transData.transform([(length or 10.0, 0.0)])
    assert axes.transAxes.inverted().transform(place)[0, 0] == pytest.approx(1 / 3, abs=1e-9)
    assert (f"first {length} s enlarged" in axes.get_xlabel()) == bool(length)


@pytest.mark.parametrize(
    "only", [["scene"], ["friction"], ["stress", "scene"], ["disc.y", "friction", "disc.y"]]
)
def test_a_dashboard_of_some_panels_draws_each_once(done, only):
    figure = dashboard(done[1], only=only, time=0.1)
    titles = [title for axes in figure.axes if (title := axes.get_title(loc="left")[3:])]
    expected = ["t = 0.1 s" if name == "scene" else name for name in {*only}]
    assert sorted(titles) == sorted(expected)


@pytest.mark.parametrize("inertial", [False, True])
def test_diagram_places_every_node_of_the_graph_by_itself(held, inertial):
    rig = coarse(pad__inertial=True) if inertial else held[0]
    graph = graph_of(rig)
    assert {"disc_spin", *(f"pad_{name}: field" for name in rig.pads)} <= set(graph)
    assert {f"contact_{name}" for name in rig.contacts} <= set(graph)
    at = positions(graph)
    assert set(at) == set(graph)
    assert pdist(np.array(list(at.values()))).min() > 0.5
    for tail, head, signal in graph.edges(data="activated"):  # bonds join neighbouring layers
        assert signal or abs(at[tail][1] - at[head][1]) < LAYER + 1e-9


def test_animation_moves(done, tmp_path):
    animate(done[1], tmp_path / "run.gif", frames=4)
    assert [path.name for path in tmp_path.iterdir()] == ["run.gif"]
    with Image.open(tmp_path / "run.gif") as gif:
        assert (gif.n_frames, gif.info["duration"]) == (4, 80)
        first = np.asarray(gif.convert("RGB"), dtype=float)
        gif.seek(3)
        assert np.abs(np.asarray(gif.convert("RGB")) - first).max() > 50


def test_a_slow_start_takes_an_eighth_of_the_pictures(done):
    np.testing.assert_allclose(frame_times(done[1], 5, 0.0), [0.0, 0.05, 0.1, 0.15, 0.2])
    times = frame_times(done[1], 17, 0.06)
    np.testing.assert_allclose(times[[0, 1, 2, 9, 16]], [0.0, 0.03, 0.06, 0.13, 0.2])
