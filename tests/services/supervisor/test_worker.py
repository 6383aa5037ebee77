"""Runtime of a stream process: role, heartbeats, commands, stop requests and self-termination."""

from __future__ import annotations

import os
import signal
from dataclasses import asdict
from types import SimpleNamespace

import pytest

from services.bus.messages import ask
from services.bus.runtime import ProcessIdentity
from services.errors import AlreadyRunning, BadMessage
from services.supervisor import worker as workers
from services.supervisor.worker import (
    MEASURED_EVERY_S,
    ORPHAN_DRAIN_S,
    SIGNALS,
    ProcessLimits,
    ProcessSpec,
    SourceSpec,
    Worker,
)


@pytest.fixture
def new_worker(runtime):
    def make(handlers=None, **limits) -> Worker:
        spec = ProcessSpec(stream="a", capture=SourceSpec(address="synthetic:"), limits=ProcessLimits(**limits))
        return Worker(runtime.stream("a"), spec, handlers)

    return make


def test_worker_answers_commands_holds_role_and_cleans_up(new_worker, runtime):
    before = [signal.getsignal(number) for number in SIGNALS]
    with new_worker({"extra": lambda arguments: {"twice": 2 * arguments["value"]}}) as worker:
        endpoint = worker.folder.commands("capture")
        assert ask(endpoint, "ping")["pid"] == os.getpid()
        assert ask(endpoint, "extra", value=4)["twice"] == 8
        worker.take({"later": lambda arguments: {"seen": True}})
        assert ask(endpoint, "later")["seen"]
        assert worker.folder.record("capture") is not None
        with pytest.raises(AlreadyRunning):
            new_worker().__enter__()
        assert not worker.stop_requested() and not worker.wait(0)
        ask(endpoint, "stop", reason="r" * 300)
        assert worker.stop_requested() and worker.wait(0)
        assert worker.stop_reason == "r" * 200
        worker.request_stop("a later reason")
        assert worker.stop_reason == "r" * 200
    assert not worker._watch.is_alive() and not worker._commands._thread.is_alive()
    assert [signal.getsignal(number) for number in SIGNALS] == before
    assert worker._said == {"state": "ended", "reason": "r" * 200}
    assert worker.folder.record("capture") is None
    with new_worker():
        pass


@pytest.mark.parametrize("number", SIGNALS)
def test_worker_signal_requests_stop(new_worker, number):
    with new_worker() as worker:
        signal.raise_signal(number)
        assert worker.stop_requested() and worker.stop_reason == f"it got {number.name}"


@pytest.mark.parametrize(
    ("error", "state", "reason"),
    [
        (None, "ended", "it has nothing more to do"),
        (RuntimeError("broken"), "failed", "broken"),
        (KeyError(), "failed", "KeyError"),
    ],
)
def test_worker_last_state_is_ended_or_failed(new_worker, error, state, reason):
    worker = new_worker()
    try:
        with worker:
            if error is not None:
                raise error
    except (RuntimeError, KeyError):
        assert error is not None
    assert worker._said == {"state": state, "reason": reason}


def test_worker_sends_state_changes_immediately(new_worker):
    worker, sent = new_worker(), []
    worker._heartbeats = SimpleNamespace(say_now=lambda: sent.append(worker._said["reason"]))
    for state, reason in (
        ("starting", "loads"), ("starting", "loads"), ("running", "one"), ("running", "two"), ("starting", "two"),
    ):  # fmt: skip
        worker.say(state, reason)
    assert sent == ["loads", "one", "two"]
    worker.say("running", "x" * 3000)
    assert worker._said["reason"] == "x" * 2000


