"""Datasets: the same whatever makes them, whole whatever kills them, and checked."""

import json
import os
import pickle
import re
import resource
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import torch
import xarray as xr
import zarr
from hostile.processes import ended, fork
from test_datasets_rigs import contents, same_commit, sound
from torch import Tensor
from torch.utils.data import DataLoader

from torchsoft import Rig, simulate
from torchsoft.cli import main
from torchsoft.datasets import generate as making
from torchsoft.datasets.check import check
from torchsoft.datasets.config import Config
from torchsoft.datasets.files import Manifest, StoreError, digest, record, record_key, write_bytes
from torchsoft.datasets.generate import Serial, generate, local_processes, points, simulate_task
from torchsoft.datasets.reader import Trajectories, open_dataset
from torchsoft.datasets.subject import Task, split
from torchsoft.datasets.writer import Store, create, laid_out, open_or_create
from torchsoft.files import replacing
from torchsoft.solve.progress import SimulationFailed

ROOT = Path(__file__).parent.parent
CONFIGS = sorted((ROOT / "data_gen" / "configs").glob("*.toml"))

TOML = """
title = "Test"
rig = "paper"
seed = 3
trajectories = {trajectories}
trajectories_per_shard = {shard}
duration = 0.9
sample_interval = 0.01
step = 0.005
samples_per_chunk = 40
[fixed]
"pads.L.elements_x" = 60
"pads.L.elements_y" = 2
"pads.U.elements_x" = 60
"pads.U.elements_y" = 2
"laws.steel_on_rubber.friction.v_s" = 0.05
"motion.F_ff.values_2" = "held"
[parameters]
"materials.rubber.E" = {{ low = 7e5, high = 8e5, scale = "log" }}
"laws.steel_on_rubber.friction.mu_s" = {{ low = 0.7, high = 0.9 }}
"motion.y_d.values_2" = {{ low = 48.6e-3, high = 48.8e-3 }}
[[kinds]]
name = "slow_roll"
fixed."motion.x_d" = {{ kind = "strokes", since = 0.5, stroke_time = 0.4, travel = 1e-3 }}
parameters."motion.x_d.travel" = {{ low = 1e-3, high = 2e-3, either_sign = true }}
[[kinds]]
name = "shake"
fixed."motion.x_d" = {{ kind = "chirp", since = 0.5, amplitude = 1.0, first = 2.0, last = 5.0 }}
parameters."motion.x_d.amplitude" = {{ low = 2e-4, high = 4e-4 }}
"""


