"""The rig of `orientation.py` in its variants: gains by design, other shapes and speeds, friction, efforts fed forward; and
what rigid bodies predict of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft import (
    PD,
    Actuator,
    Circle,
    Profile,
    Reference,
    Rig,
    Sampled,
    Shape,
    SimulationFailed,
    SmoothSlip,
    Trajectory,
)
from torchsoft import simulate as simulated
from torchsoft.physics.motion import Piecewise, hold
from torchsoft.physics.statics import resting, standing
from torchsoft.rigs import RigFile
from torchsoft.rigs.build import assemble
from torchsoft.solve.stability import NEUTRAL, modes

FILE = Path(__file__).parents[1] / "rigs" / "orientation.toml"

GRIPPED = 0.5
"""Time [s] from which errors count: the grip is closed, and the turn begins."""

LOOPS = ("carry_lower", "carry_upper", "turn_lower", "turn_upper")
"""The loops whose efforts may be fed forward; the one on y has a feed-forward already."""

MM, DEGREES = 1e3, 180 / torch.pi


class Gains(NamedTuple):
    """A bandwidth [rad/s] and a damping ratio, and the gains that give them to a rig of rigid parts that roll."""

    bandwidth: float
    damping: float
    carry: float  # half of the moved mass [kg]
    turn: float  # force [N] on each jaw over angular acceleration [1/s2]
    lift: float  # moved mass [kg]

    def of(self, inertia: float) -> dict[str, float]:
        """Kp = w^2 M, Kd = 2 zeta w M."""
        return {"Kp": self.bandwidth**2 * inertia, "Kd": 2 * self.damping * self.bandwidth * inertia}

    @property
    def table(self) -> dict[str, dict[str, float]]:
        """Gains by actuator, as a rig file has them."""
        parts = {"carry": ("carry_lower", "carry_upper"), "turn": ("turn_lower", "turn_upper"), "lift": ("lift",)}
        return {loop: self.of(getattr(self, part)) for part, loops in parts.items() for loop in loops}


def design(file: RigFile, bandwidth: float, damping: float = 1.0) -> Gains:
    """Gains for the disc of a file: forces F on both jaws give 2 F = (m + 2 m_J) x'', forces +-F give
    F = (m_J R + I / 2 R) theta''."""
    m, m_J, shape = file.bodies["disc"].mass, file.bodies["lower"].mass, file.bodies["disc"].shape
    assert m is not None
    assert m_J is not None
    assert shape is not None
    disc = shape.build(file.folder)
    assert isinstance(disc, Circle)
    R = float(disc.radius.detach())
    moved, I = m + 2 * m_J, m * float(disc.gyration().detach())
    return Gains(bandwidth, damping, moved / 2, m_J * R + I / (2 * R), moved)


@dataclass(frozen=True)
class Case:
    """A rig, its start y0 (size,), and the signals that it follows."""

    rig: Rig
    y0: Tensor
    signals: dict[str, nn.Module]
    end: float  # of the run [s]


class Outcome(NamedTuple):
    """A run in numbers: errors from `GRIPPED` on, largest and where everything is at rest, and what pushed."""

    position_mm: float
    angle_deg: float
    rest_mm: float
    rest_deg: float
    friction: float  # largest sum of the friction forces at a pad over that of the normal ones
    effort: float  # largest effort of the loop on theta [N]
    opening_mm: float  # largest change of the distance between the jaws
    stopped: str  # why the run ended early; empty if it did not

    def within(self, position_mm: float, angle_deg: float) -> bool:
        return not self.stopped and self.position_mm <= position_mm and self.angle_deg <= angle_deg


def file_of(gains: Gains | None, **groups: dict[str, Any]) -> RigFile:
    """The rig file with gains by design, and with signals for efforts to be fed forward, which are zero at first."""
    loops = {loop: {"feed_forward": f"known_{loop}"} for loop in LOOPS}
    zero = {f"known_{loop}": {"kind": "profile", "times": [0.0], "values": [0.0]} for loop in LOOPS}
    file = RigFile.from_toml(FILE).override(**groups).override(actuators=loops, motion=zero)
    return file if gains is None else file.override(actuators=gains.table)


def case_of(file: RigFile, shape: Shape | None = None) -> Case:
    """The rig with another shape in place of the disc, between jaws that are as far from its surface."""
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
    held = {name: {"x": float(start[name][0]), "y": float(start[name][1])} for name in ("lower", "upper")}
    still = assemble(file, held, loops=())
    ready.rig.bodies["disc"].shape = still.bodies["disc"].shape = shape
    rest = resting(still, start)
    profile, y = signals["y_d"], float(rest["disc"][1])
    assert isinstance(profile, Profile)
    shifted = Profile(profile.times, profile.values.detach() + y - profile.values.detach()[0])
    return Case(ready.rig, standing(ready.rig, rest), signals | {"y_d": shifted}, case.end)


def faster(case: Case, speed: float) -> Case:
    """The same, with everything after the grip so many times faster."""

    def at(times: Tensor) -> Tensor:
        return torch.where(times < GRIPPED, times, GRIPPED + (times - GRIPPED) / speed)

    signals = {}
    for name, one in case.signals.items():
        assert isinstance(one, Profile)
        signals[name] = Profile(at(one.times), one.values.detach())
    return Case(case.rig, case.y0, signals, GRIPPED + (case.end - GRIPPED) / speed)


def friction_of(case: Case) -> SmoothSlip:
    """The friction law that both contacts share."""
    slip = case.rig.contacts["lower"].law.friction
    assert isinstance(slip, SmoothSlip)
    return slip


def rubbed(case: Case, mu: float) -> None:
    """Give the law of both contacts a static coefficient of friction, the kinetic one in the same ratio as before."""
    slip = friction_of(case)
    with torch.no_grad():
        slip.mu_k.mul_(mu / slip.mu_s)
        slip.mu_s.fill_(mu)


def fed(case: Case, run: Trajectory) -> Case:
    """The same, with the efforts of a run before fed forward."""
    efforts = {f"known_{loop}": run[f"F_{loop}"] for loop in LOOPS} | {"bear": run["F_lift"]}
    return Case(case.rig, case.y0, case.signals | {k: Sampled(run.t, v.detach()) for k, v in efforts.items()}, case.end)


def by_kinematics(case: Case, gains: Gains, R: float) -> Case:
    """Jaws that follow what rolling of a rigid disc would be, each under a loop of its own that does not see the disc:
    x_J = x_d +- R theta_d."""
    rig, signals = case.rig, dict(case.signals)
    start = rig.unpack(case.y0).pose
    times = torch.linspace(0.0, case.end, 901, dtype=torch.float64)
    x_d, theta_d = (signals[name](times)[0].detach() for name in ("x_d", "theta_d"))
    jaws = {}
    for jaw, sign in (("lower", 1.0), ("upper", -1.0)):
        signals[f"{jaw}_d"] = Sampled(times, float(start[jaw][0]) + x_d + sign * R * theta_d)
        jaws[f"carry_{jaw}"] = Actuator(f"{jaw}.x", f"{jaw}.x", PD(**gains.of(gains.carry)), setpoint=f"{jaw}_d")
    own = {name: rig.actuators[name] for name in ("lift", "grip")}
    alone = Rig(
        bodies=rig.bodies,
        pads=rig.pads,
        contacts=rig.contacts,
        actuators=jaws | own,
        gravity=float(rig.gravity.detach()),
    )
    return Case(alone, case.y0, signals, case.end)


def simulate(case: Case, rtol: float) -> tuple[Trajectory, str]:
    """A run every 10 ms, or what there is of it, and why it ended early."""
    t = torch.linspace(0.0, case.end, round(100 * case.end) + 1, dtype=torch.float64)
    try:
        return simulated(case.rig, t, y0=case.y0, reference=Reference(**case.signals), rtol=rtol), ""
    except SimulationFailed as failure:
        if failure.trajectory is None:
            raise
        return failure.trajectory, failure.reason


def errors(case: Case, run: Trajectory) -> tuple[Tensor, Tensor]:
    """How far the centre is from where it should be [mm], and the angle [deg], (T,)."""
    wanted = {name: case.signals[f"{name}_d"](run.t)[0].detach() for name in ("x", "y", "theta")}
    x, y, theta = (run[f"{name}_disc"].detach() - w for name, w in wanted.items())
    return MM * torch.hypot(x, y), DEGREES * theta


def outcome(case: Case, run: Trajectory, stopped: str = "") -> Outcome:
    position, angle = errors(case, run)
    later = run.t >= GRIPPED - 1e-9
    angle, effort = angle.abs(), run["F_turn_lower"] if "F_turn_lower" in run.channels else torch.zeros_like(run.t)
    turn = case.signals["x_d"]
    assert isinstance(turn, Piecewise)
    rests = [run.at(float(turn.times[0])), len(run.t) - 1]  # the turn has come to rest when the way begins
    share = [f[later, :, 1].sum(-1).abs() / f[later, :, 0].sum(-1).clamp(min=1e-9) for f in run.force.values()]
    opening = run["y_upper"].detach() - run["y_lower"].detach()
    return Outcome(
        float(position[later].max()), float(angle[later].max()), float(position[rests].max()), float(angle[rests].max()),
        float(torch.stack(share).max()), float(effort.detach()[later].abs().max()),
        MM * float((opening - opening[run.at(GRIPPED)])[later].abs().max()), stopped,
    )  # fmt: skip


def gripped_modes(case: Case, run: Trajectory) -> complex:
    """The mode of the closed loops in the closed grip that lasts longest [1/s]. Raises `ValueError` for one that grows."""
    row = run.at(GRIPPED)
    now = {name: float(one(run.t[row])[0].detach()) for name, one in case.signals.items()}
    values = modes(case.rig, run.y[row].detach(), hold(**now)).values
    if float(values[0].real) > NEUTRAL:
        raise ValueError(
            f"these gains are unstable: the leading mode is {complex(values[0]):.3g} 1/s; lower `bandwidth`"
        )
    return complex(values[values.real < -NEUTRAL][0])


class Rigid(NamedTuple):
    """What rolling of a rigid shape between rigid plates asks for in a quarter turn, at rest."""

    friction: float  # coefficient of friction, at the upper pad
    effort: float  # of each jaw [N]
    opening_mm: float


def rigid(shape: Shape, grip: float, weight: float) -> Rigid:
    """With the support function h of the angle: the plates' normal forces N and N + W act h' beside the centre, and the
    friction F on either plate balances their couple: 2 F h = (2 N + W) h'."""
    points = shape.outline(1441).numpy()
    angle = np.linspace(0, 2 * np.pi, len(points))
    n, t = (np.stack(axes, -1) for axes in ((np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))))
    quarter = (angle >= np.pi) & (angle <= 1.5 * np.pi)  # the normals that look down in the course of the turn
    h, slope = ((points * axes).sum(-1)[quarter] for axes in (n, t))
    F = (grip + weight / 2) * float(np.abs(slope / h).max())
    return Rigid(F / grip, F, 2 * MM * float(np.abs(h - h[-1]).max()))
