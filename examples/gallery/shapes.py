"""
Objects that are not round
==========================

How does the grip change when the object is an ellipse, or a box with rounded corners? All three
are grasped by 1.5 mm and rolled to the left along the same motion.
"""

import matplotlib.pyplot as plt
import torch

import torchsoft as ts

objects = {
    "disc": ts.Circle(19.37e-3),
    "ellipse, 1.05 : 1": ts.Ellipse(20.34e-3, 19.37e-3),
    "box, corners of 18 mm": ts.RoundedBox(20e-3, 19.37e-3, radius=18e-3),
}
settings = ts.Parameters().override({"control.senses": "bracket"})  # the loop measures the bracket
t = torch.linspace(0, 2.5, 501, dtype=torch.float64)

_, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
for name, shape in objects.items():
    model = ts.SoftGrasp(settings, shape=shape)
    y0 = ts.rest(model).detach()  # at rest on the lower pad, just touched by the upper one
    y_Br = float(model.unpack(y0).pose["bracket"][1])
    motion = ts.Reference(
        x_d=ts.Profile([0.5, 2.5], [60e-3, 40e-3]),
        y_d=ts.Profile([0.0, 0.375], [y_Br, y_Br - 1.5e-3]),
        F_ff=ts.Profile([0.0], [0.0]),
    )
    run = ts.simulate(model, t, y0=y0, reference=motion)
    normal = run.force["L"][..., 0].sum(-1)
    touching = int((run.force["L"][-1, :, 0] > 0).sum())
    print(f"{name:22s} turns by {run['theta'][-1]:.3f} rad, {touching} nodes touch at the end")
    above.plot(run.t, normal, label=name)
    below.plot(run.t, 1e3 * run["y_Br"], label=name)
above.set_ylabel("force on the lower pad [N]")
below.set(xlabel="time [s]", ylabel="height of the bracket [mm]")
above.legend()
plt.show()
