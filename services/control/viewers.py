"""Viewer subscriptions: limited in number, ended with the viewer, the stream or the server."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import anyio
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketDisconnect

from services.control.auth.guard import still_valid
from services.control.auth.roles import Caller
from services.control.parts import EncodedPicture, PictureKind
from services.control.problems import Missing, Unavailable
from services.control.state import ControlState, control_of, part

log = logging.getLogger(__name__)
LOOK_S = 1.0
"""Seconds between two checks of a viewer's key."""
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
        Missing: if the stream does not exist.
    """
    control = control_of(connection)
    display = part(connection, lambda parts: parts.display, "a display")
    streams = part(connection, lambda parts: parts.streams, "streams")
    if all(each.name != stream for each in await streams.all()):
        raise Missing("there is no stream with this name; GET /v1/streams lists them")
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
    """Reason why a display ended; filled when the block ends."""

    refused: bool = False
    """The viewer's key was revoked or has expired."""


@asynccontextmanager
async def until_ended(
    connection: HTTPConnection, left: Coroutine[Any, Any, None], caller: Caller
) -> AsyncIterator[Ending]:
    """Run a block until the display has to end.

    The block is cancelled when the server drains, `left` returns, the connection breaks, or the
    caller's key becomes invalid.

    Args:
        connection: the viewer's connection.
        left: returns when the viewer has left.
        caller: checked every `LOOK_S`.

    Yields:
        The reason, readable after the block.

    Raises:
        ViewerStalled: if the connection accepts nothing more; waiting for the close would block
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
        await anyio.sleep(LOOK_S)
        try:
            if not await anyio.to_thread.run_sync(still_valid, control, caller):
                return
        except (OSError, ValueError, TypeError, KeyError) as error:
            log.warning("whether the key of %s is still valid is not known: %s", caller, error)
