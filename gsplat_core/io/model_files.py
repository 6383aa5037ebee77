"""Safe opening of untrusted model files: regular files only, non-blocking, inside their folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

from gsplat_core.errors import BundleError
from gsplat_core.io.files import open_regular
from gsplat_core.memory import available_bytes, in_gib


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
