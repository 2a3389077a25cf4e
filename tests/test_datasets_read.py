# ruff: noqa: F401, F811 -- fixtures are imported
"""Datasets that are damaged or wrong are found, and sound ones are read in windows."""

import json
import pickle
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import torch
import xarray as xr
import zarr
from hostile.damage import BYTES, Victim, damage
from test_datasets import data, faults, made
from torch.utils.data import DataLoader

from torchsoft.datasets import Trajectories, open_dataset
from torchsoft.datasets.files import Manifest, StoreError, digest, record, record_key
from torchsoft.datasets.subject import split


def copied(source: Path, folder: Path | str) -> Path:
    return Path(shutil.copytree(source, Path(folder) / "set"))


# what is damaged
# ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("theta_disc/c/0/0", b"x", r"c/0/0 is damaged.*remove .*finished/0\.sha256 and start"),
        ("theta_disc/c/1/0", None, r"theta_disc/c/1/0 is missing"),
        ("motion.y_d.values_2/c/2", b"", r"motion.y_d.values_2/c/2 is damaged"),
        ("finished/1.sha256", b"", r"finished/1\.sha256 is damaged"),
        ("finished/1.sha256", None, r"1 of 3 shards are not finished"),
        ("zarr.json", None, r"zarr\.json is missing"),
        ("manifest.json", b"[" * 100_000, r"manifest\.json is damaged"),
        ("manifest.json", b"\xff\xfe{", r"manifest\.json is damaged"),
        ("manifest.json", None, r"manifest\.json is missing"),
    ],
)
def test_a_damaged_file_is_named_with_the_remedy(made, tmp_path, name, content, message):
    """By the check, by xarray and in windows."""
    path = copied(made[0], tmp_path) / name
    path.unlink() if content is None else path.write_bytes(content)
    assert re.search(message, faults(tmp_path / "set")[0])
    for read in (
        lambda url: open_dataset(url).load(),
        lambda url: [*Trajectories(url, ["theta_disc", "motion.y_d.values_2"])],
    ):
        with pytest.raises(StoreError, match=message):
            read(str(tmp_path / "set"))


def test_a_foreign_file_is_found(made, tmp_path):
    folder = copied(made[0], tmp_path)
    (folder / "theta_disc/copy").write_bytes(b"x")
    assert re.search(r"theta_disc/copy does not belong to the dataset; remove", faults(folder)[0])


def test_damage_is_found_without_this_package(made, tmp_path):
    """By zarr, with the checksums of the arrays, and by `sha256sum`, with the records."""
    folder = copied(made[0], tmp_path)
    records = [str(path) for path in (folder / "finished").iterdir()]
    command = ["sha256sum", "--check", "--quiet", *records]
    if tool := shutil.which("sha256sum"):
        assert subprocess.run(command, cwd=folder, capture_output=True).returncode == 0
    for name in ("theta_disc/c/0/0", "motion.y_d.values_2/c/1"):
        damage(BYTES["a bit"], Victim(folder / name, np.random.default_rng(0)))
        with pytest.raises(ValueError, match="checksum"):
            np.asarray(zarr.open_group(str(folder))[name.partition("/")[0]][:])
    if tool:
        assert subprocess.run(command, cwd=folder, capture_output=True).returncode != 0


# what is wrong
# ----------------------------------------------------------------------


def put(folder: Path, name: str, where: tuple[Any, ...], value: Any) -> None:
    zarr.open_group(str(folder), mode="r+")[name][where] = value


def vouch(folder: Path) -> None:
    """Digests of what is there now, so that something else has to find what is wrong with it."""
    path = folder / "manifest.json"
    manifest = Manifest.model_validate_json(path.read_bytes())
    of = lambda key: digest((folder / key).read_bytes())
    digests = {key: of(key) for key in manifest.digests}
    path.write_text(manifest.model_copy(update={"digests": digests}).text())
    for shard in range(manifest.layout.shards):
        content = record({key: of(key) for key in manifest.layout.of(shard)})
        (folder / record_key(shard)).write_bytes(content)


def test_wrong_content_is_found(made, data, tmp_path):
    """By the check, though every digest fits: labels unlike the design, failures without a reason,
    numbers that are not finite, an energy balance that is off, forces without contact."""
    folder = copied(made[0], tmp_path)
    put(folder, "split", (0,), "toast")
    put(folder, "x_disc", (0, 3), np.inf)
    residual, injected = (data[x].values[1] for x in ("energy_residual", "injected_energy"))
    more = 3 * made[1].ledger_tolerance * injected[-1]  # an energy from nowhere, booked faithfully
    put(folder, "stored_energy", (1, 15, 2), data.stored_energy.values[1, 15, 2] + more)
    put(folder, "energy_residual", (1, 15), residual[15] + more)
    residual[15] += more
    put(folder, "energy_residual_rel", (1,), np.abs(residual).max() / injected[-1])
    put(folder, "materials.rubber.E", (2,), 7.5e5)
    put(folder, "energy_residual_rel", (2,), 1e-3)
    put(folder, "normal_force_above", (2, 20, 10), -1.0)
    put(folder, "contact_below", (2, 20), 0)
    put(folder, "failed", (3,), 1)
    put(folder, "stored_energy", (4, 7, 2), 1.0)
    vouch(folder)
    messages = [
        "0: split is toast, but the design has", "0: not finite: x_disc",
        r"1: energy residual is 0\.0[56]\d* of the energy injected, above 0\.02",
        r"2: materials\.rubber\.E is 750000.0, but", "2: energy_residual_rel is 0.001, but the",
        "2: normal_force_below acts where contact_below is 0", "2: normal_force_above pulls",
        "3: failed without a reason", "4: energy_residual is not stored - supplied",
    ]  # fmt: skip
    found = sorted(faults(folder))
    assert len(found) == len(messages), found
    for message in messages:
        assert any(re.search(f"trajectory {message}", one) for one in found), (message, found)


