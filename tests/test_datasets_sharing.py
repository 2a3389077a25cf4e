# ruff: noqa: F401, F811 -- fixtures are imported
"""Datasets in the forms of other projects: their numbers are those of the set."""

import json
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from conftest import coarse, grasped, times
from test_datasets import COUNT, data, half, made

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.datasets.export import Source, export, lerobot, the_well
from torchsoft.datasets.files import StoreError
from torchsoft.solve.trajectory import Trajectory
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.measured import vocabulary


def test_fields_on_the_surface_are_those_of_the_set(made, data, tmp_path):
    """In The Well's layout, which its own reader opens where it is installed."""
    out = tmp_path / "well"
    assert "5 trajectories on the surfaces lower, upper" in export(str(made[0]), "the-well", out)
    names, found = {"train": "train", "validation": "valid", "test": "test"}, 0
    for split, name in names.items():
        some = data.isel(trajectory=data.split.values == split)
        for pad, contact in (("lower", "below"), ("upper", "above")):
            path = out / pad / "data" / name / f"{pad}.hdf5"
            assert path.exists() == bool(some.sizes["trajectory"])
            if not path.exists():
                continue
            with h5py.File(path) as file:
                found += file.attrs["n_trajectories"]
                fields, scalars = file["t0_fields"], file["scalars"]
                force, moved = f"normal_force_{contact}", some[f"displacement_{pad}"]
                np.testing.assert_array_equal(fields[force], some[force])
                np.testing.assert_array_equal(fields["displacement_y"], moved[..., 1])
                np.testing.assert_array_equal(scalars["x_disc"], some.x_disc.astype("f4"))
                assert scalars["bodies.disc.mass"].shape == some.split.shape
    assert found == 2 * COUNT
    force = data.normal_force_below.values[data.split.values == "train"].astype(float)
    stats = (out / "lower" / "stats.yaml").read_text().split("normal_force_below: ")[1:]
    change = np.diff(force, axis=1)
    expected = [force.mean(), force.std(), np.sqrt((force**2).mean()), change.mean(), change.std()]
    written = [float(one.split()[0]) for one in stats][:5]
    np.testing.assert_allclose(written, expected, rtol=1e-6)
    if find_spec("the_well"):
        well = import_module("the_well.data")
        read = well.WellDataset(path=str(out / "lower"), well_split_name="train", n_steps_input=4)
        assert read[0]["input_fields"].shape == (4, 21, 5)


def test_episodes_are_those_of_the_set(made, data, tmp_path, monkeypatch):
    """In LeRobot's layout, which its own reader opens where it is installed."""
    pytest.importorskip("pyarrow")
    out = tmp_path / "robot"
    monkeypatch.setattr(lerobot, "SIZE", 0.02)  # [MB], a few episodes a file
    assert export(str(made[0]), "lerobot", out).startswith(
        "5 episodes, whose actions are x_d, x_d_d"
    )
    files = [pd.read_parquet(path) for path in sorted(out.glob("data/*/*.parquet"))]
    assert len(files) > 1
    frames = pd.concat(files)
    episodes = pd.read_parquet(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["fps"], info["total_frames"], len(frames)) == (200, 21 * COUNT, 21 * COUNT)
    place = info["features"]["observation.state"]["names"].index("x_disc")
    for split, span in info["splits"].items():
        first, end = map(int, span.split(":"))
        assert {*data.split.values[episodes.trajectory[first:end]]} == {split}
    for i, index in enumerate(episodes.trajectory):
        one, stored = frames[frames.episode_index == i].reset_index(), data.isel(trajectory=index)
        np.testing.assert_allclose(one.timestamp, data.time, atol=1e-7)
        state, force = (np.stack(one[f"observation.{x}"]) for x in ("state", "normal_force_above"))
        np.testing.assert_array_equal(state[:, place], stored.x_disc.astype("f4"))
        np.testing.assert_array_equal(force, stored.normal_force_above)
        assert episodes["bodies.disc.mass"][i] == float(stored["bodies.disc.mass"])
        assert episodes.dataset_from_index[i] == one["index"][0]
        assert i in files[episodes["data/file_index"][i]].episode_index.values
    stats = json.loads((out / "meta" / "stats.json").read_text())["observation.state"]
    x = data.x_disc.values.astype("f4").astype(float)
    found = [stats[key][place] for key in ("min", "max", "mean", "std")]
    np.testing.assert_allclose(found, [x.min(), x.max(), x.mean(), x.std()], rtol=1e-6)
    if find_spec("lerobot"):
        reader = import_module("lerobot.datasets.lerobot_dataset")
        assert len(reader.LeRobotDataset("torchsoft/set", root=out)) == 21 * COUNT


def test_a_log_is_a_recording(made, data, tmp_path):
    """To the last bit, of a set or of a run; one that is damaged or of others is rejected."""
    pytest.importorskip("mcap")
    from torchsoft.solve.formats import read_log, write_log

    export(str(made[0]), "mcap", tmp_path / "logs")
    read = read_log(tmp_path / "logs" / "000001.mcap")
    for name in ("x_disc", "effort_x", "x_d"):
        np.testing.assert_array_equal(read[name], data[name][1])
        assert read[name].attrs["units"] == data[name].attrs["units"]
    whole = (tmp_path / "logs" / "000001.mcap").read_bytes()
    for damage in (whole[: len(whole) // 2], whole[:300] + b"x" + whole[301:], b"t,x\n0,1\n"):
        (tmp_path / "damaged.mcap").write_bytes(damage)
        with pytest.raises(ValueError, match=r"damaged\.mcap is not a log of torchsoft"):
            read_log(tmp_path / "damaged.mcap")
    lost = xr.Dataset({"x": ("time", [0.0, np.nan])}, coords={"time": [0.0, 1.0]})
    with pytest.raises(ValueError, match="`x` is not finite"):
        write_log(tmp_path / "lost.mcap", lost, {})
    model = coarse()
    simulate(model, times(0.1, 12), y0=grasped(model), step=5e-3).save(tmp_path / "run.nc")
    assert main(["plot", str(tmp_path / "run.nc"), "--mcap"]) == 0
    Trajectory.load(tmp_path / "run.nc").to_mcap(tmp_path / "again.mcap")
    one, *others = (
        read_table(tmp_path / name, (), vocabulary(model, {})).values
        for name in ("run.nc", "run.mcap", "again.mcap")
    )
    for other in others:
        np.testing.assert_equal(other, one)


def test_exports_that_are_rejected(made, data, half, tmp_path, capsys):
    command = ["dataset", "export", str(made[0]), "--to", "the-well", "--out"]
    assert main([*command, str(half)]) == 2
    assert "the set is not empty; name a new folder" in capsys.readouterr().err
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=r"--to: `mca` is no form; did you mean `mcap`"):
        export(str(half), "mca", out)
    with pytest.raises(StoreError, match=r"1 of 3 shards are not finished"):
        export(str(half), "mcap", out)
    pytest.importorskip("pyarrow")
    less: list[tuple[Any, dict[str, Any], str]] = [
        (the_well, {"nodal": False}, "this dataset has none"),
        (lerobot, {"channels": ("x_disc",)}, "LeRobot needs actions and a state"),
        (lerobot, {"sample_interval": 3e-3}, r"sample_interval = 0\.003 s makes 333\.333"),
    ]
    for form, changes, message in less:
        source = Source(made[1].model_copy(update=changes), data, np.arange(3))
        with pytest.raises(ValueError, match=message):
            form.write(source, out)
    assert not out.exists()
