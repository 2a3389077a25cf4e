"""`simulate`: run a model over given times with the implicit stepper and gather everything into a `Trajectory`."""

import time as clock
from importlib.metadata import version
from typing import Literal

import torch
from torch import Tensor
from tqdm import tqdm

from torchsoft.adjoint import iterate
from torchsoft.equilibrium import rest
from torchsoft.solve.grid import check_times
from torchsoft.implicit import METHOD, ImplicitStepper, Progress, SimulationFailed
from torchsoft.kernels.run import DISSIPATED, INTEGRALS, SUPPLIED
from torchsoft.ledger import stored
from torchsoft.model import SoftGrasp
from torchsoft.stability import describe_instability
from torchsoft.trajectory import Stats, Trajectory


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a run; `trajectory` holds what was simulated until then."""

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__()
        self.trajectory = trajectory


def simulate(
    model: SoftGrasp,
    t: Tensor,
    *,
    y0: Tensor | None = None,
    step: float = 2e-3,
    tolerance: float = 1e-9,
    progress: bool = False,
    gradient: Literal["none", "discrete"] = "none",
) -> Trajectory:
    """Integrate `model` from y0 (size,) at t[0] through the times t (T,) [s].

    With `gradient="discrete"` the states and control forces of the result carry the exact gradient of the discrete run
    with respect to y0 and every parameter of the model (massless pads); recorded nodal forces and energies do not.

    y0 defaults to the disc at rest on the lower pad. `step` [s] is the largest step of the stepper, `tolerance` [N] its
    Newton tolerance. Raises `ValueError` for times that do not increase or a state of the wrong shape or dtype,
    `SimulationFailed` (with the trajectory so far) when the run cannot go on, and `Interrupted` (likewise) on Ctrl-C.
    """
    check_times(t)
    stepper = ImplicitStepper(model, step=step, tolerance=tolerance)
    start = rest(model) if y0 is None else y0
    bar = tqdm(
        total=float(t[-1] - t[0]),
        unit="s",
        disable=not progress,
        bar_format="{l_bar}{bar}| {n:.2f}/{total:.2f} s simulated [{elapsed}]",
    )
    y, out, wall, began = start, None, 0.0, clock.perf_counter()
    try:
        with torch.set_grad_enabled(gradient == "discrete"):
            for y, out in iterate(stepper, start, t):
                wall = clock.perf_counter() - began
                bar.n = float(t[out.rows - 1] - t[0])
                bar.refresh()
    except SimulationFailed as failure:
        assert out is not None
        raise diagnose(model, failure, gather(model, t, y, out, wall, step, failed=1)) from None
    except KeyboardInterrupt:
        if out is None:
            raise
        raise Interrupted(gather(model, t, y, out, wall, step)) from None
    finally:
        bar.close()
    assert out is not None
    return gather(model, t, y, out, wall, step)


def diagnose(model: SoftGrasp, failure: SimulationFailed, trajectory: Trajectory) -> SimulationFailed:
    """The failure with the run so far, and with the closed loop's instability as its cause if the loop is unstable."""
    try:
        cause = describe_instability(model)
    except RuntimeError:  # a model that cannot grasp has no grasp to linearise
        cause = ""
    told = (
        f"the disc was lost at t = {failure.time:.4f} s: {cause} (it ended with this: {failure})"
        if cause
        else str(failure)
    )
    out = SimulationFailed(told, failure.time)
    out.trajectory = trajectory
    return out


def gather(
    model: SoftGrasp, t: Tensor, y: Tensor, out: Progress, wall: float, step: float, failed: int = 0
) -> Trajectory:
    """The trajectory of the rows that the stepper has finished; y (T, size) carries the gradient, if any is wanted."""
    rows = out.rows
    t, y, forces, extras = t[:rows], y[:rows], *(torch.from_numpy(x[:rows]) for x in (out.forces, out.extras))
    state, lower = model.layout.unpack(y), len(model.pad_L.surface)
    with torch.set_grad_enabled(y.requires_grad):
        want = model.reference(t)
        control = torch.stack(model.controllers(want, state.r_C, state.v_C, state.r_Br, state.v_Br), -1)
    with torch.no_grad():
        energy = stored(model, state)
    column = {name: extras[:, i] for i, name in enumerate(INTEGRALS)}
    return Trajectory(
        t=t,
        y=y,
        force_L=forces[:, :lower],
        force_U=forces[:, lower:],
        control=control,
        bracket_moment=extras[:, -1],
        desired=torch.stack(want, -1),
        energy=energy,
        dissipated={name: column[name] for name in DISSIPATED},
        supplied={name: column[name] for name in SUPPLIED},
        injected=column["injected"],
        stats=Stats(out.steps, out.solves, out.failed + failed, wall, step),
        layout=model.layout,
        made_by={
            "torchsoft": version("torchsoft"),
            "method": METHOD,
            "parameters": {name: row["value"] for name, row in model.settings.table().items()},
        },
        inertia=model.inertia.item(),
    )
