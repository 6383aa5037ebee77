"""The folder that a run writes into: a new one, an empty one, or one that an earlier run of ours has left.

A run collects its results in a folder of its own inside, `.run-…`, and they take the place of the earlier ones all together when it ends:

    .run-…  →  .complete-…   from here on the new results count
    the earlier results      → .old-…
    the new results          → their names
    .old-… is removed

Whoever stops this in between leaves no mixture of two runs: before the first step the earlier results are untouched, and after it the next
run in this folder first does the steps that are left.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path

from gsplat_core.io.atomic_files import replace_durably, sync_folder, unfinished
from gsplat_core.io.regular_files import read_regular
from operators.errors import OutputFolderInUse
from operators.folder_lock import LOCK, FolderLock
from operators.output_paths import MARKER, check_folder_path
from operators.storage import STAGING_PREFIX, storage_errors, write_whole

_FORMAT = "intrasplat-output"
MOST_MARKER_BYTES = 1 << 26
_COMPLETE, _OLD = ".complete-", ".old-"
RECORDINGS = "recordings"
"""Holds what runs have recorded, one folder each. It is written as the run goes on, and no later run replaces it."""
_RESULT = re.compile(
    r"reconstruction\.mp4|model|frames\.jsonl|report\.json|report\.html|\d{6,}\.png|evaluation\.(?:json|html)|evaluation-\w+\.jsonl"
)
"""The names of results. In a folder of an earlier version, whose marker lists no files, all of them are ours."""


class OutputFolder:
    """An output folder, ours alone while entered. Write into `path`, then call `publish()`; without it nothing has changed.

    `earlier` says whether an earlier run's results are there. Raises OutputError (where a run must not write: see `output_paths`),
    OutputFolderInUse (the folder holds something that is not ours, or another run writes into it), StorageFull.
    """

    def __init__(self, folder: Path, made_by: str, inputs: Sequence[Path] = ()) -> None:
        """made_by: the command. inputs: what the run reads."""
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
            # Another run may have ended between the look above and the lock.
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
        """Put what lies in `path` in the place of the earlier results. Nothing there: nothing changes."""
        with storage_errors(self.folder):
            if not any(self.path.iterdir()):
                return
            complete = self.folder / f"{_COMPLETE}{self._token}"
            sync_folder(self.path)
            replace_durably(self.path, complete)
            try:
                _switch_to(self.folder, complete, self.made_by)
            except KeyboardInterrupt:
                _switch_to(self.folder, complete, self.made_by)  # a moment's work: rather than leave it to the next run
                raise

    def _make(self) -> None:
        missing = [part for part in (self.folder, *self.folder.parents) if not os.path.lexists(part)]
        for part in reversed(missing):
            with contextlib.suppress(
                FileExistsError
            ):  # two runs that make it at the same time: one of them gets the lock
                part.mkdir()
                self._made.append(part)

    def _remove_what_was_made(self) -> None:
        for part in reversed(self._made):
            with contextlib.suppress(OSError):  # not empty: something was written, or somebody else uses it
                part.rmdir()

    def _remove_marker(self) -> None:
        with contextlib.suppress(OSError):  # the folder was deleted meanwhile
            if not _results(self.folder) and not (self.folder / RECORDINGS).is_dir():
                (self.folder / MARKER).unlink()


def check_output_folder(folder: Path) -> bool:
    """Whether `folder` holds an earlier run of ours, whose results a new run replaces. Changes nothing.

    Raises OutputFolderInUse for anything else that is not a new or an empty folder.
    """
    if not os.path.lexists(folder):
        return False
    if not folder.is_dir():
        kind = "a link that leads nowhere" if folder.is_symlink() else "a file"
        raise OutputFolderInUse(f"{folder} is {kind}; give a folder that does not exist yet or is empty")
    if _read_marker(folder) is not None:
        _check_results(folder)
        return True
    others = sorted(entry.name for entry in folder.iterdir() if not _passing(entry.name))
    if others:
        names = ", ".join(others[:4]) + (", ..." if len(others) > 4 else "")
        raise OutputFolderInUse(
            f"{folder} is not empty and was not made by intrasplat (it holds {names}); "
            "choose another --out, so that nothing of yours is overwritten"
        )
    return False


def _check_results(folder: Path) -> None:
    """Raises OutputFolderInUse when something that no run of ours wrote has the name of a result: it would be replaced."""
    ours = _results(folder)
    foreign = [entry.name for entry in folder.iterdir() if _RESULT.fullmatch(entry.name) and entry.name not in ours]
    if foreign:
        raise OutputFolderInUse(
            f"{folder} holds {', '.join(sorted(foreign)[:4])}, which no run of intrasplat wrote; move it away or choose another --out"
        )


def _passing(name: str) -> bool:
    """Whether only a run that is under way, or was killed, leaves such a name."""
    return name == LOCK or name.startswith((STAGING_PREFIX, _COMPLETE, _OLD))


def _read_marker(folder: Path) -> dict[str, object] | None:
    try:
        marker = json.loads(read_regular(folder / MARKER, MOST_MARKER_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    return marker if isinstance(marker, dict) and marker.get("format") == _FORMAT else None


def _write_marker(folder: Path, made_by: str, files: Iterable[str], arriving: str | None = None) -> None:
    """files: the results that are, or are about to be, in the folder. arriving: from where they are being moved."""
    marker = {"format": _FORMAT, "version": 1, "made_by": made_by, "files": sorted(files)}
    write_whole(
        folder / MARKER, (json.dumps(marker if arriving is None else marker | {"arriving": arriving}) + "\n").encode()
    )


def _results(folder: Path) -> list[str]:
    """The names of the results that the marker lists and that are there. A name that leads elsewhere is no result of ours."""
    marker = _read_marker(folder) or {}
    listed = marker.get("files")
    if not isinstance(listed, list):
        listed = [entry.name for entry in folder.iterdir() if _RESULT.fullmatch(entry.name)]
    plain = (name for name in listed if isinstance(name, str) and name and not name.startswith(".") and "/" not in name)
    return [name for name in plain if os.path.lexists(folder / name)]


def _switch_to(folder: Path, complete: Path, made_by: str) -> None:
    """Put the results in `complete` in the place of the earlier ones; may be called again after it was stopped at any point."""
    old = folder / (_OLD + complete.name.removeprefix(_COMPLETE))
    marker = _read_marker(folder) or {}
    if marker.get("arriving") != complete.name:
        old.mkdir(exist_ok=True)
        for name in _results(folder):
            os.replace(folder / name, old / name)
        _write_marker(folder, made_by, (entry.name for entry in complete.iterdir()), arriving=complete.name)
    for entry in list(complete.iterdir()):
        os.replace(entry, folder / entry.name)
    sync_folder(folder)
    listed = (_read_marker(folder) or {}).get("files")
    _write_marker(folder, made_by, listed if isinstance(listed, list) else ())
    complete.rmdir()
    shutil.rmtree(old, ignore_errors=True)


def _finish_what_was_begun(folder: Path) -> None:
    """After a run that was killed: put its results in place if they were complete, and remove what is left of it."""
    marker = _read_marker(folder) or {}
    for entry in sorted(folder.iterdir()):
        if entry.is_dir() and not entry.is_symlink():
            if entry.name.startswith(_COMPLETE):
                _switch_to(folder, entry, str(marker.get("made_by", "")))
            elif entry.name.startswith((STAGING_PREFIX, _OLD)):
                shutil.rmtree(entry, ignore_errors=True)
