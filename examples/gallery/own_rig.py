"""
A rig built in Python
=====================

How far does a disc roll when the pad above it is pushed? Two pads are driven along a path, a disc
lies between them and is moved by friction. There is no controller, and one gradient at the end.
"""

import torch

import torchsoft as ts
from torchsoft.plot.figures import snapshots

# parts: a rubber, a contact law, two pads, and three bodies, two of which are driven
rubber = ts.KelvinVoigt(E=0.75e6, nu=0.45, rho=1100.0, tau=10e-3, depth=44e-3)
law = ts.SoftContact(
    K_n=1.2e5, R_n=440.0, K_t=1.2e5, R_t=440.0, friction=ts.SmoothSlip(0.8, 0.7, v_s=0.05)
)
mesh = ts.PadMesh(length=60e-3, height=4.59e-3, elements_x=60, elements_y=3)
driven = {"x": "driven", "y": "driven", "theta": 0.0}
rig = ts.Rig(
    bodies={
        "disc": ts.Body(0.4065, ts.Circle(19.37e-3)),
        "lower": ts.Body(**driven),
        "upper": ts.Body(**driven),
    },
    pads={
        "below": ts.Pad(mesh, rubber, base="lower", origin=(-30e-3, 0.0)),
        "above": ts.Pad(mesh, rubber, base="upper", origin=(-30e-3, 0.0), mirrored=True),
    },
    contacts={"below": ts.Contact("below", "disc", law), "above": ts.Contact("above", "disc", law)},
    groups={"rubber": rubber, "contact": law},  # names of shared parts: rubber.E, contact.K_n
)

# motion: press by 1 mm, then push the upper pad 10 mm to the right
motion = ts.Reference(**{
    "lower.x": ts.Profile([0.0], [0.0]), "lower.y": ts.Profile([0.0], [0.0]),
    "upper.x": ts.Profile([0.1, 0.5], [0.0, 10e-3]),
    "upper.y": ts.Profile([0.0, 0.1], [47.92e-3, 46.92e-3]),
})  # fmt: skip

y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
y0[rig.layout.slices["pose", "disc"]] = torch.tensor([3e-4, 23.94e-3, 0.0], dtype=torch.float64)
t = torch.linspace(0, 0.6, 121, dtype=torch.float64)
run = ts.simulate(rig, t, y0=y0, reference=motion, gradient="discrete")

x, theta = run["x_disc"], run["theta_disc"]
print(f"the disc moves by {1e3 * (x[-1] - x[0]):.2f} mm and turns by {theta[-1]:.3f} rad")
theta[-1].backward()
print(f"a pad 1 % stiffer: {1e-2 * 0.75e6 * rig.parameter('rubber.E').grad:+.1e} rad more")

figure = snapshots(run, times=(0.0, 0.3, 0.6), title="Pressed, then rolled")
