"""Identification: which parameters, from which recordings, with what certainty."""

from torchsoft.channels import MEASURED
from torchsoft.sysid.answer.answer import Answer, load_answer
from torchsoft.sysid.answer.estimate import Estimate
from torchsoft.sysid.answer.result import IdentificationResult
from torchsoft.sysid.fit.fit import Unreachable
from torchsoft.sysid.fit.plan import Stage
from torchsoft.sysid.problem.first_samples import estimate_initial_state
from torchsoft.sysid.problem.moving_start import MovingStart
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Recording
from torchsoft.sysid.problem.start import AtRest, Known
from torchsoft.sysid.problem.synthetic import RIG, record
from torchsoft.sysid.problem.unknowns import Prior, Sensor, Unknown
from torchsoft.sysid.solve import explain, identify

__all__ = [
    "MEASURED",
    "RIG",
    "Answer",
    "AtRest",
    "Estimate",
    "IdentificationResult",
    "Known",
    "MovingStart",
    "Prior",
    "Problem",
    "Recording",
    "Sensor",
    "Stage",
    "Unknown",
    "Unreachable",
    "estimate_initial_state",
    "explain",
    "identify",
    "load_answer",
    "record",
]  # fmt: skip
