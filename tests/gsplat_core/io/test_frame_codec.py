"""Frames as bytes: every field survives, and invalid bytes are refused before memory is allocated."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.io import frame_codec as codec
from gsplat_core.io.frame_codec import InvalidMessage, decode, decode_message, encode, encode_message
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from tests.gsplat_core.io.sessions.made import new_frame, same_frame

IMAGE = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)


def arrays():
    return {
        "image": IMAGE,
        "right_image": IMAGE[::-1],
        "depth": np.arange(6, dtype=np.float32).reshape(2, 3),
        "mask": np.ones((2, 3), np.uint8),
        "pose": np.eye(4),
    }


def head(magic=b"ISPF", version=1, bits=0, width=3, height=2, seq=7, pts_ns=8):
    return codec.HEADER.pack(magic, version, bits, width, height, seq, pts_ns)


@pytest.mark.parametrize("left_out", [(), ("pose",), ("right_image", "mask"), ("right_image", "depth", "mask", "pose")])
def test_encode_message_round_trip(left_out):
    given = {name: array for name, array in arrays().items() if name not in left_out}
    frame = decode_message(memoryview(encode_message(2**62 - 1, 1 - 2**62, given)), arrived_ns=5)
    assert (frame.seq, frame.pts_ns, frame.arrived_ns) == (2**62 - 1, 1 - 2**62, 5)
    for name in arrays():
        np.testing.assert_array_equal(getattr(frame, name), given.get(name))


def copies(frame):
    return [memoryview(bytes(piece)) for piece in encode(frame)]


@pytest.mark.parametrize("seq", range(6))
def test_encode_frame_round_trip_of_all_fields(seq):
    frame = new_frame(seq, status=list(FrameStatus)[seq % 4], damage="torn" if seq % 2 else None)
    back = decode(copies(frame))
    assert same_frame(frame, back) and (frame.arrived_ns, frame.status) == (back.arrived_ns, back.status)
    plain = Frame(seq, -seq, IMAGE)
    assert same_frame(plain, decode(copies(plain)))


def test_encode_does_not_copy_contiguous_arrays():
    frame = Frame(0, 0, IMAGE)
    assert np.shares_memory(np.frombuffer(encode(frame)[1], np.uint8), IMAGE)
    turned = Frame(0, 0, IMAGE[:, ::-1])
    np.testing.assert_array_equal(decode(copies(turned)).image, IMAGE[:, ::-1])


def test_message_header_layout():
    data = encode_message(0x0102, -2, arrays() | {"pose": np.eye(4)})
    assert data[:16] == b"ISPF\x01\x00\x0f\x00\x03\x00\x00\x00\x02\x00\x00\x00"
    assert data[16:32] == b"\x02\x01" + bytes(6) + b"\xfe" + b"\xff" * 7
    assert len(data) == 32 + 18 + 18 + 24 + 6 + 128
    assert len(encode_message(0, 0, {"image": IMAGE})) == 50
    assert codec.MAX_MESSAGE_BYTES == 32 + 11 * 2**24 + 128


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (head()[:31], "31 bytes, less than a header"),
        (head(magic=b"ISPX") + bytes(18), "begins with b'ISPX'"),
        (head(version=2) + bytes(18), "version 2; 1 is read"),
        (head(version=0) + bytes(18), "version 0; 1 is read"),
        (head(bits=16) + bytes(18), "not known"),
        (head(bits=0x8000) + bytes(18) + b"{}", "fields, which are not read"),
        (head(width=0), "0x2 px"),
        (head(height=0), "3x0 px"),
        (head(width=4097, height=4096), "4097x4096 px; at most 16777216"),
        (head(seq=2**62) + bytes(18), "out of range"),
        (head(pts_ns=2**62) + bytes(18), "out of range"),
        (head(pts_ns=-(2**62)) + bytes(18), "out of range"),
        (head() + bytes(17), "ends within image: it has 49 bytes"),
        (head(bits=4) + bytes(23), "ends within mask"),
        (head() + bytes(19), "it has 51 bytes; its header says 50"),
    ],
)
def test_decode_message_refuses_invalid_bytes(data, said):
    with pytest.raises(InvalidMessage, match=said):
        decode_message(memoryview(data))


FIELDS = 0x8000


@pytest.mark.parametrize(
    ("pieces", "said"),
    [
        ([], "no pieces"),
        ([head(bits=FIELDS) + b"x"], "33 bytes in place of 32"),
        ([head(bits=FIELDS)[:-1]], "31 bytes in place of 32"),
        ([head(), bytes(18)], "announces no fields"),
        ([head(bits=FIELDS)], r"pieces have \[\] bytes; its header announces arrays of \[18\] bytes"),
        ([head(bits=FIELDS), bytes(18)], r"pieces have \[18\] bytes"),
        ([head(bits=FIELDS), bytes(17), b"{}"], "17"),
        ([head(bits=FIELDS), bytes(18), b"", b"{}"], r"\[18, 0, 2\]"),
        ([head(bits=FIELDS | 128), bytes(18), b"{}"], "not known"),
        ([head(bits=FIELDS, width=8193, height=8192), bytes(18), b"{}"], "8193x8192 px; at most 67108864"),
        ([head(bits=FIELDS), bytes(18), b"{}" + b" " * (1 << 16)], "its fields have 65538 bytes"),
        ([head(bits=FIELDS), bytes(18), b"{"], "not those of a frame"),
        ([head(bits=FIELDS), bytes(18), b"[]"], "not those of a frame"),
    ],
)
def test_decode_refuses_invalid_pieces(pieces, said):
    with pytest.raises(InvalidMessage, match=said):
        decode([memoryview(piece) for piece in pieces])


@pytest.mark.parametrize(
    "fields",
    [
        '{"damage":3}', '{"arrived_ns":1.5}', '{"arrived_ns":true}', '{"arrived_ns":4611686018427387905}', '{"status":"asleep"}',
        '{"depth_origin":"guess"}', '{"right_camera":{"fx":1}}', '{"right_camera":4}', 
        '{"withheld":"' + 1001 * "x" + '"}', '{"new_scene":[]}',
    ],
)  # fmt: skip
def test_decode_refuses_invalid_fields(fields):
    with pytest.raises(InvalidMessage, match="not those of a frame"):
        decode([memoryview(piece) for piece in (head(bits=FIELDS), bytes(18), fields.encode())])


def test_decode_refuses_right_camera_of_other_size():
    pieces = copies(Frame(0, 0, IMAGE, right_camera=Camera.from_focal(30.0, 3, 2)))
    wider = bytes(pieces[-1]).replace(b'"width_px":3', b'"width_px":4')
    with pytest.raises(InvalidMessage, match="right camera is 4x2"):
        decode([*pieces[:-1], memoryview(wider)])


def test_decode_truncates_long_texts():
    assert decode(copies(Frame(0, 0, IMAGE, damage="x" * 5000))).damage == "x" * 1000


def test_encode_message_refuses_arrays_of_wrong_size():
    with pytest.raises(ValueError, match=r"mask is \[3, 2\]; with this image it must be \[2, 3\]"):
        encode_message(0, 0, {"image": IMAGE, "mask": np.ones((3, 2), np.uint8)})
    with pytest.raises(ValueError, match="0x2 px is not sent"):
        encode_message(0, 0, {"image": IMAGE[:, :0]})
    wide = np.broadcast_to(np.uint8(0), (4096, 4097, 3))
    with pytest.raises(ValueError, match="4097x4096 px is not sent; at most 16777216"):
        encode_message(0, 0, {"image": wide})
