"""Rules by which a process counts as well, hung or ended, with a simulated clock."""

from __future__ import annotations

import asyncio
import os
import signal
from types import SimpleNamespace
from typing import Any

import pytest

from services.errors import NoAnswer
from services.supervisor import process as processes
from services.supervisor.launcher import Direct
from services.supervisor.process import ManagedProcess, Rate
from services.supervisor.worker import EngineSpec, ProcessLimits, ProcessSpec, SourceSpec


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: now.s))  # not the event loop's
    return now


def managed(runtime, role="engine", start=None, **spec: Any) -> ManagedProcess:
    part = {"capture": SourceSpec(address="synthetic:")} if role == "capture" else {"engine": EngineSpec()}
    events: list[Any] = []
    spec = {"stream": "theatre", **part, **spec}
    process = ManagedProcess(ProcessSpec(**spec), runtime.stream("theatre"), start or Direct(), events.append)
    process.events = events  # type: ignore[attr-defined]
    return process


def test_rate_covers_last_seconds_and_restarts_with_smaller_count():
    rate = Rate(3.0)
    assert rate.hz is None
    rate.tell(10, 0.0)
    rate.tell(12, 0.49)
    assert rate.hz is None, "too short a time"
    rate.tell(15, 0.5)
    assert rate.hz == 10.0
    for second in range(1, 8):
        rate.tell(15 + 30 * second, 0.5 + second)
    assert rate.hz == 30.0, "older counts are forgotten"
    rate.tell(225, 8.5)
    assert rate.hz == 20.0, "a count that stands still lowers it"
    rate.tell(3, 9.0)
    assert rate.hz is None, "a smaller count is that of a new process"
    rate.tell(3, 10.0)
    assert rate.hz == 0.0
    rate.clear()
    assert rate.hz is None


def test_rate_includes_count_at_start_of_its_interval():
    rate = Rate(3.0)
    for moment, count in ((0.0, 0), (1.0, 100), (4.0, 130)):
        rate.tell(count, moment)
    assert rate.hz == 10.0, "the count of exactly three seconds ago is the first"
    rate = Rate(3.0)
    for moment, count in ((0.0, 0), (1.0, 100), (3.9, 129)):
        rate.tell(count, moment)
    assert rate.hz == round(129 / 3.9, 2)


def test_hangs_reports_late_start_silence_and_missing_pictures(runtime, clock):
    process = managed(runtime, limits=ProcessLimits(start_s=20.0, heartbeat_s=3.0, hung_s=10.0))
    process._heard_s = 100.0
    assert process._hangs(120.0) is None
    assert process._hangs(120.1) == "it has not begun within 20 s"
    process._take({"state": "live", "figures": {"published": 0}})
    assert process._hangs(103.0) is None
    assert process._hangs(103.1) == "it has said nothing for 3.1 s"
    process._heard_s = 200.0
    assert process._hangs(200.0) is None, "one that has published nothing yet is not measured by it"
    clock.s = 200.0
    process._take({"state": "live", "figures": {"published": 5}})
    clock.s = 205.0
    process._take({"state": "live", "figures": {"published": 5}})
    process._heard_s = 211.0
    assert process._hangs(210.0) is None
    assert process._hangs(210.5) == "it has published nothing for 10.5 s"
    clock.s = 211.0
    process._take({"state": "live", "figures": {"published": 6}})
    assert process._hangs(213.0) is None


@pytest.mark.parametrize(
    ("role", "state", "figures", "well"),
    [
        ("engine", "live", {"published": 1}, True),
        ("engine", "running", {"published": 1}, True),
        ("engine", "running", {"published": 0}, False),
        ("engine", "starting", {"published": 1}, False),
        ("engine", "running", None, False),
        ("capture", "live", {}, True),
        ("capture", "opening", {}, False),
    ],
)
def test_process_is_well_from_first_working_heartbeat(runtime, clock, role, state, figures, well):
    process = managed(runtime, role)
    process._take({"state": state, "reason": "", "figures": figures})
    assert (process._well_s == 100.0) is well
    clock.s = 101.0
    process._take({"state": state, "reason": "", "figures": figures})
    assert process._well_s == (100.0 if well else 0.0)


