"""Question: the paper's roll with other objects and other rubbers, and what rolling costs with
either kind of rubber: how do contact forces, paths and resistance change, and does the resistance
have the peak that theory gives it?

Grasp and roll out of the paper with six objects between its pads, and with five rubbers around its
disc, under a held force of 80 N. The paper's bracket is held at a height, which fits one radius
only: here its vertical loop is soft and the grasping force is fed forward, so that the bracket
rises and sinks with what turns under it. Objects are rolled by the paper's loop, which senses the
object; with most rubbers that are stiffer at first than later that loop is unstable, so rubbers are
rolled by one that senses the bracket, over twice the way. Then a disc rolls steadily on one pad
under a held load, at speeds over two and a half decades, beside theory (`_shapes_resistance.py`).
De = v tau / a, with tau the longest retardation time (relaxation time of a series) and a the
contact's half-width at rest.

Command: .venv/bin/python experiments/shapes_and_materials.py [--no-video] [--smoke]
Expected: force and power agree to 6e-3 at every speed. At 20 N, where the disc sinks in by 7 % of
the pad's height, the resistance is 1.2 % below to 3.7 % above theory's; at 5 N, near the peak, it
is theory's to 0.2 %. The peaks are higher than theory's by 1.2 to 2.7 %, at a De lower by 1 to 2.5
%: 0.0599 at 0.99 (Kelvin-Voigt), 0.0218 at 0.75 (standard linear solid), 0.0170 at 1.8 (series).
Under a held load Kelvin-Voigt has a peak, too: at high speed the contact stiffens and shrinks. The
closed form is right within 4 % for the thin layer, 30 % too low for the paper's pads. The long box
is refused: it would slide. Two and a half minutes on an idle core.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _shapes_resistance import (
    HEIGHT,
    TAU,
    Resistance,
    Roll,
    cases,
    half_width,
    length,
    resistance,
    roll,
)
from matplotlib import rc_context
from matplotlib.figure import Figure
from tqdm import tqdm

from torchsoft import (
    Circle,
    Contour,
    Ellipse,
    GeneralisedKelvin,
    KelvinVoigt,
    Parameters,
    Profile,
    Prony,
    Reference,
    RoundedBox,
    RoundedPolygon,
    Shape,
    SimulationFailed,
    SoftGrasp,
    StandardLinearSolid,
    Superellipse,
    Trajectory,
    rest,
    simulate,
)
from torchsoft.experiment import COARSE, markdown, options, timed, write
from torchsoft.materials.presets import PRESETS
from torchsoft.physics.material import Material
from torchsoft.plot.animation import animate
from torchsoft.plot.figures import COLOURS, STYLE, new_figure
from torchsoft.plot.scene import FRICTION, INK, NORMAL, Scene, instants
from torchsoft.rigs.balance import LINEAR
from torchsoft.solve.stability import loop_modes

AT_THE_PEAK = 0.7  # De at which loads are compared.
FORCE = 80.0  # Grasping force [N], about the paper's.
SOFT: dict[str, Any] = {
    "control.K_98": 2e3,
    "control.R_99": 200.0,
    "contact.points": 2,
    "contact.v_s": 0.05,
}
"""The vertical loop, two contact points an element, and a slip law that is single-valued under this
force."""
# Retardation time [s] of slow rubbers: what passes a contact of 9 mm at 4.4 mm/s is there for two.
SLOW = 1.0
MM = 1e3


@dataclass(frozen=True)
class Rolled:
    """One grasp and roll out."""

    model: SoftGrasp
    run: Trajectory


def objects() -> dict[str, Shape]:
    """Bodies about as large as the paper's disc, that lie on a side or an end at the start. The
    contour has three lobes and the same width all around, nearly."""
    R = Parameters().disc.radius
    sixths = math.pi / 3 * np.arange(6)
    corners = R / math.cos(math.pi / 6) * np.stack((np.cos(sixths), np.sin(sixths)), -1)
    around = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    lobes = R * (1 + 0.05 * np.sin(3 * around))
    return {
        "circle": Circle(R), "ellipse": Ellipse(1.08 * R, 0.92 * R),
        "superellipse": Superellipse(R, R, 2.6), "rounded box": RoundedBox(R, R, 0.65 * R),
        "rounded hexagon": RoundedPolygon(corners, 0.5 * R),
        "three lobes": Contour(np.stack((lobes * np.cos(around), lobes * np.sin(around)), -1)),
        "long box": RoundedBox(25e-3, R, 5e-3),
    }  # fmt: skip


def rubbers() -> dict[str, Material]:
    """The paper's rubber, one of the presets, and slow ones: relaxed as stiff as the paper's, at
    first twice that. Their times and moduli are assumed."""
    paper = Parameters().pad
    E, nu, rho, depth = paper.E, paper.nu, paper.rho, paper.depth
    preset = "natural rubber 40 IRHD"
    return {
        "Kelvin-Voigt, the paper's": KelvinVoigt(E, nu, rho, paper.tau, depth),
        f"Kelvin-Voigt, {preset}": PRESETS[preset].material(depth),
        "standard linear solid": StandardLinearSolid(E, 2 * E, nu, rho, SLOW, depth),
        "generalised Kelvin": GeneralisedKelvin(
            E, nu, rho, depth, J=(0.2, 0.3), tau=(0.1 * SLOW, SLOW)
        ),
        "relaxation series": Prony(
            E, nu, rho, depth, moduli=(E / 3,) * 3, tau=(0.1 * SLOW, SLOW, 10 * SLOW)
        ),
    }


def lever(shape: Shape, turned: float) -> float:
    """How far beside its centre a body is pushed by a flat pad, at the most, over how far it
    reaches there, while it turns from 0 to `turned` [rad]: the slope of the support function over
    it, below and above."""
    angle = torch.linspace(0, turned, 2001, dtype=torch.float64)
    reach = torch.stack(
        [shape.support(side * torch.stack((-angle.sin(), -angle.cos()), -1)) for side in (1, -1)]
    )
    slope = torch.gradient(reach.detach(), spacing=(angle,), dim=1)[0]
    return float((slope / reach.detach()).abs().max())


def per_millimetre(rolled: Rolled, contact: str, row: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Places along the pad (points,) [mm] from the object's centre, and normal force and friction
    [N/mm] (points, 2) of a contact; friction on the pad to the right."""
    run, pad = rolled.run, rolled.model.pads[contact]
    base = run.state.pose["bracket"][row] if pad.base else torch.zeros(3, dtype=torch.float64)
    x = (pad.spread @ (pad.positions + run.displacement[contact][row]))[:, 0] + base[0]
    to_the_right = (
        -1.0 if contact == "L" else 1.0
    )  # t of the moving frame, below and above the object
    force = run.force[contact][row] * torch.tensor([1.0, -to_the_right], dtype=torch.float64)
    return MM * (x - run["x_C"][row]), force / (MM * torch.from_numpy(pad.point_lengths))[:, None]


