"""Heartbeats: a process publishes its state and the reason four times a second."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import zmq

from services.bus.messages import packed_json

PERIOD_S = 0.25


class Heartbeats:
    """Publishes the result of `report` from its own thread until closed."""

    def __init__(self, endpoint: str, report: Callable[[], Mapping[str, Any]]) -> None:
        self._report = report
        self._stop = threading.Event()
        self._now = threading.Event()
        self._socket: zmq.Socket = zmq.Context.instance().socket(zmq.PUB)
        self._socket.setsockopt(zmq.LINGER, 200)  # lets the last heartbeat leave, which states why the process ends
        self._socket.setsockopt(zmq.SNDHWM, 8)
        self._socket.bind(endpoint)
        self._thread = threading.Thread(target=self._beat, name="heartbeats", daemon=True)
        self._thread.start()

    def say_now(self) -> None:
        """Publish at once, because the state has changed."""
        self._now.set()

    def close(self) -> None:
        """Publish the last state and remove the socket."""
        self._stop.set()
        self._now.set()
        self._thread.join()

    def _beat(self) -> None:
        while True:
            last = self._stop.is_set()
            said = {"pid": os.getpid(), "sent_ns": time.monotonic_ns(), **self._report()}
            self._socket.send(packed_json(said))
            if last:
                break
            self._now.wait(PERIOD_S)
            self._now.clear()
        self._socket.close()