def write_config(
    folder: Path, trajectories: int = 5, shard: int = 2, change: tuple[str, str] = ("", "")
) -> Path:
    path = folder / f"config-{trajectories}-{shard}-{abs(hash(change))}.toml"
    path.write_text(TOML.format(trajectories=trajectories, shard=shard).replace(*change,
        1) if change[0] else
                    TOML.format(trajectories=trajectories, shard=shard))  # fmt: skip
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small dataset, made in this process."""
    folder = tmp_path_factory.mktemp("made")
    config = Config.from_toml(write_config(folder))
    generate(config, str(folder / "set"), Serial(), progress=False)
    return folder / "set", config


def copy(source: Path, target: Path) -> Path:
    shutil.copytree(source, target)
    return target


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_ready_configs_are_valid_and_their_splits_keep_the_shares(path):
    config = Config.from_toml(path)
    found = Counter(split(config, i) for i in range(1000))
    shares = [found[name] / 1000 for name in ("train", "validation", "test")]
    np.testing.assert_allclose(shares, [0.7, 0.15, 0.15], atol=0.01)


def test_a_sobol_design_is_a_prefix_of_a_longer_one(tmp_path):
    short, long = (Config.from_toml(write_config(tmp_path, trajectories=n)) for n in (5, 40))
    np.testing.assert_array_equal(points(short), points(long)[:5])


@pytest.mark.slow
def test_processes_make_the_same_bytes(made, tmp_path):
    folder, config = made
    with local_processes(2) as executor:
        assert generate(config, str(tmp_path / "set"), executor, 2, progress=False) == 0
    assert contents(tmp_path / "set") == contents(folder)


def objects(url: str) -> dict[str, bytes]:
    """Every object below an fsspec URL."""
    fs, root = fsspec.url_to_fs(url)
    fs.invalidate_cache()
    return {name.removeprefix(f"{root}/"): same_commit(fs.cat_file(name)) for name in fs.find(root)}


def read_everywhere(url: str, folder: Path) -> None:
    """The check, xarray and torch see behind `url` what they see in `folder`."""
    assert [x for x in check(url) if "commit" not in x] == []
    assert open_dataset(url).load().identical(open_dataset(str(folder)).load())
    here, there = (
        Trajectories(place, ["x_C", "materials.rubber.E"], window=7) for place in (url, str(folder))
    )
    assert len(here) == len(there) == 5 * 13
    torch.testing.assert_close(here[20], there[20], rtol=0, atol=0)


@pytest.mark.slow
def test_an_object_store_holds_the_same_bytes(made):
    folder, config = made
    url = "memory://sets/rolling"
    generate(config, url, Serial(), progress=False)
    assert objects(url) == contents(folder)
    read_everywhere(url, folder)
    fs = fsspec.filesystem("memory")
    fs.rm_file("/sets/rolling/finished/1.sha256")
    fs.rm_file("/sets/rolling/theta_C/c/1/0")
    assert Store(url, config).unfinished() == [1]
    generate(config, url, Serial(), progress=False)
    assert objects(url) == contents(folder)
    with pytest.raises(StoreError, match="holds another dataset"):
        open_or_create(url, config.model_copy(update={"seed": 99}))
    fs.pipe_file("/sets/thesis/text", b"mine")
    with pytest.raises(StoreError, match="not empty and holds no dataset"):
        open_or_create("memory://sets/thesis", config)


@pytest.mark.slow
def test_another_shard_size_makes_the_same_data(made, tmp_path):
    folder, _ = made
    config = Config.from_toml(write_config(tmp_path, shard=3))
    generate(config, str(tmp_path / "set"), Serial(), progress=False)
    here, there = (open_dataset(str(path)).load() for path in (tmp_path / "set", folder))
    assert here.equals(there)


@pytest.mark.parametrize(
    ("fixed", "points", "stores"),
    [
        ('"pads.L.inertial" = true\n"pads.U.inertial" = true', 61, 9),
        ('"pads.L.points" = 2\n"pads.U.points" = 2', 120, 7),
    ],
)
def test_other_pads_and_contacts_are_kept_whole(tmp_path, fixed, points, stores):
    """The kinetic energy of inertial pads is in the balance; series of nodes are then those of all
    contact points."""
    path = write_config(tmp_path, trajectories=1, change=("[parameters]", f"{fixed}\n[parameters]"))
    generate(Config.from_toml(path), str(tmp_path / "set"), Serial(), progress=False)
    assert sound(tmp_path / "set")
    data = xr.open_zarr(tmp_path / "set")
    assert (data.sizes["L_point"], data.sizes["store"]) == (points, stores)
    assert float(data.normal_force_L[0, 0].sum()) == pytest.approx(0.4065 * 9.81, rel=2e-3)


def set_value(name: str, where: tuple[Any, ...], value: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        array = zarr.open_group(str(folder), mode="r+")[name]
        array[where] = value

    return change


def vouch(folder: Path) -> None:
    """Digests of what is there now, so that something else has to find what is wrong with it."""
    path = folder / "manifest.json"
    manifest = Manifest.model_validate_json(path.read_bytes())
    digests = {
        key: digest((folder / key).read_bytes())
        for key in manifest.digests
        if (folder / key).exists()
    }
    path.write_text(manifest.model_copy(update={"digests": digests}).text())
    for shard in range(manifest.layout.shards):
        (folder / record_key(shard)).write_bytes(
            record({key: digest((folder / key).read_bytes()) for key in manifest.layout.of(shard)})
        )


def change_json(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        change(content)
        (folder / name).write_text(json.dumps(content, indent=2) + "\n")

    return damage


def consolidated(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """In the copy of the metadata that readers open."""
    return change_json(
        "zarr.json", lambda group: change(group["consolidated_metadata"]["metadata"][name])
    )


def write(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(data)


def edit(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def flipped(data: bytes) -> bytes:
    """One bit in the middle."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :]


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def swap(a: str, b: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        first = (folder / a).read_bytes()
        (folder / b).replace(folder / a)
        (folder / b).write_bytes(first)

    return damage


def open_ledger(folder: Path) -> None:
    """An energy that comes from nowhere, booked faithfully."""
    data = xr.open_zarr(folder).load()
    for name, where in (("stored_energy", (1, 50, 2)), ("energy_residual", (1, 50))):
        set_value(name, where, data[name].values[where] + 0.5)(folder)
    data = xr.open_zarr(folder)
    worst = float(np.abs(data.energy_residual[1]).max() / data.injected_energy[1, -1])
    set_value("energy_residual_rel", (1,), worst)(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            consolidated("theta_C", lambda a: a["attributes"].update(units="deg")),
            "theta_C: units are 'deg', not 'rad'",
        ),
        (
            change_json(
                "zarr.json", lambda g: g["consolidated_metadata"]["metadata"].pop("omega_C")
            ),
            "omega_C: missing",
        ),
        (set_value("split", (1,), "test"), "trajectory 1: split is test, but the design has"),
        (
            open_ledger,
            r"trajectory 1: energy residual is [\d.]+ of the energy injected, above 0\.02",
        ),
        (
            set_value("energy_residual_rel", (2,), 1e-3),
            "trajectory 2: energy_residual_rel is 0.001, but the series",
        ),
        (
            change_json("manifest.json", lambda m: m["config"].update(seed=99)),
            r"config_hash is \w+, but the configuration's",
        ),
        (
            change_json("manifest.json", lambda m: m.update(seed=4)),
            "seed is 4, but the configuration's is 3",
        ),
        (
            change_json("manifest.json", lambda m: m["config"].update(duration=-1.0)),
            r"manifest\.json: .*duration",
        ),
        (
            set_value("normal_force_U", (4, 60, 30), -1.0),
            "trajectory 4: normal_force_U pulls",
        ),
        (set_value("x_C", (0, 3), np.inf), "trajectory 0: not finite: x_C"),
        (set_value("stored_energy", (1, 7, 2), 1.0), "trajectory 1: energy_residual is not"),
        (set_value("contact_L", (0, 60), 0), "acts where contact_L is 0"),
        (
            set_value("materials.rubber.E", (2,), 7.5e5),
            r"trajectory 2: materials\.rubber\.E is 750000.0",
        ),
        (set_value("failed", (3,), 1), "failed without a reason"),
    ],
)
def test_wrong_content_is_found(made, tmp_path, change, message):
    """By the check, though every digest fits."""
    change(folder := copy(made[0], tmp_path / "set"))
    vouch(folder)
    findings = [x for x in check(str(folder)) if "no commit" not in x]
    assert len(findings) == 1, findings
    assert re.search(message, findings[0])
    assert "\n" not in findings[0]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            edit("theta_C/c/0/0", flipped),
            r"theta_C/c/0/0 is damaged.*remove .*finished/0\.sha256 and start",
        ),
        (edit("motion.y_d.values_2/c/2", flipped), "motion.y_d.values_2/c/2 is damaged"),
        (remove("omega_C/c/1/0"), "omega_C/c/1/0 is missing"),
        (swap("omega_C/c/0/0", "omega_C/c/1/0"), "omega_C/c/0/0 is damaged"),
        (write("finished/1.sha256", b""), r"finished/1\.sha256 is damaged"),
        (edit("finished/1.sha256", flipped), r"finished/1\.sha256 is damaged|/c/1\S* is damaged"),
        (remove("finished/1.sha256"), "1 of 3 shards are not finished"),
        (edit("time/c/0", flipped), "time/c/0 is damaged"),
        (edit("zarr.json", flipped), r"zarr\.json is damaged"),
        (remove("zarr.json"), r"zarr\.json is missing"),
        (write("manifest.json", b"[]"), r"manifest\.json is damaged"),
        (write("manifest.json", b"\xff\xfe{"), r"manifest\.json is damaged"),
        (write("manifest.json", b"[" * 100_000), r"manifest\.json is damaged"),
        (change_json("manifest.json", lambda m: m.update(layout=3)), r"manifest\.json is damaged"),
        (
            change_json("manifest.json", lambda m: m["config"].update(step=1e-3)),
            r"manifest\.json is damaged",
        ),
        (remove("manifest.json"), r"manifest\.json is missing"),
    ],
)
def test_damage_is_found(made, tmp_path, damage, message):
    """By the check, and by reading."""
    damage(folder := copy(made[0], tmp_path / "set"))
    findings = [x for x in check(str(folder)) if "no commit" not in x]
    assert findings
    assert re.search(message, findings[0])
    assert "\n" not in "".join(findings)
    with pytest.raises(StoreError, match=r"is damaged|is missing|are not finished") as refused:
        open_dataset(str(folder)).load()
    assert "\n" not in str(refused.value)
    names = ["theta_C", "F_ff", "motion.y_d.values_2", "omega_C"]
    if (
        "time" not in message and "/c/1" not in message
    ):  # what is damaged may be of an array that it does not read
        with pytest.raises(StoreError, match=r"is damaged|is missing|are not finished"):
            every_window(str(folder), names)


