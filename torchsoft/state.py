"""The state vector: which component stands where, and how it is taken apart."""

from typing import NamedTuple

import torch
from torch import Tensor


class State(NamedTuple):
    """One state, batch dimensions leading. SI units; u_U is relative to the bracket, every velocity is absolute.

    u_L, u_U: pad displacements (..., nodes, 2); s_L, s_U: tangential stretches (..., surface); r_C, r_Br (..., 2) and
    theta (...): pose of disc and bracket; v_L, v_U: nodal velocities (..., nodes, 2) of inertial pads, with no nodes
    for massless ones; v_C, omega, v_Br: velocities of disc and bracket.
    """

    u_L: Tensor
    u_U: Tensor
    s_L: Tensor
    s_U: Tensor
    r_C: Tensor
    theta: Tensor
    r_Br: Tensor
    v_L: Tensor
    v_U: Tensor
    v_C: Tensor
    omega: Tensor
    v_Br: Tensor


class Layout:
    """Where each part of `State` stands in the flat vector; `size` is the vector's length."""

    def __init__(self, nodes: tuple[int, int], surface: tuple[int, int], massless: bool) -> None:
        moving = (0, 0) if massless else nodes
        self.shapes: dict[str, tuple[int, ...]] = {
            "u_L": (nodes[0], 2),
            "u_U": (nodes[1], 2),
            "s_L": (surface[0],),
            "s_U": (surface[1],),
            "r_C": (2,),
            "theta": (),
            "r_Br": (2,),
            "v_L": (moving[0], 2),
            "v_U": (moving[1], 2),
            "v_C": (2,),
            "omega": (),
            "v_Br": (2,),
        }
        self.slices, start = {}, 0
        for name, shape in self.shapes.items():
            width = 1
            for n in shape:
                width *= n
            self.slices[name] = slice(start, start + width)
            start += width
        self.size = start

    def unpack(self, y: Tensor) -> State:
        """Views into y (..., size). Raises `ValueError` for another length or dtype than float64."""
        if y.shape[-1:] != (self.size,) or y.dtype != torch.float64:
            raise ValueError(
                f"`y` must be float64 of shape (..., {self.size}), but is {y.dtype} of shape {tuple(y.shape)}; "
                "build it with `rest` or `Layout.pack`"
            )
        batch = y.shape[:-1]
        return State(**{k: y[..., self.slices[k]].reshape((*batch, *shape)) for k, shape in self.shapes.items()})

    def pack(self, state: State) -> Tensor:
        """The flat vector (..., size) of a state; the inverse of `unpack`."""
        batch = state.theta.shape
        return torch.cat([getattr(state, k).reshape(*batch, -1) for k in self.shapes], -1)
