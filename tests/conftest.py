"""Shared rigs and states: at rest, in the grasp, rolling, and at random."""

import gc
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchsoft import (
    Body,
    BuiltRig,
    Reference,
    Rig,
    RigFile,
    SmoothSlip,
    SoftContact,
    Trajectory,
    excite,
    hold,
    register_method,
)
from torchsoft.physics.state import State, begin_states
from torchsoft.rigs.excite import Excitation
from torchsoft.sysid import good_sensors

register_method()

torch.set_num_threads(1)
gc.set_threshold(50_000, 20, 20)

RUBBER = {"E": 7.5e5, "nu": 0.45, "rho": 1100.0, "depth": 0.044}
COARSE = {"pad.elements_x": 60, "pad.elements_y": 2, "contact.v_s": 0.05}


IDENTIFIED = """
rig = "paper"
[settings]
laws.steel_on_rubber.friction.v_s = 0.05
actuators.x.measures = "bracket.x"
bodies.disc.start.x = 60.3e-3
bodies.bracket.start.x = 60.3e-3
[unknowns."laws.steel_on_rubber.K_n"]
nominal = 1e5
[unknowns."materials.rubber.E"]
nominal = 0.7e6
[sensors]
x_C.noise = 10e-6
y_Br.noise = 10e-6
F_y.noise = 0.1
[fit]
rtol = 1e-3
"""
"""Configuration of the identification in examples/identify, with two unknowns."""

PAPER = RigFile.ready("paper")
RIG = good_sensors(PAPER.assemble())
"""Sensors of the paper's rig."""
APART, GRASPED = 50.1e-3, 48.6e-3
"""Height of the paper's bracket [m] where undeformed pads just touch the disc, and in the grasp."""


def paper(changes: Mapping[str, Any] | None = None, **groups: Any) -> BuiltRig:
    """The paper's rig with its motion, with changes by name, full or short, and by tables."""
    return PAPER.override(changes, **groups).build()


def still(
    changes: Mapping[str, Any] | RigFile | None = None, reference: Reference | None = None,
    **parts: Any,
) -> Rig:  # fmt: skip
    """The paper's rig, or that of a file of it, which is held where it starts or follows a
    reference, with `parts` of its own: friction, shape, material."""
    names = {
        "friction": "laws.steel_on_rubber.friction", "shape": "bodies.disc.shape",
        "material": "materials.rubber",
    }  # fmt: skip
    file = changes if isinstance(changes, RigFile) else PAPER.override(changes)
    rig = file.assemble({names[name]: part for name, part in parts.items()})
    rig.reference = reference or hold(x_d=file.bodies["disc"].start.x, y_d=APART, F_ff=0.0)
    return rig


def excited(
    excitation: str | Excitation, file: RigFile | None = None, F_ff: float | None = None,
    parts: Mapping[str, Any] | None = None, **how: Any,
) -> BuiltRig:  # fmt: skip
    """The paper's rig, or that of a file of it, with `parts` of its own, under an excitation; F_ff
    [N] is the force fed forward to the bracket, by default that which holds it."""
    made = excite(PAPER if file is None else file, excitation, **how)
    fed = {} if F_ff is None else {"motion.F_ff.values": [0.0, F_ff]}
    return made.override(fed).build(parts or {})


def stroked(travel: float, stroke_time: float, **more: Any) -> Excitation:
    """Strokes there and back [m, s]."""
    roll = {"kind": "strokes", "travel": travel, "stroke_time": stroke_time}
    return Excitation(roll, **more)


def rolled(travel: float, end: float, since: float = 0.5) -> dict[str, Any]:
    """One roll by so much [m] between two times [s]."""
    knots = {"times": (since, end), "values": (0.0, travel)}
    return {"kind": "profile", "offset": "start"} | knots


