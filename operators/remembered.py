"""Detection and marking of remembered tissue: rendered, but not visible in the current frame.

Remembered tissue was seen earlier and is not visible to the camera now.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from operators.messages import RenderedFrame

COVERED = 0.1
"""Minimum opacity of a covered pixel. Below it a pixel is nearly black and not marked."""
DARKENED = 0.65
"""Brightness factor of remembered tissue, which is drawn in grey."""
LINES_PER_HEIGHT = 300
"""Picture height divided by outline width. Gives 2 px at 512 px, which survives video coding."""


class RememberedTissue:
    """Finds and marks remembered tissue in pictures from the endoscope's own view.

    Reuses work buffers of the size of the last picture. Not thread-safe.
    """

    def __init__(self) -> None:
        self._resize(0, 0)
        self._found: tuple[NDArray[np.uint8], tuple[int, int, int, int]] | None = None
        """Last mask and its bounding box: left, top, width, height in pixels."""

    def _resize(self, height_px: int, width_px: int) -> None:
        self._grey, self._tools, self._scratch = (np.empty((height_px, width_px), np.uint8) for _ in range(3))
        self._colourless = np.empty((height_px, width_px, 3), np.uint8)

    def layer(self, rendered: RenderedFrame, whole: bool = False) -> NDArray[np.uint8] | None:
        """Return the mask of rendered tissue that is not visible in the content's frame.

        Such tissue is behind a tool, under the recorder's on-screen display, or outside of the field of view.

        Args:
            rendered: the picture with its frame and opacity.
            whole: no part of the picture is currently visible, so that all covered pixels are marked.

        Returns:
            uint8 [H, W], 255 = remembered, 0 elsewhere; None if no pixel is.
        """
        seen = (rendered.content or rendered.frame).tissue
        if whole or (seen is not None and seen.shape != rendered.alpha.shape):
            layer = np.asarray(cv2.inRange(rendered.alpha, COVERED, np.inf), np.uint8)
        elif seen is None:
            return None
        else:
            layer = np.empty(seen.shape, np.uint8)
            cv2.threshold(np.asarray(seen, np.uint8), 0, 255, cv2.THRESH_BINARY_INV, dst=layer)
            left, top, wide, high = box = _box(layer)
            if not wide:
                return None
            self._found = layer, box
            hidden, alpha = (plane[top : top + high, left : left + wide] for plane in (layer, rendered.alpha))
            # Fast path: the masked area is usually opaque everywhere. NaN fails the comparison.
            if alpha.min() >= COVERED:
                return layer
            cv2.bitwise_and(hidden, cv2.inRange(alpha, COVERED, np.inf), dst=hidden)
        return layer if cv2.countNonZero(layer) else None

    def mark(
        self, picture: NDArray[np.uint8], layer: NDArray[np.uint8], tissue: NDArray[np.uint8] | None = None
    ) -> None:
        """Draw masked pixels in dark grey, in place.

        Args:
            picture: uint8 RGB [H, W, 3], modified.
            layer: uint8 [H, W] from `layer`, 255 = remembered.
            tissue: uint8 [H, W], 0 = tool; draws a light outline along tool borders. None for no outline.
        """
        height, width = layer.shape
        if self._grey.shape != layer.shape:
            self._resize(height, width)
        line = max(1, round(height / LINES_PER_HEIGHT))
        known = self._found is not None and self._found[0] is layer
        left, top, wide, high = self._found[1] if known and self._found is not None else _box(layer)
        rows = slice(max(0, top - line), min(height, top + high + line))
        columns = slice(max(0, left - line), min(width, left + wide + line))
        marked, pixels = layer[rows, columns], picture[rows, columns]
        grey, colourless = self._grey[rows, columns], self._colourless[rows, columns]
        cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY, dst=grey)
        cv2.convertScaleAbs(grey, dst=grey, alpha=DARKENED)
        if tissue is not None and tissue.shape == layer.shape:
            cv2.max(grey, self._line(tissue, rows, columns, line), dst=grey)
        cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB, dst=colourless)
        cv2.copyTo(colourless, marked, pixels)

    def _line(self, tissue: NDArray[np.uint8], rows: slice, columns: slice, width_px: int) -> NDArray[np.uint8]:
        """Return a mask of tool pixels within `width_px` of tissue, 255 = outline."""
        tools, inner = self._tools[rows, columns], self._scratch[rows, columns]
        cv2.threshold(np.asarray(tissue[rows, columns], np.uint8), 0, 255, cv2.THRESH_BINARY_INV, dst=tools)
        # Erosion treats pixels beyond the picture's border as tool, so no line is drawn along it.
        cv2.erode(tools, np.ones((2 * width_px + 1, 2 * width_px + 1), np.uint8), dst=inner)
        return np.asarray(cv2.subtract(tools, inner, dst=inner), np.uint8)


def _box(layer: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Return the bounding box of nonzero pixels: left, top, width, height."""
    left, top, wide, high = cv2.boundingRect(layer)
    return left, top, wide, high


def marked(rendered: RenderedFrame) -> NDArray[np.uint8]:
    """Return the rendered picture with remembered tissue marked. It is a copy only if something is marked."""
    tissue = RememberedTissue()
    layer = tissue.layer(rendered)
    if layer is None:
        return rendered.image
    picture = rendered.image.copy()
    tissue.mark(picture, layer, (rendered.content or rendered.frame).mask)
    return picture


def share_of(gaussians: Gaussians, chosen: Tensor, camera: Camera) -> Tensor:
    """Return each pixel's share of chosen Gaussians in the blended weight.

    Args:
        gaussians: all Gaussians.
        chosen: bool [N].
        camera: camera of the picture.

    Returns:
        [H, W] in 0..1; 0 where nothing is rendered.
    """
    require_shape("chosen", chosen, (gaussians.count,), "[N]")
    colours = (chosen.to(gaussians.dtype) - 0.5) / SH_C0
    with torch.no_grad():
        seen = render(replace(gaussians, sh=colours[:, None, None].expand(-1, 1, 3).contiguous()), camera, depth=False)
    return torch.where(seen.alpha > 0, seen.image[..., 0] / seen.alpha.clamp(min=1e-6), 0).clamp(0, 1)
