"""Subscribers that measure a stream's pictures, each in a thread."""

from __future__ import annotations

import threading
import time
from typing import Any

import zmq

from services.bus.messages import parsed_json, subscribe


class Watch:
    """Subscriber that records the intervals between pictures."""

    def __init__(self, endpoint: str) -> None:
        self.gaps_ms: list[float] = []
        """Time between two pictures by their receipt here."""
        self.sent_gaps_ms: list[float] = []
        """Time between the same two pictures by their arrival at the capture process."""
        self.ages_ms: list[float] = []
        self.shown_ms: list[float] = []
        """Ages when they were shown, as their headers say."""
        self.steps: list[int] = []
        self.pictures = 0
        self.last_ns = 0
        self._sent_ns = 0
        self._stop = threading.Event()
        self._endpoint = endpoint
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Reset the measurements."""
        self.gaps_ms.clear()
        self.sent_gaps_ms.clear()
        self.ages_ms.clear()
        self.shown_ms.clear()
        self.steps.clear()

    def last_from_after(self, at_ns: int) -> bool:
        """Return true if the last picture shows a frame that arrived after `at_ns`."""
        return self._sent_ns > at_ns

    def close(self) -> None:
        """Stop watching."""
        self._stop.set()
        self._thread.join()

    def note(self, header: dict[str, Any], now_ns: int) -> None:
        """Record a new picture and its time."""
        sent_ns = header["arrived_ns"]
        if self.last_ns:
            self.gaps_ms.append((now_ns - self.last_ns) * 1e-6)
            self.sent_gaps_ms.append((sent_ns - self._sent_ns) * 1e-6)
        self.ages_ms.append((now_ns - sent_ns) * 1e-6)
        if "age_ms" in header:
            self.shown_ms.append(header["age_ms"])
            self.steps.append(header["steps"])
        self.last_ns, self._sent_ns = now_ns, sent_ns
        self.pictures += 1

    def _watch(self) -> None:
        socket = subscribe(zmq.Context.instance().socket(zmq.SUB), self._endpoint)
        while not self._stop.is_set():
            if not socket.poll(100):
                continue
            header = parsed_json(socket.recv_multipart(copy=False)[0].buffer)
            now_ns = time.monotonic_ns()
            if header.get("new") is False:
                continue
            self.note(header, now_ns)
        socket.close()


def quantiles(values: list[float]) -> dict[str, float]:
    """Return median, 99th percentile and maximum."""
    ordered = sorted(values)
    return {
        "p50": round(ordered[len(ordered) // 2], 3),
        "p99": round(ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))], 3),
        "most": round(ordered[-1], 3),
    }
