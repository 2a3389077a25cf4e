"""The figure of `orientation.py`."""

from collections.abc import Callable
from typing import Any

import numpy as np
from _orientation_cases import DEGREES, GRIPPED, MM, Outcome, errors
from _orientation_result import DISC, KINEMATICS, Result, angle_of
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchsoft.plot.figures import ACTUAL, DESIRED, OTHER, STYLE, timeline

BOXED: dict[str, Any] = {"frameon": True, "facecolor": "white", "edgecolor": "none", "framealpha": 1.0}
"""Of legends that lie on lines."""


def limits(axes: Axes, value: float, label: str) -> None:
    axes.axhline(value, color="#cc3311", ls=":", lw=1.0, label=label)


@rc_context(STYLE)
def figure(result: Result) -> Figure:
    """Errors over time, and over speed, friction and shape in parts of the tolerance."""
    c = result.config
    fig = Figure(figsize=(13, 7.5), layout="constrained")
    (centre, angle, bars), (speed, friction, opening) = fig.subplots(2, 3)

    def part(one: Outcome) -> float:
        return max(one.position_mm / c.position_mm, one.angle_deg / c.angle_deg)

    for axes, which, unit, most in ((centre, 0, "mm", c.position_mm), (angle, 1, "deg", c.angle_deg)):
        for name, colour in ((KINEMATICS, OTHER), (DISC, ACTUAL)):
            case, done = result.runs[name]
            t = timeline(axes, f"error [{unit}]", done)
            axes.plot(t, errors(case, done)[which], color=colour, label="loops" if name == DISC else "rigid kinematics")
        limits(axes, most, "tolerance")
        axes.set_xlabel("time [s]")
    limits(angle, -c.angle_deg, "")
    centre.set(title="a) disc: centre off its place", ylim=(0.0, 1.3 * c.position_mm))
    angle.set_title("b) disc: orientation off its set-point")
    angle.legend(loc="center right")

    names = list(result.rigid)
    place = np.arange(len(names))
    columns: tuple[tuple[str, str, Callable[[str], float | None]], ...] = (
        ("rigid statics, $F/K_p$", DESIRED, lambda name: angle_of(result, name) or None),
        ("loops alone", ACTUAL, lambda name: result.alone[name].angle_deg),
        ("efforts fed forward", OTHER, lambda name: result.known[name].angle_deg if name in result.known else None),
    )
    for i, (label, colour, value) in enumerate(columns):
        bars.bar(place + 0.27 * (i - 1), [value(name) or 0.0 for name in names], 0.25, color=colour, label=label)
    for i, name in enumerate(names):
        if result.alone[name].stopped:
            bars.text(i + 0.02, 1.15 * result.alone[name].angle_deg, "lost", ha="center", color="#cc3311", size=9)
    limits(bars, c.angle_deg, "tolerance")
    bars.set_xticks(place, [name.replace(" ", "\n", 1) for name in names])
    bars.set(yscale="log", ylabel="largest error of theta [deg]", title="c) other shapes", ylim=(0.001, 100.0))
    bars.legend(loc="upper left", ncols=2)

    fast = list(result.speeds)
    speed.loglog(fast, [one.position_mm for one in result.speeds.values()], "o-", color=ACTUAL, label="centre [mm]")
    speed.loglog(fast, [result.lags[s][0] for s in fast], color=ACTUAL, ls="--", lw=0.9, label="$a/\\omega^2$ [mm]")
    speed.loglog(fast, [one.angle_deg for one in result.speeds.values()], "s-", color=OTHER, label="theta [deg]")
    speed.loglog(fast, [result.lags[s][1] for s in fast], color=OTHER, ls="--", lw=0.9, label="$a/\\omega^2$ [deg]")
    speed.axhline(c.position_mm, color=ACTUAL, ls=":", lw=1.0)
    speed.axhline(c.angle_deg, color=OTHER, ls=":", lw=1.0)
    speed.set_xticks(fast, [f"{s:g}" for s in fast])
    speed.minorticks_off()
    speed.set(xlabel="times as fast", ylabel="largest error", title="d) disc: speed (dotted: tolerances)")
    speed.legend(loc="lower right", **BOXED)

    aspect = f"ellipse {c.slipping_aspect:g}"
    swept = [
        (f"disc, {c.disc_speed:g} times as fast", result.disc_frictions, [result.turning, result.carrying], ACTUAL)
    ]
    if result.frictions:
        swept.append((f"{aspect}, fed forward", result.frictions, [result.rigid[aspect].friction], OTHER))
    for label, outcomes, cones, colour in swept:
        mus = sorted(outcomes)
        friction.loglog(mus, [part(outcomes[mu]) for mu in mus], color=colour, label=label)
        for mu in mus:
            lost = bool(outcomes[mu].stopped)
            friction.plot(mu, part(outcomes[mu]), "X" if lost else "o", color=colour, ms=8 if lost else 5)
        for cone in cones:
            friction.axvline(cone, color=colour, ls="--", lw=1.0)
    friction.plot([], [], "X", color=DESIRED, ms=8, label="lost")
    friction.plot([], [], color=DESIRED, ls="--", lw=1.0, label="friction cones, rigid")
    limits(friction, 1.0, "tolerance")
    friction.set(xlabel="coefficient of friction", ylabel="largest error over its tolerance", title="e) friction")
    friction.legend(loc="lower left", **BOXED)

    for name, colour in zip([name for name in names if name != DISC], (ACTUAL, OTHER, "#009988", "#ee3377")):
        _, done = result.runs[name]
        later = done.t >= GRIPPED
        apart = MM * (done["y_upper"] - done["y_lower"]).detach()[later].numpy()
        turned = DEGREES * done["theta_disc"].detach()[later].numpy()
        opening.plot(turned, apart, color=colour, label=name + (" (lost)" if result.alone[name].stopped else ""))
    opening.set(xlabel="theta [deg]", ylabel="distance of the jaws [mm]", title="f) the jaws give way")
    opening.legend()
    return fig
