"""What a run shows of itself, gives to other libraries, and keeps in files."""

import json
import re
from html import unescape
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch
import xarray as xr
from conftest import COARSE, coarse, paper, random_state, rest, times, turning
from torch import Tensor

import torchsoft
from torchsoft import Rig, Trajectory, simulate, simulate_batch
from torchsoft.display import hidden
from torchsoft.physics.pads import von_mises
from torchsoft.rigs.written import template
from torchsoft.solve.netcdf import save
from torchsoft.sysid.columns import read_csv
from torchsoft.sysid.extensions import extend
from torchsoft.sysid.measured import vocabulary

T = times(0.1, 11)


def ran(changes: dict[str, Any]) -> tuple[Rig, Trajectory]:
    built = paper(COARSE | {"pad.elements_x": 30} | changes)
    return built.rig, built.run(T, gradient="forward", wrt=["pad.E"])


@pytest.fixture(scope="module")
def done():
    return ran({})


def equal(one: Any, other: Any) -> bool:
    if isinstance(one, Tensor):
        return torch.equal(one.detach(), other.detach())
    if isinstance(one, dict):
        return list(one) == list(other) and all(equal(one[k], other[k]) for k in one)
    return one == other


# files
# ----------------------------------------------------------------------


@pytest.mark.parametrize("inertial", [False, True])
def test_a_run_is_loaded_as_it_was(done, tmp_path, inertial):
    _, run = ran({"pad.inertial": True}) if inertial else done
    run.save(tmp_path / "run.nc")
    again = Trajectory.load(tmp_path / "run.nc")
    for name in (
        "t", "y", "channels", "force", "loads", "displacement", "energy", "dissipated", "supplied",
        "injected", "stats", "knots", "made_by", "wrt", "sensitivities", "contact_state",
        "energy_residual_rel",
    ):  # fmt: skip
        assert equal(getattr(run, name), getattr(again, name)), name
    for one, other in zip(run.state, again.state, strict=True):
        assert equal(one, other)
    assert again.wrt == ("materials.rubber.E",)
    assert again.units == {name: run.units[name] for name in run}
    assert again.rig is None


def without(name: str) -> Any:
    def change(data):
        data.attrs.pop(name, None)
        return data.drop_vars(name, errors="ignore")

    return change


def attribute(name: str, value: Any) -> Any:
    return lambda data: data.assign_attrs({name: json.dumps(value)})


def unit(name: str, units: str) -> Any:
    return lambda data: data.assign({name: data[name].assign_attrs(units=units)})


EDITED = {
    **{f"no {name}": (without(name), f"it has no `{name}`")
       for name in ("mesh_nodes_L", "setup", "stats")},
    "text": (lambda data: data.assign(x_C=("time", ["fast"] * len(T))), "`x_C` must be finite"),
    "three samples": (lambda data: data.assign(x_C=("i", np.zeros(3), data.x_C.attrs)),
        "`x_C` must be over ('time',), not ('i',)"),
    "furlong": (unit("effort_x", "furlong"), "`effort_x` must be `N`, not 'furlong'"),
    "time goes back": (lambda data: data.assign_coords(
        time=("time", data.time[::-1].values, data.time.attrs)),
        "`time` must increase strictly"),
    "stats": (attribute("stats", {"steps": 3}), "do not fit together"),
    "setup": (attribute("setup", {"bodies": {"disc": {"colour": 1}}}), "do not fit together"),
}  # fmt: skip


@pytest.mark.parametrize("kind", EDITED)
def test_a_file_that_was_edited_and_sealed_again_is_no_whole_run(done, tmp_path, kind):
    change, message = EDITED[kind]
    with xr.set_options(keep_attrs=True):
        save(change(done[1].to_xarray()), tmp_path / "run.nc")
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        Trajectory.load(tmp_path / "run.nc")
    assert str(caught.value).startswith(f"{tmp_path / 'run.nc'} is no whole run: ")


def test_vtk_files_are_read_back(tmp_path):
    """Also of pads whose base has turned."""
    rig = turning(pad__elements_x=30)
    run = simulate(rig, times(2e-3, 2), y0=random_state(rig, 0), step=1e-3)
    listed, *files = run.to_vtk(tmp_path / "run.pvd")
    assert all(path.name in listed.read_text(encoding="utf-8") for path in files)
    mesh, first = meshio.read(files[1]), 0
    for i, (name, pad) in enumerate(run.setup.pads.items()):
        count, rows = len(pad.mesh.nodes), mesh.cell_data["pad"][0] == i
        own = pad.displacement(run.displacement[name][-1].numpy())
        x, y, angle = run.state.pose[pad.base][-1].tolist() if pad.base else (0.0, 0.0, 0.0)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert (abs(angle) > 1e-3) == (pad.base == "bracket")
        where = slice(first, first + count)
        moved = own @ (turn @ pad.axes.numpy()).T
        written = mesh.point_data["displacement"][where, :2]
        np.testing.assert_allclose(written, moved, atol=1e-15)
        nodes = pad.placed(pad.mesh.nodes) @ turn.T + [x, y]
        np.testing.assert_allclose(mesh.points[where, :2], nodes, atol=1e-15)
        tensor, stress = mesh.cell_data["stress"][0][rows].reshape(-1, 3, 3), pad.stress(own)
        np.testing.assert_allclose(np.trace(tensor, axis1=1, axis2=2), stress[:, :3].sum(1))
        np.testing.assert_allclose(mesh.cell_data["von_mises"][0][rows], von_mises(stress))
        first += count
    with pytest.raises(ValueError, match=r"must end in \.pvd"):
        run.to_vtk(tmp_path / "run.vtk")


