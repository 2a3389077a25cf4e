"""
A custom friction law
=====================

How does a run depend on a parameter of a custom law? In the law below friction falls with the
normal force, as with rubber. The law and its derivatives are compiled when the run starts.
"""

import matplotlib.pyplot as plt
import torch
from torch import nn

from torchsoft import RigFile, excite


class Pressed(nn.Module):
    """Slip rate [m/s] of an effort E [N] under a normal force F_N [N] with a dashpot R [N.s/m]:
    (R + F_N / v_eta) |rate| = E - mu F_N above it. mu falls with the normal force, and friction
    grows with the slip rate over v_eta [m/s]."""

    def __init__(self, mu: float, fall: float, v_eta: float = 1.0) -> None:
        super().__init__()
        self.mu, self.fall, self.v_eta = (
            nn.Parameter(torch.tensor(x, dtype=torch.float64)) for x in (mu, fall, v_eta)
        )

    def forward(self, E: torch.Tensor, F_N: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
        mu = self.mu * torch.exp(-self.fall * F_N)
        return (E - mu * F_N).clamp(min=0.0) / (R + F_N / self.v_eta)


# a motion in which the disc slips: a light grasp, jerked
file = excite(RigFile.ready("paper"), "light jerks")
law = "laws.steel_on_rubber.friction"  # its place in the rig file
built = file.build({law: Pressed(mu=0.7, fall=0.05)})
run = built.run(gradient="discrete")

loss = run["theta"].square().mean()
loss.backward()
for name in ("mu", "fall", "v_eta"):
    value = built.rig.parameter(f"{law}.{name}")
    print(f"{name:5s} = {float(value.detach()):6.3f}: d(loss)/d({name}) = {float(value.grad):+.3e}")

_, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for fall in (0.0, 0.05, 0.2):
    again = file.build({law: Pressed(mu=0.7, fall=fall)}).run()
    change = 1e3 * (again["theta"] - run["theta"].detach())
    axes.plot(again.t, change, label=f"fall = {fall:g} 1/N")
axes.set(xlabel="time [s]", ylabel="change from 0.05 1/N [mrad]")
axes.legend()
plt.show()
