"""What systemd is told (`sd_notify`): that the service is ready, that its loop turns, that it ends. Without systemd nothing is said."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import MutableMapping

log = logging.getLogger(__name__)
SOCKET, WATCHDOG_US, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class ServiceManager:
    """systemd, where it has started this process; the variables are taken out of the environment, so that no other process speaks for it."""

    def __init__(self, environment: MutableMapping[str, str] | None = None) -> None:
        found = os.environ if environment is None else environment
        address, after_us, pid = (found.pop(name, "") for name in (SOCKET, WATCHDOG_US, WATCHDOG_PID))
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        meant = after_us.isdigit() and pid in ("", str(os.getpid()))
        self.feed_s = int(after_us) / 2e6 if meant and address else None
        """How often the watchdog is to be fed: twice as often as it looks. None: there is none."""

    def tell(self, *lines: str) -> None:
        """Send `NAME=value` lines. systemd that does not take them changes nothing here; what it then does is its own."""
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as told:
                told.setblocking(False)  # the loop must not wait for anybody
                told.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            log.warning("systemd was not told %s: %s", lines[0], error)

    async def feed_watchdog(self) -> None:
        """Say again and again that this loop turns, until cancelled."""
        while self.feed_s is not None:
            self.tell("WATCHDOG=1")
            await asyncio.sleep(self.feed_s)
