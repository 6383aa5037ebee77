"""Safe reading of untrusted model files: regular files only, non-blocking, inside their folder, in blocks of rows."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, BundleError
from gsplat_core.io.files import open_regular
from gsplat_core.machine import available_bytes, in_gib

if TYPE_CHECKING:
    from gsplat_core.scene.gaussians import Gaussians


def open_model_file(path: Path, folder: Path | None = None) -> BinaryIO:
    """Open the regular file `path` for reading.

    Args:
        path: file to open.
        folder: folder that symbolic links must not leave; None allows any target.

    Returns:
        Binary stream.

    Raises:
        BundleError: if the file is missing, unreadable, not a regular file (a pipe, device, socket
            or folder), or outside `folder`.
    """
    try:
        real = os.path.realpath(path, strict=True)
        if folder is not None and not Path(real).is_relative_to(os.path.realpath(folder)):
            raise BundleError(f"{path} is a link that leads out of its folder; copy the file in place of linking it")
        return open_regular(real, follow_links=False)
    except FileNotFoundError as error:
        raise BundleError(f"{path} is missing; check the name, or copy the model again") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BundleError(f"{path} cannot be read: {reason}; copy the model again") from error


def check_memory(path: Path, needed: int) -> None:
    """Raise BundleError if loading `path` needs more than the available memory.

    Args:
        path: file named in the message.
        needed: size in bytes.
    """
    available = available_bytes()
    if available is not None and needed > available:
        raise BundleError(
            f"{path} needs {in_gib(needed)} of memory to load, and {in_gib(available)} are available; free some, or use a machine with more"
        )


BLOCK_BYTES = 4 << 20
"""Size in bytes of the blocks in which rows of Gaussians are read and written."""
MOST_THREADS = 8


def read_rows(
    descriptor: int,
    path: Path,
    start: int,
    layout: np.dtype[Any],
    count: int,
    take: Callable[[int, NDArray[Any]], None],
) -> None:
    """Read rows of equal size in blocks, on several threads.

    Args:
        descriptor: open file.
        path: name for messages.
        start: offset of the first row in bytes.
        layout: dtype of a row.
        count: number of rows.
        take: called with the number of a block's first row and the block; it writes to its own part of the results.

    Raises:
        BundleCorrupt: if the file ends before the last row.
    """
    step = max(1, BLOCK_BYTES // layout.itemsize)

    def work(first: int) -> None:
        rows = np.empty(min(step, count - first), layout)
        raw = memoryview(rows.view(np.uint8).data)
        done = 0
        while done < len(raw):
            read = os.preadv(descriptor, [raw[done:]], start + first * layout.itemsize + done)
            if read == 0:
                raise BundleCorrupt(f"{path} became shorter while it was read; copy it again")
            done += read
        take(first, rows)

    firsts = range(0, count, step)
    threads = min(MOST_THREADS, os.cpu_count() or 1, len(firsts))
    if threads <= 1:
        for first in firsts:
            work(first)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, firsts):
            pass


def gaussians_of(
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    logits: NDArray[np.float32],
    sh: NDArray[np.float32],
) -> Gaussians:
    """Return Gaussians whose tensors share the memory of the NumPy arrays."""
    # Imported lazily, because the service opens model files in processes without torch.
    import torch

    from gsplat_core.scene.gaussians import Gaussians

    tensors = [torch.from_numpy(array) for array in (means, quats, log_scales, logits, sh)]
    return Gaussians(tensors[0], tensors[1], tensors[2], tensors[3], tensors[4])


LEAST_OPACITY = 1e-4
"""Opacity to which the stored byte 0 is converted. The byte 255 becomes 1 minus this value, so that both have finite logits."""


def logit_of_bytes(opacities: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
    """Convert opacities stored as bytes 0 to 255 to logits."""
    share = np.clip(np.arange(256) / 255.0, LEAST_OPACITY, 1 - LEAST_OPACITY)
    return np.log(share / (1 - share)).astype(np.float32)[opacities]
