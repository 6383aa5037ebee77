"""Message server for OpenIGTLink clients. Each client gets the newest message, and slow clients
delay no other client."""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading

from operators.errors import OutputError

log = logging.getLogger(__name__)
MOST_CLIENTS = 16
STALLED_S = 10.0
"""Seconds after which a client that accepts no data is dropped."""


class MessageServer:
    """Server that sends each client the newest message once the previous one is sent."""

    def __init__(self, host: str, port: int) -> None:
        """Listen at an address.

        Raises:
            OutputError: if that fails.
        """
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise OutputError(
                f"{host}:{port} cannot be listened on: {error.strerror or error}; choose another --port"
            ) from error
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._changed = threading.Condition()
        self._message, self._number = b"", 0
        self._clients: set[socket.socket] = set()
        self._closed = False
        self._accepting = threading.Thread(target=self._accept, name="igtl listen", daemon=True)
        self._accepting.start()

    @property
    def clients(self) -> int:
        """Return the number of connected clients."""
        with self._changed:
            return len(self._clients)

    def send(self, message: bytes) -> None:
        """Set the newest message; returns at once."""
        with self._changed:
            self._message, self._number = message, self._number + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Disconnect all clients."""
        with self._changed:
            self._closed = True
            clients = list(self._clients)
            self._changed.notify_all()
        for client in [self._listener, *clients]:
            with contextlib.suppress(OSError):  # already disconnected
                client.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._accepting.join()

    def _accept(self) -> None:
        while True:
            try:
                client, address = self._listener.accept()
            except OSError:
                return  # closed
            with self._changed:
                full = self._closed or len(self._clients) >= MOST_CLIENTS
                if not full:
                    self._clients.add(client)
            if full:
                client.close()
                continue
            log.info("%s is connected", address[0])
            threading.Thread(target=self._serve, args=(client,), name="igtl client", daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(STALLED_S)
        sent = 0
        try:
            while (waiting := self._newer_than(sent, client)) is not None:
                sent, message = waiting
                if message:
                    client.sendall(message)
        except OSError as error:
            log.info("a client has left: %s", error)
        finally:
            with self._changed:
                self._clients.discard(client)
            client.close()

    def _newer_than(self, sent: int, client: socket.socket) -> tuple[int, bytes] | None:
        """Return the newest message and its number. Empty after a timeout; None if the client has
        left or the server closes."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._number > sent, 0.5)
            if self._closed:
                return None
            found = (self._number, self._message) if self._number > sent else (sent, b"")
        return None if _has_left(client) else found


def _has_left(client: socket.socket) -> bool:
    """Return True if the client has closed the connection. Received data, such as requests, is
    discarded."""
    while select.select([client], [], [], 0)[0]:
        if not client.recv(65536):
            return True
    return False
