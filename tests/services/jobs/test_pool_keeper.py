"""Supervision of the pool process: start on demand, delayed restart, stop, log."""

from __future__ import annotations

import asyncio
import logging
import sys
from contextlib import suppress
from types import SimpleNamespace

import pytest

from services.errors import StoreUnavailable
from services.jobs import pool as keepers
from services.jobs.pool import PoolKeeper, relayed


@pytest.fixture
def run_keeper(monkeypatch):
    """Return a function that runs `_keep` with simulated job counts, exit codes and sleeps."""

    def run(jobs, codes):
        sleeps, runs = [], []
        jobs, codes = iter(jobs), iter(codes)

        def open_jobs():
            found = next(jobs, None)
            if found is None:
                raise asyncio.CancelledError
            if isinstance(found, Exception):
                raise found
            return found

        async def sleep(seconds):
            sleeps.append(seconds)

        async def ran():
            runs.append(True)
            return next(codes)

        keeper = PoolKeeper(SimpleNamespace(), open_jobs)
        monkeypatch.setattr(keeper, "_run", ran)
        monkeypatch.setattr(keepers, "Restarts", lambda: SimpleNamespace(ended=lambda lasted_s: 7.5))
        monkeypatch.setattr(keepers.asyncio, "sleep", sleep)

        async def to_thread(call):
            return call()

        monkeypatch.setattr(keepers.asyncio, "to_thread", to_thread)
        with suppress(asyncio.CancelledError):
            asyncio.run(keeper._keep())
        return len(runs), sleeps

    return run


def test_keeper_runs_pool_while_jobs_are_open_and_delays_restarts(run_keeper):
    assert run_keeper([0, 0], []) == (0, [keepers.POLL_S] * 2)
    assert run_keeper([1, 2], [0, 0]) == (2, [keepers.POLL_S] * 2)
    assert run_keeper([1], [3]) == (1, [7.5, keepers.POLL_S])


def test_keeper_retries_unavailable_store(run_keeper):
    assert run_keeper([StoreUnavailable("locked"), 1], [0]) == (1, [keepers.POLL_S] * 2)


@pytest.fixture
def program(monkeypatch):
    """Replace the pool by a small program."""

    start = asyncio.create_subprocess_exec

    def use(code: str) -> PoolKeeper:
        async def started(*words, **options):
            assert words[1:] == ("-P", "-m", "services.jobs.pool")
            use.environment = options["env"]
            return await start(sys.executable, "-S", "-E", "-c", code, **options)

        monkeypatch.setattr(keepers.asyncio, "create_subprocess_exec", started)
        return PoolKeeper(SimpleNamespace(line=lambda: b"settings\n"), lambda: 1)

    return use


def test_keeper_passes_settings_but_no_credentials_to_pool(program, monkeypatch, caplog):
    monkeypatch.setenv("INTRASPLAT_SECRET", "hidden")
    monkeypatch.setenv("LANG", "C")
    caplog.set_level(logging.INFO)
    keeper = program("import sys; sys.stderr.write('WARNING ' + sys.stdin.readline()); sys.exit(4)")
    assert keeper.pid is None
    assert asyncio.run(keeper._run()) == 4
    assert keeper.pid is None, "it has ended"
    assert ("intrasplat.pool", logging.WARNING, "WARNING settings") in caplog.record_tuples
    assert program.environment["LANG"] == "C" and "INTRASPLAT_SECRET" not in program.environment


def test_keeper_stops_pool_and_kills_hanging_pool(program, monkeypatch):
    async def run(code: str) -> int | None:
        keeper = program(code)
        await keeper._end()  # not started yet
        task = asyncio.create_task(keeper._run())
        while keeper.pid is None and not task.done():
            await asyncio.sleep(0.005)
        await keeper._end()
        code_ = keeper._process.returncode
        await task
        return code_

    assert asyncio.run(run("import sys; sys.stdin.read(); sys.exit(5)")) == 5
    monkeypatch.setattr(keepers, "END_S", 0.05)
    assert asyncio.run(run("import time; time.sleep(1000)")) == -9


def test_relayed_logs_pool_lines_at_their_level(caplog):
    caplog.set_level(logging.DEBUG)

    async def run() -> None:
        reader = asyncio.StreamReader(limit=64)
        reader.feed_data(
            b"INFO one\n\nERROR two\nCRITICAL three\nTraceback (most)\nwords\n" + b"x" * 200 + b"\nWARNING \xff\n"
        )
        reader.feed_eof()
        await relayed(reader)

    asyncio.run(run())
    levels = {text: level for name, level, text in caplog.record_tuples if name == "intrasplat.pool"}
    assert levels["INFO one"] == levels["words"] == logging.INFO
    assert levels["ERROR two"] == levels["CRITICAL three"] == levels["Traceback (most)"] == logging.ERROR
    assert levels["WARNING \ufffd"] == logging.WARNING and "" not in levels
