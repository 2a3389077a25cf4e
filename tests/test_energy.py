"""Power balance, momentum balance, and nothing that creates energy: at random states of several rigs, without any stepper."""

from collections.abc import Callable

import pytest
import torch
from conftest import coarse, f64, random_state, turning

from torchsoft import Rig, simulate
from torchsoft.physics.energy import dissipated, stored, supplied
from torchsoft.physics.multibond import net_efforts
from torchsoft.rigs import RigFile
from torchsoft.scenario import grasp_and_roll

SEEDS = range(4)


@pytest.mark.parametrize("seed", SEEDS)
def test_power_balance(build: Callable[..., Rig], friction: str, seed: int) -> None:
    """dH/dt = supplied - dissipated, to rounding: H differentiated by autograd along y'."""
    rig = build(contact__friction=friction)
    y = random_state(rig, seed, slip=0.05).requires_grad_(True)
    (slope,) = torch.autograd.grad(sum(stored(rig, rig.unpack(y)).values()), y)
    with torch.no_grad():
        H_dot = (slope * rig(0.0, y)).sum()
        state = rig.unpack(y)
        graph = rig.evaluate(0.0, state)
        supply, loss = supplied(graph), dissipated(rig, state, graph)
        powers = torch.stack([*supply.values(), *loss.values()])
        expected = sum(supply.values()) - sum(loss.values())
    assert abs(float(H_dot - expected)) < 1e-9 * float(powers.abs().sum())
    assert friction == "coulomb" or float(loss["slip"]) > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_no_resistor_supplies_power(build: Callable[..., Rig], friction: str, seed: int) -> None:
    rig = build(contact__friction=friction)
    state = rig.unpack(random_state(rig, seed, slip=0.1))
    with torch.no_grad():
        graph = rig.evaluate(0.0, state)
        loss = dissipated(rig, state, graph)
        scale = sum(x.abs() for x in loss.values())
        for name, power in loss.items():
            assert power > -1e-12 * scale, name
        for interface in graph.interfaces.values():
            assert bool((interface.out[..., 6] >= -1e-13).all())  # [W]; effort of a free Coulomb node is 0 to rounding


@pytest.mark.parametrize("seed", SEEDS)
def test_momentum_balance(build: Callable[..., Rig], seed: int) -> None:
    """Rate of total linear momentum = weights + control forces + ground reaction; internal forces cancel."""
    rig = build()
    y = random_state(rig, seed)
    with torch.no_grad():
        state, rate = rig.unpack(y), rig.unpack(rig(0.0, y))
        graph = rig.evaluate(0.0, state)
        ground = net_efforts(graph.ports, rig.junctions)["ground"][0]  # what the lower pad does to the ground
        momentum = sum(body.mass * rate.velocity[name][:2] for name, body in rig.bodies.items())
        for name, part in rate.rates.items():
            momentum = momentum + (rig.pads[name].masses()[:, None] * part).sum(-2)
        F_x, F_y = (graph.ports[f"control_{axis}"].effort[0, 0] for axis in "xy")
        weight = sum(body.mass * rig.gravity for body in rig.bodies.values() if body.weighted)
        external = torch.stack((F_x, F_y - weight)) - ground
        scale = 1.0 + graph.ports["contact_L"].effort.abs().sum()  # [N]
    assert float((momentum - external).abs().max()) < 1e-10 * float(scale)


def test_angular_momentum_balance_of_a_bracket_that_turns() -> None:
    """About the origin: spins and orbits of both bodies change by weights, actuators and the ground's forces alone."""
    rig = turning()
    y = random_state(rig, 1)
    with torch.no_grad():
        state, rate = rig.unpack(y), rig.unpack(rig(0.0, y))
        graph = rig.evaluate(0.0, state)
        moment = lambda r, F: r[..., 0] * F[..., 1] - r[..., 1] * F[..., 0]
        turn = weight = 0.0
        for name, body in rig.bodies.items():
            r, a = state.pose[name], rate.velocity[name]
            turn = turn + body.inertia * a[2] + body.mass * moment(r[:2], a[:2])
            weight = weight - body.mass * rig.gravity * r[0]
        pushed = torch.stack([graph.ports[f"control_{axis}"].effort[0, 0] for axis in "xy"])
        nodes = rig.pads["L"].positions + rig.displacement("L", state)
        ground = moment(
            nodes, -graph.ports["pad_L"].effort
        ).sum()  # the pad is massless: what holds it is what loads it
        external = weight + moment(state.pose["bracket"][:2], pushed) + ground
    assert float(turn - external) == pytest.approx(0.0, abs=1e-10 * float(ground.abs()))


def test_stored_energies_by_hand() -> None:
    """Springs, spin and translation of a state with one touching node and known velocities."""
    rig = coarse()
    state = rig.unpack(random_state(rig, 2))
    velocity = {"disc": f64(3e-2, 4e-2, 2.0), "bracket": f64(0.0, -0.1, 0.0)}
    with torch.no_grad():
        energy = {name: float(x) for name, x in stored(rig, state._replace(velocity=velocity)).items()}
        u = rig.displacement("U", state)
        force = torch.linalg.solve(rig.pads["U"].compliance(), u.flatten())
        depth = torch.cat([rig.penetration(k, state).clamp(min=0) for k in "LU"])
        weights, stretch = (
            torch.cat([part[k] for k in "LU"]) for part in ({k: rig.weight(k) for k in "LU"}, state.stretch)
        )
    assert energy["disc"] == pytest.approx(0.5 * 0.4065 * 0.05**2, rel=1e-14)
    assert energy["bracket"] == pytest.approx(0.5 * 0.4065 * 0.1**2, rel=1e-14)
    assert energy["spin"] == pytest.approx(0.5 * 0.5 * 0.4065 * 19.37e-3**2 * 4.0, rel=1e-13)
    assert energy["strain_U"] == pytest.approx(0.5 * float(force @ u.flatten()), rel=1e-11)
    assert energy["normal_springs"] == pytest.approx(float((0.5 * 1.2e5 * weights * depth**2).sum()), rel=1e-13)
    assert energy["tangential_springs"] == pytest.approx(float((0.5 * 1.2e5 * weights * stretch**2).sum()), rel=1e-13)


def test_a_run_balances_its_energies_better_with_smaller_steps() -> None:
    """To 1e-3 of the energy injected at 2 ms over grasp and first stroke, and better at 0.5 ms."""
    manipulation = grasp_and_roll(coarse(), grasp_force=75.0)
    t = torch.linspace(0, 0.6, 61, dtype=torch.float64)
    residual = [
        simulate(manipulation.model, t, y0=manipulation.y0, step=h).energy_residual_rel for h in (2e-3, 1e-3, 5e-4)
    ]
    assert residual[0] < 1e-3
    assert residual[2] < residual[1] < residual[0]
    assert residual[2] < 0.5 * residual[0]  # nodes touch and leave all along, so not second order


def test_the_energy_residual_of_a_fall_falls_with_the_tolerance() -> None:
    """An ellipse in free flight and on a pad, with long steps between outputs."""
    ready = RigFile.from_toml("rigs/drop.toml").override(outputs={"duration": 0.2, "snapshots": []}).build()
    runs = [simulate(ready.rig, ready.t, y0=ready.y0, rtol=rtol) for rtol in (1e-4, 1e-6)]
    assert runs[0].energy_residual_rel < 2e-4
    assert runs[1].energy_residual_rel < 0.2 * runs[0].energy_residual_rel
    flight = [float(run.energy_residual[run.t < 0.02].abs().max()) for run in runs]
    assert max(flight) < 1e-9 * float(runs[0].injected[-1])
