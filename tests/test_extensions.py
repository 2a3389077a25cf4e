"""What an extension costs: shapes, laws, materials, pads and rigs that the paper does not have, each a few lines of a
user's."""

from functools import cache

import pytest
import torch
from torch import Tensor, nn

from torchsoft import (
    Body,
    Circle,
    Contact,
    Coulomb,
    Ellipse,
    KelvinVoigt,
    Pad,
    PadMesh,
    Parameters,
    Profile,
    Reference,
    Rig,
    SmoothSlip,
    SoftContact,
    SoftGrasp,
    StandardLinearSolid,
    Trajectory,
    press,
    rest,
    simulate,
)  # fmt: skip
from torchsoft.physics.energy import dissipated, stored, supplied
from torchsoft.physics.multibond import net_efforts

COARSE = Parameters().override({"pad.elements_x": 60, "pad.elements_y": 3})


def times(end: float, count: int) -> Tensor:
    return torch.linspace(0.0, end, count, dtype=torch.float64)


def grasp(model: SoftGrasp, y0: Tensor, travel: float = 2e-3) -> Reference:
    """A grasp by 1 mm in 50 ms, then a stroke of the disc in 100 ms."""
    top = float(model.unpack(y0).pose["bracket"][1])
    x = float(model.unpack(y0).pose["disc"][0])
    return Reference(
        x_d=Profile([0.06, 0.16], [x, x + travel]),
        y_d=Profile([0.0, 0.05], [top, top - 1e-3]),
        F_ff=Profile([0.0], [0.0]),
    )


def check_gradient(build, names: list[str], value, bound: float, step: float = 1e-5) -> None:
    """dvalue/dname of a run from `build() -> (model, run)` against central differences in each parameter's logarithm."""
    model, run = build({}, "discrete")
    value(run).backward()
    for name in names:
        here = model.parameter(name).detach()
        up, down = (float(value(build({name: float(here) * (1 + s * step)}, "none")[1]).detach()) for s in (1, -1))
        slope = (up - down) / (2 * step)
        grad = model.parameter(name).grad
        assert grad is not None
        assert float(grad * here) == pytest.approx(slope, rel=bound, abs=1e-3 * bound), name


def set_values(model: Rig, values: dict[str, float]) -> None:
    with torch.no_grad():
        for name, value in values.items():
            model.parameter(name).fill_(value)


# --- an ellipse ---------------------------------------------------------------------------------------------------------


def test_an_ellipse_of_equal_axes_is_the_circle() -> None:
    round_, oval = SoftGrasp(COARSE), SoftGrasp(COARSE, shape=Ellipse(19.37e-3, 19.37e-3))
    y0 = rest(round_).detach()
    assert torch.allclose(rest(oval).detach(), y0, rtol=0, atol=1e-9)
    runs = [simulate(m, times(0.2, 21), y0=y0, reference=grasp(m, y0), step=1e-3) for m in (round_, oval)]
    for key in ("x_C", "y_C", "theta", "x_Br", "y_Br"):
        scale = float(runs[0][key].max() - runs[0][key].min())
        assert float((runs[0][key] - runs[1][key]).abs().max()) <= 1e-9 * max(scale, 1e-3), key


def test_an_ellipse_measures_distance_along_its_normal() -> None:
    shape, rng = Ellipse(20e-3, 12e-3), torch.Generator().manual_seed(0)
    angle = 2 * torch.pi * torch.rand(200, generator=rng, dtype=torch.float64)
    depth = 1e-3 * (2 * torch.rand(200, generator=rng, dtype=torch.float64) - 1)
    foot = torch.stack((20e-3 * angle.cos(), 12e-3 * angle.sin()), -1)
    normal = nn.functional.normalize(torch.stack((12e-3 * angle.cos(), 20e-3 * angle.sin()), -1), dim=-1)
    phi, n = shape(foot + depth[:, None] * normal)
    assert torch.allclose(phi, depth, rtol=0, atol=1e-12)
    assert torch.allclose(n, normal, rtol=0, atol=1e-9)


