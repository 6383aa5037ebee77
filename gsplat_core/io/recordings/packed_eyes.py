"""Pictures that hold both eyes of a stereo endoscope, side by side or one above the other.

Recorders of stereo endoscopes often store both eyes in one picture. The entry `stereo` of `recording.json` splits them (`OneEye`).
Read as one eye, such pictures would be reconstructed as one wide scene without any error, so a warning is given
(`warn_of_packed_eyes`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.choices import StereoLayout
from gsplat_core.io.recordings.calibration import read_json
from gsplat_core.io.recordings.contents import DESCRIPTION_FILE, FrameImages
from gsplat_core.io.recordings.plain_files import Findings, Picture, stays_inside

TWO_EYES = "its pictures seem to hold both eyes"
"""Text of the warning. A source that splits its pictures into two eyes leaves the warning out."""

_WIDTH = 160
"""Width in pixels to which each wider half is reduced."""
_BLOCK = 24
"""Side of the compared blocks in pixels of the reduced halves."""
_STEP = 16
"""Distance of neighbouring blocks in pixels."""
_LARGEST_SHIFT = 0.3
"""Largest disparity that is searched, as a share of the width of an eye."""
_VERTICAL = 6
"""Largest vertical shift that is searched, in pixels of the reduced halves: the eyes of an endoscope are not rectified."""
_SEARCHED, _SEARCH_STEP = 60, 10
"""Number of pictures at the start in which one with texture is searched, and the distance of those that are tried."""
_DETAIL_SIGMA = 6.0
"""Standard deviation in pixels of the blur that is subtracted, so that shading of the field of view does not count as similarity."""
_LEAST_DETAIL = 2.0
"""Standard deviation in grey levels below which a block has no texture to compare."""
_LEAST_BLOCKS = 8
_SAME_ABOVE = 0.6
"""Median correlation of the blocks above which the halves show one scene.

Pictures of two eyes have at least 0.71 in the real recordings and 0.85 in synthesised ones, halves of other pictures at most 0.49
(benchmarks/packed_eyes.py).
"""


class OneEye:
    """`FrameImages` of one eye, cut out of images that hold both eyes. Each eye decodes the images for itself."""

    def __init__(self, images: FrameImages, layout: StereoLayout, *, right: bool) -> None:
        self._images, self._layout, self._right = images, layout, right
        self.files: tuple[Path, ...] = images.files
        self.numbers: list[int | None] = images.numbers
        self.frame_count: int = images.frame_count
        self.times: Sequence[float] | None = images.times
        self.fps: float | None = images.fps
        self.keeps_times: bool = images.keeps_times
        beside = layout == "side_by_side"
        self.width_px: int = images.width_px // 2 if beside else images.width_px
        self.height_px: int = images.height_px if beside else images.height_px // 2

    def frames(self, findings: Findings) -> Iterator[Picture | None]:
        """Yield the pictures of the eye in order; None for one that cannot be read at all. Only the left eye reports problems."""
        for picture in self._images.frames(Findings() if self._right else findings):
            yield None if picture is None else self._cut(picture)

    def _cut(self, picture: Picture) -> Picture:
        half = halves(picture.image, self._layout)[int(self._right)]
        return Picture(np.ascontiguousarray(half), picture.damage)


def stated_layout(root: Path, images: FrameImages, findings: Findings) -> StereoLayout | None:
    """Return the entry `stereo` of the recording's `recording.json`; None without one, or after a problem."""
    path = root / DESCRIPTION_FILE
    if not path.is_file() or not stays_inside(root, path, Findings()):
        return None
    # Problems of the file as a whole are reported when its other entries are read.
    stated = (read_json(path, Findings()) or {}).get("stereo")
    if stated is None:
        return None
    for layout in get_args(StereoLayout):
        if stated == layout:
            if (images.width_px if layout == "side_by_side" else images.height_px) < 2:
                size = f"{images.width_px}x{images.height_px} px"
                findings.problem(
                    path, f"stereo is {stated!r}, and the pictures are {size}", "Give pictures of two eyes"
                )
                return None
            return layout
    findings.problem(path, f"stereo is {stated!r:.40}", f"Give {' or '.join(get_args(StereoLayout))}")
    return None


def warn_of_packed_eyes(path: Path, images: FrameImages, findings: Findings, *, may_state: bool) -> None:
    """Warn if the first picture with texture holds two eyes.

    Args:
        path: file or folder named in the warning.
        images: pictures, of which a few are decoded.
        findings: receives the warning.
        may_state: True if the recording may state the entry `stereo`, which the warning then proposes.
    """
    for picture in islice(images.frames(Findings()), 0, _SEARCHED, _SEARCH_STEP):
        if picture is None:
            continue
        found = {layout: similarity(*halves(picture.image, layout)) for layout in get_args(StereoLayout)}
        for layout, alike in found.items():
            if alike is not None and alike > _SAME_ABOVE:
                what = f"{TWO_EYES}, {_HOW[layout]}, and are read as those of one eye"
                findings.warn(path, what, _remedy(layout, may_state))
                return
        if any(alike is not None for alike in found.values()):
            return


_HOW: Mapping[StereoLayout, str] = {"side_by_side": "side by side", "top_bottom": "one above the other"}


def _remedy(layout: StereoLayout, may_state: bool) -> str:
    if not may_state:
        return "Split them, and give the left ones in images/ and the right ones in images_right/"
    return (
        f"To split them, give a folder with them and a {DESCRIPTION_FILE} with"
        f' {{"format": "intrasplat-recording", "version": 1, "stereo": "{layout}"}}'
    )


def halves(image: NDArray[np.uint8], layout: StereoLayout) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the left and right eye's views of a picture, uint8 [H, W, 3], that holds both; a middle row or column is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    if layout == "side_by_side":
        return image[:, :width], image[:, width : 2 * width]
    return image[:height], image[height : 2 * height]


def similarity(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> float | None:
    """Return the median over blocks of the left half of the best correlation with nearby rows of the right half; None if fewer
    than `_LEAST_BLOCKS` blocks have texture."""
    if min(left.shape[:2]) < _BLOCK:
        return None
    ours, theirs = _detail(left), _detail(right)
    height, width = ours.shape
    margin = round(_LARGEST_SHIFT * width)
    best: list[float] = []
    for y in range(0, height - _BLOCK + 1, _STEP):
        for x in range(0, width - _BLOCK + 1, _STEP):
            block = ours[y : y + _BLOCK, x : x + _BLOCK]
            rows = slice(max(0, y - _VERTICAL), y + _BLOCK + _VERTICAL)
            strip = theirs[rows, max(0, x - margin) : x + _BLOCK + margin]
            if block.std() < _LEAST_DETAIL:
                continue
            textured = strip.std() >= _LEAST_DETAIL
            best.append(float(cv2.matchTemplate(strip, block, cv2.TM_CCOEFF_NORMED).max()) if textured else 0.0)
    return float(np.median(best)) if len(best) >= _LEAST_BLOCKS else None


def _detail(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the grey levels of a half, reduced to `_WIDTH` columns, without their large-scale shading: float32 [H, W]."""
    # Not enlarged: a block of a small half would then hold too little to be told from others.
    width = min(_WIDTH, image.shape[1])
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (width, height), interpolation=cv2.INTER_AREA)
    levels = grey.astype(np.float32)
    return levels - cv2.GaussianBlur(levels, (0, 0), _DETAIL_SIGMA)