def refused(shape: Shape, parameters: Parameters) -> str:
    """Why a shape cannot be rolled so far under this grasp; empty if it can be."""
    mu, travel = parameters.contact.mu_s, abs(parameters.scenario.travel)
    ratio = lever(
        shape,
        travel / float(shape.support(torch.tensor([0.0, -1.0], dtype=torch.float64)).detach()),
    )
    return "" if ratio <= mu else (
        f"too far from round: to roll it over its corner the pads would push {ratio:.2f} of its "
        f"half-height beside its centre, and friction of mu_s = {mu:g} turns it against {mu:g} of "
        "it at the most: it would slide; round it more"
    )  # fmt: skip


def settings(senses: str, changes: Mapping[str, Any]) -> Parameters:
    usual = Parameters().override({**SOFT, **changes, "control.senses": senses})
    twice = 2 if senses == "bracket" else 1
    return usual.override({"scenario.travel": twice * usual.scenario.travel})


def grasp_and_roll(model: SoftGrasp, duration: float, rtol: float) -> Rolled:
    """Grasp with the force, and roll out."""
    y0 = rest(model).detach()
    p, pose = model.settings.scenario, model.unpack(y0).pose
    sensed = pose[model.settings.control.senses][0].item()
    height = pose["bracket"][1].item()
    model.reference = Reference(
        x_d=Profile([0.0, p.roll_time], [sensed, sensed + p.travel]),
        y_d=Profile([0.0, p.grasp_time], [height, height - model.settings.compression]),
        F_ff=Profile([0.0, p.grasp_time], [0.0, -FORCE]),
    )
    t = torch.linspace(0, duration, round(duration / 0.02) + 1, dtype=torch.float64)
    return Rolled(model, simulate(model, t, y0=y0, rtol=rtol))


