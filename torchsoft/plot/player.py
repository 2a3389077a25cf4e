"""The interactive player: a run as one self-contained HTML file for any browser.

Pads deform and show a quantity, bodies move, contact points show their state and forces; charts
follow the time.
"""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchsoft.channels import CHANNELS
from torchsoft.files import save_text
from torchsoft.physics.mesh import Array
from torchsoft.physics.setup import von_mises
from torchsoft.plot.dashboard import RIPPLE, curves, ripples, sums
from torchsoft.plot.figures import COLOURS
from torchsoft.plot.scene import (
    MM,
    along_surface,
    force_scale,
    instants,
    own_axes,
    plates,
    straight_up,
)
from torchsoft.solve.trajectory import Trajectory

TEMPLATE = Path(__file__).with_name("player.html")

CHART_SAMPLES = 1500
"""Most samples of a chart."""

LEVELS = 65535

DENSER = 0.3
"""Share of the frames that are spaced by steps, not by time."""


def packed(values: Array) -> dict[str, Any]:
    """Numbers quantised to 16 bits between their extremes, in base 64, with their shape."""
    low, high = float(np.min(values, initial=np.inf)), float(np.max(values, initial=-np.inf))
    if not values.size:
        low = high = 0.0
    step = (high - low) / LEVELS
    codes = np.round((values - low) / (step or 1.0)).astype("<u2")
    return {"low": low, "step": step, "codes": encoded(codes), "shape": list(values.shape)}


