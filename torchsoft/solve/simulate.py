"""`simulate`: run a rig over given times, by the route to a derivative that is wanted, into one
`Trajectory`."""

import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor
from tqdm import tqdm

from torchsoft.caller import warn
from torchsoft.parallel import one_torch_thread, ungraphed
from torchsoft.physics.arguments import Numbers, positive, tensor
from torchsoft.physics.channels import Touch
from torchsoft.physics.motion import Reference
from torchsoft.physics.rig import Rig
from torchsoft.physics.structure import Structure
from torchsoft.physics.validity import check_array
from torchsoft.solve.diagnostics import doubts, instability
from torchsoft.solve.gradients import (
    TAPE_BYTES,
    Route,
    Solved,
    Task,
    directions,
    iterate,
    march,
)
from torchsoft.solve.parameters import independent
from torchsoft.solve.progress import SimulationFailed
from torchsoft.solve.stepper import ImplicitStepper
from torchsoft.solve.trajectory import Trajectory


class Initial(NamedTuple):
    """The state y0 (size,) at the start of a run, and the reference that the run follows."""

    y0: Tensor
    reference: Reference


Start = Callable[[Rig], Initial]
"""Start of a run as a function of the rig, differentiable in the rig's parameters."""

RTOL = 1e-5
"""Relative tolerance where nothing else is asked for."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a run; `trajectory` holds the run until then."""

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__()
        self.trajectory = trajectory


@ungraphed
@one_torch_thread()
def simulate(
    rig: Rig, t: Numbers, *, y0: Numbers | Initial | Start, reference: Reference | None = None,
    rtol: float | None = None, atol: float | None = None, step: float | None = None,
    knots: Numbers | None = None, tolerance: float = 1e-9, gradient: Route = "none",
    wrt: Sequence[str] = (), dy0: Numbers | None = None, rigid: bool = False,
    touch: Sequence[str] = (), progress: bool = False,
) -> Trajectory:  # fmt: skip
    """Integrate `rig` from y0 (size,) at t[0] through the times t (T,) [s]: tensors, numpy's arrays
    or lists, which are computed with in float64. A `y0` that is a function of the rig, such as
    `BuiltRig.initial`, is evaluated at the rig's present parameters, and differentiated.

    `reference` is followed by the rig, its own by default.

    Steps are chosen so that the error of each stays below rtol times the largest value so far plus
    atol, which counts nodal forces in N, lengths in mm, angles in rad, and in a light or small rig
    forces by its weight, lengths by a tenth of its smallest body (`steps.rig_units`); either alone
    brings the other, a tenth of rtol being atol. A motion is right long before its derivative is:
    rtol = 1e-3 holds positions to 1e-4 of their range and forces to 1 %; the default, `RTOL`, ten
    times that and most derivatives to 1 %. With `step` [s] they are equal ones between the times t
    instead, no longer than it. `knots` are the steps of another run (its `knots`), frozen, for a
    fit whose residuals are then smooth in the parameters. `tolerance` [N] is Newton's.

    gradient: with "discrete" the states, channels, forces, loads and stored energies of the result
    carry the exact gradient of the discrete run (of the steps that were taken, which are not
    differentiated) by y0, every parameter and the reference; energies dissipated and supplied
    refuse one. With "forward" `sensitivities` holds the derivatives by the n scalar parameters
    `wrt`, and dy0 (size, n) is that of the start; columns of dy0 beyond the n are directions of the
    start alone. `rigid` keeps the derivatives of the free coordinates and their rates only, and
    `touch` names channels of touch, or arrays of them, whose derivatives are wanted too. Under
    `torch.no_grad()` no route records a graph.

    Raises `ValueError` for times that do not increase, a state of the wrong shape or dtype, an
    unknown route or parameter, two ways to choose steps at once; `SimulationFailed` (with the
    trajectory so far) when the run cannot go on; `Interrupted` (likewise) on Ctrl-C.
    """
    task = prepare(
        rig, t, y0=y0, reference=reference, rtol=rtol, atol=atol, step=step, knots=knots,
        tolerance=tolerance, gradient=gradient, wrt=wrt, dy0=dy0, rigid=rigid, touch=touch,
    )  # fmt: skip
    trajectory = Trajectory.of(run(task, TAPE_BYTES, progress))
    for doubt in doubts(trajectory, task.stepper.rig).values():
        warn(doubt)
    return trajectory


@ungraphed
@one_torch_thread()
def unjudged(rig: Rig, t: Numbers, **options: Any) -> Trajectory:
    """`simulate` without its warnings, for searches whose runs on the way need none."""
    return Trajectory.of(run(prepare(rig, t, **options), TAPE_BYTES))


