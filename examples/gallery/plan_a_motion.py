"""
A motion found by gradient
==========================

How must the bracket move so that the disc ends 8 mm to the left, with small forces? The values at
the knots of the set-point are unknowns, with respect to which the adjoint differentiates the run.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import Reference, RigFile, Sampled, excite

coarse = {"pad.elements_x": 60, "pad.elements_y": 3, "contact.v_s": 0.05}
built = excite(RigFile.ready("paper").override(coarse), "strokes").build()
grasp = {name: built.rig.reference[name] for name in ("y_d", "F_ff")}
x_0, times = 60.3e-3, torch.linspace(0.5, 1.1, 9, dtype=torch.float64)
t = torch.linspace(0, 1.3, 261, dtype=torch.float64)

u = torch.zeros(8, dtype=torch.float64, requires_grad=True)  # of the set-point at the knots [cm]
optimiser = torch.optim.LBFGS([u], max_iter=20, line_search_fn="strong_wolfe")
runs, history = [], []


def loss() -> torch.Tensor:
    """Error at the end [mm2], forces, and curvature of the set-point, with the gradient in u."""
    optimiser.zero_grad()
    knots = torch.cat((torch.zeros(1), u)).double()
    reference = Reference(x_d=Sampled(times, x_0 + 1e-2 * knots), **grasp)
    run = built.run(t, reference=reference, rtol=1e-3, gradient="discrete")
    miss = 1e3 * (run["x_C"] - (x_0 - 8e-3))[t > 1.1]
    bend = knots.diff().diff().square().sum()
    value = miss.square().mean() + 1e-3 * run["F_x"].square().mean() + bend
    value.backward()
    runs.append(run)
    history.append(value.item())
    return value


optimiser.step(loss)
run = runs[-1]
print(f"loss {history[0]:.3g} -> {history[-1]:.3g} in {len(history)} runs")
print(f"the disc ends {1e3 * abs(run['x_C'][-1].item() - (x_0 - 8e-3)):.3f} mm off")

_, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.semilogy(history)
left.set(xlabel="iteration", ylabel="loss")
right.plot(t, 1e3 * run["x_d"].detach(), label="set-point of the bracket")
right.plot(t, 1e3 * run["x_C"].detach(), label="disc")
right.axhline(1e3 * (x_0 - 8e-3), color="grey", lw=0.8, ls="--")
right.set(xlabel="time [s]", ylabel="x [mm]")
right.legend()
plt.show()
