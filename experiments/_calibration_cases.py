"""The two problems of the calibration, with their priors: one that Laplace's approximation suits, and one that it does not."""

from dataclasses import dataclass

from _experiment import COARSE

from torchsoft import Parameters
from torchsoft.excitation import Excitation, Roll, Strokes
from torchsoft.sysid import RIG, Prior, Problem, Sensor, Unknown, record


@dataclass(frozen=True)
class Case:
    """A motion of less than half a second, sensors `noise` times as bad as the good rig's, and by parameter the standard
    deviation of its logarithm beforehand. `bent`: its posteriors are not nearly normal, and NUTS is tried."""

    title: str
    motion: Strokes | Roll
    duration: float
    noise: float
    priors: dict[str, float]
    bent: bool = False

    def problem(self) -> Problem:
        """With the samples of the middle of the prior; a calibration keeps their times only."""
        base = Parameters().override(COARSE | {"contact.v_s": 0.05, "contact.mu_k": 0.4})
        excitation = Excitation(
            motion=self.motion, duration=self.duration, grasp_time=0.1, settle=0.0, senses="bracket"
        )
        sensors = {name: Sensor(noise=self.noise * one.noise) for name, one in RIG.items()}
        data = record(self.title, excitation, base, base, sensors, seed=1)
        table = base.table()
        priors = {
            name: Prior(median=float(table[name]["value"]), sd=sd, kind="log-normal")
            for name, sd in self.priors.items()
        }
        return Problem([data], sensors, {name: Unknown(prior=prior) for name, prior in priors.items()})


CASES = {
    "strokes": Case(
        "strokes", Strokes(travel=6e-3, stroke_time=0.1), 0.35, 5.0,
        {"pad.E": 0.1, "pad.tau": 0.2, "contact.K_t": 0.2, "contact.mu_s": 0.1},
    ),
    "series": Case("series", Roll(travel=4e-3), 0.25, 10.0, {"pad.E": 0.3, "contact.K_n": 0.7}, bent=True),
}  # fmt: skip
"""Strokes that slip, seen well; and a roll that sees the stiffnesses of pads and contacts in series, hardly each of them."""
