"""Job pool: claims jobs, runs attempts and publishes their results. As a process: `python -m services.jobs.pool`, which
`PoolKeeper` supervises.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import secrets
import select
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from services.errors import StoreUnavailable
from services.jobs.results import Results, Task, Workspace
from services.jobs.runners import Runner
from services.jobs.store import SCHEMA, Claimed, Claims, JobState
from services.private_files import keep_files_private
from services.registry.database import Database
from services.supervisor.process import Restarts

log = logging.getLogger(__name__)
STEP_S = 0.02
"""Seconds between checks of running attempts."""
DATABASE_S = 0.5
"""Seconds between database accesses: claims are renewed and new jobs are looked up."""
AGAIN_S = 2.0
"""Seconds from a database failure to the pool's next attempt to work."""


@dataclass(frozen=True)
class PoolSettings:
    """Concurrency, leases and resource settings of a job pool."""

    workers: int = 1
    threads: int = 1
    """Number of CPU threads per attempt."""
    lease_s: float = 15.0
    most_attempts: int = 5
    niceness: int = 0
    pack_models: bool = False


class JobPool:
    """Pool that claims jobs and runs at most `workers` attempts at once. Managed by one thread."""

    def __init__(self, database: Database, results: Results, runner: Runner, settings: PoolSettings) -> None:
        pool = secrets.token_hex(8)
        self._database, self._results, self._runner, self._settings = database, results, runner, settings
        self._claims = Claims(database, pool, settings.lease_s, settings.most_attempts, results.is_published)
        self._workspace = Workspace(results, pool)
        dead = self._workspace.dead()
        if dead:
            self._claims.free(dead)
            self._workspace.remove_dead(dead)
        self._running: dict[str, tuple[Claimed, Task]] = {}
        self._ended: dict[str, str] = {}
        self._renewed_s = self._searched_s = self._busy_s = time.monotonic() - DATABASE_S

    @property
    def idle_s(self) -> float:
        """Return the seconds since the last job ended, or 0 while jobs run."""
        return 0.0 if self._running else time.monotonic() - self._busy_s

    def run(self, is_over: Callable[[], bool], *, patience_s: float = math.inf) -> None:
        """Run until `is_over` returns True, then stop running attempts and requeue their jobs. Failures of the database are
        retried for `patience_s`.

        Raises:
            StoreUnavailable: if the database failed for longer.
        """
        failing_since_s: float | None = None
        try:
            while not is_over():
                try:
                    self.step()
                    failing_since_s = None
                except StoreUnavailable as error:
                    failing_since_s = failing_since_s or time.monotonic()
                    if time.monotonic() - failing_since_s >= patience_s:
                        raise
                    log.warning("%s", error)
                    time.sleep(AGAIN_S)
                time.sleep(STEP_S)
        finally:
            self._close()

    def step(self) -> None:
        """Run one round: publish the results of ended attempts, renew claims and start new attempts.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        self._ended.update(self._runner.ended())
        for job_id, how in list(self._ended.items()):
            self._settle(*self._running[job_id], how)
            del self._running[job_id], self._ended[job_id]
        now_s = time.monotonic()
        if self._running and now_s - self._renewed_s >= DATABASE_S:
            self._renewed_s = now_s
            self._renew_claims()
        if now_s - self._searched_s >= DATABASE_S:
            self._fill()

    def _fill(self) -> None:
        """Start attempts while jobs are queued and worker slots are free."""
        while len(self._running) < self._settings.workers:
            claimed = self._claims.take()
            if claimed is None:
                self._searched_s = time.monotonic()
                return
            self._begin(claimed)

    def _begin(self, claimed: Claimed) -> None:
        self._busy_s = time.monotonic()
        settings = self._settings
        folder = self._workspace.attempt(claimed.id, claimed.attempt)
        task = Task(
            claimed.id, claimed.source, str(folder), claimed.options,
            threads=settings.threads, niceness=settings.niceness, pack_model=settings.pack_models,
        )  # fmt: skip
        self._database.close()  # a database connection must not be shared with a forked process
        self._running[claimed.id] = claimed, task
        self._runner.start(task)
        log.info("%s began, attempt %d", claimed.id, claimed.attempt)

    def _renew_claims(self) -> None:
        """Renew the claims. Kill attempts whose job another pool has claimed, or whose cancellation was requested."""
        heard = self._claims.renew({job_id: task.progress() for job_id, (_, task) in self._running.items()})
        for job_id in heard.lost:
            log.warning("%s is another's now; this attempt is ended", job_id)
        for job_id in {*heard.lost, *heard.cancelled}:
            self._runner.kill(job_id)
        for job_id, who in heard.cancelled.items():
            self._claims.end(job_id, JobState.CANCELLED, f"cancelled by {who}")

    def _settle(self, claimed: Claimed, task: Task, how: str) -> None:
        """Publish the result of an ended attempt, or record its failure. Requeue the job if the process died."""
        self._busy_s = time.monotonic()
        outcome = task.outcome()
        if outcome is None:
            # The job is queued again, unless it was cancelled or had too many attempts.
            if self._claims.give_back(claimed.id, counts=True):
                log.warning("%s: its process died: %s", claimed.id, how)
        elif outcome[0] is JobState.DONE:
            # A pool that lost its claim must not publish; renewing detects the loss.
            if claimed.id not in self._claims.renew({claimed.id: task.progress()}).lost:
                self._publish(claimed, task)
        else:
            self._claims.end(claimed.id, *outcome)
            log.info("%s is %s", claimed.id, outcome[0])
        self._workspace.remove(Path(task.folder))
        self._searched_s -= DATABASE_S  # a worker slot is free: query the next job in the next round

    def _publish(self, claimed: Claimed, task: Task) -> None:
        self._results.publish(task.out, claimed.folder)
        if self._results.is_published(claimed.folder):
            self._claims.end(claimed.id, JobState.DONE)
            log.info("%s is done", claimed.id)
        else:
            reason = f"where its result goes, {claimed.folder}, is something else; move it away and try again"
            self._claims.end(claimed.id, JobState.FAILED, reason)

    def _close(self) -> None:
        self._runner.close()
        try:
            for claimed, task in self._running.values():
                outcome = task.outcome()
                if outcome is not None and outcome[0] is JobState.DONE:
                    self._settle(claimed, task, "")
                else:
                    self._claims.give_back(claimed.id, counts=False)
        except StoreUnavailable as error:
            log.warning("%s; its jobs are free when their leases are over", error)
        self._running.clear()
        self._workspace.close()
        self._database.close()


MOST_LINE = 1 << 16


@dataclass(frozen=True)
class PoolProcess:
    """Configuration of the pool process."""

    database: str
    results: str
    pool: PoolSettings = field(default_factory=PoolSettings)
    ray: str | None = None
    """Address of a Ray cluster; None to fork local processes."""
    idle_s: float = 60.0

    def line(self) -> bytes:
        """Return the configuration as the line of standard input that `of_line` parses."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def of_line(cls, line: str) -> PoolProcess:
        """Return the pool's configuration from the line of standard input that `line` returned."""
        values: dict[str, Any] = json.loads(line)
        return cls(**{**values, "pool": PoolSettings(**values["pool"])})


