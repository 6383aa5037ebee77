"""Frames as ZeroMQ messages: every kind of invalid message is refused before it is read."""

from __future__ import annotations

import numpy as np
import pytest

from operators.sources import zeromq_message as form
from operators.sources.zeromq_message import BadMessage

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
    return form.HEADER.pack(magic, version, bits, width, height, seq, pts_ns)


@pytest.mark.parametrize("left_out", [(), ("pose",), ("right_image", "mask"), ("right_image", "depth", "mask", "pose")])
def test_a_frame_comes_back_whole_and_in_pieces(left_out):
    given = {name: array for name, array in arrays().items() if name not in left_out}
    pieces = form.pieces(2**62 - 1, 1 - 2**62, given)
    for seq, pts_ns, found in (
        form.unpacked(memoryview(form.packed(2**62 - 1, 1 - 2**62, given))),
        form.unpacked_pieces([memoryview(piece) for piece in pieces]),
    ):
        assert (seq, pts_ns) == (2**62 - 1, 1 - 2**62) and set(found) == set(given)
        for name, array in given.items():
            np.testing.assert_array_equal(found[name], array)


def test_the_header_is_as_documented():
    data = form.packed(0x0102, -2, arrays() | {"pose": np.eye(4)})
    assert data[:16] == b"ISPF\x01\x00\x0f\x00\x03\x00\x00\x00\x02\x00\x00\x00"
    assert data[16:32] == b"\x02\x01" + bytes(6) + b"\xfe" + b"\xff" * 7
    assert len(data) == 32 + 18 + 18 + 24 + 6 + 128
    assert len(form.packed(0, 0, {"image": IMAGE})) == 50
    assert form.MOST_BYTES == 32 + 11 * 2**24 + 128


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (head()[:31], "31 bytes, less than a header"),
        (head(magic=b"ISPX") + bytes(18), "begins with b'ISPX'"),
        (head(version=2) + bytes(18), "version 2; 1 is read"),
        (head(version=0) + bytes(18), "version 0; 1 is read"),
        (head(bits=16) + bytes(18), "not known"),
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
def test_a_message_that_is_no_frame_is_refused(data, said):
    with pytest.raises(BadMessage, match=said):
        form.unpacked(memoryview(data))


@pytest.mark.parametrize(
    ("pieces", "said"),
    [
        ([], "no pieces"),
        ([head() + b"x"], "33 bytes in place of 32"),
        ([head()[:-1]], "31 bytes in place of 32"),
        ([head()], r"arrays have \[\] bytes; its header says \[18\]"),
        ([head(), bytes(17)], "17"),
        ([head(), bytes(18), b""], r"\[18, 0\]"),
    ],
)
def test_pieces_that_are_no_frame_are_refused(pieces, said):
    with pytest.raises(BadMessage, match=said):
        form.unpacked_pieces([memoryview(piece) for piece in pieces])


def test_arrays_that_do_not_fit_the_image_are_not_sent():
    with pytest.raises(ValueError, match=r"mask is \[3, 2\]; with this image it must be \[2, 3\]"):
        form.pieces(0, 0, {"image": IMAGE, "mask": np.ones((3, 2), np.uint8)})
    with pytest.raises(ValueError, match="0x2 px is not sent"):
        form.pieces(0, 0, {"image": IMAGE[:, :0]})
    wide = np.broadcast_to(np.uint8(0), (4096, 4097, 3))
    with pytest.raises(ValueError, match="4097x4096 px is not sent; at most 16777216"):
        form.pieces(0, 0, {"image": wide})