def prepare(
    rig: Rig, t: Numbers, *, y0: Numbers | Initial | Start, reference: Reference | None = None,
    rtol: float | None = None, atol: float | None = None, step: float | None = None,
    knots: Numbers | None = None, tolerance: float = 1e-9, gradient: Route = "none",
    wrt: Sequence[str] = (), dy0: Numbers | None = None, rigid: bool = False,
    touch: Sequence[str] = (), structure: Structure | None = None,
    values: Mapping[int, Tensor] | None = None, more: Sequence[Tensor] = (),
) -> Task:  # fmt: skip
    """Checks the arguments of `simulate`, and takes `values` in the place of some parameters of
    the rig of a `structure`, by their id; raises its `ValueError`s. The reference may be made of
    scalar tensors for columns of dy0 beyond those of `wrt`: these are `more`."""
    if not isinstance(rig, Rig):
        given = rig if isinstance(rig, type) else type(rig).__name__
        raise ValueError(f"`rig` must be a Rig, but is {given}")
    t = tensor("t", t)
    knots, dy0 = (
        x if x is None else tensor(name, x) for name, x in (("knots", knots), ("dy0", dy0))
    )
    _check_wanted(gradient, wrt, dy0, rigid, touch)
    leaves = tuple((values or {}).get(id(x), x) for x in map(rig.parameter, wrt))
    if callable(y0):
        if dy0 is not None:
            raise ValueError(
                "`dy0` is the derivative of a start that is a state; give the state as `y0`, too"
            )
        y0 = started(rig, y0, gradient, structure, values)
        dy0 = torch.from_numpy(directions(y0.y0, leaves)) if leaves else None
    if isinstance(y0, Initial):
        y0, reference = y0.y0, y0.reference if reference is None else reference
    start = tensor("y0", y0)
    check_array("y0", start)
    ways = {"step": step, "knots": knots, "rtol or atol": rtol if rtol is not None else atol}
    given = [f"`{name}`" for name, value in ways.items() if value is not None]
    if len(given) > 1:
        raise ValueError(f"{' and '.join(given)} each say which steps to take; give one of them")
    if rtol is None:
        rtol = RTOL if atol is None else 10 * positive("atol", atol)
    stepper = ImplicitStepper(
        rig,
        reference,
        step=step,
        rtol=rtol,
        atol=0.1 * positive("rtol", rtol) if atol is None else atol,
        knots=knots,
        tolerance=tolerance,
        structure=structure,
        values=values,
        differentiable=gradient == "forward"
        or (gradient == "discrete" and torch.is_grad_enabled()),
    )
    stepper.check(start, t)
    return Task(
        stepper, t, shared(start), gradient, tuple(map(rig.full, wrt)), dy0, rigid,
        _channels_of_touch(rig, touch), rig,
        (*leaves, *more),
    )  # fmt: skip


def started(
    rig: Rig, start: Start, gradient: Route, structure: Structure | None = None,
    values: Mapping[int, Tensor] | None = None,
) -> Initial:  # fmt: skip
    """The start of a rig with `values` in the place of some parameters, by their id, with a graph
    where the route to a gradient needs one."""
    if values:
        structure = structure or Structure(rig)
        given = [values.get(id(x), x) for x in structure.parameters]
        rig = structure.copy(given)[0]
    wanted = gradient == "forward" or (gradient == "discrete" and torch.is_grad_enabled())
    with torch.set_grad_enabled(wanted), independent():
        return start(rig)


def run(
    task: Task, tape_bytes: float, progress: bool = False, explained: bool = True,
    effort: float = float("inf"),
) -> Solved:  # fmt: skip
    """Carry out a task by one of the compiled routes; `explained` looks for the cause of a failure,
    which takes seconds. The run stops early after an `effort` of so many Newton iterations.

    Raises `SimulationFailed` and `Interrupted` with the run so far.
    """
    t, bar = task.t, None
    if progress:
        bar = tqdm(
            total=float(t[-1] - t[0]),
            unit="s",
            disable=None,
            bar_format="{l_bar}{bar}| {n:.2f}/{total:.2f} s simulated [{elapsed}]",
        )
    done, began = None, clock.perf_counter()
    try:
        with torch.set_grad_enabled(
            task.gradient == "forward" or (task.gradient == "discrete" and torch.is_grad_enabled())
        ):
            for done in _growing(task, tape_bytes):
                stats = done.out.stats
                stats.wall_s = clock.perf_counter() - began
                if bar is not None and not bar.disable:
                    bar.n = float(t[done.out.rows - 1] - t[0])
                    bar.refresh()
                if stats.newton_iterations > effort:
                    break
    except SimulationFailed as failure:
        if done is None:
            raise
        failure.trajectory = Trajectory.of(done, done.rows)
        if explained:
            raise diagnose(task.stepper.rig, failure) from None
        raise
    except KeyboardInterrupt:
        if done is None:
            raise
        raise Interrupted(Trajectory.of(done, done.rows)) from None
    finally:
        if bar is not None:
            bar.close()
    assert done is not None
    return done


