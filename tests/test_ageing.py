"""Smooth friction that ages: the slip element's equation, the strength of a contact after a rest,
and the extension of a rig."""

import numpy as np
import pytest
import torch
from test_rate_and_state import sled

from torchsoft import AgeingSlip, Reference, RigFile, SmoothSlip, SoftContact, Trajectory, simulate
from torchsoft.codegen import emit
from torchsoft.codegen.graph import Graph
from torchsoft.codegen.trace import traced
from torchsoft.physics.contact import free_law
from torchsoft.physics.extensions import extend
from torchsoft.physics.motion import Lines
from torchsoft.solve.laws import as_law

MU, AGEING, D_C, T_0 = 0.6, 0.02, 20e-6, 1e-3


def some_points(ageing: float) -> tuple[torch.Tensor, ...]:
    """Efforts, normal forces, dashpots, lengths of stages and ages, over many orders of magnitude,
    of points whose dashpots and springs outweigh the fall of friction."""
    random = np.random.default_rng(0)
    E, F_N, R, h, age = torch.from_numpy(
        10 ** random.uniform([[-6], [-5], [-1], [-7], [-5]], [[2], [1], [3], [-2], [3]], (5, 20000))
    )
    falls = MU - 0.5 + ageing * torch.log1p((age + h) / T_0)
    return E, F_N, R + (falls / 5e-3 + h * ageing / D_C) * F_N, h, age


@pytest.mark.parametrize("ageing", [0.005, 0.1])
def test_the_slip_rate_solves_the_elements_equation(ageing):
    """R V + mu(V) F_N = E at the end of a stage with mu_s + ageing ln(1 + age / t_0) at rest, and
    V = 0 where the effort is below the strength of a point at rest."""
    E, F_N, R, h, age = some_points(ageing)
    law = AgeingSlip(MU, 0.5, 5e-3, ageing, D_C, T_0)
    with torch.no_grad():
        V, rate = law(E, F_N, R, age[:, None], h)
    aged, slips = age + h * rate[:, 0], V > 0
    assert aged == pytest.approx((age + h) / (1 + h * V / D_C), rel=1e-9)
    mu_s = MU + ageing * torch.log1p(aged / T_0)
    friction = (0.5 + (mu_s - 0.5) / (1 + V / 5e-3)) * F_N
    assert float(((R * V + friction) / E - 1)[slips].abs().max()) < 1e-9
    at_rest = (MU + ageing * torch.log1p((age + h) / T_0)) * F_N
    assert bool((slips == (at_rest < E)).all())
    assert 1000 < int(slips.sum()) < 19000


def test_without_ageing_it_is_smooth_slip():
    E, F_N, R, h, age = some_points(0.0)
    smooth, ages = SmoothSlip(MU, 0.5), AgeingSlip(MU, 0.5)
    with torch.no_grad():
        assert torch.equal(ages(E, F_N, R, age[:, None], h)[0], smooth(E, F_N, R))


def peak(rest: float) -> tuple[float, float]:
    """When a block that is drawn after a rest [s] has its largest friction over normal force [s],
    and that friction."""
    numbers = {
        "mu_s": MU,
        "mu_k": MU,
        "v_s": 1.0,
        "ageing": AGEING,
        "D_c": D_C,
        "t_0": T_0,
        "age_0": 0.0,
    }
    built = sled(kind="ageing", **numbers).build()
    way = Lines(np.array([0.0, rest, rest + 0.05]), np.array([0.0, 0.0, 1e-4]))
    t = torch.cat((torch.tensor([0.0]), torch.linspace(rest, rest + 0.05, 400))).double()
    run = simulate(built.rig, t, y0=built.y0, reference=Reference(**{"block.x": way}), rtol=1e-5)
    force = run.force["track"].sum(1)
    found = (force[:, 1].abs() / force[:, 0]).max(0)
    return float(t[found.indices]), float(found.values)


def test_static_friction_grows_with_the_logarithm_of_the_time_at_rest():
    """mu_s + ageing ln(1 + t / t_0), of a block whose points begin to slip nearly at once."""
    for rest in (0.01, 0.1, 1.0):
        t, friction = peak(rest)
        assert rest < t < rest + 0.01
        assert friction == pytest.approx(MU + AGEING * np.log1p(t / T_0), abs=0.05 * AGEING)


def test_a_file_keeps_the_states_with_their_units(tmp_path):
    built = sled(kind="ageing", mu_s=MU, mu_k=MU, ageing=AGEING).build()
    run = simulate(built.rig, built.t[:3], y0=built.y0, rtol=1e-4)
    assert run.to_xarray()["friction_state_track"].attrs["units"] == "s"
    run.save(tmp_path / "run.nc")
    again = Trajectory.load(tmp_path / "run.nc")
    assert again.layout.blocks == run.layout.blocks
    assert torch.equal(again.y, run.y)


def test_a_rig_is_extended_by_ageing_and_keeps_its_names():
    built = RigFile.ready("paper").build()
    before = set(built.rig.names)
    extend(built.rig, ["laws.steel_on_rubber.friction.ageing"])
    frictions = {id(one.law.friction) for one in built.rig.contacts.values()}
    assert len(frictions) == 1  # both contacts still share it
    assert set(built.rig.names) - before == {"laws.steel_on_rubber.friction.ageing"}
    mu_s = built.rig.parameter("laws.steel_on_rubber.friction.mu_s")
    assert mu_s is next(iter(built.rig.contacts.values())).law.friction.mu_s


@pytest.mark.parametrize("ageing", [0.005, 0.1])
def test_derivatives_of_the_slip_rate_are_those_of_the_elements_equation(ageing):
    """Though only the last of its steps are differentiated: dV/dE = 1 / (R - d(mu F_N)/dV)."""
    E, F_N, R, h, age = some_points(ageing)
    law = AgeingSlip(MU, 0.5, 5e-3, ageing, D_C, T_0)
    E.requires_grad_()
    V, _ = law(E, F_N, R, age[:, None], h)
    (by_E,) = torch.autograd.grad(V.sum(), E)
    V = V.detach().requires_grad_()
    older = torch.log1p((age + h) / (1 + h * V / D_C) / T_0)
    friction = (0.5 + (MU + ageing * older - 0.5) / (1 + V / 5e-3)) * F_N
    (falls,) = torch.autograd.grad(friction.sum(), V)
    slips = (V > 0).detach()
    assert by_E[slips].numpy() == pytest.approx((1 / (R + falls))[slips].numpy(), rel=1e-8)
    assert by_E[~slips].count_nonzero() == 0
    assert slips.sum() > 5000


def test_a_point_away_from_contact_iterates_nothing():
    """No normal force, no slip to search: most points of a pad do not touch."""
    law = SoftContact(1e5, 100.0, 1e5, 100.0, friction=AgeingSlip(MU, 0.5))
    graph = Graph()
    function, parameters = as_law(free_law, {"law": law})
    out = traced(graph, function, torch.linspace(0.01, 0.02, 4).double(), parameters)
    code = emit.function(graph, "value", ("x", "p", "out"), {"out": out})
    assert code.count("@log1p") == 1
