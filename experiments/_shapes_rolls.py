"""The paper's grasp and roll with other objects and other rubbers, under a held force.

The paper's bracket is held at a height, which fits one radius only. Here its vertical loop is soft and the grasping force is
fed forward, so that the bracket rises and sinks with what turns under it; all else is the paper's, to the end of the roll out.
Objects are rolled by the paper's loop, which senses the object. With most rubbers that are stiffer at first than later that
loop is unstable, so rubbers are rolled by one that senses the bracket, over twice the way.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from _shapes_theory import Rolling, moving_contact

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
    SoftGrasp,
    StandardLinearSolid,
    Superellipse,
    Trajectory,
    rest,
    simulate,
)
from torchsoft.materials.presets import PRESETS
from torchsoft.physics.material import Material
from torchsoft.rigs.balance import LINEAR
from torchsoft.solve.stability import loop_modes

FORCE = 80.0
"""Grasping force [N], about the paper's."""

SOFT: dict[str, Any] = {"control.K_98": 2e3, "control.R_99": 200.0, "contact.points": 2, "contact.v_s": 0.05}
"""The vertical loop, two contact points an element, and a slip law that is single-valued under this force."""

SLOW = 1.0
"""Retardation time [s] about which the rubbers are slow: what passes a contact of 9 mm at 4.4 mm/s is there for two."""

AROUND = 0.5
"""Time [s] to each side of mid-roll over which its force is averaged: a few elements."""

MM = 1e3


@dataclass(frozen=True)
class Rolled:
    """One grasp and roll out."""

    model: SoftGrasp
    run: Trajectory


def objects() -> dict[str, Shape]:
    """Bodies about as large as the paper's disc, that lie on a side or an end at the start. The contour has three lobes and
    the same width all around, nearly."""
    R = Parameters().disc.radius
    sixths = math.pi / 3 * np.arange(6)
    corners = R / math.cos(math.pi / 6) * np.stack((np.cos(sixths), np.sin(sixths)), -1)
    around = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    lobes = R * (1 + 0.05 * np.sin(3 * around))
    return {
        "circle": Circle(R),
        "ellipse": Ellipse(1.08 * R, 0.92 * R),
        "superellipse": Superellipse(R, R, 2.6),
        "rounded box": RoundedBox(R, R, 0.65 * R),
        "rounded hexagon": RoundedPolygon(corners, 0.5 * R),
        "three lobes": Contour(np.stack((lobes * np.cos(around), lobes * np.sin(around)), -1)),
        "long box": RoundedBox(25e-3, R, 5e-3),
    }


def rubbers() -> dict[str, Material]:
    """The paper's rubber, one of the presets, and slow ones: relaxed as stiff as the paper's, at first twice that. Their times
    and moduli are assumed."""
    paper = Parameters().pad
    E, nu, rho, depth = paper.E, paper.nu, paper.rho, paper.depth
    preset = "natural rubber 40 IRHD"
    return {
        "Kelvin-Voigt, the paper's": KelvinVoigt(E, nu, rho, paper.tau, depth),
        f"Kelvin-Voigt, {preset}": PRESETS[preset].material(depth),
        "standard linear solid": StandardLinearSolid(E, 2 * E, nu, rho, SLOW, depth),
        "generalised Kelvin": GeneralisedKelvin(E, nu, rho, depth, J=(0.2, 0.3), tau=(0.1 * SLOW, SLOW)),
        "relaxation series": Prony(E, nu, rho, depth, moduli=(E / 3,) * 3, tau=(0.1 * SLOW, SLOW, 10 * SLOW)),
    }


def lever(shape: Shape, turned: float) -> float:
    """How far beside its centre a body is pushed by a flat pad, at the most, over how far it reaches there, while it turns from
    0 to `turned` [rad]: the slope of the support function over it, below and above."""
    angle = torch.linspace(0, turned, 2001, dtype=torch.float64)
    reach = torch.stack([shape.support(side * torch.stack((-angle.sin(), -angle.cos()), -1)) for side in (1, -1)])
    slope = torch.gradient(reach.detach(), spacing=(angle,), dim=1)[0]
    return float((slope / reach.detach()).abs().max())


def refused(shape: Shape, parameters: Parameters) -> str:
    """Why a shape cannot be rolled so far under this grasp; empty if it can be."""
    mu, travel = parameters.contact.mu_s, abs(parameters.scenario.travel)
    ratio = lever(shape, travel / float(shape.support(torch.tensor([0.0, -1.0], dtype=torch.float64)).detach()))
    if ratio <= mu:
        return ""
    return (
        f"too far from round: to roll it over its corner the pads would push {ratio:.2f} of its half-height beside its "
        f"centre, and friction of mu_s = {mu:g} turns it against {mu:g} of it at the most: it would slide; round it more"
    )