def _check_wanted(
    gradient: Route, wrt: Sequence[str], dy0: Tensor | None, rigid: bool, touch: Sequence[str]
) -> None:
    """Raises `ValueError` for an unknown route, and for arguments of another route."""
    if not isinstance(gradient, str) or gradient not in get_args(Route):
        raise ValueError(
            f"`gradient` must be one of {', '.join(get_args(Route))}, but is {gradient!r}"
        )
    for name, given in (("wrt", wrt), ("touch", touch)):
        listed = isinstance(given, list | tuple) and all(isinstance(x, str) for x in given)
        if not listed:
            raise ValueError(f"`{name}` must be a list of names, but is {given!r}")
    if wrt and gradient != "forward":
        raise ValueError("`wrt` names the parameters of gradient='forward', and of that only")
    if gradient == "forward" and not wrt and dy0 is None:
        raise ValueError(
            "gradient='forward' needs the parameters' names `wrt`, or directions `dy0` of the start"
        )
    if gradient != "forward" and (dy0 is not None or rigid or touch):
        raise ValueError(
            "`dy0`, `rigid` and `touch` belong to gradient='forward', and to that only"
        )
    if gradient == "forward" and torch.is_inference_mode_enabled():
        raise ValueError(
            "gradient='forward' needs torch's graphs, which torch.inference_mode() has not; use "
            "torch.no_grad()"
        )


def _channels_of_touch(rig: Rig, names: Sequence[str]) -> tuple[str, ...]:
    """Raises `ValueError` for names other than those of channels of touch, or of arrays of them."""
    known = Touch(rig)
    if not names:
        return ()
    for name in (expanded := known.expanded(names)):
        if name not in known:
            raise ValueError(f"`touch` names {name!r}, but channels of touch are {known.shown}")
    return expanded


def _growing(task: Task, tape_bytes: float) -> Iterator[Solved]:
    """The growing run."""
    stepper, wrt, dy0 = task.stepper, task.wrt, task.dy0
    if task.gradient != "forward":
        return march(task, tape_bytes)
    leaves = [stepper.rig.parameter(name) for name in wrt]
    for name, value in zip(wrt, leaves):
        if value.ndim or not value.requires_grad:
            raise ValueError(f"`{name}` must be a scalar parameter that requires a gradient")
    size = stepper.layout.size
    if dy0 is not None:
        check_array("dy0", dy0)
        if dy0.ndim != 2 or len(dy0) != size or dy0.shape[1] < max(1, len(wrt)):
            raise ValueError(
                f"`dy0` must have shape ({size}, {max(1, len(wrt))}), or more columns, but has "
                f"{tuple(dy0.shape)}"
            )
        if not bool(torch.isfinite(dy0).all()):
            raise ValueError("`dy0` must be finite, but has a component that is not")
    kept = stepper.layout.measured if task.rigid else list(range(size))
    return iterate(task, leaves, kept, Touch(stepper.rig).sums(task.touch))


def diagnose(rig: Rig, failure: SimulationFailed) -> SimulationFailed:
    """The failure, with the closed loop's instability as its cause if the loop is unstable."""
    cause = instability(rig, failure.trajectory)
    reason = (
        f"the run was lost at t = {failure.time:.4f} s: {cause} (it ended with: {failure})"
        if cause
        else str(failure)
    )
    out = SimulationFailed(reason, failure.time, failure.contact, failure.left)
    out.trajectory = failure.trajectory
    return out


# Inputs of a run: numbers in any usual form, and a start whose graph may be shared.


class SharedStart(RuntimeError):
    """A second backward pass through a start whose graph the first one has freed."""


class _Start(torch.autograd.Function):
    """Passes a start through; its backward says in words that the graph behind it is gone."""

    @staticmethod
    def forward(ctx: Any, y0: Tensor, origin: Any) -> Tensor:
        ctx.origin = origin
        return y0.view_as(y0)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        if freed(ctx.origin):
            raise SharedStart(
                "the start y0 was computed from parameters, and an earlier backward pass through "
                "another run has freed that computation: make y0 anew for every backward pass, "
                "give y0.detach() if its own derivative is not wanted, or call "
                "backward(retain_graph=True) before"
            )
        return bar, None


def freed(node: Any) -> bool:
    """Whether a node of autograd's graph, or one behind it, has lost its saved tensors."""
    seen, waiting = set(), [node]
    while waiting:
        one = waiting.pop()
        if one is None or one in seen:
            continue
        seen.add(one)
        try:
            for name in dir(one):
                if name.startswith("_saved") or name == "saved_tensors":
                    getattr(one, name)
        except RuntimeError:
            return True
        waiting += [behind for behind, _ in one.next_functions]
    return False


def shared(y0: Tensor) -> Tensor:
    """Start of a run, whose backward explains a second pass through a graph that is freed."""
    if y0.grad_fn is None or not torch.is_grad_enabled():
        return y0
    return _Start.apply(y0, y0.grad_fn)  # pyright: ignore[reportReturnType]
