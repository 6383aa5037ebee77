"""Pictures as plain bytes: their length and their colours, at sizes that chroma does not divide."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from operators.sources.pipe import PLANES, RawFormat

WIDTH, HEIGHT = 33, 17
BYTES = {
    "rgb24": 1683, "bgr24": 1683, "rgba": 2244, "bgra": 2244, "gray": 561, "yuv420p": 867, "yuvj420p": 867, "yuv422p": 1139,
    "yuv444p": 1683, "nv12": 867, "yuyv422": 1156, "uyvy422": 1156,
}  # fmt: skip
"""Bytes of one picture of this odd size. Half a pixel of chroma is stored as a whole one."""


def test_raw_format_frame_bytes():
    assert {name: RawFormat(name, WIDTH, HEIGHT).frame_bytes for name in PLANES} == BYTES


def test_unknown_raw_format_error_lists_known_formats():
    with pytest.raises(InvalidSetting, match="format is 'rgb25'; known are rgb24, bgr24"):
        RawFormat("rgb25", WIDTH, HEIGHT)


@pytest.mark.parametrize("name", ["rgb24", "bgr24", "rgba", "bgra", "gray"])
def test_packed_raw_formats_keep_pixel_values(name, rng):
    channels = {"gray": 1, "rgba": 4, "bgra": 4}.get(name, 3)
    values = rng.integers(0, 256, (HEIGHT, WIDTH, channels), np.uint8)
    picture = RawFormat(name, WIDTH, HEIGHT).picture(values.tobytes())
    order = {"bgr24": [2, 1, 0], "bgra": [2, 1, 0], "gray": [0, 0, 0]}.get(name, [0, 1, 2])
    np.testing.assert_array_equal(picture, values[..., order])
    picture[:] = 0  # a separate copy


@pytest.mark.parametrize(
    ("name", "red"),
    [
        ("yuv420p", b"\x51" * 561 + b"\x5a" * 153 + b"\xf0" * 153),
        ("yuvj420p", b"\x4c" * 561 + b"\x55" * 153 + b"\xff" * 153),
        ("yuv422p", b"\x51" * 561 + b"\x5a" * 289 + b"\xf0" * 289),
        ("yuv444p", b"\x51" * 561 + b"\x5a" * 561 + b"\xf0" * 561),
        ("nv12", b"\x51" * 561 + b"\x5a\xf0" * 153),
        ("yuyv422", b"\x51\x5a\x51\xf0" * 289),
        ("uyvy422", b"\x5a\x51\xf0\x51" * 289),
    ],
)
def test_yuv_raw_formats_decode_red_at_odd_size(name, red):
    picture = RawFormat(name, WIDTH, HEIGHT).picture(red)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    # A red of BT.601: chroma exchanged would be blue, and a plane read from elsewhere another colour at its rows.
    np.testing.assert_allclose(picture, np.broadcast_to([254, 0, 0], picture.shape), atol=6)
