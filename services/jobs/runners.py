"""Attempts of jobs: replay, reports and packed model, run in forked processes of this machine or on a Ray cluster (extra `ray`).

Only an attempt loads torch, so functions import it.
"""

from __future__ import annotations

import gc
import os
import resource
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from services.cli.terminal import user_sentence
from services.errors import StoreUnavailable
from services.jobs.results import Task
from services.jobs.store import JobProgress, JobState
from services.private_files import keep_files_private
from services.registry.bundle_file import SUFFIX, pack
from services.supervisor.launcher import ended_how

if TYPE_CHECKING:
    from operators.applications.session import Progress, RunOutcome

SAY_S = 0.2
MODEL = "model"


def work(task: Task) -> None:
    """Run one attempt and report its outcome. A bug is reported as failure too, because a retry would fail again."""
    import torch

    from operators.applications.replay import ReplaySettings, replay
    from services.reports.build import require_shown, write_reports

    def report(outcome: RunOutcome, folder: Path) -> None:
        write_reports(outcome, folder)

    torch.set_num_threads(task.threads)
    try:
        settings = ReplaySettings(recording=Path(task.source), out=task.out, **task.options)
        require_shown(replay(settings, _Teller(task), report=report))
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
            self._next_db = (
                self._next_db if next_db is None else next_db
            )  # keep the earlier score, because the last frame has no prediction
            self._task.say_progress(
                JobProgress(
                    progress.done, progress.total, progress.psnr_tissue_db, progress.previous_frame_db, self._next_db
                )
            )


def _pack(out: Path) -> None:
    if (out / MODEL).is_dir():
        pack(out / MODEL, out / f"{MODEL}{SUFFIX}")
        shutil.rmtree(out / MODEL)


class Runner(Protocol):
    """Runner of concurrent tasks. Attempts report through their folder (`Task`); the runner only
    starts and ends them."""

    def start(self, task: Task) -> None:
        """Start an attempt of a job."""

    def ended(self) -> Mapping[str, str]:
        """Return the attempts that ended since the last call: job id and description of the end."""
        ...

    def kill(self, job_id: str) -> None:
        """Kill an attempt; `ended` reports it. No effect on an ended attempt."""

    def close(self) -> None:
        """Kill all running attempts of jobs."""


ORPHANED = 3
"""Exit code of an attempt's process that ended itself because its pool has died."""


def load() -> None:
    """Import everything that attempts need. Call before the first fork, in a single-threaded process."""
    # The NVML check detects GPUs without initialising CUDA; after initialisation no forked process could use CUDA.
    os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
    import services.reports.build  # noqa: F401

    gc.collect()
    gc.freeze()  # excludes the imported objects from garbage collection, so their pages stay shared


class Forks:
    """Runner that forks attempts. Requires an earlier call to `load`."""

    def __init__(self) -> None:
        self._life_read, self._life_write = os.pipe()
        self._pids: dict[int, str] = {}
        """Id of the job that each running process executes."""

    def start(self, task: Task) -> None:
        """Start an attempt in a forked process."""
        pid = os.fork()
        if pid == 0:
            os.close(self._life_write)
            _become(task, self._life_read)
        self._pids[pid] = task.id

    def ended(self) -> Mapping[str, str]:
        """Return the processes that ended since the last call: job id and description of the end."""
        found = {}
        for pid in list(self._pids):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                found[self._pids.pop(pid)] = ended_how(status)
        return found

    def kill(self, job_id: str) -> None:
        """Kill the process of an attempt."""
        for pid, job in self._pids.items():
            if job == job_id:
                os.kill(pid, signal.SIGKILL)  # the child was not reaped, so its process id cannot have been reused

    def close(self) -> None:
        """Kill the processes of all running attempts."""
        for pid in self._pids:
            os.kill(pid, signal.SIGKILL)
        for pid in self._pids:
            os.waitpid(pid, 0)
        self._pids.clear()
        os.close(self._life_write)
        os.close(self._life_read)


