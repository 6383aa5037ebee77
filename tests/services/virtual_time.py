"""Event loop whose clock jumps to the next timer when idle."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

Result = TypeVar("Result")


class VirtualTime(asyncio.SelectorEventLoop):
    """Event loop for code that waits with timers alone. It starts at the time 0."""

    def __init__(self) -> None:
        super().__init__()
        self._now_s = 0.0
        selector = self._selector  # type: ignore[attr-defined]
        select = selector.select

        def jump(timeout: float | None = None) -> Any:
            events = select(0)
            if not events and timeout:
                self._now_s += timeout
            return events

        selector.select = jump

    def time(self) -> float:
        """Return the virtual time in seconds."""
        return self._now_s


def in_virtual_time(work: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine in an event loop of its own with virtual time."""
    with asyncio.Runner(loop_factory=VirtualTime) as runner:
        return runner.run(work)