def every_window(url: str, names: list[str]) -> list[dict[str, torch.Tensor]]:
    windows = Trajectories(url, names)
    return [windows[i] for i in range(len(windows))]


@pytest.mark.parametrize(
    "damage", [edit("omega_C/zarr.json", flipped), write("omega_C/copy", b"x")]
)
def test_damage_to_what_readers_do_not_open_is_found_by_the_check(made, tmp_path, damage):
    damage(folder := copy(made[0], tmp_path / "set"))
    assert len([x for x in check(str(folder)) if "no commit" not in x]) == 1
    assert open_dataset(str(folder)).load().identical(open_dataset(str(made[0])).load())


def test_a_file_behind_the_back_of_others_is_found_by_zarr_itself(made, tmp_path):
    """By the checksums of the arrays, without this package's reader."""
    folder = copy(made[0], tmp_path / "set")
    for name in ("theta_C/c/0/0", "motion.y_d.values_2/c/1"):
        edit(name, flipped)(folder)
        with pytest.raises(ValueError, match="checksum"):
            np.asarray(zarr.open_group(str(folder))[name.partition("/")[0]][:])


def test_standard_tools_check_the_shards(made, tmp_path):
    if (tool := shutil.which("sha256sum")) is None:
        pytest.skip("needs sha256sum")
    folder = copy(made[0], tmp_path / "set")
    command = [tool, "--check", "--quiet", *(str(path) for path in (folder / "finished").iterdir())]
    assert subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0
    edit("theta_C/c/0/0", flipped)(folder)
    assert subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode != 0


