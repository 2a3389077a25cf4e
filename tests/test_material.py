"""Materials of the pads: closed forms of creep and relaxation, the exact conversion, energy,
gradients, what is refused."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import pytest
import torch
from conftest import COARSE, RUBBER, f64, rest, still
from scipy.optimize import brentq
from torch import Tensor

from torchsoft import (
    Actuator,
    Body,
    Circle,
    Contact,
    GeneralisedKelvin,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Prony,
    Reference,
    Rig,
    RigFile,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
    Trajectory,
    simulate,
)
from torchsoft.physics.material import LINEAR, Material, retarded
from torchsoft.plot.diagram import graph_of
from torchsoft.sysid import Known, Problem, Recording, Sensor, Standing, Unknown, identify

MATERIALS: dict[str, Callable[[], Material]] = {
    "kelvin_voigt": lambda: KelvinVoigt(**RUBBER, tau=0.01),
    "standard_linear_solid": lambda: StandardLinearSolid(**RUBBER, E_instant=1.5e6, tau=0.02,
    tau_instant=1e-3),
    "generalised_kelvin": lambda: GeneralisedKelvin(**RUBBER, J=[0.3, 0.2, 0.1],
    tau=[4e-3, 0.02, 0.3], tau_instant=1e-3), "prony": lambda: Prony(
        **RUBBER, moduli=[3e5, 2e5, 1e5, 5e4, 5e4], tau=[3e-3, 0.01, 0.1, 0.5, 4.0],
        tau_instant=1e-3
    ),
}  # fmt: skip
CLOSED = 1e-6
"""Runs against closed forms, relative."""
TIGHT = 2e-9
"""Relative tolerance of the steps of these runs."""


@pytest.fixture(params=list(MATERIALS))
def material(request):
    return MATERIALS[request.param]()


# --- the chain
# ----------------------------------------------------------------------


def impedance(solid: Prony, s: Tensor) -> Tensor:
    """Stress over strain [Pa] of a relaxation series at complex frequencies s (...) [1/s]."""
    moduli, tau = solid.series()
    return solid.E + (moduli * s[..., None] * tau / (1 + s[..., None] * tau)).sum(-1)


SERIES: dict[str, tuple[Sequence[float], Sequence[float]]] = {
    "one": ([5e5], [0.1]),
    "unsorted": ([1e5, 5e5, 2e5], [3.0, 1e-2, 0.2]),
    "ten decades": (np.geomspace(1e6, 1e3, 11).tolist(), np.geomspace(1e-5, 1e5, 11).tolist()),
    "faint and strong": ([1e-6, 1e9, 1e-3, 1e7], [1e-3, 2e-3, 1.0, 50.0]),
    "close": ([1e5, 2e5, 1e5], [0.1, 0.1 * (1 + 1e-7), 5.0]),
}


@torch.no_grad()
@pytest.mark.parametrize("name", SERIES)
def test_a_relaxation_series_is_its_chain_exactly(name):
    """Compliance times modulus is one at every frequency, and retardation times interlace with
    relaxation times."""
    moduli, tau = SERIES[name]
    solid = Prony(**RUBBER, moduli=moduli, tau=tau, tau_instant=1e-9)
    J, late = retarded(solid.series()[0] / solid.E, solid.series()[1])
    omega = torch.logspace(-8, 8, 65, dtype=torch.float64)
    compliance = (J[0] + (J[1:] / (1 + 1j * omega[:, None] * late)).sum(-1)) / solid.E
    assert float((compliance * impedance(solid, 1j * omega) - 1).abs().max()) < 1e-10
    assert float(J.sum()) == pytest.approx(1.0, abs=1e-12)
    assert bool((J > 0).all())
    early = torch.tensor(sorted(tau), dtype=torch.float64)
    assert bool((late > early).all() and (late[:-1] < early[1:]).all())


@torch.no_grad()
def test_one_relaxation_time_is_the_standard_linear_solid():
    solid = Prony(**RUBBER, moduli=[7.5e5], tau=[0.01])
    like = StandardLinearSolid(**RUBBER, E_instant=1.5e6, tau=0.02)
    other = GeneralisedKelvin(**RUBBER, J=[0.5], tau=[0.02])
    for one in (solid, other):
        for mine, its in zip(one.chain(), like.chain()):
            assert torch.allclose(mine, its, rtol=1e-14, atol=0)


@torch.no_grad()
def test_creep_and_complex_modulus_have_their_limits(material):
    """From nothing to 1/E; the storage modulus from E on grows, and losses are positive."""
    E, ends = material.E.item(), f64(0.0, 1e6)
    assert (material.creep(ends) * E).tolist() == pytest.approx([0.0, 1.0], abs=1e-12)
    modulus = material.complex_modulus(torch.logspace(-4, 2, 25, dtype=torch.float64))
    assert modulus.real[0].item() == pytest.approx(E, rel=1e-3)
    assert bool((modulus.real.diff() > -1e-12 * E).all() and (modulus.imag > 0).all())
    if isinstance(
        material, Prony
    ):  # but for the instantaneous spring, which gives way in tau_instant
        omega = torch.logspace(-4, 1, 9, dtype=torch.float64)
        expected = impedance(material, 1j * omega)
        assert float((material.complex_modulus(omega) / expected - 1).abs().max()) < 2e-2
        assert float(material.relaxation(ends[:1])) == pytest.approx(E + 7e5, rel=1e-14)


# --- a pad under a held force and a held indentation
# ----------------------------------------------------------------------

RADIUS, HEIGHT, STIFFNESS = 5e-3, 4.59e-3, 1.2e5
"""Of the punch, so round that it touches one node of the 1 mm mesh, the pad, and the contact
spring: m, m, N/m."""


def punch(
    material: Material, *, force: float | None = None, depth: float = 0.0
) -> tuple[Rig, Tensor]:
    """A punch without friction on the middle node of a pad, pushed by a force [N] or held at a
    depth [m]; and the state at which it begins, with the contact spring pressed and the pad not
    yet. A dashpot stops the pushed one's hardly any mass from ringing, and carries no force once
    punch and pad move together."""
    mesh, R_n = PadMesh(6e-3, HEIGHT, 6, 2), 0.0 if force is None else 0.2
    law = SoftContact(STIFFNESS, R_n, STIFFNESS, 1.0, friction=SmoothSlip(0, 0, 1))
    body = Body(
        1e-7,
        Circle(RADIUS),
        x=3e-3,
        y="driven" if force is None else "free",
        theta=0.0,
        weighted=False,
    )
    push = Actuator(
        "punch.y", "punch.y", lambda w, w_dot, f, q, q_dot: f, setpoint="y_d", feed_forward="F"
    )
    y = HEIGHT + RADIUS - (depth if force is None else force / STIFFNESS)
    signals = {"punch.y": y} if force is None else {"y_d": y, "F": -force}
    rig = Rig(
        bodies={"punch": body}, pads={"pad": Pad(mesh, material)},
        contacts={"pad": Contact("pad", "punch", law, may_leave=True)},
        actuators={} if force is None else {"push": push}, groups={"rubber": material},
        reference=Reference(**{name: Profile([0.0], [value]) for name, value in signals.items()}),
    )  # fmt: skip
    y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
    if force is not None:
        y0[rig.layout.slices["pose", "punch"]] = y
    return rig, y0


def softness(rig: Rig) -> float:
    """Displacement of the middle node per force on it [m/N]."""
    return float(rig.pads["pad"].compliance().detach()[7, 7])


def relaxed(first: float, J: Tensor, tau: Tensor, t: Tensor) -> Tensor:
    """Stress per held strain (...) of a spring of the compliance `first` in series with Kelvin
    elements J, tau (n,): a residue at every zero of the compliance."""
    compliance = lambda r: first + float((J / (1 - r * tau)).sum())
    rates, out = sorted((1 / tau).tolist()), torch.full_like(t, 1 / (first + float(J.sum())))
    for low, high in pairwise([*rates, rates[-1] * (1 + 2 * float(J.sum()) / first)]):
        r = brentq(compliance, low * (1 + 1e-12), high * (1 - 1e-12), xtol=1e-300, rtol=1e-15)
        slope = -float((J * tau / (1 - r * tau) ** 2).sum())
        out = out + torch.exp(-r * t) / (-r * slope)
    return out


SAMPLED = torch.cat((torch.zeros(1).double(), torch.logspace(-3, 1, 17, dtype=torch.float64)))


def closed(run: Trajectory, found: Tensor, expected: Tensor) -> None:
    """Equal at every output but the first, relative to the value there."""
    assert len(run.knots) > 500
    assert float(((found - expected)[1:] / expected[1:]).abs().max()) < CLOSED


@torch.no_grad()
def test_creep_under_a_held_force_is_the_closed_form(material):
    rig, y0 = punch(material, force=1.0)
    run = simulate(rig, SAMPLED, y0=y0, rtol=TIGHT, atol=1e-14)
    closed(
        run,
        run["y_punch"][0] - run["y_punch"],
        softness(rig) * material.creep(SAMPLED) * material.E,
    )


@torch.no_grad()
def test_relaxation_under_a_held_indentation_is_the_closed_form(material):
    rig, y0 = punch(material, depth=5e-5)
    run = simulate(rig, SAMPLED, y0=y0, rtol=TIGHT, atol=1e-14)
    J, tau = material.chain()
    closed(
        run,
        run.loads["punch"][:, 1],
        5e-5 * relaxed(1 / STIFFNESS, softness(rig) * J, tau, SAMPLED),
    )


@pytest.mark.slow
def test_every_coefficient_of_a_series_is_identified():
    """From the punch's height under a held force, without noise, from starts a third away."""
    t = torch.cat((torch.zeros(1).double(), torch.logspace(-3, 0.5, 120, dtype=torch.float64)))
    values = {"E": 7.5e5, "E_1": 5e5, "tau_1": 5e-3, "E_2": 3e5, "tau_2": 0.1}

    def solid(E: float, E_1: float, tau_1: float, E_2: float, tau_2: float) -> Prony:
        return Prony(**(RUBBER | {"E": E}), moduli=[E_1, E_2], tau=[tau_1, tau_2])

    rig, y0 = punch(solid(**values), force=1.0)
    y = simulate(rig, t, y0=y0, rtol=1e-7)["y_punch"].detach().numpy()
    start = {
        name: value * factor
        for (name, value), factor in zip(values.items(), (1.3, 0.7, 1.4, 0.8, 0.75))
    }
    nominal, _ = punch(solid(**start), force=1.0)
    recording = Recording("creep", nominal, {"y_punch": (t.numpy(), y)}, Known(y0))
    unknowns = {f"rubber.{name}": Unknown() for name in values}
    result = identify(Problem([recording], {"y_punch": Sensor(noise=1e-9)}, unknowns), rtol=1e-5)
    found = {one.name.removeprefix("rubber."): one.value for one in result.estimates}
    assert found == pytest.approx(values, rel=1e-4)


