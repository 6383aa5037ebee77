"""A folder of recordings as one batch, without a service: jobs in an SQLite file beside the results, and a pool in this process."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.video import VIDEO_SUFFIXES
from services.jobs.options import ReplayOptions
from services.jobs.pool import JobPool, PoolSettings
from services.jobs.records import JobRecord, JobState, NewJob
from services.jobs.results import RUNNING, Results
from services.jobs.runner import Runner
from services.jobs.store import MOST_AT_ONCE, JobStore

DATABASE = "batch.sqlite"
WHO = "batch"
SAY_S = 0.5
Counts = Mapping[str, int]


@dataclass(frozen=True)
class Summary:
    """What a batch has come to."""

    counts: Counts
    already: int
    """Results that were there before."""
    failed: Sequence[JobRecord]
    seconds: float

    @property
    def is_whole(self) -> bool:
        """Whether every recording has its result."""
        return sum(self.counts.values()) == self.counts["done"]


class Batch:
    """The recordings of a folder and their results in another one. Raises InvalidSetting where that makes no sense, StoreUnavailable."""

    def __init__(self, folder: Path, out: Path, options: ReplayOptions) -> None:
        recordings = recordings_in(folder)
        _check_out(out, folder)
        self._results = Results(out.absolute())
        self._store = JobStore(f"sqlite:///{(out / DATABASE).absolute()}")
        self._options = options.chosen()
        self._submit(recordings)
        self.already = self._store.counts()["done"]

    def run(
        self, runner: Runner, settings: PoolSettings, say: Callable[[Counts], None], stop_requested: Callable[[], bool]
    ) -> Summary:
        """Work until every recording has its result or has failed, or until a stop is asked for; what runs then is begun anew another time."""
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
            JobPool(self._store.database, self._results, runner, settings).run(is_over)
            counts = self._store.counts()
            failed = self._store.newest(counts["failed"], state=str(JobState.FAILED)) if counts["failed"] else []
            return Summary(counts, self.already, failed[::-1], time.monotonic() - began_s)
        finally:
            self._store.close()

    def _submit(self, recordings: Sequence[Path]) -> None:
        """Queue what is new, and what has failed before: its recording may have been mended."""
        known = self._known()
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
                        f"{self._results.folder} was begun with {_said(job.options)}, and now {_said(self._options)} is asked for;"
                        " give another --out"
                    )
                known.add(job.folder)
            before = page[-1].number
        return known


def recordings_in(folder: Path) -> list[Path]:
    """Videos and folders in a folder, by name. Raises InvalidSetting where there are none."""
    if not folder.is_dir():
        raise InvalidSetting(f"{folder} is no folder; give one with recordings in it")
    found = sorted(
        path
        for path in folder.iterdir()
        if path.name[0] != "." and (path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES)
    )
    if not found:
        raise InvalidSetting(f"{folder} has no videos and no folders in it; give a folder of recordings")
    for path in found:
        if not path.name.isprintable():
            raise InvalidSetting(f"the name {path.name!r} has signs that cannot be printed; rename that recording")
    return found


def _check_out(out: Path, folder: Path) -> None:
    """Raises InvalidSetting for a folder that is no batch's: results must not go among somebody's files."""
    inside, outside = Path(os.path.realpath(out)), Path(os.path.realpath(folder))
    if inside == outside or outside in inside.parents or inside in outside.parents:
        raise InvalidSetting(f"{out} is in, or around, the folder of the recordings; choose another --out")
    if out.is_dir() and not (out / DATABASE).is_file() and any(path.name != RUNNING for path in out.iterdir()):
        raise InvalidSetting(f"{out} is not empty and is no earlier batch's; choose another --out")
    if out.exists() and not out.is_dir():
        raise InvalidSetting(f"{out} is a file; choose another --out")


def _said(options: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in sorted(options.items())) or "no options"
