"""
Identification of a custom friction law
=======================================

Does friction fall with the normal force, and how fast? The two parameters of a custom law are
unknowns like any other, by their names in the module.
"""

import matplotlib.pyplot as plt
import torch
from torch import nn

from torchsoft import RigFile, excite
from torchsoft.sysid import Problem, Sensor, Unknown, identify, record


class Pressed(nn.Module):
    """Friction whose coefficient falls with the normal force."""

    def __init__(self, mu: float, fall: float) -> None:
        super().__init__()
        self.mu, self.fall = (
            nn.Parameter(torch.tensor(x, dtype=torch.float64)) for x in (mu, fall)
        )

    def forward(self, E: torch.Tensor, F_N: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
        mu = self.mu * torch.exp(-self.fall * F_N)
        return (E - mu * F_N).clamp(min=0.0) / (R + F_N / 0.05)


# the simulator replaces a bench: a light grasp, jerked, with noise of the sensors
coarse = {"pad.elements_x": 60, "pad.elements_y": 2}
file = excite(RigFile.ready("paper").override(coarse), "hard light jerks")
sensors = {"x_C": Sensor(noise=1e-5), "theta": Sensor(noise=5e-4), "F_x": Sensor(noise=0.1)}
law = "laws.steel_on_rubber.friction"
truth = {f"{law}.mu": 0.7, f"{law}.fall": 0.05}
bench = file.build({law: Pressed(*truth.values())})
known = file.build({law: Pressed(mu=0.5, fall=0.02)})  # the start
made = record("bench", known, bench.rig, sensors)
problem = Problem([made], sensors, {name: Unknown() for name in truth})
result = identify(problem, rtol=1e-4, assumptions="trusted")
print(result.table())
print("truth:", truth)

force = torch.linspace(0, 12, 100)
for label, (mu, fall) in {
    "truth": truth.values(),
    "identified": [result[name].value for name in truth],
    "start": (0.5, 0.02),
}.items():
    plt.plot(force, mu * torch.exp(-fall * force), label=label)
plt.gca().set(xlabel="normal force of a node [N]", ylabel="coefficient of friction", ylim=(0, None))
plt.legend()
plt.show()