def new_runner(ray: str | None) -> Runner:
    """Create the runner of job attempts: on a Ray cluster, or on this machine.

    Raises:
        StoreUnavailable: if Ray is configured and cannot be used.
    """
    if ray is not None:
        from services.jobs.runners import OnRay

        return OnRay(ray)
    from services.jobs import runners

    runners.load()
    return runners.Forks()


def main() -> int:
    """Run the pool until standard input closes, a signal arrives, or no job has run for `idle_s`.

    Returns:
        Exit code: 0, or 2 if the database is unavailable.
    """
    keep_files_private()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("alembic").setLevel(logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopped.append(True))
    stopped: list[bool] = []
    settings = PoolProcess.of_line(sys.stdin.readline(MOST_LINE))
    try:
        runner = new_runner(settings.ray)
        pool = JobPool(Database(settings.database, SCHEMA), Results(Path(settings.results)), runner, settings.pool)
    except StoreUnavailable as error:
        logging.error("%s", error)
        return 2

    def is_over() -> bool:
        return bool(stopped) or pool.idle_s > settings.idle_s or bool(select.select([sys.stdin], [], [], 0)[0])

    pool.run(is_over)
    return 0


if __name__ == "__main__":
    sys.exit(main())


RELAY_S = 1.0
LEVELS = {"WARNING": logging.WARNING, "ERROR": logging.ERROR, "CRITICAL": logging.ERROR, "Traceback": logging.ERROR}
"""Log level of a line of the pool's output, by its first word."""
POLL_S = 0.5
END_S = 10.0
"""Seconds that a stopped pool may take to requeue its jobs and end, before it is killed."""
PASSED_ON = (
    "PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TMPDIR", "HOME", "OMP_NUM_THREADS", "OMP_WAIT_POLICY",
    "OPENBLAS_NUM_THREADS", "CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "INTRASPLAT_ISA",
)  # fmt: skip
"""Environment variables passed to a pool; none holds credentials."""


