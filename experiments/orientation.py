"""Question: can PD loops turn a disc between two soft pads by 90 degrees with its centre held, then
carry it with its orientation held, within 0.1 mm and 0.5 degrees; and where do loops alone no
longer do it?

The ready rig `orientation` has each pad on a jaw of its own; the loop on disc.x pushes both jaws
the same way, the loop on disc.theta pushes them against each other, the loop on disc.y lifts the
lower jaw, and a force grips from above. Gains by design: one bandwidth w, damping 1, for the masses
of rigid parts that roll. Errors count from the closed grip on.
  kinematics  jaws under loops of their own, driven as a rigid disc would roll: what it costs not to
              see the disc
  speed       everything after the grip faster; rigid parts lag behind by a / w^2
  friction    less of it: a shape between rigid plates asks for mu = max h'/h (1 + W / 2 N), with
              its support function h, grip N and weight W (the friction cone)
  shape       ellipses of the disc's area and a rounded box: the grip turns them with F = max h'/h
              (N + W / 2) on either jaw, for which the loop needs an error F / Kp; then with the
              efforts of the run before fed forward

Command: .venv/bin/python experiments/orientation.py [--smoke]
Expected: the disc within 0.009 mm and 0.09 degrees, 0.0005 mm and 0.003 degrees at rest; by
kinematics 2.1 degrees off. Beyond the tolerance: the disc four times as fast (inertia); by loops
alone the ellipse of 1.1 and all that is farther from a disc, which efforts fed forward mend for
1.1, 1.3 and the box; the ellipse of 1.3 with mu below its friction cone of 0.29; the
ellipse of 2, which asks for 0.82 and has 0.8, and is lost. Little more than a minute on one core.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from torchsoft import (
    PD,
    Actuator,
    Circle,
    Ellipse,
    Profile,
    Reference,
    Rig,
    RoundedBox,
    Sampled,
    Shape,
    SimulationFailed,
    SmoothSlip,
    Trajectory,
)
from torchsoft import simulate as simulated
from torchsoft.experiment import grid, markdown, options, timed, write
from torchsoft.physics.motion import Piecewise, evaluate
from torchsoft.physics.statics import resting, standing
from torchsoft.plot.animation import animate
from torchsoft.plot.figures import snapshots
from torchsoft.rigs import RigFile

READY = RigFile.ready("orientation")

GRIPPED = 0.5
"""Time [s] from which errors count: the grip is closed, and the turn begins."""

LOOPS = ("carry_lower", "carry_upper", "turn_lower", "turn_upper")
"""The loops whose efforts may be fed forward; the one on y has a feed-forward already."""

MM, DEGREES = 1e3, 180 / torch.pi


Gains = dict[str, dict[str, float]]
"""Kp and Kd of every loop, as a rig file has them."""


def design(file: RigFile, bandwidth: float) -> Gains:
    """Kp = w^2 M and Kd = 2 w M, of damping 1, for the disc of a file rolling as rigid parts do:
    forces F on both jaws give 2 F = (m + 2 m_J) x'', forces +-F give F = (m_J R + I / 2 R)
    theta''."""
    m, m_J, shape = file.bodies["disc"].mass, file.bodies["lower"].mass, file.bodies["disc"].shape
    assert m is not None and m_J is not None and shape is not None  # noqa: PT018
    disc = shape.build(file.folder)
    assert isinstance(disc, Circle)
    R, moved = disc.radius.item(), m + 2 * m_J
    turn = m_J * R + m * disc.gyration().item() / (2 * R)
    inertia = dict.fromkeys(LOOPS[:2], moved / 2) | dict.fromkeys(LOOPS[2:], turn) | {"lift": moved}
    return {loop: {"Kp": bandwidth**2 * M, "Kd": 2 * bandwidth * M} for loop, M in inertia.items()}


@dataclass(frozen=True)
class Case:
    """A rig, its start y0 (size,), and the signals that it follows."""

    rig: Rig
    y0: Tensor
    signals: dict[str, nn.Module]
    end: float  # of the run [s]


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/orientation")
    position_mm: float = 0.1  # tolerance of the centre
    angle_deg: float = 0.5  # and of the orientation
    bandwidth: float = (
        150.0  # of the loops [rad/s]; assumed, for the model has no delay that would limit it
    )
    speeds: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)  # of the disc
    aspects: tuple[float, ...] = (1.1, 1.3, 2.0)  # of the ellipses
    frictions: tuple[float, ...] = (0.5, 0.35, 0.32, 0.3, 0.28, 0.25, 0.2)
    passes: int = 2  # runs whose efforts are fed forward, one after the other
    rtol: float = 1e-4
    smoke: bool = False  # a size that takes seconds


class Outcome(NamedTuple):
    """A run in numbers: errors from `GRIPPED` on, largest and where everything is at rest, and what
    pushed."""

    position_mm: float
    angle_deg: float
    rest_mm: float
    rest_deg: float
    friction: float  # largest sum of the friction forces at a pad over that of the normal ones
    effort: float  # largest effort of the loop on theta [N]
    opening_mm: float  # largest change of the distance between the jaws
    verdict: str  # "within" or "beyond" the tolerance, or "lost"
    stopped: str  # why the run ended early; empty if it did not


def file_of(gains: Gains, **groups: dict[str, Any]) -> RigFile:
    """The rig file with gains by design, and with signals for efforts to be fed forward, which are
    zero at first."""
    loops = {loop: {"feed_forward": f"known_{loop}"} for loop in LOOPS}
    zero = {f"known_{loop}": {"kind": "profile", "times": [0.0], "values": [0.0]} for loop in LOOPS}
    file = READY.override(**groups)
    return file.override(actuators=loops, motion=zero).override(actuators=gains)


def case_of(file: RigFile, shape: Shape | None = None) -> Case:
    """The rig with another shape in place of the disc, between jaws that are as far from its
    surface."""
    ready = file.build()
    signals = {name: ready.rig.reference[name] for name in ready.rig.signals}
    case = Case(ready.rig, ready.y0, signals, file.outputs.duration)
    if shape is None:
        return case
    start = {name: pose.detach().clone() for name, pose in ready.rig.unpack(ready.y0).pose.items()}
    disc = ready.rig.bodies["disc"].shape
    assert disc is not None
    down = torch.tensor([0.0, -1.0], dtype=torch.float64)
    lower = float((disc.support(down) - shape.support(down)).detach())
    start["disc"][1] -= lower
    start["upper"][1] -= 2 * lower
    ready.rig.bodies["disc"].shape = shape
    with torch.no_grad():
        rest = resting(ready.rig, start, {"disc": (0, 1, 2)}, actuators=())
        y0 = standing(ready.rig, rest)
    profile, y = signals["y_d"], float(rest["disc"][1])
    assert isinstance(profile, Profile)
    shifted = Profile(profile.times, profile.values.detach() + y - profile.values.detach()[0])
    return Case(ready.rig, y0, signals | {"y_d": shifted}, case.end)


def faster(case: Case, speed: float) -> Case:
    """The same, with everything after the grip so many times faster."""

    def at(times: Tensor) -> Tensor:
        return torch.where(times < GRIPPED, times, GRIPPED + (times - GRIPPED) / speed)

    signals = {}
    for name, one in case.signals.items():
        assert isinstance(one, Profile)
        signals[name] = Profile(at(one.times), one.values.detach())
    return replace(case, signals=signals, end=GRIPPED + (case.end - GRIPPED) / speed)


def rubbed(case: Case, mu: float) -> None:
    """Give the law that both contacts share a static coefficient of friction, the kinetic one in
    the same ratio as before."""
    slip = case.rig.contacts["lower"].law.friction
    assert isinstance(slip, SmoothSlip)
    with torch.no_grad():
        slip.mu_k.mul_(mu / slip.mu_s)
        slip.mu_s.fill_(mu)


def fed(case: Case, run: Trajectory) -> Case:
    """The same, with the efforts of a run before fed forward."""
    efforts = {f"known_{loop}": run[f"effort_{loop}"] for loop in LOOPS} | {
        "bear": run["effort_lift"]
    }
    known = {k: Sampled(run.t, v.detach()) for k, v in efforts.items()}
    return replace(case, signals=case.signals | known)


def by_kinematics(case: Case, gains: Gains, R: float) -> Case:
    """Jaws that follow what rolling of a rigid disc would be, each under a loop of its own that
    does not see the disc: x_J = x_d +- R theta_d."""
    rig, signals = case.rig, dict(case.signals)
    start = rig.unpack(case.y0).pose
    times = grid(case.end, case.end / 900)
    x_d, theta_d = (signals[name](times)[0].detach() for name in ("x_d", "theta_d"))
    jaws = {}
    for jaw, sign in (("lower", 1.0), ("upper", -1.0)):
        signals[f"{jaw}_d"] = Sampled(times, float(start[jaw][0]) + x_d + sign * R * theta_d)
        jaws[f"carry_{jaw}"] = Actuator(
            f"{jaw}.x", f"{jaw}.x", PD(**gains[f"carry_{jaw}"]), setpoint=f"{jaw}_d"
        )
    own = {name: rig.actuators[name] for name in ("lift", "grip")}
    gravity = rig.gravity.item()
    alone = Rig(
        bodies=rig.bodies, pads=rig.pads, contacts=rig.contacts, actuators=jaws | own,
        gravity=gravity,
    )  # fmt: skip
    return replace(case, rig=alone, signals=signals)


def simulate(case: Case, rtol: float) -> tuple[Trajectory, str]:
    """A run every 10 ms, or what there is of it, and why it ended early."""
    t, reference = grid(case.end), Reference(**case.signals)
    try:
        return simulated(case.rig, t, y0=case.y0, reference=reference, rtol=rtol), ""
    except SimulationFailed as failure:
        if failure.trajectory is None:
            raise
        return failure.trajectory, failure.reason


def errors(case: Case, run: Trajectory) -> tuple[Tensor, Tensor]:
    """How far the centre is from where it should be [mm], and the angle [deg], (T,)."""
    setpoints = {name: case.signals[f"{name}_d"](run.t)[0].detach() for name in ("x", "y", "theta")}
    x, y, theta = (run[f"{name}_disc"].detach() - w for name, w in setpoints.items())
    return MM * torch.hypot(x, y), DEGREES * theta


def outcome(case: Case, run: Trajectory, stopped: str, config: Config) -> Outcome:
    position, angle = errors(case, run)
    later = run.t >= GRIPPED - 1e-9
    angle, effort = (
        angle.abs(),
        run["effort_turn_lower"]
        if "effort_turn_lower" in run.channels
        else torch.zeros_like(run.t),
    )
    turn, end = case.signals["x_d"], float(run.t[-1])
    assert isinstance(turn, Piecewise)
    # the turn has come to rest when the way begins
    rests = [run.at(min(float(turn.times[0]), end)), len(run.t) - 1]
    share = [
        f[later, :, 1].sum(-1).abs() / f[later, :, 0].sum(-1).clamp(min=1e-9)
        for f in run.force.values()
    ]
    opening = run["y_upper"].detach() - run["y_lower"].detach()
    off = float(position[later].max()), float(angle[later].max())
    within = off[0] <= config.position_mm and off[1] <= config.angle_deg
    return Outcome(
        *off, float(position[rests].max()),
        float(angle[rests].max()), float(torch.stack(share).max()),
        float(effort.detach()[later].abs().max()),
        MM * float((opening - opening[run.at(min(GRIPPED, end))])[later].abs().max()),
        "lost" if stopped else "within" if within else "beyond", stopped,
    )  # fmt: skip


class Rigid(NamedTuple):
    """What rolling of a rigid shape between rigid plates asks for in a quarter turn, at rest."""

    friction: float  # coefficient of friction, at the upper pad
    effort: float  # of each jaw [N]
    opening_mm: float


def rigid(shape: Shape, grip: float, weight: float) -> Rigid:
    """With the support function h of the angle: the plates' normal forces N and N + W act h' beside
    the centre, and the friction F on either plate balances their couple: 2 F h = (2 N + W) h'."""
    points = shape.outline(1441).numpy()
    angle = np.linspace(0, 2 * np.pi, len(points))
    n, t = (
        np.stack(axes, -1)
        for axes in ((np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle)))
    )
    quarter = (angle >= np.pi) & (
        angle <= 1.5 * np.pi
    )  # the normals that look down in the course of the turn
    h, slope = ((points * axes).sum(-1)[quarter] for axes in (n, t))
    F = (grip + weight / 2) * float(np.abs(slope / h).max())
    return Rigid(F / grip, F, 2 * MM * float(np.abs(h - h[-1]).max()))


