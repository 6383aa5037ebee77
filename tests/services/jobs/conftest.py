"""Job stores on either database, a small recording, and a runner controlled by the test."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from gsplat_core.io.recordings import synthesize
from services.jobs.pool import JobPool, PoolSettings
from services.jobs.results import Results, Task
from services.jobs.store import JobProgress, JobState, JobStore


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three synthetic frames of 48x32 px; not to be changed."""
    folder = tmp_path_factory.mktemp("recordings") / "case"
    return synthesize(folder, frames=3, width_px=48, height_px=32, stereo=False)


@pytest.fixture
def new_store(tmp_path: Path, database_url: str | None) -> Iterator[Callable[[], JobStore]]:
    """Return a function that opens the test's store, repeatedly if needed; parametrised over databases."""
    opened = []

    def new() -> JobStore:
        opened.append(
            JobStore(database_url or f"sqlite:///{tmp_path / 'jobs.sqlite'}", lambda _, name: Path("/r") / name)
        )
        return opened[-1]

    yield new
    for store in opened:
        store.close()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[JobStore]:
    """An empty SQLite store, for tests that do not depend on the database."""
    store = JobStore(f"sqlite:///{tmp_path / 'jobs.sqlite'}", lambda _, name: Path("/r") / name)
    yield store
    store.close()


class FakeRunner:
    """Runner whose attempts run until the test ends them."""

    def __init__(self) -> None:
        self.tasks: dict[str, Task] = {}
        self.over: dict[str, str] = {}
        self.killed: list[str] = []

    def start(self, task: Task) -> None:
        self.tasks[task.id] = task

    def ended(self) -> Mapping[str, str]:
        over, self.over = self.over, {}
        return over

    def kill(self, job_id: str) -> None:
        self.killed.append(job_id)
        self.die(job_id, "killed by SIGKILL")

    def close(self) -> None:
        pass

    def finish(self, job_id: str, text: str = "made") -> None:
        """Let an attempt succeed."""
        task = self.tasks[job_id]
        task.out.mkdir()
        (task.out / "report.json").write_text(json.dumps(text))
        task.say_progress(JobProgress(3, 3, 31.5))
        task.say_outcome(JobState.DONE)
        self.die(job_id, "exit code 0")

    def die(self, job_id: str, how: str) -> None:
        """Let an attempt end without an outcome, or after it."""
        del self.tasks[job_id]
        self.over[job_id] = how


@pytest.fixture
def runner() -> FakeRunner:
    return FakeRunner()


@pytest.fixture
def new_pool(tmp_path: Path, store: JobStore, runner: FakeRunner) -> Callable[..., JobPool]:
    """Return a pool that examines all jobs in each step."""

    def new(runner: FakeRunner = runner, **settings) -> JobPool:
        pool = JobPool(store.database, Results(tmp_path / "results"), runner, PoolSettings(**settings))
        step = pool.step

        def hasty_step() -> None:
            pool._renewed_s = pool._searched_s = 0.0
            step()

        pool.step = hasty_step  # type: ignore[method-assign]
        return pool

    return new