def test_process_state_follows_heartbeats(runtime, clock):
    process = managed(runtime, "capture")
    state = process.state
    assert (state.state, state.reason, state.pid, state.restarts, state.figures, state.heard_s, state.rate_hz) == (
        "stopped", "it was not started", None, 0, {}, None, None,
    )  # fmt: skip
    process._identity = SimpleNamespace(pid=7)  # type: ignore[assignment]
    assert (process.state.state, process.state.pid, process.state.heard_s) == ("starting", 7, None)
    assert process.measures == {}
    for frames in (0, 30):
        process._take({"state": "live", "reason": "well", "figures": {"frames": frames}, "measures": {"a": frames}})
        clock.s += 1.0
    clock.s -= 0.75
    state = process.state
    assert (state.state, state.reason, state.pid, state.figures) == ("live", "well", 7, {"frames": 30})
    assert (state.heard_s, state.rate_hz) == (0.25, 30.0)
    assert process.measures == {"a": 30}
    process._take({"state": "live", "reason": "well", "figures": "junk", "measures": "junk"})
    assert process.state.figures == {} and process.measures == {}


@pytest.mark.parametrize(
    ("heartbeat", "reason"),
    [
        (None, None),
        ({"state": "ended", "reason": "no more frames"}, "no more frames"),
        ({"state": "failed", "reason": "no GPU"}, "no GPU"),
        ({"state": "live", "reason": "well"}, None),
    ],
)
def test_last_reason_is_from_ended_or_failed_heartbeat(runtime, heartbeat, reason):
    process = managed(runtime)
    process._heartbeat = heartbeat
    assert process._last_reason() == reason


def test_environment_limits_engine_to_its_gpu(runtime):
    assert managed(runtime, engine=EngineSpec(gpu=1))._environment() == {"CUDA_VISIBLE_DEVICES": "1"}
    assert managed(runtime, engine=EngineSpec(gpu=0))._environment() == {"CUDA_VISIBLE_DEVICES": "0"}
    assert managed(runtime)._environment() == {}
    assert managed(runtime, "capture")._environment() == {}


class Identity:
    """Process identity that records signals and ends on some of them."""

    pid = 7

    def __init__(self, *deadly: int) -> None:
        self.deadly, self.signals, self.over = deadly, [], asyncio.Event()
        self.waits: list[float | None] = []

    def signal(self, number: int) -> None:
        self.signals.append(number)
        if number in self.deadly:
            self.over.set()

    async def ended(self, within_s: float | None = None) -> bool:
        self.waits.append(within_s)
        if within_s is None:
            await self.over.wait()
        return self.over.is_set()


class Starter:
    """Process starter that records requests and starts nothing."""

    def __init__(self, how: str | None = None) -> None:
        self.how, self.asked, self.started = how, [], []

    async def start(self, module, arguments, output, environment, *, fresh):
        self.started.append((module, list(arguments), dict(environment), fresh))
        raise OSError("no space")

    async def how_ended(self, pid: int) -> str | None:
        self.asked.append(pid)
        return self.how


@pytest.mark.parametrize(
    ("deadly", "signals"),
    [
        ((signal.SIGTERM, signal.SIGKILL), [signal.SIGTERM, signal.SIGCONT]),
        ((signal.SIGKILL,), [signal.SIGTERM, signal.SIGCONT, signal.SIGKILL]),
    ],
)
def test_end_kills_process_after_drain_s(runtime, deadly, signals):
    async def end() -> tuple[Identity, Starter]:
        start, identity = Starter(), Identity(*deadly)
        process = managed(runtime, start=start, limits=ProcessLimits(drain_s=4.0))
        await process._end(identity)  # type: ignore[arg-type]
        return identity, start

    identity, start = asyncio.run(end())
    assert identity.signals == signals and identity.waits[0] == 4.0 and identity.over.is_set()
    assert start.asked == [7], "its exit status was fetched"