def encoded(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def frame_rows(run: Trajectory, frames: int) -> list[int]:
    """Rows of the run for `frames` frames or fewer, each once; denser where the steps were
    shorter."""
    t, knots = run.t.numpy(), run.knots.numpy()
    count = np.interp(t, knots, np.linspace(0.0, 1.0, len(knots)))
    clock = (1 - DENSER) * (t - t[0]) / (t[-1] - t[0]) + DENSER * count
    return sorted({int(np.abs(clock - x).argmin()) for x in np.linspace(0.0, clock[-1], frames)})


def pads(run: Trajectory, rows: list[int]) -> dict[str, Any]:
    """Meshes, node positions in the frame of the base [mm] and stresses of the elements [kPa], by
    pad."""
    out = {}
    for name, pad in run.setup.pads.items():
        whole = pad.displacement(run.displacement[name][rows].detach().numpy())
        stress = 1e-3 * pad.stress(pad.strain(whole))
        direct = {
            "von Mises stress": von_mises(stress),
            "pressure": -stress[..., :3].mean(-1),
            "shear stress": stress[..., 3],
        }
        out[name] = {
            "base": pad.base, "nodes": packed(MM * pad.placed(pad.mesh.nodes + whole)),
            "still": (MM * pad.placed(pad.mesh.nodes)).round(6).ravel().tolist(),
            "elements": pad.mesh.elements.ravel().tolist(),
            "outline": pad.mesh.outline.tolist(),
            "fields": {key: packed(values) for key, values in direct.items()},
        }  # fmt: skip
        left, right = MM * pad.mesh.base
        thickness = plates(run.setup)[name]
        if thickness:
            corners = np.array([left, [right[0], left[1]], [right[0], left[1] - thickness],
                                [left[0], left[1] - thickness]])  # fmt: skip
            out[name]["plate"] = (MM * pad.placed(corners / MM)).ravel().tolist()
    return out


def contacts(run: Trajectory, rows: list[int]) -> dict[str, Any]:
    """Positions of the points in the frame of the base [mm], forces [N] and states, by contact;
    `along` is the direction along the surface, `up` its outward normal."""
    out = {}
    for name, contact in run.setup.contacts.items():
        pad = run.setup.pads[contact.pad]
        u = run.displacement[contact.pad][rows].detach().numpy()
        still = np.zeros(3)
        direction, (_, up) = along_surface(pad, still), own_axes(pad, still)
        turn = float(np.sign(direction @ np.array([up[1], -up[0]])))
        force = run.force[name][rows].detach().numpy() * [1.0, turn]
        out[name] = {
            "pad": contact.pad, "body": contact.body, "mu": contact.friction.get("mu_s"),
            "along": direction.tolist(), "up": up.tolist(),
            "points": packed(MM * pad.surface_points(u)), "force": packed(force),
            "state": encoded(run.contact_state[name][rows].numpy().astype(np.int8)),
        }  # fmt: skip
    return out


def charts(run: Trajectory) -> list[dict[str, Any]]:
    """The times, then groups of curves over time, each group with one unit. Forces of less than a
    billionth of the largest are drawn as zero."""
    rows = np.unique(np.linspace(0, len(run.t) - 1, CHART_SAMPLES).round().astype(int))
    t = run.t.numpy()[rows].round(9).tolist()
    out: list[dict[str, Any]] = []

    def group(name: str, unit: str, lines: list[tuple[str, Array, str]], least: float = 0) -> None:
        series = [
            {"name": one, "colour": colour, "values": packed(np.where(abs(x) > least, x, 0.0))}
            for one, values, colour in lines
            for x in [np.nan_to_num(values[rows])]
        ]
        out.append({"name": name, "unit": unit, "series": series})

    for curve in curves(run):
        name, _, unit = curve.label.rpartition(" [")
        lines = [("actual", curve.values, COLOURS[0])]
        if curve.setpoint is not None:
            lines.insert(0, ("set-point", curve.setpoint, "#999999"))
        group(name, unit.rstrip("]"), lines)
    if run.force:
        least = 1e-9 * max(float(x[..., 0].detach().sum(-1).max()) for x in run.force.values())
        for kind, (unit, series) in sums(run).items():
            lines = [(*one, colour) for one, colour in zip(series.items(), COLOURS * len(series))]
            group(kind, unit, lines, {"N": least, "%": 1e-7}.get(unit, 0.0))
    shown = {one for body in run.setup.bodies.values() for one in body.channels.values()}
    for name, values in run.channels.items():
        if name not in shown and float(values.detach().abs().max()) > 0:
            unit = run.units.get(name) or (CHANNELS[name].unit if name in CHANNELS else "")
            group(name, unit, [(name, values.detach().numpy(), COLOURS[0])])
    return [{"t": t}, *out]


def player(
    run: Trajectory, path: Path, *, frames: int = 300, title: str = "", progress: bool = False
) -> None:
    """Write the player with `frames` frames, a megabyte a hundred for pads like the paper's. The
    file appears whole or not at all. Raises `ValueError` for less than two frames."""
    if frames < 2:
        raise ValueError(f"`frames` must be 2 or more, but is {frames}")
    rows = frame_rows(run, frames)
    times = run.t.numpy()[rows]
    shown = instants(run, [times[0], times[len(times) // 2], times[-1]])
    (first, *curves_) = charts(run)
    about = {
        "title": title or "torchsoft", "times": times.round(9).tolist(),
        "bodies": {
            name: {
                "pose": packed(run.state.pose[name][rows].detach().numpy() * [MM, MM, 1.0]),
                "outline": None if body.outline is None else (MM * body.outline).ravel().tolist(),
                "spoke": None if body.outline is None else straight_up(MM * body.outline).tolist(),
            }
            for name, body in run.setup.bodies.items()
        },
        "pads": pads(run, rows), "contacts": contacts(run, rows),
        "scale": force_scale(run.setup, shown)[0], "thickness": plates(run.setup),
        "t": first["t"], "charts": curves_, "note": RIPPLE if ripples(run) else "",
        "made": {k: str(v) for k, v in run.made_by.items() if isinstance(v, str)},
    }  # fmt: skip
    data = json.dumps(about, allow_nan=False).replace("</", "<\\/")
    page = TEMPLATE.read_text(encoding="utf-8").replace("/*DATA*/null", data)
    save_text(path, page)
