"""System identification: parameters of a rig from recordings, with their uncertainty."""

from torchsoft.sysid.estimate import Estimate
from torchsoft.sysid.first_samples import estimate_initial_state
from torchsoft.sysid.fit import Stage, Unreachable
from torchsoft.sysid.identification import explain, identify
from torchsoft.sysid.initial_state import Known, MovingStart, Standing
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.result import IdentificationResult, load_answer
from torchsoft.sysid.synthetic import good_sensors, record
from torchsoft.sysid.unknowns import Prior, Sensor, Unknown

__all__ = [
    "Estimate",
    "IdentificationResult",
    "Known",
    "MovingStart",
    "Prior",
    "Problem",
    "Recording",
    "Sensor",
    "Stage",
    "Standing",
    "Unknown",
    "Unreachable",
    "estimate_initial_state",
    "explain",
    "good_sensors",
    "identify",
    "load_answer",
    "record",
]
