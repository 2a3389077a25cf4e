"""Identification: which parameters, from which recordings, with what certainty."""

from torchsoft.channels import MEASURED
from torchsoft.sysid.answer import Answer, load_answer
from torchsoft.sysid.estimate import Estimate
from torchsoft.sysid.first_samples import begin_underway
from torchsoft.sysid.fit import Unreachable
from torchsoft.sysid.plan import Stage
from torchsoft.sysid.problem import Problem
from torchsoft.sysid.recording import Recording
from torchsoft.sysid.result import IdentificationResult
from torchsoft.sysid.solve import identify
from torchsoft.sysid.start import AtRest, Known
from torchsoft.sysid.synthetic import RIG, record
from torchsoft.sysid.underway import Underway
from torchsoft.sysid.unknowns import Prior, Sensor, Unknown

__all__ = [
    "MEASURED", "RIG", "Answer", "AtRest", "Estimate", "IdentificationResult", "Known", "Prior", "Problem", "Recording",
    "Sensor", "Stage", "Underway", "Unknown", "Unreachable", "begin_underway", "identify", "load_answer", "record",
]  # fmt: skip
