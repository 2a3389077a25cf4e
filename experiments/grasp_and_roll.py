"""Question: does the model carry out the paper's manipulation, and where does it differ from the
published numbers?

A disc on a soft pad is grasped by a second pad in a bracket (0 to 0.375 s), rolled 20 mm to the
left within 10 s, held there for 5 s, rolled back within 10 s and left at rest for 5 s. References
Eq. 20-30, controllers Eq. 31-34, contact Eq. 8-13, bracket moment Eq. 35. The paper prints no
friction numbers: with the default set friction stays locked in, with the "paper-like" set (K_t =
100 N/m) it fades in the grasp, as the paper reports. Both are run.

Command: .venv/bin/python experiments/grasp_and_roll.py [--table] [--smoke]
Expected (default set; the paper's number in brackets): grasping force 80.85 N; x_C(10 s) = 40.000
mm (40); y_C in the grasp 23.199 mm (23.20); y_Br between 48.564 and 48.600 mm (48.6); theta(10 s) =
1.090 rad, anticlockwise, -0.0035 rad at the end; peak speed 4.41 mm/s; peak F_x 0.43 N, of which a
quarter is the mesh's: 0.33 N with four contact points an element; peak bracket moment 1.56 N.m; 11
nodes of each pad in contact; energy residual 1e-6. About 40 s on one core with figures and
animation; each simulation takes 2 s of that, with four points an element 7 s.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from torch import Tensor

from torchsoft import BuiltRig, NoEquilibrium, Rig, RigFile, Trajectory
from torchsoft.experiment import COARSE, markdown, options, write
from torchsoft.plot import diagram
from torchsoft.plot.animation import animate, player
from torchsoft.plot.dashboard import dashboard
from torchsoft.plot.figures import (
    COLOURS,
    DESIRED,
    finish_time_axis,
    legend_above,
    looking,
    new_figure,
    snapshots,
    timeline,
)

PAPER = RigFile.ready("paper")
PAPER_LIKE = {"contact.K_t": 100.0}
"""The paper-like friction set."""

FIGURE_16 = PAPER.outputs.snapshots
"""Times [s] of the panels of the paper's Fig. 16."""

FORCES_AT = {0.125: 14, 5.0: 15}
"""Times [s] of the paper's figures of forces along the contacts, and their numbers."""

SETTLE = 0.5
"""Time [s] after the grasp at which the bracket is judged to be at rest."""

HELD = 1e-6
"""Distance [m] to which the bracket is held at its height."""

