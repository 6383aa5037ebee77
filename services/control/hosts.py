"""Host header check against DNS rebinding (a foreign name that resolves to this machine)."""

from __future__ import annotations

import ipaddress
import re
from fnmatch import fnmatchcase

from starlette.types import ASGIApp, Receive, Scope, Send

from services.control.answers import response_of
from services.control.measures import Measures
from services.control.problems import Misdirected
from services.settings.sections import ServerSettings

_HOST = re.compile(r"(?P<name>[a-z0-9._-]{1,253}|\[[0-9a-f:.]{2,45}\])(:\d{1,5})?")


class KnownHosts:
    """Middleware that answers 421 to a request for an unknown host.

    IP addresses are always accepted, because a browser sends one only for a page served from that
    address. `localhost` and `server.host` are accepted too. Other names must be in
    `server.allowed_hosts`. With TLS and an empty list every name is accepted, because the
    certificate restricts the names.
    """

    def __init__(self, app: ASGIApp, server: ServerSettings, measures: Measures) -> None:
        self._app = app
        self._measures = measures
        self._any_name = server.certfile is not None and not server.allowed_hosts
        self._names = {"localhost", server.host.lower(), *server.allowed_hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        given = [value.decode("latin-1").lower() for name, value in scope["headers"] if name == b"host"]
        # A request without a Host header does not come from a browser: HTTP/1.1 requires the
        # header, and the parser refuses such requests.
        if len(given) < 2 and all(self.knows(host) for host in given):
            return await self._app(scope, receive, send)
        self._measures.refused.labels("host").inc()
        if scope["type"] == "websocket":
            await receive()  # websocket.connect
            return await send({"type": "websocket.close", "code": 1008})  # before accept: the client gets 403
        named = f"{', '.join(given):.100}"
        problem = Misdirected(
            f"this server is not known as {named!r}; ask for its address, or add the name to server.allowed_hosts"
        )
        await response_of(problem, scope)(scope, receive, send)

    def knows(self, host: str) -> bool:
        """Return True if a lower-case Host header names this server."""
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = match["name"]
        return self._any_name or _is_address(name) or any(fnmatchcase(name.rstrip("."), each) for each in self._names)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True
