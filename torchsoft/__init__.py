"""torchsoft: a differentiable simulator of soft contact manipulation."""

from torchsoft.paper.equilibrium import press, rest
from torchsoft.paper.parameters import Parameters
from torchsoft.paper.rig import SoftGrasp
from torchsoft.physics.contact import Coulomb, SmoothSlip, SoftContact
from torchsoft.physics.controllers import StateFeedback, controller
from torchsoft.physics.material import GeneralisedKelvin, KelvinVoigt, Prony, StandardLinearSolid
from torchsoft.physics.mesh import CurvedPadMesh, FingertipMesh, PadMesh, QuadMesh
from torchsoft.physics.motion import Profile, Reference, Sampled, hold
from torchsoft.physics.pads import Pad
from torchsoft.physics.parts import PD, Actuator, Body, Contact
from torchsoft.physics.rig import Rig
from torchsoft.physics.shapes import Circle, Contour, Ellipse, RoundedBox, RoundedPolygon, Shape, Superellipse
from torchsoft.physics.statics import NoEquilibrium
from torchsoft.solve.batch import Batch, SamplesFailed, simulate_batch
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.simulate import Interrupted, simulate
from torchsoft.solve.stepper import METHOD
from torchsoft.solve.torchdiffeq import register_method
from torchsoft.solve.trajectory import Trajectory

__all__ = [
    "METHOD", "PD", "Actuator", "Batch", "Body", "Circle", "Contact", "Contour", "Coulomb", "CurvedPadMesh", "Ellipse",
    "FingertipMesh", "GeneralisedKelvin", "Interrupted", "KelvinVoigt", "NoEquilibrium", "Pad", "PadMesh", "Parameters",
    "Profile", "Prony", "QuadMesh", "Reference", "Rig", "RoundedBox", "RoundedPolygon", "Sampled", "SamplesFailed",
    "Shape", "SimulationFailed", "SmoothSlip", "SoftContact", "SoftGrasp", "StandardLinearSolid", "StateFeedback",
    "Superellipse", "Trajectory", "controller", "hold", "press", "register_method", "rest", "simulate", "simulate_batch",
]  # fmt: skip
