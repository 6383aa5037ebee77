"""Size, quality and drawing of the pictures of reports."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from services.reports.figures import _outlined, data_uri


def bytes_of(uri: str) -> bytes:
    kind, _, data = uri.partition(",")
    assert kind == "data:image/jpeg;base64"
    return base64.b64decode(data)


@pytest.mark.parametrize(
    ("size", "shown"),
    [
        ((840, 600), (420, 300)), ((421, 300), (420, 299)), ((420, 300), (420, 300)), ((211, 100), (211, 100)),
        ((210, 100), (420, 200)), ((140, 100), (420, 300)), ((24, 16), (408, 272)), ((4200, 1), (420, 1)),
    ],
)  # fmt: skip
def test_data_uri_limits_width_to_420_px_and_enlarges_by_whole_factors(size, shown):
    image = np.zeros((size[1], size[0], 3), np.uint8)
    decoded = cv2.imdecode(np.frombuffer(bytes_of(data_uri(image)), np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape[1::-1] == shown


def test_data_uri_keeps_colours_at_jpeg_quality_88():
    """The standard table of luminance begins with 16, 11 and 12, and a quality of 88 multiplies it by 0.24."""
    image = np.empty((32, 48, 3), np.uint8)
    image[:] = 200, 90, 40
    data = bytes_of(data_uri(image))
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - [200, 90, 40]).max() <= 4
    table = data.index(b"\xff\xdb") + 5
    assert list(data[table : table + 3]) == [4, 3, 3]  # in zigzag order


@pytest.mark.parametrize(("height", "width_px"), [(90, 1), (440, 1), (600, 2)])
def test_outlined_draws_grey_line_with_width_of_height_over_300(height, width_px):
    picture = np.full((height, 400, 3), 20, np.uint8)
    mask = np.ones((height, 400), np.uint8)
    mask[30:70, 100:300] = 0
    drawn = _outlined(picture, mask)
    assert sorted(np.unique(drawn)) == [20, 235] and picture.max() == 20
    column = np.flatnonzero(drawn[:50, 200, 0] == 235)
    assert abs(len(column) - width_px) <= (width_px > 1) and abs(column.mean() - 30) <= 1
    assert drawn[50, 200, 0] == drawn[50, 20, 0] == 20
    assert _outlined(picture, None) is picture
