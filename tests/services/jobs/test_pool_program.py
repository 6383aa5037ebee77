"""The pool program, dead pools, and attempts on Ray, with stand-ins for the store and Ray."""

from __future__ import annotations

import io
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from services.errors import StoreUnavailable
from services.jobs import pool as pools
from services.jobs.pool import JobPool, PoolProcess, PoolSettings
from services.jobs.results import LOCK, RUNNING, Results, Workspace
from services.jobs.runners import OnRay, Task

SETTINGS = PoolProcess("sqlite://", "/results", PoolSettings(workers=3), "local", 2.5)


def test_pool_process_settings_round_trip_as_one_line() -> None:
    line = SETTINGS.line()
    assert line.count(b"\n") == 1 and line.endswith(b"\n")
    assert PoolProcess.of_line(line.decode()) == SETTINGS


@pytest.mark.parametrize(
    ("signalled", "idle_s", "input_ended", "is_over"),
    [(False, 2.5, False, False), (True, 0.0, False, True), (False, 2.6, False, True), (False, 0.0, True, True)],
)
def test_pool_program_ends_on_signal_idle_time_or_end_of_input(
    monkeypatch: pytest.MonkeyPatch, signalled: bool, idle_s: float, input_ended: bool, is_over: bool
) -> None:
    handlers: dict[int, Any] = {}
    answers = []

    class Pool:
        def __init__(self, database: Any, results: Results, runner: Any, settings: PoolSettings) -> None:
            assert (database, results.folder, runner, settings) == (
                "sqlite://",
                Path("/results"),
                "local",
                SETTINGS.pool,
            )
            self.idle_s = idle_s

        def run(self, over: Any) -> None:
            if signalled:
                handlers[pools.signal.SIGTERM](15, None)
            answers.append(over())

    monkeypatch.setattr(pools, "keep_files_private", lambda: None)
    monkeypatch.setattr(pools.logging, "basicConfig", lambda **_: None)
    monkeypatch.setattr(pools.signal, "signal", lambda number, handler: handlers.update({number: handler}))
    monkeypatch.setattr(pools, "new_runner", lambda ray: ray)
    monkeypatch.setattr(pools, "Database", lambda url, schema: url)
    monkeypatch.setattr(pools, "Results", lambda folder: SimpleNamespace(folder=folder))
    monkeypatch.setattr(pools, "JobPool", Pool)
    monkeypatch.setattr(sys, "stdin", io.StringIO(SETTINGS.line().decode()))
    monkeypatch.setattr(pools.select, "select", lambda *_: ([sys.stdin] if input_ended else [], [], []))
    assert pools.main() == 0 and answers == [is_over]
    assert set(handlers) == {pools.signal.SIGINT, pools.signal.SIGTERM, pools.signal.SIGHUP}


