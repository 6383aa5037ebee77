"""Protection of existing folders from being overwritten by a synthetic recording.

Accepted targets are new folders, empty folders, and folders that contain only files of an earlier `synthesize` call.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import read_regular

GENERATOR = "intrasplat synthesize"
_FRAME = r"frame-\d{6}\."
_WRITTEN = re.compile(
    rf"(views/third/)?(images/{_FRAME}color|masks/{_FRAME}mask|depth/{_FRAME}depth)\.png"
    rf"|images_right/{_FRAME}color\.png|true_depth/{_FRAME}depth\.png|(scene_)?flow/\d{{6}}\.npy"
    r"|poses_bounds\.npy|tracks\.npy|tracks_seen\.npy|recording\.json|views\.json"
)
"""Pattern of the files written by `synthesize`."""
_FOLDERS = frozenset(f"{inside}{name}" for inside in ("", "views/third/") for name in ("images", "masks", "depth")) | {
    "images_right",
    "true_depth",
    "flow",
    "scene_flow",
    "views",
    "views/third",
}


def check_target(target: Path) -> None:
    """Check that `target` can be replaced without losing foreign files.

    Raises:
        InvalidSetting: if it contains anything that `synthesize` did not write.
        OSError: if the name is impossible.
    """
    try:
        os.lstat(target)
    except FileNotFoundError:
        return
    if target.is_symlink():
        raise InvalidSetting(f"{target} is a link; give the folder itself, or one that does not exist yet")
    if not target.is_dir():
        raise InvalidSetting(f"{target} is a file; give a folder that does not exist yet")
    if os.path.ismount(target):
        raise InvalidSetting(f"{target} is the root of a disk, which cannot be replaced; give a folder on it")
    foreign = sorted(_foreign(target))
    if foreign:
        raise InvalidSetting(
            f"{target} holds what synthesize did not write ({', '.join(foreign[:5])}); give a new or an empty folder"
        )


def _foreign(target: Path) -> Iterator[str]:
    """Yield the names of entries that no earlier `synthesize` call wrote.

    Every entry is foreign unless the folder contains a synthetic recording's description.
    """
    description = target / "recording.json"
    ours = description.is_file() and _made_here(description)
    folders = [target]
    for folder in folders:
        for entry in folder.iterdir():
            name = entry.relative_to(target).as_posix()
            if not ours or entry.is_symlink():
                yield name
            elif name in _FOLDERS and entry.is_dir() and not os.path.ismount(entry):
                folders.append(entry)
            elif not (_WRITTEN.fullmatch(name) and entry.is_file()):
                yield name


def _made_here(description: Path) -> bool:
    try:
        content = json.loads(read_regular(description, 1 << 20))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("generator") == GENERATOR