POINTS = 4
"""Contact points an element of the finer run, whose peak of F_x is within 2 % of that of eight."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/grasp_and_roll")  # folder for everything that is written
    rtol: float = 1e-5  # relative tolerance of the stepper
    animation: bool = True  # write the animation
    table: bool = False  # only print the table of the summary that is already in `out`
    smoke: bool = False  # 0.6 s on a coarse mesh


@dataclass(frozen=True)
class Run:
    """One manipulation."""

    friction: str
    file: RigFile
    rig: Rig
    trajectory: Trajectory
    grasp_force: float
    finer: Trajectory


def pushed(file: RigFile, force: float) -> BuiltRig:
    """The rig with a force [N] downwards fed forward to the bracket."""
    return file.override({"motion.F_ff.values": [0.0, -force]}).build()


def grasping_force(file: RigFile, rtol: float) -> float:
    """Force [N] fed forward that leaves the vertical loop nothing to do once the grasp has settled.

    Friction locked in during the grasp stiffens the pads, so that the force of statics, "held" in a
    rig file, is too low: the grasp itself is simulated, by the secant method.
    """
    grasp: Any = file.motion["y_d"]
    t = [0.0, grasp.times[-1], grasp.times[-1] + SETTLE]

    def error(force: float) -> float:
        return float(pushed(file, force).run(t, rtol=rtol)["y_Br"][-1]) - grasp.values[-1]

    force, off = 0.0, error(0.0)
    gain = 2.0 * file.actuators["y"].Kp  # the pads are about as stiff as the loop
    for _ in range(20):
        if abs(off) <= HELD:
            return force
        new = force + gain * off
        new_off = error(new)
        gain = (new - force) / (off - new_off)
        force, off = new, new_off
    raise NoEquilibrium(
        f"no grasping force found: the bracket is still {off:.2g} m off at {force:.4g} N"
    )


def manipulate(config: Config, friction: str, changes: Mapping[str, Any]) -> Run:
    """Find the grasping force and run the manipulation with one friction set."""
    file = PAPER.override(changes, outputs={"snapshots": sorted({*FIGURE_16, *FORCES_AT})})
    if config.smoke:
        file = file.override(COARSE, outputs={"duration": 0.6, "snapshots": [0.125, 0.375]})
    print(f"{friction} friction: finding the grasping force", flush=True)
    force = grasping_force(file, config.rtol)
    print(f"{friction} friction: {force:.3f} N hold the bracket; rolling", flush=True)
    built, fine = pushed(file, force), pushed(file.override({"contact.points": POINTS}), force)
    run, finer = (one.run(rtol=config.rtol, progress=True) for one in (built, fine))
    return Run(friction, file, built.rig, run, force, finer)


def run(config: Config) -> tuple[Run, Run]:
    """The default and the paper-like friction set."""
    return manipulate(config, "default", {}), manipulate(config, "paper-like", PAPER_LIKE)


def summary(run: Run) -> dict[str, Any]:
    """The run in numbers; None for what it did not reach. F_y_hold_N counts downwards, at 5 s."""
    r = run.trajectory

    def at(time: float, signal: Tensor, unit: float = 1) -> float | None:
        return unit * signal[r.at(time)].item() if time <= r.t[-1] + 1e-9 else None

    held = r["y_Br"][r.t >= 0.5]
    rolling_out = (r.t >= 1) & (r.t <= 9)
    pads = {"L": "lower", "U": "upper"}
    touching = {pads[name]: (force[..., 0] > 0).sum(-1) for name, force in r.force.items()}
    return {
        "x_C_mm": {str(time): at(time, r["x_C"], 1e3) for time in (0, 10, 15, 25, 30)},
        "y_C_grasp_mm": at(0.375, r["y_C"], 1e3),
        "y_Br_hold_mm": {
            "min": 1e3 * held.min().item() if len(held) else None,
            "max": 1e3 * held.max().item() if len(held) else None,
        },
        "theta_10_rad": at(10, r["theta_C"]),
        "theta_30_rad": at(30, r["theta_C"]),
        "peak_speed_mm_s": 1e3 * r["v_x_C"].abs().max().item(),
        "F_y_hold_N": at(5, -r["effort_y"]),
        "F_x_peak_N": r["effort_x"].abs().max().item(),
        "F_x_peak_finer_N": run.finer["effort_x"].abs().max().item(),
        "M_Br_peak_Nm": r["M_U"].abs().max().item(),
        "contact_nodes": {name: at(5, count) for name, count in touching.items()},
        "angular_momentum_sign_out": int(r["omega_C"][rolling_out].mean().sign())
        if r.t[-1] >= 9
        else None,
        "energy_residual_rel": r.energy_residual_rel,
        "steps": r.stats.steps,
        "newton_per_step": r.stats.newton_per_step,
        "failed_steps": r.stats.failed_steps,
        "wall_s": r.stats.wall_s,
        "friction": run.friction,
        "grasp_force_N": run.grasp_force,
        "parameters": run.file.table(),
    }


ROWS = (  # what, published value, key, format
    ("x_C(0 s) [mm]", "60", "x_C_mm.0", ".3f"),
    ("x_C(10 s) [mm]", "40", "x_C_mm.10", ".3f"),
    ("x_C(15 s) [mm]", "40", "x_C_mm.15", ".3f"),
    ("x_C(25 s) [mm]", "60", "x_C_mm.25", ".3f"),
    ("x_C(30 s) [mm]", "60", "x_C_mm.30", ".3f"),
    ("y_C in the grasp, 0.375 s [mm]", "23.20", "y_C_grasp_mm", ".3f"),
    ("y_Br from 0.5 s on, lowest [mm]", "48.6", "y_Br_hold_mm.min", ".3f"),
    ("y_Br from 0.5 s on, highest [mm]", "48.6", "y_Br_hold_mm.max", ".3f"),
    ("peak speed of the disc [mm/s]", "4.375 (desired)", "peak_speed_mm_s", ".3f"),
    ("direction of rolling out", "anticlockwise", "angular_momentum_sign_out", "turn"),
    ("theta(10 s) [rad]", "curve only", "theta_10_rad", ".4f"),
    ("theta(30 s) [rad]", "curve only", "theta_30_rad", ".4f"),
    ("downward force F_y at 5 s [N]", "curve only", "F_y_hold_N", ".2f"),
    ("peak horizontal force F_x [N], contact points on nodes", "curve only", "F_x_peak_N", ".3f"),
    (f"the same, {POINTS} points an element", "curve only", "F_x_peak_finer_N", ".3f"),
    ("peak bracket moment [N.m]", "curve only", "M_Br_peak_Nm", ".3f"),
    ("nodes in contact at 5 s, lower pad", "curve only", "contact_nodes.lower", "d"),
    ("nodes in contact at 5 s, upper pad", "curve only", "contact_nodes.upper", "d"),
    ("grasping force fed forward [N]", "not given", "grasp_force_N", ".3f"),
    ("energy residual / injected", "-", "energy_residual_rel", ".1e"),
    ("steps (Newton iterations each)", "-", "steps", "d"),
    ("wall time of the stepping [s]", "-", "wall_s", ".2f"),
)


def table(numbers: Mapping[str, Any]) -> str:
    """The published values beside the runs', as Markdown."""

    def cell(source: Mapping[str, Any], key: str, form: str) -> str:
        value: Any = source
        for part in key.split("."):
            value = value[part]
        if value is None:
            return "-"
        if form == "turn":
            return {1: "anticlockwise", -1: "clockwise", 0: "none"}[value]
        return f"{value:{form}}" + (f" ({source['newton_per_step']:.2f})" if key == "steps" else "")

    columns = numbers, numbers["paper_like"]
    head = ("", "paper", *(f"{c['friction']} friction" for c in columns))
    return markdown(
        head,
        [
            (quantity, paper, *(cell(c, key, form) for c in columns))
            for quantity, paper, key, form in ROWS
        ],
    )


