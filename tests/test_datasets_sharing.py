"""Datasets made by many and given to others: parts, job arrays, estimates, cards, exports."""

import json
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from test_datasets_rigs import contents, sound, written

from torchsoft.cli import main
from torchsoft.datasets import generate as generation
from torchsoft.datasets import open_dataset
from torchsoft.datasets.card import card
from torchsoft.datasets.check import check
from torchsoft.datasets.config import Config
from torchsoft.datasets.export import Source, export, lerobot, the_well
from torchsoft.datasets.files import StoreError, listed
from torchsoft.datasets.generate import Part, Serial, estimate, generate, simulate_task, unfinished
from torchsoft.datasets.writer import Store, open_or_create
from torchsoft.solve.trajectory import Trajectory
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.measured import vocabulary


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three trajectories in two shards, made in two parts."""
    folder = tmp_path_factory.mktemp("sharing")
    config, url = Config.from_toml(written(folder)), str(folder / "set")
    generate(config, url, Serial(), progress=False, part=Part(2, 2))
    assert Store(url, config).unfinished() == [0]
    assert not (folder / "set" / "README.md").exists()
    with pytest.raises(StoreError, match=r"1 of 2 shards are not finished \(0\)"):
        open_dataset(url)
    assert list(check(url))[-1].endswith("1 of 2 shards are not finished: 0")
    assert unfinished(config, url, Part(2, 2)) == []
    generate(config, url, Serial(), progress=False, part=Part(1, 2))
    return folder / "set", config


@pytest.fixture(scope="module")
def data(made):
    return open_dataset(str(made[0])).load()


@pytest.fixture
def half(made, tmp_path):
    """The same with its first shard unfinished."""
    shutil.copytree(made[0], tmp_path / "the set")
    (tmp_path / "the set" / "finished" / "0.sha256").unlink()
    return tmp_path / "the set"


def test_two_who_make_one_set_at_once_share_the_work(made, tmp_path, monkeypatch):
    """Every trajectory is simulated once, and the set is that of the parts."""
    simulated, url = list[int](), str(tmp_path / "set")

    def simulate(config: Config, task: Any) -> Any:
        simulated.append(task.index)
        return simulate_task(config, task)

    monkeypatch.setattr(generation, "simulate_task", simulate)
    open_or_create(url, made[1])  # zarr's warnings are not for two threads
    with ThreadPoolExecutor(2) as two:
        both = [two.submit(generate, made[1], url, Serial(), progress=False) for _ in range(2)]
    assert [one.result() for one in both] == [0, 0]
    assert sorted(simulated) == [0, 1, 2]
    assert contents(tmp_path / "set") == contents(made[0])
    assert sound(made[0])


def test_parts_share_every_shard_out_once(made):
    config = made[1].model_copy(update={"trajectories": 37})
    for of in (1, 2, 5, 19):
        shards = [shard for i in range(of) for shard in Part(i + 1, of).shards(config)]
        assert sorted(shards) == list(range(19))
    with pytest.raises(ValueError, match=r"part 1 of 20 is empty, .* shards of 2: make at most 19"):
        Part(1, 20).shards(config)
    assert listed([0, 3, 4, 5, 9]) == "0, 3-5, 9"
    assert listed(range(0, 100, 2)).endswith("38, ...")


def test_a_shard_is_made_by_one_at_a_time(made, half, tmp_path, monkeypatch, capsys):
    """Who comes second leaves it, and says so; its progress is seen by others."""
    store, path = open_or_create(str(half), made[1]), written(tmp_path)
    monkeypatch.setattr(generation, "simulate_task", None)  # nothing is to be made
    with store.claim(0) as simulated:
        assert simulated is not None
        with store.claim(0) as second:
            assert second is None
        simulated()
        assert store.simulated(0) == 1
        assert main(["dataset", "make", str(path), "--out", str(half), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "another process is making shards 0" in said
    assert "1 trajectories in" in said
    assert "1 of 2 shards are left: 0" in said
    assert not list(half.rglob("*.partial"))
    assert generation.run_shard(store, 1, None) == (1, 0)


def test_the_job_array_makes_its_part(made, half, tmp_path, monkeypatch, capsys):
    """What its last line gives the shell is a command that makes the part; made parts are no longer
    in it."""
    folder, asked = tmp_path / "a place", list[Any]()
    folder.mkdir()
    path = written(folder)
    arguments = ["dataset", "slurm", str(path), "--out", str(tmp_path / "new set"), "--parts", "2"]
    assert main(arguments) == 0
    script = capsys.readouterr().out
    assert script.startswith("#!/bin/bash\n#SBATCH")
    assert "--array=1-2\n" in script
    shown = script.replace("exec ", "printf '%s\\n' ")
    run = subprocess.run(
        ["/bin/bash", "-c", shown], env={"SLURM_ARRAY_TASK_ID": "2", "SLURM_CPUS_PER_TASK": "1"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    python, module, name, *command = run.stdout.splitlines()
    assert (Path(python).name[:6], module, name) == ("python", "-m", "torchsoft")
    monkeypatch.setattr(
        generation, "generate",
        lambda config, url, _, workers, part: asked.append((config, url, workers, part)) or 0,
    )  # fmt: skip
    assert main(command) == 0
    assert asked == [(made[1], str(tmp_path / "new set"), 1, Part(2, 2))]
    arguments[4] = str(half)
    assert main(arguments) == 0
    assert "--array=1\n" in capsys.readouterr().out
    arguments[4] = str(made[0])
    assert main(arguments) == 2
    assert "all 2 shards are finished" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["dataset", "make", str(path), "--out", str(half), "--part", "3/2"])


def test_an_estimate_is_measured_on_the_sets_own_runs(made, tmp_path, monkeypatch):
    """Of what is left; the first run, which loads kernels, does not count."""
    now, times = [0.0], iter((0.5, *4 * (0.04, 0.06)))
    monkeypatch.setattr(generation.time, "thread_time", lambda: now[0])

    def slow(*_):
        now[0] += next(times)
        return {"steps": 7}

    monkeypatch.setattr(generation, "simulate_task", slow)
    many = made[1].model_copy(update={"trajectories": 1000})
    price = estimate(many, str(tmp_path / "none"), 1)
    error = 2 * 0.01 * (8 / 7) ** 0.5 / 8**0.5
    assert price.seconds == pytest.approx(1000 * (0.05 + error))
    assert price.least == pytest.approx(1000 * (0.05 - error))
    assert price.steps == 7000
    assert "this takes 42 to 58 seconds (7e+03 steps)" in price.sentence
    assert generation.cost(many, 1).seconds > 1000 * generation.STATICS
    assert estimate(made[1], str(made[0]), 1).seconds == 0.0


def test_the_card_says_what_the_set_holds(made, tmp_path):
    text = (made[0] / "README.md").read_text()
    for said in (
        "license: unknown", "# Pressed", "3 (", "0 failed", "seed 3",
        "bodies disc, bracket; pads lower, upper; contacts disc on lower, disc on upper",
        "| `materials.rubber.E` | 600000 to 900000, logarithmic | Pa |",
        "| `bodies.disc.mass` | one of 0.3, 0.4 | kg |",
        "| `laws.dry.friction.mu_k` | 0.8 to 1, times `laws.dry.friction.mu_s` | 1 |",
        "| `x_disc` | trajectory, time | m | x of the body disc |",
    ):  # fmt: skip
        assert said in text, said
    (made[0] / "README.md").write_text("mine")
    generate(made[1], str(made[0]), Serial(), progress=False)
    assert (made[0] / "README.md").read_text() == "mine"
    (made[0] / "README.md").write_text(card(str(made[0])))
    licensed = made[1].model_copy(update={"license": "CC-BY-4.0"})
    assert "license" not in made[1].model_dump()
    assert Config.model_validate(licensed.model_dump()).license == "CC-BY-4.0"


# exports
# ----------------------------------------------------------------------


def test_fields_on_the_surface_are_those_of_the_set(made, data, tmp_path):
    """In The Well's layout, which its own reader opens where it is installed."""
    out = tmp_path / "well"
    assert "3 trajectories on the surfaces lower, upper" in export(str(made[0]), "the-well", out)
    names, found = {"train": "train", "validation": "valid", "test": "test"}, 0
    for split, name in names.items():
        rows = np.flatnonzero(data.split.values == split)
        for pad, contact in (("lower", "below"), ("upper", "above")):
            path = out / pad / "data" / name / f"{pad}.hdf5"
            assert path.exists() == bool(len(rows))
            if not len(rows):
                continue
            with h5py.File(path) as file:
                found += len(rows)
                assert file.attrs["n_trajectories"] == len(rows)
                fields, scalars = file["t0_fields"], file["scalars"]
                force, moved = f"normal_force_{contact}", data[f"displacement_{pad}"].values
                np.testing.assert_array_equal(fields[force], data[force].values[rows])
                np.testing.assert_array_equal(fields["displacement_y"], moved[rows, ..., 1])
                x = data.x_disc.values[rows].astype("f4")
                np.testing.assert_array_equal(scalars["x_disc"], x)
                assert scalars["bodies.disc.mass"].shape == (len(rows),)
                assert file["dimensions"]["s"].shape == moved.shape[2:3]
    assert found == 2 * 3
    force = data.normal_force_below.values[data.split.values == "train"].astype(float)
    stats = (out / "lower" / "stats.yaml").read_text().split("normal_force_below: ")[1:]
    numbers = [float(one.split()[0]) for one in stats]
    change = np.diff(force, axis=1)
    expected = [force.mean(), force.std(), np.sqrt((force**2).mean()), change.mean(), change.std()]
    np.testing.assert_allclose(numbers[:5], expected, rtol=1e-6)
    if find_spec("the_well"):
        well = import_module("the_well.data")
        read = well.WellDataset(path=str(out / "lower"), well_split_name="train", n_steps_input=4)
        assert read[0]["input_fields"].shape == (4, 21, 5)


