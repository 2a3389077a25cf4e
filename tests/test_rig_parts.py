"""Every shape, material, pad and control law that a rig file may have, and rigs that make no
sense."""

import io
import json
import re
import subprocess
import sys
import tomllib
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch
from conftest import f64, nested
from hostile.damage import document
from torch import nn

from torchsoft import Pad, PadMesh, Trajectory
from torchsoft.cli import main
from torchsoft.materials.presets import PRESETS
from torchsoft.physics.material import GeneralisedKelvin, KelvinVoigt, Prony
from torchsoft.physics.mesh import CurvedPadMesh, FingertipMesh, Mesh, QuadMesh
from torchsoft.physics.shapes import Contour, RoundedBox, RoundedPolygon, Superellipse
from torchsoft.rigs import RigFile
from torchsoft.rigs import run as running
from torchsoft.rigs.check import check
from torchsoft.rigs.geometry import collision, surface
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

SHAPES: dict[str, tuple[dict[str, Any], type]] = {
    "superellipse": ({"a": 20e-3, "b": 20e-3, "n": 3.0}, Superellipse),
    "rounded_box": ({"half_width": 20e-3, "half_height": 20e-3, "radius": 6e-3}, RoundedBox),
    "rounded_polygon": ({"vertices": SQUARE, "radius": 5e-3}, RoundedPolygon),
    "contour": ({"file": "pear.csv"}, Contour),
}
MATERIALS: dict[str, tuple[dict[str, Any], type]] = {
    "generalised_kelvin": (RUBBER | {"J": [0.3, 0.5], "tau": [1e-2, 1e-1]}, GeneralisedKelvin),
    "prony": (RUBBER | {"moduli": [2e5, 3e5], "tau": [2e-2, 2e-1]}, Prony),
    "preset": ({"name": "Dragon Skin 20", "depth": 44e-3}, KelvinVoigt),
    "file": ({"file": "material.toml", "depth": 30e-3}, Prony),
}
PADS: dict[str, tuple[dict[str, Any], type[Mesh]]] = {
    "curved": (COARSE | {"radius": 0.2}, CurvedPadMesh),
    "fingertip": (TIP, FingertipMesh),
    "mesh": (
        {"file": "pad.msh", "unit": "mm", "material": "rubber", "origin": [-40e-3, 0.0]},
        QuadMesh,
    ),
}


def slow(*kinds: str) -> list[Any]:
    return [pytest.param(kind, marks=pytest.mark.slow) for kind in kinds]


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
    save_network(path / "law.npz", network())
    return path


def save_network(path: Path, net: nn.Module) -> None:
    np.savez(path, **{name: value.numpy() for name, value in net.state_dict().items()})


def network() -> nn.Sequential:
    """A network whose first layer brings metres and metres a second to one."""
    net = nn.Sequential(nn.Linear(4, 5), nn.Tanh(), nn.Linear(5, 1)).double()
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for p in net.parameters():
            p.copy_(torch.randn(p.shape, generator=generator, dtype=torch.float64))
        net[0].weight.mul_(f64(50.0, 1.0, 50.0, 1.0))
    return net


