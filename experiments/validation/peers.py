"""Question: how exact are derivatives through sliding contact, here and in other programs?

A block slides from v to a stop, and a body slides until it rolls. The final position x and its
derivatives with respect to mu and v are compared with closed forms. A program that is not
installed is left out. None is a dependency of torchsoft. Install them in an environment of their
own: pip install mujoco mujoco-mjx jax newton warp-lang

The cases are the same, the models are not. In torchsoft a block or a cylinder slides on a rubber
pad (`sliding.py`), which it ploughs and which rings after the stop. In the other programs a block
or a sphere slides on a rigid plane, with contact springs or soft constraints.

Command: .venv/bin/python -m experiments.validation.peers [--smoke] [--programs torchsoft MuJoCo]
Expected: positions within 0.8 % in torchsoft and 2 % in MuJoCo. Derivatives of torchsoft are off by
up to 0.4 % for the block and 3 % for the roll, by 0.1 and 0.4 % with a finer mesh and tolerance; of
MuJoCo by 0.4 to 17 % or more, as MJX's, or nan; of Newton by 0.3 % where its explicit steps are
stable, and of no use elsewhere. Three minutes on one core, and as many again to compile MJX's.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import torch

from experiments.frame import grid, numbers, options, write
from experiments.validation.sliding import GRAVITY, MU, TAU, Sliding
from torchsoft import Circle, Coulomb, simulate

V = 0.5
"""Initial speed [m/s]."""


@dataclass(frozen=True)
class Config:
    out: Path = Path("out/peers")
    programs: tuple[str, ...] = ("torchsoft", "MuJoCo", "MJX", "Newton")
    smoke: bool = False  # the first setting of torchsoft and MuJoCo


Found = tuple[float, float, float]
"""Final position [m], and its derivatives with respect to mu [m] and v [s]."""

Way = Callable[[float, float], float]
"""Final position [m] as a function of mu and v."""


@dataclass(frozen=True)
class Case:
    """A body that loses a `share` of its speed by sliding, seen after a `duration` [s]."""

    share: float
    duration: float

    def way(self, mu: float, v: float) -> float:
        """The closed form."""
        lost = self.share * v
        return (v - lost) * self.duration + lost**2 / (2 * mu * GRAVITY)


BLOCK, CYLINDER, SPHERE = Case(1, 0.3), Case(1 / 3, 0.35), Case(2 / 7, 0.35)


def differences(way: Way, h: float) -> Found:
    """Central differences, with steps of h times mu and v."""
    by_mu = way(MU * (1 + h), V) - way(MU * (1 - h), V)
    by_v = way(MU, V * (1 + h)) - way(MU, V * (1 - h))
    return way(MU, V), by_mu / (2 * h * MU), by_v / (2 * h * V)


def slid(
    case: Case, mu: float = MU, v: float = V, at: float = 5.0, tau: float = TAU, elements: int = 8,
    h: float = 0.0, **steps: Any,
) -> Found:  # fmt: skip
    """torchsoft's run from `at` heights of the pad, with forward sensitivities or differences."""
    if h:
        return differences(lambda mu, v: slid(case, mu, v)[0], h)
    rubber = Sliding(friction=Coulomb(mu, mu), tau=tau, elements=elements)
    shape = rubber.box if case.share == 1 else Circle(2 * rubber.size)
    rig, y0 = rubber.start(shape, at * rubber.size, v=v)
    mus = [f"contacts.pad.law.friction.{name}" for name in ("mu_s", "mu_k")]
    dy0 = torch.zeros(len(y0), 3, dtype=torch.float64)
    dy0[rig.layout.slices["velocity", "body"].start, 2] = 1.0
    run = simulate(
        rig, grid(case.duration), y0=y0, gradient="forward", wrt=mus, dy0=dy0, rigid=True, **steps
    )
    x = rig.layout.rigid.index(rig.layout.slices["pose", "body"].start)
    assert run.sensitivities is not None
    by_mu_s, by_mu_k, by_v = run.sensitivities[-1, x].tolist()
    return float(run["x_body"][-1] - run["x_body"][0]), by_mu_s + by_mu_k, by_v


