"""Detection of pictures that hold both eyes of a stereo endoscope, side by side or one above the other.

Recorders of stereo endoscopes often store both eyes in one picture. Read as one eye, such a picture would be reconstructed as one
wide scene without any error.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.plain_files import Findings

TWO_EYES = "its pictures seem to hold both eyes"
"""Text of the warning. A source that splits its pictures into two eyes leaves the warning out."""

_WIDTH = 160
"""Width in pixels to which each half is reduced."""
_BLOCK = 24
"""Side of the compared blocks in pixels of the reduced halves."""
_STEP = 16
"""Distance of neighbouring blocks in pixels."""
_LARGEST_SHIFT = 0.15
"""Largest disparity that is searched, as a share of the width of an eye."""
_DETAIL_SIGMA = 6.0
"""Standard deviation in pixels of the blur that is subtracted, so that shading of the field of view does not count as similarity."""
_LEAST_DETAIL = 2.0
"""Standard deviation in grey levels below which a block has no texture to compare."""
_LEAST_BLOCKS = 8
_SAME_ABOVE = 0.6
"""Median correlation of the blocks above which the halves show one scene.

The real stereo pairs among the recordings have 0.83 to 0.97, halves of other pictures at most 0.36.
"""


def warn_of_packed_eyes(path: Path, image: NDArray[np.uint8], findings: Findings) -> None:
    """Warn if a picture, RGB uint8 [H, W, 3], holds two eyes. `path` is the file or folder named in the warning."""
    for how, stereo in (("side by side", "side_by_side"), ("one above the other", "top_bottom")):
        if _similarity(*_halves(image, stereo)) > _SAME_ABOVE:
            findings.warn(
                path,
                f"{TWO_EYES}, {how}, and are read as those of one eye",
                f"Append ?stereo={stereo} to the path to split them",
            )
            return


def _halves(image: NDArray[np.uint8], stereo: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    height, width = image.shape[0] // 2, image.shape[1] // 2
    if stereo == "side_by_side":
        return image[:, :width], image[:, width : 2 * width]
    return image[:height], image[height : 2 * height]


def _similarity(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> float:
    """Return the median over blocks of the left half of the best correlation with the same rows of the right half; 0 if fewer than
    `_LEAST_BLOCKS` blocks have texture."""
    if min(left.shape[:2]) < _BLOCK:
        return 0.0
    ours, theirs = _detail(left), _detail(right)
    height, width = ours.shape
    margin = round(_LARGEST_SHIFT * width)
    best: list[float] = []
    for y in range(0, height - _BLOCK + 1, _STEP):
        for x in range(margin, width - _BLOCK - margin + 1, _STEP):
            block = ours[y : y + _BLOCK, x : x + _BLOCK]
            strip = theirs[y : y + _BLOCK, x - margin : x + _BLOCK + margin]
            if block.std() < _LEAST_DETAIL:
                continue
            textured = strip.std() >= _LEAST_DETAIL
            best.append(float(cv2.matchTemplate(strip, block, cv2.TM_CCOEFF_NORMED).max()) if textured else 0.0)
    return float(np.median(best)) if len(best) >= _LEAST_BLOCKS else 0.0


def _detail(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the grey levels of a half, reduced to `_WIDTH` columns, without their large-scale shading: float32 [H, W]."""
    height = max(2 * _BLOCK, round(image.shape[0] * _WIDTH / image.shape[1]))
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (_WIDTH, height), interpolation=cv2.INTER_AREA)
    levels = grey.astype(np.float32)
    return levels - cv2.GaussianBlur(levels, (0, 0), _DETAIL_SIGMA)
