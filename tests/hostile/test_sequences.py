"""Random sequences of what people do to models: every gradient equals differences of what ran, or
is refused with a sentence.

A sequence runs its model once or twice, changes it before `backward`, and compares the gradient
along two directions with central differences of a copy that was made when it ran. Differences at
several steps, of which two that follow each other must agree, tell the points where one of the runs
straddles a touch-down, and a run that halves a step jumps where another would not: there is no
derivative to compare with, and such sequences may only be few.
"""

import copy
import pickle
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from conftest import PAPER, Exp, coarse, f64, grasp, times, towards
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from torch import Tensor, nn
from torch.nn.utils import parametrize

from hostile.trial import SEED, count, sentence
from torchsoft import Coulomb, Profile, Rig, SimulationFailed, SmoothSlip, hold, simulate
from torchsoft.solve.gradients import GradientFailed

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.filterwarnings("ignore:the energies of the run", "ignore:the slip law of"),
]

T = times(6e-3, 4)
RIG = PAPER.assemble()
REFUSALS = ValueError, TypeError, SimulationFailed, GradientFailed
SETTINGS = {"pad__elements_x": 48, "contact__mu_s": 0.4, "contact__mu_k": 0.3}
WEIGHTS = {
    "theta": 1.0, "x_C": 1e2, "y_Br": 1e2, "v_x": 1.0, "omega": 0.1, "F_x": 1e-2, "F_y": 1e-2,
    "angular_momentum": 1e3,
}  # fmt: skip
LAW = "contacts.L.law"
NAMES = sorted(
    RIG.aliases.get(name, name) for name in {"gravity", *RIG.short.values()}
    if name in {"gravity", *RIG.aliases} or name.startswith("bodies.")
)  # fmt: skip
"""Parameters of the rig by their places among its parts."""
CHANGED = sorted(set(NAMES) - {f"{LAW}.friction.v_s"})
"""Those that operations change."""
STEPS = 1e-4, 3e-5, 1e-5, 1e-6
"""Of the differences, relative to the values; taken until two that follow each other agree."""
ALIKE, CLEAR, SMALL = 1e-5, 1e-4, 1e-4
"""Relative difference that a gradient may have, beside what the differences have among themselves,
which is at most `CLEAR`; of derivatives of the loss by relative changes below `SMALL` that size is
taken."""
PART = 0.3
"""What each of the values may add to the derivative: those that matter more are changed less."""

SHARE = 0.7
"""A number that a law below reads from its module."""


class Own(nn.Module):
    """A friction law of one's own, which reads a global number, has a dropout, and learns its
    coefficient."""

    def __init__(self, mu: float) -> None:
        super().__init__()
        self.mu_s, self.dropout = nn.Parameter(f64(mu)[0]), nn.Dropout(0.5)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.dropout(SHARE * (E - self.mu_s * F_N).clamp(min=0.0) / (R + 10.0))


def run(model: Rig, y0: Tensor, gradient: Any = "discrete") -> Any:
    return simulate(model, T, y0=y0, gradient=gradient, step=1e-3, tolerance=1e-10)


def loss(ended: Any) -> Any:
    return sum((w * (ended[name] - ended[name][0])).sum() for name, w in WEIGHTS.items())


class Simulated(nn.Module):
    """A run as a module, for functional_call."""

    def __init__(self, model: Rig) -> None:
        super().__init__()
        self.model = model

    def forward(self, y0: Tensor) -> Tensor:
        return loss(run(self.model, y0))


def attribute(model: nn.Module, name: str) -> tuple[nn.Module, str]:
    """The part that has a parameter, and its name there."""
    owner, _, last = name.rpartition(".")
    return model.get_submodule(owner), last


class Ran:
    """One run: its loss, and a copy of the model for differences, with the tensors whose gradients
    are wanted beside their places in it."""

    def __init__(self, model: Rig, y0: Tensor, put: dict[str, Tensor]) -> None:
        self.share, self.copy, y0 = SHARE, copy.deepcopy(model), y0.clone().requires_grad_()
        twins = zip(model.parameters(), self.copy.parameters())
        self.places = [(y0, y0.detach()), *((p, q) for p, q in twins if p.requires_grad)]
        for name, value in put.items():  # replaces one name, not what is tied to it
            self.places.append((value, nn.Parameter(value.detach().clone())))
            setattr(*attribute(self.copy, name), self.places[-1][1])
        values = {f"model.{name}": x for name, x in put.items()}
        self.value = torch.func.functional_call(Simulated(model), values, (y0,), tie_weights=False)

    def shifted(self, h: float, directions: dict[int, Tensor]) -> float:
        """The loss of the copy with tensors moved by `h` along directions, by the tensor's id; NaN
        where a step was halved."""
        global SHARE
        now, SHARE, old = SHARE, self.share, [place.detach().clone() for _, place in self.places]
        with torch.no_grad():
            for leaf, place in self.places:
                place.add_(h * directions.get(id(leaf), torch.zeros(())))
            ended = run(self.copy, self.places[0][1], "none")
            for (_, place), value in zip(self.places, old):
                place.copy_(value)
        SHARE = now
        return float(loss(ended)) if ended.stats.failed_steps == 0 else np.nan


