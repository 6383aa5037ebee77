"""`valid_mask.png` has two values; a picture that is no mask is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording


def take(folder, mask):
    (folder / "images").mkdir()
    for k in range(2):
        cv2.imwrite(str(folder / "images" / f"{k}.png"), np.full((32, 48, 3), 90, np.uint8))
    cv2.imwrite(str(folder / "valid_mask.png"), mask)
    return folder


@pytest.mark.parametrize(
    "mask",
    [
        np.tile(np.linspace(0, 255, 48).astype(np.uint8), (32, 1)),
        np.random.default_rng(0).integers(0, 256, (32, 48)).astype(np.uint8),
        np.where(np.arange(48) < 20, 100, 150).astype(np.uint8)[None].repeat(32, 0),
        np.full((32, 48), 7, np.uint8),
        np.where(np.arange(48) < 20, 0, np.where(np.arange(48) < 30, 128, 255)).astype(np.uint8)[None].repeat(32, 0),
    ],
    ids=["gradient", "noise", "two greys", "one grey", "three values"],
)
def test_valid_mask_of_other_values_is_refused(tmp_path, mask):
    with pytest.raises(RecordingInvalid, match="different values"):
        open_recording(take(tmp_path, mask))


@pytest.mark.parametrize("white", [1, 255])
def test_valid_mask_of_two_values_is_read(tmp_path, white):
    mask = np.zeros((32, 48), np.uint8)
    mask[4:28, 4:44] = white
    assert open_recording(take(tmp_path, mask)).frame_count == 2
