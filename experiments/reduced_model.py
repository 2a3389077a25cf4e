"""Question: how small can an ordinary differential equation for disc and bracket be, and where does it stop being enough?

Stick. Both pads stick to the disc: each is a spring k and a dashpot c on its slip (`torchsoft.reduced.terms`), so that
    m x_C''     =  k (x_Br - 2 x_C) + c (...)'
    I theta''   = -r [k (x_Br + 2 r theta) + c (...)'] - c_r theta'
    m_Br x_Br'' =  F_x - k (x_Br - x_C + r theta) - c (...)'
with F_x known from the control law. What mechanics expects of k, c, r and c_r is computed from the full model, linearised in
the grasp: pads and stretches condensed at rest ("static"), and, because that condensation is not quite a spring and a dashpot
at every frequency, the same regression on the linearised full model under the same motions ("in band"). Slow rolling does not
excite k and c (m x_C'' is nothing), so the training motions are taps: small random velocities of disc and bracket and a broad
multi-sine, some micrometres large. The radius comes from one roll to the other side. Held out: the paper's manipulation.

Slip. A light grasp, the horizontal loop on the bracket, strokes ever faster: the disc rolls on the lower pad and the upper one
slips. Then F_U = mu_k N_U + eta n s_U' and x_C = -r theta, so that x_C'' = 2 F_U / (m + I / r^2). Held out: other strokes.

Errors are root mean squares over the signal's range, worst of the six states; `summary.json` has those over the standard
deviation as well.

Command: .venv/bin/python experiments/reduced_model.py [--smoke]
Expected: stick: 8 terms, the very ones above; held-out error 0.3 % of range (node transitions in the spin), more than 100 times
faster than the full model; k, c and the masses within 10 % of the static expectation but for the spin's k (-14 %) and c_r
(-18 %), all within 4 % of that in band. Noise up to 5 % leaves the rollouts as they are and spoils the spin's coefficients
first. Slip: 5 terms, 1 % up to 80 m/s2, 4 % at 300 m/s2, where the normal force is no longer that of the training strokes; 7 %
in a grasp of another depth, which is another mode. Two minutes on one core.
"""

from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
from _reduced_common import Config, smoke
from _reduced_gain import study_gain
from _reduced_slip import study_slip
from _reduced_stick import study_stick
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from torchsoft.experiment import made_by, markdown, options, write
from torchsoft.files import finite
from torchsoft.reduced.records import STATES


@dataclass(frozen=True)
class Result:
    config: Config
    stick: dict[str, Any]
    slip: dict[str, Any]
    gain: dict[str, Any]
    traces: dict[str, Any] = field(repr=False)


def run(config: Config) -> Result:
    config = smoke(config) if config.smoke else config
    bar = tqdm(total=12, unit="part")
    stick, traces, grasp, A, model = study_stick(config, bar)
    gain = study_gain(config, grasp, A, model, bar)
    slip, more = study_slip(config, bar)
    bar.close()
    return Result(config, stick, slip, gain, {"stick": traces, "slip": more})


def summary(result: Result) -> dict[str, Any]:
    made = made_by(result.config, pysindy=version("pysindy"), seed=result.config.seed)
    return finite({"stick": result.stick, "slip": result.slip, "gain_sweep": result.gain, "made_by": made})


def table(result: Result) -> str:
    """Markdown: both regimes, and the coefficients beside mechanics."""
    regimes = [
        (name, one["terms"], f"{one['heldout_nrmse']:.2%}", f"{one['speedup']:.0f} x")
        for name, one in (("stick", result.stick), ("slip", result.slip))
    ]
    rows = []
    for row in result.stick["coefficients"]:
        low, high = row["interval"]
        static = ("-", "-") if row["expected"] is None else (f"{row['expected']:.4g}", f"{row['error']:+.1%}")
        banded = f"{row['expected_in_band']:.4g}", f"{row['error_in_band']:+.1%}"
        found = f"{row['value']:.4g}", f"{low:.4g} to {high:.4g}"
        rows.append((f"{row['equation']}'", row["term"], *found, *static, *banded))
    head = ("equation", "term", "found", "5 to 95 %", "static", "error", "in band", "error")
    return markdown(("regime", "terms", "held-out NRMSE", "speed-up"), regimes) + "\n\n" + markdown(head, rows)


