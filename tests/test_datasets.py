"""What a dataset holds, and that it is the same whatever makes it and whatever interrupts that."""

import errno
import os
import re
import shutil
import signal
import tomllib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fsspec
import numpy as np
import pytest
import xarray as xr
from conftest import coarse, grasped, times
from hostile.processes import ended, fork
from hypothesis import example, given, settings
from hypothesis import strategies as st

from torchsoft import simulate
from torchsoft.cli import main
from torchsoft.datasets import generate as making
from torchsoft.datasets import open_dataset
from torchsoft.datasets.card import card
from torchsoft.datasets.check import check
from torchsoft.datasets.config import Config
from torchsoft.datasets.files import Manifest, StoreError, listed, store_errors
from torchsoft.datasets.generate import (
    Part,
    Serial,
    estimate,
    generate,
    local_processes,
    local_workers,
    points,
    simulate_task,
)
from torchsoft.datasets.subject import split
from torchsoft.datasets.writer import Store, create, open_or_create
from torchsoft.rigs import RigFile
from torchsoft.solve.mcap import read_log, write_log
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.trajectory import Trajectory
from torchsoft.sysid.columns import read_table
from torchsoft.sysid.measured import vocabulary

ROOT = Path(__file__).parent.parent
CONFIGS = sorted((ROOT / "data_gen" / "configs").glob("*.toml"))
COUNT = 5

RIG = """
[bodies.disc]
mass = 0.4
shape = {kind = "circle", radius = 20e-3}
start = {x = 0.3e-3, y = "rest"}
[bodies.bracket]
mass = 0.4
theta = 0.0
weighted = false
start = {x = 0.0, y = 50.1e-3}
[materials.rubber]
kind = "kelvin_voigt"
E = 0.75e6
nu = 0.45
tau = 10e-3
depth = 44e-3
[pads.lower]
material = "rubber"
length = 80e-3
height = 5e-3
elements_x = 40
elements_y = 1
origin = [-40e-3, 0.0]
[pads.upper]
material = "rubber"
length = 80e-3
height = 5e-3
elements_x = 20
elements_y = 1
origin = [-40e-3, 0.0]
base = "bracket"
mirrored = true
[laws.dry]
K_n = 1.2e5
R_n = 400.0
K_t = 1.2e5
R_t = 400.0
friction = {kind = "smooth", mu_s = 0.8, mu_k = 0.7, v_s = 0.05}
[contacts]
below = {pad = "lower", body = "disc", law = "dry"}
above = {pad = "upper", body = "disc", law = "dry"}
[actuators.x]
pushes = "bracket.x"
setpoint = "x_d"
Kp = 1e5
Kd = 400.0
[controllers.lift]
measures = ["bracket.y"]
setpoints = ["y_d"]
pushes = ["bracket.y"]
gain = [[1e5, 400.0]]
[motion]
x_d = {kind = "csv", file = "x_d.csv", column = "x"}
y_d = {kind = "profile", times = [0.0, 0.05], values = ["start", 49.5e-3]}
[outputs]
duration = 0.1
interval = 0.005
snapshots = [0.1]
[solver]
rtol = 1e-5
"""

CONFIG = """
title = "Pressed"
seed = 3
trajectories = 5
trajectories_per_shard = 2
samples_per_chunk = 8
rig = "rigs/pressed.toml"
channels = ["x_disc", "theta_disc", "effort_x", "x_d", "x_d_dot"]
[fixed]
"pads.lower.elements_x" = 20
"laws.dry.friction.v_s" = 0.06
[parameters]
"materials.rubber.E" = { low = 0.6e6, high = 0.9e6, scale = "log" }
"bodies.disc.mass" = { choices = [0.3, 0.4] }
"bodies.disc.start.x" = { mean = 0.0, sd = 0.2e-3 }
"laws.dry.friction.mu_s" = { low = 0.7, high = 0.9 }
"laws.dry.friction.mu_k" = { low = 0.8, high = 1.0, ratio_to = "laws.dry.friction.mu_s" }
"actuators.x.Kp" = { low = 0.8e5, high = 1.2e5 }
"controllers.lift.gain_1_2" = { low = 300.0, high = 500.0 }
"motion.y_d.values_2" = { low = 49.4e-3, high = 49.6e-3 }
"pads.upper.origin_1" = { low = -41e-3, high = -39e-3 }
"""
ALL = re.sub("channels = .*\n", "", CONFIG)
KINDS = """
[[kinds]]
name = "stroke"
fixed."motion.x_d" = { kind = "strokes", since = 0.05, stroke_time = 0.02, travel = 1e-4 }
parameters."motion.x_d.travel" = { low = 1e-4, high = 2e-4, either_sign = true }
[[kinds]]
name = "grip"
weight = 2.0
parameters."motion.y_d.values_2" = { low = 49.1e-3, high = 49.2e-3 }
"""
"""Kinds of trajectories, for the end of a configuration."""