@contextmanager
def told() -> Iterator[None]:
    """Whatever is refused in the body is refused with a sentence."""
    try:
        yield
    except REFUSALS as refusal:
        if not sentence(str(refusal)):
            raise AssertionError(f"not one sentence: {refusal!r}") from refusal


def step_by_step(operation: Callable[["ModelInUse"], object]) -> Any:
    """A rule that does an operation, or is refused with a sentence."""

    @wraps(operation)
    def tried(self: "ModelInUse") -> None:
        with told():
            operation(self)

    return rule()(tried)


@seed(SEED)
class ModelInUse(RuleBasedStateMachine):
    """A model in use, and the runs whose gradients are asked for."""

    tally: ClassVar = Counter[str]()

    @initialize(key=st.integers(0, 2**32 - 1), before=st.integers(0, 5))
    def begin(self, key: int, before: int) -> None:
        self.rng, self.before = np.random.default_rng([SEED, key]), before
        self.model, self.rans = coarse(**SETTINGS), list[Ran]()
        velocity = 0.05 * self.rng.uniform(-1, 1), 0.01 * self.rng.uniform(-1, 1)
        self.y0, self.model.reference = grasp(self.model, velocity)
        self.nominal = {name: self.model.get_parameter(name).item() for name in NAMES}

    def some(self, *choices: Any) -> Any:
        return choices[self.rng.integers(len(choices))]

    def names(self, number: int) -> list[str]:
        """Of parameters that are neither parametrised nor gone with a law."""
        known = dict(self.model.named_parameters(remove_duplicate=False))
        return self.rng.permutation([name for name in CHANGED if name in known])[:number].tolist()

    def near(self, name: str) -> Tensor:
        low, high = (0.95, 1.04) if name.endswith(("nu", "radius")) else (0.7, 1.4)
        return f64(self.nominal[name] * self.rng.uniform(low, high))[0]

    # operations
    # ------------------------------------------------------------

    @step_by_step
    def set_in_place(self) -> None:
        for name in self.names(1):
            with torch.no_grad():
                self.model.get_parameter(name).copy_(self.near(name))

    @step_by_step
    def set_data(self) -> None:
        for name in self.names(1):
            self.model.get_parameter(name).data = self.near(name)

    @step_by_step
    def set_parameter(self) -> None:
        for name in self.names(1):
            setattr(*attribute(self.model, name), nn.Parameter(self.near(name)))

    @step_by_step
    def load(self) -> None:
        table = {name: x.clone() for name, x in self.model.state_dict().items()}
        table |= {name: self.near(name) for name in self.names(4)}
        self.model.load_state_dict(table, assign=self.some(True, False))

    @step_by_step
    def tie(self) -> None:
        law = self.model.contacts["L"].law
        if {f"{LAW}.R_t", f"{LAW}.R_n"} <= set(self.names(99)):
            law.R_t = law.R_n

    @precondition(lambda self: not self.rans)  # torch drops the gradient of what ran before
    @step_by_step
    def parametrise(self) -> None:
        for name in self.names(1):
            parametrize.register_parametrization(*attribute(self.model, name), Exp())

    @step_by_step
    def copy_deep(self) -> None:
        self.model = copy.deepcopy(self.model)

    @step_by_step
    def pickled(self) -> None:
        if not any(map(parametrize.is_parametrized, self.model.modules())):
            with suppress(AttributeError, pickle.PicklingError):  # a law that is a lambda
                self.model = pickle.loads(pickle.dumps(self.model))

    @step_by_step
    def toggle(self) -> None:
        for name in self.names(3):
            self.model.get_parameter(name).requires_grad_(self.some(True, False))

    @step_by_step
    def change_dtype(self) -> None:
        kinds = torch.float16, torch.bfloat16, torch.float32, torch.float64
        torch.set_default_dtype(self.some(*kinds))

    @step_by_step
    def run_without_grad(self) -> None:
        with self.some(torch.no_grad, torch.inference_mode)():
            ended = run(self.model, self.y0)
        assert not ended.y.requires_grad
        assert not ended["F_x"].requires_grad

    @step_by_step
    def replace_law(self) -> None:
        frozen = SmoothSlip(0.5, 0.4, 0.05).requires_grad_(False)
        law = self.model.contacts["L"].law
        del law.friction
        law.friction = self.some(
            SmoothSlip(0.5, 0.4, 0.08),
            Coulomb(0.4, 0.38),
            Own(self.rng.uniform(0.2, 0.5)).eval(),
            lambda E, F_N, R: frozen(E, F_N, R),
        )

    @step_by_step
    def change_a_global(self) -> None:
        global SHARE
        SHARE = float(self.rng.uniform(0.3, 0.9))

    @step_by_step
    def train(self) -> None:
        self.model.train(self.some(True, False))

    @step_by_step
    def optimise(self) -> None:
        if leaves := [p for p in self.model.parameters() if p.requires_grad]:
            rate = lambda p: 1e-2 * abs(float(p.detach().flatten()[0]))
            optimiser = torch.optim.Adam([{"params": [p], "lr": rate(p)} for p in leaves])
            loss(run(self.model, self.y0)).backward()
            optimiser.step()
            optimiser.zero_grad()

    @step_by_step
    def change_reference(self) -> None:
        x = Profile([0.0, 4e-3], [0.06, 0.06 + 1e-4 * self.rng.standard_normal()])
        x.values.requires_grad_(self.some(True, False))
        self.model.reference = towards(self.model, x)

    @step_by_step
    def move_knots(self) -> None:
        with torch.no_grad():
            self.model.reference["x_d"].values.add_(1e-5 * self.rng.standard_normal())

    @precondition(lambda self: self.rans)
    @step_by_step
    def lose_reference(self) -> None:
        self.model.reference = hold(x_d=0.03, y_d=0.07, F_ff=9.0)

    @precondition(lambda self: self.rans)
    @step_by_step
    def lose_model(self) -> None:
        self.model = coarse(**SETTINGS)

    # runs
    # ------------------------------------------------------------

    @invariant()
    def run_after_some_operations(self) -> None:
        self.before -= 1
        if self.before == 0:
            self.some(self.run, self.run_functional)()

    @precondition(lambda self: len(self.rans) < 2)
    @step_by_step
    def run(self) -> None:
        self.rans.append(Ran(self.model, self.y0, {}))

    @precondition(lambda self: len(self.rans) < 2)
    @step_by_step
    def run_functional(self) -> None:
        put = {name: self.near(name).requires_grad_() for name in self.names(3)}
        self.rans.append(Ran(self.model, self.y0, put))

    def teardown(self) -> None:
        """The gradient of the sum of the runs, beside differences."""
        global SHARE
        try:
            if not self.rans:
                self.run()
            if self.rans:
                self.differentiate()
        finally:
            SHARE = 0.7
            torch.set_default_dtype(torch.float32)

    def differentiate(self) -> None:
        found = {id(leaf): leaf for ran in self.rans for leaf, _ in ran.places}
        leaves = [leaf for leaf in found.values() if leaf.requires_grad]
        with told():
            total = torch.stack([ran.value for ran in self.rans]).sum()
            bars = torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
            self.tally["compared"] += 1
            self.tally["unclear"] += not self.compare(leaves, bars)

    def compare(self, leaves: list[Tensor], bars: tuple[Tensor, ...]) -> bool:
        """Whether differences along a random direction, of one tensor or of all, are clear; raises
        `AssertionError` where they are and the gradient is another."""
        directions, expected = dict[int, Tensor](), 0.0
        some = self.rng.permutation(len(leaves))[: self.some(1, len(leaves))]
        for leaf, bar in ((leaves[i], bars[i]) for i in some):
            noise = torch.from_numpy(self.rng.standard_normal(tuple(leaf.shape)))
            d = leaf.detach().abs().clamp(min=1e-12) * noise * (1e-3 if leaf.ndim else 1.0)
            directions[id(leaf)] = d * min(1.0, PART / max(abs(float((bar * d).sum())), 1e-300))
            expected += float((bar * directions[id(leaf)]).sum())
        total = lambda h: sum(ran.shifted(h, directions) for ran in self.rans)
        found = [total(0.0)]  # not a number where a step was halved
        for h in STEPS if np.isfinite(found[0]) else ():
            found.append((total(h) - total(-h)) / (2 * h))
            size = max(abs(found[-1]), SMALL)
            spread = abs(found[-1] - found[-2]) if found[2:] else np.inf
            if spread <= CLEAR * size:  # never where one is not a number
                right = abs(expected - found[-1]) <= ALIKE * size + 2 * spread
                assert right, f"gradient {expected!r}, loss and differences {found} along {some}"
                return True
        return False


def test_gradients_after_any_sequence_are_those_of_what_ran(tally):
    line, sequences = tally("sequences of model operations, gradients"), count(1000)
    how = settings(
        max_examples=sequences, stateful_step_count=10, database=None, deadline=None,
        phases=[Phase.generate, Phase.shrink], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    ModelInUse.tally.clear()
    line.call(
        "sequence", lambda: run_state_machine_as_test(ModelInUse, settings=how), (), limit=1e5
    )
    line.tried, unclear = ModelInUse.tally["compared"], ModelInUse.tally["unclear"]
    enough = line.tried >= 0.3 * sequences and unclear <= 0.05 * line.tried + 3
    line.held(enough, f"of {line.tried} sequences {unclear} had nothing to compare with")
