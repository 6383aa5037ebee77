"""Separation of illumination and pigment in a picture, and the brightness change of tissue between two pictures.

Light that weakens with distance reduces red, green and blue alike, while pigment absorbs them unequally. Fine detail
is mostly pigment, since distance and slope change slowly. Log brightness is therefore the weighted sum of the
channels' logarithms, with weights summing to 1, that has the least fine detail (best linear unbiased estimate; Aitken
1936).

Wet tissue also reflects the lamp, which adds white. The excess of red over green and blue is free of reflections. The
excess of a pixel's white over its surroundings reveals highlights.

The pigment of a piece of tissue is constant, so its brightness change between two pictures depends on light and slope
alone. Tissue is tracked from a key picture by optical flow with a forward-backward check. Specular reflections are
removed beforehand (`log_diffuse`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.highlights import without_highlights
from gsplat_core.geometry.grid_tracks import TexturedPicture, seen_by
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

LONG_SIDE_PX = 320
"""Longest side, in pixels, to which pictures are reduced before their shading is analysed."""
CELLS = 40
"""Number of cells along the longer side of the brightness grid."""
BRIGHTEST, DARKEST = 249, 20
"""Levels of the brightest channel above which a pixel is clipped and below which it is noise."""
DARKEST_CHANNEL = 5
"""Level (0 to 255) of a channel below which its logarithm is noise and the pixel is not used."""
SHOULDER = 0.8
"""Strength of the camera's highlight compression: linear light x is recorded as (1 - exp(-SHOULDER
x)) / SHOULDER. It differs between cameras.
"""
BESIDE_TOOLS = 0.07
"""Width of the margin around tools that is excluded because of the tools' shadows, as a share of the picture's longer side."""
LEAST_KNOWN = 0.3
"""Smallest share of usable pixels (tissue that is neither under- nor overexposed) at which a grid cell counts as known."""
LEAST_DETAIL = 0.01
"""Lower bound of `Cells.detail`: no picture has less noise of log brightness between neighbouring cells."""
LEAST_RED = 0.1
"""Smallest excess of red over the mean of green and blue, relative to red, at a pixel whose diffuse light is usable."""
GLINT = 0.35
"""Smallest excess of a highlight's white over that of its surroundings, relative to the surroundings' brightness."""
SURROUNDINGS = 0.025
"""Standard deviation of the window for a highlight's surroundings, as a share of the longer side."""
BESIDE_TOOL_EDGE = 0.0125
"""Margin around tools excluded from the search for highlights, as a share of the longer side."""


@dataclass(frozen=True)
class Cells:
    """Brightness of a picture, averaged over cells of a coarse grid."""

    brightness: NDArray[np.float64]
    """Log brightness without pigment up to an offset, [h, w]; meaningless where `share` is too small."""
    share: NDArray[np.float64]
    """Share of each cell's pixels that are usable (well-exposed tissue), [h, w]."""
    detail: float
    """Standard deviation of brightness between neighbouring cells caused by remaining pigment and noise."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells with a share of usable pixels of at least `LEAST_KNOWN`, bool [h, w]."""
        return self.share >= LEAST_KNOWN


@dataclass(frozen=True)
class Shading(Cells):
    """Shading of a picture. The brightness is computed from a mixture of the colour channels."""

    glints: NDArray[np.float64]
    """Share of each cell's pixels that are specular highlights on tissue, [h, w]."""
    wet_share: NDArray[np.float64]
    """Share of each cell's pixels that count for `glints`: lit tissue away from tool edges, [h, w]."""
    diffuse: Cells | None = None
    """Brightness of the diffuse part (`log_diffuse`), whose errors differ from those of the
    mixture. None if no cell has any.
    """


@dataclass(frozen=True)
class SmallPicture:
    """Picture reduced in size, from which depth is estimated by shading."""

    levels: NDArray[np.uint8]
    """Reduced picture, RGB uint8 [H, W, 3]."""
    usable: NDArray[np.float32]
    """Weights [H, W]: 1 on tissue that is well exposed and away from tool shadows, else 0."""
    tissue: NDArray[np.uint8]
    """Mask [H, W]: 0 on and near tools and where it is too dark."""

    @classmethod
    def of(cls, frame: Frame) -> SmallPicture:
        """Return a frame's picture at reduced size. Exposure is ignored since it is uniform over the picture."""
        return _reduced(frame)

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the brightness grid."""
        height, width = self.levels.shape[:2]
        return max(2, round(width * CELLS / max(height, width))), max(2, round(height * CELLS / max(height, width)))

    def averaged(
        self, values: NDArray[np.float32], weight: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Average values [H, W] or [H, W, C] with weights [H, W] over the cells; also returns the mean weights [h, w]."""
        share = cv2.resize(weight, self.cells, interpolation=cv2.INTER_AREA).astype(np.float64)
        weighted = values * (weight if values.ndim == 2 else weight[..., None])
        total = cv2.resize(weighted, self.cells, interpolation=cv2.INTER_AREA).astype(np.float64)
        least = np.maximum(share, 1e-6)
        return np.asarray(total / (least if values.ndim == 2 else least[..., None])), share


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
    """Return the differences between horizontally and vertically neighbouring known cells, [N] or [N, channels]."""
    known = share >= LEAST_KNOWN
    across = (cells[:, 1:] - cells[:, :-1])[known[:, 1:] & known[:, :-1]]
    return np.concatenate([across, (cells[1:] - cells[:-1])[known[1:] & known[:-1]]])


