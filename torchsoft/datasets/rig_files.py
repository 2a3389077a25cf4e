"""The rig file of a dataset, embedded in its configuration, and places in it by name."""

import base64
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchsoft.files import check_file
from torchsoft.physics.channels import units
from torchsoft.physics.energy import integrals, stores
from torchsoft.physics.rig import Rig
from torchsoft.rigs.build import RigFile
from torchsoft.rigs.places import Place
from torchsoft.rigs.places import place as place_in
from torchsoft.rigs.written import files_renamed
from torchsoft.tables import line, read_toml, shown

EMBEDDED = 2e6
"""Largest total size [B] of the files that a rig file names, since the configuration embeds
them."""

OWN = {"title": "title", "outputs": "duration and sample_interval", "solver": "rtol and step"}
"""Tables of a rig file that a dataset does not use, and the fields of the dataset in their
place."""


def embedded(tree: Any, folder: Path) -> Any:
    """The configuration with its rig file embedded, and the files that the rig file names. Raises
    `ValueError` naming the file, and `OSError`."""
    name = tree.get("rig") if isinstance(tree, Mapping) else None
    if name is None:
        return tree
    if not isinstance(name, str):
        raise ValueError(f"rig should be the name of a rig file, not {shown(name)}")
    path, contents = RigFile.path(name, folder), dict[str, str]()
    RigFile.from_toml(path)

    def stored(file: str) -> str:
        data = check_file(path.parent / file, EMBEDDED).read_bytes()
        own = f"{sha256(data).hexdigest()[:16]}{Path(file).suffix}"
        contents[own] = base64.b64encode(data).decode()
        if (total := sum(map(len, contents.values()))) > EMBEDDED:
            raise ValueError(
                f"{path}: the files that it names have {total / 1e6:.3g} MB in base 64, but a "
                f"dataset's configuration holds {EMBEDDED / 1e6:g} MB at most; take smaller ones"
            )
        return own

    fields = {key: tree[key] for key in ("fixed", "kinds") if key in tree}
    known = files_renamed(fields | {"rig": read_toml(path)}, stored)
    return {**tree, **known} | ({"files": contents} if contents else {})


def outputs_of(rig: Any) -> dict[str, Any]:
    """Duration and sample interval of the rig file, as far as it states them."""
    outputs = rig.get("outputs")
    given = outputs if isinstance(outputs, Mapping) else {}
    named = {"duration": given.get("duration"), "sample_interval": given.get("interval", 0.01)}
    return {name: x for name, x in named.items() if x is not None}


def place(file: RigFile, name: str) -> Place:
    """The place of a name in the rig file of a dataset. Raises `ValueError` for an unknown name,
    and for a table that the dataset replaces."""
    if name in file.names:
        full = " and ".join(map(repr, file.full(name)))
        raise ValueError(f"`{line(name, 80)}` is short; in a file write the full name, {full}")
    found = place_in(file, name)
    if (own := OWN.get(str(found.keys[0]))) is not None:
        raise ValueError(f"`{line(name, 80)}` has no part in a dataset, whose own {own} decide it")
    return found


def own_points(rig: Rig, name: str) -> NDArray[np.float64]:
    """Positions (points, 2) [m] of a pad's contact points in its own frame."""
    pad = rig.pads[name]
    surface = pad.mesh.nodes[pad.mesh.free[pad.mesh.surface]]
    return np.einsum("pk,pkj->pj", pad.point_shares, surface[pad.point_nodes])


def differs(one: Rig, other: Rig) -> str | None:
    """The first difference between two rigs that would change the arrays of a dataset, None if
    there is none."""
    for name in one.pads:
        a, b = own_points(one, name), own_points(other, name)
        if a.shape != b.shape or np.abs(a - b).max() > 1e-12:
            return f"the contact points of pads.{name}"
        if one.pads[name].state_shape != other.pads[name].state_shape:
            return f"the state of pads.{name}"
    kinds = units, lambda rig: [*stores(rig)], integrals
    for kind in (*kinds, lambda rig: rig.layout.free):
        if kind(one) != kind(other):
            return "the coordinates and energies of the rig"
    return None
