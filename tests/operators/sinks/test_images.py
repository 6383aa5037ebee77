"""Pictures on disk are lossless."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from operators.sinks.video import write_png


@pytest.mark.parametrize(("shape", "dtype"), [((7, 5, 3), np.uint8), ((7, 5), np.uint8), ((7, 5), np.uint16)])
def test_write_png_round_trip_is_lossless(tmp_path, shape, dtype, rng):
    image = rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    write_png(tmp_path / "picture.png", image)
    read = cv2.imread(str(tmp_path / "picture.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read[..., ::-1] if image.ndim == 3 else read, image)
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((4, 4, 7), np.uint8), np.zeros(4, np.uint8)])
def test_write_png_refuses_unsupported_shape_or_dtype(tmp_path, image):
    with pytest.raises(InvalidInput, match=r"must be \[H, W\] or \[H, W, 3\] of uint8 or uint16"):
        write_png(tmp_path / "picture.png", image)
    assert list(tmp_path.iterdir()) == []
