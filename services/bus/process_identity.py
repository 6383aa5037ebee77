"""Identity of a process that is safe against reuse of process ids."""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from signal import pidfd_send_signal

_STATE, _STARTED = 0, 19
"""Field positions in /proc/PID/stat after the name. The name may contain anything, so fields are
counted from its last bracket."""


@dataclass(frozen=True)
class ProcessIdentity:
    """Process id and start time, which together are unique."""

    pid: int
    started: str
    """Boot id of the machine, and the start time of the process in clock ticks since boot."""

    @staticmethod
    def of(pid: int) -> ProcessIdentity | None:
        """Return the identity of a process, or None if it does not exist or is a zombie."""
        try:
            fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            return None
        if fields[_STATE] in "ZX":
            return None
        return ProcessIdentity(pid, f"{_boot()} {fields[_STARTED]}")

    @property
    def is_alive(self) -> bool:
        """Return True if this process still runs."""
        return ProcessIdentity.of(self.pid) == self

    def signal(self, number: int) -> bool:
        """Send a signal to this process only.

        Returns:
            False if the process has ended.
        """
        try:
            handle = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return False
        try:
            # The handle refers to this process, so the identity check stays valid when the signal
            # is sent.
            if not self.is_alive:
                return False
            pidfd_send_signal(handle, number)
        except ProcessLookupError:
            return False
        finally:
            os.close(handle)
        return True

    async def ended(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the process, which need not be a child.

        Returns:
            False after `timeout_s`.
        """
        try:
            handle = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        loop, over = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(handle, over.set)  # the pidfd becomes readable when the process ends
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
