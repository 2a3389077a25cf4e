"""
A rig from a file
=================

What does an ellipse do that falls askew onto a soft pad? The rig is one of the ready files in
``rigs/``; ``torchsoft run rigs/drop.toml`` does the same without any Python.
"""

from pathlib import Path

import matplotlib.pyplot as plt

from torchsoft import simulate
from torchsoft.plot.figures import snapshots
from torchsoft.rigs import RigFile

folder = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "rigs" / "drop.toml").exists())
file = RigFile.from_toml(folder / "rigs" / "drop.toml")
print(file.title)

# every field of the file can be replaced; units, bounds and names are checked again
file = file.override(outputs={"duration": 0.5, "interval": 2e-3, "snapshots": []})
ready = file.build()  # the rig, its state at the start, the times of the outputs
run = simulate(ready.rig, ready.t, y0=ready.y0)
figure = snapshots(run, times=(0.0, 0.06, 0.12), title="The fall")

softer = file.override(materials={"gel": {"E": 5e4}}).build()
soft_run = simulate(softer.rig, softer.t, y0=softer.y0)

_, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for name, one in (("as in the file", run), ("E = 50 kPa", soft_run)):
    axes.plot(1e3 * one.t, 1e3 * one["y_ellipse"], label=name)
axes.set(xlabel="time [ms]", ylabel="height of the centre [mm]")
axes.legend()
plt.show()
