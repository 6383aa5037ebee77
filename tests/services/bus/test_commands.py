from __future__ import annotations

import asyncio
import json

import pytest
import zmq

from gsplat_core.errors import InvalidSetting
from services.bus.messages import MOST_BYTES, CommandServer, ask, ask_async, text_of
from services.errors import BadMessage, CommandRefused, NoAnswer


def refuse(arguments):
    raise InvalidSetting("quality is 7; it must be 8")


def fail(arguments):
    raise RuntimeError("oh")


@pytest.fixture
def endpoint(runtime):
    where = runtime.stream("a").commands("engine")
    handlers = {
        "echo": dict,
        "silent": lambda _: None,
        "refuse": refuse,
        "fail": fail,
        "nan": lambda _: {"x": float("nan")},
    }
    server = CommandServer(where, handlers)
    yield where
    server.close()


def test_ask_returns_result_of_command_handler(endpoint):
    assert ask(endpoint, "echo", x=1, y="z") == {"x": 1, "y": "z"}
    assert ask(endpoint, "silent") == {}
    assert asyncio.run(ask_async(endpoint, "echo", x=2)) == {"x": 2}


@pytest.mark.parametrize(
    ("command", "why"),
    [("refuse", "it must be 8"), ("fail", "RuntimeError: oh"), ("nan", "JSON"), ("what", "echo, silent")],
)
def test_command_refused_states_reason_and_server_continues(endpoint, command, why):
    with pytest.raises(CommandRefused, match=why):
        ask(endpoint, command)
    with pytest.raises(CommandRefused, match=why):
        asyncio.run(ask_async(endpoint, command))
    assert ask(endpoint, "silent") == {}


def test_ask_raises_no_answer_after_timeout(runtime):
    nobody = runtime.stream("a").commands("capture")
    with pytest.raises(NoAnswer, match=r"'echo' within 0\.05 s"):
        ask(nobody, "echo", timeout_s=0.05)
    with pytest.raises(NoAnswer):
        asyncio.run(ask_async(nobody, "echo", timeout_s=0.05))


@pytest.mark.parametrize("data", [b"", b"nonsense", b"[]", b'{"command": 3}', b'{"command": ["echo"]}', b"\x80\x04."])
def test_command_server_refuses_malformed_requests(endpoint, data):
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.connect(endpoint)
        socket.send(data)
        assert json.loads(socket.recv())["ok"] is False


def test_oversized_commands_are_not_sent_or_read(endpoint):
    with pytest.raises(BadMessage):
        ask(endpoint, "echo", x="y" * MOST_BYTES)
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(endpoint)
        socket.send(b"x" * (MOST_BYTES + 1))
        assert not socket.poll(200)
    assert ask(endpoint, "silent") == {}


def test_text_of_raises_unless_non_empty_text():
    assert text_of({"folder": "x"}, "folder") == "x"
    for wrong in ({}, {"folder": 3}, {"folder": ""}):
        with pytest.raises(BadMessage, match="folder"):
            text_of(wrong, "folder")
