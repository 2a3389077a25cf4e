"""LeRobot's dataset v3, with a trajectory as an episode and a sample as a frame.

Set-points are the action, or efforts of the actuators where no set-point is kept. Other channels
are the state, and forces at the contact points observations of their own. Drawn parameters are
columns of the episodes.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from torchsoft.datasets.export import Source
from torchsoft.extras import needed
from torchsoft.files import write_json

VERSION = "v3.0"
CHUNK, SIZE = 1000, 100
"""Most files in a folder, and largest size of a file [MB]."""

PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
SEEN = "observation."
EFFORTS = "effort_", "F_"
"""Prefixes of the channels of efforts, of now and of version 0.2."""
INDICES = ("frame_index", "episode_index", "index", "task_index")


def write(source: Source, out: Path) -> str:
    """Write data, episodes, tasks and statistics. Raises `ValueError` for a sample rate that is not
    a whole number."""
    arrow, parquet = needed("pyarrow", "export"), needed("pyarrow.parquet", "export")
    rate = 1.0 / source.config.sample_interval
    if abs(rate - round(rate)) > 1e-6 * rate:
        raise ValueError(
            f"LeRobot takes a whole number of samples a second, but sample_interval = "
            f"{source.config.sample_interval:g} s makes {rate:g}"
        )
    features = dict(of_frames(source))
    named = {key: one["names"] for key, one in features.items() if one["names"]}
    length, episodes, known = source.data.sizes["time"], list[dict[str, Any]](), list[str]()
    frame = sum(4 * one["shape"][0] for one in features.values())
    per_file = max(1, int(SIZE * 1e6 / (length * frame)))
    forces = [key.removeprefix(SEEN) for key, one in features.items() if one["names"] is None]
    kept = [name for name in (*source.channels, *source.drawn, *forces, "kind")
            if name in source.data]  # fmt: skip
    order = [index for some in source.splits.values() for index in some]
    sink: Any = None
    for i, run in enumerate(source.runs(order, kept)):
        task = str(run["kind"].item()) if "kind" in run else source.config.title
        if task not in known:
            known.append(task)
        chunk, file = divmod(i // per_file, CHUNK)
        columns = values(run, named, features) | {
            "timestamp": run.time.values.astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, i),
            "index": i * length + np.arange(length),
            "task_index": np.full(length, known.index(task)),
        }
        table = arrow.table({key: column(arrow, one) for key, one in columns.items()})
        if i % per_file == 0:
            if sink is not None:
                sink.close()
            path = out / "data" / PLACE.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            sink = parquet.ParquetWriter(path, table.schema)
        sink.write_table(table)
        episodes.append(
            {"episode_index": i, "tasks": [task], "length": length, "trajectory": order[i]}
            | {name: run[name].item() for name in source.drawn}
            | {"dataset_from_index": i * length, "dataset_to_index": (i + 1) * length}
            | {"data/chunk_index": chunk, "data/file_index": file}
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            | {f"stats/{key}/{statistic}": x for key, one in columns.items()
               for statistic, x in statistics(one).items()}
        )  # fmt: skip
    sink.close()
    path = out / "meta" / "episodes" / PLACE.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    parquet.write_table(arrow.Table.from_pylist(episodes), path)
    tasks = pd.DataFrame({"task_index": range(len(known))}, index=known)
    tasks.to_parquet(out / "meta" / "tasks.parquet")
    ends = np.cumsum([0, *(len(some) for some in source.splits.values())]).tolist()
    info = {
        "codebase_version": VERSION, "robot_type": None, "total_episodes": len(order),
        "total_frames": len(order) * length, "total_tasks": len(known), "chunks_size": CHUNK,
        "data_files_size_in_mb": SIZE, "video_files_size_in_mb": SIZE, "fps": round(rate),
        "splits": {name: f"{a}:{b}" for name, a, b in zip(source.splits, ends, ends[1:])},
        "data_path": f"data/{PLACE}", "video_path": None, "features": features,
    }  # fmt: skip
    write_json(out / "meta" / "info.json", info)
    write_json(out / "meta" / "stats.json", together(episodes, features))
    return f"{len(order)} episodes, whose actions are {', '.join(named['action'])}"


def of_frames(source: Source) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every feature by its name. Raises `ValueError` where no channel can be an action."""
    action = source.motions or [name for name in source.channels if name.startswith(EFFORTS)]
    state = [name for name in source.channels if name not in action]
    if not action or not state:
        raise ValueError(
            "LeRobot needs actions and a state: keep motions or efforts (effort_*), and "
            "coordinates, in `channels`"
        )
    for key, names in (("action", action), (f"{SEEN}state", state)):
        yield key, {"dtype": "float32", "shape": [len(names)], "names": names}
    for name, one in source.data.data_vars.items():
        if str(name).partition("_force_")[0] in ("normal", "friction") and one.ndim == 3:
            shape = [one.shape[-1]]
            yield f"{SEEN}{name}", {"dtype": "float32", "shape": shape, "names": None}
    yield "timestamp", {"dtype": "float32", "shape": [1], "names": None}
    for name in INDICES:
        yield name, {"dtype": "int64", "shape": [1], "names": None}


def values(
    run: xr.Dataset, named: dict[str, list[str]], features: dict[str, Any]
) -> dict[str, NDArray]:
    """Vectors (samples, n) of the features of a trajectory."""
    out = dict[str, NDArray]()
    for key in features:
        if key in named:
            out[key] = np.stack([run[name].values for name in named[key]], -1).astype(np.float32)
        elif key.startswith(SEEN):
            out[key] = run[key.removeprefix(SEEN)].values.astype(np.float32)
    return out


def column(arrow: Any, values: NDArray) -> Any:
    """A column of vectors; of numbers for vectors of length one, as LeRobot requires."""
    if values.size == len(values):
        return arrow.array(values.ravel())
    return arrow.FixedSizeListArray.from_arrays(arrow.array(values.ravel()), values.shape[1])


def statistics(values: NDArray) -> dict[str, Any]:
    """LeRobot's statistics of one feature in one episode."""
    x = values.reshape(len(values), -1).astype(float)
    found = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
    return {key: one.tolist() for key, one in found.items()} | {"count": [len(x)]}


def together(episodes: list[dict[str, Any]], features: dict[str, Any]) -> dict[str, Any]:
    """LeRobot's statistics over all episodes, which are of equal length."""
    out = dict[str, Any]()
    for key in features:
        of = {
            statistic: np.array([one[f"stats/{key}/{statistic}"] for one in episodes])
            for statistic in ("min", "max", "mean", "std", "count")
        }
        mean = of["mean"].mean(0)
        spread = np.sqrt((of["std"] ** 2 + (of["mean"] - mean) ** 2).mean(0))
        found = {"min": of["min"].min(0), "max": of["max"].max(0), "mean": mean, "std": spread}
        out[key] = {statistic: one.tolist() for statistic, one in found.items()}
        out[key]["count"] = of["count"].sum(0).tolist()
    return out
