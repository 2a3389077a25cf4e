"""Twelve rigs that combine every shape, material, pad, friction law, loop and motion: the same
checks of each."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import RUBBER, f64, times
from rig_tester import Start, assert_gradients_exact, at_random
from test_pads import trapezium
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
    Eccentric,
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
    Shape,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
    StateFeedback,
    Superellipse,
    Trajectory,
    Yeoh,
    controller,
)
from torchsoft.physics.hyperelastic import Hyperelastic, invariants
from torchsoft.physics.mesh import Mesh
from torchsoft.physics.motion import Lines, Waves, wave
from torchsoft.physics.statics import standing
from torchsoft.solve.kernel.arrays import GAMMA
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.sysid.extensions import extend, extensions
from torchsoft.testing import check_power

MESH = PadMesh(60e-3, 4.59e-3, 30, 2)
R = 19.37e-3
END = 0.01
"""Of the runs [s]."""
DEPTH = 4e-4
"""By which the pads are pressed at the start [m]."""
NEWTON = 1e-10
"""Newton's tolerance of compiled steps that are compared [N]; 1e-11 is rounding."""


def along(angles: np.ndarray, a: float, b: float) -> np.ndarray:
    return np.stack((a * np.cos(angles), b * np.sin(angles)), -1)


# custom parts


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


class NetworkEnergy(Hyperelastic):
    """A neo-Hookean energy with a network of its invariants on top, of second order in them."""

    def __init__(self) -> None:
        super().__init__(**RUBBER, tau=0.01)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.net = nn.Sequential(nn.Linear(2, 4), nn.Softplus(), nn.Linear(4, 1)).double()

    def distortion(self, F: Tensor) -> Tensor:
        I1, I2, _ = invariants(F)
        bent = self.net(torch.stack((I1 - 3, I2 - 3), -1))[..., 0] * (I1 - 3) * (I2 - 3)
        return 0.5 * self.shear * (I1 - 3 + bent)


