"""Cost of checking and of running a rig file, estimated from its tables before anything is computed."""

from torchsoft.cost import Cost, row_bytes, step_time, steps_per_second
from torchsoft.physics.mesh import Mesh
from torchsoft.physics.mesh.compliance import SMALLEST_BLOCK
from torchsoft.rigs.fields import at_field
from torchsoft.rigs.schema import RigTables
from torchsoft.solve.simulate import RTOL

FLOPS = 1e10
"""Operations a second [1/s] of products of blocks on one core of a usual machine."""


def condensing_time(mesh: Mesh) -> float:
    """Time [s] for condensing a mesh onto its surface: a factorisation in the order of the smallest band, and as many solutions
    as surface coordinates."""
    surface, free, band = mesh.counts()
    width = max(2 * min(band, free // band), SMALLEST_BLOCK)
    return 2 * free * width * (4 * width + 12 * surface) / FLOPS


def cost(file: RigTables, runs: bool) -> Cost:
    """Cost of a check, and of a run after it. Raises `ValueError` for a mesh file that cannot be read."""
    meshes = []
    for name, table in file.pads.items():
        with at_field(f"pads.{name}"):
            meshes.append(table.mesh(file.folder))
    seconds = sum(condensing_time(mesh) for mesh in set(meshes))
    memory, steps = max(mesh.memory for mesh in meshes), 0.0
    if runs:
        span, s = file.outputs.duration, file.solver
        steps = span / s.step if s.step is not None else span * steps_per_second(s.rtol or RTOL)
        for mesh, table in zip(meshes, file.pads.values()):
            surface, free, _ = mesh.counts()
            points = table.points * surface
            seconds += 0.5 * steps * step_time(surface, points, free if table.inertial else 0)
            memory += span / file.outputs.interval * row_bytes(free if table.inertial else surface, points) / 2**30
    return Cost(steps, seconds, memory)