def test_an_ellipse_has_exact_gradients() -> None:
    def build(values: dict[str, float], gradient: str) -> tuple[SoftGrasp, Trajectory]:
        model = SoftGrasp(COARSE, shape=Ellipse(19.37e-3, 18.5e-3))
        y0 = rest(model).detach()
        reference = grasp(model, y0)
        set_values(model, values)
        return model, simulate(
            model, times(0.12, 7), y0=y0, reference=reference, step=1e-3, tolerance=1e-10, gradient=gradient
        )

    check_gradient(build, ["disc.shape.a", "disc.shape.b", "pad.E"], lambda run: 1e3 * run["y_C"][-1], 2e-5, step=1e-7)


# --- a friction law of the user's ------------------------------------------------------------------------------------------


class NetworkFriction(nn.Module):
    """A user's law: a coefficient of friction that a small network makes of the normal force."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.net = nn.Sequential(nn.Linear(1, 4), nn.Tanh(), nn.Linear(4, 1)).double()
        for p in self.net.parameters():
            p.data = 0.3 * torch.randn(p.shape, generator=generator, dtype=torch.float64)
        self.level = nn.Parameter(torch.tensor(0.3, dtype=torch.float64))

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        mu = self.level * (1 + 0.2 * torch.tanh(self.net(0.1 * F_N[..., None])[..., 0]))
        return (E - mu * F_N).clamp(min=0.0) / (R + 10.0)


def test_a_network_inside_a_friction_law_runs_compiled_with_exact_gradients() -> None:
    def build(values: dict[str, float], gradient: str) -> tuple[SoftGrasp, Trajectory]:
        model = SoftGrasp(COARSE.override({"control.senses": "bracket"}), friction=NetworkFriction())
        y0 = rest(model).detach()
        reference = grasp(model, y0, travel=15e-3)
        set_values(model, values)
        return model, simulate(
            model, times(0.16, 9), y0=y0, reference=reference, step=1e-3, tolerance=1e-10, gradient=gradient
        )

    check_gradient(build, ["contact.friction.level", "contact.K_t"], lambda run: 1e3 * run["x_C"][-1], 1e-4, step=1e-6)
    model, run = build({}, "discrete")
    assert float(run.dissipated["slip"][-1]) > 1e-4  # it slips
    (1e3 * run["x_C"][-1]).backward()
    weight = model.parameter("contact.friction.net.0.weight")
    assert weight.grad is not None
    direction = torch.tensor([[1.0], [-0.5], [0.3], [0.8]], dtype=torch.float64)

    def moved(by: float) -> float:
        other = SoftGrasp(COARSE.override({"control.senses": "bracket"}), friction=NetworkFriction())
        y0 = rest(other).detach()
        with torch.no_grad():
            other.parameter("contact.friction.net.0.weight").add_(by * direction)
        reference = grasp(other, y0, travel=15e-3)
        run = simulate(other, times(0.16, 9), y0=y0, reference=reference, step=1e-3, tolerance=1e-10)
        return 1e3 * float(run["x_C"][-1])

    slope = (moved(1e-5) - moved(-1e-5)) / 2e-5
    assert float((weight.grad * direction).sum()) == pytest.approx(slope, rel=1e-3, abs=1e-7)


def test_a_law_that_is_a_function_runs_in_one_line() -> None:
    model = SoftGrasp(COARSE, friction=lambda E, F_N, R: (E - 0.5 * F_N).clamp(min=0.0) / (R + 10.0))
    like = SoftGrasp(COARSE.override({"contact.mu_s": 0.5, "contact.mu_k": 0.5}))
    y0 = rest(like).detach()
    runs = [simulate(m, times(0.16, 9), y0=y0, reference=grasp(m, y0), step=1e-3) for m in (model, like)]
    assert torch.allclose(runs[0].y, runs[1].y, rtol=1e-9, atol=1e-12)


# --- materials ------------------------------------------------------------------------------------------------------------


def test_a_standard_linear_solid_creeps_between_its_two_moduli() -> None:
    """Under a held force a pad's displacement goes from E_instant's to E's, as its creep function says."""
    solid = StandardLinearSolid(
        E=0.75e6, E_instant=1.5e6, nu=0.45, rho=1100.0, tau=20e-3, depth=44e-3, tau_instant=1e-3
    )
    model = SoftGrasp(COARSE, material=solid)
    z = torch.zeros(2, model.pads["L"].nodes, 2, dtype=torch.float64)
    force, t = torch.zeros_like(z[0]), torch.tensor(0.03, dtype=torch.float64)
    force[30, 1] = -1.0
    fractions, taus = solid.chain()
    z_t = (1 - torch.exp(-t / taus))[:, None, None] * force
    state = model.unpack(torch.zeros(model.layout.size, dtype=torch.float64))
    u = model.displacement("L", state._replace(pads=state.pads | {"L": z_t}))
    static = SoftGrasp(COARSE).pads["L"].compliance().detach() @ force.flatten()
    creep = float((fractions * (1 - torch.exp(-t / taus))).sum().detach())
    assert torch.allclose(u.detach().flatten(), creep * static, rtol=1e-12, atol=1e-18)


