"""Every shape, material, pad, law, loop and motion in a rig of its own, through the same tester."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import RUBBER, f64, times
from rig_tester import (
    Start,
    assert_compiled_is_the_module,
    assert_gradients_exact,
    assert_parts_are_kept,
    assert_rates_differentiable,
    at_random,
    telling,
)
from test_meshes import trapezium
from torch import Tensor, nn

from torchsoft import (
    PD,
    Actuator,
    AgeingSlip,
    Body,
    Circle,
    Contact,
    Contour,
    Coulomb,
    CurvedPadMesh,
    Ellipse,
    FingertipMesh,
    GeneralisedKelvin,
    Integral,
    KelvinVoigt,
    Lagging,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Pad,
    PadMesh,
    Profile,
    Prony,
    RateAndState,
    Reference,
    Rig,
    RoundedBox,
    RoundedPolygon,
    Sampled,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
    StateFeedback,
    Superellipse,
    Yeoh,
    controller,
    simulate,
)
from torchsoft.physics.extensions import extend, extensions
from torchsoft.physics.hyperelastic import Hyperelastic, invariants
from torchsoft.physics.mesh import Mesh
from torchsoft.physics.statics import standing
from torchsoft.testing import check_power

MESH = PadMesh(60e-3, 4.59e-3, 30, 2)
R = 19.37e-3
END = 0.01
"""Of the runs [s]."""
DEPTH = 4e-4
"""By which the jaw is pressed on at the start [m]."""


def along(angles: np.ndarray, a: float, b: float) -> np.ndarray:
    return np.stack((a * np.cos(angles), b * np.sin(angles)), -1)


class NetworkFriction(nn.Module):
    """A coefficient of friction that a small network makes of the normal force."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.net = nn.Sequential(nn.Linear(1, 4), nn.Tanh(), nn.Linear(4, 1)).double()
        for p in self.net.parameters():
            p.data = 0.3 * torch.randn(p.shape, generator=generator, dtype=torch.float64)
        self.level = nn.Parameter(f64(0.3)[0])

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = self.level * (1 + 0.2 * torch.tanh(self.net(0.1 * F_N[..., None])[..., 0]))
        return (E - mu * F_N).clamp(min=0.0) / R


class Saturated(nn.Module):
    """PD up to an effort that it learns."""

    def __init__(self, most: float) -> None:
        super().__init__()
        self.pd, self.most = PD(1.2e5, 441.7), nn.Parameter(f64(most)[0])

    def forward(self, *x: Tensor) -> Tensor:
        return self.most * torch.tanh(self.pd(*x) / self.most)


