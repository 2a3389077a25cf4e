"""Re-read a dataset and list what is wrong with it: `python -m data_gen.check DIR`.

One line a finding; exit status 1 if there is any. Writes `coverage.png`, what the set covers.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from pydantic import ValidationError

from torchsoft.datasets.config import Config
from torchsoft.datasets.coverage import figure
from torchsoft.datasets.design import SPLITS, points, task
from torchsoft.datasets.reader import local_path, open_dataset
from torchsoft.datasets.schema import sizes, variables
from torchsoft.datasets.simulation import labels
from torchsoft.datasets.store import MANIFEST, Store, filesystem, read_text
from torchsoft.files import findings


def check(url: str) -> Iterator[str]:
    """Every finding, as a sentence."""
    try:
        config, manifest = read_manifest(url)
    except (ValueError, OSError) as error:
        yield f"{MANIFEST}: {error}"
        return
    for key in ("torchsoft", "seed", "config_hash", "config", "parameters", "layout"):
        if key not in manifest:
            yield f"{MANIFEST}: `{key}` is missing"
    if not manifest.get("commit"):
        yield f"{MANIFEST}: no commit; the dataset was made outside a repository"
    if manifest.get("config_hash") != config.hash:
        yield f"{MANIFEST}: config_hash is {manifest.get('config_hash')}, but the configuration's is {config.hash}"
        return  # nothing else can be held against a configuration that was changed
    if manifest.get("seed") != config.seed:
        yield f"{MANIFEST}: seed is {manifest.get('seed')}, but the configuration's is {config.seed}"
    try:
        store = Store(url, config)
    except (OSError, ValueError) as error:
        yield f"the store cannot be opened: {error}"
        return
    made_of = store.group.attrs.get("config_hash")
    if made_of != config.hash:
        yield f"{MANIFEST}: describes the configuration {config.hash}, but the arrays were made of {made_of}"
        return
    structure = list(check_structure(store))
    yield from structure
    if structure:
        return
    unfinished = store.unfinished()
    if unfinished:
        yield f"{len(unfinished)} of {config.shards} shards are not finished, the first is shard {unfinished[0]}"
    design = points(config)
    for shard in sorted(set(range(config.shards)) - set(unfinished)):
        try:
            yield from check_shard(store, shard, design)
        except Exception as error:  # whatever a damaged file makes the decoder raise is a finding
            yield f"shard {shard} cannot be read: {type(error).__name__}: {error}"


def read_manifest(url: str) -> tuple[Config, dict[str, Any]]:
    """The configuration that the manifest describes. Raises `ValueError`."""
    text = read_text(url, MANIFEST)
    if text is None:
        raise ValueError("missing")
    manifest = json.loads(text)
    try:
        return Config.model_validate(manifest.get("config")), manifest
    except ValidationError as error:
        raise ValueError(f"its configuration is impossible: {findings(error)}") from error


def check_structure(store: Store) -> Iterator[str]:
    """Arrays, their shapes, dimensions and units: in each array's own metadata, and in the copy that readers open."""
    found: dict[str, None] = {}
    for consolidated in (False, True):
        try:
            group = zarr.open_group(local_path(store.url), mode="r", use_consolidated=consolidated)
        except (OSError, ValueError) as error:
            found[f"the consolidated metadata cannot be read: {error}"] = None
            continue
        found |= dict.fromkeys(check_arrays(group, store.config))
    yield from found


def check_arrays(group: zarr.Group, config: Config) -> Iterator[str]:
    """Findings in one copy of the metadata."""
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


def check_shard(store: Store, shard: int, design: np.ndarray[Any, Any]) -> Iterator[str]:
    """Everything about the trajectories of one finished shard."""
    config, here, schema = store.config, store.rows(shard), variables(store.config)
    data = {name: np.asarray(store.array(name)[here.start : here.stop]) for name in schema}
    for row, index in enumerate(here):
        one = {name: values[row] for name, values in data.items()}
        finding = f"trajectory {index}: ".__add__
        for name, value in labels(task(config, index, design[index])).items():
            if one[name] != value:
                yield finding(f"{name} is {one[name]}, but the design has {value}")
        floats = [name for name, v in schema.items() if v.dtype.startswith("float") and len(v.dims) > 1]
        if one["failed"]:
            filled = [name for name in floats if not np.isnan(one[name]).all()]
            if not one["reason"]:
                yield finding("failed without a reason")
            elif filled:
                yield finding(f"failed, but {', '.join(filled)} hold numbers")
            continue
        bad = [name for name in (*floats, "grasp_force", "energy_residual_rel") if not np.isfinite(one[name]).all()]
        if bad:
            yield finding(f"not finite: {', '.join(bad)}")
            continue
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
    data, (fs, root) = open_dataset(url), filesystem(url)
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
    parser.add_argument("--picture", type=Path, default=Path("coverage.png"), help="where to write the picture")
    given = parser.parse_args(arguments)
    count = 0
    for count, finding in enumerate(check(given.store), 1):
        print(finding)
    try:
        print(summary(given.store))
        figure(open_dataset(given.store), read_manifest(given.store)[0]).savefig(given.picture, dpi=120)
        print(f"picture in {given.picture}")
    except Exception as error:  # a damaged store has been reported above; the picture must not hide it
        count += 1
        print(f"no summary or picture: {type(error).__name__}: {error}")
    print("sound" if count == 0 else f"{count} findings")
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