def mujoco_model(case: Case, cone: str, contact: str, dt: float) -> tuple[Any, Any]:
    """Model, and the body at rest on the plane."""
    mujoco = import_module("mujoco")
    shape, z = ("box", 0.01) if case.share == 1 else ("sphere", 0.024)
    size = "0.02 0.02 0.01" if case.share == 1 else "0.024"
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="{dt}" cone="{cone}" tolerance="1e-12"/>
          <worldbody>
            <geom type="plane" size="5 5 .1" {contact}/>
            <body pos="0 0 {z}"><freejoint/>
              <geom type="{shape}" size="{size}" mass="0.15" {contact}/>
            </body>
          </worldbody>
        </mujoco>""")
    model.geom_friction[:, 0] = MU
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 200)
    return model, data


def mujoco(case: Case, cone: str, contact: str = "", dt: float = 2e-3, h: float = 1e-4) -> Found:
    program = import_module("mujoco")
    model, rest = mujoco_model(case, cone, contact, dt)

    def way(mu: float, v: float) -> float:
        model.geom_friction[:, 0] = mu
        data = program.MjData(model)
        data.qpos[:], data.qvel[0] = rest.qpos, v
        program.mj_step(model, data, round(case.duration / dt))
        return data.qpos[0] - rest.qpos[0]

    return differences(way, h)


def mjx(case: Case, cone: str, contact: str = "", dt: float = 2e-3) -> Found:
    jax, program = import_module("jax"), import_module("mujoco.mjx")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_disable_most_optimizations", True)  # compiles faster
    model, rest = mujoco_model(case, cone, contact, dt)
    rest.qvel[:] = 0
    fixed, data = program.put_model(model), program.put_data(model, rest)

    def step(mu: Any, q: Any, v: Any, warm: Any) -> tuple[Any, ...]:
        here = fixed.replace(geom_friction=fixed.geom_friction.at[:, 0].set(mu))
        now = program.step(here, data.replace(qpos=q, qvel=v, qacc_warmstart=warm))
        return now.qpos, now.qvel, now.qacc_warmstart

    @jax.jit
    def advance(state: Any, directions: Any) -> Any:
        """The next state, and its derivatives in two directions."""
        mu = jax.numpy.array([1.0, 0.0])
        one = lambda d_mu, d: jax.jvp(step, (MU, *state), (d_mu, *d))
        return jax.vmap(one, out_axes=(None, 0))(mu, directions)

    state = data.qpos, data.qvel.at[0].set(V), data.qacc_warmstart
    directions = tuple(jax.numpy.zeros((2, len(x))) for x in state)
    directions = directions[0], directions[1].at[1, 0].set(1.0), directions[2]
    for _ in range(round(case.duration / dt)):
        state, directions = advance(state, directions)
    by_mu, by_v = directions[0][:, 0]
    return float(state[0][0] - data.qpos[0]), float(by_mu), float(by_v)


def newton(case: Case, dt: float, ke: float, kd: float, kf: float) -> Found:
    program, warp = import_module("newton"), import_module("warp")
    warp.config.quiet = True
    with warp.ScopedDevice("cpu"):
        builder = program.ModelBuilder(up_axis=program.Axis.Z, gravity=(0.0, 0.0, -GRAVITY))
        cfg = program.ModelBuilder.ShapeConfig(ke=ke, kd=kd, kf=kf, mu=MU, density=0.0)
        mass, block = 0.15, case.share == 1
        z, inertia = (0.01, mass * 5e-4 / 3) if block else (0.024, 0.4 * mass * 0.024**2)
        sag = mass * GRAVITY / ke / (4 if block else 1)  # by as many contact points
        body = builder.add_body(
            xform=warp.transform(warp.vec3(0.0, 0.0, z - sag), warp.quat_identity()),
            mass=mass, inertia=warp.mat33(np.eye(3) * inertia),
        )  # fmt: skip
        if block:
            builder.add_shape_box(body, hx=0.02, hy=0.02, hz=0.01, cfg=cfg)
        else:
            builder.add_shape_sphere(body, radius=0.024, cfg=cfg)
        builder.add_ground_plane(cfg=cfg)
        model = builder.finalize(requires_grad=True)
        solver = program.solvers.SolverSemiImplicit(model, angular_damping=0.0)
        pipeline = program.CollisionPipeline(model, broad_phase="explicit", requires_grad=True)
        states = [model.state() for _ in range(round(case.duration / dt) + 1)]
        velocity = states[0].body_qd.numpy()
        velocity[0, 0] = V
        states[0].body_qd.assign(velocity)
        control = model.control()
        with warp.Tape() as tape:
            for now, then in pairwise(states):
                contacts = pipeline.contacts()
                pipeline.collide(now, contacts)
                solver.step(now, then, control, contacts, dt)
        x = warp.array([[1.0, 0, 0, 0, 0, 0, 0]], dtype=warp.transform)
        tape.backward(grads={states[-1].body_q: x})
        by_mu = model.shape_material_mu.grad.numpy().sum()
        return float(states[-1].body_q.numpy()[0, 0]), by_mu, states[0].body_qd.grad.numpy()[0, 0]


@dataclass(frozen=True)
class Program:
    run: Callable[..., Found]
    packages: list[str]
    settings: dict[str, dict[str, Any]]
    rolls: Case = SPHERE

    def errors(self, setting: dict[str, Any]) -> dict[str, float]:
        """Errors relative to the closed forms."""
        out = {}
        for body, case in (("block", BLOCK), ("rolls", self.rolls)):
            exact = differences(case.way, setting.get("h", 1e-6))
            found = self.run(case, **setting)
            for name, a, b in zip(("x", "dx/dmu", "dx/dv"), found, exact):
                out[f"{body}: {name}"] = float(a / b - 1)
        return out


HARD = {"contact": 'solref="0.004 1" solimp="0.99 0.999 0.0001"'}
CONES = {"elliptic": {"cone": "elliptic"}, "pyramidal": {"cone": "pyramidal"}}
SPRINGS = {"ke": 1e4, "kd": 30.0, "kf": 1e3}

PROGRAMS = {
    "torchsoft": Program(slid, ["torchsoft"], {
        "default": {},
        "`rtol=1e-7`": {"rtol": 1e-7},
        "`rtol=1e-7`, twice the elements": {"rtol": 1e-7, "elements": 16},
        "started half an element further": {"at": 5 + 1 / 16},
        "10 times the retardation time": {"tau": 10 * TAU},
        "differences over 5 %": {"h": 0.05},
    }, CYLINDER),
    "MuJoCo": Program(mujoco, ["mujoco"], {
        **CONES,
        "elliptic, stiff": {"cone": "elliptic", **HARD},
        "pyramidal, stiff": {"cone": "pyramidal", **HARD},
        "elliptic, stiff, 0.1 ms, differences over 5 %":
            {"cone": "elliptic", **HARD, "dt": 1e-4, "h": 0.05},
    }),
    "MJX": Program(mjx, ["mujoco-mjx", "jax"], CONES),
    "Newton": Program(newton, ["newton", "warp-lang"], {
        "soft springs, 0.2 ms": {"dt": 2e-4, "ke": 2e3, "kd": 10.0, "kf": 1e2},
        "stiff springs, 0.1 ms": {"dt": 1e-4, **SPRINGS},
        "stiff springs, 0.05 ms": {"dt": 5e-5, **SPRINGS},
    }),
}  # fmt: skip


def main(config: Config) -> None:
    if config.smoke:
        config = replace(config, programs=("torchsoft", "MuJoCo"))
    versions, seconds, tables = {}, {}, {}
    for name in config.programs:
        program = PROGRAMS[name]
        try:
            versions |= {package: version(package) for package in program.packages}
        except PackageNotFoundError:
            print(f"{name} is left out: pip install {' '.join(program.packages)}")
            continue
        rows = {}
        for label, setting in list(program.settings.items())[: 1 if config.smoke else None]:
            start = process_time()
            rows[label] = program.errors(setting)
            seconds[f"{name}, {label}"] = process_time() - start
        title = ", ".join(f"{package} {versions[package]}" for package in program.packages)
        tables[name] = numbers(title, rows, "+.2%")
    write(config, {"versions": versions, "CPU [s]": seconds}, tables)


if __name__ == "__main__":
    main(options(Config, __doc__))
