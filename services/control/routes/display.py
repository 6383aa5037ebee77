"""Live pictures of a stream: by WebSocket with metadata, or as MJPEG for browsers and players."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, suppress
from typing import Annotated

import anyio
from fastapi import Path, Query
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketState

from services.control.auth.guard import CallerOf, new_router, requires
from services.control.auth.roles import Caller
from services.control.parts import BOUNDARY, EncodedPicture, PictureKind
from services.control.problems import problem_answer
from services.control.viewers import REFUSED, REFUSED_WHY, ViewerStalled, in_time, until_ended, viewing
from services.settings import ResourceName

router = new_router("display")
Kind = Annotated[
    PictureKind,
    Query(
        description="The camera's picture (`raw`), what is shown in its place (`shown`), or of that the depth, the confidence, and the view of the"
        " stream's virtual camera (`orbit`), which are drawn while somebody watches them."
    ),
]
Quality = Annotated[int, Query(ge=10, le=95, description="Of the JPEG.")]
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
    """MJPEG response that ends when the viewer leaves or stalls, or the server drains. The
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
