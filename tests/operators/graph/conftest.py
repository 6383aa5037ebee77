"""Operators for tests, engines to run them on, and a guard that turns a hang into a failure."""

from __future__ import annotations

import faulthandler
import itertools
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from operators.graph import (
    Application,
    Clock,
    CountCondition,
    GreedyScheduler,
    MultiThreadScheduler,
    Operator,
    RunResult,
    run,
)

GUARD_S = 300.0
ENGINES = [
    pytest.param(("embedded", GreedyScheduler), id="greedy"),
    pytest.param(("embedded", MultiThreadScheduler), id="threads"),
    pytest.param(("holoscan", GreedyScheduler), id="holoscan-greedy", marks=pytest.mark.holoscan),
    pytest.param(("holoscan", MultiThreadScheduler), id="holoscan-threads", marks=pytest.mark.holoscan),
]


class Source(Operator):
    """Emits 0, 1, 2, … with its number as `seq` in the metadata."""

    def setup(self, spec):
        spec.output("out")
        spec.param("per_compute", 1)
        spec.param("failing", ())

    def start(self):
        self.next = 0

    def compute(self, op_input, op_output, context):
        for _ in range(self.per_compute):
            seq = self.next
            self.next += 1
            self.metadata["seq"] = seq
            if seq in self.failing:
                raise ValueError(f"bad {seq}")
            op_output.emit(seq, "out")


class Apply(Operator):
    """Emits function(value), or nothing if that is None."""

    def setup(self, spec):
        spec.input("in")
        spec.output("out")
        spec.param("function", lambda value: value)

    def compute(self, op_input, op_output, context):
        value = self.function(op_input.receive("in"))
        if value is not None:
            op_output.emit(value, "out")


class Collect(Operator):
    """Keeps what it receives and its metadata; calls `function` on each value first."""

    def setup(self, spec):
        spec.input("in")
        spec.param("function", lambda value: None)
        self.values: list[Any] = []
        self.seqs: list[Any] = []

    def compute(self, op_input, op_output, context):
        value = op_input.receive("in")
        self.function(value)
        self.values.append(value)
        self.seqs.append(self.metadata.get("seq"))


class Join(Operator):
    """Emits pairs of its two inputs."""

    def setup(self, spec):
        spec.input("left")
        spec.input("right")
        spec.output("out")

    def compute(self, op_input, op_output, context):
        op_output.emit((op_input.receive("left"), op_input.receive("right")), "out")


class Recorder:
    """Lets operators record their life-cycle calls in one list."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []

    def __call__(self, kind: type[Operator]) -> type[Operator]:
        events = self.events

        class Recorded(kind):
            def initialize(self):
                events.append((self.name, "initialize"))
                super().initialize()

            def start(self):
                events.append((self.name, "start"))
                super().start()

            def stop(self):
                events.append((self.name, "stop"))
                super().stop()

        return Recorded

    def names(self, event: str) -> list[str]:
        return [name for name, what in self.events if what == event]


class Wired(Application):
    """An application composed by a function; `ops` holds what it returned."""

    def __init__(self, wire: Callable[[Wired], Any], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.wire = wire
        self.ops: Any = None

    def compose(self):
        self.ops = self.wire(self)

    def counted(self, count: int, kind: type[Operator] = Source, **kwargs: Any) -> Operator:
        """A source of `count` computes."""
        return kind(self, CountCondition(self, count), **kwargs)

    def chain(self, *operators: Operator, **kwargs: Any) -> None:
        """Connect operators in a row."""
        for one, other in itertools.pairwise(operators):
            self.add_flow(one, other, **kwargs)


def guarded(call: Callable[[], Any], timeout_s: float = GUARD_S, on_hang: Callable[[], None] | None = None) -> Any:
    """Return the call's result or exception; fail if it does not return in time."""
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["value"] = call()
        except BaseException as error:  # noqa: BLE001 - raised again in the test's thread
            outcome["error"] = error

    thread = threading.Thread(target=work, daemon=True, name="guarded")
    thread.start()
    thread.join(timeout_s)
    if thread.is_alive():
        faulthandler.dump_traceback()
        if on_hang is not None:
            on_hang()
        pytest.fail(f"hung for {timeout_s} s")
    if "error" in outcome:
        raise outcome["error"]
    return outcome["value"]


@pytest.fixture
def kit() -> SimpleNamespace:
    """The operators above."""
    return SimpleNamespace(
        Source=Source, Apply=Apply, Collect=Collect, Join=Join, Recorder=Recorder, Wired=Wired, guarded=guarded
    )


class Runner:
    """Runs applications on one engine and scheduler, guarded."""

    def __init__(self, engine: Any, scheduler: type) -> None:
        self.engine, self.kind = engine, scheduler
        self.threads = scheduler is MultiThreadScheduler

    def prepare(self, app: Application, clock: Clock | None = None) -> None:
        app.scheduler(self.kind(app, clock=clock))

    def __call__(self, app: Application, *, clock: Clock | None = None) -> RunResult:
        self.prepare(app, clock)
        return guarded(lambda: run(app, self.engine), on_hang=app.stop_execution)

    def in_background(self, app: Application) -> tuple[threading.Thread, list[Any]]:
        """Start a run. After the thread has been joined, the list holds its result or exception."""
        self.prepare(app)
        outcome: list[Any] = []

        def work() -> None:
            try:
                outcome.append(run(app, self.engine))
            except Exception as error:  # noqa: BLE001 - for the test to look at
                outcome.append(error)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        return thread, outcome


@pytest.fixture(params=ENGINES)
def runner(request: pytest.FixtureRequest) -> Runner:
    """Every engine with every scheduler."""
    engine, scheduler = request.param
    if engine == "holoscan":
        request.getfixturevalue("sdk")
    return Runner(engine, scheduler)


@pytest.fixture(params=[ENGINES[0], ENGINES[2]])
def greedy_runner(request: pytest.FixtureRequest) -> Runner:
    """Every engine with the greedy scheduler."""
    engine, scheduler = request.param
    if engine == "holoscan":
        request.getfixturevalue("sdk")
    return Runner(engine, scheduler)
