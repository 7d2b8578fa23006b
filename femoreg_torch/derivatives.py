"""Functions whose derivatives cannot be differentiated again, and say so."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Backward = Callable[..., tuple[Tensor | None, ...]]


def first_order(what: str) -> Callable[[Backward], Backward]:
    """For the `backward` of an autograd function: what it gives raises `RuntimeError` if it is differentiated again.

    `what` names that which was differentiated. torch's own `once_differentiable` does so only where the gradient from
    above depends on something; of a linear loss it takes the derivatives for constants, without a word.
    """

    def decorate(backward: Backward) -> Backward:
        @functools.wraps(backward)
        def once(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
            with torch.no_grad():
                found = backward(ctx, *upstream)
            if not torch.is_grad_enabled():
                return found
            depends_on = [*upstream, *(saved for saved in ctx.saved_tensors if saved is not None)]
            return tuple(None if each is None else _Last.apply(each, what, *depends_on) for each in found)

        return once

    return decorate


class _Last(torch.autograd.Function):
    """A derivative, of tensors that nobody differentiates it by."""

    @staticmethod
    def forward(ctx: Any, derivative: Tensor, what: str, *_: Tensor) -> Tensor:
        ctx.what = what
        return derivative.view_as(derivative)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[None, ...]:
        raise RuntimeError(f"{ctx.what} cannot be differentiated twice.")
