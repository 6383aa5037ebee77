"""Output folder of a run, and the files that a run may write or replace.

An output folder is new, empty, or the output of an earlier run of this program. Outputs never replace recordings,
inputs, home or current folders, or files of other programs. A lock prevents two runs from writing into one folder.

`--overwrite` replaces only files that this program wrote. They are recognised by a mark in the file: a comment in
`.ply`, `.spz` and `.mp4`, the generator of `.glb`, bytes after the array of `.npy`.
A `.splat` has no space for a mark, so its rows are validated instead.

A run collects its results in the staging folder `.run-…` inside the output folder. At the end the results replace the
earlier ones in one transaction:

    .run-…  →  .complete-…   commit point: the new results are valid
    the earlier results      → .old-…
    the new results          → their names
    .old-… is removed

An interruption never mixes two runs. Before the commit point the earlier results are untouched. After it, the next
run in the folder completes the remaining steps.

The marker file lists every file of a run with a fingerprint. Only listed files are replaced or removed. A run refuses
a folder with modified listed files or foreign files among the results. Files that appear during a run are moved to
`kept-…`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsplat_core.io.exports.export import TIMES_FILE
from gsplat_core.io.exports.files import ROW
from gsplat_core.io.files import open_regular, read_regular, replace_durably, sync_folder, unfinished
from gsplat_core.io.ply import MARK_LINE
from gsplat_core.io.recordings.calibration import TRAILER
from gsplat_core.io.spz import GZIP_START
from operators.errors import OutputError, OutputFolderInUse
from operators.storage import STAGING_PREFIX, storage_errors, write_whole

_MOST_JSON_BYTES = 64 << 20


def is_own_file(path: Path) -> bool:
    """Return True if this program wrote the file, by the mark for its suffix. False for a missing or unreadable file."""
    recognise = _KINDS.get(path.suffix.lower())
    if recognise is None:
        return False
    try:
        with open_regular(path) as file:
            return recognise(file)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, struct.error, zipfile.BadZipFile):
        return False


def _ply(file: BinaryIO) -> bool:
    return any(line.strip() == MARK_LINE.encode() for line in file.read(512).split(b"\n")[:4])


def _glb(file: BinaryIO) -> bool:
    magic, _, _, length, kind = struct.unpack("<4sIII4s", file.read(20))
    if magic != b"glTF" or kind != b"JSON" or length > _MOST_JSON_BYTES:
        return False
    return json.loads(file.read(length))["asset"]["generator"] == "IntraSplat"


def _npy(file: BinaryIO) -> bool:
    if file.read(6) != b"\x93NUMPY":
        return False
    file.seek(-len(TRAILER), os.SEEK_END)
    return file.read() == TRAILER


def _mp4(file: BinaryIO) -> bool:
    import av

    from operators.sinks.video import MARK

    try:
        with av.open(file, format="mp4") as container:
            return container.metadata.get("comment") == MARK
    except av.FFmpegError:
        return False


def _splat(file: BinaryIO) -> bool:
    data = file.read(1 << 24)
    size = os.fstat(file.fileno()).st_size
    if not data or size % ROW.itemsize:
        return False
    rows = np.frombuffer(data[: len(data) - len(data) % ROW.itemsize], ROW)
    return bool(np.isfinite(rows["position"]).all() and np.isfinite(rows["scale"]).all() and (rows["scale"] >= 0).all())


def _spz(file: BinaryIO) -> bool:
    return file.read(len(GZIP_START)) == GZIP_START


def _sequence(file: BinaryIO) -> bool:
    with zipfile.ZipFile(file) as archive:
        return archive.namelist()[:2] == [TIMES_FILE, "0000.ply"]


def _packed(file: BinaryIO) -> bool:
    """Return True for a tar archive whose first member is a manifest, as written by `pack`."""
    block = file.read(512)
    return block[:100].rstrip(b"\0") == b"manifest.json" and block[257:262] == b"ustar"


def _page(file: BinaryIO) -> bool:
    head = file.read(4096)
    return head.startswith(b"<!doctype html>") and b"IntraSplat" in head


def _report(file: BinaryIO) -> bool:
    values = json.loads(file.read(_MOST_JSON_BYTES))
    return isinstance(values, dict) and {"series", "outputs", "notes"} <= set(values)


def _frames(file: BinaryIO) -> bool:
    entry = json.loads(file.readline(1 << 16))
    return isinstance(entry, dict) and {"seq", "psnr_tissue_db"} <= set(entry)


_KINDS: dict[str, Callable[[BinaryIO], bool]] = {
    ".ply": _ply,
    ".glb": _glb,
    ".npy": _npy,
    ".mp4": _mp4,
    ".splat": _splat,
    ".spz": _spz,
    ".zip": _sequence,
    ".isplat": _packed,
    ".html": _page,
    ".json": _report,
    ".jsonl": _frames,
}
LOCK = ".intrasplat.lock"
_CANNOT_LOCK = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


class FolderLock:
    """Context manager that holds an exclusive lock on a folder.

    The lock is a `flock` on a file in the folder. The operating system releases the lock when the
    process ends, even after a crash. On NFS, Linux forwards the lock to the server, so the lock
    also excludes runs on other machines if the server supports locks.

    Raises:
        OutputFolderInUse: another run holds the lock; the message names its process.
        OutputError: the file system does not support locks.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / LOCK
        self._descriptor = -1

    def __enter__(self) -> FolderLock:
        while not self._taken():
            pass  # the previous run deleted its lock file between open and flock: retry with a new file
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, f"{os.getpid()}\n".encode())
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(FileNotFoundError):  # the folder was deleted during the run
            self._path.unlink()
        os.close(self._descriptor)

    def _taken(self) -> bool:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.lstat(self._path)):
                    self._descriptor, descriptor = descriptor, -1
                    return True
            return False
        except BlockingIOError as error:
            pid = os.read(descriptor, 32).decode("ascii", "replace").strip()
            raise OutputFolderInUse(
                f"another run writes into {self.folder} (process {pid or 'unknown'}); wait for its end or choose another --out"
            ) from error
        except OSError as error:
            if error.errno not in _CANNOT_LOCK:
                raise
            self._path.unlink()
            raise OutputError(
                f"{self.folder} is on a file system that cannot lock files ({error.strerror}); choose another --out"
            ) from error
        finally:
            if descriptor >= 0:
                os.close(descriptor)


