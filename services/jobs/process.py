"""The pool as a process: `python -m services.jobs.process`. Its first line of standard input is its `PoolProcess` in JSON, which may hold the password of
a database; when the input ends, because whoever started it says so or has died, it gives its jobs back and ends. It also ends when there has been nothing
to do for a while, and is started again when there is: what it has loaded takes memory.
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

from services.jobs.pool import JobPool, PoolSettings
from services.jobs.results import Results
from services.jobs.runner import Runner
from services.jobs.tables import SCHEMA
from services.private_files import keep_files_private
from services.registry.database import Database
from services.registry.errors import StoreUnavailable

MOST_LINE = 1 << 16


@dataclass(frozen=True)
class PoolProcess:
    """What the process is told."""

    database: str
    results: str
    pool: PoolSettings = field(default_factory=PoolSettings)
    ray: str | None = None
    """Address of a Ray cluster; None: processes of this machine."""
    idle_s: float = 60.0

    def line(self) -> bytes:
        """As it is written to the process."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def of_line(cls, line: str) -> PoolProcess:
        """As it was written."""
        values: dict[str, Any] = json.loads(line)
        return cls(**{**values, "pool": PoolSettings(**values["pool"])})


def new_runner(ray: str | None) -> Runner:
    """What runs the attempts. Raises StoreUnavailable where Ray was asked for and cannot be used."""
    if ray is not None:
        from services.jobs.on_ray import OnRay

        return OnRay(ray)
    from services.jobs import forks

    forks.load()
    return forks.Forks()


def main() -> int:
    """Run until the input ends; returns the exit code."""
    keep_files_private()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("alembic").setLevel(logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopped.append(True))
    stopped: list[bool] = []
    told = PoolProcess.of_line(sys.stdin.readline(MOST_LINE))
    try:
        runner = new_runner(told.ray)
        pool = JobPool(Database(told.database, SCHEMA), Results(Path(told.results)), runner, told.pool)
    except StoreUnavailable as error:
        logging.error("%s", error)
        return 2

    def is_over() -> bool:
        return bool(stopped) or pool.idle_s > told.idle_s or bool(select.select([sys.stdin], [], [], 0)[0])

    pool.run(is_over)
    return 0


if __name__ == "__main__":
    sys.exit(main())
