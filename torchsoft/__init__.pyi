"""torchsoft: a differentiable simulator of soft contact manipulation."""

from .physics.ageing import AgeingSlip
from .physics.contact import Coulomb, SmoothSlip, SoftContact
from .physics.hyperelastic import Hyperelastic, MooneyRivlin, NeoHookean, Ogden, Yeoh
from .physics.material import GeneralisedKelvin, KelvinVoigt, Prony, StandardLinearSolid
from .physics.mesh import CurvedPadMesh, FingertipMesh, PadMesh, QuadMesh
from .physics.motion import Profile, Reference, Sampled, hold
from .physics.pads import Pad, Taxels
from .physics.parts import (
    PD,
    Actuator,
    Body,
    Contact,
    Integral,
    Lagging,
    StateFeedback,
    controller,
)
from .physics.rate_and_state import RateAndState
from .physics.rig import Rig
from .physics.shapes import (
    Circle,
    Contour,
    Eccentric,
    Ellipse,
    RoundedBox,
    RoundedPolygon,
    Shape,
    Superellipse,
)
from .physics.statics import NoEquilibrium
from .rigs.build import RigFile
from .rigs.built import BuiltRig
from .rigs.excite import excite
from .solve.batch import Batch, SamplesFailed, simulate_batch
from .solve.progress import SimulationFailed
from .solve.simulate import Interrupted, simulate
from .solve.stepper import METHOD
from .solve.torchdiffeq import register_method
from .solve.trajectory import Trajectory

__version__: str

__all__ = [
    "METHOD",
    "PD",
    "Actuator",
    "AgeingSlip",
    "Batch",
    "Body",
    "BuiltRig",
    "Circle",
    "Contact",
    "Contour",
    "Coulomb",
    "CurvedPadMesh",
    "Eccentric",
    "Ellipse",
    "FingertipMesh",
    "GeneralisedKelvin",
    "Hyperelastic",
    "Integral",
    "Interrupted",
    "KelvinVoigt",
    "Lagging",
    "MooneyRivlin",
    "NeoHookean",
    "NoEquilibrium",
    "Ogden",
    "Pad",
    "PadMesh",
    "Profile",
    "Prony",
    "QuadMesh",
    "RateAndState",
    "Reference",
    "Rig",
    "RigFile",
    "RoundedBox",
    "RoundedPolygon",
    "Sampled",
    "SamplesFailed",
    "Shape",
    "SimulationFailed",
    "SmoothSlip",
    "SoftContact",
    "StandardLinearSolid",
    "StateFeedback",
    "Superellipse",
    "Taxels",
    "Trajectory",
    "Yeoh",
    "controller",
    "excite",
    "hold",
    "register_method",
    "simulate",
    "simulate_batch",
]