def written(folder: Path, config: str = CONFIG) -> Path:
    """The rig file, the motion that it names, and the configuration."""
    (folder / "rigs").mkdir(exist_ok=True)
    (folder / "rigs" / "pressed.toml").write_text(RIG)
    (folder / "rigs" / "x_d.csv").write_text("t [s],x [mm]\n0,0\n0.05,0\n0.1,0.2\n")
    (folder / "set.toml").write_text(config)
    return folder / "set.toml"


@cache
def made_at(folder: Path, config: str = CONFIG) -> tuple[Path, Config]:
    parsed = Config.from_toml(written(folder, config))
    generate(parsed, str(folder / "set"), Serial(), progress=False)
    return folder / "set", parsed


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Five trajectories in three shards, made in this process one after the other."""
    return made_at(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session")
def data(made):
    return open_dataset(str(made[0])).load()


@pytest.fixture
def half(made, tmp_path):
    """The same with its first shard unfinished."""
    shutil.copytree(made[0], tmp_path / "the set")
    (tmp_path / "the set" / "finished" / "0.sha256").unlink()
    return tmp_path / "the set"


def objects(url: str) -> dict[str, bytes]:
    """Every file of a store, without the commit, which may move on during a test, and its
    digest."""
    fs, root = fsspec.url_to_fs(url)
    fs.invalidate_cache()
    names = [name for name in fs.find(root) if fs.isfile(name)]
    files = {name.removeprefix(root): fs.cat_file(name) for name in names}
    return {name: re.sub(rb'"(commit|digest)": "\w*"', b"", x) for name, x in files.items()}


def faults(url: str | Path) -> list[str]:
    """Findings of the check; a manifest outside a repository has no commit."""
    return [one for one in check(str(url)) if "commit" not in one]


# the bytes
# ----------------------------------------------------------------------


def killed_at(index: int, config: Config, url: str) -> None:
    """Make the set in a process that is killed in a trajectory."""

    def simulated(config, one):
        if one.index == index:
            os.kill(os.getpid(), signal.SIGKILL)
        return simulate_task(config, one)

    def run():
        making.simulate_task = simulated
        generate(config, url, Serial(), progress=False)

    assert ended(fork(run)) == -signal.SIGKILL


LOST = {
    "record": ["finished/1.sha256"],
    "file": ["theta_disc/c/1/0"],
    "shard": ["finished/1.sha256", "theta_disc/c/1/0"],
}
SHM = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Where waiting for a disk takes no time."""


