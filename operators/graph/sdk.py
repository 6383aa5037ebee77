"""Import of the Holoscan SDK installed by pip, without LD_LIBRARY_PATH.

Separate from the adapter, which cannot be imported without the SDK, so that its errors can be tested there.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import os
import signal
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from operators.errors import EngineMissing

_CUDART = "libcudart.so.13"
_ADVICE = "install it with: pip install 'intrasplat[holoscan]'"


def load_sdk() -> Any:
    """Return the SDK's modules `core`, `schedulers` and `resources`. Raises EngineMissing naming the missing part."""
    if importlib.util.find_spec("holoscan") is None:
        raise EngineMissing(f"the Holoscan SDK is not installed; {_ADVICE}")
    _preload_cudart()
    try:
        with warnings.catch_warnings():
            # The SDK warns about a stack below 32 MB, which is not needed here.
            warnings.filterwarnings("ignore", message="Current stack size", category=RuntimeWarning)
            core, schedulers, resources, logger = (
                importlib.import_module(f"holoscan.{name}") for name in ("core", "schedulers", "resources", "logger")
            )
    except (ImportError, OSError) as error:
        raise EngineMissing(f"the Holoscan SDK is installed but cannot be loaded ({error}); {_ADVICE}") from error
    if "HOLOSCAN_LOG_LEVEL" not in os.environ:
        logger.set_log_level(logger.LogLevel.ERROR)
    return SimpleNamespace(core=core, schedulers=schedulers, resources=resources)


def keep_signals() -> Callable[[], None]:
    """Save the handlers of SIGINT and SIGTERM. Return a thread-safe function that restores them.

    A run of the SDK replaces the handlers permanently, after which the process ignores SIGTERM.
    """
    get, put = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
    get.restype = put.restype = ctypes.c_void_p
    put.argtypes = [ctypes.c_int, ctypes.c_void_p]
    kept = {number: get(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in kept.items():
            put(number, handler)

    return restore


def _preload_cudart() -> None:
    """Load the CUDA runtime globally; the SDK is linked against it even for CPU graphs."""
    try:
        ctypes.CDLL(_CUDART, ctypes.RTLD_GLOBAL)
        return
    except OSError:
        spec = importlib.util.find_spec("nvidia")
    for site in (spec.submodule_search_locations or []) if spec is not None else []:
        for library in sorted(Path(site).glob(f"*/lib/{_CUDART}")):
            ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)
            return
    raise EngineMissing(f"the Holoscan SDK needs {_CUDART} of the package nvidia-cuda-runtime >= 13; {_ADVICE}")