# --- the grasp
# ----------------------------------------------------------------------

STABLE = COARSE | {"control.senses": "bracket.x"}


@torch.no_grad()
def test_the_graph_has_the_fields_of_the_chain(material):
    labels = {
        data["label"] for _, data in graph_of(still(STABLE, material=material)).nodes(data=True)
    }
    own = "L" if material.branches == 1 else f"L,1..{material.branches}"
    assert {f"C: [K_{own}]^-1", f"R: [R_{own}]"} <= labels
    assert material.branches == len(material.chain()[0])


# --- what is refused
# ----------------------------------------------------------------------


def test_a_recording_that_begins_before_the_pads_forget_is_named():
    model = still(STABLE, material=MATERIALS["prony"]())
    with pytest.warns(
        UserWarning,
        match=r"begins 0.2 s before the first sample, but the pad `.` creeps for 4.27 s",
    ) as said:
        Standing.of(model, rest(model))
    assert len(said) == 2
    Standing.of(model, rest(model), lead=20.0)


def test_every_material_has_a_name_in_files():
    assert {name: type(make()) for name, make in MATERIALS.items()} == dict(LINEAR)


@pytest.mark.parametrize("kind", list(MATERIALS))
def test_a_material_needs_its_modulus(kind, monkeypatch):
    monkeypatch.setitem(RUBBER, "E", None)
    with pytest.raises(ValueError, match="must be a number, but is None"):
        MATERIALS[kind]()


def test_an_actuator_of_a_file_pushes_a_coordinate():
    with pytest.raises(ValueError, match=r"actuators.x.pushes: "):
        RigFile.ready("paper").override({"actuators.x.pushes": ""})
