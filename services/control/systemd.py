"""systemd notifications (`sd_notify`): ready, watchdog, stopping. Without systemd they are skipped."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import MutableMapping

log = logging.getLogger(__name__)
SOCKET, WATCHDOG_US, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class ServiceManager:
    """Client of the systemd notification socket. Removes the variables from the environment, so
    child processes cannot notify."""

    def __init__(self, environment: MutableMapping[str, str] | None = None) -> None:
        found = os.environ if environment is None else environment
        address, after_us, pid = (found.pop(name, "") for name in (SOCKET, WATCHDOG_US, WATCHDOG_PID))
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        meant = after_us.isdigit() and pid in ("", str(os.getpid()))
        self.feed_s = int(after_us) / 2e6 if meant and address else None
        """Watchdog interval in seconds, half of systemd's timeout. None without a watchdog."""

    def tell(self, *lines: str) -> None:
        """Send `NAME=value` lines to systemd. Failures are logged and otherwise ignored."""
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)  # never block the event loop
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            log.warning("systemd was not told %s: %s", lines[0], error)

    async def feed_watchdog(self) -> None:
        """Send watchdog notifications until cancelled."""
        while self.feed_s is not None:
            self.tell("WATCHDOG=1")
            await asyncio.sleep(self.feed_s)
