"""Guarantees of each embedded scheduler."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
from types import SimpleNamespace

import pytest

from operators.errors import EngineUnsupported, GraphInvalid, OperatorStuck
from operators.graph import (
    AsynchronousCondition,
    AsynchronousEventState,
    GreedyScheduler,
    ManualClock,
    MultiThreadScheduler,
    Operator,
    PeriodicCondition,
    StopReason,
    run,
    schedulers,
)


def test_greedy_scheduler_order_is_topological_and_deterministic(kit):
    def trace(compose_backwards):
        order = []

        def noting(kind):
            class Noting(kind):
                def compute(self, op_input, op_output, context):
                    order.append(self.name)
                    super().compute(op_input, op_output, context)

            return Noting

        def wire(app):
            source, join = app.counted(3, noting(kit.Source), name="source"), noting(kit.Join)(app, name="join")
            left, right = (noting(kit.Apply)(app, name=name) for name in ("left", "right"))
            sink = noting(kit.Collect)(app, name="sink")
            if compose_backwards:
                app.add_operator(sink)
                app.add_operator(join)
            app.add_flow(source, left)
            app.add_flow(source, right)
            app.add_flow(left, join, {("out", "left")})
            app.add_flow(right, join, {("out", "right")})
            app.add_flow(join, sink)

        kit.guarded(kit.Wired(wire).run)
        return order

    assert trace(False) == ["source", "left", "right", "join", "sink"] * 3
    assert trace(True) == trace(False)


def test_greedy_scheduler_computes_in_calling_thread(kit):
    threads = set()
    app = kit.Wired(
        lambda app: app.chain(
            app.counted(2, kit.Source), kit.Collect(app, function=lambda value: threads.add(threading.current_thread()))
        )
    )
    app.run()
    assert threads == {threading.current_thread()}


def test_multi_thread_scheduler_refuses_manual_clock():
    with pytest.raises(GraphInvalid, match="ManualClock needs the GreedyScheduler"):
        MultiThreadScheduler(clock=ManualClock())


def test_multi_thread_scheduler_computes_branches_in_parallel(kit):
    """Each of two branches waits until the other computes, which one thread could not do."""
    meet = threading.Barrier(2, timeout=300)

    def wire(app):
        source = app.counted(3, kit.Source)
        for name in ("a", "b"):
            app.add_flow(source, kit.Collect(app, name=name, function=lambda value: meet.wait()))

    app = kit.Wired(wire)
    app.scheduler(MultiThreadScheduler(app))
    assert kit.guarded(app.run).reason is StopReason.FINISHED


def test_multi_thread_scheduler_delivers_1000_messages_in_order(kit):
    def wire(app):
        source, sink = app.counted(1000, kit.Source, name="source"), kit.Collect(app, name="sink")
        join, viewer = kit.Join(app, name="join"), kit.Collect(app, name="viewer")
        left, right = kit.Apply(app, name="left"), kit.Apply(app, name="right")
        app.add_flow(source, left)
        app.add_flow(source, right, capacity=3)
        app.add_flow(left, join, {("out", "left")})
        app.add_flow(right, join, {("out", "right")})
        app.add_flow(join, sink)
        app.add_flow(source, viewer, policy="drop_oldest")
        return sink, viewer

    app = kit.Wired(wire)
    app.scheduler(MultiThreadScheduler(app))
    result = kit.guarded(app.run, on_hang=app.stop_execution)
    sink, viewer = app.ops
    assert sink.values == [(i, i) for i in range(1000)]
    assert viewer.values[-1] == 999
    for edge in result.edges:
        assert edge.sent == edge.received + sum(edge.dropped.values()) and edge.queued == 0


def test_operator_stuck_error_names_operator_that_does_not_return(kit):
    release, entered = threading.Event(), threading.Event()
    life = kit.Recorder()

    def hang(value):
        entered.set()
        release.wait(300)

    def wire(app):
        app.chain(life(kit.Source)(app, name="source"), life(kit.Collect)(app, name="stubborn", function=hang))

    app = kit.Wired(wire)
    app.scheduler(MultiThreadScheduler(app, stop_timeout_s=0.2))
    future = app.run_async()
    assert entered.wait(300)
    app.stop_execution()
    try:
        with pytest.raises(OperatorStuck, match=r"0.2 s after the graph stopped: stubborn"):
            future.result(300)
    finally:
        release.set()
    assert life.names("stop") == ["source"], "an operator that still computes must not be entered by stop"


def test_run_async_can_be_stopped_immediately(kit):
    app = kit.Wired(lambda app: app.chain(kit.Source(app), kit.Collect(app)))
    for _ in range(20):
        future = app.run_async()
        app.stop_execution()
        assert future.result(300).reason is StopReason.STOPPED


def test_event_wakes_greedy_scheduler_during_periodic_wait(kit):
    """An event wakes its operator although another operator waits for an hour."""
    asleep, woken = threading.Event(), threading.Event()

    class Driven(Operator):
        def compute(self, op_input, op_output, context):
            if asleep.is_set():
                woken.set()
            self.conditions[0].event_state = AsynchronousEventState.EVENT_WAITING
            asleep.set()

    class Idle(Operator):
        def compute(self, op_input, op_output, context):
            pass

    def wire(app):
        app.add_operator(Idle(app, PeriodicCondition(app, 3600 * 10**9)))
        event = AsynchronousCondition(app)
        app.add_operator(Driven(app, event))
        return event

    app = kit.Wired(wire)
    future = app.run_async()
    assert asleep.wait(300)
    app.ops.event_state = AsynchronousEventState.EVENT_DONE
    assert woken.wait(300)
    app.stop_execution()
    assert future.result(300).reason is StopReason.STOPPED


def test_run_refuses_unknown_engine(kit):
    with pytest.raises(ValueError, match="unknown engine 'cuda'; choose embedded or holoscan"):
        run(kit.Wired(lambda app: None), "cuda")


@pytest.mark.holoscan
def test_holoscan_engine_refuses_scheduler_without_counterpart(kit, sdk):
    class Own:
        pass

    app = kit.Wired(lambda app: None)
    app.scheduler(Own())
    with pytest.raises(EngineUnsupported, match="no scheduler like Own"):
        run(app, "holoscan")


INTERRUPTED = """
    import os, signal, sys, threading
    from operators.graph import *

    class Tick(Operator):
        def compute(self, op_input, op_output, context):
            if MODE == "busy":
                import time; time.sleep(0.001)
            ticked.set()
        def stop(self):
            print("stopped", flush=True)

    ENGINE, SCHEDULER, MODE, WHERE = sys.argv[1:]
    ticked = threading.Event()

    class App(Application):
        def compose(self):
            self.add_operator(Tick(self, *([PeriodicCondition(self, 3600 * 10**9)] if MODE == "idle" else [])))

    def interrupt():
        ticked.wait()
        signal.pthread_kill(THREAD, signal.SIGINT)

    app = App()
    app.scheduler((GreedyScheduler if SCHEDULER == "GreedyScheduler" else MultiThreadScheduler)(app))
    interrupter = threading.Thread(target=interrupt, daemon=True)
    interrupter.start()
    THREAD = threading.main_thread().ident if WHERE == "main thread" else interrupter.ident
    try:
        run(app, ENGINE)
    except KeyboardInterrupt:
        print("interrupted", app.result.reason.value, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["busy", "idle"])