def changed(tree: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A tree with others put into it; a table of another kind replaces the whole."""
    for name, value in changes.items():
        old = tree.get(name)
        inner = (
            isinstance(old, dict)
            and isinstance(value, dict)
            and value.get("kind", old.get("kind")) == old.get("kind")
        )
        tree[name] = changed(dict(old), value) if inner and isinstance(old, dict) else value
    return {name: value for name, value in tree.items() if value is not None}


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
    file = RigFile.from_tree(changed(coarse_tree(), changes))
    file._folder = folder
    return file


def runs(file: RigFile) -> Trajectory:
    """The first tenth of a second of a rig that checks clean."""
    doubts = [str(one) for one in check(file) if one.severity != "note"]
    assert [one for one in doubts if "cannot roll" not in one] == []  # it is rolled by 20 mm later
    done = running.carry_out(file.override(outputs={"duration": 0.12}))
    assert done.stopped is None
    assert done.trajectory.energy_residual_rel < 1e-3
    return done.trajectory


# shapes, materials, pads
# ----------------------------------------------------------------------


def in_a_rig(kind: str, table: dict[str, Any]) -> dict[str, Any]:
    """Changes of the template that put a part of a kind into it."""
    if kind in SHAPES:
        return {
            "bodies": {
                "disc": {
                    "shape": {"kind": kind} | table,
                    "mass": None,
                    "density": 7800.0,
                    "depth": 20e-3,
                    "start": {"theta": 0.0 if kind == "circle" else "rest"},
                }
            }
        }
    if kind in MATERIALS:
        return {"materials": {"rubber": {"kind": kind} | table}}
    pads = {
        "lower": {"kind": kind} | table,
        "upper": {"kind": kind, "base": "bracket", "mirrored": True} | table,
    }
    higher = {
        "bodies": {"bracket": {"start": {"y": 80.1e-3}}},
        "motion": {"y_d": {"values": ["start", 79e-3]}},
    }
    return {"pads": pads} | (higher if kind == "fingertip" else {})


RUN = [
    "rounded_box",
    "curved",
    *slow("superellipse", "rounded_polygon", "contour", "fingertip", "mesh"),
]


@pytest.mark.parametrize("kind", [*MATERIALS, *RUN])
def test_every_kind_of_part_is_built_written_and_runs(kind, folder):
    table, made = (SHAPES | MATERIALS | PADS)[kind]
    file = rig(folder, **in_a_rig(kind, table))
    built = file.build().rig
    disc, pad = built.bodies["disc"], built.pads["lower"]
    assert made in (type(disc.shape), type(pad.material), type(pad.mesh))
    again = RigFile.from_tree(tomllib.loads(to_toml(file)))
    assert again.model_dump() == file.model_dump()
    if kind in SHAPES:
        assert disc.mass.item() == pytest.approx(7800 * 20e-3 * disc.shape.area().item(), rel=1e-12)
        assert disc.inertia.item() == pytest.approx(
            disc.mass.item() * disc.shape.gyration().item(), rel=1e-12
        )
    if kind in MATERIALS:
        assert pad.material.depth.item() == table["depth"]
        assert (
            kind != "preset"
            or pad.material.E.item() == PRESETS["Dragon Skin 20"].coefficients["E"].value
        )
        assert kind != "file" or pad.material.get_parameter("E_1").item() == 1e5
    else:
        assert float(runs(file).loads["disc"][0, 1]) == pytest.approx(
            disc.mass.item() * 9.81, rel=1e-3
        )  # it rests


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


def test_the_middle_of_a_hollow_pad_is_below_its_ends(folder):
    """And what lies in the hollow does not overlap it."""
    hollow = COARSE | {"kind": "curved", "radius": -0.05, "height": 3e-3}
    file = rig(folder, pads={"lower": hollow}, bodies={"disc": {"start": {"x": 0.0}}})
    ready = file.build()
    pose = {name: x.numpy() for name, x in ready.rig.unpack(ready.y0).pose.items()}
    at = surface(ready.rig.pads["lower"], pose)
    sag = 0.05 - (0.05**2 - 0.04**2) ** 0.5
    assert at.depth(np.array([0.0, 3e-3])) == pytest.approx(0.0, abs=1e-12)
    assert at.depth(np.array([39.999e-3, 3e-3])) == pytest.approx(sag, rel=1e-2)
    pads = dict(ready.rig.pads)
    for bottom, overlap in ((6e-3, False), (2e-3, True)):
        inner = file.override(
            pads={"upper": {"length": 10e-3, "elements_x": 8, "base": None, "mirrored": False}}
        )
        inner = inner.override(
            pads={"upper": {"origin": [-5e-3, bottom]}}, contacts={"upper": {"may_leave": True}}
        )
        small = inner.pads["upper"].build(ready.rig.pads["lower"].material, folder)
        assert (collision(pads["lower"], small, pose) > 1e-6) == overlap


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
        PadMesh(length=0.05, height=0.05, elements_x=40, elements_y=40),
        CurvedPadMesh(length=0.1, height=2e-2, elements_x=100, elements_y=10, radius=0.1),
        FingertipMesh(radius=1e-2, elements_around=64),
    ],
    ids=["block", "square", "curved", "fingertip"],
)
def test_a_mesh_is_counted_before_it_is_built(mesh):
    """As it is counted of itself, as of those in files."""
    assert mesh.counts()[:2] == (len(mesh.face), len(mesh.free))
    surface, free, band = Mesh.counts(mesh)
    assert mesh.memory == pytest.approx(
        8 * 4 * free * (4 * surface + 4 * min(band, free // band)) / 2**30, rel=0.3
    )


CONDENSING = """
from torchsoft import CurvedPadMesh, PadMesh
from torchsoft.physics.mesh import unit_compliance

def memory(name):
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(name)) / 2**20

