"""
Rubber at finite strain
=======================

When are linear pads too soft? A layer of rubber that is compressed by a sixth of its height is
stiffer than linear theory predicts. The same grasp is run with linear and with neo-Hookean pads.
"""

import matplotlib.pyplot as plt
import torch

from torchsoft import RigFile

coarse = {f"pads.{pad}.elements_{axis}": n for pad in "LU" for axis, n in (("x", 80), ("y", 3))}
file = RigFile.ready("paper").override({
    **coarse, "motion.F_ff": {"kind": "hold", "value": 0.0},
    "motion.y_d": {"kind": "profile", "offset": "start", "times": [0, 0.5], "values": [0, -1.6e-3]},
})  # fmt: skip
t = torch.linspace(0, 0.5, 101, dtype=torch.float64)
runs = {}
for kind in ("kelvin_voigt", "neo_hookean"):
    rubber = {"kind": kind, "E": 0.75e6, "nu": 0.45, "tau": 10e-3, "depth": 44e-3}
    runs[kind] = file.override({"materials.rubber": rubber}).build().run(t, rtol=1e-4)

_, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for kind, run in runs.items():
    way = 1e3 * (run["y_Br"][0] - run["y_Br"]) / 2  # of each pad, about
    force = run.force["U"][..., 0].sum(-1)
    left.plot(way, force, label=kind)
    print(f"{kind}: {force[-1]:.1f} N at the end, {run.stats.wall_s:.2f} s")
left.set(xlabel="indentation of each pad [mm]", ylabel="grip [N]")
left.legend()

# Cauchy's stress through the lower pad under the middle of the disc
run = runs["neo_hookean"]
pad = run.setup.pads["L"]
whole = pad.displacement(run.displacement["L"][-1].numpy())
stress = 1e-3 * pad.stress(whole)[:, 1]
centres = 1e3 * (pad.mesh.nodes + whole)[pad.mesh.elements].mean(1)
shown = right.tripcolor(*centres.T, stress, cmap="viridis")
right.set(xlim=(48, 72), xlabel="x [mm]", ylabel="y [mm]", title="vertical stress [kPa]")
plt.colorbar(shown)
plt.show()
