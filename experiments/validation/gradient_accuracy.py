"""Question: how exact are the four routes to a gradient, in every contact mode, and what do they cost?

The loss over a window of outputs t_k is L = mean over k and i of (1/2 + (t_k - t_0)/(t_T - t_0)) (z_ki + z_ki^2 / 2), with
z = (q - mean q) / std q of the nominal run, constants both, and q = (x_C, y_C, theta, v_C, omega, x_Br, y_Br, F_x, F_y).
dL/dp for every scalar parameter p, the state at t_0 held, comes from
  discrete     the discrete adjoint of the implicit stepper,
  forward      forward sensitivities of the same steps, contracted with dL/dy,
  unrolled     backpropagation through the plain torch step,
  continuous   `torchdiffeq.odeint_adjoint` with dopri5 on the right-hand side,
and is judged by central differences D(d) = (L(p + d) - L(p - d)) / 2d of the stepper at a Newton tolerance of 1e-10 N. Each
neighbouring pair of relative steps d gives a Richardson value; the three in a row that agree best are the plateau, and their
spread is the judge's own uncertainty. No gradient is looked at to choose the step.

Windows: `stick` (gentle rolling in the grasp), `slip` (a 2 mm stroke in 20 ms with mu_s = 0.3, mu_k = 0.2, v_s = 50 mm/s),
`make-break` (rolling at 4.4 mm/s), `grasp` (the bracket coming down from 20 um above touching) and `full` (the 30 s
manipulation). The unrolled and the continuous route are slow, so they are run over a sub-window of a few steps about
the window's first event, against central differences over that sub-window; the continuous one solves the ODE and not the
steps, so it is compared with the discrete adjoint at a step of 1 us.

Further: the literal Coulomb law, whose force jumps at break-away unless mu_s = mu_k; dL/dp through slip as the step is
refined; d omega / d K_n before and after a node touches; and a window that starts at `rest`, where the upper pad's gap is
exactly zero and central differences straddle the kink.

Command: .venv/bin/python experiments/validation/gradient_accuracy.py [--smoke]
Expected, largest error of the discrete and forward routes among parameters whose central difference is itself known to 1e-6:
6e-7 in each of the short windows, 6e-6 over 30 s and 180 node events; elsewhere within the judge's uncertainty. Unrolled equals
discrete to 3e-8. Backward at 0.3 to 0.8 of the forward run. Coulomb's law with mu_s > mu_k: the adjoint calls dL/dmu_s 0, the
loss falls with a slope of -0.105 +- 0.01; with mu_s = mu_k they agree to 2e-4. Through slip dL/dmu_s is 9 % off at 2 ms. About
seven minutes on one core.
"""

from dataclasses import dataclass
from typing import Any

import torch
from _gradient_limits import coulomb, from_rest, refinement, touch_down
from _gradients import FINER, RADIUS, Config, judge_window, smoke, windows
from matplotlib.figure import Figure
from tqdm import tqdm

from torchsoft.experiment import made_by, markdown, options
from torchsoft.experiment import write as write_files


@dataclass(frozen=True)
class Result:
    config: Config
    windows: dict[str, dict[str, Any]]
    coulomb: dict[str, Any]
    refinement: dict[str, Any]
    touch_down: dict[str, Any]
    rest: dict[str, Any]


def run(config: Config) -> Result:
    config = smoke(config) if config.smoke else config
    bar = tqdm(total=4 * 4 + 2 + 4, unit="part")
    every = windows(config)
    judged = {}
    for window in every:
        bar.set_description(window.name)
        judged[window.name] = judge_window(window, config, bar)
    rest = []
    for part in (coulomb, refinement, lambda c: touch_down(c, every[2]), from_rest):
        rest.append(part(config))
        bar.update()
    bar.close()
    return Result(config, judged, *rest)


def table(result: Result) -> str:
    """Markdown: per window and route the largest error and the cost; then the Coulomb bias and the convergence."""
    rows = []
    for name, window in result.windows.items():
        for route, errors in window["relative_error"].items():
            worst, cost = max(errors, key=lambda n: errors[n]), window["cost_ratio"][route]
            key = {"unrolled": "sub_window_events", "continuous": "continuous_events"}.get(route, "events")
            e, unsure = window[key], window["judge_uncertainty" + ("" if key == "events" else "_sub_window")]
            if route == "continuous":  # judged by the discrete adjoint
                unsure = dict.fromkeys(errors, 0.0)
            known = max((errors[n] for n in errors if unsure[n] <= 1e-6), default=float("nan"))
            counts = f"{e['touch']} / {e['leave']} / {e['slip_onsets']}"
            largest = f"{errors[worst]:.1e} ({worst}, {unsure[worst]:.0e})"
            rows.append(
                (name, counts, route, largest, f"{known:.1e}", f"{cost['gradient']:.2f}", f"{cost['total']:.2f}")
            )
    head = ("window", "touch / leave / slip onsets", "route", "largest error (parameter, judge's own uncertainty)",
            "largest where the judge knows 1e-6", "gradient / forward", "total / forward")  # fmt: skip
    tables = [markdown(head, rows)]
    rows = [
        (label, f"{c['adjoint']:.4g}", f"{c['slope']:.3g} +- {c['uncertainty']:.1g}",
         ", ".join(f"{x:.3g}" for x in c["slopes"]))
        for label, c in result.coulomb.items()
    ]  # fmt: skip
    tables.append(markdown(("Coulomb, literal: dL/dmu", "adjoint", "slope of L", "by width"), rows))
    refined = result.refinement["relative_error"]
    names = list(next(iter(refined.values())))
    rows = [(step, *(f"{errors[n]:.1e}" for n in names)) for step, errors in refined.items()]
    tables.append(markdown(("step [ms]", *names), rows))
    rows = [
        (label, f"{h:g}", f"{jump:.2f}", f"{end:.3g}", f"{before:.0e}", f"{after:.0e}")
        for label, row in result.touch_down.items()
        for h, jump, end, before, after in zip(
            *(row[key] for key in ("step_ms", "jump", "end", "before_error", "after_error"))
        )
    ]
    head = ("ramp", "step [ms]", "largest change in a step / range", "end value", "error before", "error after")
    tables.append(markdown(head, rows))
    head = ("start", "adjoint dL/dradius", *(f"d = {FINER[RADIUS] * d:g}" for d in result.config.steps))
    rows = [(k, f"{r['adjoint']:.6g}", *(f"{x:.6g}" for x in r["central_differences"])) for k, r in result.rest.items()]
    return "\n\n".join([*tables, markdown(head, rows)])


