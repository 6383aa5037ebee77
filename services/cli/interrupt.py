"""Signal handling: the first Ctrl-C asks the run to stop, the second ends it."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from types import FrameType, TracebackType

INTERRUPTED = 130
ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INSISTING = (signal.SIGINT, signal.SIGTERM)
"""Signals whose repetition ends the run at once. Not SIGHUP, which a closing terminal may send
repeatedly."""
GRACE_S = 2.0
"""Seconds that a run has to unwind after the second signal before the process is terminated."""


def end_on_interrupt() -> None:
    """Make Ctrl-C end the process at once. During startup nothing needs saving, and an interrupted
    import would print a traceback."""
    signal.signal(signal.SIGINT, _end)


def _end(number: int, frame: FrameType | None) -> None:
    _say("interrupted")
    _end_now()


def _end_now() -> None:
    files = sys.modules.get("gsplat_core.io.files")
    if files is not None:
        files.remove_unfinished()
    os._exit(INTERRUPTED)


class InterruptRequest:
    """Context manager that turns SIGINT, SIGTERM and SIGHUP into a flag, acknowledged on stderr at
    once. Calling the object returns the flag.

    A second SIGINT or SIGTERM raises KeyboardInterrupt. If a long computation blocks that for
    GRACE_S, the process is terminated.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, object] = {}
        self._wakeup_before = -1

    def __call__(self) -> bool:
        return self.requested

    def __enter__(self) -> InterruptRequest:
        # The interpreter writes signal numbers into the pipe at arrival; handlers run only when the
        # main thread returns to Python code.
        receiver, self._sender = os.pipe()
        os.set_blocking(self._sender, False)
        self._wakeup_before = signal.set_wakeup_fd(self._sender, warn_on_full_buffer=False)
        for number in ASKING:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # nohup: the run must outlive its terminal
            self._before[number] = signal.signal(number, self._handle)
        threading.Thread(target=_acknowledge, args=(receiver,), name="signals", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before.clear()
        signal.set_wakeup_fd(self._wakeup_before)
        os.close(self._sender)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested and number in INSISTING:
            raise KeyboardInterrupt
        self.requested = True


def _acknowledge(receiver: int) -> None:
    """Acknowledge each signal at its arrival, until the write end of the pipe is closed."""
    seen = 0
    ended = threading.Event()
    with os.fdopen(receiver, "rb", buffering=0) as signals:
        while numbers := signals.read(64):
            for number in numbers:
                if number not in ASKING or (seen and number not in INSISTING):
                    continue
                seen += 1
                if seen == 1:
                    _say(
                        "interrupted: finishing the frame on its way, then writing what there is; once more ends at once"
                    )
                elif seen == 2:
                    _say("interrupted again: ending at once")
                    threading.Thread(target=_end_after, args=(ended,), name="end", daemon=True).start()
    ended.set()


def _end_after(ended: threading.Event) -> None:
    if not ended.wait(GRACE_S):
        _end_now()


def _say(text: str) -> None:
    """Write a line to stderr from any thread, bypassing buffers."""
    with contextlib.suppress(OSError):  # the terminal is closed
        os.write(2, f"{text}\n".encode())