def waves(x: float, y: float, band: tuple[float, float]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sums of random sines along the pads and across them [m], in a band of frequencies [Hz]."""
    sines = {"kind": "multi_sine", "band": band}
    return sines | {"amplitude": x, "seed": 0}, sines | {"amplitude": y, "seed": 1}


def rest(rig: Rig, x: float = 60e-3) -> Tensor:
    """The paper's disc at rest on the lower pad, the upper one just touching it."""
    return rig.state(disc={"x": x, "y": "rest"}, bracket={"x": x, "y": "touch"})


def press(rig: Rig, height: float = GRASPED, x: float = 60e-3) -> Tensor:
    """The paper's disc between its pads, with the bracket at a height [m], without friction."""
    return rig.state(disc={"x": x, "y": "rest"}, bracket={"x": x, "y": height})


@torch.no_grad()
def holding_force(rig: Rig, y: Tensor) -> float:
    """Downward force [N] on the paper's bracket that balances the upper pad's normal forces."""
    pad, part = rig.pads["U"], rig.unpack(y).pads["U"]
    force = pad.internal_force(part, torch.zeros_like(part)) if pad.inertial else part[0]
    return float(force[:, 1].sum())


def coarse(**changes: object) -> Rig:
    """The paper's rig, still, on a coarse mesh (2 mm nodes), quick enough for hundreds of
    evaluations."""
    return still(COARSE | {k.replace("__", "."): v for k, v in changes.items()})


def turning(**changes: object) -> Rig:
    """The coarse rig with a bracket that may turn and has weight, driven as before; its pads are
    massless."""
    model = coarse(**changes)
    bracket = Body(0.4, inertia=3e-4)
    rig = Rig(
        bodies={"disc": model.bodies["disc"], "bracket": bracket}, pads=dict(model.pads),
        contacts=dict(model.contacts), actuators=dict(model.actuators), reference=model.reference,
    )  # fmt: skip
    rig.fixed = lambda: model  # the same rig with a bracket that does not turn
    return rig


def nested(name: str, value: Any) -> dict[str, Any]:
    """A tree with a value by a dotted name, `__` for a dot."""
    for part in reversed(name.replace("__", ".").split(".")):
        value = {part: value}
    return value


def dry(**how: Any) -> SoftContact:
    """A contact with smooth slip."""
    return SoftContact(1.2e5, 440.0, 1.2e5, 440.0, friction=SmoothSlip(0.8, 0.7, 0.05), **how)


def fingers() -> tuple[Rig, Trajectory]:
    """A disc on a table between two pads that stand upright, on fingers that lean."""
    lean = {"kind": "profile", "times": [0.0, 0.4], "values": [0.0, 0.08]}
    tips = {name: {"elements_x": 18} for name in ("left_tip", "right_tip")}
    pads = {"table": {"elements_x": 25}, **tips}
    built = RigFile.ready("two_fingers").override(pads=pads, motion={"lean": lean}).build()
    return built.rig, built.run(times(0.5, 6), rtol=1e-3)


def times(end: float, n: int) -> Tensor:
    return torch.linspace(0, end, n, dtype=torch.float64)


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def grasp(
    model: Rig, velocity: tuple[float, float] = (0.0, 0.0), **place: float
) -> tuple[Tensor, Reference]:
    """The frictionless grasp (size,) at a place as of `press`, with the disc moving at `velocity`
    [m/s], and the reference that holds it there."""
    y = press(model, **place).detach()
    pose = model.unpack(y).pose
    y[model.layout.slices["velocity", "disc"]] = f64(*velocity, 0.0)
    return y, hold(
        x_d=float(pose["disc"][0]), y_d=float(pose["bracket"][1]), F_ff=-holding_force(model, y)
    )


def grasped(model: Rig, velocity: tuple[float, float] = (0.0, 0.0), **place: float) -> Tensor:
    """The grasp, after the model was given the reference that holds it."""
    y, model.reference = grasp(model, velocity, **place)
    return y


def towards(model: Rig, x_d: nn.Module) -> Reference:
    """The model's reference with another horizontal set-point."""
    return Reference(**{name: model.reference[name] for name in model.signals} | {"x_d": x_d})


def random_state(rig: Rig, seed: int, slip: float = 0.02) -> Tensor:
    """A grasped state (size,) of the paper's rigs shaken about."""
    model = rig.fixed() if hasattr(rig, "fixed") else rig
    return shaken(rig, model.unpack(press(model).detach()), seed, slip)


def shaken(rig: Rig, state: State, seed: int, slip: float = 0.02) -> Tensor:
    """A state (size,) shaken about: touching and separated nodes, stick and slip, stretched
    springs; nodes that touch down are as old as the others, so that f(t, y) is the whole step."""
    old = {
        name: begin_states(rig.contacts[name].law.friction, s.shape).mT
        for name, s in state.stretch.items()
    }
    generator = torch.Generator().manual_seed(seed)

    def moved(part, scale):
        noise = {
            name: torch.randn(x.shape, generator=generator, dtype=torch.float64)
            for name, x in part.items()
        }
        return {name: x + scale * noise[name] for name, x in part.items()}

    force = 2e-5 if any(pad.nodal for pad in rig.pads.values()) else 0.5  # [m] or [N]
    return rig.pack(
        State(
            pads=moved(state.pads, force),
            stretch=moved(state.stretch, 2e-5),
            pose=moved(state.pose, f64(1e-4, 1e-4, 0.02)),
            rates=moved(state.rates, 0.01 * slip),
            velocity=moved(state.velocity, slip * f64(1.0, 1.0, 50.0)),
            friction=old,
        )
    )


def pytest_collection_finish() -> None:
    """Keep modules out of garbage collections, which are a twentieth of the time else."""
    gc.collect()
    gc.freeze()
