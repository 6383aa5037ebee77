"""Which part of a picture shows tissue that nobody sees at this moment, and how that is marked."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.endoscope.stage import tissue_of
from operators.messages import RenderedFrame

COVERED = 0.1
"""Opacity from which on a picture shows something; where it is more transparent it is nearly black, and nothing is remembered there."""
DARKENED = 0.65
"""How bright remembered tissue is drawn, beside what it was; it is drawn without colour."""
LINES_PER_HEIGHT = 300
"""The outline's width is the picture's height over this: 2 px of 512, so that video coding leaves it there."""


class RememberedTissue:
    """Finds remembered tissue in pictures from the endoscope's own view, and marks it.

    Keeps the memory that it works in, of the size of the last picture. For one thread at a time.
    """

    def __init__(self) -> None:
        self._resize(0, 0)
        self._found: tuple[NDArray[np.uint8], tuple[int, int, int, int]] | None = None
        """The last layer, and a box with all of it: left, top, width and height."""

    def _resize(self, height_px: int, width_px: int) -> None:
        self._grey, self._tools, self._scratch = (np.empty((height_px, width_px), np.uint8) for _ in range(3))
        self._colourless = np.empty((height_px, width_px, 3), np.uint8)

    def layer(self, rendered: RenderedFrame, whole: bool = False) -> NDArray[np.uint8] | None:
        """uint8 [H, W], 255 where the picture shows tissue that the frame whose content it shows does not: behind a tool, under a
        recorder's strip, outside of the field of view. 0 elsewhere; None where there is none.

        whole: nobody sees any of the picture. Highlights are seen: the picture has them as the frame has them.
        """
        seen = tissue_of(rendered.content or rendered.frame)
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
            # Most often the picture is opaque there; NaN is not.
            if alpha.min() >= COVERED:
                return layer
            cv2.bitwise_and(hidden, cv2.inRange(alpha, COVERED, np.inf), dst=hidden)
        return layer if cv2.countNonZero(layer) else None

    def mark(
        self, picture: NDArray[np.uint8], layer: NDArray[np.uint8], tissue: NDArray[np.uint8] | None = None
    ) -> None:
        """Draw the pixels of a layer without colour and darker into an RGB picture [H, W, 3], in place; all others stay as they are.

        tissue: uint8 [H, W], 0 where a tool is: along its border the layer gets a light line. The border of the field of view needs none.
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
        """255 on the tools' pixels that are so close to tissue."""
        tools, inner = self._tools[rows, columns], self._scratch[rows, columns]
        cv2.threshold(np.asarray(tissue[rows, columns], np.uint8), 0, 255, cv2.THRESH_BINARY_INV, dst=tools)
        # What lies beyond the picture's border counts as tool: no line is drawn along it.
        cv2.erode(tools, np.ones((2 * width_px + 1, 2 * width_px + 1), np.uint8), dst=inner)
        return np.asarray(cv2.subtract(tools, inner, dst=inner), np.uint8)


def _box(layer: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Left, top, width and height of the smallest box with all that is not 0."""
    left, top, wide, high = cv2.boundingRect(layer)
    return left, top, wide, high


def marked(rendered: RenderedFrame) -> NDArray[np.uint8]:
    """The rendered picture with remembered tissue marked: a copy, or itself where there is none."""
    tissue = RememberedTissue()
    layer = tissue.layer(rendered)
    if layer is None:
        return rendered.image
    picture = rendered.image.copy()
    tissue.mark(picture, layer, (rendered.content or rendered.frame).mask)
    return picture
