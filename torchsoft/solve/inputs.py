"""Inputs of a run: numbers in any usual form, and a start whose graph may be shared."""

from typing import Any

import torch
from torch import Tensor


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
