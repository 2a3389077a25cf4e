"""torchsoft: a differentiable simulator of soft contact manipulation."""

from .paper.equilibrium import press, rest
from .paper.parameters import Parameters
from .paper.rig import SoftGrasp
from .physics.contact import Coulomb, SmoothSlip, SoftContact
from .physics.material import GeneralisedKelvin, KelvinVoigt, Prony, StandardLinearSolid
from .physics.mesh import CurvedPadMesh, FingertipMesh, PadMesh, QuadMesh
from .physics.motion import Profile, Reference, Sampled, hold
from .physics.pads import Pad, Taxels
from .physics.parts import PD, Actuator, Body, Contact, StateFeedback, controller
from .physics.rig import Rig
from .physics.shapes import (
    Circle,
    Contour,
    Ellipse,
    RoundedBox,
    RoundedPolygon,
    Shape,
    Superellipse,
)
from .physics.statics import NoEquilibrium
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
    "Batch",
    "Body",
    "Circle",
    "Contact",
    "Contour",
    "Coulomb",
    "CurvedPadMesh",
    "Ellipse",
    "FingertipMesh",
    "GeneralisedKelvin",
    "Interrupted",
    "KelvinVoigt",
    "NoEquilibrium",
    "Pad",
    "PadMesh",
    "Parameters",
    "Profile",
    "Prony",
    "QuadMesh",
    "Reference",
    "Rig",
    "RoundedBox",
    "RoundedPolygon",
    "Sampled",
    "SamplesFailed",
    "Shape",
    "SimulationFailed",
    "SmoothSlip",
    "SoftContact",
    "SoftGrasp",
    "StandardLinearSolid",
    "StateFeedback",
    "Superellipse",
    "Taxels",
    "Trajectory",
    "controller",
    "hold",
    "press",
    "register_method",
    "rest",
    "simulate",
    "simulate_batch",
]
