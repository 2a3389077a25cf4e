"""
The paper's manipulation
========================

How does the contact force spread over the pads while the disc rolls? A disc is grasped between two
rubber pads and rolled by 20 mm; the picture shows the forces on every touching node at 5 s.
"""

import torch

from torchsoft import SoftGrasp, simulate
from torchsoft.scenario import grasp_and_roll

model = SoftGrasp()  # the paper's rig
manipulation = grasp_and_roll(model)  # its reference, its initial state, its grasping force
t = torch.linspace(0, 30, 3001, dtype=torch.float64)
run = simulate(model, t, y0=manipulation.y0)

for time in (0, 1000, 3000):
    print(f"t = {t[time]:4.0f} s: x_C = {1e3 * run['x_C'][time]:.3f} mm")
print(f"the disc turns by {run['theta'][1000]:.3f} rad; {manipulation.grasp_force:.1f} N hold it")

figure = run.plot(time=5.0, only=("scene", "contact U", "contact L"))