# tables, texts and pictures
# ----------------------------------------------------------------------


def test_channels_have_one_name_and_unit_everywhere(done, tmp_path):
    """In files and tables, as `identify` reads them, with a meaning, whatever the rig calls it."""
    run = done[1]
    data, table = run.to_xarray(), run.to_pandas()
    assert run.keys() == list(run) == list(table.columns) == run._ipython_key_completions_()
    for name in run:
        np.testing.assert_array_equal(data[name], run[name])
        np.testing.assert_array_equal(table[name], run[name])
        assert data[name].attrs["units"] == table.attrs["units"][name] == run.units[name]
    with pytest.raises(KeyError, match="no channel `x_c`; did you mean `x_C`"):
        run["x_c"]
    ready = template("t").build()
    run = simulate(ready.rig, ready.t[:12], y0=ready.y0)
    wanted = ["x_disc [m]", "theta_disc [rad]", "effort_x [N]", "y_d_dot [m/s]", "y_d [m]"]
    run.to_pandas(units=True)[wanted].to_csv(tmp_path / "run.csv")
    columns = read_csv(tmp_path / "run.csv", (), vocabulary(ready.rig, {})).values
    for name in ("theta_disc", "effort_x", "y_d_dot"):
        assert np.array_equal(columns[name], run[name].numpy())
    data = run.to_xarray()
    meanings = {name: data[name].attrs["long_name"] for name in run}
    assert meanings["x_d"] == "set-point of bracket.x"
    assert meanings["M_upper"] == "moment of the pad upper on its base"
    assert not [name for name, meaning in meanings.items() if "channel" in meaning]


def test_objects_show_themselves(done, tmp_path):
    """As text and as pages; figures as pictures, films as players."""
    model, run = done
    batch = simulate_batch(model, T[:3], y0=[run.y[0], run.y[-1]])
    for one, words in (
        (run, ("0 to 0.1 s, 11 samples", "x of disc", "N on")),
        (model, ("2 bodies, 2 pads", "Circle of radius 0.01937 m", "E 7.5e+05 Pa", "Kp")),
        (batch, ("2 runs, 0 failed", "x_C")),
    ):
        text, page = repr(one), one._repr_html_()
        assert len(text.splitlines()) <= 20
        assert all(word in text and word in page for word in words)
    assert run.plot()._repr_png_().startswith(b"\x89PNG")
    player = run.animate(tmp_path / "run.html", frames=2)
    page = re.fullmatch(r'<iframe srcdoc="([^"]*)" .*></iframe>', player._repr_html_())
    assert page
    assert unescape(page[1]) == (tmp_path / "run.html").read_text(encoding="utf-8")


def test_points_stick_slip_and_part_as_the_graph_says():
    """In a fast stroke that slips, where a pad has retardation times of its own."""
    built = paper(COARSE | {"contact.mu_s": 0.05, "contact.mu_k": 0.04})
    model = built.rig
    for name in ("pads.L.tau_ratio", "materials.rubber.slow(0.1 s)"):
        extend(model, [name])
        torch.nn.init.constant_(model.parameter(name), 0.5)
    t = times(3.0, 61)
    run = built.run(t, y0=built.start().detach())
    rows = torch.arange(0, len(t), 4)
    state, found = model.unpack(run.y[rows], model.follow(t[rows])), torch.zeros(3)
    for name, interface in model.evaluate(t[rows], state).interfaces.items():
        slips, touches = interface.law.slip > 0, interface.F_N > 0
        expected = torch.where(touches, 1 + slips.int(), 0)
        assert torch.equal(run.contact_state[name][rows].int(), expected)
        found += torch.bincount(expected.flatten(), minlength=3)
    assert bool((found > 0).all())


def test_a_progress_bar_is_shown_to_people_only(capfd):
    """Not in a file, to which it would write a line for every step of it."""
    simulate(coarse(), T[:3], y0=rest(coarse()).detach(), progress=True)
    assert capfd.readouterr().err == ""
    assert (hidden(True), hidden(False)) == (None, True)


# the package
# ----------------------------------------------------------------------


def test_a_star_imports_what_is_public():
    import pydoc

    names = {}
    exec("from torchsoft import *", names)
    assert {"RigFile", "simulate", "Rig", "Trajectory"} <= names.keys()
    assert "torch" not in names
    assert "simulate_batch" in pydoc.plain(pydoc.render_doc(torchsoft))
    assert all(hasattr(torchsoft, name) for name in dir(torchsoft))
    assert (Path(torchsoft.__file__).parent / "py.typed").is_file()