@pytest.mark.parametrize(
    ("how", "heartbeat", "said"),
    [
        ("signal 9", {"state": "failed", "reason": "no GPU"}, "signal 9"),
        (None, {"state": "failed", "reason": "no GPU"}, "no GPU"),
        (None, None, "it ended"),
    ],
)
def test_watched_prefers_exit_status_then_heartbeat_reason(runtime, how, heartbeat, said):
    async def watched() -> str:
        process, identity = managed(runtime, start=Starter(how)), Identity()
        process._heartbeat, process._heard_s = heartbeat, processes.time.monotonic()
        identity.over.set()
        return await process._watched(identity)  # type: ignore[arg-type]

    assert asyncio.run(watched()) == said


def test_watched_kills_hung_process_but_tolerates_supervisor_pause(runtime, clock, monkeypatch):
    monkeypatch.setattr(processes, "POLL_S", 0.001)

    async def watched() -> tuple[str, list[int]]:
        process, identity = managed(runtime, start=Starter("signal 9")), Identity(signal.SIGKILL)
        process._heartbeat, process._heard_s, process._shown = {"state": "live"}, clock.s, (4, clock.s)
        task = asyncio.create_task(process._watched(identity))  # type: ignore[arg-type]
        await asyncio.sleep(0.01)
        clock.s += 1000.0  # the supervisor stood still
        await asyncio.sleep(0.02)
        assert not task.done() and process._heard_s == clock.s == process._shown[1] and process._shown[0] == 4
        silent_s = process._spec.limits.heartbeat_s + 0.5
        for _ in range(int(silent_s / 0.5) + 2):
            clock.s += 0.5
            await asyncio.sleep(0.005)
        return await task, identity.signals

    how, signals = asyncio.run(watched())
    assert how.startswith("it has said nothing for") and how.endswith("; it was killed")
    assert signals == [signal.SIGKILL]


@pytest.mark.parametrize(
    ("restarts", "never_well", "role", "again", "fresh"),
    [(0, 0, "engine", False, False), (1, 2, "engine", True, False), (5, 3, "engine", True, True), (5, 3, "capture", False, True)],
)  # fmt: skip
def test_start_arguments_depend_on_earlier_ends(runtime, restarts, never_well, role, again, fresh):
    start = Starter()
    process = managed(runtime, role, start=start)
    process._restarts = SimpleNamespace(total=restarts, never_well=never_well)  # type: ignore[assignment]
    assert asyncio.run(process._started()) is None
    ((module, arguments, _, was_fresh),) = start.started
    assert module == f"services.supervisor.{role}" and ("--again" in arguments) is again and was_fresh is fresh
    assert process.state.state == "down" and process.state.reason == "it cannot be started: no space"


@pytest.mark.parametrize(("size", "kept"), [(1 << 20, True), ((1 << 20) + 1, False)])
def test_start_removes_log_over_1_mib(runtime, size, kept):
    process = managed(runtime, start=Starter())
    log = process._folder.log("engine")
    log.write_bytes(bytes(size))
    asyncio.run(process._started())
    assert log.exists() is kept


def test_command_raises_no_answer_if_process_is_not_running(runtime):
    with pytest.raises(NoAnswer, match="the engine process of theatre does not run: it was not started"):
        asyncio.run(managed(runtime).command("ping"))


def test_close_ends_process_with_stopped_event(runtime):
    async def close() -> tuple[Any, Identity]:
        process, identity = managed(runtime, start=Starter()), Identity(signal.SIGTERM)
        process._identity = identity  # type: ignore[assignment]
        await process.close("why")
        return process, identity

    process, identity = asyncio.run(close())
    assert identity.signals
    ((event),) = process.events
    assert (event.stream, event.role, event.kind, event.reason, event.pid) == (
        "theatre", "engine", "stopped", "why", 7,
    )  # fmt: skip
    assert (process.state.state, process.state.reason, process.state.pid) == ("stopped", "why", None)


def recorded(identity: Any, digest: str) -> Any:
    return SimpleNamespace(identity=identity, spec_digest=digest)


