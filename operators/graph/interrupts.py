"""Waiting that remains interruptible by Ctrl-C."""

from __future__ import annotations

import threading
import time

_LOOK_S = 0.25


def interruptible_wait(event: threading.Event, timeout_s: float | None = None) -> bool:
    """Wait for an event in short steps. Raises KeyboardInterrupt within one step after Ctrl-C.

    A single long wait would not notice a signal that arrives just before it blocks or in another
    thread.
    """
    due_s = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        left_s = _LOOK_S if due_s is None else min(_LOOK_S, due_s - time.monotonic())
        if event.wait(max(0.0, left_s)):
            return True
        if left_s < _LOOK_S:
            return False
