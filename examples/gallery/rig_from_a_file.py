"""
A rig from a file
=================

How does a tilted ellipse fall onto a soft pad? The rig is one of the ready files;
``torchsoft run drop`` does the same on the command line.
"""

import matplotlib.pyplot as plt

from torchsoft import RigFile
from torchsoft.plot.figures import snapshots

file = RigFile.ready("drop")
print(file.title)

# every field of the file can be replaced; units, bounds and names are checked again
file = file.override(outputs={"duration": 0.5, "interval": 2e-3, "snapshots": []})
run = file.build().run()
figure = snapshots(run, times=(0.0, 0.06, 0.12), title="The fall")

softer = file.override({"materials.gel.E": 5e4}).build().run()

_, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for name, one in (("as in the file", run), ("E = 50 kPa", softer)):
    axes.plot(1e3 * one.t, 1e3 * one["y_ellipse"], label=name)
axes.set(xlabel="time [ms]", ylabel="height of the centre [mm]")
axes.legend()
plt.show()