def test_unfinished_shards_are_refused_or_left_out(made, tmp_path):
    folder = copy(made[0], tmp_path / "set")
    remove("finished/1.sha256")(folder)
    for read in (open_dataset, lambda url: Trajectories(url, [])):
        with pytest.raises(StoreError, match="1 of 3 shards are not finished"):
            read(str(folder))
    assert open_dataset(str(folder), unfinished=True).trajectory.values.tolist() == [0, 1, 4]
    assert Trajectories(str(folder), [], unfinished=True).trajectories.tolist() == [0, 1, 4]


def test_what_is_not_finite_is_not_written(made, tmp_path, monkeypatch):
    """Unless it is marked as failed; a simulation whose results are not finite has failed."""
    config = made[1]
    store, design = open_or_create(str(tmp_path / "set"), config), points(config)
    row = simulate_task(config, config.subject.task(4, design[4]))
    angle = row["theta_C"].copy()
    angle[3] = np.nan
    with pytest.raises(
        ValueError, match="trajectory 4 is not marked as failed, but not finite: theta_C"
    ):
        store.write(2, [row | {"theta_C": angle}])
    assert store.unfinished() == [0, 1, 2]
    series = making.series
    monkeypatch.setattr(making, "series", lambda *given: series(*given) | {"theta_C": angle})
    row = simulate_task(config, config.subject.task(4, design[4]))
    assert (row["failed"], row["reason"]) == (1, "not finite: theta_C")
    assert np.isnan(row["theta_C"]).all()


def test_leftovers_of_the_dead_are_removed_and_files_of_the_living_are_not(made, tmp_path):
    """At the next start: partial files of a killed run, in the layout too, but none that somebody
    is writing."""
    config, folder = made[1], tmp_path / "set"
    content = laid_out(config)
    for key, data in list(content.items())[:5]:
        write_bytes(str(folder), key, data)
    (folder / "zarr.json.0123456789abcdef.partial").write_bytes(b"half")
    (folder / "time/c/0.0123456789abcdef.partial").parent.mkdir(parents=True)
    (folder / "time/c/0.0123456789abcdef.partial").write_bytes(b"half")
    with replacing(folder / "theta_C/zarr.json") as partial:
        partial.write_bytes(content["theta_C/zarr.json"])
        open_or_create(str(folder), config)
        assert list(folder.rglob("*.partial")) == [partial]
    create(str(tmp_path / "other"), config)
    assert contents(folder) == contents(tmp_path / "other")


