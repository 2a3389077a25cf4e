"""Finite elements of a pad: meshes of bilinear quadrilaterals in plane strain, in the pad's own
frame, where its face looks up.

Every stiffness is linear in the two Lame moduli, K = depth (lambda K_lambda + mu K_mu). The
dilatational part is integrated at the element's centre and the shear part at 2 x 2 points
(selective reduced integration), which is free of volumetric locking and of hourglass modes.
"""

from torchsoft.physics.mesh.block import CurvedPadMesh, FingertipMesh, PadMesh
from torchsoft.physics.mesh.mesh import (
    Array,
    Index,
    Mesh,
    StoredMesh,
    dofs_of,
    lame_moduli,
    unit_compliance,
)
from torchsoft.physics.mesh.quads import QuadMesh

__all__ = [
    "Array", "CurvedPadMesh", "FingertipMesh", "Index", "Mesh", "PadMesh", "QuadMesh",
    "StoredMesh", "dofs_of", "lame_moduli", "unit_compliance",
]  # fmt: skip
