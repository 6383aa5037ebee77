from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import zmq

from gsplat_core.io.frame_codec import encode
from gsplat_core.scene.frames import Frame
from services.bus.messages import (
    HIGH_WATER,
    MAX_PARTS,
    MOST_BYTES,
    PicturePublisher,
    packed_json,
    parsed_json,
    picture_from,
    split,
    subscribe,
)
from services.errors import BadMessage


@pytest.fixture
def context():
    with zmq.Context() as context:
        yield context


def picture(value: int, height: int = 4, width: int = 6) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def next_picture(socket: zmq.Socket):
    """Return the next picture, skipping late ones of `connect_readers`."""
    while socket.poll(300_000):
        picture = picture_from(socket.recv_multipart(copy=False))
        if picture.header["seq"] != -1:
            return picture
    pytest.fail("nothing came")


def connect_readers(publisher: PicturePublisher, *sockets: zmq.Socket) -> None:
    """Publish until every socket has received a picture, then empty the sockets."""
    for socket in sockets:
        while not socket.poll(10):
            publisher.publish({"seq": -1}, picture(0))
        while socket.poll(50):
            socket.recv_multipart()


def test_picture_and_frame_arrive_unchanged(runtime, context):
    endpoint = runtime.stream("a").pictures("engine")
    publisher = PicturePublisher(endpoint, context)
    with subscribe(context.socket(zmq.SUB), endpoint) as socket:
        connect_readers(publisher, socket)
        image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
        publisher.publish({"seq": 7, "state": "live"}, image[:, ::-1])
        got = next_picture(socket)
        assert (got.header["seq"], got.header["state"]) == (7, "live")
        np.testing.assert_array_equal(got.image, image[:, ::-1])
        publisher.publish_frame({"run": 3}, Frame(8, 5, image, mask=image[..., 0], arrived_ns=7))
        got = next_picture(socket)
        stated = {"seq": 8, "pts_ns": 5, "arrived_ns": 7, "damage": None, "status": "replay"}
        assert got.header == {"pixels": "frame", "run": 3, **stated}
        np.testing.assert_array_equal(got.image, image)
    publisher.close()


def test_subscriber_receives_from_later_publishers(runtime, context):
    endpoint = runtime.stream("a").pictures("engine")
    with subscribe(context.socket(zmq.SUB), endpoint) as socket:
        for value in (1, 2):  # the second one after the first has gone
            publisher = PicturePublisher(endpoint, context)
            connect_readers(publisher, socket)
            publisher.publish({"seq": value}, picture(value))
            assert next_picture(socket).header["seq"] == value
            publisher.close()


READER = """
import sys, zmq
from services.bus.messages import subscribe
socket = subscribe(zmq.Context.instance().socket(zmq.SUB), sys.argv[1])
socket.recv_multipart()
print("reads", flush=True)
while True:
    socket.recv_multipart()
"""


