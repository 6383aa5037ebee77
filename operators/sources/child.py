"""The process that a `ProcessSource` starts: opens one source, and hands over its frames.

It imports no torch. It ends when the other side of its connection is gone, whatever the source is doing, and ignores the signals that a terminal
or a service manager sends to all processes of a group: the parent decides.
"""

from __future__ import annotations

import importlib
import logging
import os
import signal
import threading
import time
from collections import deque
from multiprocessing.connection import Connection

from gsplat_core.errors import UserError
from gsplat_core.scene.frames import Frame
from operators.sources.shared_memory import SLOTS, FrameWriter
from operators.sources.source import FrameSource
from operators.sources.wire import (
    as_contiguous,
    description_to,
    frame_header,
    message,
    options_from,
    parsed,
    planes_of,
)

IGNORED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LOOK_S = 0.1
"""How often the parent hears from this process when there is no frame."""
END_WITHIN_S = 0.6
"""After the parent has let go, the process ends within so long, even when the source does not."""


class Served:
    """One source and the connection to the process that reads it."""

    def __init__(self, connection: Connection, memory_fd: int) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._writer = FrameWriter(memory_fd)
        self._changed = threading.Condition()
        self._free = deque(range(SLOTS))
        self._wanted = False
        self.ended = threading.Event()

    def send(self, kind: str, **content: object) -> None:
        """Say something; without effect when nobody listens any more."""
        try:
            with self._sending:
                self._connection.send_bytes(message(kind, **content))
        except OSError:
            self._let_go()

    def listen(self) -> None:
        """Hear what the parent says, in a thread of its own, until it has let go."""
        try:
            while True:
                told = parsed(self._connection.recv_bytes(1 << 12))
                with self._changed:
                    if told["kind"] == "free":
                        self._free.append(told["slot"])
                    self._wanted = self._wanted or told["kind"] == "open"
                    self._changed.notify_all()
        except (EOFError, OSError):
            self._let_go()
        time.sleep(END_WITHIN_S)
        os._exit(0)

    def serve(self, source: FrameSource) -> None:
        """Hand over the source's frames until it ends or nobody wants them."""
        with self._changed:
            self._changed.wait_for(lambda: self._wanted or self.ended.is_set())
        source.open()
        try:
            said_s = 0.0
            while not self.ended.is_set():
                frame = source.read(LOOK_S)
                if frame is not None:
                    self._hand_over(frame)
                if frame is None or time.monotonic() - said_s > LOOK_S:
                    said_s = time.monotonic()
                    self._report(source)
                if frame is None and source.state.value == "ended":
                    self.send("ended", sentence=getattr(source, "state_sentence", ""))
                    return
        finally:
            source.close()

    def _report(self, source: FrameSource) -> None:
        counts = getattr(source, "counts", dict)
        sentence = getattr(source, "state_sentence", "")
        self.send("state", state=source.state.value, sentence=sentence, counts=dict(counts()))

    def _hand_over(self, frame: Frame) -> None:
        planes = as_contiguous(planes_of(frame))
        with self._changed:
            fits = self._writer.fits(planes)
            self._changed.wait_for(lambda: self.ended.is_set() or len(self._free) >= (1 if fits else SLOTS))
            if self.ended.is_set():
                return
            if not fits:
                self._writer.grow(planes)
            slot = self._free.popleft()
        self.send("frame", slot=slot, planes=self._writer.write(slot, planes), **frame_header(frame))

    def _let_go(self) -> None:
        with self._changed:
            self.ended.set()
            self._changed.notify_all()


class ToParent(logging.Handler):
    """Log records become messages."""

    def __init__(self, served: Served) -> None:
        super().__init__(logging.INFO)
        self._served = served

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        self._served.send("log", level=record.levelno, text=record.getMessage()[:2000])


def main(connection_fd: int, memory_fd: int) -> None:
    """The life of the process. The first message names what opens the source: `module:function`, an address and options."""
    for number in IGNORED_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    connection = Connection(connection_fd)
    served = Served(connection, memory_fd)
    logging.getLogger().addHandler(ToParent(served))
    logging.getLogger().setLevel(logging.INFO)
    asked = parsed(connection.recv_bytes())
    threading.Thread(target=served.listen, name="listen to the parent", daemon=True).start()
    try:
        module, name = asked["opener"].split(":")
        source = getattr(importlib.import_module(module), name)(asked["address"], options_from(asked["options"]))
        drops = getattr(source, "drops", True)
        served.send("described", description=description_to(source.description), drops=drops)
        served.serve(source)
    except UserError as error:
        served.send("refused", error=str(error))
    except Exception as error:  # noqa: BLE001 - carried to the parent, which says it
        served.send("failed", error=f"{type(error).__name__}: {error}"[:2000])
    # Threads within a library may still wait for a network; they keep nobody waiting.
    connection.close()
    os._exit(0)
