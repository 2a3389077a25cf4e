"""
Objects that are not round
==========================

How does the grip change if the object is an ellipse, or a box with rounded corners? All three
are grasped by 1.5 mm and rolled to the left along the same motion.
"""

import matplotlib.pyplot as plt

import torchsoft as ts
from torchsoft.rigs.excite import Excitation

objects = {
    "disc": ts.Circle(19.37e-3),
    "ellipse, 1.05 : 1": ts.Ellipse(20.34e-3, 19.37e-3),
    "box, corners of 18 mm": ts.RoundedBox(20e-3, 19.37e-3, radius=18e-3),
}
roll = {"kind": "profile", "offset": "start", "times": [0.5, 2.5], "values": [0.0, -20e-3]}
file = ts.RigFile.ready("paper").override({"contact.v_s": 0.05})
file = ts.excite(file, Excitation(roll, duration=2.5, depth=1.5e-3))

_, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
for name, shape in objects.items():
    run = file.build({"bodies.disc.shape": shape}).run()
    normal = run.force["L"][..., 0].sum(-1)
    touching = int((run.force["L"][-1, :, 0] > 0).sum())
    print(f"{name:22s} turns by {run['theta'][-1]:.3f} rad, {touching} nodes in contact at the end")
    above.plot(run.t, normal, label=name)
    below.plot(run.t, 1e3 * run["y_Br"], label=name)
above.set_ylabel("force on the lower pad [N]")
below.set(xlabel="time [s]", ylabel="height of the bracket [mm]")
above.legend()
plt.show()