def test_a_standard_linear_solid_keeps_its_energy_and_its_gradients() -> None:
    def build(values: dict[str, float], gradient: str) -> tuple[SoftGrasp, Trajectory]:
        solid = StandardLinearSolid(0.75e6, 1.5e6, 0.45, 1100.0, 20e-3, 44e-3)
        model = SoftGrasp(COARSE.override({"control.senses": "bracket"}), material=solid)
        y0 = rest(model).detach()
        reference = grasp(model, y0)
        set_values(model, values)
        return model, simulate(
            model, times(0.16, 9), y0=y0, reference=reference, step=5e-4, tolerance=1e-10, gradient=gradient
        )

    _, run = build({}, "none")
    assert run.energy_residual_rel < 1e-3
    names = ["pad.E", "pad.E_instant", "pad.tau", "pad.tau_instant", "pad.nu"]
    check_gradient(build, names, lambda run: 1e3 * run["y_C"][-1] + run["theta"][-1], 2e-5, step=1e-6)
    model, by_adjoint = build({}, "discrete")
    by_adjoint["y_C"][-1].backward()
    y0 = by_adjoint.y[0].detach()
    forward = simulate(
        model, by_adjoint.t, y0=y0, reference=grasp(model, y0), step=5e-4, tolerance=1e-10, gradient="forward", wrt=names,
        rigid=True,
    )  # fmt: skip
    assert forward.sensitivities is not None
    for k, name in enumerate(names):
        assert float(forward.sensitivities[-1, 1, k]) == pytest.approx(float(model.parameter(name).grad), rel=1e-8), (
            name
        )


# --- other rigs -------------------------------------------------------------------------------------------------------------

MESH = PadMesh(60e-3, 4.59e-3, 60, 3)
RADIUS = 19.37e-3
GRASPED = 2 * (MESH.height + RADIUS) - 1e-3


def law() -> SoftContact:
    return SoftContact(1.2e5, 441.7, 1.2e5, 441.7, friction=SmoothSlip(0.8, 0.7, 5e-2, 10.0))


def rubber() -> KelvinVoigt:
    return KelvinVoigt(0.75e6, 0.45, 1100.0, 10e-3, 44e-3)


def hand(**motions: Profile) -> Rig:
    """A disc between two driven pads, each with x, y and theta, pressed together by 1 mm unless a motion says otherwise."""
    still = {"lower.x": 0.0, "lower.y": 0.0, "lower.theta": 0.0, "upper.x": 0.0, "upper.y": GRASPED, "upper.theta": 0.0}
    signals = {name: Profile([0.0], [value]) for name, value in still.items()} | motions
    soft, contact = rubber(), law()
    driven = {"x": "driven", "y": "driven", "theta": "driven", "weighted": False}
    return Rig(
        bodies={"disc": Body(0.4065, Circle(RADIUS)), "lower": Body(**driven), "upper": Body(**driven)},
        pads={
            "lower": Pad(MESH, soft, base="lower", origin=(-30e-3, 0.0)),
            "upper": Pad(MESH, soft, base="upper", origin=(-30e-3, 0.0), mirrored=True),
        },
        contacts={name: Contact(name, "disc", contact) for name in ("lower", "upper")},
        reference=Reference(**signals),
        groups={"rubber": soft, "contact": contact},
    )


