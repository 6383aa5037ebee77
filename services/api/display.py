"""Live pictures of a stream: by WebSocket with metadata, or as MJPEG for browsers and players.

Viewer subscriptions are limited in number, and end with the viewer, the stream or the server.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Annotated, Any

import anyio
from fastapi import Path, Query
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from services.api.guard import CallerOf, new_router, requires, still_valid
from services.api.problems import Unavailable, problem_answer
from services.api.state import ControlState, control_of, part
from services.auth.keys import Caller
from services.display import BOUNDARY, EncodedPicture, PictureKind
from services.settings import ResourceName

log = logging.getLogger(__name__)
POLL_S = 1.0
"""Interval in seconds at which an open display checks that its viewer's key is still valid."""
REFUSED = 1008
REFUSED_WHY = "the key was revoked or has expired"


class ViewerStalled(Exception):
    """The viewer's connection accepts no more pictures."""


@asynccontextmanager
async def viewing(
    connection: HTTPConnection, transport: str, stream: str, kind: PictureKind, quality: int
) -> AsyncIterator[AsyncIterator[EncodedPicture]]:
    """Subscribe a viewer to a stream.

    Args:
        connection: the viewer's connection.
        transport: metrics label.
        stream: name of the stream.
        kind: picture to send.
        quality: JPEG quality.

    Yields:
        The pictures.

    Raises:
        Unavailable: if the limit on open displays is reached.
        NotFound: if the stream does not exist.
    """
    control = control_of(connection)
    display = part(connection, lambda parts: parts.display, "a display")
    streams = part(connection, lambda parts: parts.streams, "streams")
    streams.get(stream)
    gauge = control.measures.viewers.labels(transport)
    if control.viewers.full:
        raise Unavailable(f"{control.settings.limits.viewers} displays are open, which is as many as may be; close one")
    with control.viewers.one_more(), gauge.track_inprogress():
        async with display.subscribe(stream, kind, quality) as pictures:
            yield pictures


def in_time(send: Callable[[Any], Awaitable[None]], connection: HTTPConnection) -> Callable[[Any], Awaitable[None]]:
    """Wrap `send` with a timeout of `limits.viewer_stall_s`; the wrapper raises ViewerStalled."""
    control = control_of(connection)
    stall_s = control.settings.limits.viewer_stall_s

    async def send_in_time(message: Any) -> None:
        with anyio.move_on_after(stall_s) as waiting:
            await send(message)
        if waiting.cancelled_caught:
            control.measures.viewers_dropped.labels("stalled").inc()
            raise ViewerStalled(f"a viewer took nothing for {stall_s:g} s")

    return send_in_time


@dataclass
class Ending:
    """Reason for the end of a display, readable once the block of `until_ended` has ended."""

    refused: bool = False
    """True if the display ended because the viewer's key was revoked or has expired."""


@asynccontextmanager
async def until_ended(
    connection: HTTPConnection, left: Coroutine[Any, Any, None], caller: Caller
) -> AsyncIterator[Ending]:
    """Run a block that sends pictures until its viewer gets no more.

    The block is cancelled when the server drains, `left` returns, the connection breaks, or the caller's key becomes
    invalid.

    Args:
        connection: the viewer's connection.
        left: coroutine that returns when the viewer disconnects.
        caller: checked every `POLL_S`.

    Yields:
        The reason, readable after the block.

    Raises:
        ViewerStalled: if the connection accepts no more data, so that waiting for its orderly close would block
        forever.
    """
    control = control_of(connection)
    stalled: ViewerStalled | None = None
    ending = Ending()
    async with anyio.create_task_group() as group:

        async def end_after(over: Coroutine[Any, Any, Any]) -> None:
            await over
            group.cancel_scope.cancel()

        async def refused() -> None:
            await _no_longer_admitted(control, caller)
            ending.refused = True
            control.measures.viewers_dropped.labels("not admitted").inc()
            log.info("a display of %s was closed: its key was revoked or has expired", caller)

        group.start_soon(end_after, control.draining.wait())
        group.start_soon(end_after, left)
        group.start_soon(end_after, refused())
        try:
            yield ending
        except ViewerStalled as error:
            stalled = error
        except (WebSocketDisconnect, OSError) as error:
            log.info("a viewer's connection broke: %s", error or type(error).__name__)
        group.cancel_scope.cancel()
    if stalled is not None:
        log.info("a viewer was dropped: %s", stalled)
        raise stalled