@example(
    store="memory://", order=[2, 1, 3], workers=0, killed=None, lost="record", torn=True, size=2
)
@settings(max_examples=4, derandomize=True, deadline=None)
@given(
    store=st.sampled_from(["", "file://", "memory://"]), order=st.permutations(range(1, 4)),
    workers=st.sampled_from([0, 2]), killed=st.none() | st.integers(0, COUNT - 1),
    lost=st.none() | st.sampled_from([*LOST]), torn=st.booleans(), size=st.sampled_from([2, 3]),
)  # fmt: skip
def test_the_bytes_of_a_set_do_not_depend_on_how_it_is_made(
    made, data, store, order, workers, killed, lost, torn, size
):
    """In one process or several threads, in whichever order of its parts, in any store, killed in
    a trajectory, resumed with records or files lost or half written: the files are those of `made`.
    Shards of another size are other files with the same data."""
    tree = Manifest.read(str(made[0])).config  # without the rig file, which the manifest holds
    config = Config.model_validate(tree | {"trajectories_per_shard": size})
    parts = order if size == 2 else [1]
    with TemporaryDirectory(dir=SHM) as folder, local_workers(workers) as executor:
        url = f"{store}{folder}/set"
        fs, root = fsspec.url_to_fs(url)
        if killed is not None and store != "memory://":
            killed_at(killed, config, url)
            assert len(Store(url, config).unfinished()) == config.shards - killed // size
        for part in parts:
            assert generate(config, url, executor, 2, False, Part(part, len(parts))) == 0
        if lost:
            for name in LOST[lost]:
                fs.rm_file(f"{root}/{name}")
            if torn:
                fs.pipe_file(f"{root}/theta_disc/c/1/0.0123456789abcdef.partial", b"half")
            if torn and lost == "shard":
                fs.pipe_file(f"{root}/theta_disc/c/1/0", b"half")
            assert Store(url, config).unfinished() == [1]
            generate(config, url, executor, 2, progress=False)
            if torn and store == "memory://":  # which nobody cleans up
                fs.rm_file(f"{root}/theta_disc/c/1/0.0123456789abcdef.partial")
        if size == 2:
            assert objects(url) == objects(str(made[0]))
        else:
            assert open_dataset(url).load().equals(data)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_processes_make_the_same_bytes(made, tmp_path):
    with local_processes(2) as executor:
        assert generate(made[1], str(tmp_path / "set"), executor, 2, progress=False) == 0
    assert objects(str(tmp_path / "set")) == objects(str(made[0]))


def test_two_who_make_one_set_at_once_make_the_same(made, tmp_path, monkeypatch):
    """The slower one to lay the folder out undoes nothing, and a finished shard is left."""
    url = str(tmp_path / "set")
    row = simulate_task(made[1], made[1].subject.task(0, points(made[1])[0]))
    monkeypatch.setattr(making, "simulate_task", lambda _, task: row | task.labels)
    store = open_or_create(url, made[1])  # zarr's warnings are not for two threads
    with ThreadPoolExecutor(2) as two:
        both = [two.submit(generate, made[1], url, Serial(), progress=False) for _ in range(2)]
    assert [one.result() for one in both] == [0, 0]
    assert not [*Path(url).rglob("*.partial")]
    before = objects(url)
    for config in (made[1], made[1].model_copy(update={"seed": 99})):
        create(url, config)
        assert objects(url) == before
    monkeypatch.setattr(making, "simulate_task", None)  # nothing is to be made
    assert making.run_shard(store, 1, None) == (2, 0)


# the content
# ----------------------------------------------------------------------


def test_a_trajectory_is_the_run_of_the_rig_file_with_its_values(tmp_path):
    """With the names of the rig's parts and their units; all channels by default."""
    folder, config = made_at(tmp_path, ALL.replace("trajectories = 5", "trajectories = 1"))
    assert not faults(folder)
    data = open_dataset(str(folder)).load()
    row = data.isel(trajectory=0)
    p = {name: float(row[name]) for name in tomllib.loads(CONFIG)["parameters"]}
    values = p | tomllib.loads(CONFIG)["fixed"]
    built = RigFile.from_toml(tmp_path / "rigs" / "pressed.toml").override(values).build()
    run = simulate(built.rig, built.t, y0=built.y0, rtol=1e-5)
    assert {*config.subject.channels} <= {*run}
    for name in config.subject.channels:
        there, here = row[name].values, run[name].numpy()
        assert data[name].attrs["units"] == run.units[name]
        np.testing.assert_allclose(there, here, atol=2e-3 * np.abs(here).max(), err_msg=name)
    force = run.force["above"][..., 0].numpy()
    np.testing.assert_allclose(row.normal_force_above, force, atol=1e-2 * force.max())
    assert force[-1].sum() > 1.0
    rest = data.normal_force_below[0, 0].sum("lower_point")
    assert float(rest) == pytest.approx(p["bodies.disc.mass"] * 9.81, rel=2e-3)
    assert data.normal_force_below.dims == ("trajectory", "time", "lower_point")
    assert data.displacement_upper.dims == ("trajectory", "time", "upper_point", "axis")
    np.testing.assert_allclose(data.lower_point, np.linspace(0, 80e-3, 21), atol=1e-15)
    np.testing.assert_allclose(data.upper_places[:, 1], 5e-3)
    units = {"actuators.x.Kp": "N/m", "motion.y_d.values_2": "m", "laws.dry.friction.mu_k": "1"}
    assert {name: data[name].attrs["units"] for name in units} == units
    assert all("units" in one.attrs for one in data.data_vars.values())


