"""Settings of the interpreter and of OpenCV for a low latency of live frames."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

GARBAGE_THRESHOLDS = (20_000, 20, 1000)
"""Thresholds of the garbage collector. Collections are rare and mostly of young objects: processing
a frame creates no cycles, and a full collection takes tens of milliseconds.
"""
SWITCH_INTERVAL_S = 0.0002
"""Interpreter switch interval in seconds. With the default of 5 ms, a thread could wait that long for the GIL."""
OPENCV_THREADS = 1
"""Number of OpenCV threads. Starting more takes longer than processing a small picture."""


@contextmanager
def low_latency() -> Iterator[None]:
    """Context manager with a short interpreter switch interval and existing objects exempt from garbage collection."""
    interval_s = sys.getswitchinterval()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(min(threads, OPENCV_THREADS))
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    thresholds = gc.get_threshold()
    gc.set_threshold(*GARBAGE_THRESHOLDS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
        cv2.setNumThreads(threads)
        sys.setswitchinterval(interval_s)
