"""Source in a separate process, which isolates the reader from blocking drivers and crashing decoders.

The parent starts the process, exchanges control messages with it and ends it. Frames travel in shared memory: an anonymous
file, which exists only while one of the processes has it open. The process does not import torch.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import logging
import math
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from gsplat_core.errors import UserError
from gsplat_core.io.frame_codec import MAX_FRAME_BYTES, MAX_PIECES, InvalidMessage, decode, encode
from gsplat_core.scene.frames import Frame
from operators.errors import SourceLost, SourceUnavailable
from operators.sources.address import SourceOptions
from operators.sources.live import STALLED_AFTER_S, Backoff, FrameOrder, LiveSource
from operators.sources.source import FrameSource, SourceDescription, SourceState

log = logging.getLogger(__name__)


SLOTS = 4
"""Number of slots in shared memory, and so of frames in flight between child and parent process."""
_ALIGNMENT = 64


def new_memory() -> int:
    """Return a file descriptor of empty shared memory, inheritable by a child process through `pass_fds`."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        # Shrinking the memory would crash the reader.
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return fd
    with tempfile.TemporaryFile() as file:  # like a memfd, this file has no name in the file system
        return os.dup(file.fileno())


class FrameWriter:
    """Writer of encoded frames to shared memory."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._memory: mmap.mmap | None = None
        self._slot_bytes = 0

    def fits(self, pieces: Sequence[bytes | memoryview]) -> bool:
        """Return True if the frame's pieces (parts of its encoding) fit into a slot of the shared memory."""
        return _laid_out(map(len, pieces))[1] <= self._slot_bytes

    def grow(self, pieces: Sequence[bytes | memoryview]) -> None:
        """Enlarge the slots for this frame; no slot may be in use."""
        if self._memory is not None:
            self._memory.close()
        self._slot_bytes = _laid_out(map(len, pieces))[1]
        os.ftruncate(self._fd, SLOTS * self._slot_bytes)
        self._memory = mmap.mmap(self._fd, SLOTS * self._slot_bytes)

    def write(self, slot: int, pieces: Sequence[bytes | memoryview]) -> dict[str, Any]:
        """Copy a frame's pieces into a slot, which must be free. Return their position for `FrameReader.read`."""
        assert self._memory is not None
        offset, sizes = slot * self._slot_bytes, [len(piece) for piece in pieces]
        for piece, begin in zip(pieces, _laid_out(sizes)[0], strict=True):
            self._memory[offset + begin : offset + begin + len(piece)] = piece
        return {"offset": offset, "sizes": sizes}


class FrameReader:
    """Reader of encoded frames from shared memory."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._memory: mmap.mmap | None = None

    def read(self, offset: Any, sizes: Any) -> list[memoryview]:
        """Return copies of a frame's pieces.

        Args:
            offset: position of the first piece in bytes.
            sizes: sizes of the pieces in bytes.

        Raises:
            InvalidMessage: the position or a size is invalid.
        """
        whole = isinstance(sizes, list) and all(type(size) is int and size > 0 for size in sizes)
        if not whole or not 1 <= len(sizes) <= MAX_PIECES or sum(sizes) > MAX_FRAME_BYTES:
            raise InvalidMessage(f"a frame cannot have pieces of {sizes!r:.80} bytes")
        begins, length = _laid_out(sizes)
        if type(offset) is not int or not 0 <= offset < 1 << 62:
            raise InvalidMessage(f"a frame cannot begin at byte {offset!r:.20}")
        if self._memory is None or offset + length > len(self._memory):
            self._map()
        if self._memory is None or offset + length > len(self._memory):
            raise InvalidMessage(f"pieces of {sizes} bytes at byte {offset} lie outside of the shared memory")
        with memoryview(self._memory) as memory:
            places = [(offset + begin, size) for begin, size in zip(begins, sizes, strict=True)]
            return [memoryview(bytearray(memory[begin : begin + size])) for begin, size in places]

    def close(self) -> None:
        """Unmap the shared memory."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def _map(self) -> None:
        self.close()
        size = os.fstat(self._fd).st_size
        if size:
            self._memory = mmap.mmap(self._fd, size, prot=mmap.PROT_READ)