class Policy(nn.Module):
    """Loops of x, y and theta, whose efforts a network of set-points and the whole state
    corrects."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.net = nn.Sequential(nn.Linear(18, 5), nn.Tanh(), nn.Linear(5, 3)).double()
        gains = (1.2e5, 1.2e5, 60.0), (440.0, 440.0, 0.2)
        self.Kp, self.Kd = (nn.Parameter(f64(*x)) for x in gains)

    def forward(self, setpoints: Tensor, state: Tensor) -> Tensor:
        w, w_dot = setpoints.unflatten(-1, (2, 3)).unbind(-2)
        q, q_dot = state.unflatten(-1, (2, 6)).unbind(-2)
        off, rate = w - q[..., :3], w_dot - q_dot[..., :3]
        seen = torch.cat((100.0 * off, w_dot, 100.0 * q, q_dot), -1)
        return self.Kp * off + self.Kd * rate + 2.0 * self.net(seen)


# rigs


def law(friction: Any = None) -> SoftContact:
    return SoftContact(1.2e5, 441.7, 1.1e5, 430.0, friction=friction or SmoothSlip(0.5, 0.4, 5e-2))


def to(*values: float) -> Profile:
    return Profile([0.0, 0.015], list(values))


def grip(
    shape: Shape | None = None, material: Any = None, tip: Mesh = MESH, friction: Any = None,
    lower: Body | None = None, jaw: Body | None = None, motion: Any = None, loops: Any = None,
    under: Any = None, floor: Mesh = MESH, **pad: Any,
) -> Start:  # fmt: skip
    """A body pressed between a pad below, on the mesh `floor` and of the material `under` if given,
    and one under a jaw, which is driven or pushed by loops; it is rolled and slips."""
    shape, contact = shape or Circle(R), law(friction)
    soft = material or KelvinVoigt(**RUBBER, tau=0.01)
    down, up = shape.support(f64(0.0, -1.0, 0.0, 1.0).reshape(2, 2)).detach().tolist()
    y = floor.height - DEPTH + down
    top = y + up - DEPTH + tip.height
    reference = {} if jaw and loops else {"jaw.x": to(0.0, 2e-3), "jaw.y": to(top, top - 1e-4)}
    driven = Body(x="driven", y="driven", theta=0.0, weighted=False)
    rig = Rig(
        bodies={"disc": Body(0.4, shape), "jaw": jaw or driven}
        | ({"lower": lower} if lower else {}),
        pads={
            "lower": Pad(floor, under or soft, base="lower" if lower else None,
                         origin=(-30e-3, 0.0), **pad),
            "upper": Pad(tip, soft, base="jaw", origin=(-tip.length / 2, 0.0), mirrored=True,
                         **pad),
        },
        contacts={name: Contact(name, "disc", contact) for name in ("lower", "upper")},
        actuators=loops() if loops else None, groups={"rubber": soft, "contact": contact},
        reference=Reference(**reference | (motion(top) if callable(motion) else motion or {})),
    )  # fmt: skip
    pose = empty_pose(rig) | {"disc": f64(3e-4, y, 0.0)}
    if jaw and loops:
        pose["jaw"] = f64(0.0, top, 0.0)
    return rig, standing(rig, pose).detach()


def empty_pose(rig: Rig) -> dict[str, Tensor]:
    return rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64)).pose


def loops(actuators: Callable[[], dict[str, Any]], theta: Any = 0.0, **parts: Any) -> Start:
    """The grip by a jaw with a mass, pushed by actuators towards set-points."""
    x_d = parts.pop("x_d", None) or to(0.0, 3e-3)
    motion = lambda top: {
        "x_d": x_d, "y_d": to(top, top - 1e-4), "theta_d": to(0.0, 0.02), "F": to(-20.0, -25.0)
    }  # fmt: skip
    return grip(jaw=Body(0.4, inertia=3e-4, theta=theta), loops=actuators, motion=motion, **parts)


def jaws(shape: Shape, *soft: Any, friction: Any = None) -> Start:
    """Two pads at the sides, one below: a body is held on three sides."""
    contact, at = law(friction), MESH.height - DEPTH
    reach = at + float(shape.support(f64(1.0, 0.0)).detach())
    jaw = {"x": "driven", "y": reach, "theta": 0.0, "weighted": False}
    rig = Rig(
        bodies={"disc": Body(0.4, shape), "left": Body(**jaw), "right": Body(**jaw)},
        pads={
            "floor": Pad(MESH, soft[0], origin=(-30e-3, 0.0)),
            "left": Pad(MESH, soft[1], base="left", origin=(0.0, 30e-3), angle=-torch.pi / 2),
            "right": Pad(MESH, soft[-1], base="right", origin=(0.0, -30e-3), angle=torch.pi / 2),
        },
        contacts={name: Contact(name, "disc", contact) for name in ("floor", "left", "right")},
        reference=Reference(**{
            "left.x": Lines([0.0, 0.015], [-reach, -reach + 4e-4]),
            "right.x": to(reach, reach - 1e-4),
        }),
    )  # fmt: skip
    return rig, standing(rig, empty_pose(rig) | {"disc": f64(3e-4, reach, 0.0)}).detach()


TURNING = {"x": "driven", "y": "driven", "theta": "driven", "weighted": False}
WHOLE = [f"{body}.{axis}" for body in ("jaw", "disc") for axis in ("x", "y", "theta")]
SETPOINTS = ["x_d", "y_d", "theta_d"]
PUSHES = {"x": "jaw.x", "y": "jaw.y", "turn": "jaw.theta"}


def turning(**parts: Any) -> Start:
    """Both pads on bases that move and turn."""
    motion = {"lower.x": to(0.0, -2e-3), "lower.y": to(0.0, 1e-4), "lower.theta": to(0.0, 0.03),
              "jaw.theta": to(0.0, 0.02)}  # fmt: skip
    return grip(jaw=Body(**TURNING), lower=Body(**TURNING), motion=motion, **parts)


def pd(measures: str = "jaw.x") -> dict[str, Actuator]:
    x_law = PD(1.2e5, 441.7) if measures == "jaw.x" else PD(2e4, 100.0)
    return {
        "x": Actuator(measures, "jaw.x", x_law, setpoint="x_d"),
        "y": Actuator("jaw.y", "jaw.y", PD(1.2e5, 441.7), setpoint="y_d", feed_forward="F"),
    }


def remembering() -> dict[str, Any]:
    """Coupled feedback of x and y, and an integral of the angle, after a lag, with a limit."""
    gain = [[1.2e5, 10.0, 441.7, 0.0], [0.0, 1.2e5, 10.0, 441.7]]
    feedback = controller(
        StateFeedback(gain), measures=["jaw.x", "jaw.y"], setpoints=["x_d", "y_d"],
        pushes={"x": "jaw.x", "y": "jaw.y"}, feed_forward={"y": "F"},
    )  # fmt: skip
    integral = Lagging(Integral(PD(60.0, 0.2), 3e3), 3e-3)
    lag = Actuator("jaw.theta", "jaw.theta", integral, setpoint="theta_d", limit=50.0)
    return {**feedback, "turn": lag}


def extended() -> Start:
    """Everything that a rig may be extended by, away from its neutral value."""
    shape = Eccentric(RoundedBox(18e-3, 17e-3, 12e-3), 3e-4, -2e-4)
    rig, y0 = loops(lambda: pd("disc.x"), shape=shape, tip=trapezium())
    pose = {name: place.detach() for name, place in rig.unpack(y0).pose.items()}
    for name, one in extensions(rig).items():
        if name in extensions(rig):  # of two slow branches, one
            extend(rig, [name])
            nn.init.constant_(rig.parameter(name), one.neutral + 2 * one.amount)
    return rig, standing(rig, pose).detach()


OCTAGON = lambda: RoundedPolygon(along(np.arange(0.5, 8) * np.pi / 4, 20e-3, 20e-3), 9e-3)
EGG = lambda: Contour(along(np.arange(24) * np.pi / 12, 20e-3, 18e-3), tolerance=1e-5)
SLOWLY = {"nu": 0.48, "rho": 1100.0, "tau": 0.01, "depth": 0.044}
MOONEY = lambda: MooneyRivlin(C10=9e4, C01=4e4, **SLOWLY)
YEOH = lambda **how: Yeoh(C10=1.3e5, C20=-1e4, C30=3e3, **SLOWLY, **how)
OGDEN = lambda: Ogden(mu=[2.8e5, -2e4], alpha=[1.8, -3.0], **SLOWLY)
SOLID = lambda: StandardLinearSolid(**RUBBER, E_instant=1.5e6, tau=0.02, tau_instant=1e-2)
KELVIN = lambda: GeneralisedKelvin(
    **RUBBER, J=[0.3, 0.2, 0.1], tau=[8e-3, 0.02, 0.3], tau_instant=6e-3
)
PRONY = lambda: Prony(**RUBBER, moduli=[3e5, 2e5], tau=[0.012, 0.1], tau_instant=6e-3)
NEO = lambda: NeoHookean(**RUBBER, tau=0.01)
AGES = lambda: AgeingSlip(0.4, 0.3, ageing=0.02, age_0=0.01)
EVOLVES = lambda: RateAndState(0.4, 0.02, 0.03, 4e-5, 1e-3, 0.05)
SAMPLES = lambda: Sampled([0.0, 0.004, 0.008, 0.015], [0.0, 1e-3, 3e-3, 3e-3], clamped=True)
SHAKES = lambda: Waves(([0.0, 0.015], [0.0, 3e-3]), 0.0, 1.0, wave(1e-3, 20.0, 5.0, 0.2))
BLOCK = PadMesh(60e-3, 4.59e-3, 24, 1)
TIP = FingertipMesh(8e-3, 12)

FAST = {
    "loops": lambda: loops(pd, tip=PadMesh(40e-3, 4.59e-3, 20, 2, bonded_sides=True),
                           x_d=SAMPLES()),
    "turning jaws": lambda: turning(shape=Ellipse(R, 18.5e-3), material=SOLID(), friction=AGES(),
                                    points=2),
    "three pads": lambda: jaws(OCTAGON(), KELVIN(), PRONY(),
                               friction=NetworkFriction()),
    "rate and state": lambda: grip(EGG(), under=SOLID(), friction=EVOLVES(),
                                   tip=CurvedPadMesh(30e-3, 6e-3, 30, 3, radius=40e-3),
                                   motion={"jaw.x": SHAKES()}),
    "inertial pads": lambda: grip(Circle(12e-3), tip=TIP, floor=BLOCK, inertial=True,
                                  motion={"jaw.x": SAMPLES()}),
    "neo-Hookean pads": lambda: grip(RoundedBox(11e-3, 11e-3, 8e-3), NEO(), tip=TIP, floor=BLOCK,
                                     friction=EVOLVES(), points=2),
    "feedback": lambda: loops(remembering, theta="free", shape=Superellipse(20e-3, 18.5e-3, 2.6),
                              material=PRONY(), under=KELVIN(), friction=Coulomb(0.5, 0.4),
                              tip=PadMesh(40e-3, 4.59e-3, 20, 2, bonded_sides=True),
                              x_d=Lines([0.0, 0.006, 0.015], [0.0, 2e-3, 3e-3])),
    "policy": lambda: loops(lambda: controller(
        Policy(), measures=WHOLE, setpoints=SETPOINTS, pushes=PUSHES, feed_forward={"y": "F"}),
        theta="free", shape=Eccentric(Ellipse(R, 18.5e-3), 5e-4, -3e-4), x_d=SHAKES(),
        friction=NetworkFriction()),
    "extended": extended,
}  # fmt: skip
SLOW = {
    "three finite strains": lambda: jaws(Superellipse(R, R, 2.6), MOONEY(), OGDEN(),
                                         YEOH(moduli=[3e5, 2e5], times=[0.05, 4e-3])),
    "a network and two finite strains": lambda: jaws(OCTAGON(), MOONEY(), NetworkEnergy(), YEOH(),
                                                     friction=Coulomb(0.5, 0.4)),
    "finite strain on turning bases": lambda: turning(
        shape=EGG(), under=OGDEN(), material=NetworkEnergy(), points=2,
        tip=CurvedPadMesh(30e-3, 6e-3, 15, 2, radius=40e-3)),
}  # fmt: skip
RIGS = FAST | SLOW


@pytest.fixture(
    scope="module", params=[*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def start(request):
    return RIGS[request.param]()


@pytest.fixture(scope="module")
def y(start):
    """A state in which some points touch and some do not, of those some stick and some slip."""
    rig = start[0]
    for seed in range(100):
        y = at_random(start, seed)
        with torch.no_grad():
            faces = rig.evaluate(0.01, rig.unpack(y)).interfaces.values()
        touches = [one.frame.g > 0 for one in faces]
        slips = torch.cat([one.law.slip[on] > 1e-12 for one, on in zip(faces, touches)])
        if all(on.any() for on in touches) and slips.any() and not slips.all():
            assert not torch.cat(touches).all()
            return y
    raise AssertionError("no state touches, sticks and slips")


def test_power_and_momentum_are_balanced_and_rates_have_derivatives(start, y):
    """Autograd through the module, along one direction of the state and of every parameter, against
    differences."""
    rig, y0 = start
    check_power(rig, y, 0.01)
    weight = torch.randn(len(y), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weight /= rig(0.01, y).detach().abs().clamp(min=1e-3)

    def value(by):
        changed = {
            name: p.detach() * (1 + by * (1 + 0.1 * (i % 7)))
            for i, (name, p) in enumerate(rig.named_parameters())
        }
        return weight @ torch.func.functional_call(rig, changed, (0.01, y + by * (y - y0)))

    (slope,) = torch.autograd.grad(value(by := f64(0.0)[0].requires_grad_()), by)
    with torch.no_grad():
        up, down = (float(value(f64(h)[0])) for h in (1e-7, -1e-7))
    assert float(slope) == pytest.approx((up - down) / 2e-7, rel=1e-5)


@torch.no_grad()
def test_rows_of_a_batch_and_copies_are_the_rig(start, y):
    rig, y0 = start
    both = torch.stack((y, y0))
    state = rig.unpack(both)
    assert torch.equal(rig.pack(state), both)
    batch, alone = rig(0.01, both), rig(0.01, y)
    assert float((batch[0] - alone).abs().max()) < 1e-12 * float(alone.abs().max())
    changed = {name: p * 1.01 for name, p in rig.named_parameters() if p.requires_grad}
    called = torch.func.functional_call(rig, changed, (0.01, y))
    assert not torch.equal(called, alone)
    copied = pickle.loads(pickle.dumps(rig))
    copied.load_state_dict(changed, strict=False)
    assert torch.equal(copied(0.01, y), called)


@torch.no_grad()
def test_compiled_steps_are_the_module_s(start, y):
    """Y = y* + a h f(t, Y) at both stages of a step, with pads, contacts, friction, bodies and
    control."""
    rig, h = start[0], 2e-4
    segments = []
    stepper = ImplicitStepper(rig, step=h, tolerance=NEWTON)
    *_, last = stepper.integrate(y, f64(0.0, h), segments, float("inf"))
    assert last.stats.steps == 1
    assert segments[-1].tapes is not None
    star, a = torch.from_numpy(segments[-1].tapes[0].y), GAMMA * h
    assert torch.equal(star[0], y)
    end, first = torch.from_numpy(last.y[-1]), y + a / (h - a) * (star[1] - y)
    for begin, stage, time in ((y, first, a), (star[1], end, h)):
        got, expected = (stage - begin) / a, rig(time, stage)
        for (part, name), where in rig.layout.slices.items():
            if where.start == where.stop:
                continue
            noise = 1e-9 * (1 + float(expected[where].abs().max()))
            noise += 4e-15 * float(stage[where].abs().max()) / a
            if part == "rates":
                noise += NEWTON / float(rig.pads[name].masses().min())
            elif part == "velocity":  # Newton's tolerance at a few nodes, on the spin
                noise += 3 * NEWTON * 0.02 / float(rig.bodies[name].inertia)
            assert float((got - expected)[where].abs().max()) < noise, (part, name, time)


def test_gradients_of_runs_are_exact_and_runs_are_saved(start, tmp_path):
    run = assert_gradients_exact(start, times(END, 4))
    for force in run.force.values():  # all pads touch
        assert float(force[-1, :, 0].detach().sum()) > 1.0
    run.save(tmp_path / "run.nc")
    again = Trajectory.load(tmp_path / "run.nc")
    assert torch.equal(again.y, run.y.detach())
    assert again.layout.blocks == run.layout.blocks
    for name, force in run.force.items():
        assert torch.equal(again.force[name], force.detach())
