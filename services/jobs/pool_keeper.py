"""Supervision of the job pool process."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from services.errors import StoreUnavailable
from services.jobs.pool import PoolProcess
from services.supervisor.process import Restarts

log = logging.getLogger(__name__)
RELAY_S = 1.0
LEVELS = {"WARNING": logging.WARNING, "ERROR": logging.ERROR, "CRITICAL": logging.ERROR, "Traceback": logging.ERROR}
"""Log level of a line of the pool's output, by its first word."""
LOOK_S = 0.5
END_S = 10.0
"""Seconds that a pool may take to requeue its jobs."""
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
        """Return the process id of the pool, or None."""
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
            await asyncio.sleep(LOOK_S)

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
