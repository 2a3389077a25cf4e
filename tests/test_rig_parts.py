"""Every shape, material, pad and control law that a rig file may have."""

import tomllib
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch
from conftest import f64
from torch import nn

from torchsoft import Body, Ellipse, Pad, PadMesh, Rig
from torchsoft.materials.presets import PRESETS
from torchsoft.physics.material import KelvinVoigt, Prony
from torchsoft.physics.mesh import CurvedPadMesh, FingertipMesh, Mesh, QuadMesh
from torchsoft.physics.shapes import Contour, RoundedBox, RoundedPolygon, Superellipse
from torchsoft.rigs import RigFile
from torchsoft.rigs.check import check
from torchsoft.rigs.geometry import Scene, collision
from torchsoft.rigs.naming import merged as changed
from torchsoft.rigs.written import template, to_toml

SQUARE = [[-20e-3, -20e-3], [20e-3, -20e-3], [16e-3, 20e-3], [-16e-3, 20e-3]]
RUBBER = {"E": 0.75e6, "depth": 44e-3}
COARSE = {
    "length": 80e-3, "height": 5e-3, "elements_x": 40, "elements_y": 2, "origin": [-40e-3, 0.0],
    "material": "rubber"
}  # fmt: skip
TIP = {
    "kind": "fingertip",
    "radius": 20e-3,
    "elements_around": 28,
    "origin": [-20e-3, 0.0],
    "material": "rubber",
}

