"""Separation of illumination and pigment in a picture.

Light that weakens with distance reduces red, green and blue alike, while pigment absorbs them
unequally. Fine detail is mostly pigment, since distance and slope change slowly. Log brightness is
therefore the weighted sum of the channels' logarithms, with weights summing to 1, that has the
least fine detail (best linear unbiased estimate; Aitken 1936).

Wet tissue also reflects the lamp, which adds white. The excess of red over green and blue is free
of reflections. The excess of a pixel's white over its surroundings reveals highlights.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.scene.frames import Frame

LONG_SIDE_PX = 320
"""Longest side of the analysed pictures, in pixels."""
CELLS = 40
"""Number of cells along the longer side of the brightness grid."""
BRIGHTEST, DARKEST = 249, 20
"""Levels of the brightest channel above which a pixel is clipped and below which it is noise."""
DARKEST_CHANNEL = 5
"""Level of any channel below which its logarithm is noise."""
SHOULDER = 0.8
"""Strength of the camera's highlight compression: linear light x is recorded as (1 - exp(-SHOULDER
x)) / SHOULDER. It differs between cameras.
"""
BESIDE_TOOLS = 0.07
"""Margin around tools excluded because of shadows, as a share of the longer side."""
LEAST_KNOWN = 0.3
"""Share of a cell's pixels that must be tissue that is neither under- nor overexposed."""
LEAST_DETAIL = 0.01
"""Lower bound of `Shading.detail`, the least noise of any picture."""
LEAST_RED = 0.1
"""Smallest excess of red over green and blue, relative to red, for the diffuse part to be usable.
"""
GLINT = 0.35
"""Smallest excess of white over the surroundings of a highlight, relative to the surroundings'
brightness.
"""
SURROUNDINGS = 0.025
"""Standard deviation of the window for a highlight's surroundings, as a share of the longer side.
"""
BESIDE_TOOL_EDGE = 0.0125
"""Margin around tools excluded from the search for highlights, as a share of the longer side."""


@dataclass(frozen=True)
class Cells:
    """Brightness of a picture's cells."""

    brightness: NDArray[np.float64]
    """Log brightness without pigment up to an offset, [h, w]; meaningless where `share` is too
    small.
    """
    share: NDArray[np.float64]
    """Share of usable pixels in each cell, [h, w]."""
    detail: float
    """Standard deviation of brightness between neighbouring cells caused by remaining pigment and
    noise.
    """

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells with enough usable pixels, bool [h, w]."""
        return self.share >= LEAST_KNOWN


@dataclass(frozen=True)
class Shading(Cells):
    """Shading of a picture; its brightness is from the mixture of channels."""

    glints: NDArray[np.float64]
    """Share of each cell's pixels in highlights of wet tissue, [h, w]."""
    wet_share: NDArray[np.float64]
    """Share of each cell's pixels in which highlights are detectable, [h, w]."""
    diffuse: Cells | None = None
    """Brightness of the diffuse part (`log_diffuse`), whose errors differ from those of the
    mixture. None if no cell has any.
    """


@dataclass(frozen=True)
class SmallPicture:
    """Picture reduced for the analysis of its light."""

    levels: NDArray[np.uint8]
    """RGB levels [H, W, 3]."""
    usable: NDArray[np.float32]
    """Weights [H, W]: 1 on tissue that is well exposed and away from tool shadows, else 0."""
    tissue: NDArray[np.uint8]
    """Mask [H, W]: 0 on and near tools and where it is too dark."""

    @classmethod
    def of(cls, frame: Frame) -> SmallPicture:
        """Reduce a frame. Exposure is ignored since it is uniform over the picture."""
        return _reduced(frame)

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the brightness grid."""
        height, width = self.levels.shape[:2]
        return max(2, round(width * CELLS / max(height, width))), max(2, round(height * CELLS / max(height, width)))

    def averaged(
        self, values: NDArray[np.float32], weight: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Average values [H, W] or [H, W, C] with weights [H, W] over the cells; also returns the
        mean weights [h, w].
        """
        share = cv2.resize(weight, self.cells, interpolation=cv2.INTER_AREA).astype(np.float64)
        weighted = values * (weight if values.ndim == 2 else weight[..., None])
        total = cv2.resize(weighted, self.cells, interpolation=cv2.INTER_AREA).astype(np.float64)
        least = np.maximum(share, 1e-6)
        return np.asarray(total / (least if values.ndim == 2 else least[..., None])), share