@pytest.mark.slow
def test_other_pads_and_contacts_are_kept_whole(tmp_path):
    """The kinetic energy of inertial pads is in the balance; series of nodes are those of all
    contact points between them."""
    own = '[fixed]\n"pads.lower.inertial" = true\n"pads.upper.points" = 2'
    text = CONFIG.replace("[fixed]", own).replace("trajectories = 5", "trajectories = 2")
    folder, config = made_at(tmp_path, text + KINDS)
    assert not faults(folder)
    data = open_dataset(str(folder)).load()
    sizes = [data.sizes[name] for name in ("lower_point", "upper_point", "store")]
    assert sizes == [21, 40, 8]
    force = data.normal_force_below[:, 0].sum("lower_point")
    np.testing.assert_allclose(force, 9.81 * data["bodies.disc.mass"], rtol=2e-3)
    assert {*data.kind.values} <= {kind.name for kind in config.kinds}


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_ready_configs_are_valid_and_their_splits_keep_the_fractions(path):
    config = Config.from_toml(path)
    found = Counter(split(config, i) for i in range(1000))
    shares = [found[name] / 1000 for name in ("train", "validation", "test")]
    np.testing.assert_allclose(shares, [0.7, 0.15, 0.15], atol=0.01)


def test_a_sobol_design_is_a_prefix_of_a_longer_one(made):
    long = made[1].model_copy(update={"trajectories": 40})
    np.testing.assert_array_equal(points(made[1]), points(long)[:COUNT])


def test_the_card_lists_what_the_set_holds(made):
    text = (made[0] / "README.md").read_text()
    for part in (
        "# Pressed", "5 (", "0 failed", "seed 3",
        "| `materials.rubber.E` | 600000 to 900000, logarithmic | Pa |",
        "| `laws.dry.friction.mu_k` | 0.8 to 1, times `laws.dry.friction.mu_s` | 1 |",
        "| `x_disc` | trajectory, time | m | x of the body disc |",
    ):  # fmt: skip
        assert part in text, part
    (made[0] / "README.md").write_text("mine")
    generate(made[1], str(made[0]), Serial(), progress=False)
    assert (made[0] / "README.md").read_text() == "mine"
    (made[0] / "README.md").write_text(text)
    assert card(str(made[0])) == text


def failing(model: Any, t: Any, **options: Any) -> None:
    failure = SimulationFailed("the disc was lost at t = 0.1 s", 0.1)
    failure.trajectory = simulate(model, t[:11], **options)
    raise failure


def test_a_failed_simulation_is_recorded(tmp_path, monkeypatch):
    """Here in a set without series of points."""
    monkeypatch.setattr(making, "simulate", failing)
    one = CONFIG.replace("trajectories = 5", "trajectories = 1\nnodal = false")
    folder, _ = made_at(tmp_path, one)
    data = xr.open_zarr(folder).load()
    assert not [name for name in data if "_below" in str(name) or "_lower" in str(name)]
    assert (data.failed.item(), data.failure_time.item()) == (1, 0.1)
    assert data.reason.item() == "the disc was lost at t = 0.1 s"
    assert np.isnan(data.x_disc).all()
    assert data["materials.rubber.E"].values[0] > 0
    assert [*check(str(folder))] == [
        f"1 of 1 trajectories failed, most often: {data.reason.item()}"
    ]


