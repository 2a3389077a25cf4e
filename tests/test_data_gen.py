"""Datasets: the same whatever makes them, whole whatever kills them, and checked."""

import errno
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr

from data_gen.check import check
from data_gen.config import Config
from data_gen.design import points, split, task
from data_gen.generate import Serial, generate, local_processes, main
from data_gen.simulation import simulate_task
from data_gen.store import Store, StoreError, open_or_create

ROOT = Path(__file__).parent.parent
CONFIGS = sorted((ROOT / "data_gen" / "configs").glob("*.toml"))

TOML = """
title = "Test"
seed = 3
trajectories = {trajectories}
trajectories_per_shard = {shard}
duration = 0.9
sample_interval = 0.01
step = 0.002
samples_per_chunk = 40
grasp_depth = {{ low = 1.3e-3, high = 1.5e-3 }}
[fixed]
"pad.elements_x" = 60
"pad.elements_y" = 2
"contact.v_s" = 0.05
[parameters]
"pad.E" = {{ low = 7e5, high = 8e5, scale = "log" }}
"contact.mu_s" = {{ low = 0.7, high = 0.9 }}
[[kinds]]
kind = "slow_roll"
travel = {{ low = 1e-3, high = 2e-3 }}
[[kinds]]
kind = "multi_sine"
amplitude_x = {{ low = 2e-4, high = 4e-4 }}
amplitude_y = {{ low = 1e-5, high = 3e-5 }}
"""


def write_config(folder: Path, trajectories: int = 5, shard: int = 2, change: tuple[str, str] = ("", "")) -> Path:
    path = folder / f"config-{trajectories}-{shard}-{abs(hash(change))}.toml"
    path.write_text(TOML.format(trajectories=trajectories, shard=shard).replace(*change, 1) if change[0] else
                    TOML.format(trajectories=trajectories, shard=shard))  # fmt: skip
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Config]:
    """A small dataset, made in this process."""
    folder = tmp_path_factory.mktemp("made")
    config = Config.from_toml(write_config(folder))
    generate(config, str(folder / "set"), Serial(), progress=False)
    return folder / "set", config


