"""Capture of a sequence of kernel launches as a CUDA graph, replayed as one launch."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch

Result = TypeVar("Result")

_CAPTURING = threading.Lock()
"""Lock held during a capture. Other threads may launch and allocate, but captures never overlap."""


class GraphMemory:
    """Memory pool for the captured graphs of one owner.

    A graph that replaces an unused one takes over its memory.
    """

    def __init__(self, device: torch.device) -> None:
        # torch frees a pool together with the last graph in it; this empty one keeps it.
        self._keeper = torch.cuda.CUDAGraph()
        _capture(self._keeper, lambda: torch.zeros(1, device=device), device, None)

    @property
    def pool(self) -> Any:
        """Return torch's handle of the pool."""
        return self._keeper.pool()


class CapturedSequence(Generic[Result]):
    """CUDA graph of the launches of `sequence()`.

    Allocations of the sequence keep their addresses. `results` are the same tensors at every
    replay, which overwrites them. Inputs that change between replays must be in device memory
    referenced by the sequence.

    Kernels cannot be loaded during a capture. The sequence must have run before, or `warm_up` runs
    it once with all its side effects.
    """

    def __init__(
        self, sequence: Callable[[], Result], device: torch.device, memory: GraphMemory, *, warm_up: bool
    ) -> None:
        if warm_up:
            sequence()
        self._graph = torch.cuda.CUDAGraph()
        self.results = _capture(self._graph, sequence, device, memory.pool)

    def replay(self) -> Result:
        """Launch the graph on the current stream without waiting."""
        self._graph.replay()
        return self.results


def _capture(
    graph: torch.cuda.CUDAGraph,
    sequence: Callable[[], Result],
    device: torch.device,
    pool: Any,
) -> Result:
    # Not `torch.cuda.graph`, which collects garbage first: that takes longer than many frames.
    with _CAPTURING:
        current, side = torch.cuda.current_stream(device), torch.cuda.Stream(device)
        side.wait_stream(current)
        with torch.cuda.stream(side):
            # thread_local lets other threads allocate
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                results = sequence()
            finally:
                graph.capture_end()
        current.wait_stream(side)
    return results
