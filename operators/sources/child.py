"""Capture process started by a `ProcessSource`: opens one source and transfers its frames.

The process does not import torch. It ends when the parent closes the connection, even if the source
blocks. It ignores signals sent to the process group, because the parent controls its lifetime.
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
from operators.sources.source import FrameSource
from operators.sources.wire import (
    SLOTS,
    FrameWriter,
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
"""Period of state messages to the parent while no frame arrives, in seconds."""
END_WITHIN_S = 0.6
"""Time limit in seconds to exit after the parent has closed the connection, even if the source
blocks.
"""


class Served:
    """One source and the connection to the parent process."""

    def __init__(self, connection: Connection, memory_fd: int) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._writer = FrameWriter(memory_fd)
        self._changed = threading.Condition()
        self._free = deque(range(SLOTS))
        self._wanted = False
        self.ended = threading.Event()

    def send(self, kind: str, **content: object) -> None:
        """Send a message to the parent. No effect after the connection was closed."""
        try:
            with self._sending:
                self._connection.send_bytes(message(kind, **content))
        except OSError:
            self._let_go()

    def listen(self) -> None:
        """Receive messages from the parent until the connection closes, then exit. Runs in its own
        thread.
        """
        try:
            while True:
                received = parsed(self._connection.recv_bytes(1 << 12))
                with self._changed:
                    if received["kind"] == "free":
                        self._free.append(received["slot"])
                    self._wanted = self._wanted or received["kind"] == "open"
                    self._changed.notify_all()
        except (EOFError, OSError):
            self._let_go()
        time.sleep(END_WITHIN_S)
        os._exit(0)

    def serve(self, source: FrameSource) -> None:
        """Transfer frames until the source ends or the parent closes the connection."""
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
    """Log handler that forwards records to the parent."""

    def __init__(self, served: Served) -> None:
        super().__init__(logging.INFO)
        self._served = served

    def emit(self, record: logging.LogRecord) -> None:
        self._served.send("log", level=record.levelno, text=record.getMessage()[:2000])


def main(connection_fd: int, memory_fd: int) -> None:
    """Run the capture process.

    The first message names the function that opens the source (`module:function`), an address and
    options.

    Args:
        connection_fd: file descriptor of the connection to the parent.
        memory_fd: file descriptor of the shared memory.
    """
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
    except Exception as error:  # noqa: BLE001 - carried to the parent, which reports it
        served.send("failed", error=f"{type(error).__name__}: {error}"[:2000])
    # Exit without waiting for library threads, which may be blocked in network calls.
    connection.close()
    os._exit(0)