_UNSPECIFIC = frozenset({"images", "flow", "views"})
SIDECARS = _UNSPECIFIC | {"images_right", "masks", "depth", "true_depth", "scene_flow"}
"""Names of sub-folders in which recordings store data next to their pictures; outputs must not replace them."""
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
        OutputError: `out` is too long, a protected folder or a result of a batch, or contains or is part of an input or
            recording.
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

    With `overwrite`, an earlier output of this program is replaced, and no other file. An input, a part of one or a
    hard link to one is never replaced, and no file is put among a recording's pictures.

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
        raise OutputError(f"{out} already exists; give another {option}, or --overwrite to replace it")
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
    """Return the file inside an input folder of which `out` is a hard link; None if there is none."""
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
    """Raise OutputError if an output path is inside an input or among a recording's images, masks or depth.

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
    """Return True if the sub-folder `name` of `folder` is part of a recording there (see `layouts`)."""
    if (folder / MARKER).exists() or not folder.is_dir():
        return False
    if any((folder / description).exists() for description in DESCRIPTIONS):
        return True
    # Next to a video or pictures, sub-folders of unspecific names are not read by the recording's loader.
    return name not in _UNSPECIFIC and (_holds_pictures(folder / "images") or _holds_pictures(folder))


def _holds_pictures(folder: Path) -> bool:
    """Return True if the folder contains pictures, videos or arrays that are not results of this program."""
    if (folder / MARKER).exists() or not folder.is_dir():
        return False
    return any(entry.suffix.lower() in _PICTURES for entry in folder.iterdir())


def _with_parents(path: Path) -> Iterator[Path]:
    real = Path(os.path.realpath(path))
    yield real
    yield from real.parents


def _same(first: Path, second: Path) -> bool:
    """Return True if both paths name one file or folder, also through bind mounts or ignored case."""
    if first == second:
        return True
    try:
        return os.path.samefile(first, second)
    except OSError:
        return False


def _home() -> Path:
    return Path(os.path.realpath(os.path.expanduser("~")))


_FORMAT = "intrasplat-output"
MOST_MARKER_BYTES = 1 << 26
_COMPLETE, _OLD, _KEPT = ".complete-", ".old-", "kept-"
_PASSING = re.compile(r"\.(run|complete|old)-[0-9a-f]{8}")
"""Names of the transaction folders of a running or killed run."""
_CONTENTS = ".contents.json"
_FINGERPRINT_BYTES = 1 << 16
RECORDINGS = "recordings"
"""Folder of recorded sessions, one sub-folder each. It is written during a run and never replaced by a later one."""
_RESULT = re.compile(
    r"reconstruction\.mp4|model|frames\.jsonl|report\.json|report\.html|\d{6,}\.png|evaluation\.(?:json|html)|evaluation-\w+\.jsonl"
)
"""Names of results. With the marker of an old version, which lists no files, all of them count as results of a run."""
_KNOWN = re.compile(rf"(?:{_RESULT.pattern})|model/(?:model(?:\.next)?\.safetensors|manifest(?:\.next)?\.json)")
"""Paths of result files. They identify the results of an old version, which recorded no fingerprints."""


class OutputFolder:
    """Context manager that owns an output folder exclusively.

    Write results to `path`, then call `publish()`. Without `publish()` the folder stays unchanged.
    `earlier` is True if the folder contains results of an earlier run.

    Raises:
        OutputError: writing to the folder is not allowed (see `check_folder_path`).
        OutputFolderInUse: the folder contains foreign files, or another run writes into it.
        StorageFull: the disk is full.
    """

    def __init__(self, folder: Path, made_by: str, inputs: Sequence[Path] = ()) -> None:
        """Set the parameters without touching the disk.

        Args:
            folder: the output folder.
            made_by: name of the command, for the marker.
            inputs: paths that the run reads; the folder must not overlap them.
        """
        self.folder, self.made_by, self.inputs = folder, made_by, tuple(inputs)
        self.earlier = False
        self._made: list[Path] = []
        self._stack = ExitStack()

    def __enter__(self) -> OutputFolder:
        with ExitStack() as stack, storage_errors(self.folder):
            check_folder_path(self.folder, self.inputs)
            check_output_folder(self.folder)
            stack.callback(self._remove_what_was_made)
            self._make()
            stack.enter_context(FolderLock(self.folder))
            # Another run may have ended between the first check and the lock.
            ours = check_output_folder(self.folder)
            _finish_what_was_begun(self.folder)
            self.earlier = ours and bool(_results(self.folder))
            if not ours:
                _write_marker(self.folder, self.made_by, ())
                stack.callback(self._remove_marker)
            self._token = secrets.token_hex(4)
            self.path = self.folder / f"{STAGING_PREFIX}{self._token}"
            self.path.mkdir()
            stack.callback(shutil.rmtree, self.path, ignore_errors=True)
            stack.enter_context(unfinished(self.path))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def publish(self) -> None:
        """Replace the earlier results by the contents of `path`. No effect if `path` is empty."""
        with storage_errors(self.folder):
            if not any(self.path.iterdir()):
                return
            complete = self.folder / f"{_COMPLETE}{self._token}"
            _write_contents(self.path)
            sync_folder(self.path)
            replace_durably(self.path, complete)
            try:
                _switch_to(self.folder, complete, self.made_by)
            except KeyboardInterrupt:
                _switch_to(
                    self.folder, complete, self.made_by
                )  # an interrupt must not leave the publication half done, and finishing it is quick
                raise

    def _make(self) -> None:
        missing = [part for part in (self.folder, *self.folder.parents) if not os.path.lexists(part)]
        for part in reversed(missing):
            with contextlib.suppress(FileExistsError):  # two runs create it concurrently; one of them gets the lock
                part.mkdir()
                self._made.append(part)

    def _remove_what_was_made(self) -> None:
        for part in reversed(self._made):
            with contextlib.suppress(OSError):  # not empty: it contains files or another program uses it
                part.rmdir()

    def _remove_marker(self) -> None:
        with contextlib.suppress(OSError):  # the folder was deleted during the run
            if not _results(self.folder) and not (self.folder / RECORDINGS).is_dir():
                (self.folder / MARKER).unlink()


def check_output_folder(folder: Path) -> bool:
    """Return True if `folder` contains an earlier run, whose results a new run replaces. Read-only.

    Raises:
        OutputFolderInUse: the folder is neither new, nor empty, nor an earlier run's, or it contains modified or
            foreign results.
    """
    if not os.path.lexists(folder):
        return False
    if not folder.is_dir():
        kind = "a link that leads nowhere" if folder.is_symlink() else "a file"
        raise OutputFolderInUse(f"{folder} is {kind}; give a folder that does not exist yet or is empty")
    if (marker := _read_marker(folder)) is not None:
        _check_results(folder, marker)
        return True
    others = sorted(entry.name for entry in folder.iterdir() if not _passing(entry.name))
    if others:
        names = ", ".join(others[:4]) + (", ..." if len(others) > 4 else "")
        raise OutputFolderInUse(
            f"{folder} is not empty and was not made by intrasplat (it holds {names}); "
            "choose another --out, so that nothing of yours is overwritten"
        )
    return False


def is_whole_output(folder: Path) -> bool:
    """Return True if the folder's marker is valid and every file that it lists exists."""
    marker = _read_marker(folder)
    if marker is None:
        return False
    listed = marker.get("files")
    names = [*(listed if isinstance(listed, list) else ()), *(_contents(marker, "contents") or ())]
    return all(os.path.lexists(folder / str(name)) for name in names)


