from __future__ import annotations

import numpy as np
import pytest
import simplejpeg

from gsplat_core.errors import InvalidSetting
from services.display import check_quality, dimmed, encoded


def test_encoded_jpeg_keeps_colours_and_orientation():
    image = np.zeros((32, 48, 3), np.uint8)
    image[:16, :24] = (230, 30, 20)
    image[16:, 24:] = (20, 40, 220)
    decoded = simplejpeg.decode_jpeg(encoded(image, 90), colorspace="RGB")
    assert np.abs(decoded.astype(int) - image).mean() < 6
    assert np.array_equal(encoded(image[:, ::-1], 90), encoded(np.ascontiguousarray(image[:, ::-1]), 90))


def test_higher_jpeg_quality_has_smaller_error():
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    off = [np.abs(simplejpeg.decode_jpeg(encoded(image, q)).astype(int) - image).mean() for q in (20, 90)]
    assert off[1] < off[0]


def test_dimmed_picture_is_grey_and_darker():
    image = np.full((4, 4, 3), (250, 100, 40), np.uint8)
    grey = dimmed(image)
    assert (grey == grey[..., :1]).all()
    assert grey.mean() < 0.6 * image.mean()


@pytest.mark.parametrize("quality", [0, 9, 96, 1000, -1])
def test_check_quality_rejects_values_out_of_range(quality):
    with pytest.raises(InvalidSetting):
        check_quality(quality)
