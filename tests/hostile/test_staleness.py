"""Random sequences of changes between runs of one rig: what is kept of a rig from run to run is
never what it was before.

After every change the rig runs twice: as it is, with what is kept of earlier runs, and as a rig of
which nothing is known. Both have the same bits, or are refused with the same words.
"""

import copy
import pickle
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
from conftest import f64, grasp, still, times
from torch import Tensor, nn
from torch.nn.utils import parametrize

from hostile.trial import SEED, count
from torchsoft import (
    Actuator,
    Circle,
    Coulomb,
    Ellipse,
    KelvinVoigt,
    Reference,
    Rig,
    SimulationFailed,
    SmoothSlip,
    hold,
    simulate,
    simulate_batch,
)
from torchsoft.physics.motion import Lines
from torchsoft.physics.parts import PD, Guide
from torchsoft.solve import model as models

MESH = {"pad.elements_x": 30, "pad.elements_y": 2, "contact.v_s": 0.05}
T = times(4e-3, 3)
GAIN = 1.0
"""A number that a law below reads from its module."""


class Push(nn.Module):
    """A control law of one's own, which reads a global number and an attribute."""

    share = 0.5

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        return GAIN * self.share * (w - q) - 3.0 * q_dot


class Twice(nn.Module):
    """A parametrization."""

    def forward(self, x: Tensor) -> Tensor:
        return 2.0 * x


