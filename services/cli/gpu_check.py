"""Detection of a usable NVIDIA GPU and of obstacles, for `intrasplat doctor` and `make demo`.

python -m services.cli.gpu_check     # prints the answer; exit code 0 with a GPU, 1 without
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

OLDEST = (8, 0)
"""Minimum compute capability: the CUDA kernels use Ampere instructions."""
DRIVER, DEVICE, WSL = Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"), Path("/dev/dxg")


@dataclass(frozen=True)
class Graphics:
    """Result of the GPU detection: what was found, whether it is usable, and the remedy."""

    usable: bool
    found: str
    advice: str = ""
    """Remedy; empty if the GPU is usable or there is no remedy."""


def look() -> Graphics:
    """Query torch, and inspect the driver's files for the reason if torch sees no GPU."""
    import torch

    if torch.version.cuda is None:
        return Graphics(False, f"none that torch {torch.__version__} could use: it was built without CUDA")
    if not torch.cuda.is_available():
        return _unseen(torch.version.cuda)
    names, capabilities = [], []
    for k in range(torch.cuda.device_count()):
        capabilities.append(torch.cuda.get_device_capability(k))
        names.append("{} (compute capability {}.{})".format(torch.cuda.get_device_name(k), *capabilities[-1]))
    found = ", ".join(names)
    if capabilities[0] < OLDEST:
        return Graphics(False, found, "the CUDA kernels need compute capability {}.{} or later".format(*OLDEST))
    return Graphics(True, found)


def _unseen(cuda: str) -> Graphics:
    """Explain why torch sees no GPU. A container always has the host driver's version file, but not the device file."""
    if DEVICE.exists() or WSL.exists():
        return Graphics(
            False,
            f"one is here, and torch, built for CUDA {cuda}, cannot start it ({_why_cuda_does_not_start()})",
            f"install an NVIDIA driver for CUDA {cuda} or later; CUDA_VISIBLE_DEVICES must not hide the GPU",
        )
    if DRIVER.exists():
        return Graphics(
            False, "none here, though this machine has NVIDIA's driver", "in a container, start it with `--gpus all`"
        )
    return Graphics(
        False, "none: this machine has no NVIDIA driver", "not needed; with an NVIDIA GPU, install its driver"
    )


def _why_cuda_does_not_start() -> str:
    import torch

    try:
        torch.cuda.init()
    except (RuntimeError, AssertionError) as error:
        return str(error).splitlines()[0].rstrip(". ")
    return "it says no more"


def main() -> int:
    """Print whether the GPU works.

    Returns:
        The exit code; 0 if a GPU is usable.
    """
    graphics = look()
    print("NVIDIA GPU:", graphics.found + (f"; {graphics.advice}" if graphics.advice else ""))  # noqa: T201 - its purpose
    return 0 if graphics.usable else 1


if __name__ == "__main__":
    sys.exit(main())