def at_rest(rig: Rig, **disc: float) -> Tensor:
    """The state with the disc at some pose, nothing touched yet."""
    state = rig.unpack(torch.zeros(rig.layout.size, dtype=torch.float64))
    pose = torch.tensor([disc.get("x", 0.0), disc.get("y", 0.0), disc.get("theta", 0.0)], dtype=torch.float64)
    return rig.pack(state._replace(pose=state.pose | {"disc": pose}))


@cache
def grasped() -> Tensor:
    """The disc settled between the pressed pads, off the nodes."""
    rig = hand(**{"upper.y": Profile([0.0, 0.06], [GRASPED + 1e-3, GRASPED])})
    y0 = at_rest(rig, x=3e-4, y=MESH.height + RADIUS - 2e-5)
    return simulate(rig, times(0.3, 2), y0=y0, step=1e-3).y[-1]


def turning_hand(**parameters: float) -> tuple[Rig, Tensor]:
    """The grasped disc rolled by pads that glide apart and turn by different angles."""
    rig = hand(
        **{
            "upper.x": Profile([0.0, 0.2], [0.0, 8e-3]),
            "lower.x": Profile([0.0, 0.2], [0.0, -6e-3]),
            "upper.theta": Profile([0.0, 0.2], [0.0, 0.05]),
            "lower.theta": Profile([0.0, 0.2], [0.0, 0.08]),
        }
    )
    set_values(rig, parameters)
    return rig, grasped()


@torch.no_grad()
def test_two_driven_turning_pads_balance_energy_and_momentum() -> None:
    rig, y0 = turning_hand()
    run = simulate(rig, times(0.2, 41), y0=y0, step=5e-4)
    assert run.energy_residual_rel < 1e-3
    assert abs(float(run["theta_disc"][-1] - run["theta_disc"][0])) > 0.2  # it rolls
    for i in (15, 25, 40):
        state = rig.unpack(run.y[i].detach(), t=run.t[i])
        graph = rig.evaluate(run.t[i], state)
        contacts = {name: port for name, port in graph.ports.items() if name.startswith(("contact", "pad"))}
        left = net_efforts(contacts, rig.junctions)
        force = sum(left[name][0] for name in rig.bodies)
        assert isinstance(force, Tensor)
        assert float(force.abs().max()) < 1e-9 * float(left["lower"].abs().max())
        moment = sum(
            left[f"{name}_spin"][0, 0] + state.pose[name][0] * left[name][0, 1] - state.pose[name][1] * left[name][0, 0]
            for name in rig.bodies
        )
        assert abs(float(moment)) < 1e-11 + 1e-9 * abs(float(left["lower_spin"]))
        where = rig.layout.slices["velocity", "disc"]
        disc = rig.bodies["disc"]
        gained = rig(run.t[i], run.y[i].detach())[where] * torch.stack(disc.masses) + torch.tensor(
            [0.0, 0.4065 * 9.81, 0.0], dtype=torch.float64
        )
        assert torch.allclose(
            gained.detach(), run.load["disc"][i], rtol=1e-7, atol=1e-6
        )  # what runs is what torch says


@torch.no_grad()
def test_power_is_balanced_where_the_bases_turn() -> None:
    """dH/dt = supplied - dissipated - what the drives take out, at states of the run, from the torch module alone."""
    rig, y0 = turning_hand()
    run = simulate(rig, times(0.2, 11), y0=y0, step=1e-3)
    for i in (3, 5, 8):
        y, t, h = run.y[i].detach(), run.t[i], 1e-7
        rate = rig(t, y)
        state = rig.unpack(y, t=t)
        graph = rig.evaluate(t, state)
        change = [sum(stored(rig, rig.unpack(y + s * h * rate, t=t + s * h)).values()) for s in (1.0, -1.0)]
        stored_rate = (change[0] - change[1]) / (2 * h)
        contacts = {name: port for name, port in graph.ports.items() if not port.source}
        left = net_efforts(contacts, rig.junctions)
        drive = -sum(
            (left[b][0] @ state.velocity[b][:2]) + left[f"{b}_spin"][0, 0] * state.velocity[b][2]
            for b in ("lower", "upper")
        )
        balance = sum(supplied(graph).values()) + drive - sum(dissipated(rig, state, graph).values())
        assert float(stored_rate) == pytest.approx(float(balance), rel=1e-5, abs=1e-8)