def change(name: str, edit: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def changed(folder):
        content = json.loads((folder / name).read_text())
        edit(content["consolidated_metadata"]["metadata"] if name == "zarr.json" else content)
        (folder / name).write_text(json.dumps(content, indent=2) + "\n")

    return changed


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (change("zarr.json", lambda m: m["theta_disc"]["attributes"].update(units="deg")),
         "theta_disc: units are 'deg', not 'rad'"),
        (change("zarr.json", lambda m: m.pop("theta_disc")), "theta_disc: missing"),
        (change("manifest.json", lambda m: m["config"].update(seed=99)),
         r"config_hash is \w+, but the configuration's"),
        (change("manifest.json", lambda m: m.update(seed=4)),
         "seed is 4, but the configuration's is 3"),
        (change("manifest.json", lambda m: m["config"].update(duration=-1.0)),
         r"manifest\.json: .*duration"),
    ],
)  # fmt: skip
def test_a_manifest_and_metadata_unlike_the_configuration_are_found(
    made, tmp_path, damage, message
):
    damage(folder := copied(made[0], tmp_path))
    vouch(folder)
    (found,) = faults(folder)
    assert re.search(message, found)


# windows
# ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def partial(made, tmp_path_factory):
    """The dataset with a trajectory that failed, a value that is infinite, and a last shard that is
    not finished."""
    folder = copied(made[0], tmp_path_factory.mktemp("partial"))
    put(folder, "failed", (2,), 1)
    put(folder, "motion.y_d.values_2", (0,), np.inf)
    vouch(folder)
    (folder / "finished/2.sha256").unlink()
    return str(folder)


NAMES = ["x_disc", "materials.rubber.E"]


def reading(url: str, *what: Any, **how: Any) -> Trajectories:
    """What is finished."""
    return Trajectories(url, *what, **how, unfinished=True)


def test_windows_hold_what_the_store_holds(partial, made):
    """Of finished trajectories that did not fail; a set that is not finished is rejected unless
    that is allowed."""
    windows, stored = reading(partial, NAMES, window=5, stride=8), xr.open_zarr(partial)
    assert windows.trajectories.tolist() == [0, 1, 3]
    assert open_dataset(partial, unfinished=True).trajectory.values.tolist() == [0, 1, 2, 3]
    assert len(windows) == 3 * 3
    item = windows[4]  # the second window of trajectory 1
    assert (int(item["trajectory"]), int(item["start"])) == (1, 8)
    np.testing.assert_array_equal(item["x_disc"], stored["x_disc"][1, 8:13])
    assert item["materials.rubber.E"] == float(stored["materials.rubber.E"][1])
    assert int(windows[-1]["start"]) == 16  # which ends with the last sample
    with pytest.raises(IndexError):
        windows[9]
    for name in ("train", "validation", "test"):
        own = [i for i in (0, 1, 3) if split(made[1], i) == name]
        assert [*reading(partial, [], split=name).trajectories] == own


def test_windows_in_memory_streamed_and_read_by_workers_are_the_same(partial):
    """From any store; each sweep of a stream has another order, and its workers share shards."""
    fsspec.filesystem("memory").put(partial, "/copy/set", recursive=True)
    how = {"window": 5, "stride": 3, "dtype": torch.float32}
    held, read = (
        reading(partial, NAMES, **how),
        reading("memory://copy/set", NAMES, **how, memory=0.0),
    )
    assert (held.fits, read.fits) == (True, False)
    assert held.size == 3 * 4 * (21 + 1)
    assert len(pickle.dumps(read)) < 2000
    of = lambda one: (int(one["trajectory"]), int(one["start"]))
    wanted = {of(one): one["x_disc"] for one in held}
    held[0]["x_disc"].zero_()
    assert bool(held[0]["x_disc"].any())  # a window is a copy
    stream = read.streamed(shards=1, seed=3)
    for windows, workers in ((read, 0), (read, 2), (stream, 0), (stream, 2)):
        forked = {"multiprocessing_context": "fork", "timeout": 60}
        loader = DataLoader(windows, num_workers=workers, **(forked if workers else {}))
        orders = []
        for _ in range(1 + (windows is stream)):
            sweep = [*loader]
            orders.append([*map(of, sweep)])
            assert sorted(orders[-1]) == sorted(wanted)
            for one in sweep:
                torch.testing.assert_close(one["x_disc"][0], wanted[of(one)], rtol=0, atol=0)
        assert orders[0] != orders[-1] or windows is read


@pytest.mark.parametrize(
    ("names", "how", "message"),
    [
        (["disc_pose"], {}, r"no numbers named 'disc_pose'; known: .*x_disc"),
        ([], {"window": 22}, "`window` must be 1 to 21"),
        ([], {"dtype": torch.int32}, r"`dtype` must be one of torch\.float64, .*, but is "),
        ([], {"split": "dev"}, "`split` must be"),
        (["materials.rubber.E"], {"dtype": torch.float16},
         r"`materials.rubber.E` of trajectory 0 holds [6-9].*, which torch\.float16 cannot"),
    ],
)  # fmt: skip
def test_a_reading_that_cannot_be_is_rejected(partial, names, how, message):
    with pytest.raises(ValueError, match=message):
        reading(partial, names, **how)[0]


def test_values_that_are_not_finite_are_read_as_they_are(partial):
    name = "motion.y_d.values_2"
    assert torch.isinf(reading(partial, [name], dtype=torch.float16)[0][name])