class PoolKeeper:
    """Starts the pool process when jobs are queued and restarts it after a crash. Its output is logged."""

    def __init__(self, pool: PoolProcess, open_jobs: Callable[[], int]) -> None:
        self._pool, self._open_jobs = pool, open_jobs
        self._process: asyncio.subprocess.Process | None = None
        self._relaying: asyncio.Task[None] | None = None

    @property
    def pid(self) -> int | None:
        """Return the process id of the pool; None while it is not running."""
        process = self._process
        return None if process is None or process.returncode is not None else process.pid

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run the pool on demand while the block runs, then stop it; its jobs are requeued."""
        task = asyncio.create_task(self._keep(), name="pool of jobs")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await self._end()

    async def _keep(self) -> None:
        restarts, loop = Restarts(), asyncio.get_running_loop()
        while True:
            if await self._is_wanted():
                began_s = loop.time()
                code = await self._run()
                if code != 0:
                    wait_s = restarts.ended(loop.time() - began_s)
                    log.error("the pool of jobs ended with code %d; it is started again in %.1f s", code, wait_s)
                    await asyncio.sleep(wait_s)
            await asyncio.sleep(POLL_S)

    async def _is_wanted(self) -> bool:
        try:
            return await asyncio.to_thread(self._open_jobs) > 0
        except StoreUnavailable as error:
            log.warning("%s", error)
            return False

    async def _run(self) -> int:
        environment = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-P", "-m", "services.jobs.pool",
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
            env=environment, start_new_session=True,
        )  # fmt: skip
        process = self._process
        assert process.stdin is not None and process.stderr is not None
        process.stdin.write(self._pool.line())
        self._relaying = asyncio.create_task(relayed(process.stderr), name="log of the pool")
        code = await process.wait()
        await asyncio.wait(
            {self._relaying}, timeout=RELAY_S
        )  # child processes of the pool may keep the pipe open longer
        self._relaying.cancel()
        return code

    async def _end(self) -> None:
        process = self._process
        if process is None or process.returncode is not None:
            return
        assert process.stdin is not None
        process.stdin.close()
        try:
            await asyncio.wait_for(process.wait(), END_S)
        except TimeoutError:
            process.kill()
            await process.wait()
        if self._relaying is not None:
            await asyncio.wait({self._relaying}, timeout=RELAY_S)
            self._relaying.cancel()


async def relayed(said: asyncio.StreamReader) -> None:
    """Log each line that a process writes to standard error, in this program's log format."""
    while True:
        try:
            line = await said.readline()
        except ValueError:  # the line exceeds the reader's limit; the rest arrives as the next line
            continue
        if not line:
            return
        text = line.decode(errors="replace").strip()
        if text:
            level = LEVELS.get(text.partition(" ")[0], logging.INFO)
            logging.getLogger("intrasplat.pool").log(level, "%s", text)
