"""The service itself: liveness, readiness, version, settings in force and metrics, and a listener that answers probes when the main port is at its
connection limit.
"""

from __future__ import annotations

import asyncio
import errno
import json
import os
import platform
import socket
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AsyncExitStack
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs

import fastapi
from fastapi import Query, Response
from prometheus_client.exposition import choose_encoder
from starlette.requests import Request

from services.api.guard import new_router, requires
from services.api.state import KEYS_UNREADABLE, ControlState, control_of
from services.auth.keys import KeysUnreadable
from services.errors import CannotServe
from services.schemas import Alive, CheckResult, Readiness, Version
from services.settings import ServiceSettings

CHECK_TIMEOUT_S = 2.0


async def readiness(control: ControlState, *, verbose: bool) -> Readiness:
    """Run every health check concurrently.

    Args:
        control: state of the application.
        verbose: include the result of each check.
    """
    checks = await _results(control)
    status: Literal["ready", "degraded", "not ready"] = "ready" if all(c.ok for c in checks.values()) else "degraded"
    if any(check.needed and not check.ok for check in checks.values()):
        status = "not ready"
    return Readiness(status=status, checks=checks if verbose else None)


async def _results(control: ControlState) -> dict[str, CheckResult]:
    checks: dict[str, Callable[[], Awaitable[CheckResult]]] = {
        "disk": control.storage.disk,
        "audit": control.storage.audit,
        "keys": partial(_keys, control),
        **control.parts.checks,
    }
    results = await asyncio.gather(*(_result(check) for check in checks.values()))
    draining = control.draining.is_set()
    return {
        "server": CheckResult(not draining, "draining" if draining else "accepting requests"),
        **dict(zip(checks, results, strict=True)),
    }


async def _keys(control: ControlState) -> CheckResult:
    try:
        await asyncio.to_thread(control.keys.all)
    except KeysUnreadable:
        return CheckResult(False, KEYS_UNREADABLE)
    return CheckResult(True, "their file can be read")


async def _result(check: Callable[[], Awaitable[CheckResult]]) -> CheckResult:
    try:
        async with asyncio.timeout(CHECK_TIMEOUT_S):
            return await check()
    except TimeoutError:
        return CheckResult(False, f"no answer within {CHECK_TIMEOUT_S:g} s")


router = new_router("health", prefix="")


@router.head("/livez", include_in_schema=False)
@router.get("/livez")
@requires("public")
async def live() -> Alive:
    """Confirm that the process answers. Nothing else is checked: a lost camera does not justify a restart."""
    return Alive()


@router.head("/readyz", include_in_schema=False)
@router.get("/readyz", response_model_exclude_none=True, responses={503: {"model": Readiness}})
@requires("public")
async def ready(
    request: Request,
    response: Response,
    verbose: str | None = Query(
        None,
        max_length=8,
        description="If present, with or without a value, the answer contains the result of each check.",
    ),
) -> Readiness:
    """Report readiness: 503 while the server drains or a required part is unhealthy."""
    found = await readiness(control_of(request), verbose=verbose is not None)
    if found.status == "not ready":
        response.status_code = 503
    return found


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
@requires("viewer")
async def metrics(request: Request) -> Response:
    """Return the metrics. Give Prometheus a key with the role viewer (`authorization: credentials_file`)."""
    encode, content_type = choose_encoder(request.headers.get("accept", ""))
    body = await asyncio.to_thread(encode, control_of(request).measures.registry)
    return Response(body, headers={"Content-Type": content_type})


service_router = new_router("service")


@service_router.get("/version")
@requires("viewer", scope="any")
async def version(request: Request) -> Version:
    """Return the versions of the server, Python and FastAPI, and the available parts."""
    parts = control_of(request).parts
    here = [name for name in ("streams", "models", "display", "jobs", "recordings") if getattr(parts, name) is not None]
    return Version(
        version=request.app.version, python=platform.python_version(), fastapi=fastapi.__version__, parts=here
    )


@service_router.get("/config")
@requires("admin")
async def config(request: Request) -> dict[str, Any]:
    """Return the settings of this server, with secrets masked."""
    return control_of(request).settings.shown()


@service_router.get("/config/schema")
@requires("viewer")
async def config_schema() -> dict[str, Any]:
    """Return the JSON schema of the settings file."""
    return ServiceSettings.model_json_schema()


SOCKET = "probe.sock"
MOST_CONNECTIONS = 32
MOST_HEAD_BYTES = 4096
REQUEST_S = 2.0


