"""Selection of the compute device, of its scheduler and of the random seed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from operators.errors import DeviceMissing
from operators.graph import GreedyScheduler, ManualClock, MultiThreadScheduler

if TYPE_CHECKING:
    from operators.graph import Application

DEVICES = ("cpu", "cuda")


def check_device(device: str) -> None:
    """Raise DeviceMissing if this machine or this build cannot run on `device`."""
    import torch

    if device == "cpu":
        return
    if device != "cuda":
        raise DeviceMissing(f"device {device!r} is not known; use --device {' or '.join(DEVICES)}")
    if not torch.cuda.is_available():
        raise DeviceMissing(
            f"device cuda is not available: torch {torch.__version__} finds no GPU; use --device cpu, "
            "or let `intrasplat doctor` say what is missing"
        )
    from gsplat_core.ops.native import CUDA_MISSING

    if CUDA_MISSING is not None:
        raise DeviceMissing(f"device cuda is not available: the CUDA kernels are {CUDA_MISSING}; use --device cpu")


def scheduler_for(device: str, app: Application) -> GreedyScheduler | MultiThreadScheduler:
    """Return the scheduler for an application that processes every frame, such as a replay.

    The results do not depend on the scheduler.

    On the CPU, training occupies all cores, so one thread runs all operators in turn. With a GPU
    the host is idle during training: each operator gets a thread, and decoding, scoring and
    encoding overlap with the training on later frames.
    """
    return GreedyScheduler(app, clock=ManualClock()) if device == "cpu" else MultiThreadScheduler(app)


@contextmanager
def seeded(seed: int, device: str) -> Iterator[None]:
    """Context manager that seeds torch's random generators and restores their state on exit.

    Args:
        seed: the seed.
        device: `cuda` also covers the generators of all GPUs.
    """
    import torch

    with torch.random.fork_rng(devices=range(torch.cuda.device_count()) if device == "cuda" else []):
        torch.manual_seed(seed)
        yield
