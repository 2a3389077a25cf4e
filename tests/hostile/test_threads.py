"""Eight threads, a hundred runs with gradients in each: the same bits as alone."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import coarse, grasp, times
from torch import Tensor, nn

from torchsoft import Profile, Reference, SoftGrasp, simulate

pytestmark = pytest.mark.slow

T = times(6e-3, 4)
THREADS, RUNS, MOTIONS = 8, 100, 5


class Own(nn.Module):
    """A friction law of one's own, compiled anew for every run."""

    def forward(self, E: Tensor, F_N: Tensor, R: Tensor) -> Tensor:
        return (E - 0.4 * F_N).clamp(min=0.0) / (R + 10.0)


def model_of(kind: int) -> SoftGrasp:
    """A model of one of four kinds; threads of one kind share their model."""
    changes = [{}, {"pad__fidelity": "inertial"}, {"contact__points": 2}, {}][kind]
    model = coarse(pad__elements_x=24, **changes)
    return SoftGrasp(model.settings, friction=Own()) if kind == 3 else model


def answer(model: SoftGrasp, y0: Tensor, reference: Reference, route: str) -> list[Tensor]:
    """States, forces and gradients of one run."""
    if route == "forward":
        run = simulate(
            model, T, y0=y0, reference=reference, gradient="forward", wrt=["pad.E", "contact.K_n"]
        )
        assert run.sensitivities is not None
        return [run.y, run.force["L"], run.sensitivities]
    run = simulate(model, T, y0=y0, reference=reference, gradient="discrete")
    leaves = [p for p in model.parameters() if p.requires_grad]
    gradients = torch.autograd.grad(
        run["theta"][-1] + 1e2 * run["x_C"][-1], leaves, allow_unused=True
    )
    return [run.y.detach(), run.force["L"], *(g for g in gradients if g is not None)]


@pytest.mark.filterwarnings("ignore:the energies of the run")
def test_threads_give_the_bits_of_runs_alone(
    tally: Callable[[str], Any],
    count: Callable[[int], int],
    random: Callable[..., np.random.Generator],
) -> None:
    line, rng = tally("runs with gradients in threads"), random(72)
    models = [model_of(kind) for kind in range(4)]
    starts = [grasp(model, (0.05, 0.0)) for model in models]
    motions = []
    for kind in range(4):
        y0, held = starts[kind]
        for _ in range(MOTIONS):
            x = Profile([0.0, 6e-3], [0.06, 0.06 + 1e-4 * float(rng.standard_normal())])
            reference = Reference(x_d=x, y_d=held["y_d"], F_ff=held["F_ff"])
            motions.append(
                (models[kind], y0, reference, "forward" if rng.random() < 0.25 else "discrete")
            )
    alone = [answer(*motion) for motion in motions]
    found: list[tuple[bool, str]] = []
    together = threading.Barrier(THREADS)

    def work(thread: int) -> None:
        together.wait()
        for i in range(count(RUNS)):
            number = MOTIONS * (thread % 4) + (thread + i) % MOTIONS
            try:
                same = all(
                    torch.equal(a, b)
                    for a, b in zip(answer(*motions[number]), alone[number], strict=True)
                )
                found.append((same, f"thread {thread}, run {i}: other bits"))
            except Exception as error:
                found.append((False, f"thread {thread}, run {i}: {type(error).__name__}: {error}"))

    threads = [threading.Thread(target=work, args=(thread,)) for thread in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for same, otherwise in found:
        line.held(same, otherwise)
    assert line.tried == THREADS * count(RUNS)


def test_laws_first_compiled_in_many_threads_are_right(
    tally: Callable[[str], Any], count: Callable[[int], int]
) -> None:
    """Every thread meets the same new law at the same time, round after round."""
    line = tally("laws first compiled in threads")
    base = coarse(pad__elements_x=24)
    y0, reference = grasp(base, (0.05, 0.0))

    def law(number: int) -> Callable[..., Tensor]:
        return lambda E, F_N, R: (
            (E - (0.2 + 0.01 * number) * F_N).clamp(min=0.0) / (R + 10.0 + number)
        )

    for number in range(count(15)):
        models = [SoftGrasp(base.settings, friction=law(number)) for _ in range(THREADS)]
        results: dict[int, Any] = {}
        together = threading.Barrier(THREADS)

        def work(
            thread: int,
            models: list[SoftGrasp] = models,
            results: dict[int, Any] = results,
            together: threading.Barrier = together,
        ) -> None:
            together.wait()
            try:
                results[thread] = simulate(models[thread], T, y0=y0, reference=reference).y
            except Exception as error:
                results[thread] = error

        threads = [threading.Thread(target=work, args=(thread,)) for thread in range(THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        alone = simulate(models[0], T, y0=y0, reference=reference).y
        for thread, result in results.items():
            same = isinstance(result, Tensor) and torch.equal(result, alone)
            line.held(same, f"law {number}, thread {thread}: {result!r:.300}")
