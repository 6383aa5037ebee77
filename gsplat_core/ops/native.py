"""The compiled core: loader of its library and, if built, of the CUDA kernels, and registration of the ops' gradients.

Importing this module loads the libraries. An error about a missing one states the remedy.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from gsplat_core.errors import NativeLibraryMissing

LIBRARY_PATH = Path(__file__).resolve().parent.parent / "gsplat_core_cpu.so"
CUDA_LIBRARY_PATH = LIBRARY_PATH.with_name("gsplat_core_cuda.so")
INSTRUCTION_SETS = ("baseline", "avx2", "avx512")


def load_native() -> None:
    """Register the compiled ops under `torch.ops.gsplat_core`.

    Raises:
        NativeLibraryMissing: if the library was not built, or for another torch version or machine.
    """
    if not LIBRARY_PATH.exists():
        raise NativeLibraryMissing(
            f"the compiled core {LIBRARY_PATH} is missing; build it with `make native` in the repository, or reinstall with"
            " `pip install .` (needs a C++20 compiler). gsplat_core.reference works without it."
        )
    try:
        torch.ops.load_library(str(LIBRARY_PATH))
    except OSError as error:
        raise NativeLibraryMissing(
            f"the compiled core {LIBRARY_PATH} cannot be loaded ({error}); it needs torch >= 2.11 (this is {torch.__version__})"
            " and the machine it was built for. Rebuild it with `make native` or `pip install --force-reinstall .`"
        ) from error


def load_cuda() -> str | None:
    """Register the CUDA kernels if they were built. Does not access a GPU.

    A failure does not affect the CPU kernels.

    Returns:
        None on success, otherwise the reason as a sentence.
    """
    if not CUDA_LIBRARY_PATH.exists():
        return "not built (on a machine with an NVIDIA GPU `make cuda` in the repository builds them)"
    if torch.version.cuda is None:
        return f"built, and torch {torch.__version__} has no CUDA"
    try:
        torch.ops.load_library(str(CUDA_LIBRARY_PATH))
    except OSError as error:
        return f"built, and torch {torch.__version__} cannot load them ({error}); rebuild them with `make cuda`"
    return None


def instruction_set() -> str:
    """Return the vector instruction set used by the compiled core on this machine."""
    return INSTRUCTION_SETS[torch.ops.gsplat_core.active_isa()]


def cuda_build() -> str:
    """Return compiler and compute capabilities of the CUDA kernels: `nvcc 13.0 for 8.0, 9.0`."""
    build = ctypes.CDLL(str(CUDA_LIBRARY_PATH)).gsplat_core_cuda_build
    build.restype = ctypes.c_char_p
    version, _, architectures = build().decode().partition(";")
    return f"nvcc {version} for {', '.join(str(int(number) / 100) for number in architectures.split(','))}"


def cuda_refusal() -> str | None:
    """Return CUDA's reason why the kernels cannot run on the first GPU; None if they can. Initialises CUDA."""
    refusal = ctypes.CDLL(str(CUDA_LIBRARY_PATH)).gsplat_core_cuda_refusal
    refusal.restype = ctypes.c_char_p
    with torch.cuda.device(0):
        torch.cuda.synchronize()
        said = refusal()
    return None if said is None else str(said.decode())


load_native()
CUDA_MISSING = load_cuda()
"""Reason why the CUDA kernels are unavailable; None if they are loaded."""


class _Unfollowed(Function):
    """Identity on the gradients of a compiled operation, whose own derivative raises NotImplementedError.

    Without it, torch would take second derivatives of compiled operations for zero.
    """

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
        if not torch.is_grad_enabled():  # backward pass without create_graph=True
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