def _check_results(folder: Path, marker: dict[str, object]) -> None:
    """Raise OutputFolderInUse if publishing would replace a file that no run of this program wrote."""
    ours = _results(folder)
    foreign = [entry.name for entry in folder.iterdir() if _RESULT.fullmatch(entry.name) and entry.name not in ours]
    if marker.get("arriving") is None:  # otherwise an interrupted transaction is pending, which the next run completes
        foreign += [
            path.relative_to(folder).as_posix() for path in _foreign_files(folder, ours, _contents(marker, "contents"))
        ]
    if foreign:
        raise OutputFolderInUse(
            f"{folder} holds {', '.join(sorted(foreign)[:4])}, which no run of intrasplat wrote like that; move it away or choose another --out"
        )


def _passing(name: str) -> bool:
    """Return True for the names of files and folders that only a running or killed run leaves in its output folder."""
    return name == LOCK or _PASSING.fullmatch(name) is not None


def _read_marker(folder: Path) -> dict[str, object] | None:
    try:
        marker = json.loads(read_regular(folder / MARKER, MOST_MARKER_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    return marker if isinstance(marker, dict) and marker.get("format") == _FORMAT else None


def _write_marker(folder: Path, made_by: str, files: Iterable[str], **more: object) -> None:
    """Write the marker file.

    Args:
        folder: the output folder.
        made_by: name of the command.
        files: names of results that are, or will be, in the folder.
        more: `contents` (fingerprints by path). During a transaction also `arriving` (source
            folder) and `earlier` (fingerprints of the replaced results).
    """
    marker = {"format": _FORMAT, "version": 1, "made_by": made_by, "files": sorted(files), **more}
    write_whole(folder / MARKER, (json.dumps(marker) + "\n").encode())


def _write_contents(results: Path) -> None:
    """Write the fingerprints of all files of a complete run into its results folder."""
    found = {path.relative_to(results).as_posix(): _fingerprint(path) for path in _files_in(results)}
    write_whole(results / _CONTENTS, json.dumps(found).encode())


def _files_in(folder: Path) -> Iterator[Path]:
    """Yield every file below a folder. Links to folders count as files."""
    for parent, folders, names in os.walk(folder):
        for name in [*names, *(each for each in folders if os.path.islink(os.path.join(parent, each)))]:
            yield Path(parent) / name


def _fingerprint(path: Path) -> str:
    """Return a digest of a file's length, beginning and end, to detect replaced files."""
    with open_regular(path, follow_links=False) as file:
        size = os.fstat(file.fileno()).st_size
        digest = hashlib.sha256(f"{size}\n".encode())
        digest.update(file.read(_FINGERPRINT_BYTES))
        file.seek(max(0, size - _FINGERPRINT_BYTES))
        digest.update(file.read(_FINGERPRINT_BYTES))
    return digest.hexdigest()


def _contents(marker: dict[str, object], name: str) -> dict[str, str] | None:
    """Return the fingerprints by path that the marker's entry `name` holds; None for a marker of an old version without them."""
    found = marker.get(name)
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else None


def _foreign_files(folder: Path, results: Iterable[str], contents: dict[str, str] | None) -> list[Path]:
    """Return the files among the results that an earlier run did not write, or that changed since.

    Args:
        folder: folder of the results.
        results: names of files and folders in it.
        contents: fingerprints by path that the run recorded. None for a run of an old version, whose files are recognised
            by their paths only.
    """
    found = []
    for name in results:
        top = folder / name
        for path in _files_in(top) if top.is_dir() and not top.is_symlink() else [top]:
            relative = path.relative_to(folder).as_posix()
            try:
                if contents is None:
                    ours = not path.is_symlink() and path.is_file() and _KNOWN.fullmatch(relative) is not None
                else:
                    ours = contents.get(relative) == _fingerprint(path)
            except OSError:
                ours = False
            if not ours:
                found.append(path)
    return found


def _results(folder: Path) -> list[str]:
    """Return the names of existing results listed in the marker. Names with path separators are ignored."""
    marker = _read_marker(folder) or {}
    listed = marker.get("files")
    if not isinstance(listed, list):
        listed = [entry.name for entry in folder.iterdir() if _RESULT.fullmatch(entry.name)]
    plain = (name for name in listed if isinstance(name, str) and name and not name.startswith(".") and "/" not in name)
    return [name for name in plain if os.path.lexists(folder / name)]


def _switch_to(folder: Path, complete: Path, made_by: str) -> None:
    """Replace the earlier results by those in `complete`. Resumable after an interruption at any point."""
    old = folder / (_OLD + complete.name.removeprefix(_COMPLETE))
    marker = _read_marker(folder) or {}
    arriving = [entry.name for entry in complete.iterdir() if entry.name != _CONTENTS]
    if marker.get("arriving") != complete.name:
        old.mkdir(exist_ok=True)
        for name in {*_results(folder), *(name for name in arriving if os.path.lexists(folder / name))}:
            os.replace(folder / name, old / name)
        contents, earlier = _read_contents(complete), _contents(marker, "contents")
        _write_marker(folder, made_by, arriving, contents=contents, earlier=earlier, arriving=complete.name)
    for name in arriving:
        os.replace(complete / name, folder / name)
    sync_folder(folder)
    marker = _read_marker(folder) or {}
    _remove_own(folder, old, _contents(marker, "earlier"))
    listed = marker.get("files")
    (complete / _CONTENTS).unlink(missing_ok=True)
    complete.rmdir()
    _write_marker(
        folder, made_by, listed if isinstance(listed, list) else (), contents=_contents(marker, "contents") or {}
    )


def _read_contents(complete: Path) -> dict[str, str]:
    try:
        found = json.loads(read_regular(complete / _CONTENTS, MOST_MARKER_BYTES))
    except FileNotFoundError:  # an interrupted run of an old version leaves this state
        return {path.relative_to(complete).as_posix(): _fingerprint(path) for path in _files_in(complete)}
    return dict(found)


def _remove_own(folder: Path, old: Path, contents: dict[str, str] | None) -> None:
    """Remove the replaced results of an earlier run in `old`. Files that it did not write are moved to `kept-…` in `folder`."""
    if not old.is_dir():
        return
    foreign = _foreign_files(old, [entry.name for entry in old.iterdir()], contents)
    kept = folder / f"{_KEPT}{old.name.removeprefix(_OLD)}"
    for path in foreign:
        target = kept / path.relative_to(old)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
    shutil.rmtree(old, ignore_errors=True)


def _finish_what_was_begun(folder: Path) -> None:
    """Complete or roll back the transaction of a killed run and remove its folders."""
    marker = _read_marker(folder) or {}
    for entry in sorted(folder.iterdir()):
        if _PASSING.fullmatch(entry.name) and entry.is_dir() and not entry.is_symlink():
            if entry.name.startswith(_COMPLETE):
                _switch_to(folder, entry, str(marker.get("made_by", "")))
            elif entry.name.startswith(STAGING_PREFIX):
                shutil.rmtree(entry, ignore_errors=True)
            else:
                _remove_own(folder, entry, _contents(marker, "earlier") or _contents(marker, "contents"))