@pytest.mark.parametrize("where", ["main thread", "other thread"])  # the main one sleeps through what another is handed
def test_ctrl_c_stops_all_operators_and_run_raises_keyboard_interrupt(runner, mode, where):
    command = [sys.executable, "-c", textwrap.dedent(INTERRUPTED), runner.engine, runner.kind.__name__, mode, where]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ, check=False)
    assert done.stdout.split("\n")[:2] == ["stopped", "interrupted stopped"], done.stderr
    assert done.returncode == 0


TERMINATED = """
    import os, signal, sys, time
    from operators.graph import *

    class Once(Operator):
        def compute(self, op_input, op_output, context):
            pass

    class App(Application):
        def compose(self):
            self.add_operator(Once(self, CountCondition(self, 1)))

    run(App(), sys.argv[1])
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(30)
"""


def test_sigterm_still_ends_the_process_after_a_run(runner):
    command = [sys.executable, "-c", textwrap.dedent(TERMINATED), runner.engine]
    done = subprocess.run(command, capture_output=True, timeout=300, check=False)
    assert done.returncode == -signal.SIGTERM, done.stderr


def test_greedy_scheduler_waits_until_operator_is_due(monkeypatch):
    waits = []
    monkeypatch.setattr(schedulers, "interruptible_wait", lambda woken, seconds=None: waits.append(seconds))
    scheduler = GreedyScheduler(clock=SimpleNamespace(timestamp=lambda: 3_000_000_000))
    assert scheduler._await(3_250_000_000, False) and waits == [pytest.approx(0.25)]
    assert scheduler._await(None, True) and waits[1:] == [None]
    assert not scheduler._await(None, False)
    scheduler.wake()
    assert scheduler._await(None, False) and len(waits) == 2
