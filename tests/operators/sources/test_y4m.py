"""The first line of a YUV4MPEG2 stream: size, rate and format, or a refusal."""

from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidSetting
from operators.sources.pipe import Y4mHeader


@pytest.mark.parametrize(
    ("line", "header"),
    [
        ("YUV4MPEG2 W640 H512 F30000:1001 Ip A1:1 C420jpeg", (640, 512, 30000 / 1001, "yuv420p")),
        ("YUV4MPEG2 W640 H512 F25:1", (640, 512, 25.0, "yuv420p")),
        ("YUV4MPEG2 W99999 H12345 F25:2 C420mpeg2", (99999, 12345, 12.5, "yuv420p")),
        ("YUV4MPEG2 H5 W7 C420paldv XCOLORRANGE=LIMITED", (7, 5, None, "yuv420p")),
        ("YUV4MPEG2 W7 H5 F0:1 C420 XCOLORRANGE=FULL", (7, 5, None, "yuvj420p")),
        ("YUV4MPEG2 W7 H5 F30:0 C422 XCOLORRANGE=FULL", (7, 5, None, "yuv422p")),
        ("YUV4MPEG2  W7  H5 Fx C444", (7, 5, None, "yuv444p")),
        ("YUV4MPEG2 W7 H5 F1:3 Cmono", (7, 5, 1 / 3, "gray")),
        ("YUV4MPEG2 W7 H5 W8 H6", (7, 5, None, "yuv420p")),  # the first one of two counts
    ],
)
def test_y4m_header_parse_returns_size_rate_and_format(line, header):
    found = Y4mHeader.parse(line.encode())
    assert (found.width_px, found.height_px, found.fps, found.format) == header


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("RIFF W7 H5", "no YUV4MPEG2 stream"),
        ("", "no YUV4MPEG2 stream"),
        ("YUV4MPEG2", "names no size"),
        ("YUV4MPEG2 W7", "names no size"),
        ("YUV4MPEG2 H7", "names no size"),
        ("YUV4MPEG2 W7 H-5", "names no size"),
        ("YUV4MPEG2 Wx H5", "names no size"),
        ("YUV4MPEG2 W100000 H5", "names no size"),
        ("YUV4MPEG2 W5 H100000", "names no size"),
        ("YUV4MPEG2 W7 H5 C420p10", "kind C420p10 are not read; known are 420, "),
    ],
)
def test_y4m_header_parse_refuses_unusable_header(line, said):
    with pytest.raises(InvalidSetting, match=said):
        Y4mHeader.parse(line.encode())
