"""Quadrilaterals from mesh files."""

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from torchsoft.files import check_file
from torchsoft.physics.arguments import LENGTHS
from torchsoft.physics.mesh.element import Array
from torchsoft.physics.mesh.mesh import Index

IGNORED = {"line", "vertex"}
"""Kinds of cells beside the quadrilaterals."""

FLAT = 1e-9
"""How far the points may be from one plane, over the size of the mesh."""


LARGEST = 2e9
"""Size [B] of a mesh file at the most."""


def read_quads(path: str | Path, unit: str) -> tuple[Array, Index, dict[str, Index]]:
    """Points (n, 2) [m], quadrilaterals (m, 4) and, by their names, groups of lines (., 2) of a file that meshio reads.

    Raises `ValueError` naming the file for one that it cannot read, another unit, cells of another kind, and points that are
    not in a plane of constant z, and `OSError`.
    """
    import meshio  # takes half a second, and few need it

    if unit not in LENGTHS:
        raise ValueError(f"`unit` must be one of {', '.join(LENGTHS)}, but is {unit!r}")
    with check_file(path, LARGEST).open("rb"):  # what is not there, or not to be read, is an OSError
        pass
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):  # it prints, and exits
            mesh: Any = meshio.read(path)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{path} is not a mesh that can be read: {error or 'its format is not known'}") from None
    kinds = {block.type for block in mesh.cells} - IGNORED
    if kinds != {"quad"}:
        raise ValueError(
            f"{path} must be a mesh of quadrilaterals with four points, but has {', '.join(sorted(kinds)) or 'none'}; in gmsh "
            "recombine the triangles"
        )
    x = np.asarray(mesh.points, np.float64)
    if not np.isfinite(x).all() or (x.shape[1] > 2 and np.ptp(x[:, 2]) > FLAT * np.ptp(x[:, :2])):
        raise ValueError(f"{path} must have finite points in a plane of constant z")
    quads = np.concatenate([block.data for block in mesh.cells if block.type == "quad"])
    return LENGTHS[unit] * x[:, :2], quads, groups_of_lines(mesh)


def groups_of_lines(mesh: Any) -> dict[str, Index]:
    """Sides (., 2) by the names of their groups: meshio's cell sets, and gmsh's physical curves of older files."""
    groups: dict[str, list[Index]] = {}
    tags = mesh.cell_data.get("gmsh:physical", [None] * len(mesh.cells))
    curves = {name: tag for name, (tag, dimension) in mesh.field_data.items() if dimension == 1}
    for k, block in enumerate(mesh.cells):
        if block.type != "line":
            continue
        for name, chosen in mesh.cell_sets.items():
            if chosen[k] is not None and len(chosen[k]):
                groups.setdefault(name, []).append(block.data[chosen[k]])
        for name, tag in curves.items():
            if tags[k] is not None and name not in mesh.cell_sets and (tags[k] == tag).any():
                groups.setdefault(name, []).append(block.data[tags[k] == tag])
    groups.pop("gmsh:bounding_entities", None)
    return {name: np.concatenate(sides) for name, sides in groups.items()}
