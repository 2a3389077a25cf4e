"""Gradients at the limits of the laws: Coulomb's jumps, slip as the step is refined, a touch-down, a gap of exactly zero."""

from dataclasses import replace
from typing import Any

import torch
from _gradients import (
    NEWTON,
    RADIUS,
    Config,
    Window,
    central_differences,
    collect,
    events,
    linspace,
    make_loss,
    relative_errors,
    states,
    stroke,
)

from torchsoft import Parameters, SoftGrasp, simulate
from torchsoft.scenario import grasp_and_roll, reference

WIDTHS = (0.04, 0.02, 0.01)  # Relative half-widths over which the slope of a loss with steps is averaged.


def coulomb(config: Config) -> dict[str, Any]:
    """The adjoint's bias with the literal Coulomb law, by least squares over L(mu), which has steps, at several widths.

    With mu_s = mu_k both are varied together.
    """
    out: dict[str, Any] = {}
    h = 1e-3 * config.coulomb_ms
    for label, mu_k, varied in (
        ("mu_s, of mu_s > mu_k", 0.2, ("mu_s",)),
        ("mu_k, of mu_s > mu_k", 0.2, ("mu_k",)),
        ("mu_s = mu_k", 0.3, ("mu_s", "mu_k")),
    ):
        window = stroke(config, 8e-3, h, {"contact.friction": "coulomb", "contact.mu_k": mu_k}, every=2.5e-4)
        loss, parameters = make_loss(window), {name: window.model.parameter(f"contact.{name}") for name in varied}
        y = states(window)
        loss(y).backward()
        adjoint = sum(parameters[name].grad.item() for name in varied)  # pyright: ignore[reportOptionalMemberAccess]
        middle, scan = parameters[varied[0]].item(), []
        changes = torch.linspace(-max(WIDTHS), max(WIDTHS), config.coulomb_runs, dtype=torch.float64)
        with torch.no_grad():
            for change in changes:
                for name in varied:
                    parameters[name].fill_(middle * (1 + change.item()))
                scan.append(loss(states(window)).item())
            for name in varied:
                parameters[name].fill_(middle)
        slopes = []
        for width in WIDTHS:
            near = changes.abs() <= width * (1 + 1e-9)
            x = middle * changes[near]
            slopes.append(((x * torch.tensor(scan, dtype=torch.float64)[near]).sum() / x.square().sum()).item())
        slope = sum(slopes) / len(slopes)
        out[label] = {
            "events": events(window, y.detach()), "adjoint": adjoint, "slope": slope, "slopes": slopes, "widths": WIDTHS,
            "uncertainty": (max(slopes) - min(slopes)) / 2, "mu": (middle * (1 + changes)).tolist(), "loss": scan,
        }  # fmt: skip
    return out


def refinement(config: Config) -> dict[str, Any]:
    """dL/dp through slip, at the same outputs, as the step is refined; errors against the finest step's."""
    steps = [1e-3 * h for h in (*config.refinement_ms, config.refinement_ms[-1] / 2)]
    names = ("contact.mu_s", "contact.mu_k", "contact.K_t")
    base = stroke(config, 16e-3, steps[-1], {}, every=4e-3)
    loss, table = make_loss(base), {}
    for h in steps:
        value = loss(states(replace(base, step=h)))
        value.backward()
        table[f"{1e3 * h:g}"] = {"loss": value.item(), **collect(base.model, names)}
    with torch.no_grad():
        dense = replace(base, t=linspace(0.0, 16e-3, 2.5e-4), step=2.5e-4)
        found = events(dense, states(dense))
    exact = list(table.values())[-1]
    error = {key: {n: abs(row[n] - exact[n]) / abs(exact[n]) for n in exact} for key, row in list(table.items())[:-1]}
    return {"events": found, "gradient": table, "relative_error": error}


def touch_down(config: Config, window: Window) -> dict[str, Any]:
    """d omega / d K_n at the end of windows that end before and after a node touches, with two ramps, at several steps.

    Continuous in the window's end if its largest change within a step, over its range, goes to zero with the step.
    """
    out: dict[str, Any] = {}
    name = "contact.K_n"
    with torch.no_grad():
        path = states(window)
    rows = events(window, path)["touch_rows"] or [3]
    start, y0 = window.t[rows[0] - 1].item(), path[rows[0] - 1]
    for label, epsilon in (("1 um", 1e-6), ("10 nm", 1e-8)):
        model = SoftGrasp(window.model.settings.override({"contact.epsilon": epsilon}))
        model.reference = window.model.reference
        at, p = model.layout.slices["velocity", "disc"].start + 2, model.parameter(name)
        out[label] = {"step_ms": [], "jump": [], "end": [], "before_error": [], "after_error": []}
        for h in (1e-3 * x for x in config.touch_ms):
            short = replace(window, model=model, y0=y0, t=linspace(start, start + 8e-3, h), step=h)
            run = simulate(model, short.t, y0=y0, step=h, tolerance=NEWTON, gradient="forward", wrt=[name])
            assert run.sensitivities is not None
            value, ends = run.sensitivities[:, at, 0], []
            touch = (events(short, run.y)["touch_rows"] or [len(value) // 2])[0]
            with torch.no_grad():
                keep = p.clone()
                for sign in (1, -1):
                    p.copy_(keep * (1 + sign * 1e-5))
                    ends.append(states(short)[:, at])
                p.copy_(keep)
            error = (value - (ends[0] - ends[1]) / (2e-5 * keep)).abs() / value.abs()
            row = out[label]
            row["step_ms"].append(1e3 * h)
            row["jump"].append((value.diff().abs().max() / (value.max() - value.min())).item())
            row["end"].append(value[-1].item())
            row["before_error"].append(error[touch].item())
            row["after_error"].append(error[touch + 1].item())
            row["time_ms"], row["trace"] = (1e3 * (short.t - short.t[touch + 1])).tolist(), value.tolist()
    return out


def from_rest(config: Config) -> dict[str, Any]:
    """dL/dradius from `rest`, where the gap is exactly zero, and with the bracket 5 um higher."""
    out: dict[str, Any] = {}
    for label, offset in (("at rest", 0.0), ("5 um above", 5e-6)):
        model = SoftGrasp(Parameters().override(dict(config.changes)))
        manipulation = grasp_and_roll(model, grasp_force=75.0)
        y0 = manipulation.y0.clone()
        y0[model.layout.slices["pose", "bracket"].stop - 1] += offset
        model.reference = reference(model, y0, 75.0)
        window = Window("rest", model, y0, linspace(0.0, 0.1, 2e-3), 2e-3)
        loss, chosen = make_loss(window), replace(config, only=(RADIUS,))
        judge, _, at = central_differences(window, loss, chosen, config.steps)
        loss(states(window)).backward()
        got = collect(model, judge)
        out[label] = {
            "adjoint": got[RADIUS], "central_differences": at[RADIUS], "steps": config.steps,
            "relative_error": relative_errors(got, judge)[RADIUS],
        }  # fmt: skip
    return out
