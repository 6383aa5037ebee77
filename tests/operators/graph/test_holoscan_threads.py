"""Race conditions of the SDK's event-based scheduler, with the window between two threads widened."""

from __future__ import annotations

import threading
import time

import pytest

from operators.graph import BooleanCondition, MultiThreadScheduler, Operator, StopReason
from operators.graph.ports import LockedEdge

pytestmark = [
    pytest.mark.holoscan,
    pytest.mark.parametrize("runner", [("holoscan", MultiThreadScheduler)], ids=["holoscan"], indirect=True),
]


def test_producer_sees_room_made_after_sdk_notification(kit, runner, monkeypatch):
    take = LockedEdge.pop

    def take_late(edge):
        time.sleep(0.02)  # the SDK has handed out the message, and checks the producer
        return take(edge)

    monkeypatch.setattr(LockedEdge, "pop", take_late)

    def wire(app):
        source, left, right = app.counted(3, kit.Source), kit.Collect(app, name="left"), kit.Collect(app, name="right")
        app.add_flow(source, left)
        app.add_flow(source, right)
        return left, right

    app = kit.Wired(wire)
    runner(app)
    assert [sink.values for sink in app.ops] == [[0, 1, 2]] * 2


def test_gate_check_during_last_compute_does_not_end_operator(kit, runner, monkeypatch):
    from operators.graph.holoscan import Gate

    look, gates = Gate.check, {}

    def look_and_note(gate, timestamp):
        gates[gate.task.name] = gate
        return look(gate, timestamp)

    monkeypatch.setattr(Gate, "check", look_and_note)

    def work(value):
        while value == 2 and not gates["source"].task.finished:
            time.sleep(0.001)
        if value == 2:  # nothing is left to take and nothing will come
            look(gates["work"], 0)  # as by a thread that began to look before
            time.sleep(0.1)  # for the sink to see that nothing will come
        return value

    app = kit.Wired(lambda app: _through(app, kit, work))
    result = runner(app)
    assert app.ops.values == [0, 1, 2]
    assert all(edge.dropped == {} for edge in result.edges)


def _through(app, kit, function):
    sink = kit.Collect(app, name="sink")
    app.chain(app.counted(3, kit.Source, name="source"), kit.Apply(app, name="work", function=function), sink)
    return sink


def test_concurrent_gate_checks_do_not_restart_stopped_operator(kit, runner, monkeypatch):
    from operators.graph.holoscan import Gate

    look, computed = Gate.check, threading.Event()

    def look_long(gate, timestamp):
        verdict = look(gate, timestamp)
        if gate.task.computes == 1 and not gate.task.graph.stopping:
            time.sleep(0.2)  # until what it saw is of the past
        return verdict

    class Endless(Operator):
        def compute(self, op_input, op_output, context):
            computed.set()

    monkeypatch.setattr(Gate, "check", look_long)

    def wire(app):
        condition = BooleanCondition(app)
        app.add_operator(Endless(app, condition))
        return condition

    app = kit.Wired(wire)
    thread, outcome = runner.in_background(app)
    assert computed.wait(300)
    time.sleep(0.05)  # one thread looks because it has computed,
    app.ops.wake_scheduler()  # another because of this
    time.sleep(0.05)
    app.stop_execution()
    thread.join(300)
    assert outcome[0].reason is StopReason.STOPPED
