"""Positions in shared memory are checked before any data is read."""

from __future__ import annotations

import os

import pytest

from gsplat_core.io.frame_codec import InvalidMessage
from operators.sources.process import FrameReader, FrameWriter, new_memory


@pytest.fixture
def memory():
    fd = new_memory()
    yield fd
    os.close(fd)


@pytest.fixture
def reader(memory):
    """A reader of 192 bytes: 0, 1, 2, …"""
    os.write(memory, bytes(range(192)))
    reader = FrameReader(memory)
    yield reader
    reader.close()


def test_frame_reader_returns_aligned_pieces_as_copies(reader):
    first, second, third = reader.read(0, [5, 64, 3])
    assert (bytes(first), bytes(second), bytes(third)) == (
        bytes(range(5)),
        bytes(range(64, 128)),
        bytes(range(128, 131)),
    )
    first[0] = 9
    assert reader.read(0, [5])[0][0] == 0


@pytest.mark.parametrize(
    ("offset", "sizes"),
    [
        (0, None),
        (0, {}),
        (0, []),
        (0, [1] * 40),
        (0, (1, 1)),
        (0, [0]),
        (0, [5, -1]),
        (0, [True]),
        (0, [1.0]),
        (0, ["5"]),
        (0, [2**62]),
        (-1, [1]),
        (True, [1]),
        (0.0, [1]),
        (None, [1]),
        (2**62, [1]),
        (129, [1]),
        (0, [64, 64, 65]),
    ],
)
def test_frame_reader_refuses_invalid_offsets_and_sizes(reader, offset, sizes):
    with pytest.raises(InvalidMessage):
        reader.read(offset, sizes)


def test_frame_reader_maps_grown_memory_again(memory, reader):
    reader.read(0, [5])
    os.lseek(memory, 0, os.SEEK_END)
    os.write(memory, bytes([7] * 64))
    assert bytes(reader.read(192, [64])[0]) == bytes([7] * 64)


def test_frame_reader_refuses_empty_memory(memory):
    with pytest.raises(InvalidMessage, match="outside of the shared memory"):
        FrameReader(memory).read(0, [1])


def test_frame_writer_slots_round_trip(memory):
    writer, reader = FrameWriter(memory), FrameReader(memory)
    small, large = [b"ab", b"c"], [bytes(range(200)), b"d"]
    assert not writer.fits(small)
    writer.grow(small)
    assert writer.fits(small) and not writer.fits(large)
    found = [writer.write(slot, small) for slot in (0, 3)]
    assert [list(map(bytes, reader.read(**each))) for each in found] == [small, small]
    writer.grow(large)
    assert list(map(bytes, reader.read(**writer.write(3, large)))) == large
    reader.close()
