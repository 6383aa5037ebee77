"""Where the heavy work runs."""

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
    """Raises DeviceMissing where this machine or this build cannot run on `device`."""
    import torch

    if device == "cpu":
        return
    if device != "cuda":
        raise DeviceMissing(f"device {device!r} is not known; use --device {' or '.join(DEVICES)}")
    if not torch.cuda.is_available():
        raise DeviceMissing(
            f"device cuda was asked for, and torch {torch.__version__} sees no GPU; use --device cpu, "
            "or let `intrasplat doctor` say what is missing"
        )
    from gsplat_core.ops.native import CUDA_MISSING

    if CUDA_MISSING is not None:
        raise DeviceMissing(f"device cuda was asked for, and the CUDA kernels are {CUDA_MISSING}; use --device cpu")


def scheduler_for(device: str, app: Application) -> GreedyScheduler | MultiThreadScheduler:
    """How an application that keeps every frame runs beside `device`; the frames' bytes do not depend on it.

    On the CPU the training keeps every core busy, and one thread runs all operators in turn. While a GPU trains, the host is free: decoding,
    scoring and video each have a thread of their own, and what they do for one frame overlaps with the training on the next ones.
    """
    return GreedyScheduler(app, clock=ManualClock()) if device == "cpu" else MultiThreadScheduler(app)


@contextmanager
def seeded(seed: int, device: str) -> Iterator[None]:
    """Torch's random numbers start from `seed` inside, and go on as if nothing had happened afterwards."""
    import torch

    with torch.random.fork_rng(devices=range(torch.cuda.device_count()) if device == "cuda" else []):
        torch.manual_seed(seed)
        yield