def _become(task: Task, life: int) -> NoReturn:
    """Run an attempt in the forked process, which exits at its end; never returns."""
    code = 1
    try:
        os.setsid()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        _print_into(task)
        threading.Thread(target=_end_with_the_pool, args=(life,), name="life", daemon=True).start()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core file would contain patient images
        os.nice(task.niceness)
        # A new thread has no OpenMP team. This one may have the team of the thread that forked it, whose members do not
        # exist in the fork, so that a parallel loop would wait for them for ever.
        with ThreadPoolExecutor(1, thread_name_prefix="attempt") as attempt:
            attempt.submit(work, task).result()
        code = 0
    except BaseException:  # noqa: BLE001 - the forked process must never continue as the pool
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _print_into(task: Task) -> None:
    output = os.open(task.log, os.O_CREAT | os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC, 0o600)
    nothing = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
    for source, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(source, target)


def _end_with_the_pool(life: int) -> None:
    """Exit this process when the pool has ended. Only the pool holds the pipe's write end, so a read returns at its
    death."""
    os.read(life, 1)
    os._exit(ORPHANED)


ATTEMPTS_OF_A_PROCESS = 20
"""Number of attempts after which Ray replaces a worker process, which bounds memory leaks."""


def _attempt(values: dict[str, Any]) -> None:
    """Run an attempt in a Ray worker process."""
    keep_files_private()
    work(Task(**values))


class OnRay:
    """Runner on a Ray cluster.

    Raises:
        StoreUnavailable: if Ray is missing or does not answer.
    """

    def __init__(self, address: str) -> None:
        """Connect to Ray.

        Args:
            address: head of a cluster, or `local` for a cluster in this process.
        """
        try:
            import ray
        except ImportError as error:
            raise StoreUnavailable(
                "jobs.ray is set and Ray is not installed; install the extra `ray`, or leave it out"
            ) from error
        self._ray = ray
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # no usage statistics are sent
        try:
            ray.init(address, log_to_driver=False, include_dashboard=False if address == "local" else None)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            raise StoreUnavailable(f"Ray at {address} cannot be used: {error}; check that it runs") from error
        self._attempts: dict[Any, str] = {}
        """Id of the job of each running Ray task."""

    def start(self, task: Task) -> None:
        """Start an attempt as a Ray task."""
        # Ray's own retries are off. The pool retries a failed attempt if it still holds the claim.
        remote = self._ray.remote(
            max_retries=0, max_calls=ATTEMPTS_OF_A_PROCESS,
            num_cpus=task.threads, num_gpus=1 if task.options.get("device") == "cuda" else 0,
        )(_attempt)  # fmt: skip
        self._attempts[remote.remote(asdict(replace(task, niceness=0)))] = task.id

    def ended(self) -> Mapping[str, str]:
        """Return the Ray tasks that ended since the last call: job id and description of the end."""
        if not self._attempts:
            return {}
        done, _ = self._ray.wait(list(self._attempts), num_returns=len(self._attempts), timeout=0)
        return {self._attempts.pop(attempt): self._how(attempt) for attempt in done}

    def kill(self, job_id: str) -> None:
        """Cancel the Ray task of an attempt by force."""
        for attempt, job in self._attempts.items():
            if job == job_id:
                self._ray.cancel(attempt, force=True)

    def close(self) -> None:
        """Cancel all Ray tasks and disconnect from the cluster."""
        for attempt in self._attempts:
            self._ray.cancel(attempt, force=True)
        self._attempts.clear()
        self._ray.shutdown()

    def _how(self, attempt: Any) -> str:
        try:
            self._ray.get(attempt)
        except (self._ray.exceptions.RayError, self._ray.exceptions.TaskCancelledError) as error:
            return f"{type(error).__name__} of Ray"
        return "exit code 0"