def _spread(steps: NDArray[np.float64]) -> float:
    return max(1.4826 * float(np.median(np.abs(steps))), LEAST_DETAIL) if len(steps) else LEAST_DETAIL


def log_diffuse(picture: SmallPicture) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the logarithm of the diffuse light [H, W], without specular reflections, and a bool mask [H, W], True where it is known.

    It is the excess of red over green and blue, so the tissue must be red.
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
    """Return channel weights [3], summing to 1, that minimise the mean square of the weighted `steps` [N, 3]."""
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
    """Return the logarithm of linear light for each 8-bit level [256]: inverse sRGB curve (IEC 61966-2-1), then the inverse of the
    camera's highlight compression (`SHOULDER`).
    """
    level = np.arange(256) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.log(np.maximum(-np.log1p(-SHOULDER * linear) / SHOULDER, 1e-4)).astype(np.float32)


_LOG_LIGHT = _log_light()
RETURN_PX = 1.0
"""Largest forward-backward error in pixels of the optical flow at a pixel that counts as tracked."""
MOST = 0.5
"""Largest change of a tracked pixel's log brightness that is used; larger changes are tracking errors or shadows."""
LEAST_FOUND = 0.6
"""Smallest share of the key picture's tissue pixels that must be tracked for a usable comparison of two pictures."""
WIDEST = 0.15
"""Largest standard deviation of the change of log brightness for a usable comparison; a moving scope changes the light
more.
"""


@dataclass(frozen=True)
class ShadedPicture:
    """Precomputed shading and texture of one picture, from which its changes against other pictures are computed."""

    shading: Shading
    picture: SmallPicture
    texture: TexturedPicture
    diffuse: NDArray[np.float32]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class Change:
    """Change of the tissue from a key picture to another picture, in each cell of the key picture."""

    brighter: NDArray[np.float64]
    """Change of log brightness from the key picture to the other one, mean over the cell's tracked pixels, float64 [h, w]."""
    share: NDArray[np.float64]
    """Share of the cell's pixels that were tracked into the other picture, float64 [h, w]."""
    moved: NDArray[np.float64]
    """Displacement of each cell's tissue from the key picture to the other one, in cells (columns, rows), float64 [h, w, 2]."""
    found: float
    """Share of the key picture's tissue pixels that were tracked into the other picture."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells with a share of tracked pixels of at least `LEAST_KNOWN`, bool [h, w]."""
        return self.share >= LEAST_KNOWN

    @property
    def is_followed(self) -> bool:
        """True if enough tissue was tracked into the other picture (`LEAST_FOUND`) and its brightness changed evenly (`WIDEST`)."""
        known = self.known
        return self.found >= LEAST_FOUND and bool(known.any()) and float(np.std(self.brighter[known])) <= WIDEST


def shaded_picture(frame: Frame, camera: Camera) -> ShadedPicture:
    """Compute shading and texture of a frame."""
    picture = SmallPicture.of(frame)
    return ShadedPicture(shading_in(picture), picture, seen_by(frame, camera), *log_diffuse(picture))


class Follower:
    """Tracker of the tissue of one key picture in other pictures of the same size. Pictures are best passed in temporal
    order away from the key, since each flow starts from the previous one.
    """

    def __init__(self, key: ShadedPicture) -> None:
        self._key = key
        self._there: Any = None
        self._back: Any = None
        self._method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def change_to(self, other: ShadedPicture) -> Change:
        """Compute the change of brightness and position of the key picture's tissue in another picture, per cell."""
        key = self._key
        first, second = key.texture.texture, other.texture.texture
        self._there = self._method.calc(first, second, self._there)
        self._back = self._method.calc(second, first, self._back)
        height, width = first.shape
        column, row = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        x, y = column + self._there[..., 0], row + self._there[..., 1]
        read = lambda plane, how=cv2.INTER_LINEAR: cv2.remap(plane, x, y, how, borderMode=cv2.BORDER_CONSTANT)
        returned = self._there + read(self._back)
        found = np.hypot(returned[..., 0], returned[..., 1]) < RETURN_PX
        tissue = key.known & (key.texture.usable > 0)
        found &= tissue
        for usable in (other.known.astype(np.uint8), other.texture.usable):
            found &= read(usable, cv2.INTER_NEAREST) > 0
        brighter = read(other.diffuse) - key.diffuse
        found &= np.abs(brighter) <= MOST
        weight = found.astype(np.float32)
        mean, share = key.picture.averaged(np.asarray(brighter, np.float32), weight)
        moved, _ = key.picture.averaged(self._there, weight)
        columns, rows = key.picture.cells
        return Change(
            mean, share, moved * [columns / width, rows / height], float(found.sum() / max(int(tissue.sum()), 1))
        )
