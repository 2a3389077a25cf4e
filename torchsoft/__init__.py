"""torchsoft: a differentiable simulator of soft contact manipulation."""

from torchsoft.equilibrium import NoEquilibrium, press, rest
from torchsoft.implicit import METHOD, SimulationFailed
from torchsoft.model import SoftGrasp
from torchsoft.parameters import Parameters
from torchsoft.simulate import Interrupted, simulate
from torchsoft.torchdiffeq_solver import register
from torchsoft.trajectory import Trajectory

register()

__all__ = [
    "METHOD",
    "Interrupted",
    "NoEquilibrium",
    "Parameters",
    "SimulationFailed",
    "SoftGrasp",
    "Trajectory",
    "press",
    "rest",
    "simulate",
]
