"""What a run shows of itself, gives to other libraries, and keeps in files."""

import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch
import xarray as xr
from conftest import COARSE, coarse, f64, paper, rest, times
from torch import Tensor

import torchsoft
from torchsoft import (
    Rig,
    Trajectory,
    simulate,
    simulate_batch,
)
from torchsoft.display import hidden
from torchsoft.physics.extensions import extend
from torchsoft.physics.setup import von_mises
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.rigs.written import template
from torchsoft.solve.formats import load, save
from torchsoft.solve.simulate import SharedStart
from torchsoft.solve.trajectory import Stats
from torchsoft.sysid.columns import read_csv
from torchsoft.sysid.measured import vocabulary

T = times(0.1, 11)


def ran(changes: dict[str, Any] | None = None) -> tuple[Rig, Trajectory]:
    built = paper(COARSE | (changes or {}))
    return built.rig, built.run(T)


@pytest.fixture(scope="module")
def done():
    return ran()


def equal(one: Any, other: Any) -> bool:
    if isinstance(one, Tensor):
        return torch.equal(one.detach(), other.detach())
    if isinstance(one, dict):
        return list(one) == list(other) and all(equal(one[k], other[k]) for k in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    return one == other


@pytest.mark.parametrize("inertial", [False, True])
def test_a_run_is_loaded_as_it_was(tmp_path, inertial):
    model, run = ran({"pad.inertial": inertial})
    run.save(tmp_path / "run.nc")
    again = Trajectory.load(tmp_path / "run.nc")
    for name in (
        "t", "y", "state", "channels", "force", "loads", "displacement", "energy", "dissipated",
        "supplied", "injected", "stats", "knots", "made_by", "wrt", "contact_state",
    ):  # fmt: skip
        assert equal(getattr(run, name), getattr(again, name)), name
    assert again.energy_residual_rel == run.energy_residual_rel
    assert again.layout.slices == run.layout.slices
    assert again.units == {name: run.units[name] for name in run}
    assert again.rig is None
    assert str(again) == str(run)
    resumed = simulate(model, T + T[-1], y0=again.y[-1])
    assert equal(resumed["x_C"], simulate(model, T + T[-1], y0=run.y[-1])["x_C"])


def test_sensitivities_are_loaded_too(tmp_path):
    model = coarse()
    run = simulate(model, T[:3], y0=rest(model).detach(), gradient="forward", wrt=["pad.E"])
    run.save(tmp_path / "run.nc")
    again = Trajectory.load(tmp_path / "run.nc")
    assert again.wrt == ("materials.rubber.E",)
    assert equal(run.sensitivities, again.sensitivities)


@pytest.mark.parametrize("gone", ["knots", "mesh_nodes_L", "x_C", "setup"])
def test_a_file_that_lacks_something_is_no_whole_run(done, tmp_path, gone):
    data = done[1].to_xarray()
    if gone == "setup":
        del data.attrs["setup"]
    save(data.drop_vars(gone, errors="ignore"), tmp_path / "run.nc")
    assert "effort_x" in load(tmp_path / "run.nc")
    with pytest.raises(ValueError, match=rf"run\.nc is no whole run: it has no `{gone}`"):
        Trajectory.load(tmp_path / "run.nc")


def text(data, name):
    return data.assign({name: ("time", ["fast"] * len(T))})


def about(name, value):
    return lambda data: data.assign_attrs({name: json.dumps(value)})


CHANGED = {
    "text": (lambda data: text(data, "x_C"), "`x_C` must be finite numbers"),
    "text of forces": (lambda data: data.assign(normal_force_L=data.normal_force_L.astype(str)),
        "`normal_force_L` must be finite numbers"),
    "nan": (lambda data: data.assign(y_C=data.y_C * np.nan), "`y_C` must be finite numbers"),
    "three samples": (lambda data: data.assign(x_C=("i", np.zeros(3), data.x_C.attrs)),
        "length 3 on {'time': 'x_C'}"),
    "over another": (lambda data: data.assign(x_C=("i", data.x_C.values, data.x_C.attrs)),
        "`x_C` must be over ('time',), not ('i',)"),
    "three poses": (lambda data: data.assign(pose=("i", np.zeros(3))), "do not fit together"),
    "furlong": (lambda data: data.assign(
        effort_x=data.effort_x.assign_attrs(units="furlong")),
        "the unit of `effort_x` must be `N`, not 'furlong'"),
    "furlong of another": (lambda data: data.assign(L=data.x_d.assign_attrs(units="m")).assign(
        x_d=data.x_d.assign_attrs(units="furlong")), "the unit of `x_d` must be `N`"),
    "turned": (lambda data: data.assign(x_C=data.x_C.assign_attrs(units="rad")),
        "the unit of `x_C` must be `m`, not 'rad'"),
    "no unit": (lambda data: data.assign(pose=data.pose * 1.0).assign(
        pose=lambda d: d.pose.drop_attrs()), "the unit of `pose` must be `m, m, rad`, not None"),
    "time goes back": (lambda data: data.assign_coords(time=data.time[::-1].values),
        "`time` must increase strictly"),
    "stats": (about("stats", {"steps": 3}), "do not fit together"),
    "stats in words": (about("stats", dict.fromkeys(vars(Stats(0, 0, 0, 0, 0.0)), "3")),
        "do not fit together"),
    "wrt as a word": (about("wrt", "materials.rubber.E"), "do not fit together"),
    "stats as a number": (about("stats", 3), "do not fit together"),
    "setup": (about("setup", {"bodies": {"disc": {"colour": "red"}}}), "do not fit together"),
    "parts": (about("parts", {"channels": [3]}), "it has no `3`"),
    **{name: (lambda data, name=name: data.drop_attrs().assign_attrs(
        {k: x for k, x in data.attrs.items() if k != name}), f"it has no `{name}`")
        for name in ("stats", "wrt", "touch", "parts")},
}  # fmt: skip
"""Files that were edited and sealed again, which were taken or ended in a traceback."""


@pytest.mark.parametrize("kind", CHANGED)
def test_a_file_that_was_edited_is_refused_in_a_sentence(done, tmp_path, kind):
    change, message = CHANGED[kind]
    with xr.set_options(keep_attrs=True):
        save(change(done[1].to_xarray()), tmp_path / "run.nc")
    with pytest.raises(ValueError, match=re.escape(message)) as refused:
        Trajectory.load(tmp_path / "run.nc")
    assert str(refused.value).startswith(f"{tmp_path / 'run.nc'} is no whole run: ")


def test_a_channel_with_the_name_of_another_array_is_not_saved(
    done,
):
    run = replace(done[1], channels=done[1].channels | {"pose": done[1].t})
    with pytest.raises(ValueError, match="the channel `pose` has the name of another array"):
        run.to_xarray()


def test_channels_have_one_name_everywhere(done):
    run = done[1]
    data, table = run.to_xarray(), run.to_pandas()
    assert run.keys() == list(run) == list(table.columns) == run._ipython_key_completions_()
    for name in run:
        assert name in run
        np.testing.assert_array_equal(data[name], run[name].detach())
        np.testing.assert_array_equal(table[name], run[name].detach())
        assert data[name].attrs["units"] == table.attrs["units"][name] == run.units[name]
    assert "x_d" in run
    assert "x_c" not in run
    with pytest.raises(KeyError, match="no channel `x_c`; did you mean `x_C`"):
        run["x_c"]


@pytest.mark.parametrize("extended", [False, True])
def test_points_stick_slip_and_part_as_the_graph_says(extended):
    """The same as the graph at the same states, in a fast stroke that slips, also where a pad has
    retardation times of its own."""
    built = paper(COARSE | {"contact.mu_s": 0.05, "contact.mu_k": 0.04})
    model = built.rig
    for name in ("pads.L.tau_ratio", "materials.rubber.slow(0.1 s)") if extended else ():
        extend(model, [name])
        torch.nn.init.constant_(model.parameter(name), 0.5)
    t = times(3.0, 61)
    run = built.run(t, y0=built.start().detach())
    rows = torch.arange(0, len(t), 4)
    state = model.unpack(run.y[rows], model.follow(t[rows]))
    found = torch.zeros(3)
    for name, interface in model.evaluate(t[rows], state).interfaces.items():
        slips, touches = interface.law.slip > 0, interface.F_N > 0
        expected = torch.where(touches, 1 + slips.int(), 0)
        assert torch.equal(run.contact_state[name][rows].int(), expected)
        found += torch.bincount(expected.flatten(), minlength=3)
    assert bool((found > 0).all())


def test_states_of_points_are_not_told_of_a_rig_that_has_changed():
    model, run = ran()
    with torch.no_grad():
        model.parameter("contact.mu_s").mul_(0.9)
    for name, state in run.contact_state.items():
        assert torch.equal(state == -1, run.force[name][..., 0] > 0)
        assert bool((state[-1] == -1).any())
        assert not bool((state > 0).any())


def test_vtk_files_are_read_back(done, tmp_path):
    run = done[1]
    listed, *files = run.to_vtk(tmp_path / "run.pvd", [0.0, 0.1])
    assert [path.name for path in files] == ["run_00000.vtu", "run_00001.vtu"]
    assert all(path.name in listed.read_text(encoding="utf-8") for path in files)
    mesh = meshio.read(files[1])
    setup, first = run.setup, 0
    for i, (name, pad) in enumerate(setup.pads.items()):
        count = len(pad.mesh.nodes)
        rows = mesh.cell_data["pad"][0] == i
        own = pad.displacement(run.displacement[name][-1].numpy())
        np.testing.assert_allclose(
            mesh.point_data["displacement"][first : first + count, :2], own @ pad.axes.T, atol=1e-15
        )
        stress = pad.stress(own)
        np.testing.assert_allclose(mesh.cell_data["von_mises"][0][rows], von_mises(stress))
        tensor = mesh.cell_data["stress"][0][rows].reshape(-1, 3, 3)
        np.testing.assert_allclose(np.trace(tensor, axis1=1, axis2=2), stress[:, :3].sum(1))
        first += count
    places = mesh.points[:, :2] + mesh.point_data["displacement"][:, :2]
    points = setup.pads["L"].surface_points(run.displacement["L"][-1].numpy())
    apart = np.linalg.norm(places[:, None] - points[None], axis=-1).min(0)
    assert apart.max() < 1e-15
    with pytest.raises(ValueError, match=r"must end in \.pvd"):
        run.to_vtk(tmp_path / "run.vtk")


def test_objects_show_themselves(done):
    model, run = done
    batch = simulate_batch(model, T[:3], y0=[run.y[0], run.y[-1]])
    for one, words in (
        (run, ("0 to 0.1 s, 11 samples", "x of disc", "N on")),
        (model, ("2 bodies, 2 pads", "Circle of radius 0.01937 m", "E 7.5e+05 Pa", "Kp")),
        (batch, ("2 runs, 0 failed", "x_C")),
        (template("t").build().rig, ("bodies", "disc")),
    ):
        text, page = repr(one), one._repr_html_()
        assert len(text.splitlines()) <= 20
        for word in words:
            assert word in text
            assert word in page
    assert "<table>" in page
    assert batch.keys() == run.keys()
    assert "x_C" in batch


# starts and inputs
# ----------------------------------------------------------------------


def test_a_notebook_shows_figures_and_films(done, tmp_path):
    """A picture, not an address; a video or the player."""
    figure = done[1].plot()
    assert "_EmbeddedFonts" not in repr(figure)
    assert figure._repr_png_().startswith(b"\x89PNG")
    gif = done[1].animate(tmp_path / "run.gif", frames=2, dpi=30)
    assert gif._repr_html_().startswith('<img src="data:image/gif;base64,R0lG')
    player = done[1].animate(str(tmp_path / "run.html"), frames=2)
    page = re.fullmatch(r'<iframe srcdoc="([^"]*)" .*></iframe>', player._repr_html_())
    assert page
    assert unescape(page[1]) == (tmp_path / "run.html").read_text(encoding="utf-8")
    assert (
        str(player) == f"Film: {tmp_path / 'run.html'}, {player.path.stat().st_size / 1e6:.2g} MB"
    )


def test_channels_have_units_in_tables_and_meanings_in_files(tmp_path):
    """As `identify` reads them; what each one is, whatever the rig calls it."""
    ready = template("t").build()
    run = simulate(ready.rig, ready.t[:12], y0=ready.y0)
    assert list(run.to_pandas()) == list(run.channels)
    table = run.to_pandas(units=True)
    assert table.index.name == "t [s]"
    wanted = ["x_disc [m]", "theta_disc [rad]", "effort_x [N]", "y_d_dot [m/s]", "y_d [m]"]
    table[wanted].to_csv(tmp_path / "run.csv")
    columns = read_csv(tmp_path / "run.csv", (), vocabulary(ready.rig, {})).values
    assert np.array_equal(columns["theta_disc"], run["theta_disc"].numpy())
    assert np.array_equal(columns["t"], run.t.numpy())
    data = run.to_xarray()
    said = {name: data[name].attrs["long_name"] for name in run.channels}
    assert said["x_disc"] == "x of the body disc"
    assert said["omega_disc"] == "rate of angle (anticlockwise) of the body disc"
    assert said["x_d"] == "set-point of bracket.x"
    assert said["effort_y"] == "effort of the actuator y on bracket.y"
    assert said["M_upper"] == "moment of the pad upper on its base"
    assert not [name for name, meaning in said.items() if "channel" in meaning]


def test_a_bar_is_shown_to_people_only(capfd):
    """And not to a file, to which it would write a line for every step of it."""
    simulate(coarse(), T[:3], y0=rest(coarse()).detach(), progress=True)
    assert capfd.readouterr().err == ""
    assert (hidden(True), hidden(False)) == (None, True)


def test_a_start_is_stated_by_coordinates():
    model = coarse()
    y0 = rest(model).detach()
    x, y, _ = model.unpack(y0).pose["disc"].tolist()
    height = float(model.unpack(y0).pose["bracket"][1]) + 1e-3
    stated = model.state(disc={"x": x, "y": "rest"}, bracket={"x": x, "y": height}).detach()
    expected, found = model.unpack(y0), model.unpack(stated)
    torch.testing.assert_close(found.pose["disc"], expected.pose["disc"], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.pads["L"], expected.pads["L"], rtol=0, atol=1e-7)
    assert not bool(found.pads["U"].any())
    moving = model.state(
        {"disc": {"x": x, "y": y, "v_x": 0.01, "omega": -0.5}, "bracket": {"x": x, "y": height}}
    )
    state = model.unpack(moving)
    assert state.velocity["disc"].tolist() == [0.01, 0.0, -0.5]
    assert state.pose["disc"].tolist() == [x, y, 0.0]
    assert simulate(model, T[:3], y0=moving.detach())["v_x"][0] == 0.01


def test_a_start_is_differentiable():
    model = coarse()

    def height(x: float, E: float) -> Tensor:
        with torch.no_grad():
            model.parameter("pad.E").fill_(E)
        at = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        y = model.state(disc={"x": at, "y": "rest"}, bracket={"x": 0.06, "y": 0.06})
        return model.unpack(y).pose["disc"][1]

    (by_E,) = torch.autograd.grad(height(0.0605, 7.5e5), [model.parameter("pad.E")])
    h = 10.0
    expected = (height(0.0605, 7.5e5 + h).item() - height(0.0605, 7.5e5 - h).item()) / (2 * h)
    assert float(by_E) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"disk": {}}, "there is no body `disk`; did you mean `disc`"),
        ({"disc": {"x": 0.06}}, "`y` of `disc` is missing: it is free"),
        ({"disc": {"x": 0.06, "y": "low"}}, "`y` of `disc` must be a number or 'rest'"),
        ({"disc": {"x": "rest", "y": 0.0}}, "`x` of `disc` must be a number, but is 'rest'"),
        ({"disc": {"x": 0.06, "y": float("nan")}, "bracket": {"x": 0.0, "y": 0.1}},
         "`disc.y` must be one finite number"),
        ({"disc": {"x": 0.06, "y": 0.02, "vx": 1.0}}, "`vx` is no coordinate of `disc`.* `v_x`"),
        ({"disc": [0.06, 0.02]}, "`disc` must be given coordinates by name"),
        ({"disc": {"x": 0.06, "y": 0.03}, "bracket": {"x": 0.06, "y": 0.06, "theta": 0.1}},
         "`theta` of `bracket` has no meaning: theta is fixed"),
    ],
)  # fmt: skip
def test_a_start_that_is_none_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        coarse().state(given)