def test_what_is_not_finite_is_not_written(made, tmp_path, monkeypatch):
    """Unless it is marked as failed; a simulation whose results are not finite has failed."""
    config, task = made[1], made[1].subject.task(4, points(made[1])[4])
    store = open_or_create(str(tmp_path / "set"), config)
    row = simulate_task(config, task)
    lost = {"theta_disc": np.where(np.arange(21) == 3, np.nan, row["theta_disc"])}
    with pytest.raises(ValueError, match=r"trajectory 4 is not marked .* not finite: theta_disc"):
        store.write(2, [row | lost])
    assert store.unfinished() == [0, 1, 2]
    series = making.series
    monkeypatch.setattr(making, "series", lambda *given: series(*given) | lost)
    row = simulate_task(config, task)
    assert (row["failed"], row["reason"]) == (1, "not finite: theta_disc")
    assert np.isnan(row["theta_disc"]).all()


@pytest.mark.slow
def test_a_log_is_a_recording(data, tmp_path):
    """To the last bit, of a set or of a run; one that is damaged or of others is rejected."""
    log = tmp_path / "000001.mcap"
    write_log(log, data.isel(trajectory=1), {"split": "train"})
    read = read_log(log)
    for name in ("x_disc", "effort_x", "x_d"):
        np.testing.assert_array_equal(read[name], data[name][1])
        assert read[name].attrs["units"] == data[name].attrs["units"]
    log.write_bytes(log.read_bytes()[:300])
    with pytest.raises(ValueError, match=r"000001\.mcap is not a log of torchsoft"):
        read_log(log)
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


# places, parts and costs
# ----------------------------------------------------------------------


def test_folders_that_hold_something_else_are_rejected(made, tmp_path):
    (mine := tmp_path / "thesis.txt").write_text("mine")
    fsspec.filesystem("memory").pipe_file("/sets/thesis/text", b"mine")
    for place, message in (
        (str(tmp_path), "not empty and holds no dataset"),
        ("memory://sets/thesis", "not empty and holds no dataset"),
        (str(mine), r"thesis\.txt is a file; give a folder"),
        (str(mine / "set"), "a part of this path is a file"),
        *([("/sys/torchsoft-set", "may not be written")] if Path("/sys").is_dir() else []),
    ):
        with pytest.raises(StoreError, match=message):
            open_or_create(place, made[1])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    with pytest.raises(StoreError, match="holds another dataset"):
        open_or_create(str(made[0]), made[1].model_copy(update={"seed": 99}))


@pytest.mark.parametrize(
    ("number", "words"), [(errno.EFBIG, "outgrew the limit on file sizes"), (errno.ENOSPC, "full")]
)
def test_errors_of_the_disk_have_remedies(number, words):
    with pytest.raises(StoreError, match=f"^a set: .*{words}"), store_errors("a set"):
        raise OSError(number, "no")


def test_parts_share_every_shard_out_once(made):
    config = made[1].model_copy(update={"trajectories": 37})
    for of in (1, 2, 5, 19):
        shards = [shard for i in range(of) for shard in Part(i + 1, of).shards(config)]
        assert sorted(shards) == [*range(19)]
    with pytest.raises(ValueError, match=r"part 1 of 20 is empty, .* shards of 2: make at most 19"):
        Part(1, 20).shards(config)
    assert listed([0, 3, 4, 5, 9]) == "0, 3-5, 9"
    assert listed(range(0, 100, 2)).endswith("38, ...")


def test_a_part_is_made_alone(made, tmp_path):
    """As a job of an array makes it."""
    path, out = written(tmp_path), str(tmp_path / "set")
    command = ["dataset", "make", str(path), "--out", out, "--workers", "0", "--part"]
    assert main([*command, "2/2"]) == 0
    assert Store(out, made[1]).unfinished() == [0, 2]
    with pytest.raises(SystemExit):
        main([*command, "3/2"])


@pytest.mark.slow
def test_an_estimate_is_measured_on_the_sets_own_runs(made, data, tmp_path):
    """Of what is left."""
    many = made[1].model_copy(update={"trajectories": 300})
    price = estimate(many, str(tmp_path / "none"), 1)
    assert price.steps == pytest.approx(300 * float(data.steps.mean()), rel=0.3)
    assert 0.0 < price.least < price.seconds < 600.0
    assert estimate(made[1], str(made[0]), 1).seconds == 0.0
