"""Which process: its number alone may belong to another one by now."""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from signal import pidfd_send_signal

_STATE, _STARTED = 0, 19
"""Where they stand in /proc/PID/stat after the name, which may hold anything but ends with the last bracket."""


@dataclass(frozen=True)
class ProcessIdentity:
    """A process by its number and when it started: no other one, now or later, has both."""

    pid: int
    started: str
    """The machine's boot, and the clock ticks from it to the start of the process."""

    @staticmethod
    def of(pid: int) -> ProcessIdentity | None:
        """That of the process with this number; None where there is none, or only what is left of one that has ended."""
        try:
            fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            return None
        if fields[_STATE] in "ZX":
            return None
        return ProcessIdentity(pid, f"{_boot()} {fields[_STARTED]}")

    @property
    def is_alive(self) -> bool:
        """Whether this very process still runs."""
        return ProcessIdentity.of(self.pid) == self

    def signal(self, number: int) -> bool:
        """Send a signal to this process and to no other; False when it has ended."""
        try:
            handle = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return False
        try:
            # The handle stays with the process, so what is asked now holds when the signal is sent.
            if not self.is_alive:
                return False
            pidfd_send_signal(handle, number)
        except ProcessLookupError:
            return False
        finally:
            os.close(handle)
        return True

    async def ended(self, timeout_s: float | None = None) -> bool:
        """Wait until the process has ended, whoever started it; False when it has not within `timeout_s`."""
        try:
            handle = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        loop, over = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(handle, over.set)  # readable from the end of the process on
        try:
            if self.is_alive:
                await asyncio.wait_for(over.wait(), timeout_s)
            return True
        except TimeoutError:
            return False
        finally:
            loop.remove_reader(handle)
            os.close(handle)


@cache
def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
