"""
A block, a curved pad, a fingertip
==================================

How does the shape of a pad's face affect its stiffness? A driven base presses each pad against the
same rod of 20 mm radius; the curves show force against travel.
"""

import matplotlib.pyplot as plt
import torch

import torchsoft as ts
from torchsoft.plot.figures import snapshots

rubber = ts.KelvinVoigt(E=0.5e6, nu=0.45, rho=1100.0, tau=10e-3, depth=20e-3)
slip = ts.SmoothSlip(0.8, 0.7, v_s=0.05)
law = ts.SoftContact(K_n=2e5, R_n=200.0, K_t=2e5, R_t=200.0, friction=slip)
faces = {
    "block of 16 x 8 mm": ts.PadMesh(16e-3, 8e-3, 32, 8),
    "the same, face of 30 mm radius": ts.CurvedPadMesh(16e-3, 8e-3, 32, 8, radius=30e-3),
    "half-round fingertip of 8 mm": ts.FingertipMesh(radius=8e-3, elements_around=32),
}
t = torch.linspace(0, 0.5, 101, dtype=torch.float64)

_, axes = plt.subplots(figsize=(7, 4), layout="constrained")
for name, mesh in faces.items():
    high = float(mesh.nodes[:, 1].max())  # of the face over the base
    rig = ts.Rig(
        bodies={
            "finger": ts.Body(x=0.0, y="driven", theta=0.0),
            "rod": ts.Body(shape=ts.Circle(20e-3), x=0.0, y=high + 20e-3, theta=0.0),
        },
        pads={"tip": ts.Pad(mesh, rubber, base="finger", origin=(-8e-3, 0.0))},
        contacts={"tip": ts.Contact("tip", "rod", law, may_leave=True)},
    )
    y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
    press = ts.Reference(**{"finger.y": ts.Profile([0.0, 0.5], [0.0, 1e-3])})
    run = ts.simulate(rig, t, y0=y0, reference=press)
    force = run.force["tip"][..., 0].sum(-1)
    print(f"{name:32s} {force[-1]:6.1f} N at {1e3 * run['finger.y'][-1]:.1f} mm")
    axes.plot(1e3 * run["finger.y"], force, label=name)
axes.set(xlabel="travel of the base [mm]", ylabel="normal force [N]")
axes.legend()

figure = snapshots(run, times=(0.0, 0.5), title="The fingertip, before and after")