@pytest.mark.parametrize(
    "name", ["rubber.E", "rubber.tau", "rubber.nu", "contact.K_n", "contact.K_t", "contact.friction.mu_s"]
)
def test_gradients_of_a_final_pose_between_turning_pads(name: str) -> None:
    def pose(rig: Rig, y0: Tensor, gradient: str) -> Tensor:
        run = simulate(rig, times(0.2, 3), y0=y0, step=1e-3, tolerance=1e-10, gradient=gradient)
        return 1e2 * run["x_disc"][-1] + 1e2 * run["y_disc"][-1] + run["theta_disc"][-1]

    rig, y0 = turning_hand()
    here = rig.parameter(name)
    pose(rig, y0, "discrete").backward()
    assert here.grad is not None
    h, value = 1e-5, float(here.detach())
    ends = [float(pose(*turning_hand(**{name: value * (1 + k * h)}), "none").detach()) for k in (-2, -1, 1, 2)]
    slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
    assert float(here.grad * value) == pytest.approx(slope, rel=1e-6, abs=1e-9)


def test_gradients_reach_the_motion_of_driven_pads() -> None:
    def end(turn: float, travel: float) -> tuple[list[Tensor], Tensor]:
        knots = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (turn, travel)]
        rig = hand(
            **{"lower.theta": Profile([0.0, 0.1], [0.0, knots[0]]), "upper.x": Profile([0.0, 0.1], [0.0, knots[1]])}
        )
        run = simulate(rig, times(0.1, 3), y0=grasped(), step=1e-3, tolerance=1e-10, gradient="discrete")
        return knots, run["theta_disc"][-1] + 1e2 * run["y_disc"][-1]

    at = (0.05, 4e-3)
    knots, value = end(*at)
    value.backward()
    h = 1e-7  # differences converge with h^2: a larger h straddles points that touch
    for k in range(2):
        up, down = (float(end(*(a + s * h * (i == k) for i, a in enumerate(at)))[1].detach()) for s in (1, -1))
        assert float(knots[k].grad) == pytest.approx((up - down) / (2 * h), rel=1e-6)


def test_a_third_pad_is_one_more_entry_of_the_lists() -> None:
    """Two pads at the sides as jaws, one below: the disc is held on three sides, and energy is balanced."""
    soft, contact, height = rubber(), law(), MESH.height
    jaw = {"y": RADIUS + height, "theta": 0.0, "weighted": False}
    rig = Rig(
        bodies={
            "disc": Body(0.4065, Circle(RADIUS)),
            "left": Body(x="driven", **jaw),
            "right": Body(x="driven", **jaw),
        },
        pads={
            "floor": Pad(MESH, soft, origin=(-30e-3, 0.0)),
            "left": Pad(MESH, soft, base="left", origin=(0.0, 30e-3), angle=-torch.pi / 2),
            "right": Pad(MESH, soft, base="right", origin=(0.0, -30e-3), angle=torch.pi / 2),
        },
        contacts={name: Contact(name, "disc", contact) for name in ("floor", "left", "right")},
        reference=Reference(
            **{
                "left.x": Profile([0.0, 0.1], [-RADIUS - height, -RADIUS - height + 6e-4]),
                "right.x": Profile([0.0, 0.1], [RADIUS + height, RADIUS + height - 4e-4]),
            }
        ),
    )
    run = simulate(rig, times(0.3, 31), y0=at_rest(rig, y=RADIUS + height - 1e-5), step=5e-4)
    assert run.energy_residual_rel < 1e-3
    assert all(float(run.force[name][-1, :, 0].sum()) > 1.0 for name in ("left", "right"))
    assert float(run["x_disc"][-1]) == pytest.approx(1e-4, abs=3e-5)  # midway between the jaws
    assert float(run.load["disc"][-1, 1]) == pytest.approx(0.4065 * 9.81, rel=0.02)


