"""
Which motion shows which parameter
==================================

What should be recorded to find friction, and what to find damping? The Fisher matrix of each
motion predicts how well its recording would determine each parameter, before anything is built.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

from torchsoft import RigFile, excite

names = [f"contact.{name}" for name in ("K_n", "R_n", "K_t", "mu_s", "mu_k")] + ["pad.E", "pad.tau"]
motions = ("strokes", "fast strokes", "deep pressing", "light shaking")
noise = {"x": 1e-5, "y": 1e-5, "theta": 5e-4}  # of the sensors [m, rad]
coarse = {"contact.v_s": 0.05, "pad.elements_x": 60, "pad.elements_y": 3}
file = RigFile.ready("paper").override(coarse)

table = np.zeros((len(motions), len(names)))
for row, motion in enumerate(motions):
    built = excite(file, motion).build()
    t = torch.arange(0, 1.5, 0.005, dtype=torch.float64)
    run = built.run(t, gradient="forward", wrt=names, rigid=True)
    sizes = torch.stack([built.rig.parameter(name).detach() for name in names])
    J = run.sensitivities.detach() * sizes  # with respect to logarithms
    measured = {"disc": ("x", "y", "theta"), "bracket": ("x", "y")}
    rows, layout = [], built.rig.layout
    for body, axes_ in measured.items():
        begins = layout.rigid.index(layout.slices["pose", body].start)
        rows += [J[:, begins + i] / noise[axis] for i, axis in enumerate(axes_)]
    fisher = sum(one.T @ one for one in rows)
    table[row] = 100 * torch.linalg.inv(fisher).diagonal().sqrt().numpy()

print(f"{'standard deviation [%]':24s}" + "".join(f"{name.split('.')[1]:>9s}" for name in names))
for motion, deviations in zip(motions, table):
    print(f"{motion:24s}" + "".join(f"{d:9.2g}" for d in deviations))

_, axes = plt.subplots(figsize=(8, 3), layout="constrained")
image = axes.imshow(np.log10(table), cmap="RdYlGn_r", vmin=-1, vmax=2)
axes.set_xticks(range(len(names)), [name.split(".")[1] for name in names])
axes.set_yticks(range(len(motions)), motions)
plt.colorbar(image, label="log10 of the deviation in %")
plt.show()
