"""By which names a server is asked: a page of another name that resolves to this machine (DNS rebinding) is none of its own."""

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
    """Middleware that answers 421 to a request for a host that is not this server.

    An address is always taken: a browser sends it only for a page that lies at this address. So is `localhost`, which no name server is
    asked for, and what the server listens on. Other names must be listed; with TLS and without a list the certificate says which they are.
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
        # Without one there is no browser behind it: HTTP/1.1 must send it, and a request without is refused before it comes here.
        if len(given) < 2 and all(self.knows(host) for host in given):
            return await self._app(scope, receive, send)
        self._measures.refused.labels("host").inc()
        if scope["type"] == "websocket":
            await receive()  # websocket.connect
            return await send({"type": "websocket.close", "code": 1008})  # before it is accepted: 403 to the client
        named = f"{', '.join(given):.100}"
        problem = Misdirected(
            f"this server is not known as {named!r}; ask for its address, or add the name to server.allowed_hosts"
        )
        await response_of(problem, scope)(scope, receive, send)

    def knows(self, host: str) -> bool:
        """Whether a Host header, in small letters, names this server."""
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
