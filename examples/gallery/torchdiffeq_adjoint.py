"""
With torchdiffeq
================

Can the model be used in a program that is built on torchdiffeq? A rig is a right-hand side f(t, y)
for ``odeint``, ``odeint_adjoint`` differentiates it, and the stepper is one of the methods.
"""

import time

import matplotlib.pyplot as plt
import torch
from torchdiffeq import odeint, odeint_adjoint

from torchsoft import RigFile, register_method, simulate

coarse = {"pad.elements_x": 40, "pad.elements_y": 2}
model = RigFile.ready("paper").override(coarse).build().rig
bracket = {"x": 60e-3, "y": 48.6e-3, "v_y": -0.01}  # its pad grips the disc, without friction yet
y0 = model.state(disc={"x": 60e-3, "y": "rest"}, bracket=bracket).detach()
t = torch.linspace(0, 4e-4, 3, dtype=torch.float64)
height = model.layout.slices["pose", "bracket"].start + 1  # of the bracket, in the flat state

with torch.no_grad():
    print(f"rates of {model.layout.size} states: {tuple(model(t[0], y0).shape)}")


walls = {}


def timed(name: str, solve) -> None:
    model.zero_grad()
    began = time.perf_counter()
    y = solve()
    (1e9 * y[-1, height]).backward()
    slope = float(model.parameter("contact.K_n").grad) * 1.2e5
    wall = time.perf_counter() - began
    moved = 1e9 * float((y[-1, height] - y0[height]).detach())
    print(f"{name:20s} moved by {moved:.0f} nm, d/d ln(K_n) {slope:+.0f} nm, {wall:.2f} s")
    walls[name] = wall


register_method()  # adds the stepper to torchdiffeq's methods
parameters = tuple(p for name, p in model.named_parameters() if not name.startswith("reference."))
timed(
    "odeint_adjoint, sdirk2",
    lambda: odeint_adjoint(
        model, y0, t, method="sdirk2", rtol=1e-7, atol=1e-8, adjoint_params=parameters
    ),
)
timed("odeint, sdirk2", lambda: odeint(model, y0, t, method="sdirk2", rtol=1e-7, atol=1e-8))
timed("simulate, discrete", lambda: simulate(model, t, y0=y0, rtol=1e-7, gradient="discrete").y)

plt.figure(figsize=(6, 2), layout="constrained")
plt.barh(list(walls), list(walls.values()))
plt.gca().set(xscale="log", xlabel="value and gradient over 0.4 ms [s]")
plt.show()
