"""A sequence of launches, recorded once as a CUDA graph and replayed without the host's work."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch

Result = TypeVar("Result")


class GraphMemory:
    """Memory that the recordings of one owner hand on: a new one takes what the one before it, no longer in use, has left."""

    def __init__(self, device: torch.device) -> None:
        # torch gives a pool up with the last graph in it; this one stays.
        self._anchor = torch.cuda.CUDAGraph()
        _record(self._anchor, lambda: torch.zeros(1, device=device), device, None)

    @property
    def pool(self) -> Any:
        """What torch knows the memory by."""
        return self._anchor.pool()


class CapturedSequence(Generic[Result]):
    """`sequence()` as one launch.

    What it allocates keeps its place from one replay to the next, so `results` are the same tensors every time, overwritten by every
    replay. Anything that changes between replays must be read from device memory that the sequence refers to already.

    A recording may not load kernels: the sequence must have run before, or `warm_up` runs it once for real.
    """

    def __init__(
        self, sequence: Callable[[], Result], device: torch.device, memory: GraphMemory, *, warm_up: bool
    ) -> None:
        if warm_up:
            sequence()
        self._graph = torch.cuda.CUDAGraph()
        self.results = _record(self._graph, sequence, device, memory.pool)

    def replay(self) -> Result:
        """Launch the whole sequence on the current stream; returns at once."""
        self._graph.replay()
        return self.results


def _record(
    graph: torch.cuda.CUDAGraph,
    sequence: Callable[[], Result],
    device: torch.device,
    pool: Any,
) -> Result:
    # Not `torch.cuda.graph`, which collects garbage first: that takes longer than many frames.
    current, side = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    side.wait_stream(current)
    with torch.cuda.stream(side):
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")  # other threads may go on allocating
        try:
            results = sequence()
        finally:
            graph.capture_end()
    current.wait_stream(side)
    return results