def numbers(rolled: Rolled, moments: tuple[float, ...]) -> dict[str, Any]:
    """A roll in numbers: at the moments, with the lower pad's forces, and its extremes."""
    run, model = rolled.run, rolled.model
    out: dict[str, Any] = {"at": {}}
    lengths = MM * torch.from_numpy(model.pads["L"].point_lengths)
    for time in moments:
        row = run.at(time)
        _, force = per_millimetre(rolled, "L", row)
        out["at"][f"{time:g} s"] = {f"{name} [mm]": MM * run[name][row].item() for name in ("x_C",
            "y_C", "y_Br")} | {
            "theta [rad]": run["theta"][row].item(), "F_x [N]": run["F_x"][row].item(),
            "normal force, lower [N]": (force[:, 0] * lengths).sum().item(),
            "largest normal force, lower [N/mm]": force[:, 0].max().item(),
            "largest friction, lower [N/mm]": force[:, 1].abs().max().item(),
            "contact, lower [mm]": lengths[force[:, 0] > 0].sum().item(),
        }  # fmt: skip
    given = max(
        u.norm(dim=-1).max().item() / model.pads[name].mesh.height
        for name, u in run.displacement.items()
    )
    held = run["y_Br"][run.t >= model.settings.scenario.grasp_time]
    out |= {
        "F_x, largest [N]": run["F_x"].abs().max().item(), "pad gives way by, of its height": given,
        "bracket rises and sinks by [mm]": MM * (held.max() - held.min()).item(),
        "slip dissipates [mJ]": 1e3 * run.dissipated["slip"][-1].item(),
        "energy residual": run.energy_residual_rel, "steps": run.stats.steps,
    }  # fmt: skip
    if given > LINEAR:
        out["note"] = (
            f"a pad gives way by more than {LINEAR:.0%} of its height: forces are beyond linear "
            "elasticity"
        )
    return out