def _laid_out(sizes: Iterable[int]) -> tuple[list[int], int]:
    """Return the aligned offset in bytes of each piece of a frame within its slot, and the total size in bytes."""
    begins, end = [], 0
    for size in sizes:
        begins.append(end)
        end += -(-size // _ALIGNMENT) * _ALIGNMENT
    return begins, end


MOST_BYTES = 1 << 20
"""Maximum size of a control message in bytes."""


def message(kind: str, **content: Any) -> bytes:
    """Encode a message between the source's process and its parent, as JSON."""
    return json.dumps({"kind": kind, **content}).encode()


def parsed(data: bytes) -> dict[str, Any]:
    """Decode a message between the source's process and its parent. Raises InvalidMessage."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InvalidMessage(f"{data[:40]!r} is not JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise InvalidMessage(f"{data[:40]!r} is not a message")
    return content


def finite_counts(content: Any) -> dict[str, int]:
    """Return the valid counts of a JSON object; empty if it is not an object."""
    if not isinstance(content, dict):
        return {}
    return {str(name): int(times) for name, times in content.items() if isinstance(times, int) and math.isfinite(times)}


IGNORED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REPORT_S = 0.1
"""Period of state messages to the parent while no frame arrives, and their minimum interval otherwise, in seconds."""
_EXIT_WITHIN_S = 0.6
"""Time limit in seconds to exit after the parent has closed the connection, even if the source blocks."""


class Served:
    """Source in the child process, and the child's connection to the parent process."""

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
        """Receive messages from the parent until the connection closes. End the process `_EXIT_WITHIN_S` seconds later.

        Runs in its own thread.
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
        time.sleep(_EXIT_WITHIN_S)
        os._exit(0)

    def serve(self, source: FrameSource) -> None:
        """Transfer frames until the source ends or the parent closes the connection."""
        with self._changed:
            self._changed.wait_for(lambda: self._wanted or self.ended.is_set())
        source.open()
        try:
            reported_s = 0.0
            while not self.ended.is_set():
                frame = source.read(_REPORT_S)
                if frame is not None:
                    self._hand_over(frame)
                if frame is None or time.monotonic() - reported_s > _REPORT_S:
                    reported_s = time.monotonic()
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
        pieces = encode(frame)
        with self._changed:
            fits = self._writer.fits(pieces)
            self._changed.wait_for(lambda: self.ended.is_set() or len(self._free) >= (1 if fits else SLOTS))
            if self.ended.is_set():
                return
            if not fits:
                self._writer.grow(pieces)
            slot = self._free.popleft()
        self.send("frame", slot=slot, **self._writer.write(slot, pieces))

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


def serve_source(connection_fd: int, memory_fd: int) -> None:
    """Open one source and transfer its frames to the parent process; the main function of the child process.

    The process ends when the parent closes the connection, even if the source blocks. It ignores signals sent to the
    process group, because the parent controls its lifetime.

    The first message names the function that opens the source (`module:function`), an address and options.

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
        source = getattr(importlib.import_module(module), name)(asked["address"], SourceOptions(**asked["options"]))
        drops = getattr(source, "drops", True)
        served.send("described", description=source.description.as_json(), drops=drops)
        served.serve(source)
    except UserError as error:
        served.send("refused", error=str(error))
    except Exception as error:  # noqa: BLE001 - sent to the parent process, which reports it
        served.send("failed", error=f"{type(error).__name__}: {error}"[:2000])
    # Exit without waiting for library threads, which may be blocked in network calls.
    connection.close()
    os._exit(0)


END_WITHIN_S = 0.8
"""Time in seconds for the process to exit after its connection closed, before it is killed."""
_BOOT = (
    "import signal, sys, json\n"
    "for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_IGN)\n"
    "sys.path[:] = json.loads(sys.argv[1])\n"
    "from operators.sources.process import serve_source\n"
    "serve_source(int(sys.argv[2]), int(sys.argv[3]))\n"
)


class ChildLost(Exception):
    """The process that reads the source ended, does not respond, or sent an invalid message."""


class ChildRefused(ChildLost):
    """The source in the process raised a UserError while it was read, for example for a damaged file."""


@dataclass(frozen=True)
class Opening:
    """Function, address and options for opening a source in the process."""

    opener: str
    """`module:function`, called with the address and the options."""
    address: str = field(repr=False)  # may contain a password
    options: SourceOptions


class ChildProcess:
    """Child process that reads one source, as seen by the parent."""

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
        self.message_s = time.monotonic()
        """Time of the last received message, by `time.monotonic`."""
        content = {"opener": opening.opener, "address": opening.address, "options": asdict(opening.options)}
        self.send("ask", **content)

    def send(self, kind: str, **content: object) -> None:
        """Send a message to the process. No effect if it has ended."""
        with contextlib.suppress(OSError):
            self.connection.send_bytes(message(kind, **content))

    def receive(self, timeout_s: float) -> dict[str, Any] | None:
        """Wait for the next message of the child process.

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
        except InvalidMessage as error:
            raise ChildLost(f"it sent an invalid message: {error}") from error
        self.message_s = time.monotonic()
        return received

    def end(self) -> None:
        """Close the connection, wait for the process to exit, kill it if necessary, and free its resources."""
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


OPENER = "operators.sources.registry:open_source"
OPEN_TIMEOUT_S = 30.0
"""Timeout for the process to start and to open its source, in seconds."""
HUNG_AFTER_S = 5.0
"""Time without a message, in seconds, after which the process is considered hung."""
MOST_FAILURES = 10
"""Number of consecutive processes that end without a frame after which the source is given up. Failures to open a
source that may return, such as a camera, do not count.
"""
POLL_S = 0.05


class ProcessSource(LiveSource):
    """Reads a source in a child process, which is restarted after an exit, hang or failure.

    Frames arrive through shared memory. Numbers and timestamps continue over a restart. The constructor starts the
    process and raises if the source cannot be opened. `close` ends the process.
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
        may_return: bool = False,
    ) -> None:
        """Start the process and wait for the description of the source.

        Args:
            address: address of the source.
            options: source options.
            opener: `module:function` called in the process with address and options.
            hung_after_s: time without a message after which the process is replaced, in seconds.
            stuck_after_s: time without a frame of a stalled source after which the process is replaced, in seconds.
            open_timeout_s: timeout for opening the source, in seconds.
            may_return: a source that is unavailable may return, such as a camera. Otherwise a source that refuses its
                address or content, as for a missing or damaged file, is given up at once.

        Raises:
            SourceUnavailable: the source cannot be opened; has the message of the process.
        """
        options = options or SourceOptions()
        # The process detects and counts stalls of its source; `state` detects stalls of the process.
        super().__init__(waiting=options.waiting, stalled_after_s=math.inf, order=FrameOrder(trusted=True))
        self._opening = Opening(opener, address, options)
        self._may_return = may_return
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
        """Current state of the source.

        It is `LIVE` while frames wait for `read`, `ENDED` after the last one, and `RECONNECTING` from a call of `lost`
        to the next frame. Otherwise it is `STALLED` if the child process does not respond, else the state that the
        child reported, except `ENDED`.
        """
        state, reported, child = super().state, self._child_state, self._child
        if state is not SourceState.LIVE or self._ready:
            return state
        if child is not None and time.monotonic() - child.message_s > STALLED_AFTER_S:
            return SourceState.STALLED
        return reported[0] if reported is not None and reported[0] is not SourceState.ENDED else state

    @property
    def state_sentence(self) -> str:
        """Reason for the state, as a sentence: that of the child process if it reported one, else of this process."""
        reported, state = self._child_state, self.state
        if reported is not None and state is reported[0] and reported[1]:
            return reported[1]
        if state is SourceState.STALLED:
            return f"the process that reads {self.description.name} does not respond"
        return super().state_sentence

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of items dropped or repaired in the child process and in this process, by reason."""
        counts = Counter(super().counts())
        counts.update(self._earlier_counts)
        counts.update(self._child_counts)
        return dict(counts)

    def open(self) -> None:
        """Start reading, with counts from 0. Idempotent."""
        if self._thread is None:
            self._earlier_counts.clear()
            self._child_counts = {}
        super().open()

    def close(self) -> None:
        """End the child process and release all resources. Idempotent."""
        super().close()
        self._end()

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of the child process, and of its replacements after an exit, hang or failure.

        Raises:
            SourceLost: after `MOST_FAILURES` failures without a frame, or the first error of a source that cannot return.
        """
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
                    if not self._may_return and isinstance(error, ChildRefused | SourceUnavailable):
                        # Another process would find the same file, and repeat the frames before the error.
                        raise SourceLost(str(error)) from error
                    delay_s = backoff.failed()
                    # A missing camera may return. Repeated crashes are permanent.
                    comes_back = isinstance(error, SourceUnavailable) and self._may_return
                    crashes = 0 if comes_back else crashes + 1
                    if crashes >= MOST_FAILURES:
                        raise SourceLost(
                            f"{name} is given up after {crashes} attempts: {str(error).rstrip('.')}. Check the source and start again."
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
        child.send("open")
        # The child sends nothing between its description and the receipt of `open`, so this pause does not count as a hang.
        last_s = child.message_s = time.monotonic()
        while not self.wait(0):
            message = child.receive(POLL_S)
            if message is None:
                if time.monotonic() - child.message_s > self._hung_after_s:
                    raise ChildLost(f"it has sent nothing for {self._hung_after_s:g} s")
                continue
            if message["kind"] == "frame":
                last_s = child.message_s
                yield self._frame(child, message)
            elif message["kind"] == "ended":
                return
            else:
                self._note(message)
                stalls = self._child_state is not None and self._child_state[0] is SourceState.STALLED
                if stalls and child.message_s - last_s > self._stuck_after_s:
                    raise ChildLost(f"it has delivered no frame for {self._stuck_after_s:g} s")

    def _frame(self, child: ChildProcess, message: dict[str, Any]) -> Frame:
        try:
            frame = decode(child.frames.read(message.get("offset"), message.get("sizes")))
        except InvalidMessage as error:
            raise ChildLost(f"its frame cannot be read: {error}") from error
        child.send("free", slot=message.get("slot"))
        self._child_state = None  # the last reported state is older than this frame
        return frame

    def _note(self, message: dict[str, Any]) -> None:
        """Store the state, counts or log record of a message that is not a frame."""
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
        elif kind == "refused":
            raise ChildRefused(str(message.get("error")))
        elif kind == "failed":
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
            message = child.receive(POLL_S)
            if message is None:
                if time.monotonic() > until_s:
                    raise ChildLost(f"it has not opened the source within {self._open_timeout_s:g} s")
            elif message["kind"] == "described":
                self._drops = message.get("drops") is not False
                try:
                    return SourceDescription.from_json(message.get("description"))
                except InvalidMessage as error:
                    raise ChildLost(str(error)) from error
            elif message["kind"] == "refused":
                raise SourceUnavailable(str(message.get("error")))
            else:
                self._note(message)
        raise ChildLost("it was no longer wanted")

    def _end(self, *, kill: bool = False) -> None:
        """End the current child process: orderly, or by SIGKILL if `kill` is set."""
        child, self._child = self._child, None
        if child is None:
            return
        if self._finalizer is not None:
            self._finalizer.detach()
        if kill:
            child.kill()
        else:
            child.end()
