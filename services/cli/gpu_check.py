"""Is there an NVIDIA GPU that this program can use, and if not, what is in the way? For `intrasplat doctor` and `make demo`.

python -m services.cli.gpu_check     # prints the answer; exit code 0 when there is one, 1 when there is none
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

OLDEST = (8, 0)
"""Compute capability that the CUDA kernels need: they use instructions of Ampere."""
DRIVER, DEVICE, WSL = Path("/proc/driver/nvidia/version"), Path("/dev/nvidiactl"), Path("/dev/dxg")


@dataclass(frozen=True)
class Graphics:
    """What was found."""

    usable: bool
    found: str
    advice: str = ""
    """What would make it usable; empty when it is, or nothing would."""


def look() -> Graphics:
    """Ask torch, whose word counts, and where it sees no GPU look at the driver's files for the reason."""
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
    """torch sees no GPU. The driver's version file is there in every container of its machine; the device's is not."""
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
    """Print what was found; 0 when it is usable."""
    graphics = look()
    print("NVIDIA GPU:", graphics.found + (f"; {graphics.advice}" if graphics.advice else ""))  # noqa: T201 - its purpose
    return 0 if graphics.usable else 1


if __name__ == "__main__":
    sys.exit(main())
