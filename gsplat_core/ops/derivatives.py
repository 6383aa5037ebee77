"""Derivatives of compiled operations, which have first ones only."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function


class _Unfollowed(Function):
    """Gradients that are part of a graph, so that differentiating them fails instead of giving zero."""

    @staticmethod
    def forward(ctx: Any, anchor: Tensor, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        return tuple(None if each is None else each.clone() for each in gradients)

    @staticmethod
    def backward(ctx: Any, *v: Tensor | None) -> Any:
        raise NotImplementedError(
            "compiled operations have first derivatives only; detach the gradient, leave create_graph out, or take differences"
            " of first derivatives"
        )


def differentiable_once(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Return `backward` of an operation whose result raises NotImplementedError if it is differentiated again.

    torch would take gradients of compiled code for constants, and sum up second derivatives without them.
    `once_differentiable` of torch is not enough: it raises only if the given gradients are differentiated, too.
    """

    @functools.wraps(backward)
    def called(ctx: Any, *v: Any) -> Any:
        if not torch.is_grad_enabled():  # without create_graph
            return backward(ctx, *v)
        with torch.no_grad():
            found = backward(ctx, *v)
        anchor = torch.zeros((), requires_grad=True)
        if isinstance(found, tuple):
            return _Unfollowed.apply(anchor, *found)
        return _Unfollowed.apply(anchor, found)[0]

    return called


def register_gradient(name: str, backward: Callable[..., Any], *, setup_context: Callable[..., None]) -> None:
    """Register the backward function of an operation, as `torch.library.register_autograd`, for first derivatives."""
    torch.library.register_autograd(name, differentiable_once(backward), setup_context=setup_context)