DISC, KINEMATICS, SLIPPING = "disc", "disc, by kinematics", "ellipse 1.3"
"""Runs by name; the friction of the last is varied."""


GROUPS = {
    "loops_alone": "{}",
    "efforts_fed_forward": "{}, efforts fed forward",
    "speeds": "disc, {} times as fast",
    "frictions": "ellipse, fed forward, mu = {}",
}
"""Groups of runs, and what the table calls one of them."""


@dataclass(frozen=True)
class Result:
    """Outcomes by group and key, predictions of rigid statics by shape, lags a / w^2 [mm, deg] by
    speed, and runs to be drawn."""

    gains: Gains
    outcomes: dict[str, dict[str, Outcome]]
    rigid: dict[str, Rigid]
    lags: dict[str, tuple[float, float]]
    runs: dict[str, Trajectory]

    def content(self) -> dict[str, Any]:
        """What `summary.json` holds."""
        by_group = {
            group: {key: one._asdict() for key, one in some.items()}
            for group, some in self.outcomes.items()
        }
        rigid = {name: one._asdict() for name, one in self.rigid.items()}
        return {"gains": self.gains, "inertia_alone_mm_deg": self.lags, "rigid": rigid, **by_group}


def table(result: Result) -> str:
    """Every run in a row, and what rigid parts ask for."""
    head = (
        "run", "centre [mm]", "angle [deg]", "at rest [mm]", "[deg]", "friction / normal",
        "effort [N]", "verdict",
    )  # fmt: skip
    rows = [
        (
            GROUPS[group].format(key),
            f"{x.position_mm:.4f}",
            f"{x.angle_deg:.3f}",
            f"{x.rest_mm:.4f}",
            f"{x.rest_deg:.4f}",
            f"{x.friction:.3g}",
            f"{x.effort:.3g}",
            x.verdict,
        )
        for group, some in result.outcomes.items()
        for key, x in some.items()
    ]
    demand = markdown(
        ("rigid", "asks for a friction of"),
        [(name, f"{one.friction:.3g}") for name, one in result.rigid.items()],
    )
    return f"{markdown(head, rows)}\n\n{demand}"