def settings(senses: str, changes: Mapping[str, Any]) -> Parameters:
    usual = Parameters().override({**SOFT, **changes, "control.senses": senses})
    twice = 2 if senses == "bracket" else 1
    return usual.override({"scenario.travel": twice * usual.scenario.travel})


def roll(model: SoftGrasp, duration: float, rtol: float) -> Rolled:
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


def per_millimetre(rolled: Rolled, contact: str, row: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Places along the pad (points,) [mm] from the object's centre, and normal force and friction [N/mm] (points, 2) of a
    contact; friction on the pad to the right."""
    run, pad = rolled.run, rolled.model.pads[contact]
    base = run.state.pose["bracket"][row] if pad.base else torch.zeros(3, dtype=torch.float64)
    x = (pad.spread @ (pad.positions + run.displacement[contact][row]))[:, 0] + base[0]
    to_the_right = -1.0 if contact == "L" else 1.0  # t of the moving frame, below and above the object
    force = run.force[contact][row] * torch.tensor([1.0, -to_the_right], dtype=torch.float64)
    return MM * (x - run["x_C"][row]), force / (MM * torch.from_numpy(pad.point_lengths))[:, None]


def numbers(rolled: Rolled, moments: tuple[float, ...]) -> dict[str, Any]:
    """A roll in numbers: at the moments, and its extremes."""
    run, model = rolled.run, rolled.model
    out: dict[str, Any] = {"at": {}}
    for time in moments:
        row = run.at(time)
        here: dict[str, float] = {f"{name} [mm]": MM * run[name][row].item() for name in ("x_C", "y_C", "y_Br")}
        here |= {"theta [rad]": run["theta"][row].item(), "F_x [N]": run["F_x"][row].item()}
        for contact, name in (("L", "lower"), ("U", "upper")):
            _, force = per_millimetre(rolled, contact, row)
            lengths = MM * torch.from_numpy(model.pads[contact].point_lengths)
            here |= {
                f"normal force, {name} [N]": (force[:, 0] * lengths).sum().item(),
                f"friction, {name} [N]": (force[:, 1] * lengths).sum().item(),
                f"largest normal force, {name} [N/mm]": force[:, 0].max().item(),
                f"largest friction, {name} [N/mm]": force[:, 1].abs().max().item(),
                f"contact, {name} [mm]": lengths[force[:, 0] > 0].sum().item(),
            }
        out["at"][f"{time:g} s"] = here
    given = {name: u.norm(dim=-1).max().item() / model.pads[name].mesh.height for name, u in run.displacement.items()}
    held = run["y_Br"][run.t >= model.settings.scenario.grasp_time]
    out |= {
        "F_x, largest [N]": run["F_x"].abs().max().item(),
        "bracket rises and sinks by [mm]": MM * (held.max() - held.min()).item(),
        "pad gives way by, of its height": max(given.values()),
        "slip dissipates [mJ]": 1e3 * run.dissipated["slip"][-1].item(),
        "energy residual": run.energy_residual_rel,
        "steps": run.stats.steps,
    }
    if out["pad gives way by, of its height"] > LINEAR:
        out["note"] = f"a pad gives way by more than {LINEAR:.0%} of its height: forces are beyond linear elasticity"
    return out


def leading_mode(material: Material) -> complex:
    """Of the paper's own grasp on this rubber, whose loop senses the disc [1/s]."""
    return complex(loop_modes(SoftGrasp(Parameters(), material=material))[0])


def steady_resistance(rolled: Rolled, time: float) -> dict[str, float]:
    """Horizontal force over normal force of a disc between its pads, about a moment, and the steady theory's at its speed: the
    bracket moves twice as fast as the disc over either pad, so that its force is the resistance of one."""
    run, model = rolled.run, rolled.model
    about = (run.t - time).abs() < AROUND
    N = 0.5 * sum(force[about, :, 0].sum(-1).mean().item() for force in run.force.values())
    law = model.contacts["L"].law
    per_length = law.K_n.item() / law.node_spacing, law.K_t.item() / law.node_spacing
    material = model.pads["L"].material
    at = Rolling(model.settings.disc.radius, model.settings.pad.height, material.depth.item(), *per_length)
    theory = moving_contact(at, material, N, run["v_x"][about].mean().abs().item())
    return {"measured": run["F_x"][about].mean().abs().item() / N, "theory": theory.coefficient}