def test_a_body_beside_its_pad_does_not_rest():
    with pytest.raises(NoEquilibrium, match="no pad that it has a contact with lies under x = 9"):
        coarse().state(disc={"x": 9.0, "y": "rest"}, bracket={"x": 0.06, "y": 0.06})


@pytest.mark.parametrize(
    "as_given",
    [
        lambda x: x.numpy(), lambda x: x.tolist(), lambda x: x.float(), lambda x: tuple(x.tolist()),
        lambda x: x.float().numpy(),
    ],
)  # fmt: skip
def test_numbers_may_be_given_in_any_form(as_given):
    model = coarse()
    y0, t = rest(model).detach(), T[:3]
    t32, y32 = (torch.as_tensor(as_given(x), dtype=torch.float64) for x in (t, y0))
    run = simulate(model, as_given(t), y0=as_given(y0))
    assert run.t.dtype == run.y.dtype == torch.float64
    assert equal(run.y, simulate(model, t32, y0=y32).y)
    K_n = f64(8e4, 1e5)
    batch = simulate_batch(
        model, as_given(t), parameters={"contact.K_n": as_given(K_n)}, y0=as_given(y0)
    )
    assert equal(batch["y_C"], simulate_batch(
        model, t32, parameters={"contact.K_n": K_n}, y0=y32)["y_C"])  # fmt: skip
    rows = simulate_batch(model, [as_given(t), as_given(t[:2])], y0=as_given(y0))
    assert rows.mask.sum(1).tolist() == [3, 2]


