"""
Identification from a CSV file
==============================

How stiff are the pads of a rig, and how large is their friction? The recording is a CSV file with
units in the headings. A few lines of TOML state what is unknown; estimates come with intervals.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from torchsoft.sysid import identify
from torchsoft.sysid.measured import load

here = Path("examples") / "identify"  # in the repository
folder = next((p / here for p in (Path.cwd(), *Path.cwd().parents) if (p / here).exists()), here)
print((folder / "rolling.csv").read_text(encoding="utf-8").splitlines()[0])

question = """
rig = "paper"
[settings]                       # fields of the rig file that differ
actuators.x.measures = "bracket.x"
bodies.disc.start.x = 60.3e-3
bodies.bracket.start.x = 60.3e-3
laws.steel_on_rubber = {K_n = 1.6e5, R_t = 300.0, friction = {v_s = 0.05, mu_k = 0.5}}
[unknowns]                       # where the search starts
"materials.rubber.E" = {nominal = 0.45e6}
"materials.rubber.tau" = {nominal = 20e-3}
"laws.steel_on_rubber.friction.mu_s" = {nominal = 0.9, low = 0.5}
[sensors]                        # standard deviation of the noise
x_C.noise = 10e-6
theta.noise = 0.5e-3
F_y.noise = 0.1
"""
config = Path(tempfile.mkdtemp()) / "question.toml"
config.write_text(question, encoding="utf-8")

case = load([folder / "rolling.csv"], config)
result = identify(case.problem, rtol=1e-4, assumptions="trusted")
print(result.table())
print("truth:  E 900000,  tau 0.012,  mu_s 0.6")

recording = case.problem.recordings[0]
_, axes = plt.subplots(figsize=(7, 3), layout="constrained")
t, x = recording.samples["theta_C"]
axes.plot(t, x, ".", ms=2)
axes.set(xlabel="time [s]", ylabel="recorded angle [rad]")
plt.show()
