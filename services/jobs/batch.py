"""Batch replay of a folder of recordings without a service. Jobs are in an SQLite file next to the
results, and the pool runs in this process."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import PartialFile, open_regular, read_regular
from gsplat_core.io.recordings.calibration import POSES_FILE
from gsplat_core.io.recordings.layouts import split_eyes
from gsplat_core.io.recordings.video import VIDEO_SUFFIXES
from operators.output_folder import BATCH_DATABASE, DESCRIPTIONS, is_whole_output
from operators.settings import JobOptions
from operators.storage import storage_errors
from services.jobs.pool import JobPool, PoolSettings
from services.jobs.results import RUNNING, Results
from services.jobs.runners import Runner
from services.jobs.store import MOST_AT_ONCE, JobRecord, JobState, JobStore, NewJob

DATABASE = BATCH_DATABASE
WHO = "batch"
SAY_S = 0.5
PATIENCE_S = 10.0
"""Seconds for which writing to the database of the jobs is retried."""
RECORDINGS = ".recordings.json"
"""File in the output folder with the fingerprint of each recording, by name."""
MOST_NOTES_BYTES = 1 << 26
FINGERPRINT_BYTES = 4096
Counts = Mapping[str, int]


@dataclass(frozen=True)
class Summary:
    """Result of the batch replay of a folder of recordings: job counts, failures and duration."""

    counts: Counts
    already: int
    """Number of recordings whose results exist from earlier runs of the batch, so that they were not replayed again."""
    failed: Sequence[JobRecord]
    seconds: float
    unusable: Sequence[tuple[str, str]] = ()
    """Names of skipped files and folders, each with the reason."""

    @property
    def is_whole(self) -> bool:
        """Return True if every recording has its result."""
        return sum(self.counts.values()) == self.counts["done"] and not self.unusable


class Batch:
    """Batch of one folder of recordings and one output folder.

    Raises:
        InvalidSetting: if the input folder has no usable recordings, or the output folder has foreign files.
        StoreUnavailable: if the output folder or the database cannot be used.
    """

    def __init__(self, folder: Path, out: Path, options: JobOptions) -> None:
        recordings, self.unusable = recordings_in(folder)
        _check_out(out, folder)
        with _removed_on_failure(out):
            self._results = Results(out.absolute())
            self._store = JobStore(f"sqlite:///{(out / DATABASE).absolute()}")
            try:
                self._options = options.chosen()
                self._submit(recordings)
                self.already = self._store.counts()["done"]
            except BaseException:
                self._store.close()
                raise

    def run(
        self, runner: Runner, settings: PoolSettings, say: Callable[[Counts], None], stop_requested: Callable[[], bool]
    ) -> Summary:
        """Run until every recording has a result or has failed, or a stop is requested. Interrupted
        jobs restart in a later run.

        Args:
            runner: runner of the attempts.
            settings: settings of the pool.
            say: called with the job counts every `SAY_S`.
            stop_requested: polled.

        Raises:
            StoreUnavailable: if the database of the jobs could not be written for `PATIENCE_S`, for example on a full disk.
        """
        began_s, said_s = time.monotonic(), 0.0
        left = True

        def is_over() -> bool:
            nonlocal said_s, left
            if time.monotonic() - said_s >= SAY_S:
                said_s = time.monotonic()
                counts = self._store.counts()
                left = counts["queued"] + counts["running"] > 0
                say(counts)
            return not left or stop_requested()

        try:
            JobPool(self._store.database, self._results, runner, settings).run(is_over, patience_s=PATIENCE_S)
            counts = self._store.counts()
            failed = self._store.newest(counts["failed"], state=str(JobState.FAILED)) if counts["failed"] else []
            return Summary(counts, self.already, failed[::-1], time.monotonic() - began_s, self.unusable)
        finally:
            self._store.close()

    def _submit(self, recordings: Sequence[Path]) -> None:
        """Queue new recordings, and retry failed ones because they may have been repaired."""
        known = self._known()
        self._check_same(recordings)
        self._store.retry([JobState.FAILED, JobState.CANCELLED])
        fresh = [NewJob(path.name, str(path.absolute()), path.name) for path in recordings if path.name not in known]
        for start in range(0, len(fresh), MOST_AT_ONCE):
            self._store.submit(fresh[start : start + MOST_AT_ONCE], self._options, WHO)

    def _known(self) -> set[str]:
        known: set[str] = set()
        before = None
        while page := self._store.newest(1000, before=before):
            for job in page:
                if dict(job.options) != self._options:
                    raise InvalidSetting(
                        f"{self._results.folder} was begun with {_said(job.options)}, and this run has {_said(self._options)};"
                        " give another --out"
                    )
                if job.state == JobState.DONE and not self._has_result(job.folder):
                    self._store.forget(job.id)  # its result was removed: run the job again
                else:
                    known.add(job.folder)
            before = page[-1].number
        return known

    def _has_result(self, name: str) -> bool:
        """Return True if the result is complete, False if absent.

        Raises:
            InvalidSetting: if files of the result are missing.
        """
        folder = self._results.folder / name
        if not os.path.lexists(folder):
            return False
        if self._results.is_published(name) and is_whole_output(folder):
            return True
        raise InvalidSetting(f"files of the result {folder} are missing; remove that folder, and it is made anew")

    def _check_same(self, recordings: Sequence[Path]) -> None:
        """Compare recordings with their stored fingerprints, and store the fingerprints of new recordings.

        Raises:
            InvalidSetting: if a recording with a result was replaced, or the stored fingerprints cannot be read.
        """
        notes = self._results.folder / RECORDINGS
        try:
            noted = json.loads(read_regular(notes, MOST_NOTES_BYTES)) if notes.exists() else {}
            if not isinstance(noted, dict):
                raise ValueError("it holds no names")
        except (OSError, ValueError, RecursionError) as error:
            raise InvalidSetting(
                f"{notes} cannot be read ({error}); put a copy of it back, or give another --out"
            ) from error
        for path in recordings:
            now = fingerprint_of(path)
            if noted.get(path.name, now) != now and os.path.lexists(self._results.folder / path.name):
                raise InvalidSetting(
                    f"{path} is another recording than the one whose result is in {self._results.folder / path.name}; remove that folder,"
                    " or give another --out"
                )
            noted[path.name] = now
        with storage_errors(notes.parent), PartialFile(notes) as partial:
            partial.file.write(json.dumps(noted, indent=0).encode())


@contextmanager
def _removed_on_failure(out: Path) -> Iterator[None]:
    """Remove what a new batch has created in its output folder if the block fails, such as on a full disk."""
    before = {path.name for path in out.iterdir()} if out.is_dir() else None
    try:
        yield
    except BaseException:
        if DATABASE not in (before or ()):
            for name in (*(f"{DATABASE}{suffix}" for suffix in ("", "-wal", "-shm", "-journal")), RECORDINGS):
                (out / name).unlink(missing_ok=True)
            with suppress(OSError):  # not empty, or missing
                (out / RUNNING).rmdir()
            with suppress(OSError):
                if before is None:
                    out.rmdir()
        raise


def fingerprint_of(recording: Path) -> str:
    """Return a digest of the names, sizes, first and last bytes of a recording's files (of an unreadable file: name and
    error number). Much faster than hashing all content."""
    digest = hashlib.sha256()
    for path in sorted(each for each in recording.rglob("*") if each.is_file()) if recording.is_dir() else [recording]:
        try:
            with open_regular(path) as file:
                size = os.fstat(file.fileno()).st_size
                digest.update(
                    os.fsencode(path.relative_to(recording)) + f"\0{size}\0".encode() + file.read(FINGERPRINT_BYTES)
                )
                file.seek(max(0, size - FINGERPRINT_BYTES))
                digest.update(file.read(FINGERPRINT_BYTES))
        except OSError as error:
            digest.update(f"{path.name} {error.errno}".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _check_no_recording(folder: Path) -> None:
    """Check that a folder is not itself one recording, whose parts would be taken for recordings.

    Raises:
        InvalidSetting: if the folder is a recording.
    """
    names = sorted(entry.name for entry in folder.iterdir())
    videos = [folder / name for name in names if Path(name).suffix.lower() in VIDEO_SUFFIXES and name[0] != "."]
    eyes = split_eyes(videos)
    found = [name for name in (*DESCRIPTIONS, "images", "images_right", "masks", "depth", POSES_FILE) if name in names]
    if eyes is not None and len(eyes.left) == 1 and not eyes.others:
        found += [eyes.left[0].name, eyes.right[0].name]
    if found:
        raise InvalidSetting(
            f"{folder} is a recording itself (it holds {', '.join(found[:4])}); replay it with `intrasplat replay`, or give the folder around it"
        )


def recordings_in(folder: Path) -> tuple[list[Path], list[tuple[str, str]]]:
    """List the videos and folders in a folder, by name.

    Returns:
        The usable recordings, and the unusable names with the reason.

    Raises:
        InvalidSetting: if there are none, or the folder is itself a recording.
    """
    if not folder.is_dir():
        raise InvalidSetting(f"{folder} is no folder; give one with recordings in it")
    _check_no_recording(folder)
    found = sorted(
        path
        for path in folder.iterdir()
        if path.name[0] != "." and (path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES)
    )
    if not found:
        raise InvalidSetting(f"{folder} has no videos and no folders in it; give a folder of recordings")
    unusable = [
        (path.name, "its name has characters that cannot be printed; rename it")
        for path in found
        if not path.name.isprintable()
    ]
    return [path for path in found if path.name.isprintable()], unusable


def _check_out(out: Path, folder: Path) -> None:
    """Check that the output folder is empty or from an earlier batch, so results never mix with other files.

    Raises:
        InvalidSetting: if it is not usable.
    """
    inside, outside = Path(os.path.realpath(out)), Path(os.path.realpath(folder))
    if inside == outside or outside in inside.parents or inside in outside.parents:
        raise InvalidSetting(f"{out} is in, or around, the folder of the recordings; choose another --out")
    if out.is_dir() and not (out / DATABASE).is_file() and any(path.name != RUNNING for path in out.iterdir()):
        raise InvalidSetting(f"{out} is not empty and is no earlier batch's; choose another --out")
    if out.exists() and not out.is_dir():
        raise InvalidSetting(f"{out} is a file; choose another --out")


def _said(options: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in sorted(options.items())) or "no options"