def test_worker_reports_new_figures_always_and_measures_once_per_second(new_worker, monkeypatch):
    now = SimpleNamespace(s=50.0)
    monkeypatch.setattr(workers, "time", SimpleNamespace(monotonic=lambda: now.s))
    worker, counts = new_worker(), {"figures": 0, "measures": 0}

    def count(name: str) -> dict[str, int]:
        counts[name] += 1
        return {name: counts[name]}

    worker.tell_figures("part", lambda: count("figures"))
    worker.tell_measures("part", lambda: count("measures"))
    worker.tell_figures("other", lambda: {"more": 1})
    reports = []
    for after_s in (0.0, 0.5, MEASURED_EVERY_S - 0.5, MEASURED_EVERY_S - 0.25):
        now.s += after_s
        reports.append(worker._report())
    assert [each["figures"] for each in reports] == [{"figures": k, "more": 1} for k in (1, 2, 3, 4)]
    assert [each["measures"] for each in reports] == [{"measures": k} for k in (1, 1, 2, 2)]
    assert reports[0]["role"] == "capture" and reports[0]["state"] == "starting"


class Exited(Exception):
    pass


@pytest.fixture
def watch(monkeypatch):
    """Run the watch thread's loop in this thread at given times."""

    def run(worker: Worker, *times: float, then=lambda now_s: None) -> float | None:
        """Return the time at which the process exited, or None."""
        looks = iter(times)
        now = SimpleNamespace(s=0.0)

        def wait(seconds: float) -> bool:
            assert 0 < seconds <= 0.5, "an orphan ends 1.25 s after the death of its supervisor"
            now.s = next(looks, -1.0)
            then(now.s)
            return now.s < 0

        def leave(code: int) -> None:
            assert code == 1
            raise Exited

        worker._over = SimpleNamespace(wait=wait)
        monkeypatch.setattr(workers, "time", SimpleNamespace(monotonic=lambda: now.s))
        monkeypatch.setattr(workers.os, "_exit", leave)
        try:
            worker._watch_loop()
        except Exited:
            return now.s
        return None

    return run


DEAD = ProcessIdentity(os.getpid(), "another boot 1")


def test_orphaned_worker_stops_after_orphan_after_s_then_exits(new_worker, watch):
    worker = new_worker(orphan_after_s=30.0, drain_s=10.0)
    worker._parent.identity = DEAD
    object.__setattr__(worker, "folder", SimpleNamespace(clean=lambda role: None))
    assert watch(worker, 10.0, 39.0) is None and not worker.stop_requested()
    assert watch(worker, 40.0, 40.0 + ORPHAN_DRAIN_S, 41.5) == 41.5
    assert worker.stop_reason == "its supervisor has died"


def test_worker_keeps_running_with_living_or_next_supervisor(new_worker, watch):
    worker = new_worker(orphan_after_s=30.0)
    assert watch(worker, 1.0, 1e6) is None and not worker.stop_requested(), "run by hand"
    worker._parent.identity = ProcessIdentity.own()
    assert watch(worker, 2e6) is None and not worker.stop_requested()
    worker._parent.identity = DEAD
    next_one = asdict(ProcessIdentity.own())

    def adopt(now_s):
        if now_s > 3e6:
            worker._handlers["ping"]({"supervisor": next_one})

    assert watch(worker, 3e6, 3e6 + 20, 3e6 + 40, then=adopt) is None and not worker.stop_requested()
    with pytest.raises(BadMessage, match="no identity"):
        worker._handlers["ping"]({"supervisor": {"pid": "x"}})


def test_worker_exits_if_not_finished_within_drain_s(new_worker, watch):
    worker = new_worker(drain_s=5.0)
    assert watch(worker, 1.0, 90.0) is None
    socket_file = runtime_file = worker.folder.path / "left"
    runtime_file.touch()
    stop = lambda now_s: worker.request_stop("requested") if now_s >= 100 else None
    assert watch(worker, 99.0, 100.0, 103.0, 105.0, then=stop) is None
    cleaned = []
    object.__setattr__(worker, "folder", SimpleNamespace(clean=cleaned.append))
    assert watch(worker, 200.0, 204.0, 205.1, 300.0) == 205.1
    assert cleaned == ["capture"] and socket_file.exists()