def test_whoever_lays_a_folder_out_later_changes_nothing(made, tmp_path):
    """Two that begin at once both find no manifest; the slower one must not undo what the faster
    one made since."""
    config, folder = made[1], copy(made[0], tmp_path / "set")
    create(str(folder), config)
    assert contents(folder) == contents(made[0])
    create(str(folder), other := config.model_copy(update={"seed": 99}))
    with pytest.raises(StoreError, match="holds another dataset"):
        open_or_create(str(folder), other)
    assert contents(folder) == contents(made[0])


def test_the_bar_of_a_finished_set_counts_simulated_seconds(made, capsys):
    """It said "-188155.69 simulated s/s" and "1.2000000000000002"."""
    generate(made[1], str(made[0]), Serial())
    err = capsys.readouterr().err
    total = 5 * made[1].duration
    assert f" {total:.1f}/{total:.1f} simulated s [" in err
    assert "-" not in err


def test_nothing_is_written_into_a_dataset(made, tmp_path):
    for part, words in (
        ("export", ["--to", "mcap", "--out", str(made[0] / "logs")]),
        ("check", ["--picture", str(made[0] / "picture.png")]),
    ):
        assert main(["dataset", part, str(made[0]), *words]) == 2
    assert list(check(str(made[0]))) == []


def test_check_draws_its_picture(made, tmp_path, capsys):
    picture = str(tmp_path / "coverage.png")
    assert main(["dataset", "check", str(made[0]), "--picture", picture]) == 0
    assert "5 trajectories" in capsys.readouterr().out
    assert (tmp_path / "coverage.png").stat().st_size > 10_000


def test_a_failed_simulation_is_recorded(tmp_path, monkeypatch):
    def failing(model: Rig, t: Tensor, **options: Any) -> None:
        failure = SimulationFailed("the disc was lost at t = 0.1 s", 0.1)
        failure.trajectory = simulate(model, t[:11], **options)
        raise failure

    monkeypatch.setattr("torchsoft.datasets.generate.simulate", failing)
    config = Config.from_toml(write_config(tmp_path, trajectories=1))
    generate(config, str(tmp_path / "set"), Serial(), progress=False)
    data = xr.open_zarr(tmp_path / "set").load()
    assert data.failed.values.tolist() == [1]
    assert str(data.reason.values[0]) == "the disc was lost at t = 0.1 s"
    assert data.failure_time.values.tolist() == [0.1]
    assert np.isnan(data.x_C).all()
    assert data["materials.rubber.E"].values[0] > 0
    (found,) = check(str(tmp_path / "set"))
    assert found == "1 of 1 trajectories failed, most often: the disc was lost at t = 0.1 s"


@pytest.mark.parametrize("recorded", [False, True])
def test_only_unfinished_shards_are_made_again(made, tmp_path, recorded):
    """A shard that lacks a file counts as unfinished, whatever its record says."""
    folder, config = copy(made[0], tmp_path / "set"), made[1]
    if not recorded:
        remove("finished/1.sha256")(folder)
    (folder / "theta_C/c/1/0").unlink()
    (folder / "theta_C/c/1/0.0123456789abcdef.partial").write_bytes(b"half")
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("c/**/*") if p.is_file()}
    generate(config, str(folder), Serial(), progress=False)
    assert contents(folder) == contents(made[0])
    written = {
        p.relative_to(folder)
        for p in folder.rglob("c/**/*")
        if p.is_file() and before.get(p) != p.stat().st_mtime_ns
    }
    assert written == {Path(name) for name in contents(folder) if re.search(r"/c/1(/|$)", name)}