SHAPES = {
    "superellipse": ({"a": 20e-3, "b": 20e-3, "n": 3.0}, Superellipse),
    "rounded_box": ({"half_width": 20e-3, "half_height": 20e-3, "radius": 6e-3}, RoundedBox),
    "rounded_polygon": ({"vertices": SQUARE, "radius": 5e-3}, RoundedPolygon),
    "contour": ({"file": "pear.csv"}, Contour),
}
MATERIALS = {
    "preset": ({"name": "Dragon Skin 20", "depth": 44e-3}, KelvinVoigt),
    "file": ({"file": "material.toml", "depth": 30e-3}, Prony),
}
PADS = {
    "curved": (COARSE | {"radius": 0.2}, CurvedPadMesh),
    "fingertip": (TIP, FingertipMesh),
    "mesh": (
        {"file": "pad.msh", "unit": "mm", "material": "rubber", "origin": [-40e-3, 0.0]},
        QuadMesh,
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With a contour, a material, a mesh and networks."""
    path = tmp_path_factory.mktemp("parts")
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    r = 20 * (1 + 0.1 * np.cos(3 * turn))
    rows = [f"{x},{y}" for x, y in zip(r * np.cos(turn) + 3, r * np.sin(turn))]
    (path / "pear.csv").write_text("\n".join(["x [mm],y [mm]", *rows]), encoding="utf-8")
    (path / "material.toml").write_text(
        '[materials.test]\nkind = "prony"\nE = 5e5\nmoduli = [1e5]\ntau = [0.1]\ndepth = 1e-2\n',
        encoding="utf-8",
    )
    mesh = PadMesh(80e-3, 5e-3, 40, 2)
    sides = [np.stack((mesh.edge(name)[:-1], mesh.edge(name)[1:]), -1) for name in ("face", "base")]
    tags = [np.full(len(mesh.elements), 3), np.full(len(sides[0]), 1), np.full(len(sides[1]), 2)]
    meshio.write(
        path / "pad.msh",
        meshio.Mesh(
            np.pad(1e3 * mesh.nodes, ((0, 0), (0, 1))),
            [("quad", mesh.elements), ("line", sides[0]), ("line", sides[1])],
            cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
            field_data={"face": np.array([1, 1]), "base": np.array([2, 1])},
        ),
        file_format="gmsh22",
    )
    weights = {name: value.numpy() for name, value in network().state_dict().items()}
    np.savez(path / "law.npz", **weights)
    return path


def network() -> nn.Sequential:
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(4, 5), nn.Tanh(), nn.Linear(5, 1)).double()


def coarse_tree() -> dict[str, Any]:
    """The template on a coarse mesh, its contact points on the nodes."""
    tree = template("t").model_dump(exclude_unset=True)
    return tree | {
        "pads": {
            name: pad | {"elements_x": 40, "elements_y": 2, "points": 0}
            for name, pad in tree["pads"].items()
        }
    }


def rig(folder: Path, **changes: Any) -> RigFile:
    """The template on a coarse mesh, changed."""
    return RigFile.from_tree(changed(coarse_tree(), changes), folder)


# shapes, materials, pads
# ----------------------------------------------------------------------


def in_a_rig(kind: str, table: dict[str, Any]) -> dict[str, Any]:
    """Changes of the template that put a part of a kind into it."""
    part = {"kind": kind} | table
    if kind in MATERIALS:
        return {"materials": {"rubber": part}}
    if kind in SHAPES:
        uniform = {"mass": None, "density": 7800.0, "depth": 20e-3, "start": {"theta": "rest"}}
        return {"bodies": {"disc": {"shape": part, **uniform}}}
    pads = {"lower": part, "upper": {"base": "bracket", "mirrored": True} | part}
    if kind != "fingertip":
        return {"pads": pads}
    higher = {"bracket": {"start": {"y": 80.1e-3}}, "disc": {"start": {"x": 0.0}}}  # on the top
    return {"pads": pads, "bodies": higher, "motion": {"y_d": {"values": ["start", 79e-3]}}}


QUICK = "rounded_box", "curved"
SLOW = sorted({*SHAPES, *PADS}.difference(QUICK))


@pytest.mark.parametrize(
    "kind", [*MATERIALS, *QUICK, *(pytest.param(one, marks=pytest.mark.slow) for one in SLOW)]
)
def test_every_kind_of_part_is_built_written_and_runs(kind, folder):
    table, made = (SHAPES | MATERIALS | PADS)[kind]
    file = rig(folder, **in_a_rig(kind, table))
    built = file.build().rig
    disc, pad = built.bodies["disc"], built.pads["lower"]
    assert made in (type(disc.shape), type(pad.material), type(pad.mesh))
    again = RigFile.from_tree(tomllib.loads(to_toml(file)))
    assert again.model_dump() == file.model_dump()
    if kind in MATERIALS:
        assert pad.material.depth.item() == table["depth"]
        dragon = PRESETS["Dragon Skin 20"].coefficients["E"].value
        assert kind != "preset" or pad.material.E.item() == dragon
        assert kind != "file" or pad.material.get_parameter("E_1").item() == 1e5
        return
    if kind in SHAPES:
        mass = 7800 * 20e-3 * disc.shape.area().item()
        assert disc.mass.item() == pytest.approx(mass, rel=1e-12)
        inertia = mass * disc.shape.gyration().item()
        assert disc.inertia.item() == pytest.approx(inertia, rel=1e-12)
    pressed = file.override(outputs={"duration": 0.4})
    assert [str(one) for one in check(pressed) if one.severity != "note"] == []
    run = pressed.build().run()
    assert run.energy_residual_rel < 1e-3
    load = float(run.loads["disc"][0, 1])
    assert load == pytest.approx(disc.mass.item() * 9.81, rel=1e-3)  # it rests


def test_parts_of_two_builds_are_not_the_same(folder):
    """A contour is fitted once, but parameters that one user trains are not another's."""
    file = rig(folder, bodies={"disc": {"shape": {"kind": "contour", "file": "pear.csv"}}})
    one, other = (file.build().rig.bodies["disc"].shape for _ in range(2))
    assert one.control is not other.control
    assert torch.equal(one.control, other.control)


def test_a_mesh_from_a_file_is_the_block_that_it_was_made_of(folder):
    table = {"kind": "mesh", **PADS["mesh"][0]}
    found = [
        float(rig(folder, **change).build().y0[:-12].abs().sum())
        for change in ({}, {"pads": {"lower": table}})
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_what_lies_in_the_hollow_of_a_pad_does_not_overlap_it(folder):
    hollow = COARSE | {"kind": "curved", "radius": -0.05, "height": 3e-3}
    lower = rig(folder, pads={"lower": hollow}).assemble().pads["lower"]
    for bottom, overlap in ((6e-3, False), (2e-3, True)):
        inner = Pad(PadMesh(10e-3, 5e-3, 8, 2), lower.material, origin=(-5e-3, bottom))
        assert (collision(lower, inner, {}) > 1e-6) == overlap


def test_a_point_in_a_turned_ellipse_is_inside_along_its_long_axis():
    rig = Rig(bodies={"body": Body(1.0, Ellipse(0.03, 0.015))}, pads={}, contacts={})
    scene = Scene(rig, {"body": np.array([0.01, 0.0, 0.5])})
    for angle, is_inside in ((0.5, True), (-0.5, False)):
        place = [0.01 + 0.028 * np.cos(angle), 0.028 * np.sin(angle)]
        assert (scene.inside("body", np.array([place])) > 0) == is_inside


def test_pads_that_cross_without_a_node_in_each_other_overlap():
    """Like a plus: their sides cross."""
    rubber = KelvinVoigt(E=1e6, nu=0.45, rho=1100.0, tau=0.01, depth=0.04)
    mesh = PadMesh(length=60e-3, height=4e-3, elements_x=2, elements_y=1)
    lying = Pad(mesh, rubber, origin=(-30e-3, -2e-3))
    for x, depth in ((3e-3, 2e-3), (40e-3, 0.0)):
        upright = Pad(mesh, rubber, origin=(x, -15e-3), angle=np.pi / 2)
        assert collision(lying, upright, {}) == pytest.approx(depth, abs=2e-3 if depth else 0.0)
        assert (collision(lying, upright, {}) > 0) == (depth > 0)


@pytest.mark.parametrize(
    "mesh",
    [
        PadMesh(length=0.1, height=5e-3, elements_x=120, elements_y=4),
        CurvedPadMesh(length=0.1, height=2e-2, elements_x=100, elements_y=10, radius=0.1),
        FingertipMesh(radius=1e-2, elements_around=64),
    ],
    ids=["block", "curved", "fingertip"],
)
def test_a_mesh_is_counted_before_it_is_built(mesh):
    """As it is counted of itself, as of those in files."""
    assert mesh.counts()[:2] == (len(mesh.face), len(mesh.free))
    surface, free, band = Mesh.counts(mesh)
    assert mesh.memory == pytest.approx(
        8 * 4 * free * (4 * surface + 4 * min(band, free // band)) / 2**30, rel=0.3
    )


# control laws
# ----------------------------------------------------------------------


@torch.no_grad()
def test_a_network_from_a_file_is_the_module_in_python(folder):
    """Beside the gains, which `reversed` turns round."""
    x = f64(1e-2, 0.1, 5e-3, -0.2)
    for sign in (1, -1):
        loop = {"network": "law.npz", "reversed": sign < 0}
        law = rig(folder, actuators={"x": loop}).build().rig.actuators["x"]
        expected = sign * (1e5 * 5e-3 + 400 * 0.3) + network()(x)[0]
        assert float(law(x)) == pytest.approx(float(expected), rel=1e-12)


# A friction law of a Python file

LAW = """import torch

def coulomb(E, F_N, R):
    return torch.clamp(E - 0.5 * F_N, min=0.0) / R
"""


def of_a_file(folder: Path, law: str = "coulomb") -> RigFile:
    (folder / "law.py").write_text(LAW)
    tree = RigFile.ready("drop").model_dump(mode="json", exclude_unset=True)
    tree["laws"]["dry"]["friction"] = {"kind": "python", "file": "law.py", "law": law}
    return RigFile.from_tree(tree, folder)


def test_a_law_of_a_python_file_is_run_where_the_user_says_so(tmp_path, monkeypatch):
    """It gives what the same law given in Python does; without a word of the user it is not run."""
    file = of_a_file(tmp_path)
    monkeypatch.delenv("TORCHSOFT_RUN_CODE", raising=False)
    with pytest.raises(ValueError, match=r"laws.dry.friction.file: .*TORCHSOFT_RUN_CODE=1"):
        file.build()
    monkeypatch.setenv("TORCHSOFT_RUN_CODE", "1")
    found = file.override({"outputs.duration": 0.1, "outputs.snapshots": []}).build().run(rtol=1e-3)
    given = RigFile.ready("drop").override({"outputs.duration": 0.1, "outputs.snapshots": []})
    expected = given.build({"laws.dry.friction": file.build().rig.contacts["ground"].law.friction})
    assert torch.equal(found["theta_ellipse"], expected.run(rtol=1e-3)["theta_ellipse"])
    with pytest.raises(ValueError, match=r"laws\.dry\.friction: must be one part, but is a dict"):
        given.build({"laws.dry.friction": {"dry": expected}})
    with pytest.raises(ValueError, match=r"laws.dry.friction.law: .*no function"):
        of_a_file(tmp_path, "none").build()
    (tmp_path / "law.py").unlink()
    with pytest.raises(ValueError, match="is not a Python file"):
        file.build()
