"""
A reduced model
===============

How few terms describe the disc in the grip? pysindy fits the terms of mechanics to small impulses
of a settled grasp; the equations then predict a motion that was held out.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import Profile, Reference, RigFile, simulate
from torchsoft.physics.motion import Waves, wave
from torchsoft.reduced import Recipe, Record, assemble, fit, mechanics, record, rollout_of, score

file = RigFile.ready("paper").override({"motion.x_d": {"kind": "hold"}})  # grasped, not rolled
rig = file.build().rig
held = {name: Profile([0.0], file.motion[name].values[-1:]) for name in ("y_d", "F_ff")}
begin = file.build().run([0.0, 1.0]).y[-1]


def impulse(seed: int, size: float, end: float) -> Record:
    """A record of the settled grasp under a multi-sine of the set-point about where it is."""
    torch.manual_seed(seed)
    f = torch.logspace(0.5, 2.1, 10).tolist()
    sines = wave([size] * 10, f, [0.0] * 10, (6.28 * torch.rand(10)).tolist())
    y = begin.clone()
    for body, kick in (("disc", [2e-3, 0.0, 0.1]), ("bracket", [2e-3, 0.0])):
        at = rig.layout.slices["velocity", body]
        y[at] += (torch.randn(len(kick)) * torch.tensor(kick)).double()
    t = torch.arange(0, end, 2.5e-4, dtype=torch.float64)
    reference = Reference(x_d=Waves(([0.0], [60e-3]), -1.0, end + 1.0, sines), **held)
    return record(simulate(rig, t, y0=y, reference=reference, step=2.5e-4))


impulses = [impulse(seed, 3e-6, 0.3) for seed in range(8)]
K, R = file.actuators["x"].Kp, file.actuators["x"].Kd
law = {"F_x": {"x_d": K, "x_d_dot": R, "x_C": -K, "v_C": -R}}  # Eq. 33, 34
recipe = Recipe(threshold=0.05, width=0.004, window=0.3)
reduced = fit(assemble(impulses, mechanics(r=18.35e-3), recipe), recipe, law)
print(reduced)

other = impulse(99, 6e-6, 0.3)
out = rollout_of(reduced, other)
print(f"held out: within {score(reduced, other).worst:.2%} of the range, {1e3 * out.wall_s:.1f} ms")
plt.figure(figsize=(7, 3), layout="constrained")
plt.plot(other.t, 1e6 * other.series["x_C"], label="full model")
plt.plot(out.t, 1e6 * out.y[:, 0], "--", label="reduced model")
plt.gca().set(xlabel="time [s]", ylabel="x of the disc [µm]")
plt.legend()
plt.show()
