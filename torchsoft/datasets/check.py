"""Validation of a dataset: read it again, and list its defects."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import xarray as xr

from torchsoft.datasets.card import by_split
from torchsoft.datasets.config import Config
from torchsoft.datasets.files import (
    CARD,
    MANIFEST,
    Manifest,
    StoreError,
    filesystem,
    keys,
    listed,
    record_key,
)
from torchsoft.datasets.generate import points
from torchsoft.datasets.reader import Vouched, open_dataset
from torchsoft.files import PARTIAL
from torchsoft.tables import line

MANY = 0.5
"""Share of trajectories that failed from which a set is called wrong."""


def check(url: str) -> Iterator[str]:
    """Every finding, as a sentence. Raises nothing."""
    try:
        yield from findings(url)
    except StoreError as error:
        yield str(error)
    except Exception as error:  # whatever a damaged file makes a library raise is a finding
        yield line(f"{url} cannot be checked: {type(error).__name__}: {error}")


def findings(url: str) -> Iterator[str]:
    """Every finding, as a sentence. Raises the error that ends the check."""
    manifest = Manifest.read(url)
    try:
        config = Config.model_validate(manifest.config)
    except ValueError as error:
        yield f"{MANIFEST}: its configuration is impossible: {error}"
        return
    if manifest.config_hash != config.hash:
        yield (
            f"{MANIFEST}: config_hash is {manifest.config_hash}, but the configuration's is "
            f"{config.hash}"
        )
        return  # nothing else can be held against a configuration that was changed
    if manifest.seed != config.seed:
        yield f"{MANIFEST}: seed is {manifest.seed}, but the configuration's is {config.seed}"
    if damaged := list(check_files(url, manifest)):
        yield from damaged
        return
    store = Vouched(url, unfinished=True)
    data = store.data(chunks=None)
    if wrong := list(check_arrays(data, config)):
        yield from wrong
        return
    if unfinished := sorted(set(range(config.shards)) - store.finished):
        yield (
            f"{len(unfinished)} of {config.shards} shards are not finished: {listed(unfinished)}"
        )
    design = points(config)
    for shard in sorted(store.finished):
        yield from check_shard(data, config, shard, design)
    finished = [i for shard in sorted(store.finished) for i in config.rows(shard)]
    share, sentence = failures(data.isel(trajectory=finished))
    if share > MANY:
        yield sentence


def failures(data: xr.Dataset) -> tuple[float, str]:
    """Share of finished trajectories that failed, and a sentence with the commonest reason."""
    failed = data.failed.values.astype(bool)
    if not failed.any():
        return 0.0, "none failed"
    reason, _ = Counter(data.reason.values[failed].tolist()).most_common(1)[0]
    message = (
        f"{failed.sum()} of {len(failed)} trajectories failed, most often: {line(reason, 200)}"
    )
    return float(failed.mean()), message


def check_files(url: str, manifest: Manifest) -> Iterator[str]:
    """Files that are missing, damaged or foreign to the dataset."""
    layout, there = manifest.layout, keys(url)
    for key in manifest.digests:
        try:
            manifest.laid_out(url, key)
        except StoreError as error:
            yield str(error)
    running = len(layout.finished(url)) < layout.shards
    for key in there:
        known = key in (MANIFEST, CARD, *manifest.digests) or layout.shard(key) is not None
        if not known and not (running and PARTIAL.search(key)):
            yield f"{url}/{key} does not belong to the dataset; remove it"


def check_arrays(data: xr.Dataset, config: Config) -> Iterator[str]:
    """Arrays that are missing, or whose dimensions, unit or shard size differ from the schema."""
    for name, variable in config.subject.variables.items():
        if name not in data:
            yield f"{name}: missing"
            continue
        array, size = data[name], config.trajectories_per_shard
        for aspect, found, expected in (
            ("sizes", dict(array.sizes), variable.sizes),
            ("units", array.attrs.get("units"), variable.unit),
            (
                "trajectories of a shard",
                (array.encoding["shards"] or array.encoding["chunks"])[0],
                size,
            ),
        ):
            if found != expected:
                yield f"{name}: {aspect} are {found!r}, not {expected!r}"


def check_shard(
    data: xr.Dataset, config: Config, shard: int, design: np.ndarray[Any, Any]
) -> Iterator[str]:
    """Findings on the trajectories of one finished shard."""
    schema, columns, here = config.subject.variables, dict[str, Any](), config.rows(shard)
    for name in schema:
        try:
            columns[name] = data[name][here.start : here.stop].values
        except StoreError as error:
            yield str(error)
            if record_key(shard) in str(error).partition(";")[0]:
                return  # nothing vouches for the others either
    for row, index in enumerate(here if len(columns) == len(schema) else []):
        one = {name: values[row] for name, values in columns.items()}
        labels = config.subject.task(index, design[index]).labels
        for finding in check_trajectory(config, one, labels):
            yield f"trajectory {index}: {finding}"


def check_trajectory(config: Config, one: dict[str, Any], labels: dict[str, Any]) -> Iterator[str]:
    """Findings on one trajectory: labels unlike the design, numbers that are not finite, a failure
    without a reason, and physics."""
    for name, value in labels.items():
        if one[name] != value:
            yield f"{name} is {one[name]}, but the design has {value}"
    if one["failed"]:
        series = [
            name
            for name, v in config.subject.variables.items()
            if v.kept.kind == "f" and len(v.shape) > 1
        ]
        if not one["reason"]:
            yield "failed without a reason"
        elif filled := [name for name in series if not np.isnan(one[name]).all()]:
            yield f"failed, but {', '.join(filled)} hold numbers"
    elif bad := config.subject.not_finite(one):
        yield f"not finite: {', '.join(bad)}"
    else:
        yield from check_physics(config, one)


def check_physics(config: Config, one: dict[str, Any]) -> Iterator[str]:
    """Findings on the energy balance, and on contact forces without contact."""
    stored, dissipated, supplied = (
        one[f"{x}_energy"].sum(-1) for x in ("stored", "dissipated", "supplied")
    )
    residual, injected = stored - stored[0] - supplied + dissipated, one["injected_energy"][-1]
    if np.abs(residual - one["energy_residual"]).max() > 1e-9 * max(np.abs(stored).max(), injected):
        yield "energy_residual is not stored - supplied + dissipated"
        return
    relative, booked = np.abs(residual).max() / injected, one["energy_residual_rel"]
    if abs(relative - booked) > 1e-9:
        yield f"energy_residual_rel is {booked:.3g}, but the series have {relative:.3g}"
    if relative > config.ledger_tolerance:
        yield (
            f"energy residual is {relative:.2g} of the energy injected, above "
            f"{config.ledger_tolerance}"
        )
    for name in (name for name in one if name.startswith("normal_force_")):
        force, contact = one[name], f"contact_{name.removeprefix('normal_force_')}"
        if (force < 0).any():
            yield f"{name} pulls"
        if ((force > 0) & (one[contact] == 0)).any():
            yield f"{name} acts where {contact} is 0"


def summary(url: str, data: xr.Dataset) -> str:
    """Sizes and counts."""
    fs, root = filesystem(url)
    stored = [info["size"] for info in fs.find(root, detail=True).values()]
    return (
        f"{data.sizes['trajectory']} trajectories ({by_split(data)}; {int(data.failed.sum())} "
        f"failed) of {data.sizes['time']} samples, {data.nbytes / 1e6:.1f} MB of arrays in "
        f"{sum(stored) / 1e6:.1f} MB and {len(stored)} files"
    )


def report(url: str, say: Callable[[str], None] = print) -> int:
    """Say every finding, sizes and counts; how many findings there are."""
    found = list[str]()
    for finding in check(url):
        say(finding)
        found.append(finding)
    try:
        say(summary(url, open_dataset(url, unfinished=True)))
    except Exception as error:  # a damaged store has been reported above
        if str(error) not in found:
            found.append(line(f"no summary: {type(error).__name__}: {error}"))
            say(found[-1])
    say(f"{len(found)} finding{'s' * (len(found) > 1)}" if found else "sound")
    return len(found)
