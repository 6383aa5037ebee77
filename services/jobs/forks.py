"""Attempts as forked processes of this machine.

Importing torch takes seconds and forking takes milliseconds. Every attempt thus has its own process
and memory, and a kill ends it cleanly. The forking process computes nothing, has one thread and
uses no GPU. A pipe tells the forked processes when the pool dies, so they exit.
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
"""Exit code of a process whose pool has died."""


def load() -> None:
    """Import everything that attempts need. Call before the first fork, in a single-threaded
    process."""
    # The NVML check detects GPUs without initialising CUDA; after initialisation no forked process
    # could use CUDA.
    os.environ["PYTORCH_NVML_BASED_CUDA_CHECK"] = "1"
    import services.jobs.work  # noqa: F401

    gc.collect()
    gc.freeze()  # excludes the imported objects from garbage collection, so their pages stay shared


class Forks:
    """Runner that forks attempts. Requires an earlier call to `load`."""

    def __init__(self) -> None:
        self._life_read, self._life_write = os.pipe()
        self._pids: dict[int, str] = {}
        """Job id per process."""

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
                os.kill(pid, signal.SIGKILL)  # a child that was not reaped, so the id is not reused

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
    """Run an attempt in a forked process; never returns."""
    code = 1
    try:
        os.setsid()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        _print_into(task)
        threading.Thread(target=_end_with_the_pool, args=(life,), name="life", daemon=True).start()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core file would contain patient images
        os.nice(task.niceness)
        from services.jobs.work import work

        work(task)
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
    """Exit when the pool has ended. Only the pool holds the pipe's write end, so a read returns
    after its death."""
    os.read(life, 1)
    os._exit(ORPHANED)
