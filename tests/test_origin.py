"""Time has an origin: a run that counts from a Unix clock is the run that counts from zero."""

from typing import Any, cast

import pytest
import torch
from torch import Tensor, nn

from torchsoft import (
    Body,
    Circle,
    Contact,
    KelvinVoigt,
    Pad,
    PadMesh,
    Profile,
    Reference,
    Rig,
    Sampled,
    SmoothSlip,
    SoftContact,
    simulate,
)

CLOCKS = [1.7e9, 2.0**30]
"""Times [s] at which runs begin: today's, and one whose last bits are zero."""


class Wiggle(nn.Module):
    """A signal that is a function of the user's own time, whole seconds of which are forgotten."""

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        w, part = 2 * torch.pi, t - t.floor()
        return 0.0298 - 1e-4 * (w * part).sin(), -1e-4 * w * (w * part).cos()


def rig(motion: nn.Module | None = None) -> Rig:
    """A disc over a pad, driven along y by `motion`, or free to fall."""
    y: Any = "free" if motion is None else "driven"
    pad = Pad(PadMesh(0.06, 0.02, 12, 3), KelvinVoigt(4e4, 0.4, 1e3, 0.01, 0.04), origin=(-0.03, 0))
    law = SoftContact(5e4, 20.0, 5e4, 20.0, friction=SmoothSlip(0.5, 0.4, 0.05))
    return Rig(
        bodies={"disc": Body(0.1, Circle(0.01), x=0.0, y=y, theta=0.0)},
        pads={"gel": pad}, contacts={"gel": Contact("gel", "disc", law)},
        reference=Reference() if motion is None else Reference(**{"disc.y": motion}),
    )  # fmt: skip


def times() -> Tensor:
    """Outputs every 1/128 s, which both clocks resolve."""
    return torch.arange(65, dtype=torch.float64) / 128


def begun(one: Rig) -> Tensor:
    """The start of the disc that falls 3.2 cm."""
    return one.state(disc={"y": 0.032, "v_y": -0.3}) if one.layout.rigid else one.state()


def moved(t0: float, kind: str) -> Rig:
    """The rig whose motion has its knots from t0 [s] on; every knot is resolved there."""
    at = t0 + torch.tensor([0.0, 0.125, 0.25, 0.5], dtype=torch.float64)
    values = torch.tensor([0.0305, 0.0298, 0.0302, 0.0295], dtype=torch.float64)
    motions: dict[str, Any] = {
        "free": lambda: None,
        "profile": lambda: Profile(at, values),
        "sampled": lambda: Sampled(at, values),
        "function": Wiggle,
    }
    return rig(motions[kind]())


@pytest.mark.parametrize("t0", CLOCKS)
@pytest.mark.parametrize("kind", ["free", "profile", "sampled", "function"])
@pytest.mark.parametrize("steps", [{"rtol": 1e-4}, {"step": 1e-4}])
def test_a_run_from_any_clock(t0: float, kind: str, steps: dict[str, Any]):
    """A drop, and motions by knots, by samples and by a function of time."""
    runs = []
    for begin in (0.0, t0):
        one = moved(begin, kind)
        runs.append(simulate(one, begin + times(), y0=begun(one), **steps))
    zero, late = runs
    assert torch.equal(late.t, t0 + times())
    assert float(late.knots[0]) == t0
    assert float(late.knots[-1]) == float(late.t[-1])
    assert float(zero["disc.load_y"].max()) > 0.1
    near = 2e-3 if kind == "function" else 1e-9  # the function is asked to 2e-7 s, steps differ
    for name in ("y_disc", "disc.load_y"):
        scale = float(zero[name].abs().max())
        assert float((late[name] - zero[name]).abs().max()) < near * scale
    assert abs(late.stats.steps - zero.stats.steps) <= (5 if kind == "function" else 0)


@pytest.mark.parametrize("t0", CLOCKS)
def test_gradients_from_any_clock(t0: float):
    """Adjoint and sensitivities, and runs along the steps of another."""
    found = []
    for begin in (0.0, t0):
        one, name = moved(begin, "profile"), "pads.gel.material.E"
        E, values = one.parameter(name), cast(Profile, one.reference["disc.y"]).values
        E.requires_grad_(True)
        values.requires_grad_(True)
        options: dict[str, Any] = {"y0": one.state().detach(), "rtol": 1e-4}
        run = simulate(one, begin + times(), gradient="discrete", **options)
        adjoint = torch.autograd.grad(run["disc.load_y"].sum(), [E, values])
        along = simulate(
            one, begin + times(), gradient="forward", wrt=[name], touch=["disc.load_y"], **options
        )
        slope = along.touch_sensitivities["disc.load_y"].sum()
        assert float(slope) == pytest.approx(float(adjoint[0]), rel=1e-6)
        again = simulate(one, begin + times(), y0=options["y0"], knots=run.knots)
        assert torch.allclose(again["disc.load_y"], run["disc.load_y"], atol=1e-4)
        found.append(torch.cat((adjoint[0][None], adjoint[1])))
    assert torch.allclose(*found, rtol=1e-6)


def test_the_time_of_a_failure_is_the_user_s_own():
    """So is that of a signal that is not finite; times that are not resolved are refused."""

    class Lost(nn.Module):
        def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
            return 0.03 + 0.0 / (t < 1.7e9 + 0.25).double(), torch.zeros_like(t)

    one = rig(Lost())
    with pytest.raises(ValueError, match=r"not finite at t = 17000000"):
        simulate(one, 1.7e9 + times(), y0=one.state())
    falling = rig()
    with pytest.raises(ValueError, match="count them from the beginning of the run"):
        simulate(falling, 1.7e9 + times() / 1e4, y0=begun(falling))