def figure(result: Result) -> Figure:
    """Held-out manipulation, its error, the choice of the threshold; coefficients, slip, gain sweep."""
    fig = Figure(figsize=(15, 8.5), layout="constrained")
    (a, b, c), (d, e, f) = fig.subplots(2, 3)
    held, out = result.traces["stick"]["held"], result.traces["stick"]["rollout"]
    shown = (("x_C", 1e3, "mm"), ("x_Br", 1e3, "mm"), ("theta", 10.0, "0.1 rad"))
    for i, (name, size, unit) in enumerate(shown):
        a.plot(held.t, size * held.series[name], f"C{i}", lw=3, alpha=0.35)
        a.plot(held.t, size * out.y[:, STATES.index(name)], f"C{i}--", lw=1, label=f"{name} [{unit}]")
    a.set(xlabel="time [s]", title="Stick: held out; wide full, dashed reduced")
    a.legend()
    for i, name in enumerate(STATES):
        scale = np.ptp(held.series[name])
        b.plot(held.t, 100 * (out.y[:, i] - held.series[name]) / scale, lw=0.7, label=name)
    b.set(xlabel="time [s]", ylabel="error over range [%]", title="Stick: error of the held-out rollout")
    b.legend(ncols=3, fontsize="small")
    tried = [row for row in result.stick["thresholds"] if np.isfinite(row["nrmse"])]
    c.semilogy([row["terms"] for row in tried], [100 * row["nrmse"] for row in tried], ".", color="0.6", label="tried")
    chosen = {"mfc": "none", "ms": 12, "color": "C3", "label": "chosen"}
    c.semilogy(result.stick["terms"], 100 * result.stick["validation_nrmse"], "o", **chosen)
    c.set(xlabel="terms", ylabel="NRMSE of validation rollouts [%]", title="Stick: thresholds by rollout error")
    c.legend()
    rows = [row for row in result.stick["coefficients"] if row["expected"]]
    for i, row in enumerate(rows):
        low, high = sorted(x / row["expected"] for x in row["interval"])
        d.plot([low, high], [i, i], "C0", lw=3, alpha=0.5)
        d.plot(row["value"] / row["expected"], i, "oC0", label="found" if i == 0 else None)
        d.plot(row["expected_in_band"] / row["expected"], i, "xC1", label="expected in band" if i == 0 else None)
    d.axvspan(0.9, 1.1, color="0.92", zorder=0)
    d.axvline(1.0, color="k", lw=0.8)
    d.set_yticks(range(len(rows)), [f"{row['equation']}': {row['term']}" for row in rows])
    d.invert_yaxis()
    d.set(xlabel="over the static expectation", title="Stick: coefficients and mechanics")
    d.legend(loc="best", fontsize="small")
    by = result.slip["by_stroke"]
    acceleration = [row["acceleration_m_s2"] for row in by]
    e.loglog(
        acceleration, [100 * row["nrmse"] for row in by], "o-C0", label=f"with friction, {result.slip['terms']} terms"
    )
    linear = [row["nrmse_linear"] for row in by]
    e.loglog(acceleration, [100 * min(x, 10.0) for x in linear], "s-C1", label="its limit for small slip (linear)")
    deep = result.slip["another_grasp"]
    e.axhline(100 * min(deep["nrmse"], 10.0), color="C3", ls=":", label=f"same, grasp of {deep['depth_mm']:.2g} mm")
    e.set(
        xlabel="peak acceleration of the bracket [m/s$^2$]", ylabel="NRMSE [%]", title="Slip: rollouts of other strokes"
    )
    part = e.twinx()
    part.fill_between(acceleration, [100 * row["slipping"] for row in by], color="0.5", alpha=0.2, lw=0)
    part.set(ylabel="slipping nodes of the upper pad [%] (grey)", ylim=(0, 100))
    e.set_zorder(part.get_zorder() + 1)
    e.patch.set_visible(False)
    e.legend(loc="upper left", fontsize="small")
    sweep = result.gain["sweep"]
    f.semilogx([row["R_80"] for row in sweep], [row["growth_1_s"] for row in sweep], "C0", label="reduced")
    f.axhline(0.0, color="k", lw=0.8)
    for i, row in enumerate(result.gain["confirmed"]):
        label = None if i else "full, linearised\n(filled: dies out in a run)"
        f.plot(row["R_80"], row["growth_full_1_s"], "oC3", mfc="C3" if row["full_dies_out"] else "w", label=label)
    f.set(
        xlabel="gain $R_{80}$ [N s/m]", ylabel="growth of the slowest mode [1/s]", title="Gain sweep", ylim=(None, 30)
    )
    f.legend(fontsize="small", loc="upper center")
    return fig


def main() -> None:
    config = options(Config, __doc__)
    with threadpool_limits(1):  # what is timed, is timed on one core
        result = run(config)
    print("\n" + table(result) + "\n")
    print("\n".join(["stick:", *result.stick["equations"], "", "slip:", *result.slip["equations"]]))
    write(result.config.out, summary(result), {"reduced_model": figure(result)})


if __name__ == "__main__":
    main()
