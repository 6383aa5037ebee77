"""Attempts as processes of this machine, each forked from one that has loaded everything.

Loading torch takes seconds and forking milliseconds, so that every job has a process of its own, with memory of its own, and a kill ends it cleanly. The
process that forks computes nothing, has one thread, and touches no GPU. When it dies, however, what it has forked notices by a pipe and ends.
"""

from __future__ import annotations

import gc
import os
import resource
import signal
import sys
import threading
import traceback
from collections.abc import Mapping
from typing import NoReturn

from services.jobs.task import Task
from services.supervisor.process_end import ended_how

ORPHANED = 3
"""Exit code of a process whose pool is gone."""


def load() -> None:
    """Load what every attempt needs; called before the first fork, in a process that has one thread."""
    # By NVML it can be asked whether there is a GPU without using it, after which no forked process could.
    os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
    import services.jobs.work  # noqa: F401

    gc.collect()
    gc.freeze()  # nobody searches what it was born with for garbage, and so it stays in shared memory


class Forks:
    """See `Runner`. `load` was called."""

    def __init__(self) -> None:
        self._life_read, self._life_write = os.pipe()
        self._pids: dict[int, str] = {}
        """The job of each process."""

    def start(self, task: Task) -> None:
        """See `Runner`."""
        pid = os.fork()
        if pid == 0:
            os.close(self._life_write)
            _become(task, self._life_read)
        self._pids[pid] = task.id

    def ended(self) -> Mapping[str, str]:
        """See `Runner`."""
        found = {}
        for pid in list(self._pids):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                found[self._pids.pop(pid)] = ended_how(status)
        return found

    def kill(self, job_id: str) -> None:
        """See `Runner`."""
        for pid, job in self._pids.items():
            if job == job_id:
                os.kill(pid, signal.SIGKILL)  # ours, and not waited for: the number is no other's

    def close(self) -> None:
        """See `Runner`."""
        for pid in self._pids:
            os.kill(pid, signal.SIGKILL)
        for pid in self._pids:
            os.waitpid(pid, 0)
        self._pids.clear()
        os.close(self._life_write)
        os.close(self._life_read)


def _become(task: Task, life: int) -> NoReturn:
    """The rest of the life of a forked process."""
    code = 1
    try:
        os.setsid()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        _print_into(task)
        threading.Thread(target=_end_with_the_pool, args=(life,), name="life", daemon=True).start()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # no core file with a patient's pictures in it
        os.nice(task.niceness)
        from services.jobs.work import work

        work(task)
        code = 0
    except BaseException:  # noqa: BLE001 - nothing of this process may go on as the pool
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
    """The pipe's other end is the pool's alone: it reads as closed when the pool has ended, whichever way."""
    os.read(life, 1)
    os._exit(ORPHANED)