def test_running_process_with_same_spec_is_adopted(runtime, monkeypatch):
    process, identity = managed(runtime, start=Starter()), Identity(signal.SIGTERM)
    monkeypatch.setattr(process._folder, "record", lambda role: recorded(identity, process._spec.digest))
    process._heartbeat, process._well_s, process._shown = {"state": "ended"}, 5.0, (3, 5.0)
    process._rate.tell(1, 0.0)
    process._rate.tell(2, 1.0)
    assert asyncio.run(process._running()) is identity is process._identity
    ((event),) = process.events
    assert (event.kind, event.reason, event.pid) == ("adopted", "it ran already", 7)
    assert not identity.signals and not process._start.started
    # What the last process said does not count for this one.
    assert (process._heartbeat, process._well_s, process._shown, process._rate.hz) == (None, 0.0, (0, 0.0), None)


def test_running_process_with_other_spec_is_replaced(runtime, monkeypatch):
    process, identity = managed(runtime, start=Starter()), Identity(signal.SIGTERM)
    monkeypatch.setattr(process._folder, "record", lambda role: recorded(identity, "others"))
    assert asyncio.run(process._running()) is None, "the starter cannot start it"
    assert [event.kind for event in process.events] == ["replaced"] and process.events[0].pid == 7
    assert signal.SIGTERM in identity.signals and len(process._start.started) == 1