def test_episodes_are_those_of_the_set(made, data, tmp_path, monkeypatch):
    """In LeRobot's layout, which its own reader opens where it is installed."""
    pytest.importorskip("pyarrow")
    out = tmp_path / "robot"
    monkeypatch.setattr(lerobot, "SIZE", 0.03)  # [MB], two episodes a file
    said = export(str(made[0]), "lerobot", out)
    assert said.startswith("3 episodes, whose actions are x_d, x_d_dot, y_d, y_d_dot")
    info = json.loads((out / "meta" / "info.json").read_text())
    files = [pd.read_parquet(path) for path in sorted(out.glob("data/*/*.parquet"))]
    assert list(map(len, files)) == [42, 21]
    frames = pd.concat(files)
    episodes = pd.read_parquet(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert (info["fps"], info["total_frames"], len(frames)) == (200, 63, 63)
    state = info["features"]["observation.state"]["names"]
    for split, span in info["splits"].items():
        first, end = map(int, span.split(":"))
        assert {*data.split.values[episodes.trajectory[first:end]]} == {split}
    for i, index in enumerate(episodes.trajectory):
        one = frames[frames.episode_index == i].reset_index()
        np.testing.assert_allclose(one.timestamp, data.time, atol=1e-7)
        values = np.stack(one["observation.state"])[:, state.index("y_disc")]
        np.testing.assert_array_equal(values, data.y_disc.values[index].astype("f4"))
        force = np.stack(one["observation.normal_force_above"])
        np.testing.assert_array_equal(force, data.normal_force_above.values[index])
        assert episodes["bodies.disc.mass"][i] == float(data["bodies.disc.mass"][index])
        assert episodes.dataset_from_index[i] == one["index"][0]
        assert i in files[episodes["data/file_index"][i]].episode_index.values
    stats = json.loads((out / "meta" / "stats.json").read_text())["observation.state"]
    y = data.y_disc.values.astype("f4").astype(float)
    found = [stats[key][state.index("y_disc")] for key in ("min", "max", "mean", "std")]
    np.testing.assert_allclose(found, [y.min(), y.max(), y.mean(), y.std()], rtol=1e-6)
    if find_spec("lerobot"):
        reader = import_module("lerobot.datasets.lerobot_dataset")
        assert len(reader.LeRobotDataset("torchsoft/set", root=out)) == 63


def test_a_log_is_a_recording(made, data, tmp_path):
    """With the numbers of the set to the last bit; one that is damaged or of others is refused."""
    pytest.importorskip("mcap")
    from torchsoft.solve.formats import read_log, write_log

    export(str(made[0]), "mcap", tmp_path / "logs")
    read = read_log(tmp_path / "logs" / "000001.mcap")
    for name in ("x_disc", "effort_x", "y_d"):
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


def test_a_run_is_logged_and_read_as_its_file_is(tmp_path):
    """By whoever reads recordings of the paper's rig."""
    pytest.importorskip("mcap")
    from conftest import coarse, grasped, times

    from torchsoft import simulate

    model = coarse()
    run = simulate(model, times(0.1, 12), y0=grasped(model), step=5e-3)
    run.save(tmp_path / "run.nc")
    assert main(["plot", str(tmp_path / "run.nc"), "--mcap"]) == 0
    Trajectory.load(tmp_path / "run.nc").to_mcap(tmp_path / "again.mcap")
    known = vocabulary(model, {})
    one = read_table(tmp_path / "run.nc", (), known)
    for name in ("run.mcap", "again.mcap"):
        other = read_table(tmp_path / name, (), known)
        assert {*one.values} == {*other.values}
        for column, values in one.values.items():
            np.testing.assert_array_equal(values, other.values[column])


def test_exports_that_are_refused(made, data, half, tmp_path, capsys):
    command = ["dataset", "export", str(made[0]), "--to", "the-well", "--out"]
    assert main([*command, str(half)]) == 2
    assert "the set is not empty; name a new folder" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"--to: `mca` is no form; did you mean `mcap`"):
        export(str(half), "mca", tmp_path / "out")
    with pytest.raises(StoreError, match=r"1 of 2 shards are not finished"):
        export(str(half), "mcap", tmp_path / "out")

    def write(to: Any, **less: Any) -> None:
        to.write(Source(made[1].model_copy(update=less), data, np.arange(3)), tmp_path / "out")

    with pytest.raises(ValueError, match="this dataset has none"):
        write(the_well, nodal=False)
    pytest.importorskip("pyarrow")
    with pytest.raises(ValueError, match="LeRobot needs actions and a state"):
        write(lerobot, channels=("x_disc",))
    with pytest.raises(ValueError, match=r"sample_interval = 0\.003 s makes 333\.333"):
        write(lerobot, sample_interval=3e-3)
    assert not (tmp_path / "out").exists()