async def _no_longer_admitted(control: ControlState, caller: Caller) -> None:
    """Return once the caller's key is revoked or expired.

    An unreadable key file does not end running displays: a disk error must not interrupt the
    pictures during a procedure. New callers are still refused.
    """
    while True:
        await anyio.sleep(POLL_S)
        try:
            if not await anyio.to_thread.run_sync(still_valid, control, caller):
                return
        except (OSError, ValueError, TypeError, KeyError) as error:
            log.warning("whether the key of %s is still valid is not known: %s", caller, error)


router = new_router("display")
Kind = Annotated[
    PictureKind,
    Query(
        description="Picture to receive: the camera's frame (`raw`), the reconstruction (`shown`), its depth map (`depth`), "
        "its confidence map (`confidence`), or the view of the stream's virtual camera (`orbit`). The last three "
        "are rendered only while they have viewers."
    ),
]
Quality = Annotated[int, Query(ge=10, le=95, description="JPEG quality.")]
GOING_AWAY = 1001
CLOSE_S = 1.0
"""Seconds that a viewer may take to receive the close message."""


@router.websocket("/streams/{name}/display")
@requires("viewer", ticket=True, scope="stream")
async def display(
    socket: WebSocket,
    caller: CallerOf,
    name: Annotated[ResourceName, Path()],
    kind: Kind = "shown",
    quality: Quality = 75,
) -> None:
    """Send pictures as binary WebSocket messages. A slow viewer skips pictures."""
    async with viewing(socket, "websocket", name, kind, quality) as pictures:
        await socket.accept()
        send = in_time(socket.send_bytes, socket)
        with suppress(ViewerStalled):  # the server closes the connection, and the kernel cuts it off
            async with until_ended(socket, _left(socket), caller) as ending:
                async for picture in pictures:
                    await send(picture.message)
            if socket.client_state is WebSocketState.CONNECTED and socket.application_state is WebSocketState.CONNECTED:
                with anyio.move_on_after(CLOSE_S):
                    if ending.refused:
                        await socket.close(REFUSED, REFUSED_WHY)
                    else:
                        await socket.close(GOING_AWAY, "the stream or the server has ended")


async def _left(socket: WebSocket) -> None:
    """Discard messages from the viewer until it disconnects."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


@router.get(
    "/streams/{name}/mjpeg",
    response_class=Response,
    responses={
        200: {"content": {f"multipart/x-mixed-replace; boundary={BOUNDARY}": {}}},
        409: problem_answer("The stream is stopped."),
    },
)
@requires("viewer", ticket=True, scope="stream")
async def mjpeg(
    request: Request, caller: CallerOf, name: ResourceName, kind: Kind = "shown", quality: Quality = 75
) -> Response:
    """Send pictures as `multipart/x-mixed-replace`, for an `<img>` element."""
    opened = AsyncExitStack()
    pictures = await opened.enter_async_context(viewing(request, "mjpeg", name, kind, quality))
    return MjpegResponse(request, caller, pictures, opened)


class MjpegResponse(Response):
    """MJPEG response that ends when the viewer leaves or stalls, its key becomes invalid, or the server drains. The
    subscription is then closed."""

    media_type = f"multipart/x-mixed-replace; boundary={BOUNDARY}"

    def __init__(
        self, request: Request, caller: Caller, pictures: AsyncIterator[EncodedPicture], opened: AsyncExitStack
    ) -> None:
        super().__init__()
        del self.headers["content-length"]
        self._request, self._caller = request, caller
        self._pictures = pictures
        self._opened = opened

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async with self._opened:
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            send_part = in_time(send, self._request)
            with suppress(ViewerStalled):
                async with until_ended(self._request, _hung_up(receive), self._caller):
                    async for picture in self._pictures:
                        await send_part({"type": "http.response.body", "body": picture.part, "more_body": True})
                with anyio.move_on_after(CLOSE_S):
                    await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _hung_up(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