def outcome(rig: Rig, y0: Tensor, **how: Any) -> Any:
    """All numbers of a run, or why there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            run = simulate(rig, T, y0=y0, rtol=1e-3, **how)
        except (ValueError, TypeError, SimulationFailed, NotImplementedError) as refusal:
            return str(refusal)
    parts = run.y, run.recorded, *run.channels.values(), *run.energy.values()
    return [*(x.detach().numpy().tobytes() for x in parts), repr(run.made_by["parameters"])]


class Changes:
    """A rig, and what may be done to it."""

    def __init__(self, key: int) -> None:
        self.rng = np.random.default_rng([SEED, key])
        self.rig = still(MESH)
        self.y0, self.rig.reference = grasp(self.rig)

    def some(self, *choices: Any) -> Any:
        return choices[self.rng.integers(len(choices))]

    def near(self, value: Tensor) -> Tensor:
        return value.detach() * self.rng.uniform(0.97, 1.03)

    def place(self) -> tuple[nn.Module, str]:
        names = [name for name, _ in self.rig.named_parameters()]
        owner, _, last = self.some(*names).rpartition(".")
        return self.rig.get_submodule(owner), last

    @torch.no_grad()
    def in_place(self) -> None:
        owner, name = self.place()
        owner.get_parameter(name).copy_(self.near(owner.get_parameter(name)))

    def data(self) -> None:
        owner, name = self.place()
        owner.get_parameter(name).data = self.near(owner.get_parameter(name))

    def numpy(self) -> None:
        owner, name = self.place()
        owner.get_parameter(name).detach().numpy()[...] *= self.rng.uniform(0.97, 1.03)

    def parameter(self) -> None:
        owner, name = self.place()
        setattr(owner, name, nn.Parameter(self.near(owner.get_parameter(name))))

    def state_dict(self) -> None:
        table = {k: self.near(x) if x.ndim == 0 else x for k, x in self.rig.state_dict().items()}
        self.rig.load_state_dict(table, assign=self.some(True, False))

    def wrong_value(self) -> None:
        owner, name = self.place()
        value = owner.get_parameter(name).detach()
        wrong = torch.full_like(value, self.some(float("nan"), -1.0, 1e300))
        old = value.clone()
        value.copy_(wrong)
        self.compare()
        value.copy_(old)

    def wrong_dtype(self) -> None:
        owner, name = self.place()
        old = owner._parameters[name]
        owner._parameters[name] = nn.Parameter(old.detach().float())
        self.compare()
        owner._parameters[name] = old

    def buffer(self) -> None:
        pad = self.some(*self.rig.pads.values())
        pad.positions.numpy()[0, 0] += 1e-6
        pad.origin += f64(1e-6, 0.0) * self.rng.uniform(-1, 1)

    def shares(self) -> None:
        self.some(*self.rig.pads.values()).point_lengths[3] *= 1.01

    def spacing(self) -> None:
        self.some(*self.rig.contacts.values()).law.node_spacing *= self.rng.uniform(0.97, 1.03)

    def friction(self) -> None:
        law = self.some(*self.rig.contacts.values()).law
        law.friction = self.some(SmoothSlip(0.5, 0.4, 0.08), Coulomb(0.4, 0.38))

    def power(self) -> None:
        law = self.some(*self.rig.contacts.values()).law
        law.power = self.some(None, nn.Parameter(f64(1.2)[0]))

    def shape(self) -> None:
        self.rig.bodies["disc"].shape = self.some(Circle(0.02), Ellipse(0.02, 0.0201))

    def material(self) -> None:
        pad = self.some(*self.rig.pads.values())
        pad.material = KelvinVoigt(7e5, self.some(0.4, 0.45), 1100.0, 0.01, 0.044)

    def stiffer(self) -> None:
        pad = self.some(*self.rig.pads.values())
        pad.E_ratio = self.some(None, nn.Parameter(f64(1.1)[0]))

    def tie(self) -> None:
        law = self.some(*self.rig.contacts.values()).law
        law.R_t = law.R_n

    def weight(self) -> None:
        self.rig.bodies["disc"].weighted = self.some(True, False)

    def may_leave(self) -> None:
        self.some(*self.rig.contacts.values()).may_leave = self.some(True, False)

    def guide(self) -> None:
        guide = Actuator("disc.x", "disc.x", Guide(0.1, 1.0), setpoint=())
        self.rig.actuators["guide"] = guide  # pyright: ignore[reportIndexIssue]

    def control(self) -> None:
        name = self.some(*self.rig.actuators)
        if self.rig.actuators[name].is_loop:
            self.rig.actuators[name].law = self.some(PD(2e3, 50.0), Push())

    def change_a_global(self) -> None:
        global GAIN
        GAIN, Push.share = (float(x) for x in self.rng.uniform(0.5, 2.0, 2))

    def parametrised(self) -> None:
        law = self.some(*self.rig.contacts.values()).law
        if not parametrize.is_parametrized(law):
            parametrize.register_parametrization(law, "K_n", Twice())

    def hook(self) -> None:
        law = self.some(*self.rig.actuators.values())
        law.register_forward_hook(lambda *given: 1.01 * given[-1])

    def training(self) -> None:
        self.rig.train(self.some(True, False))

    def copied(self) -> None:
        self.rig = copy.deepcopy(self.rig)

    def pickled(self) -> None:
        with suppress(AttributeError, RuntimeError, TypeError, pickle.PicklingError):
            self.rig = pickle.loads(pickle.dumps(self.rig))

    def motion(self) -> None:
        now = {name: float(self.rig.reference[name].values[0]) for name in self.rig.signals}
        lines = Lines([0.0, 4e-3], [now["x_d"], now["x_d"] + 1e-5])
        self.rig.reference = self.some(hold(**now), Reference(**hold(**now).signals, **{}))
        if self.some(True, False):
            self.rig.reference.signals["x_d"] = lines

    @torch.no_grad()
    def knots(self) -> None:
        signal = self.rig.reference["x_d"]
        signal.values.numpy()[...] += 1e-6
        if len(signal.times) > 1:
            signal.times[1:] += 1e-4

    def batch(self) -> None:
        """Values in the place of parameters are forgotten with the batch."""
        E = self.rig.parameter("pads.L.material.E").detach() * f64(0.9, 1.1)
        own = {"pads.L.material.E": E}
        with warnings.catch_warnings(), suppress(ValueError, TypeError):
            warnings.simplefilter("ignore")
            simulate_batch(self.rig, T, y0=self.y0, parameters=own, rtol=1e-3)

    def compare(self) -> None:
        """The run with what is kept, and that of a rig of which nothing is."""
        how = {"gradient": self.some("none", "none", "discrete")}
        found = outcome(self.rig, self.y0, **how)
        models.forget()
        assert found == outcome(self.rig, self.y0, **how)


OPERATIONS: list[Callable[[Changes], None]] = [
    one for name, one in vars(Changes).items()
    if not name.startswith("_") and name not in ("some", "near", "place", "compare")
]  # fmt: skip


def sequence(key: int, length: int = 6) -> None:
    changes = Changes(key)
    outcome(changes.rig, changes.y0)
    for _ in range(length):
        operation = OPERATIONS[changes.rng.integers(len(OPERATIONS))]
        operation(changes)
        changes.compare()


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda one: one.__name__)
def test_nothing_is_stale_after_a_change(operation):
    changes = Changes(0)
    for _ in range(3):
        outcome(changes.rig, changes.y0)
        operation(changes)
        changes.compare()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_is_stale_after_any_sequence(tally):
    line = tally("sequences of changes between runs, bits")
    for key in range(count(1000)):
        line.call(f"sequence {key}", lambda key=key: sequence(key), (), limit=100.0)
        line.held(True)
