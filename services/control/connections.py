"""Listening socket with a limit on open connections per client address."""

from __future__ import annotations

import ipaddress
import logging
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from services.control.limits import network_of_address

log = logging.getLogger(__name__)
SAY_AGAIN_S = 10.0
"""Seconds between log lines about refused connections."""
MOST_REFUSED = 64
"""Connections that one `accept` call closes before the event loop runs other work."""


class AddressBound:
    """Counter and limit of open connections per address (per /64 for IPv6). Thread-safe."""

    def __init__(
        self,
        most: int,
        exempt: Sequence[str] = (),
        on_refused: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Set the limit.

        Args:
            most: connections allowed per address; 0 means no limit.
            exempt: networks that are not counted, normally the trusted proxies. X-Forwarded-For is
                not considered, because connections are refused before anything is read.
            on_refused: called for each connection closed because its address is at the limit.
            clock: monotonic time in seconds.
        """
        self._most, self._on_refused, self._clock = most, on_refused, clock
        self._exempt = [ipaddress.ip_network(each) for each in exempt]
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._said_s: float | None = None

    def enter(self, address: str) -> str | None:
        """Count a new connection.

        Returns:
            The key to pass to `leave`, or None if the address is at its limit.
        """
        key = "" if not self._most or self._is_exempt(address) else network_of_address(address)
        with self._lock:
            if key and self._open[key] >= self._most:
                self._on_refused()
                self._say(key)
                return None
            self._open[key] += 1
            return key

    def leave(self, key: str) -> None:
        """Discount a closed connection."""
        with self._lock:
            self._open[key] -= 1
            if self._open[key] <= 0:
                del self._open[key]

    def open(self, address: str) -> int:
        """Return the number of open connections of an address."""
        with self._lock:
            return self._open[network_of_address(address)]

    def _is_exempt(self, address: str) -> bool:
        try:
            ip = ipaddress.ip_address(address)
        except ValueError:
            return False
        ip = getattr(ip, "ipv4_mapped", None) or ip
        return any(ip in network for network in self._exempt if network.version == ip.version)

    def _say(self, key: str) -> None:
        now_s = self._clock()
        if self._said_s is None or now_s - self._said_s >= SAY_AGAIN_S:
            self._said_s = now_s
            log.warning(
                "%s has %d connections, which is limits.connections_per_address; more are closed", key, self._open[key]
            )


class BoundedListener(socket.socket):
    """Listening socket whose `accept` closes connections above the limit.

    asyncio accepts through this method, before TLS and before any request is read.
    """

    bound: AddressBound

    @classmethod
    def of(cls, listener: socket.socket, bound: AddressBound) -> BoundedListener:
        """Wrap an existing listening socket, taking over its descriptor."""
        made = cls(listener.family, listener.type, listener.proto, fileno=listener.detach())
        made.bound = bound
        return made

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection within the limit.

        Raises:
            BlockingIOError: if none is pending, or after `MOST_REFUSED` refused connections.
        """
        for _ in range(MOST_REFUSED):
            descriptor, address = self._accept()  # type: ignore[attr-defined]
            taken = _Connection(self.family, self.type, self.proto, fileno=descriptor)
            key = self.bound.enter(str(address[0]))
            if key is None:
                taken.close()
                continue
            taken.left = lambda key=key: self.bound.leave(key)
            return taken, address
        raise BlockingIOError("the connections that wait are beyond the bound; the loop comes back for the next")


class _Connection(socket.socket):
    """Connection that calls `left` once when it is closed or detached."""

    left: Callable[[], None] | None = None

    def close(self) -> None:
        """Close the connection and discount it."""
        super().close()
        left, self.left = self.left, None
        if left is not None:
            left()

    def detach(self) -> int:
        """Release the descriptor and discount the connection."""
        left, self.left = self.left, None
        if left is not None:
            left()
        return super().detach()
