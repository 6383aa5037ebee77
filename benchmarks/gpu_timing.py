"""Timing methods for an NVIDIA GPU and the comparison line that the `gpu_*.py` benchmarks print.

Three times per function call, in milliseconds:

- `ms`: median over calls of the time between two CUDA events around one call, with the GPU idle before. It includes the host's part as far as the GPU waits for it.
  Peers are measured in this way, and limits are for this time.
- `queued_ms`: many calls between two events, divided by their number; the cost per frame of a stream.
- `kernel_ms`: time in which anything ran on the GPU (kernels, copies, fills), from torch.profiler. Overlapping kernels count once.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the repository, where it is not installed

Work = Callable[[], object]


@dataclass(frozen=True)
class Times:
    """Times of a function call, in milliseconds."""

    ms: float
    queued_ms: float
    kernel_ms: float
    kernels: float
    """Launches on the GPU per call."""


def measure(work: Work, repetitions: int = 50, warm_up: int = 5) -> Times:
    """Measure all times of `work`, with about three times `repetitions` calls."""
    for _ in range(warm_up):
        work()
    kernel_ms, kernels = _on_the_gpu(work, max(3, repetitions // 5))
    return Times(_median_of_calls(work, repetitions), _queued(work, repetitions), kernel_ms, kernels)


def _median_of_calls(work: Work, repetitions: int) -> float:
    torch.cuda.synchronize()
    times = []
    for _ in range(repetitions):
        start, end = _events()
        start.record()
        work()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def _queued(work: Work, repetitions: int) -> float:
    """Return the best of three, since other work of the host can only add time."""
    best = float("inf")
    for _ in range(3):
        start, end = _events()
        torch.cuda.synchronize()
        start.record()
        for _ in range(repetitions):
            work()
        end.record()
        end.synchronize()
        best = min(best, start.elapsed_time(end) / repetitions)
    return best


def _on_the_gpu(work: Work, repetitions: int) -> tuple[float, float]:
    with profile(activities=[ProfilerActivity.CUDA], acc_events=True) as profiler:
        for _ in range(repetitions):
            work()
        torch.cuda.synchronize()
    there = sorted(
        (event.time_range.start, event.time_range.end)
        for event in profiler.events()
        if event.device_type == DeviceType.CUDA
    )
    busy_us, until = 0.0, -math.inf
    for start, end in there:
        busy_us += max(0.0, end - max(start, until))
        until = max(until, end)
    return busy_us / 1e3 / repetitions, len(there) / repetitions


def _events() -> tuple[torch.cuda.Event, torch.cuda.Event]:
    return torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)


def captured(work: Work, warm_up: int = 2) -> Work:
    """Capture `work` as a CUDA graph; returns the function that replays it."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(warm_up):
            work()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    return graph.replay


def extra_mib(work: Work, calls: int = 3) -> float:
    """Return the peak of torch's memory during `work`, in addition to the memory before, after a warm-up call."""
    work()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    for _ in range(calls):
        work()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def gsplat() -> ModuleType | None:
    """Return the gsplat module, or None if it is not installed (`benchmarks/peers/build_gsplat.py`)."""
    import gsplat as module

    if not hasattr(module, "rasterization"):
        # Without it, the folder of this name next to this file is imported.
        print("gsplat is not compared: it is not installed", file=sys.stderr)
        return None
    return module


def report(work: str, **figures: Any) -> None:
    """Print one JSON object on one line, with the fields of `Times` prefixed by their name."""
    flat: dict[str, Any] = {"work": work}
    for name, value in figures.items():
        if isinstance(value, Times):
            flat |= {f"{name}_{part}": part_value for part, part_value in asdict(value).items()}
        else:
            flat[name] = value
    print(json.dumps({name: _rounded(value) for name, value in flat.items()}), flush=True)


def compare(work: str, ours: Times, peers: Mapping[str, Times], asked_ms: float | None = None, **more: object) -> None:
    """Print our times, each peer's times, the ratios to the fastest peer, and the verdict against the limit."""
    figures: dict[str, Any] = {"ours": ours, **peers}
    if peers:
        figures["ratio"] = min(peer.ms for peer in peers.values()) / ours.ms
        figures["queued_ratio"] = min(peer.queued_ms for peer in peers.values()) / ours.queued_ms
        figures["kernel_ratio"] = min(peer.kernel_ms for peer in peers.values()) / ours.kernel_ms
    if asked_ms is not None:
        figures |= {"asked_ms": asked_ms, "met": ours.ms <= asked_ms}
    report(work, **figures, **more)


def report_machine() -> None:
    """Print GPU, driver and versions as the first line of a run."""
    module = gsplat()
    report(
        "machine",
        device=torch.cuda.get_device_name(),
        torch=torch.__version__,
        cuda=torch.version.cuda,
        gsplat=None if module is None else module.__version__,
    )


def _rounded(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value