def test_stopped_reader_does_not_slow_other_reader(runtime, context):
    endpoint = runtime.stream("a").pictures("engine")
    publisher = PicturePublisher(endpoint, context)
    process = subprocess.Popen([sys.executable, "-c", READER, endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        image = np.zeros((512, 640, 3), np.uint8)
        while process.poll() is None and not select_line(process):
            publisher.publish({"seq": -1}, image)
        process.send_signal(signal.SIGSTOP)
        with subscribe(context.socket(zmq.SUB), endpoint) as socket:
            connect_readers(publisher, socket)
            for seq in range(40):
                publisher.publish({"seq": seq}, image)
                assert next_picture(socket).header["seq"] == seq
                time.sleep(0.005)  # no camera is so fast that ZeroMQ does not come to take note of what was read
    finally:
        process.kill()
        process.communicate()
        publisher.close()


def select_line(process: subprocess.Popen) -> bool:
    import select

    return bool(select.select([process.stdout], [], [], 0.01)[0])


def test_slow_reader_queues_few_pictures(runtime, context):
    endpoint = runtime.stream("a").pictures("engine")
    publisher = PicturePublisher(endpoint, context)
    with subscribe(context.socket(zmq.SUB), endpoint) as socket:
        connect_readers(publisher, socket)
        image = np.zeros((256, 320, 3), np.uint8)
        for seq in range(100):
            publisher.publish({"seq": seq}, image)
        waiting = 0
        while socket.poll(100 if waiting else 300_000):
            socket.recv_multipart()
            waiting += 1
        assert 0 < waiting <= 2 * HIGH_WATER + 8  # what the kernel holds besides
    publisher.close()


FRAME = [bytes(piece) for piece in encode(Frame(0, 0, np.zeros((2, 2, 3), np.uint8)))]


@pytest.mark.parametrize(
    "parts",
    [
        [b"{}"],
        [b"{}", b"", b""],
        [b"{}", b"123"],
        [pickle.dumps({}), b"123"],
        [b'{"pixels":"rgb","width_px":1,"height_px":2}', b"123"],
        [b'{"pixels":"rgb","width_px":-1,"height_px":-1}', b"123"],
        [b'{"pixels":"rgb","width_px":0,"height_px":0}', b""],
        [b'{"pixels":"rgb","width_px":true,"height_px":1}', b"123"],
        [b'{"pixels":"rgb","width_px":1e0,"height_px":1}', b"123"],
        [b'{"pixels":"frame"}', b"123"],
        [b'{"pixels":"frame"}', FRAME[0]],
        [b'{"pixels":"frame"}', FRAME[0], FRAME[1]],
        [b'{"pixels":"frame"}', FRAME[0], FRAME[1][:-1], FRAME[2]],
        [b'{"pixels":"frame"}', FRAME[0], FRAME[1], b"1234"],
        [b'{"pixels":"frame"}', *FRAME, b"{}"],
        [b'{"pixels":"frame"}', b"".join(FRAME)],
        [b'{"pixels":"frame"}', *[FRAME[1]] * 11],
        [b'{"pixels":"rgb","width_px":1,"height_px":1}', b"12", b"3"],
        [b'{"x":"' + b"y" * (1 << 17) + b'"}', b"123"],
    ],
    ids=lambda parts: repr(parts[0][:40]),
)
def test_picture_from_raises_for_malformed_message(parts):
    with pytest.raises(BadMessage):
        picture_from([zmq.Frame(part) for part in parts])


@pytest.mark.parametrize(("more", "is_read"), [(0, True), (1, False)])
def test_messages_and_headers_are_limited_to_most_bytes(more, is_read):
    """One byte more is refused by sender and reader."""
    text = {"text": "x" * (MOST_BYTES - len(packed_json({"text": ""})) + more)}
    data = b'{"text":"' + b"x" * (MOST_BYTES - len(b'{"text":""}') + more) + b'"}'
    assert len(data) == MOST_BYTES + more
    parts = [zmq.Frame(data), zmq.Frame(b"pixels")]
    if is_read:
        assert len(packed_json(text)) == MOST_BYTES
        assert parsed_json(data).keys() == split(parts)[0].keys() == {"text"}
        return
    for call, argument, said in (
        (packed_json, text, "is not sent"), (parsed_json, data, "is not read"), (split, parts, "at most 65536 are read"),
    ):  # fmt: skip
        with pytest.raises(BadMessage, match=said):
            call(argument)


@pytest.mark.parametrize(("count", "is_read"), [(1, False), (2, True), (MAX_PARTS, True), (MAX_PARTS + 1, False)])
def test_split_accepts_2_to_max_parts(count, is_read):
    parts = [zmq.Frame(b"{}"), *(zmq.Frame(b"x") for _ in range(count - 1))]
    if is_read:
        header, pixels = split(parts)
        assert header == {} and len(pixels) == count - 1
    else:
        with pytest.raises(BadMessage, match=f"this message {count}"):
            split(parts)
