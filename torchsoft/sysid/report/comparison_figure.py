"""The picture of a comparison of laws: where in the motion the evidence against the others comes from."""

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from torchsoft.plot.figures import ACTUAL, OTHER, STYLE
from torchsoft.sysid.answer.comparison import Comparison, Series, Versus
from torchsoft.sysid.report.figures import literal

MOST = 4
"""Recordings that are shown, those with most of the evidence first."""


@rc_context(STYLE)
def plot(comparison: Comparison, other: str | None = None) -> Figure:
    """The evidence against `other` (by default the law next to the best) as it grows along each recording, in all and by the
    channels that tell most, and both laws' residuals of the channel that tells most. Raises `ValueError` for a law that was
    not compared with the best, and where the residuals have not been kept."""
    chosen = [v for v in comparison.against if other in (None, v.other)]
    if not chosen:
        raise ValueError(
            f"the best law was not compared with `{other}`, but with {', '.join(v.other for v in comparison.against)}"
        )
    if not comparison.series:
        raise ValueError(
            "the comparison was kept without its residuals, so there is nothing to draw: compare once more"
        )
    versus = min(chosen, key=lambda v: v.evidence)
    by_recording: dict[str, list[Series]] = {}
    for one in comparison.series:
        by_recording.setdefault(one.recording, []).append(one)
    names = sorted(by_recording, key=lambda name: -sum(growth(s, versus)[-1] for s in by_recording[name]))[:MOST]
    figure = Figure(figsize=(10.5, 0.9 + 2.6 * len(names)), layout="constrained")
    figure.suptitle(literal(f"{versus.best} against {versus.other}: {versus.evidence:.3g} nats, z = {versus.z:.2g}"))
    for (left, right), name in zip(figure.subplots(len(names), 2, squeeze=False, sharex="row"), names):
        told = sorted(by_recording[name], key=lambda s: -abs(growth(s, versus)[-1]))
        t = np.unique(np.concatenate([s.t for s in told]))
        left.plot(t, sum(np.interp(t, s.t, growth(s, versus)) for s in told), color="k", lw=2, label="all")
        for s in told[:3]:
            left.plot(s.t, growth(s, versus), lw=1, label=s.channel)
        held = "" if told[0].fitted else ", held out"
        left.set_title(literal(f"evidence against {versus.other} in {name}{held} [nats]"))
        left.legend(loc="upper left")
        for law, colour in ((versus.other, OTHER), (versus.best, ACTUAL)):
            right.plot(told[0].t, told[0].residuals[law], ".-", color=colour, lw=0.6, ms=3, label=literal(law))
        right.set_title(f"residual over noise in {told[0].channel}")
        right.legend()
        for axes in (left, right):
            axes.set(xlabel="time [s]", xlim=(t[0], t[-1]))
    return figure


def growth(s: Series, versus: Versus) -> np.ndarray:
    """Evidence up to each sample [nats]."""
    a, b = (np.array(s.residuals[law]) for law in (versus.best, versus.other))
    return np.cumsum(0.5 * (b**2 - a**2))
