"""Random sequences of what people do to models: every gradient equals differences of what ran, or
is refused with a sentence.

A sequence does some operations to a model, runs it once or twice, does some more to it before
`backward`, and compares the gradient along two directions with central differences of a copy that
was made when it ran. Differences at several steps, of which two that follow each other must agree,
tell the points where one of the runs straddles a touch-down, and a run that halves a step jumps
where another would not: there is no derivative to compare with, and such sequences may only be few.
"""

import copy
import gc
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import coarse, f64, grasp, times
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchsoft import (
    Coulomb,
    Profile,
    Reference,
    SimulationFailed,
    SmoothSlip,
    SoftGrasp,
    hold,
    simulate,
)
from torchsoft.solve.adjoint import GradientFailed

pytestmark = pytest.mark.slow

T = times(6e-3, 4)
REFUSALS = (ValueError, TypeError, SimulationFailed, GradientFailed)
SETTINGS = {"pad__elements_x": 48, "contact__mu_s": 0.4, "contact__mu_k": 0.3}
NAMES = (
    "pad.E", "pad.nu", "pad.tau", "pad.depth", "contact.K_n", "contact.R_n", "contact.K_t",
    "contact.R_t", "contact.friction.mu_s",
    "contact.friction.mu_k", "contact.friction.eta", "disc.mass", "bracket.mass",
    "disc.shape.radius", "control.x.Kp", "control.x.Kd",
    "control.y.Kp", "control.y.Kd", "gravity",
)  # fmt: skip
WEIGHTS = {
    "theta": 1.0,
    "x_C": 1e2,
    "y_Br": 1e2,
    "v_x": 1.0,
    "omega": 0.1,
    "F_x": 1e-2,
    "F_y": 1e-2,
    "angular_momentum": 1e3,
}
STEPS = (1e-4, 3e-5, 1e-5, 1e-6)
"""Of the differences, relative to the values; taken until two that follow each other agree."""
ALIKE, CLEAR, SMALL = 1e-5, 1e-4, 1e-4
"""Relative difference that a gradient may have, beside what the differences have among themselves,
which is at most `CLEAR`; of derivatives of the loss by relative changes below `SMALL` that size is
taken."""
PART = 0.3
"""What each of the values may add to the derivative: those that matter more are changed less."""

SHARE = 0.7
"""A number that a law below reads from its module."""


class Exp(nn.Module):
    """A positive parameter by its logarithm."""

    def forward(self, x: Tensor) -> Tensor:
        return x.exp()

    def right_inverse(self, x: Tensor) -> Tensor:
        return x.log()


class Own(nn.Module):
    """A friction law of one's own, which reads a global number, has a dropout, and learns its
    coefficient."""

    def __init__(self, mu: float) -> None:
        super().__init__()
        self.mu_s, self.dropout = nn.Parameter(f64(mu)[0]), nn.Dropout(0.5)

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return self.dropout(SHARE * (E - self.mu_s * F_N).clamp(min=0.0) / (R + 10.0))


