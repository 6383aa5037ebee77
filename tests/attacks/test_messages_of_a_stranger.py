"""ZeroMQ messages that are no frames or state a wrong size."""

from __future__ import annotations

import os
import pickle
import random
import struct
import threading
import time
import tracemalloc
from contextlib import contextmanager

import numpy as np
import pytest
import zmq

from gsplat_core.io import frame_codec
from gsplat_core.io.frame_codec import HEADER, InvalidMessage, decode, decode_message, encode, encode_message
from gsplat_core.scene.frames import Frame
from operators.sources import process, zeromq
from operators.sources.process import FrameReader, FrameWriter, new_memory, parsed
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import SourceDescription

GOOD = encode_message(1, 2, {"image": np.full((4, 6, 3), 5, np.uint8)})


@contextmanager
def opened(address):
    """Open a source, close it at exit."""
    source = open_source(address, SourceOptions(waiting=64))
    source.open()
    yield source
    source.close()


def next_frame(source):
    end = time.monotonic() + 300
    while (frame := source.read(0.1)) is None:
        assert time.monotonic() < end, source.state_sentence
    return frame


class Bomb:
    """Object that would create a file if it were unpickled."""

    def __reduce__(self):
        return (open, ("unpickled", "w"))


def header(magic=b"ISPF", version=1, bits=0, width=6, height=4, seq=0, pts=0):
    return HEADER.pack(magic, version, bits, width, height, seq, pts)


BAD = {
    "nothing": b"",
    "half a header": GOOD[:31],
    "a pickle": pickle.dumps(Bomb()),
    "another magic": header(magic=b"ISPG") + bytes(72),
    "another version": header(version=2) + bytes(72),
    "unknown arrays": header(bits=128) + bytes(72),
    "a confidence, which no other program sends": header(bits=16) + bytes(72 + 96),
    "fields, which no other program sends": header(bits=0x8000) + bytes(72) + b"{}",
    "no pixels": header(width=0) + bytes(72),
    "four thousand million pixels": header(width=2**32 - 1, height=2**32 - 1) + bytes(72),
    "sides whose product overflows": header(width=2**31, height=2) + bytes(72),
    "cut off": GOOD[:-1],
    "too long": GOOD + b"\x00",
    "a mask that is not there": header(bits=4) + bytes(72),
    "a number out of range": header(seq=2**64 - 1) + bytes(72),
    "a time out of range": header(pts=-(2**63)) + bytes(72),
}


@pytest.mark.parametrize("name", BAD)
def test_decode_message_refuses_malformed_data_without_allocating(name):
    tracemalloc.start()
    with pytest.raises(InvalidMessage):
        decode_message(memoryview(BAD[name]))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


@pytest.mark.parametrize("seed", range(5))
def test_decode_message_of_fuzzed_bytes_yields_valid_frame_or_raises(seed):
    rng = random.Random(seed)
    for _ in range(300):
        data = bytearray(GOOD)
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(40)] = rng.randrange(256)
        try:
            frame = decode_message(memoryview(bytes(data)))
        except InvalidMessage:
            continue
        assert frame.image.nbytes == len(data) - 32 and 0 <= frame.seq < 2**62 and abs(frame.pts_ns) < 2**62


def test_zeromq_source_skips_malformed_messages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        stop = threading.Event()

        def send():
            k = 0
            while not stop.wait(0.002):
                for bad in BAD.values():
                    socket.send(bad)
                socket.send_multipart([GOOD, GOOD])
                socket.send(encode_message(k, k * 10**7, {"image": np.full((4, 6, 3), 5, np.uint8)}))
                k += 1

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        try:
            with opened(f"zmq+tcp://127.0.0.1:{port}") as source:
                assert all((next_frame(source).image == 5).all() for _ in range(5))
                assert source.counts()["bad_messages"] > 5
        finally:
            stop.set()
            thread.join()
    assert not (tmp_path / "unpickled").exists()


@pytest.mark.slow
def test_zeromq_source_drops_oversized_message_and_reconnects(monkeypatch):
    monkeypatch.setattr("operators.sources.zeromq.MAX_MESSAGE_BYTES", 10_000)
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        stop = threading.Event()

        def send():
            k = 0
            while not stop.wait(0.005):
                socket.send(
                    bytes(20_000)
                    if k % 50 == 49
                    else encode_message(k, k * 10**7, {"image": np.zeros((4, 6, 3), np.uint8)})
                )
                k += 1

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        try:
            with opened(f"zmq+tcp://127.0.0.1:{port}") as source:
                while source.counts().get("reconnections", 0) < 1:
                    next_frame(source)
                assert next_frame(source).image.shape == (4, 6, 3), "the connection was made again"
                assert "bad_messages" not in source.counts()
        finally:
            stop.set()
            thread.join()


def test_frame_transport_modules_do_not_import_pickle():
    for module in (frame_codec, process, zeromq):
        assert "pickle" not in vars(module)


GOOD_PIECES = [bytes(piece) for piece in encode(Frame(1, 2, np.full((4, 6, 3), 5, np.uint8)))]


@pytest.mark.parametrize(
    ("offset", "sizes"),
    [
        (0, None),
        (0, []),
        (0, [32, 72, 2] * 9),
        (-64, [32, 72, 2]),
        (2**40, [32, 72, 2]),
        (10_000, [32, 72, 2]),
        (0.5, [32, 72, 2]),
        (0, [32, 2**61, 2]),
        (0, [32, 72]),
        (0, [32, 96, 2]),
        (0, [True, 72, 2]),
        (0, [32, 0, 2]),
        (0, "4x6"),
        (64, [32, 72, 2]),
    ],
)
def test_frame_reader_refuses_invalid_offset_and_sizes(offset, sizes):
    fd = new_memory()
    writer, reader = FrameWriter(fd), FrameReader(fd)
    writer.grow(GOOD_PIECES)
    assert decode(reader.read(**writer.write(0, GOOD_PIECES))).seq == 1
    with pytest.raises(InvalidMessage):
        decode(reader.read(offset, sizes))
    reader.close()
    os.close(fd)


@pytest.mark.parametrize("seed", range(5))
def test_decode_of_fuzzed_pieces_yields_valid_frame_or_raises(seed):
    rng = random.Random(seed)
    for _ in range(300):
        pieces = [bytearray(piece) for piece in GOOD_PIECES]
        for _ in range(rng.randint(1, 4)):
            piece = pieces[rng.choice((0, 2))]
            piece[rng.randrange(len(piece))] = rng.randrange(256)
        try:
            frame = decode([memoryview(piece) for piece in pieces])
        except InvalidMessage:
            continue
        assert frame.image.nbytes == 72 and 0 <= frame.seq < 2**62 and abs(frame.pts_ns) < 2**62


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b'{"kind": 3}', struct.pack("<I", 7), b"\xff\xfe", b'{"kind"'])
def test_parsed_refuses_malformed_process_message(data):
    with pytest.raises(InvalidMessage):
        parsed(data)


def test_source_description_from_json_refuses_incomplete_content():
    for content in (
        None,
        {},
        {"camera": {}},
        {"camera": {"fx": 1, "width_px": 1, "height_px": 1}, "fields": [], "notes": []},
    ):
        with pytest.raises(InvalidMessage):
            SourceDescription.from_json(content)