unit_compliance(PadMesh(0.1, 0.01, 40, 4), 0.45)
mesh = {}
_ = mesh.matrices, mesh.surface
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")  # the peak begins anew
before = memory("VmRSS")
unit_compliance(mesh, 0.45)
print((memory("VmHWM") - before) / mesh.memory)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="the peak of memory is Linux's"
)
@pytest.mark.parametrize("mesh", [
    "PadMesh(0.1, 5e-3, 600, 4)", "PadMesh(0.05, 0.05, 100, 100)",
    "CurvedPadMesh(0.1, 2e-2, 400, 24, radius=0.1)",
])  # fmt: skip
def test_the_memory_of_a_pad_is_estimated_before_it_is_built(mesh):
    """By the order of what condensing takes at its peak, in a process of its own: freed memory of
    another mesh would be used again."""
    code = CONDENSING.format(mesh)
    taken = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0.6 < float(taken.stdout) < 1.3


# control laws
# ----------------------------------------------------------------------


def test_a_network_from_a_file_is_the_module_in_python(folder):
    file = rig(folder, actuators={"x": {"network": "law.npz"}}, outputs={"duration": 0.12})
    ready = file.build()
    run = running.carry_out(file).trajectory
    law = ready.rig.actuators["x"]
    x = f64(1e-2, 0.1, 5e-3, -0.2)
    net = network()
    with torch.no_grad():
        expected = 1e5 * 5e-3 + 400 * 0.3 + net(x)[0]
        assert float(law(x)) == pytest.approx(float(expected), rel=1e-12)
    with torch.no_grad():
        at = torch.stack((run["x_d"], run["x_d_dot"], run["x_bracket"], run["v_x_bracket"]), -1)
        loop = 1e5 * (at[:, 0] - at[:, 2]) + 400 * (at[:, 1] - at[:, 3])
        assert torch.allclose(run["effort_x"], loop + net(at)[:, 0], rtol=1e-9, atol=1e-9)
    assert run.energy_residual_rel < 1e-3


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        (
            {"0.weight": np.zeros((1, 3)), "0.bias": np.zeros(1)},
            r"0\.weight has the shape \(1, 3\)",
        ),
        ({"0.weight": np.zeros((2, 4)), "0.bias": np.zeros(2)}, r"must have \(1, 4\) and \(1,\)"),
        ({"a": np.zeros(3)}, r"it has a, but a network has 0\.weight, 0\.bias"),
        (
            {"0.weight": np.full((1, 4), np.nan), "0.bias": np.zeros(1)},
            r"0\.weight must be finite numbers",
        ),
        ({"0.weight": np.zeros((600, 4)), "0.bias": np.zeros(600)}, r"more than 2000 numbers"),
        (
            {"0.weight": np.array([object()]), "0.bias": np.zeros(1)},
            r"is not an \.npz file of numbers: Object arrays",
        ),
    ],
)
def test_weights_that_are_no_network_are_refused(tmp_path, arrays, sentence):
    np.savez(tmp_path / "law.npz", allow_pickle=True, **arrays)
    (found,) = check(rig(tmp_path, actuators={"x": {"network": "law.npz"}}))
    assert (found.severity, found.where) == ("error", "actuators.x.network")
    assert re.search(sentence, found.message), found.message


# rigs that make no sense
# ----------------------------------------------------------------------

SOFT = {"kind": "kelvin_voigt", "E": 1e5, "nu": 0.45, "tau": 10e-3, "depth": 44e-3}
WET = {
    "K_n": 1e5,
    "R_n": 400.0,
    "K_t": 1e5,
    "R_t": 400.0,
    "friction": {"kind": "smooth", "mu_s": 0.2, "mu_k": 0.1},
}

