"""Identification: which parameters, from which recordings, with what certainty."""

from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.plan import Stage
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import CHANNELS, Recording
from torchsoft.sysid.result import Answer, Estimate
from torchsoft.sysid.solve import identify
from torchsoft.sysid.synthetic import RIG, record
from torchsoft.sysid.unknowns import Sensor, Unknown

__all__ = [
    "CHANNELS", "RIG", "Answer", "Estimate", "Problem", "Recording", "Sensor", "Stage", "Unknown", "Unreachable", "identify",
    "record",
]  # fmt: skip
