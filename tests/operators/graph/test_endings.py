"""Ends of runs (finished, stopped, deadlocked) with their reason, on every engine and scheduler."""

from __future__ import annotations

import threading
import time

import pytest

from operators.errors import GraphBusy, GraphDeadlock
from operators.graph import (
    AsynchronousCondition,
    AsynchronousEventState,
    BooleanCondition,
    CountCondition,
    Operator,
    PeriodicCondition,
    StopReason,
)


def test_finished_consumer_does_not_block_other_consumers(kit, runner):
    def wire(app):
        source = app.counted(20, kit.Source, name="source")
        few, all_ = kit.Collect(app, CountCondition(app, 3), name="few"), kit.Collect(app, name="all")
        app.add_flow(source, few)
        app.add_flow(source, all_)
        return few, all_

    app = kit.Wired(wire)
    result = runner(app)
    few, all_ = app.ops
    assert few.values == [0, 1, 2] and all_.values == list(range(20))
    assert result.reason is StopReason.FINISHED
    stats = {edge.edge: edge for edge in result.edges}["source.out -> few.in"]
    assert (stats.sent, stats.received, stats.queued, stats.dropped) == (20, 3, 0, {"closed": 17})


def test_join_without_input_does_not_block_its_other_producer(kit, runner):
    def wire(app):
        short, long = app.counted(2, kit.Source, name="short"), app.counted(9, kit.Source, name="long")
        join, sink = kit.Join(app, name="join"), kit.Collect(app, name="sink")
        app.add_flow(short, join, {("out", "left")})
        app.add_flow(long, join, {("out", "right")})
        app.add_flow(join, kit.Collect(app, name="pairs"))
        app.add_flow(long, sink)
        return sink

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    assert app.ops.values == list(range(9))


def test_source_finishes_if_only_consumer_is_finished(kit, runner):
    def wire(app):
        app.chain(kit.Source(app, name="endless"), kit.Collect(app, CountCondition(app, 4), name="sink"))

    app = kit.Wired(wire)
    result = runner(app)
    assert result.reason is StopReason.FINISHED
    assert result.computes["sink"] == 4


def test_graph_deadlock_lists_waiting_operators_and_edges(kit, runner):
    def wire(app):
        source, join = app.counted(10, kit.Source, name="source"), kit.Join(app, name="join")
        nothing = kit.Apply(app, name="nothing", function=lambda value: None)
        app.add_flow(source, nothing)
        app.add_flow(nothing, join, {("out", "left")})
        app.add_flow(source, join, {("out", "right")})
        app.add_flow(join, kit.Collect(app, name="sink"))

    app = kit.Wired(wire)
    with pytest.raises(GraphDeadlock, match=r"source waits for room on source.out -> join.right") as caught:
        runner(app)
    assert caught.value.waiting == {
        "source": "room on source.out -> join.right (1 of 1 taken)",
        "nothing": "a message on source.out -> nothing.in",
        "join": "a message on nothing.out -> join.left",
        "sink": "a message on join.out -> sink.in",
    }
    assert app.result.reason is StopReason.DEADLOCK and app.result.computes["source"] == 1


def test_stop_execution_in_compute_ends_an_endless_graph(kit, runner):
    def wire(app):
        def stop_at(value):
            if value == 5:
                app.stop_execution()

        sink = kit.Collect(app, name="sink", function=stop_at)
        app.chain(kit.Source(app), sink)
        return sink

    app = kit.Wired(wire)
    result = runner(app)
    assert result.reason is StopReason.STOPPED and result.error is None
    assert app.ops.values == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("waiting_for", ["event", "time", "nothing"])
def test_stop_execution_from_other_thread_ends_waiting_graph(kit, runner, waiting_for):
    begun = threading.Event()

    class Waiting(Operator):
        def compute(self, op_input, op_output, context):
            if waiting_for == "event":
                self.conditions[0].event_state = AsynchronousEventState.EVENT_WAITING
            begun.set()

    def wire(app):
        conditions = {
            "event": AsynchronousCondition(app),
            "time": PeriodicCondition(app, 3600 * 10**9),
            "nothing": BooleanCondition(app),
        }
        app.add_operator(Waiting(app, conditions[waiting_for]))

    app = kit.Wired(wire)
    thread, outcome = runner.in_background(app)
    assert begun.wait(300)
    with pytest.raises(GraphBusy):
        app.run()
    app.stop_execution()
    thread.join(300)
    assert not thread.is_alive(), "stop_execution did not end the run"
    assert outcome[0].reason is StopReason.STOPPED


def test_operator_stop_execution_finishes_only_that_operator(kit, runner):
    def wire(app):
        source, sink = kit.Source(app, name="source"), kit.Collect(app, name="sink")
        sink.function = lambda value: source.stop_execution() if value == 3 else None
        app.chain(source, sink)
        return sink

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    assert app.ops.values[:4] == [0, 1, 2, 3]
    assert app.ops.values == list(range(len(app.ops.values)))


def test_event_from_other_thread_wakes_operator(kit, runner):
    class Driven(Operator):
        def start(self):
            self.computes = 0
            self.asleep = threading.Event()

        def compute(self, op_input, op_output, context):
            self.computes += 1
            self.conditions[0].event_state = AsynchronousEventState.EVENT_WAITING
            self.asleep.set()

    ready = threading.Event()

    class Started(Driven):
        def start(self):
            super().start()
            ready.set()

    def wire(app):
        driven = Started(app, AsynchronousCondition(app, name="camera"))
        app.add_operator(driven)
        return driven

    app = kit.Wired(wire)
    thread, outcome = runner.in_background(app)
    assert ready.wait(300)
    event = app.ops.conditions[0]
    for _ in range(3):
        assert app.ops.asleep.wait(300)
        app.ops.asleep.clear()
        time.sleep(0.02)
        event.event_state = AsynchronousEventState.EVENT_DONE
    assert app.ops.asleep.wait(300)
    time.sleep(0.02)
    event.event_state = AsynchronousEventState.EVENT_NEVER
    thread.join(300)
    assert not thread.is_alive(), "EVENT_NEVER did not end the run"
    assert outcome[0].reason is StopReason.FINISHED
    assert app.ops.computes == 4


def test_boolean_condition_finishes_the_operator(kit, runner):
    def wire(app):
        enabled = BooleanCondition(app)
        sink = kit.Collect(app, function=lambda value: enabled.disable_tick() if value == 2 else None)
        app.chain(kit.Source(app, enabled), sink)
        return sink

    app = kit.Wired(wire)
    assert runner(app).reason is StopReason.FINISHED
    assert app.ops.values[:3] == [0, 1, 2]
