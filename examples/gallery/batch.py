"""
A batch of runs with different parameters
=========================================

Which rubber grips best? Sixteen runs take place side by side in threads, each with another
stiffness and friction, and one backward pass gives the gradients of all of them.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import RigFile, excite, simulate_batch

rig, y0, _ = excite(RigFile.ready("paper"), "light shaking").build()
E = torch.linspace(0.4e6, 1.2e6, 16, dtype=torch.float64, requires_grad=True)
mu = torch.full((16,), 0.5, dtype=torch.float64, requires_grad=True)
t = torch.linspace(0, 1.0, 201, dtype=torch.float64)

batch = simulate_batch(
    rig, t, y0=y0, gradient="discrete",
    parameters={"pad.E": E, "contact.mu_s": mu, "contact.mu_k": 0.9 * mu},
)  # fmt: skip
print(f"{len(batch)} runs in {batch.wall_s:.1f} s; failed: {batch.failures or 'none'}")

# slip: how far the disc is from where the bracket would have rolled it
wander = (batch["x_C"] - batch["x_C"][:, :1]).square().mean(1).sqrt()
wander.sum().backward()  # of every run with respect to its E and mu

_, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.plot(1e-6 * E.detach(), 1e3 * wander.detach(), "o-")
left.set(xlabel="E [MPa]", ylabel="travel of the disc, rms [mm]")
right.plot(1e-6 * E.detach(), 1e3 * mu.grad, "o-")
right.set(xlabel="E [MPa]", ylabel="d(travel) / d(mu) [mm]")
plt.show()