def figure(result: Result) -> Figure:
    """Errors per parameter and window; convergence through slip; Coulomb's jumps; both sides of a touch-down."""
    fig = Figure(figsize=(13, 11), layout="constrained")
    grid = fig.add_gridspec(2, 3, height_ratios=(1.2, 1.0))
    top, below = fig.add_subplot(grid[0, :]), [fig.add_subplot(grid[1, k]) for k in range(3)]
    names = list(next(iter(result.windows.values()))["gradient"])
    smallest = 1e-16
    markers = {"discrete": "o", "forward": "x", "unrolled": "s", "continuous": "^"}
    for i, (window, numbers) in enumerate(result.windows.items()):
        for route, errors in numbers["relative_error"].items():
            x = [k + 0.16 * (i - 2) for k in range(len(names))]
            hollow = {} if route == "forward" else {"markerfacecolor": "none"}
            top.semilogy(
                x, [max(errors[n], smallest) for n in names], markers[route], color=f"C{i}", ms=6, ls="none", **hollow
            )
        top.plot([], [], "-", color=f"C{i}", label=window, lw=4)
    for route, marker in markers.items():
        top.plot([], [], marker, color="k", ls="none", markerfacecolor="none" if marker != "x" else "k", label=route)
    for k in range(len(names) - 1):
        top.axvline(k + 0.5, color="0.9", lw=0.8, zorder=0)
    top.set_xticks(range(len(names)), [n.split(".")[-1] for n in names], rotation=45)
    top.set(
        ylabel="relative error [1]", title=f"Gradient against central differences ({smallest:g}: both exactly zero)"
    )
    top.set_xlim(-0.6, len(names) - 0.4)
    top.legend(ncols=9, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    errors = result.refinement["relative_error"]
    h = [float(key) for key in errors]
    for (n, label), marker in zip((("contact.mu_s", "mu_s"), ("contact.mu_k", "mu_k"),
                                   ("contact.K_t", "K_t"), ("loss", "the loss itself")), "osvD"):  # fmt: skip
        below[0].loglog(h, [row[n] for row in errors.values()], marker=marker, label=label)
    below[0].loglog(h, [errors[f"{h[0]:g}"]["loss"] * (x / h[0]) ** 2 for x in h], "k--", label="second order")
    below[0].set(xlabel="step [ms]", ylabel="relative error [1]", title="dL/dp through slip against the finest step")
    below[0].set_xticks(h, [f"{x:g}" for x in h])
    below[0].minorticks_off()
    below[0].legend()
    for k, (label, c) in enumerate(result.coulomb.items()):
        if label.startswith("mu_k"):
            continue
        mu, L = torch.tensor(c["mu"]), torch.tensor(c["loss"])
        shift = mu - mu[len(mu) // 2]
        below[1].plot(mu, L - L.mean(), f"C{k}.", ms=3, label=f"L by {label}")
        below[1].plot(mu, c["adjoint"] * shift, f"C{k}-", label="adjoint's slope")
        below[1].plot(mu, c["slope"] * shift, f"C{k}--", label="L's own slope")
    below[1].set(xlabel="mu [1]", ylabel="L less its mean [1]", title="Coulomb's law to the letter")
    below[1].legend(fontsize=8)
    for k, (label, row) in enumerate(result.touch_down.items()):
        below[2].plot(row["time_ms"], row["trace"], f"C{k}.-", ms=2, lw=0.8, label=f"ramp of {label}")
    below[2].axvline(0, color="0.7", lw=0.8)
    below[2].set(xlabel="end of the window after a node touched [ms]", ylabel="d omega / d K_n [rad/s per N/m]",
                 xlim=(-1.0, 2.0), title="Both sides of a touch-down")  # fmt: skip
    below[2].legend(fontsize=8)
    return fig


def write(result: Result) -> None:
    """summary.json, table.md and gradient_accuracy.png into the output folder."""
    parts = {k: getattr(result, k) for k in ("windows", "coulomb", "refinement", "touch_down", "rest")}
    files = {**parts, "made_by": made_by(result.config)}
    write_files(result.config.out, files, {"gradient_accuracy": figure(result)}, table(result))


def main() -> None:
    result = run(options(Config, __doc__))
    print("\n" + table(result) + "\n")
    write(result)


if __name__ == "__main__":
    main()
