"""Figures, diagram and animation of a short run: the reconstructed meshes are right, and everything
draws something."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import coarse
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from torchsoft import (
    Body,
    Circle,
    Contact,
    Ellipse,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
    Trajectory,
    simulate,
)
from torchsoft.physics.mesh import lame_moduli
from torchsoft.plot import figures
from torchsoft.plot.animation import animate
from torchsoft.plot.diagram import dot, graph_of, multibond_graph, positions
from torchsoft.plot.scene import deformed_mesh, instants, straight_up
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


def test_a_spoke_ends_on_the_outline() -> None:
    square = np.array([[-1.0, -2.0], [3.0, -2.0], [3.0, 1.0], [-1.0, 2.0], [-1.0, -2.0]])
    np.testing.assert_allclose(straight_up(square), [0.0, 1.75], rtol=1e-15)
    np.testing.assert_allclose(straight_up(Circle(2.0).outline().numpy()), [0.0, 2.0], atol=1e-3)
    np.testing.assert_allclose(straight_up(square + [2.0, 0.0]), [0.0, 0.0], rtol=1e-15)


@pytest.mark.parametrize("enclosed", [False, True])
@pytest.mark.parametrize("which", ["L", "U"])
def test_deformed_mesh_is_the_surface_and_an_interior_in_equilibrium(
    which: str, enclosed: bool
) -> None:
    model, run = manipulated(pad__enclosed=enclosed)
    pad, u = model.pads[which], run.displacement[which]
    mesh = deformed_mesh(pad, u)
    assert mesh.shape == (21, 61 * 3, 2)
    nodes = mesh.reshape(21, -1, 2)
    surface = nodes[:, pad.mesh.free[pad.mesh.surface]]
    np.testing.assert_allclose(surface, (pad.positions + u).numpy(), rtol=1e-9, atol=1e-15)
    displacement = nodes @ pad.axes.numpy()
    displacement = displacement - displacement[:, :1] - (pad.mesh.nodes - pad.mesh.nodes[0])
    assert np.abs(displacement[:, pad.mesh.bonded]).max() < 1e-15
    K_lambda, K_mu, _ = pad.mesh.matrices
    lame_lambda, lame_mu = lame_moduli(1.0, model.settings.pad.nu)
    force = (
        pad.mesh.assemble(lame_lambda * K_lambda + lame_mu * K_mu)
        @ displacement[-1, pad.mesh.free].ravel()
    )
    force = force.reshape(-1, 2)
    interior = np.delete(force, pad.mesh.surface, axis=0)
    assert np.abs(interior).max() < 1e-11 * np.abs(force).max()


def test_friction_is_drawn_towards_the_right(done: Done) -> None:
    """In the grasp the pads are squeezed outwards, so friction on them points inwards, whichever
    pad."""
    (instant,) = instants(*done, [0.2])
    for k in "LU":
        x, friction = instant.points[k][:, 0], instant.force[k][:, 1]
        left, right = friction[x < 59], friction[x > 61]
        assert left.sum() > 0 > right.sum()


def hand() -> Rig:
    """An egg against a wall and a ball on the floor, and a finger that comes down from above and
    turns."""
    rubber = KelvinVoigt(1e6, 0.3, 1100.0, 0.05, 0.02)
    mesh = PadMesh(0.06, 0.006, 30, 3)
    law = SoftContact(
        5e4, 20.0, 2e4, 5.0, friction=SmoothSlip(0.8, 0.5, 0.05, 10.0), node_spacing=2e-3
    )
    return Rig(
        bodies={
            "egg": Body(0.2, Ellipse(0.02, 0.014)), "ball": Body(0.1, Circle(0.01)),
            "finger": Body(0.5, x="driven", y=0.032, theta="driven", weighted=False),
        },
        pads={
            "floor": Pad(PadMesh(0.12, 0.006, 60, 3), rubber, origin=(-0.06, -0.006)),
            "wall": Pad(mesh, rubber, angle=-np.pi / 2, origin=(-0.05, 0.06)),
            "tip": Pad(mesh, rubber, base="finger", angle=np.pi / 2, origin=(0.008, -0.03)),
        },
        contacts={
            "egg on floor": Contact("floor", "egg", law),
            "ball on floor": Contact("floor", "ball", law),
            "egg at wall": Contact("wall", "egg", law), "egg at tip": Contact("tip", "egg", law),
        },
        reference=Reference(
            **{"finger.x": Profile([0.0, 0.1], [-2e-3, -0.009]),
            "finger.theta": Profile([0.0, 0.1], [0.0, 0.08])}
        ),
    )  # fmt: skip


@pytest.fixture(scope="module")
def held() -> tuple[Rig, Trajectory]:
    """The egg between wall, floor and finger."""
    rig = hand()
    state = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64))
    start = {"egg": [-0.0241, 0.0139, 0.0], "ball": [0.045, 0.0099, 0.0]}
    pose = state.pose | {
        name: torch.tensor(place, dtype=torch.float64) for name, place in start.items()
    }
    t = torch.linspace(0, 0.12, 13, dtype=torch.float64)
    return rig, simulate(rig, t, y0=rig.pack(state._replace(pose=pose)), step=1e-3)


def test_any_rig_is_drawn_where_its_bodies_are(held: tuple[Rig, Trajectory]) -> None:
    rig, run = held
    (instant,) = instants(rig, run, [0.12])
    assert all(bool((force[:, 0] > 0).any()) for force in instant.force.values())
    x, y, angle = run.state.pose["finger"][-1].tolist()
    c, s = np.cos(angle), np.sin(angle)
    face = rig.pads["tip"].mesh.nodes[rig.pads["tip"].mesh.bonded] @ np.array(
        [[0.0, 1.0], [-1.0, 0.0]]
    ) + [
        0.008,
        -0.03,
    ]
    expected = 1e3 * (face @ np.array([[c, s], [-s, c]]) + [x, y])
    np.testing.assert_allclose(
        instant.mesh["tip"][rig.pads["tip"].mesh.bonded], expected, atol=1e-9
    )
    surface = instant.points["egg at tip"]
    touching = instant.force["egg at tip"][:, 0] > 0
    centre, turn = instant.pose["egg"][:2], instant.pose["egg"][2]
    d = (surface[touching] - centre) @ np.array(
        [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    )
    assert bool(
        ((d / [20.0, 14.0]) ** 2).sum(-1).max() < 1
    )  # a point that is loaded is inside the egg
    figure = figures.snapshots(run, rig, [0.0, 0.12])
    axes = figure.axes[0]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for mesh in instant.mesh.values():
        assert left <= mesh[..., 0].min() < mesh[..., 0].max() <= right
        assert low <= mesh[..., 1].min() < mesh[..., 1].max() <= high
    assert len(axes.patches) == 3 + 2 + 3  # pads, bodies with a shape, plates behind the pads


def test_energies_of_any_rig_are_all_in_the_balance(held: tuple[Rig, Trajectory]) -> None:
    _, run = held
    drawn = sum(part for _, part, _ in figures.energy_groups(run))
    total = sum([*run.energy.values(), *run.dissipated.values()])
    np.testing.assert_allclose(drawn, 1e3 * total.numpy(), rtol=1e-12)


DRAWN: dict[str, Callable[[Rig, Trajectory], Figure]] = {
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


@pytest.mark.parametrize(
    ("rig", "name"),
    [*(("done", name) for name in DRAWN)]
    + [
        ("held", name)
        for name in ("snapshots", "force_distribution", "energy_balance", "multibond_graph")
    ],
)
def test_figure_draws_something(rig: str, name: str, request: pytest.FixtureRequest) -> None:
    figure = DRAWN[name](*request.getfixturevalue(rig))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert float(np.asarray(canvas.buffer_rgba())[..., :3].std()) > 5
    if rig == "held":
        return
    for axes in figure.axes:
        if axes.get_visible() and axes.axison:
            assert axes.has_data()
            assert axes.get_ylabel() or name == "snapshots"
    assert figure.get_suptitle()
    assert name == "energy_balance" or "paper: Fig" in figure.get_suptitle()


def test_save_writes_the_whole_file_or_none(done: Done, tmp_path: Path) -> None:
    figures.save(figures.bracket_moment(done[1]), tmp_path / "moment.png", dpi=50)
    assert [path.name for path in tmp_path.iterdir()] == ["moment.png"]
    with Image.open(tmp_path / "moment.png") as picture:
        assert picture.format == "PNG"


@pytest.mark.parametrize("build", [coarse, lambda: coarse(pad__fidelity="inertial"), hand])
def test_diagram_places_every_node_of_the_graph_by_itself(build: Callable[[], Rig]) -> None:
    rig = build()
    graph = graph_of(rig)
    assert {"egg_spin", "contact_egg at tip", "pad_tip: field"} <= set(graph) or isinstance(
        rig, SoftGrasp
    )
    at = positions(graph)
    assert set(at) == set(graph)
    points = np.array(list(at.values()))
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(len(points))
    assert apart.min() > 0.5
    assert dot(rig).startswith("digraph")


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
