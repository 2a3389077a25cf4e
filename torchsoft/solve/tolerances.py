"""Data of a rig for step-size control: groups of errors with their units, and the reference's
pieces."""

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoft.physics.motion import Reference
from torchsoft.physics.parts import COORDINATES
from torchsoft.physics.rig import Rig
from torchsoft.solve.kernel.arrays import NO_SIGNALS, Errors, Signals
from torchsoft.solve.kernel.table import Array

UNITS = {"force": 1.0, "length": 1e-3, "angle": 1.0}
"""Units of `atol`: nodal forces [N], displacements, stretches and positions [m], angles [rad]."""


def error_parts(rig: Rig, y0: Array, atol: float) -> Errors:
    """Parts of the state whose error is judged together: each pad's forces, each contact's
    stretches, a body's position, its angle. A rate's error counts by the displacement within a
    step. A position's size is how far it has come from y0."""
    first, last, rate, unit, size, origin = [], [], [], [], [], np.zeros(len(y0))
    layout = rig.layout
    for (kind, name), here in layout.slices.items():
        if kind in ("pads", "stretch", "rates"):
            parts = [
                (
                    here.start,
                    here.stop,
                    "force" if kind == "pads" and not rig.pads[name].inertial else "length",
                )
            ]
        else:
            axes = layout.free[name]
            turning = "theta" in [COORDINATES[i] for i in axes]
            split = here.stop - turning
            parts = [(here.start, split, "length"), (split, here.stop, "angle")]
        if kind == "pose":
            origin[here] = y0[here]
        for begin, end, what in parts:
            if end > begin:
                first.append(begin)
                last.append(end)
                rate.append(kind in ("rates", "velocity"))
                unit.append(UNITS[what])
                size.append(np.linalg.norm(y0[begin:end] - origin[begin:end]))
    whole = [np.array(numbers, np.int64) for numbers in (first, last, rate)]
    return Errors(whole[0], whole[1], whole[2], atol * np.array(unit), np.array(size), origin)


def part_name(rig: Rig, errors: Errors, number: int) -> str:
    """Quantity of a part's error, in words."""
    what = {
        "pads": "the nodal forces of pad", "stretch": "the stretches of contact",
        "pose": "the pose of body", "rates": "the nodal velocities of pad",
        "velocity": "the velocity of body",
    }  # fmt: skip
    for (kind, name), here in rig.layout.slices.items():
        if here.start <= errors.first[number] < here.stop:
            return f"{what[kind]} `{name}`"
    return "the state"


class Followed:
    """The signals of a run as the kernels evaluate them: `arrays`, and `stops` [s], times that no
    step may pass.

    A reference of pieces (`Profile`, `Sampled`, `Waves`) is evaluated by the kernel, any other one
    by itself, called at every stage; its exceptions are kept in `error`.
    """

    def __init__(self, signals: Callable[[Tensor], Tensor], rig: Rig, reference: Reference) -> None:
        self.error: BaseException | None = None
        chosen = reference.plain(rig.signals)
        self._callback: Any = None
        if chosen is None:
            self.arrays = NO_SIGNALS._replace(address=self._call(signals), room=np.zeros(1))
            self.stops = np.zeros(0)
            return
        with torch.no_grad():
            pieces = [one.pieces() for one in chosen]
            one = torch.ones(1, dtype=torch.float64)
            pieces += [(0.0 * one, one, value.reshape(1, 1)) for value in rig.fixed_values]
            widest = max((c.shape[1] for *_, c in pieces), default=1)
            padded = [torch.nn.functional.pad(c, (0, widest - c.shape[1])) for *_, c in pieces]
            empty = torch.zeros(0, dtype=torch.float64)
            self.arrays = Signals(
                np.cumsum([0, *(len(at) for at, *_ in pieces)]).astype(np.int64),
                np.array([c.shape[1] for *_, c in pieces], np.int64),
                torch.cat([empty, *(at for at, *_ in pieces)]).numpy(),
                torch.cat([empty, *(span for _, span, _ in pieces)]).numpy(),
                torch.cat([torch.zeros(0, widest, dtype=torch.float64), *padded])
                .contiguous()
                .numpy(),
                0,
                np.zeros(max(widest, 1)),
            )
        self.stops = np.unique(
            np.concatenate([np.zeros(0), *(signal.stops.numpy() for signal in chosen)])
        )

    def _call(self, signals: Callable[[Tensor], Tensor]) -> int:
        """Address of a function that writes the signals at the time x[0] to out."""

        def call(x: Any, _: Any, out: Any) -> None:
            try:
                with torch.no_grad():
                    values = signals(torch.tensor(x[0], dtype=torch.float64)).numpy().ravel()
            except BaseException as error:  # nothing can be raised through the kernel
                self.error = self.error or error
                values = None
            for i in range(self._count):
                out[i] = np.nan if values is None else values[i]

        self._count = signals(torch.zeros((), dtype=torch.float64)).numel()
        pointer = ctypes.POINTER(ctypes.c_double)
        self._callback = ctypes.CFUNCTYPE(None, pointer, pointer, pointer)(call)
        return ctypes.cast(self._callback, ctypes.c_void_p).value or 0