def test_gradients_reach_what_is_given_in_single_precision():
    model = coarse()
    y0 = rest(model).detach().float().requires_grad_()
    simulate(model, T[:3], y0=y0, gradient="discrete")["y_C"][-1].backward()
    assert y0.grad.dtype == torch.float32
    assert bool(y0.grad.any())


def test_a_second_backward_through_a_shared_start_is_explained():
    model = coarse()
    runs = lambda y0: [simulate(model, T[:3], y0=y0, gradient="discrete")["y_C"][-1] for _ in "12"]
    first, second = runs(rest(model))
    first.backward()
    with pytest.raises(SharedStart, match=r"make y0 anew .* y0\.detach\(\) .*retain_graph=True"):
        second.backward()
    first, second = runs(rest(model))
    first.backward(retain_graph=True)
    second.backward()
    for one in runs(rest(model).detach()):
        one.backward()


# the package
# ----------------------------------------------------------------------


def test_a_star_imports_what_help_names():
    names: dict[str, Any] = {}
    exec("from torchsoft import *", names)
    assert {"RigFile", "simulate", "Rig", "Trajectory"} <= names.keys()
    assert "torch" not in names


def test_help_is_one_page():
    import pydoc

    page = pydoc.plain(pydoc.render_doc(torchsoft)).splitlines()
    assert len(page) < 80
    assert any("simulate_batch" in line for line in page)
    assert torchsoft.__version__
    assert (Path(torchsoft.__file__).parent / "py.typed").is_file()
    assert {"Rig", "simulate", "simulate_batch", "Trajectory"} < set(dir(torchsoft))
    assert all(hasattr(torchsoft, name) for name in dir(torchsoft))
