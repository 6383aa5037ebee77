"""Loader of the compiled core and, if built, of the CUDA kernels.

Reports the remedy if a library is missing.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import torch

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