@rc_context(STYLE)
def distributions(rolled: Mapping[str, Rolled], moments: Sequence[float], title: str) -> Figure:
    """A column a roll: its picture in the middle, and normal force and friction along both pads at
    the moments."""
    figure = new_figure(title, 2.6 * len(rolled) + 0.6, 9)
    grid = figure.subplots(
        1 + len(moments),
        len(rolled),
        squeeze=False,
        sharey="row",
        height_ratios=(1.3, *[1] * len(moments)),
    )
    for (top, *below), (name, one) in zip(grid.T, rolled.items()):
        (instant,) = instants(one.run, moments[len(moments) // 2 : len(moments) // 2 + 1])
        Scene(top, one.run.setup).show(instant)
        x, y = instant.pose["disc"][:2]
        top.set(xlim=(x - 26, x + 26), ylim=(y - 30, y + 30), title=name)
        top.set_axis_off()
        for axes, time in zip(below, moments):
            for contact, style, pad in (("L", "-", "lower"), ("U", "--", "upper")):
                x, force = per_millimetre(one, contact, one.run.at(time))
                axes.plot(
                    x, force[:, 0], style, color=NORMAL, lw=1.2, label=f"normal force, {pad} pad"
                )
                axes.plot(
                    x,
                    force[:, 1],
                    style,
                    color=FRICTION,
                    lw=1.2,
                    label=f"friction to the right, {pad} pad",
                )
            axes.set(xlim=(-13, 13), title=f"{time:g} s")
    figure.supxlabel("place along the pad from the centre [mm]")
    figure.supylabel("force [N/mm]")
    figure.legend(*grid[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


@rc_context(STYLE)
def paths(rolled: Mapping[str, Rolled]) -> Figure:
    """Angle, heights, and horizontal force of all rolls over time."""
    figure = new_figure("Grasp and roll out", 11, 7)
    shown = {
        "theta": "theta [rad]",
        "y_C": "y_C - y_C(0) [m]",
        "y_Br": "y_Br - y_Br(0) [m]",
        "F_x": "F_x [N]",
    }
    for axes, (channel, label) in zip(figure.subplots(2, 2, sharex=True).ravel(), shown.items()):
        for name, one in rolled.items():
            axes.plot(one.run.t, one.run[channel] - one.run[channel][0], lw=1.2, label=name)
        axes.set(xlabel="time [s]", ylabel=label)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


@rc_context(STYLE)
def resistance_figure(curves: Mapping[str, Resistance], loads: Mapping[float, Roll]) -> Figure:
    """Measured by force and by power beside both theories; then how far theory is off, by speed and
    by load."""
    figure = new_figure("Rolling resistance of a disc on a pad under a held load", 14, 4.5)
    absolute, by_speed, by_depth = figure.subplots(1, 3)
    for colour, (name, one) in zip(COLOURS, curves.items()):
        De, between = (
            [one.deborah(v) for v in speeds]
            for speeds in ([r.speed for r in one.rolls], one.speeds)
        )
        absolute.loglog(between, one.theory, color=colour, lw=1.6, label=name)
        absolute.loglog(between, one.winkler, ":", color=colour, lw=1.2)
        absolute.loglog(De, [r.force for r in one.rolls], "o", color=colour, mfc="none", ms=7)
        absolute.loglog(De, [r.power for r in one.rolls], "+", color=INK, ms=6)
        by_speed.semilogx(
            De, [r.force / r.theory for r in one.rolls], "o-", color=colour, ms=4, lw=1
        )
    by_depth.plot(
        [r.depth / HEIGHT for r in loads.values()],
        [r.force / r.theory for r in loads.values()],
        "o-",
    )
    title = "lines: theory, dotted: thin layer,\ncircles: driving force, crosses: power"
    absolute.set(xlabel="De = v tau / a", ylabel="resistance / load", title=title)
    absolute.legend(fontsize=8)
    by_speed.set(xlabel="De = v tau / a", ylabel="measured / theory")
    by_depth.set(
        xlabel="depth of the disc over the pad's height", title="standard linear solid at De = 0.7"
    )
    return figure


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/shapes_and_materials")
    speeds: int = 10  # speeds of every rubber
    slowest: float = 0.03  # of them, as De
    fastest: float = 8.0
    load_N: float = 20.0  # on the rolling disc; a quarter of it on the thin layer
    loads_N: tuple[float, ...] = (2.5, 5.0, 10.0, 20.0, 40.0)  # at one speed
    element_mm: float = 0.5  # along the pad
    duration: float = 10.0  # of grasp and roll out [s]
    moments: tuple[float, ...] = (2.5, 5.0, 7.5)  # of the force distributions [s]
    rtol: float = 1e-4  # of the grasps and rolls
    rtol_steady: float = 1e-3  # of the steady rolls, whose forces are averaged
    video: bool = True
    smoke: bool = False  # a size that takes seconds


@dataclass(frozen=True)
class Result:
    config: Config
    objects: dict[str, Rolled]
    rubbers: dict[str, Rolled]
    refused: dict[str, str]
    resistance: dict[str, Resistance]
    loads: dict[float, Roll]


def by_load(config: Config) -> dict[float, Roll]:
    """The standard linear solid near its peak, under loads down to where deformations are small."""
    out = {}
    for load in config.loads_N:
        case = cases(load, 1e-3 * min(config.element_mm, 0.5 * (load / config.load_N) ** 0.5))[
            "standard linear solid"
        ]
        v = AT_THE_PEAK * half_width(case) / TAU
        out[load] = roll(case, v, length(case, [v]), config.rtol_steady)
    return out


def run(config: Config) -> Result:
    if config.smoke:
        config = replace(config, speeds=3, slowest=0.2, fastest=2.0, loads_N=(10.0,),
            element_mm=1.0, duration=0.6,
                         moments=(0.3, 0.6), rtol=1e-3, video=False)  # fmt: skip

    def some(parts: dict[str, Any], *kept: str) -> dict[str, Any]:
        return {name: part for name, part in parts.items() if not config.smoke or name in kept}

    coarse = COARSE if config.smoke else {}
    shaped, made_of, wrong = dict[str, Rolled](), dict[str, Rolled](), dict[str, str]()
    for name, shape in tqdm(
        some(objects(), "circle", "rounded hexagon", "long box").items(), "objects"
    ):
        wanted = settings("disc", coarse)
        if why := refused(shape, wanted):
            wrong[name] = why
            continue
        try:
            shaped[name] = grasp_and_roll(
                SoftGrasp(wanted, shape=shape), config.duration, config.rtol
            )
        except SimulationFailed as failure:
            wrong[name] = f"the run ended: {failure}"
    for name, rubber in tqdm(some(rubbers(), "standard linear solid").items(), "rubbers"):
        model = SoftGrasp(settings("bracket", coarse), material=rubber)
        made_of[name] = grasp_and_roll(model, config.duration, config.rtol)
    layers = some(cases(config.load_N, 1e-3 * config.element_mm), "standard linear solid")
    how = config.slowest, config.fastest, config.speeds, config.rtol_steady
    curves = {name: resistance(case, *how) for name, case in tqdm(layers.items(), "resistance")}
    return Result(config, shaped, made_of, wrong, curves, by_load(config))


def summary(result: Result) -> dict[str, Any]:
    """Everything in numbers."""
    moments = result.config.moments
    materials = rubbers()
    curves = {}
    for name, one in result.resistance.items():
        peaks = {kind: one.peak(kind) for kind in ("force", "theory", "winkler")}
        curves[name] = {
            "half-width at rest [mm]": 1e3 * one.half_width,
            "rolls": [{"De": one.deborah(r.speed), **r._asdict()} for r in one.rolls],
            "peak": {
                k: p and {"speed [m/s]": p[0], "De": one.deborah(p[0]), "height": p[1]}
                for k, p in peaks.items()
            },
            "power over force less one, largest": max(
                abs(r.power / r.force - 1) for r in one.rolls
            ),
            "force over theory": [min(q := [r.force / r.theory for r in one.rolls]), max(q)],
        }
    modes = {
        name: complex(loop_modes(SoftGrasp(Parameters(), material=materials[name]))[0])
        for name in result.rubbers
    }
    return {
        "objects": {name: numbers(one, moments) for name, one in result.objects.items()},
        "rubbers": {
            name: numbers(one, moments)
            | {
                "the paper's loop on it, leading mode [1/s]": [modes[name].real, modes[name].imag],
                "coefficients (assumed)": {
                    k: p.item() for k, p in materials[name].named_parameters()
                },
            }
            for name, one in result.rubbers.items()
        },
        "refused": result.refused,
        "resistance": curves,
        "by load": {
            f"{load:g} N": {
                "depth over height": r.depth / HEIGHT,
                "force over theory": r.force / r.theory,
                **r._asdict(),
            }
            for load, r in result.loads.items()
        },
    }


def tables(content: dict[str, Any]) -> str:
    """Markdown tables: rolls in mid-roll, resistance, loads, and what was refused."""
    rows = []
    for name, one in (content["objects"] | content["rubbers"]).items():
        here = list(one["at"].values())[len(one["at"]) // 2]
        rows.append((
            name, f"{here['theta [rad]']:.3f}", f"{one['bracket rises and sinks by [mm]']:.2f}",
            f"{here['normal force, lower [N]']:.1f}", f"{here['contact, lower [mm]']:.1f}",
            f"{here['largest normal force, lower [N/mm]']:.2f}",
            f"{here['largest friction, lower [N/mm]']:.2f}", f"{one['F_x, largest [N]']:.2f}",
            f"{one['pad gives way by, of its height']:.0%}",
        ))  # fmt: skip
    head = (
        "in mid-roll", "theta [rad]", "bracket rises and sinks by [mm]", "normal force [N]",
        "contact [mm]", "its peak [N/mm]", "friction's peak [N/mm]", "largest F_x [N]",
        "pad gives way by",
    )  # fmt: skip
    rolls = markdown(head, rows)
    rows = []
    for name, one in content["resistance"].items():
        got, theory, thin = (one["peak"][kind] for kind in ("force", "theory", "winkler"))
        shown = [f"{p['height']:.4f} at {p['De']:.3f}" if p else "-" for p in (got, theory, thin)]
        ratio = (
            f"{got['height'] / theory['height']:.3f}, {got['De'] / theory['De']:.3f}"
            if got and theory
            else "-"
        )
        low, high = one["force over theory"]
        rows.append(
            (
                name,
                *shown,
                ratio,
                f"{low:.3f} .. {high:.3f}",
                f"{one['power over force less one, largest']:.1e}",
            )
        )
    head = (
        "peak of resistance over load, at De", "measured", "theory", "thin layer's closed form",
        "measured / theory: height, De", "measured / theory, all speeds", "power / force - 1",
    )  # fmt: skip
    curves = markdown(head, rows)
    loads = markdown(
        ("standard linear solid at De = 0.7", "depth over height", "measured / theory"),
        [
            (k, f"{r['depth over height']:.3f}", f"{r['force over theory']:.3f}")
            for k, r in content["by load"].items()
        ],
    )
    notes = [f"- {name}: {why}" for name, why in content["refused"].items()]
    every = content["objects"] | content["rubbers"]
    notes += [f"- {name}: {one['note']}" for name, one in every.items() if "note" in one]
    return "\n\n".join((rolls, curves, loads, "\n".join(notes)))


def main(config: Config) -> None:
    torch.set_num_threads(1)
    result, wall = timed(lambda: run(config))
    content = summary(result) | {"wall_s": wall}
    moments = result.config.moments
    figures = {
        "objects": distributions(
            result.objects, moments, f"Objects between the paper's pads, {FORCE:g} N"
        ),
        "rubbers": distributions(
            result.rubbers, moments, f"The paper's disc on rubbers, {FORCE:g} N"
        ),
        "paths": paths(result.objects | result.rubbers),
        "resistance": resistance_figure(result.resistance, result.loads),
    }
    write(result.config, content, figures, tables(content))
    for name, one in result.objects.items() if result.config.video else ():
        path, title = (
            config.out / f"{name.replace(' ', '_')}.gif",
            f"{name.capitalize()}, {FORCE:g} N",
        )
        animate(one.run, path, frames=72, title=title, follow="disc.theta")


if __name__ == "__main__":
    main(options(Config, __doc__))