def test_folders_that_are_refused(made, tmp_path):
    config = made[1]
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(StoreError, match="not empty and holds no dataset"):
        open_or_create(str(tmp_path), config)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    with pytest.raises(StoreError, match="holds another dataset"):
        open_or_create(str(made[0]), config.model_copy(update={"seed": 99}))
    with pytest.raises(StoreError, match=r"thesis\.txt is a file; give a folder"):
        open_or_create(str(tmp_path / "thesis.txt"), config)
    with pytest.raises(StoreError, match="a part of this path is a file"):
        open_or_create(str(tmp_path / "thesis.txt" / "set"), config)


@pytest.mark.skipif(
    not Path("/sys").is_dir(), reason="needs a folder that not even root may write to"
)
def test_an_unwritable_folder_is_refused(made):
    with pytest.raises(StoreError, match="may not be written"):
        open_or_create("/sys/torchsoft-set", made[1])


@pytest.mark.slow
def test_a_file_size_limit_is_said_and_costs_nothing(made, tmp_path, capfd):
    """The operating system's own refusal, in the middle of a shard; without the limit the same
    command finishes."""
    largest = max(len(data) for name, data in contents(made[0]).items() if "/c/" in name)
    config, out = str(write_config(tmp_path)), str(tmp_path / "set")
    command = ["dataset", "make", config, "--out", out, "--workers", "0"]
    open_or_create(str(tmp_path / "set"), made[1])

    def limited() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest // 3, largest // 3))
        return main(command)

    assert ended(fork(limited)) == 2
    said = capfd.readouterr().err
    assert "error: " in said
    assert "a file outgrew the limit on file sizes" in said
    assert "Traceback" not in said
    assert Store(str(tmp_path / "set"), made[1]).unfinished() == [0, 1, 2]
    assert main(command) == 0
    assert contents(tmp_path / "set") == contents(made[0])


