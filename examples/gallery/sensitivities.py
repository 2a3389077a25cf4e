"""
Sensitivities over time
=======================

Which samples of a recording depend on which parameter? Forward sensitivities are the derivatives of
every sample with respect to a few parameters, from one run.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import RigFile, excite

# where points slip under 25 N each, friction must fall slowly: see Limits
file = RigFile.ready("paper").override({"contact.v_s": 0.05})
built = excite(file, "deep pressing").build()
names = ["contact.K_n", "contact.R_n", "pad.E", "pad.tau"]
t = torch.linspace(0, 1.5, 601, dtype=torch.float64)
run = built.run(t, gradient="forward", wrt=names, rigid=True)
print("derivatives:", tuple(run.sensitivities.shape), "= times, coordinates and rates, parameters")

# the columns are those of `layout.rigid`: poses and velocities of the bodies
layout = built.rig.layout
angle = layout.rigid.index(layout.slices["pose", "disc"].start + 2)

_, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
above.plot(t, run["theta"].detach())
above.set_ylabel("angle [rad]")
for i, name in enumerate(names):
    size = built.rig.parameter(name).item()
    below.plot(t, 1e3 * 0.01 * size * run.sensitivities[:, angle, i], label=name)
below.set(xlabel="time [s]", ylabel="change for 1 % [mrad]")
below.legend(ncols=2)
plt.show()
