"""Edges and ports: what a full edge does, ports of several messages, optional ports, loops, misuse; the same on every engine and scheduler."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from operators.errors import OperatorFailed, PortError, QueueFull
from operators.graph import (
    ConditionType,
    CountCondition,
    IOSpec,
    Operator,
    PeriodicCondition,
    StopReason,
)
from operators.graph.operator import InputContext


@pytest.mark.parametrize(("policy", "received"), [("drop_oldest", [2, 5, 8]), ("drop_new", [0, 3, 6])])
def test_edge_counts_dropped_messages_by_policy(kit, runner, policy, received):
    def wire(app):
        source, sink = app.counted(3, kit.Source, name="source", per_compute=3), kit.Collect(app, name="sink")
        app.add_flow(source, sink, policy=policy)
        return sink

    app = kit.Wired(wire)
    (stats,) = runner(app).edges
    assert stats.sent == 9 and stats.queued == 0
    assert stats.received + sum(stats.dropped.values()) == 9
    assert len(app.ops.values) == stats.received
    assert app.ops.values == sorted(app.ops.values)
    if policy == "drop_oldest":
        assert app.ops.values[-1] == 8
    if not runner.threads:
        assert app.ops.values == received
        assert stats.dropped == {policy: 6}


def test_drop_oldest_edge_does_not_block_producer(kit, runner):
    """The source continues while the consumer has not read its frame."""
    seen = threading.Event()

    def wire(app):
        source = app.counted(100, kit.Source, name="source")
        slow, fast = kit.Collect(app, name="viewer"), kit.Collect(app, name="recorder")
        if runner.threads:
            slow.function = lambda value: seen.wait(300)
            fast.function = lambda value: seen.set() if value == 99 else None
        app.add_flow(source, slow, policy="drop_oldest")
        app.add_flow(source, fast)
        return slow, fast

    app = kit.Wired(wire)
    result = runner(app)
    viewer, recorder = app.ops
    assert recorder.values == list(range(100))
    assert viewer.values[-1] == 99
    if runner.threads:
        assert len(viewer.values) <= 3
    stats = {edge.edge: edge for edge in result.edges}["source.out -> viewer.in"]
    assert stats.sent == 100 == stats.received + sum(stats.dropped.values())


def test_emitting_more_than_a_blocking_edge_holds_is_an_error(kit, runner):
    app = kit.Wired(lambda app: app.chain(app.counted(1, kit.Source, per_compute=2), kit.Collect(app)))
    with pytest.raises(OperatorFailed, match=r"Source.out -> Collect.in holds 1") as caught:
        runner(app)
    assert isinstance(caught.value.__cause__, QueueFull)


def test_edge_capacity_limits_messages_per_compute(kit, runner):
    with pytest.raises(OperatorFailed, match="holds 2"):
        # The default condition of an output asks for room for one message only.
        runner(
            kit.Wired(lambda app: app.chain(app.counted(4, kit.Source, per_compute=3), kit.Collect(app), capacity=2))
        )

    class Pairs(kit.Source):
        def setup(self, spec):
            super().setup(spec)
            spec.outputs["out"].condition(ConditionType.DOWNSTREAM_MESSAGE_AFFORDABLE, min_size=2)

    app = kit.Wired(lambda app: app.chain(app.counted(4, Pairs, per_compute=2), kit.Collect(app, name="c"), capacity=2))
    assert runner(app).computes["c"] == 8


class Batch(Operator):
    def setup(self, spec):
        spec.input("in", size=3)
        self.values = []

    def compute(self, op_input, op_output, context):
        self.values.append(op_input.receive("in"))


def test_input_of_size_n_receives_n_messages_per_compute(kit, runner):
    def wire(app):
        batch = Batch(app)
        app.chain(app.counted(7, kit.Source), batch)
        return batch

    app = kit.Wired(wire)
    (stats,) = runner(app).edges
    assert app.ops.values == [(0, 1, 2), (3, 4, 5)]
    assert stats.dropped == {"closed": 1}


class Many(Operator):
    def setup(self, spec):
        spec.input("in", size=IOSpec.ANY_SIZE)
        self.values = []

    def compute(self, op_input, op_output, context):
        self.values.append(op_input.receive("in"))


def test_any_size_input_receives_from_connections_in_order(kit, runner):
    def wire(app):
        many = Many(app)
        for factor in (1, 10, 100):
            scale = kit.Apply(app, name=f"x{factor}", function=lambda value, factor=factor: value * factor)
            app.chain(app.counted(3, kit.Source, name=f"s{factor}"), scale, many)
        return many

    app = kit.Wired(wire)
    runner(app)
    assert app.ops.values == [(0, 0, 0), (1, 10, 100), (2, 20, 200)]


class Optional(Operator):
    def setup(self, spec):
        spec.input("in")
        spec.input("hint", optional=True)
        spec.input("extra").condition(ConditionType.NONE)
        spec.output("debug", optional=True)
        self.values = []

    def compute(self, op_input, op_output, context):
        op_output.emit("unheard", "debug")
        self.values.append((op_input.receive("in"), op_input.receive("hint"), op_input.receive("extra")))


def test_optional_ports_may_stay_unconnected(kit, runner):
    def wire(app):
        optional = Optional(app)
        app.add_flow(app.counted(2, kit.Source), optional, {("out", "in")})
        return optional

    app = kit.Wired(wire)
    runner(app)
    assert app.ops.values == [(0, None, None), (1, None, None)]


class Feedback(Operator):
    def setup(self, spec):
        spec.input("in")
        spec.input("back").condition(ConditionType.NONE)
        spec.output("out")

    def compute(self, op_input, op_output, context):
        op_output.emit(op_input.receive("in") + (op_input.receive("back") or 0), "out")


def test_graph_with_feedback_loop_finishes(kit, greedy_runner):
    def wire(app):
        feedback, sink, tee = Feedback(app, name="sum"), kit.Collect(app, name="sink"), kit.Apply(app, name="tee")
        app.add_flow(app.counted(5, kit.Source), feedback, {("out", "in")})
        app.add_flow(feedback, tee)
        app.add_flow(tee, feedback, {("out", "back")}, policy="drop_oldest")
        app.add_flow(tee, sink)
        return sink

    app = kit.Wired(wire)
    assert greedy_runner(app).reason is StopReason.FINISHED
    assert app.ops.values == [0, 1, 3, 6, 10]


def test_periodic_operators_keep_their_rate(kit, runner):
    stamps = []

    class Clocked(kit.Source):
        def compute(self, op_input, op_output, context):
            stamps.append(context.clock.timestamp())
            super().compute(op_input, op_output, context)

    def wire(app):
        app.chain(Clocked(app, CountCondition(app, 4), PeriodicCondition(app, 20_000_000)), kit.Collect(app))

    runner(kit.Wired(wire))
    assert len(stamps) == 4
    assert stamps[-1] - stamps[0] >= 55_000_000


class Misuse(Operator):
    def setup(self, spec):
        spec.output("out", type=int)
        spec.param("act")

    def compute(self, op_input, op_output, context):
        self.act(op_input, op_output)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda ins, outs: outs.emit("text", "out"), "emitted str on output 'out'"),
        (lambda ins, outs: outs.emit(1, "elsewhere"), r"no output 'elsewhere'; it has \['out'\]"),
        (lambda ins, outs: ins.receive("in"), r"no input 'in'; it has \[\]"),
    ],
)
def test_port_misuse_raises_port_error(kit, runner, act, message):
    app = kit.Wired(lambda app: app.chain(Misuse(app, CountCondition(app, 1), act=act), kit.Collect(app)))
    with pytest.raises(OperatorFailed, match=message) as caught:
        runner(app)
    assert isinstance(caught.value.__cause__, PortError)


def test_context_find_operator_returns_operator_by_name(kit, runner):
    found = []

    class Finder(Operator):
        def compute(self, op_input, op_output, context):
            found.extend([context.find_operator("peer"), context.find_operator(), context.find_operator("nobody")])

    def wire(app):
        finder, peer = Finder(app, CountCondition(app, 1)), Finder(app, CountCondition(app, 0), name="peer")
        app.add_operator(finder)
        app.add_operator(peer)
        return peer, finder

    app = kit.Wired(wire)
    runner(app)
    assert found == [*app.ops, None]


def test_input_context_queued_counts_waiting_messages():
    ports = {"frame": SimpleNamespace(batched=False), "alone": SimpleNamespace(batched=False)}
    operator = SimpleNamespace(spec=SimpleNamespace(inputs=ports))
    waiting = [1, 2, 3]
    inputs = InputContext(operator, {"frame": [waiting]}, [])
    assert (inputs.queued("frame"), inputs.queued("alone")) == (3, 0)
    waiting.clear()
    assert inputs.queued("frame") == 0