class ProbeListener:
    """Probe server on the sockets of `bind_probe`. Runs in the event loop that calls `open`."""

    def __init__(self, control: ControlState, sockets: Sequence[socket.socket]) -> None:
        self._control, self._sockets = control, sockets
        self._servers: list[asyncio.Server] = []
        self._open: dict[asyncio.Task[Any], asyncio.StreamWriter] = {}

    async def open(self) -> None:
        """Start answering."""
        for each in self._sockets:
            self._servers.append(await asyncio.start_server(self._serve, sock=each, limit=MOST_HEAD_BYTES))

    async def close(self) -> None:
        """Stop answering and remove the Unix socket."""
        for each in self._sockets:
            if each.family == socket.AF_UNIX:
                Path(each.getsockname()).unlink(missing_ok=True)
        for server in self._servers:
            server.close()
        for task in list(self._open):
            task.cancel()
        await asyncio.gather(*self._open, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if len(self._open) >= MOST_CONNECTIONS:
            next(iter(self._open)).cancel()
        self._open[task] = writer
        try:
            async with AsyncExitStack() as ending:
                ending.callback(writer.close)
                async with asyncio.timeout(REQUEST_S):
                    head = await reader.readuntil(b"\r\n\r\n")
                writer.write(await self._answer(head))
                async with asyncio.timeout(REQUEST_S):
                    await writer.drain()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            return  # slow, gone, or too long: no client to answer
        except asyncio.CancelledError:
            return  # evicted by a newer connection, or server shutdown
        finally:
            self._open.pop(task, None)

    async def _answer(self, head: bytes) -> bytes:
        method, _, rest = head.partition(b"\r\n")[0].decode("latin-1").partition(" ")
        path, _, query = rest.partition(" ")[0].partition("?")
        if method not in ("GET", "HEAD"):
            return _response(405, {"status": "only GET is answered here"}, method)
        if path == "/livez":
            return _response(200, {"status": "alive"}, method)
        if path == "/readyz":
            ready = await readiness(self._control, verbose="verbose" in parse_qs(query, keep_blank_values=True))
            status = 503 if ready.status == "not ready" else 200
            return _response(status, ready.model_dump(mode="json", exclude_none=True), method)
        return _response(404, {"status": "only /livez and /readyz are here"}, method)


def bind_probe(settings: ServiceSettings) -> list[socket.socket]:
    """Bind the sockets of the probe listener. The runtime folder must exist.

    Raises:
        CannotServe: if another program uses the port or the socket.
    """
    path = settings.runtime_dir / SOCKET
    bound = [_unix(path)]
    server = settings.server
    if server.probe_port is not None:
        family = socket.AF_INET6 if ":" in server.probe_host else socket.AF_INET
        try:
            bound.append(socket.create_server((server.probe_host, server.probe_port), family=family, backlog=64))
        except OSError as error:
            bound[0].close()
            path.unlink(missing_ok=True)
            raise CannotServe(
                f"cannot listen on {server.probe_host} port {server.probe_port}: {error.strerror}; give another server.probe_port, or none"
            ) from error
    return bound


async def probe_socket_is_there(settings: ServiceSettings) -> CheckResult:
    """Check that the runtime folder with the Unix socket of `bind_probe` was not removed while the service runs."""
    if (settings.runtime_dir / SOCKET).exists():
        return CheckResult(True, f"{SOCKET} is there", needed=False)
    return CheckResult(
        False,
        f"the runtime folder or its {SOCKET} was removed; restart the service when no stream is needed",
        needed=False,
    )


def _unix(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if _answers(path):
            raise CannotServe(f"another service listens at {path}; end it, or choose another paths.runtime")
        path.unlink(missing_ok=True)
        listener.bind(os.fspath(path))
        listener.listen(64)
    except OSError as error:
        listener.close()
        raise CannotServe(
            f"cannot listen at {path}: {error.strerror or error}; choose another paths.runtime"
        ) from error
    except CannotServe:
        listener.close()
        raise
    return listener


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.setblocking(False)
        try:
            client.connect(os.fspath(path))
        except OSError as error:
            return error.errno == errno.EAGAIN  # a busy listener exists
        return True


def _response(status: int, body: dict[str, Any], method: str) -> bytes:
    content = json.dumps(body).encode()
    head = (
        f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\nContent-Type: application/json\r\nContent-Length: {len(content)}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + (b"" if method == "HEAD" else content)
