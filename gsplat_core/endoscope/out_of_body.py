"""Whether a picture was taken inside of the body: before anything is recorded, sent or trained on.

Tissue under a scope's white light is red, as red as blood makes it in places, and its redness varies; rooms, drapes, clothes, monitors
and test pictures are not, and skin is paler and more even. Nothing here recognises people or objects: a picture is taken for one from
outside unless its colours speak for tissue. A red and varied picture from outside passes; docs/tool-masks.md says what was tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.median import median_of
from gsplat_core.endoscope.reduced import averaged, channels
from gsplat_core.errors import InvalidInput

LONG_SIDE_PX = 96
"""A picture is judged at this size."""
SMALLEST_PX = 16
"""A picture with a shorter side than this cannot be judged."""
DARKEST = 25
"""Brightness (largest channel, 0..255) below which a pixel has no colour to judge."""
NOISE = 6.0
"""Added to each channel before ratios are taken."""
LOGS = np.log(np.arange(256, dtype=np.float32) + np.float32(NOISE))
RATIOS = np.array([[1, -1, 0], [0, 1, -1]], np.float32)
"""From logarithms of red, green and blue to those of red over green and green over blue."""


@dataclass(frozen=True)
class Evidence:
    """What a picture's colours say. Ratios are natural logarithms; shares are 0..1 of the lit pixels unless said otherwise."""

    lit: float
    """Share of the picture that is bright enough to be judged."""
    tissue: float
    """Share that has a colour of tissue: from purple over red to yellow."""
    cool: float
    """Share in which green or blue clearly exceed red: drapes, gloves, sky, and tools to a degree."""
    redness: float
    """Red over green, the value that a quarter of the pixels exceed."""
    spread: float
    """Red over green, from the value that 30 % stay below to the one that 10 % exceed."""
    yellowness: float
    """Green over blue relative to red over green, both medians; 1 is the colour of skin."""
    corners: float
    """Brightness of the picture's corners relative to its middle; near 0 where the field of view is round or the light falls off."""


@dataclass(frozen=True)
class Limits:
    """What a picture must have to count as taken inside."""

    lit: float
    tissue: float
    cool: float
    """At most."""
    redness: float
    spread: float


TO_ENTER = Limits(lit=0.2, tissue=0.7, cool=0.25, redness=0.34, spread=0.1)
"""Evidence that is needed to begin."""
TO_STAY = Limits(lit=0.2, tissue=0.6, cool=0.35, redness=0.3, spread=0.05)
"""Evidence that is needed to go on: tools, smoke and glare take some of it away."""
YELLOW, YELLOW_TISSUE, YELLOW_REDNESS, DARK_CORNERS = 1.25, 0.9, 0.15, 0.25
"""Fat and phantoms are less red: they are taken for tissue where nearly all of the picture is yellow rather than skin-coloured and its
corners are dark, as under a scope's light."""
FRAMES_TO_RETURN = 10
"""After a picture from outside so many in a row must have what is needed to begin."""


def evidence_of(image: NDArray[np.uint8]) -> Evidence | None:
    """What the colours of a picture say; None where there is too little of it. RGB uint8 [H, W, 3]; raises InvalidInput for anything else."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise InvalidInput(f"image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    height, width = image.shape[:2]
    if min(height, width) < SMALLEST_PX:
        return None
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    size = max(8, round(width * scale)), max(8, round(height * scale))
    # Averaging leaves little of noise, whose colours would look varied.
    small = averaged(image, size, samples=3)
    cv2.GaussianBlur(small, (0, 0), 1.0, dst=small)
    brightness, green, blue = channels(small)
    cv2.max(cv2.max(brightness, green, dst=brightness), blue, dst=brightness)
    levels = cv2.calcHist([brightness], [0], None, [256], [0, 256]).ravel()
    seen = float(levels[DARKEST:].sum())
    if not seen:
        return None
    lit = brightness >= max(DARKEST, 0.25 * float(levels[DARKEST:] @ np.arange(DARKEST, 256)) / seen)
    red_green, green_blue = (plane[lit] for plane in channels(cv2.transform(cv2.LUT(small, LOGS), RATIOS)))
    red_blue = red_green + green_blue
    ordered = np.sort(red_green)
    low, middle, high, top = (float(ordered[int(share * (ordered.size - 1))]) for share in (0.3, 0.5, 0.75, 0.9))
    # Red over whichever of green and blue it exceeds more, and less.
    tissue = (red_green > -0.03) & (np.maximum(red_green, red_blue) > 0.18)
    return Evidence(
        lit=ordered.size / brightness.size,
        tissue=np.count_nonzero(tissue) / ordered.size,
        cool=np.count_nonzero(np.minimum(red_green, red_blue) < -0.06) / ordered.size,
        redness=high,
        spread=top - low,
        yellowness=median_of(green_blue) / max(middle, 0.05),
        corners=_corners(brightness),
    )


def doubt(evidence: Evidence | None, limits: Limits) -> str | None:
    """Why a picture may have been taken outside, in a few words; None where nothing speaks for it."""
    if evidence is None or evidence.lit < limits.lit:
        return "too dark"
    if evidence.tissue < limits.tissue or evidence.cool > limits.cool:
        return "colours that tissue has not"
    yellow = (
        evidence.yellowness > YELLOW
        and evidence.corners < DARK_CORNERS
        and evidence.tissue > YELLOW_TISSUE
        and evidence.redness > YELLOW_REDNESS
    )
    if evidence.redness < limits.redness and not yellow:
        return "not as red as tissue"
    if evidence.spread < limits.spread:
        return "one colour everywhere"
    return None


class BodyGate:
    """Decides picture by picture whether a stream is inside of the body. Outside until there is evidence, and at once when it is gone.

    The first picture of a stream may decide alone; after one from outside, `FRAMES_TO_RETURN` in a row are needed.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next picture is the first one."""
        self._inside = False
        self._missing = 1
        """How many more pictures with enough evidence are needed."""

    @property
    def inside(self) -> bool:
        """Whether the last picture counts as taken inside."""
        return self._inside

    def judge(self, image: NDArray[np.uint8]) -> str | None:
        """None where the stream's next picture counts as taken inside, otherwise why not, in a few words.

        image: RGB uint8 [H, W, 3]. Raises InvalidInput for anything else; the picture then counts as taken outside.
        """
        try:
            evidence = evidence_of(image)
        except BaseException:
            self.close()
            raise
        reason = doubt(evidence, TO_STAY if self._inside else TO_ENTER)
        if reason is not None:
            self.close()
            return reason
        if not self._inside:
            self._missing -= 1
            self._inside = self._missing <= 0
        return None if self._inside else "not yet certain again"

    def close(self) -> None:
        """Count the present picture as taken outside."""
        self._inside, self._missing = False, FRAMES_TO_RETURN


def _corners(brightness: NDArray[np.uint8]) -> float:
    height, width = brightness.shape
    rows, columns = max(1, height // 8), max(1, width // 8)
    top, bottom, left, right = slice(rows), slice(-rows, None), slice(columns), slice(-columns, None)
    corners = sum(cv2.mean(brightness[y, x])[0] for y in (top, bottom) for x in (left, right)) / 4
    middle = cv2.mean(brightness[2 * rows : -2 * rows, 2 * columns : -2 * columns])[0]
    return corners / max(1.0, middle)
