"""Parent side of a capture process: start, messages and termination."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from operators.sources.options import SourceOptions
from operators.sources.shared_memory import BadHeader, FrameReader, new_memory
from operators.sources.wire import MOST_BYTES, message, options_to, parsed

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
            raise ChildLost(f"it says what makes no sense: {error}") from error
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
