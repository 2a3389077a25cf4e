"""A designed motion in one picture: set-points before and after, standard deviations, and the criterion as it went."""

from typing import Any

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure

from torchsoft.plot.figures import ACTUAL, DESIRED, OTHER, STYLE
from torchsoft.sysid.design.design import Design
from torchsoft.sysid.report.figures import SHOWN


@rc_context(STYLE)
def design_figure(design: Design) -> Figure:
    """The signals whose knots moved, above; relative standard deviations and the criterion below."""
    names, bounds = tuple(design.made_by["bounds"]), design.made_by["bounds"]
    figure = Figure(figsize=(9.0, 1.8 * len(names) + 3.2), layout="constrained")
    panels: Any = figure.subfigures(2, 1, height_ratios=(1.8 * len(names), 3.2))
    above, below = panels
    t = np.linspace(design.recording.times[0], design.recording.times[-1], 2000)
    for ax, name in zip(above.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0], names):
        shown, scale = SHOWN.get(own := design.recording.units[name], (own, 1.0))
        for one, colour, label in ((design.given, DESIRED, "given"), (design.recording, ACTUAL, "designed")):
            signal = one.rig.reference(torch.from_numpy(t), [name])[:, 0, 0].detach().numpy()
            ax.plot(t, scale * signal, color=colour, label=label)
        for end in ("low", "high"):
            ax.axhline(scale * bounds[name][end], color=OTHER, lw=0.8, ls=":")
        ax.set_ylabel(f"{name} [{shown}]")
    above.axes[0].legend(loc="upper right", ncols=2)
    above.axes[-1].set_xlabel("time [s]")
    left, right = below.subplots(1, 2, width_ratios=(3, 2))
    at = np.arange(len(design.before))
    for offset, sds, colour in ((-0.2, design.before, DESIRED), (0.2, design.after, ACTUAL)):
        left.bar(at + offset, [100 * sd for sd in sds.values()], 0.38, color=colour)
    left.set_yscale("log")
    left.set_xticks(at, [name.split(".")[-1] for name in design.before])
    left.set_ylabel("standard deviation [%]")
    right.plot([v.iteration for v in design.history], [v.value for v in design.history], "o-", color=ACTUAL, ms=3)
    right.set(xlabel="iteration", ylabel=f"criterion {design.made_by['criterion']}")
    return figure
