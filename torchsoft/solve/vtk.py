"""Pads of a run as VTK files: deformed by `displacement`, with strain and stress of their elements,
for ParaView, and for meshio, which reads them back."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
from numpy.typing import ArrayLike

from torchsoft.files import replacing
from torchsoft.physics.mesh import Array
from torchsoft.physics.pads import von_mises
from torchsoft.solve.trajectory import Trajectory


def tensors(xx: Array, yy: Array, zz: Array, xy: Array) -> Array:
    """Symmetric tensors (..., 9) of plane components."""
    zero = np.zeros_like(xx)
    return np.stack((xx, xy, zero, xy, yy, zero, zero, zero, zz), -1)


def write(run: Trajectory, path: Path, times: Sequence[float] | None = None) -> list[Path]:
    """Write `path`, a .pvd that lists a .vtu for each of the samples nearest to `times` [s] (all by
    default); the files written. All pads are in one file, at their places of rest in the world [m]
    with their base as it is then, and told apart by the number `pad`.

    Points have `displacement` [m] from there; elements `strain`, `stress` [Pa], the elastic part,
    and `von_mises` [Pa]. Raises `ValueError` for another suffix.
    """
    import meshio  # takes half a second, and few need it

    if path.suffix != ".pvd":
        raise ValueError(f"`path` must end in .pvd, but is {path}")
    rows = range(len(run.t)) if times is None else sorted({run.at(time) for time in times})
    pads = run.setup.pads
    cells, first = [], 0
    for pad in pads.values():
        cells.append(("quad", pad.mesh.elements + first))
        first += len(pad.mesh.nodes)
    root = xml.Element("VTKFile", type="Collection", version="0.1")
    listed, written = xml.SubElement(root, "Collection"), []
    for number, row in enumerate(rows):
        points, moved = [], []
        fields: dict[str, list[ArrayLike]] = {
            k: [] for k in ("pad", "strain", "stress", "von_mises")
        }
        for i, (name, pad) in enumerate(pads.items()):
            u = pad.displacement(run.displacement[name][row].detach().numpy())
            x, y, angle = (
                (0.0, 0.0, 0.0) if pad.base is None
                else run.state.pose[pad.base][row].detach().tolist()
            )  # fmt: skip
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            axes = turn @ pad.axes.numpy()
            points.append(pad.placed(pad.mesh.nodes) @ turn.T + [x, y])
            moved.append(u @ axes.T)
            strain = pad.strain(u)
            stress, zero = pad.stress(u), np.zeros(len(strain))
            fields["pad"].append(np.full(len(strain), i))
            for key, values in (
                ("strain", tensors(strain[:, 0], strain[:, 1], zero, strain[:, 2])),
                ("stress", tensors(*stress.T)),
            ):
                world = np.eye(3)
                world[:2, :2] = axes
                turned = world @ values.reshape(-1, 3, 3) @ world.T
                fields[key].append(turned.reshape(-1, 9))
            fields["von_mises"].append(von_mises(stress))
        flat = lambda parts: np.pad(np.concatenate(parts), ((0, 0), (0, 1)))
        mesh = meshio.Mesh(
            flat(points), cells, point_data={"displacement": flat(moved)}, cell_data=fields
        )
        file = path.with_name(f"{path.stem}_{number:05d}.vtu")
        with replacing(file) as partial:
            meshio.write(partial, mesh, file_format="vtu")
        entry = {"timestep": f"{float(run.t[row])!r}", "part": "0", "file": file.name}
        xml.SubElement(listed, "DataSet", entry)
        written.append(file)
    with replacing(path) as partial:
        partial.write_bytes(xml.tostring(root, "utf-8", xml_declaration=True))
    return [path, *written]