STONE = {"x": 0.3e-3, "y": 30e-3, "theta": 0.0, "shape": {"kind": "circle", "radius": 5e-3}}

REFUSED: dict[str, tuple[dict[str, Any], *tuple[str, ...]]] = {
    "misspelt": ({"pads__lower__lenght": 0.1},
        r"pads\.lower: `lenght` is not known here; did you mean `length`\?"),
    "millimetres": ({"pads__lower__length": 80.0},
        r"pads\.lower\.length: should be from 1e-06 to 10 m, not 80"),
    "freedom": ({"bodies__bracket__theta": "locked"}, r'bodies\.bracket\.theta: should be "free", '
                                                      r'"driven" or a number'),
    "sort": ({"bodies__disc__shape__kind": "heart"},
        r"bodies\.disc\.shape\.kind should be one of .*'circle'.*, not 'heart'"),
    "no mass": ({"bodies__bracket__mass": None},
        r"bodies\.bracket: mass is missing, but x and y can move freely"),
    "no start": ({"bodies__bracket__start": {"y": None}},
        r"bodies\.bracket: start\.y is missing: y is free"),
    "start of what is fixed": ({"bodies__bracket__start__theta": 0.1},
        r"bodies\.bracket: start\.theta has no meaning"),
    "no such base": ({"pads__upper__base": "braket"},
        r"pads\.upper\.base: there is no `braket` among bodies; there is disc"),
    "pad on its own body": ({"pads__lower__base": "disc"},
        r"contacts\.lower: the pad `lower` is bonded to the body `disc`"),
    "nothing to touch with": ({"contacts__lower__body": "bracket"},
        r"contacts\.lower\.body: `bracket` has no shape"),
    "pushes what is fixed": ({"actuators__x__pushes": "bracket.theta"},
        r"actuators\.x\.pushes: bracket\.theta is fixed at 0"),
    "no such coordinate": ({"actuators__x__pushes": "bracket.z"},
        r"`bracket\.z` is not a coordinate; free ones are disc\.x"),
    "loop without a motion": ({"actuators__x__setpoint": None},
        r"actuators\.x: setpoint is missing: the gains Kp, Kd and Ki need"),
    "motion that nothing follows": ({"motion__wave": {"kind": "hold"}},
        r"motion\.wave: nothing follows it"),
    "material of nothing": ({"materials__gel": SOFT},
        r"materials\.gel: no pad is made of it; name it as the material of one"),
    "law of nothing": ({"laws__wet": WET},
        r"laws\.wet: no contact follows it; name it as the law of one"),
    "motion that is missing": ({"actuators__x__setpoint": "w"},
        r"motion\.w is missing: it is the setpoint of bracket\.x"),
    "time goes back": ({"motion__x_d__times": (1.5, 0.5)},
        r"motion\.x_d.*: times must increase, but 0\.5 s follows 1\.5 s"),
    "two ways to step": ({"solver": {"step": 1e-3, "rtol": 1e-4}},
        r"solver: step and rtol .*each say which steps to take"),
    "one motion, two units": ({"actuators__y__feed_forward": "x_d"},
        r"motion\.(x_d would be in two units|press: nothing)"),
    "name": ({"bodies": {"my disc": {"x": 0.0, "y": 0.0, "theta": 0.0}}},
        r"bodies\.my disc: the name should be letters"),
    "taken": ({"bodies": {"keys": {"x": 0.0, "y": 0.0, "theta": 0.0}}},
        r"bodies\.keys: the name is taken by torch"),
    "overlap": ({"bodies": {"stone": STONE}},
        r"error: bodies\.disc: it and bodies\.stone overlap by .* mm at t = 0 s"),
    "no room": ({"motion__y_d__values": ("start", 40e-3)},
        r"error: contacts\.upper: `disc` does not fit: at t = 0\.4 s"),
    "strain": ({"motion__y_d__values": ("start", 45.8e-3)},
        r"warning: pads\.\w+: the strain leaves linear elasticity: at"),
    "nothing carries it": (
        {"bodies": {"ball": {"mass": 0.1, "shape": {"kind": "circle", "radius": 5e-3},
        "start": {"x": 0.0, "y": 0.1}}}},
        r"error: bodies\.ball: nothing carries it: it has no contact with any pad",
    ),
    "beside the pad": (
        {"bodies__disc__start": {"x": 0.1, "y": 0.03}},
        r"error: bodies\.disc: nothing carries it: no pad that it has a contact with lies under it",
    ),
    "no rest beside the pad": ({"bodies__disc__start__x": 0.1}, r'error: bodies\.disc\.start\.y: '
                                                                r'"rest", but no pad'),
    "set-point elsewhere, corners between the points": (
        {"motion__x_d__values": (10e-3, 20e-3),
         "bodies": {"disc": {"shape": {"kind": "rounded_box", "half_width": 2e-2,
         "half_height": 2e-2, "radius": 5e-4},
         "start": {"theta": "rest"}}}},
        r"warning: motion\.x_d: it begins at 0\.01 m, but bracket\.x at 0 m: `actuators\.x` pushes "
        r"with 1e\+03 at once",
        r"warning: bodies\.disc\.shape: its sharpest corner has a radius of 0\.5 mm",
    ),
    "never touches": ({"motion__y_d__values": ("start", 50.05e-3),
    "motion__press__values": (0.0, 0.0)},
                      r"warning: contacts\.upper: `lower` and `upper` never press `disc`"),
    "a meganewton": (
        {"motion__press__values": (0.0, -1e6)},
        r"error: motion\.press: at t = 2 s it pushes `bracket` with 1e\+06 N, but"
    ),
    "through the disc": (
        {"motion__y_d__values": ("start", -0.05)},
        r"error: pads\.lower: it and pads\.upper overlap by .* mm at t = 0\.2 s",
    ),
    "between points": (
        {"bodies__disc__shape__radius": 1e-5},
        r"error: bodies\.disc\.start\.y: 0\.02 mm wide, it falls between points of `lower`"
    ),
    "too stiff to rest": (
        {"laws__dry__K_n": 1e9}, r"error: laws\.dry\.K_n: no rest is found with 1e\+09 N/m, .* "
                                 r"take 4e\+05 N/m or less"
    ),
    "steps, slip and outputs": (
        {"solver": {"step": 0.05}, "laws__dry__friction__v_s": 1e-4,
         "motion__x_d": {"kind": "chirp", "amplitude": 1e-3, "first": 1.0, "last": 50.0}},
        r"warning: solver\.step: steps of 0\.05 s are too coarse: motion\.y_d goes",
        r"warning: laws\.dry\.friction: slip is not single-valued",
        r"warning: outputs\.interval: outputs every 0\.01 s do not show motion\.x_d, which goes up "
        r"to 50 Hz; take 0\.005 s",
    ),
    "start of an effort": (
        {"motion__press__values": ("start", -30.0)}, r'error: motion\.press\.values: "start" '
                                                     r'stands for where the one free'
    ),
    "no time for waves": (
        {"motion__x_d": {"kind": "sines", "components": [{"amplitude": 1e-3, "frequency": 5.0}],
        "since": 1.9}},
        r"error: motion\.x_d\.since = 1\.9 s leaves 0\.1 s until 2 s, but waves take 0\.3 s",
    ),
    "no file": (
        {"motion__x_d": {"kind": "csv", "file": "none.csv", "column": "x_d"}},
        r"error: motion\.x_d\.file: .*none\.csv: No such"
    ),
    "an unstable loop": (
        {"materials": {"rubber": {"tau": 1e-4}},
        "actuators": {"x": {"measures": "disc.x", "Kp": 1e6, "Kd": 10.0}},
         "bodies": {"bracket": {"start": {"y": 49.5e-3}}}, "motion": {"y_d": {"kind": "hold"}}},
        r"the rig is unstable at t = ",
    ),
    "too slim": (
        {"bodies": {"disc": {"shape": {"kind": "ellipse", "a": 40e-3, "b": 10e-3}}}},
        r"bodies\.disc\.shape: the axes a and b differ by more than a factor of 3",
    ),
    "sides that cross": (
        {"bodies": {"disc": {"shape": {"kind": "rounded_polygon",
        "vertices": [SQUARE[i] for i in (0, 2, 1, 3)],
                                       "radius": 1e-3}}}},
        r"bodies\.disc\.shape: `vertices` cannot be used as a polygon",
    ),
    "two masses": (
        {"bodies": {"disc": {"density": 7800.0, "depth": 1e-2}}},
        r"mass and density each say how heavy it is; give one"
    ),
    "density of nothing": (
        {"bodies": {"bracket": {"mass": None, "density": 7800.0, "depth": 1e-2}}},
        r"bodies\.bracket: shape is missing"
    ),
    "depth without density": ({"bodies": {"disc": {"depth": 1e-2}}},
        r"bodies\.disc: density is missing: depth is given"),
    "no such rubber": (
        {"materials": {"rubber": {"kind": "preset", "name": "Dragon", "depth": 1e-2}}},
        r"there is no preset `Dragon`; did you mean `Dragon Skin 30`?",
    ),
    "hardness beside a modulus": (
        {"materials": {"rubber": {"shore_a": 30}}},
        r"materials\.rubber: E and shore_a each say how stiff it is; give one of them",
    ),
    "an inertial series": (
        {"materials": {"rubber": {"kind": "prony", **RUBBER, "moduli": [1e5], "tau": [0.1]}},
         "pads": {"lower": {"inertial": True}}},
        r"error: pads\.lower\.inertial: an inertial pad has one retardation time",
    ),
    "more than memory": (
        {"pads": {"lower": {"kind": "fingertip", "material": "rubber", "radius": 1e-2,
        "elements_around": 4000}}}, r"elements_around = 4000 take about",
    ),
    "an arc that is too short": (
        {"pads": {"lower": COARSE | {"kind": "curved", "radius": 30e-3}}},
        r"pads\.lower: `radius` must be at least half of the length",
    ),
    "a mesh that is none": (
        {"pads": {"lower": {"kind": "mesh", "material": "rubber", "file": "pear.csv",
        "unit": "mm"}}}, r"error: pads\.lower\.file:",
    ),
    "a program for weights": (
        {"actuators": {"x": {"network": "law.pt"}}},
        r"error: actuators\.x\.network: .*law\.pt is not an \.npz file: weights are data, and "
        r"other files may be programs",
    ),
}  # fmt: skip
"""Changes of the template, by nested names or by `__` for a dot, and the sentences that say what is
wrong."""


