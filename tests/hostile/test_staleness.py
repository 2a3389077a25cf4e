"""Changes to a rig between its runs, and between a run and its gradient: what is kept of a rig is
never what it was before.

After every change the rig runs twice: as it is, with what is kept of earlier runs, and as a rig of
which nothing is known. Both have the same bits, or are rejected with the same words. A gradient
that is asked for after changes equals central differences of a copy that was made when it ran;
where two sizes of differences disagree, a run straddles a touch-down, which only few may.
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

from hostile.trial import SEED, count, sentence
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
from torchsoft.solve.gradients import GradientFailed

MESH = {"pad.elements_x": 24, "pad.elements_y": 1, "contact.v_s": 0.05}
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

    def numpy(self) -> None:
        owner, name = self.place()
        owner.get_parameter(name).detach().numpy()[...] *= self.rng.uniform(0.97, 1.03)

    def state_dict(self) -> None:
        table = {k: self.near(x) if x.ndim == 0 else x for k, x in self.rig.state_dict().items()}
        self.rig.load_state_dict(table, assign=self.some(True, False))

    def wrong_value(self) -> None:
        owner, name = self.place()
        value = owner.get_parameter(name).detach()
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


HELPERS = "some", "near", "place", "compare"
OPERATIONS: list[Callable[[Changes], None]] = [
    one for name, one in vars(Changes).items() if name[0] != "_" and name not in HELPERS
]


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda one: one.__name__)
def test_nothing_is_stale_after_a_change(operation):
    changes = Changes(0)
    for _ in range(2):
        outcome(changes.rig, changes.y0)
        operation(changes)
        changes.compare()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_is_stale_after_any_sequence(tally):
    line = tally("sequences of changes between runs, bits")

    def sequence(key: int) -> None:
        changes = Changes(key)
        for _ in range(6):
            changes.some(*OPERATIONS)(changes)
            changes.compare()

    for key in range(count(1000)):
        line.call(f"sequence {key}", lambda key=key: sequence(key), (), limit=100.0)


# gradients
# ----------------------------------------------------------------------

WEIGHTS = {"theta": 1.0, "x_C": 1e2, "y_Br": 1e2, "v_x": 1.0, "omega": 0.1, "F_x": 1e-2}
REFUSALS = ValueError, TypeError, SimulationFailed, GradientFailed
STEPS = 1e-4, 3e-5, 1e-5, 1e-6
"""Of the differences, relative to the values; taken until two that follow each other agree."""
ALIKE, CLEAR, SMALL, PART = 1e-5, 1e-4, 1e-4, 0.3
"""Relative difference that a gradient may have, beside what the differences have among themselves,
which is at most `CLEAR`; of derivatives below `SMALL` that size is taken. The most that each value
adds to the derivative."""


class Ran:
    """One run: its loss, and a copy of the rig with the places of the tensors in it."""

    def __init__(self, rig: Rig, y0: Tensor) -> None:
        self.globals, self.copy, y0 = (GAIN, Push.share), copy.deepcopy(rig), y0.requires_grad_()
        twins = zip(rig.parameters(), self.copy.parameters())
        twins = [(p, q) for p, q in twins if p.requires_grad]
        self.places = [(y0, y0.detach().clone()), *twins]
        self.value = self.loss(rig, y0, "discrete")

    def loss(self, rig: Rig, y0: Tensor, gradient: str) -> Tensor:
        run = simulate(rig, T, y0=y0, gradient=gradient, step=1e-3, tolerance=1e-10)
        lost = np.nan if run.stats.failed_steps else 0.0  # halved: it may jump there
        return lost + sum((w * (run[name] - run[name][0])).sum() for name, w in WEIGHTS.items())

    def shifted(self, h: float, directions: dict[int, Tensor]) -> float:
        """The loss of the copy with tensors moved by `h` along directions, by the tensor's id."""
        global GAIN
        now, (GAIN, Push.share) = (GAIN, Push.share), self.globals
        with torch.no_grad():
            old = [place.detach().clone() for _, place in self.places]
            for leaf, place in self.places:
                place.add_(h * directions.get(id(leaf), torch.zeros(())))
            ended = float(self.loss(self.copy, self.places[0][1], "none"))
            for (_, place), value in zip(self.places, old):
                place.copy_(value)
        GAIN, Push.share = now
        return ended


def compared(key: int) -> bool | None:
    """Whether differences along a random direction are clear, None where there was no run; raises
    `AssertionError` where they are and the gradient is another."""
    changes = Changes(key)
    after = [one for one in OPERATIONS if one is not Changes.parametrised]  # drops gradients
    for _ in range(changes.rng.integers(4)):
        changes.some(*OPERATIONS)(changes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            ran = Ran(changes.rig, changes.y0.clone())
            for _ in range(1 + changes.rng.integers(4)):
                changes.some(*after)(changes)
            leaves = [leaf for leaf, _ in ran.places]
            bars = torch.autograd.grad(ran.value, leaves, allow_unused=True, materialize_grads=True)
        except REFUSALS as refusal:
            if sentence(str(refusal)):
                return None
            raise
        directions, expected = dict[int, Tensor](), 0.0
        for i in changes.rng.permutation(len(leaves))[: changes.some(1, len(leaves))]:
            leaf, bar = leaves[i], bars[i]
            noise = torch.from_numpy(changes.rng.standard_normal(tuple(leaf.shape)))
            d = ran.places[i][1].detach().abs().clamp(min=1e-12) * noise
            d = d * 1e-3 if leaf.ndim else d
            d = d * min(1.0, PART / max(abs(float((bar * d).sum())), 1e-300))
            directions[id(leaf)], expected = d, expected + float((bar * d).sum())
        found: list[float] = []
        for h in STEPS:
            found.append((ran.shifted(h, directions) - ran.shifted(-h, directions)) / (2 * h))
            size = max(abs(found[-1]), SMALL)
            spread = abs(found[-1] - found[-2]) if found[1:] else np.inf
            if spread <= CLEAR * size:  # never where one is not a number
                assert abs(expected - found[-1]) <= ALIKE * size + 2 * spread, (expected, found)
                return True
    return False


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_gradients_after_any_sequence_are_those_of_what_ran(tally):
    line, results = tally("sequences of changes before a gradient"), list[bool | None]()
    for key in range(count(1000)):
        results.append(line.call(f"sequence {key}", lambda key=key: compared(key), (), limit=100.0))
    clear, unclear = results.count(True), results.count(False)
    enough = clear >= 0.5 * len(results) and unclear <= 0.1 * len(results) + 3
    line.held(enough, f"{clear} of {len(results)} compared, {unclear} with nothing to compare with")
