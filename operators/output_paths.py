"""Where a run must not write: into a recording, over its own input, over what the user works in."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from operators.errors import OutputError

SIDECARS = frozenset({"images", "images_right", "masks", "depth"})
"""Folders inside a recording whose every file belongs to it."""
DESCRIPTIONS = ("recording.json", "cameras.json", "poses_bounds.npy")
"""Files that only a recording's folder has."""
MAX_PATH_BYTES = 4096
MARKER = ".intrasplat.json"
"""Lies in every folder that this program has made, and only there."""
_PICTURES = frozenset({".png", ".jpg", ".jpeg", ".npy", ".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v"})


def check_folder_path(out: Path, inputs: Sequence[Path] = ()) -> None:
    """Raises OutputError where a run with these inputs must not collect its results in the folder `out`."""
    if len(os.fsencode(out)) >= MAX_PATH_BYTES:
        raise OutputError(f"--out has {len(os.fsencode(out))} bytes; a path has at most {MAX_PATH_BYTES - 1}")
    real = Path(os.path.realpath(out))
    for place, what in ((Path("/"), "the root of the file system"), (_home(), "your home folder")):
        if _same(real, place):
            raise OutputError(f"--out is {what}; give a folder for the results alone")
    if _same(real, Path.cwd()):
        raise OutputError("--out is empty or the current folder; give the name of a folder for the results alone")
    for source in inputs:
        if any(_same(parent, real) for parent in _with_parents(source)):
            raise OutputError(f"{source} lies inside --out {out}, where the results are replaced; choose another --out")
    check_beside_recordings(real, out, inputs)


def check_file_path(out: Path, inputs: Sequence[Path] = ()) -> None:
    """Raises OutputError where a run with these inputs must not write the file `out`."""
    real = Path(os.path.realpath(out))
    if any(_same(source, real) for source in inputs):
        raise OutputError(f"{out} is what the run reads; choose another --out")
    folder = real.parent
    found = [name for name in DESCRIPTIONS if os.path.lexists(folder / name)]
    found += [name for name in sorted(SIDECARS) if _holds_pictures(folder / name)]
    if found:
        raise OutputError(f"{folder} is a recording's folder (it holds {', '.join(found)}); choose another --out")
    check_beside_recordings(real, out, inputs)


def check_beside_recordings(real: Path, out: Path, inputs: Sequence[Path]) -> None:
    """Raises OutputError when `real`, which the user called `out`, is inside an input or among a recording's images, masks or depth."""
    for source in inputs:
        if any(_same(parent, source) for parent in _with_parents(real)):
            raise OutputError(f"--out {out} lies inside {source}, which the run reads; choose another --out")
    for part in _with_parents(real):
        if part.name.lower() in SIDECARS and _has_sidecar(part.parent, part.name.lower()):
            raise OutputError(
                f"--out {out} lies in {part}, which belongs to the recording {part.parent}; choose another --out"
            )


def _has_sidecar(folder: Path, name: str) -> bool:
    """Whether a folder called `name` inside `folder` is part of a recording there (see `layouts`)."""
    if (folder / MARKER).exists() or not folder.is_dir():
        return False
    if any((folder / description).exists() for description in DESCRIPTIONS):
        return True
    # Beside a video or pictures a folder called images means nothing; the other three are read along with them.
    return name != "images" and (_holds_pictures(folder / "images") or _holds_pictures(folder))


def _holds_pictures(folder: Path) -> bool:
    """Whether a folder has pictures, videos or arrays of its own, and not those of a run of ours."""
    if (folder / MARKER).exists() or not folder.is_dir():
        return False
    return any(entry.suffix.lower() in _PICTURES for entry in folder.iterdir())


def _with_parents(path: Path) -> Iterator[Path]:
    real = Path(os.path.realpath(path))
    yield real
    yield from real.parents


def _same(first: Path, second: Path) -> bool:
    """Whether two names lead to one file or folder; a bind mount or a system that ignores case gives one folder two names."""
    if first == second:
        return True
    try:
        return os.path.samefile(first, second)
    except OSError:
        return False


def _home() -> Path:
    return Path(os.path.realpath(os.path.expanduser("~")))