def test_pool_program_exits_2_if_runner_is_unavailable(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(ray: Any) -> None:
        raise StoreUnavailable("Ray does not answer")

    monkeypatch.setattr(pools, "keep_files_private", lambda: None)
    monkeypatch.setattr(pools.logging, "basicConfig", lambda **_: None)
    monkeypatch.setattr(pools.signal, "signal", lambda *_: None)
    monkeypatch.setattr(pools, "new_runner", fail)
    monkeypatch.setattr(sys, "stdin", io.StringIO(SETTINGS.line().decode()))
    assert pools.main() == 2 and "Ray does not answer" in caplog.text


def test_new_pool_frees_jobs_and_folders_of_dead_pools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    freed: list[Any] = []
    monkeypatch.setattr(pools, "Claims", lambda *_: SimpleNamespace(free=freed.append))
    results = SimpleNamespace(folder=tmp_path, is_published=None)
    running = tmp_path / RUNNING
    running.mkdir()
    alive = Workspace(results, "alive")
    for name in ("dead", "without a lock"):
        (running / name / "job-1").mkdir(parents=True)
    (running / "dead" / LOCK).write_bytes(b"")
    pool = JobPool(None, results, None, PoolSettings())
    assert [sorted(each) for each in freed] == [["dead", "without a lock"]]
    assert {path.name for path in running.iterdir()} == {"alive", pool._workspace.folder.name}
    JobPool(None, results, None, PoolSettings())
    assert len(freed) == 1, "nothing is freed without a dead pool"
    alive.close()
    assert not alive.folder.exists()


def test_idle_s_counts_from_end_of_last_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(pools, "Claims", lambda *_: None)
    monkeypatch.setattr(pools.time, "monotonic", lambda: now.s)
    (tmp_path / RUNNING).mkdir()
    pool = JobPool(None, SimpleNamespace(folder=tmp_path, is_published=None), None, PoolSettings())
    pool._busy_s, now.s = 100.0, 107.0
    assert pool.idle_s == 7.0
    pool._running["job"] = None
    assert pool.idle_s == 0.0


class Ray(ModuleType):
    """Stand-in for Ray, whose attempts end when the test sets `ready`."""

    class exceptions:  # as in Ray
        class RayError(Exception):
            pass

        class TaskCancelledError(Exception):
            pass

    def __init__(self) -> None:
        super().__init__("ray")
        self.calls: list[Any] = []
        self.ready: dict[str, Exception | None] = {}

    def init(self, address: str, **options: Any) -> None:
        self.calls.append(("init", address, options["include_dashboard"]))

    def remote(self, **options: Any) -> Any:
        return lambda function: SimpleNamespace(remote=lambda task: self.calls.append((task, options)) or task["id"])

    def wait(self, attempts: list[str], num_returns: int, timeout: float) -> tuple[list[str], list[str]]:
        assert (num_returns, timeout) == (len(attempts), 0)
        return [each for each in attempts if each in self.ready], []

    def get(self, attempt: str) -> None:
        if (error := self.ready[attempt]) is not None:
            raise error

    def cancel(self, attempt: str, force: bool) -> None:
        self.calls.append(("cancel", attempt, force))

    def shutdown(self) -> None:
        self.calls.append("shutdown")


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> Ray:
    made = Ray()
    monkeypatch.setitem(sys.modules, "ray", made)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "1")
    return made


TASK = Task("a", "/recording", "/folder", {"device": "cuda"}, threads=3, niceness=5, pack_model=False)


def test_on_ray_starts_tasks_without_retries_and_reports_their_end(ray: Ray) -> None:
    runner = OnRay("local")
    assert ray.calls == [("init", "local", False)] and os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert runner.ended() == {}
    for task in (TASK, replace(TASK, id="b", options={}), replace(TASK, id="c")):
        runner.start(task)
    (first, options), (_, other), _ = ray.calls[1:]
    assert first["niceness"] == 0 and first["threads"] == 3, "Ray shares the machine itself"
    assert (options["max_retries"], options["num_cpus"], options["num_gpus"], other["num_gpus"]) == (0, 3, 1, 0)
    ray.ready = {"a": None, "b": ray.exceptions.RayError()}
    assert runner.ended() == {"a": "exit code 0", "b": "RayError of Ray"}
    assert runner.ended() == {}
    ray.ready = {"c": ray.exceptions.TaskCancelledError()}
    assert runner.ended() == {"c": "TaskCancelledError of Ray"}


def test_on_ray_kill_and_close_cancel_tasks_by_force(ray: Ray) -> None:
    runner = OnRay("ray://head:10001")
    assert ray.calls == [("init", "ray://head:10001", None)]
    for name in ("a", "b", "c"):
        runner.start(replace(TASK, id=name))
    ray.calls.clear()
    runner.kill("b")
    assert ray.calls == [("cancel", "b", True)]
    runner.close()
    assert ray.calls[1:] == [("cancel", name, True) for name in "abc"] + ["shutdown"]
    assert runner.ended() == {}
