"""Pictures on disk, lossless."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from operators.errors import OutputError
from operators.storage import StorageReserve, write_whole


def write_png(path: Path, image: NDArray[Any], reserve: StorageReserve | None = None) -> None:
    """Write an RGB uint8 [H, W, 3] or a one-channel image [H, W] as PNG, whole or not at all.

    Raises:
        StorageFull: there is no room.
        OutputError: the image cannot be coded.
    """
    coded, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not coded:
        raise OutputError(
            f"{path}: an image {list(image.shape)} of {image.dtype} cannot be coded as PNG; give uint8 or uint16"
        )
    write_whole(path, data.tobytes(), reserve)