@pytest.fixture(scope="module")
def said(folder):
    """Status and words of `torchsoft check` on the template, changed: right or wrong."""

    def check_file(changes: dict[str, Any]) -> tuple[int, str]:
        tree = coarse_tree()
        for name, value in changes.items():
            tree = changed(tree, nested(name, value))
        (folder / "asked.toml").write_text(document(tree), encoding="utf-8")
        with redirect_stdout(io.StringIO()) as out, redirect_stderr(out):
            return main(["check", str(folder / "asked.toml")]), out.getvalue()

    return check_file


@pytest.fixture(scope="module")
def quiet(said):
    return said({})[1]


@pytest.mark.parametrize("name", REFUSED)
def test_a_rig_that_makes_no_sense_is_refused(name, said, quiet):
    changes, *sentences = REFUSED[name]
    status, words = said(changes)
    for sentence in sentences:
        assert re.search(sentence, words), words
        assert not re.search(sentence, quiet)
        assert status == (0 if sentence.startswith("warning") else 2)


def test_a_run_that_ends_where_it_begins_has_its_summary(folder, tmp_path):
    running.run(rig(folder, pads={"upper": {"origin": (5.0, 0.0)}}), tmp_path)
    numbers = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert numbers["simulated_s"] == 0.0
    assert "`disc` was lost: it left the space over the pad `upper`" in numbers["stopped"]


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
    for law, name in (("none", "no function"), ("torch", "no function")):
        with pytest.raises(ValueError, match=f"laws.dry.friction.law: .*{name}"):
            of_a_file(tmp_path, law).build()
    (tmp_path / "law.py").unlink()
    with pytest.raises(ValueError, match="is not a Python file"):
        file.build()
