"""Which folder a synthetic recording may take the place of: a new one, an empty one, or what an earlier call wrote, and nothing more."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

from gsplat_core.errors import InvalidSetting

GENERATOR = "intrasplat synthesize"
_WRITTEN = {
    "images": r"frame-\d{6}\.color\.png",
    "images_right": r"frame-\d{6}\.color\.png",
    "masks": r"frame-\d{6}\.mask\.png",
    "depth": r"frame-\d{6}\.depth\.png",
    "poses_bounds.npy": "",
    "tracks.npy": "",
    "recording.json": "",
}
"""What this module writes: a folder with the names of its files, or a file."""


def check_target(target: Path) -> None:
    """Raises InvalidSetting unless `target` can be replaced whole without losing anything that `synthesize` did not write; OSError for a
    name that cannot be one."""
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
    """What is in the folder and not of an earlier `synthesize`: everything, unless its description lies there."""
    description = target / "recording.json"
    ours = description.is_file() and _made_here(description)
    for entry in target.iterdir():
        pattern = _WRITTEN.get(entry.name)
        if not ours or pattern is None or entry.is_symlink():
            yield entry.name
        elif pattern == "":
            if not entry.is_file():
                yield entry.name
        elif not entry.is_dir() or os.path.ismount(entry):
            yield entry.name
        else:
            yield from (
                f"{entry.name}/{part.name}"
                for part in entry.iterdir()
                if not re.fullmatch(pattern, part.name) or part.is_symlink() or not part.is_file()
            )


def _made_here(description: Path) -> bool:
    with description.open("rb") as file:
        try:
            content = json.loads(file.read(1 << 20))
        except (ValueError, RecursionError):
            return False
    return isinstance(content, dict) and content.get("generator") == GENERATOR
