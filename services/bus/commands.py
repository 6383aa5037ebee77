"""Commands to a process and its answers: one JSON object each way, with limits on size and time."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import zmq
import zmq.asyncio

from gsplat_core.errors import UserError
from services.bus.errors import BadMessage, BusError, CommandRefused, NoAnswer
from services.bus.messages import MOST_BYTES, packed_json, parsed_json

log = logging.getLogger(__name__)
LOOK_MS = 100
ANSWER_S = 2.0

Handler = Callable[[Mapping[str, Any]], Mapping[str, Any] | None]
"""Command handler: takes the arguments, returns the answer."""


def ask(endpoint: str, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any) -> dict[str, Any]:
    """Send a command and wait for the answer.

    Args:
        endpoint: ZeroMQ address of the process.
        command: name of the command.
        timeout_s: seconds to wait.
        arguments: arguments of the command.

    Raises:
        NoAnswer: if the process does not answer in time.
        CommandRefused: with the reason, if the process refuses.
    """
    socket = _to(endpoint, zmq.Context.instance())
    try:
        socket.send(packed_json({"command": command, **arguments}))
        if not socket.poll(round(timeout_s * 1000)):
            raise _silence(endpoint, command, timeout_s)
        return _accepted(socket.recv())
    finally:
        socket.close()


async def ask_async(endpoint: str, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any) -> dict[str, Any]:
    """Send a command like `ask`, in an event loop."""
    socket = _to(endpoint, zmq.asyncio.Context.instance())
    try:
        await socket.send(packed_json({"command": command, **arguments}))
        if not await socket.poll(round(timeout_s * 1000)):
            raise _silence(endpoint, command, timeout_s)
        return _accepted(await socket.recv())
    finally:
        socket.close()


def _to(endpoint: str, context: Any) -> Any:
    """Create a socket for one command."""
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
    socket.setsockopt(zmq.RECONNECT_IVL, 20)
    socket.connect(endpoint)
    return socket


def _silence(endpoint: str, command: str, timeout_s: float) -> NoAnswer:
    return NoAnswer(f"{endpoint} has not answered {command!r} within {timeout_s:g} s")


def _accepted(data: bytes) -> dict[str, Any]:
    answer = parsed_json(data)
    if answer.pop("ok", False) is not True:
        raise CommandRefused(str(answer.get("error", "it gave no reason")))
    return answer


class CommandServer:
    """Answers commands one at a time in its own thread."""

    def __init__(self, endpoint: str, handlers: Mapping[str, Handler]) -> None:
        self._handlers = handlers
        self.heard_s = time.monotonic()
        """Time of the last command."""
        self._stop = threading.Event()
        self._socket: zmq.Socket = zmq.Context.instance().socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 200)  # lets the answer to the stop command leave before the process ends
        self._socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
        self._socket.bind(endpoint)
        self._thread = threading.Thread(target=self._serve, name="commands", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering and remove the socket."""
        self._stop.set()
        self._thread.join()

    def _serve(self) -> None:
        while not self._stop.is_set():
            if not self._socket.poll(LOOK_MS):
                continue
            parts = self._socket.recv_multipart()
            self.heard_s = time.monotonic()
            answer = self._answer(b"".join(parts))
            self.heard_s = time.monotonic()
            self._socket.send(answer)
        self._socket.close()

    def _answer(self, data: bytes) -> bytes:
        try:
            request = parsed_json(data)
            name = request.pop("command", None)
            if name not in self._handlers:
                raise CommandRefused(f"there is no command {str(name)[:60]!r}; there are {', '.join(self._handlers)}")
            return packed_json({"ok": True, **(self._handlers[name](request) or {})})
        except (UserError, BusError) as error:
            return _refusal(str(error))
        except Exception as error:  # the client gets the error, and the process continues
            log.exception("command failed")
            return _refusal(f"{type(error).__name__}: {error}")


def _refusal(why: str) -> bytes:
    return packed_json({"ok": False, "error": why[:4000]})


def text_of(arguments: Mapping[str, Any], name: str) -> str:
    """Return a text argument.

    Raises:
        BadMessage: if the argument is missing, empty or no text.
    """
    value = arguments.get(name)
    if not isinstance(value, str) or not value:
        raise BadMessage(f"{name} is {value!r:.60}; it must be a text")
    return value
