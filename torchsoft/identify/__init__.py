"""Identification: which parameters, from which recordings, with what certainty."""

from torchsoft.identify.answer import Answer, Estimate
from torchsoft.identify.fit import Unreachable
from torchsoft.identify.plan import Stage
from torchsoft.identify.problem import Problem
from torchsoft.identify.recording import CHANNELS, Recording
from torchsoft.identify.solve import identify
from torchsoft.identify.synthetic import RIG, record
from torchsoft.identify.unknowns import Sensor, Unknown

__all__ = [
    "CHANNELS", "RIG", "Answer", "Estimate", "Problem", "Recording", "Sensor", "Stage", "Unknown", "Unreachable", "identify",
    "record",
]  # fmt: skip