class Bench:
    """A model in use, and what its gradient is asked for."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.model = coarse(**SETTINGS)
        self.y0, self.model.reference = grasp(
            self.model, (0.05 * rng.uniform(-1, 1), 0.01 * rng.uniform(-1, 1))
        )
        self.nominal = {name: self.model.get_parameter(name).item() for name in NAMES}

    def some(self, *choices: Any) -> Any:
        return choices[self.rng.integers(len(choices))]

    def plain(self) -> list[str]:
        """Names that are parameters still: neither parametrised nor gone with a law."""
        return [
            name
            for name in NAMES
            if name in dict(self.model.named_parameters(remove_duplicate=False))
        ]

    def near(self, name: str) -> Tensor:
        low, high = (0.95, 1.04) if name.endswith(("nu", "radius")) else (0.7, 1.4)
        return f64(self.nominal[name] * self.rng.uniform(low, high))[0]

    # operations
    # ------------------------------------------------------------

    def set_in_place(self) -> None:
        name = self.some(*self.plain())
        with torch.no_grad():
            self.model.get_parameter(name).copy_(self.near(name))

    def set_data(self) -> None:
        name = self.some(*self.plain())
        parameter = self.model.get_parameter(name)
        if self.some(True, False):
            parameter.data = self.near(name)
        else:
            parameter.data.copy_(self.near(name))

    def set_parameter(self) -> None:
        """A new parameter in the place of the old."""
        name = self.some(*[name for name in self.plain() if "." in name])
        owner, _, last = name.rpartition(".")
        setattr(self.model.get_submodule(owner), last, nn.Parameter(self.near(name)))

    def load(self) -> None:
        table = {name: x.clone() for name, x in self.model.state_dict().items()}
        for name in self.rng.permutation(self.plain())[:4]:
            table[name] = self.near(name)
        self.model.load_state_dict(table, assign=bool(self.some(True, False)))
        for name in self.plain():  # `assign` puts in what is loaded as it is
            if not self.model.get_parameter(name).requires_grad and self.some(True, False):
                self.model.get_parameter(name).requires_grad_()

    def tie(self) -> None:
        a, b = self.some(
            ("contact.R_t", "contact.R_n"),
            ("contact.K_t", "contact.K_n"),
            ("control.y.Kp", "control.x.Kp"),
        )
        if {a, b} <= set(self.plain()):
            owner, _, last = a.rpartition(".")
            setattr(self.model.get_submodule(owner), last, self.model.get_parameter(b))

    def parametrise(self) -> None:
        name = self.some(*[name for name in self.plain() if "." in name])
        owner, _, last = name.rpartition(".")
        parametrize.register_parametrization(self.model.get_submodule(owner), last, Exp())

    def copy_deep(self) -> None:
        self.model = copy.deepcopy(self.model)

    def pickled(self) -> None:
        if not any(parametrize.is_parametrized(module) for module in self.model.modules()):
            self.model = pickle.loads(pickle.dumps(self.model))

    def toggle(self) -> None:
        for name in self.rng.permutation(self.plain())[:3]:
            self.model.get_parameter(name).requires_grad_(bool(self.some(True, False)))

    def change_dtype(self) -> None:
        torch.set_default_dtype(
            self.some(torch.float16, torch.bfloat16, torch.float32, torch.float64)
        )

    def run_without_grad(self) -> None:
        with self.some(torch.no_grad, torch.inference_mode)():
            run = simulate(self.model, T, y0=self.y0, gradient="discrete")
        assert not any(x.requires_grad for x in (run.y, run["F_x"])), (
            "torch.no_grad() is not honoured"
        )

    def replace_law(self) -> None:
        own = Own(self.rng.uniform(0.2, 0.5)).eval()
        frozen = SmoothSlip(0.5, 0.4, 0.05, 20.0).requires_grad_(False)
        law = self.some(
            SmoothSlip(0.5, 0.4, 0.08, 20.0),
            Coulomb(0.4, 0.38),
            own,
            lambda E, F_N, R: frozen(E, F_N, R),
        )
        self.model.contact.friction = law

    def change_a_global(self) -> None:
        globals()["SHARE"] = float(self.rng.uniform(0.3, 0.9))

    def train(self) -> None:
        self.model.train(bool(self.some(True, False)))

    def optimise(self) -> None:
        leaves = [p for p in self.model.parameters() if p.requires_grad]
        if leaves:
            groups = [
                {"params": [p], "lr": 1e-2 * abs(float(p.detach().flatten()[0]))} for p in leaves
            ]
            optimiser = torch.optim.Adam(groups)
            loss(run(self.model, self.y0)).backward()
            optimiser.step()
            optimiser.zero_grad()

    def change_reference(self) -> None:
        old = self.model.reference
        knots = [0.0, 4e-3]
        x = Profile(knots, [0.06, 0.06 + 1e-4 * self.rng.standard_normal()])
        new = Reference(x_d=x, y_d=old["y_d"], F_ff=old["F_ff"])
        if self.some(True, False):
            x.values.requires_grad_()
        self.model.reference = new

    def move_knots(self) -> None:
        with torch.no_grad():
            self.model.reference["x_d"].values.add_(1e-5 * self.rng.standard_normal())

    def lose_reference(self) -> None:
        self.model.reference = hold(x_d=0.03, y_d=0.07, F_ff=9.0)

    def lose_model(self) -> None:
        self.model = coarse(**SETTINGS)
        gc.collect()


BEFORE = (
    Bench.set_in_place, Bench.set_data, Bench.set_parameter, Bench.load, Bench.tie,
    Bench.parametrise, Bench.copy_deep, Bench.pickled,
    Bench.toggle, Bench.change_dtype, Bench.run_without_grad, Bench.replace_law,
    Bench.change_a_global, Bench.train, Bench.optimise,
    Bench.change_reference, Bench.move_knots,
)  # fmt: skip
BETWEEN = (
    Bench.set_in_place, Bench.set_data, Bench.load, Bench.replace_law, Bench.change_a_global,
    Bench.change_dtype, Bench.toggle,
    Bench.change_reference, Bench.move_knots, Bench.lose_reference, Bench.lose_model,
    Bench.set_parameter,
)  # fmt: skip


class Simulated(nn.Module):
    """A run as a module, for functional_call."""

    def __init__(self, model: SoftGrasp) -> None:
        super().__init__()
        self.model = model

    def forward(self, y0: Tensor) -> Tensor:
        return loss(run(self.model, y0))


def run(model: SoftGrasp, y0: Tensor, gradient: str = "discrete") -> Any:
    return simulate(model, T, y0=y0, gradient=gradient, step=1e-3, tolerance=1e-10)  # pyright: ignore


def loss(trajectory: Any) -> Tensor:
    return sum((w * (trajectory[name] - trajectory[name][0])).sum() for name, w in WEIGHTS.items())  # pyright: ignore


class Ran:
    """What ran: a copy of the model for differences, the tensors whose gradients are wanted and
    where they are in the copy."""

    def __init__(self, bench: Bench) -> None:
        self.y0, self.shared = bench.y0.clone().requires_grad_(), SHARE
        put_in: dict[str, Tensor] = {}
        if bench.some(True, False, False):
            put_in = {
                name: bench.near(name).requires_grad_()
                for name in bench.rng.permutation(bench.plain())[:3]
            }
        self.copy = copy.deepcopy(bench.model)
        tied = {id(p): q for p, q in zip(bench.model.parameters(), self.copy.parameters())}
        self.leaves = [p for p in bench.model.parameters() if p.requires_grad]
        self.places: list[Tensor] = [tied[id(p)] for p in self.leaves]
        for name, value in put_in.items():
            owner, _, last = name.rpartition(".")
            place = nn.Parameter(value.detach().clone())
            for (
                path,
                module,
            ) in (
                self.copy.named_modules()
            ):  # functional_call replaces one name, not what is tied to it
                if path == owner:
                    setattr(module, last, place)
            self.leaves.append(value)
            self.places.append(place)
        self.base = self.y0.detach().clone()
        if put_in:
            self.value = torch.func.functional_call(
                Simulated(bench.model),
                {f"model.{name}": x for name, x in put_in.items()},
                (self.y0,),
                tie_weights=False,
            )
        else:
            self.value = loss(run(bench.model, self.y0))
        self.smooth = run(self.copy, self.base, "none").stats.failed_steps == 0

    def difference(self, directions: list[Tensor], y_direction: Tensor, h: float) -> float:
        """Central difference of the loss along the directions of the leaves and of y0."""
        ends, old = [], [place.detach().clone() for place in self.places]
        now, dtype = globals()["SHARE"], torch.get_default_dtype()
        globals()["SHARE"] = self.shared
        with torch.no_grad():
            for sign in (1, -1):
                for place, value, d in zip(self.places, old, directions):
                    place.copy_(value + sign * h * d)
                end = run(self.copy, self.base + sign * h * y_direction, "none")
                ends.append(float(loss(end)) if end.stats.failed_steps == 0 else np.nan)
            for place, value in zip(self.places, old):
                place.copy_(value)
        globals()["SHARE"] = now
        torch.set_default_dtype(dtype)
        return (ends[0] - ends[1]) / (2 * h)


def compare(
    rans: list[Ran], leaves: list[Tensor], gradients: list[Tensor], rng: np.random.Generator
) -> str | None:
    """Empty if the gradients are those of the differences, what is wrong if not; None where there
    is nothing to compare."""
    if not all(ran.smooth for ran in rans):
        return None
    y_bar, bars = gradients[0], gradients[1:]
    for single in (True, False):
        chosen = rng.integers(len(leaves)) if leaves and single else -1
        directions = []
        for i, leaf in enumerate(leaves):
            d = leaf.detach().abs().clamp(min=1e-12) * torch.from_numpy(
                rng.standard_normal(tuple(leaf.shape))
            )
            d = d * min(1.0, PART / max(abs(float((bars[i] * d).sum())), 1e-300))
            directions.append(d if not single or i == chosen else torch.zeros_like(d))
        y_direction = torch.zeros_like(y_bar)
        if not single or chosen < 0:
            y_direction = y_bar.sign() * rans[0].base.abs()
            y_direction = y_direction * min(
                1e-3, PART / max(float((y_bar * y_direction).sum()), 1e-300)
            )
        expected = float((y_bar * y_direction).sum()) + sum(
            float((b * d).sum()) for b, d in zip(bars, directions)
        )
        found: list[float] = []
        for h in STEPS:
            total = 0.0
            for ran in rans:
                mine = {id(leaf): d for leaf, d in zip(leaves, directions)}
                total += ran.difference(
                    [mine.get(id(x), torch.zeros_like(x)) for x in ran.leaves], y_direction, h
                )
            found.append(total)
            spread, size = (
                abs(found[-1] - found[-2]) if found[1:] else np.inf,
                max(abs(total), SMALL),
            )
            if spread <= CLEAR * size:  # never where one is not a number
                break
        else:
            return None
        if not abs(expected - found[-1]) <= ALIKE * size + 2 * spread:
            return f"gradient {expected!r}, differences {found} along {chosen if single else 'all'}"
    return ""


def sequence(number: int, rng: np.random.Generator) -> tuple[str, str | None]:
    """What was done in one sequence, and what came of it: empty if right or refused, what is wrong
    if not."""
    done: list[str] = []

    def do(bench: Bench, operations: tuple[Callable[[Bench], None], ...], most: int) -> None:
        for _ in range(rng.integers(most + 1)):
            operation = operations[rng.integers(len(operations))]
            done.append(operation.__name__)
            operation(bench)

    bench = Bench(rng)
    try:
        do(bench, BEFORE, 5)
        rans = [Ran(bench)]
        if rng.random() < 0.3:  # a second run, perhaps under another reference, and the sum of both
            done.append("again")
            bench.some(bench.change_reference, bench.move_knots, lambda: None)()
            rans.append(Ran(bench))
        done.append("|")
        do(bench, BETWEEN, 3)
        leaves = list(
            {id(leaf): leaf for ran in rans for leaf in ran.leaves if leaf.requires_grad}.values()
        )
        value = sum(ran.value for ran in rans)
        gradients = torch.autograd.grad(
            value, [*(ran.y0 for ran in rans), *leaves], allow_unused=True
        )  # pyright: ignore
    except REFUSALS as refusal:
        text = str(refusal)
        return " ".join(done), "" if text and "\n" not in text else f"not one sentence: {text!r}"
    finally:
        torch.set_default_dtype(torch.float32)
    bars = [torch.zeros_like(x) if g is None else g for g, x in zip(gradients[len(rans) :], leaves)]
    y_bar = sum(gradients[: len(rans)])
    return " ".join(done), compare(rans, leaves, [y_bar, *bars], rng)  # pyright: ignore[reportArgumentType]


@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore:the energies of the run", "ignore:the slip law of")
def test_gradients_after_any_sequence_are_those_of_what_ran(
    tally: Callable[[str], Any],
    count: Callable[[int], int],
    random: Callable[..., np.random.Generator],
) -> None:
    line, unclear = tally("sequences of model operations, gradients"), 0
    for number in range(count(1000)):
        try:
            done, wrong = sequence(number, random(71, number))
        except Exception as error:
            done, wrong = "?", f"{type(error).__name__}: {error}"
        unclear += wrong is None
        line.held(not wrong, f"sequence {number} ({done}): {wrong}")
    assert unclear <= 0.05 * line.tried + 1, (
        f"{unclear} of {line.tried} sequences had nothing to compare with"
    )
