"""Attempt at a job and its reports. All communication is by files, so an attempt may run on any
machine."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from services.jobs.records import JobProgress, JobState
from services.jobs.results import OUT

PROGRESS, OUTCOME, LOG = "progress.json", "outcome.json", "log"


@dataclass(frozen=True)
class Task:
    """Work order of an attempt; JSON-serialisable."""

    id: str
    source: str
    folder: str
    """Folder of this attempt."""
    options: Mapping[str, Any] = field(default_factory=dict)
    threads: int = 1
    niceness: int = 0
    pack_model: bool = False
    """Pack the model into one file for the registry, in place of a folder."""

    @property
    def out(self) -> Path:
        """Return the folder for the result."""
        return Path(self.folder) / OUT

    @property
    def log(self) -> Path:
        """Return the log file of the process."""
        return Path(self.folder) / LOG

    def say_progress(self, reached: JobProgress) -> None:
        """Report the progress."""
        _write(Path(self.folder) / PROGRESS, asdict(reached))

    def say_outcome(self, state: JobState, reason: str | None = None) -> None:
        """Report the outcome, after everything is written."""
        _write(Path(self.folder) / OUTCOME, {"state": str(state), "reason": reason})

    def progress(self) -> JobProgress:
        """Return the reported progress."""
        said = _read(Path(self.folder) / PROGRESS)
        return JobProgress(**said) if said else JobProgress(0, None, None)

    def outcome(self) -> tuple[JobState, str | None] | None:
        """Return the reported outcome; None if the process died before reporting."""
        said = _read(Path(self.folder) / OUTCOME)
        return (JobState(said["state"]), said["reason"]) if said else None


def _write(path: Path, values: Mapping[str, Any]) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(values), encoding="utf-8")
    os.replace(part, path)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