def shading_of(frame: Frame) -> Shading:
    """Compute the shading of a frame's tissue."""
    return shading_in(SmallPicture.of(frame))


def shading_in(picture: SmallPicture) -> Shading:
    """Compute the shading of a reduced picture."""
    cells, share = picture.averaged(_LOG_LIGHT[picture.levels], picture.usable)
    weights = _least_pigment(_steps(cells, share))
    glints, wet_share = picture.averaged(_glints(picture), picture.tissue.astype(np.float32))
    diffuse, known = log_diffuse(picture)
    red, red_share = picture.averaged(diffuse, known.astype(np.float32))
    return Shading(
        cells @ weights,
        share,
        _spread(_steps(cells, share) @ weights),
        glints * wet_share,
        wet_share,
        Cells(red, red_share, _spread(_steps(red, red_share))) if np.any(red_share >= LEAST_KNOWN) else None,
    )


def _steps(cells: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return differences of neighbouring known cells, [N] or [N, channels]."""
    known = share >= LEAST_KNOWN
    across = (cells[:, 1:] - cells[:, :-1])[known[:, 1:] & known[:, :-1]]
    return np.concatenate([across, (cells[1:] - cells[:-1])[known[1:] & known[:-1]]])


def _spread(steps: NDArray[np.float64]) -> float:
    return max(1.4826 * float(np.median(np.abs(steps))), LEAST_DETAIL) if len(steps) else LEAST_DETAIL


def log_diffuse(picture: SmallPicture) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the logarithm of the diffuse light [H, W] without specular reflections, and where it
    is known. It relies on tissue being red.
    """
    light = np.exp(_LOG_LIGHT[picture.levels])
    diffuse = light[..., 0] - 0.5 * (light[..., 1] + light[..., 2])
    known = (picture.usable > 0) & (diffuse > LEAST_RED * light[..., 0])
    return np.log(np.maximum(diffuse, 1e-4)).astype(np.float32), known


def _glints(picture: SmallPicture) -> NDArray[np.float32]:
    light = np.exp(_LOG_LIGHT[picture.levels])
    white = light.min(axis=2)
    sigma = SURROUNDINGS * max(white.shape)
    around, brightest = (cv2.GaussianBlur(each, (0, 0), sigma) for each in (white, light.max(axis=2)))
    return (white - around > GLINT * brightest).astype(np.float32)


def _least_pigment(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return channel weights [3], summing to 1, that minimise the mean square of the weighted
    `steps` [N, 3].
    """
    covariance = steps.T @ steps / max(len(steps), 1) + 1e-5 * np.eye(3)
    weights = np.linalg.solve(covariance, np.ones(3))
    return np.asarray(weights / weights.sum())


def _reduced(frame: Frame) -> SmallPicture:
    height, width = frame.image.shape[:2]
    usable = np.ones((height, width), np.uint8)
    for kept in (without_highlights(frame.image), frame.loss_mask):
        if kept is not None:
            usable &= (kept != 0).astype(np.uint8)
    image = frame.image
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    size = round(width * scale), round(height * scale)
    if scale < 1:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        usable = np.asarray(cv2.resize(usable, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    brightest, darkest = image.max(axis=2), image.min(axis=2)
    lit = (brightest > DARKEST).astype(np.uint8)
    usable &= ((brightest <= BRIGHTEST) & (lit > 0) & (darkest >= DARKEST_CHANNEL)).astype(np.uint8)
    if frame.mask is None:
        return SmallPicture(image, usable.astype(np.float32), lit)
    tissue = cv2.resize((frame.mask != 0).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    unshaded, beside = (_shrunk(tissue, margin * max(size)) for margin in (BESIDE_TOOLS, BESIDE_TOOL_EDGE))
    return SmallPicture(image, (usable & unshaded).astype(np.float32), beside & lit)


def _shrunk(tissue: NDArray[np.uint8], margin_px: float) -> NDArray[np.uint8]:
    side = 2 * round(margin_px) + 1
    return np.asarray(cv2.erode(tissue, np.ones((side, side), np.uint8)), np.uint8)


def _log_light() -> NDArray[np.float32]:
    """Return the log light of each level [256]: inverse sRGB curve (IEC 61966-2-1), then inverse
    shoulder.
    """
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.log(np.maximum(-np.log1p(-SHOULDER * linear) / SHOULDER, 1e-4)).astype(np.float32)


_LOG_LIGHT = _log_light()
