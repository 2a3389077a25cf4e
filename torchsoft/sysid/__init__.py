"""Identification: which parameters, from which recordings, with what certainty."""

from torchsoft.channels import MEASURED
from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.plan import Stage
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.result import Estimate, IdentificationResult
from torchsoft.sysid.solve import identify
from torchsoft.sysid.synthetic import RIG, record
from torchsoft.sysid.unknowns import Sensor, Unknown

__all__ = [
    "MEASURED", "RIG", "Estimate", "IdentificationResult", "Problem", "Recording", "Sensor", "Stage", "Unknown",
    "Unreachable", "identify", "record",
]  # fmt: skip
