"""How brightly each part of a picture is lit, told apart from what colour it has.

Light that gets weaker with distance weakens red, green and blue alike; pigment takes them away unequally. Fine detail of a picture is mostly
pigment, since what changes by distance and slope changes slowly. So log brightness is the weighted sum of the channels' logarithms, with weights that
sum to 1, that has the least fine detail (the best linear unbiased estimate; Aitken 1936).

Wet tissue also mirrors the lamp, which adds white. What red has more than green and blue is free of that, and how much white a pixel has more than its
surroundings shows glints.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.scene.frames import Frame

LONG_SIDE_PX = 320
"""Larger pictures are looked at in this size."""
CELLS = 40
"""Along the longer side of the grid on which brightness is averaged."""
BRIGHTEST, DARKEST = 249, 20
"""Levels of the brightest channel beyond which it is clipped, or noise."""
DARKEST_CHANNEL = 5
"""Levels of any channel below which its logarithm is noise."""
SHOULDER = 0.8
"""How far cameras compress what is bright after their gamma: linear light x is recorded as (1 - exp(-SHOULDER x)) / SHOULDER. Cameras differ; 0 is none."""
BESIDE_TOOLS = 0.07
"""Margin around tools that is left out because of their shadows, as a share of the longer side."""
LEAST_KNOWN = 0.3
"""Share of a cell's pixels that must be tissue lit neither too dark nor too bright."""
LEAST_DETAIL = 0.01
"""Lower bound of `Shading.detail`: no picture has less noise."""
LEAST_RED = 0.1
"""What red has more than green and blue, by red: with less, tissue is not red, and light without what is mirrored is noise."""
GLINT = 0.35
"""White that a glint has more than its surroundings, by the brightness of these."""
SURROUNDINGS = 0.025
"""Their standard deviation, as a share of the longer side."""
BESIDE_TOOL_EDGE = 0.0125
"""Margin around tools in which there are no glints of tissue, as a share of the longer side."""


@dataclass(frozen=True)
class Cells:
    """How brightly the cells of a picture are lit."""

    brightness: NDArray[np.float64]
    """Logarithm [h, w] of how bright the cell would be without its pigment, up to one summand; meaningless where `share` is too small."""
    share: NDArray[np.float64]
    """[h, w]: share of the cell's pixels that could be used."""
    detail: float
    """Standard deviation of `brightness` between neighbouring cells: pigment that is left, and noise."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """The cells of which enough could be used [h, w]."""
        return self.share >= LEAST_KNOWN


@dataclass(frozen=True)
class Shading(Cells):
    """What a picture tells about its light; its brightness is that of the mixture of channels."""

    glints: NDArray[np.float64]
    """[h, w]: share of the cell's pixels that are glints of wet tissue."""
    wet_share: NDArray[np.float64]
    """[h, w]: share in which glints could be seen."""
    diffuse: Cells | None = None
    """By what comes out of the tissue (`log_diffuse`): it errs otherwise than the mixture. None where it is not known of any cell."""


@dataclass(frozen=True)
class SmallPicture:
    """A picture in the size in which its light is looked at."""

    levels: NDArray[np.uint8]
    """RGB [H, W, 3]."""
    usable: NDArray[np.float32]
    """[H, W]: 1 where it shows tissue by its own colour, off shadows of tools; 0 elsewhere."""
    tissue: NDArray[np.uint8]
    """[H, W]: 0 on tools and close to them."""

    @classmethod
    def of(cls, frame: Frame) -> SmallPicture:
        """Of a frame; its exposure plays no part: it is the same everywhere."""
        return _reduced(frame)

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the grid on which brightness is averaged."""
        height, width = self.levels.shape[:2]
        return max(2, round(width * CELLS / max(height, width))), max(2, round(height * CELLS / max(height, width)))

    def averaged(
        self, values: NDArray[np.float32], weight: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Weighted means of values [H, W] or [H, W, C] over the cells, and the mean weights [h, w]."""
        share = cv2.resize(weight, self.cells, interpolation=cv2.INTER_AREA).astype(np.float64)
        weighted = values * (weight if values.ndim == 2 else weight[..., None])
        total = cv2.resize(weighted, self.cells, interpolation=cv2.INTER_AREA).astype(np.float64)
        least = np.maximum(share, 1e-6)
        return np.asarray(total / (least if values.ndim == 2 else least[..., None])), share


def shading_of(frame: Frame) -> Shading:
    """The shading of a frame's tissue."""
    return shading_in(SmallPicture.of(frame))


def shading_in(picture: SmallPicture) -> Shading:
    """The shading of the tissue in a small picture."""
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
    """Differences between neighbouring cells [N] or [N, channels], of those of which enough is known."""
    known = share >= LEAST_KNOWN
    across = (cells[:, 1:] - cells[:, :-1])[known[:, 1:] & known[:, :-1]]
    return np.concatenate([across, (cells[1:] - cells[:-1])[known[1:] & known[:-1]]])


def _spread(steps: NDArray[np.float64]) -> float:
    return max(1.4826 * float(np.median(np.abs(steps))), LEAST_DETAIL) if len(steps) else LEAST_DETAIL


def log_diffuse(picture: SmallPicture) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Logarithm of the light [H, W] that came out of tissue, without what its wet surface mirrors, and where that is known [H, W]: tissue is red."""
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
    """Weights [3] of the channels that sum to 1, with the least mean square of `steps` [N, 3] weighted by them."""
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
    """Logarithm of the light that a level stands for [256]: the sRGB curve undone (IEC 61966-2-1), then the shoulder."""
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.log(np.maximum(-np.log1p(-SHOULDER * linear) / SHOULDER, 1e-4)).astype(np.float32)


_LOG_LIGHT = _log_light()
