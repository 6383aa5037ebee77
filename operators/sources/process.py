"""Source in a separate process, which isolates the reader from blocking drivers and crashing decoders.

The parent starts the process, exchanges messages with it and ends it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import signal
import subprocess
import sys
import time
import weakref
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from gsplat_core.scene.frames import Frame
from operators.errors import SourceLost, SourceUnavailable
from operators.sources.backoff import Backoff
from operators.sources.live import STALLED_AFTER_S, FrameOrder, LiveSource
from operators.sources.options import SourceOptions
from operators.sources.registry import split_address
from operators.sources.source import SourceDescription, SourceState
from operators.sources.wire import (
    MOST_BYTES,
    BadHeader,
    FrameReader,
    description_from,
    finite_counts,
    frame_from,
    message,
    new_memory,
    options_to,
    parsed,
)

END_WITHIN_S = 0.8
"""Time in seconds for the process to exit after its connection closed, before it is killed."""
_BOOT = (
    "import signal, sys, json\n"
    "for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_IGN)\n"
    "sys.path[:] = json.loads(sys.argv[1])\n"
    "from operators.sources.child import main\n"
    "main(int(sys.argv[2]), int(sys.argv[3]))\n"
)


class ChildLost(Exception):
    """The capture process ended, does not respond, or sent an invalid message."""


@dataclass(frozen=True)
class Opening:
    """Function, address and options for opening a source in the process."""

    opener: str
    """`module:function`, called with the address and the options."""
    address: str = field(repr=False)  # may contain a password
    options: SourceOptions


class ChildProcess:
    """One capture process with one source."""

    def __init__(self, opening: Opening) -> None:
        """Start the process, which opens its source immediately."""
        memory_fd = new_memory()
        ours, theirs = Pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _BOOT, json.dumps(sys.path), str(theirs.fileno()), str(memory_fd)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # its output arrives as messages
                pass_fds=(theirs.fileno(), memory_fd),
                start_new_session=True,  # keeps Ctrl-C from reaching the process
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        except BaseException:
            ours.close()
            os.close(memory_fd)
            raise
        finally:
            theirs.close()
        self.connection: Connection = ours
        self.frames = FrameReader(memory_fd)
        self._memory_fd = memory_fd
        self.heard_s = time.monotonic()
        """Time of the last received message, by `time.monotonic`."""
        content = {"opener": opening.opener, "address": opening.address, "options": options_to(opening.options)}
        self.say("ask", **content)

    def say(self, kind: str, **content: object) -> None:
        """Send a message to the process. No effect if it has ended."""
        with contextlib.suppress(OSError):
            self.connection.send_bytes(message(kind, **content))

    def hear(self, timeout_s: float) -> dict[str, Any] | None:
        """Receive the next message.

        Args:
            timeout_s: maximum waiting time in seconds.

        Returns:
            The message; None if there was none in time.

        Raises:
            ChildLost: the process has ended or sent an invalid message.
        """
        try:
            if not self.connection.poll(timeout_s):
                return None
            received = parsed(self.connection.recv_bytes(MOST_BYTES))
        except (EOFError, OSError) as error:
            raise ChildLost(self._how_it_ended()) from error
        except BadHeader as error:
            raise ChildLost(f"it sent an invalid message: {error}") from error
        self.heard_s = time.monotonic()
        return received

    def end(self) -> None:
        """Close the connection, wait for the process to exit, kill it if necessary, and free its
        resources.
        """
        self.connection.close()
        try:
            self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._forget()

    def kill(self) -> None:
        """Kill the process immediately and free its resources."""
        self._process.kill()
        self._process.wait()
        self.connection.close()
        self._forget()

    def _forget(self) -> None:
        self.frames.close()
        if self._memory_fd >= 0:
            os.close(self._memory_fd)
            self._memory_fd = -1

    def _how_it_ended(self) -> str:
        try:
            code = self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            return "its connection is closed"
        return f"it was ended by {signal.Signals(-code).name}" if code < 0 else f"it ended with status {code}"


log = logging.getLogger(__name__)
OPENER = "operators.sources.registry:open_source"
OPEN_TIMEOUT_S = 30.0
"""Timeout for the process to start and to open its source, in seconds."""
HUNG_AFTER_S = 5.0
"""Time without a message, in seconds, after which the process is considered hung."""
ON_DISK = frozenset({"recording", "realtime"})
"""Schemes of sources on disk. Missing files count towards `MOST_FAILURES`, as they do not
return.
"""
MOST_FAILURES = 10
"""Maximum number of consecutive processes without a frame before the source is given up."""
LOOK_S = 0.05


class ProcessSource(LiveSource):
    """Reads a source in a child process, which is restarted after an exit, hang or failure.

    Frames arrive through shared memory. Numbers and timestamps continue over a restart. The
    constructor starts the process and raises if the source cannot be opened. `close` ends the
    process.
    """

    def __init__(
        self,
        address: str,
        options: SourceOptions | None = None,
        *,
        opener: str = OPENER,
        hung_after_s: float = HUNG_AFTER_S,
        stuck_after_s: float = math.inf,
        open_timeout_s: float = OPEN_TIMEOUT_S,
    ) -> None:
        """Start the process and wait for the description of the source.

        Args:
            address: address of the source.
            options: source options.
            opener: `module:function` called in the process with address and options.
            hung_after_s: time without a message after which the process is replaced, in seconds.
            stuck_after_s: time without a frame of a stalled source after which the process is
                replaced.
            open_timeout_s: timeout for opening the source, in seconds.

        Raises:
            SourceUnavailable: the source cannot be opened; has the message of the process.
        """
        options = options or SourceOptions()
        # The process detects and counts stalls of its source; `state` detects stalls of the
        # process.
        super().__init__(waiting=options.waiting, stalled_after_s=math.inf, order=FrameOrder(trusted=True))
        self._opening = Opening(opener, address, options)
        self._scheme = split_address(address)[0]
        self._hung_after_s, self._stuck_after_s, self._open_timeout_s = hung_after_s, stuck_after_s, open_timeout_s
        self._child_state: tuple[SourceState, str] | None = None
        self._child_counts: dict[str, int] = {}
        self._earlier_counts: Counter[str] = Counter()
        self._child: ChildProcess | None = None
        self._finalizer: weakref.finalize | None = None
        try:
            self.description = self._start()
        except ChildLost as error:
            raise SourceUnavailable(f"the process that opens the source failed: {error}") from error

    @property
    def state(self) -> SourceState:
        """State of the source. The state reported by the process applies while the process
        responds.
        """
        state, reported, child = super().state, self._child_state, self._child
        if state is not SourceState.LIVE or self._ready:
            return state
        if child is not None and time.monotonic() - child.heard_s > STALLED_AFTER_S:
            return SourceState.STALLED
        return reported[0] if reported is not None and reported[0] is not SourceState.ENDED else state

    @property
    def state_sentence(self) -> str:
        """See `LiveSource`."""
        reported, state = self._child_state, self.state
        if reported is not None and state is reported[0] and reported[1]:
            return reported[1]
        if state is SourceState.STALLED:
            return f"the process that reads {self.description.name} does not respond"
        return super().state_sentence

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of items dropped or repaired in the process and here, by reason."""
        counts = Counter(super().counts())
        counts.update(self._earlier_counts)
        counts.update(self._child_counts)
        return dict(counts)

    def open(self) -> None:
        """See `FrameSource`."""
        if self._thread is None:
            self._earlier_counts.clear()
            self._child_counts = {}
        super().open()

    def close(self) -> None:
        """See `FrameSource`."""
        super().close()
        self._end()

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of successive processes."""
        backoff, crashes = Backoff(), 0
        try:
            while True:
                try:
                    if self._child is None:
                        self._start()
                    for frame in self._received():
                        backoff.worked()
                        crashes = 0
                        yield frame
                    return
                except (ChildLost, SourceUnavailable) as error:
                    self._end(kill=True)
                    self._earlier_counts.update(self._child_counts)
                    self._child_counts, self._child_state = {}, None
                    name = self.description.name
                    delay_s = backoff.failed()
                    # A missing camera may return. Missing files and repeated crashes are permanent.
                    comes_back = isinstance(error, SourceUnavailable) and self._scheme not in ON_DISK
                    crashes = 0 if comes_back else crashes + 1
                    if crashes >= MOST_FAILURES:
                        raise SourceLost(
                            f"{name} is given up after {crashes} attempts: {error}. Check the source and start again."
                        ) from error
                    self.count("process_restarts")
                    self.lost(f"the process that reads {name} failed ({error}); another one is started")
                    if self.wait(delay_s):
                        return
        finally:
            self._end()

    def _received(self) -> Iterator[Frame]:
        """Yield the frames of the current process until its source ends. Raises ChildLost."""
        child = self._child
        assert child is not None
        child.say("open")
        last_s = time.monotonic()
        while not self.wait(0):
            message = child.hear(LOOK_S)
            if message is None:
                if time.monotonic() - child.heard_s > self._hung_after_s:
                    raise ChildLost(f"it has sent nothing for {self._hung_after_s:g} s")
                continue
            if message["kind"] == "frame":
                last_s = child.heard_s
                yield self._frame(child, message)
            elif message["kind"] == "ended":
                return
            else:
                self._note(message)
                stalls = self._child_state is not None and self._child_state[0] is SourceState.STALLED
                if stalls and child.heard_s - last_s > self._stuck_after_s:
                    raise ChildLost(f"it has given no frame for {self._stuck_after_s:g} s")

    def _frame(self, child: ChildProcess, message: dict[str, Any]) -> Frame:
        try:
            frame = frame_from(message, child.frames.read(message.get("planes")))
        except (BadHeader, TypeError, ValueError) as error:
            raise ChildLost(f"its frame cannot be read: {error}") from error
        child.say("free", slot=message.get("slot"))
        self._child_state = None  # the last reported state is older than this frame
        return frame

    def _note(self, message: dict[str, Any]) -> None:
        """Process a message other than a frame."""
        kind = message["kind"]
        if kind == "state":
            try:
                self._child_state = SourceState(message.get("state")), str(message.get("sentence", ""))
            except ValueError as error:
                raise ChildLost(f"its state is {message.get('state')!r:.40}") from error
            self._child_counts = finite_counts(message.get("counts"))
        elif kind == "log":
            level = message.get("level")
            log.log(level if isinstance(level, int) else logging.INFO, "%s", message.get("text"))
        elif kind in ("refused", "failed"):
            raise ChildLost(str(message.get("error")))

    def _start(self) -> SourceDescription:
        """Start a process and wait until it has opened its source.

        Raises:
            SourceUnavailable: the source cannot be opened.
            ChildLost: the process failed or timed out.
        """
        child = ChildProcess(self._opening)
        self._child = child
        self._finalizer = weakref.finalize(self, child.end)  # ends the process of a source that was never closed
        try:
            return self._described(child)
        except BaseException:
            self._end(kill=True)
            raise

    def _described(self, child: ChildProcess) -> SourceDescription:
        until_s = time.monotonic() + self._open_timeout_s
        while not self.wait(0):
            message = child.hear(LOOK_S)
            if message is None:
                if time.monotonic() > until_s:
                    raise ChildLost(f"it has not opened the source within {self._open_timeout_s:g} s")
            elif message["kind"] == "described":
                self._drops = message.get("drops") is not False
                try:
                    return description_from(message.get("description", {}))
                except BadHeader as error:
                    raise ChildLost(str(error)) from error
            elif message["kind"] == "refused":
                raise SourceUnavailable(str(message.get("error")))
            else:
                self._note(message)
        raise ChildLost("it was no longer wanted")

    def _end(self, *, kill: bool = False) -> None:
        """End the current process."""
        child, self._child = self._child, None
        if child is None:
            return
        if self._finalizer is not None:
            self._finalizer.detach()
        if kill:
            child.kill()
        else:
            child.end()
