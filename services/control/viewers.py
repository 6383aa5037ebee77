"""Viewers of a stream: a bounded number, each with a subscription that ends when the viewer, the stream or the server does."""

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
"""Time between two looks at a viewer's key."""
REFUSED = 1008
REFUSED_WHY = "the key was revoked or has expired"


class ViewerStalled(Exception):
    """A viewer takes no pictures any more."""


@asynccontextmanager
async def viewing(
    connection: HTTPConnection, transport: str, stream: str, kind: PictureKind, quality: int
) -> AsyncIterator[AsyncIterator[EncodedPicture]]:
    """The pictures for one viewer. Raises Unavailable when there are as many viewers as may be, Missing for a stream that is not there."""
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
    """`send`, which raises ViewerStalled when the viewer takes nothing for too long."""
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
    """Why a display has ended, once it has."""

    refused: bool = False
    """The viewer's key was revoked or has expired."""


@asynccontextmanager
async def until_ended(
    connection: HTTPConnection, left: Coroutine[Any, Any, None], caller: Caller
) -> AsyncIterator[Ending]:
    """A block that is left when the server drains, when `left` returns, when the viewer's connection breaks, and when the caller would not be
    let in any more. Raises ViewerStalled where nothing more can be sent: whoever waited for that would wait for ever."""
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
    """Return when the caller would be refused. A key file that cannot be read refuses nobody who was let in: an error of the disk must not end
    the pictures in a room, and no new caller gets in."""
    while True:
        await anyio.sleep(LOOK_S)
        try:
            if not await anyio.to_thread.run_sync(still_valid, control, caller):
                return
        except (OSError, ValueError, TypeError, KeyError) as error:
            log.warning("whether the key of %s is still valid is not known: %s", caller, error)