def files(folder: Path) -> dict[str, bytes]:
    """Every file of a store, the manifest included."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def copy(source: Path, target: Path) -> Path:
    for name, data in files(source).items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_bytes(data)
    return target


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_ready_configs_are_valid_and_their_splits_keep_the_shares(path: Path) -> None:
    config = Config.from_toml(path)
    shares = [sum(split(config, i) == name for i in range(1000)) / 1000 for name in ("train", "validation", "test")]
    np.testing.assert_allclose(shares, [0.7, 0.15, 0.15], atol=0.01)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('title = "Test"', 'title = "Test"\nworkers = 3', "workers"),
        ("low = 7e5", "low = 9e5", r"parameters\.pad\.E"),
        ("low = 7e5", "low = -1.0", r"parameters\.pad\.E"),
        ('"pad.E"', '"pad.Young"', r"pad\.Young"),
        ("low = 1.3e-3, high = 1.5e-3", "low = 1.3e-3, high = 0.02", r"grasp_depth = 0\.02"),
        ("low = 0.7, high = 0.9", "low = 0.3, high = 0.9", r"contact\.mu_s = 0\.3.*mu_k"),
        ("low = 1e-3, high = 2e-3", "low = 1e-3, high = 0.2", r"kinds\.0\.travel"),
        ("duration = 0.9", "duration = 0.5", "duration"),
        ("step = 0.002", "step = 0.5", "step"),
        ('kind = "slow_roll"', 'kind = "hop"', "kinds"),
    ],
)
def test_a_wrong_config_is_refused_with_the_field(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Config.from_toml(write_config(tmp_path, change=(old, new)))


def test_a_sobol_design_is_a_prefix_of_a_longer_one(tmp_path: Path) -> None:
    short, long = (Config.from_toml(write_config(tmp_path, trajectories=n)) for n in (5, 40))
    np.testing.assert_array_equal(points(short), points(long)[:5])


def test_processes_make_the_same_bytes(made: tuple[Path, Config], tmp_path: Path) -> None:
    folder, config = made
    with local_processes(2) as executor:
        assert generate(config, str(tmp_path / "set"), executor, 2, progress=False) == 0
    assert files(tmp_path / "set") == files(folder)


def test_another_shard_size_makes_the_same_data(made: tuple[Path, Config], tmp_path: Path) -> None:
    folder, _ = made
    config = Config.from_toml(write_config(tmp_path, shard=3))
    generate(config, str(tmp_path / "set"), Serial(), progress=False)
    here, there = (xr.open_zarr(path).drop_vars("done").load() for path in (tmp_path / "set", folder))
    assert here.equals(there)


def test_xarray_opens_it_with_units(made: tuple[Path, Config]) -> None:
    data = xr.open_zarr(made[0])
    assert dict(data.normal_force_lower.sizes) == {"trajectory": 5, "time": 91, "lower_surface": 61}
    assert data.normal_force_lower.attrs["units"] == "N"
    assert data.displacement_upper.dims == ("trajectory", "time", "upper_surface", "axis")
    assert all("units" in data[name].attrs for name in data.data_vars)
    weight = float(data.normal_force_lower.isel(trajectory=0, time=50).sum())
    assert 20 < weight < 120  # [N], the grasp


def test_a_sound_dataset_has_no_finding(made: tuple[Path, Config]) -> None:
    findings = [x for x in check(str(made[0])) if "commit" not in x]
    assert findings == []


def set_value(name: str, where: tuple[Any, ...], value: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        array = zarr.open_group(str(folder), mode="r+")[name]
        assert isinstance(array, zarr.Array)
        array[where] = value

    return change


def truncate(folder: Path) -> None:
    path = folder / "disc_angle/c/0/0"
    path.write_bytes(path.read_bytes()[:-40])


def change_units(folder: Path) -> None:
    zarr.open_group(str(folder), mode="r+")["disc_angle"].attrs["units"] = "deg"


def change_seed(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seed": 4}))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (set_value("disc_angle", (1, 7), np.nan), "trajectory 1: not finite: disc_angle"),
        (set_value("stored_energy", (1, 7, 2), 1.0), "trajectory 1: energy_residual is not"),
        (set_value("contact_lower", (0, 60), 0), "acts where contact_lower is 0"),
        (set_value("done", (1,), 0), "1 of 3 shards are not finished"),
        (set_value("pad.E", (2,), 7.5e5), r"trajectory 2: pad\.E is 750000.0"),
        (set_value("failed", (3,), 1), "failed without a reason"),
        (truncate, "shard 0 cannot be read"),
        (change_seed, "seed is 4"),
        (lambda folder: (folder / "manifest.json").unlink(), r"manifest\.json: missing"),
    ],
)
def test_damage_is_found(made: tuple[Path, Config], tmp_path: Path, damage: Any, said: str) -> None:
    damage(copy(made[0], tmp_path / "set"))
    assert any(re.search(said, finding) for finding in check(str(tmp_path / "set")))


def test_check_draws_its_picture(made: tuple[Path, Config], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from data_gen.check import main as check_main

    check_main([str(made[0]), "--picture", str(tmp_path / "coverage.png")])
    assert "5 trajectories" in capsys.readouterr().out
    assert (tmp_path / "coverage.png").stat().st_size > 10_000


def test_a_failed_simulation_is_recorded(tmp_path: Path) -> None:
    path = write_config(tmp_path, trajectories=1, change=('"contact.v_s" = 0.05', '"pad.tau" = 1e-4'))
    config = Config.from_toml(path)
    generate(config, str(tmp_path / "set"), Serial(), progress=False)
    data = xr.open_zarr(tmp_path / "set").load()
    assert data.failed.values.tolist() == [1]
    assert "at t = " in str(data.reason.values[0])
    assert np.isnan(data.disc_position).all()
    assert data["pad.E"].values[0] > 0
    assert [x for x in check(str(tmp_path / "set")) if "commit" not in x] == []


def test_only_unfinished_shards_are_made_again(
    made: tuple[Path, Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, config = copy(made[0], tmp_path / "set"), made[1]
    set_value("done", (1,), 0)(folder)
    (folder / "disc_angle/c/1/0").unlink()
    (folder / "disc_angle/c/1/0.1234.partial").write_bytes(b"half")
    seen = []
    monkeypatch.setattr("data_gen.generate.simulate_task", lambda c, t: seen.append(t.index) or simulate_task(c, t))
    generate(config, str(folder), Serial(), progress=False)
    assert seen == [2, 3]
    assert files(folder) == files(made[0])


def test_folders_that_are_refused(made: tuple[Path, Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = made[1]
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(StoreError, match="not empty and holds no dataset"):
        open_or_create(str(tmp_path), config)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    with pytest.raises(StoreError, match="holds another dataset"):
        open_or_create(str(made[0]), config.model_copy(update={"seed": 99}))

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("fsspec.implementations.local.LocalFileSystem.makedirs", refuse)
    with pytest.raises(StoreError, match="may not be written"):
        open_or_create(str(tmp_path / "new"), config)


def test_a_full_disk_is_said_and_costs_nothing(
    made: tuple[Path, Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, config = copy(made[0], tmp_path / "set"), made[1]
    set_value("done", (2,), 0)(folder)
    before = zarr.Array.__setitem__

    def full(self: Any, key: Any, value: Any) -> None:
        if self.basename == "disc_spin":
            raise OSError(errno.ENOSPC, "No space left on device")
        before(self, key, value)

    with monkeypatch.context() as patch:
        patch.setattr(zarr.Array, "__setitem__", full)
        with pytest.raises(StoreError, match="disk is full"):
            generate(config, str(folder), Serial(), progress=False)
    assert Store(str(folder), config).unfinished() == [2]
    generate(config, str(folder), Serial(), progress=False)
    assert files(folder) == files(made[0])


def test_command_line_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none.toml"), "--out", str(tmp_path / "set")]) == 2
    assert "No such file" in capsys.readouterr().err


def kill_and_resume(folder: Path, config: Path, kills: int, seed: int) -> None:
    """Start again and again, SIGKILL after a random while past the first new file; then let it finish."""
    rng, out = random.Random(seed), folder / "set"
    command = [sys.executable, "-m", "data_gen.generate", str(config), "--out", str(out), "--workers", "1"]
    for kill in range(kills):
        before = sum(1 for _ in out.rglob("*"))
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        while process.poll() is None and kill % 5 and sum(1 for _ in out.rglob("*")) == before:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 6.0 if kill % 5 == 0 else 0.4))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("kills", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_killed_runs_end_in_the_same_bytes(tmp_path: Path, kills: int) -> None:
    path = write_config(tmp_path, trajectories=2 * kills + 2, shard=1)
    generate(Config.from_toml(path), str(tmp_path / "whole"), Serial(), progress=False)
    kill_and_resume(tmp_path, path, kills, seed=kills)
    assert files(tmp_path / "set") == files(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_that_loses_a_worker_makes_the_same_bytes(made: tuple[Path, Config], tmp_path: Path) -> None:
    from distributed import Client, LocalCluster

    path = write_config(tmp_path, trajectories=12, shard=1)
    config = Config.from_toml(path)
    generate(config, str(tmp_path / "whole"), Serial(), progress=False)
    settings: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**settings) as cluster, Client(cluster) as client:
        pids = client.run(os.getpid)
        executor = client.get_executor(retries=3, pure=False)
        from threading import Thread

        def kill_once_started() -> None:
            while not list((tmp_path / "set" / "done").glob("c/*")):
                time.sleep(0.02)
            os.kill(next(iter(pids.values())), signal.SIGKILL)

        killer = Thread(target=kill_once_started)
        killer.start()
        generate(config, str(tmp_path / "set"), executor, 2, progress=False)
        killer.join()
    assert files(tmp_path / "set") == files(tmp_path / "whole")


def test_tasks_do_not_depend_on_each_other(made: tuple[Path, Config]) -> None:
    config = made[1]
    design, data = points(config), xr.open_zarr(made[0])
    row = simulate_task(config, task(config, 4, design[4]))
    np.testing.assert_allclose(row["disc_position"], data.disc_position[4], rtol=0, atol=1e-12)
