"""Rules on paths that a run must not write to: recordings, inputs, home and current folders."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from operators.errors import OutputError
from operators.own_files import is_own_file

_UNSPECIFIC = frozenset({"images", "flow", "views"})
SIDECARS = _UNSPECIFIC | {"images_right", "masks", "depth", "true_depth", "scene_flow"}
"""Names of sub-folders that belong to a recording."""
DESCRIPTIONS = ("recording.json", "cameras.json", "poses_bounds.npy", "valid_mask.png", "session.json")
"""Names of files that occur only in a recording's folder."""
MAX_PATH_BYTES = 4096
BATCH_DATABASE = "batch.sqlite"
"""Database next to the results of a batch. Other runs must not replace these results."""
MARKER = ".intrasplat.json"
"""Marker file of folders that this program created."""
_PICTURES = frozenset({".png", ".jpg", ".jpeg", ".npy", ".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v"})


def check_folder_path(out: Path, inputs: Sequence[Path] = ()) -> None:
    """Check that a run may use `out` as its output folder.

    Args:
        out: the output folder.
        inputs: files and folders that the run reads.

    Raises:
        OutputError: `out` is a protected folder, or contains or is part of an input or recording.
    """
    if len(os.fsencode(out)) >= MAX_PATH_BYTES:
        raise OutputError(f"--out has {len(os.fsencode(out))} bytes; a path has at most {MAX_PATH_BYTES - 1}")
    real = Path(os.path.realpath(out))
    for place, what in ((Path("/"), "the root of the file system"), (_home(), "your home folder")):
        if _same(real, place):
            raise OutputError(f"--out is {what}; give a folder for the results alone")
    if _same(real, Path.cwd()):
        raise OutputError("--out is empty or the current folder; give the name of a folder for the results alone")
    if (real.parent / BATCH_DATABASE).is_file():
        raise OutputError(f"--out {out} is a result of the batch in {real.parent}; choose another --out")
    for source in inputs:
        if any(_same(parent, real) for parent in _with_parents(source)):
            raise OutputError(f"{source} lies inside --out {out}, where the results are replaced; choose another --out")
    check_beside_recordings(real, out, inputs)


def check_file_path(
    out: Path,
    inputs: Sequence[Path] = (),
    *,
    overwrite: bool = False,
    into_recording: bool = False,
    option: str = "--out",
) -> None:
    """Raise OutputError if a command with these inputs must not write the file `out`.

    With `overwrite`, an earlier output of this program is replaced, and no other file. An input, a
    part of one or a hard link to one is never replaced, and no file is put among a recording's
    pictures.

    Args:
        out: the output file.
        inputs: files and folders that the command reads.
        overwrite: replace an earlier output.
        into_recording: `out` belongs into a recording's folder, next to its description.
        option: command line option that set `out`, for the messages.
    """
    if "\0" in str(out) or len(os.fsencode(out)) >= MAX_PATH_BYTES:
        raise OutputError(f"{option} {str(out)[:80]!r} is no name that a file can have; give another one")
    try:
        _check_file_path(out, inputs, overwrite, into_recording, option)
    except OSError as error:
        raise OutputError(f"{option} {out} cannot be used: {error.strerror or error}; choose another one") from error


def _check_file_path(out: Path, inputs: Sequence[Path], overwrite: bool, into_recording: bool, option: str) -> None:
    real = Path(os.path.realpath(out))
    if out.is_dir():
        raise OutputError(f"{out} is a folder; give the name of a file")
    if any(_same(source, real) for source in inputs):
        raise OutputError(f"{out} is what the command reads; choose another {option}")
    if into_recording:
        inputs = [source for source in inputs if not _same(source, real.parent)]
    else:
        _check_no_recording(real.parent, option)
    check_beside_recordings(real, out, inputs, option)
    if not out.parent.is_dir():
        raise OutputError(f"there is no folder {out.parent} to write {out.name} into; make it first")
    if not os.path.lexists(out):
        return
    if not overwrite:
        raise OutputError(f"{out} is there already; give another {option}, or --overwrite to replace it")
    if out.is_symlink() or not out.is_file():
        raise OutputError(f"{out} is not a plain file, so that it is not replaced; give another {option}")
    if (part := _part_of(inputs, out)) is not None:
        raise OutputError(f"{out} is {part} by another name, which the command reads; choose another {option}")
    if not is_own_file(out):
        raise OutputError(f"{out} was not written by intrasplat, so that it is not replaced; give another {option}")


def _check_no_recording(folder: Path, option: str) -> None:
    found = [name for name in DESCRIPTIONS if os.path.lexists(folder / name)]
    found += [name for name in sorted(SIDECARS) if _holds_pictures(folder / name)]
    if found:
        raise OutputError(f"{folder} is a recording's folder (it holds {', '.join(found)}); choose another {option}")


def _part_of(inputs: Sequence[Path], out: Path) -> Path | None:
    """Return the input file of which `out` is a hard link; None if there is none."""
    status = out.stat()
    if status.st_nlink < 2:
        return None
    for source in inputs:
        for parent, _, names in os.walk(source):
            for name in names:
                found = Path(parent) / name
                if found != out and _same(found, out):
                    return found
    return None


def check_beside_recordings(real: Path, out: Path, inputs: Sequence[Path], option: str = "--out") -> None:
    """Raise OutputError if an output path is inside an input or among a recording's images, masks
    or depth.

    Args:
        real: the resolved output path.
        out: the path as given by the user, for the messages.
        inputs: paths that the command reads.
        option: command line option that set the path, for the messages.
    """
    for source in inputs:
        if any(_same(parent, source) for parent in _with_parents(real)):
            raise OutputError(f"{option} {out} lies inside {source}, which the run reads; choose another {option}")
    for part in _with_parents(real):
        if part.name.lower() in SIDECARS and _has_sidecar(part.parent, part.name.lower()):
            raise OutputError(
                f"{option} {out} lies in {part}, which belongs to the recording {part.parent}; choose another {option}"
            )


def _has_sidecar(folder: Path, name: str) -> bool:
    """Return True if the sub-folder `name` of `folder` is part of a recording there (see
    `layouts`).
    """
    if (folder / MARKER).exists() or not folder.is_dir():
        return False
    if any((folder / description).exists() for description in DESCRIPTIONS):
        return True
    # Next to a video or pictures, sub-folders of unspecific names are not read by the recording's
    # loader.
    return name not in _UNSPECIFIC and (_holds_pictures(folder / "images") or _holds_pictures(folder))


def _holds_pictures(folder: Path) -> bool:
    """Return True if the folder contains pictures, videos or arrays that are not results of this
    program.
    """
    if (folder / MARKER).exists() or not folder.is_dir():
        return False
    return any(entry.suffix.lower() in _PICTURES for entry in folder.iterdir())


def _with_parents(path: Path) -> Iterator[Path]:
    real = Path(os.path.realpath(path))
    yield real
    yield from real.parents


def _same(first: Path, second: Path) -> bool:
    """Return True if both paths name one file or folder, also through bind mounts or ignored
    case.
    """
    if first == second:
        return True
    try:
        return os.path.samefile(first, second)
    except OSError:
        return False


def _home() -> Path:
    return Path(os.path.realpath(os.path.expanduser("~")))
