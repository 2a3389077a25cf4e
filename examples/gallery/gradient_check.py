"""
A gradient compared with finite differences
===========================================

Is the gradient of a run right? One backward pass gives the derivatives with respect to all
parameters; a central difference of two runs on the same steps checks one at a time.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import RigFile, excite

built = excite(RigFile.ready("paper"), "fast strokes").build()
t = torch.linspace(0, 0.8, 161, dtype=torch.float64)
run = built.run(t, gradient="discrete", tolerance=1e-10)
run["theta"].square().mean().backward()  # of the disc's angle over the strokes

h = 1e-6  # small, so that the two have the same contacts
names = "contact.K_n", "contact.K_t", "contact.R_t", "contact.mu_s", "pad.E", "pad.tau", "disc.mass"
print("parameter      adjoint       difference    error")
pairs = []
for name in names:
    parameter = built.rig.parameter(name)
    value, sides = parameter.item(), []
    for factor in (1 + h, 1 - h, 1):
        parameter.data.fill_(factor * value)
        if factor != 1:
            again = built.run(t, knots=run.knots, tolerance=1e-10)  # the steps of that run
            sides.append(again["theta"].square().mean().item())
    difference = (sides[0] - sides[1]) / (2 * h)  # with respect to ln(parameter)
    adjoint = value * parameter.grad.item()
    pairs.append((abs(difference), abs(adjoint)))
    print(f"{name:12s}  {adjoint:+.6e}  {difference:+.6e}  {abs(adjoint / difference - 1):.0e}")

x, y = zip(*pairs)
plt.figure(figsize=(5, 3.5), layout="constrained")
plt.axline((1e-4, 1e-4), (1e-3, 1e-3), color="grey", lw=0.8)
plt.loglog(x, y, "o")
plt.gca().set(xlabel="|central difference|", ylabel="|adjoint|")
plt.show()
