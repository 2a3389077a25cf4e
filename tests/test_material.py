"""Contracts of every material: modulus and chain by closed forms, gradients, files; and pads of
linear ones that creep by closed forms."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import COARSE, PAPER, RUBBER, rest, still

from torchsoft import (
    Actuator,
    Body,
    Circle,
    Contact,
    GeneralisedKelvin,
    KelvinVoigt,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Pad,
    PadMesh,
    Prony,
    Rig,
    SmoothSlip,
    SoftContact,
    StandardLinearSolid,
    hold,
    simulate,
)
from torchsoft.physics.hyperelastic import KINDS, again, described
from torchsoft.physics.material import Branch
from torchsoft.sysid import Standing

REST = {"nu": 0.45, "rho": 1100.0, "depth": 0.044}
ENERGIES = {
    "neo_hookean": {"E": 7.5e5},
    "mooney_rivlin": {"C10": 9e4, "C01": 4e4},
    "yeoh": {"C10": 1.3e5, "C20": -1e4, "C30": 3e3},
    "ogden": {"mu": [2.8e5, -2e4], "alpha": [1.8, -3.0]},
}
"""A new energy is one line here, a new linear material one of `LINEAR`."""
ARMS = {"moduli": [1.5e5, 4.5e5], "times": [0.4, 0.05]}


def fading(s: Any, moduli: Any, times: Any) -> Any:
    """Stress over strain [Pa] of Maxwell elements at complex frequencies s [1/s]."""
    return sum(E * s * t / (1 + s * t) for E, t in zip(moduli, times))


def behind_a_spring(s: Any, first: float, solid: Any) -> Any:
    """Stress over strain of a `solid` with the relaxed modulus 7.5e5 Pa whose spring, a part
    `first` of its compliance, gives way in 1 ms."""
    return 1 / (1 / solid - first / 7.5e5 * (1 - 1 / (1 + s * 1e-3)))


LINEAR = {
    "kelvin_voigt": ({"tau": 0.01}, lambda s: 7.5e5 * (1 + 0.01 * s)),
    "standard_linear_solid": (
        {"E_instant": 1.5e6, "tau": 0.02, "tau_instant": 1e-3},
        lambda s: behind_a_spring(s, 0.5, 7.5e5 + fading(s, [7.5e5], [0.01])),
    ),
    "generalised_kelvin": (
        {"J": [0.3, 0.2, 0.1], "tau": [4e-3, 0.02, 0.3], "tau_instant": 1e-3},
        lambda s: 7.5e5 / (0.4 / (1 + 1e-3 * s) + 0.3 / (1 + 4e-3 * s) + 0.2 / (1 + 0.02 * s)
                           + 0.1 / (1 + 0.3 * s)),
    ),
    "prony": (
        {"moduli": [3e5, 2e5, 1e5], "tau": [0.1, 3e-3, 4.0], "tau_instant": 1e-3},
        lambda s: behind_a_spring(
            s, 7.5e5 / 1.35e6, 7.5e5 + fading(s, [3e5, 2e5, 1e5], [0.1, 3e-3, 4.0])
        ),
    ),
}  # fmt: skip
"""Arguments beside those of `RUBBER`, and stress over strain [Pa] at complex frequencies [1/s]."""


def energy(kind: str, tau: float = 0.01, **arms: Any) -> Any:
    return KINDS[kind](**ENERGIES[kind], **REST, tau=tau, **arms)


MATERIALS = {
    name: ({"kind": name} | RUBBER | more, modulus) for name, (more, modulus) in LINEAR.items()
}
for kind, own in ENERGIES.items():
    E = energy(kind).E.item()
    modulus = lambda s, E=E: E * (1 + 1e-3 * s)
    table = {"kind": kind, "tau": 1e-3} | REST | own
    MATERIALS |= {
        kind: (table, modulus),
        f"{kind}, relaxing": (
            table | ARMS, lambda s, modulus=modulus: modulus(s) + fading(s, *ARMS.values())
        ),
    }  # fmt: skip
EVERY = pytest.mark.parametrize("name", MATERIALS)


def made(name: str) -> Any:
    return again(MATERIALS[name][0])


# the contract


@EVERY
@torch.no_grad()
def test_the_modulus_is_that_of_springs_and_dashpots(name):
    """And the chain is one: positive fractions of one compliance, which all creep at last. A branch
    added takes its fraction from the others."""
    material, modulus = made(name), MATERIALS[name][1]
    omega = torch.logspace(-4, 6, 41, dtype=torch.float64)
    expected = torch.from_numpy(modulus(1j * omega.numpy()))
    assert float((material.complex_modulus(omega) / expected - 1).abs().max()) < 1e-12
    J, tau = material.chain()
    assert len(J) == len(tau) == material.branches
    assert float(J.min()) > 0 and float(tau.min()) > 0  # noqa: PT018
    creep = material.creep(torch.tensor([0.0, 1e6]).double()) * material.E
    assert creep.tolist() == pytest.approx([0.0, 1.0], abs=1e-12)
    assert material.well_posed() == ""
    material.added.append(Branch(0.2, 0.05))
    softer = 0.8 / expected + 0.2 / (material.E * (1 + 0.05j * omega))
    assert float((material.complex_modulus(omega) * softer - 1).abs().max()) < 1e-12


@EVERY
def test_the_modulus_has_its_derivatives_by_every_parameter(name):
    material, omega = made(name), torch.tensor([3.0, 40.0]).double()
    leaves = dict(material.named_parameters())

    def value():
        return torch.log(material.complex_modulus(omega).abs() * material.creep(1 / omega)).sum()

    slopes = torch.autograd.grad(value(), list(leaves.values()), materialize_grads=True)
    with torch.no_grad():
        for (key, leaf), slope in zip(leaves.items(), slopes):
            at, ends = leaf.clone(), list[float]()
            for h in (1e-5, -1e-5):
                leaf.copy_(at * (1 + h))
                ends.append(float(value()))
            leaf.copy_(at)
            difference = (ends[0] - ends[1]) / 2e-5
            assert float(slope * at) == pytest.approx(difference, rel=1e-6, abs=1e-9), key


@EVERY
def test_a_rig_file_has_the_material_and_its_parameters(name):
    material, table = made(name), MATERIALS[name][0]
    file = PAPER.override({"materials.rubber": table})
    rig = file.assemble()
    assert type(rig.pads["L"].material) is type(material)
    if table["kind"] in ENERGIES:
        assert described(material) == table
    for key, p in material.named_parameters():
        symbol, _, k = key.partition("_")
        own = f"{material.lists[symbol]}_{k}" if symbol in material.lists and k.isdigit() else key
        assert float(rig.parameter(f"materials.rubber.{own}").detach()) == p.item()
    changed = file.override({f"materials.rubber.{own}": 1.01 * p.item()}).assemble()
    assert float(changed.parameter(f"materials.rubber.{own}").detach()) == 1.01 * p.item()


def test_every_material_of_rig_files_is_here():
    assert {table["kind"] for table, _ in MATERIALS.values()} == set(KINDS)


@torch.no_grad()
@pytest.mark.parametrize(
    ("moduli", "tau"),
    [
        (np.geomspace(1e6, 1e3, 11), np.geomspace(1e-5, 1e5, 11)),
        ([1.0, 1e9, 3.0, 1e7], [1e-3, 2e-3, 1.0, 50.0]),
        ([1e5, 2e5, 1e5], [0.1, 0.1 * (1 + 1e-7), 5.0]),
    ],
    ids=["ten decades", "faint and strong", "close"],
)
def test_a_relaxation_series_is_its_chain_exactly(moduli, tau):
    """At every frequency, and retardation times interlace with relaxation times."""
    solid = Prony(**RUBBER, moduli=moduli, tau=tau, tau_instant=1e-9)
    J, late = (part[1:].numpy() for part in solid.chain())
    s = 1j * np.logspace(-8, 8, 65)
    compliance = 1 - J.sum() + (J / (1 + s[:, None] * late)).sum(-1)
    assert np.abs(compliance * (1 + fading(s, moduli, tau) / 7.5e5) - 1).max() < 1e-10
    assert (J > 0).all()
    assert (late > np.sort(tau)).all()
    assert (late[:-1] < np.sort(tau)[1:]).all()
    assert float(solid.relaxation(torch.zeros(1).double())) == pytest.approx(7.5e5 + sum(moduli))


WRONG = [
    (lambda: NeoHookean(**RUBBER, tau=0.01, moduli=[1e5], times=[0.1, 0.2]),
     "as many `moduli` as `times`"),
    (lambda: NeoHookean(**RUBBER, tau=0.01, moduli=[1e5, 2e5], times=[0.1, 0.1]),
     "relaxation times are equal"),
    (lambda: Prony(**RUBBER, moduli=[1e5, 2e5], tau=[0.1, 0.1]), "relaxation times are equal"),
    (lambda: Prony(**RUBBER, moduli=[1e5], tau=[0.1], tau_instant=0.2), "below the shortest tau"),
    (lambda: GeneralisedKelvin(**RUBBER, J=[0.7, 0.4], tau=[0.1, 1.0]), "sum to 1.1, above one"),
    (lambda: StandardLinearSolid(**RUBBER, E_instant=1e5, tau=0.1), "E_instant is below E"),
    (lambda: MooneyRivlin(C10=1e4, C01=-2e4, **REST, tau=0.01), "make it positive"),
    (lambda: Ogden(mu=[1e5], alpha=[0.0], **REST, tau=0.01), "leave that term out"),
    (lambda: KelvinVoigt(**RUBBER | {"E": None}, tau=0.01), "must be a number, but is None"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "words"), WRONG, ids=[words for _, words in WRONG])
def test_numbers_that_do_not_fit_together_are_rejected(make, words):
    with pytest.raises(ValueError, match=words):
        raise ValueError(make().well_posed())


# pads


STIFFNESS = 1.2e5
"""Of the contact spring [N/m]."""
SAMPLED = torch.cat((torch.zeros(1).double(), torch.logspace(-3, 1, 17, dtype=torch.float64)))


@pytest.mark.parametrize("name", LINEAR)
@torch.no_grad()
def test_creep_under_a_held_force_is_the_closed_form(name):
    """A punch without friction is pushed by a force onto the middle node of a pad, and starts with
    the contact spring pressed and the pad not yet. A dashpot stops the punch of hardly any mass
    from ringing, and carries no force once punch and pad move together."""
    material, force = made(name), 1.0
    law = SoftContact(STIFFNESS, 0.2, STIFFNESS, 1.0, friction=SmoothSlip(0, 0, 1))
    push = Actuator(
        "punch.y", "punch.y", lambda w, w_dot, f, q, q_dot: f, setpoint="y_d", feed_forward="F"
    )
    y = 4.59e-3 + 5e-3 - force / STIFFNESS
    rig = Rig(
        bodies={"punch": Body(1e-7, Circle(5e-3), x=3e-3, theta=0.0, weighted=False)},
        pads={"pad": Pad(PadMesh(6e-3, 4.59e-3, 6, 2), material)},
        contacts={"pad": Contact("pad", "punch", law, may_leave=True)},
        actuators={"push": push}, reference=hold(y_d=y, F=-force),
    )  # fmt: skip
    y0 = torch.zeros(rig.layout.size, dtype=torch.float64)
    y0[rig.layout.slices["pose", "punch"]] = y
    run = simulate(rig, SAMPLED, y0=y0, rtol=2e-9, atol=1e-14)
    softness = float(rig.pads["pad"].compliance().detach()[7, 7])
    expected = force * softness * material.creep(SAMPLED) * material.E
    found = run["y_punch"][0] - run["y_punch"]
    assert found[1:].tolist() == pytest.approx(expected[1:].tolist(), rel=1e-6)


def test_a_recording_that_starts_before_the_pads_forget_is_named():
    model = still(COARSE, material=made("prony"))
    with pytest.warns(UserWarning, match=r"begins 0.2 s before .* pad `.` creeps for 4.\d+ s"):
        Standing.of(model, rest(model))
    Standing.of(model, rest(model), lead=20.0)
