"""
The paper's manipulation
========================

How does the contact force spread over the pads while the disc rolls? A disc is grasped between two
rubber pads and rolled by 20 mm; the picture shows the force on every node in contact at 5 s.
"""

from torchsoft import RigFile

run = RigFile.ready("paper").build().run()  # the rig of the paper, along its motion of 30 s

for time in (0, 10, 30):
    print(f"t = {time:2d} s: x_C = {1e3 * run['x_C'][run.at(time)]:.3f} mm")
print(f"the disc turns by {run['theta'][run.at(10)]:.3f} rad")

figure = run.plot(time=5.0, only=("scene", "contact U", "contact L"))
