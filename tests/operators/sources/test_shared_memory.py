"""Headers of shared memory are checked before any data is read."""

from __future__ import annotations

import os

import numpy as np
import pytest

from operators.sources.wire import BadHeader, FrameReader


@pytest.fixture
def reader():
    """A reader of 48 bytes: 0, 1, 2, …"""
    fd = os.memfd_create("frames")
    os.write(fd, bytes(range(48)))
    reader = FrameReader(fd)
    yield reader
    reader.close()
    os.close(fd)


def test_arrays_are_copied_from_where_they_lie(reader):
    found = reader.read([["image", 0, [2, 5, 3]], ["mask", 38, [2, 5]], ["depth", 8, [1, 2]]])
    np.testing.assert_array_equal(found["image"], np.arange(30, dtype=np.uint8).reshape(2, 5, 3))
    np.testing.assert_array_equal(found["mask"], np.arange(38, 48, dtype=np.uint8).reshape(2, 5))
    np.testing.assert_array_equal(found["depth"], np.frombuffer(bytes(range(8, 16)), np.float32).reshape(1, 2))
    found["image"][:] = 0
    assert reader.read([["image", 0, [2, 5, 3]]])["image"][0, 0, 1] == 1


@pytest.mark.parametrize(
    "found",
    [
        None,
        {},
        [],
        [["mask", 0, [1, 1]]] * 40,
        [["colour", 0, [1, 1]]],
        [["mask", 0, (1, 1)]],
        [["mask", 0, [1]]],
        [["mask", 0, [1, 1, 1]]],
        [["image", 0, [1, 1]]],
        [["image", 0, [1, 1, 4]]],
        [["pose", 0, [4, 3]]],
        [["mask", 0, [0, 1]]],
        [["mask", 0, [1, -1]]],
        [["mask", 0, [True, 1]]],
        [["mask", 0, [2**16, 2**16]]],
        [["mask", -1, [1, 1]]],
        [["mask", True, [1, 1]]],
        [["mask", 0.0, [1, 1]]],
        [["mask", 39, [2, 5]]],
        [["depth", 45, [1, 1]]],
        [["pose", 0, [4, 4]]],
    ],
)
def test_what_cannot_be_a_frame_or_lies_outside_is_refused(reader, found):
    with pytest.raises(BadHeader):
        reader.read(found)


def test_memory_that_has_grown_is_mapped_again(reader):
    reader.read([["mask", 0, [2, 5]]])
    os.lseek(reader._fd, 0, os.SEEK_END)
    os.write(reader._fd, bytes([7] * 16))
    assert reader.read([["mask", 48, [4, 4]]])["mask"].tolist() == [[7] * 4] * 4


def test_empty_memory_holds_no_frame():
    fd = os.memfd_create("empty")
    with pytest.raises(BadHeader, match="outside of the shared memory"):
        FrameReader(fd).read([["mask", 0, [1, 1]]])
    os.close(fd)