def test_a_killed_run_ends_in_the_same_bytes(made, tmp_path, monkeypatch):
    """Killed in the second shard, and started again; the hostile trial kills at any moment."""
    out = tmp_path / "set"

    def killed(config: Config, one: Task) -> dict[str, Any]:
        if one.index == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return simulate_task(config, one)

    with monkeypatch.context() as patch:
        patch.setattr("torchsoft.datasets.generate.simulate_task", killed)
        pid = fork(lambda: generate(made[1], str(out), Serial(), progress=False))
    assert ended(pid) == -signal.SIGKILL
    assert Store(str(out), made[1]).unfinished() == [1, 2]
    make = ["dataset", "make", str(write_config(tmp_path))]
    assert main([*make, "--out", str(out), "--workers", "1"]) == 0
    assert contents(out) == contents(made[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_that_loses_a_worker_makes_the_same_bytes(made, tmp_path):
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
            while not list((tmp_path / "set" / "finished").glob("*.sha256")):
                time.sleep(0.02)
            os.kill(next(iter(pids.values())), signal.SIGKILL)

        killer = Thread(target=kill_once_started)
        killer.start()
        generate(config, str(tmp_path / "set"), executor, 2, progress=False)
        killer.join()
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


# the torch dataset
# ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def partial(made, tmp_path_factory):
    """The dataset with a trajectory that failed, a number that is infinite, and a last shard that
    is not finished."""
    folder = copy(made[0], tmp_path_factory.mktemp("partial") / "set")
    set_value("failed", (2,), 1)(folder)
    set_value("motion.y_d.values_2", (0,), np.inf)(folder)
    vouch(folder)
    remove("finished/2.sha256")(folder)
    return str(folder)


def reading(url: str, *what: Any, **how: Any) -> Trajectories:
    """What is finished."""
    return Trajectories(url, *what, **how, unfinished=True)


def test_windows_hold_what_the_store_holds(partial):
    data, stored = (
        reading(partial, ["x_C", "materials.rubber.E"], window=5, stride=40),
        xr.open_zarr(partial),
    )
    assert data.trajectories.tolist() == [0, 1, 3]  # 2 failed, 4 is unfinished
    assert len(data) == 3 * 3
    item = data[4]  # the second window of trajectory 1
    assert (int(item["trajectory"]), int(item["start"])) == (1, 40)
    np.testing.assert_array_equal(item["x_C"], stored["x_C"][1, 40:45])
    assert item["materials.rubber.E"] == float(stored["materials.rubber.E"][1])
    assert int(data[-1]["start"]) == 80


def test_splits_are_those_of_the_design(partial, made):
    for name in ("train", "validation", "test"):
        assert list(reading(partial, [], split=name).trajectories) == [
            i for i in (0, 1, 3) if split(made[1], i) == name
        ]


def test_it_pickles_small_and_is_read_by_forked_workers_from_any_store(partial):
    fsspec.filesystem("memory").put(partial, "/copy/set", recursive=True)
    plain = reading(partial, ["x_C", "materials.rubber.E"], window=30, dtype=torch.float32)
    for url in (partial, "memory://copy/set"):
        data = reading(url, ["x_C", "materials.rubber.E"], window=30, dtype=torch.float32)
        data[0]  # opened before the fork
        assert len(pickle.dumps(data)) < 2000
        batches = list(
            DataLoader(
                data, batch_size=4, num_workers=2, multiprocessing_context="fork", timeout=60
            )
        )
        for name in data.variables:
            got = torch.cat([batch[name] for batch in batches])
            assert got.dtype == torch.float32
            torch.testing.assert_close(got, torch.stack([x[name] for x in plain]))


def test_windows_in_memory_streamed_and_read_one_by_one_are_the_same(partial):
    """With each sweep in another order, and with workers that share the shards out."""
    names, how = ["x_C", "materials.rubber.E"], {"window": 5, "stride": 3, "dtype": torch.float32}
    held, read = reading(partial, names, **how), reading(partial, names, **how, memory=0.0)
    assert (held.fits, read.fits) == (True, False)
    assert held.size == 3 * 4 * (91 + 1)
    for i in range(0, len(held), 7):
        torch.testing.assert_close(held[i], read[i], rtol=0, atol=0)
    held[0]["x_C"].zero_()
    assert bool(held[0]["x_C"].any())  # what is given is the user's own
    wanted = {(int(x["trajectory"]), int(x["start"])): x["x_C"] for x in held}
    stream = read.streamed(shards=1, seed=3)
    for workers in (0, 2):
        loader = DataLoader(stream, num_workers=workers, timeout=60 * (workers > 0))
        orders = []
        for _ in range(2):
            sweep = list(loader)
            found = [(int(x["trajectory"]), int(x["start"])) for x in sweep]
            assert sorted(found) == sorted(wanted)
            for one, x in zip(found, sweep):
                torch.testing.assert_close(x["x_C"][0], wanted[one], rtol=0, atol=0)
            orders.append(found)
        assert orders[0] != orders[1]


def test_windows_come_fast_from_memory(partial):
    """Shuffled, two thousand a second and more on one core."""
    windows = reading(partial, ["x_C", "effort_y", "materials.rubber.E"], window=20, stride=1)
    began, count = time.process_time(), 0
    while time.process_time() - began < 0.5:
        for batch in DataLoader(windows, batch_size=64, shuffle=True):
            count += len(batch["start"])
    assert count / (time.process_time() - began) > 2000


@pytest.mark.parametrize(
    ("names", "how", "message"),
    [
        ([], {"memory": -1.0}, "`memory` must be a number of GiB, 0 or more"),
        (["disc_pose"], {}, r"no numbers named 'disc_pose'; known: .*x_C"),
        ([], {"window": 92}, "`window` must be 1 to 91"),
        *(([], {name: value}, f"`{name}` must be a whole number from 1 on, but is {value}")
          for name in ("window", "stride") for value in (0, 2.5)),
        *(([], {"dtype": dtype}, r"`dtype` must be one of torch\.float64, .*, but is ")
          for dtype in (torch.int32, torch.bool, torch.complex64, "float32")),
        ([], {"split": "dev"}, "`split` must be"),
    ],
)  # fmt: skip
def test_a_reading_that_is_none_is_refused(partial, names, how, message):
    with pytest.raises(ValueError, match=message):
        reading(partial, names, **how)


def test_numbers_that_the_dtype_cannot_hold_are_refused(partial):
    """And those that are not finite in the store are given as they are."""
    assert torch.isinf(
        reading(partial, ["motion.y_d.values_2"], dtype=torch.float16)[0]["motion.y_d.values_2"]
    )
    with pytest.raises(
        ValueError,
        match=r"`materials.rubber.E` of trajectory 0 holds 7.*, which torch\.float16 cannot; take "
        r"a wider `dtype`",
    ):
        reading(partial, ["materials.rubber.E"], dtype=torch.float16)[0]
    with pytest.raises(IndexError):
        reading(partial, ["materials.rubber.E"])[1000]
