"""
A gradient beside finite differences
====================================

Is the gradient of a run right? The adjoint gives all of them at once; a central difference of two
runs on the same steps checks one after the other.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import Parameters, SoftGrasp, simulate
from torchsoft.excitation import CATALOGUE, begin

context = begin(CATALOGUE["fast strokes"], Parameters())
t = torch.linspace(0, 0.8, 161, dtype=torch.float64)


def loss(model: SoftGrasp, **steps: object) -> torch.Tensor:
    """Mean square of the disc's angle over the strokes."""
    run = simulate(model, t, y0=context.y0, reference=context.rig.reference, **steps)
    loss.knots = run.knots
    return run["theta"].square().mean()


model = context.rig
loss(model, gradient="discrete", tolerance=1e-10).backward()
knots = loss.knots  # the steps of that run, which the differences take as well

h = 1e-6  # small, so that no node touches or leaves between the two
names = (
    "contact.K_n",
    "contact.K_t",
    "contact.R_t",
    "contact.mu_s",
    "pad.E",
    "pad.tau",
    "disc.mass",
)
print("parameter      adjoint       difference    apart")
pairs = []
for name in names:
    value = float(model.parameter(name).detach())
    sides = []
    for sign in (1, -1):
        moved = SoftGrasp(model.settings.override({name: value * (1 + sign * h)}))
        sides.append(float(loss(moved, knots=knots, tolerance=1e-10)))
    difference = (sides[0] - sides[1]) / (2 * h)  # by the logarithm of the parameter
    adjoint = value * float(model.parameter(name).grad)
    pairs.append((abs(difference), abs(adjoint)))
    print(f"{name:12s}  {adjoint:+.6e}  {difference:+.6e}  {abs(adjoint / difference - 1):.0e}")

x, y = zip(*pairs)
plt.figure(figsize=(5, 3.5), layout="constrained")
plt.axline((1e-4, 1e-4), (1e-3, 1e-3), color="grey", lw=0.8)
plt.loglog(x, y, "o")
plt.gca().set(xlabel="|central difference|", ylabel="|adjoint|")
plt.show()