CURVES = (  # title, channel, its set-point, label, scale
    ("place of the disc (paper: Figs. 10a, 13a)", "x_C", "x_d", "$x_C$ [mm]", 1e3),
    ("speed of the disc (Figs. 10b, 13b)", "v_x_C", "x_d_dot", "$v_x$ [mm/s]", 1e3),
    ("vertical force on the bracket (Fig. 11a)", "effort_y", "", "$F_y$ [N]", 1.0),
    ("horizontal force on the bracket (Fig. 11b)", "effort_x", "", "$F_x$ [N]", 1.0),
    ("moment on the bracket (Fig. 12)", "M_U", "", "$M_{Br}$ [N m]", 1.0),
    ("angular momentum (Fig. 17)", "angular_momentum_C", "", r"$I_C\,\omega$ [kg mm$^2$/s]", 1e6),
)


def over_time(runs: Sequence[Run]) -> Figure:
    """The paper's curves of both friction sets, and the set-points of the disc."""
    with looking("screen") as size:
        figure = new_figure("Grasp and roll over time", size.width, 9.0)
        for axes, (title, channel, setpoint, label, scale) in zip(
            figure.subplots(3, 2).flat, CURVES
        ):
            first = runs[0].trajectory
            t = timeline(axes, label, first)
            if setpoint:
                axes.plot(t, scale * first[setpoint], color=DESIRED, lw=3, label="set-point")
            for run, colour in zip(runs, COLOURS):
                values = scale * run.trajectory[channel].detach().numpy()
                axes.plot(t, values, color=colour, lw=1.0, label=f"{run.friction} friction")
            axes.set_title(title)
            legend_above(axes)
            finish_time_axis(axes)
    return figure


def figures(run: Run) -> dict[str, Figure]:
    """Every figure of one run by its file's name."""
    trajectory = run.trajectory
    out = {
        "dashboard": dashboard(trajectory, title=f"Grasp and roll, {run.friction} friction"),
        "snapshots": snapshots(
            trajectory,
            [t for t in FIGURE_16 if t <= trajectory.t[-1]],
            title=f"Grasp and roll, {run.friction} friction (paper: Fig. 16)",
        ),
        "multibond": diagram.multibond_graph(run.rig),
    }
    for time, number in FORCES_AT.items():
        if time <= trajectory.t[-1]:
            out[f"force_distribution_{time:g}s"] = dashboard(
                trajectory, only=("scene", "contact U", "contact L"), time=time,
                title=f"Contact forces at {time:g} s, {run.friction} friction (Fig. {number})",
            )  # fmt: skip
    return out


def save(config: Config, runs: tuple[Run, Run]) -> None:
    """Everything into `out`, the paper-like friction set under "paper_like" in the summary."""
    first, other = runs
    config.out.mkdir(parents=True, exist_ok=True)
    first.trajectory.save(config.out / "trajectory.nc")
    other.trajectory.save(config.out / "trajectory_paper_like.nc")
    (config.out / "multibond.dot").write_text(diagram.dot(first.rig), encoding="utf-8")
    content = summary(first) | {"paper_like": summary(other)}
    pictures = figures(first) | {"over_time": over_time(runs)}
    pictures |= {
        f"{name}_paper_like": one for name, one in figures(other).items() if name != "multibond"
    }
    write(config, content, pictures, table(content))
    if config.animation:
        animate(
            first.trajectory, config.out / "animation.gif", frames=12 if config.smoke else 150,
            title="Grasp and roll; the first half second in slow motion", follow="disc.x",
            slow=0.5, progress=True,
        )  # fmt: skip
        player(first.trajectory, config.out / "player.html", title="Grasp and roll")


def main(config: Config) -> None:
    if config.table:
        print(table(json.loads((config.out / "summary.json").read_text(encoding="utf-8"))))
    else:
        save(config, run(config))


if __name__ == "__main__":
    main(options(Config, __doc__))
