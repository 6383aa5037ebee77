"""Output folder of a run: created, empty, or left by an earlier run of this program.

A run collects its results in the staging folder `.run-…` inside the output folder. At the end the
results replace the earlier ones in one transaction:

    .run-…  →  .complete-…   commit point: the new results are valid
    the earlier results      → .old-…
    the new results          → their names
    .old-… is removed

An interruption never mixes two runs. Before the commit point the earlier results are untouched.
After it, the next run in the folder completes the remaining steps.

The marker file lists every file of a run with a fingerprint. Only listed files are replaced or
removed. A run refuses a folder with modified listed files or foreign files among the results. Files
that appear during a run are moved to `kept-…`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from gsplat_core.io.files import open_regular, read_regular, replace_durably, sync_folder, unfinished
from operators.errors import OutputFolderInUse
from operators.folder_lock import LOCK, FolderLock
from operators.output_paths import MARKER, check_folder_path
from operators.storage import STAGING_PREFIX, storage_errors, write_whole

_FORMAT = "intrasplat-output"
MOST_MARKER_BYTES = 1 << 26
_COMPLETE, _OLD, _KEPT = ".complete-", ".old-", "kept-"
_PASSING = re.compile(r"\.(run|complete|old)-[0-9a-f]{8}")
"""Names of the transaction folders of a running or killed run."""
_CONTENTS = ".contents.json"
_FINGERPRINT_BYTES = 1 << 16
RECORDINGS = "recordings"
"""Folder of recorded sessions, one sub-folder each. It is written during a run and never replaced
by a later one.
"""
_RESULT = re.compile(
    r"reconstruction\.mp4|model|frames\.jsonl|report\.json|report\.html|\d{6,}\.png|evaluation\.(?:json|html)|evaluation-\w+\.jsonl"
)
"""Names of results. With the marker of an old version, which lists no files, all of them count as
results of a run.
"""
_KNOWN = re.compile(rf"(?:{_RESULT.pattern})|model/(?:model(?:\.next)?\.safetensors|manifest(?:\.next)?\.json)")
"""Paths of result files, for markers without fingerprints."""


class OutputFolder:
    """Context manager that owns an output folder exclusively.

    Write results to `path`, then call `publish()`. Without `publish()` the folder stays unchanged.
    `earlier` is True if the folder contains results of an earlier run.

    Raises:
        OutputError: writing to the folder is not allowed (see `output_paths`).
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
                )  # finish now, which is quick, instead of leaving it to the next run
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
        with contextlib.suppress(OSError):  # the folder was deleted meanwhile
            if not _results(self.folder) and not (self.folder / RECORDINGS).is_dir():
                (self.folder / MARKER).unlink()


def check_output_folder(folder: Path) -> bool:
    """Return True if `folder` contains an earlier run, whose results a new run replaces. Read-only.

    Raises:
        OutputFolderInUse: the folder is neither new, nor empty, nor an earlier run's.
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
    """Raise OutputFolderInUse if publishing would replace a file that no run of this program
    wrote.
    """
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
    """Return True for names that only a running or killed run leaves."""
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
    """Return fingerprints by path; None for a marker of an old version without fingerprints."""
    found = marker.get(name)
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else None


def _foreign_files(folder: Path, results: Iterable[str], contents: dict[str, str] | None) -> list[Path]:
    """Return the files among the results that the run of `contents` did not write, or that changed
    since.
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
    """Return the names of existing results listed in the marker. Names with path separators are
    ignored.
    """
    marker = _read_marker(folder) or {}
    listed = marker.get("files")
    if not isinstance(listed, list):
        listed = [entry.name for entry in folder.iterdir() if _RESULT.fullmatch(entry.name)]
    plain = (name for name in listed if isinstance(name, str) and name and not name.startswith(".") and "/" not in name)
    return [name for name in plain if os.path.lexists(folder / name)]


def _switch_to(folder: Path, complete: Path, made_by: str) -> None:
    """Replace the earlier results by those in `complete`. Resumable after an interruption at any
    point.
    """
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
    except FileNotFoundError:  # an old version was interrupted here
        return {path.relative_to(complete).as_posix(): _fingerprint(path) for path in _files_in(complete)}
    return dict(found)


def _remove_own(folder: Path, old: Path, contents: dict[str, str] | None) -> None:
    """Remove the replaced results of an earlier run. Foreign files are moved to `kept-…`."""
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