def peak(signal: Any) -> float:
    """Largest second derivative of a piecewise signal."""
    assert isinstance(signal, Piecewise)
    t = torch.linspace(0.0, float(signal.times[-1]), 4001, dtype=torch.float64)
    return float(evaluate(signal.pieces(), t, 2)[2].detach().abs().max())


def shapes(config: Config, R: float) -> dict[str, Shape]:
    """Ellipses of the disc's area, and a square box with corners rounded to half."""
    found: dict[str, Shape] = {
        f"ellipse {k:g}": Ellipse(R * k**0.5, R / k**0.5) for k in config.aspects
    }
    box = {} if config.smoke else {"rounded box": RoundedBox(0.9 * R, 0.9 * R, 0.45 * R)}
    return found | box


def inertia_alone(case: Case, bandwidth: float) -> tuple[float, float]:
    """The errors a / w^2 of centre [mm] and orientation [deg] at the largest accelerations of the
    set-points."""
    x, y, theta = (peak(case.signals[name]) / bandwidth**2 for name in ("x_d", "y_d", "theta_d"))
    return MM * (x**2 + y**2) ** 0.5, DEGREES * theta


def run(config: Config) -> Result:
    if config.smoke:
        config = replace(
            config, speeds=(6.0,), aspects=(1.3,), frictions=(0.2,), passes=1, rtol=1e-3
        )
    mesh = {"elements_x": 35, "elements_y": 2}
    gains = design(READY, config.bandwidth)
    file = file_of(gains, pads={"lower": mesh, "upper": mesh}) if config.smoke else file_of(gains)
    base = case_of(file)
    disc = base.rig.bodies["disc"]
    assert isinstance(disc.shape, Circle)
    R = disc.shape.radius.item()
    weight = base.rig.gravity.item() * disc.mass.item()
    grip = -float(base.signals["grip"](torch.tensor(base.end, dtype=torch.float64))[0].detach())
    outcomes: dict[str, dict[str, Outcome]] = {group: {} for group in GROUPS}
    result = Result(gains, outcomes, {DISC: rigid(disc.shape, grip, weight)}, {}, {})
    bar = tqdm(unit="run", disable=None)

    def attempt(case: Case, group: str, key: object) -> Trajectory:
        done, stopped = simulate(case, config.rtol)
        outcomes[group][str(key)] = outcome(case, done, stopped, config)
        bar.update()
        return done

    result.runs[DISC] = attempt(base, "loops_alone", DISC)
    attempt(by_kinematics(base, gains, R), "loops_alone", KINEMATICS)
    for speed in config.speeds:
        case = faster(base, speed)
        result.lags[str(speed)] = inertia_alone(case, config.bandwidth)
        attempt(case, "speeds", speed)
    for name, shape in shapes(config, R).items():
        case, result.rigid[name] = case_of(file, shape), rigid(shape, grip, weight)
        done, last = attempt(case, "loops_alone", name), outcomes["loops_alone"]
        for _ in range(config.passes):
            if last[name].stopped:
                break
            case, last = fed(case, done), outcomes["efforts_fed_forward"]
            done = result.runs[name] = attempt(case, "efforts_fed_forward", name)
        if name == SLIPPING and not last[name].stopped:
            case = fed(case, done)
            for mu in config.frictions:
                rubbed(case, mu)
                attempt(case, "frictions", mu)
    bar.close()
    return result


def main(config: Config) -> None:
    result, wall = timed(lambda: run(config))
    stills = snapshots(
        result.runs[DISC], (0.5, 1.1, 1.5, 2.5, 3.5, 4.5), title="A disc turned, then carried"
    )
    write(config, result.content() | {"wall_s": wall}, {"snapshots": stills}, table(result))
    for file, name, title in (
        ("orientation.gif", DISC, "A disc turned by 90 degrees between two jaws, then carried"),
        ("ellipse.gif", SLIPPING, f"{SLIPPING}, with efforts fed forward: the jaws give way"),
    ):
        if name in result.runs:
            animate(
                result.runs[name], config.out / file, frames=2 if config.smoke else 90,
                title=title, follow="disc.theta",
            )  # fmt: skip


if __name__ == "__main__":
    main(options(Config, __doc__))
