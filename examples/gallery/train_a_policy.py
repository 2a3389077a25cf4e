"""
A policy trained by gradient
============================

Can a small network roll the disc to its target? It observes disc and bracket and pushes the
bracket, in place of the horizontal PD loop. The adjoint of the run reaches its weights.
"""

import matplotlib.pyplot as plt
import torch
from torch import nn

import torchsoft as ts

torch.manual_seed(0)
coarse = {"pad.elements_x": 60, "pad.elements_y": 3}
paper, y0, _ = ts.excite(ts.RigFile.ready("paper").override(coarse), "strokes").build()


class Policy(nn.Module):
    """Efforts [N] of set-points and state: a weak linear law, corrected by a network."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 1)).double()

    def forward(self, setpoints: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        x_d, (x, x_Br, v, v_Br) = setpoints[..., 0], state.unbind(-1)
        seen = torch.stack((1e3 * (x_d - x), 1e3 * (x_d - x_Br), 10 * v, 10 * v_Br), -1)
        return (4e3 * (x_d - x) - 60.0 * v_Br)[..., None] + 20.0 * self.net(seen)


policy = Policy()
actuators = ts.controller(
    policy, measures=["disc.x", "bracket.x"], setpoints=["x_d"], pushes={"x": "bracket.x"}
)
actuators["y"] = paper.actuators["y"]  # the vertical loop stays
parts = {name: dict(getattr(paper, name)) for name in ("bodies", "pads", "contacts")}
rig = ts.Rig(**parts, actuators=actuators, symbols={"disc": "C", "bracket": "Br"})
target = ts.Profile([0.5, 0.9], [60.3e-3, 57.3e-3])
reference = ts.Reference(x_d=target, y_d=paper.reference["y_d"], F_ff=paper.reference["F_ff"])
t = torch.linspace(0, 1.2, 241, dtype=torch.float64)
optimiser, history = torch.optim.Adam(policy.parameters(), lr=0.02), []
for i in range(25):
    run = ts.simulate(rig, t, y0=y0, reference=reference, rtol=1e-3, gradient="discrete")
    loss = (1e3 * (run["x_C"] - run["x_d"])).square().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    history.append(run["x_C"].detach())
    if i % 8 == 0:
        print(f"{i:2d}: root mean square error {loss.sqrt().item():.3f} mm")

_, axes = plt.subplots(figsize=(7, 3), layout="constrained")
axes.plot(t, 1e3 * torch.stack((run["x_d"].detach(), history[0], history[-1]), -1))
axes.legend(["set-point", "first run", "trained"])
axes.set(xlabel="time [s]", ylabel="x of the disc [mm]")
plt.show()