def supervise_ends(
    process: ManagedProcess, monkeypatch: pytest.MonkeyPatch, how: list[str | None], *, other: bool = False
) -> Any:
    """Supervise a process through given ends (None: failed start). Return the waits between them in seconds."""
    waits: list[float] = []
    ends, cleaned = iter(how), []

    async def running() -> Any:
        return None if how[len(waits)] is None else Identity()

    async def watched(identity: Any) -> str:
        process._identity = identity
        return str(next(ends))

    async def sleep(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == len(how):
            raise asyncio.CancelledError

    monkeypatch.setattr(process, "_running", running)
    monkeypatch.setattr(process, "_watched", watched)
    monkeypatch.setattr(process._folder, "clean", cleaned.append)
    monkeypatch.setattr(processes, "asyncio", SimpleNamespace(sleep=sleep))
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(process._keep())
    assert cleaned == [process._role] * len(how)
    return waits


def test_repeated_ends_lengthen_wait_before_restart(runtime, monkeypatch, clock):
    process = managed(runtime)
    waits = supervise_ends(process, monkeypatch, ["signal 9"] * 9)
    assert waits[0] == 0 and waits[1:] == sorted(waits[1:]) and waits[1] > 0
    assert waits[-1] == waits[-2] == processes.MOST_S
    assert process.causes and sum(process.causes.values()) == 9
    assert process._identity is None and process.state.state == "failed" and process.state.reason == "signal 9"
    assert [event.kind for event in process.events] == ["ended"] * 9


def test_process_that_ran_well_is_restarted_immediately(runtime, monkeypatch, clock):
    process = managed(runtime)
    process._well_s = clock.s - 3600
    assert supervise_ends(process, monkeypatch, ["signal 9"]) == [0.0]
    assert process.state.state == "down"
    assert supervise_ends(managed(runtime), monkeypatch, [None])[0] == 0.0


def test_unrecoverable_end_reports_last_words_of_log(runtime, monkeypatch, clock):
    process = managed(runtime)
    process._folder.log("engine").write_text("Traceback\nValueError: the last words\n", encoding="utf-8")
    monkeypatch.setattr(processes, "is_of_no_use", lambda how: True)
    monkeypatch.setattr(processes, "last_words", lambda log: log.read_text().splitlines()[-1])
    assert supervise_ends(process, monkeypatch, ["exit code 2"]) == [processes.MOST_S]
    assert process.state.state == "failed" and process.state.reason == "ValueError: the last words"
    monkeypatch.setattr(processes, "last_words", lambda log: None)
    assert supervise_ends(process, monkeypatch, ["exit code 2"]) == [processes.MOST_S]
    assert process.state.reason == "exit code 2"


def test_end_is_not_reported_if_another_process_holds_role(runtime, monkeypatch):
    process, rounds = managed(runtime), []

    async def running() -> Any:
        rounds.append(None)
        if len(rounds) == 3:
            raise asyncio.CancelledError
        return Identity()

    async def watched(identity: Any) -> str:
        return "signal 9"

    monkeypatch.setattr(process, "_running", running)
    monkeypatch.setattr(process, "_watched", watched)
    monkeypatch.setattr(process._folder, "record", lambda role: recorded(Identity(), "any"))
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(process._keep())
    assert process.events == [] and not process.causes and len(rounds) == 3


def test_ping_is_sent_only_after_first_heartbeat(runtime, monkeypatch):
    asked, rounds = [], []
    process = managed(runtime)

    async def ask(endpoint: Any, command: str, **arguments: Any) -> None:
        asked.append((command, arguments["supervisor"]["pid"]))

    async def sleep(seconds: float) -> None:
        rounds.append(seconds)
        if len(rounds) == 2:
            process._identity = Identity()  # type: ignore[assignment]
        if len(rounds) == 3:
            process._heartbeat = {}
        if len(rounds) == 5:
            raise asyncio.CancelledError

    monkeypatch.setattr(processes, "ask_async", ask)
    monkeypatch.setattr(processes, "asyncio", SimpleNamespace(sleep=sleep))
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(process._ping())
    assert asked == [("ping", os.getpid())] * 2


def test_listen_ignores_malformed_and_foreign_heartbeats(runtime, monkeypatch):
    """Foreign heartbeats come from an earlier process."""
    heard = [b'{"pid": 6, "state": "ended"}', b"nonsense", b'{"pid": 7, "state": "live"}']
    closed = []

    class Socket:
        async def recv(self) -> bytes:
            if not heard:
                raise asyncio.CancelledError
            return heard.pop(0)

        def close(self) -> None:
            closed.append(None)

    process = managed(runtime)
    process._identity = Identity()  # type: ignore[assignment]

    def subscribe(socket: Any, endpoint: Any, waiting: int) -> Socket:
        socket.close()
        return Socket()

    monkeypatch.setattr(processes, "subscribe", subscribe)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(process._listen())
    assert process._heartbeat == {"pid": 7, "state": "live"} and closed == [None]


def test_close_during_start_ends_the_started_process(runtime):
    async def close() -> tuple[int, list[Any]]:
        asked, children = asyncio.Event(), []

        class SlowStart(Direct):
            async def start(self, *arguments, **options):
                asked.set()
                await asyncio.sleep(0.05)  # a launcher's answer, which comes after its fork
                children.append(await asyncio.create_subprocess_exec("sleep", "60"))
                return children[0].pid

            async def how_ended(self, pid):
                return f"exit status {await children[0].wait()}"

        process = managed(runtime, start=SlowStart())
        process.open()
        await asyncio.wait_for(asked.wait(), 10)
        await process.close("it was requested")
        return children[0].returncode, process.events

    code, events = asyncio.run(close())
    assert code == -signal.SIGTERM
    assert events[-1].kind == "stopped"


@pytest.mark.parametrize("wrong", ["the specification", "the folder"])
def test_supervision_goes_on_after_file_errors(runtime, monkeypatch, wrong):
    monkeypatch.setattr(processes, "MOST_S", 0.01)
    monkeypatch.setattr(processes, "is_of_no_use", lambda how: True)  # a wait of MOST_S between starts

    async def run() -> list[str]:
        start = Starter()
        process = managed(runtime, start=start)
        folder = process._folder
        reasons = []
        if wrong == "the folder":
            folder.path.rmdir()
            folder.path.write_bytes(b"")  # nothing can be written into a file
        else:
            folder.spec("engine").mkdir()  # which a file cannot replace
        process.open()
        for _ in range(1000):
            await asyncio.sleep(0.005)
            if process._causes.total() >= 2 and not reasons:
                reasons.append(process.state.reason)
                assert not start.started
                if wrong == "the folder":
                    folder.path.unlink()
                else:
                    folder.spec("engine").rmdir()
            if start.started:
                break
        assert start.started, "it is started once the folder can be used"
        await process.close("done")
        return reasons

    assert asyncio.run(run())[0]
