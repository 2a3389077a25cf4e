"""
A rubber from a relaxation test
===============================

How much force does a grasp lose over time? A test with a step of strain determines the Prony
series of the rubber, of which the pads are then made.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from torchsoft import Prony, RigFile
from torchsoft.materials.fit import fit
from torchsoft.materials.measured import Measured, read

# a file of a laboratory: 2 % of strain held from t = 0 on, stress with 0.5 % of noise
rng, seconds = np.random.default_rng(1), np.geomspace(1e-2, 30.0, 200)
modulus = 0.5e6 + 0.2e6 * np.exp(-seconds / 0.1) + 0.15e6 * np.exp(-seconds / 2.0)
stress = 0.02 * modulus * (1 + 0.005 * rng.standard_normal(200))
path = Path(tempfile.mkdtemp()) / "relaxation.csv"
rows = [f"{a:.6g},2,{1e-3 * b:.6g}" for a, b in zip(seconds, stress)]
path.write_text("\n".join(["t [s],strain [%],stress [kPa]", *rows]), encoding="utf-8")

test = read(path)
assert isinstance(test, Measured)
found = fit(test)
for name, value in found.values.items():
    print(f"{name:6s} = {value:10.4g}  +- {found.sd[name] / value:.1%}")
rubber = found.material(nu=0.45, rho=1100.0, depth=44e-3)
assert isinstance(rubber, Prony)

# the same grasp with that rubber, held for ten seconds
file = RigFile.ready("paper").override({
    "control.senses": "bracket.x", "motion.x_d": {"kind": "hold"},
    "motion.F_ff": {"kind": "hold", "value": 0.0},
    "motion.y_d": {"kind": "profile", "offset": "start", "times": [0, 0.1], "values": [0, -1.5e-3]},
})  # fmt: skip
t = torch.cat((torch.zeros(1), torch.logspace(-2, 1, 150))).double()
run = file.build({"materials.rubber": rubber}).run(t)
force = run.force["U"][..., 0].sum(-1)
print(f"peak of {force.max():.1f} N, {force[-1]:.1f} N after {t[-1]:.0f} s")

_, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.semilogx(seconds, 1e-3 * stress, ".", ms=3, label="test")
left.semilogx(seconds, 1e-3 * found.fitted, label=f"fit of {found.terms} terms")
left.set(xlabel="time [s]", ylabel="stress [kPa]")
left.legend()
right.semilogx(t[1:], force[1:])
right.set(xlabel="time [s]", ylabel="grip [N]")
plt.show()