def test_a_turned_rig_moves_like_the_paper_s() -> None:
    """The whole hand turned by 30 degrees about the origin, without gravity, moves as before, turned."""
    runs = []
    for angle in (0.0, torch.pi / 6):
        c, s = float(torch.cos(torch.tensor(angle).double())), float(torch.sin(torch.tensor(angle).double()))
        knots, x, y = [0.0, 0.06, 0.16], [0.0, 0.0, 5e-3], [GRASPED + 1e-3, GRASPED, GRASPED]
        rig = hand(
            **{
                "upper.x": Profile(knots, [c * a - s * b for a, b in zip(x, y)]),
                "upper.y": Profile(knots, [s * a + c * b for a, b in zip(x, y)]),
                "upper.theta": Profile([0.0], [angle]),
                "lower.theta": Profile([0.0], [angle]),
            }
        )
        set_values(rig, {"gravity": 0.0})
        arm, off = MESH.height + RADIUS - 2e-5, 3e-4
        y0 = at_rest(rig, x=c * off - s * arm, y=s * off + c * arm, theta=angle)
        run = simulate(rig, times(0.16, 9), y0=y0, step=1e-3, tolerance=1e-10)
        px, py = run["x_disc"], run["y_disc"]
        runs.append((c * px + s * py, c * py - s * px, run["theta_disc"] - angle))
    for a, b in zip(*runs):
        assert float((a - b).abs().max()) < 1e-9


def test_contact_points_between_nodes_have_exact_gradients_and_less_ripple() -> None:
    def build(values: dict[str, float], gradient: str) -> tuple[SoftGrasp, Trajectory]:
        model = SoftGrasp(COARSE.override({"contact.points": 2}))
        y0 = rest(model).detach()
        reference = grasp(model, y0)
        set_values(model, values)
        return model, simulate(
            model, times(0.14, 8), y0=y0, reference=reference, step=1e-3, tolerance=1e-10, gradient=gradient
        )

    check_gradient(
        build, ["contact.K_n", "contact.K_t", "pad.E", "pad.tau"], lambda run: 1e2 * run["y_C"][-1] + run["theta"][-1], 2e-5,
        step=1e-6,
    )  # fmt: skip

    def sideways(points: int) -> float:
        """Largest horizontal static force of a grasped disc as it stands between the nodes [N]."""
        out = []
        for x in (60.0, 60.5, 61.0, 61.5):
            model = SoftGrasp(COARSE.override({"contact.points": points, "scenario.x_C0": 1e-3 * x}))
            state = model.unpack(press(model, 48.6e-3))
            out.append(float(state.pads["L"][0, :, 0].sum().detach()))
        return max(out) - min(out)

    assert sideways(2) < 0.6 * sideways(0)


def test_an_inertial_pad_on_a_turning_base_is_refused() -> None:
    soft = rubber()
    with pytest.raises(NotImplementedError, match="its base `finger` may turn"):
        Rig(
            bodies={"disc": Body(0.4, Circle(RADIUS)), "finger": Body(x="driven", y="driven", theta="driven")},
            pads={"finger": Pad(MESH, soft, base="finger", inertial=True)},
            contacts={"finger": Contact("finger", "disc", law())},
        )


def test_literal_coulomb_is_a_law_like_any_other() -> None:
    model = SoftGrasp(COARSE, friction=Coulomb(0.8, 0.7))
    listed = SoftGrasp(COARSE.override({"contact.friction": "coulomb"}))
    y0 = rest(model).detach()
    a, b = (simulate(m, times(0.1, 6), y0=y0, reference=grasp(m, y0), step=1e-3) for m in (model, listed))
    assert torch.equal(a.y, b.y)
