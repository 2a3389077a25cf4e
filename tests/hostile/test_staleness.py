"""Changes to a rig between its runs, and between a run and its gradient: nothing is of another rig
than the one that ran.

After every change the rig runs twice: as it is, with what is kept of earlier runs, and as a rig of
which nothing is known. Both have the same bits, gradients too, or are rejected with the same words.
What is asked for after changes, a gradient too, has the bits of what was asked for before them.
"""

import copy
import pickle
import warnings
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
    PD,
    Actuator,
    Circle,
    Coulomb,
    Ellipse,
    KelvinVoigt,
    Reference,
    Rig,
    SimulationFailed,
    SmoothSlip,
    Trajectory,
    hold,
    simulate,
    simulate_batch,
)
from torchsoft.physics.motion import Lines
from torchsoft.physics.parts import Guide
from torchsoft.solve import model as models
from torchsoft.solve.gradients import GradientFailed

MESH = {"pad.elements_x": 24, "pad.elements_y": 1, "contact.v_s": 0.05}
T = times(4e-3, 3)
REJECTIONS = ValueError, TypeError, NotImplementedError, SimulationFailed, GradientFailed
GAIN = 1.0
"""A number that a law below reads from its module."""


class Push(nn.Module):
    """A custom control law, which reads a global number and an attribute."""

    share = 0.5

    def forward(
        self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor
    ) -> Tensor:
        return GAIN * self.share * (w - q) - 3.0 * q_dot


class Twice(nn.Module):
    """A parametrization."""

    def forward(self, x: Tensor) -> Tensor:
        return 2.0 * x


def bits(*tensors: Tensor) -> list[bytes]:
    return [x.detach().numpy().tobytes() for x in tensors]


class Ran:
    """A run of a rig, and the tensors that its gradient is taken with respect to."""

    def __init__(self, rig: Rig, y0: Tensor) -> None:
        self.leaves = [y0.clone().requires_grad_(), *rig.parameters()]
        self.leaves = [leaf for leaf in self.leaves if leaf.requires_grad]
        how = {"rtol": 1e-3, "gradient": "discrete"}
        self.run: Trajectory = simulate(rig, T, y0=self.leaves[0], **how)

    def all(self) -> Any:
        """Numbers, their gradient, and the description of what ran."""
        run = self.run
        numbers = [run.y, run.recorded, *run.channels.values(), *run.energy.values()]
        ends = torch.stack([values[-1] for values in run.channels.values()])
        slopes = torch.autograd.grad(ends.sum(), self.leaves, materialize_grads=True)
        return bits(*numbers), bits(*slopes), [*run.channels], run.units, repr(run.made_by)


def outcome(rig: Rig, y0: Tensor) -> Any:
    """All numbers of a run with its gradient, or why there are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return Ran(rig, y0).all()
        except REJECTIONS as error:
            return str(error)


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

    def parameter(self) -> Tensor:
        return self.some(*self.rig.parameters()).detach()

    def in_place(self) -> None:
        value = self.parameter()
        value.copy_(self.near(value))

    def numpy(self) -> None:
        self.parameter().numpy()[...] *= self.rng.uniform(0.97, 1.03)

    def state_dict(self) -> None:
        table = {k: self.near(x) if x.ndim == 0 else x for k, x in self.rig.state_dict().items()}
        self.rig.load_state_dict(table, assign=self.some(True, False))

    def wrong_value(self) -> None:
        value = self.parameter()
        old = value.clone()
        value.fill_(self.some(float("nan"), -1.0, 1e300))
        self.compare()
        value.copy_(old)

    def buffer(self) -> None:
        pad = self.some(*self.rig.pads.values())
        pad.positions.numpy()[0, 0] += 1e-6
        pad.origin += f64(1e-6, 0.0) * self.rng.uniform(-1, 1)

    def friction(self) -> None:
        law = self.some(*self.rig.contacts.values()).law
        law.friction = self.some(SmoothSlip(0.5, 0.4, 0.08), Coulomb(0.4, 0.38))

    def shape(self) -> None:
        self.rig.bodies["disc"].shape = self.some(Circle(0.02), Ellipse(0.02, 0.0201))

    def material(self) -> None:
        pad = self.some(*self.rig.pads.values())
        pad.material = KelvinVoigt(7e5, self.some(0.4, 0.45), 1100.0, 0.01, 0.044)

    def tie(self) -> None:
        law = self.some(*self.rig.contacts.values()).law
        law.R_t = law.R_n

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

    def copied(self) -> None:
        self.rig = copy.deepcopy(self.rig)

    def pickled(self) -> None:
        with suppress(AttributeError, RuntimeError, TypeError, pickle.PicklingError):
            self.rig = pickle.loads(pickle.dumps(self.rig))

    def renamed(self) -> None:
        self.rig.symbols["disc"] = "other"
        self.rig.bodies["disc"].freedom["x"] = "fixed"

    def motion(self) -> None:
        place = {name: float(self.rig.reference[name].values[0]) for name in self.rig.signals}
        lines = Lines([0.0, 4e-3], [place["x_d"], place["x_d"] + 1e-5])
        self.rig.reference = self.some(hold(**place), Reference(**hold(**place).signals))
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
        found = outcome(self.rig, self.y0)
        models.forget()
        assert found == outcome(self.rig, self.y0)


HELPERS = "some", "near", "parameter", "compare"
OPERATIONS = [one for name, one in vars(Changes).items() if name[0] != "_" and name not in HELPERS]


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda one: one.__name__)
def test_nothing_is_stale_after_a_change(operation):
    changes = Changes(0)
    early, late = (Ran(changes.rig, changes.y0) for _ in "12")
    expected = early.all()
    operation(changes)
    changes.compare()
    operation(changes)
    changes.compare()
    if operation is not Changes.parametrised:  # which drops the gradient of what it replaces
        assert late.all() == expected


def changed_between_runs(changes: Changes) -> None:
    for _ in range(6):
        changes.some(*OPERATIONS)(changes)
        changes.compare()


def changed_after_a_run(changes: Changes) -> None:
    for _ in range(changes.rng.integers(4)):
        changes.some(*OPERATIONS)(changes)
    try:
        early, late = (Ran(changes.rig, changes.y0) for _ in "12")
        expected = early.all()
    except REJECTIONS:
        return
    later = [one for one in OPERATIONS if one is not Changes.parametrised]
    for _ in range(1 + changes.rng.integers(4)):
        changes.some(*later)(changes)
    assert late.all() == expected


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("sequence", [changed_between_runs, changed_after_a_run])
def test_nothing_is_stale_after_any_sequence(sequence, tally):
    for key in range(count(1000)):
        tally.call(f"sequence {key}", lambda key=key: sequence(Changes(key)), (), limit=100.0)
