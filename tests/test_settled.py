"""Pads that have settled around given bodies: at rest by the graph, with exact derivatives, and the
same bits every time."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from conftest import RUBBER, coarse, dry, f64, press, turning
from torch import Tensor

from torchsoft import Body, Circle, Contact, NoEquilibrium, Pad, PadMesh, Rig
from torchsoft.physics.material import StandardLinearSolid
from torchsoft.physics.state import State
from torchsoft.physics.statics import settled


def shaken(model: Rig, seed: int = 0, stretch: float = 5e-5) -> State:
    """The grasp with bodies displaced by tenths of a millimetre and stretched points, sticking and
    slipping; nothing moves."""
    generator, state = (
        torch.Generator().manual_seed(seed),
        model.unpack(press(model).detach()),
    )

    def noise(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    pose = {name: x + noise(x) * f64(1e-4, 2e-4, 0.02) for name, x in state.pose.items()}
    pose["bracket"][2] = 0.0
    return state._replace(
        pose=pose, stretch={name: stretch * noise(s) for name, s in state.stretch.items()}
    )


def around(rig: Rig, state: State) -> Tensor:
    return settled(rig, state.pose, state.velocity, state.stretch)


def rates(rig: Rig, y: Tensor) -> float:
    """Largest rate [m/s] of a pad's node, by the multibond graph."""
    state = rig.unpack(y.detach())
    graph = rig.evaluate(0.0, state)
    return max(
        float(graph.ports[f"pad_{name}"].transformer.flow(graph.flows).detach().abs().max())
        for name in rig.pads
    )


@pytest.mark.parametrize("points", [0, 2])
def test_pads_settled_around_the_grasp_are_those_of_statics(points):
    model = coarse(contact__points=points)
    y = press(model).detach()
    assert float((around(model, model.unpack(y)) - y).detach().abs().max()) < 1e-10  # [N]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("build", [coarse, turning])
def test_no_node_moves(build, seed):
    rig = build()
    y = around(rig, shaken(coarse(), seed))
    assert float(y[rig.layout.slices["pads", "U"]].detach().abs().max()) > 1.0  # [N]
    assert rates(rig, y) < 1e-9


def test_derivatives_are_those_of_differences():
    """Along one direction of poses, stretches and every kind of parameter each."""
    model = coarse()
    state = shaken(model)
    weights = torch.randn(
        model.layout.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    weights[model.layout.rigid] = 0.0  # what stands in the state as it was given
    steps = {"x": 1e-8, "y": 1e-8, "theta": 1e-6, "stretch": 1e-8}
    steps |= dict.fromkeys(("pad.E", "pad.nu", "contact.K_t", "contact.mu_s", "disc.radius"), 1e-6)

    class Settled(torch.nn.Module):
        """Weighted state with the disc moved and the points stretched further."""

        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, by: dict[str, Tensor]) -> Tensor:
            disc = state.pose["disc"] + torch.stack([by[axis] for axis in ("x", "y", "theta")])
            stretch = {
                k: s + by["stretch"] * torch.linspace(-1, 1, len(s))
                for k, s in state.stretch.items()
            }
            return weights @ settled(model, state.pose | {"disc": disc}, state.velocity, stretch)

    def value(by: dict[str, Tensor]) -> Tensor:
        scaled = {
            f"model.{model.names.get(model.full(n), model.full(n))}": model.parameter(n).detach()
            * (1 + h)
            for n, h in by.items()
            if "." in n
        }
        return torch.func.functional_call(Settled(), scaled, (by,))

    zeros = {name: f64(0.0)[0].requires_grad_() for name in steps}
    exact = torch.autograd.grad(value(zeros), list(zeros.values()))
    with torch.no_grad():
        for (name, h), slope in zip(steps.items(), exact):
            up, down = (float(value(zeros | {name: f64(by)[0]})) for by in (h, -h))
            assert float(slope) == pytest.approx(
                (up - down) / (2 * h), rel=1e-3 if "." in name else 1e-4, abs=1e-4
            ), name


def test_the_same_bits_come_again_from_other_threads_too():
    model = coarse()
    state = shaken(model)
    first = around(model, state)
    with ThreadPoolExecutor(2, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for again in pool.map(lambda _: around(model, state), range(3)):
            assert torch.equal(first, again)


def test_two_bodies_on_one_pad_and_a_chain_of_branches():
    """Every branch carries the contacts' forces, and a body feels the dent of its neighbour."""
    rubber, law = StandardLinearSolid(**RUBBER, E_instant=1.5e6, tau=0.01), dry(node_spacing=2e-3)
    rig = Rig(
        bodies={name: Body(0.4, Circle(0.01)) for name in "ab"},
        pads={"P": Pad(PadMesh(0.12, 4.59e-3, 60, 2), rubber)},
        contacts={name: Contact("P", name, law) for name in "ab"},
    )  # fmt: skip
    still = {name: torch.zeros(3, dtype=torch.float64) for name in "ab"}
    stretch = {name: torch.zeros(61, dtype=torch.float64) for name in "ab"}
    pressed = f64(0.05, 4.59e-3 + 0.01 - 3e-4, 0.0)

    def pad(x: float) -> Tensor:
        return rig.unpack(
            settled(rig, {"a": pressed, "b": f64(x, float(pressed[1]), 0.0)}, still, stretch)
        ).pads["P"]

    near, far = pad(0.056).detach(), pad(0.1).detach()
    assert near.shape == (2, 61, 2)
    assert torch.equal(near[0], near[1])
    total = [float(z[0, :, 1].sum()) for z in (near, far)]
    assert abs(total[0] / total[1] - 1) > 1e-3  # the dents meet


def test_refusals():
    model = coarse()
    state = shaken(model)
    unknown = state.stretch | {"L": torch.full((61,), torch.nan).double()}
    far = {name: torch.full_like(s, 1e-3) for name, s in state.stretch.items()}
    away = state.pose | {"disc": f64(0.06, 0.01, 0.0)}
    for changed, kind, message in (
        (
            {"pose": {"disc": state.pose["disc"]}},
            ValueError,
            r"`pose` must be given by the names \['disc', 'bracket'\]",
        ),
        ({"stretch": unknown}, ValueError, "61 finite numbers"),
        ({"pose": state.pose | {"disc": f64(0.0, 0.0)}}, ValueError, "3 finite numbers"),
        ({"pose": away, "stretch": far}, NoEquilibrium, "`L` does not settle"),
    ):
        with pytest.raises(kind, match=message):
            around(model, state._replace(**changed))
    with torch.inference_mode(), pytest.raises(ValueError, match="inference_mode"):
        around(model, state)
