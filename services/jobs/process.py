"""Job pool as a process: `python -m services.jobs.process`.

The first line of standard input is its `PoolProcess` in JSON, which may hold a database password.
When the input closes, because the server stops the pool or has died, the pool requeues its jobs and
exits. It also exits after an idle time to free memory; the server starts a new pool when jobs are
queued.
"""

from __future__ import annotations

import json
import logging
import select
import signal
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from services.errors import StoreUnavailable
from services.jobs.pool import JobPool, PoolSettings
from services.jobs.results import Results
from services.jobs.runner import Runner
from services.jobs.tables import SCHEMA
from services.private_files import keep_files_private
from services.registry.database import Database

MOST_LINE = 1 << 16


@dataclass(frozen=True)
class PoolProcess:
    """Configuration of the pool process."""

    database: str
    results: str
    pool: PoolSettings = field(default_factory=PoolSettings)
    ray: str | None = None
    """Address of a Ray cluster; None runs local processes."""
    idle_s: float = 60.0

    def line(self) -> bytes:
        """Return the configuration as an input line."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def of_line(cls, line: str) -> PoolProcess:
        """Parse an input line."""
        values: dict[str, Any] = json.loads(line)
        return cls(**{**values, "pool": PoolSettings(**values["pool"])})


def new_runner(ray: str | None) -> Runner:
    """Create the runner.

    Raises:
        StoreUnavailable: if Ray is configured and cannot be used.
    """
    if ray is not None:
        from services.jobs.on_ray import OnRay

        return OnRay(ray)
    from services.jobs import forks

    forks.load()
    return forks.Forks()


def main() -> int:
    """Run until the input closes.

    Returns:
        The exit code.
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
