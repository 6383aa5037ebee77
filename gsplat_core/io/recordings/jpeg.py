"""JPEG with the decoder's own doubts: libjpeg repairs damage as it decodes and only warns. simplejpeg reports the warnings."""

from __future__ import annotations

import warnings

import numpy as np
import simplejpeg
from numpy.typing import NDArray

_RGB_SPACES = frozenset({"RGB", "YCbCr", "Gray"})


def decode_jpeg(data: bytes) -> tuple[NDArray[np.uint8], str | None] | None:
    """RGB [H, W, 3] and what libjpeg had to repair (None: nothing). None where it can decode nothing, or where the colours
    are neither grey nor RGB nor YCbCr."""
    try:
        space = simplejpeg.decode_jpeg_header(data)[2]
        if space not in _RGB_SPACES:
            return None
        return simplejpeg.decode_jpeg(data, "RGB", strict=True), None
    except ValueError as error:
        damage = str(error)
    try:
        with warnings.catch_warnings(action="ignore"):
            return simplejpeg.decode_jpeg(data, "RGB", strict=False), damage
    except ValueError:
        return None


def jpeg_damage(data: bytes) -> str | None:
    """What libjpeg would have to repair in a JPEG; None for nothing, and for what it does not decode at all."""
    try:
        simplejpeg.decode_jpeg(data, "GRAY", strict=True)
    except ValueError as error:
        text = str(error)
        return text if "corrupt" in text.lower() or "premature" in text.lower() else None
    return None
