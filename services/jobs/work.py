"""Body of a job process: replay, reports and packed model. Only this module of the jobs loads torch."""

from __future__ import annotations

import shutil
import sys
import time
import traceback
from pathlib import Path

import torch

from operators.applications.replay import ReplaySettings, replay
from operators.applications.session import Progress, RunOutcome
from services.cli.exit_codes import user_sentence
from services.jobs.results import Task
from services.jobs.store import JobProgress, JobState
from services.registry.bundle_file import SUFFIX, pack
from services.reports.build import require_shown, write_reports

SAY_S = 0.2
MODEL = "model"


def work(task: Task) -> None:
    """Run one attempt and report its outcome. A bug is reported as failure too, because a retry would fail again."""
    torch.set_num_threads(task.threads)
    try:
        settings = ReplaySettings(recording=Path(task.source), out=task.out, **task.options)
        require_shown(replay(settings, _Teller(task), report=_write_reports))
        if task.pack_model:
            _pack(task.out)
    except Exception as error:  # noqa: BLE001 - the error message becomes the failed job's reason
        traceback.print_exc(file=sys.stderr)
        sentence = user_sentence(error, [task.source])
        reason = (
            f"a bug in this program ({type(error).__name__}); the log has the rest" if sentence is None else sentence
        )
        task.say_outcome(JobState.FAILED, reason.replace(f"{Path(task.source).parent}/", ""))
    else:
        task.say_outcome(JobState.DONE)


class _Teller:
    """Progress callback of a run that writes `JobProgress` to the attempt's folder a few times per second."""

    def __init__(self, task: Task) -> None:
        self._task, self._said_s = task, 0.0
        self._next_db: float | None = None

    def __call__(self, progress: Progress) -> None:
        now_s = time.monotonic()
        if now_s - self._said_s >= SAY_S or progress.done == progress.total:
            self._said_s = now_s
            next_db = progress.next_frame_db
            self._next_db = self._next_db if next_db is None else next_db  # the last frame has no prediction score
            self._task.say_progress(
                JobProgress(
                    progress.done, progress.total, progress.psnr_tissue_db, progress.previous_frame_db, self._next_db
                )
            )


def _write_reports(outcome: RunOutcome, folder: Path) -> None:
    write_reports(outcome, folder)


def _pack(out: Path) -> None:
    if (out / MODEL).is_dir():
        pack(out / MODEL, out / f"{MODEL}{SUFFIX}")
        shutil.rmtree(out / MODEL)
