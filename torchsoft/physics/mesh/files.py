"""Meshes of quadrilaterals in files: gmsh, Abaqus and CalculiX decks, VTK and all else that meshio
reads."""

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from torchsoft.files import check_file
from torchsoft.physics.arguments import LENGTHS
from torchsoft.physics.mesh.mesh import Array, Index, boundary

IGNORED = {"line", "vertex"}
"""Kinds of cells beside the quadrilaterals."""

FLAT = 1e-9
"""Largest distance of the points from one plane, over the size of the mesh."""

LARGEST = 2e9
"""Size [B] of a mesh file at the most."""

PLANE_STRAIN = {"CPE3": "triangle", **dict.fromkeys(
    ("CPE4", "CPE4H", "CPE4R", "CPE4RH", "CPE4I", "CPE4IH"), "quad")}  # fmt: skip
"""Abaqus' and CalculiX' plane-strain elements, which meshio does not know: the nodes of each."""


def read_quads(path: str | Path, unit: str) -> tuple[Array, Index, dict[str, Index]]:
    """Points (n, 2) [m], quadrilaterals (m, 4) and, by their names, edges as sides (., 2) of a file
    that meshio reads.

    Raises `ValueError` naming the file for one that it cannot read, another unit, cells of another
    kind, and points that are not in a plane of constant z, and `OSError`.
    """
    import meshio  # takes half a second, and few need it
    from meshio.abaqus._abaqus import abaqus_to_meshio_type

    abaqus_to_meshio_type.update(PLANE_STRAIN)
    if unit not in LENGTHS:
        raise ValueError(f"`unit` must be one of {', '.join(LENGTHS)}, but is {unit!r}")
    with check_file(path, LARGEST).open("rb"):  # a missing or unreadable file is an OSError
        pass
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            mesh: Any = meshio.read(path)  # it prints its reasons, and exits
    except (Exception, SystemExit) as error:
        said = " ".join(printed.getvalue().split()) or f"{error}"
        raise ValueError(
            f"{path} is not a mesh that can be read: {said or 'its format is not known'}"
        ) from None
    kinds = {block.type for block in mesh.cells} - IGNORED
    if kinds != {"quad"}:
        raise ValueError(
            f"{path} must be a mesh of quadrilaterals with four points, but has "
            f"{', '.join(sorted(kinds)) or 'none'}; in gmsh recombine the triangles"
        )
    x = np.asarray(mesh.points, np.float64)
    if not np.isfinite(x).all() or (x.shape[1] > 2 and np.ptp(x[:, 2]) > FLAT * np.ptp(x[:, :2])):
        raise ValueError(f"{path} must have finite points in a plane of constant z")
    quads = np.concatenate([block.data for block in mesh.cells if block.type == "quad"])
    return LENGTHS[unit] * x[:, :2], quads, sets_of_nodes(mesh, quads) | groups_of_lines(mesh)


def groups_of_lines(mesh: Any) -> dict[str, Index]:
    """Sides (., 2) by the names of their groups: meshio's cell sets, gmsh's physical curves, named
    or "physical 3", and its curves of geometry, "curve 3"."""
    groups: dict[str, list[Index]] = {}
    named = {tag: name for name, (tag, dimension) in mesh.field_data.items() if dimension == 1}
    for k, block in enumerate(mesh.cells):
        if block.type != "line":
            continue
        for name, chosen in mesh.cell_sets.items():
            # gmsh's bounding entities are numbers of curves, not of lines
            if name != "gmsh:bounding_entities" and chosen[k] is not None and len(chosen[k]):
                groups.setdefault(name, []).append(block.data[chosen[k]])
        for key, kind in (("gmsh:physical", "physical"), ("gmsh:geometrical", "curve")):
            tags = mesh.cell_data[key][k] if key in mesh.cell_data else np.zeros(0)
            for tag in np.unique(tags).tolist():
                name = named.get(tag, "") if kind == "physical" else ""
                if tag and name not in mesh.cell_sets:
                    here = block.data[tags == tag]
                    groups.setdefault(name or f"{kind} {tag}", []).append(here)
    return {name: np.concatenate(sides) for name, sides in groups.items()}


def sets_of_nodes(mesh: Any, quads: Index) -> dict[str, Index]:
    """Sides (., 2) of the boundary with both ends in a set of nodes, by the set's name."""
    sides = boundary(quads)
    found = {
        name: sides[np.isin(sides, np.asarray(chosen, int)).all(1)]
        for name, chosen in mesh.point_sets.items()
    }
    return {name: part for name, part in found.items() if len(part)}
