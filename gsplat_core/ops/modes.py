"""Modes of torch that the compiled operations would compute wrongly: autocasting, transforms and forward-mode derivatives."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch.autograd import forward_ad

P = ParamSpec("P")
R = TypeVar("R")
_AUTOCAST_DEVICES = ("cpu", "cuda")


def in_plain_mode(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function`, which then runs without autocasting and refuses transforms that it would compute wrongly.

    Forward-mode derivatives of the compiled operations would be zero.

    Raises:
        NotImplementedError: inside `torch.func.vmap`, `grad`, `jvp` and the like, and inside `forward_ad.dual_level`.
    """

    plain = without_autocast(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.compiler.is_compiling() and (
            torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0
        ):
            raise NotImplementedError(
                f"{function.__name__}() has no transforms of torch.func and no forward-mode derivatives; give batch"
                " dimensions in place of vmap, and use backward() or torch.autograd.grad for gradients"
            )
        return plain(*args, **kwargs)

    return call


def without_autocast(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function`, which then runs without autocasting: products in half precision would misplace and misorder splats."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        enabled = [device for device in _AUTOCAST_DEVICES if torch.is_autocast_enabled(device)]
        if not enabled:
            return function(*args, **kwargs)
        with contextlib.ExitStack() as stack:
            for device in enabled:
                stack.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return call
