"""Loads the compiled core once, and says what to do when it is not there."""

from __future__ import annotations

from pathlib import Path

import torch

from gsplat_core.errors import NativeLibraryMissing

LIBRARY_PATH = Path(__file__).resolve().parent.parent / "gsplat_core_cpu.so"
INSTRUCTION_SETS = ("baseline", "avx2", "avx512")


def load_native() -> None:
    """Register the compiled ops under `torch.ops.gsplat_core`.

    Raises NativeLibraryMissing when the library was not built, or was built for another torch or machine.
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


def instruction_set() -> str:
    """The vector instruction set that the compiled core uses on this machine."""
    return INSTRUCTION_SETS[torch.ops.gsplat_core.active_isa()]


load_native()
