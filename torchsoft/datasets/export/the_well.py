"""The Well's HDF5: fields on the surface of each pad, along the line of its contact points.

Each pad has a dataset of its own, since all fields of one share their grid. Displacements are two
scalar fields: a vector field of The Well has as many components as its grid has dimensions, here
one.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from torchsoft.datasets.export import Source

NAMES = {"train": "train", "validation": "valid", "test": "test"}

FLOAT = np.float32
"""Precision of all numbers, as in The Well."""


def write(source: Source, out: Path) -> str:
    """Write a folder for each pad, with its splits. Raises `ValueError` for a dataset without
    contact points."""
    if not (surfaces := list(source.config.subject.surfaces)) or not source.config.nodal:
        raise ValueError(
            "The Well is for fields, and this dataset has none (nodal = false); export it to "
            "lerobot or mcap"
        )
    for surface in surfaces:
        grown = Statistics()
        for split, rows in source.splits.items():
            path = out / surface / "data" / NAMES[split] / f"{surface}.hdf5"
            path.parent.mkdir(parents=True)
            with h5py.File(path, "w") as file:
                names = lay_out(file, source, surface, len(rows))
                moved, single = f"displacement_{surface}", (*source.channels, *source.drawn)
                arrays: Any = file
                for i, run in enumerate(source.runs(rows, (*names[:-2], moved, *single))):
                    shift = dict(zip(names[-2:], np.moveaxis(run[moved].values, -1, 0)))
                    for name in names:
                        values = shift[name] if name in shift else run[name].values
                        arrays["t0_fields"][name][i] = values
                        if split == "train":
                            grown.add(name, values)
                    for name in single:
                        arrays["scalars"][name][i] = run[name].values
        if grown.of:
            (out / surface / "stats.yaml").write_text(grown.yaml(), encoding="utf-8")
    lacking = [name for name in NAMES if name not in source.splits]
    return f"{len(source.sound)} trajectories on the surfaces {', '.join(surfaces)}" + (
        f" (none in {', '.join(lacking)})" if lacking else ""
    )


def lay_out(file: h5py.File, source: Source, surface: str, count: int) -> list[str]:
    """Create groups and attributes of a file of `count` trajectories; returns the names of its
    fields, the displacements last."""
    config, data, point = source.config, source.data, f"{surface}_point"
    names = [str(name) for name in data if data[name].dims == ("trajectory", "time", point)]
    names += ["displacement_x", "displacement_y"]
    file.attrs.update(
        dataset_name=surface, grid_type="cartesian", n_spatial_dims=1, n_trajectories=count,
        simulation_parameters=source.drawn, title=config.title,
    )  # fmt: skip
    groups = {
        name: file.create_group(name)
        for name in (
            "boundary_conditions",
            "dimensions",
            "scalars",
            "t0_fields",
            "t1_fields",
            "t2_fields",
        )
    }
    grid, steady = data[point].values, {"sample_varying": False, "time_varying": False}
    groups["dimensions"].attrs["spatial_dims"] = ["s"]
    for name, values in (("time", data.time.values), ("s", grid)):
        groups["dimensions"].create_dataset(name, data=values.astype(FLOAT)).attrs.update(steady)
    ends = groups["boundary_conditions"].create_group("ends")
    ends.attrs.update(steady, associated_dims=["s"], associated_fields=[], bc_type="OPEN")
    mask = np.zeros(len(grid), bool)
    mask[[0, -1]] = True
    ends.create_dataset("mask", data=mask)

    def add(group: str, some: list[str], shape: tuple[int, ...], **varying: object) -> None:
        groups[group].attrs["field_names"] = [*groups[group].attrs.get("field_names", []), *some]
        for name in some:
            one = groups[group].create_dataset(name, (count, *shape), FLOAT)
            one.attrs.update(sample_varying=True, **varying)
            of = data[f"displacement_{surface}"] if name.startswith("displacement_") else data[name]
            one.attrs.update(units=of.attrs["units"], long_name=of.attrs["long_name"])

    times = data.sizes["time"]
    add("scalars", source.channels, (times,), time_varying=True)
    add("scalars", source.drawn, (), time_varying=False)
    add("t0_fields", names, (times, len(grid)), time_varying=True, dim_varying=[True])
    for group in ("t1_fields", "t2_fields"):
        groups[group].attrs["field_names"] = np.array([], h5py.string_dtype())
    return names


class Statistics:
    """Mean, standard deviation and root mean square of fields, and of their changes between
    samples."""

    def __init__(self) -> None:
        self.of: dict[str, NDArray] = {}

    def add(self, name: str, values: NDArray) -> None:
        """Add one more trajectory (times, points)."""
        values = values.astype(float)
        sums = [(x.size, x.sum(), (x * x).sum()) for x in (values, np.diff(values, axis=0))]
        self.of[name] = self.of.get(name, 0.0) + np.array(sums)

    def yaml(self) -> str:
        """Content of the file that The Well's normalisations read."""
        out = dict[str, dict[str, float]]()
        for name, sums in self.of.items():
            for (n, total, squares), suffix in zip(sums, ("", "_delta")):
                mean, square = total / max(n, 1), squares / max(n, 1)
                found = {"mean": mean, "std": max(square - mean**2, 0.0) ** 0.5, "rms": square**0.5}
                for key, value in found.items():
                    out.setdefault(key + suffix, {})[name] = value
        lines = (
            [f"{key}:", *(f"  {name}: {x:.9e}" for name, x in some.items())]
            for key, some in out.items()
        )
        return "\n".join(line for some in lines for line in some) + "\n"
