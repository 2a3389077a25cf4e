"""Figures, diagram and animation of a short run: the reconstructed meshes are right, and everything draws something."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import coarse
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from torchsoft import SoftGrasp, Trajectory, simulate
from torchsoft.pad import lame_moduli
from torchsoft.plot import figures
from torchsoft.plot.animation import animate
from torchsoft.plot.diagram import dot, graph_of, multibond_graph, positions
from torchsoft.plot.scene import deformed_mesh, instants
from torchsoft.scenario import grasp_and_roll

Done = tuple[SoftGrasp, Trajectory]


def manipulated(**changes: object) -> Done:
    """The first 0.2 s of the grasp on a coarse mesh, with a force that need not be looked for."""
    model = coarse(**changes)
    start = grasp_and_roll(model, grasp_force=80.0)
    return model, simulate(model, torch.linspace(0, 0.2, 21, dtype=torch.float64), y0=start.y0)


@pytest.fixture(scope="module")
def done() -> Done:
    return manipulated()


@pytest.mark.parametrize("enclosed", [False, True])
@pytest.mark.parametrize("which", ["L", "U"])
def test_deformed_mesh_is_the_surface_and_an_interior_in_equilibrium(which: str, enclosed: bool) -> None:
    model, run = manipulated(pad__enclosed=enclosed)
    s, pad = run.state, model.pads[which]
    u, base = (s.u_L, torch.zeros_like(s.r_Br)) if which == "L" else (s.u_U, s.r_Br)
    mesh = deformed_mesh(model, which, u, base)
    assert mesh.shape == (21, 61, 3, 2)
    nodes = mesh.reshape(21, -1, 2)
    surface = nodes[:, pad.mesh.free[pad.mesh.surface]]
    expected = (pad.positions + u + base[:, None]).numpy()
    np.testing.assert_allclose(surface, expected, rtol=1e-9, atol=0)
    displacement = (nodes - base[:, None].numpy()) * pad.mirror.numpy()
    displacement = displacement - displacement[:, :1] - (pad.mesh.nodes - pad.mesh.nodes[0])
    assert np.abs(displacement[:, pad.mesh.bonded]).max() < 1e-15
    K_lambda, K_mu, _ = pad.mesh.matrices
    lame_lambda, lame_mu = lame_moduli(1.0, model.settings.pad.nu)
    force = pad.mesh.assemble(lame_lambda * K_lambda + lame_mu * K_mu) @ displacement[-1, pad.mesh.free].ravel()
    force = force.reshape(-1, 2)
    interior = np.delete(force, pad.mesh.surface, axis=0)
    assert np.abs(interior).max() < 1e-11 * np.abs(force).max()


def test_both_fidelities_draw_the_same_pads() -> None:
    meshes = []
    for fidelity in ("massless", "inertial"):
        model, run = manipulated(pad__fidelity=fidelity)
        meshes.append(instants(model, run, [0.2])[0].mesh)
    for k in "LU":
        assert np.abs(meshes[0][k] - meshes[1][k]).max() < 1e-3  # [mm], of a compression of some 0.3 mm
        assert np.abs(meshes[0][k] - meshes[1][k]).max() > 0


def test_friction_is_drawn_towards_the_right(done: Done) -> None:
    """In the grasp the pads are squeezed outwards, so friction on them points inwards, whichever pad."""
    (instant,) = instants(*done, [0.2])
    for k in "LU":
        x, friction = instant.surface[k][:, 0], instant.force[k][:, 1]
        left, right = friction[x < 59], friction[x > 61]
        assert left.sum() > 0 > right.sum()


DRAWN: dict[str, Callable[[SoftGrasp, Trajectory], Figure]] = {
    "motion": lambda m, r: figures.motion(r),
    "control_forces": lambda m, r: figures.control_forces(r),
    "bracket_moment": lambda m, r: figures.bracket_moment(r),
    "angular_momentum": lambda m, r: figures.angular_momentum(r),
    "force_distribution": lambda m, r: figures.force_distribution(r, m, 0.125),
    "snapshots": lambda m, r: figures.snapshots(r, m, (0.05, 0.1, 0.15, 0.2)),
    "snapshots_of_the_end": lambda m, r: figures.snapshots(r, m),
    "energy_balance": lambda m, r: figures.energy_balance(r),
    "friction_comparison": lambda m, r: figures.friction_comparison({"one": (m, r), "two": (m, r)}),
    "multibond_graph": lambda m, r: multibond_graph(m),
}


@pytest.mark.parametrize("name", DRAWN)
def test_figure_draws_something(name: str, done: Done) -> None:
    figure = DRAWN[name](*done)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert float(np.asarray(canvas.buffer_rgba())[..., :3].std()) > 5
    for axes in figure.axes:
        if not axes.get_visible() or not axes.axison:
            continue
        assert axes.has_data()
        assert axes.get_ylabel() or name == "snapshots"
    title = figure.get_suptitle()
    assert title
    if name != "energy_balance":
        assert "paper: Fig" in title


def test_save_writes_the_whole_file_or_none(done: Done, tmp_path: Path) -> None:
    figures.save(figures.bracket_moment(done[1]), tmp_path / "moment.png", dpi=50)
    assert [path.name for path in tmp_path.iterdir()] == ["moment.png"]
    with Image.open(tmp_path / "moment.png") as picture:
        assert picture.format == "PNG"


def test_diagram_places_every_node_of_the_graph_by_itself() -> None:
    for fidelity in ("massless", "inertial"):
        model = coarse(pad__fidelity=fidelity)
        graph = graph_of(model)
        at = positions(graph)
        assert set(at) == set(graph)
        points = np.array(list(at.values()))
        apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(len(points))
        assert apart.min() > 0.5
        assert dot(model).startswith("digraph")


def test_animation_moves(done: Done, tmp_path: Path) -> None:
    model, run = done
    animate(run, model, tmp_path / "run.gif", frames=4, dpi=40, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["run.gif"]
    with Image.open(tmp_path / "run.gif") as gif:
        assert gif.n_frames == 4
        pictures = []
        for i in (0, 3):
            gif.seek(i)
            pictures.append(np.asarray(gif.convert("RGB"), dtype=float))
    assert np.abs(pictures[0] - pictures[1]).max() > 50


def test_animation_in_an_unknown_format_is_refused(done: Done, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in \.gif or \.mp4"):
        animate(done[1], done[0], tmp_path / "run.avi")
