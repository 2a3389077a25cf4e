"""Pads at finite strain: elements against theory and another program, energies in every form, rest,
runs and files."""

import ctypes
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import PAPER, RUBBER, f64, paper
from torch import Tensor

from torchsoft import (
    Body,
    Circle,
    Hyperelastic,
    KelvinVoigt,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Pad,
    PadMesh,
    Rig,
    Trajectory,
    Yeoh,
    simulate,
)
from torchsoft.codegen import compile_law
from torchsoft.physics import elements
from torchsoft.physics.elements import element_constants, element_potentials
from torchsoft.physics.hyperelastic import again, described, invariants, plane
from torchsoft.physics.setup import PadSetup
from torchsoft.physics.statics import net_loads, settled, unstretched
from torchsoft.solve.kernel.arrays import LANES
from torchsoft.solve.laws import Factors, as_law, element
from torchsoft.testing import CheckFailed, check_energy

REST = {"nu": 0.45, "rho": 1100.0, "tau": 0.01, "depth": 0.044}
MATERIALS = {
    "neo_hookean": lambda: NeoHookean(**RUBBER, tau=0.01),
    "mooney_rivlin": lambda: MooneyRivlin(C10=9e4, C01=4e4, **REST),
    "yeoh": lambda: Yeoh(C10=1.3e5, C20=-1e4, C30=3e3, **REST),
    "ogden": lambda: Ogden(mu=[2.8e5, -2e4], alpha=[1.8, -3.0], **REST),
}
SKEWED = np.array([[[0.0, 0.0], [1.0, 0.02], [1.05, 1.0], [0.03, 0.9]]]) * 1e-3
CONSTANTS = torch.from_numpy(element_constants(SKEWED)[0])


@pytest.fixture(scope="module", params=MATERIALS)
def material(request):
    return MATERIALS[request.param]()


def factors(material, tau: float = 0.01) -> Tensor:
    lame = material.bulk - 2 / 3 * material.shear, material.shear
    return torch.stack((material.depth, f64(tau)[0], *lame)).detach()


def random(size: float, seed: int = 0, n: int = 8) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(n, generator=generator, dtype=torch.float64)


@cache
def law_of(material, lanes: int = 1):
    own = Factors(factors(material))
    function, parameters = as_law(element, {"material": material, "factors": own})
    x = torch.cat((random(1e-4), random(1e-4, 1), CONSTANTS))
    law = compile_law(
        function, x, parameters, linear=8, differentiated=16, conjugates=8, lanes=lanes
    )
    p = np.concatenate([value.detach().numpy().ravel() for value in parameters.values()])
    return law, p


