"""Re-read a dataset and list what is wrong with it: `python -m data_gen.check DIR`.

One line a finding; exit status 1 if there is any. `--picture FILE` draws what the set covers.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from torchsoft.datasets.config import Config
from torchsoft.datasets.coverage import figure
from torchsoft.datasets.design import SPLITS, points, task
from torchsoft.datasets.manifest import COPY, MANIFEST, Manifest, digest, finished, record_key
from torchsoft.datasets.reader import open_dataset, opened
from torchsoft.datasets.schema import not_finite, sizes, variables
from torchsoft.datasets.simulation import labels
from torchsoft.datasets.storage import StoreError, filesystem, keys, read_bytes
from torchsoft.datasets.vouched import Vouched
from torchsoft.files import PARTIAL
from torchsoft.plot.figures import save
from torchsoft.tables import line


def check(url: str) -> Iterator[str]:
    """Every finding, as a sentence. Raises nothing."""
    try:
        yield from findings(url)
    except StoreError as error:
        yield str(error)
    except Exception as error:  # whatever a damaged file makes a library raise is a finding
        yield line(f"{url} cannot be checked: {type(error).__name__}: {error}")


def findings(url: str) -> Iterator[str]:
    """Every finding; raises what keeps it from going on."""
    manifest = Manifest.read(url)
    try:
        config = Config.model_validate_json(json.dumps(manifest.config))
    except ValueError as error:
        yield f"{MANIFEST}: its configuration is impossible: {error}"
        return
    if not manifest.commit:
        yield f"{MANIFEST}: no commit; the dataset was made outside a repository"
    if manifest.config_hash != config.hash:
        yield f"{MANIFEST}: config_hash is {manifest.config_hash}, but the configuration's is {config.hash}"
        return  # nothing else can be held against a configuration that was changed
    if manifest.seed != config.seed:
        yield f"{MANIFEST}: seed is {manifest.seed}, but the configuration's is {config.seed}"
    damaged = list(check_files(url, manifest))
    yield from damaged
    if damaged:
        return
    store = Vouched(url, manifest, finished(url, manifest.layout))
    structure = list(check_arrays(opened(store), config))
    yield from structure
    if structure:
        return
    if unfinished := sorted(set(range(config.shards)) - store.finished):
        yield f"{len(unfinished)} of {config.shards} shards are not finished, the first is shard {unfinished[0]}"
    design = points(config)
    for shard in sorted(store.finished):
        yield from check_shard(store, config, shard, design)


def check_files(url: str, manifest: Manifest) -> Iterator[str]:
    """Files laid out at the start that are missing or damaged, and files that do not belong there."""
    layout, there = manifest.layout, keys(url)
    for key, expected in manifest.digests.items():
        data = read_bytes(url, key)
        if data is None or digest(data) != expected:
            yield f"{url}/{key} is {'missing' if data is None else 'damaged'}; {COPY}"
    known = {MANIFEST, *manifest.digests, *(record_key(shard) for shard in range(layout.shards))}
    running = len(finished(url, layout)) < layout.shards
    for key in there:
        if key not in known and layout.shard(key) is None and not (running and PARTIAL.search(key)):
            yield f"{url}/{key} does not belong to the dataset; remove it"


def check_arrays(group: zarr.Group, config: Config) -> Iterator[str]:
    """Arrays, their shapes, dimensions and units."""
    length = sizes(config)
    for name, variable in variables(config).items():
        array = group.get(name)
        if not isinstance(array, zarr.Array):
            yield f"{name}: missing"
            continue
        dims = getattr(array.metadata, "dimension_names", None)
        shape = tuple(length[dim] for dim in variable.dims)
        if array.shape != shape or tuple(dims or ()) != variable.dims:
            yield f"{name}: has shape {array.shape} over {dims}, not {shape} over {variable.dims}"
        if array.attrs.get("units") != variable.unit:
            yield f"{name}: units are {array.attrs.get('units')!r}, not {variable.unit!r}"
        if (array.shards or array.chunks)[0] != config.trajectories_per_shard:
            yield f"{name}: its shards hold {(array.shards or array.chunks)[0]} trajectories, not one task's"


def check_shard(store: Vouched, config: Config, shard: int, design: np.ndarray[Any, Any]) -> Iterator[str]:
    """Everything about the trajectories of one finished shard."""
    schema, group, data = variables(config), opened(store), dict[str, Any]()
    size = config.trajectories_per_shard
    here = range(shard * size, min((shard + 1) * size, config.trajectories))
    for name in schema:
        try:
            array = group[name]
            assert isinstance(array, zarr.Array)
            data[name] = np.asarray(array[here.start : here.stop])
        except StoreError as error:
            yield str(error)
            if record_key(shard) in str(error).partition(";")[0]:
                return  # nothing vouches for the others either
    if len(data) < len(schema):
        return
    for row, index in enumerate(here):
        one = {name: values[row] for name, values in data.items()}
        finding = f"trajectory {index}: ".__add__
        for name, value in labels(task(config, index, design[index])).items():
            if one[name] != value:
                yield finding(f"{name} is {one[name]}, but the design has {value}")
        if one["failed"]:
            series = [name for name, v in schema.items() if v.dtype.startswith("float") and len(v.dims) > 1]
            filled = [name for name in series if not np.isnan(one[name]).all()]
            if not one["reason"]:
                yield finding("failed without a reason")
            elif filled:
                yield finding(f"failed, but {', '.join(filled)} hold numbers")
        elif bad := not_finite(config, one):
            yield finding(f"not finite: {', '.join(bad)}")
        else:
            yield from map(finding, check_physics(config, one))


def check_physics(config: Config, one: dict[str, Any]) -> Iterator[str]:
    """The energy balance, and contact where there is force."""
    stored, dissipated, supplied = (one[f"{x}_energy"].sum(-1) for x in ("stored", "dissipated", "supplied"))
    residual = stored - stored[0] - supplied + dissipated
    scale = max(np.abs(stored).max(), one["injected_energy"][-1])
    if np.abs(residual - one["energy_residual"]).max() > 1e-9 * scale:
        yield "energy_residual is not stored - supplied + dissipated"
        return
    relative = np.abs(residual).max() / one["injected_energy"][-1]
    if abs(relative - one["energy_residual_rel"]) > 1e-9:
        yield f"energy_residual_rel is {one['energy_residual_rel']:.3g}, but the series have {relative:.3g}"
    if relative > config.ledger_tolerance:
        yield f"energy residual is {relative:.2g} of the energy injected, above {config.ledger_tolerance}"
    for pad in ("lower", "upper"):
        if (one[f"normal_force_{pad}"] < 0).any():
            yield f"normal_force_{pad} pulls"
        if ((one[f"normal_force_{pad}"] > 0) & (one[f"contact_{pad}"] == 0)).any():
            yield f"normal_force_{pad} acts where contact_{pad} is 0"


def summary(url: str) -> str:
    """Sizes and counts."""
    data, (fs, root) = open_dataset(url, unfinished=True), filesystem(url)
    files = fs.find(root, detail=True)
    stored, failed = sum(info["size"] for info in files.values()), int(data.failed.sum())
    counts = ", ".join(f"{int((data.split == name).sum())} {name}" for name in SPLITS)
    return (
        f"{data.sizes['trajectory']} trajectories ({counts}; {failed} failed) of {data.sizes['time']} samples, "
        f"{data.nbytes / 1e6:.1f} MB of arrays in {stored / 1e6:.1f} MB and {len(files)} files"
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m data_gen.check", description=__doc__)
    parser.add_argument("store", help="folder or fsspec URL")
    parser.add_argument("--picture", type=Path, help="where to write a picture of what the set covers")
    given = parser.parse_args(arguments)
    count = 0
    for count, finding in enumerate(check(given.store), 1):
        print(finding)
    try:
        print(summary(given.store))
        config = Config.model_validate_json(json.dumps(Manifest.read(given.store).config))
        if given.picture is not None:
            save(figure(open_dataset(given.store, unfinished=True), config), given.picture, dpi=120)
            print(f"picture in {given.picture}")
    except Exception as error:  # a damaged store has been reported above; the picture must not hide it
        count += 1
        print(line(f"no summary or picture: {type(error).__name__}: {error}"))
    print("sound" if count == 0 else f"{count} findings")
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