class Policy(nn.Module):
    """Loops of x, y and theta, whose efforts a network of set-points and the whole state
    corrects."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.net = nn.Sequential(nn.Linear(18, 5), nn.Tanh(), nn.Linear(5, 3)).double()
        self.Kp, self.Kd = (
            nn.Parameter(f64(*x)) for x in ((1.2e5, 1.2e5, 60.0), (440.0, 440.0, 0.2))
        )

    def forward(self, setpoints: Tensor, state: Tensor) -> Tensor:
        (w, w_dot), (q, q_dot) = (
            setpoints.unflatten(-1, (2, 3)).unbind(-2),
            state.unflatten(-1, (2, 6)).unbind(-2),
        )
        seen = torch.cat((100.0 * (w - q[..., :3]), w_dot, 100.0 * q, q_dot), -1)
        return (
            self.Kp * (w - q[..., :3]) + self.Kd * (w_dot - q_dot[..., :3]) + 2.0 * self.net(seen)
        )


class Wave(nn.Module):
    """A signal that is no piecewise polynomial."""

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        return 1e-3 * torch.sin(40 * t), 4e-2 * torch.cos(40 * t)


def law(friction: Any = None) -> SoftContact:
    return SoftContact(1.2e5, 441.7, 1.1e5, 430.0, friction=friction or SmoothSlip(0.5, 0.4, 5e-2))


def grip(
    shape: nn.Module | None = None, material: Any = None, tip: Mesh = MESH, friction: Any = None,
    lower: Body | None = None, jaw: Body | None = None, motion: dict[str, nn.Module] | None = None,
    loops: Callable[[float], dict[str, Any]] | None = None, under: Any = None, **pad: Any,
) -> Start:  # fmt: skip
    """A body pressed between a pad below, of the material `under` if given, and one under a jaw,
    which is driven or pushed by loops; it is rolled and slips."""
    shape, soft, contact = (
        shape or Circle(R),
        material or KelvinVoigt(**RUBBER, tau=0.01),
        law(friction),
    )
    down, up = shape.support(f64(0.0, -1.0, 0.0, 1.0).reshape(2, 2)).detach().tolist()
    y = MESH.height - DEPTH + down
    top = y + up - DEPTH + tip.height
    reference = {
        "jaw.x": Profile([0.0, 0.015], [0.0, 2e-3]),
        "jaw.y": Profile([0.0, 0.015], [top, top - 1e-4]),
    }
    driven = Body(x="driven", y="driven", theta=0.0, weighted=False)
    rig = Rig(
        bodies={"disc": Body(0.4, shape),
        "jaw": jaw or driven} | ({"lower": lower} if lower else {}), pads={
            "lower": Pad(MESH, under or soft, base="lower" if lower else None,
                         origin=(-30e-3, 0.0), **pad),
            "upper": Pad(tip, soft, base="jaw", origin=(-tip.length / 2, 0.0), mirrored=True,
            **pad),
        },
        contacts={name: Contact(name, "disc", contact) for name in ("lower", "upper")},
        actuators=loops(top) if loops else None, groups={"rubber": soft, "contact": contact},
        reference=Reference(
            **({} if jaw and loops else reference)
            | (motion(top) if callable(motion) else motion or {})
        ),
    )  # fmt: skip
    pose = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64)).pose | {
        "disc": f64(3e-4, y, 0.0)
    }
    if jaw and loops:
        pose["jaw"] = f64(0.0, top, 0.0)
    return rig, standing(rig, pose).detach()


def loops(actuators: Callable[[], dict[str, Any]], theta: Any = 0.0) -> Start:
    """The grip by a jaw with a mass, pushed by actuators towards set-points."""
    motion = lambda top: {
        "x_d": Profile([0.0, 0.015], [0.0, 3e-3]), "y_d": Profile([0.0, 0.015], [top, top - 1e-4]),
        "theta_d": Profile([0.0, 0.015], [0.0, 0.02]), "F": Profile([0.0, 0.015], [-20.0, -25.0]),
    }  # fmt: skip
    return grip(
        jaw=Body(0.4, inertia=3e-4, theta=theta), loops=lambda top: actuators(), motion=motion
    )


def jaws() -> Start:
    """Two pads at the sides, one below: the disc is held on three sides."""
    soft, contact, reach = KelvinVoigt(**RUBBER, tau=0.01), law(), MESH.height + R - DEPTH
    jaw = {"x": "driven", "y": reach, "theta": 0.0, "weighted": False}
    rig = Rig(
        bodies={"disc": Body(0.4, Circle(R)), "left": Body(**jaw), "right": Body(**jaw)},
        pads={
            "floor": Pad(MESH, soft, origin=(-30e-3, 0.0)),
            "left": Pad(MESH, soft, base="left", origin=(0.0, 30e-3), angle=-torch.pi / 2),
            "right": Pad(MESH, soft, base="right", origin=(0.0, -30e-3), angle=torch.pi / 2),
        },
        contacts={name: Contact(name, "disc", contact) for name in ("floor", "left", "right")},
        reference=Reference(**{
            "left.x": Profile([0.0, 0.015], [-reach, -reach + 4e-4]),
            "right.x": Profile([0.0, 0.015], [reach, reach - 1e-4])
        }),
    )  # fmt: skip
    pose = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64)).pose
    return rig, standing(rig, pose | {"disc": f64(3e-4, reach, 0.0)}).detach()


class NetworkEnergy(Hyperelastic):
    """A neo-Hookean energy with a network of its invariants on top, of second order in them."""

    def __init__(self) -> None:
        super().__init__(**RUBBER, tau=0.01)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.net = nn.Sequential(nn.Linear(2, 4), nn.Softplus(), nn.Linear(4, 1)).double()

    def distortion(self, F: Tensor) -> Tensor:
        I1, I2, _ = invariants(F)
        x = torch.stack((I1 - 3, I2 - 3), -1)
        bent = self.net(x)[..., 0] * (I1 - 3) * (I2 - 3)
        return 0.5 * self.shear * (I1 - 3 + bent)


TURNING = {"x": "driven", "y": "driven", "theta": "driven", "weighted": False}
WHOLE = [f"{body}.{axis}" for body in ("jaw", "disc") for axis in ("x", "y", "theta")]
SETPOINTS = ["x_d", "y_d", "theta_d"]
PUSHES = {"x": "jaw.x", "y": "jaw.y", "turn": "jaw.theta"}


def pd(measures: str = "jaw.x", x_law: nn.Module | None = None) -> dict[str, Actuator]:
    return {
        "x": Actuator(measures, "jaw.x", x_law or PD(1.2e5, 441.7), setpoint="x_d"),
        "y": Actuator("jaw.y", "jaw.y", PD(1.2e5, 441.7), setpoint="y_d", feed_forward="F"),
    }


def remembering() -> dict[str, Actuator]:
    """An integral, after a lag, and a lag alone."""
    integral = Lagging(Integral(PD(1.2e5, 441.7), 4e6), 3e-3)
    return {
        "x": Actuator("jaw.x", "jaw.x", integral, setpoint="x_d"),
        "y": Actuator("jaw.y", "jaw.y", Lagging(PD(5e4, 441.7), 1e-3), setpoint="y_d",
                      feed_forward="F"),
    }  # fmt: skip


def feedback(coupling: float = 0.0) -> dict[str, Actuator]:
    gain = [[1.2e5, coupling, 441.7, 0.0], [0.0, 1.2e5, coupling, 441.7]]
    return controller(
        StateFeedback(gain), measures=["jaw.x", "jaw.y"], setpoints=["x_d", "y_d"],
        pushes={"x": "jaw.x", "y": "jaw.y"}, feed_forward={"y": "F"},
    )  # fmt: skip


def extended_loops() -> Start:
    """Everything that a rig may be extended by, away from its neutral value."""
    rig, _ = loops(pd)
    for name, one in extensions(rig).items():
        if name in extensions(rig):  # of two slow branches, one
            extend(rig, [name])
            torch.nn.init.constant_(rig.parameter(name), one.neutral + 2 * one.amount)
    pose = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64)).pose
    top = rig.follow(0.0)[rig.signals.index("y_d"), 0]
    pose |= {"disc": f64(3e-4, MESH.height - DEPTH + R, 0.0), "jaw": f64(0.0, float(top), 0.0)}
    return rig, standing(rig, pose).detach()


RIGS: dict[str, Callable[[], Start]] = {
    "circle": grip,
    "ellipse": lambda: grip(Ellipse(R, 18.5e-3)),
    "superellipse": lambda: grip(Superellipse(20e-3, 18.5e-3, 2.6)),
    "rounded box": lambda: grip(RoundedBox(18e-3, 17e-3, 12e-3)),
    "rounded polygon": lambda: grip(RoundedPolygon(along(np.arange(0.5, 8) * np.pi / 4, 20e-3,
    20e-3), 9e-3)), "contour": lambda: grip(Contour(along(np.arange(24) * np.pi / 12, 20e-3, 18e-3),
    tolerance=1e-5)),
    "standard linear solid": lambda: grip(material=StandardLinearSolid(**RUBBER, E_instant=1.5e6,
    tau=0.02, tau_instant=1e-3)), "generalised Kelvin": lambda: grip(
        material=GeneralisedKelvin(**RUBBER, J=[0.3, 0.2, 0.1], tau=[4e-3, 0.02, 0.3],
        tau_instant=1e-3)
    ),
    "Prony": lambda: grip(
        material=Prony(**RUBBER, moduli=[3e5, 2e5, 1e5, 5e4], tau=[3e-3, 0.01, 0.1, 0.5],
        tau_instant=1e-3)
    ),
    "crowned pad": lambda: grip(tip=CurvedPadMesh(30e-3, 6e-3, 30, 3, radius=40e-3)),
    "fingertip": lambda: grip(Circle(12e-3), tip=FingertipMesh(8e-3, 24)),
    "fingertip, inertial": lambda: grip(Circle(12e-3), tip=FingertipMesh(8e-3, 12), inertial=True),
    "mesh of quadrilaterals": lambda: grip(Circle(12e-3), tip=trapezium().refined(2)),
    "enclosed pad": lambda: grip(tip=PadMesh(40e-3, 4.59e-3, 20, 2, bonded_sides=True)),
    "points between nodes": lambda: grip(points=2),
    "inertial pads": lambda: grip(inertial=True),
    "neo-Hookean pads": lambda: grip(material=NeoHookean(**RUBBER, tau=0.01)),
    "relaxing pad under another": lambda: grip(
        material=NeoHookean(**RUBBER, tau=0.01),
        under=NeoHookean(**RUBBER, tau=0.01, moduli=[6e5], times=[0.02])),
    "pads that relax twice": lambda: grip(Circle(12e-3), tip=FingertipMesh(8e-3, 12), points=2,
        material=Yeoh(C10=1.3e5, C20=-1e4, C30=3e3, nu=0.48, rho=1100.0, tau=0.01, depth=0.044,
        moduli=[3e5, 2e5], times=[0.05, 4e-3])),
    "neo-Hookean pads with inertia": lambda: grip(
        material=NeoHookean(**RUBBER, tau=0.01), inertial=True),
    "Mooney-Rivlin pads on turning bases": lambda: grip(
        jaw=Body(**TURNING), lower=Body(**TURNING), points=2,
        material=MooneyRivlin(C10=9e4, C01=4e4, nu=0.45, rho=1100.0, tau=0.01, depth=0.044),
        motion={f"lower.{axis}": Profile([0.0, 0.015], [0.0, to]) for axis,
        to in (("x", -2e-3), ("y", 1e-4), ("theta", 0.03))}
        | {"jaw.theta": Profile([0.0, 0.015], [0.0, 0.02])},
    ),
    "Yeoh fingertip": lambda: grip(Circle(12e-3), tip=FingertipMesh(8e-3, 12), material=Yeoh(
        C10=1.3e5, C20=-1e4, C30=3e3, nu=0.48, rho=1100.0, tau=0.01, depth=0.044)),
    "Ogden pads": lambda: grip(material=Ogden(
        mu=[2.8e5, -2e4], alpha=[1.8, -3.0], nu=0.45, rho=1100.0, tau=0.01, depth=0.044)),
    "network of energy": lambda: grip(material=NetworkEnergy()),
    "Coulomb": lambda: grip(friction=Coulomb(0.5, 0.4)),
    "friction that ages": lambda: grip(friction=AgeingSlip(0.4, 0.3, ageing=0.02, age_0=0.01)),
    "rate and state": lambda: grip(friction=RateAndState(0.4, 0.02, 0.03, 4e-5, 1e-3, 0.05)),
    "network of friction": lambda: grip(friction=NetworkFriction()),
    "turning jaws": lambda: grip(
        jaw=Body(**TURNING), lower=Body(**TURNING),
        motion={f"lower.{axis}": Profile([0.0, 0.015], [0.0, to]) for axis,
        to in (("x", -2e-3), ("y", 1e-4), ("theta", 0.03))}
        | {"jaw.theta": Profile([0.0, 0.015], [0.0, 0.02])},
    ),
    "three pads": jaws,
    "sampled motion": lambda: grip(motion={"jaw.x": Sampled([0.0, 0.004, 0.008, 0.015],
    [0.0, 1e-3, 3e-3, 3e-3])}), "motion of one's own": lambda: grip(motion={"jaw.x": Wave()}),
    "loops": lambda: loops(pd),
    "loops that remember": lambda: loops(remembering),
    "loops by feedback": lambda: loops(feedback),
    "loop about the disc": lambda: loops(lambda: pd("disc.x", PD(2e4, 100.0))),
    "saturated loop": lambda: loops(lambda: pd(x_law=Saturated(3.0))),
    "coupled feedback": lambda: loops(lambda: feedback(10.0)),
    "extended": extended_loops,
    "policy": lambda: loops(lambda: controller(
        Policy(), measures=WHOLE, setpoints=SETPOINTS, pushes=PUSHES, feed_forward={"y": "F"}),
        theta="free"),
}  # fmt: skip


SLOW = (
    "relaxing pad under another",
    "Yeoh fingertip",
    "pads that relax twice",
    "Ogden pads",
    "Mooney-Rivlin pads on turning bases",
    "neo-Hookean pads with inertia",
    "network of energy",
    "generalised Kelvin",
    "superellipse",
    "rounded polygon",
)
PARAMS = [
    pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in RIGS
]  # fmt: skip


@pytest.fixture(scope="module", params=PARAMS)
def start(request):
    return RIGS[request.param]()


@pytest.fixture(scope="module")
def seed(start):
    return telling(start)


def test_power_and_momentum_are_balanced(start, seed):
    check_power(start[0], at_random(start, seed), 0.01)
    assert_rates_differentiable(start, seed)


def test_copies_batches_and_states_are_the_rigs(start):
    assert_parts_are_kept(start)


def test_compiled_steps_are_the_modules(start, seed):
    assert_compiled_is_the_module(start, seed)


def test_gradients_of_runs_are_exact(start):
    made = assert_gradients_exact(start, times(END, 4))
    assert all(
        float(force[-1, :, 0].detach().sum()) > 1.0 for force in made.force.values()
    )  # all pads touch


def test_a_turned_rig_moves_like_the_one_that_is_not():
    """Both jaws turned by 30 degrees about the origin, without gravity."""
    runs = []
    for angle in (0.0, np.pi / 6):
        c, s = np.cos(angle), np.sin(angle)
        top = 2 * (MESH.height + R - DEPTH)
        x, y = np.array([[0.0, 2e-3], [top, top - 1e-4]])
        motion = {
            "jaw.x": c * x - s * y,
            "jaw.y": s * x + c * y,
            "jaw.theta": [angle, angle],
            "lower.theta": [angle, angle],
        }
        still = {f"lower.{axis}": Profile([0.0], [0.0]) for axis in "xy"}
        rig, _ = grip(
            jaw=Body(**TURNING), lower=Body(**TURNING),
            motion=still | {name: Profile([0.0, 0.015], list(ends)) for name,
            ends in motion.items()},
        )  # fmt: skip
        torch.nn.init.zeros_(rig.gravity)
        arm, off = MESH.height + R - DEPTH, 3e-4
        pose = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64)).pose
        y0 = standing(
            rig, pose | {"disc": f64(c * off - s * arm, s * off + c * arm, angle)}
        ).detach()
        x, y, theta = (
            simulate(rig, times(END, 5), y0=y0, step=1e-3, tolerance=1e-10)
            .state.pose["disc"]
            .unbind(-1)
        )
        runs.append(torch.stack((c * x + s * y, c * y - s * x, theta - angle)))
    assert float((runs[0] - runs[1]).abs().max()) < 1e-9


def test_efforts_of_a_policy_are_those_of_its_module():
    """In the channels of a run, whose units are those of what is pushed."""
    rig, y0 = RIGS["policy"]()
    run = simulate(rig, times(END, 7), y0=y0)
    signals = rig.follow(run.t)
    state = rig.unpack(run.y, signals)
    w, seen = (
        (dict(zip(rig.signals, signals.unbind(-2)))[name] for name in SETPOINTS),
        (state.pose, state.velocity),
    )
    setpoints = torch.stack(list(w), -2).mT.flatten(-2)
    poses = torch.cat([part[body] for part in seen for body in ("jaw", "disc")], -1)
    wanted = rig.actuators["x"].law.module(setpoints, poses).detach()
    wanted[:, 1] += run["F"]
    for i, name in enumerate(PUSHES):
        assert torch.allclose(run[f"effort_{name}"], wanted[:, i], rtol=1e-12, atol=1e-12)
        assert float(wanted[:, i].abs().max()) > 0.1
    assert (run.units["theta_d"], run.units["effort_turn"], run.units["y_d"]) == ("rad", "N.m", "m")


def test_knots_with_a_graph_receive_their_gradient():
    """A profile of tensors that require one: the chain rule through its values."""
    d = f64(0.5, 1.0).requires_grad_()
    knots = f64(0.0, 1.0).requires_grad_()
    slopes = []
    for values, leaf in ((torch.cat((d[:1] - 0.5, d[1:] ** 2)) * 1e-3, d), (knots * 1e-3, knots)):
        rig, y0 = grip(motion={"jaw.x": Profile([0.0, 0.015], values)})
        value = simulate(rig, times(END, 3), y0=y0, step=1e-3, gradient="discrete")["theta_disc"][
            -1
        ]
        slopes.append(torch.autograd.grad(value, leaf)[0])
    assert torch.allclose(slopes[0], slopes[1] * f64(1.0, 2.0), rtol=1e-9)
    assert float(slopes[0].abs().min()) > 0