def linearised(law, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outputs and derivatives of a compiled law at inputs x (inputs,) or (inputs, lanes)."""
    out, J = np.zeros((9, *x.shape[1:])), np.zeros((8, 16, *x.shape[1:]))
    call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)(law.linearise)
    call(*(np.ascontiguousarray(one).ctypes.data for one in (x, p)), out.ctypes.data, J.ctypes.data)
    return out, J


# elements
# ----------------------------------------------------------------------


def test_the_compiled_element_is_the_derivative_of_its_energies(material):
    law, p = law_of(material)
    x = torch.cat((random(1e-4), random(1e-3, 1), CONSTANTS))
    out, J = linearised(law, x.numpy(), p)
    at = x.clone().requires_grad_()
    energy, potential = element_potentials(material, factors(material), at)
    elastic = torch.autograd.grad(energy, at, retain_graph=True)[0][:8]
    viscous = torch.autograd.grad(potential, at)[0][8:16]
    assert out[:8] == pytest.approx((elastic + viscous).numpy(), rel=1e-12, abs=1e-12)
    assert out[8] == pytest.approx(2 * float(potential.detach()), rel=1e-12)
    for i in range(16):
        size = 1e-9 if i < 8 else 1e-7
        d = np.zeros(len(x))
        d[i] = size
        ahead, behind = (linearised(law, x.numpy() + s * d, p)[0][:8] for s in (1, -1))
        slope = (ahead - behind) / (2 * size)
        assert J[:, i] == pytest.approx(slope, rel=1e-6, abs=1e-7 * np.abs(J[:, i]).max())


def test_its_derivative_at_rest_is_that_of_the_smallest_motion(material):
    """A product whose first factor vanishes has a derivative: at no strain and no rate."""
    law, p = law_of(material)
    none, some = (torch.cat((random(s), random(s, 1), CONSTANTS)).numpy() for s in (0.0, 1e-13))
    at_rest, moving = (linearised(law, x, p)[1] for x in (none, some))
    assert at_rest == pytest.approx(moving, rel=1e-6, abs=1e-8 * np.abs(moving).max())
    assert np.linalg.eigvalsh(at_rest[:, 8:]).min() > -1e-12 * np.abs(at_rest[:, 8:]).max()


def test_several_elements_at_once_are_each_of_them(material):
    (one, p), (several, _) = law_of(material), law_of(material, LANES)
    x = [torch.cat((random(1e-4, k), random(1e-3, -k), CONSTANTS)).numpy() for k in range(LANES)]
    out, J = linearised(several, np.stack(x, -1), p)
    for lane in range(LANES):
        alone = linearised(one, x[lane], p)
        assert np.array_equal(out[..., lane], alone[0])
        assert np.array_equal(J[..., lane], alone[1])
    w, sums = np.random.default_rng(0).normal(size=(8, LANES)), []
    for law, pairs in ((several, [(np.stack(x, -1), w)]), (one, list(zip(x, w.T)))):
        bar = np.zeros(len(p))
        call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)(law.pullback)
        for own, weights in pairs:
            given = [np.ascontiguousarray(a) for a in (own, p, weights)]
            call(*(a.ctypes.data for a in given), bar.ctypes.data)
        sums.append(bar)
    assert sums[0] == pytest.approx(sums[1], rel=1e-11, abs=1e-13 * np.abs(sums[1]).max())


def test_small_strains_are_those_of_the_linear_element(material):
    linear = KelvinVoigt(E=material.E.item(), **REST)
    x = torch.cat((random(1e-10), random(1e-10, 1), CONSTANTS)).requires_grad_()
    rows = []
    for one in (material, linear):
        energy, potential = element_potentials(one, factors(material), x)
        rows.append(torch.autograd.grad(energy + potential, x)[0][:16])
    assert rows[0].numpy() == pytest.approx(rows[1].numpy(), rel=1e-6, abs=1e-6 * rows[1].max())


def test_a_turn_costs_no_energy_and_its_rate_no_power(material):
    corners, angle, spin = torch.from_numpy(SKEWED[0]), 1.1, 3.0
    c, s = np.cos(angle), np.sin(angle)
    R = torch.tensor([[c, -s], [s, c]])
    W = spin * torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
    u = random(5e-5).reshape(4, 2)
    turned = (corners + u) @ R.mT - corners
    x = torch.cat((turned.flatten(), ((corners + turned) @ W.mT).flatten(), CONSTANTS))
    plain = torch.cat((u.flatten(), torch.zeros(8).double(), CONSTANTS))
    energy, power = element_potentials(material, factors(material), x).detach()
    strained, _ = element_potentials(material, factors(material), plain).detach()
    assert float(energy) == pytest.approx(float(strained), rel=1e-12)
    assert float(power) < 1e-20 * float(strained)


def test_uniform_strain_passes_the_patch_test(material):
    """Nodes inside of a skewed mesh are balanced, and the energy is that of the area."""
    generator = np.random.default_rng(0)
    mesh = PadMesh(4e-3, 3e-3, 4, 3)
    nodes = mesh.nodes.copy()
    inner = ((nodes > 1e-9) & (nodes < [4e-3 - 1e-9, 3e-3 - 1e-9])).all(1)
    nodes[inner] += generator.uniform(-2e-4, 2e-4, (inner.sum(), 2))
    F = np.array([[1.2, 0.3], [-0.1, 0.75]])
    u = torch.from_numpy((nodes @ (F - np.eye(2)).T)[mesh.elements].reshape(-1, 8))
    constants = torch.from_numpy(element_constants(nodes[mesh.elements]))
    x = torch.cat((u, torch.zeros_like(u), constants), -1).requires_grad_()
    energy = element_potentials(material, factors(material), x)[..., 0].sum()
    (f,) = torch.autograd.grad(energy, x)
    total = np.zeros_like(nodes)
    np.add.at(total, mesh.elements.ravel(), f[:, :8].reshape(-1, 2).numpy())
    whole = torch.eye(3).double()
    whole[:2, :2] = torch.from_numpy(F)
    W = float(material.energy(whole).detach())
    assert np.abs(total[inner]).max() < 1e-13 * np.abs(total).max()
    assert float(energy.detach()) == pytest.approx(W * 0.044 * 12e-6, rel=1e-12)


def test_forces_are_those_of_another_program(monkeypatch):
    """felupe's mean dilatation, a layer pressed by a sixth of its height: without the modulus
    `WITHIN`, which that formulation lacks, to rounding; with it, what it changes."""
    data = np.genfromtxt(Path(__file__).parent / "felupe_layer.csv", names=True, delimiter=",")
    nodes, u, f = (np.stack([data[f"{n}_{axis}"] for axis in "xy"], -1) for n in ("X", "u", "f"))
    number = np.arange(len(nodes)).reshape(5, 13)
    quads = np.stack(
        (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]), -1
    ).reshape(-1, 4)
    rubber = NeoHookean(E=7.5e5, nu=0.45, rho=1.0, tau=1.0, depth=1.0)
    constants = torch.from_numpy(element_constants(nodes[quads]))
    forces = {}
    for within in (0.0, elements.WITHIN):
        monkeypatch.setattr(elements, "WITHIN", within)
        at = torch.from_numpy(u[quads].reshape(-1, 8))
        x = torch.cat((at, torch.zeros_like(at), constants), -1).requires_grad_()
        energy = element_potentials(rubber, factors(rubber), x)[..., 0].sum()
        forces[within] = np.zeros_like(nodes)
        own = torch.autograd.grad(energy, x)[0][:, :8].reshape(-1, 2).numpy()
        np.add.at(forces[within], quads.ravel(), own)
    free = (data["f_x"] == 0) & (data["f_y"] == 0)
    scale = np.abs(f).max()
    assert free.sum() > 30
    assert np.abs(forces[0.0] - f).max() < 1e-9 * scale
    pressed = nodes[:, 1] > 4e-3 - 1e-9
    with_it, without = (forces[k][pressed, 1].sum() for k in (elements.WITHIN, 0.0))
    assert 1e-4 < abs(with_it / without - 1) < 2e-3


# materials
# ----------------------------------------------------------------------


def test_moduli_of_small_strains_are_those_of_the_energy(material):
    assert material.well_posed() == ""
    again_made = again(described(material))
    F = torch.eye(3).double() + 0.2 * torch.tensor([[1.0, 2, 0], [0.5, -1, 0], [0, 0, 0]])
    assert float(again_made.energy(F).detach()) == float(material.energy(F).detach())


class Bent(Hyperelastic):
    """A neo-Hookean energy with another term."""

    def __init__(self, term: Callable[[Tensor], Tensor]) -> None:
        super().__init__(**RUBBER, tau=0.01)
        self.term = term

    def distortion(self, F: Tensor) -> Tensor:
        return 0.5 * self.shear * (invariants(F)[0] - 3) + self.term(F)


def green(F: Tensor, i: int, j: int) -> Tensor:
    """An entry of C = F^T F."""
    return (F[..., i] * F[..., j]).sum(-1)


FAULTS = {
    "has a stress without strain": lambda F: 100.0 * (F[..., 0, 0] - 1),
    r"P_xx by F_xx .* 3.20038e\+06 Pa, but 2.84483e\+06 Pa": (
        lambda F: 1e6 / 7.5 * (invariants(F)[0] - 3)
    ),
    "changes with a rotation": lambda F: 3e5 * F[..., 1, 0] ** 2,
    "changes with a rotation .*F = ": lambda F: 3e5 * (F[..., 1, 1] - 1) ** 2,
    "changes with a rotation .* C = ": lambda F: 1e7 * F[..., 1, 0] ** 4,
    "P_yy by F_yy .* make them agree": lambda F: 3e4 * (green(F, 1, 1) - 1) ** 2,
    "P_xy by F_xy .* make them agree": lambda F: 3e4 * green(F, 0, 1) ** 2,
    r"not stable at F = \[\[0.98, 0.1\]": lambda F: -1e7 * (invariants(F)[0] - 3) ** 2,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_energy_that_is_no_isotropic_objective_stable_one_is_rejected(fault):
    assert re.search(fault, Bent(FAULTS[fault]).well_posed())


def test_energies_that_are_right_pass_and_a_negative_modulus_is_rejected():
    for term in (lambda F: 0 * F[..., 0, 0], lambda F: 1e5 * (green(F, 1, 1) - 1) ** 4):
        assert Bent(term).well_posed() == ""
    soft = MooneyRivlin(C10=1e4, C01=-2e4, **REST)
    assert "make it positive" in soft.well_posed()


def test_an_energy_that_collapses_at_the_strains_of_a_run_fails_check_energy():
    """In simple shear s the modulus of Yeoh's energy is 2 C10 + 12 C20 s^2: negative from 0.236 on
    with C20 = -3 C10."""
    rubber = Yeoh(C10=1.3e5, C20=-3.9e5, **REST)
    modulus = lambda s: 2 * 1.3e5 - 12 * 3.9e5 * s**2
    F = plane(f64(1.0, 0.3, 0.0, 1.0).reshape(1, 2, 2))
    assert float(rubber.stress_and_moduli(F)[1][0, 1, 1]) == pytest.approx(modulus(0.3), rel=1e-9)
    assert rubber.well_posed() == ""
    mesh = PadMesh(length=8e-3, height=2e-3, elements_x=4, elements_y=2)
    bodies = {"free": Body(1.0, Circle(1e-3), weighted=False)}
    rig = Rig(bodies=bodies, pads={"P": Pad(mesh, rubber)}, contacts={})

    def sheared(s: float) -> Tensor:
        y = torch.zeros(rig.layout.size, dtype=torch.float64)
        u = np.outer(mesh.nodes[mesh.free, 1], [s, 0.0]).ravel()
        y[rig.layout.slices["pads", "P"]] = torch.from_numpy(u)
        return y

    run = {"rig": rig, "t": f64(0.0, 1e-6)}
    check_energy(**run, y0=sheared(0.2))
    with pytest.raises(CheckFailed, match=r"`P`: the energy is not stable at F = .*0\.3") as failed:
        check_energy(**run, y0=sheared(0.3))
    least = float(re.search(r"stiffness is (\S+) Pa", str(failed.value))[1])
    assert least == pytest.approx(modulus(0.3), rel=0.1)


def test_ogdens_sums_are_smooth_where_stretches_are_equal():
    rubber = MATERIALS["ogden"]()

    def energy(a: float, b: float, turn: float) -> float:
        c, s = np.cos(turn), np.sin(turn)
        R = torch.tensor([[c, -s], [s, c]])
        F = torch.eye(3).double()
        F[:2, :2] = torch.diag(f64(a, b)) @ R
        return float(rubber.distortion(F).detach())

    def direct(a: float, b: float) -> float:
        J = a * b
        return sum(
            2 * mu.item() / k.item() ** 2
            * (sum((x * J ** (-1 / 3)) ** k.item() for x in (a, b, 1.0)) - 3)
            for mu, k in rubber.series()
        )  # fmt: skip

    for a, b in ((1.3, 1.3), (1.3, 1.3001), (1.1, 1.35), (0.5, 2.2), (0.8, 0.95)):
        assert energy(a, b, 0.7) == pytest.approx(direct(a, b), rel=1e-10)


# rest, runs, files
# ----------------------------------------------------------------------


def pressed(nu: float, depth: float, material=NeoHookean, **mesh: int) -> float:
    """Force [N] on the paper's disc, held so deep [m] in a lower pad, without friction or rates."""
    sizes = {"length": 0.06, "height": 4.59e-3, "elements_x": 60, "elements_y": 4} | mesh
    built = paper({"laws.steel_on_rubber.K_n": 4e6})
    rig = built.rig
    own = RUBBER | {"nu": nu}
    rig.pads["L"] = Pad(PadMesh(**sizes), material(**own, tau=0.01), origin=(30e-3, 0.0))
    pose = {
        "disc": f64(60e-3, 4.59e-3 + 19.37e-3 - depth, 0.0), "bracket": f64(60e-3, 1.0, 0.0)
    }  # fmt: skip
    still = {name: torch.zeros(3).double() for name in pose}
    with torch.no_grad():
        y = settled(rig, pose, still, unstretched(rig, ()))
        signals = torch.zeros(len(rig.signals), 2).double()
        load = net_loads(rig, rig.unpack(y, signals), signals, ())["disc"][1]
    return float(load) + 0.4065 * 9.81


def test_a_layer_that_is_pressed_by_a_sixth_is_stiffer_than_linear():
    for nu, low, high in ((0.45, 1.15, 1.30), (0.49, 1.25, 1.45)):
        finite, linear = pressed(nu, 0.75e-3), pressed(nu, 0.75e-3, KelvinVoigt)
        assert low < finite / linear < high
        little = [pressed(nu, 1e-6, kind) for kind in (NeoHookean, KelvinVoigt)]
        assert little[0] == pytest.approx(little[1], rel=2e-3)


def test_nearly_incompressible_pads_do_not_lock():
    coarse = pressed(0.499, 0.4e-3)
    fine = pressed(0.499, 0.4e-3, elements_x=120, elements_y=8)
    assert coarse == pytest.approx(fine, rel=0.04)


NEO = {"kind": "neo_hookean", "E": 7.5e5, "nu": 0.45, "tau": 0.01, "depth": 0.044}
COARSE = {
    "materials.rubber": NEO, "pads.L.elements_x": 60, "pads.U.elements_x": 60,
    "pads.L.elements_y": 2, "pads.U.elements_y": 2,
    "outputs": {"duration": 0.2, "interval": 5e-3, "snapshots": [0.0], "figures": False},
}  # fmt: skip


@pytest.fixture(scope="module")
def grasp():
    return paper(COARSE)


@pytest.fixture(scope="module")
def run(grasp):
    return grasp.run(rtol=1e-5)


def test_the_ledger_closes_by_tolerance(grasp, run):
    loose = grasp.run(rtol=1e-3)
    assert run.energy_residual_rel < 1e-5
    assert run.energy_residual_rel < 0.2 * loose.energy_residual_rel
    assert float(run.dissipated["pad_L"].diff().min()) >= 0
    assert float(run.energy["strain_L"][-1].detach()) > 1e-3


def test_it_starts_at_rest_and_stays(grasp):
    rig, y0 = grasp.rig, grasp.y0
    t = torch.linspace(0, 0.02, 3, dtype=torch.float64)
    held = paper(COARSE | {"motion.y_d": {"kind": "hold", "value": 49.99e-3}})
    kept = simulate(held.rig, t, y0=held.y0, rtol=1e-6)
    assert float((kept["y_C"] - kept["y_C"][0]).abs().max()) < 2e-7
    assert rig.layout.size == len(y0)


def test_a_run_is_kept_in_files_and_shown(run, tmp_path):
    run.save(tmp_path / "run.nc")
    loaded = Trajectory.load(tmp_path / "run.nc")
    assert torch.equal(loaded.y, run.y)
    pad = loaded.setup.pads["L"]
    assert pad.energy == {"rho": 1100.0, **NEO}
    whole = pad.displacement(run.displacement["L"][-1].numpy())
    assert pad.stress(whole).min() < -5e4
    assert 0.05 < pad.largest_strain(run.displacement["L"][-1].numpy()) < 0.5
    assert set(loaded.contact_state["L"][-1].unique().tolist()) <= {0, 1, 2}
    assert loaded.to_vtk(tmp_path / "run.pvd", [0.2])


def test_cauchys_stress_is_that_of_theory():
    rubber = MATERIALS["neo_hookean"]()
    setup = PadSetup.of(Pad(PadMesh(4e-3, 3e-3, 4, 3), rubber))
    F = np.array([[1.2, 0.3], [-0.1, 0.75]])
    u = setup.mesh.nodes @ (F - np.eye(2)).T
    J, b = np.linalg.det(F), np.diag([0.0, 0.0, 1.0])
    b[:2, :2] = F @ F.T
    mu, kappa = rubber.shear.item(), rubber.bulk.item()
    sigma = mu / J ** (5 / 3) * (b - np.trace(b) / 3 * np.eye(3)) + kappa * (J - 1) * np.eye(3)
    found = setup.stress(u)
    for i, j, k in ((0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 1, 3)):
        assert found[:, k] == pytest.approx(sigma[i, j], rel=1e-10)
    U = setup.strain(u)[0] + [1, 1, 0]
    stretches = np.linalg.eigvalsh([[U[0], U[2]], [U[2], U[1]]])
    assert stretches == pytest.approx(np.sort(np.linalg.svd(F)[1]), rel=1e-10)
    own = PadSetup.of(Pad(PadMesh(4e-3, 3e-3, 4, 3), Bent(lambda F: F[..., 0, 0])))
    with pytest.raises(ValueError, match="one of your own"):
        own.stress(u)


def test_its_numbers_are_unknowns_like_any(grasp):
    rig = grasp.rig
    assert rig.quantity("materials.rubber.E").unit == "Pa"
    ogden = {"kind": "ogden", "mu": [2.5e5], "alpha": [2.0]} | {
        name: NEO[name] for name in ("nu", "tau", "depth")
    }
    other = paper(COARSE | {"materials.rubber": ogden})
    assert float(other.rig.parameter("materials.rubber.mu_1").detach()) == 2.5e5
    file = PAPER.override(COARSE | {"materials.rubber": ogden})
    changed = file.override({"materials.rubber.alpha_1": 3.0}).build()
    assert float(changed.rig.parameter("materials.rubber.alpha_1").detach()) == 3.0
