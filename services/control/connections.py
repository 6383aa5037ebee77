"""A listening socket that takes a bounded number of connections from each address."""

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
"""Time between two lines in the log about refused connections."""
MOST_REFUSED = 64
"""Connections that one call closes before other work of the event loop goes on."""


class AddressBound:
    """Open connections of each address (of IPv6 each /64), and a bound on them. Any thread may use it."""

    def __init__(
        self,
        most: int,
        exempt: Sequence[str] = (),
        on_refused: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            most: connections of one address; 0: no bound.
            exempt: networks whose connections are not counted, those of trusted proxies. What a proxy says in X-Forwarded-For plays no part:
                connections are refused before anything is read.
            on_refused: called for each connection that is closed because its address has too many.
        """
        self._most, self._on_refused, self._clock = most, on_refused, clock
        self._exempt = [ipaddress.ip_network(each) for each in exempt]
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._said_s: float | None = None

    def enter(self, address: str) -> str | None:
        """Count a connection. Returns the key to leave with, or None for one too many."""
        key = "" if not self._most or self._is_exempt(address) else network_of_address(address)
        with self._lock:
            if key and self._open[key] >= self._most:
                self._on_refused()
                self._say(key)
                return None
            self._open[key] += 1
            return key

    def leave(self, key: str) -> None:
        """Forget a connection that has ended."""
        with self._lock:
            self._open[key] -= 1
            if self._open[key] <= 0:
                del self._open[key]

    def open(self, address: str) -> int:
        """Number of connections that an address has."""
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
    """A listening socket whose `accept` closes connections beyond the bound. asyncio accepts by this method, before TLS and before a request."""

    bound: AddressBound

    @classmethod
    def of(cls, listener: socket.socket, bound: AddressBound) -> BoundedListener:
        """Take over a listening socket."""
        made = cls(listener.family, listener.type, listener.proto, fileno=listener.detach())
        made.bound = bound
        return made

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection within the bound. Raises BlockingIOError where none waits, or after many that were refused."""
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
    """A connection that says once when it is closed, whoever closes it."""

    left: Callable[[], None] | None = None

    def close(self) -> None:
        """Close the connection and leave the count."""
        super().close()
        left, self.left = self.left, None
        if left is not None:
            left()

    def detach(self) -> int:
        """Give the descriptor away, and leave the count."""
        left, self.left = self.left, None
        if left is not None:
            left()
        return super().detach()
