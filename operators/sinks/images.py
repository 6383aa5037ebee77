"""Lossless images on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from operators.errors import OutputError
from operators.storage import StorageReserve, write_whole


def write_png(path: Path, image: NDArray[Any], reserve: StorageReserve | None = None) -> None:
    """Write a PNG file atomically.

    Args:
        path: the file.
        image: uint8 or uint16, RGB [H, W, 3] or one channel [H, W].
        reserve: free disk space to be kept; None for no check.

    Raises:
        InvalidInput: the array has another shape or type.
        StorageFull, OutputError: the file cannot be written.
    """
    pictured = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not pictured or image.dtype not in (np.uint8, np.uint16):
        raise InvalidInput(
            f"{path.name}: an image must be [H, W] or [H, W, 3] of uint8 or uint16, got {list(image.shape)} of {image.dtype}"
        )
    coded, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not coded:
        raise OutputError(f"{path}: OpenCV {cv2.__version__} cannot code an image {list(image.shape)} as PNG")
    write_whole(path, data.tobytes(), reserve)
