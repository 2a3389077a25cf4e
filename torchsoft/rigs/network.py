"""Control laws that are networks, from files of weights: data that are computed with, never programs that are run."""

import io
import re
import zipfile
from collections.abc import Sequence
from math import prod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from torchsoft.files import check_file
from torchsoft.physics.controllers import StateFeedback
from torchsoft.physics.parts import PD
from torchsoft.tables import line

WEIGHTS = 2000
"""Numbers of a network at the most: every one of them becomes machine code."""

LARGEST = 10e6
"""Size [B] of a file of weights at the most."""

PYTHON = (
    "a module of another kind is given in Python: torchsoft.Actuator(measures, pushes, module, setpoint=...) or "
    "torchsoft.controller(module, ...)"
)

LOOP = "set-point", "its rate", "coordinate", "its rate"
"""What the network of one loop sees, in SI units."""


class NetworkPD(PD):
    """A PD law and a network of (set-point, its rate, coordinate, its rate), whose efforts [N or N.m] are added."""

    def __init__(self, Kp: float, Kd: float, network: nn.Module, reversed: bool = False) -> None:
        super().__init__(Kp, Kd)
        self.network, self.sign = network, -1.0 if reversed else 1.0

    def forward(self, w: Tensor, w_dot: Tensor, feed_forward: Tensor, q: Tensor, q_dot: Tensor) -> Tensor:
        loop = self.Kp * (w - q) + self.Kd * (w_dot - q_dot)
        return self.sign * loop + self.network(torch.stack((w, w_dot, q, q_dot), -1))[..., 0] + feed_forward


class FedNetwork(nn.Module):
    """State feedback and a network of (set-points, their rates, coordinates, their rates), whose efforts [N or N.m] are added;
    either may be missing."""

    def __init__(self, feedback: StateFeedback | None, network: nn.Module | None) -> None:
        super().__init__()
        self.feedback, self.network = feedback, network

    def forward(self, setpoints: Tensor, state: Tensor) -> Tensor:
        if self.network is None:
            assert self.feedback is not None
            return self.feedback(setpoints, state)
        efforts = self.network(torch.cat((setpoints, state), -1))
        return efforts if self.feedback is None else self.feedback(setpoints, state) + efforts


def read_network(path: Path, inputs: Sequence[str], efforts: int = 1) -> nn.Sequential:
    """Linear layers with tanh between them from an .npz file of their weights and biases, with the names of torch's
    `Sequential(Linear, Tanh, Linear, ...)`: 0.weight, 0.bias, 2.weight, ... `inputs` are the words for what it sees.

    Raises `ValueError` naming the file for another kind of file, names or shapes, and `OSError`.
    """
    if path.suffix != ".npz":
        raise ValueError(
            f"{path} is not an .npz file: weights are data, and other files may be programs, which are not run; save them by "
            f"numpy.savez(file, **network.state_dict()). {PYTHON}"
        )
    check_file(path, LARGEST)
    try:
        if declared(path) > WEIGHTS:
            raise ValueError(f"it has more than {WEIGHTS} numbers, which are too many to be compiled")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not an .npz file of numbers: {line(error, 120)}") from None
    try:
        return layers(arrays, inputs, efforts)
    except ValueError as error:
        raise ValueError(f"{path}: {error}. {PYTHON}") from None


def declared(path: Path) -> int:
    """Numbers that the headings of an .npz file declare, before any is read. Raises `ValueError` for another kind of file."""
    total = 0
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.file_size > LARGEST:  # unpacked
                return WEIGHTS + 1
            member = io.BytesIO(archive.read(info))
            version = np.lib.format.read_magic(member)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            total += prod(read(member)[0])
    return total


def layers(arrays: dict[str, np.ndarray], inputs: Sequence[str], efforts: int) -> nn.Sequential:
    """Raises `ValueError` for what is no network of such layers."""
    found = sorted(int(name[1]) for name in (re.fullmatch(r"(\d{1,3})\.weight", name) for name in arrays) if name)
    if not found or {*arrays} != {f"{i}.{part}" for i in found for part in ("weight", "bias")}:
        raise ValueError(
            f"it has {', '.join(line(name, 40) for name in arrays) or 'nothing'}, but a network has 0.weight, 0.bias, "
            "2.weight, 2.bias and so on: linear layers with tanh between them"
        )
    if sum(array.size for array in arrays.values()) > WEIGHTS:
        raise ValueError(f"it has more than {WEIGHTS} numbers, which are too many to be compiled")
    width, parts = len(inputs), list[nn.Module]()
    for i in found:
        weight, bias = arrays[f"{i}.weight"], arrays[f"{i}.bias"]
        last = i == found[-1]
        if (
            weight.ndim != 2
            or weight.shape[1] != width
            or bias.shape != weight.shape[:1]
            or (last and len(bias) != efforts)
        ):
            raise ValueError(
                f"{i}.weight has the shape {weight.shape} and {i}.bias {bias.shape}, but must have "
                f"({efforts if last else 'n'}, {width}) and ({efforts if last else 'n'},): from {len(inputs)} inputs "
                f"({', '.join(inputs)}) to {'one effort' if efforts == 1 else f'{efforts} efforts'}"
            )
        for name, array in (("weight", weight), ("bias", bias)):
            if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
                raise ValueError(f"{i}.{name} must be finite numbers")
        linear = nn.Linear(width, len(bias), dtype=torch.float64)
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(weight.astype(np.float64)))
            linear.bias.copy_(torch.from_numpy(bias.astype(np.float64)))
        parts += [linear] if last else [linear, nn.Tanh()]
        width = len(bias)
    return nn.Sequential(*parts)
